"""Readings of cells that stop below the end of the converter while the load goes on: the end of an amplifier or of a divider.

Letters in shapes: T rows, K cells.
"""

from collections.abc import Sequence

import numpy as np

from taccorl.alignment.checks.cell_gains import below_end
from taccorl.alignment.machines.cell_model import loads
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import Finding, listed

LEAST_ROWS, TOP = 20, 0.005
"""The highest reading of a cell is taken as the reading that this share of its rows exceeds, and at least this number of rows,
so that single outliers do not count."""
WIDTH = 4.0
"""Rows within so many standard deviations of the noise of the highest reading may be on a plateau."""
LONG = 10.0
"""A plateau is so many of its own widths long: by as much the reading would have risen with the load, at the gain below it. The
smooth law f / (1 + f / f_s) has one only if pressed with more than ten times f_s."""
ALL = 0.9
"""Share of the rows with the loads of a plateau that are on it. With lag or hysteresis only those of a release are."""


def plateaus(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> list[Finding]:
    """Check whether readings of cells stop rising, but for their noise, while the load still rises, at a level that is not an end
    of the converter's range. Returns one warning, or nothing; nothing with ``same_place_mm``, where the load of a cell depends on
    the place."""
    if config.same_place_mm is not None:
        return []
    load = np.concatenate([loads(m) for m in measurements])
    reading = config.sign * np.concatenate([m.measured for m in measurements])
    free = np.concatenate([below_end(config, m) for m in measurements])
    step = np.max([m.quantum for m in measurements], axis=0) / np.sqrt(12)
    noise = np.maximum(_noise([m.measured for m in measurements]), np.maximum(step, 1e-12))
    found: list[tuple[int, np.ndarray, float, float]] = []  # cell, its readings and first and last load on the plateau
    for k in range(config.num_cells):
        x, y = load[free[:, k], k], reading[free[:, k], k]
        if len(y) < 2 * LEAST_ROWS:
            continue
        level = np.sort(y)[-max(LEAST_ROWS, round(TOP * len(y)))]
        on = y > level - WIDTH * noise[k]
        if len(y) - on.sum() < LEAST_ROWS or np.ptp(x[~on]) == 0:
            continue
        first, last = np.quantile(x[on], (0.05, 0.95))
        gain = float(np.polyfit(x[~on], y[~on], 1)[0])
        if gain * (last - first) > LONG * 2 * WIDTH * noise[k] and np.mean(on[x >= first]) > ALL:
            found.append((k, config.sign * y[on], float(first), float(last)))
    if not found:
        return []
    unit, of_load = config.reading.unit, config.load.unit
    levels = [float(np.median(y)) for _, y, _, _ in found]
    first, last = (float(np.median(x)) for x in ([f[2] for f in found], [f[3] for f in found]))
    one = len(set(levels)) == 1 and all(np.mean(y == levels[0]) > ALL for _, y, _, _ in found)
    key, end = ("highest", config.high) if config.sign > 0 else ("lowest", config.low)
    at = f"{min(levels):.5g}" if one else f"{min(levels):.5g} … {max(levels):.5g}"
    way = (
        f"write `{key}: {levels[0]:.7g}` below `reading:` in the cells file"
        if one
        else f"raise that end, or leave out presses beyond {min(f[2] for f in found):.3g} {of_load}: a fit takes it for "
        "`taxel_saturation`, which has no such kink"
    )
    text = (
        f"the readings of {len(found)} of {config.num_cells} cells ({listed([config.names[k] for k, *_ in found], 4)}) stop at "
        f"{at} {unit} while the load goes on from {first:.3g} to {last:.3g} {of_load} (medians of these cells); {key} of the "
        f"cells file is {end:g}. An amplifier or a divider ends there: {way}"
    )
    return [Finding("plateau", "warning", "reading", text)]


def _noise(recordings: Sequence[np.ndarray]) -> np.ndarray:
    """(K,) noise of the readings from second differences of rows, whose variance is 6 times the noise's."""
    second = np.concatenate([np.diff(values, n=2, axis=0) for values in recordings])
    return 1.4826 * np.median(np.abs(second), axis=0) / np.sqrt(6)
