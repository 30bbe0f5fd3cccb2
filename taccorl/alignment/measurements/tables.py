"""Measurements from CSV, parquet and MATLAB files: each row is one instant, each column (in a .mat file: each variable) one
quantity. Without a columns file the table must have taccorl's own names: ``t`` [s], and for every signal ``left_joint5.q`` [rad,
m], ``left_joint5.q_target``, and, if recorded, ``left_joint5.qd`` [rad/s, m/s], ``left_joint5.tau`` [N·m, N] and
``left_joint5.load`` [N·m, N], a known external torque on the joint, positive forwards. A single axis may also have
``servo.torque_ff`` [N·m, N], which its controller adds to the law, ``servo.supply`` [V] and ``servo.enabled``, 0 while its motor
is off. Other names and units are written down in a columns file; no unit is ever guessed::

    time: {column: stamp, unit: ms}
    signals:
      left_joint5:
        q:        {column: pos_5, unit: deg, factor: 0.0879, zero: 2048}   # ticks, 2048 where the joint is at 0
        q_target: {column: cmd_5, unit: deg}
        qd:       {column: speed_5, unit: rpm}
        tau:      {column: current_5, unit: Nm, factor: 0.000082}    # mA, 0.082 Nm/A; a factor of -1 mends a sign
        # sign_bit: 1024, of a register in sign and magnitude; wraps_at: 65536, of one in two's complement, read without its sign
        supply:   {column: volts_5, unit: V, factor: 0.1}            # of an axis or robot file with law pwm
        enabled:  {column: torque_enable_5, unit: "1", if_missing: 1}   # of a file that lacks the column

Of a table with taccorl's own names it may state only what differs: ``changes: {left_joint5.q: {factor: -1}}``, or the
``column:`` that holds it, or ``target_rows_late: 1`` alone.

A CSV file may state its origin in lines before the header, ``# domain: surrogate`` and ``# origin: …``, which stay with a copy of
it. A columns file that states another domain is refused.

CSV files are UTF-8, or as their byte order mark states (UTF-8, UTF-16), with commas between columns and decimal points. A columns
file may state others: ``separator: semicolon``, ``decimal: comma``, ``encoding: latin-1``.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.alignment.measurements.even_rows import even_rows
from taccorl.alignment.measurements.measurement import Measurement, TargetKind, unit_of
from taccorl.alignment.measurements.quantisation import find_quantum
from taccorl.alignment.measurements.registers import (
    Register,
    UnsignedColumn,
    as_text,
    find_registers,
    possible_registers,
)
from taccorl.alignment.measurements.table_files import (
    SUFFIXES,
    FileForm,
    first_ns,
    read_columns,
    table_origin,
)
from taccorl.data.origin import Origin
from taccorl.data.strict_yaml import Document, Rules
from taccorl.errors import RecordingError, nearest
from taccorl.robots import ROBOT

_TURN, _DEG = 2 * math.pi, math.pi / 180
TIME_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0}
"""Unit of time → seconds."""
POSITION = {
    "rad": ("rad", 1.0),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", _DEG),
    "mdeg": ("rad", 1e-3 * _DEG),
    "rev": ("rad", _TURN),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
    "µm": ("m", 1e-6),
}
"""Unit of a position → (rad or m, factor to it)."""
VELOCITY = {
    "rad/s": ("rad", 1.0),
    "mrad/s": ("rad", 1e-3),
    "deg/s": ("rad", _DEG),
    "rpm": ("rad", _TURN / 60),
    "rev/s": ("rad", _TURN),
    "m/s": ("m", 1.0),
    "cm/s": ("m", 1e-2),
    "mm/s": ("m", 1e-3),
}
"""Unit of a velocity → (unit of the position that it goes with, factor to that per second)."""
EFFORT = {
    "Nm": ("rad", 1.0),
    "N·m": ("rad", 1.0),
    "Ncm": ("rad", 1e-2),
    "Nmm": ("rad", 1e-3),
    "mNm": ("rad", 1e-3),
    "kgcm": ("rad", 0.0980665),
    "N": ("m", 1.0),
    "kN": ("m", 1e3),
    "mN": ("m", 1e-3),
}
"""Unit of an effort → (unit of the position that it goes with, factor to N·m or N). Amperes are no effort: a torque
constant is somebody's guess until it is written down as a column in N·m."""
_CONVERSIONS = {
    "q": POSITION,
    "q_target": POSITION,
    "qd": VELOCITY,
    "tau": EFFORT,
    "load": EFFORT,
    "qd_target": VELOCITY,
    "tau_target": EFFORT,
    "torque_ff": EFFORT,
    "supply": {"V": ("", 1.0), "mV": ("", 1e-3)},
    "enabled": {"1": ("", 1.0)},
}
_CURRENT = "; a current needs its motor's torque constant: write `unit: Nm` with `factor:` in Nm a unit of the column"
_HINTS: dict[str, str] = {
    **dict.fromkeys(
        ("ticks", "tick", "counts", "count"),
        "; write `unit: rad` with `factor:` in rad a tick",
    ),
    "A": _CURRENT,
    "mA": _CURRENT,
}
TARGETS: dict[str, TargetKind] = {
    "q_target": "position",
    "qd_target": "velocity",
    "tau_target": "torque",
}
"""Column of a target → what it states; a signal has one of them. Without any, its effort ``tau`` is the input of the model
(law ``effort``)."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column of the table, with its unit: quantity = (number − ``zero``) · ``factor`` [``unit``], of the signed number where
    a register was logged without its sign."""

    column: str
    unit: str  # Unit of the quantity, such as a key of ``TIME_S``, ``POSITION``, ``VELOCITY`` or ``EFFORT``
    factor: float = 1.0
    """Factor from the column's numbers to ``unit``: turns per tick, N·m per mA, or −1 to reverse the sign."""
    zero: float = 0.0
    """The column's number at 0 of its quantity, such as 512 counts or a pulse of 1500 µs; subtracted before ``factor``."""
    sign_bit: float | None = None
    """Number of the sign bit of a register in sign and magnitude, such as 1024 of bit 10: 1033 is −9."""
    wraps_at: float | None = None
    """Number of values of a register in two's complement, such as 65536 of 16 bits: 65527 is −9."""
    unwrap: bool = False
    """True of an angle that jumps by a full turn where it passes ± half a turn: the turns are added, and the target is
    that within half a turn of the position. Of ``q`` and ``q_target`` of a hinge."""
    if_missing: float | None = (
        None  # Value for files without the column; if not given, such a file is rejected
    )

    def quantity(self, numbers: np.ndarray) -> np.ndarray:
        """(any shape) the quantity [``unit``] for the column's ``numbers``, of the same shape."""
        register = self.register
        if register is not None:
            numbers = register.decoded(numbers)
        elif numbers.dtype == object:  # of 64 bits: 0 is taken off before it is rounded
            whole = self.zero == int(self.zero)
            numbers = numbers - (int(self.zero) if whole else self.zero)
            return numbers.astype(float) * self.factor
        return (numbers - self.zero) * self.factor

    @property
    def register(self) -> Register | None:
        """Register whose unsigned numbers the column holds; None: they are signed."""
        if self.sign_bit is not None:
            return Register("sign_bit", self.sign_bit)
        return None if self.wraps_at is None else Register("wraps_at", self.wraps_at)

    def wrong_register(self) -> str:
        """What is wrong with ``sign_bit`` and ``wraps_at``; empty if nothing is."""
        if self.sign_bit is not None and self.wraps_at is not None:
            return "sign_bit and wraps_at exclude each other: a register is in sign and magnitude or in two's complement"
        value = self.register.value if self.register else 1.0
        if not math.isfinite(value) or value <= 0.0:
            return f"{value:g}; give the number of the sign bit, or of all values, such as 1024 or 65536"
        return ""


@dataclass(frozen=True, kw_only=True)
class Change:
    """What differs at one column from taccorl's own names and units; fields as of ``Column``, None: nothing."""

    column: str | None = None
    unit: str | None = None
    factor: float | None = None
    zero: float | None = None
    sign_bit: float | None = None
    wraps_at: float | None = None
    unwrap: bool | None = None


@dataclass(frozen=True, kw_only=True)
class SignalColumns:
    """Columns of one signal; None for quantities that the table does not have."""

    q: Column  # Measured position
    q_target: Column | None = (
        None  # Commanded position; one of the target columns is given, or none where ``tau`` is
    )
    qd_target: Column | None = None  # Commanded velocity
    tau_target: Column | None = None  # Commanded torque; 0 while the motor is off
    qd: Column | None = None  # Measured velocity
    tau: Column | None = None  # Effort of the motor
    load: Column | None = (
        None  # Known external torque, positive if it drives the joint forwards
    )
    torque_ff: Column | None = None  # Torque that the controller adds to its law
    supply: Column | None = None
    """Supply voltage of the motor (V or mV): it scales the motor's torque in law pwm; with another law it is an error."""
    enabled: Column | None = None  # 0 while the motor is off, else 1


@dataclass(frozen=True, kw_only=True)
class ColumnsFile(FileForm):
    """Keys that every columns file may have."""

    time: Column  # Column of the rows' times

    def check(self, document: Document[Any]) -> None:
        """Raises SpecError: a separator, text encoding or unit of time that is not supported."""
        super().check(document)
        if (unit := self.time.unit) not in TIME_S:
            raise document.error(
                "time/unit", f"{unit!r} is not a unit of time; {nearest(unit, TIME_S)}"
            )


@dataclass(frozen=True, kw_only=True)
class TableSpec(ColumnsFile):
    """Names and units of a table's columns."""

    time: Column = field(default_factory=lambda: Column(column="t", unit="s"))
    signals: dict[str, SignalColumns] = field(default_factory=dict)
    """Signal → its columns. The robot's signals are ``left_joint1`` … ``right_gripper``; others may have any name."""
    changes: dict[str, Change] = field(default_factory=dict)
    """Column of a table with taccorl's own names, which has them without ``signals`` → what differs there."""
    target_rows_late: int = 0
    """Number of rows by which the file states targets too late: 1 if row k holds the target that was in force from row k − 1 on,
    −1 if it holds that of row k + 1."""
    instruction: str = ""  # Task text of the recordings; empty if there is none


def is_table(m: Measurement) -> bool:
    """True if a measurement was read from a table (with a columns file), not from a recording (with a recording spec)."""
    return m.source.suffix in SUFFIXES


def load_table_spec(path: Path) -> TableSpec:
    """Load and check a columns file. Raises SpecError: it is invalid; the message names file, line, key and remedy."""
    document = Document(TableSpec, Path(path))
    document.value.check(document)
    document.refuse(_rules(document.value))
    return document.value


def _rules(spec: TableSpec) -> Rules:
    both = "stands beside changes, which are to a table with taccorl's own names; keep one of the two"
    yield spec.signals and spec.changes, "signals", both
    for name, signal in spec.signals.items():
        place, kinds = f"signals/{name}", dict[str, str]()
        num = sum(getattr(signal, key) is not None for key in TARGETS)
        yield (
            num > 1,
            place,
            f"has {num} targets; one of {', '.join(TARGETS)} commands it",
        )
        none = "key 'q_target' is missing; or qd_target, tau_target, or tau alone for a file with law: effort"
        yield num == 0 and signal.tau is None, place, none
        for key, column in _columns_of(signal):
            known, where = _CONVERSIONS[key], f"{place}/{key}/unit"
            alike = f"{nearest(column.unit, known)}{_HINTS.get(column.unit, '')}"
            yield (
                column.unit not in known,
                where,
                f"{column.unit!r} is not a unit of {key}; {alike}",
            )
            yield (
                not math.isfinite(column.zero),
                f"{place}/{key}/zero",
                f"{column.zero:g}; give a finite number",
            )
            wrong = not math.isfinite(column.factor) or column.factor == 0.0
            yield (
                wrong,
                where,
                f"factor {column.factor:g}; give a finite number other than 0",
            )
            yield (
                column.unwrap and not _is_angle(key, column),
                f"{place}/{key}/unwrap",
                "is of q and q_target of a hinge; remove it here",
            )
            wrong = column.wrong_register()
            yield (
                wrong,
                f"{place}/{key}/{column.register.key if column.register else 'sign_bit'}",
                wrong,
            )
            if known[column.unit][0]:
                kinds.setdefault(known[column.unit][0], f"{key} in {column.unit}")
        mixed = "units of rotation and of translation are mixed; is the joint a hinge or a slide?"
        yield len(kinds) > 1, place, f"{' and '.join(kinds.values())}: {mixed}"
        if name in ROBOT.action_names:
            unit = unit_of(name)
            must = f"the robot's signal {name} must be in {unit} or a multiple of it, such as m{unit}"
            yield (
                POSITION[signal.q.unit][0] != unit,
                f"{place}/q/unit",
                f"{signal.q.unit!r}: {must}",
            )
    twice = _used_twice(spec)
    yield twice, "signals", twice


def _is_angle(key: str, column: Column) -> bool:
    """Whether a column is an angle, which may be wrapped."""
    return key in ("q", "q_target") and POSITION[column.unit][0] == "rad"


def _used_twice(spec: TableSpec) -> str:
    names = [column.column for column in stated_columns(spec)]
    twice = sorted(name for name in names if names.count(name) > 1)
    return f"column {twice[0]!r} is used twice" if twice else ""


def stated_columns(of: Any) -> Iterator[Column]:
    """All columns that a columns file, or a part of it, states, in its order."""
    if isinstance(of, Column):
        yield of
    elif isinstance(of, Mapping):
        for part in of.values():
            yield from stated_columns(part)
    elif is_dataclass(of):
        yield from stated_columns({f.name: getattr(of, f.name) for f in fields(of)})


def _resolved(
    path: Path,
    header: list[str],
    spec: TableSpec | None,
    units: Mapping[str, str] | None,
) -> TableSpec:
    """``spec``, or that of taccorl's own names with its ``changes``."""
    if spec is not None and spec.signals:
        return spec
    own = _own_spec(path, header, units)
    for column, change in {} if spec is None else spec.changes.items():
        name, _, key = column.rpartition(".")
        if (
            name not in own.signals
            or (old := getattr(own.signals[name], key, None)) is None
        ):
            raise RecordingError(
                f"{path}: changes: no column {column!r}; {nearest(column, header)}"
            )
        new, kinds = (
            replace(old, **{k: v for k, v in vars(change).items() if v is not None}),
            _CONVERSIONS[key],
        )
        is_alike = new.unit in kinds and kinds[new.unit][0] == kinds[old.unit][0]
        if wrong := new.wrong_register():
            raise RecordingError(f"{path}: changes: {column}: {wrong}")
        if is_alike and new.unwrap and not _is_angle(key, new):
            raise RecordingError(
                f"{path}: changes: {column}: unwrap is of q and q_target of a hinge; remove it here"
            )
        if (
            not is_alike
            or not math.isfinite(new.zero)
            or not math.isfinite(new.factor)
            or new.factor == 0.0
        ):
            way_out = (
                "finite numbers, and a factor other than 0"
                if is_alike
                else f"a unit of the kind of {old.unit}"
            )
            raise RecordingError(f"{path}: changes: {column}: {new}; give {way_out}")
        own.signals[name] = replace(own.signals[name], **{key: new})
    if twice := _used_twice(own):
        raise RecordingError(
            f"{path}: changes: {twice}; state which one takes its place"
        )
    return own if spec is None else replace(spec, signals=own.signals)


def _columns_of(signal: SignalColumns) -> Iterable[tuple[str, Column]]:
    return [
        (own.name, column)
        for own in fields(signal)
        if (column := getattr(signal, own.name)) is not None
    ]


def _expected(units: Mapping[str, str]) -> str:
    """The columns that a table must have, and a columns file for other names, with TODO for what only its user knows."""
    name, unit = next(iter(units.items()))
    return (
        f"Expected: t [s], {name}.q, {name}.q_target [{unit}], where recorded {name}.qd, {name}.tau; joints: "
        f"{', '.join(units)}. For other names or units write a file --columns=columns.yaml: {{time: {{column: TODO, unit: s}}, "
        f"signals: {{{name}: {{q: {{column: TODO, unit: {unit}}}, q_target: {{column: TODO, unit: {unit}}}}}}}}}"
    )


def _own_spec(
    path: Path, header: list[str], units: Mapping[str, str] | None = None
) -> TableSpec:
    """Columns of a table with taccorl's own names. ``units``: signal of the machine → unit of its position, the PiPER's if None.
    Raises RecordingError: ``t`` or a position or a target is missing, or a column is unknown; the message names file and
    column."""
    known = (
        {name: unit_of(name) for name in ROBOT.action_names} if units is None else units
    )
    if "t" not in header:
        has = f"it has {', '.join(header[:6])}{' …' if len(header) > 6 else ''}"
        raise RecordingError(f"{path}: no column 't' [s]; {has}. {_expected(known)}")
    parts: dict[str, set[str]] = {}
    for k, column in enumerate(header):
        name, _, key = column.rpartition(".")
        if column == "t":
            continue
        if key not in _CONVERSIONS or not name:
            own = [f"{n}.{key}" for n in known for key in _CONVERSIONS]
            raise RecordingError(
                f"{path}: column {k + 1} {column!r} is not NAME.{', .'.join(_CONVERSIONS)} ({nearest(column, own, most=4)}). "
                f"{_expected(known)}"
            )
        if name not in known:
            whose = "the machine of --twin"
            if {*known} <= {*ROBOT.action_names}:
                whose = "without a robot file (--twin=robot.yaml, which `taccorl init-robot` writes) the machine is a "
                whose += "two-arm PiPER, which"
            raise RecordingError(
                f"{path}: column {k + 1} {column!r}: {whose} has no {name!r} ({nearest(name, known)}). A columns file gives "
                "columns of other names"
            )
        parts.setdefault(name, set()).add(key)
    for name, keys in parts.items():
        targets = [key for key in TARGETS if key in keys]
        if len(targets) > 1:
            raise RecordingError(
                f"{path}: {name} has several targets, {' and '.join(targets)}; keep the one that commands it, and remove the "
                "others"
            )
        for needed in (
            "q",
            *(["q_target"] if not targets and "tau" not in keys else []),
        ):
            if needed not in keys:
                hint = (
                    "; or give tau, for a file with law: effort"
                    if needed == "q_target"
                    else ""
                )
                raise RecordingError(
                    f"{path}: column '{name}.{needed}' is missing; {name} has {', '.join(sorted(keys))}{hint}"
                )

    def named(name: str, key: str) -> Column:
        unit = known[name]
        of = {
            "q": unit,
            "q_target": unit,
            "qd": f"{unit}/s",
            "qd_target": f"{unit}/s",
            "supply": "V",
            "enabled": "1",
        }
        return Column(
            column=f"{name}.{key}", unit=of.get(key, "Nm" if unit == "rad" else "N")
        )

    names = sorted(parts, key=list(known).index)
    signals = {
        name: SignalColumns(**{key: named(name, key) for key in parts[name]})
        for name in names
    }
    if not signals:
        raise RecordingError(f"{path}: it has a time column, but no signal")
    return TableSpec(time=Column(column="t", unit="s"), signals=signals)


def read_table(
    path: Path, spec: TableSpec | None = None, units: Mapping[str, str] | None = None
) -> Measurement:
    """Read a CSV, parquet or MATLAB file as a measurement. Uneven rows are resampled to an even grid (``even_rows``). ``spec``:
    names and units of its columns; taccorl's own names if not given. ``units``: signal of the machine → unit of its position,
    for a table without a spec; the PiPER's if not given. Raises RecordingError: a column is missing, or a cell is empty or not
    a number; the message names file, line and column."""
    path = Path(path)
    header, columns = read_columns(
        path,
        lambda own: wanted_columns(_resolved(path, own, spec, units), own),
        spec,
        exact=True,
    )
    resolved = _resolved(path, header, spec, units)
    return measurement_of_columns(
        path,
        columns,
        resolved,
        name=path.name,
        origin=table_origin(path, resolved),
        own_names=spec is None or not spec.signals,
    )


def measurement_of_columns(
    path: Path,
    columns: Mapping[str, np.ndarray],
    spec: TableSpec,
    *,
    name: str,
    origin: Origin,
    own_names: bool = False,
) -> Measurement:
    """Make a ``Measurement`` of one table read from ``path``. Uneven rows are resampled to an even grid (``even_rows``).

    ``columns``: name of each column of ``spec`` → its numbers (T,). ``own_names``: the table has taccorl's own names. Raises
    RecordingError: there are too few rows, a motor is neither on nor off, or a number is none of its register."""
    time = columns[spec.time.column].astype(float)
    time_s = time * spec.time.factor * TIME_S[spec.time.unit]
    if len(time_s) < 2:
        raise RecordingError(
            f"{path}: {len(time_s)} rows, too few for a measurement; record it again, or remove the file"
        )
    shape = (len(time_s), len(spec.signals))
    nothing = {"load": 0.0, "torque_ff": 0.0, "enabled": 1.0}
    values = {key: np.full(shape, nothing.get(key, np.nan)) for key in _CONVERSIONS}
    units = []
    kinds: list[TargetKind] = []
    registers: list[UnsignedColumn] = []
    for j, signal in enumerate(spec.signals.values()):
        units.append(POSITION[signal.q.unit][0])
        for key, column in _columns_of(signal):
            if key in TARGETS:
                kinds.append(TARGETS[key])
            read = (
                columns[column.column]
                if column.column in columns
                else np.full(len(time_s), column.if_missing)
            )
            if column.register is not None:
                _check_register(path, column, read)
            elif key in ("q", "q_target", "tau") and column.zero == 0.0:
                registers += _unsigned(
                    own_names, list(spec.signals)[j], key, column, read
                )
            numbers = column.quantity(read) * _CONVERSIONS[key][column.unit][1]
            if column.unwrap:
                numbers = np.unwrap(numbers)
            values["q_target" if key in TARGETS else key][:, j] = numbers
        if signal.q_target is not None and signal.q_target.unwrap:
            off = np.nanmedian(values["q_target"][:, j] - values["q"][:, j])
            if np.isfinite(off):
                values["q_target"][:, j] -= _TURN * np.round(off / _TURN)
        if not any(
            getattr(signal, key) for key in TARGETS
        ):  # the model is held where this was measured
            kinds.append("effort")
            values["q_target"][:, j] = values["q"][:, j]
    between = ~np.isin(values["enabled"], (0.0, 1.0))
    if between.any():
        row, j = np.argwhere(between)[0]
        raise RecordingError(
            f"{path}: row {row + 1} after the header: {list(spec.signals)[j]}.enabled is {values['enabled'][row, j]:g}; write 0 "
            "while the motor is off, else 1"
        )

    def extra(key: str) -> np.ndarray:
        return (
            values[key][rows]
            if any(getattr(s, key) for s in spec.signals.values())
            else np.empty(0)
        )

    late = spec.target_rows_late
    if abs(late) >= len(time_s) - 1:
        raise RecordingError(
            f"{path}: target_rows_late {late} removes all {len(time_s)} rows"
        )
    rows = slice(
        max(0, -late), len(time_s) - max(0, late)
    )  # rows for which the target in force is in the file
    start = time_s[rows][0]
    found = Measurement(
        name=name,
        time_s=time_s[rows] - start,
        target=values["q_target"][rows.start + late : rows.stop + late],
        measured=values["q"][rows],
        velocity=values["qd"][rows],
        effort=values["tau"][rows],
        load=extra("load"),
        torque_ff=extra("torque_ff"),
        supply_v=extra("supply"),
        enabled=extra("enabled"),
        signals=tuple(spec.signals),
        units=tuple(units),
        target_kinds=tuple(kinds),
        quantum=np.array([find_quantum(column) for column in values["q"].T]),
        source=path,
        origin=origin,
        registers=tuple(
            replace(own, row=max(own.row - rows.start, 0)) for own in registers
        ),
        instruction=spec.instruction,
        start_ns=first_ns(path, time_s[rows]),
    )
    return even_rows(found)


def _check_register(path: Path, column: Column, numbers: np.ndarray) -> None:
    """Raises RecordingError: the column holds a number that its register cannot hold."""
    register = column.register
    assert register is not None, "the caller has asked"
    bad = np.flatnonzero(~register.holds(numbers))
    if len(bad):
        raise RecordingError(
            f"{path}: column {column.column!r}: {numbers[bad[0]]:.12g} in row {bad[0] + 1} after the header is no number of a "
            f"register with {register.key}: {as_text(register.value)}, which holds 0 … below {as_text(register.end)}; correct "
            f"{register.key}, or remove it where the column is signed"
        )


def _unsigned(
    own_names: bool, signal: str, key: str, column: Column, numbers: np.ndarray
) -> Iterator[UnsignedColumn]:
    """Registers that may have been logged without their sign in this column, each with the line that reads it."""
    found = find_registers(numbers)
    if key == "tau" and not any(changes for _, changes, _ in found):
        known = {register for register, _, _ in found}
        others = [own for own in possible_registers(numbers) if own not in known]
        found += [(register, 0, 0) for register in others]
    for register, changes, row in found:
        if key != "tau" and (not changes or register.key == "sign_bit"):
            continue  # a position may lie anywhere, and jumps where its sensor wraps
        side = -1.0 if register.key == "zero" and numbers.max() <= 0 else 1.0
        new = replace(column, **{register.key: side * register.value})
        stated = [
            f"{name}: {as_text(value)}"
            for name, usual in {
                "factor": 1.0,
                "zero": 0.0,
                "sign_bit": None,
                "wraps_at": None,
            }.items()
            if (value := getattr(new, name)) != usual
        ]
        # A table with own names has these units.
        unit = (
            [] if column.unit in ("rad", "m", "Nm", "N") else [f"unit: {column.unit}"]
        )
        moved = [f"column: {column.column}"] * (column.column != f"{signal}.{key}")
        line = f"changes: {{{signal}.{key}: {{{', '.join([*moved, *unit, *stated])}}}}}"
        if not own_names:
            both = f"column: {column.column}, unit: {column.unit}"
            line = f"{key}: {{{', '.join([both, *stated])}}}"
        step = register.value * column.factor * _CONVERSIONS[key][column.unit][1]
        yield UnsignedColumn(signal, key, register, step, line, changes, row)


def wanted_columns(spec: TableSpec, header: list[str]) -> list[str]:
    """Columns to read of a table with this ``header``: all of ``spec`` but those that may be missing and are."""
    return [
        column.column
        for column in stated_columns(spec)
        if column.if_missing is None or column.column in header
    ]
