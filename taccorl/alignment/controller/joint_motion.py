"""One joint's part of a recording: its targets, what was measured, and the torque by which other joints' motion loads it.

Letters in shapes: T rows, N numbers of a pose.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, sosfiltfilt

from taccorl.alignment.measurements.measurement import Measurement
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT

_START_S = 0.1  # of a rest at the start is averaged
STILL = 0.01  # Another joint counts as held if it moves by less than this [rad, m]
_BANDS_HZ = (20.0, 60.0)
"""Of the other joints' measured motion. Seven clean robots of ``docs/robot_study.jsonl`` ended at up to 1.45 noise floors with
10 Hz, which loses what steps do to other joints, at 1.16 with 20 Hz, and at 1.18 with 30 Hz, which lets in noise."""
_LEFT_HZ = (5.0, *_BANDS_HZ)
"""Likewise of the difference between measured and modelled positions, which is slow: its ends average many rows. A choice."""
_FAST_S, _FAST_TIMES = 0.05, 4.0
"""Motion between two of these frequencies is kept only where its mean square over ``_FAST_S`` [s] exceeds ``_FAST_TIMES`` times
that of white noise, whose level is the median of the fastest band, because steps are rare. Choices."""
Position = tuple[float, float, float]  # x, y, z [m]
AT_TCP: Position = (0.0, 0.0, ROBOT.tcp_from_hand_m)
"""Position in link 6's frame [m]: the middle between the pads, where the PiPER's gripper holds its payload."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surroundings:
    """State of the rest of the machine in one recording. Objects are equal only if the same, so that results can be kept."""

    coupling_nm: np.ndarray
    """(T · F,) torque that the joint must hold against the motion of the other joints [N·m], F times per row; 0 if they stand
    still. Where ``carrying_nm`` is given, all weight is included."""
    carrying_nm: np.ndarray | None = None
    """(T · F,) torque that the motor adds for gravity compensation besides that of ``Rigid`` [N·m]; None: none."""
    torque_ff_nm: np.ndarray | None = (
        None  # (T,) known torque that the controller adds to its law [N·m]; None: none
    )
    supply: np.ndarray | None = (
        None  # (T,) supply voltage of the motor divided by that of its file; None: 1
    )
    on: np.ndarray | None = (
        None  # (T,) 0 while the motor is off, else 1; None: always 1
    )
    moment_kgm: float = 0.0
    """Σ m l of the masses that the recording mounts on an axis, with the arm that holds them [kg·m]."""
    mounted_kgm2: float = 0.0  # Σ m l² of these masses [kg·m²]; on a slide Σ m [kg]
    pose: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(N,) positions at which the other joints are held [rad, m] (for the PiPER its arm's joints and gripper); the entry of the
    free joint is not used."""
    positions: np.ndarray | None = None
    """(T · F, N) positions of all joints [rad, m]; None: the others are held, or no mass depends on them."""
    payload_kg: float = 0.0  # Mass of the payload in the gripper, as the recording states it [kg]; 0: none
    payload_at_m: Position = (
        AT_TCP  # Centre of mass of the payload in link 6's frame [m]
    )
    payload_at_known: bool = False  # True if the recording states that position


@dataclass(frozen=True, kw_only=True, eq=False)
class JointMotion(Surroundings):
    """Data of one joint from one recording. Row k holds the state of the joint at the time of command k, before it acts."""

    name: str
    time_s: np.ndarray  # (T,) times [s]
    rate_hz: float  # Row rate [Hz]
    target: np.ndarray  # (T,) targets in the unit that ``target_kind`` of the joint implies [rad, rad/s or N·m]
    measured: np.ndarray  # (T,) measured positions [rad]; NaN where not measured
    effort: np.ndarray  # (T,) efforts [N·m]; NaN where not recorded
    start: float  # Position reported at rest before the first command [rad]
    start_nm: float = math.inf  # Effort reported there [N·m]; inf: not recorded
    start_speed: float = (
        0.0  # Speed at the first row of a recording that begins in motion [rad/s]
    )
    kp_scale: float = 1.0
    """Factor on the requested K_p in this recording: commanded gain over the twin's, if it is known; else over that of the other
    recordings (``Measurement.gain_scale``)."""
    kd_scale: float = 1.0  # The same for K_d
    held_nm_per_rad: float = 0.0
    """Stiffness K of a spring that holds a model of law torque near the measured position q, 0 if there is none. ``torque_ff_nm``
    then is the part K q + D q̇ of the torque of spring and damper."""
    kp_known: bool = False  # True if the recording states the commanded K_p
    kd_known: bool = False  # True if the recording states the commanded K_d
    command_s: np.ndarray | None = None
    """(T,) arrival time of each target [s], on the clock of ``time_s``; None: the time of its row."""


@lru_cache(
    maxsize=32
)  # the same object for the same rows, so that what is kept for it is found again
def first_rows(motion: JointMotion, rows: int) -> JointMotion:
    """``motion`` without the rows from row ``rows`` on; ``motion`` itself if it has no more."""
    whole = len(motion.time_s)
    if rows >= whole:
        return motion
    columns = {
        f.name: getattr(motion, f.name)
        for f in dataclasses.fields(motion)
        if f.name != "pose"
    }
    own = {
        name: a[: rows * (len(a) // whole)]
        for name, a in columns.items()
        if isinstance(a, np.ndarray)
    }
    return dataclasses.replace(motion, **own)


def resting(m: Measurement, j: int) -> float:
    """Mean position of signal ``j`` [rad, m] measured before the targets change, over a tenth of a second at most, to reduce
    noise. A velocity or torque other than 0, or a constant target elsewhere, moves the joint at once: then the first position. If
    the signal was never measured: the first position that its targets plan. Raises TaccorlError: nothing was measured before the
    targets change."""
    changed = np.flatnonzero(m.target[:, j] != m.target[0, j])
    rest = min(
        changed[0] + 1 if len(changed) else m.num_rows,
        max(1, round(_START_S * m.rate_hz)),
    )
    if m.target_kind(m.signals[j]) != "position" and m.target[0, j] != 0.0:
        rest = 1
    rows = m.measured[:rest, j]
    if steps_at_once(m, j):
        return float(m.measured[0, j])
    if np.isfinite(rows).any():
        return float(np.nanmean(rows))
    if np.isfinite(m.measured[:, j]).any():
        name = f"{m.name}: {m.signals[j]}"
        raise TaccorlError(
            f"{name} was not measured in its first {rest} rows; cut the recording there"
        )
    return float(_planned(m, j)[0])


def steps_at_once(m: Measurement, j: int) -> bool:
    """Whether the target of signal ``j`` stands at its new value in the first row and never changes, and the joint, which starts
    elsewhere, moves at once."""
    rows = m.measured[: max(2, round(_START_S * m.rate_hz)), j]
    if (
        m.target_kind(m.signals[j]) != "position"
        or np.ptp(m.target[:, j]) != 0.0
        or not np.isfinite(rows).all()
    ):
        return False
    # A joint that starts away from its target moves by 5 % of the way in the first tenth
    # of a second. A choice.
    return bool(np.ptp(rows) > 0.05 * abs(m.target[0, j] - rows[0]) > 0.0)


def _planned(m: Measurement, j: int) -> np.ndarray:
    """(T,) targets of a signal that was not measured. Raises TaccorlError: they are no positions."""
    if (kind := m.target_kind(m.signals[j])) != "position":
        why = (
            f"{m.signals[j]} is commanded by {kind}, and its position was not measured"
        )
        raise TaccorlError(f"{m.name}: {why}; log the position, or remove the signal")
    return m.target[:, j]


def moved_by_others(
    m: Measurement, signals: Sequence[str], still: float = STILL
) -> dict[str, np.ndarray]:
    """Signal → (T,) motion [rad, m] of those ``signals`` that move by more than ``still``: measured, or planned where nothing
    was measured, and low-pass filtered."""
    motions = {
        name: _smooth(_seen(m, name), m.rate_hz, _BANDS_HZ)
        for name in signals
        if name in m.signals
    }
    return {name: motion for name, motion in motions.items() if np.ptp(motion) > still}


def beside_model(m: Measurement, signal: str, modelled: np.ndarray) -> np.ndarray:
    """(T · F,) position of ``signal`` [rad, m], F times per row: ``modelled`` (T · F,), the drive model's answer to the targets,
    plus the low-pass filtered difference of the measured positions from it. A filter alone would miss accelerations that jump
    with a target. If more fast motion is left than was measured, the model is wrong, and 0 stands in its place."""
    seen, fine = _seen(m, signal), len(modelled) // m.num_rows
    left = seen - modelled[::fine]
    fast = [np.nanvar(np.diff(x, 2)) for x in (left, seen)]
    if not fast[0] < fast[1]:
        left, modelled = seen, np.zeros(len(modelled))
    smooth = _smooth(left, m.rate_hz, _LEFT_HZ if modelled.any() else _BANDS_HZ)
    return modelled + CubicSpline(np.arange(m.num_rows), smooth)(
        np.arange(len(modelled)) / fine
    )


def _seen(m: Measurement, signal: str) -> np.ndarray:
    j = m.column(signal)
    return m.measured[:, j] if np.isfinite(m.measured[:, j]).any() else _planned(m, j)


@lru_cache(maxsize=32)  # their design takes longer than their use
def _filters(
    rows: int, rate_hz: float, bands_hz: tuple[float, ...]
) -> tuple[list[np.ndarray], list[float]]:
    """Low-pass filters, and the share of white noise that passes between two of them."""
    filters = [butter(2, min(f / (rate_hz / 2), 0.8), output="sos") for f in bands_hz]
    one = np.eye(1, rows, rows // 2)[0]
    padding = {"padtype": "odd", "padlen": min(9, rows - 1)}
    passed = [sosfiltfilt(sos, one, **padding) for sos in filters]
    pairs = itertools.pairwise(passed)
    return filters, [float(np.sum((wide - low) ** 2)) for low, wide in pairs]


def _smooth(
    angles: np.ndarray, rate_hz: float, bands_hz: Sequence[float]
) -> np.ndarray:
    """(T,) ``angles`` below the first frequency, and up to the last one where there is more than noise, as after a step."""
    seen = np.isfinite(angles)
    rows = np.arange(len(angles))
    whole = (
        np.interp(rows, rows[seen], angles[seen])
        if seen.any()
        else np.zeros(len(angles))
    )
    filters, shares = _filters(len(rows), rate_hz, tuple(bands_hz))
    ends, beyond = (
        ("even", round(rate_hz / bands_hz[0])) if bands_hz == _LEFT_HZ else ("odd", 9)
    )
    beyond = min(beyond, len(rows) - 1)
    below = [sosfiltfilt(sos, whole, padtype=ends, padlen=beyond) for sos in filters]
    found, white = below[0], -1.0
    for k in reversed(range(1, len(filters))):
        band, share = below[k] - below[k - 1], shares[k - 1]
        power = uniform_filter1d(band**2, max(3, round(_FAST_S * rate_hz)))
        white = float(np.median(power)) / max(share, 1e-12) if white < 0.0 else white
        found = (
            found
            + np.clip(
                1.0 - _FAST_TIMES * white * share / np.maximum(power, 1e-30), 0.0, 1.0
            )
            * band
        )
    return found
