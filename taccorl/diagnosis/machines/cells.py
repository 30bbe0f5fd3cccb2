"""A sensor of cells as a machine, described by a cells file (``alignment.machines.cells_file``). The sensor is its only part."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from taccorl.alignment.checks.cell_set import CellSet
from taccorl.alignment.checks.cells import LOADED, check_cells, warnings_of_all
from taccorl.alignment.machines.cell_model import (
    by_cell,
    calibrated,
    file_numbers,
    of_file,
    readings,
    responses,
    thinned,
    within_ends,
)
from taccorl.alignment.machines.cell_places import with_places
from taccorl.alignment.machines.cell_tables import (
    CellMeasurement,
    cells_of,
    load_cell_columns,
    read_cell_table,
)
from taccorl.alignment.machines.cells_file import (
    CellsConfig,
    cells_digest,
    load_cells,
    make_cells_effect,
    save_cells,
)
from taccorl.alignment.measurements.folder import (
    Measurements,
    read_measurements,
    repeat_pairs,
)
from taccorl.data.finding import Finding as DataFinding
from taccorl.diagnosis.comparison.result import (
    USES,
    CellNumbers,
    Comparison,
    TouchTrace,
)
from taccorl.diagnosis.machines.machine import (
    Addition,
    Counted,
    Finding,
    GainsAre,
    Machine,
    machines,
    numbers_of,
)
from taccorl.diagnosis.problems.cells_problem import (
    CellsProblem,
    median_reading,
    prepared_all,
    reading_floor,
    without_dead,
)
from taccorl.diagnosis.problems.numbers_of_cells import numbers_apart
from taccorl.diagnosis.search.result import Diagnosis
from taccorl.diagnosis.search.solve import solved
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import Effect

THIRDS = ("first rows", "middle rows", "last rows")
"""Names of thirds, for a grid of three rows or more."""


@machines.register("cells")
@dataclass(frozen=True, repr=False)
class CellsMachine(Machine):
    """A sensor of cells."""

    config: CellsConfig
    """Content of the cells file."""
    name: str = "cells"
    part_word: ClassVar[str] = "sensor"
    of_joints: ClassVar[bool] = False

    @classmethod
    def load(cls, path: Path) -> Self:
        return cls(load_cells(path), path.stem)

    def save(self, path: Path) -> None:
        save_cells(self.config, path)

    def digest(self) -> str:
        return cells_digest(self.config)

    @property
    def effects(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.config.effects if not e.is_absent)

    def numbers(self, part: str) -> dict[str, tuple[float, str]]:
        c = self.config
        units = {"gain": f"{c.reading.unit}/{c.load.unit}", "offset": c.reading.unit}
        own = by_cell(c, {key: getattr(c, key) for key in units})
        return {
            name: (x, units[name.split("_")[0]]) for name, x in own.items()
        } | numbers_of(c.effects)

    @property
    def units(self) -> Mapping[str, str]:
        """Empty: a sensor of cells has no positions."""
        return {}

    def read(
        self,
        path: Path,
        *,
        spec: str | None = None,
        columns: Path | None = None,
        validation_every: int | None = None,
        fit_needed: bool = True,
    ) -> Measurements:
        if spec is not None:
            raise TaccorlError(
                f"--spec={spec}: recordings of a sensor of cells are tables (CSV, parquet); remove --spec"
            )

        def table(one: Path, beside: Path | None) -> CellMeasurement:
            return read_cell_table(
                one,
                self.config,
                None if beside is None else load_cell_columns(beside, self.config),
            )

        fit_needed = (
            fit_needed or not self.config.gain
        )  # compare fits gain and offset that the file does not state
        found = read_measurements(
            path,
            columns=columns,
            validation_every=validation_every,
            table=table,
            fit_needed=fit_needed,
        )
        return with_places(self.config, found)

    def check(self, measurements: Measurements) -> dict[str, list[DataFinding]]:
        return check_cells(
            self.config, cells_of(measurements.all), [m.name for m in measurements.fit]
        )

    def parts(self, measurements: Measurements) -> tuple[str, ...]:
        return (self.config.name,)

    def select(
        self, parts: Sequence[str], joints: Sequence[str], pads: Sequence[str]
    ) -> tuple[str, ...]:
        if joints or pads:
            option = "joints" if joints else "pads"
            raise TaccorlError(
                f"--{option}: {self.name} is a sensor of cells and has no {option}; remove --{option}"
            )
        return tuple(parts)

    def _compared(
        self, measurements: Measurements, name: str, progress: Counted
    ) -> Comparison:
        """Compare with gain and offset from the file; if it states none, with those fitted to the fit recordings, and the gain 0
        of dead cells."""
        config = self.config
        measurements = with_places(config, measurements)
        fit_to = prepared_all(config, measurements.fit)
        calibration = of_file(config)
        if calibration is None:
            raw = cells_of(measurements.fit)
            fitted = calibrated(
                config, [(responses(config, m), m.measured) for m in fit_to]
            )
            calibration = without_dead(
                fitted, CellSet(config, raw).dead, median_reading(raw)
            )
        floor = reading_floor(config, prepared_all(config, measurements.all))
        gain, offset = (
            np.array(numbers).reshape(config.shape)
            for numbers in file_numbers(config, calibration).values()
        )
        cells = CellNumbers(
            names=config.names,
            gain=gain,
            offset=offset,
            places=calibration.gain.size // len(config.names),
        )
        touches = []
        total = len(measurements.all)
        for use in USES:
            for m in map(thinned, cells_of(getattr(measurements, use))):
                progress(m.name, len(touches), total)
                zero = calibration.offset
                simulated = readings(config, responses(config, m), calibration)
                if m.place.size:  # rows at no known place are not compared
                    rows = m.place >= 0
                    kept = {
                        name: getattr(m, name)[rows] for name in ("time_s", *m.columns)
                    }
                    m, simulated = (
                        dataclasses.replace(m, **kept, place=m.place[rows]),
                        simulated[rows],
                    )
                shape = (m.num_rows, 1, *config.shape)
                counted = within_ends(config, m).reshape(shape)
                loaded = np.asarray(
                    (m.target > LOADED * config.load.rated).any(axis=1, keepdims=True)
                )
                touches.append(
                    TouchTrace(
                        recording=m.name,
                        use=use,
                        pads=(config.name,),
                        time_s=m.time_s[:, None],
                        measured=(config.sign * (m.measured - zero)).reshape(shape),
                        replayed=(config.sign * (simulated - zero)).reshape(shape),
                        floor=floor.reshape(1, *config.shape),
                        origin=m.origin,
                        touched=loaded,
                        unit=config.reading.unit,
                        thirds=THIRDS if config.shape[0] >= len(THIRDS) else (),
                        load=m.target.reshape(shape),
                        load_unit=config.load.unit,
                        repeated=bool(repeat_pairs(measurements.all)),
                        cells=cells,
                        counted=counted,
                    )
                )
        return Comparison(
            twin=name,
            effects=self.effects,
            traces=(),
            touches=tuple(touches),
            split=measurements.record(),
            left_out=tuple(_cut_words(config, measurements)),
        )

    def problem(
        self, part: str, measurements: Measurements, gains: GainsAre
    ) -> CellsProblem:
        return CellsProblem(self.config, measurements)

    def diagnose(
        self,
        part: str,
        measurements: Measurements,
        *,
        gains: GainsAre = "auto",
        **options: Any,
    ) -> Finding:
        measurements = with_places(self.config, measurements)
        problem = self.problem(part, measurements, gains)
        found = solved(part, problem, **options)
        unit, load = self.config.load.unit, self.config.load_of_reading
        remark = f"1 in the unit reading is {load:g} {unit}, a tenth of the rated load"
        d = _with_numbers(problem, found.diagnosis)
        of_cells = warnings_of_all(
            self.config, cells_of(measurements.fit), cells_of(measurements.all)
        )
        of_effects = (
            *_of_whole_load(problem, d),
            *numbers_apart(problem, found.diagnosis),
        )
        d = dataclasses.replace(
            d, remarks=(*(f.text for f in of_cells), *of_effects, *d.remarks)
        )
        return dataclasses.replace(found, diagnosis=d, remark=remark)

    def effect(self, name: str, part: str, values: Mapping[str, Any]) -> Effect | None:
        if name in registry and "cells" not in registry.get(name).kinds():
            return None
        return make_cells_effect(
            name, **{k: v for k, v in values.items() if k != "pads"}
        )

    def by_hand(
        self,
        name: str,
        joints: Sequence[str],
        pads: Sequence[str],
        values: Mapping[str, float],
    ) -> list[Addition]:
        """Add an effect with values by hand; gain and offset are not changed."""
        (part,) = self.select((self.config.name,), joints, pads)
        made = self.effect(name, part, {**values, "evidence": "by hand"})
        if made is None:
            known = [name for name in registry if "cells" in registry.get(name).kinds()]
            raise TaccorlError(
                f"{name} is not an effect of a sensor of cells; {nearest(name, known)}"
            )
        numbers = by_cell(
            self.config, {key: getattr(self.config, key) for key in ("gain", "offset")}
        )
        return [Addition(part, [made], numbers, {})]

    def with_additions(self, additions: Sequence[Addition]) -> "CellsMachine":
        """Add effects, with the gain and offset that were fitted together with them. Without fitted ones both are left out of
        the file, and are fitted whenever it is used."""
        config = self.config
        for addition in additions:
            names = {e.name for e in addition.effects}
            kept = [e for e in config.effects if e.name not in names]
            numbers = {
                key: [
                    addition.base[f"{key}_{cell}"]
                    for cell in config.names
                    if f"{key}_{cell}" in addition.base
                ]
                for key in ("gain", "offset")
            }
            added = [e for e in addition.effects if not e.is_absent]
            config = dataclasses.replace(config, effects=[*kept, *added], **numbers)
        return CellsMachine(config, self.name)


def _cut_words(config: CellsConfig, measurements: Measurements) -> list[str]:
    """How many readings were at an end of the converter, recording by recording."""
    words = []
    for m in cells_of(measurements.all):
        share = float(np.mean(~within_ends(config, m)))
        if share > 0:
            words.append(
                f"{m.name}: {share:.1%} of the readings are at an end of the converter; they say nothing"
            )
    return words


def _of_whole_load(problem: CellsProblem, d: Diagnosis) -> list[str]:
    """A remark for each effect whose numbers are not those of a cell, whose share of the load differs from place to place."""
    if problem.config.same_place_mm is None:
        return []
    bent = [
        e.name
        for e in d.effects
        if any("reading" in f.unit for f in problem.candidates[e.name].frees)
    ]
    return [
        f"{name}: with several places it acts on the whole load, so its numbers are a mean over shares of the load; record one "
        "place alone for them"
        for name in bent
    ]


def _with_numbers(problem: CellsProblem, d: Diagnosis) -> Diagnosis:
    """With gain and offset of each cell, which the search fits in closed form, among the fitted numbers."""
    present = {k: v for k, v in d.before.values.items() if "." in k}
    return dataclasses.replace(
        d,
        base=problem.file_numbers(d.effects),
        before=dataclasses.replace(
            d.before, values=present | problem.file_numbers(d.before.effects)
        ),
        offers=tuple(
            dataclasses.replace(o, base=problem.file_numbers(o.effects))
            for o in d.offers
        ),
    )
