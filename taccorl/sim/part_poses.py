"""Poses of a task's parts in the world as numbers, privileged: the ``observation.environment_state`` of rows and environments.

    x, y, z [m]; r00, r10, r20, r01, r11, r21        position, and the first two columns of the rotation, of each body

Bodies are the task's movable parts in their order, then those that are clamped where the reset draws them.
"""

from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:  # it would load MuJoCo wherever LeRobot loads its plug-ins
    from taccorl.sim.task import Task

PARTS_KEY = "observation.environment_state"  # LeRobot's name
POSE_NAMES = ("x", "y", "z", "r00", "r10", "r20", "r01", "r11", "r21")
"""Names of the 9 numbers of a body's pose: position, and the first two columns of the rotation matrix."""
POSE_UNITS = ("m",) * 3 + ("1",) * 6
"""Unit of each of them."""


class _Posed(Protocol):
    """A simulation, as far as its bodies' poses go."""

    task: "Task"
    num_sims: int

    def poses(self, body: str) -> np.ndarray:
        """World-from-body (N, 4, 4)."""
        ...


def posed_bodies(task: "Task | type[Task]") -> tuple[str, ...]:
    """Names of the bodies whose poses are in the observation, in order: parts, then clamped bodies."""
    return (*task.parts, *task.clamped)


def part_pose_names(task: "Task | type[Task]") -> tuple[str, ...]:
    """Names of the (9 × bodies) numbers, such as ``plug.x``; the order is that of ``part_poses``."""
    return tuple(f"{body}.{name}" for body in posed_bodies(task) for name in POSE_NAMES)


def part_poses(sim: _Posed) -> np.ndarray:
    """(N, 9 × bodies) float32: present world poses of the bodies, for each of ``posed_bodies`` x, y, z [m] and the first two
    columns of its rotation matrix (``POSE_NAMES``)."""
    numbers = []
    for body in posed_bodies(sim.task):
        pose = sim.poses(body)
        numbers += [pose[:, :3, 3], pose[:, :3, 0], pose[:, :3, 1]]
    return np.concatenate([np.zeros((sim.num_sims, 0)), *numbers], axis=1).astype(
        np.float32
    )
