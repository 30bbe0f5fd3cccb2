"""Do Puzzle: pieces are picked up by their knobs, pressed onto the tray and moved until they drop into their holes."""

from collections.abc import Generator
from dataclasses import replace
from functools import partial

import numpy as np

from taccorl.errors import LostError
from taccorl.sim.part import Part
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.experts.hands import DT_S
from taccorl.tasks.experts.scripted import Aim, Mating, Script, ScriptedExpert
from taccorl.tasks.experts.se3 import turn
from taccorl.tasks.puzzle.scene import Puzzle

# Heights of a piece's underside over the tray's top: when carried (clear of the other knobs), and before it is pressed.
_CARRY_M, _HOVER_M = 0.045, 0.003
_REACH_MPS, _CARRY_MPS, _NEAR_MPS = (
    0.35,
    0.30,
    0.15,
)  # peak speeds: empty, with a piece, up and down
# The arm has 7 N/mm over the tray. Pressed on a corner by more than some 10 N, a piece would turn in the fingers.
_FEEL = 0.4  # of the configuration's: blocked at 4 N more than the hand's own damping
_LIGHTLY_M = 0.0005  # the command below the piece while it slides on the tray
_EASE_M = 0.002  # the hand lifts by that much before it presses again
_IN_MOUTH_M, _AT_FLOOR_M, _FLOOR_M = (
    0.001,
    0.0092,
    0.010,
)  # depth from which it has dropped in, lies, and of the hole
_FASTER_IN_HOLE = (
    3.0  # than down to the tray, where a quick hand would hit hard: 0.6 N for each mm/s
)
_LET_GO_M = 0.045  # between the pads: wider, the fingers would reach the knobs beside
_LEVEL_RAD = 0.3  # a piece that leans by more cannot be gripped by its knob
_NEAR_TRAY_M = 0.13  # from the tray's middle: in the other hand's way
_LONGEST_S = 10.0  # to press on one piece
_MOST_TRIES = 4  # to place one piece
_HAND = {"triangle": "right", "circle": "left", "heart": "right"}


class PuzzleExpert(ScriptedExpert):
    """Expert of the puzzle. The right hand places triangle and heart, the left hand the circle between them; one hand at a
    time."""

    def script(self, arm: str) -> Script:
        return self._left() if arm == "left" else self._right()

    def finish(self, arm: str, subtask: str) -> Script:
        yield from self._place(arm, subtask.removeprefix("place "), is_near=True)
        if arm == "right" and subtask == self._task.subtasks()[arm][-1].name:
            yield from self._retreat(arm)

    def remaining(self, arm: str) -> Script:
        order = self._order()
        own = [shape for shape in order if _HAND[shape] == arm]
        for shape in own:
            self._require_grippable(arm, shape)
        return self._go_on(arm, own, order)

    def _order(self) -> list[str]:
        """Pieces that are not in yet, by turns: triangle, circle, heart; with the heart first where the right hand holds it."""
        order = ["triangle", "circle", "heart"]
        if self.holds("right", self._part("heart")) and not self._is_in("triangle"):
            order.reverse()
        return [shape for shape in order if not self._is_in(shape)]

    def _go_on(self, arm: str, own: list[str], order: list[str]) -> Script:
        """Place these pieces, the first of which may be in the hand, in turns with the other hand."""
        for shape in own:
            part, mating = self._part(shape), self._mating(shape)
            if not self.holds(arm, part):
                yield from self._lift(arm, shape)
            else:
                yield from self.firm(arm, part.grasps["knob"].width_m)
                low_m = float(mating.fit(self).depth_m) + _CARRY_M
                if low_m > 0 and not self.is_in(mating):
                    yield from self.move(
                        arm, raised(self.hands[arm].pose, low_m), speed_mps=_NEAR_MPS
                    )
            before = order[: order.index(shape)]
            if not {
                _is_in(other) for other in before
            } <= self.flags and self._is_over_tray(arm):
                home = self.kinematics[arm].pose(np.array(self._task.home_rad[arm]))
                yield from self.move(arm, self.near(home), speed_mps=_CARRY_MPS)
            for other in before:
                yield from self.wait_for(_is_in(other), self._task.time_limit_s)
            yield from self._place(arm, shape)
            self.flags.add(_is_in(shape))
        yield from self._retreat(arm)

    def _is_over_tray(self, arm: str) -> bool:
        return bool(
            np.linalg.norm((self.tcp(arm) - self.body("tray"))[:2, 3]) < _NEAR_TRAY_M
        )

    def _is_in(self, shape: str) -> bool:
        """In its hole and let go."""
        return bool(self._task.placed(self.sim, shape)[0])

    def _require_grippable(self, arm: str, shape: str) -> None:
        """
        Raises:
            LostError: the piece is neither in the hand nor lies on its underside.
        """
        part = self._part(shape)
        if self.holds(arm, part):
            return
        self.require_not_in_other_hand(arm, part)
        if self.body(shape)[2, 2] < np.cos(_LEVEL_RAD):
            raise LostError(f"{shape} lies on another side than at the reset")

    def _mating(self, shape: str) -> Mating:
        return Mating.of(self._part(shape), self._task.tray, shape)

    def _left(self) -> Script:
        yield from self.pause("left", 0.0, 1.0)
        yield from self._lift("left", "circle")
        yield from self.wait_for(_is_in("triangle"), self._task.time_limit_s)
        yield from self._place("left", "circle")
        self.flags.add(_is_in("circle"))
        yield from self._retreat("left")

    def _right(self) -> Script:
        yield from self.pause("right", 0.0, 0.4)
        yield from self._lift("right", "triangle")
        yield from self._place("right", "triangle")
        self.flags.add(_is_in("triangle"))
        yield from self._lift("right", "heart")
        yield from self.wait_for(_is_in("circle"), self._task.time_limit_s)
        yield from self._place("right", "heart")
        yield from self._retreat("right")

    # one piece --------------------------------------------------------------------------------------------------------

    def _lift(self, arm: str, shape: str, height_m: float = 0.06) -> Script:
        """Grip a piece by its knob where it lies and lift it."""
        ahead = partial(raised, height_m=0.04)
        yield from self.reach(
            arm, self._knob(shape), ahead, speed_mps=_NEAR_MPS, far_mps=_REACH_MPS
        )
        yield from self.close(arm, self._part(shape).grasps["knob"].width_m)
        yield from self.move(
            arm, raised(self.hands[arm].pose, height_m), speed_mps=_NEAR_MPS
        )

    def _place(self, arm: str, shape: str, *, is_near: bool = False) -> Script:
        """Carry a held piece to its hole, where it may be already, feel it in, let go, look; grip it again where it rests on
        the rim."""
        mating = self._mating(shape)
        for attempt in range(_MOST_TRIES):
            if attempt:
                self.felt(arm, f"{shape} rests on the rim")
                yield from self._lift(arm, shape, height_m=0.02)
            yield from self._press(arm, mating, carry=bool(attempt) or not is_near)
            yield from self.open(arm, _LET_GO_M)
            yield from self.move(
                arm, raised(self.hands[arm].pose, 0.035), speed_mps=_NEAR_MPS
            )
            self.hands[arm].learns, self.hands[arm].steadiness = True, 1.0
            if self._task.placed(self.sim, shape)[0]:
                return

    def _press(self, arm: str, mating: Mating, *, carry: bool) -> Script:
        """Carry a held piece over its hole and press it down; where the rim stops it, slide it on lightly until it drops in;
        push it to the floor.

        The hole is seen with an error, of which each slide takes a part away. After a slide in vain the hand lifts a little,
        looks at the piece in its fingers, which may have turned, and presses again.
        """
        hand, config = self.hands[arm], self.config
        hand.mating = mating
        aim = self._first_aim(arm, mating)
        if carry:
            yield from self.aim(arm, mating, aim, -_CARRY_M, speed_mps=_CARRY_MPS)
        yield from self.aim(
            arm, mating, aim, -_HOVER_M, speed_mps=_NEAR_MPS, settle=True
        )
        hand.learns, hand.steadiness = False, 0.3
        aim, depth = (yield from self._align(arm, mating, aim, -_HOVER_M)), -_HOVER_M
        speed_mps = (
            self.rng.uniform(0.006, 0.010) if config.aim_m > 0 else 0.008
        ) * config.speed
        began, free = self.step_count, self.pushed(arm)
        while self.step_count - began < _LONGEST_S * CONTROL_HZ:
            at, pushed = float(mating.fit(self).depth_m), self.pushed(arm) - free
            if at > _AT_FLOOR_M:
                break
            if pushed[2] > _FEEL * config.feel_m:
                self.felt(arm, f"{mating.held} blocked at {at * 1e3:.1f} mm")
                corrected = self._corrected(aim)
                if at < _IN_MOUTH_M:
                    yield from self._slide(arm, mating, aim, corrected)
                aim, depth = corrected, float(mating.fit(self).depth_m)
                if depth < at + _IN_MOUTH_M:
                    depth = max(at, 0.0) - _EASE_M
                    yield from self.aim(arm, mating, aim, depth, speed_mps=0.04)
                    yield from self.settle(arm, longest_s=0.5)
                    aim = yield from self._align(arm, mating, aim, depth)
            elif at > _IN_MOUTH_M:
                aim = aim.giving_way(self, mating, config.give_way * pushed)
            depth = min(
                depth + speed_mps * DT_S * (_FASTER_IN_HOLE if at > _IN_MOUTH_M else 1),
                _FLOOR_M,
            )
            hand.place(*aim.poses(self, mating, depth))
            yield
        yield from self.pause(arm, 0.1, 0.25)

    def _align(
        self, arm: str, mating: Mating, aim: Aim, depth_m: float
    ) -> Generator[None, None, Aim]:
        """Look at the piece in the fingers, and bring it to where the aim says that it should be."""
        aim = self._look(arm, mating, aim)
        yield from self.aim(arm, mating, aim, depth_m, speed_mps=0.04)
        yield from self.settle(arm, longest_s=0.5)
        return aim

    def _slide(self, arm: str, mating: Mating, start: Aim, end: Aim) -> Script:
        """Slide a piece over the tray under light pressure, until it drops into its hole or the stretch is over."""
        num = round(self.rng.uniform(0.3, 0.5) / self.config.speed * CONTROL_HZ)
        for k in range(1, num + 1):
            at = float(mating.fit(self).depth_m)
            if at > _IN_MOUTH_M:
                return
            off_m = start.off_m + (end.off_m - start.off_m) * k / num
            off_rad = start.off_rad + (end.off_rad - start.off_rad) * k / num
            now = replace(end, off_m=off_m, off_rad=off_rad)
            self.hands[arm].place(*now.poses(self, mating, at + _LIGHTLY_M))
            yield

    def _retreat(self, arm: str) -> Script:
        """Back to where the hand began."""
        home = self.kinematics[arm].pose(np.array(self._task.home_rad[arm]))
        yield from self.move(arm, self.near(home), speed_mps=_REACH_MPS)

    def _knob(self, shape: str) -> np.ndarray:
        """TCP pose for a piece's knob, from above, among the four ways to grip it that with the hand's x nearest the base."""
        grip = self.body(shape) @ self._part(shape).grasps["knob"].part_from_tcp
        turned = [grip @ turn((0, 0, k * np.pi / 2)) for k in range(4)]
        return raised(
            min(turned, key=lambda pose: pose[0, 0]), 0.001 + self.config.grasp_m
        )

    @property
    def _task(self) -> Puzzle:
        assert isinstance(self.sim.task, Puzzle)
        return self.sim.task

    def _part(self, shape: str) -> Part:
        return self._task.pieces[shape]


def _is_in(shape: str) -> str:
    """Flag."""
    return f"{shape} is in"


def raised(pose: np.ndarray, height_m: float) -> np.ndarray:
    """``pose`` (4, 4) moved straight up by ``height_m``, (4, 4)."""
    up = pose.copy()
    up[2, 3] += height_m
    return up
