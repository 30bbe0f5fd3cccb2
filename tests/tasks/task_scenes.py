"""Shared by the tests of tasks: states written into a simulation, and one episode of a demonstrator."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.sim.simulation import Simulation
from taccorl.tasks.experts import expert_of
from taccorl.tasks.experts.hands import ScriptedExpertConfig
from taccorl.tasks.experts.scripted import ScriptedExpert


def pose_at(
    *at_m: float, euler_deg: tuple[float, float, float] = (0, 0, 0)
) -> np.ndarray:
    """(4, 4); angles about z, y, x in turn."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", euler_deg, degrees=True).as_matrix()
    pose[:3, 3] = at_m
    return pose


def put(
    sim: Simulation, part: str, pose: np.ndarray, velocity_mps: Any = (0, 0, 0)
) -> None:
    """Write a world pose (4, 4) and a velocity into the state."""
    joint = sim.model.joint(part)
    at, speed = joint.qposadr[0], joint.dofadr[0]
    quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    sim.arrays["qpos"][0, at : at + 7] = np.r_[pose[:3, 3], quat]
    sim.arrays["qvel"][0, speed : speed + 6] = np.r_[velocity_mps, 0, 0, 0]
    sim.batch.forward(np.array([0]))


def stay(sim: Simulation, num_steps: int, targets: np.ndarray | None = None) -> None:
    """Let time pass; the arms stay where they are, or go to ``targets`` (1, 14)."""
    targets = sim.targets.copy() if targets is None else targets
    for _ in range(num_steps):
        sim.step(targets)


def failures(sim: Simulation) -> set[str]:
    """What is seen now, before it has lasted."""
    return {name for name, seen in sim.task.look(sim).failures.items() if seen[0]}


class Episode:
    """One run of a demonstrator to its end, and what was seen meanwhile."""

    def __init__(
        self,
        sim: Simulation,
        seed: int,
        config: ScriptedExpertConfig | None = None,
        longest_s: float = 60.0,
        rng_seed: int = 7,
    ) -> None:
        sim.reset([seed])
        self.seed = seed
        self.expert: ScriptedExpert = expert_of(sim.task)(
            sim, np.random.default_rng([seed, rng_seed]), config
        )
        self.expert.start()
        self.actions, self.tcps_m, self.force_n, self.joints_rad = [], [], [], []
        self.subtasks: list[tuple[int, int]] = []
        self.penetration_m, self.lost_steps, self.met = 0.0, 0, set[frozenset[str]]()
        while not sim.judge.outcome.over[0] and len(self.actions) < 30 * longest_s:
            self.actions.append(self.expert.act())
            sim.step(self.actions[-1][None])
            contacts = [sim.contact(*pair) for pair in sim.task.mating]
            self.penetration_m = max(
                self.penetration_m, *(float(c.penetration_m[0]) for c in contacts)
            )
            self.force_n.append(float(contacts[0].force_n[0]))
            self.tcps_m.append([sim.tcp(arm)[0, :3, 3] for arm in ("left", "right")])
            self.joints_rad.append(
                np.delete(sim.proprioception()[0], [6, 13]).reshape(2, 6)
            )
            self.lost_steps = max(self.lost_steps, sim.judge.lasted[0].max())
            current = tuple(sim.judge.subtask[0].tolist())
            if not self.subtasks or self.subtasks[-1] != current:
                self.subtasks.append(current)
            if len(self.actions) % 5 == 0:
                self.met |= contacts_of(sim)
        self.outcome, self.duration_s = sim.judge.outcome, len(self.actions) / 30
        self.success, self.failure = (
            bool(self.outcome.success[0]),
            str(self.outcome.failure[0]),
        )

    def noted(self, what: str) -> int:
        return sum(what in event for _, event in self.expert.events)


def contacts_of(sim: Simulation) -> set[frozenset[str]]:
    """Pairs of what touches: part, stand, table, or an arm's pads or anything else of it."""
    import mujoco

    def kind(geom: int) -> str:
        body = sim.model.body(sim.model.geom_bodyid[geom]).name
        arm, _, rest = body.partition("_")
        return f"{arm} {'pads' if rest.startswith('pad') else 'arm'}" if rest else body

    data = mujoco.MjData(sim.model)
    data.qpos[:] = sim.arrays["qpos"][0]
    data.mocap_pos[:], data.mocap_quat[:] = (
        sim.arrays["mocap_pos"][0],
        sim.arrays["mocap_quat"][0],
    )
    mujoco.mj_fwdPosition(sim.model, data)
    return {frozenset(map(kind, contact.geom)) for contact in data.contact}
