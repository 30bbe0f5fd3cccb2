"""Cost of a diagnosis. Its accuracy is in docs/diagnosis.md (``python -m pipelines.diagnosis_study``)."""

import time
from collections.abc import Iterator
from pathlib import Path

from pipelines.benchmarks.rows import Row, against_reference, benchmark
from pipelines.studies.joints_and_pads import Job, run, run_touch
from taccorl.diagnosis.machines.machine import diagnose_parts
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.robots import ROBOT
from taccorl.sim.twin_file import load_twin
from taccorl.surrogate.cases import case_of
from taccorl.surrogate.recordings import robot_recordings

HIDDEN = (
    "coulomb_friction",
    "backlash",
    "command_delay",
    "gravity_mismatch",
    "cogging",
)

HIDDEN_IN_PADS = (
    "taxel_saturation",
    "taxel_creep",
    "taxel_gain_spread",
    "pad_shift",
    "taxel_crosstalk",
)
ARMS = (410, 420)
"""Seeds of whole arms."""
STICKY = Path("configs/surrogates/sticky.yaml")
"""Effects that whole arms hide."""


@benchmark("diagnosis")
def diagnosis() -> Iterator[Row]:
    """Cost of the diagnosis of one joint from the paper's 10 s chirp, and of a whole arm on two cores; surrogate recordings."""
    run(Job(study="warm-up", hidden=(), seed=0, design="chirp"))
    jobs = [
        Job(study="cost", hidden=(name,), seed=400 + k, design="chirp")
        for k, name in enumerate(HIDDEN)
    ]
    costs = [float(run(job)["cpu_s"]) for job in jobs]
    yield against_reference(
        "one joint, 10 s chirp twice and four validation motions at 200 Hz, 26 candidates, gains unknown, surrogate",
        costs,
        "≤ 1,500,000",
    )
    walls = []
    twin = load_twin(STICKY)
    for seed in ARMS:
        cases = [
            case_of(twin, f"left_{joint}", seed, "chirp") for joint in ROBOT.joints
        ]
        made, machine = robot_recordings(cases), PiperTwin(cases[0].twin)
        before = time.perf_counter()
        diagnose_parts(machine, [case.signal for case in cases], made, workers=2)
        walls.append(time.perf_counter() - before)
    yield Row.of(
        walls,
        name="a whole arm until the noise floor, eight recordings of each joint, two processes, surrogate",
        unit="s (wall)",
    )
    run_touch(Job(study="warm-up", hidden=(), seed=0, design="press"))
    pads = [
        Job(study="cost", hidden=(name,), seed=430 + k, design="press")
        for k, name in enumerate(HIDDEN_IN_PADS)
    ]
    # 40 CPU-s where 200 thousand reference steps took 2.4.
    yield against_reference(
        "one arm's pads, four fit and two validation recordings, 13 candidates, surrogate",
        [float(run_touch(job)["cpu_s"]) for job in pads],
        goal="≤ 3.3e6",
    )
