"""Measurements of a sensor of cells from CSV and parquet files: time, load and readings, one row an instant.

Without a columns file a table has ``t`` [s], the load as ``force_n``, ``pressure_pa`` or ``depth_m`` (``thumb.force_n`` … where
cells have loads of their own), for each cell ``thumb.reading`` in the unit of the cells file, and if recorded ``temperature_c``.
Other names and units are written down in a columns file::

    time: {column: stamp, unit: ms}
    load: {column: Fz, unit: N}                   # of all cells; or `load:` below each cell
    temperature: {column: T}                      # °C
    cells:
      thumb: {reading: {column: adc3, unit: count}}

The load of row k acted at the time of row k, and follows a straight line to the next. A table with uneven rows
comes to an even grid by straight lines between its rows.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from taccorl.alignment.machines.cells_file import LOADS, READINGS, CellsConfig
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.quantisation import find_quantum
from taccorl.alignment.measurements.tables import TIME_S, Column, ColumnsFile, read_columns, table_origin
from taccorl.data.finding import Finding
from taccorl.data.strict_yaml import Document
from taccorl.errors import RecordingError, nearest

EVEN, LONGEST_GAP_S, LONGEST_GAP_ROWS = 0.1, 0.25, 5
"""Steps within the first share of the period are even; a gap longer than the second [s] and the third [periods] is not
bridged."""


@dataclass(frozen=True, kw_only=True)
class CellMeasurement(Measurement):
    """A recording of a sensor of cells: signals are cells, ``target`` is the load and ``measured`` the reading of each (T, J)."""

    known_units: ClassVar = tuple(READINGS)
    temperature_c: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T,) temperature [°C]; empty if it was not recorded."""


@dataclass(frozen=True, kw_only=True)
class TemperatureColumn:
    """Column of the temperature [°C]."""

    column: str


@dataclass(frozen=True, kw_only=True)
class CellColumns:
    """Columns of one cell."""

    reading: Column
    """Column of the reading."""
    load: Column | None = None
    """Column of the load, if the cell has its own."""


@dataclass(frozen=True, kw_only=True)
class CellTableSpec(ColumnsFile):
    """Names and units of a table's columns."""

    cells: dict[str, CellColumns]
    """Name of the cell → its columns."""
    load: Column | None = None
    """Column of the load of all cells; None if each cell has its own."""
    temperature: TemperatureColumn | None = None
    """None if the table has no temperature."""


def load_cell_columns(path: Path, config: CellsConfig) -> CellTableSpec:
    """Load a columns file, and check it against the cells file.

    Raises:
        SpecError: it is invalid; the message names file, line, key and remedy.
    """
    document = Document(CellTableSpec, Path(path))
    spec = document.value
    spec.check(document)
    for name in spec.cells:
        if name not in config.names:
            raise document.error(f"cells/{name}", f"the cells file has no cell {name!r}; {nearest(name, config.names)}")
    lacking = [name for name in config.names if name not in spec.cells]
    if lacking:
        raise document.error("cells", f"cell {lacking[0]!r} of the cells file is missing")
    kind = LOADS[config.load.unit][0]
    for name, cell in spec.cells.items():
        own, factor = READINGS.get(cell.reading.unit, ("", 0.0)), READINGS[config.reading.unit]
        if own[0] != factor[0]:
            same = [unit for unit, (quantity, _) in READINGS.items() if quantity == factor[0]]
            text = f"{cell.reading.unit!r} is no unit like the cells file's {config.reading.unit}; "
            raise document.error(f"cells/{name}/reading/unit", text + nearest(cell.reading.unit, same))
        load, key = (cell.load, f"cells/{name}/load") if not config.load.shared else (spec.load, "load")
        if load is None:
            shared = (
                "each cell has a load of its own (shared: false)"
                if not config.load.shared
                else "all cells share one load"
            )
            raise document.error(key, f"is missing: the cells file states that {shared}")
        if LOADS.get(load.unit, ("",))[0] != kind:
            same = [unit for unit, (other, _) in LOADS.items() if other == kind]
            raise document.error(
                f"{key}/unit",
                f"{load.unit!r} is not of the same kind as the cells file's unit {config.load.unit}; "
                f"{nearest(load.unit, same)}",
            )
    return spec


def _own_cell_columns(path: Path, header: list[str], config: CellsConfig) -> CellTableSpec:
    """Columns of a table with taccorl's own names.

    Args:
        header: names of its columns.

    Raises:
        RecordingError: a column is missing or unknown; the message names file, column and remedy.
    """
    load = LOADS[config.load.unit][0]
    known = ["t", "temperature_c", *(f"{name}.reading" for name in config.names)]
    loads = [load] if config.load.shared else [f"{name}.{load}" for name in config.names]
    for column in header:
        if column not in (*known, *loads):
            raise RecordingError(
                f"{path}: column {column!r} is not a column of this sensor; {nearest(column, [*known, *loads])}. Other names "
                "and units must be stated in a columns file (--columns; taccorl/alignment/machines/cell_tables.py shows one)"
            )
    for column in ("t", *loads, *(f"{name}.reading" for name in config.names)):
        if column not in header:
            raise RecordingError(
                f"{path}: no column {column!r}; it has {', '.join(header)}. Other names and units must be stated in a columns "
                "file (--columns; taccorl/alignment/machines/cell_tables.py shows one)"
            )
    unit = {"force_n": "N", "pressure_pa": "Pa", "depth_m": "m"}[load]
    own = {
        name: CellColumns(
            reading=Column(column=f"{name}.reading", unit=config.reading.unit),
            load=None if config.load.shared else Column(column=f"{name}.{load}", unit=unit),
        )
        for name in config.names
    }
    return CellTableSpec(
        time=Column(column="t", unit="s"),
        cells=own,
        load=Column(column=load, unit=unit) if config.load.shared else None,
        temperature=TemperatureColumn(column="temperature_c") if "temperature_c" in header else None,
    )


def read_cell_table(path: Path, config: CellsConfig, spec: CellTableSpec | None = None) -> CellMeasurement:
    """Read a table as a measurement of the sensor, in the units of the cells file.

    Raises:
        RecordingError: a column is missing, a cell of the table is empty or no number, time does not increase; the message names
            file, line or row, and column.
    """
    path = Path(path)

    def choose(header: list[str]) -> list[str]:
        return _wanted(spec or _own_cell_columns(path, header, config))

    header, columns = read_columns(path, choose, spec.separator if spec else "comma")
    spec = spec or _own_cell_columns(path, header, config)
    time_s = columns[spec.time.column] * TIME_S[spec.time.unit]
    if len(time_s) < 2:
        raise RecordingError(f"{path}: {len(time_s)} rows are too few for a measurement")
    steps = np.diff(time_s)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 2
        raise RecordingError(f"{path}: time does not increase at row {row}: {time_s[row - 1]:.6g} s; remove such rows")
    load_factor = LOADS[config.load.unit][1]
    load, reading = np.empty((2, len(time_s), config.num_cells))
    for k, name in enumerate(config.names):
        cell = spec.cells[name]
        column = cell.load if spec.load is None else spec.load
        assert column is not None
        load[:, k] = columns[column.column] * (LOADS[column.unit][1] / load_factor)
        reading[:, k] = columns[cell.reading.column] * (
            READINGS[cell.reading.unit][1] / READINGS[config.reading.unit][1]
        )
    found = CellMeasurement(
        name=path.name,
        time_s=time_s - time_s[0],
        target=load,
        measured=reading,
        signals=config.names,
        units=(config.reading.unit,) * config.num_cells,
        quantum=np.array([find_quantum(column) for column in reading.T]),
        source=path,
        origin=table_origin(path, spec.domain, spec.origin),
        start_ns=round(time_s[0] * 1e9),
        temperature_c=columns[spec.temperature.column] if spec.temperature else np.empty(0),
    )
    return _even(found)


def _wanted(spec: CellTableSpec) -> list[str]:
    names = [spec.time.column, *(c.reading.column for c in spec.cells.values())]
    names += [c.column for c in (spec.load, *(cell.load for cell in spec.cells.values())) if c is not None]
    names += [spec.temperature.column] if spec.temperature else []
    return list(dict.fromkeys(names))


def _even(m: CellMeasurement) -> CellMeasurement:
    """At even times, by straight lines between rows.

    Raises:
        RecordingError: a gap of more than ``LONGEST_GAP_S`` and ``LONGEST_GAP_ROWS``.
    """
    steps, period = np.diff(m.time_s), m.period_s
    if (np.abs(steps - period) < EVEN * period).all():
        return m
    gap = int(np.argmax(steps))
    if steps[gap] > max(LONGEST_GAP_S, LONGEST_GAP_ROWS * period):
        raise RecordingError(
            f"{m.source}: no row for {steps[gap]:.2f} s after {m.time_s[gap]:.2f} s; split the table there into two files"
        )
    even = m.resampled(1.0 / period)
    temperature = np.interp(even.time_s, m.time_s, m.temperature_c) if m.temperature_c.size else m.temperature_c
    text = (
        f"rows were not even (steps {1e3 * steps.min():.2f} … {1e3 * steps.max():.2f} ms): brought to {1 / period:.6g} Hz by "
        "straight lines. Log the driver's own stamps to avoid it"
    )
    finding = Finding("resampled", "warning", "time", text)
    return dataclasses.replace(even, temperature_c=temperature, findings=(*m.findings, finding))
