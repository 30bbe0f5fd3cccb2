"""Figures of physics on a GPU against all CPU threads, in one run; ``python -m pipelines.benchmarks --only=physics_on_gpu``.

Needs the extra gpu. Without CUDA a few worlds run on Warp's CPU device, to try it: those rows have no goal.
"""

import importlib.util
import os
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from statistics import median
from typing import Any

import numpy as np

from pipelines.benchmarks.rows import Row, benchmark
from pipelines.benchmarks.sim import holding
from taccorl.extras import OnUse
from taccorl.sim.simulation import Snapshot
from taccorl.sim.twin import PhysicsConfig, TwinConfig
from taccorl.sim.vector_env import TaccorlVectorEnv

torch: Any = OnUse("torch")

WORLDS, WORLDS_ON_CPU = (2048, 8192), (4,)
NUM_ENVS = 128
"""Environments of MuJoCo C, as many as the paper post-trains in."""
REPEATS = 5
STEPS = 20
"""Physics steps within a control step."""
ACTIONS = 8
"""Control steps of one measurement: a chunk."""
SIZE = (112, 112)
"""Rows and columns of a picture."""
SHIFT_RAD = 0.02
"""Targets move by this within a chunk, so that contacts work."""
_CPUS = len(os.sched_getaffinity(0))


@benchmark("physics_on_gpu")
def physics_on_gpu() -> Iterator[Row]:
    """Benchmark of control steps with parts in both hands, of those with three pictures a chunk, and of the physics alone."""
    if importlib.util.find_spec("mujoco_warp") is None:
        print(
            '  physics_on_gpu needs the extra gpu (pip install ".[gpu]"): nothing measured'
        )
        return
    on_gpu = torch.cuda.is_available()
    twin = TwinConfig(physics=PhysicsConfig(steps_per_control_step=STEPS))
    sim, goal = holding(NUM_ENVS, twin)
    held, targets = sim.snapshot(), _moving(goal)
    on_cpu = _environments(twin, held, "c", NUM_ENVS)
    for num in WORLDS if on_gpu else WORLDS_ON_CPU:
        envs = _environments(twin, held, "warp" if on_gpu else "warp:device=cpu", num)
        where = f"{num}: worlds on {torch.cuda.get_device_name() if on_gpu else 'the CPU device'}"
        yield from _agreement(envs, on_cpu, held, targets, where)
        for what, one, goal_text in (
            ("physics, touch and predicates", _whole_s, "≥ 3" if on_gpu else ""),
            (
                f"physics, touch, predicates and three pictures of {SIZE[0]}² a chunk",
                _pictured_s,
                "≥ 2.5" if on_gpu else "",
            ),
            ("physics alone", _physics_s, ""),
        ):
            turns = [
                (one(envs, held, targets), one(on_cpu, held, targets))
                for _ in range(1 + REPEATS)
            ][1:]
            yield Row.of(
                [(num / ours) / (NUM_ENVS / theirs) for ours, theirs in turns],
                name=f"{where} over {NUM_ENVS} environments on {_CPUS} threads, control steps/s of {STEPS} physics steps: {what}",
                unit="×",
                goal=goal_text,
                rival="environments, control steps/s of wall time",
                rival_value=NUM_ENVS * ACTIONS / median(theirs for _, theirs in turns),
            )
            yield Row.of(
                [num * ACTIONS / ours for ours, _ in turns],
                name=f"{where}: {what}",
                unit="control steps/s (wall)",
            )
        envs.close()
    on_cpu.close()


def _moving(goal: np.ndarray) -> np.ndarray:
    """(N, H, 14) targets about the present ones ``goal`` (N, 14); the hands stay closed."""
    share = np.sin(np.linspace(0, 2 * np.pi, ACTIONS, endpoint=False))[None, :, None]
    is_joint = np.arange(goal.shape[1]) % 7 != 6
    return (goal[:, None] + SHIFT_RAD * share * is_joint).astype(np.float32)


def _environments(
    twin: TwinConfig, held: Snapshot, physics: str, num: int
) -> TaccorlVectorEnv:
    envs = TaccorlVectorEnv(
        "assembly_1",
        num,
        twin=twin,
        physics=physics,
        num_threads=_CPUS,
        images="on_request",
    )
    envs.reset(seed=0)
    _place(envs, held)
    return envs


def _repeated(values: Any, num: int) -> Any:
    if isinstance(values, dict):
        return {name: _repeated(v, num) for name, v in values.items()}
    return values[np.arange(num) % len(values)]


def _place(envs: TaccorlVectorEnv, held: Snapshot) -> None:
    of_all = {
        f.name: _repeated(getattr(held, f.name), envs.num_envs)
        for f in fields(Snapshot)
    }
    envs.sim.restore(replace(held, **of_all))


def _whole_s(envs: TaccorlVectorEnv, held: Snapshot, targets: np.ndarray) -> float:
    """Wall time [s] of a chunk ``targets`` (N, H, 14), repeated for as many environments as there are."""
    _place(envs, held)
    actions = _repeated(targets, envs.num_envs)
    before = time.perf_counter()
    envs.step_chunk(actions)
    return time.perf_counter() - before


def _pictured_s(envs: TaccorlVectorEnv, held: Snapshot, targets: np.ndarray) -> float:
    """As ``_whole_s``, and the three pictures of each environment after the chunk."""
    took = _whole_s(envs, held, targets)
    before = time.perf_counter()
    envs.sim.render(size=SIZE)
    return took + time.perf_counter() - before


def _physics_s(envs: TaccorlVectorEnv, held: Snapshot, targets: np.ndarray) -> float:
    """As ``_whole_s``, without touch, predicates and sub-commands, and without copies of what has been computed."""
    _place(envs, held)
    actions, ctrl = _repeated(targets, envs.num_envs), envs.sim.arrays["ctrl"]
    before = time.perf_counter()
    for k in range(ACTIONS):
        ctrl[:, envs.sim.action_actuators] = actions[:, k]
        envs.sim.batch.step(nstep=STEPS)
    return time.perf_counter() - before


def _agreement(
    envs: TaccorlVectorEnv,
    on_cpu: TaccorlVectorEnv,
    held: Snapshot,
    targets: np.ndarray,
    where: str,
) -> Iterator[Row]:
    """After one chunk: distance of the parts from those of MuJoCo C, and worlds that diverged."""
    for one in (envs, on_cpu):
        _whole_s(one, held, targets)
    num = min(envs.num_envs, NUM_ENVS)
    apart_um = [
        1e6
        * np.linalg.norm(
            envs.sim.poses(part)[:num, :3, 3] - on_cpu.sim.poses(part)[:num, :3, 3],
            axis=1,
        )
        for part in envs.sim.task.parts
    ]
    name = f"{where}: parts in the hands off MuJoCo C's after {ACTIONS} control steps"
    yield Row.of(
        np.concatenate(apart_um).tolist(),
        name=f"{name}, median",
        unit="µm",
        goal="≤ 10",
    )
    yield Row(
        name=f"{name}, largest",
        value=float(np.max(apart_um)),
        unit="µm",
        n=num,
        spread=0.0,
    )
    yield Row(
        name=f"{where}: diverged",
        value=float(envs.sim.diverged.sum()),
        unit="worlds",
        goal="≤ 0",
        n=1,
        spread=0.0,
    )
