"""Figures of the twin: physics, touch, pictures, gripping. ``make bench ONLY=twin_speed`` and the others."""

import time
from collections.abc import Callable, Iterator
from statistics import median

import mujoco
import numpy as np

from pipelines.benchmarks.grip_rig import gripped, in_hand_m, rest, shake
from pipelines.benchmarks.rows import Row, against_reference, benchmark, cpu_times_s
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.pad import OneSim, PadArray
from taccorl.sim.rendering import Renderer
from taccorl.sim.robot import RobotConfig
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig
from taccorl.sim.vector_env import TaccorlVectorEnv

NUM_SIMS = 128
REPEATS = 7


def _in_turns(
    *works: Callable[[], object], repeats: int = REPEATS
) -> list[list[float]]:
    """CPU-seconds of each, measured in turns, because a scene's cost drifts and so does a shared machine."""
    times = [[cpu_times_s(work, 1)[0] for work in works] for _ in range(repeats)]
    return [list(column) for column in zip(*times, strict=True)]


def holding(
    num_sims: int, config: TwinConfig | None = None
) -> tuple[Simulation, np.ndarray]:
    """Simulations of Assembly #1 in which both hands hold their part on the table, and the targets that keep them in place."""
    sim = Simulation(tasks.get("assembly_1")(), config, num_sims=num_sims)
    sim.reset(np.arange(num_sims))
    qpos = sim.arrays["qpos"]
    goal = sim.targets.copy()
    for arm, part, width_m in (("left", "holder", 0.030), ("right", "plug", 0.020)):
        task_part = getattr(sim.task, part)
        joint = sim.model.joint(task_part.name).qposadr[0]
        grasp = next(iter(task_part.grasps.values())).part_from_tcp
        pose = sim.tcp(arm) @ np.linalg.inv(grasp)
        for i in range(num_sims):
            qpos[i, joint : joint + 3] = pose[i, :3, 3]
            mujoco.mju_mat2Quat(
                qpos[i, joint + 3 : joint + 7],
                np.ascontiguousarray(pose[i, :3, :3]).ravel(),
            )
        for finger in ROBOT.fingers:
            qpos[:, sim.model.joint(f"{arm}_finger_{finger}").qposadr[0]] = (
                width_m / 2 + 0.0001
            )
        goal[:, ROBOT.gripper_index(arm)] = width_m - 0.02
    sim.batch.forward()
    for _ in range(15):
        sim.step(goal)
    for part in sim.task.parts:
        if sim.pads_touching(part).sum(1).min() < 2:
            raise TaccorlError(f"benchmark: {part} is not held in every simulation")
    return sim, goal


@benchmark("twin_speed")
def twin_speed() -> Iterator[Row]:
    """Benchmark of control steps, touch and the share of Python's time, with parts in both hands."""
    sim, goal = holding(NUM_SIMS)
    step_ms = sim.config.physics.timestep_s * 1e3
    steps = sim.config.physics.steps_per_control_step
    full, bare = _in_turns(lambda: sim.step(goal), lambda: sim.batch.step(nstep=steps))
    # 1/600 CPU-s at 2 ms, 1/300 at 1 ms, at 10 µs a reference step: in proportion to the number of steps.
    yield against_reference(
        f"one control step of {NUM_SIMS} sims, both hands holding, step {step_ms:.2f} ms, one thread",
        [t / NUM_SIMS for t in full],
        f"≤ {1e5 / 300 / step_ms:.0f}",
    )
    shares = [b / f for f, b in zip(full, bare, strict=True)]
    rival = {
        "rival": "Batch.step, env steps/CPU-s",
        "rival_value": NUM_SIMS / median(bare),
    }
    yield Row.of(
        shares,
        name="share of a bare Batch.step loop's speed",
        unit="1",
        goal="≥ 0.9",
        **rival,
    )
    touch = [
        t / NUM_SIMS for t in cpu_times_s(lambda: sim.pads.touch(sim.batch), REPEATS)
    ]
    # Its goal is the share of a control step, below: memory bounds both, and a step of the reference loop stays in the cache.
    taxels = f"{len(ROBOT.pads)} × {ROBOT.pad.num_taxels} taxels"
    name = f"touch, depth and rate of {taxels}, per env in a batch of {NUM_SIMS}"
    yield Row.of([1e6 * t for t in touch], name=name, unit="µs/env")
    alone, goal_alone = holding(1)
    alone.step(goal_alone)
    single = [
        1e6 * t / 20
        for t in cpu_times_s(
            lambda: [alone.pads.touch(alone.batch) for _ in range(20)], REPEATS
        )
    ]
    yield Row.of(single, name="touch of a single env, not in a batch", unit="µs")
    share = [100 * t / (median(full) / NUM_SIMS) for t in touch]
    yield Row.of(share, name="touch", unit="% of a control step", goal="≤ 10")
    env = TaccorlVectorEnv("assembly_1", num_envs=NUM_SIMS, num_threads=1)
    env.reset(seed=0)
    env.sim.restore(sim.snapshot())
    actions = goal.astype(np.float32)
    # What the environment adds: its own Python, without MuJoCo and without touch.
    stepped, bare, felt = _in_turns(
        lambda: env.step(actions),
        lambda: env.sim.batch.step(nstep=steps),
        lambda: env.sim.touch(),
    )
    added = [100 * (t - b - f) / t for t, b, f in zip(stepped, bare, felt, strict=True)]
    yield Row.of(
        added,
        name="vector env: Python outside of MuJoCo and touch",
        unit="% of a control step",
        goal="≤ 20",
    )


@benchmark("grip")
def grip() -> Iterator[Row]:
    """Benchmark of a held part: creep, slip, and influence of its mass on the pads' reading."""
    model, data = gripped(0.04, 10.0)
    creeps = []
    for _ in range(3):
        before = in_hand_m(data)
        rest(model, data, 2.0)
        creeps.append(float(np.linalg.norm(in_hand_m(data) - before)) / 2.0 * 1e3)
    yield Row.of(
        creeps, name="creep of a 40 g part at 10 N", unit="mm/s", goal="≤ 0.02"
    )
    for swing_rad, goal in ((0.06, "≤ 1"), (0.2, "")):
        slips = [
            shake(*gripped(mass_kg, 10.0), swing_rad=swing_rad) * 1e3
            for mass_kg in (0.04, 0.07, 0.1)
        ]
        name = f"slip in a 3 s shake of {swing_rad:g} rad at 10 N, largest of 40, 70 and 100 g"
        yield Row.of(slips, by=max, name=name, unit="mm", goal=goal)
    for pads, goal in (("sprung", "≤ 5"), ("rigid", "")):
        peaks = [_peak_reading(mass_kg, pads) for mass_kg in (0.04, 0.1, 0.3)]
        differs = 100 * (max(peaks) - min(peaks)) / min(peaks)
        name = f"reading at 10 N, 40 → 300 g, {pads} pads: largest over smallest"
        yield Row(
            name=name, value=differs, unit="%", goal=goal, n=len(peaks), spread=0.0
        )


def _peak_reading(mass_kg: float, pads: str) -> float:
    config = TwinConfig(robot=RobotConfig(pads=pads))  # pyright: ignore[reportArgumentType]
    model, data = gripped(mass_kg, 10.0, config)
    array = PadArray(model, ROBOT.pads)
    sensor = config.sensor.build(ROBOT.pads)
    reading = sensor.reading(*array.touch(OneSim(data)), None)
    return float(reading[0, 2:].max())


@benchmark("pictures")
def pictures() -> Iterator[Row]:
    """Benchmark of rendering the three cameras."""
    sim = Simulation(tasks.get("test_tube")())
    sim.reset([0])
    names = [camera.name for camera in sim.config.cameras]
    for size, goal in ((224, "≤ 600"), (96, "")):
        with Renderer(sim.model, names, size, size) as renderer:
            times = cpu_times_s(lambda r=renderer: r.render_batch(sim.batch), 30)
            driver = renderer.driver
        name = f"three {size}² pictures of a task with {sim.model.ngeom} geoms, {driver.split('(')[0].strip()}"
        yield against_reference(name, times, goal)


@benchmark("tiled_pictures")
def tiled_pictures() -> Iterator[Row]:
    """Benchmark of rendering many small views at a time, as reinforcement learning does; wall time, because a GPU may
    draw them."""
    sim = Simulation(tasks.get("assembly_1")(), num_sims=NUM_SIMS)
    sim.reset(np.arange(NUM_SIMS))
    names = [camera.name for camera in sim.config.cameras]
    with Renderer(sim.model, names, 96, 96) as renderer:
        renderer.render_batch(sim.batch)
        rates = []
        for _ in range(REPEATS):
            before = time.perf_counter()
            renderer.render_batch(sim.batch)
            rates.append(NUM_SIMS * len(names) / (time.perf_counter() - before))
        driver = renderer.driver
    software = "llvmpipe" in driver or "softpipe" in driver
    name, goal = (
        f"96² views tiled, {driver.split('(')[0].strip()}",
        "" if software else "≥ 10000",
    )
    yield Row.of(rates, name=name, unit="images/s (wall)", goal=goal)
