"""Correlation of residuals over time: the number of independent rows, and blocks of time that count as independent. The
correlation is computed over time for each channel (a taxel of a pad, angle or effort of a joint) of one recording.

Letters in shapes: T rows, C channels of one recording, n measured entries of all recordings.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.fft import next_fast_len

BLOCK_S = 0.5
"""Length of a block [s]. Residuals within a block are correlated, because a misfit lasts as long as a motion; blocks count as
independent."""
SMALL = 0.05
"""Autocorrelation below which further lags are taken as noise of the estimate."""
FEWEST = 10.0
"""Least number of independent rows that is assumed."""


class Rows(NamedTuple):
    """Position of one recording's entries in a stacked vector of residuals."""

    measured: np.ndarray
    """(T, C) bool: entries that were measured."""
    rate_hz: float
    """Row rate [Hz]."""
    short_noise: bool = False
    """As in ``Recording``."""


def rate_of(time_s: np.ndarray) -> float:
    """Mean rate [Hz] of the rows at ``time_s`` (T,)."""
    return (len(time_s) - 1) / float(time_s[-1] - time_s[0])


def block_of_rows(num_rows: int, rate_hz: float) -> np.ndarray:
    """(T,) int, index of the block of 0.5 s (``BLOCK_S``) to which each of the T = ``num_rows`` rows of a recording belongs. A
    remainder shorter than half a block joins the block before it, because one row would have the weight of a block."""
    length = max(1, round(BLOCK_S * rate_hz))
    block = np.arange(num_rows) // length
    last = int(block[-1]) if num_rows else 0
    if last > 0 and 2 * (num_rows - last * length) < length:
        block[last * length :] = last - 1
    return block


def unstacked(values: np.ndarray, layout: Sequence[Rows]) -> Iterator[np.ndarray]:
    """Iterate over the recordings: values (T, C) of each, from the stacked ``values`` (n,); NaN where not measured.

    Args:
        layout: position of each recording's entries in ``values``.
    """
    at = 0
    for rows in layout:
        count = int(rows.measured.sum())
        part = np.full(rows.measured.shape, np.nan)
        part[rows.measured] = values[at : at + count]
        at += count
        yield part


def block_sums(values: np.ndarray, layout: Sequence[Rows]) -> np.ndarray:
    """(B, …) sums of the stacked ``values`` (n, …) over each of the B blocks of all recordings, all channels together.

    Args:
        layout: position of each recording's entries in ``values``.
    """
    first, number = 0, []
    for rows in layout:
        block = block_of_rows(len(rows.measured), rows.rate_hz)
        number.append(
            first + np.broadcast_to(block[:, None], rows.measured.shape)[rows.measured]
        )
        first += int(block[-1]) + 1
    where = np.concatenate(number)
    starts = np.flatnonzero(
        np.diff(where, prepend=-1)
    )  # entries of a block stand together: rows are in order of time
    return np.add.reduceat(values, starts, axis=0)


def lasting_square(values: np.ndarray, layout: Sequence[Rows]) -> float:
    """Part of the mean square of the stacked residuals ``values`` (n,) that outlasts noise: mean product of two residuals
    of one channel, one to two blocks of ``BLOCK_S`` apart, in recordings with ``short_noise``. At least 0."""
    products = np.zeros(2)  # of values, and of ones in their places
    for part, rows in zip(unstacked(values, layout), layout, strict=True):
        block = max(1, round(BLOCK_S * rows.rate_hz))
        for k, own in enumerate(
            (np.nan_to_num(part), rows.measured) if rows.short_noise else ()
        ):
            sums = np.cumsum(own, axis=0)
            products[k] += (
                own[: -2 * block] * (sums[2 * block :] - sums[block:-block])
            ).sum()
    return max(float(products[0]), 0.0) / max(float(products[1]), 1.0)


def independent_rows(parts: Sequence[np.ndarray]) -> float:
    """Number of independent entries among those of ``parts``: Σ n / (1 + 2 Σ_k ρ_k), the sum over recordings and channels.

    ρ_k is the autocorrelation of one channel of one recording at a lag of k rows, up to the first lag at which it is below
    ``SMALL``; n counts its measured rows (effective sample size, e.g. Sokal 1997, §3).

    Args:
        parts: (T, C) residuals of each recording; NaN where nothing was measured.

    Returns:
        At least ``FEWEST``, or the number of entries where there are fewer than 20.
    """
    total = sum(int(np.isfinite(part).sum()) for part in parts)
    if total < 20:
        return float(max(total, 1))
    return max(FEWEST, sum(_independent(part) for part in parts))


def _independent(part: np.ndarray) -> float:
    measured = np.isfinite(part)
    seen = measured.any(axis=1)
    if not seen.any():
        return 0.0
    rows = np.flatnonzero(seen)
    part, measured = part[rows[0] : rows[-1] + 1], measured[rows[0] : rows[-1] + 1]
    count = measured.sum(axis=0)
    filled = np.where(measured, part, 0.0)
    filled = np.where(measured, filled - filled.sum(axis=0) / np.maximum(count, 1), 0.0)
    length = next_fast_len(2 * len(part), real=True)
    spectrum = np.abs(np.fft.rfft(filled, length, axis=0))
    correlation = np.fft.irfft(spectrum**2, length, axis=0)[: max(len(part) // 2, 1)]
    power = correlation[0]
    varies = power > 1e-20 * np.maximum(
        (np.where(measured, part, 0.0) ** 2).sum(axis=0), 1e-300
    )
    correlation = correlation[:, varies] / power[varies]
    alike = np.logical_and.accumulate(correlation[1:] >= SMALL, axis=0)
    implied = 1.0 + 2.0 * (correlation[1:] * alike).sum(axis=0)
    return float((count[varies] / implied).sum() + count[~varies].sum())
