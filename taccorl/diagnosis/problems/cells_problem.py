"""A sensor of cells as a problem for the search: candidates are all effects on readings, channels at most 64 cells.

Each cell's gain and offset are always fitted, in closed form: for every set of effects they are the least squares over the fit
recordings (variable projection, Golub and Pereyra 1973), so that the search works on residuals which no gain and offset
explains, and a grid of hundreds of cells has no more unknowns than one cell. Rows in which the converter is at an end are used
neither in fits nor in errors.

Letters in shapes: T rows, K cells, C channels.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from taccorl.alignment.checks.cell_set import CellSet
from taccorl.alignment.checks.cells import LOADED
from taccorl.alignment.machines.cell_model import (
    Calibration,
    by_cell,
    calibrated,
    file_numbers,
    loads,
    readings,
    responses,
    thinned,
    within_ends,
)
from taccorl.alignment.machines.cell_places import with_places
from taccorl.alignment.machines.cell_tables import CellMeasurement, cells_of
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.alignment.measurements.folder import Measurements, repeat_pairs
from taccorl.alignment.measurements.noise_floor import residue_floor
from taccorl.alignment.measurements.repeats import overlay
from taccorl.diagnosis.problems.touch_problem import FIXED, MAX_CHANNELS
from taccorl.diagnosis.search.problem import (
    Candidate,
    Free,
    Recording,
    Values,
    WithoutMaps,
    candidate,
    split_rows,
)
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import CELLS, Effect

SAME_LOAD = 0.2
"""Largest difference between the load of a repeat and of the original, as a share of the load's motion."""
SAME_FLOORS = 1.0
"""A repeat is used where its load differs by no more than so many noise floors of the reading."""
SAME_TEMPERATURE_K = 0.5
"""A repeat is used where its temperature differs by no more than this [K], if recorded."""
_KEPT = 64
"""Sets of effects whose calibration is remembered: a step of the solver asks for each set once a recording."""


class CellsProblem(WithoutMaps):
    """Search problem of a sensor of cells (a ``machines.machine.PartProblem``).

    Args:
        config: configuration of the sensor. Its effects are ``present``: they are fitted again with all other numbers.
        measurements: ``CellMeasurement``s of it.

    Raises:
        TaccorlError: no cell is loaded in the fit recordings.
    """

    numbers: str
    """Text: the numbers that are always fitted."""
    measured = "readings of the cells"

    known = ()

    def __init__(self, config: CellsConfig, measurements: Measurements) -> None:
        self.config = dataclasses.replace(config, effects=[])
        measurements = with_places(config, measurements)
        places = max((m.num_places for m in cells_of(measurements.all)), default=0)
        self.numbers = "gain and offset of each cell fitted" + (
            f", a gain for each of {places} places" if places else ""
        )
        self.floor = reading_floor(config, prepared_all(config, measurements.all))
        """(K,) noise floor in the unit of the reading."""
        sides = [
            prepared_all(config, side)
            for side in (measurements.fit, measurements.validation, measurements.test)
        ]
        load = np.concatenate([m.target for m in sides[0]])
        self._load_noise = _own_noise([(m.target, m.rate_hz) for m in sides[0]])
        fit_to = cells_of(measurements.fit)
        self.dead = CellSet(config, fit_to).dead
        """(K,) bool: cells that are loaded and hardly respond. They are not compared."""
        self._level = median_reading(fit_to)
        loaded = np.flatnonzero(
            (load.max(axis=0) > LOADED * config.load.rated) & ~self.dead
        )
        if len(loaded) == 0:
            raise TaccorlError(
                f"{config.name}: no cell is loaded with {LOADED:.0%} of the rated load in a fit recording; press it harder"
            )
        some = np.random.default_rng(0).permutation(loaded)[:MAX_CHANNELS]
        self.channels = np.sort(some)
        """(C,) numbers of the cells that are compared, increasing: loaded ones that respond, at most ``MAX_CHANNELS``."""
        self.fit: Sequence[Recording] = [self._recording(m) for m in sides[0]]
        self.validation: Sequence[Recording] = [self._recording(m) for m in sides[1]]
        self.test: Sequence[Recording] = [self._recording(m) for m in sides[2]]
        self._calibrate_on: Sequence[Recording] = (
            self.fit if self.validation else split_rows(self.fit)[0]
        )
        self._calibrations: dict[tuple, tuple[Calibration, dict[str, np.ndarray]]] = {}
        self.base: tuple[Free, ...] = ()
        seen = {
            "peak_reading": float(load.max()) / config.load_of_reading,
            "duration_s": max(float(m.time_s[-1] - m.time_s[0]) for m in sides[0]),
        }
        gives = [
            *config.known_facts,
            *(
                ["temperature"]
                if all(m.temperature_c.size for side in sides for m in side)
                else []
            ),
        ]
        self.candidates: dict[str, Candidate] = {
            name: candidate(cls, seen, pads=[CELLS], **FIXED.get(name, {}))
            for name in registry
            if (cls := registry.get(name)).fitted
            and "cells" in cls.kinds()
            and cls.works_with(gives)
        }
        self.present = tuple(
            e.name
            for e in config.effects
            if not e.is_absent and e.name in self.candidates
        )
        self.start: Values = {
            f.name: getattr(e, f.name.split(".", 1)[1])
            for e in config.effects
            if e.name in self.present
            for f in self.candidates[e.name].frees
        }
        repeated = bool(repeat_pairs(measurements.all))
        bound = "" if repeated else "; a lower bound: record a press twice (repeat_of)"
        level = float(np.median(self.floor[self.channels]))
        self.noise = f"{level:.3g} {config.reading.unit} (the median cell{bound})"

    def _recording(self, m: CellMeasurement) -> Recording:
        unit = self.config.reading.unit
        return Recording(
            name=m.name,
            time_s=m.time_s,
            measured=m.measured[:, self.channels],
            floor=self.floor[self.channels],
            channels=tuple(f"{self.config.names[k]} [{unit}]" for k in self.channels),
            data=m,
            short_noise=True,
        )

    def noisier(self, recording: Recording) -> Recording:
        m = recording.data
        noise = (
            np.random.default_rng(0).standard_normal(m.target.shape) * self._load_noise
        )
        noise = noise[:, :1] if self.config.load.shared else noise
        return dataclasses.replace(
            recording,
            name=f"{recording.name}, noisier",
            data=dataclasses.replace(m, target=m.target + noise),
        )

    def simulate(
        self, base: Mapping[str, float], effects: Sequence[Effect], recording: Recording
    ) -> np.ndarray:
        """(T, C) simulated readings in the unit of the file, with the gains and offsets of cells that fit best."""
        calibration, known = self._calibrated(effects)
        response = known.get(recording.name)
        if response is None:
            response = responses(self.config, recording.data, effects)
        return readings(self.config, response, calibration)[:, self.channels]

    def _calibrated(
        self, effects: Sequence[Effect]
    ) -> tuple[Calibration, dict[str, np.ndarray]]:
        """Gain and offset of each cell beside ``effects``, and the responses of the recordings that they were fitted to."""
        key = tuple(
            (e.name, *(getattr(e, p.name) for p in e.parameters())) for e in effects
        )
        if key not in self._calibrations:
            known = {
                r.name: responses(self.config, r.data, effects)
                for r in self._calibrate_on
            }
            pairs = [(known[r.name], self._fitted_rows(r)) for r in self._calibrate_on]
            while len(self._calibrations) >= _KEPT:
                self._calibrations.pop(next(iter(self._calibrations)))
            self._calibrations[key] = calibrated(self.config, pairs), known
        return self._calibrations[key]

    def _fitted_rows(self, r: Recording) -> np.ndarray:
        """(T, K) readings of all cells in the rows that are fitted."""
        return np.where(
            np.isfinite(r.measured).any(axis=1, keepdims=True), r.data.measured, np.nan
        )

    def file_numbers(self, effects: Sequence[Effect]) -> dict[str, float]:
        """Gain and offset of each cell as fitted together with ``effects``: ``gain_thumb`` [unit of the reading per unit of the
        load], …, ``offset_thumb`` [unit of the reading], …. Dead cells have the gain 0 and the median reading as offset. Empty
        with ``same_place_mm``."""
        if self.config.same_place_mm is not None:
            return {}  # a gain for each place; the file cannot hold them
        own = without_dead(self._calibrated(effects)[0], self.dead, self._level)
        return by_cell(self.config, file_numbers(self.config, own))


def without_dead(
    calibration: Calibration, dead: np.ndarray, level: np.ndarray
) -> Calibration:
    """``calibration`` with the gain 0 and the offset ``level`` for cells that ``dead`` marks, all (K,)."""
    gain = calibration.gain
    return Calibration(
        np.where(dead if gain.ndim == 1 else dead[:, None], 0.0, gain),
        np.where(dead, level, calibration.offset),
    )


def median_reading(measurements: Sequence[CellMeasurement]) -> np.ndarray:
    """(K,) median reading of each cell."""
    return np.median(np.concatenate([m.measured for m in measurements]), axis=0)


def prepared_all(config: CellsConfig, measurements: Sequence) -> list[CellMeasurement]:
    """The recordings for fits and errors, in their order: readings at the converter's ends, and rows at no known place, are NaN,
    with at most 200 rows per second."""

    def usable(m: CellMeasurement) -> np.ndarray:
        return (
            within_ends(config, m) & (m.place[:, None] >= 0)
            if m.place.size
            else within_ends(config, m)
        )

    return [
        thinned(
            dataclasses.replace(m, measured=np.where(usable(m), m.measured, np.nan))
        )
        for m in measurements
    ]


def reading_floor(
    config: CellsConfig, measurements: Sequence[CellMeasurement]
) -> np.ndarray:
    """(K,) noise floor of each cell in the unit of the reading: its own noise and, times its gain, that of the load; if a press
    was repeated, at least the difference between repeats under the same load."""
    step = np.max([m.quantum for m in measurements], axis=0) / math.sqrt(12)
    own, load = (
        _own_noise([(getattr(m, kind), m.rate_hz) for m in measurements])
        for kind in ("measured", "target")
    )
    gain = np.abs(
        calibrated(config, [(loads(m), m.measured) for m in measurements]).gain
    )
    gain = (
        gain if gain.ndim == 1 else np.sqrt(np.mean(np.square(gain), axis=1))
    )  # of a place: RMS over places
    floor = np.hypot(np.maximum(own, step), gain * load)
    squares, rows = np.zeros(len(floor)), np.zeros(len(floor))
    for one, repeat in repeat_pairs(measurements):
        time_s = one.time_s + overlay(one, repeat, SAME_LOAD).shift_s
        inside = (time_s >= repeat.time_s[0]) & (time_s <= repeat.time_s[-1])
        for k in range(len(floor)):
            again, pressed = (
                np.interp(time_s[inside], repeat.time_s, x[:, k])
                for x in (repeat.measured, repeat.target)
            )
            same = np.ones(len(again), dtype=bool)
            if one.temperature_c.size and repeat.temperature_c.size:
                warmer = (
                    np.interp(time_s[inside], repeat.time_s, repeat.temperature_c)
                    - one.temperature_c[inside]
                )
                same = np.abs(warmer) < SAME_TEMPERATURE_K
            same &= (
                gain[k] * np.abs(pressed - one.target[inside, k])
                < SAME_FLOORS * floor[k]
            )
            difference = (again - one.measured[inside, k])[same]
            squares[k] += np.nansum(np.square(difference)) / 2
            rows[k] += np.isfinite(difference).sum()
    repeated = np.sqrt(squares / np.maximum(rows, 1))
    columns = np.concatenate([m.measured for m in measurements]).T
    spread = np.array(
        [np.std(c[np.isfinite(c)]) if np.isfinite(c).any() else 0.0 for c in columns]
    )
    return np.maximum(np.maximum(floor, repeated), 1e-6 * spread + 1e-12)


def _own_noise(channels: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
    """(K,) noise of each column by ``residue_floor``; where recordings are too short for it, from second differences of rows,
    whose variance is 6 times the noise's."""
    noise = residue_floor(channels)
    for k in np.flatnonzero(~np.isfinite(noise)):
        second = np.concatenate([np.diff(values[:, k], n=2) for values, _ in channels])
        second = np.abs(second[np.isfinite(second)])
        noise[k] = 1.4826 * np.median(second) / math.sqrt(6) if len(second) else 0.0
    return noise
