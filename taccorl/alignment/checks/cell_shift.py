"""Loads of a grid of cells that were computed for another place than that of the contact.

Where a contact is off by s cells, each cell has the load of the point s beside it: f(x − s) ≈ f − s ∂f/∂x. What a reading leaves
of its own load then follows the difference of the two neighbours' loads; crosstalk follows their sum.

Letters in shapes: T rows of all recordings, R × C the grid.
"""

from collections.abc import Sequence

import numpy as np

from taccorl.alignment.checks.cell_gains import below_end, dead_cells
from taccorl.alignment.machines.cell_model import calibrated, loads
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import Finding

EXPLAINED, TIMES_BLUR = 0.5, 2.0
"""A shift is reported if it explains this share of what the own loads leave of the readings, and so many times what crosstalk
does. A choice: in simulated arrays a contact 1 mm off, at a pitch of 3 mm, explained 0.95 and more, crosstalk alone 0.07, and
neither 0."""


def shift_of_loads(
    config: CellsConfig, measurements: Sequence[CellMeasurement]
) -> tuple[float, float, float, float] | None:
    """Rows and columns by which the loads act farther on than stated, and the shares of what the own loads leave of the readings
    that this shift, and crosstalk to the four neighbours, explain. Of inner cells, by least squares beside a gain, an offset and
    a delay of each. None without a grid of 3 × 3 cells with loads of their own, or where nothing is left."""
    rows, columns = config.shape
    if config.load.shared or min(rows, columns) < 3:
        return None
    pairs = [(loads(m), np.where(below_end(config, m), m.measured, np.nan)) for m in measurements]
    found, dead = calibrated(config, pairs), dead_cells(config, measurements)
    load = np.concatenate([load for load, _ in pairs])
    rate = np.concatenate(
        [np.gradient(load, m.period_s, axis=0) for m, (load, _) in zip(measurements, pairs, strict=True)]
    )
    measured = np.concatenate([reading for _, reading in pairs])
    f = load.reshape(-1, rows, columns)
    terms, left = [], []
    for k in np.flatnonzero(~dead & (config.sign * found.gain > 0)):
        i, j = divmod(int(k), columns)
        if not (0 < i < rows - 1 and 0 < j < columns - 1):
            continue
        above, below, before, after = f[:, i - 1, j], f[:, i + 1, j], f[:, i, j - 1], f[:, i, j + 1]
        blur = (above + below + before + after) / 4 - f[:, i, j]
        rest = (measured[:, k] - found.offset[k]) / found.gain[k] - load[:, k]
        own = np.column_stack([np.ones(len(load)), load[:, k], rate[:, k]])
        both = np.column_stack([(above - below) / 2, (before - after) / 2, blur, rest])
        used = np.isfinite(rest)
        both = both[used] - own[used] @ np.linalg.lstsq(own[used], both[used], rcond=None)[0]
        terms.append(both[:, :3])
        left.append(both[:, 3])
    if not terms or not (power := float(np.square(np.concatenate(left)).mean())):
        return None
    given, rest = np.concatenate(terms), np.concatenate(left)

    def explained(some: list[int]) -> float:
        fitted = given[:, some] @ np.linalg.lstsq(given[:, some], rest, rcond=None)[0]
        return 1 - float(np.square(rest - fitted).mean()) / power

    down, right, _ = np.linalg.lstsq(given, rest, rcond=None)[0].tolist()
    return down, right, explained([0, 1]), explained([2])


def shifted_loads(config: CellsConfig, measurements: Sequence[CellMeasurement]) -> list[Finding]:
    """A warning if the loads act at another place than stated; empty if they do not, or if it cannot be told."""
    found = shift_of_loads(config, measurements)
    if found is None or found[2] < max(EXPLAINED, TIMES_BLUR * found[3]):
        return []
    down, right, share, blur = found
    text = (
        f"the loads act {down:+.2f} rows and {right:+.2f} columns farther on than stated: this shift explains {share:.0%} of "
        f"what the cells' own loads leave of the readings, crosstalk {blur:.0%}. No effect describes it, and taxel_crosstalk "
        "may stand in for it. Correct the place from which the loads of the cells were computed"
    )
    return [Finding("shifted_loads", "warning", "load", text)]
