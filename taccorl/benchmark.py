"""Benchmarks: figures with a goal, a reference ("rival"), n and spread, measured in one run. ``make bench``, ``make bench
ONLY=ingest``.

A package registers its benchmarks in a module ``benchmarks`` with ``@benchmark("name")``: a function that yields ``Row``s.
Timings are CPU-seconds or ratios within one run, because machines are shared and noisy. A goal is never one of CPU-seconds:
machines differ by four times. It is a ratio to a rival, or to a step of the reference loop, measured in the same run
(``against_reference``). All rows go to ``bench.json``; ``docs/benchmarks.md`` is rendered from it.
"""

import dataclasses
import datetime
import importlib
import importlib.util
import json
import os
import pkgutil
import platform
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import taccorl
from taccorl.errors import TaccorlError, nearest

ROOT = Path(taccorl.__file__).resolve().parents[1]
JSON_PATH = ROOT / "bench.json"
PAGE_PATH = ROOT / "docs" / "benchmarks.md"
REFERENCE_LINKS = 12
REFERENCE_STEPS = 20_000


@dataclass(frozen=True, kw_only=True)
class Row:
    """One figure of a benchmark, with goal, rival, number of measurements and spread."""

    name: str
    value: float
    unit: str
    goal: str = ""
    """Condition such as "≥ 4" or "< 1.5"; empty: no goal, for information."""
    rival: str = ""
    """Reference that the figure is compared with, measured in the same run."""
    rival_value: float | None = None
    n: int
    """Number of measurements."""
    spread: float
    """(largest − smallest) / 2 of the n measurements, in the row's unit."""
    met: bool | None = None
    command: str = ""
    machine: str = ""
    date: str = ""


BENCHMARKS: dict[str, Callable[[], Iterator[Row]]] = {}


def benchmark(name: str) -> Callable[[Callable[[], Iterator[Row]]], Callable[[], Iterator[Row]]]:
    """Register a function that yields rows under ``name``."""

    def add(fn: Callable[[], Iterator[Row]]) -> Callable[[], Iterator[Row]]:
        BENCHMARKS[name] = fn
        return fn

    return add


def spread(values: list[float]) -> float:
    """Half the range (largest − smallest) of the measurements."""
    return (max(values) - min(values)) / 2


def cpu_s(*, children: bool = False) -> float:
    """CPU-seconds (user + system) of this process and, with ``children``, of those that ended."""
    usages = [resource.getrusage(resource.RUSAGE_SELF)]
    if children:
        usages.append(resource.getrusage(resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in usages)


def reference_step_s(repeats: int = 3) -> float:
    """CPU-seconds of one step of the reference loop, median of ``repeats`` loops: a chain of 12 links that swings in MuJoCo.

    10 to 12 µs on two cores of an Intel Xeon (November 2026). Goals that once were CPU-seconds count 10 µs a step. The loop stays
    in the cache: what memory bounds, or a disk, wants a rival of its own kind.
    """
    import mujoco

    links = [
        f'<body pos="0 0 {-0.2 if k else 0}"><joint axis="{k % 2} {1 - k % 2} 0" damping="0.01"/>'
        '<geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2"/>'
        for k in range(REFERENCE_LINKS)
    ]
    option = '<option timestep="0.001" integrator="implicitfast"/>'
    chain = "".join(links) + "</body>" * REFERENCE_LINKS
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{chain}</worldbody></mujoco>")
    times = []
    for _ in range(repeats):
        data = mujoco.MjData(model)
        data.qpos[:] = 0.1
        before = time.process_time()
        mujoco.mj_step(model, data, nstep=REFERENCE_STEPS)
        times.append(time.process_time() - before)
    return median(times) / REFERENCE_STEPS


def against_reference(name: str, cpu_s: Sequence[float], goal: str = "") -> Row:
    """Row with the costs just measured, in steps of the reference loop, which is measured in the same run."""
    step_s = reference_step_s()
    steps = [cost / step_s for cost in cpu_s]
    return Row(
        name=name,
        value=median(steps),
        unit="reference steps",
        goal=goal,
        rival="one reference step, µs CPU",
        rival_value=1e6 * step_s,
        n=len(steps),
        spread=spread(steps),
    )


def meets(value: float, goal: str) -> bool | None:
    """Whether a value meets a goal: ``meets(4.2, "≥ 4")`` is True. None without a goal."""
    if not goal:
        return None
    sign, _, bound = goal.partition(" ")
    try:
        limit = float(bound.split()[0].replace(",", ""))
        return {"≥": value >= limit, "≤": value <= limit, "<": value < limit, ">": value > limit, "=": value == limit}[
            sign
        ]
    except (KeyError, ValueError, IndexError) as error:
        raise TaccorlError(f"goal {goal!r} cannot be read; write it like '≥ 4' or '< 1.5'") from error


def machine() -> str:
    """Number of cores and name of the processor, without the name of the host."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    return f"{os.cpu_count()} cores, {model}, shared"


def run(only: str | None = None) -> list[Row]:
    """Run all benchmarks, or the one named ``only``, and store their rows, those of each as soon as it is done."""
    for package in pkgutil.iter_modules(taccorl.__path__):
        name = f"taccorl.{package.name}.benchmarks"
        if package.ispkg and importlib.util.find_spec(name):
            importlib.import_module(name)
    if only is not None and only not in BENCHMARKS:
        raise TaccorlError(f"no benchmark {only!r}; {nearest(only, BENCHMARKS)}")
    rows: list[Row] = []
    for name in [only] if only else list(BENCHMARKS):
        print(f"bench {name} …", flush=True)
        first = len(rows)
        for row in BENCHMARKS[name]():
            full = dataclasses.replace(
                row,
                name=f"{name}: {row.name}",
                value=float(row.value),  # NumPy's numbers are not JSON's
                spread=float(row.spread),
                met=meets(float(row.value), row.goal),
                command=f"make bench ONLY={name}",
                machine=machine(),
                date=datetime.date.today().isoformat(),
            )
            print(f"  {_line(full)}", flush=True)
            rows.append(full)
        _store(rows[first:])
    print(f"{JSON_PATH.name} and {PAGE_PATH.relative_to(ROOT)} written")
    return rows


def _line(row: Row) -> str:
    met = {True: "met", False: "NOT MET", None: ""}[row.met]
    rival = f"; {row.rival}: {row.rival_value:.4g}" if row.rival_value is not None else ""
    return f"{row.name}: {row.value:.4g} ± {row.spread:.2g} {row.unit} (n={row.n}{rival}) {row.goal} {met}".rstrip()


def _store(rows: list[Row]) -> None:
    """Instead of the rows that the same benchmark made on the same machine; those of other machines stay beside them."""
    before = json.loads(JSON_PATH.read_text()) if JSON_PATH.exists() else []
    replaced = {(r.name.split(":")[0], r.machine) for r in rows}
    kept = [r for r in before if (r["name"].split(":")[0], r["machine"]) not in replaced]
    merged = kept + [dataclasses.asdict(r) for r in rows]
    merged.sort(key=lambda r: r["name"].split(":")[0])
    JSON_PATH.write_text(json.dumps(merged, indent=1, ensure_ascii=False) + "\n")
    PAGE_PATH.parent.mkdir(exist_ok=True)
    PAGE_PATH.write_text(render(merged))


def render(rows: list[dict[str, Any]]) -> str:
    """Text of docs/benchmarks.md for all rows."""
    lines = [
        "# Benchmarks",
        "",
        "Written by `make bench` from `bench.json`; do not edit. Value ± half the range of n measurements. Timings are",
        "CPU-seconds or ratios within one run: the machine is shared. A reference step is one MuJoCo step of a chain of 12",
        "links, run beside what is measured: machines differ by four times. Goals in CPU-seconds that were not measured again",
        "since are not judged. Recordings and the twin are simulated: no robot was near.",
        "",
        "| what | value | unit | goal | met | rival in the same run | n | command | machine | date |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        met = {True: "yes", False: "**no**", None: ""}[r["met"]]
        rival = f"{r['rival']}: {r['rival_value']:.4g}" if r["rival_value"] is not None else r["rival"]
        value = f"{r['value']:.4g} ± {r['spread']:.2g}"
        cells = [
            r["name"],
            value,
            r["unit"],
            r["goal"],
            met,
            rival,
            str(r["n"]),
            f"`{r['command']}`",
            r["machine"],
            r["date"],
        ]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Command line: ``python -m taccorl.benchmark [--only=name]``."""
    words = sys.argv[1:]
    only = [a.removeprefix("--only=") for a in words if a.startswith("--only=")]
    if len(only) != len(words) or len(words) > 1:
        print(f"unknown {' '.join(words)!r}; usage: python -m taccorl.benchmark [--only=name]", file=sys.stderr)
        return 2
    try:
        # The module run as __main__ is another one than taccorl.benchmark, where the packages register.
        rows = importlib.import_module("taccorl.benchmark").run(only[0] if only else None)
    except TaccorlError as error:
        print(error, file=sys.stderr)
        return 2
    missed = [r.name for r in rows if r.met is False]
    print(f"{len(rows)} figures, {len(missed)} short of their goal" + (f": {'; '.join(missed)}" if missed else ""))
    return 0


if __name__ == "__main__":
    sys.exit(main())
