"""When joints begin to move after steps of their targets, compared with a replay.

While a joint follows a step from rest, dry friction and a constant load take torque from the whole step: the joint moves as the
replay does times a factor, and begins at the same time. Another inertia, too, changes the first motion by a factor. So
q(t) − q₀ = s · r(t − d) with the replay's motion r gives the delay d also where effects are missing.

Letters in shapes: T rows, N rows after a step.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from taccorl.alignment.measurements.measurement import Measurement

REST_S = 0.25
"""Time for which all targets must have rested before a step [s]."""
HELD_S = 0.04
"""Time for which the target must rest after a step [s]."""
WINDOW_S = 0.12
"""Time after a step within which a joint must have moved by ``SHARE`` [s]."""
SHARE = 0.25
"""Share of the step up to which the motion is compared. A choice."""
SEEN_FLOORS, SEEN_ROWS = 6.0, 3
"""Least number of rows in which the motion is above so many noise floors."""
DELAY_ROWS = -8.0, 20.0
"""Range of delays that are tried."""
FINE_ROWS = 0.05
"""Step between them."""
ALIKE = 0.04
"""Largest residual of the comparison, as a share of what an offset of one row would leave. A torque at its limit, play and a
wrong scale of torques change the motion's shape. On simulated joints delays were right within 1.9 ms below this share, and up to
9 ms off above it."""
LEAST_STEPS = 2
"""Least number of steps by which a delay is judged."""


@dataclass(frozen=True)
class Onset:
    """Delay of a joint's measured motion after steps, compared with a replay."""

    delay_s: float
    """Median over the steps [s]; negative if the measurement leads."""
    sd_s: float
    """Standard error of the median, from the scatter of the steps [s]."""
    num_steps: int


def onset_delay(m: Measurement, signal: str, reported: np.ndarray, floor: float) -> Onset | None:
    """Compare the motion of one joint after the steps of its target; None if fewer than ``LEAST_STEPS`` are alike in both.
    ``reported``: (T,) positions of the replay [rad, m]. ``floor``: noise floor of the positions [rad, m]."""
    j, rate_hz = m.column(signal), m.rate_hz
    target, measured = m.target[:, j], m.measured[:, j]
    rest, held, window = (max(1, round(seconds * rate_hz)) for seconds in (REST_S, HELD_S, WINDOW_S))
    still = np.all(np.abs(np.diff(m.target, axis=0)) < 1e-6, axis=1)
    found = []
    for k in np.flatnonzero(np.abs(np.diff(target)) > 1e-6) + 1:
        if k < rest or not (still[k - rest : k - 1].all() and still[k : k + held].all()):
            continue
        step, before, after = float(target[k] - target[k - 1]), slice(k - rest // 2, k - 1), slice(k, k + window)
        own, other = (np.sign(step) * (q[after] - q[before].mean()) for q in (measured, reported))
        beyond = np.flatnonzero(own > SHARE * abs(step))
        if len(beyond) and np.isfinite(other).all():
            own = own[: beyond[0] + 1]
            if np.isfinite(own).all() and np.sum(own > SEEN_FLOORS * floor) >= SEEN_ROWS:
                found += _delay_rows(own, other)
    if len(found) < LEAST_STEPS:
        return None
    error_rows = 1.25 * float(np.std(found, ddof=1)) / np.sqrt(len(found))  # of a median
    return Onset(float(np.median(found)) / rate_hz, max(error_rows, FINE_ROWS) / rate_hz, len(found))


def _delay_rows(own: np.ndarray, replay: np.ndarray) -> list[float]:
    """Delay [rows] of a motion (N,) after a replay's, from rest at row 0; empty if their shapes differ."""
    rows, still = np.arange(len(own)), int(np.ceil(DELAY_ROWS[1]))
    motion = PchipInterpolator(np.arange(-still, len(replay)), np.concatenate([np.zeros(still), replay]))
    delays = np.arange(*DELAY_ROWS, FINE_ROWS)
    shifted = motion(np.clip(rows - delays[:, None], -still, len(replay) - 1))
    power = np.maximum((shifted**2).sum(1), 1e-300)
    left = own - (shifted @ own / power)[:, None] * shifted
    best = int(np.argmin((left**2).sum(1)))
    late = motion(np.clip(rows - delays[best] - 1.0, -still, len(replay) - 1))
    of_one_row = float(shifted[best] @ own / power[best]) * (late - shifted[best])
    return [float(delays[best])] if np.linalg.norm(left[best]) < ALIKE * np.linalg.norm(of_one_row) else []
