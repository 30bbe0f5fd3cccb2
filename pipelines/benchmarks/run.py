"""Run benchmarks; store all rows in ``bench.json`` and render ``docs/benchmarks.md`` from it."""

import dataclasses
import datetime
import importlib
import json
import os
import pkgutil
import platform
import re
import sys
from pathlib import Path
from typing import Any

from pipelines.benchmarks.rows import BENCHMARKS, Row, meets
from taccorl.errors import TaccorlError, nearest

ROOT = Path(__file__).resolve().parents[2]
JSON_PATH = ROOT / "bench.json"
PAGE_PATH = ROOT / "docs" / "benchmarks.md"


def machine() -> str:
    """Number of cores and name of the processor, without the name of the host."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in info.read_text().splitlines()
            if line.startswith("model name")
        ]
        model = names[0] if names else model
    return f"{os.cpu_count()} cores, {model}, shared"


def run(only: str | None = None) -> list[Row]:
    """Run all benchmarks, or the one named ``only``, and store their rows, those of each as soon as it is done."""
    for module in pkgutil.iter_modules([str(Path(__file__).parent)]):
        if not module.name.startswith("__"):
            importlib.import_module(f"{__package__}.{module.name}")
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
    rival = (
        f"; {row.rival}: {row.rival_value:.4g}" if row.rival_value is not None else ""
    )
    return f"{row.name}: {row.value:.4g} ± {row.spread:.2g} {row.unit} (n={row.n}{rival}) {row.goal} {met}".rstrip()


def _store(rows: list[Row]) -> None:
    """Instead of the rows that the same benchmark made on the same machine; those of other machines stay beside them."""
    before = json.loads(JSON_PATH.read_text()) if JSON_PATH.exists() else []
    replaced = {(r.name.split(":")[0], r.machine) for r in rows}
    kept = [
        r for r in before if (r["name"].split(":")[0], r["machine"]) not in replaced
    ]
    merged = kept + [dataclasses.asdict(r) for r in rows]
    merged.sort(key=lambda r: r["name"].split(":")[0])
    JSON_PATH.write_text(json.dumps(merged, indent=1, ensure_ascii=False) + "\n")
    PAGE_PATH.parent.mkdir(exist_ok=True)
    PAGE_PATH.write_text(render(merged))


def render(rows: list[dict[str, Any]]) -> str:
    """Text of docs/benchmarks.md: the figures of each benchmark's latest run that are judged by a goal. Figures of several
    subjects, such as tasks, share a line."""
    judged = [r for r in rows if r["met"] is not None]
    latest = {
        r["name"].partition(": ")[0]: r["machine"]
        for r in sorted(judged, key=lambda r: r["date"])
    }
    groups: dict[tuple[str, ...], list[tuple[str, str, dict[str, Any]]]] = {}
    letters: dict[str, str] = {}
    for r in judged:
        name, _, what = (
            re.sub(r" \((95 %:|median) [^)]*\)", "", r["name"])
            .partition("; ")[0]
            .partition(": ")
        )
        if latest[r["name"].partition(": ")[0]] == r["machine"]:
            family, subject = (
                ("mimicgen_*", name[9:]) if name.startswith("mimicgen_") else (name, "")
            )
            own, rest = "", what
            if not subject and (parts := re.fullmatch(r"(?:([\w-]+)[:,] )?(.*)", what)):
                own, rest = parts.groups("")
            letter = letters.setdefault(r["machine"], chr(65 + len(letters)))
            place = f"**{family}** | {letter}, {r['date']}"
            groups.setdefault((place, rest, r["unit"], r["goal"]), []).append(
                (subject or own, what, r)
            )
    lines = [
        "# Benchmarks",
        "",
        "`make bench` writes `bench.json`, with all figures and references, and this page, with those that have a goal;",
        "`make bench ONLY=x` runs one. … repeats the row above. Value ± half the range of n measurements (of a yield: half",
        "its 95 % interval), **bold** where the goal is missed. A reference step is one MuJoCo step of a chain of 12 links.",
        "All is simulated. A robot's loop: its [dry run](robot.md). Machines:",
        "; ".join(f"{letter} {name}" for name, letter in letters.items()) + ".",
        "",
        "| what | value | goal | n |",
        "|---|---|---|---|",
    ]
    before, above = "", ""
    for (place, rest, unit, goal), members in groups.items():
        if place != before:
            before, above = place, ""
            lines.append(f"| {place} | | |")
        what = members[0][1] if len(members) == 1 else rest
        values = [
            f"{r['value']:.4g}" + f" ± {r['spread']:.2g}" * bool(r["spread"])
            for _, _, r in members
        ]
        values = [
            v if r["met"] else f"**{v}**"
            for v, (_, _, r) in zip(values, members, strict=True)
        ]
        if len(members) > 1:
            values = [
                f"{subject} {v}"
                for v, (subject, _, _) in zip(values, members, strict=True)
            ]
        sizes = " … ".join(
            str(n)
            for n in sorted({f([r["n"] for _, _, r in members]) for f in (min, max)})
        )
        cells = [
            _unrepeated(what, above),
            ", ".join(values) + f" {unit}" * (unit != "1"),
            goal,
            sizes,
        ]
        lines.append(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
        )
        above = what
    return "\n".join(lines) + "\n"


def _unrepeated(what: str, above: str) -> str:
    """``what`` with the parts up to a comma or colon that it shares with the row above as "…"."""
    parts, before = (re.split(r"(?<=[,:]) ", text) for text in (what, above))
    shared = next(
        (
            k
            for k, (one, other) in enumerate(zip(parts, before, strict=False))
            if one != other
        ),
        len(parts),
    )
    return " ".join(["…", *parts[shared:]]) if shared else what


def main() -> int:
    """``python -m pipelines.benchmarks [--only=name]``"""
    words = sys.argv[1:]
    only = [a.removeprefix("--only=") for a in words if a.startswith("--only=")]
    if len(only) != len(words) or len(words) > 1:
        print(
            f"unknown {' '.join(words)!r}; usage: python -m pipelines.benchmarks [--only=name]",
            file=sys.stderr,
        )
        return 2
    try:
        rows = run(only[0] if only else None)
    except TaccorlError as error:
        print(error, file=sys.stderr)
        return 2
    missed = [r.name for r in rows if r.met is False]
    print(
        f"{len(rows)} figures, {len(missed)} short of their goal"
        + (f": {'; '.join(missed)}" if missed else "")
    )
    return 0
