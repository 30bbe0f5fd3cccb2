"""Measurements of a sensor of cells from CSV and parquet files: time, load and readings, one row an instant.

Without a columns file a table has ``t`` [s], the load as ``force_n``, ``pressure_pa`` or ``depth_m`` (``thumb.force_n`` … where
cells have loads of their own), for each cell ``thumb.reading`` in the unit of the cells file, and if recorded
``temperature_c``. A columns file states other names and units: ``docs/your_robot.md``, A force cell. For an array one pattern
states the columns of all cells, in place of ``cells:``. ``first`` is the number of the first cell; ``{row}`` and ``{column}``
are numbers of a grid. With ``{index}`` the cells of a grid are numbered ``order: row by row`` or ``order: column by column``,
and cells with names in the order of the cells file::

    array: {reading: {column: "taxel_{row}_{column}", unit: count}, first: 0}
    array: {reading: {column: "t{index}", unit: count}, first: 1, order: row by row}

Numbers may have leading zeros. Every cell must have one column, and every column that fits the pattern a cell.

The load of row k acted at the time of row k, and follows a straight line to the next. A table with uneven rows
comes to an even grid by straight lines between its rows.
"""

import dataclasses
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from taccorl.alignment.machines.cells_file import LOADS, READINGS, CellsConfig
from taccorl.alignment.measurements.even_rows import EVEN, LONGEST_GAP_S
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.quantisation import find_quantum
from taccorl.alignment.measurements.table_files import (
    first_ns,
    read_columns,
    table_origin,
)
from taccorl.alignment.measurements.tables import (
    POSITION,
    TIME_S,
    Column,
    ColumnsFile,
    stated_columns,
)
from taccorl.data.finding import Finding, listed
from taccorl.data.strict_yaml import Document, Rules
from taccorl.errors import RecordingError, nearest

_PLACE = re.compile(r"\{(\w*)\}")


@dataclass(frozen=True, kw_only=True)
class TemperatureColumn:
    """Which column of a table holds the temperature of the sensor [°C]."""

    column: str


@dataclass(frozen=True, kw_only=True)
class PositionColumns:
    """Columns with the position of the probe that presses the sensor: two coordinates in the plane of the cells. Origin and axes
    are free, but the same in all recordings."""

    x: Column  # Column of the coordinate along the first axis, with its unit of length
    y: Column  # Column of the coordinate along the second axis, at a right angle to the first


@dataclass(frozen=True, kw_only=True)
class CellColumns:
    """Which columns of a table hold the reading of one cell and the load that acts on it."""

    reading: Column  # Column of the reading
    load: Column | None = None  # Column of the load, if the cell has its own


@dataclass(frozen=True, kw_only=True)
class ArrayColumns(CellColumns):
    """Columns of all cells of an array; their names are patterns."""

    first: int  # Number from which the column names count cells, rows and columns: 0 or 1, say
    order: Literal["row by row", "column by column"] | None = None
    """Order in which ``{index}`` numbers the cells of a grid; None for other patterns."""


@dataclass(frozen=True, kw_only=True)
class CellTableSpec(ColumnsFile):
    """Names and units of a table's columns."""

    cells: dict[str, CellColumns] = field(
        default_factory=dict
    )  # Name of the cell → its columns; empty with ``array``
    array: ArrayColumns | None = (
        None  # Pattern of the column names of all cells; given instead of ``cells``
    )
    load: Column | None = (
        None  # Column of the load of all cells; None if each cell has its own
    )
    temperature: TemperatureColumn | None = None  # None if the table has no temperature
    position: PositionColumns | None = (
        None  # Position of the probe; None if all presses are at one place
    )


def load_cell_columns(path: Path, config: CellsConfig) -> CellTableSpec:
    """Load a columns file, and check it against the cells file. Raises SpecError: it is invalid; the message names file, line,
    key and remedy."""
    document = Document(CellTableSpec, Path(path))
    document.value.check(document)
    document.refuse(_rules(document.value, config))
    return document.value


def _rules(spec: CellTableSpec, config: CellsConfig) -> Rules:
    neither = "give `cells:` with the columns of each cell, or `array:` with a pattern for all"
    yield bool(spec.cells) == (spec.array is not None), "", neither
    if spec.array is not None:
        yield from _rules_of_array(spec.array, config)
    for name in spec.cells:
        unknown = f"the cells file has no cell {name!r}; {nearest(name, config.names)}"
        yield name not in config.names, f"cells/{name}", unknown
    lacking = [name for name in config.names if name not in spec.cells]
    yield (
        lacking and spec.array is None,
        "cells",
        f"cell {', '.join(map(repr, lacking[:1]))} of the cells file is missing",
    )
    at, same = spec.position, config.same_place_mm
    yield (
        at is None and same is not None,
        "position",
        "the probe's position is missing: the cells file has same_place_mm",
    )
    where = "write `same_place_mm:` in the cells file, the largest distance of presses at one place; or remove position"
    yield at is not None and same is None, "position", where
    for key, column in (("x", at.x), ("y", at.y)) if at else ():
        lengths = [unit for unit, (of, _) in POSITION.items() if of == "m"]
        no_length = f"{column.unit!r} is not a length; {nearest(column.unit, lengths)}"
        yield (
            POSITION.get(column.unit, ("",))[0] != "m",
            f"position/{key}/unit",
            no_length,
        )
    shared = config.load.shared
    stated = {f"cells/{name}": cell for name, cell in spec.cells.items()}
    for place, cell in (
        stated if spec.array is None else {"array": spec.array}
    ).items():
        yield _other_kind(
            cell.reading, READINGS, config.reading.unit, f"{place}/reading"
        )
        load, key = (spec.load, "load") if shared else (cell.load, f"{place}/load")
        states = (
            "all cells share one load"
            if shared
            else "each cell has a load of its own (shared: false)"
        )
        yield load is None, key, f"is missing: the cells file states that {states}"
        assert load is not None
        yield _other_kind(load, LOADS, config.load.unit, key)
        for where, column in ((f"{place}/reading", cell.reading), (key, load)):
            yield column.factor == 0.0, f"{where}/factor", "is 0; give another number"
            always = "a cell has a reading and a load in every recording; remove it"
            yield column.if_missing is not None, f"{where}/if_missing", always


def _other_kind(
    column: Column, units: Mapping[str, tuple[str, float]], unit: str, key: str
) -> tuple[bool, str, str]:
    """Rule: the unit of a column has the kind of the cells file's ``unit``."""
    kind = units[unit][0]
    alike = nearest(
        column.unit, [other for other, (of, _) in units.items() if of == kind]
    )
    text = f"{column.unit!r} is not of the same kind as the cells file's unit {unit}; {alike}"
    return units.get(column.unit, ("",))[0] != kind, f"{key}/unit", text


def _rules_of_array(array: ArrayColumns, config: CellsConfig) -> Rules:
    """An array's placeholders are known and complete, and the order of its cells is stated."""
    yield array.first < 0, "array/first", f"{array.first} is below 0"
    for key, column in (("reading", array.reading), ("load", array.load)):
        if column is None:
            continue
        where, found = f"array/{key}/column", _PLACE.findall(column.column)
        text = f"{column.column!r}: a pattern has {{index}} once, or {{row}} and {{column}} once each, in quotes"
        wrong = sorted(found) not in (["column", "row"], ["index"])
        yield wrong, where, f'{text}: "t{{index}}", "taxel_{{row}}_{{column}}"'
        of_grid = "{row} and {column} are of a grid, but the cells file gives names: write {index}"
        yield "row" in found and config.cells, where, of_grid
        ordered, order = "index" in found and not config.cells, "array/order"
        missing = "is missing: write `order: row by row` or `order: column by column` of a grid"
        yield ordered and array.order is None, order, missing
        yield (
            not ordered and array.order is not None,
            order,
            "is only for {index} of a grid",
        )


def columns_of_cells(
    path: Path, header: list[str], spec: CellTableSpec, config: CellsConfig
) -> CellTableSpec:
    """``spec`` with the columns of each cell in place of the pattern of an array. ``path``: the table, for messages. ``header``:
    names of its columns. Raises RecordingError: no column fits the pattern, a cell has none or two, or a column fits and has no
    cell."""
    array = spec.array
    if array is None:
        return spec
    reading = _matched(path, header, array.reading, array, config)
    load = (
        [None] * config.num_cells
        if array.load is None
        else _matched(path, header, array.load, array, config)
    )
    cells = {
        name: CellColumns(reading=own, load=pressed)
        for name, own, pressed in zip(config.names, reading, load, strict=True)
    }
    return dataclasses.replace(spec, cells=cells, array=None)


def _matched(
    path: Path,
    header: list[str],
    pattern: Column,
    array: ArrayColumns,
    config: CellsConfig,
) -> list[Column]:
    """The columns that fit ``pattern``, in the order of the cells."""
    text, first = pattern.column, array.first
    parts = _PLACE.split(text)  # text, placeholder, text, …
    form = re.compile(
        "".join(
            f"(?P<{p}>[0-9]+)" if k % 2 else re.escape(p) for k, p in enumerate(parts)
        )
    )
    rows, columns = config.shape
    if "index" in parts:
        numbers = [{"index": k} for k in range(config.num_cells)]
        if array.order == "column by column":
            numbers = [
                {"index": j * rows + i} for i in range(rows) for j in range(columns)
            ]
    else:
        numbers = [{"row": i, "column": j} for i in range(rows) for j in range(columns)]
    wanted = {
        tuple(n + first for n in cell.values()): k for k, cell in enumerate(numbers)
    }
    found: dict[int, str] = {}
    for name in header:
        match = form.fullmatch(name)
        if match is None:
            continue
        k = wanted.get(tuple(int(match[key]) for key in numbers[0]))
        if k is None:
            shape = (
                f"{config.num_cells} cells"
                if config.cells
                else f"{rows} × {columns} cells"
            )
            raise RecordingError(
                f"{path}: column {name!r} fits {text!r}, but is none of {shape} counted from {first}; correct `first` in the "
                "columns file, or the cells of the cells file"
            )
        if k in found:
            raise RecordingError(
                f"{path}: columns {found[k]!r} and {name!r} are the same cell of {text!r}; keep one"
            )
        found[k] = name
    if not found:
        shown = ", ".join(header[:6]) + (" …" if len(header) > 6 else "")
        raise RecordingError(
            f"{path}: no column fits the pattern {text!r} of the columns file; the table has {shown}"
        )
    lacking = [
        _PLACE.sub(lambda m, cell=cell: str(cell[m[1]] + first), text)
        for k, cell in enumerate(numbers)
        if k not in found
    ]
    if lacking:
        raise RecordingError(
            f"{path}: {len(lacking)} of {config.num_cells} cells have no column: {listed(lacking, 6)}; correct `first` in the "
            "columns file, or the cells of the cells file"
        )
    return [
        dataclasses.replace(pattern, column=found[k]) for k in range(config.num_cells)
    ]


def own_cell_columns(
    path: Path, header: list[str], config: CellsConfig
) -> CellTableSpec:
    """Columns of a table with taccorl's own names. ``header``: names of its columns. Raises RecordingError: a column is missing
    or unknown; the message names file, column and remedy."""
    load = LOADS[config.load.unit][0]
    known = ["t", "temperature_c", *(f"{name}.reading" for name in config.names)]
    place = ["x_mm", "y_mm"] if config.same_place_mm is not None else []
    loads = (
        [load] if config.load.shared else [f"{name}.{load}" for name in config.names]
    )
    for column in header:
        if column not in (*known, *place, *loads):
            raise RecordingError(
                f"{path}: column {column!r} is not a column of this sensor ({nearest(column, [*known, *place, *loads])}). "
                "Other names and units must be stated in a columns file (--columns; "
                "taccorl/alignment/machines/cell_tables.py shows one)"
            )
    for column in ("t", *place, *loads, *(f"{name}.reading" for name in config.names)):
        if column not in header:
            raise RecordingError(
                f"{path}: no column {column!r}; it has {', '.join(header)}. Other names and units must be stated in a columns "
                "file (--columns; taccorl/alignment/machines/cell_tables.py shows one)"
            )
    unit = {"force_n": "N", "pressure_pa": "Pa", "depth_m": "m"}[load]
    own = {
        name: CellColumns(
            reading=Column(column=f"{name}.reading", unit=config.reading.unit),
            load=None
            if config.load.shared
            else Column(column=f"{name}.{load}", unit=unit),
        )
        for name in config.names
    }
    return CellTableSpec(
        time=Column(column="t", unit="s"),
        cells=own,
        load=Column(column=load, unit=unit) if config.load.shared else None,
        temperature=TemperatureColumn(column="temperature_c")
        if "temperature_c" in header
        else None,
        position=PositionColumns(
            x=Column(column="x_mm", unit="mm"), y=Column(column="y_mm", unit="mm")
        )
        if place
        else None,
    )


LONGEST_GAP_ROWS = 5
"""A gap longer than so many periods, and than ``LONGEST_GAP_S``, is not bridged."""


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
    num_places: int = 0  # Number P of places of the sensor; 0 while ``place`` is empty

    @property
    def columns(self) -> list[str]:
        return [
            *super().columns,
            *(
                name
                for name in ("temperature_c", "position_mm")
                if getattr(self, name).size
            ),
        ]


def cells_of(measurements: Iterable[Measurement]) -> list[CellMeasurement]:
    """Those of ``measurements`` that are of a sensor of cells."""
    return [m for m in measurements if isinstance(m, CellMeasurement)]


def read_cell_table(
    path: Path, config: CellsConfig, spec: CellTableSpec | None = None
) -> CellMeasurement:
    """Read a table as a measurement of the sensor, in the units of the cells file. Raises RecordingError: a column is missing, a
    cell of the table is empty or no number, time does not increase; the message names file, line or row, and column."""
    path = Path(path)

    def stated(header: list[str]) -> CellTableSpec:
        if spec is None:
            return own_cell_columns(path, header, config)
        return columns_of_cells(path, header, spec, config)

    def wanted(header: list[str]) -> list[str]:
        own = stated(header)
        names = [column.column for column in stated_columns(own)]
        names += [own.temperature.column] if own.temperature else []
        return list(dict.fromkeys(names))

    header, columns = read_columns(path, wanted, spec)
    own = stated(header)
    time_s = own.time.quantity(columns[own.time.column]) * TIME_S[own.time.unit]
    if len(time_s) < 2:
        raise RecordingError(
            f"{path}: {len(time_s)} rows, too few for a measurement; record it again, or remove the file"
        )
    steps = np.diff(time_s)
    if not (steps > 0).all():
        row = int(np.argmin(steps > 0)) + 2
        raise RecordingError(
            f"{path}: time does not increase at row {row}: {time_s[row - 1]:.6g} s; remove such rows"
        )
    load_factor = LOADS[config.load.unit][1]
    load, reading = np.empty((2, len(time_s), config.num_cells))
    for k, name in enumerate(config.names):
        cell = own.cells[name]
        column = own.load if config.load.shared else cell.load
        assert column is not None
        load[:, k] = column.quantity(columns[column.column]) * (
            LOADS[column.unit][1] / load_factor
        )
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
        start_ns=first_ns(path, time_s),
        temperature_c=columns[own.temperature.column]
        if own.temperature
        else np.empty(0),
        position_mm=np.column_stack(position) if position else np.empty(0),
    )
    return _even(found)


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
    text = (
        f"rows were not even (steps {1e3 * steps.min():.2f} … {1e3 * steps.max():.2f} ms): brought to {1 / period:.6g} Hz by "
        "straight lines. Log the driver's own stamps to avoid it"
    )
    finding = Finding("resampled", "warning", "time", text)
    return dataclasses.replace(
        m.resampled(1.0 / period), findings=(*m.findings, finding)
    )
