"""A bench for effects: the left gripper presses a block that is clamped in the air, the right arm is free to move."""

import functools

import mujoco
import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import Reset, Scene, Subtask, Task, Verdict
from taccorl.sim.twin import TwinConfig, empty_bench

LEFT_HOME = (0.003, 1.732, -0.883, -0.528, 0.884, -1.213)
RIGHT_HOME = (-0.003, 1.732, -0.883, 0.528, 0.884, 1.213)
BLOCK_M = 0.02  # Between the pads; they press it by 2000 N/m for each metre that the command lies below the opening


@functools.cache
def block_pose() -> np.ndarray:
    """(7,) position [m] and quaternion: between the left pads at home."""
    model = empty_bench(TwinConfig()).compile()
    data = mujoco.MjData(model)
    for k, angle in enumerate(LEFT_HOME):
        data.joint(f"left_joint{k + 1}").qpos = angle
    mujoco.mj_kinematics(model, data)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, data.site("left_tcp").xmat)
    return np.r_[data.site("left_tcp").xpos, quat]


class PressBench(Task):
    """Nothing to do, and nothing is drawn."""

    name = "press_bench"
    instruction = "press the block"
    parts = ()
    clamped = ("block",)
    home_rad = {"left": LEFT_HOME, "right": RIGHT_HOME}  # noqa: RUF012

    def add_parts(self, spec: mujoco.MjSpec) -> None:
        block = spec.worldbody.add_body(name="block", mocap=True)
        half = [0.006, BLOCK_M / 2, 0.01]
        block.add_geom(
            name="block",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half,
            contype=1,
            conaffinity=7,
            mass=0,
        )

    def reset(self, draw: dict[str, np.ndarray]) -> Reset:
        return Reset(poses={"block": block_pose()})

    def look(self, scene: Scene) -> Verdict:
        no = np.zeros(scene.num_sims, dtype=bool)
        return Verdict(goal=no, failures={"dropped": no}, partial=no.astype(int))

    def subtasks(self) -> dict[str, tuple[Subtask, ...]]:
        return dict.fromkeys(ROBOT.arms, ())


def typical_effect(name: str) -> Effect:
    return make_effect(
        name, **{p.name: p.typical for p in effects.get(name).parameters()}
    )


def start(*present: Effect, num_sims: int = 1, num_threads: int = 1) -> Simulation:
    """Both arms at rest at home, the left gripper just open around the block."""
    config = TwinConfig(effects=list(present))
    sim = Simulation(PressBench(), config, num_sims=num_sims, num_threads=num_threads)
    sim.reset(range(num_sims))
    joints, targets = (
        np.r_[LEFT_HOME, BLOCK_M + 5e-4, RIGHT_HOME, 0.07],
        sim.targets[0].copy(),
    )
    targets[6] = joints[6]
    sim.place_arms(joints, targets)
    return sim


def perform(sim: Simulation, first: int = 0, last: int = 10) -> dict[str, np.ndarray]:
    """Control steps ``first`` to ``last`` (excluded): press the block for four, hold, let go at the eighth; the right arm
    swings. Returns all that is seen, name → (T, N, …)."""
    rest = np.r_[LEFT_HOME, BLOCK_M + 5e-4, RIGHT_HOME, 0.07]
    swing = 0.1 + 0.02 * np.arange(sim.num_sims)[:, None]
    seen = []
    for step in range(first, last):
        targets = np.tile(rest, (sim.num_sims, 1))
        targets[:, 6] -= 0.0035 * min(step + 1, 4) if step < 8 else 0.0
        targets[:, 7:13] += swing * np.sin(0.5 * (step + 1))
        sim.step(targets)
        seen.append(
            {
                "reported": sim.proprioception().copy(),
                "hands": np.stack([sim.tcp(arm) for arm in ROBOT.arms], axis=1),
                "reading": sim.reading(),
                "touch": sim.touch(),
                "sensors": sim.arrays["sensordata"].copy(),
                "state": sim.batch.state.copy(),
            }
        )
    return {name: np.stack([row[name] for row in seen]) for name in seen[0]}
