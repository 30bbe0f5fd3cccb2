"""Residual as a function of the variables on which physical effects depend, with a band that includes the correlation of rows.

A curve that leaves zero shows on which variable the error depends; it does not show the cause.

Letters in shapes: T rows, B blocks, V bins of a variable.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from taccorl.alignment.measurements.correlation import BLOCK_S
from taccorl.alignment.measurements.measurement import UNITS
from taccorl.diagnosis.comparison.localise import (
    LEAST_SHARE,
    Motion,
    bridged,
    motions_of,
)
from taccorl.diagnosis.comparison.result import Comparison, Kind, drawn_blocks

BINS = 14
"""Number of bins of equal width along a variable."""
STANDS = 1e-6
"""Range below which a variable counts as constant [rad, rad/s, N·m, s]."""
Measure = Literal["mean", "RMS"]
"""Statistic of the residual along a variable. Along time and speed the RMS is used, because the residual's sign changes with the
direction."""


@dataclass(frozen=True)
class Variable:
    """A variable on which physical effects depend, such as speed or position."""

    name: str
    measure: Measure
    """Statistic of the residual that is shown along it."""
    values: Callable[[Motion], np.ndarray]
    """Function of a ``Motion`` that returns the variable (T,)."""


VARIABLES: tuple[Variable, ...] = (
    # friction, drag, damping, delay
    Variable("velocity", "mean", lambda m: m.velocity),
    # gravity, springs, cogging, encoder waves
    Variable("position", "mean", lambda m: bridged(m.trace.position)),
    # inertia, delay, slew limits
    Variable("commanded acceleration", "mean", lambda m: m.acceleration),
    # load friction, compliance, saturation, torque scale
    Variable("modelled torque", "mean", lambda m: m.trace.torque),
    # heating, drift
    Variable("time", "RMS", lambda m: m.trace.time_s - m.trace.time_s[0]),
    # slew limits, lag, feed-forward
    Variable("commanded speed", "RMS", lambda m: np.abs(m.target_speed)),
)
"""The variables of the figures and reports, in their order."""


def variable_unit(variable: str, position_unit: str) -> str:
    """Unit of the variable of that name, such as "rad/s", for a signal whose position is in ``position_unit`` (rad or m)."""
    speed, effort = UNITS[position_unit]
    units = {
        "velocity": speed,
        "position": position_unit,
        "commanded acceleration": f"{speed}²",
        "time": "s",
    }
    return units.get(variable, effort if variable == "modelled torque" else speed)


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Residual of one signal along one variable, in the signal's unit."""

    signal: str
    kind: Kind
    variable: str
    measure: Measure
    """Statistic of the residual: mean or RMS."""
    at: np.ndarray
    """(V,) mean of the variable in each bin; bins have equal width, and those with too few rows are left out."""
    middle: np.ndarray
    """(V,) mean or RMS of the residual."""
    low: np.ndarray
    """(V,) lower end of the 95 % band, from blocks of ``BLOCK_S``, because neighbouring rows are correlated."""
    high: np.ndarray
    """(V,) upper end of the band."""
    explained: float
    """Share of the residual's variance that the means of the bins explain (along time and speed: share of the mean square)."""
    by_chance: float
    """The 95 % quantile of ``explained`` for residuals of the same shape that do not depend on the variable (cyclically shifted
    in time)."""


def curves(comparison: Comparison, signal: str, kind: Kind = "position") -> list[Curve]:
    """One curve for each of ``VARIABLES`` that is not constant, from all recordings of the signal together."""
    motions = motions_of(comparison.of(signal, kind))
    found = [_curve(motions, signal, kind, variable) for variable in VARIABLES]
    return [c for c in found if c is not None]


def _curve(
    motions: Sequence[Motion], signal: str, kind: Kind, variable: Variable
) -> Curve | None:
    values = np.concatenate([variable.values(m) for m in motions])
    residual = np.concatenate([m.trace.residual for m in motions])
    rows = [max(1, round(BLOCK_S / m.trace.period_s)) for m in motions]
    sizes = [len(m.trace.time_s) for m in motions]
    firsts = np.concatenate(
        [[0], np.cumsum([-(-size // r) for size, r in zip(sizes, rows, strict=True)])]
    )
    block = np.concatenate(
        [
            first + np.arange(size) // r
            for first, size, r in zip(firsts[:-1], sizes, rows, strict=True)
        ]
    )
    known = np.isfinite(values) & np.isfinite(residual)
    low, high = (
        np.quantile(values[known], (0.01, 0.99))
        if known.sum() > 10 * BINS
        else (0.0, 0.0)
    )
    if high - low < STANDS:
        return None
    which = np.clip(np.floor((values - low) / (high - low) * BINS), 0, BINS - 1)
    values, which, block = values[known], which[known].astype(int), block[known]
    seen = residual[known] ** 2 if variable.measure == "RMS" else residual[known]
    # (B, V) sums and numbers: a bootstrap of blocks is then a product of matrices.
    shape = (int(firsts[-1]), BINS)
    sums, counts = np.zeros(shape), np.zeros(shape)
    np.add.at(sums, (block, which), seen)
    np.add.at(counts, (block, which), 1.0)
    kept = counts.sum(axis=0) >= LEAST_SHARE * len(values)
    if kept.sum() < 3:
        return None
    weights = drawn_blocks(shape[0])
    with np.errstate(
        invalid="ignore", divide="ignore"
    ):  # a draw may hold no row of a bin
        draws = ((weights @ sums) / (weights @ counts))[:, kept]
    curve = np.vstack(
        [
            sums.sum(axis=0)[kept] / counts.sum(axis=0)[kept],
            np.nanquantile(draws, (0.025, 0.975), axis=0),
        ]
    )
    middle, band_low, band_high = np.sqrt(curve) if variable.measure == "RMS" else curve
    return Curve(
        signal=signal,
        kind=kind,
        variable=variable.name,
        measure=variable.measure,
        at=np.bincount(which, values, BINS)[kept] / counts.sum(axis=0)[kept],
        middle=middle,
        low=band_low,
        high=band_high,
        explained=_explained(seen, which, BINS),
        by_chance=_by_chance(seen, which, BINS),
    )


def _explained(residual: np.ndarray, which: np.ndarray, num: int) -> float:
    """1 − variance about the bins' means / variance."""
    left = residual - residual.mean()
    power = float(left @ left)
    counts = np.bincount(which, minlength=num)
    means = np.bincount(which, left, num) / np.maximum(counts, 1)
    return float(counts @ means**2) / power if power > 0 else 0.0


def _by_chance(residual: np.ndarray, which: np.ndarray, num: int) -> float:
    """95th percentile over shifts of the residual by random parts of the whole."""
    rng = np.random.default_rng(0)
    shifts = rng.integers(
        len(residual) // 10, max(len(residual) - len(residual) // 10, 2), 100
    )
    return float(
        np.quantile(
            [_explained(np.roll(residual, s), which, num) for s in shifts], 0.95
        )
    )
