"""``python -m pipelines.diagnosis_study chirp pack none …``: is the search for missing effects right? On surrogate robots.

Rows go to docs/diagnosis_study.jsonl as they are finished; what is there is not run again. Then docs/diagnosis.md is written.
Seeds from 5000 on are for these figures only: thresholds were chosen on seeds below 300, and after a look at 1000 to 1012.
"""

import json
import sys
from multiprocessing import get_context
from pathlib import Path

from taccorl.cli.tables import Bars
from taccorl.diagnosis import study
from taccorl.diagnosis.surrogate.hidden import OUTSIDE, REGISTERED
from taccorl.diagnosis.surrogate.touch_hidden import REGISTERED_TOUCH

ROWS = Path("docs/diagnosis_study.jsonl")
PAIRS = (
    ("coulomb_friction", "command_delay"),
    ("coulomb_friction", "gravity_mismatch"),
    ("backlash", "coulomb_friction"),
    ("cogging", "command_lag"),
    ("quadratic_drag", "sensor_delay"),
    ("load_friction", "torque_lag"),
    ("cable_spring", "coulomb_friction"),
    ("stribeck_friction", "joint_compliance"),
    ("error_deadband", "command_delay"),
    ("slew_limit", "coulomb_friction"),
)
PAIR_FLOORS = 5.0
"""Noise floors that each of two effects leaves alone."""
AMPLITUDES = (0.4, 0.6, 0.8, 1.0, 1.3, 1.7, 2.3)
"""Noise floors that an effect leaves: around those at which it begins to be found."""
STUDIES = {
    "chirp": lambda n: study.single("chirp", REGISTERED, range(5000, 5000 + n)),
    "pack": lambda n: study.single("pack", REGISTERED, range(5000, 5000 + n)),
    "amplitude": lambda n: study.amplitude("chirp", REGISTERED, AMPLITUDES, range(8000, 8000 + n // 4)),
    "none": lambda n: study.nothing("chirp", range(5000, 5000 + 5 * n)),
    "removed": lambda n: study.removed("chirp", REGISTERED, range(6000, 6000 + n)),
    "outside": lambda n: study.removed("chirp", OUTSIDE, range(6000, 6000 + n)),
    "touch": lambda n: study.touch(REGISTERED_TOUCH, range(5000, 5000 + n)),
    "pairs": lambda n: study.pairs("pack", PAIRS, range(7000, 7000 + n)),
    "pairs_alike": lambda n: study.pairs("pack", PAIRS, range(7000, 7000 + n), strength=PAIR_FLOORS),
}


def read_rows() -> list[dict]:
    """All rows that have been made."""
    return [json.loads(line) for line in ROWS.read_text(encoding="utf-8").splitlines()] if ROWS.exists() else []


def _run(job: study.Job) -> dict:
    return study.run_touch(job) if job.study == "touch" else study.run(job)


def main(words: list[str]) -> None:
    """Words: names of studies, and ``--seeds=20``."""
    seeds = next((int(w.partition("=")[2]) for w in words if w.startswith("--seeds=")), 20)
    names = [w for w in words if not w.startswith("--")]
    done = {row["key"] for row in read_rows()}
    jobs = [job for name in names for job in STUDIES[name](seeds) if job.key not in done]
    with Bars(len(jobs)) as bars, get_context("spawn").Pool(2) as pool, ROWS.open("a", encoding="utf-8") as file:
        for count, row in enumerate(pool.imap_unordered(_run, jobs), 1):
            file.write(json.dumps(row, ensure_ascii=False) + "\n")
            file.flush()
            bars.update(row["key"], count, len(jobs))
    from pipelines.diagnosis_page import write_page

    write_page(read_rows())


if __name__ == "__main__":
    main(sys.argv[1:])
