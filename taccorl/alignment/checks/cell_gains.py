"""Gains of cells and recordings, compared with each other: cells that hardly respond, cells whose columns are exchanged,
recordings in another unit, and a shared load whose share of each cell changes. Only ratios of gains are judged, so nothing here
needs the gains of the cells file.

Letters in shapes: T rows, K cells, S sums or cells, N pieces of recordings.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from taccorl.alignment.machines.cell_model import calibrated, loads
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import Finding, listed

DEAD = 0.05
"""Share of the usual gain, that of the median cell which responds, below which a cell hardly responds."""
RESPONDS = 0.5
"""Correlation of load and reading from which on a cell responds."""
AS_LOADED = 0.5
"""A cell is judged only if its load reaches this share of the largest load of any cell: a cell with less may have a threshold."""
CLEAR = 3.0
"""A cell is judged only if the usual gain would have changed its reading by so many standard deviations of the rest of it."""
EXCHANGED = 4.0
"""Cells are exchanged if the load of another cell leaves less than one part in so many of a reading's variance that the own load
leaves. A choice: with columns in order the own load left less than every other in all simulated arrays, also with crosstalk of
0.15, hysteresis, saturation, and a contact 1 mm off its stated place."""
FACTOR = 3.0
"""Ratio of the gains of two recordings from which on one of them has another unit."""
SAME_WAY = 1.2
"""Both in rows up to the same load and up to the same reading the gains must differ by this factor, in the same direction."""
LINEAR = 0.7
"""Correlation of load and reading from which on a recording's gain is known well enough for ``FACTOR``: noise of the load lowers
a gain by the square of this at most."""
PRESSED, REST = 0.3, 0.05
"""Shares of a recording's largest load above which it is pressed, and below which it rests."""
PIECES = 8
"""Number of pieces into which the pressed rows of a recording are divided."""
UNEVEN = 0.3
"""Change of the cells' shares of the load, RMS over cells in units of the mean share, from which on a load is not shared alike.
A choice: simulated arrays whose cells saturate at limits that differ by 40 % change their shares by 0.07 at most."""
ABOVE_NOISE = 5.0
"""The change of shares must be so many times that which the readings' variation at rest explains."""


def below_end(config: CellsConfig, m: CellMeasurement) -> np.ndarray:
    """(T, K) bool: the reading is not at that end of the converter to which a load drives it. Readings without load may lie at
    the other end."""
    end = config.high if config.sign > 0 else config.low
    return config.sign * (end - m.measured) > 0.5 * m.quantum + 1e-9 * np.abs(m.measured)


def slopes(x: np.ndarray, y: np.ndarray, use: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares slope of each column of ``y`` over that of ``x``, and their correlation, both (S,), in the rows that ``use``
    marks, all (T, S); NaN where nothing changes."""
    count = np.maximum(use.sum(axis=0), 1)
    dx, dy = (np.where(use, v - np.where(use, v, 0.0).sum(axis=0) / count, 0.0) for v in (x, y))
    xx, yy, xy = (dx * dx).sum(axis=0), (dy * dy).sum(axis=0), (dx * dy).sum(axis=0)
    known = (xx > 1e-18 * np.square(x).sum(axis=0)) & (yy > 1e-18 * np.square(y).sum(axis=0)) & (count > 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(known, xy / xx, np.nan), np.where(known, xy / np.sqrt(xx * yy), np.nan)


def cell_shares(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> np.ndarray:
    """(K,) gain of each cell over all recordings together, as a multiple of the usual gain, that of the median responding cell.
    A negative one is of the wrong sign. NaN for cells that cannot be judged: those whose load is small, or whose readings vary
    more than the usual gain would change them; all are NaN if fewer than two cells are loaded or none responds."""
    if config.same_place_mm is not None:
        return _shares_by_place(config, measurements)
    load, reading = (np.concatenate([getattr(m, key) for m in measurements]) for key in ("target", "measured"))
    use = np.concatenate([below_end(config, m) for m in measurements])
    stuck = np.ptp(reading, axis=0) == 0
    use[:, stuck] = True  # a reading that never changes is no clipped one
    gain, correlation = slopes(load, reading, use)
    gain, correlation = config.sign * np.where(stuck, 0.0, gain), config.sign * correlation
    peak = load.max(axis=0)
    loaded = (peak > 0) & (peak >= AS_LOADED * peak.max()) & np.isfinite(gain)
    responds = loaded & (correlation > RESPONDS)
    if loaded.sum() < 2 or not responds.any():
        return np.full(len(gain), np.nan)
    usual = float(np.median(gain[responds]))
    change, spread = (np.nanstd(np.where(use, v, np.nan), axis=0) for v in (load, reading))
    rest = spread * np.sqrt(1 - np.square(np.nan_to_num(correlation)))
    return np.where(loaded & (responds | (usual * change > CLEAR * rest)), gain / usual, np.nan)


def _shares_by_place(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> np.ndarray:
    """(K,) gain of each cell at the place where it responds most, as a multiple of that of the median cell."""
    pairs = [
        (loads(m), np.where(below_end(config, m) & (m.place >= 0)[:, None], m.measured, np.nan)) for m in measurements
    ]
    gain = np.max(config.sign * calibrated(config, pairs).gain, axis=1)
    usual = float(np.median(gain[gain > 0])) if (gain > 0).any() else np.nan
    return gain / usual


def dead_cells(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> np.ndarray:
    """(K,) bool: cells that ``measurements`` load as the others but whose gain is below ``DEAD`` times the usual one, or of the
    wrong sign."""
    return cell_shares(config, measurements) < DEAD  # NaN is not


def dead_finding(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> list[Finding]:
    """A warning that names the dead cells; empty if there are none."""
    shares = cell_shares(config, measurements)
    dead = np.flatnonzero(shares < DEAD)
    if not len(dead):
        return []
    named = [f"{config.names[k]} ({float(shares[k]):.1%})" for k in dead]
    what = "dead, or not touched by the load that all cells share" if config.load.shared else "dead, or not connected"
    text = (
        f"{len(dead)} of {config.num_cells} cells hardly respond: {listed(named, 12)} of the usual gain; {what}. They take no "
        "part in the search, and a corrected file has the gain 0 for them"
    )
    return [Finding("dead_cells", "warning", "reading", text)]


class Exchanged(NamedTuple):
    """A cell whose reading follows the load of another cell."""

    cell: int
    """Number of the cell."""
    load_of: int
    """Number of the cell whose load its reading follows."""
    own: float
    """Share of the reading's variance that a fit to its own load leaves."""
    other: float
    """The same of the load of ``load_of``."""


def exchanged_cells(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> list[Exchanged]:
    """Cells whose readings follow each other's loads ``EXCHANGED`` times better than their own: pairs, or longer cycles. Empty if
    there are none, or where cells share one load.

    Each reading is fitted by each load, with a gain and an offset, over all recordings together; readings are assigned to loads
    so that the sum of log (share of the variance that remains) is least (maximum likelihood of normal residuals).
    """
    if config.load.shared or config.num_cells < 2:
        return []
    remains = _remains(config, measurements)
    load_of = linear_sum_assignment(np.log(remains))[1].tolist()
    found, seen = [], set()
    for k in range(config.num_cells):
        cycle = []
        while k not in seen:
            seen.add(k)
            cycle.append(Exchanged(k, load_of[k], float(remains[k, k]), float(remains[k, load_of[k]])))
            k = load_of[k]
        if all(e.own > EXCHANGED * e.other for e in cycle):
            found += cycle
    return found


def _remains(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> np.ndarray:
    """(K, K) share of the variance of each reading (rows) that remains after a fit of gain and offset to each load (columns); 1
    where the gain has the wrong sign, or nothing changes. At least 1e-9."""
    load, reading = (np.concatenate([getattr(m, key) for m in measurements]) for key in ("target", "measured"))
    use = np.concatenate([below_end(config, m) for m in measurements])
    count = np.maximum(use.sum(axis=0), 1)
    off = np.where(use, reading - np.where(use, reading, 0.0).sum(axis=0) / count, 0.0)
    load = load - load.mean(axis=0)
    rows = use.T.astype(float)
    power = rows @ np.square(load) - np.square(rows @ load) / count[:, None]
    product, variance = config.sign * (off.T @ load), np.square(off).sum(axis=0)[:, None]
    known = (power > 1e-9 * np.square(load).sum(axis=0)) & (variance > 0) & (product > 0)
    explained = np.divide(np.square(product), power * variance, out=np.zeros(product.shape), where=known)
    return np.maximum(1.0 - explained, 1e-9)


def exchanged_finding(config: CellsConfig, exchanged: Sequence[Exchanged]) -> list[Finding]:
    """An error that names the cells whose columns are exchanged; empty if there are none."""
    if not exchanged:
        return []
    names = config.names
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
    return [Finding("exchanged_cells", "error", "reading", text)]


def other_gains(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> dict[str, Finding]:
    """Recordings whose gain is ``FACTOR`` times that of the others or more, or as much less: name → error.

    The reference is the recording with the median gain, the earlier one if two are in the middle. A bent law gives low presses
    other gains, but equal readings at equal loads; so the ratio must also show in rows up to the same load or up to the same
    reading, where these can be compared. A wrong factor F on the load of y = f^p shows as F among the latter, as F^p among the
    former.
    """
    dead = dead_cells(config, measurements)
    sums = [_sums(config, m, ~dead) for m in measurements]
    gains = np.array([_gain(*s) for s in sums])
    known = np.flatnonzero(np.isfinite(gains))
    if len(known) < 2:
        return {}
    order = known[np.argsort(gains[known], kind="stable")]
    middle = min(order[(len(order) - 1) // 2], order[len(order) // 2])
    found = {}
    for n in known:
        ratio = gains[n] / gains[middle]
        sizes = [float(np.log(r) * np.sign(np.log(ratio))) for r in _ratios(sums[n], sums[middle]) or [ratio]]
        if min(abs(np.log(ratio)), max(sizes)) < np.log(FACTOR) or min(sizes) < np.log(SAME_WAY):
            continue
        m, other = measurements[n], measurements[middle].name
        unit, load = config.reading.unit, config.load.unit
        which = f"one of {m.name} and {other}" if len(known) == 2 else m.name
        text = (
            f"its gain, {gains[n]:.3g} {unit} per {load}, is {ratio:.3g} times that of {other}: the load or the readings of "
            f"{which} are in another unit. State its units in a columns file (load: {{column: …, unit: …}}), or correct the file"
        )
        found[m.name] = Finding("other_gain", "error", "load", text)
    return found


def _sums(config: CellsConfig, m: CellMeasurement, live: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(T, S) load, reading from rest, and usable rows. Under a shared load S is 1, the mean of all live cells: it does not depend
    on the place of a probe; else S is the number of live cells."""
    load, reading, use = m.target[:, live], config.sign * m.measured[:, live], below_end(config, m)[:, live]
    if config.load.shared:
        load, reading, use = (
            load[:, :1],
            reading.mean(axis=1, keepdims=True),
            np.all(use, axis=1, keepdims=True),
        )
    rest = np.where(use & (load <= REST * np.max(load, axis=0)), reading, np.nan)
    level = np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan for c in rest.T])
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
        highest = np.minimum(*(np.where(s[2], s[key], -np.inf).max(axis=0) for s in (one, other)))
        gains = [_gain(s[0], s[1], s[2] & (s[key] <= highest)) for s in (one, other)]
        found.append(gains[0] / gains[1])
    return [r for r in found if np.isfinite(r)]


def uneven_load(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> list[Finding]:
    """A warning if the cells' shares of a shared load differ between recordings or within one; empty if they do not, or if each
    cell has its own load."""
    if not config.load.shared or config.num_cells < 2 or config.same_place_mm is not None:
        return []
    pieces, of, noise = [], [], 0.0
    for m in measurements:
        patterns, own = _patterns(config, m)
        pieces += patterns
        of += [m.name] * len(patterns)
        noise = max(noise, own)
    if len(pieces) < 2:
        return []
    shares = np.array(pieces)  # (N, K)
    common = np.isfinite(shares).all(axis=0)
    if common.sum() < 2:
        return []
    means = shares[:, common].mean(axis=1, keepdims=True)
    shares = shares[:, common] / np.where(means > 0, means, np.nan)
    least = max(UNEVEN, ABOVE_NOISE * noise)
    if not _change(shares) > least:
        return []
    names = list(dict.fromkeys(of))
    within = [name for name in names if _change(shares[[o == name for o in of]]) > least]
    where = f"within {listed(within)}" if within else f"between {listed(names)}"
    text = (
        f"the load is not shared alike by the cells: their shares change {where}, by {_change(shares):.2g} of the mean share "
        "(RMS). A probe that moves over the cells, or tilts, does this, and no effect describes it. State the probe's position "
        "(`position:` in the columns file, `same_place_mm:` in the cells file), or diagnose one place alone"
    )
    return [Finding("uneven_load", "warning", "load", text)]


def _change(shares: np.ndarray) -> float:
    """RMS over cells and pieces of the deviation from the mean piece, of shares (N, K) whose mean over cells is 1."""
    return float(np.sqrt(np.nanmean(np.square(shares - np.nanmean(shares, axis=0)))))


def _patterns(config: CellsConfig, m: CellMeasurement) -> tuple[list[np.ndarray], float]:
    """(K,) mean reading from rest of every cell in each piece of the pressed rows, NaN for cells at an end of the converter, and
    the variation of the readings at rest as a share of the mean pattern. No pieces without rest or press."""
    load, use = m.target[:, 0], below_end(config, m)
    pressed, rest = np.flatnonzero(load > PRESSED * load.max()), load < REST * load.max()
    if len(pressed) < PIECES or rest.sum() < PIECES:
        return [], 0.0
    level = np.median(m.measured[rest], axis=0)
    found = [
        np.where(use[rows].all(axis=0), config.sign * (m.measured[rows].mean(axis=0) - level), np.nan)
        for rows in np.array_split(pressed, PIECES)
    ]
    mean = float(np.nanmean(found)) if np.isfinite(found).any() else 0.0
    if mean <= 0:
        return [], 0.0
    return found, float(np.sqrt(np.mean(np.var(m.measured[rest], axis=0)))) / mean
