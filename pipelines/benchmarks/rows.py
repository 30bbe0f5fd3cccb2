"""Benchmarks: figures with a goal, a reference ("rival"), n and spread, measured in one run. ``make bench``, ``make bench
ONLY=ingest``.

A module of this folder registers a benchmark with ``@benchmark("name")``: a function that yields ``Row``s.
Timings are CPU-seconds or ratios within one run, because machines are shared and noisy. A goal is never one of CPU-seconds:
machines differ by four times. It is a ratio to a rival, or to a step of the reference loop, measured in the same run
(``against_reference``).
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Self

from taccorl.errors import TaccorlError

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

    @classmethod
    def of(
        cls,
        values: Sequence[float],
        *,
        by: Callable[[list[float]], float] = median,
        **facts: Any,
    ) -> Self:
        """The row of measurements ``values`` (n,) in the row's unit: its value is ``by`` of them."""
        return cls(
            value=by(list(values)), n=len(values), spread=spread(values), **facts
        )


BENCHMARKS: dict[str, Callable[[], Iterator[Row]]] = {}


def benchmark(
    name: str,
) -> Callable[[Callable[[], Iterator[Row]]], Callable[[], Iterator[Row]]]:
    """Register a function that yields rows under ``name``."""

    def add(fn: Callable[[], Iterator[Row]]) -> Callable[[], Iterator[Row]]:
        BENCHMARKS[name] = fn
        return fn

    return add


def spread(values: Sequence[float]) -> float:
    """Half the range (largest − smallest) of the measurements."""
    return (max(values) - min(values)) / 2


def cpu_times_s(work: Callable[[], object], repeats: int) -> list[float]:
    """CPU-seconds of each of ``repeats`` calls of ``work``, after one warm-up call."""
    times = []
    for _ in range(1 + repeats):
        before = time.process_time()
        work()
        times.append(time.process_time() - before)
    return times[1:]


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
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}<worldbody>{chain}</worldbody></mujoco>"
    )

    def swing() -> None:
        data = mujoco.MjData(model)
        data.qpos[:] = 0.1
        mujoco.mj_step(model, data, nstep=REFERENCE_STEPS)

    return median(cpu_times_s(swing, repeats)) / REFERENCE_STEPS


def against_reference(name: str, cpu_s: Sequence[float], goal: str = "") -> Row:
    """Row with the costs just measured, in steps of the reference loop, which is measured in the same run."""
    step_s = reference_step_s()
    rival = {"rival": "one reference step, µs CPU", "rival_value": 1e6 * step_s}
    return Row.of(
        [cost / step_s for cost in cpu_s],
        name=name,
        unit="reference steps",
        goal=goal,
        **rival,
    )


def meets(value: float, goal: str) -> bool | None:
    """Whether a value meets a goal: ``meets(4.2, "≥ 4")`` is True. None without a goal."""
    if not goal:
        return None
    sign, _, bound = goal.partition(" ")
    try:
        limit = float(bound.split()[0].replace(",", ""))
        return {
            "≥": value >= limit,
            "≤": value <= limit,
            "<": value < limit,
            ">": value > limit,
            "=": value == limit,
        }[sign]
    except (KeyError, ValueError, IndexError) as error:
        raise TaccorlError(
            f"goal {goal!r} cannot be read; write it like '≥ 4' or '< 1.5'"
        ) from error
