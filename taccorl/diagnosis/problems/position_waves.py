"""Position-periodic torques in recordings of many turns, from which a search for cogging starts.

Over a span of s radians two numbers of periods can be told apart if they differ by 2π/s, so that a grid of starts over a hundred
turns would need thousands. A periodogram of the acceleration over the position finds the few that are worth a start.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.signal import savgol_filter

from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.sim.effects.effect import Effect
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
    cogging: type[Effect] = Cogging,
    *,
    length: float = 1.0,
) -> dict[str, float]:
    """The strongest waves over the position, as facts for ``Cogging.starts``.

    Velocity, its sign, the position's sine and cosine and a constant are regressed out of J q̈ − τ with the recorded effort τ:
    the rest contains A sin(N q + φ). Where no effort was recorded, position and target are regressed out of J q̈, too.

    Args:
        inertias_kgm2: J of each motion [kg·m²].
        cogging: the effect in the units of the joint, whose bounds of ``periods``
            are those of the search.
        length: position that counts as 1 rad: 1 of a hinge; of a slide
            ``Scale.wave`` [m]. Returned wave numbers are those of position / ``length``.

    Returns:
        ``wave_periods_1`` N, ``wave_phase_1`` φ [rad], … of up to ``MOST_WAVES`` waves,
        strongest first. Empty if a hinge turns by at most ``SPAN_RAD``; of a slide the
        grid, which counts turns, is of no use.
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
    periods_of = next(p for p in cogging.parameters() if p.name == "periods")
    if periods_of.unit == "1" and span <= SPAN_RAD:
        return {}
    lowest, highest = periods_of.low * length, periods_of.high * length
    width = math.tau / highest / BINS
    place = np.round((q - low) / width).astype(int)
    size = FINER * (int(place.max()) + 1)
    spectrum = np.fft.rfft(np.bincount(place, left_over), size)
    periods = math.tau * np.arange(len(spectrum)) / (size * width)
    power = np.where((periods >= lowest) & (periods <= highest), np.abs(spectrum), 0.0)
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
