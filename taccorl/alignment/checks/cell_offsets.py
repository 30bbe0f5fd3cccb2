"""Readings of cells without load: offsets that differ between recordings, and readings that fall below those before a press.

Letters in shapes: T rows, K cells, N recordings.
"""

from collections.abc import Sequence

import numpy as np

from taccorl.alignment.checks.cell_gains import below_end, dead_cells
from taccorl.alignment.machines.cell_model import calibrated, loads
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import Finding, listed
from taccorl.data.timing import runs

FIRST_S, LEAST_S = 1.0, 0.3
"""The offset of a recording is that of its rows without load in the first so many seconds, and of at least the second number: at
the same time in all recordings, so that a drift within them makes no difference, and before any press, so that none creeps on."""
UNLOADED = 0.02
"""Share of the rated load below which a cell counts as unloaded."""
OTHER_OFFSET = 5.0
"""Offsets differ from this number of standard deviations of the unloaded readings on. A choice: those of clean simulated
recordings differ by 0.7 at most."""
RELEASED_S, LONG_S = (0.1, 0.4), 1.0
"""The readings just after a release are those of this stretch of time after it, where nothing presses for the second number."""
RETURNS = 0.3
"""Least share of a fall below rest that is gone at the end of the rest: relaxation returns, a drift does not."""


def other_offsets(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> list[Finding]:
    """A warning if the offsets of cells differ between recordings without a temperature; empty if they do not, or if all
    recordings have a temperature.

    An offset is the median reading less gain times load; the gain is the least-squares one over all recordings.
    """
    unloaded = [(m, rows) for m in measurements if len(rows := _first_unloaded(config, m))]
    if len(unloaded) < 2 or all(m.temperature_c.size for m in measurements):
        return []
    at_rest = _without_load(config, measurements)
    rests = [at_rest[m.name][rows] for m, rows in unloaded]
    offset = np.array([np.median(rest, axis=0) for rest in rests])  # (N, K)
    step = np.max([m.quantum for m, _ in unloaded], axis=0) / np.sqrt(12)
    noise = np.maximum(np.sqrt(np.mean([np.var(rest, axis=0) for rest in rests], axis=0)), np.maximum(step, 1e-12))
    widest = int(np.argmax(np.ptp(offset, axis=0) / noise))
    one, other = sorted((int(np.argmin(offset[:, widest])), int(np.argmax(offset[:, widest]))))
    change = offset[other] - offset[one]
    differ = np.flatnonzero(np.abs(change) > OTHER_OFFSET * noise)
    if not len(differ):
        return []
    typical, floors = float(np.median(change[differ])), float(np.median(np.abs(change / noise)[differ]))
    text = (
        f"the offset of {len(differ)} of {config.num_cells} cells ({listed([config.names[k] for k in differ], 4)}) differs "
        f"between recordings {unloaded[one][0].name} and {unloaded[other][0].name}, by {typical:+.3g} {config.reading.unit}, "
        f"{floors:.3g} times the noise at rest (medians of these cells). The model has one offset for all recordings. Record "
        "the temperature (`temperature:` in the columns file) if the sensor warms up; or subtract from the readings of each "
        "recording their mean before its first press"
    )
    return [Finding("other_offset", "warning", "reading", text)]


def falls_below_rest(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> list[Finding]:
    """A warning if readings fall below their level before the first press when a load is released, and return: the model of creep
    must then act below rest. Empty if they do not, or if the cells file says so (``below_rest``)."""
    if config.reading.below_rest:
        return []
    at_rest = _without_load(config, measurements)
    falls: list[np.ndarray] = []  # (K,) of every release, in standard deviations of the noise
    returns: list[np.ndarray] = []  # (K,) share of each fall that is gone at the end of the rest
    for m in measurements:
        first = _first_unloaded(config, m)
        if not len(first):
            continue
        off = config.sign * (at_rest[m.name] - np.median(at_rest[m.name][first], axis=0))
        noise = np.maximum(np.std(off[first], axis=0), np.maximum(m.quantum / np.sqrt(12), 1e-12))
        for begin, end in runs(np.asarray((m.target < UNLOADED * config.load.rated).all(axis=1))):
            early, late = (begin + round(s * m.rate_hz) for s in RELEASED_S)
            if begin == 0 or end - begin < LONG_S * m.rate_hz or late == early:
                continue
            fall = -np.mean(off[early:late], axis=0)
            falls.append(fall / noise)
            returns.append(1 + np.mean(off[end - (late - early) : end], axis=0) / np.maximum(fall, noise))
    if not falls:
        return []
    fall, back = np.median(falls, axis=0), np.median(returns, axis=0)
    cells = np.flatnonzero((fall > OTHER_OFFSET) & (back > RETURNS) & ~dead_cells(config, measurements))
    if not len(cells):
        return []
    text = (
        f"after releases the readings of {len(cells)} of {config.num_cells} cells "
        f"({listed([config.names[k] for k in cells], 4)}) are beyond those before the first press, on the side away from a load, "
        f"by {float(np.median(fall[cells])):.3g} times the noise at rest (median), and return: the cells relax. Write "
        "`below_rest: true` below `reading:` in the cells file; creep is then not limited to readings above rest"
    )
    return [Finding("falls_below_rest", "warning", "reading", text)]


def _without_load(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> dict[str, np.ndarray]:
    """Recording → (T, K) readings less gain times load, with the least-squares gain over all recordings."""
    pairs = [(loads(m), np.where(below_end(config, m), m.measured, np.nan)) for m in measurements]
    gain = calibrated(config, pairs).gain
    return {m.name: m.measured - (loads(m) * gain if gain.ndim == 1 else loads(m) @ gain.T) for m in measurements}


def _first_unloaded(config: CellsConfig, m: CellMeasurement) -> np.ndarray:
    """Numbers of the rows of the first ``FIRST_S`` before any load; empty if they are less than ``LEAST_S``."""
    loaded = np.flatnonzero((m.target > UNLOADED * config.load.rated).any(axis=1))
    end_s = min(FIRST_S, float(m.time_s[loaded[0]] - m.time_s[0]) if len(loaded) else FIRST_S)
    return np.flatnonzero(m.time_s - m.time_s[0] < end_s) if end_s >= LEAST_S else np.empty(0, dtype=int)
