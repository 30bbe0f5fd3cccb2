"""Measurements of a sensor of cells from CSV and parquet files: time, load and readings, one row an instant.

Without a columns file a table has ``t`` [s], the load as ``force_n``, ``pressure_pa`` or ``depth_m`` (``thumb.force_n`` … where
cells have loads of their own), for each cell ``thumb.reading`` in the unit of the cells file, and if recorded ``temperature_c``.
A columns file states other names and units (``cell_columns``).

The load of row k acted at the time of row k, and follows a straight line to the next. A table with uneven rows
comes to an even grid by straight lines between its rows.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from taccorl.alignment.machines.cell_columns import CellTableSpec, columns_of_cells, own_cell_columns
from taccorl.alignment.machines.cells_file import LOADS, READINGS, CellsConfig
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.quantisation import find_quantum
from taccorl.alignment.measurements.table_files import read_columns, table_origin
from taccorl.alignment.measurements.tables import POSITION, TIME_S
from taccorl.data.finding import Finding
from taccorl.errors import RecordingError

EVEN, LONGEST_GAP_S, LONGEST_GAP_ROWS = 0.1, 0.25, 5
"""Steps within the first share of the period are even; a gap longer than the second [s] and the third [periods] is not
bridged."""


@dataclass(frozen=True, kw_only=True)
class CellMeasurement(Measurement):
    """A recording of a sensor of cells: signals are cells, ``target`` is the load and ``measured`` the reading of each (T, J)."""

    known_units: ClassVar = tuple(READINGS)
    temperature_c: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T,) temperature [°C]; empty if it was not recorded."""
    position_mm: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T, 2) position of the probe [mm]; empty if all presses are at one place."""
    place: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """(T,) number of the place that is pressed, −1 in rows that are not used; empty if not known (``cell_places``)."""
    num_places: int = 0
    """Number P of places of the sensor; 0 while ``place`` is empty."""


def read_cell_table(path: Path, config: CellsConfig, spec: CellTableSpec | None = None) -> CellMeasurement:
    """Read a table as a measurement of the sensor, in the units of the cells file. Raises RecordingError: a column is missing, a
    cell of the table is empty or no number, time does not increase; the message names file, line or row, and column."""
    path = Path(path)

    def stated(header: list[str]) -> CellTableSpec:
        if spec is None:
            return own_cell_columns(path, header, config)
        return columns_of_cells(path, header, spec, config)

    header, columns = read_columns(path, lambda header: _wanted(stated(header)), spec)
    own = stated(header)
    time_s = own.time.quantity(columns[own.time.column]) * TIME_S[own.time.unit]
    if len(time_s) < 2:
        raise RecordingError(f"{path}: {len(time_s)} rows are too few for a measurement")
    steps = np.diff(time_s)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 2
        raise RecordingError(f"{path}: time does not increase at row {row}: {time_s[row - 1]:.6g} s; remove such rows")
    load_factor = LOADS[config.load.unit][1]
    load, reading = np.empty((2, len(time_s), config.num_cells))
    for k, name in enumerate(config.names):
        cell = own.cells[name]
        column = own.load if config.load.shared else cell.load
        assert column is not None
        load[:, k] = column.quantity(columns[column.column]) * (LOADS[column.unit][1] / load_factor)
        reading[:, k] = cell.reading.quantity(columns[cell.reading.column]) * (
            READINGS[cell.reading.unit][1] / READINGS[config.reading.unit][1]
        )
    position = [
        column.quantity(columns[column.column]) * (POSITION[column.unit][1] * 1e3)
        for column in ((own.position.x, own.position.y) if own.position else ())
    ]
    found = CellMeasurement(
        name=path.name,
        time_s=time_s - time_s[0],
        target=load,
        measured=reading,
        signals=config.names,
        units=(config.reading.unit,) * config.num_cells,
        quantum=np.array([find_quantum(column) for column in reading.T]),
        source=path,
        origin=table_origin(path, own),
        start_ns=round(time_s[0] * 1e9),
        temperature_c=columns[own.temperature.column] if own.temperature else np.empty(0),
        position_mm=np.column_stack(position) if position else np.empty(0),
    )
    return _even(found)


def _wanted(spec: CellTableSpec) -> list[str]:
    names = [spec.time.column, *(c.reading.column for c in spec.cells.values())]
    names += [c.column for c in (spec.load, *(cell.load for cell in spec.cells.values())) if c is not None]
    names += [spec.temperature.column] if spec.temperature else []
    names += [spec.position.x.column, spec.position.y.column] if spec.position else []
    return list(dict.fromkeys(names))


def _even(m: CellMeasurement) -> CellMeasurement:
    """At even times, by straight lines between rows. Raises RecordingError: a gap of more than ``LONGEST_GAP_S`` and
    ``LONGEST_GAP_ROWS``."""
    steps, period = np.diff(m.time_s), m.period_s
    if (np.abs(steps - period) < EVEN * period).all():
        return m
    gap = int(np.argmax(steps))
    if steps[gap] > max(LONGEST_GAP_S, LONGEST_GAP_ROWS * period):
        raise RecordingError(
            f"{m.source}: no row for {steps[gap]:.2f} s after {m.time_s[gap]:.2f} s; split the table there into two files"
        )
    even = m.resampled(1.0 / period)

    def also(column: np.ndarray) -> np.ndarray:
        return np.interp(even.time_s, m.time_s, column)

    temperature = also(m.temperature_c) if m.temperature_c.size else m.temperature_c
    position = np.column_stack([also(c) for c in m.position_mm.T]) if m.position_mm.size else m.position_mm
    text = (
        f"rows were not even (steps {1e3 * steps.min():.2f} … {1e3 * steps.max():.2f} ms): brought to {1 / period:.6g} Hz by "
        "straight lines. Log the driver's own stamps to avoid it"
    )
    finding = Finding("resampled", "warning", "time", text)
    return dataclasses.replace(even, temperature_c=temperature, position_mm=position, findings=(*m.findings, finding))
