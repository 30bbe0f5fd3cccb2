"""Library of motions to record for one joint: the paper's sweep and others that separate effects. 200 Hz, at rest at both ends.

    chirp            10 s as the paper's sweep (App. B.1), 0.1 to 2.5 Hz (a choice, the paper gives no frequencies)
    wide triangle    there and back over a wide range in 14 s: friction, weight, effects that depend on the angle
    steps            nine holds of a second: delays, slipping, integrators
    small chirp      0.02 rad up to 4 Hz: play, dead bands, stiction
    chirp at 2× K_p and K_d; chirp with 0.3 kg in the hand: effects that gains and inertia hide

Validation recordings (for choices) and test recordings (for final figures) hold other motions about other middle positions.

Letters in shapes: T rows.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT

RATE_HZ = 200  # Rate of the targets [Hz]
SWEEP_S = (
    10.0  # Duration of the sweep with which joints are identified [s] (paper App. B.1).
)
SWEEP_HZ = (
    0.1,
    2.5,
)  # Frequencies of the sweep, from and to [Hz]. A choice: the paper gives none.
REST_S = 1.0  # Rest before and after each motion [s]
SPEED_RAD_PER_S = 3.0  # Highest speed of targets [rad/s]; the arm's slowest joint is rated for 3.1 rad/s (PiPER manual)
TORQUE_NM = (25.0, 25.0, 25.0, 10.0, 10.0, 10.0)
"""Largest torque of each joint, weight and motion together [N·m]: a choice, no rating is published."""
MARGIN_RAD = 0.05  # Distance that is kept from the joint's limits [rad]
KNOWN_KG = 0.3  # Mass of the weighed payload that is gripped in one recording [kg]
OPENING_M = 0.02  # Opening of the gripper in all motions [m]
REST_POSE = (
    0.0,
    1.732,
    -0.883,
    0.0,
    0.2,
    0.0,
)  # Joint angles of the arm that is not under test [rad]

POSES = (
    (0.0, 1.34, -2.3, 0.0, -0.6, 0.3),
    (0.0, 1.35, -2.1, 0.2, 0.1, 0.2),
    (0.0, 0.3, -1.4, 0.0, 0.1, -0.4),
    (0.0, 1.2, -1.6, 0.0, 0.7, 0.0),
    (0.0, 1.2, -1.4, 0.1, 0.1, 0.4),
    (0.0, 0.8, -1.2, -0.4, 0.3, 0.0),
)
"""Joint angles of the arm while joint 1, 2, … is under test, in the middle of its range [rad]: over the wide range nothing is
touched."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """One motion of a joint to be recorded."""

    name: str
    target: Callable[["Room"], np.ndarray]
    """Function of the joint's ``Room`` that returns the joint's targets (T,) [rad] at ``RATE_HZ``: absolute angles, with
    ``REST_S`` of rest at both ends."""
    gain: float = 1.0  # Factor on K_p and K_d
    payload_kg: float = 0.0  # Mass in the gripper [kg]
    repeat_of: str | None = (
        None  # Name of the motion that this one repeats; None if it is no repeat
    )
    aims: str = ""  # Effect at whose limit it is aimed; empty: none


@dataclass(frozen=True, kw_only=True)
class Room:
    """Range of motion of one joint: middle, widest reach and amplitude of the sweep [rad]; of a slide read m for rad."""

    middle_rad: float  # Angle about which the motions go [rad]
    wide_rad: float  # Half of the range of the wide triangle [rad]
    sweep_rad: float  # Amplitude of the slow part of the chirp [rad]
    speed_rad_per_s: float = SPEED_RAD_PER_S  # Highest speed of targets [rad/s]
    small_rad: float = 0.02
    """Amplitude of the small chirp, for play and dead bands [rad]."""

    @classmethod
    def of(
        cls, joint: int, middle_rad: float, inertia_kgm2: float, weight_nm: float
    ) -> "Room":
        """Range of motion of joint 1 to 6 of the PiPER about ``middle_rad``: within its limits, and with a sweep whose torque is
        within ``TORQUE_NM`` for this inertia and weight."""
        low, high = ROBOT.links[joint - 1].range_rad
        # Half of the range of the wide triangle of joint 1 to 6.
        wide = min(
            (1.1, 0.9, 0.9, 1.1, 0.95, 1.2)[joint - 1],
            middle_rad - low - MARGIN_RAD,
            high - middle_rad - MARGIN_RAD,
        )
        left_nm = max(TORQUE_NM[joint - 1] - abs(weight_nm), 0.2 * TORQUE_NM[joint - 1])
        sweep = min(
            0.35, left_nm / (inertia_kgm2 * (2 * math.pi * SWEEP_HZ[1]) ** 2 * 0.6)
        )
        return cls(
            middle_rad=middle_rad, wide_rad=wide, sweep_rad=min(sweep, 0.6 * wide)
        )


def chirp(
    seconds: float,
    low_hz: float,
    high_hz: float,
    amplitude_rad: float,
    speed: float = SPEED_RAD_PER_S,
) -> np.ndarray:
    """Chirp (T,) [rad] at 200 Hz that starts and ends at 0, with a smaller amplitude at frequencies at which it would be faster
    than ``speed`` [rad/s]. Its duration is ``seconds``."""
    time_s = _time(seconds)
    hz = low_hz + (high_hz - low_hz) * time_s / seconds
    angle = (
        2 * np.pi * (low_hz * time_s + (high_hz - low_hz) * time_s**2 / (2 * seconds))
    )
    return (
        np.minimum(amplitude_rad, speed / (2 * np.pi * hz))
        * np.sin(angle)
        * _fade(time_s, seconds)
    )


def triangle(seconds: float, amplitude_rad: float, turns: int = 1) -> np.ndarray:
    """Triangle (T,) [rad] at 200 Hz: from 0 up, down and back to 0, ``turns`` times in ``seconds``."""
    time_s = _time(seconds)
    return amplitude_rad * np.interp(
        time_s * turns / seconds % 1.0, [0.0, 0.25, 0.75, 1.0], [0.0, 1.0, -1.0, 0.0]
    )


def steps(
    levels_rad: np.ndarray, hold_s: float = 1.0, speed: float = SPEED_RAD_PER_S
) -> np.ndarray:
    """Steps (T,) [rad] at 200 Hz between ``levels_rad`` (N,), with the highest speed ``speed`` [rad/s]; each level lasts
    ``hold_s``, with the way to it. It starts at 0."""
    most = speed / RATE_HZ
    at, out = 0.0, []
    for level in levels_rad:
        for _ in range(round(hold_s * RATE_HZ)):
            at += min(max(level - at, -most), most)
            out.append(at)
    return np.array(out)


def multisine(
    seconds: float, amplitude_rad: float, seed: int, speed: float = SPEED_RAD_PER_S
) -> np.ndarray:
    """Multisine (T,) [rad] at 200 Hz: four sines with random phases, starting and ending at 0. Its duration is ``seconds``; its
    amplitude is smaller if it would be faster than ``speed`` [rad/s]."""
    rng = np.random.default_rng(seed)
    time_s = _time(seconds)
    hz = np.array([0.15, 0.4, 0.9, 1.7])
    waves = np.sin(
        2 * np.pi * hz * time_s[:, None] + rng.uniform(0, 2 * np.pi, 4)
    ) / np.sqrt(hz + 0.3)
    motion = waves.sum(axis=1) * _fade(time_s, seconds)
    motion *= amplitude_rad / np.abs(motion).max()
    fastest = np.abs(np.diff(motion)).max() * RATE_HZ
    return motion * min(1.0, speed / fastest)


def _time(seconds: float) -> np.ndarray:
    return np.arange(round(seconds * RATE_HZ)) / RATE_HZ


def _fade(time_s: np.ndarray, seconds: float) -> np.ndarray:
    share = np.clip(np.minimum(time_s, seconds - time_s) / 0.5, 0.0, 1.0)
    return share**2 * (3 - 2 * share)


def between_rests(
    name: str, moved: Callable[[Room], np.ndarray], off: float = 0.0
) -> Motion:
    """Motion about a middle that is off by ``off`` times the sweep's amplitude; ``moved``: room → (T,) [rad], without rests."""
    still = np.zeros(round(REST_S * RATE_HZ))

    def target(room: Room) -> np.ndarray:
        return (
            room.middle_rad
            + off * room.sweep_rad
            + np.concatenate([still, moved(room), still])
        )

    return Motion(name=name, target=target)


def _steps(
    levels: tuple[float, ...], hold_s: float = 1.0
) -> Callable[[Room], np.ndarray]:
    return lambda room: steps(
        np.array(levels) * room.sweep_rad, hold_s, room.speed_rad_per_s
    )


CHIRP = between_rests(
    "chirp", lambda r: chirp(SWEEP_S, *SWEEP_HZ, r.sweep_rad, r.speed_rad_per_s)
)
AGAIN = dataclasses.replace(CHIRP, name="chirp_again", repeat_of="chirp")
WIDE_TRIANGLE = between_rests("wide_triangle", lambda r: triangle(14.0, r.wide_rad))
STIFFER_CHIRP = dataclasses.replace(CHIRP, name="chirp_2x_gain", gain=2.0)
LOADED_CHIRP = dataclasses.replace(CHIRP, name="chirp_payload", payload_kg=KNOWN_KG)
STEPS = between_rests(
    "steps", _steps((0.0, 0.3, -0.4, 1.0, 0.85, -1.0, -0.95, 0.4, 0.0))
)
SMALL_CHIRP = between_rests(
    "small_chirp", lambda r: chirp(6.0, 0.2, 4.0, r.small_rad, r.speed_rad_per_s)
)
PACK = (WIDE_TRIANGLE, STEPS, SMALL_CHIRP, STIFFER_CHIRP, LOADED_CHIRP)
"""Motions of the fit recordings besides the chirp and its repeat."""
HELD_STEPS = between_rests(
    "held_steps", _steps((0.0, -0.6, 0.85, 0.9, -1.0, 0.6, 0.5, -0.3, 0.0)), -0.2
)
"""Motion that is recorded twice as well: with dry friction a robot repeats its steps worse than its chirp."""
VALIDATION = (
    between_rests(
        "held_chirp",
        lambda r: chirp(10.0, 0.15, 2.1, 0.77 * r.sweep_rad, r.speed_rad_per_s),
        -0.3,
    ),
    between_rests("held_triangle", lambda r: triangle(12.0, 0.8 * r.wide_rad, 2)),
    HELD_STEPS,
    dataclasses.replace(HELD_STEPS, name="held_steps_again", repeat_of="held_steps"),
)
"""Motions of the validation recordings."""
TEST = (
    between_rests(
        "test_multisine",
        lambda r: multisine(10.0, 1.2 * r.sweep_rad, 5, r.speed_rad_per_s),
    ),
    between_rests(
        "test_multisine_far",
        lambda r: multisine(8.0, 0.7 * r.sweep_rad, 9, r.speed_rad_per_s),
        0.4,
    ),
)
"""Motions of the test recordings."""
LIBRARY = (
    CHIRP,
    *PACK,
    between_rests("slow_triangle", lambda r: triangle(30.0, 0.5 * r.wide_rad)),
    between_rests("holds", _steps((0.3, -0.3, 0.8, -0.8, 0.0), hold_s=4.0)),
    dataclasses.replace(STEPS, name="steps_2x_gain", gain=2.0),
    dataclasses.replace(WIDE_TRIANGLE, name="triangle_payload", payload_kg=KNOWN_KG),
)
"""Motions from which ``taccorl excite`` chooses."""
DESIGNS = {"chirp": (CHIRP, AGAIN), "pack": (CHIRP, AGAIN, *PACK)}
"""Motions of the fit recordings by design: the paper's sweep (twice, for the noise floor), or all."""
JUDGED_ON = {
    "chirp": (CHIRP,),
    "pack": (CHIRP, WIDE_TRIANGLE, STIFFER_CHIRP, LOADED_CHIRP),
}
"""Motion on which the strength of hidden effects is measured."""


def joint_number(signal: str) -> int:
    """Number of a joint: ``left_joint5`` → 5. Raises TaccorlError: there is no such joint."""
    arm, _, joint = signal.partition("_")
    if arm not in ROBOT.arms or joint not in ROBOT.joints:
        known = [f"{a}_{j}" for a in ROBOT.arms for j in ROBOT.joints]
        raise TaccorlError(f"no joint {signal!r}; {nearest(signal, known)}")
    return ROBOT.joints.index(joint) + 1
