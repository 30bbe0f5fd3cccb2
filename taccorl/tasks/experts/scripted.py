"""The scripted expert: two hands that move like a person at leader arms, detect when a part is blocked, and correct their aim.

Each arm is a generator of targets (TCP pose, gripper opening), one per control step; ``act`` converts both into 14 joint
targets. It sees the true poses, as a person sees the bench, but aims with an error: it detects a wrong aim only when the part is
blocked, as a person does, backs off and has a smaller error in the next try. Those corrections are what a policy with touch is
to learn. The human-like errors are tuned to about 2 corrections per insertion.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.errors import LostError, TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.part import Part
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.experts.hands import (
    DT_S,
    LEARNED,
    Hand,
    Pulses,
    ScriptedExpertConfig,
    follow,
    squeezed_m,
)
from taccorl.tasks.experts.kinematics import ArmKinematics, retargeted
from taccorl.tasks.experts.mating import Aim, Mating, deflection
from taccorl.tasks.experts.se3 import (
    PEAK_OF_MEAN,
    between,
    inverse,
    is_on_way,
    minimum_jerk,
    rotvec,
    transform,
    turn,
)

_TREMOR_KEPT = math.exp(
    -DT_S / 0.3
)  # from one control step to the next; its correlation time is 0.3 s
_RECOIL_MPS = 0.08  # of a hand that has felt a block
_LONGEST_PUSH_S = 12.0
_AT_MOUTH_M = 0.004  # shallower is the rim, deeper is a wedge
_STRAIGHT = 0.5  # of the turn that is felt: a part that is in the mouth and turned by less is pushed on
_SAME_SIDE_RAD, _SAME_HEIGHT_M = (
    0.15,
    0.005,
)  # a part that lies like that lies on the side on which it lay at the reset
_LOOSE_M = 0.001  # wider than a firm grip is not firm
_OPEN_ENOUGH_M, _AT_GRASP_M = (
    0.003,
    0.01,
)  # how much less is still open; so near its grasp a hand closes where it is
_ON_THE_WAY = (
    0.015,
    0.3,
)  # largest distance and turn of a hand that is on its way down to a grasp [m, rad]. Choices.
APART_M = (
    0.002  # the end of a held part that is farther before its hole touches nothing
)
_NEAR_MATE_M = (
    0.008  # no pulses where the end of a held part is nearer before its hole, or in it
)

Script = Iterator[None]
"""Motion of one arm as a generator: one yield per control step."""


class ScriptedExpert(ABC):
    """Scripted expert for one episode. ``act()`` returns the next action until ``done``.

    Subclasses write ``script(arm)``: a generator that moves ``self.hands[arm]`` and yields once a control step."""

    def __init__(
        self,
        sim: Simulation,
        rng: np.random.Generator,
        config: ScriptedExpertConfig | None = None,
    ) -> None:
        if sim.num_sims != 1:
            raise TaccorlError(f"an expert drives one simulation, not {sim.num_sims}")
        self.sim, self.rng, self.config = sim, rng, config or ScriptedExpertConfig()
        self.kinematics = {
            arm: ArmKinematics(arm, sim.config.robot) for arm in ROBOT.arms
        }
        gains = {arm: sim.config.controller_of(arm) for arm in ROBOT.arms}
        self._lag_s = {
            arm: np.divide(g.kd_nms_per_rad, g.kp_nm_per_rad)
            for arm, g in gains.items()
        }
        # Of its own, so that what a hand decides does not depend on how many control steps went before.
        self._tremor_rng = rng.spawn(1)[0]
        self._tremor = np.repeat((self.config.tremor_m, self.config.tremor_rad), 3)
        self.pulses = {
            arm: Pulses(self.config.pulse_rad, own)
            for arm, own in zip(ROBOT.arms, rng.spawn(2), strict=True)
        }
        """Pulses of each arm."""
        self._pulse_rad = {arm: np.zeros(ROBOT.num_joints) for arm in ROBOT.arms}
        self.events: list[tuple[int, str]] = []
        """(control step, text): corrections after a block was detected by touch."""
        self.unreachable_m = 0.0
        """Largest remaining error of inverse kinematics [m]."""
        self.step_count = 0
        self.flags: set[str] = set()
        """Flags by which one arm signals the other that a part of its motion has ended."""

    @abstractmethod
    def script(self, arm: str) -> Script:
        """Motion of one arm as a generator: one yield per control step."""

    def finish(self, arm: str, subtask: str) -> Script:
        """Motion that completes a subtask, from the held part close before its mate; an arm's last one ends with its retreat.

        Raises:
            TaccorlError: this expert can only start at the beginning of an episode.
        """
        raise TaccorlError(
            f"expert of {self.sim.task.name}: cannot start within {subtask!r}; implement its finish()"
        )

    @classmethod
    def can_finish(cls) -> bool:
        """Whether the expert can start in the middle of a subtask (``finish``)."""
        return cls.finish is not ScriptedExpert.finish

    def start(self) -> None:
        """Start both arms' scripts after a reset of the simulation."""
        self.stand_by()
        self._scripts = {arm: self.script(arm) for arm in ROBOT.arms}
        self.running = set(ROBOT.arms)

    def stand_by(self) -> None:
        """Start after a reset of the simulation, while another controller moves the arms until ``take_over``."""
        command = self.sim.arrays["ctrl"][0, self.sim.action_actuators]
        self.hands = {}
        for arm in ROBOT.arms:
            own = ROBOT.joint_slice(arm)
            joints = self.sim.proprioception()[0, own].copy()
            pose = self.kinematics[arm].pose(joints)
            self.hands[arm] = Hand(
                pose=pose,
                opening_m=float(command[ROBOT.gripper_index(arm)]),
                joints_rad=joints,
                bias_rad=joints - command[own],
                predicted_rad=joints,
                goal=pose,
            )
        self._scripts: dict[str, Script] = {}
        self.running: set[str] = set()
        """Arms that the expert moves."""
        self.step_count = 0
        self.flags, self.events = set(), []

    def take_over(
        self, arm: str, subtask: str, pose: np.ndarray, opening_m: float
    ) -> None:
        """Finish ``subtask`` with an arm whose last target, set by another controller, was the world-from-TCP pose ``pose``
        (4, 4) in free motion."""
        joints = self.sim.proprioception()[0, ROBOT.joint_slice(arm)].copy()
        self.hands[arm] = Hand(
            pose=pose,
            opening_m=opening_m,
            joints_rad=self.kinematics[arm].solve(pose, joints)[0],
            bias_rad=np.zeros(ROBOT.num_joints),
            predicted_rad=joints,
            goal=pose,
        )
        self._scripts[arm] = self.finish(arm, subtask)
        self.running.add(arm)

    def remaining(self, arm: str) -> Script:
        """Remaining motion of one arm from the simulation's present state, anywhere in the task.

        Raises:
            LostError: the task cannot be completed from there.
            TaccorlError: this expert can only start at the beginning of an episode.
        """
        raise TaccorlError(
            f"expert of {self.sim.task.name}: cannot take over within a task; implement its remaining()"
        )

    @classmethod
    def can_resume(cls) -> bool:
        """Whether the expert can start from any state (``remaining``)."""
        return cls.remaining is not ScriptedExpert.remaining

    def resume(self) -> None:
        """Take over both arms in the simulation's present state, independently of what happened since its reset. The first
        action repeats the command in force, so that the arms do not jump.

        Raises:
            LostError, TaccorlError: as ``remaining``.
        """
        self.stand_by()
        for hand in self.hands.values():
            hand.brought = True
        self._scripts = {arm: self.remaining(arm) for arm in ROBOT.arms}
        self.running = set(ROBOT.arms)

    @property
    def done(self) -> bool:
        """True if both arms have finished."""
        return not self.running

    def act(self) -> np.ndarray:
        """(14,) float32 joint targets [rad] and openings [m] of the next control step."""
        action = np.empty(ROBOT.num_actions)
        allowed = self._may_be_pushed()
        for arm in ROBOT.arms:
            if arm in self.running:
                try:
                    next(self._scripts[arm])
                except StopIteration:
                    self.running.discard(arm)
            self._pulse_rad[arm] = self.pulses[arm].next_rad(
                allowed and not self.hands[arm].rests
            )
            action[ROBOT.joint_slice(arm)] = self._joints(arm) + self._pulse_rad[arm]
            action[ROBOT.gripper_index(arm)] = self.hands[arm].opening_m
        self.step_count += 1
        return np.clip(action, ROBOT.action_low, ROBOT.action_high).astype(np.float32)

    def _may_be_pushed(self) -> bool:
        matings = [
            hand.mating for hand in self.hands.values() if hand.mating is not None
        ]
        return all(mating.fit(self).depth_m < -_NEAR_MATE_M for mating in matings)

    def intended(self, action: np.ndarray) -> np.ndarray:
        """Return ``action`` without pulses, aiming error and tremor, as the training target of a policy: (14,) float32 joint
        targets [rad] and gripper openings [m].

        Args:
            action: (14,) the array that the latest call of ``act`` returned.
        """
        joints_rad = {arm: hand.joints_rad for arm, hand in self.hands.items()}
        goals = {arm: hand.intended for arm, hand in self.hands.items()}
        undisturbed = action.astype(float)
        for arm, pulse_rad in self._pulse_rad.items():
            undisturbed[ROBOT.joint_slice(arm)] -= pulse_rad
        return retargeted(undisturbed, self.kinematics, joints_rad, goals)

    def _joints(self, arm: str) -> np.ndarray:
        """(J,) targets that bring the hand, with its tremor, to where it wants to be."""
        hand, actual = (
            self.hands[arm],
            self.sim.proprioception()[0, ROBOT.joint_slice(arm)],
        )
        if hand.learns and not self.pulses[arm].displaces:
            hand.bias_rad = hand.bias_rad + LEARNED * (actual - hand.predicted_rad)
        hand.goal = self._shaken(hand)
        joints, error_m = self.kinematics[arm].solve(hand.goal, hand.joints_rad)
        self.unreachable_m = max(self.unreachable_m, error_m)
        hand.predicted_rad = follow(
            hand.predicted_rad, hand.joints_rad, joints, self._lag_s[arm]
        )
        hand.joints_rad = joints
        return joints - hand.bias_rad

    def _shaken(self, hand: Hand) -> np.ndarray:
        fresh = (
            math.sqrt(1 - _TREMOR_KEPT**2)
            * self._tremor
            * self._tremor_rng.normal(size=6)
        )
        hand.tremor = _TREMOR_KEPT * hand.tremor + fresh
        shake = hand.steadiness * hand.tremor
        goal = hand.pose @ turn(shake[3:])
        goal[:3, 3] += shake[:3]
        return goal

    # primitives: each yields once a control step ----------------------------------------------------------------------

    def move(
        self,
        arm: str,
        goal: np.ndarray | Callable[[], np.ndarray],
        *,
        speed_mps: float = 0.2,
        turn_radps: float = 1.2,
        settle: bool = False,
        intended: Callable[[], np.ndarray] | None = None,
    ) -> Script:
        """Move to the world-from-TCP pose ``goal`` (4, 4) with a minimum-jerk motion; a callable goal is evaluated at each step.
        ``intended`` returns the goal (4, 4) without the error of the hand's aim, if it has one.

        ``speed_mps`` and ``turn_radps`` are peak speeds, before the configuration's factor ``speed``; with ``settle`` the motion
        ends when the hand is at rest.
        """
        hand, start, meant = (
            self.hands[arm],
            self.hands[arm].pose.copy(),
            self.hands[arm].intended.copy(),
        )
        aim = goal if callable(goal) else lambda: goal
        exact = aim if intended is None else intended
        distance = np.linalg.norm(aim()[:3, 3] - start[:3, 3])
        angle = np.linalg.norm(rotvec(start, aim()))
        slow = self.rng.uniform(0.85, 1.2) if self.config.waypoint_m > 0 else 1.0
        duration_s = (
            slow
            * max(0.25, PEAK_OF_MEAN * max(distance / speed_mps, angle / turn_radps))
            / self.config.speed
        )
        num = max(2, round(duration_s * CONTROL_HZ))
        for k in range(1, num + 1):
            share = minimum_jerk(k / num)
            hand.place(between(start, aim(), share), between(meant, exact(), share))
            yield
        if settle:
            yield from self.settle(arm)

    def settle(
        self,
        arm: str,
        tolerance_m: float = 0.0004,
        longest_s: float = 1.2,
        tolerance_rad: float = 0.006,
    ) -> Script:
        """Wait until the hand has reached its target within both tolerances, at most ``longest_s``."""
        for _ in range(round(longest_s * CONTROL_HZ)):
            error = deflection(self.hands[arm].goal, self.tcp(arm))
            if (
                np.linalg.norm(error[:3]) < tolerance_m
                and np.linalg.norm(error[3:]) < tolerance_rad
            ):
                return
            yield

    def pause(self, arm: str, low_s: float = 0.08, high_s: float = 0.3) -> Script:
        """Keep still for a random time between ``low_s`` and ``high_s`` [s]."""
        for _ in range(round(self.rng.uniform(low_s, high_s) * CONTROL_HZ)):
            yield

    def close(self, arm: str, width_m: float, force_n: float | None = None) -> Script:
        """Close on a part of width ``width_m``, then squeeze with ``force_n`` (the configuration's by default).

        The smallest gripper command is 0: a narrow part is squeezed with less, at most 33 N at 20 mm with sprung pads."""
        force_n = self.config.grip_n if force_n is None else force_n
        yield from self._grip(
            arm, squeezed_m(self.sim.config.robot, width_m, force_n), 0.4
        )

    def firm(self, arm: str, width_m: float, force_n: float | None = None) -> Script:
        """Increase the grip force on a part of ``width_m`` that another controller has gripped to that of ``close``."""
        least_n = self.config.grip_n if force_n is None else force_n
        if (
            self.hands[arm].opening_m
            > squeezed_m(self.sim.config.robot, width_m, least_n) + _LOOSE_M
        ):
            yield from self.close(arm, width_m, force_n)

    def free(self, arm: str) -> Script:
        """Open a hand that holds nothing; no motion if it is open."""
        if self.hands[arm].opening_m < ROBOT.opening_max_m - _OPEN_ENOUGH_M:
            yield from self.open(arm)

    def rise(self, arm: str, height_m: float, speed_mps: float = 0.12) -> Script:
        """Move the hand straight up by ``height_m``."""
        up = self.hands[arm].pose.copy()
        up[2, 3] += height_m
        yield from self.move(arm, up, speed_mps=speed_mps)

    def open(self, arm: str, width_m: float = ROBOT.opening_max_m) -> Script:
        """Open the hand to ``width_m`` between the pads."""
        yield from self._grip(arm, min(width_m, ROBOT.opening_max_m), 0.3)
        self.hands[arm].mating = None

    def _grip(self, arm: str, opening_m: float, duration_s: float) -> Script:
        hand, start = self.hands[arm], self.hands[arm].opening_m
        num = max(2, round(duration_s * CONTROL_HZ))
        for k in range(1, num + 1):
            hand.opening_m = start + (opening_m - start) * k / num
            yield
        yield from self.pause(arm, 0.15, 0.25)

    def wait_for(self, flag: str, longest_s: float = 25.0) -> Script:
        """Keep still until the other arm has set ``flag``, at most ``longest_s``."""
        for _ in range(round(longest_s * CONTROL_HZ)):
            if flag in self.flags:
                return
            yield

    def insert(
        self,
        arm: str,
        mating: Mating,
        *,
        depth_m: float,
        enough_m: float,
        start_m: float = -0.02,
    ) -> Script:
        """Bring a held part before a hole (to the depth ``start_m``, negative outside) and push it in to a depth of at least
        ``enough_m`` [m]; the target depth is at most ``depth_m`` [m].

        Sideways and in rotation the hand is compliant, as a relaxed wrist is, so that the part aligns itself once it is in the
        mouth. When the part is blocked, the hand backs off, reads the pose of the part again, which may have turned in the hand,
        and aims again with a smaller error. A part that is in the mouth already, and straight, is pushed on from where it is.
        """
        hand, config = self.hands[arm], self.config
        hand.mating = mating
        depth, aim = start_m, self._first_aim(arm, mating)
        if self.is_in(mating):
            depth = float(mating.fit(self).depth_m)
        else:
            aim = yield from self._bring_before(arm, mating, aim, start_m)
        speed_mps = (
            self.rng.uniform(0.02, 0.03) if config.aim_m > 0 else 0.025
        ) * config.speed
        hand.learns, hand.steadiness = False, 0.3
        began, free, holder = (
            self.step_count,
            self.pushed(arm),
            self.body(mating.holder),
        )
        while self.step_count - began < _LONGEST_PUSH_S * CONTROL_HZ:
            fit, pushed = mating.fit(self), self.pushed(arm) - free
            at = float(fit.depth_m)
            if at > enough_m:
                break
            turned_rad = max(
                float(fit.tilt_rad),
                float(np.linalg.norm(rotvec(holder, self.body(mating.holder)))),
            )
            hand.learns = (
                at < -APART_M
            )  # nothing but friction, or a late command, holds it back
            if hand.learns:
                free = self.pushed(arm)
            elif (
                turned_rad > config.feel_rad
                or self._held_back_m(arm, mating, aim, pushed) > config.feel_m
            ):
                self.felt(arm, f"blocked at {at * 1e3:.1f} mm")
                back = max(at - _AT_MOUTH_M, start_m)
                while depth > back:
                    depth = max(depth - _RECOIL_MPS * DT_S, back)
                    hand.place(*aim.poses(self, mating, depth))
                    yield
                yield from self.regain(arm)
                aim, holder = (
                    self._look(arm, mating, self._corrected(aim)),
                    self.body(mating.holder),
                )
                hand.learns = depth < -APART_M
                yield from self.aim(arm, mating, aim, depth)
                yield from self.settle(arm, longest_s=0.4)
            elif at > 0:
                aim = aim.giving_way(self, mating, config.give_way * pushed)
            depth = min(depth + speed_mps * DT_S, depth_m)
            hand.place(*aim.poses(self, mating, depth))
            yield
        yield from self.pause(arm, 0.1, 0.25)

    def is_in(self, mating: Mating) -> bool:
        """Whether the part is past the hole's mouth and not wedged."""
        fit = mating.fit(self)
        in_mouth = fit.depth_m > _AT_MOUTH_M and fit.lateral_m < _AT_MOUTH_M
        return bool(in_mouth and fit.tilt_rad < _STRAIGHT * self.config.feel_rad)

    def _first_aim(self, arm: str, mating: Mating) -> Aim:
        """With an error that nothing has corrected yet."""
        config = self.config
        return Aim(
            off_m=self.rng.normal(size=2) * config.aim_m,
            off_rad=self.rng.normal(size=3) * config.aim_rad,
            part_from_tcp=inverse(self.body(mating.held)) @ self.tcp(arm),
            turned=mating.turned(self),
        )

    def _bring_before(
        self, arm: str, mating: Mating, aim: Aim, start_m: float
    ) -> Generator[None, None, Aim]:
        """Carry a held part to ``start_m`` before the hole and look twice, the second time when it has come to rest."""
        for _ in range(2):
            yield from self.aim(arm, mating, aim, start_m, speed_mps=0.12)
            yield from self.settle(arm)
            aim = self._look(arm, mating, aim)
        return aim

    def aim(
        self,
        arm: str,
        mating: Mating,
        aim: Aim,
        depth_m: float,
        *,
        speed_mps: float = 0.2,
        settle: bool = False,
    ) -> Script:
        """Move the hand until the leading end of the held part is ``depth_m`` [m] inside the hole (negative: outside). The
        position and direction errors of ``aim`` remain. ``speed_mps`` and ``settle`` are those of ``move``."""
        goal, intended = (
            partial(aim.pose, self, mating, depth_m),
            partial(aim.exact.pose, self, mating, depth_m),
        )
        yield from self.move(
            arm, goal, speed_mps=speed_mps, settle=settle, intended=intended
        )

    def regain(self, arm: str) -> Script:
        """Motion between a block and the next try. Subclasses whose other hand holds the hole wait until that hand is at rest."""
        yield from self.settle(arm, longest_s=0.2)

    def _held_back_m(
        self, arm: str, mating: Mating, aim: Aim, pushed: np.ndarray
    ) -> float:
        """How far the hand is pushed back out of the hole, or the part has slipped in it since it was looked at."""
        slipped = (
            aim.part_from_tcp[:3, 3]
            - (inverse(self.body(mating.held)) @ self.tcp(arm))[:3, 3]
        )
        return max(
            float(-(mating.axis(self) @ pushed[:3])), float(np.linalg.norm(slipped))
        )

    def _corrected(self, aim: Aim) -> Aim:
        """Touch has told on which side the rim is."""
        kept, config = self.config.aim_kept, self.config
        return replace(
            aim,
            off_m=kept * aim.off_m + self.rng.normal(size=2) * 0.1 * config.aim_m,
            off_rad=kept * aim.off_rad + self.rng.normal(size=3) * 0.1 * config.aim_rad,
        )

    def _look(self, arm: str, mating: Mating, aim: Aim) -> Aim:
        """The same aim with the part as it lies in the hand now, and a wrist that has given way to nothing yet."""
        part_from_tcp = inverse(self.body(mating.held)) @ self.tcp(arm)
        return replace(
            aim,
            part_from_tcp=part_from_tcp,
            turned=mating.turned(self),
            given=np.zeros(6),
        )

    def pushed(self, arm: str) -> np.ndarray:
        """(6,) displacement of the TCP by contact forces, in the world frame: translation [m], then rotation vector [rad]."""
        return deflection(
            self.kinematics[arm].pose(self.hands[arm].predicted_rad), self.tcp(arm)
        )

    # what a person sees and errs about ---------------------------------------------------------------------------------

    def near(
        self, pose: np.ndarray, spread_m: float | None = None, spread_rad: float = 0.0
    ) -> np.ndarray:
        """``pose`` (4, 4) with a random human deviation, (4, 4). Its standard deviations per axis are ``spread_m``, by default
        that of way points, and ``spread_rad``."""
        spread_m = self.config.waypoint_m if spread_m is None else spread_m
        off = pose @ turn(self.rng.normal(size=3) * spread_rad)
        off[:3, 3] += self.rng.normal(size=3) * spread_m
        return off

    def felt(self, arm: str, what: str) -> None:
        """Record a correction as an event; ``what`` is the text of the contact."""
        self.events.append((self.step_count, f"{arm}: {what}"))

    def grasp(
        self,
        part: Part,
        name: str,
        *,
        lean_rad: float = 0.0,
        lift_m: float = 0.0,
        pivot_m: float = 0.0,
    ) -> np.ndarray:
        """World-from-TCP pose (4, 4) at which a hand means to grip, by the grasp ``name`` of a part where it lies.

        It is ``lift_m`` higher, and ``grasp_m`` more, so that hands miss it in both directions (``gripped``). ``lean_rad`` turns
        the hand about its closing direction, so that it approaches from −x of the grasp's frame; the turn is about a point
        ``pivot_m`` ahead of the TCP, where the part is gripped.
        """
        spot = transform((0, 0, pivot_m))
        pose = (
            self.body(part.name)
            @ part.grasps[name].part_from_tcp
            @ spot
            @ turn((0, lean_rad, 0))
            @ inverse(spot)
        )
        pose[2, 3] += lift_m + self.config.grasp_m
        return pose

    def gripped(self, meant: np.ndarray) -> np.ndarray:
        """World-from-TCP pose (4, 4) of a hand that means to grip at ``meant`` (4, 4): with human spread."""
        config, rng = self.config, self.rng
        pose = meant @ turn(rng.normal(size=3) * config.grasp_rad * (0.3, 1, 0.3))
        pose[:3, 3] += pose[:3, 0] * rng.normal() * config.grasp_m
        pose[2, 3] += (2 * abs(rng.normal()) - 1) * config.grasp_m
        return pose

    def reach(
        self,
        arm: str,
        meant: np.ndarray,
        ahead: Callable[[np.ndarray], np.ndarray],
        speed_mps: float,
        far_mps: float = 0.2,
    ) -> Script:
        """Move to ``gripped(meant)`` by way of ``ahead`` of it (a pose (4, 4)), with the peak speeds ``far_mps`` and
        then ``speed_mps``. The intended target is ``meant``: policies cannot see where a hand is going to miss, and one that
        learnt it stopped at the first height at which hands have gripped. A hand that a policy has left on this way goes on
        from there; one that it has left at the part does not move.
        """
        goal, before, here = self.gripped(meant), ahead(meant), self.tcp(arm)
        brought, self.hands[arm].brought = self.hands[arm].brought, False
        on_way = brought and is_on_way(here, before, meant, *_ON_THE_WAY)
        if on_way and np.linalg.norm(meant[:3, 3] - here[:3, 3]) < _AT_GRASP_M:
            return
        yield from self.free(arm) if brought else ()
        if not on_way:
            yield from self.move(
                arm, self.near(ahead(goal)), speed_mps=far_mps, intended=lambda: before
            )
        yield from self.move(
            arm, goal, speed_mps=speed_mps, settle=True, intended=lambda: meant
        )

    def holds(self, arm: str, part: Part) -> bool:
        """Whether both pads of the hand touch the part."""
        first = len(ROBOT.fingers) * ROBOT.arms.index(arm)
        return bool(
            self.sim.pads_touching(part.name)[
                0, first : first + len(ROBOT.fingers)
            ].all()
        )

    def require_lying(self, arm: str, part: Part) -> None:
        """Raise LostError if a part is in the other hand, on another side than at the reset, or not on the table."""
        self.require_not_in_other_hand(arm, part)
        pose = self.sim.task.reset(self.sim.draws[0]).poses[part.name]
        began, now = (
            Rotation.from_quat(pose[3:], scalar_first=True).as_matrix(),
            self.body(part.name),
        )
        if began[2] @ now[2, :3] < math.cos(_SAME_SIDE_RAD):  # up, in the part's frame
            raise LostError(f"{part.name} lies on another side than at the reset")
        if abs(now[2, 3] - pose[2]) > _SAME_HEIGHT_M:
            raise LostError(
                f"{part.name} is in no hand, and does not lie where a hand can grip it"
            )

    def require_not_in_other_hand(self, arm: str, part: Part) -> None:
        """Raise LostError if the other hand holds a part."""
        if any(self.holds(other, part) for other in ROBOT.arms if other != arm):
            raise LostError(f"{part.name} is in the other hand")

    def body(self, name: str) -> np.ndarray:
        """Present pose world-from-body (4, 4) of the body ``name``."""
        return self.sim.poses(name)[0]

    def tcp(self, arm: str) -> np.ndarray:
        """Present pose world-from-TCP (4, 4) of an arm."""
        return self.sim.tcp(arm)[0]
