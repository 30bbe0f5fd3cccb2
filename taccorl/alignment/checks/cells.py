"""Checks of recordings of a sensor of cells. Each finding states the line to write or what to record instead."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from taccorl.alignment.checks.cell_gains import dead_finding, exchanged_cells, exchanged_finding, other_gains
from taccorl.alignment.checks.cell_readings import UNLOADED
from taccorl.alignment.checks.cell_set import DEAD, CellSet
from taccorl.alignment.checks.registry import CHECKS, check, find, run
from taccorl.alignment.machines.cell_model import within_ends
from taccorl.alignment.machines.cell_places import place_findings
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import Finding

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
    one about all recordings, is stored at the first of them. ``fit_names``: names of the fit recordings."""
    found = {m.name: [*m.findings, *_of_recording(config, m), *place_findings(config, m)] for m in measurements}
    fit, every = [m for m in measurements if m.name in fit_names], CellSet(config, measurements)
    if not fit:
        return found
    first, *others = (m.name for m in fit)
    exchanged = list(exchanged_finding(every))
    wrong = list(_together(CellSet(config, fit), {e.cell for e in exchanged_cells(every)}))
    found[first] += wrong
    for name in others:
        found[name] += [
            dataclasses.replace(f, text=f"{f.feature}: all fit recordings together, see {first}") for f in wrong
        ]
    for name, finding in other_gains(every):
        found[name].append(finding)
    explained = {name for f in exchanged for name in CHECKS[f.check].explains}
    found[first] += [*exchanged, *(f for f in warnings_of_all(config, fit, measurements) if f.check not in explained)]
    return found


def warnings_of_all(
    config: CellsConfig, fit: Sequence[CellMeasurement], measurements: Sequence[CellMeasurement]
) -> list[Finding]:
    """Warnings about the recordings together, of which the fit recordings show dead cells."""
    return [*dead_finding(CellSet(config, fit)), *run("cells", CellSet(config, measurements))]


@check("other_rate", "error")
@check("load_held", "error")
@check("load_unit", "error")
@check("beyond_ends", "error")
def _of_recording(config: CellsConfig, m: CellMeasurement) -> Iterator[Finding]:
    if config.rate_hz is not None and abs(m.rate_hz / config.rate_hz - 1) > RATE:
        text = f"{m.rate_hz:g} rows a second; write `rate_hz: {m.rate_hz:g}` in the cells file, or check the unit of the time"
        yield find("other_rate", "time", text)
    if held := _held_rows(m):
        text = (
            f"the load changes every {held} rows only: it was recorded at {m.rate_hz / held:g} Hz and the readings at "
            f"{m.rate_hz:g} Hz. Write the load on straight lines between its own samples (numpy.interp over its own times), or "
            f"keep every {held}. row"
        )
        yield find("load_held", "load", text)
    high, unit, rated = float(np.max(m.target)), config.load.unit, config.load.rated
    if high > TOO_MUCH * rated:
        text = (
            f"the load reaches {high:.4g} {unit}, {high / rated:.3g} times the rated {rated:g} {unit}: is the column in another "
            "unit? Write it in a columns file, or correct `rated`"
        )
        yield find("load_unit", "load", text)
    over = (m.measured > config.high + m.quantum) | (m.measured < config.low - m.quantum)
    if over.any():
        k = int(np.argmax(over.any(axis=0)))
        own, name = m.measured[:, k], m.signals[k]
        text = (
            f"{name}: readings are {own.min():.4g} … {own.max():.4g} {config.reading.unit}, beyond lowest {config.low:g} … "
            f"highest {config.high:g} of the cells file; correct these, or the unit"
        )
        yield find("beyond_ends", name, text)


@check("constant_load", "error")
@check("no_rest", "error")
@check("saturated", "error")
@check("no_reading", "error")
@check("wrong_sign", "error")
def _together(s: CellSet, exchanged: set[int]) -> Iterator[Finding]:
    """What all fit recordings together lack.
    ``exchanged``: cells whose columns are exchanged; the sign of their gain is not judged."""
    config, rated, unit = s.config, s.config.load.rated, s.config.load.unit
    load = np.concatenate([m.target for m in s.recordings])
    inside = np.concatenate([within_ends(config, m) for m in s.recordings])
    if (np.ptp(load, axis=0) < CONSTANT * rated).all():
        text = (
            f"the load of all fit recordings stays within {np.ptp(load):.3g} {unit}, {np.ptp(load) / rated:.1%} of the rated "
            f"{rated:g} {unit}: press and release, to three loads at least; or correct the unit of the load in a columns file"
        )
        yield find("constant_load", "load", text)
        return
    if float(load.max()) < TOO_LITTLE * rated:
        text = f"the load reaches {load.max():.3g} {unit} of {rated:g} {unit} rated: is the column in another unit?"
        yield find("load_unit", "load", text)
    if ((load < UNLOADED * rated).sum(axis=0) * s.recordings[0].period_s < REST_S).any():
        text = (
            f"less than {REST_S:g} s without load (below {UNLOADED * rated:.3g} {unit}): offset and gain cannot be told apart. "
            "Record 2 s of nothing before and after each press; a load cell with an offset must be zeroed first"
        )
        yield find("no_rest", "load", text)
    weak = np.abs(s.shares) < DEAD
    for k, name in enumerate(config.names):
        loaded, use = load[:, k] > LOADED * rated, inside[:, k]
        cut = float(np.mean(~s.free[loaded, k])) if loaded.any() else 0.0
        x, y = load[use, k], s.reading[use, k]
        if cut > MOST_CUT:
            text = (
                f"{name}: {cut:.0%} of the loaded rows are at an end of the converter ({config.low:g} … "
                f"{config.high:g} {config.reading.unit}): press less, take a smaller resistor in the divider, or correct lowest "
                "and highest of the cells file"
            )
            yield find("saturated", name, text)
        elif use.sum() < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
            if loaded.any() and not s.dead[k]:  # which is a warning where others respond
                text = (
                    f"{name}: the reading never changes under load: a broken wire, or the column of another channel; the search "
                    "leaves such a cell out with --accept=no_reading"
                )
                yield find("no_reading", name, text)
        elif not weak[k] and k not in exchanged and config.sign * np.corrcoef(x, y)[0, 1] < WRONG_WAY:
            way, write = ("rises", "false") if config.reading.falls else ("falls", "true")
            text = f"{name}: the reading {way} under load; write `falls: {write}` below `reading:` in the cells file"
            yield find("wrong_sign", name, text)


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
