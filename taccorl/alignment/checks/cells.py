"""Checks of recordings of a sensor of cells. Each finding states the line to write or what to record instead: also offsets that
differ between recordings, readings that fall below those before a press or stop below the end of the converter, and loads of a
grid that were computed for another place than that of the contact.

Letters in shapes: T rows, K cells, N recordings.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from taccorl.alignment.checks.cell_gains import (
    dead_finding,
    exchanged_cells,
    exchanged_finding,
    other_gains,
)
from taccorl.alignment.checks.cell_set import DEAD, CellSet
from taccorl.alignment.checks.registry import CHECKS, check, find, run
from taccorl.alignment.machines.cell_model import loads, within_ends
from taccorl.alignment.machines.cell_places import place_findings
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import Finding
from taccorl.data.timing import runs

LOADED = 0.05  # Share of the rated load above which a cell counts as loaded
REST_S = 0.5  # Time without load that a set of recordings must have, for the offsets
CONSTANT = 0.05  # A load whose variation is below this share of the rated load does not determine gain and law
MOST_CUT = 0.9  # Share of the loaded rows at an end of the converter from which on a cell counts as always saturated
WRONG_WAY = -0.5  # Correlation of load and reading, with the file's sign, below which the file's sign is wrong
RATE = 0.05  # Largest share by which a recording's rate may differ from the file's
FEWEST_HELD, HELD = 3, 0.9
"""Load changes that lie at multiples of at least so many rows, in this share of cases, show that the load was recorded at a
lower rate and held."""
TOO_MUCH, TOO_LITTLE = 3.0, 0.02
"""Load as a multiple of the rated load above, or below, which its unit is probably wrong."""


def check_cells(
    config: CellsConfig,
    measurements: Sequence[CellMeasurement],
    fit_names: Sequence[str],
) -> dict[str, list[Finding]]:
    """Check the recordings of a sensor of cells. Returns recording → findings. A finding about all fit recordings together, and
    one about all recordings, is stored at the first of them. ``fit_names``: names of the fit recordings."""
    found = {
        m.name: [*m.findings, *_of_recording(config, m), *place_findings(config, m)]
        for m in measurements
    }
    fit, every = (
        [m for m in measurements if m.name in fit_names],
        CellSet(config, measurements),
    )
    if not fit:
        return found
    first, *others = (m.name for m in fit)
    exchanged = list(exchanged_finding(every))
    wrong = list(
        _together(CellSet(config, fit), {e.cell for e in exchanged_cells(every)})
    )
    found[first] += wrong
    together = f"all fit recordings together, see {first}"
    for name in others:
        found[name] += [
            dataclasses.replace(f, text=f"{f.feature}: {together}") for f in wrong
        ]
    for name, finding in other_gains(every):
        found[name].append(finding)
    explained = {name for f in exchanged for name in CHECKS[f.check].explains}
    found[first] += [
        *exchanged,
        *(
            f
            for f in warnings_of_all(config, fit, measurements)
            if f.check not in explained
        ),
    ]
    return found


def warnings_of_all(
    config: CellsConfig,
    fit: Sequence[CellMeasurement],
    measurements: Sequence[CellMeasurement],
) -> list[Finding]:
    """Warnings about the recordings together, of which the fit recordings show dead cells."""
    return [
        *dead_finding(CellSet(config, fit)),
        *run("cells", CellSet(config, measurements)),
    ]


@check("error", "other_rate", "load_held", "load_unit", "beyond_ends")
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
    over = (m.measured > config.high + m.quantum) | (
        m.measured < config.low - m.quantum
    )
    if over.any():
        k = int(np.argmax(over.any(axis=0)))
        own, name = m.measured[:, k], m.signals[k]
        text = (
            f"{name}: readings are {own.min():.4g} … {own.max():.4g} {config.reading.unit}, beyond lowest {config.low:g} … "
            f"highest {config.high:g} of the cells file; correct these, or the unit"
        )
        yield find("beyond_ends", name, text)


@check("error", "constant_load", "no_rest", "saturated", "no_reading")
@check("error", "wrong_sign", of_all=True)
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
    if (
        (load < UNLOADED * rated).sum(axis=0) * s.recordings[0].period_s < REST_S
    ).any():
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
            if (
                loaded.any() and not s.dead[k]
            ):  # which is a warning where others respond
                text = (
                    f"{name}: the reading never changes under load: a broken wire, or the column of another channel; the search "
                    "leaves such a cell out with --accept=no_reading"
                )
                yield find("no_reading", name, text)
        elif (
            not weak[k]
            and k not in exchanged
            and config.sign * np.corrcoef(x, y)[0, 1] < WRONG_WAY
        ):
            way, write = (
                ("rises", "false") if config.reading.falls else ("falls", "true")
            )
            text = f"{name}: the reading {way} under load; write `falls: {write}` below `reading:` in the cells file"
            yield find("wrong_sign", name, text)


def _held_rows(m: CellMeasurement) -> int:
    """Rows for which every load is held; 0 if it changes from row to row."""
    changes = np.flatnonzero(np.any(np.diff(m.target, axis=0) != 0, axis=1)) + 1
    if len(changes) < 20:
        return 0
    steps = np.diff(changes)
    size = int(np.median(steps))
    if (
        size < FEWEST_HELD
        or np.mean(np.abs(steps / size - np.round(steps / size)) < 1e-9) < HELD
    ):
        return 0
    return size if np.mean(steps == size) > 0.5 else 0


FIRST_S, LEAST_S = 1.0, 0.3
"""The offset of a recording is that of its rows without load in the first so many seconds, and of at least the second number: at
the same time in all recordings, so that a drift within them makes no difference, and before any press, so that none creeps on."""
UNLOADED = 0.02  # Share of the rated load below which a cell counts as unloaded
OTHER_OFFSET = 5.0
"""Offsets differ from this number of standard deviations of the unloaded readings on. A choice: those of clean simulated
recordings differ by 0.7 at most."""
RELEASED_S, LONG_S = (0.1, 0.4), 1.0
"""The readings just after a release are those of this stretch of time after it, where nothing presses for the second number."""
RETURNS = 0.3
"""Least share of a fall below rest that is gone at the end of the rest: relaxation returns, a drift does not."""
LEAST_ROWS, TOP = 20, 0.005
"""Share of a cell's rows, and least number of rows, whose readings are above what is taken as its highest reading, so that single
outliers do not count."""
WIDTH = 4.0  # Rows within so many standard deviations of the noise of the highest reading may be on a plateau
LONG = 10.0
"""A plateau is so many of its own widths long: by as much the reading would have risen with the load, at the gain below it. The
smooth law f / (1 + f / f_s) has one only if pressed with more than ten times f_s."""
ALL = 0.9
"""Share of the rows with the loads of a plateau that are on it. With lag or hysteresis only those of a release are."""
EXPLAINED, TIMES_BLUR = 0.5, 2.0
"""A shift is reported if it explains this share of what the own loads leave of the readings, and so many times what crosstalk
does. A choice: in simulated arrays a contact 1 mm off, at a pitch of 3 mm, explained 0.95 and more, crosstalk alone 0.07, and
neither 0."""


@check("warning", "other_offset", needs="cells")
def other_offsets(s: CellSet) -> Iterator[Finding]:
    """Offsets of cells that differ between recordings without a temperature.

    An offset is the median reading less gain times load; the gain is the least-squares one over all recordings."""
    unloaded = [(m, rows) for m in s.recordings if len(rows := _first_unloaded(s, m))]
    if len(unloaded) < 2 or all(m.temperature_c.size for m in s.recordings):
        return
    rests = [_without_load(s, m)[rows] for m, rows in unloaded]
    offset = np.array([np.median(rest, axis=0) for rest in rests])  # (N, K)
    step = np.maximum(
        np.max([m.quantum for m, _ in unloaded], axis=0) / np.sqrt(12), 1e-12
    )
    noise = np.maximum(
        np.sqrt(np.mean([np.var(rest, axis=0) for rest in rests], axis=0)), step
    )
    widest = int(np.argmax(np.ptp(offset, axis=0) / noise))
    one, other = sorted(
        (int(np.argmin(offset[:, widest])), int(np.argmax(offset[:, widest])))
    )
    change = offset[other] - offset[one]
    differ = np.flatnonzero(np.abs(change) > OTHER_OFFSET * noise)
    if not len(differ):
        return
    typical, floors = (
        float(np.median(change[differ])),
        float(np.median(np.abs(change / noise)[differ])),
    )
    text = (
        f"the offset of {s.some(differ)} differs between recordings {unloaded[one][0].name} and {unloaded[other][0].name}, by "
        f"{typical:+.3g} {s.config.reading.unit}, {floors:.3g} times the noise at rest (medians of these cells). The model has "
        "one offset for all recordings. Record the temperature (`temperature:` in the columns file) if the sensor warms up; or "
        "subtract from the readings of each recording their mean before its first press"
    )
    yield find("other_offset", "reading", text)


@check("warning", "falls_below_rest", needs="cells")
def falls_below_rest(s: CellSet) -> Iterator[Finding]:
    """Readings that fall below their level before the first press when a load is released, and return: the model of creep must
    then act below rest. Not where the cells file says so (``below_rest``)."""
    if s.config.reading.below_rest:
        return
    falls: list[
        np.ndarray
    ] = []  # (K,) of every release, in standard deviations of the noise
    returns: list[
        np.ndarray
    ] = []  # (K,) share of each fall that is gone at the end of the rest
    for m in s.recordings:
        first = _first_unloaded(s, m)
        if not len(first):
            continue
        rest = _without_load(s, m)
        off = s.config.sign * (rest - np.median(rest[first], axis=0))
        noise = np.maximum(
            np.std(off[first], axis=0), np.maximum(m.quantum / np.sqrt(12), 1e-12)
        )
        for begin, end in runs(
            np.asarray((m.target < UNLOADED * s.config.load.rated).all(axis=1))
        ):
            early, late = (begin + round(seconds * m.rate_hz) for seconds in RELEASED_S)
            if begin == 0 or end - begin < LONG_S * m.rate_hz or late == early:
                continue
            fall = -np.mean(off[early:late], axis=0)
            falls.append(fall / noise)
            returns.append(
                1
                + np.mean(off[end - (late - early) : end], axis=0)
                / np.maximum(fall, noise)
            )
    if not falls:
        return
    fall, back = np.median(falls, axis=0), np.median(returns, axis=0)
    cells = np.flatnonzero((fall > OTHER_OFFSET) & (back > RETURNS) & ~s.dead)
    if not len(cells):
        return
    text = (
        f"after releases the readings of {s.some(cells)} are beyond those before the first press, on the side away from a load, "
        f"by {float(np.median(fall[cells])):.3g} times the noise at rest (median), and return: the cells relax. Write "
        "`below_rest: true` below `reading:` in the cells file; creep is then not limited to readings above rest"
    )
    yield find("falls_below_rest", "reading", text)


def _without_load(s: CellSet, m: CellMeasurement) -> np.ndarray:
    """(T, K) readings of one recording less gain times load, with the least-squares gain over all recordings."""
    gain = s.calibration.gain
    return m.measured - (loads(m) * gain if gain.ndim == 1 else loads(m) @ gain.T)


def _first_unloaded(s: CellSet, m: CellMeasurement) -> np.ndarray:
    """Numbers of the rows of the first ``FIRST_S`` before any load; empty if they are less than ``LEAST_S``."""
    loaded = np.flatnonzero((m.target > UNLOADED * s.config.load.rated).any(axis=1))
    end_s = min(
        FIRST_S, float(m.time_s[loaded[0]] - m.time_s[0]) if len(loaded) else FIRST_S
    )
    return (
        np.flatnonzero(m.time_s - m.time_s[0] < end_s)
        if end_s >= LEAST_S
        else np.empty(0, dtype=int)
    )


@check("warning", "plateau", needs="cells")
def plateaus(s: CellSet) -> Iterator[Finding]:
    """Readings of cells that stop rising, but for their noise, while the load still rises, at a level that is not an end of the
    converter's range: the end of an amplifier or of a divider. Not with ``same_place_mm``, where a cell's load depends on the
    place. The noise is that of second differences of rows, whose variance is 6 times the noise's."""
    if s.config.same_place_mm is not None:
        return
    second = np.concatenate([np.diff(m.measured, n=2, axis=0) for m in s.recordings])
    noise = np.maximum(
        1.4826 * np.median(np.abs(second), axis=0) / np.sqrt(6), s.step_noise
    )
    found: list[
        tuple[int, np.ndarray, float, float]
    ] = []  # cell, its readings and first and last load on the plateau
    for k in range(s.config.num_cells):
        x, y = s.load[s.free[:, k], k], s.config.sign * s.reading[s.free[:, k], k]
        if len(y) < 2 * LEAST_ROWS:
            continue
        level = np.sort(y)[-max(LEAST_ROWS, round(TOP * len(y)))]
        on = y > level - WIDTH * noise[k]
        if len(y) - on.sum() < LEAST_ROWS or np.ptp(x[~on]) == 0:
            continue
        first, last = np.quantile(x[on], (0.05, 0.95))
        gain = float(np.polyfit(x[~on], y[~on], 1)[0])
        flat = np.mean(y[on] < level + WIDTH * noise[k]) > ALL
        if (
            flat
            and gain * (last - first) > LONG * 2 * WIDTH * noise[k]
            and np.mean(on[x >= first]) > ALL
        ):
            found.append((k, s.config.sign * y[on], float(first), float(last)))
    if not found:
        return
    unit, of_load = s.config.reading.unit, s.config.load.unit
    levels = [float(np.median(y)) for _, y, _, _ in found]
    first, last = (
        float(np.median(x)) for x in ([f[2] for f in found], [f[3] for f in found])
    )
    one = len(set(levels)) == 1 and all(
        np.mean(y == levels[0]) > ALL for _, y, _, _ in found
    )
    key, end = (
        ("highest", s.config.high) if s.config.sign > 0 else ("lowest", s.config.low)
    )
    at = f"{min(levels):.5g}" if one else f"{min(levels):.5g} … {max(levels):.5g}"
    way = (
        f"write `{key}: {levels[0]:.7g}` below `reading:` in the cells file"
        if one
        else f"raise that end, or leave out presses beyond {min(f[2] for f in found):.3g} {of_load}: a fit takes it for "
        "`taxel_saturation`, which has no such kink"
    )
    text = (
        f"the readings of {s.some([k for k, *_ in found])} stop at {at} {unit} while the load goes on from {first:.3g} to "
        f"{last:.3g} {of_load} (medians of these cells); {key} of the cells file is {end:g}. An amplifier or a divider ends "
        f"there: {way}"
    )
    yield find("plateau", "reading", text)


@check("warning", "shifted_loads", needs="cells")
def shifted_loads(s: CellSet) -> Iterator[Finding]:
    """Loads of a grid of 3 × 3 cells or more that act at another place than stated; not where cells share one load.

    Where a contact is off by d cells, each cell has the load of the point d beside it: f(x − d) ≈ f − d ∂f/∂x. What a reading
    leaves of its own load then follows the difference of the two neighbours' loads; crosstalk follows their sum. Of inner cells,
    by least squares beside a gain, an offset and a delay of each.
    """
    rows, columns = s.config.shape
    if s.config.load.shared or min(rows, columns) < 3:
        return
    rate = np.concatenate(
        [np.gradient(loads(m), m.period_s, axis=0) for m in s.recordings]
    )
    f, gain, offset = (
        s.load.reshape(-1, rows, columns),
        s.calibration.gain,
        s.calibration.offset,
    )
    terms = []
    for k in np.flatnonzero(~s.dead & (s.config.sign * gain > 0)):
        i, j = divmod(int(k), columns)
        if not (0 < i < rows - 1 and 0 < j < columns - 1):
            continue
        above, below, before, after = (
            f[:, i - 1, j],
            f[:, i + 1, j],
            f[:, i, j - 1],
            f[:, i, j + 1],
        )
        blur = (above + below + before + after) / 4 - f[:, i, j]
        rest = (s.reading[:, k] - offset[k]) / gain[k] - s.load[:, k]
        own = np.column_stack([np.ones(len(f)), s.load[:, k], rate[:, k]])[s.free[:, k]]
        both = np.column_stack([(above - below) / 2, (before - after) / 2, blur, rest])[
            s.free[:, k]
        ]
        terms.append(both - own @ np.linalg.lstsq(own, both, rcond=None)[0])
    given, rest = np.split(np.concatenate([np.empty((0, 4)), *terms]), [3], axis=1)
    power = float(np.square(rest).sum())
    if not power:
        return

    def explained(some: list[int]) -> float:
        fitted = given[:, some] @ np.linalg.lstsq(given[:, some], rest, rcond=None)[0]
        return 1 - float(np.square(rest - fitted).sum()) / power

    down, right, _ = np.linalg.lstsq(given, rest[:, 0], rcond=None)[0].tolist()
    share, of_blur = explained([0, 1]), explained([2])
    if share < max(EXPLAINED, TIMES_BLUR * of_blur):
        return
    text = (
        f"the loads act {down:+.2f} rows and {right:+.2f} columns farther on than stated: this shift explains {share:.0%} of "
        f"what the cells' own loads leave of the readings, crosstalk {of_blur:.0%}. No effect describes it, and taxel_crosstalk "
        "may stand in for it. Correct the place from which the loads of the cells were computed"
    )
    yield find("shifted_loads", "load", text)
