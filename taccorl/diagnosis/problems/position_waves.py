"""Position-periodic torques in recordings of many turns, from which a search for cogging starts.

Over a span of s radians two numbers of periods can be told apart if they differ by 2π/s, so that a grid of starts over a hundred
turns would need thousands. A periodogram of the acceleration over the position finds the few that are worth a start.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.signal import savgol_filter

from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.sim.effects.load import Cogging

SPAN_RAD = math.pi
"""Up to this span [rad] the grid of ``Cogging.starts`` is dense enough."""
SMOOTH_S = 0.025
"""Window of the quadratic whose second derivative is the measured acceleration [s]. A choice: waves of up to 20 Hz pass."""
BINS = 4
"""Number of equal position bins per period of the shortest wave that is searched for."""
FINER = 8
"""Number of frequency bins of the periodogram within its resolution of 2π / span [periods per turn]."""
MOST_WAVES = 3
"""Number of waves that are returned at most. A choice."""


def position_waves(
    motions: Sequence[JointMotion],
    inertias_kgm2: Sequence[float],
    *,
    length: float = 1.0,
    least_span: float = SPAN_RAD,
) -> dict[str, float]:
    """The strongest waves over the position, as facts for ``Cogging.starts``.

    Velocity, its sign, the position's sine and cosine and a constant are regressed out of J q̈ − τ with the recorded effort τ:
    the rest contains A sin(N q + φ). Where no effort was recorded, position and target are regressed out of J q̈, too.

    Args:
        inertias_kgm2: J of each motion [kg·m²].
        length: position that counts as 1 rad, for slides [m]: wave numbers are those of position / ``length``.
        least_span: span, in these units, up to which nothing is returned.

    Returns:
        ``wave_periods_1`` N, ``wave_phase_1`` φ [rad], … of up to ``MOST_WAVES`` waves, strongest first; empty where the motions
        span at most ``least_span``.
    """
    angles, left = [], []
    for m, inertia in zip(motions, inertias_kgm2, strict=True):
        seen = np.isfinite(m.measured)
        rows = max(5, 2 * round(0.5 * SMOOTH_S * m.rate_hz) + 1)
        if seen.sum() < 4 * rows:
            continue
        q = np.interp(m.time_s, m.time_s[seen], m.measured[seen])
        v, a = (
            savgol_filter(q, rows, 2, deriv=d, delta=1.0 / m.rate_hz) for d in (1, 2)
        )
        known = np.isfinite(m.effort).all()
        torque = inertia * a - (m.effort if known else 0.0)
        around = np.column_stack(
            [
                v,
                np.sign(v),
                np.sin(q),
                np.cos(q),
                np.ones_like(q),
                *([] if known else [q, m.target]),
            ]
        )
        scale = np.maximum(np.abs(around).max(axis=0), 1e-12)
        angles.append(q / length)
        left.append(
            torque
            - around @ (np.linalg.lstsq(around / scale, torque, rcond=None)[0] / scale)
        )
    if not angles:
        return {}
    q, left_over = np.concatenate(angles), np.concatenate(left)
    low, span = float(q.min()), float(np.ptp(q))
    if span <= least_span:
        return {}
    bounds = next(p for p in Cogging.parameters() if p.name == "periods")
    width = math.tau / bounds.high / BINS
    place = np.round((q - low) / width).astype(int)
    size = FINER * (int(place.max()) + 1)
    spectrum = np.fft.rfft(np.bincount(place, left_over), size)
    periods = math.tau * np.arange(len(spectrum)) / (size * width)
    power = np.where(
        (periods >= bounds.low) & (periods <= bounds.high), np.abs(spectrum), 0.0
    )
    found: dict[str, float] = {}
    for k in range(1, MOST_WAVES + 1):
        at = int(np.argmax(power))
        # r = sin(N q + φ) has the transform e^{iφ} / 2i about q = 0.
        phase = np.angle(spectrum[at]) + 0.5 * math.pi - periods[at] * low
        found |= {
            f"wave_periods_{k}": float(periods[at]),
            f"wave_phase_{k}": math.remainder(float(phase), math.tau),
        }
        power[np.abs(periods - periods[at]) < 2 * math.tau / span] = 0.0
    return found
