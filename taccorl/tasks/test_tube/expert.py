"""Test Tube Insertion: the left hand grips the rack's handle; the right hand lifts the tube, turns it upright and inserts it,
corrected by touch."""

from dataclasses import replace
from itertools import chain

import numpy as np

from taccorl.errors import LostError
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.experts.hands import ScriptedExpertConfig
from taccorl.tasks.experts.scripted import Mating, Script, ScriptedExpert
from taccorl.tasks.experts.se3 import inverse, transform, turn
from taccorl.tasks.test_tube.scene import TestTube

_LEAN_LEFT_RAD = 0.40  # away from the right hand
_TIPS_M = 0.034  # from the TCP to the fingertips, about which the left hand leans: they keep clear of the rack's body
_LEAN_RIGHT_RAD = 0.575  # towards the cap; the hand then comes from above and behind when the tube stands
_TOWARDS_TIPS_M = (
    0.023  # of the tube, from the pads' middle: the fingers stay above the rack
)
_GRIP_M = (
    0.0600,
    0.0645,
)  # from the tube's bottom: clear of the stand's block now, of the rack later
_HOVER_M = (0.400, 0.005, 0.110)  # of the upright tube's bottom
_LIFT_M = 0.06
_IN_STAND_M = 0.004
# of a tube that can be brought to the hole's mouth from where it is
_UPRIGHT_RAD, _ABOVE_HOLE_M, _CLEAR_M = (0.5, 0.05, 0.02)
_HEADING_RAD = np.deg2rad(55)  # of the hand above the rack
_TURN_RADPS = 0.8  # fastest joint while the tube turns, on average
_GIVE_WAY = 0.25  # at least: both plates of the rack hold the tube, and a stiff wrist would wedge it between them
_OPEN_M = 0.040  # at the rack, wide enough for the cap: the left hand is near


class TestTubeExpert(ScriptedExpert):
    """Expert of the task: the left hand holds the rack, the right hand inserts the tube."""

    __test__ = False

    def __init__(
        self,
        sim: Simulation,
        rng: np.random.Generator,
        config: ScriptedExpertConfig | None = None,
    ) -> None:
        config = config or ScriptedExpertConfig()
        super().__init__(
            sim, rng, replace(config, give_way=max(config.give_way, _GIVE_WAY))
        )

    def script(self, arm: str) -> Script:
        return self._left() if arm == "left" else self._right()

    def finish(self, arm: str, subtask: str) -> Script:
        return self._hold() if arm == "left" else self._insert()

    def remaining(self, arm: str) -> Script:
        rack, tube = self._task.rack, self._task.tube
        if arm == "left":
            if self.holds("left", rack):
                return self._go_on_holding()
            self.require_lying("left", rack)
            return self._left()
        if self.holds("right", tube):
            return self._go_on_inserting()
        if (
            self.is_in(self._mating()) or self._task.inside(self._task.fit(self.sim))[0]
        ):  # or falls in
            return self._leave()
        self.require_not_in_other_hand("right", tube)
        seat = self.body("stand") @ self._task.stand.seats["tube"]
        if np.linalg.norm((inverse(seat) @ self.body("tube"))[:3, 3]) > _IN_STAND_M:
            raise LostError("tube is neither in a hand nor in the stand")
        return chain(self._lift(), self._turn_upright(), self._insert_when_held())

    def _go_on_holding(self) -> Script:
        """With the rack in the left hand."""
        yield from self.firm("left", self._task.rack.grasps["handle"].width_m)
        self.flags.add("rack is held")
        yield from self._hold()

    def _go_on_inserting(self) -> Script:
        """With the tube in the right hand."""
        yield from self.firm("right", self._task.tube.grasps["middle"].width_m)
        mating, tube = self._mating(), self.body("tube")
        if not self.is_in(mating):
            fit = mating.fit(self)
            is_above = (
                tube[2, 2] > np.cos(_UPRIGHT_RAD) and fit.lateral_m < _ABOVE_HOLE_M
            )
            if (
                float(fit.depth_m) > -_CLEAR_M
            ):  # off the hole it would be pulled over the rack, in the stand along it
                yield from self.rise(
                    "right", float(fit.depth_m) + _CLEAR_M if is_above else _LIFT_M
                )
            if not is_above:
                yield from self._turn_upright()
        yield from self._insert_when_held()

    def _left(self) -> Script:
        rack = self._task.rack
        meant = self.grasp(
            rack, "handle", lean_rad=_LEAN_LEFT_RAD, lift_m=0.004, pivot_m=_TIPS_M
        )
        yield from self.reach(
            "left", meant, lambda pose: pose @ transform((0, 0, -0.07)), speed_mps=0.1
        )
        yield from self.close("left", rack.grasps["handle"].width_m)
        self.flags.add("rack is held")
        yield from self._hold()

    def _hold(self) -> Script:
        """Keep the rack where it is until the tube is in."""
        hand = self.hands["left"]
        hand.steadiness, hand.learns, hand.rests = 0.4, False, True
        yield from self.wait_for("tube is in")

    def _right(self) -> Script:
        yield from self.pause("right", 0.0, 0.4)
        yield from self._lift()
        yield from self._turn_upright()
        yield from self._insert_when_held()

    def _insert_when_held(self) -> Script:
        yield from self.wait_for("rack is held")
        yield from self._insert()

    def _insert(self) -> Script:
        """From the tube upright and held to the hand away from it."""
        yield from self.insert("right", self._mating(), depth_m=0.0445, enough_m=0.0425)
        yield from self._leave()

    def _mating(self) -> Mating:
        return Mating.of(self._task.tube, self._task.rack, "middle")

    def _leave(self) -> Script:
        """Open the right hand and take it away from the tube."""
        yield from self.open("right", _OPEN_M)
        away = self.hands["right"].pose @ transform((0, 0, -0.08))
        yield from self.move("right", away, speed_mps=0.12)
        yield from self.pause("right", 0.6, 0.7)
        self.flags.add("tube is in")

    def _lift(self) -> Script:
        tube = self._task.tube
        meant = self._kept_clear(
            self.grasp(tube, "middle", lean_rad=_LEAN_RIGHT_RAD)
        ) @ transform((0, 0, -_TOWARDS_TIPS_M))
        yield from self.reach(
            "right", meant, lambda pose: pose @ transform((0, 0, -0.06)), speed_mps=0.1
        )
        yield from self.close("right", tube.grasps["middle"].width_m)
        yield from self.rise("right", _LIFT_M)

    def _kept_clear(self, goal: np.ndarray) -> np.ndarray:
        """The same grasp moved along the tube to where no finger meets the stand, as the eye would."""
        grip = inverse(self.body("tube")) @ goal
        along_m = (
            grip[2, 3] - grip[0, 3] * grip[2, 2] / grip[0, 2]
        )  # where the approach crosses the tube's axis
        shift_m = np.clip(along_m, *_GRIP_M) - along_m
        return transform(shift_m * self.body("tube")[:3, 2]) @ goal

    def _turn_upright(self) -> Script:
        """Bring the tube's bottom to ``_HOVER_M``, cap up, along a straight line in the space of joints.

        The wrist passes through joint 5 = 0, where joints 4 and 6 turn about the same axis: on a straight line of the hand
        they would have to jump.
        """
        hand, kinematics = self.hands["right"], self.kinematics["right"]
        tube_from_tcp = inverse(self.body("tube")) @ self.tcp("right")
        heading = np.arctan2(tube_from_tcp[1, 2], tube_from_tcp[0, 2])
        goal = (
            self.near(transform(_HOVER_M))
            @ turn((0, 0, _HEADING_RAD - heading))
            @ tube_from_tcp
        )
        start, end = hand.joints_rad.copy(), kinematics.search(goal, self.rng)
        yield from self._along_joints(start, end)
        yield from self.settle("right")

    def _along_joints(self, start: np.ndarray, end: np.ndarray) -> Script:
        hand = self.hands["right"]
        slow = self.rng.uniform(0.85, 1.2) if self.config.waypoint_m > 0 else 1.0
        num = round(
            slow
            * np.abs(end - start).max()
            / _TURN_RADPS
            / self.config.speed
            * CONTROL_HZ
        )
        for k in range(1, num + 1):
            x = k / num
            joints = start + (end - start) * (10 * x**3 - 15 * x**4 + 6 * x**5)
            hand.place(self.kinematics["right"].pose(joints))
            hand.steadiness = min(
                1.0, abs(joints[4]) / 0.3
            )  # near joint 5 = 0 a tremor is out of the wrist's reach
            yield

    @property
    def _task(self) -> TestTube:
        assert isinstance(self.sim.task, TestTube)
        return self.sim.task
