"""Read all measurements of a folder, divided into those for fitting, for validation and for test. A folder of recordings may
hold a ``measurements.yaml`` with facts that the files do not state::

    spec: piper_flexitac_mcap         # how its recordings are read; not needed where only one shipped spec reads the format
    columns: columns.yaml             # names and units of its tables, and of datasets that do not state them
    validation_every: 3                 # every third motion judges; or say it recording by recording
    recordings:
      sweep_05.mcap: {use: validation}
      sweep_02.mcap: {repeat_of: sweep_01.mcap}
      sweep_03.mcap: {kp: {left_joint5: 40}, kd: {left_joint5: 4}, effort_scale: {left_joint1: 0.25}}
      sweep_04.mcap: {payload_kg: {left: 0.5}, payload_position_m: {left: [0, 0, 0.2]}}
      swing_01.csv: {payload_kg: {servo: 0.3}, lever_m: {servo: 0.15}, arm_kg: {servo: 0.02}, supply_v: {servo: 7.4}}
      press_01.mcap: {pressed: &ball {shape: sphere, radius_m: 0.012, arm: left, position_m: [0.001, 0, 0.003]}}
      press_02.mcap: {pressed: *ball, use: validation}
      press_03.mcap: {pressed: {shape: rod, radius_m: 0.008, length_m: 0.04, arm: left, rpy_rad: [0, 1.5708, 0]}}

``payload_kg`` is a known mass in the gripper. Its centre of mass is ``payload_position_m`` [m] in link 6's frame: origin at the
flange, z along the hand towards the fingers, y the direction in which they close. By default it is the TCP, [0, 0, 0.168].
``pressed`` is a known object between the fingers of one arm; with it ``taccorl compare`` and ``diagnose`` look at the arm's pads.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import numpy as np

from taccorl.alignment.measurements.dataset_rows import read_dataset
from taccorl.alignment.measurements.measurement import Measurement, Stated
from taccorl.alignment.measurements.own_spec import own_spec, taken
from taccorl.alignment.measurements.pressed import PressedObject, indenter
from taccorl.alignment.measurements.recorded import read_recording
from taccorl.alignment.measurements.table_files import SUFFIXES, EmptyColumns
from taccorl.alignment.measurements.tables import TableSpec, load_table_spec, read_table
from taccorl.data.decode import natural_key
from taccorl.data.origin import Domain
from taccorl.data.recording import find_sources
from taccorl.data.spec import (
    RecordingSpec,
    load_recording_spec,
    shipped_recording_specs,
)
from taccorl.data.strict_yaml import Document, Rules
from taccorl.errors import RecordingError, TaccorlError, nearest, no_such_path
from taccorl.robots import ROBOT

INDEX = "measurements.yaml"  # Name of the file, in a folder of recordings, that states facts about them
TableReader = Callable[[Path, Any], Measurement]
"""Function that reads a table from its path and, if there is one, its columns file."""
FARTHEST_PAYLOAD_M = 1.0
"""Largest accepted distance of a payload's centre of mass from the flange [m]: the arm itself reaches 0.63 m (PiPER manual)."""
Use = Literal["fit", "validation", "test"]
"""Use of a recording: fit of parameters, choice of effects, or final error only."""
if TYPE_CHECKING:
    ArmName = str
else:  # the names that a measurements.yaml may give: others are an error with its line
    ArmName = Literal[*ROBOT.arms]


@dataclass(frozen=True, kw_only=True)
class PressedNote:
    """A known object between the fingers of one arm: the arguments of ``indenter``."""

    shape: Literal["sphere", "rod"]
    radius_m: float  # Radius of the sphere or rod [m]
    arm: ArmName
    length_m: float | None = (
        None  # Length of a rod, which has flat ends [m]; not for a sphere
    )
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the object [m]: in the TCP's frame (origin in the middle between the pads, z = approach, fingers close along y),
    or in the world's, as ``frame`` says."""
    rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Fixed-axis roll, pitch, yaw [rad]; a rod lies along its own z, and [0, 1.5708, 0] lays it across the pads."""
    frame: Literal["tcp", "world"] = "tcp"
    """tcp: the object is fixed relative to the hand; world: it is fixed to the bench."""

    def made(self) -> PressedObject:
        """The object as a ``PressedObject``, for ``touch_motion``."""
        return indenter(
            **{name: value for name, value in vars(self).items() if value is not None}
        )

    def entry(self) -> dict[str, Any]:
        """The note as YAML values."""
        return {
            k: list(v) if isinstance(v, tuple) else v
            for k, v in vars(self).items()
            if v is not None
        }


@dataclass(frozen=True, kw_only=True)
class RecordingNote(Stated):
    """Facts about one recording that its file does not state."""

    use: Use | None = None
    """Use of the recording. fit: parameters are fitted to it; validation: effects are chosen by its error; test: no choice
    depends on it. None: as ``validation_every`` or the command line decides, else fit."""
    repeat_of: str | None = None
    """Name of the recording of the same motion that this one repeats; None if it is no repeat."""
    supply_v: dict[str, float] = field(default_factory=dict)
    """Name of an axis → voltage of its motor's supply [V], if no column has it."""
    effort_scale: dict[str, float] = field(default_factory=dict)
    """Signal → factor from the recorded effort to N·m or N; 0: the effort is not used. PiPER's firmware 1.5 to 1.8 reports
    joints 1 to 3 four times too large (piper_sdk issue 73)."""
    pressed: PressedNote | None = (
        None  # Known object between the fingers of one arm; None if there is none
    )


@dataclass(frozen=True, kw_only=True)
class MeasurementIndex:
    """Content of ``measurements.yaml``."""

    spec: str | None = (
        None  # Recording spec of the recordings: a shipped one's name, or a path; None if not needed
    )
    columns: str | None = None
    """Path of the columns file of tables and of datasets without units; None if they have taccorl's own names."""
    domain: Domain | None = (
        None  # Domain of all recordings that state none, such as ``real``
    )
    validation_every: int = (
        0  # Every k-th motion is for validation; 0: only recordings that are named
    )
    recordings: dict[str, RecordingNote] = field(
        default_factory=dict
    )  # File name of the recording → facts about it


@dataclass(frozen=True)
class Measurements:
    """Several measurements divided into fit, validation and test; the division is part of every result made from them."""

    fit: tuple[Measurement, ...]
    validation: tuple[Measurement, ...] = ()
    test: tuple[Measurement, ...] = ()
    rule: str = ""  # Description of the rule of the division
    skipped: tuple[
        str, ...
    ] = ()  # Other entries of the folder that were not read, with the reason
    unlisted: tuple[str, ...] = ()
    """Recordings for the fit that ``measurements.yaml`` does not list, although it states the use of others."""

    @property
    def all(self) -> tuple[Measurement, ...]:
        """Measurements of all three uses: fit, validation, test."""
        return (*self.fit, *self.validation, *self.test)

    def record(self) -> dict[str, object]:
        """The division for a report: keys ``rule``, ``fit``, ``validation``, ``test`` (lists of names) and ``skipped``."""
        names = {
            use: [m.name for m in getattr(self, use)]
            for use in ("fit", "validation", "test")
        }
        return {"rule": self.rule, **names, "skipped": list(self.skipped)}


def read_measurements(
    path: Path,
    *,
    spec: str | Path | RecordingSpec | None = None,
    columns: Path | TableSpec | None = None,
    validation_every: int | None = None,
    units: Mapping[str, str] | None = None,
    table: "TableReader | None" = None,
    fit_needed: bool = True,
) -> Measurements:
    """Read a recording, a table, a dataset, or a folder of those, and divide them into fit, validation and test.

    Args:
        spec: recording spec; else the index's, else the only shipped one that reads the format.
        columns: columns file of the tables, and of datasets that do not state their units; else the index's, else taccorl's own
            names.
        validation_every: every k-th motion that the index does not name is for validation; else the index's.
        units: signal of the machine → unit of its position, for tables without a columns file; the PiPER's if not given.
        table: for machines whose tables hold no joints: function that reads a table from its path and that of the columns file;
            ``columns`` is then a path.
        fit_needed: False if nothing is fitted: no recording need be for the fit.

    Raises TaccorlError: there is nothing to read, a name is unknown, or a motion and its repeat have different uses."""
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    index = _load_index(folder, ROBOT.arms if units is None else (*ROBOT.arms, *units))
    if spec is None and index.spec is not None:  # beside the index, or a shipped one
        spec = folder / index.spec if (folder / index.spec).is_file() else index.spec
    columns = (
        columns
        if columns is not None or index.columns is None
        else folder / index.columns
    )
    if isinstance(columns, TableSpec):
        stated = columns
    else:
        stated = (
            None if columns is None or table is not None else load_table_spec(columns)
        )
    read_one = table or (lambda one, _: read_table(one, stated, units))
    skipped: list[str] = []
    found = _read(
        path,
        spec,
        lambda one: read_one(one, columns),
        lambda root: read_dataset(root, stated, is_all=root == path),
        skipped,
        units,
    )
    found = sorted(found, key=lambda m: natural_key(m.name))
    whole, uses, names = (
        path.is_dir(),
        ("fit", "validation", "test"),
        [m.name for m in found],
    )
    unknown = [name for name in index.recordings if name not in names]
    if whole and unknown:
        raise TaccorlError(
            f"{folder / INDEX}: there is no recording {unknown[0]!r} in this folder; {nearest(unknown[0], names)}"
        )
    found = [_with_note(m, index, folder, names if whole else None) for m in found]
    held = not repeat_pairs(found)
    found = [
        dataclasses.replace(m, held=held and "torque" in m.target_kinds) for m in found
    ]
    # If the path is a single file, it is fitted, whatever ``use`` measurements.yaml states for it.
    named = {
        use: [m.name for m in found if whole and _note(index, m).use == use]
        for use in uses
    }
    every = (
        index.validation_every * whole if validation_every is None else validation_every
    )
    divided = split(found, **named, validation_every=every, fit_needed=fit_needed)
    states_uses = whole and any(note.use for note in index.recordings.values())
    unlisted = tuple(
        m.name for m in divided.fit if states_uses and m.name not in index.recordings
    )
    return dataclasses.replace(divided, skipped=tuple(skipped), unlisted=unlisted)


def split(
    measurements: Iterable[Measurement],
    *,
    fit: Sequence[str] = (),
    validation: Sequence[str] = (),
    test: Sequence[str] = (),
    validation_every: int = 0,
    fit_needed: bool = True,
) -> Measurements:
    """Divide measurements by name, and assign every k-th (``validation_every``; 0: none) of the other motions to ``validation``;
    what remains is for the fit. The result depends on the list only. A motion and its repeats count as one and stay together,
    because a repeat in validation would measure the noise and not the model. Raises TaccorlError: a name is unknown or given
    twice, a motion has different uses, or nothing remains for the fit although ``fit_needed``."""
    measurements = list(measurements)
    names = [m.name for m in measurements]
    for name in (name for name in names if names.count(name) > 1):
        raise TaccorlError(f"two measurements have the name {name!r}; rename one file")
    uses: dict[str, str] = {}
    for use, listed in (("fit", fit), ("validation", validation), ("test", test)):
        for name in listed:
            if name not in names:
                raise TaccorlError(
                    f"{use}: no measurement {name!r}; {nearest(name, names)}"
                )
            if uses.setdefault(name, use) != use:
                raise TaccorlError(
                    f"{name} is listed both for {uses[name]} and for {use}; list it once"
                )
    if validation_every < 0 or validation_every == 1:
        raise TaccorlError(
            f"validation_every: {validation_every} leaves nothing for the fit; 0 means no motion, 2 every second"
        )
    motion = motions(measurements)
    for name, use in list(uses.items()):
        for other in (n for n in names if motion[n] == motion[name]):
            if uses.setdefault(other, use) != use:
                raise TaccorlError(
                    f"{name} ({use}) and {other} ({uses[other]}) are repeats of one motion: give both the same use"
                )
    free = list(dict.fromkeys(motion[n] for n in names if n not in uses))
    taken = {
        m
        for k, m in enumerate(free)
        if validation_every and k % validation_every == validation_every - 1
    }
    for name in names:
        uses.setdefault(name, "validation" if motion[name] in taken else "fit")
    for name, first in copies(measurements).items():
        if uses[name] != uses[first]:
            said = f"{name} ({uses[name]}) is {first} ({uses[first]}), number for number, and would be checked with itself"
            raise TaccorlError(
                f"{said}; remove one of them, and its entry in {INDEX} if it has one"
            )
    sides = {
        use: tuple(m for m in measurements if uses[m.name] == use)
        for use in ("fit", "validation", "test")
    }
    if fit_needed and not sides["fit"]:
        raise TaccorlError(
            f"no recording is left for the fit: of {', '.join(names)}, {len(sides['validation'])} are for validation and "
            f"{len(sides['test'])} for the test; record another motion, or give one of them use: fit in measurements.yaml"
        )
    words = [f"{len(validation) + len(test)} by name"] * bool(validation or test)
    words += [
        f"every {validation_every}. of {len(free)} motions for validation"
    ] * bool(validation_every)
    return Measurements(
        sides["fit"],
        sides["validation"],
        sides["test"],
        rule=", ".join(words) or "all for fitting",
    )


def motions(measurements: Iterable[Measurement]) -> dict[str, str]:
    """Name of each measurement → name of the recording that it repeats, by way of others if need be, or its own; that recording
    need not be there. Raises TaccorlError: repeats refer to each other in a circle."""
    of = {m.name: m.repeat_of for m in measurements}
    roots = {}
    for name in of:
        root, seen = name, [name]
        while of.get(root) is not None:
            root = str(of[root])
            if root in seen:
                raise TaccorlError(
                    f"{' repeats '.join([*seen, root])}: a circle; correct repeat_of"
                )
            seen.append(root)
        roots[name] = root
    return roots


def copies(measurements: Iterable[Measurement]) -> dict[str, str]:
    """Find recordings that hold the same numbers as another. Returns: name of the copy → name of the original, which is the one
    that ``repeat_of`` of others names, else one that repeats none, else the first."""
    measurements = list(measurements)
    firsts, there = {m.repeat_of for m in measurements}, dict[bytes, Measurement]()
    found = {}
    for m in sorted(
        measurements, key=lambda m: (m.name not in firsts, m.repeat_of is not None)
    ):
        first = there.setdefault(m.measured.tobytes(), m)
        if first is not m and m.is_copy_of(first):
            found[m.name] = first.name
    return found


def repeat_pairs[M: Measurement](measurements: Iterable[M]) -> list[tuple[M, M]]:
    """Pairs (first recording of a motion, one of its repeats), one pair for each repeat that is no copy."""
    by_name = {m.name: m for m in measurements}
    firsts: dict[str, M] = {}
    pairs = []
    roots = motions(by_name.values())
    for name, root in sorted(
        roots.items(), key=lambda item: item[0] != item[1]
    ):  # the original first, if it is here
        first = firsts.setdefault(root, by_name[name])
        if first.name != name and not by_name[name].is_copy_of(first):
            pairs.append((first, by_name[name]))
    return pairs


def _load_index(folder: Path, holders: Sequence[str]) -> MeasurementIndex:
    if not (folder / INDEX).is_file():
        return MeasurementIndex()
    document = Document(MeasurementIndex, folder / INDEX)
    document.refuse(_rules(document.value, folder, holders))
    return document.value


def _rules(index: MeasurementIndex, folder: Path, holders: Sequence[str]) -> Rules:
    axes = [h for h in holders if h not in (*ROBOT.arms, *ROBOT.action_names)]
    for name, note in index.recordings.items():
        place = f"recordings/{name}"
        for key in (
            "kp",
            "kd",
            "gain_scale",
            "payload_kg",
            "lever_m",
            "arm_kg",
            "supply_v",
        ):
            for signal, value in getattr(note, key).items():
                yield value < 0, f"{place}/{key}/{signal}", f"{value:g} is below 0"
        for key in (
            "payload_kg",
            "payload_position_m",
            "lever_m",
            "arm_kg",
            "supply_v",
        ):
            known = {"payload_kg": holders, "payload_position_m": ROBOT.arms}.get(
                key, axes
            )
            others = (
                ", ".join(h for h in known if h not in ROBOT.action_names)
                or "there is none"
            )
            what = (
                "arm" if set(known) & set(ROBOT.arms) else "joint of the machine's file"
            )
            for holder in getattr(note, key):
                yield (
                    holder not in known,
                    f"{place}/{key}/{holder}",
                    f"no {what} {holder!r}; {others}",
                )
        for arm, at_m in note.payload_position_m.items():
            is_near = all(
                math.isfinite(x) and abs(x) <= FARTHEST_PAYLOAD_M for x in at_m
            )
            far = f"{list(at_m)} is further than {FARTHEST_PAYLOAD_M:g} m from the flange; is it in millimetres?"
            yield not is_near, f"{place}/payload_position_m/{arm}", far
        if note.pressed is not None:
            yield from _rules_of_pressed(f"{place}/pressed", note.pressed)
    lacks_columns = index.columns and not (folder / index.columns).is_file()
    yield lacks_columns, "columns", f"no file {index.columns!r} beside it"


def _rules_of_pressed(key: str, pressed: PressedNote) -> Rules:
    is_rod, lengths = (
        pressed.shape == "rod",
        {} if pressed.length_m is None else {"length_m": pressed.length_m},
    )
    need = (
        "a rod needs its length_m"
        if is_rod
        else "a sphere has no length_m; leave it out"
    )
    yield is_rod != bool(lengths), f"{key}/length_m" if lengths else key, need
    for name, size in {"radius_m": pressed.radius_m, **lengths}.items():
        yield not 0 < size < math.inf, f"{key}/{name}", f"{size:g} is not above 0"
    room = f"does not fit between the fingers, which open {ROBOT.opening_max_m:g} m; is it in millimetres?"
    yield (
        2 * pressed.radius_m > ROBOT.opening_max_m,
        f"{key}/radius_m",
        f"{pressed.radius_m:g} m {room}",
    )


def _note(index: MeasurementIndex, measurement: Measurement) -> RecordingNote:
    return index.recordings.get(measurement.name, RecordingNote())


def _with_note(
    m: Measurement, index: MeasurementIndex, folder: Path, names: Sequence[str] | None
) -> Measurement:
    """``m`` with what the index says of it; ``names``: of all recordings of the folder, None if not all were read."""
    note = _note(index, m)

    def refuse(key: str, text: str) -> NoReturn:
        raise TaccorlError(f"{folder / INDEX}: recordings → {m.name} → {key}: {text}")

    first = note.repeat_of
    if names is not None and first is not None and first not in names:
        refuse(
            "repeat_of",
            f"there is no recording {first!r} in this folder; {nearest(first, names)}",
        )
    for key in ("kp", "kd", "effort_scale", "supply_v"):
        for name in getattr(note, key):
            if name not in m.signals:
                refuse(key, f"no signal {name!r}; {nearest(name, m.signals)}")
    for arm in note.payload_position_m:
        if not (m.payload_kg | note.payload_kg).get(arm):
            refuse(
                "payload_position_m",
                f"{arm} holds no payload; state payload_kg, or leave it out",
            )
    if note.pressed is not None and m.touch is None:
        why = next((f" ({f.text})" for f in m.findings if f.check == "no_baseline"), "")
        refuse(
            "pressed",
            f"the recording holds no frames of the pads{why}; record them, or remove pressed",
        )
    repeat_of = note.repeat_of or m.repeat_of
    if (
        repeat_of
        and index.recordings.get(repeat_of, RecordingNote()).pressed != note.pressed
    ):
        text = f"this recording repeats {repeat_of}, whose pressed differs; correct pressed, or repeat_of"
        refuse("pressed", text)
    supply_v = m.supply_v
    if note.supply_v:
        if supply_v.size:
            refuse(
                "supply_v",
                "the recording also has a column with the supply voltage; remove one of them",
            )
        supply_v = np.tile(
            [note.supply_v.get(name, np.nan) for name in m.signals], (m.num_rows, 1)
        )
    scale = np.array(
        [note.effort_scale.get(name, 1.0) or np.nan for name in m.signals]
    )  # 0: as if not recorded
    facts: dict[str, Any] = {
        name: getattr(m, name) | getattr(note, name) for name in Stated.names()
    }
    return dataclasses.replace(
        m,
        **facts,
        origin=m.origin.agreed(index.domain, f"{folder / INDEX}: {m.name}"),
        repeat_of=repeat_of,
        supply_v=supply_v,
        pressed=note.pressed.made() if note.pressed is not None else None,
        effort=m.effort * scale,
    )


def _read(
    path: Path,
    spec: str | Path | RecordingSpec | None,
    table: Callable[[Path], Measurement],
    dataset: Callable[[Path], list[Measurement]],
    skipped: list[str],
    units: Mapping[str, str] | None,
) -> list[Measurement]:
    if not path.exists():
        raise RecordingError(no_such_path(path))
    if (path / "meta" / "info.json").is_file():
        return dataset(path)
    if path.is_file():
        if path.suffix in SUFFIXES:
            return [table(path)]
        return _read_recordings(path, spec, skipped, units)
    children = sorted(path.iterdir(), key=lambda p: natural_key(p.name))
    datasets = [p for p in children if (p / "meta" / "info.json").is_file()]
    tables = [p for p in children if p.is_file() and p.suffix in SUFFIXES]
    found = [m for p in datasets for m in dataset(p)]
    empty: dict[tuple[str, ...], list[str]] = {}
    for p in tables:
        try:
            found.append(table(p))
        except EmptyColumns as error:
            empty.setdefault(error.columns, []).append(p.name)
    if empty:
        raise EmptyColumns(empty, f"{path}: ")
    left: list[str] = []
    found += _read_recordings(path, spec, left, units, is_needed=not found)
    read = {p.name for p in (*datasets, *tables)} | {INDEX}
    read |= {
        p.name for p in children if p.suffix in (".yaml", ".yml")
    }  # specs and columns files
    skipped += [text for text in left if text.split(" (")[0] not in read]
    return found


def _read_recordings(
    path: Path,
    spec: str | Path | RecordingSpec | None,
    skipped: list[str],
    units: Mapping[str, str] | None,
    is_needed: bool = True,
) -> list[Measurement]:
    loaded = (
        spec
        if isinstance(spec, RecordingSpec) or spec is None
        else load_recording_spec(spec)
    )
    none = f"{path}: no recording here"
    try:
        found = find_sources(
            path,
            reader=loaded.reader if loaded else None,
            split_bag=bool(loaded and loaded.split_bag),
            skipped=skipped if path.is_dir() else None,
        )
    except RecordingError as error:
        found, none = [], str(error)
    # Datasets were read before; find_sources lists them as recordings, too.
    found = [(reader, source) for reader, source in found if reader != "lerobot"]
    if is_needed and not found:
        if path.is_dir():
            none += f", and there are no tables ({', '.join(SUFFIXES)}) or datasets"
        raise RecordingError(none)
    measurements = []
    is_own = (
        loaded is None and units is not None and not {*units} <= {*ROBOT.action_names}
    )
    for reader, source in found:
        try:
            if is_own and units is not None:
                own = own_spec(reader, source, units)
            else:
                own = loaded or _only_spec(path, reader)
            measured = read_recording(source, own)
            if is_own:
                findings = (*measured.findings, taken(own))
                measured = dataclasses.replace(measured, findings=findings)
            measurements.append(measured)
        except TaccorlError as error:
            text = str(error)
            raise RecordingError(
                text if text.startswith(source.name) else f"{source.name}: {text}"
            ) from error
    return measurements


def _only_spec(path: Path, reader: str) -> RecordingSpec:
    fitting = {
        name: spec
        for name, spec in shipped_recording_specs().items()
        if spec.reader == reader
    }
    if len(fitting) != 1:
        raise RecordingError(
            f"{path}: {len(fitting)} shipped specs read {reader} ({', '.join(fitting) or 'none'}); choose one: --spec=NAME, or "
            f"`spec:` in {INDEX}. `taccorl ingest inspect` drafts one"
        )
    return next(iter(fitting.values()))
