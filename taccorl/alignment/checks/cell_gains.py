"""Gains of cells and recordings, compared with each other: cells that hardly respond, cells whose columns are exchanged,
recordings in another unit, and a shared load whose share of each cell changes. Only ratios of gains are judged, so nothing here
needs the gains of the cells file.

Letters in shapes: T rows, K cells, S sums or cells, N pieces of recordings.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from taccorl.alignment.checks.cell_set import CellSet, below_end, slopes
from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import Finding, listed

EXCHANGED = 4.0
"""Cells are exchanged if the load of another cell leaves less than one part in so many of a reading's variance that the own load
leaves. A choice: with columns in order the own load left less than every other in all simulated arrays, also with crosstalk of
0.15, hysteresis, saturation, and a contact 1 mm off its stated place."""
FACTOR = 3.0  # Ratio of the gains of two recordings from which on one of them has another unit
SAME_WAY = 1.2
"""Both in rows up to the same load and up to the same reading the gains must differ by this factor, in the same direction."""
LINEAR = 0.7
"""Correlation of load and reading from which on a recording's gain is known well enough for ``FACTOR``: noise of the load lowers
a gain by the square of this at most."""
PRESSED, REST = (
    0.3,
    0.05,
)  # Shares of a recording's largest load above which it is pressed, and below which it rests
PIECES = 8  # Number of pieces into which the pressed rows of a recording are divided
UNEVEN = 0.3
"""Change of the cells' shares of the load, RMS over cells in units of the mean share, from which on a load is not shared alike.
A choice: simulated arrays whose cells saturate at limits that differ by 40 % change their shares by 0.07 at most."""
ABOVE_NOISE = 5.0  # The change of shares must be so many times that which the readings' variation at rest explains


@check("warning", "dead_cells")
def dead_finding(s: CellSet) -> Iterator[Finding]:
    """Cells that hardly respond to a load that others respond to."""
    if not s.dead.any():
        return
    named = [
        f"{s.config.names[k]} ({float(s.shares[k]):.1%})"
        for k in np.flatnonzero(s.dead)
    ]
    what = (
        "dead, or not touched by the load that all cells share"
        if s.config.load.shared
        else "dead, or not connected"
    )
    text = (
        f"{len(named)} of {s.config.num_cells} cells hardly respond: {listed(named, 12)} of the usual gain; {what}. They take no "
        "part in the search, and a corrected file has the gain 0 for them"
    )
    yield find("dead_cells", "reading", text)


class Exchanged(NamedTuple):
    """A cell whose reading follows the load of another cell."""

    cell: int  # Number of the cell
    load_of: int  # Number of the cell whose load its reading follows
    own: float  # Share of the reading's variance that a fit to its own load leaves
    other: float  # The same of the load of ``load_of``


def exchanged_cells(s: CellSet) -> list[Exchanged]:
    """Cells whose readings follow each other's loads ``EXCHANGED`` times better than their own: pairs, or longer cycles. Empty if
    there are none, or where cells share one load.

    Each reading is fitted by each load, with a gain and an offset, over all recordings together; readings are assigned to loads
    so that the sum of log (share of the variance that remains) is least (maximum likelihood of normal residuals).
    """
    if s.config.load.shared or s.config.num_cells < 2:
        return []
    remains = _remains(s)
    load_of = linear_sum_assignment(np.log(remains))[1].tolist()
    found, seen = [], set()
    for k in range(s.config.num_cells):
        cycle = []
        while k not in seen:
            seen.add(k)
            cycle.append(
                Exchanged(
                    k, load_of[k], float(remains[k, k]), float(remains[k, load_of[k]])
                )
            )
            k = load_of[k]
        if all(e.own > EXCHANGED * e.other for e in cycle):
            found += cycle
    return found


def _remains(s: CellSet) -> np.ndarray:
    """(K, K) share of the variance of each reading (rows) that remains after a fit of gain and offset to each load (columns); 1
    where the gain has the wrong sign, or nothing changes. At least 1e-9."""
    load = s.load - s.load.mean(axis=0)
    rows = s.free.T.astype(float)
    count = np.maximum(s.free.sum(axis=0), 1)
    off = np.where(
        s.free, s.reading - np.where(s.free, s.reading, 0.0).sum(axis=0) / count, 0.0
    )
    power = rows @ np.square(load) - np.square(rows @ load) / count[:, None]
    product, variance = (
        s.config.sign * (off.T @ load),
        np.square(off).sum(axis=0)[:, None],
    )
    known = (
        (power > 1e-9 * np.square(load).sum(axis=0)) & (variance > 0) & (product > 0)
    )
    explained = np.divide(
        np.square(product), power * variance, out=np.zeros(product.shape), where=known
    )
    return np.maximum(1.0 - explained, 1e-9)


@check("error", "exchanged_cells", explains=("shifted_loads",))
def exchanged_finding(s: CellSet) -> Iterator[Finding]:
    """Cells whose readings follow the load of another cell, so that columns are exchanged."""
    exchanged = exchanged_cells(s)
    if not exchanged:
        return
    names = s.config.names
    follows = [
        f"the reading of {names[e.cell]} follows the load of {names[e.load_of]} (its own load leaves {e.own:.2g} of the "
        f"variance, that one {e.other:.2g})"
        for e in exchanged
    ]
    lines = listed([f"`{names[e.cell]}:`" for e in exchanged], 12)
    text = (
        f"{listed(follows, 4)}: the columns are exchanged. Exchange `reading: {{column: …}}`, or `load:` if the loads were "
        f"exchanged, in the lines {lines} below `cells:` of the columns file (`array:` has no such lines: write `cells:`); "
        f"without a columns file exchange the headers, such as {names[exchanged[0].cell]}.reading"
    )
    yield find("exchanged_cells", "reading", text)


@check("error", "other_gain")
def other_gains(s: CellSet) -> Iterator[tuple[str, Finding]]:
    """Recordings whose gain is ``FACTOR`` times that of the others or more, or as much less: name, and error.

    The reference is the recording with the median gain, the earlier one if two are in the middle. A bent law gives low presses
    other gains, but equal readings at equal loads; so the ratio must also show in rows up to the same load or up to the same
    reading, where these can be compared. A wrong factor F on the load of y = f^p shows as F among the latter, as F^p among the
    former.
    """
    sums = [_sums(s.config, m, ~s.dead) for m in s.recordings]
    gains = np.array([_gain(*own) for own in sums])
    known = np.flatnonzero(np.isfinite(gains))
    if len(known) < 2:
        return
    order = known[np.argsort(gains[known], kind="stable")]
    middle = min(order[(len(order) - 1) // 2], order[len(order) // 2])
    for n in known:
        ratio = gains[n] / gains[middle]
        sizes = [
            float(np.log(r) * np.sign(np.log(ratio)))
            for r in _ratios(sums[n], sums[middle]) or [ratio]
        ]
        if min(abs(np.log(ratio)), max(sizes)) < np.log(FACTOR) or min(sizes) < np.log(
            SAME_WAY
        ):
            continue
        name, other = s.recordings[n].name, s.recordings[middle].name
        which = f"one of {name} and {other}" if len(known) == 2 else name
        text = (
            f"its gain, {gains[n]:.3g} {s.config.reading.unit} per {s.config.load.unit}, is {ratio:.3g} times that of {other}: "
            f"the load or the readings of {which} are in another unit. State its units in a columns file (load: {{column: …, "
            "unit: …}), or correct the file"
        )
        yield name, find("other_gain", "load", text)


def _sums(
    config: CellsConfig, m: CellMeasurement, live: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(T, S) load, reading from rest, and usable rows. Under a shared load S is 1, the mean of all live cells: it does not depend
    on the place of a probe; else S is the number of live cells."""
    load, reading, use = (
        m.target[:, live],
        config.sign * m.measured[:, live],
        below_end(config, m)[:, live],
    )
    if config.load.shared:
        load, reading, use = (
            load[:, :1],
            reading.mean(axis=1, keepdims=True),
            np.all(use, axis=1, keepdims=True),
        )
    rest = np.where(use & (load <= REST * np.max(load, axis=0)), reading, np.nan)
    level = np.array(
        [
            np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan
            for c in rest.T
        ]
    )
    return load, reading - level, use


def _gain(load: np.ndarray, reading: np.ndarray, use: np.ndarray) -> float:
    """Median gain of the columns that respond; NaN if none does."""
    shift = np.where(np.isfinite(reading), reading, 0.0)
    gain, correlation = slopes(load, shift, use & np.isfinite(reading))
    good = gain[(correlation > LINEAR) & (gain > 0)]
    return float(np.median(good)) if len(good) else np.nan


def _ratios(one: tuple, other: tuple) -> list[float]:
    """Ratios of the gains of two recordings in rows up to the same load, and up to the same reading; those that are known."""
    found = []
    for key in (0, 1):
        highest = np.minimum(
            *(np.where(s[2], s[key], -np.inf).max(axis=0) for s in (one, other))
        )
        gains = [_gain(s[0], s[1], s[2] & (s[key] <= highest)) for s in (one, other)]
        found.append(gains[0] / gains[1])
    return [r for r in found if np.isfinite(r)]


@check("warning", "uneven_load", needs="cells")
def uneven_load(s: CellSet) -> Iterator[Finding]:
    """Cells' shares of a shared load that differ between recordings or within one; not where each cell has its own load."""
    if (
        not s.config.load.shared
        or s.config.num_cells < 2
        or s.config.same_place_mm is not None
    ):
        return
    pieces, of, noise = [], [], 0.0
    for m in s.recordings:
        patterns, own = _patterns(s.config, m)
        pieces += patterns
        of += [m.name] * len(patterns)
        noise = max(noise, own)
    shares = np.array(pieces).reshape(-1, s.config.num_cells)  # (N, K)
    common = np.isfinite(shares).all(axis=0)
    if len(shares) < 2 or common.sum() < 2:
        return
    means = shares[:, common].mean(axis=1, keepdims=True)
    shares = shares[:, common] / np.where(means > 0, means, np.nan)
    least = max(UNEVEN, ABOVE_NOISE * noise)
    if not _change(shares) > least:
        return
    names = list(dict.fromkeys(of))
    within = [
        name for name in names if _change(shares[[o == name for o in of]]) > least
    ]
    where = f"within {listed(within)}" if within else f"between {listed(names)}"
    text = (
        f"the load is not shared alike by the cells: their shares change {where}, by {_change(shares):.2g} of the mean share "
        "(RMS). A probe that moves over the cells, or tilts, does this, and no effect describes it. State the probe's position "
        "(`position:` in the columns file, `same_place_mm:` in the cells file), or diagnose one place alone"
    )
    yield find("uneven_load", "load", text)


def _change(shares: np.ndarray) -> float:
    """RMS over cells and pieces of the deviation from the mean piece, of shares (N, K) whose mean over cells is 1."""
    return float(np.sqrt(np.nanmean(np.square(shares - np.nanmean(shares, axis=0)))))


def _patterns(
    config: CellsConfig, m: CellMeasurement
) -> tuple[list[np.ndarray], float]:
    """(K,) mean reading from rest of every cell in each piece of the pressed rows, NaN for cells at an end of the converter, and
    the variation of the readings at rest as a share of the mean pattern. No pieces without rest or press."""
    load, use = m.target[:, 0], below_end(config, m)
    pressed, rest = (
        np.flatnonzero(load > PRESSED * load.max()),
        load < REST * load.max(),
    )
    if len(pressed) < PIECES or rest.sum() < PIECES:
        return [], 0.0
    level = np.median(m.measured[rest], axis=0)
    found = [
        np.where(
            use[rows].all(axis=0),
            config.sign * (m.measured[rows].mean(axis=0) - level),
            np.nan,
        )
        for rows in np.array_split(pressed, PIECES)
    ]
    mean = float(np.nanmean(found)) if np.isfinite(found).any() else 0.0
    if mean <= 0:
        return [], 0.0
    return found, float(np.sqrt(np.mean(np.var(m.measured[rest], axis=0)))) / mean
