"""A held part and its hole: the present pose error, and the pose of a hand that aims with an error."""

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from taccorl.sim.part import Fit, Part, measure_fit
from taccorl.tasks.experts.se3 import inverse, rotvec, transform, turn


class BodyPoses(Protocol):
    """Interface of the scene as an expert observes it: poses of bodies."""

    def body(self, name: str) -> np.ndarray:
        """Present pose world-from-body (4, 4)."""
        ...


@dataclass(frozen=True)
class Mating:
    """A held part and the hole it goes into. The mate is the part's leading end."""

    held: str  # Name of the held part
    held_from_mate: np.ndarray  # (4, 4) pose of its leading end (``Mate``) in its frame
    num_turns: (
        int | None
    )  # Number of rotations about the hole's axis at which it looks the same; None: any angle
    holder: str  # Name of the part with the hole
    holder_from_hole: np.ndarray  # (4, 4) pose of the hole in that part's frame

    @classmethod
    def of(cls, held: Part, holder: Part, hole: str) -> "Mating":
        """The mating of ``held``, whose leading end (``Part.mate``) is required, with the hole called ``hole`` of ``holder``."""
        assert held.mate is not None
        return cls(
            held.name,
            held.mate.part_from_mate,
            held.mate.num_turns,
            holder.name,
            holder.holes[hole].part_from_hole,
        )

    def _relative(self, scene: BodyPoses) -> tuple[np.ndarray, np.ndarray]:
        return scene.body(self.holder) @ self.holder_from_hole, scene.body(
            self.held
        ) @ self.held_from_mate

    def fit(self, scene: BodyPoses) -> Fit:
        """Present pose error of the held part in the hole."""
        return measure_fit(*self._relative(scene), self.num_turns)

    def axis(self, scene: BodyPoses) -> np.ndarray:
        """(3,) unit vector along the hole's axis into the hole, in the world frame."""
        return scene.body(self.holder)[:3, :3] @ self.holder_from_hole[:3, 2]

    def turned(self, scene: BodyPoses) -> np.ndarray:
        """Rotation (4, 4) about the hole's axis, among those at which the part looks the same, that is nearest to the held
        part's present rotation."""
        hole, mate = self._relative(scene)
        angle = measure_fit(hole, mate, 1).turn_rad
        wrong = measure_fit(hole, mate, self.num_turns).turn_rad
        return turn((0, 0, float(angle - wrong)))


@dataclass(frozen=True, kw_only=True)
class Aim:
    """Where a hand aims that inserts a held part: the hand's aiming error, the part's pose in the hand, and the displacement of
    the compliant wrist.
    """

    off_m: np.ndarray
    """(2,) error of the aim across the hole's axis [m]."""
    off_rad: np.ndarray
    """(3,) error of the direction, about the part's leading end [rad]."""
    part_from_tcp: np.ndarray
    """(4, 4) pose of the TCP in the part's frame when the expert last observed it."""
    turned: np.ndarray
    """(4, 4) rotation about the hole's axis at which the part is inserted: one of those at which it looks the same."""
    given: np.ndarray = field(default_factory=lambda: np.zeros(6))
    """(6,) [m, rad] displacement of the compliant wrist by contact, about the TCP, in the hole's frame; 0 along the hole's
    axis."""

    def pose(self, scene: BodyPoses, mating: Mating, depth_m: float) -> np.ndarray:
        """World-from-TCP (4, 4) that brings the part's leading end to ``depth_m`` [m] in the hole, with the hand's aiming
        error.
        """
        hole = scene.body(mating.holder) @ mating.holder_from_hole
        mate = transform((*self.off_m, depth_m)) @ turn(self.off_rad) @ self.turned
        pose = hole @ mate @ inverse(mating.held_from_mate) @ self.part_from_tcp
        pose[:3, :3] = (
            hole[:3, :3] @ turn(self.given[3:])[:3, :3] @ hole[:3, :3].T @ pose[:3, :3]
        )
        pose[:3, 3] += hole[:3, :3] @ self.given[:3]
        return pose

    @property
    def exact(self) -> "Aim":
        """Copy of this aim with zero position error (``off_m``) and zero direction error (``off_rad``)."""
        return replace(self, off_m=np.zeros(2), off_rad=np.zeros(3))

    def poses(
        self, scene: BodyPoses, mating: Mating, depth_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return two target poses (4, 4) of the TCP in the world: with the errors of this aim, and without them. The arguments
        are those of ``pose``."""
        return self.pose(scene, mating, depth_m), self.exact.pose(
            scene, mating, depth_m
        )

    def giving_way(
        self, scene: BodyPoses, mating: Mating, push_world: np.ndarray
    ) -> "Aim":
        """The aim after contact forces have displaced the compliant wrist by ``push_world`` (6,) [m, rad], except along the
        hole's axis."""
        world_from_hole = (scene.body(mating.holder) @ mating.holder_from_hole)[:3, :3]
        sideways = world_from_hole.T @ push_world[:3] * (1, 1, 0)
        return replace(
            self, given=self.given + np.r_[sideways, world_from_hole.T @ push_world[3:]]
        )


def deflection(wanted: np.ndarray, actual: np.ndarray) -> np.ndarray:
    """Difference (6,) [m, rad] from the pose ``wanted`` to ``actual``, (4, 4) each, in the world frame: translation, then
    rotation vector.
    """
    off = np.empty(6)
    off[:3] = actual[:3, 3] - wanted[:3, 3]
    off[3:] = wanted[:3, :3] @ rotvec(wanted, actual)
    return off
