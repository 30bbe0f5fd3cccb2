"""True signals of a stand-in recording: the left arm holds a rack, the right arm puts a tube into it. No physics.

command q*(t)   minimum-jerk between solved key poses, plus a hand's tremor
state q(t)      q̇ = (q* − q) / τ with τ = ``COMMAND_LEAD_S``; a gripper stops where it meets its part
grip(t)         how far the gripper would have gone on into the part, one contact delay later, 0 to 1
touch(t)        grip × footprint of the part on the pad (tube: a stripe; rack: a patch), moved by the insertion load
"""

import math
from dataclasses import dataclass

import numpy as np

from taccorl.robots import ROBOT
from taccorl.surrogate.drivers import ARMS, TrueSignals

GRIPPER_OPEN_M = 0.065  # of PiPER's 0.070 m stroke
SQUEEZE_M = 0.008  # how far past first touch the closing command goes
COMMAND_LEAD_S = 0.08  # time constant with which the arms follow their commands
CONTACT_DELAY_S = 0.03  # from the fingers' stop to the pads' first count
PART_WIDTH_M = {"left": 0.040, "right": 0.018}  # rack, tube
# Key poses [rad] of the joints of an arm, and the shares of an episode at which it arrives there and leaves. Solved once for
# grippers that point down at parts on a table; a failed insertion stops 38 mm too high.
_REST_RAD = {
    "left": (-0.211, 1.798, -0.879, 0.0, 0.739, 1.36),
    "right": (0.211, 1.798, -0.879, 0.0, 0.739, 0.211),
}
_KEY_POSES_RAD = {
    "left": (
        ((0.21, 0.21), (-0.224, 2.279, -1.203, 0.0, 0.582, 1.347)),  # over the rack
        ((0.28, 0.38), (-0.224, 2.515, -1.257, 0.0, 0.400, 1.347)),  # grasp
        ((0.46, 0.46), (-0.224, 2.364, -1.213, 0.0, 0.507, 1.347)),
        (
            (0.57, 0.86),
            (-0.548, 2.595, -1.669, 0.0, 0.732, 1.023),
        ),  # hold it for the tube
        ((0.90, 0.96), (-0.548, 2.676, -1.702, 0.0, 0.684, 1.023)),  # put it down
        ((1.00, 1.00), (-0.548, 2.519, -1.649, 0.0, 0.788, 1.023)),
    ),
    "right": (
        ((0.24, 0.24), (0.257, 2.232, -1.336, 0.0, 0.762, 0.257)),  # over the tube
        ((0.33, 0.43), (0.257, 2.383, -1.334, 0.0, 0.608, 0.257)),  # grasp
        ((0.51, 0.51), (0.257, 2.187, -1.348, 0.0, 0.819, 0.257)),
        ((0.63, 0.68), (0.626, 2.433, -1.835, 0.0, 1.060, 0.626)),  # over the hole
        ((0.77, 0.86), (0.626, 2.529, -1.814, 0.0, 0.942, 0.626)),  # in it
        ((0.93, 0.93), (0.626, 2.433, -1.835, 0.0, 1.060, 0.626)),
        ((1.00, 1.00), (0.452, 2.171, -1.405, 0.0, 0.892, 0.452)),
    ),
}
_LEAVES_REST_AT = {"left": 0.04, "right": 0.07}
_SEATED, _MISSED_RAD = 4, (0.626, 2.454, -1.826, 0.0, 1.030, 0.626)  # of the right arm
_SPREAD_RAD = 0.03  # of an episode's poses

_GRID_HZ = 500
_MARKER_MARGIN_S = 0.1  # between the edge of an episode's time slot and its marker
_TREMOR_RAD = 0.002  # times three sines


@dataclass(frozen=True, kw_only=True)
class EpisodePlan:
    """Plan of one episode; times in seconds from the start of the recording."""

    start_s: float  # Start of the episode
    end_s: float  # End of the episode
    outcome: str  # Closing marker, one of ``OUTCOMES``
    shift_rad: (
        np.ndarray
    )  # (2, 6) shift of all poses of an arm but at rest, left arm first [rad]

    def at(self, fraction: float) -> float:
        """Time at which this fraction (0 … 1) of the episode has passed [s]."""
        return self.start_s + fraction * (self.end_s - self.start_s)

    def closing_s(self, arm: str) -> tuple[float, float]:
        """(start, end) of the closing command of an arm's gripper [s]."""
        begin = self.at(0.30 if arm == "left" else 0.35)
        return begin, begin + min(0.5, 0.06 * (self.end_s - self.start_s))

    def opening_s(self, arm: str) -> tuple[float, float]:
        """(start, end) of the opening command of an arm's gripper [s]."""
        begin = self.at(0.92 if arm == "left" else 0.82)
        return begin, begin + min(0.4, 0.04 * (self.end_s - self.start_s))

    def insertion_s(self) -> tuple[float, float]:
        """(start, end) of the insertion [s]."""
        return self.at(0.68), self.at(0.77)


def plan_episodes(
    duration_s: float, episodes: int, outcomes: tuple[str, ...], seed: int
) -> list[EpisodePlan]:
    """One plan per episode, which divide the recording into equal time slots; every episode's poses are a little different."""
    slot_s = duration_s / episodes
    return [
        EpisodePlan(
            start_s=i * slot_s + _MARKER_MARGIN_S,
            end_s=(i + 1) * slot_s - _MARKER_MARGIN_S,
            outcome=outcomes[i % len(outcomes)],
            shift_rad=np.random.default_rng([seed, 1, i]).uniform(
                -_SPREAD_RAD, _SPREAD_RAD, (2, ROBOT.num_joints)
            ),
        )
        for i in range(episodes)
    ]


def _ramp(
    x: np.ndarray, start: float | np.ndarray, end: float | np.ndarray
) -> np.ndarray:
    """0 before ``start``, 1 after ``end``, minimum jerk between."""
    s = np.clip((x - start) / np.maximum(end - start, 1e-9), 0.0, 1.0)
    return s * s * s * (10 - 15 * s + 6 * s * s)


def _follow(command: np.ndarray, time_constant_s: float) -> np.ndarray:
    """Steps q̇ = (q* − q) / τ along the grid, exactly for a command that stays at the mean of its two ends."""
    keep = math.exp(-1.0 / (_GRID_HZ * time_constant_s))
    drive = 0.5 * (1 - keep) * (command[1:] + command[:-1])
    state = np.empty_like(command)
    state[0] = command[0]
    for n in range(
        len(drive)
    ):  # scipy.signal would do it too, and takes a second to import
        state[n + 1] = keep * state[n] + drive[n]
    return state


class Story(TrueSignals):
    """True signals of one recording as functions of the time since its start [s]. State and command are (N, 14), left arm
    first."""

    def __init__(self, plans: list[EpisodePlan], duration_s: float, seed: int) -> None:
        self.plans = plans
        self.time_s = (
            np.arange(-_GRID_HZ, math.ceil((duration_s + 1.0) * _GRID_HZ) + 1)
            / _GRID_HZ
        )  # −1 s to end + 1 s
        self._command = np.empty((len(self.time_s), ROBOT.num_actions))
        for a, arm in enumerate(ARMS):
            self._command[:, ROBOT.joint_slice(arm)] = self._joint_commands(
                arm, np.random.default_rng([seed, 2, a])
            )
            self._command[:, ROBOT.gripper_index(arm)] = self._gripper_commands(arm)
        self._state = _follow(self._command, COMMAND_LEAD_S)
        self._velocity = (self._command - self._state) / COMMAND_LEAD_S
        self._squeeze_m = np.empty((len(self.time_s), len(ARMS)))
        for a, arm in enumerate(ARMS):
            opening_m = self._state[:, ROBOT.gripper_index(arm)]
            self._squeeze_m[:, a] = np.maximum(PART_WIDTH_M[arm] - opening_m, 0.0)
            np.maximum(
                opening_m, PART_WIDTH_M[arm], out=opening_m
            )  # the part is in the way
            self._velocity[self._squeeze_m[:, a] > 0, ROBOT.gripper_index(arm)] = 0.0
        self._load = self._insertion_load()
        self._holds = {arm: self._hold_times(arm) for arm in ARMS}

    def _joint_commands(self, arm: str, rng: np.random.Generator) -> np.ndarray:
        times, poses = _key_poses(arm, self.plans)
        i = np.clip(
            np.searchsorted(times, self.time_s, side="right") - 1, 0, len(times) - 2
        )
        command = poses[i] + _ramp(self.time_s, times[i], times[i + 1])[:, None] * (
            poses[i + 1] - poses[i]
        )
        for _ in range(3):  # a hand is never still
            hz, phase = (
                rng.uniform(0.3, 2.2, ROBOT.num_joints),
                rng.uniform(0, 2 * np.pi, ROBOT.num_joints),
            )
            command += _TREMOR_RAD * np.sin(
                2 * np.pi * hz * self.time_s[:, None] + phase
            )
        return command

    def _gripper_commands(self, arm: str) -> np.ndarray:
        opening_m = np.full(len(self.time_s), GRIPPER_OPEN_M)
        for plan in self.plans:
            closed = _ramp(self.time_s, *plan.closing_s(arm)) - _ramp(
                self.time_s, *plan.opening_s(arm)
            )
            opening_m -= (GRIPPER_OPEN_M - PART_WIDTH_M[arm] + SQUEEZE_M) * closed
        return opening_m

    def _insertion_load(self) -> np.ndarray:
        """0 to 1: how hard the tube is pushed against the rack. A missed hole pushes harder, and until release."""
        load = np.zeros(len(self.time_s))
        for plan in self.plans:
            begin, seated = plan.insertion_s()
            release = plan.opening_s("right")[0]
            pushed = _ramp(self.time_s, 0.5 * (begin + seated), seated)
            if plan.outcome == "failure":
                load += pushed * (self.time_s < release)
            else:
                load += 0.8 * pushed * (1.0 - _ramp(self.time_s, seated, release))
        return load

    def _sample(self, grid: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Linear interpolation of a grid array: shape time_s.shape + grid.shape[1:]."""
        x = np.clip(
            (np.asarray(time_s, float) - self.time_s[0]) * _GRID_HZ,
            0,
            len(self.time_s) - 1.001,
        )
        i = x.astype(np.int64)
        weight = (x - i).reshape(x.shape + (1,) * (grid.ndim - 1))
        return (1 - weight) * grid[i] + weight * grid[i + 1]

    def at(self, signal: str, time_s: np.ndarray) -> np.ndarray:
        """State, command of the leader arms, rate of the state, or effort: six joints [rad] and gripper opening [m] of each
        arm."""
        if signal == "effort":
            return self._effort(time_s)
        return self._sample(
            {
                "state": self._state,
                "command": self._command,
                "velocity": self._velocity,
            }[signal],
            time_s,
        )

    def _effort(self, time_s: np.ndarray) -> np.ndarray:
        """Plausible efforts (N, 14) [N·m, N] at ``time_s`` (N,) [s]: gravity on the long links, tracking error, and the
        force with which the grippers close."""
        joints = self.at("state", time_s)
        effort = 6.0 * (self.at("command", time_s) - joints)
        for arm in ARMS:
            own, own_effort = (
                rows[:, ROBOT.joint_slice(arm)] for rows in (joints, effort)
            )
            shoulder, elbow = own[:, 1], own[:, 2]
            own_effort[:, 1] += 5.0 * np.cos(shoulder)
            own_effort[:, 2] += 2.5 * np.cos(shoulder + elbow)
            effort[:, ROBOT.gripper_index(arm)] = 1.2 * self.grip(arm, time_s)
        return effort

    def grip(self, arm: str, time_s: np.ndarray) -> np.ndarray:
        """Closing of the gripper on its part as the pads sense it, 0 to 1, in the shape of ``time_s``."""
        felt_m = self._sample(
            self._squeeze_m, np.asarray(time_s, float) - CONTACT_DELAY_S
        )
        return felt_m[..., ARMS.index(arm)] / SQUEEZE_M

    def _hold_times(self, arm: str) -> list[tuple[float, float]]:
        """From when to when the fingers are stopped by the part, one interval per episode."""
        stopped = np.diff((self._squeeze_m[:, ARMS.index(arm)] > 0).astype(np.int8))
        begins_s = self.time_s[:-1][
            stopped > 0
        ]  # the last instant before, so that interpolation stays inside
        ends_s = self.time_s[1:][stopped < 0]
        return [(float(a), float(b)) for a, b in zip(begins_s, ends_s, strict=True)]

    def contact_s(self, arm: str) -> list[tuple[float, float]]:
        """(start, end) [s] of the interval in which the pads of an arm are in contact with its part, one per episode."""
        return [(a + CONTACT_DELAY_S, b + CONTACT_DELAY_S) for a, b in self._holds[arm]]

    def clean_counts(self, pad: str, time_s: np.ndarray) -> np.ndarray:
        """Counts above baseline in wire order, (N, 12, 32), before taxel gains, noise and rounding.

        ``time_s`` is (N,) for one instant, or (N, 12) where every row is scanned at its own time.
        """
        arm = pad.split("_")[0]
        row_time_s = np.broadcast_to(
            np.asarray(time_s, float).reshape(len(time_s), -1), (len(time_s), 12)
        )
        grip = self.grip(arm, row_time_s)[..., None]
        load = np.where(grip > 0, self._sample(self._load, row_time_s)[..., None], 0.0)
        row, col = np.arange(12.0)[:, None], np.arange(32.0)
        if pad.endswith("right_finger"):
            row = 11.0 - row  # the two pads of a gripper face each other
        if (
            arm == "right"
        ):  # tube: a stripe along the finger; pushing tilts it and digs its upper end in
            middle = 5.2 + 1.4 * load + (0.02 + 0.07 * load) * (col - 18)
            stripe = np.exp(-0.5 * ((row - middle) / 1.25) ** 2) / (
                1 + np.exp((9.0 - col) / 0.8)
            )
            ridge = (
                0.50
                * load
                * np.exp(
                    -0.5 * ((col - 11.0) / 1.1) ** 2 - 0.5 * ((row - middle) / 2.2) ** 2
                )
            )
            counts = 105.0 * grip**0.9 * (stripe + ridge)
        else:  # rack: a patch at the finger tip with a firmer edge; pushing shears it towards the tip
            top = 14.0 + 2.0 * load
            inside = (
                1
                / (1 + np.exp((top - col) / 0.7))
                / (1 + np.exp((np.abs(row - 5.5) - 5.0) / 0.6))
            )
            ridge = np.exp(-0.5 * ((col - top - 1.5) / 1.0) ** 2) * (0.3 + 0.5 * load)
            counts = 75.0 * grip**0.9 * inside * (0.8 + ridge + 0.15 * load)
        return np.where(grip > 0, counts, 0.0).astype(np.float32)


def _key_poses(arm: str, plans: list[EpisodePlan]) -> tuple[np.ndarray, np.ndarray]:
    """Times (K,) and poses (K, 6) [rad] an arm passes through; equal neighbours are rests."""
    times, poses = [-1.0], [np.array(_REST_RAD[arm])]
    for plan in plans:
        times.append(plan.at(_LEAVES_REST_AT[arm]))
        poses.append(poses[-1])
        for k, (shares, pose) in enumerate(_KEY_POSES_RAD[arm]):
            missed = arm == "right" and k == _SEATED and plan.outcome == "failure"
            for share in dict.fromkeys(shares):
                times.append(plan.at(share))
                poses.append(
                    np.array(_MISSED_RAD if missed else pose)
                    + plan.shift_rad[ARMS.index(arm)]
                )
    times.append(times[-1] + 10.0)
    poses.append(poses[-1])
    return np.array(times), np.array(poses)
