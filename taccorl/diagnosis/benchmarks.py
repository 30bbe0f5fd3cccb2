"""What a diagnosis costs. How often it is right is in docs/diagnosis.md (``python -m pipelines.diagnosis_study``)."""

import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from statistics import median

from taccorl.benchmark import Row, against_reference, benchmark, spread
from taccorl.diagnosis.study import Job, run, run_touch
from taccorl.diagnosis.surrogate.cases import draw_case
from taccorl.diagnosis.surrogate.recordings import recordings

HIDDEN = ("coulomb_friction", "backlash", "command_delay", "gravity_mismatch", "cogging")

HIDDEN_IN_PADS = ("taxel_saturation", "taxel_creep", "taxel_gain_spread", "pad_shift", "taxel_crosstalk")


@benchmark("diagnosis")
def diagnosis() -> Iterator[Row]:
    """One joint from the paper's 10 s chirp, and a whole arm on two cores; recordings of surrogate robots."""
    run(Job(study="warm-up", hidden=(), seed=0, design="chirp"))
    jobs = [Job(study="cost", hidden=(name,), seed=400 + k, design="chirp") for k, name in enumerate(HIDDEN)]
    costs = [float(run(job)["cpu_s"]) for job in jobs]
    yield against_reference(
        "one joint, 10 s chirp twice and four validation motions at 200 Hz, 26 candidates, gains unknown, surrogate",
        costs,
        "≤ 1,500,000",
    )
    walls = []
    for seed in (410, 420):
        arm = [(f"left_joint{joint}", seed + joint) for joint in range(1, 7)]
        before = time.perf_counter()
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            made = sum(pool.map(_one_of_an_arm, arm))
        walls.append(time.perf_counter() - before - made / 2)
    yield Row(
        name="a whole arm, a sweep of each joint, two processes, without making the recordings, surrogate",
        value=median(walls),
        unit="s (wall)",
        n=len(walls),
        spread=spread(walls),
    )
    run_touch(Job(study="warm-up", hidden=(), seed=0, design="press"))
    ratios = []
    for k, name in enumerate(HIDDEN_IN_PADS):
        reference_s = _reference_cpu_s()
        ratios.append(
            float(run_touch(Job(study="cost", hidden=(name,), seed=430 + k, design="press"))["cpu_s"]) / reference_s
        )
    yield Row(
        name="one arm's pads, four fit and two validation recordings, 13 candidates, surrogate: CPU time over that of "
        "200 thousand MuJoCo steps of a chain of 12 links",
        value=median(ratios),
        unit="×",
        goal="≤ 17",
        n=len(ratios),
        spread=spread(ratios),
    )


def _reference_cpu_s() -> float:
    """What 200 thousand MuJoCo steps cost on this machine now: 2.4 s where a diagnosis of pads may take 40."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = 1e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    body = spec.worldbody
    for k in range(12):
        body = body.add_body(pos=[0, 0, -0.2 if k else 0.0])
        body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[k % 2, 1 - k % 2, 0], damping=[0.01, 0, 0])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.03, 0, 0], fromto=[0, 0, 0, 0, 0, -0.2])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = 0.1
    began = time.process_time()
    mujoco.mj_step(model, data, nstep=200_000)
    return time.process_time() - began


def _one_of_an_arm(job: tuple[str, int]) -> float:
    """Diagnose one joint; seconds that its recordings took."""
    from taccorl.diagnosis.joint_problem import JointProblem
    from taccorl.diagnosis.search import diagnose

    signal, seed = job
    before = time.perf_counter()
    case = draw_case(("coulomb_friction",), seed, signal=signal)
    made = recordings(case, "chirp")
    took = time.perf_counter() - before
    problem = JointProblem(case.twin, signal, made, gains="fitted", effort=False)
    diagnose(problem, problem.fit, problem.validation, problem.test, start=problem.start)
    return took
