"""Localise the error of a twin by regime, a part of the motion such as slow, fast or after a reversal.

This shows where the error is, not its cause: a delay, a payload, a wrong gain scale and missing inertia all cause errors at
"high speed" and "high load" (measured on surrogates). ``taccorl diagnose`` separates causes by simulating each.

Letters in shapes: T rows.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.signal import savgol_filter

from taccorl.diagnosis.comparison.result import Comparison, Kind, Trace

SMOOTH_S = 0.1
"""Window of the straight lines whose slopes are the velocities [s]; cubics would overshoot at a sudden stop and show a
reversal."""
SLOW, FAST = 0.05, 0.7
"""Shares of the peak speed (99th percentile): a speed below the first is near zero, one above the second is high."""
REVERSAL_S = 0.15
"""Time after a change of the velocity's sign that belongs to the reversal [s]: friction and backlash take about as long."""
HIGH_LOAD = 0.75
"""Quantile of |torque| above which the load is high."""
LEAST_SHARE = 0.01
"""Least share of the rows for a regime to be evaluated."""


@dataclass(frozen=True)
class Regime:
    """A condition that selects rows of a motion, such as high speed."""

    name: str
    """Name in tables, such as ``high speed``."""
    group: str
    """Name of the group; regimes of one group exclude each other."""
    words: str
    """Definition for readers."""
    rows: Callable[["Motion"], np.ndarray]
    """Function of a ``Motion`` that returns (T,) bool."""


@dataclass(frozen=True)
class Motion:
    """Motion of a joint in one recording, from its own measurement (gaps are interpolated): velocity, acceleration, scales."""

    trace: Trace
    velocity: np.ndarray
    """(T,) measured velocity [rad/s, m/s]."""
    acceleration: np.ndarray
    """(T,) commanded acceleration [rad/s², m/s²], from the smoothed target."""
    target_speed: np.ndarray
    """(T,) velocity of the smoothed target, with its sign [rad/s, m/s]."""
    peak_speed: float
    """99th percentile of the speed over all recordings of the signal [rad/s, m/s]."""
    span: tuple[float, float]
    """Lowest and highest measured position over all recordings of the signal [rad, m]."""
    high_torque: float
    """|torque| above which the load is high, over all recordings of the signal [N·m, N]; inf if no torque is known."""

    @property
    def after_reversal(self) -> np.ndarray:
        """(T,) bool: rows after a reversal. A reversal counts if the joint was faster than near zero on both sides of it."""
        sign = np.where(
            np.abs(self.velocity) > SLOW * self.peak_speed, np.sign(self.velocity), 0.0
        )
        moving = np.flatnonzero(sign)
        after = np.zeros(len(sign), dtype=bool)
        rows = round(REVERSAL_S / self.trace.period_s)
        turned = np.flatnonzero(np.diff(sign[moving]) != 0)
        for last, first in zip(moving[turned], moving[turned + 1], strict=True):
            crossing = last + int(np.argmin(np.abs(self.velocity[last : first + 1])))
            after[crossing : crossing + rows] = True
        return after


def motions_of(traces: Sequence[Trace]) -> list[Motion]:
    """One motion per trace, all of one signal, with common limits for speed, range and load."""
    velocities = [_slope(bridged(t.position), t.period_s) for t in traces]
    peak = float(np.quantile(np.abs(np.concatenate(velocities)), 0.99))
    positions = np.concatenate([t.position for t in traces])
    torques = np.abs(np.concatenate([t.torque for t in traces]))
    known = torques[np.isfinite(torques)]
    high = float(np.quantile(known, HIGH_LOAD)) if len(known) else np.inf
    span = (float(np.nanmin(positions)), float(np.nanmax(positions)))
    found = []
    for t, velocity in zip(traces, velocities, strict=True):
        speed = _slope(t.target, t.period_s)
        found.append(
            Motion(t, velocity, _slope(speed, t.period_s), speed, peak, span, high)
        )
    return found


def bridged(values: np.ndarray) -> np.ndarray:
    """``values`` (T,) with linear interpolation in place of NaN; all 0 if every value is NaN."""
    known = np.isfinite(values)
    at = np.arange(len(values))
    return (
        np.interp(at, at[known], values[known])
        if known.any()
        else np.zeros(len(values))
    )


def _slope(values: np.ndarray, period_s: float) -> np.ndarray:
    window = min(
        2 * round(SMOOTH_S / period_s / 2) + 1, len(values) - (len(values) + 1) % 2
    )
    if window < 3:
        return np.gradient(values, period_s)
    return np.asarray(
        savgol_filter(values, window, 1, deriv=1, delta=period_s, mode="interp")
    )


def _third(values: np.ndarray, low: float, high: float, part: int) -> np.ndarray:
    share = (values - low) / max(high - low, 1e-12) * 3
    return np.clip(np.floor(share), 0, 2) == part


def _pose(part: int) -> Callable[[Motion], np.ndarray]:
    return lambda m: _third(bridged(m.trace.position), *m.span, part)


def _time(part: int) -> Callable[[Motion], np.ndarray]:
    return lambda m: _third(m.trace.time_s, m.trace.time_s[0], m.trace.time_s[-1], part)


REGIMES: tuple[Regime, ...] = (
    Regime(
        "near zero speed",
        "speed",
        f"slower than {SLOW:.0%} of its peak speed",
        lambda m: np.abs(m.velocity) < SLOW * m.peak_speed,
    ),
    Regime(
        "medium speed",
        "speed",
        f"{SLOW:.0%} to {FAST:.0%} of its peak speed",
        lambda m: (
            (np.abs(m.velocity) >= SLOW * m.peak_speed)
            & (np.abs(m.velocity) <= FAST * m.peak_speed)
        ),
    ),
    Regime(
        "high speed",
        "speed",
        f"faster than {FAST:.0%} of its peak speed",
        lambda m: np.abs(m.velocity) > FAST * m.peak_speed,
    ),
    Regime(
        "moving forwards",
        "direction",
        "moving towards larger positions",
        lambda m: m.velocity > SLOW * m.peak_speed,
    ),
    Regime(
        "moving backwards",
        "direction",
        "moving towards smaller positions",
        lambda m: m.velocity < -SLOW * m.peak_speed,
    ),
    Regime(
        "after a reversal",
        "reversal",
        f"within {REVERSAL_S:g} s of a change of direction",
        lambda m: m.after_reversal,
    ),
    Regime(
        "high load",
        "load",
        f"the twin's motor torque is in its highest {1 - HIGH_LOAD:.0%}",
        lambda m: np.abs(m.trace.torque) > m.high_torque,
    ),
    Regime(
        "lowest third of the range",
        "pose",
        "of the positions in all recordings",
        _pose(0),
    ),
    Regime(
        "middle third of the range",
        "pose",
        "of the positions in all recordings",
        _pose(1),
    ),
    Regime(
        "highest third of the range",
        "pose",
        "of the positions in all recordings",
        _pose(2),
    ),
    Regime("first third of the time", "time", "of each recording's time", _time(0)),
    Regime("second third of the time", "time", "of each recording's time", _time(1)),
    Regime("last third of the time", "time", "of each recording's time", _time(2)),
    Regime(
        "in contact", "contact", "a pad of its arm touches", lambda m: m.trace.touched
    ),
    Regime(
        "no contact",
        "contact",
        "no pad of its arm touches",
        lambda m: ~m.trace.touched & m.trace.touched.any(),
    ),
)
"""All regimes of the motion of a joint or axis."""
WHERE_NOT_WHY = (
    "This says where the twin is off, not why: delays, loads, gains and inertia cause errors in the same regimes. "
    "taccorl diagnose tries each cause."
)
"""Remark that reports add to errors by regime."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Error of one signal in one regime."""

    signal: str
    kind: Kind | Literal["touch"]
    regime: str
    rmse: float
    """RMS residual in the regime, in the signal's unit."""
    ratio: float
    """RMSE / noise floor."""
    share_of_error: float
    """Share of the regime in the signal's sum of squared residuals."""
    share_of_time: float
    """Share of the signal's measured rows that the regime holds."""
    n: int
    """Number of measured rows in the regime (for touch: of taxel readings)."""

    @property
    def lift(self) -> float:
        """Ratio of its share of the error to its share of the time."""
        return self.share_of_error / self.share_of_time


def cell_of(
    signal: str,
    kind: Kind | Literal["touch"],
    regime: str,
    inside: np.ndarray,
    total: float,
    rows: float,
    floor: float,
) -> Cell | None:
    """The error of a regime from its finite squared residuals ``inside`` (n,), of a signal with so many ``rows`` and the sum
    ``total``. None if it holds fewer rows than ``LEAST_SHARE``."""
    if len(inside) < max(LEAST_SHARE * rows, 1):
        return None
    rmse = float(np.sqrt(np.mean(inside)))
    return Cell(
        signal=signal,
        kind=kind,
        regime=regime,
        rmse=rmse,
        ratio=rmse / floor,
        share_of_error=float(np.sum(inside)) / total if total > 0 else 0.0,
        share_of_time=len(inside) / rows,
        n=len(inside),
    )


def heat_map(comparison: Comparison, kind: Kind = "position") -> list[Cell]:
    """One cell for every signal of this kind and regime with at least 1 % of the rows; all recordings together."""
    cells = []
    for signal in [s for s, k in comparison.signals if k == kind]:
        motions = motions_of(comparison.of(signal, kind))
        squares = [m.trace.residual**2 for m in motions]
        total, rows = (
            float(f(np.concatenate(squares)))
            for f in (np.nansum, lambda s: np.isfinite(s).sum())
        )
        levels = [
            np.full(len(s), m.trace.floor.value**2)
            for s, m in zip(squares, motions, strict=True)
        ]
        for regime in REGIMES:
            which = [
                regime.rows(m) & np.isfinite(s)
                for s, m in zip(squares, motions, strict=True)
            ]
            inside, level = (
                np.concatenate([v[w] for v, w in zip(of, which, strict=True)])
                for of in (squares, levels)
            )
            floor = math.sqrt(level.sum() / max(len(level), 1))
            cells.append(cell_of(signal, kind, regime.name, inside, total, rows, floor))
    return [cell for cell in cells if cell]


def worst_regime(
    cells: Sequence[Cell], signal: str, kind: str = "position"
) -> Cell | None:
    """The cell (errors of one signal in one regime of motion) of ``signal`` with the highest root mean square error. Regimes that
    hold 90 % of the rows or more are left out; None if no other one remains. ``cells``: errors as from ``heat_map`` or
    ``touch_heat_map``. ``kind``: ``position``, ``effort`` or ``touch``."""
    own = [
        c
        for c in cells
        if c.signal == signal and c.kind == kind and c.share_of_time < 0.9
    ]
    return max(own, key=lambda c: c.ratio, default=None)
