"""Hands of a scripted expert: their human-like errors and speeds, their targets, and pulses that push them off their paths."""

import math
from dataclasses import dataclass, field

import numpy as np

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.experts.mating import Mating

DT_S = 1.0 / CONTROL_HZ
"""Duration of a control step [s]."""
LEARNED = 1 - math.exp(-3.0 * DT_S)
"""Share of an offset at rest that is learnt in a control step: it is down to a third after 1 / 3 s."""
_PULSE_S, _BETWEEN_PULSES_S = (
    (0.27, 0.73),
    (0.5, 2.3),
)  # ranges of a pulse's duration, and of the time to the next one
_AFTER_PULSE_STEPS = round(
    0.2 * CONTROL_HZ
)  # two time constants of the arm: then it is back on its path
_MOST = {"m": 0.1, "rad": 0.5}
"""Unit → largest standard deviation of an error or a pulse, a choice far beyond what succeeds: 0.5 rad move a hand by 0.2 m."""


@dataclass(kw_only=True)
class ScriptedExpertConfig:
    """Human-like errors and speeds of the hands. All zero: exact."""

    speed: float = 1.0
    """Factor on every speed."""
    tremor_m: float = 0.0004
    """Standard deviation of the hand's tremor per axis [m] (Ornstein–Uhlenbeck process, time constant 0.3 s)."""
    tremor_rad: float = 0.004
    """Standard deviation of the tremor in rotation, per axis [rad]."""
    waypoint_m: float = 0.004
    """Standard deviation of the random displacement of way points in free space, per axis [m]. If it is above 0, the duration of
    each motion is also multiplied by a random factor, 0.85 … 1.2."""
    grasp_m: float = 0.0015
    """Standard deviation of the place on a part at which the hand grips, sideways [m]; upwards it is twice as much, half-normal.
    The intended target does not contain it."""
    grasp_rad: float = 0.03
    """Standard deviation of the hand's rotation when it grips [rad]."""
    aim_m: float = 0.0010
    """Standard deviation of the perceived position of a hole or mate, per axis [m]."""
    aim_rad: float = 0.015
    """Standard deviation of its perceived direction, per axis [rad]."""
    grip_n: float = 30.0
    """Closing force of each pad [N]; PiPER's gripper is rated for 40 N."""
    feel_m: float = 0.0010
    """Displacement [m] at which the hand detects that the part is blocked: contact holds the hand back, or the part slips in it,
    by this much. For comparison: an arm has 5 N/mm upwards and 7 N/mm sideways, and a part that is gripped with 25 N slips at 15
    N if its friction is low."""
    feel_rad: float = 0.06
    """Rotation [rad] at which it detects the same: of the part relative to the hole, or of the hole since the hand last observed
    it."""
    give_way: float = 0.1
    """Share of a sideways displacement or rotation by contact to which the wrist yields in each control step."""
    aim_kept: float = 0.45
    """Share of the aiming error that remains after a correction by touch."""
    pulse_rad: float = 0.0
    """Standard deviation per joint of the amplitude of pulses that push both arms off their paths [rad]: 0.3 … 0.7 s long,
    sin²-shaped, at random times, also at rest and while a hand grips, until a held part is 8 mm before its hole. The
    intended target does not contain them, so that a policy learns to return to the path (DART: Laskey et al. 2017,
    arXiv:1703.09327). 0.02 rad move a hand by about 8 mm. 0: no pulses."""

    def __post_init__(self) -> None:
        """
        Raises:
            TaccorlError: a number is negative or not finite, the speed is 0, or a standard deviation is beyond ``_MOST``.
        """
        for name, value in vars(self).items():
            if not 0 <= value < math.inf or (name == "speed" and value == 0):
                least = "above 0" if name == "speed" else "0 or more"
                raise TaccorlError(f"hands.{name}={value:g}: a finite number, {least}")
            unit = name.rpartition("_")[2]
            if value > _MOST.get(unit, math.inf) and not name.startswith("feel"):
                raise TaccorlError(
                    f"hands.{name}={value:g}: at most {_MOST[unit]:g} {unit}"
                )


EXACT = ScriptedExpertConfig(
    tremor_m=0, tremor_rad=0, waypoint_m=0, grasp_m=0, grasp_rad=0, aim_m=0, aim_rad=0
)
"""Hands without tremor and errors."""


@dataclass
class Hand:
    """Present target of one arm of a scripted expert: pose, opening and joint angles."""

    pose: np.ndarray
    """Target pose (4, 4) of the TCP in the world. It contains the expert's aiming error, but not its tremor."""
    opening_m: float  # Commanded opening between the pads [m]
    joints_rad: np.ndarray  # (6,) joint angles of the last command, without the correction for the offset [rad]
    bias_rad: np.ndarray
    """(6,) offset of the joints at rest from their targets [rad], estimated in free motion, as a person corrects the hand by
    eye."""
    predicted_rad: (
        np.ndarray
    )  # (6,) joint angles that are expected now if nothing touches the arm [rad]
    goal: np.ndarray  # World-from-TCP (4, 4) target, with tremor
    learns: bool = (
        True  # False in contact: an offset that contact causes is not learned
    )
    tremor: np.ndarray = field(
        default_factory=lambda: np.zeros(6)
    )  # (6,) present tremor [m, rad]
    steadiness: float = 1.0  # Factor on the tremor, 0 … 1
    rests: bool = False  # True while what it holds stands on the table, which pulses would push away
    brought: bool = False  # True from the takeover of a policy until the hand begins to reach for a part
    mating: Mating | None = None
    """The held part and its hole, from the approach to the hole until the hand opens; else None."""
    intended: np.ndarray = field(init=False)
    """Target pose (4, 4) of the TCP in the world without aiming error and tremor: the training target of a policy."""

    def __post_init__(self) -> None:
        self.intended = self.pose

    def place(self, pose: np.ndarray, intended: np.ndarray | None = None) -> None:
        """Set the world-from-TCP target ``pose`` (4, 4). ``intended`` (4, 4) is the same target without the aiming error; None:
        the target has no aiming error."""
        self.pose = pose
        self.intended = pose if intended is None else intended


class Pulses:
    """Random displacement of the joint targets of one arm (``ScriptedExpertConfig.pulse_rad``)."""

    def __init__(self, amplitude_rad: float, rng: np.random.Generator) -> None:
        self._amplitude_rad, self._rng = amplitude_rad, rng
        self._peak_rad = np.zeros(ROBOT.num_joints)
        self._num, self._step = 0, _AFTER_PULSE_STEPS
        self._wait = self._drawn(_BETWEEN_PULSES_S)

    def _drawn(self, range_s: tuple[float, float]) -> int:
        return round(self._rng.uniform(*range_s) * CONTROL_HZ)

    def next_rad(self, allowed: bool) -> np.ndarray:
        """Displacement (6,) [rad] in the next control step. A pulse that is not ``allowed`` any more ends at once."""
        self._step += 1
        if not allowed:
            self._num = min(self._num, self._step - 1)
        elif self._step > self._num + self._wait and self._amplitude_rad > 0:
            self._num, self._step, self._wait = (
                self._drawn(_PULSE_S),
                1,
                self._drawn(_BETWEEN_PULSES_S),
            )
            self._peak_rad = (
                self._rng.normal(size=ROBOT.num_joints) * self._amplitude_rad
            )
        if self._step > self._num:
            return np.zeros(ROBOT.num_joints)
        return math.sin(math.pi * self._step / (self._num + 1)) ** 2 * self._peak_rad

    @property
    def displaces(self) -> bool:
        """True during a pulse and until the arm has returned to its path."""
        return self._step < self._num + _AFTER_PULSE_STEPS


def follow(
    start: np.ndarray, before: np.ndarray, after: np.ndarray, lag_s: np.ndarray
) -> np.ndarray:
    """State (n,) of a first-order lag after one control step in which its target moves linearly from ``before`` to ``after``,
    (n,) each.

    ``start`` (n,) is the state before, ``lag_s`` (n,) the time constant τ [s]. ẋ = (u − x) / τ with u̇ = s constant has the
    solution x = u − τ s + (x₀ − u₀ + τ s) e^(−t/τ).
    """
    behind = lag_s * (after - before) / DT_S
    return after - behind + (start - before + behind) * np.exp(-DT_S / lag_s)


def squeezed_m(robot: RobotConfig, width_m: float, force_n: float) -> float:
    """Opening [m] at which the pads press with ``force_n`` on a part of that width."""
    squeeze = force_n / robot.grip_stiffness_n_per_m
    if robot.pads == "sprung":
        squeeze += 2 * force_n / robot.pad_stiffness_n_per_m
    return max(width_m - squeeze, 0.0)
