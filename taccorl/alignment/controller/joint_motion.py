"""One joint's part of a recording: its targets, what was measured, and the torque by which other joints' motion loads it.

Letters in shapes: T rows, N numbers of a pose.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, sosfiltfilt

from taccorl.alignment.measurements.measurement import Measurement
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT

_START_S = 0.1  # of a rest at the start is averaged
STILL = 0.01
"""Another joint counts as held if it moves by less than this [rad, m]."""
_SMOOTH_HZ = 20.0
"""Of the other joints' measured motion. Seven clean robots of ``docs/robot_study.jsonl`` ended at up to 1.45 noise floors with
10 Hz, which loses what steps do to other joints, at 1.16 with 20 Hz, and at 1.18 with 30 Hz, which lets in noise."""
_FAST_HZ, _FAST_S, _FAST_TIMES = 60.0, 0.05, 4.0
"""Motion between ``_SMOOTH_HZ`` and the first number is kept where its mean square over the second [s] is more than the third
times its median, which is noise where steps are rare (choices)."""
STEP_FROM_START = 0.05
"""Least share of the way to a target that never changes by which a joint moves in the first tenth of a second if it started away
from it. A choice."""
Position = tuple[float, float, float]
"""x, y, z [m]."""
AT_TCP: Position = (0.0, 0.0, ROBOT.tcp_from_hand_m)
"""Position in link 6's frame [m]: the middle between the pads, where the PiPER's gripper holds its payload."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointMotion:
    """Data of one joint from one recording. Row k holds the state of the joint at the time of command k, before this command
    acts. Objects are equal only if they are the same, so that results for one can be kept."""

    name: str
    time_s: np.ndarray
    """(T,) times [s]."""
    rate_hz: float
    """Row rate [Hz]."""
    target: np.ndarray
    """(T,) targets in the unit that ``target_kind`` of the joint implies [rad, rad/s or N·m]."""
    measured: np.ndarray
    """(T,) measured positions [rad]; NaN where not measured."""
    effort: np.ndarray
    """(T,) efforts [N·m]; NaN where not recorded."""
    coupling_nm: np.ndarray
    """(T,) torque that the joint must hold against the measured motion of the other joints [N·m]; 0 if they stand still. Where
    ``carrying_nm`` is given, all weight is included."""
    start: float
    """Position reported at rest before the first command [rad]."""
    start_speed: float = 0.0
    """Speed at the first row of a recording that begins in motion [rad/s]."""
    pose: np.ndarray
    """(N,) positions at which the other joints are held [rad, m] (for the PiPER its arm's joints and gripper); the entry of the
    free joint is not used."""
    positions: np.ndarray | None = None
    """(T, N) measured positions of all joints, low-pass filtered [rad, m]; None: the others are held, or no mass depends on
    them."""
    kp_scale: float = 1.0
    """Factor on the requested K_p in this recording: commanded gain over the twin's, if it is known; else over that of the other
    recordings (``Measurement.gain_scale``)."""
    kd_scale: float = 1.0
    """The same for K_d."""
    kp_known: bool = False
    """True if the recording states the commanded K_p."""
    kd_known: bool = False
    """True if the recording states the commanded K_d."""
    payload_kg: float = 0.0
    """Known mass in the gripper [kg]."""
    carrying_nm: np.ndarray | None = None
    """(T,) torque that the motor adds for gravity compensation besides that of ``Rigid`` [N·m]; None: none."""
    torque_ff_nm: np.ndarray | None = None
    """(T,) known torque that the controller adds to its law [N·m]; None: none."""
    supply: np.ndarray | None = None
    """(T,) supply voltage of the motor divided by that of its file; None: 1."""
    command_s: np.ndarray | None = None
    """(T,) arrival time of each target [s], on the clock of ``time_s``; None: the time of its row."""
    on: np.ndarray | None = None
    """(T,) 0 while the motor is off, else 1; None: always 1."""
    moment_kgm: float = 0.0
    """Σ m l of the masses that the recording mounts on an axis [kg·m]."""
    mounted_kgm2: float = 0.0
    """Σ m l² of the masses that the recording mounts on an axis [kg·m²]; on a slide Σ m [kg]."""
    payload_at_m: Position = AT_TCP
    """Centre of mass of the payload in link 6's frame [m]."""
    payload_at_known: bool = False
    """True if the recording states that position."""


@lru_cache(maxsize=32)  # the same object for the same rows, so that what is kept for it is found again
def first_rows(motion: JointMotion, rows: int) -> JointMotion:
    """``motion`` without the rows from row ``rows`` on; ``motion`` itself if it has no more."""
    whole = len(motion.time_s)
    if rows >= whole:
        return motion
    names = (
        "time_s",
        "target",
        "measured",
        "effort",
        "coupling_nm",
        "carrying_nm",
        "torque_ff_nm",
        "supply",
        "command_s",
        "on",
        "positions",
    )
    arrays = {name: getattr(motion, name) for name in names}
    return dataclasses.replace(motion, **{name: a[:rows] for name, a in arrays.items() if a is not None})


def resting(m: Measurement, j: int) -> float:
    """Mean position of signal ``j`` [rad, m] measured before the targets change, over a tenth of a second at most, to reduce
    noise. A velocity or torque other than 0, or a constant target elsewhere, moves the joint at once: then the first position. If
    the signal was never measured: the first position that its targets plan. Raises TaccorlError: nothing was measured before the
    targets change."""
    changed = np.flatnonzero(m.target[:, j] != m.target[0, j])
    rest = min(changed[0] + 1 if len(changed) else m.num_rows, max(1, round(_START_S * m.rate_hz)))
    if m.target_kind(m.signals[j]) != "position" and m.target[0, j] != 0.0:
        rest = 1
    rows = m.measured[:rest, j]
    if steps_at_once(m, j):
        return float(m.measured[0, j])
    if np.isfinite(rows).any():
        return float(np.nanmean(rows))
    if np.isfinite(m.measured[:, j]).any():
        raise TaccorlError(
            f"{m.name}: {m.signals[j]} was not measured in its first {rest} rows; cut the recording there"
        )
    return float(_planned(m, j)[0])


def steps_at_once(m: Measurement, j: int) -> bool:
    """Whether the target of signal ``j`` stands at its new value in the first row and never changes, and the joint, which starts
    elsewhere, moves at once."""
    rows = m.measured[: max(2, round(_START_S * m.rate_hz)), j]
    if m.target_kind(m.signals[j]) != "position" or np.ptp(m.target[:, j]) != 0.0 or not np.isfinite(rows).all():
        return False
    return bool(np.ptp(rows) > STEP_FROM_START * abs(m.target[0, j] - rows[0]) > 0.0)


def _smooth_motion(m: Measurement, signal: str) -> np.ndarray:
    """(T,) measured positions of ``signal`` [rad, m], or targets if none were measured, low-pass filtered (20 Hz)."""
    j = m.column(signal)
    seen = m.measured[:, j]
    return _smooth(seen if np.isfinite(seen).any() else _planned(m, j), m.rate_hz)


def _planned(m: Measurement, j: int) -> np.ndarray:
    """(T,) targets of a signal that was not measured. Raises TaccorlError: they are no positions."""
    kind = m.target_kind(m.signals[j])
    if kind != "position":
        raise TaccorlError(
            f"{m.name}: {m.signals[j]} is commanded by {kind}, and its position was not measured; log the position, or remove "
            "the signal"
        )
    return m.target[:, j]


def moved_by_others(m: Measurement, signal: str, others: Sequence[str], still: float = STILL) -> dict[str, np.ndarray]:
    """Signal → (T,) low-pass filtered motion [rad, m]: ``signal`` itself, always, and those ``others`` whose motion has a range
    above ``still``."""
    found = {signal: _smooth(m.measured[:, m.column(signal)], m.rate_hz)}
    for other in others:
        if other != signal and other in m.signals:
            motion = _smooth_motion(m, other)
            if np.ptp(motion) > still:
                found[other] = motion
    return found


def _smooth(angles: np.ndarray, rate_hz: float) -> np.ndarray:
    """(T,) ``angles`` below ``_SMOOTH_HZ``, and up to ``_FAST_HZ`` where there is more than noise, after a step for instance."""
    seen = np.isfinite(angles)
    rows = np.arange(len(angles))
    whole = np.interp(rows, rows[seen], angles[seen]) if seen.any() else np.zeros(len(angles))
    slow, wide = (
        sosfiltfilt(butter(2, min(cutoff / (rate_hz / 2), 0.8), output="sos"), whole, padlen=min(9, len(whole) - 1))
        for cutoff in (_SMOOTH_HZ, _FAST_HZ)
    )
    power = uniform_filter1d((wide - slow) ** 2, max(3, round(_FAST_S * rate_hz)))
    noise = _FAST_TIMES * float(np.median(power))
    return slow + np.clip(1.0 - noise / np.maximum(power, 1e-30), 0.0, 1.0) * (wide - slow)
