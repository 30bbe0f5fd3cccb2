"""Readings of a sensor of cells for a measured load: load → effects → gain and offset → ends of the converter.

Letters in shapes: T rows, K cells, R × C the grid, P places at which a probe presses.

With places (``cell_places``) a response is that of one cell which is loaded at one place only, for each place, and a cell reads
the sum of the responses of all places, each times its gain there. This is exact for effects whose response is in proportion to
the load (creep, lag, delay, hysteresis); other effects act on the whole load, as where the cells share one load.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.alignment.touch.model import through
from taccorl.sim.effects.added import present
from taccorl.sim.effects.effect import Effect, Memory
from taccorl.sim.effects.pads import NOMINAL_C, TaxelTemperature
from taccorl.sim.effects.touch_memory import CreepingEffect, RememberingEffect

MOST_ROWS_HZ = 200.0
"""Recordings with a higher row rate are reduced to about this rate by means of neighbouring rows [Hz]."""
STEPS_OF_ROW = 4
"""Steps into which a row is divided. With n held steps in a row of Δt a time constant T is overestimated by Δt² / (12 T n²):
0.03 ms at T = 20 ms and 100 Hz."""


class Calibration(NamedTuple):
    """Gain and offset of each cell."""

    gain: np.ndarray  # (K,) gains: the reading's unit per 1 of the unit ``reading``. With places (K, P).
    offset: np.ndarray  # (K,) offsets in the reading's unit


def responses(
    config: CellsConfig, m: CellMeasurement, effects: Sequence[Effect] = ()
) -> np.ndarray:
    """(T, K) readings in the unit ``reading``, before gain and offset, of the load of ``m``, which acts at its row's time and
    follows a straight line between rows. If ``m`` has places, (T, P): a column for each place, with the load while it is pressed.
    ``effects``: effects besides the config's; one of the same name replaces the config's. Raises TaccorlError: an effect is given
    twice."""
    acting = present(
        [
            *(
                e
                for e in config.effects
                if e.name not in {effect.name for effect in effects}
            ),
            *effects,
        ]
    )
    if config.reading.below_rest:
        acting = [
            dataclasses.replace(e, below_rest=True)
            if isinstance(e, CreepingEffect)
            else e
            for e in acting
        ]
    load, shape = loads(m), (1, m.num_places) if m.place.size else config.shape
    reading = (load / config.load_of_reading).astype(np.float32).reshape(-1, 1, *shape)
    dt_s = np.diff(m.time_s, prepend=m.time_s[0])
    for effect in acting:
        if isinstance(effect, TaxelTemperature):
            effect = effect.at(
                m.temperature_c
                if m.temperature_c.size
                else np.full(m.num_rows, NOMINAL_C)
            )
        memory = effect.memory(1, shape)
        if isinstance(effect, RememberingEffect) and effect.holds_scan:
            reading = _along_lines(effect, reading, memory, dt_s)
        else:
            reading = through(effect, reading, memory, m.time_s, dt_s)
    return reading.reshape(m.num_rows, -1).astype(float)


def loads(m: CellMeasurement) -> np.ndarray:
    """(T, K) load of each cell, in the unit of the cells file. If ``m`` has places, (T, P): the load while each is pressed."""
    return (
        m.target[:, :1] * (m.place[:, None] == np.arange(m.num_places))
        if m.place.size
        else m.target
    )


def _along_lines(
    effect: RememberingEffect, reading: np.ndarray, memory: Memory, dt_s: np.ndarray
) -> np.ndarray:
    """(T, 1, R, C) after an effect that holds its input since the scan before, of readings on straight lines between rows.

    A row is ``STEPS_OF_ROW`` equal steps, each at the mean of its piece of the line, and a step of 0 s at the row's own reading.
    """
    share = (np.arange(STEPS_OF_ROW + 1) + 0.5) / STEPS_OF_ROW
    share[-1] = 1.0
    before = np.concatenate([reading[:1], reading[:-1]])
    fine = (
        before[:, None]
        + share.astype(np.float32)[:, None, None, None] * (reading - before)[:, None]
    )
    fine_dt_s = np.repeat(dt_s[:, None] / STEPS_OF_ROW, STEPS_OF_ROW + 1, axis=1)
    fine_dt_s[:, -1] = 0.0
    times_s = np.cumsum(fine_dt_s.ravel())
    out = through(
        effect, fine.reshape(-1, *reading.shape[1:]), memory, times_s, fine_dt_s.ravel()
    )
    return out[STEPS_OF_ROW :: STEPS_OF_ROW + 1]


def readings(
    config: CellsConfig, response: np.ndarray, calibration: Calibration
) -> np.ndarray:
    """(T, K) readings in the unit of the file: g r + o for the ``response`` r (T, K) in the unit ``reading``, limited to the ends
    of the converter. With places Σ g r + o over them, for r (T, P)."""
    gain = calibration.gain
    loaded = gain * response if gain.ndim == 1 else response @ gain.T
    return np.clip(loaded + calibration.offset, config.low, config.high)


def within_ends(config: CellsConfig, m: CellMeasurement) -> np.ndarray:
    """(T, K) bool: the converter is not at one of its ends (more than half a step away)."""
    half = 0.5 * np.maximum(m.quantum, 0.0) + 1e-9 * np.abs(m.measured)
    return (m.measured > config.low + half) & (m.measured < config.high - half)


def calibrated(
    config: CellsConfig, pairs: Sequence[tuple[np.ndarray, np.ndarray]]
) -> Calibration:
    """Fit gain and offset of every cell by least squares over pairs (response, reading), each (T, K), with NaN in rows that are
    not used. Cells that were never loaded get the median gain of the others.

    With places responses are (T, P) and gains (K, P); cells with too few rows have the gain 0.
    """
    if config.same_place_mm is not None:
        return _calibrated_by_place(pairs)
    response = np.concatenate([r for r, _ in pairs])
    reading = np.concatenate([y for _, y in pairs])
    use = np.isfinite(reading)
    count = np.maximum(use.sum(axis=0), 1)
    mean_r = np.where(use, response, 0.0).sum(axis=0) / count
    mean_y = np.where(use, reading, 0.0).sum(axis=0) / count
    off_r = np.where(use, response - mean_r, 0.0)
    power = np.square(off_r).sum(axis=0)
    known = power > 1e-6 * count
    product = (off_r * np.where(use, reading - mean_y, 0.0)).sum(axis=0)
    gain = np.divide(product, power, out=np.full(len(power), np.nan), where=known)
    other = float(np.nanmedian(gain)) if known.any() else config.sign
    gain = np.where(known, gain, other)
    return Calibration(gain, mean_y - gain * mean_r)


def _calibrated_by_place(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Calibration:
    """Least squares with a regressor for each place and an offset; cells with NaN in other rows than most are solved alone."""
    response = np.concatenate([r for r, _ in pairs])
    reading = np.concatenate([y for _, y in pairs])
    given = np.column_stack([response, np.ones(len(response))])
    finite = np.isfinite(reading)
    common = finite.any(axis=1)
    solved = np.zeros((given.shape[1], reading.shape[1]))
    alike = finite[common].all(axis=0)
    for rows, cells in [
        (common, np.flatnonzero(alike)),
        *((finite[:, k], [k]) for k in np.flatnonzero(~alike)),
    ]:
        if np.sum(rows) and len(cells):
            own = given[rows]
            # Normal equations: (P + 1)² numbers in place of T (P + 1); a place without a row gets the gain 0.
            inverse = np.linalg.pinv(own.T @ own, rcond=1e-10, hermitian=True)
            solved[:, cells] = inverse @ (own.T @ reading[rows][:, cells])
    return Calibration(solved[:-1].T, solved[-1])


def of_file(config: CellsConfig) -> Calibration | None:
    """Gain and offset of the cells file; None if it states none."""
    if not config.gain:
        return None
    return Calibration(
        np.array(config.gain) * config.load_of_reading, np.array(config.offset)
    )


def by_cell(
    config: CellsConfig, numbers: Mapping[str, Sequence[float]]
) -> dict[str, float]:
    """``KEY_CELL`` → number of each cell; ``numbers``: ``gain`` or ``offset`` → K numbers, or none."""
    return {
        f"{key}_{cell}": x
        for key, own in numbers.items()
        for cell, x in zip(config.names, own, strict=False)
    }


def file_numbers(
    config: CellsConfig, calibration: Calibration
) -> dict[str, list[float]]:
    """Keys ``gain`` and ``offset`` of a cells file, each with K numbers; gains are per unit of the load. With places the gain is
    that of the place where the cell responds most."""
    gain = calibration.gain
    if gain.ndim > 1:
        gain = config.sign * np.max(config.sign * gain, axis=1)
    return {
        "gain": (gain / config.load_of_reading).tolist(),
        "offset": calibration.offset.tolist(),
    }


def thinned(m: CellMeasurement) -> CellMeasurement:
    """The measurement at about ``MOST_ROWS_HZ`` or less: each row is the mean of as many neighbours as needed."""
    size = int(m.rate_hz // MOST_ROWS_HZ)
    if size < 2:
        return m
    whole = m.num_rows // size * size

    def mean(values: np.ndarray) -> np.ndarray:
        return values[:whole].reshape(-1, size, *values.shape[1:]).mean(axis=1)

    columns = {name: mean(getattr(m, name)) for name in ("time_s", *m.columns)}
    columns["place"] = m.place[:whole:size]
    return dataclasses.replace(m, **columns)
