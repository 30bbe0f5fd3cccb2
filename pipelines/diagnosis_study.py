"""``python -m pipelines.diagnosis_study pack chirp … [--seeds=5] [--workers=2] [--rows=PATH] [--first_seed=740000]``

Is the search for missing effects right? On surrogate robots. Rows go to docs/diagnosis_study.jsonl as they are finished; what is
there is not run again (a case that failed is, with ``--again``). ``--page`` writes docs/diagnosis.md and runs nothing. Thresholds
were chosen on seeds 300 to 999 and 15000 to 99999. Rows from 100000 on led to ``out_of_dents``;
the page is of seeds from 740000 on.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Before NumPy is imported, here and in every worker: CPU-seconds are those of one thread.
for _name in ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM", "NUMEXPR"):
    os.environ[f"{_name}_NUM_THREADS"] = "1"

from pipelines.benchmarks.rows import reference_step_s  # noqa: E402
from pipelines.benchmarks.run import machine  # noqa: E402
from pipelines.studies import joints_and_pads as study  # noqa: E402
from taccorl.cli.parse import parse as parse_options  # noqa: E402
from taccorl.cli.progress import Bars  # noqa: E402
from taccorl.errors import TaccorlError, nearest  # noqa: E402
from taccorl.lineage.processes import Care, Done, Failed, run_in_processes  # noqa: E402
from taccorl.surrogate.hidden import OUTSIDE, REGISTERED  # noqa: E402
from taccorl.surrogate.touch_hidden import OUTSIDE_TOUCH, REGISTERED_TOUCH  # noqa: E402

ROWS = Path("docs/diagnosis_study.jsonl")
FIRST_SEED = 770000
PAIRS = (
    "coulomb_friction+command_delay",
    "coulomb_friction+gravity_mismatch",
    "backlash+coulomb_friction",
    "cogging+command_lag",
    "quadratic_drag+sensor_delay",
    "load_friction+torque_lag",
    "cable_spring+coulomb_friction",
    "stribeck_friction+joint_compliance",
    "error_deadband+command_delay",
    "slew_limit+coulomb_friction",
)
Jobs = list[study.Job]


def _seeds(first: int, n: float) -> range:
    return range(first, first + max(1, round(n)))


STUDIES: dict[str, Callable[[int, float], Jobs]] = {
    "pack": lambda first, n: study.jobs("single", "pack", REGISTERED, _seeds(first, n)),
    "chirp": lambda first, n: study.jobs(
        "single", "chirp", REGISTERED, _seeds(first, n)
    ),
    "pairs": lambda first, n: study.jobs(
        "pairs", "pack", PAIRS, _seeds(first + 1000, n)
    ),
    "none": lambda first, n: [
        *study.jobs("none", "chirp", [""], _seeds(first, 11 * n)),
        *study.jobs("none", "pack", [""], _seeds(first, 5.5 * n)),
    ],
    "loop": lambda first, n: study.jobs(
        "loop", "chirp", [""], _seeds(first + 3500, 2 * n)
    ),
    "outside": lambda first, n: [
        *study.jobs("removed", "chirp", OUTSIDE, _seeds(first + 2000, n / 2)),
        *study.jobs("removed", "pack", OUTSIDE, _seeds(first + 2500, n / 2)),
    ],
    "removed": lambda first, n: study.jobs(
        "removed", "chirp", REGISTERED, _seeds(first + 2000, n / 5)
    ),
    "dropped": lambda first, n: [
        *study.jobs(
            "dropped", "chirp", ["dropped_commands"], _seeds(first + 3000, 3 * n)
        ),
        *study.jobs(
            "dropped", "pack", ["dropped_commands"], _seeds(first + 3000, 3 * n)
        ),
    ],
    "touch": lambda first, n: study.jobs(
        "touch", "press", REGISTERED_TOUCH, _seeds(first, n / 2)
    ),
    "touch_none": lambda first, n: study.jobs("none", "press", [""], _seeds(first, n)),
    "touch_outside": lambda first, n: study.jobs(
        "removed", "press", OUTSIDE_TOUCH, _seeds(first + 2000, n / 2)
    ),
}
"""Name → cases, from the first seed and the number of seeds."""
EVERY_JOBS = 40
"""After so many cases the reference loop is run among them, so that it is as slow as they are."""
_COST = {"press": 3, "pack": 1, "chirp": 0}


@dataclass(kw_only=True)
class StudyConfig:
    """Words of the command line."""

    seeds: float = 5.0
    workers: int = 2
    rows: Path = ROWS
    first_seed: int = FIRST_SEED
    limit_s: float = 900.0
    """Wall time of one case; what takes longer is stopped, stored and counted as wrong."""
    page: bool = False
    again: bool = False
    """Run cases once more that failed."""


def parse(words: list[str]) -> tuple[StudyConfig, list[str]]:
    """Studies, and how they are run.

    Raises:
        TaccorlError: a word that is neither.
    """
    names = [word for word in words if not word.startswith("--")]
    for name in names:
        if name not in STUDIES:
            raise TaccorlError(f"no study {name!r}; {nearest(name, STUDIES)}")
    options = [
        word if "=" in word else f"{word}=true"
        for word in words
        if word.startswith("--")
    ]
    return parse_options(StudyConfig, options, prog="diagnosis_study"), names


def read_rows(path: Path = ROWS) -> list[dict]:
    """All rows that have been made; of a case that was run again, the last."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return list({row["key"]: row for row in map(json.loads, lines)}.values())


def reference_loop() -> dict[str, float]:
    """CPU-seconds of 200 000 steps of the reference loop, as machines differ by a factor of four."""
    return {"cpu_s": round(200_000 * reference_step_s(), 3)}


def work(job: study.Job | str) -> dict[str, Any]:
    """A row; a word stands for the reference loop."""
    if isinstance(job, str):
        return {"key": job, "study": "reference", **reference_loop()}
    return study.run_job(job)


def ordered(jobs: Jobs, stamp: str) -> list[study.Job | str]:
    """Longest first, so that no core waits at the end, with reference loops among them."""
    out: list[study.Job | str] = []
    for k, job in enumerate(
        sorted(jobs, key=lambda j: (-_COST[j.design], -len(j.hidden)))
    ):
        if k % EVERY_JOBS == 0:
            out.append(f"reference {stamp} {k // EVERY_JOBS}")
        out.append(job)
    return out


def main(words: list[str]) -> None:
    """Words: names of studies, and options."""
    config, names = parse(words)
    if config.page:
        from pipelines.diagnosis_page import write_page

        write_page(read_rows(config.rows))
        return
    there = {
        row["key"]
        for row in read_rows(config.rows)
        if not (config.again and "failed" in row)
    }
    jobs = [
        job
        for name in names
        for job in STUDIES[name](config.first_seed, config.seeds)
        if job.key not in there
    ]
    if not jobs:
        print(
            "nothing to run: all rows are there, or no study was named; --page writes the page"
        )
        return
    # What Numba compiles is written to its cache once, before many processes need it.
    warm_up = [
        study.Job(study="warm-up", hidden=(), seed=300, design=d)
        for d in sorted({j.design for j in jobs})
    ]
    _run(
        warm_up,
        1,
        config.limit_s,
        lambda row: print(f"{row['key']}: {row.get('failed', 'compiled')}", flush=True),
    )
    stamp = time.strftime("%Y-%m-%d %H:%M")
    head = {
        "key": f"machine {stamp}",
        "study": "machine",
        "machine": machine(),
        "workers": config.workers,
    }
    stored: list[dict[str, Any]] = []
    with Bars(len(jobs)) as bars, config.rows.open("a", encoding="utf-8") as file:

        def store(row: dict[str, Any]) -> None:
            file.write(
                json.dumps(row, ensure_ascii=False, separators=(",", ":")) + "\n"
            )
            file.flush()
            stored.extend([row] if row["study"] not in ("machine", "reference") else [])
            bars.update(row["key"], len(stored), len(jobs))

        store(head)
        _run(ordered(jobs, stamp), config.workers, config.limit_s, store)
    wrong = sum("failed" in row for row in stored)
    print(
        f"{config.rows}: {len(stored)} rows more, {wrong} of them of cases that failed"
    )


def _run(
    jobs: list[Any],
    workers: int,
    limit_s: float,
    store: Callable[[dict[str, Any]], None],
) -> None:
    """``store`` gets the row of each job as it is done; one that fails, dies or takes too long costs its own row only."""

    def take(index: int, outcome: Done | Failed) -> None:
        job = jobs[index]
        if isinstance(outcome, Done):
            store(outcome.result)
        elif isinstance(job, study.Job):
            store(study.failed(job, outcome.trace or outcome.reason))

    run_in_processes(work, jobs, workers, str, take, Care(limit_s=limit_s), 0)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except TaccorlError as error:
        sys.exit(f"diagnosis_study: {error}")
