"""Checks of recordings of a sensor of cells. Each finding states the line to write or what to record instead."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from taccorl.alignment.checks.cell_gains import (
    DEAD,
    below_end,
    cell_shares,
    dead_finding,
    exchanged_cells,
    exchanged_finding,
    other_gains,
    uneven_load,
)
from taccorl.alignment.checks.cell_offsets import UNLOADED, falls_below_rest, other_offsets
from taccorl.alignment.checks.cell_plateau import plateaus
from taccorl.alignment.checks.cell_shift import shifted_loads
from taccorl.alignment.machines.cell_model import within_ends
from taccorl.alignment.machines.cell_places import place_findings
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import Finding

ERRORS = (
    *("other_rate", "load_held", "load_unit", "beyond_ends", "constant_load", "no_rest", "saturated", "no_reading"),
    *("wrong_sign", "other_gain", "exchanged_cells"),
)
"""Checks that can end in an error, and so can be accepted with ``--accept``."""
LOADED = 0.05
"""Share of the rated load above which a cell counts as loaded."""
REST_S = 0.5
"""Time without load that a set of recordings must have, for the offsets."""
CONSTANT = 0.05
"""A load whose variation is below this share of the rated load does not determine gain and law."""
MOST_CUT = 0.9
"""Share of the loaded rows at an end of the converter from which on a cell counts as always saturated."""
WRONG_WAY = -0.5
"""Correlation of load and reading, with the file's sign, below which the file's sign is wrong."""
RATE = 0.05
"""Largest share by which a recording's rate may differ from the file's."""
FEWEST_HELD, HELD = 3, 0.9
"""Load changes that lie at multiples of at least so many rows, in this share of cases, show that the load was recorded at a
lower rate and held."""
TOO_MUCH, TOO_LITTLE = 3.0, 0.02
"""Load as a multiple of the rated load above, or below, which its unit is probably wrong."""


def check_cells(
    config: CellsConfig, measurements: Sequence[CellMeasurement], fit_names: Sequence[str]
) -> dict[str, list[Finding]]:
    """Check the recordings of a sensor of cells. Returns recording → findings. A finding about all fit recordings together, and
    one about all recordings, is stored at the first of them.

    Args:
        fit_names: names of the fit recordings.
    """
    found = {m.name: [*m.findings, *_of_recording(config, m), *place_findings(config, m)] for m in measurements}
    together = [m for m in measurements if m.name in fit_names]
    if together:
        first, *others = together
        exchanged = exchanged_cells(config, measurements)
        wrong = _of_all(config, together, {e.cell for e in exchanged})
        found[first.name] += wrong
        for m in others:
            found[m.name] += [
                dataclasses.replace(f, text=f"{f.feature}: all fit recordings together, see {first.name}")
                for f in wrong
            ]
        for name, finding in other_gains(config, measurements).items():
            found[name].append(finding)
        found[first.name] += [
            *exchanged_finding(config, exchanged),
            *dead_finding(config, together),
            *uneven_load(config, measurements),
            *other_offsets(config, measurements),
            *falls_below_rest(config, measurements),
            *plateaus(config, measurements),
            *([] if exchanged else shifted_loads(config, measurements)),
        ]
    return found


def _of_recording(config: CellsConfig, m: CellMeasurement) -> list[Finding]:
    found = []
    if config.rate_hz is not None and abs(m.rate_hz / config.rate_hz - 1) > RATE:
        text = f"{m.rate_hz:g} rows a second; write `rate_hz: {m.rate_hz:g}` in the cells file, or check the unit of the time"
        found.append(Finding("other_rate", "error", "time", text))
    held = _held_rows(m)
    if held:
        text = (
            f"the load changes every {held} rows only: it was recorded at {m.rate_hz / held:g} Hz and the readings at "
            f"{m.rate_hz:g} Hz. Write the load on straight lines between its own samples (numpy.interp over its own times), or "
            f"keep every {held}. row"
        )
        found.append(Finding("load_held", "error", "load", text))
    high, unit, rated = float(np.max(m.target)), config.load.unit, config.load.rated
    if high > TOO_MUCH * rated:
        text = (
            f"the load reaches {high:.4g} {unit}, {high / rated:.3g} times the rated {rated:g} {unit}: is the column in another "
            "unit? Write it in a columns file, or correct `rated`"
        )
        found.append(Finding("load_unit", "error", "load", text))
    over = (m.measured > config.high + m.quantum) | (m.measured < config.low - m.quantum)
    if over.any():
        k = int(np.argmax(over.any(axis=0)))
        own, name = m.measured[:, k], m.signals[k]
        text = (
            f"{name}: readings are {own.min():.4g} … {own.max():.4g} {config.reading.unit}, beyond lowest {config.low:g} … "
            f"highest {config.high:g} of the cells file; correct these, or the unit"
        )
        found.append(Finding("beyond_ends", "error", name, text))
    return found


def _of_all(config: CellsConfig, measurements: Sequence[CellMeasurement], exchanged: set[int]) -> list[Finding]:
    """What all fit recordings together lack.

    Args:
        exchanged: cells whose columns are exchanged; the sign of their gain is not judged.
    """
    rated, unit = config.load.rated, config.load.unit
    load = np.concatenate([m.target for m in measurements])
    inside = np.concatenate([within_ends(config, m) for m in measurements])
    reading = np.concatenate([m.measured for m in measurements])
    period_s = measurements[0].period_s
    if (np.ptp(load, axis=0) < CONSTANT * rated).all():
        text = (
            f"the load of all fit recordings stays within {np.ptp(load):.3g} {unit}, {np.ptp(load) / rated:.1%} of the rated "
            f"{rated:g} {unit}: press and release, to three loads at least; or correct the unit of the load in a columns file"
        )
        return [Finding("constant_load", "error", "load", text)]
    found = []
    if float(load.max()) < TOO_LITTLE * rated:
        text = f"the load reaches {load.max():.3g} {unit} of {rated:g} {unit} rated: is the column in another unit?"
        found.append(Finding("load_unit", "error", "load", text))
    if ((load < UNLOADED * rated).sum(axis=0) * period_s < REST_S).any():
        text = (
            f"less than {REST_S:g} s without load (below {UNLOADED * rated:.3g} {unit}): offset and gain cannot be told apart. "
            "Record 2 s of nothing before and after each press; a load cell with an offset must be zeroed first"
        )
        found.append(Finding("no_rest", "error", "load", text))
    unclipped = np.concatenate([below_end(config, m) for m in measurements])
    weak = np.abs(cell_shares(config, measurements)) < DEAD
    for k, name in enumerate(config.names):
        loaded = load[:, k] > LOADED * rated
        cut = float(np.mean(~unclipped[loaded, k])) if loaded.any() else 0.0
        if cut > MOST_CUT:
            text = (
                f"{name}: {cut:.0%} of the loaded rows are at an end of the converter ({config.low:g} … "
                f"{config.high:g} {config.reading.unit}): press less, take a smaller resistor in the divider, or correct lowest "
                "and highest of the cells file"
            )
            found.append(Finding("saturated", "error", name, text))
            continue
        use = inside[:, k]
        if use.sum() < 3 or np.ptp(load[use, k]) == 0 or np.ptp(reading[use, k]) == 0:
            if loaded.any():
                text = (
                    f"{name}: the reading never changes under load: a broken wire, or the column of another channel; the search "
                    "leaves such a cell out with --accept=no_reading"
                )
                found.append(Finding("no_reading", "error", name, text))
            continue
        if (
            not weak[k]
            and k not in exchanged
            and config.sign * np.corrcoef(load[use, k], reading[use, k])[0, 1] < WRONG_WAY
        ):
            way, write = ("rises", "false") if config.reading.falls else ("falls", "true")
            text = f"{name}: the reading {way} under load; write `falls: {write}` below `reading:` in the cells file"
            found.append(Finding("wrong_sign", "error", name, text))
    return found


def _held_rows(m: CellMeasurement) -> int:
    """Rows for which every load is held; 0 if it changes from row to row."""
    changes = np.flatnonzero(np.any(np.diff(m.target, axis=0) != 0, axis=1)) + 1
    if len(changes) < 20:
        return 0
    steps = np.diff(changes)
    size = int(np.median(steps))
    if size < FEWEST_HELD or np.mean(np.abs(steps / size - np.round(steps / size)) < 1e-9) < HELD:
        return 0
    return size if np.mean(steps == size) > 0.5 else 0
