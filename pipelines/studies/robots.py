"""Is the search right on robots other than the PiPER? Simulated robots of ``studies.foreign``, one hidden effect or none each.

``python -m pipelines.studies.robots rows.jsonl`` runs the cases that the file lacks and counts all. Exact: the hidden effect
is the one that is added first, pairs that no angle tells apart counted as one. Named: it is that, or named with it as a tie,
a rival or a near-twin by nature. Silent: nothing hidden, and no effect is added. Material: the validation error, always
fitted numbers refitted, is at least 1.5 noise floors.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

from pipelines.studies.foreign import KINDS, ROBOTS, draw, with_robot
from taccorl.diagnosis.problems.joints import diagnose_joint
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.evaluation.statistics import wilson_interval
from taccorl.sim.effects import effects

MATERIAL_FLOORS = 1.5
NUM_HIDDEN, NUM_CLEAN = 60, 30
FIRST_SEED, FIRST_CLEAN_SEED = 60_000, 70_000
ALIKE = ({"coulomb_friction", "asymmetric_friction"}, {"command_delay", "sensor_delay"})
"""Pairs that no angle tells apart."""


def jobs() -> list[tuple[int, str]]:
    """(seed, hidden effect or nothing): kinds in turn, so that the first rows are a sample of all."""
    kinds = list(KINDS)
    hidden = [(FIRST_SEED + k, kinds[k % len(kinds)]) for k in range(NUM_HIDDEN)]
    clean = [(FIRST_CLEAN_SEED + k, "") for k in range(NUM_CLEAN)]
    return [
        job
        for k, one in enumerate(hidden)
        for job in (one, *clean[k // 2 : k // 2 + 1 - k % 2])
    ]


def run(job: tuple[int, str]) -> dict[str, Any]:
    """Draw the robot, record it, diagnose the joint by its robot file with commanded gains."""
    seed, hidden = job
    case = draw(seed, hidden)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        robot, measurements = with_robot(case, Path(folder))
        recorded = time.process_time()
        found = diagnose_joint(
            robot, case.joint, measurements, search=SearchConfig(max_effects=1)
        ).diagnosis
    first = found.rounds[0] if found.rounds else None
    added = first.added if first is not None else None
    beside = (
        {*found.rivals.get(added, ()), *effects.get(added).near_twins}
        if added
        else set[str]()
    )
    return {
        "seed": seed,
        "hidden": hidden,
        "robot": case.robot,
        "joint": case.joint,
        "effort": case.effort,
        "strength": round(case.strength, 4),
        "added": added,
        "beside": sorted(beside),
        "fitted": round(found.errors["fitted"]["validation"], 3),
        "after": round(found.errors["after"]["validation"], 3),
        "recording_cpu_s": round(recorded - began, 2),
        "cpu_s": round(time.process_time() - recorded, 2),
    }


def is_exact(row: dict[str, Any]) -> bool:
    """The hidden effect was added, or one that is counted as the same."""
    return row["added"] == row["hidden"] or any(
        {row["added"], row["hidden"]} == pair for pair in ALIKE
    )


def is_named(row: dict[str, Any]) -> bool:
    """Exact, or named beside what was added."""
    return is_exact(row) or row["hidden"] in row["beside"]


def counted(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Lines of the table in Markdown, and below it one line for each failed case."""
    hidden = [r for r in rows if r["hidden"] and r["fitted"] >= MATERIAL_FLOORS]
    clean = [r for r in rows if not r["hidden"]]
    shares = [
        share_row("one hidden effect: exact", "≥ 80 %", hidden, is_exact),
        share_row("… named", "≥ 95 %", hidden, is_named),
        *(
            share_row(
                f"… {name}: exact",
                "",
                [r for r in hidden if r["robot"] == name],
                is_exact,
            )
            for name in ROBOTS
        ),
        share_row(
            "nothing hidden: silent", "≥ 98 %", clean, lambda r: r["added"] is None
        ),
    ]
    failed = [
        r
        for r in [*hidden, *clean]
        if not (is_named(r) if r["hidden"] else r["added"] is None)
    ]
    return table(shares, rows, len(hidden), failed, "≤ 15")


def table(
    shares: Sequence[str],
    rows: Sequence[dict[str, Any]],
    material: int,
    failed: Sequence[dict[str, Any]],
    cpu_asked: str,
) -> list[str]:
    """Lines of a study's table in Markdown with the rows ``shares``, and below it one line for each failed case. ``material``:
    number of hidden effects that show."""
    lines = [
        "| what | asked | measured |",
        "|---|---|---|",
        *shares,
        f"| hidden, and too weak to show (below {MATERIAL_FLOORS} noise floors) | | "
        f"{sum(bool(r['hidden']) for r in rows) - material} |",
        f"| CPU-s a diagnosis, median / 90th percentile | {cpu_asked} | {cpu_words(rows, 1)} |",
        "",
    ]
    for r in failed:
        of = f", {r['joint']} of the {r['robot']}" if "robot" in r else ""
        lines.append(
            f"- seed {r['seed']}{of}: {r['hidden'] or 'nothing'} hidden, {r['added'] or 'nothing'} added; validation error "
            f"{r['fitted']:.2f} → {r['after']:.2f} noise floors"
        )
    return lines


def cpu_words(rows: Sequence[dict[str, Any]], digits: int) -> str:
    """Median / 90th percentile of the CPU-seconds."""
    cpu = sorted(r["cpu_s"] for r in rows)
    return f"{median(cpu):.{digits}f} / {cpu[int(0.9 * (len(cpu) - 1))]:.{digits}f}"


def share(count: int, n: int) -> str:
    """``87 % (34 of 39; 73 … 94)``, with Wilson's 95 % interval."""
    low, high = (100 * end for end in wilson_interval(count, n))
    return (
        f"{count / n:.0%} ({count} of {n}; {low:.0f} … {high:.0f})"
        if n
        else "not measured yet"
    )


def share_row(
    what: str,
    asked: str,
    rows: Sequence[dict[str, Any]],
    good: Callable[[dict[str, Any]], bool],
) -> str:
    return f"| {what} | {asked} | {share(sum(map(good, rows)), len(rows))} |"


def run_missing(
    path: Path,
    jobs: Sequence[tuple[int, str]],
    run: Callable[[tuple[int, str]], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Append a row to ``path`` for each job (seed, hidden) whose seed has none, one on each core; returns all rows."""
    done = (
        {r["seed"] for r in map(json.loads, path.read_text().splitlines())}
        if path.exists()
        else ()
    )
    missing = [job for job in jobs if job[0] not in done]
    with (
        ProcessPoolExecutor(
            len(os.sched_getaffinity(0)), mp_context=get_context("spawn")
        ) as pool,
        path.open("a") as file,
    ):
        for row in pool.map(run, missing):
            file.write(json.dumps(row) + "\n")
            file.flush()
    return [json.loads(line) for line in path.read_text().splitlines()]


def study(
    jobs: Sequence[tuple[int, str]],
    run: Callable[[tuple[int, str]], dict[str, Any]],
    counted: Callable[[list[dict[str, Any]]], list[str]],
) -> None:
    """``python -m pipelines.studies.NAME rows.jsonl``: run the jobs that the file lacks, and print the table.

    Args:
        jobs: (seed, hidden effect) of each case.
        run: function of a job that returns its row.
        counted: function of all rows that returns the lines of the table.
    """
    print("\n".join(counted(run_missing(Path(sys.argv[1]), jobs, run))))


if __name__ == "__main__":
    study(jobs(), run, counted)
