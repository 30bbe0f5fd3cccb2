"""Cost of a diagnosis. Its accuracy is in docs/diagnosis.md (``python -m pipelines.diagnosis_study``)."""

import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from pipelines.benchmarks.rows import Row, against_reference, benchmark, spread
from pipelines.studies.cells import ASKED, FIRST_SEED, run_cells
from pipelines.studies.joints_and_pads import Job, run, run_touch
from taccorl.robots import ROBOT
from taccorl.surrogate.cases import draw_case
from taccorl.surrogate.recordings import recordings

HIDDEN = ("coulomb_friction", "backlash", "command_delay", "gravity_mismatch", "cogging")

HIDDEN_IN_PADS = ("taxel_saturation", "taxel_creep", "taxel_gain_spread", "pad_shift", "taxel_crosstalk")
ARMS, ARM_JOINTS, CELLS_EACH, CLEAN_CELLS, ROBOTS = (410, 420), ROBOT.num_joints, 5, 20, 6
"""Seeds of whole arms; joints of each; sensors of cells with each effect, and without; robots."""


@benchmark("diagnosis")
def diagnosis() -> Iterator[Row]:
    """Cost of the diagnosis of one joint from the paper's 10 s chirp, and of a whole arm on two cores; surrogate recordings."""
    run(Job(study="warm-up", hidden=(), seed=0, design="chirp"))
    jobs = [Job(study="cost", hidden=(name,), seed=400 + k, design="chirp") for k, name in enumerate(HIDDEN)]
    costs = [float(run(job)["cpu_s"]) for job in jobs]
    yield against_reference(
        "one joint, 10 s chirp twice and four validation motions at 200 Hz, 26 candidates, gains unknown, surrogate",
        costs,
        "≤ 1,500,000",
    )
    walls = []
    for seed in ARMS:
        arm = [(f"left_joint{joint}", seed + joint) for joint in range(1, ARM_JOINTS + 1)]
        before = time.perf_counter()
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            made = sum(pool.map(_one_of_an_arm, arm))
        walls.append(time.perf_counter() - before - made / 2)
    yield Row.of(
        walls,
        name="a whole arm, a sweep of each joint, two processes, without making the recordings, surrogate",
        unit="s (wall)",
    )
    run_touch(Job(study="warm-up", hidden=(), seed=0, design="press"))
    pads = [Job(study="cost", hidden=(name,), seed=430 + k, design="press") for k, name in enumerate(HIDDEN_IN_PADS)]
    # 40 CPU-s where 200 thousand reference steps took 2.4.
    yield against_reference(
        "one arm's pads, four fit and two validation recordings, 13 candidates, surrogate",
        [float(run_touch(job)["cpu_s"]) for job in pads],
        goal="≤ 3.3e6",
    )


@benchmark("cells")
def cells() -> Iterator[Row]:
    """Sensors of cells with one of eight hidden effects, and clean ones; all simulated (``python -m pipelines.cells_study``)."""
    run_cells("", FIRST_SEED - 1)
    rows = [run_cells(name, FIRST_SEED + k) for name in ASKED for k in range(CELLS_EACH)]
    seen = [r for r in rows if r.material]
    clean = [run_cells("", FIRST_SEED + 100 + k) for k in range(CLEAN_CELLS)]
    exact, silent = sum(r.exact for r in seen) / len(seen), sum(r.exact for r in clean) / len(clean)
    yield Row(
        name="hidden effect of a force cell: exact, simulated",
        value=exact,
        unit="1",
        goal="≥ 0.85",
        n=len(seen),
        spread=0.0,
    )
    yield Row(
        name="nothing hidden in a force cell: silent, simulated",
        value=silent,
        unit="1",
        goal="≥ 0.98",
        n=len(clean),
        spread=0.0,
    )
    yield against_reference(
        "one force cell, six recordings at 100 Hz, 10 candidates, simulated",
        [r.cpu_s for r in rows],
        goal="≤ 1,500,000",
    )


@benchmark("robots")
def robots() -> Iterator[Row]:
    """One joint of robots that are not the PiPER, by their robot files; the whole study is ``pipelines.studies.robots``."""
    from pipelines.studies import robots as robot_study

    rows = [robot_study.run(job) for job in robot_study.jobs()[:ROBOTS]]
    hidden = [r for r in rows if r["hidden"] and r["fitted"] >= robot_study.MATERIAL_FLOORS]
    right = [float(robot_study.is_exact(r)) for r in hidden]
    yield Row(
        name="share of hidden effects found exactly, of the study's first, simulated robots",
        value=sum(right) / len(right),
        unit="1",
        goal="≥ 0.8",
        n=len(right),
        spread=spread(right),
    )
    costs = [float(r["cpu_s"]) for r in rows]
    yield against_reference(
        "one joint, commanded gains, five recordings of 8 to 9 s at 200 Hz, simulated robots", costs
    )


def _one_of_an_arm(job: tuple[str, int]) -> float:
    """Diagnose one joint; seconds that its recordings took."""
    from taccorl.diagnosis.problems.joint_problem import JointProblem
    from taccorl.diagnosis.search.search import diagnose

    signal, seed = job
    before = time.perf_counter()
    case = draw_case(("coulomb_friction",), seed, signal=signal)
    made = recordings(case, "chirp")
    took = time.perf_counter() - before
    problem = JointProblem(case.twin, signal, made, gains="fitted", effort=False)
    diagnose(problem, problem.fit, problem.validation, problem.test, start=problem.start)
    return took
