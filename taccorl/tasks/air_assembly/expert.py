"""Scripted expert of both assembly tasks: each hand lifts a part, the hands meet in the air, the plug is inserted by touch."""

from abc import abstractmethod
from itertools import chain

import numpy as np

from taccorl.sim.part import Part
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.air_assembly.scene import AirAssembly
from taccorl.tasks.experts.scripted import APART_M, Mating, Script, ScriptedExpert
from taccorl.tasks.experts.se3 import inverse, rotvec, transform

_TAIL, _HEAD = "tail", "head"  # grasps of the part with the hole and of the plug
_LEAN_RAD = (
    0.40  # hands lean away from each other, so that wrists and cameras keep apart
)
_GRIP_M = 0.028  # from the TCP to the part: it is gripped near the fingers' tips
_LIFT_M, _LIFT_MPS = 0.10, 0.12
_MEET_M = (0.32, 0.03, 0.16)  # the hole's mouth
_NEAR_M = 0.03  # from there: near enough
_LOW_M = 0.05  # a part in the air below that goes up before it goes anywhere
_CLEAR_M = 0.04  # between the plug and a hole that may still move
_LEFT_STEADINESS = 0.4  # of a hand that holds still for the other
_FIRMER = 1.2  # than the hand that inserts: what it holds is pushed
_LEVEL_RAD, _FREE_M = (
    0.03,
    0.0004,
)  # it brings a part that was pushed askew back to level once nothing pushes any more
_LONGEST_REGAIN_S = 1.0


class AirAssemblyExpert(ScriptedExpert):
    """Base of both assembly experts: both hands lift a part, the left one holds its part in the air, the right one inserts."""

    enough_m: float
    """Least depth in its hole at which the plug stays in place after release [m]."""
    _held_like: np.ndarray | None = None
    """(3, 3) orientation of the hole in the left hand when it began to hold it; None: level."""

    @property
    def scene(self) -> AirAssembly:
        """The task of the simulation."""
        assert isinstance(self.sim.task, AirAssembly)
        return self.sim.task

    @abstractmethod
    def world_from_level(self) -> np.ndarray:
        """Rotation matrix (3, 3), world from the held part, at which its hole is presented: the hole's axis points along world
        +y.
        """

    @abstractmethod
    def push_in(self, mating: Mating) -> Script:
        """Motion that inserts the plug, from both parts held in the hands to the plug in place and still in the hand."""

    def script(self, arm: str) -> Script:
        return self._left() if arm == "left" else self._right()

    def finish(self, arm: str, subtask: str) -> Script:
        return self._hold(self._hole()) if arm == "left" else self._join()

    def remaining(self, arm: str) -> Script:
        if arm == "left":
            if self.holds("left", self.scene.holder):
                return self._go_on_holding()
            self.require_lying("left", self.scene.holder)
            return self._left()
        plug = self.scene.plug
        if self.holds("right", plug):
            return self._go_on_joining()
        if self._mating().fit(self).depth_m > self.enough_m:
            return self._leave()
        self.require_lying("right", plug)
        return chain(self._lift("right", plug, _HEAD), self._meet())

    def _go_on_holding(self) -> Script:
        """Continue with the part with the hole in the left hand."""
        yield from self.firm(
            "left",
            self.scene.holder.grasps[_TAIL].width_m,
            _FIRMER * self.config.grip_n,
        )
        if self.is_in(self._mating()):
            self.flags.add("holder waits")
            yield from self._hold(self._hole())
            return
        if self._hole()[2, 3] < _LOW_M:
            yield from self.rise("left", _LIFT_M, _LIFT_MPS)
        yield from self._bring_mouth()

    def _go_on_joining(self) -> Script:
        """Continue with the plug in the right hand."""
        plug = self.scene.plug
        yield from self.firm("right", plug.grasps[_HEAD].width_m)
        if not self.is_in(self._mating()):
            fit = self._mating().fit(self)
            if (
                fit.depth_m > -_CLEAR_M and fit.lateral_m < 2 * _CLEAR_M
            ):  # out of the way of a left hand that may turn
                back = self.hands["right"].pose.copy()
                back[:3, 3] -= (
                    _CLEAR_M + max(float(fit.depth_m), 0.0)
                ) * self._mating().axis(self)
                yield from self.move("right", back, speed_mps=_LIFT_MPS)
            elif self.body(plug.name)[2, 3] < _LOW_M:
                yield from self.rise("right", _LIFT_M, _LIFT_MPS)
        yield from self._meet()

    def _lift(self, arm: str, part: Part, grasp: str) -> Script:
        meant = self.grasp(
            part, grasp, lean_rad=_LEAN_RAD, lift_m=0.004, pivot_m=_GRIP_M
        )
        yield from self.reach(
            arm, meant, lambda pose: pose @ transform((0, 0, -0.08)), speed_mps=0.1
        )
        yield from self.close(
            arm,
            part.grasps[grasp].width_m,
            self.config.grip_n * (_FIRMER if arm == "left" else 1.0),
        )
        yield from self.rise(arm, _LIFT_M, _LIFT_MPS)

    def _left(self) -> Script:
        yield from self._lift("left", self.scene.holder, _TAIL)
        yield from self._bring_mouth()

    def _bring_mouth(self) -> Script:
        """Bring the hole level to where the hands meet, or leave it where it is if that is near, and hold it there."""
        hole = self._hole()
        hole_from_tcp = inverse(hole) @ self.tcp("left")
        is_near = np.linalg.norm(hole[:3, 3] - _MEET_M) < _NEAR_M
        mouth = transform(
            (hole if is_near else self.near(transform(_MEET_M)))[:3, 3],
            self.world_from_level(),
        )
        yield from self.move(
            "left", mouth @ hole_from_tcp, speed_mps=_LIFT_MPS, settle=True
        )
        self.flags.add("holder waits")
        yield from self._hold(mouth)

    def _hold(self, mouth: np.ndarray) -> Script:
        """Hold the hole still at ``mouth`` (4, 4) until the plug is in."""
        self.hands["left"].steadiness, self.hands["left"].learns = (
            _LEFT_STEADINESS,
            False,
        )
        self._held_like = mouth[:3, :3]
        while "plug is in" not in self.flags:
            self.hands["left"].learns = self._mating().fit(self).depth_m < -APART_M
            if (
                self._askew_rad() > _LEVEL_RAD
                and np.linalg.norm(self.pushed("left")[:3]) < _FREE_M
            ):
                yield from self.move(
                    "left", mouth @ inverse(self._hole()) @ self.tcp("left")
                )
                yield from self.settle("left")
            yield

    def _hole(self) -> np.ndarray:
        """World-from-hole (4, 4) now."""
        part = self.scene.holder
        return self.body(part.name) @ part.holes[self.scene.hole].part_from_hole

    def _mating(self) -> Mating:
        return Mating.of(self.scene.plug, self.scene.holder, self.scene.hole)

    def _askew_rad(self) -> float:
        """How far the hole is turned from how it is to be held."""
        held_like = (
            self.world_from_level() if self._held_like is None else self._held_like
        )
        return float(np.linalg.norm(rotvec(held_like, self._hole())))

    def regain(self, arm: str) -> Script:
        """Wait until the left hand has brought the hole back to level."""
        yield from super().regain(arm)
        for _ in range(round(_LONGEST_REGAIN_S * CONTROL_HZ)):
            if self._askew_rad() < _LEVEL_RAD:
                return
            yield

    def _right(self) -> Script:
        yield from self.pause("right", 0.0, 0.4)
        yield from self._lift("right", self.scene.plug, _HEAD)
        yield from self._meet()

    def _meet(self) -> Script:
        yield from self.wait_for("holder waits")
        yield from self._join()

    def _join(self) -> Script:
        """From the plug held to the hand away from it."""
        yield from self.push_in(self._mating())
        yield from self._leave()

    def _leave(self) -> Script:
        """Open the right hand and take it away from the plug."""
        yield from self.open("right")
        away = self.hands["right"].pose.copy()
        away[:3, 3] -= 0.08 * away[:3, 2]
        yield from self.move("right", away, speed_mps=_LIFT_MPS)
        yield from self.pause("right", 0.6, 0.7)
        self.flags.add("plug is in")
