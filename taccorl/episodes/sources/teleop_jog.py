"""Cartesian jogging of the twin's hands: a key moves one hand's goal by a step; inverse kinematics gives joint targets.

A hand moves along the bench's axes (x away from the arms, y left, z up) and turns about its own (x towards its palm's edge,
y the fingers' closing direction, z the approach). A goal that is out of reach is refused, so that it never runs away from the
hand, and the hand follows its goal no faster than an arm moves. Nothing here knows a window or a device.

A requested motion is (7,): numbers of steps of translation along x, y, z, of rotation about x, y, z, and of the gripper, where
+ opens it.
"""

import enum
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.experts.se3 import between, rotvec, turn

GRIP_STEP_M = 0.005
"""Opening that one step of a gripper adds or takes [m]."""
GRIP_N = 30.0  # a held gripper key closes with no more; PiPER's gripper is rated for 40 N
REACH_M = 0.0005  # a goal is in reach if inverse kinematics errs by less (m, and 0.15 m a radian)
HELD_STEPS_PER_S = 8.0  # of a key that is held
_HELD_AFTER = round(0.25 * CONTROL_HZ)  # control steps until a key that is down counts as held
_FASTEST_MPS, _FASTEST_RADPS = 0.25, 1.5  # of a hand on its way to its goal


class StepSize(NamedTuple):
    """Size of one step: translation [m], rotation [rad], opening [m]."""

    name: str
    move_m: float
    turn_rad: float


STEP_SIZES = (StepSize("fine", 0.001, 0.01), StepSize("medium", 0.005, 0.05), StepSize("coarse", 0.02, 0.2))
"""Sizes of a step between which a person may choose."""


class Command(enum.Enum):
    """Commands of a person that are not motions: other arm, step size, begin or finish, discard."""

    SWITCH_ARM = "other arm"
    STEP_SIZE = "next step size: fine, medium, coarse"
    GO = "begin; when done: finish (all holds still for 1 s while the task is judged)"
    DISCARD = "discard, and the same scene from its beginning"


class Axis(NamedTuple):
    """Two opposite keys for one axis of motion. Codes are GLFW's, which MuJoCo passes on (mjui.h)."""

    labels: str
    more: tuple[int, ...]
    less: tuple[int, ...]
    index: int
    """Index of the axis in the requested steps (7,)."""
    meaning: str


_GRIPPER = 6  # index in the requested steps
# Keys that MuJoCo's viewer leaves free: it takes all letters, 0–5, F1–F7 and most punctuation (tests/episodes/test_teleop.py).
AXES = (
    Axis("Up      Down", (265, 328), (264, 322), 0, "away from the arms / towards them (also keypad 8 2)"),
    Axis("Left    Right", (263, 324), (262, 326), 1, "left / right (also keypad 4 6)"),
    Axis("Home    End", (268, 329), (269, 323), 2, "up / down (also keypad 9 3)"),
    Axis("6       7", (ord("6"),), (ord("7"),), 5, "turn + / − about the approach direction"),
    Axis("8       9", (ord("8"),), (ord("9"),), 4, "turn + / − about the fingers' closing direction"),
    Axis("-       =", (ord("-"),), (ord("="),), 3, "turn + / − about the hand's third axis"),
    Axis("Insert  Delete", (260,), (261,), _GRIPPER, "open / close the gripper"),
)
COMMAND_KEYS = {
    ord(" "): ("Space", Command.SWITCH_ARM),
    267: ("Page Down", Command.STEP_SIZE),
    257: ("Enter", Command.GO),
    298: ("F9", Command.DISCARD),
}
"""Code of a key (GLFW's) → name of the key, and its command."""
_WISHES = {code: (axis.index, 1.0) for axis in AXES for code in axis.more}
_WISHES |= {code: (axis.index, -1.0) for axis in AXES for code in axis.less}


def label(command: Command) -> str:
    """Name of the key for a command."""
    return next(label for label, meant in COMMAND_KEYS.values() if meant is command)


def key_map() -> str:
    """Text that lists the keys and their functions."""
    rows = [(axis.labels, axis.meaning) for axis in AXES]
    rows += [(label, command.value) for label, command in COMMAND_KEYS.values()]
    return "\n".join(f"  {keys:16}{meaning}" for keys, meaning in rows)


class Keyboard:
    """Keyboard as a source of steps (7,): a tap is one step, a held key repeats."""

    def __init__(self) -> None:
        self._down: dict[int, int] = {}

    def requested_steps(self, taps: Iterable[int], held: Collection[int]) -> tuple[np.ndarray, list[Command]]:
        """Return the steps (7,) requested in this control step (as ``Jogger.jog``), and the person's commands. ``taps``: codes of
        the keys pressed since the last control step, in order. ``held``: codes of the keys that are down now."""
        steps, commands = np.zeros(len(AXES)), []
        for code in taps:
            if code in _WISHES:
                index, sign = _WISHES[code]
                steps[index] += sign
            elif code in COMMAND_KEYS:
                commands.append(COMMAND_KEYS[code][1])
        self._down = {code: self._down.get(code, 0) + 1 for code in held if code in _WISHES}
        for code, control_steps in self._down.items():
            if control_steps > _HELD_AFTER:
                index, sign = _WISHES[code]
                steps[index] += sign * HELD_STEPS_PER_S / CONTROL_HZ
        return steps, commands


@dataclass
class JoggedHand:
    """Goal and present target of one arm that a person moves in steps."""

    goal: np.ndarray  # World-from-TCP (4, 4) to which the hand moves; always reachable
    pose: np.ndarray  # World-from-TCP (4, 4) of the present target on the way there
    joints_rad: np.ndarray  # (6,) joint angles for ``pose`` [rad]
    bias_rad: np.ndarray  # (6,) offset of the joints at rest from their targets at the beginning [rad]
    opening_m: float  # Commanded opening between the pads [m]


class Jogger:
    """Controls of one attempt: moves the targets of both hands of simulation 0 in the steps, and by the commands, that ``read``
    makes of the pressed keys. Make a new one after each reset."""

    def __init__(self, sim: Simulation, read: Callable[[Sequence[int]], tuple[np.ndarray, list[Command]]]) -> None:
        self.sim, self._read = sim, read
        self.kinematics = {arm: ArmKinematics(arm, sim.config.robot) for arm in ROBOT.arms}
        self.arm = ROBOT.arms[0]
        self.size = STEP_SIZES[1]
        self.notice = ""
        """Reason why the newest motion was refused; empty if it was not."""
        reported, targets = sim.proprioception()[0], sim.targets[0]
        self.hands = {}
        for arm in ROBOT.arms:
            own = ROBOT.joint_slice(arm)
            joints = reported[own].copy()
            pose = self.kinematics[arm].pose(joints)
            bias = joints - targets[own]
            self.hands[arm] = JoggedHand(pose, pose, joints, bias, float(targets[ROBOT.gripper_index(arm)]))

    def switch_arm(self) -> None:
        """Select the other hand for the next steps."""
        self.arm = ROBOT.arms[1 - ROBOT.arms.index(self.arm)]
        self.notice = ""

    def next_size(self) -> None:
        """Select the next step size: fine → medium → coarse → fine."""
        self.size = STEP_SIZES[(STEP_SIZES.index(self.size) + 1) % len(STEP_SIZES)]

    def jog(self, steps: np.ndarray) -> None:
        """Move the target of the selected hand, unless the new target is out of reach.

        ``steps`` (7,): numbers of steps along the world's x, y, z, about the hand's x, y, z, and of the gripper (+: open).
        """
        if not steps.any():
            return
        hand, self.notice = self.hands[self.arm], ""
        if steps[_GRIPPER]:
            hand.opening_m = self._opening(hand.opening_m + steps[_GRIPPER] * GRIP_STEP_M)
        if not steps[:_GRIPPER].any():
            return
        goal = hand.goal @ turn(steps[3:6] * self.size.turn_rad)
        goal[:3, 3] += steps[:3] * self.size.move_m
        _, error_m = self.kinematics[self.arm].solve(goal, hand.joints_rad)
        if error_m > REACH_M:
            self.notice = f"out of reach by {error_m * 1e3:.1f} mm: the {self.arm} hand stays where it is"
            return
        hand.goal = goal

    def _opening(self, wanted_m: float) -> float:
        """Within the gripper's range, and no farther below what it has reached than ``GRIP_N`` takes."""
        measured_m = float(self.sim.proprioception()[0, ROBOT.gripper_index(self.arm)])
        return float(np.clip(wanted_m, max(0.0, measured_m - squeeze_m(self.sim.config.robot)), ROBOT.opening_max_m))

    def act(self, taps: Sequence[int]) -> tuple[np.ndarray, list[Command]]:
        """Return the action (14,) [rad, m] for the next control step, and the person's commands."""
        steps, commands = self._read(taps)
        for command in commands:
            if command is Command.SWITCH_ARM:
                self.switch_arm()
            elif command is Command.STEP_SIZE:
                self.next_size()
        self.jog(steps)
        return self.targets(), commands

    def lines(self) -> list[str]:
        """Status lines: selected hand, step size, and why the last step was refused."""
        size, opening_mm = self.size, self.hands[self.arm].opening_m * 1e3
        step = f"step {size.name}: {size.move_m * 1e3:g} mm, {size.turn_rad:g} rad"
        return [f"{self.arm} hand, {step}, gripper {opening_mm:.0f} mm", *([self.notice] if self.notice else [])]

    def goals(self) -> list[np.ndarray]:
        """World-from-TCP target (4, 4) of the selected hand, as the only entry."""
        return [self.hands[self.arm].goal]

    def targets(self) -> np.ndarray:
        """(14,) float32 joint targets [rad] and openings [m] of the next control step."""
        action = np.empty(ROBOT.num_actions)
        for arm in ROBOT.arms:
            hand = self.hands[arm]
            away_m = float(np.linalg.norm(hand.goal[:3, 3] - hand.pose[:3, 3]))
            away_rad = float(np.linalg.norm(rotvec(hand.pose, hand.goal)))
            longest = max(away_m / _FASTEST_MPS, away_rad / _FASTEST_RADPS) * CONTROL_HZ
            hand.pose = between(hand.pose, hand.goal, 1 / longest) if longest > 1 else hand.goal
            hand.joints_rad, _ = self.kinematics[arm].solve(hand.pose, hand.joints_rad)
            action[ROBOT.joint_slice(arm)] = hand.joints_rad - hand.bias_rad
            action[ROBOT.gripper_index(arm)] = hand.opening_m
        return np.clip(action, ROBOT.action_low, ROBOT.action_high).astype(np.float32)


def squeeze_m(robot: RobotConfig) -> float:
    """Distance [m] of the command below the fingers' opening that gives the force ``GRIP_N``: F / k of the gripper's
    controller."""
    return GRIP_N / robot.grip_stiffness_n_per_m
