"""Data contract: contents of a dataset, format of a sensor, and how recordings fill a dataset.

Every feature states dtype, shape, unit, frame, rate and valid range. The files live in ``data_specs/``.
"""

import contextlib
import dataclasses
import functools
import hashlib
import itertools
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from taccorl.data.ros import vector_type
from taccorl.data.sensor_spec import SensorSpec, load_sensor_spec, unit_rule
from taccorl.data.strict_yaml import Document, Rules, check_version
from taccorl.errors import DatasetError, SpecError, nearest

Align = Literal["hold", "asof", "window"]
"""Rule by which samples are assigned to rows, see ``timing.match``."""
ActionTime = Literal["next_row", "this_row"]
ACTION = "action"
STATE = "observation.state"  # Key of the robot's state, which names the arms
_TIMED = {"lead_frames": "its messages have times of their own"}
_ROWS = {
    "split_bag": "each file is whole",
    "max_clock_spread_s": "all channels have the clock of the rows",
    "drop_zero_stamp": "rows have no header",
    "field": "the topic itself is the value",
    "pick": "the elements of a row have no names in the file: the order is that of the file",
}
WITHOUT_EFFECT = {
    "mcap": _TIMED,
    "db3": _TIMED,
    "rosbag1": _TIMED,
    "hdf5": _ROWS,
    "lerobot": _ROWS,
}
"""Reader → key of a recording spec or a channel that does nothing with it → reason."""


@dataclass(frozen=True, kw_only=True)
class FeatureSpec:
    """One feature of the dataset: type, shape, unit, frame of reference, rate and range of its values."""

    dtype: Literal["float32", "float64", "int16", "int64", "video"]
    shape: tuple[int, ...]
    unit: str | tuple[str, ...]
    """One unit for all elements, or one for each."""
    frame: str
    rate_hz: float
    """Rate at which the robot measures the feature [Hz]; rows of the dataset come at the dataset's fps."""
    range: tuple[float, float] | dict[str, tuple[float, float]]
    """Lowest and highest valid value, of all elements or by an element's name."""
    names: tuple[str, ...] = ()
    """Names of the elements; empty: they have none."""
    layout: tuple[int, ...] = ()
    """Axes in which the flat values stand, such as pads, rows and columns of another kind of touch; empty: none stated."""
    sensor: str | None = None
    """Tactile features only: sensor file, relative to this file; ``pads``: order of the pads. The feature holds the taxels of
    these pads, row after row, pad after pad."""
    pads: tuple[str, ...] = ()
    history: int = 1
    """L: number of readings per row, oldest first (with ``align: window``)."""
    optional: bool = False
    """True if recording specs may leave this feature out."""

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each element."""
        return (self.unit,) * self.size if isinstance(self.unit, str) else self.unit

    def element_names(self, key: str) -> tuple[str, ...]:
        """Name of each element of the feature ``key``; ``key[0]``, ``key[1]`` … where the spec names none."""
        return self.names or tuple(f"{key}[{i}]" for i in range(self.size))

    @functools.cached_property
    def limits(self) -> np.ndarray:
        """(size, 2) lowest and highest valid value per element."""
        if isinstance(self.range, dict):
            return np.array([self.range[n] for n in self.names], dtype=float)
        return np.tile(np.array(self.range, dtype=float), (self.size, 1))


@dataclass(frozen=True, kw_only=True)
class DatasetSpec:
    """Contract of a dataset: its features, row rate and video codec."""

    spec_version: int
    name: str
    robot_type: str
    fps: int
    features: dict[str, FeatureSpec]
    action_time: ActionTime | None = None
    """When the target in ``action`` of row t is in force. In both cases it is the last command sent before row t + 1, which is
    what a policy that sees row t outputs. ``next_row``: the robot receives targets faster than there are rows, and this one is
    reached in a straight line at row t + 1. ``this_row``: the robot receives one target a row, right after the observation of row
    t, and it is in force from row t on (LeRobot's and ALOHA's loops of recording). Measurements and replays take it so.
    None: nobody stated it (other people's datasets, and those that taccorl wrote before it had this key: ingested rows then hold
    the command in force at row t)."""
    video_codec: Literal["h264", "libsvtav1"] = "h264"
    sensors: dict[str, SensorSpec] = dataclasses.field(default_factory=dict)
    """Filled on loading: feature key → its sensor. Not a key of the file."""

    def require_action_time(self, name: str) -> None:
        """Raises DatasetError: nobody stated at which row the actions of ``name``, a dataset or episode, are reached."""
        if self.action_time is None:
            raise DatasetError(
                f"{name}: nothing states when its actions are reached (action_time in meta/taccorl/dataset_spec.json): that of "
                "row t may be in force at row t (as ingest stored it) or reached at row t + 1 (as the twin stored it). Ingest "
                "its recordings again, or collect or augment it again; of other people's LeRobot datasets: taccorl ingest "
                "DATASET --spec=…, with reader: lerobot and lead_frames on the channel of action"
            )

    def keys(
        self, kind: Literal["video", "tactile", "vector", "simulator"]
    ) -> list[str]:
        """Feature keys of one kind, in the spec's order; ``sim.*`` are a simulator's own: its state, seeds and labels."""

        def kind_of(key: str) -> str:
            if key.startswith("sim.") or self.features[key].dtype == "video":
                return "simulator" if key.startswith("sim.") else "video"
            return "tactile" if key in self.sensors else "vector"

        return [key for key in self.features if kind_of(key) == kind]


@dataclass(frozen=True, kw_only=True)
class ChannelSpec:
    """One recorded stream: its topic, the part of the message that is used, its clock, and the age at which a sample is old."""

    topic: str
    """Topic (MCAP, bag), path inside the file (HDF5) or feature key (LeRobot)."""
    rate_hz: float
    max_age_s: float | None = None
    """Largest accepted age of a row's newest sample [s]; the episode is split at older ones. Required but for ``align: hold``."""
    type: str | None = None
    """Required schema name; a recording with another type is refused. None: not checked."""
    field: str | None = None
    """Dotted name of the message's field to read."""
    pick: tuple[str, ...] = ()
    """Names of the elements to take: from the message's own ``name`` list, or paths in a pose, a wrench … (``ros``).
    Elements are never taken by position."""
    scale: tuple[float, ...] = ()
    """Factor for each element, applied after ``pick``: unit conversion or a driver's known error."""
    clock: Literal["header", "log"] | None = None
    """Clock of the channel; None: that of the recording spec."""
    latency_s: float = 0.0
    """Time from the event to its stamp [s]; it is subtracted from the stamp."""
    drop_zero_stamp: bool = False
    """Messages stamped 0 (PiPER's joint_ctrl before a first command) are dropped and counted."""
    lead_frames: int | None = None
    """Files without clocks (HDF5, LeRobot) only: sample k is valid at row k + lead_frames; 0 if not given. The channels of
    ``action`` must state it: 1 if row k holds the command that was sent after the observation of row k (cobot_magic, ALOHA,
    LeRobot), 0 if it was sent before."""
    channel_order: Literal["rgb", "bgr"] = "rgb"
    """Order of the colours in arrays and in JPEG and PNG pictures; raw pictures whose encoding states it are refused with bgr."""


@dataclass(frozen=True, kw_only=True)
class MappingSpec:
    """Source of one feature: channels whose values are joined in this order and aligned to the rows by ``align``
    (``timing.match``)."""

    channels: tuple[str, ...]
    align: Align


@dataclass(frozen=True, kw_only=True)
class EpisodesSpec:
    """Rule for the start and end of episodes in a recording: ``whole_file``: one episode a file; ``markers``: from a start to a
    success, failure, discard or end; ``metadata``: as the file states."""

    by: Literal["whole_file", "markers", "metadata"]
    topic: str | None = None
    """Topic of the markers: std_msgs/String "start:<instruction>", then "success", "failure", "discard" or "end"."""
    min_s: float = 1.0
    """Shortest episode that is written [s]; shorter pieces are only reported."""


@dataclass(frozen=True, kw_only=True)
class InstructionSpec:
    """The sentence the policy reads (LeRobot's task): ``text`` of every episode, such as "insert the plug"; the value of ``key``
    in an MCAP metadata record; the text of the markers; or that on ``topic``."""

    from_: Literal["spec", "metadata", "markers", "topic"]
    text: str | None = None
    key: str | None = None
    topic: str | None = None


@dataclass(frozen=True, kw_only=True)
class RecordingSpec:
    """Recording spec: how recordings of one robot's drivers fill a dataset."""

    spec_version: int
    dataset: str
    reader: str
    clock: Literal["header", "log"]
    episodes: EpisodesSpec
    instruction: InstructionSpec
    channels: dict[str, ChannelSpec]
    features: dict[str, MappingSpec]
    split_bag: bool = False
    """Files x_0, x_1, … of a folder without metadata.yaml are one recording."""
    max_clock_spread_s: float = 0.25
    """Largest accepted difference of (log time − stamp) between channels [s]; above it they are on different clocks, and the
    recording is refused."""
    contract: DatasetSpec | None = None
    """Filled on loading from ``dataset``. Not a key of the file."""

    @property
    def target(self) -> DatasetSpec:
        """The dataset spec ``contract``, which must have been loaded."""
        assert self.contract is not None, (
            "load a RecordingSpec with load_recording_spec"
        )
        return self.contract

    @property
    def mapped(self) -> dict[str, FeatureSpec]:
        """The dataset's features that this spec fills, in the dataset's order."""
        return {
            key: f for key, f in self.target.features.items() if key in self.features
        }

    @property
    def picture_channels(self) -> dict[str, str]:
        """Name of a channel with pictures → key of the video feature that is made from it."""
        keys = [key for key in self.target.keys("video") if key in self.features]
        return {channel: key for key in keys for channel in self.features[key].channels}

    @property
    def picture_topics(self) -> set[str]:
        """Topics that are read as pictures."""
        return {self.channels[name].topic for name in self.picture_channels}

    def clock_of(self, channel: str) -> Literal["header", "log"]:
        """Clock of a channel: its own, else that of the recording spec."""
        return self.channels[channel].clock or self.clock

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of everything in the spec that affects the output; comments and layout of the files do not."""
        return hashlib.sha256(
            json.dumps(dataclasses.asdict(self), sort_keys=True).encode()
        ).hexdigest()


# ---- files ----


def data_specs_folder() -> Path:
    """Folder of the shipped specs: ``data_specs`` of the clone, or the copy in an installed package."""
    package = Path(__file__).resolve().parents[1]
    clone = package.parent / "data_specs"
    return clone if clone.is_dir() else package / "_data_specs"


def find_spec(name: str | Path) -> Path:
    """Path of a spec: ``name`` itself if it is a file, else the shipped spec of that name. Raises SpecError: neither exists."""
    path, shipped = (
        Path(name),
        {p.stem: p for p in sorted(data_specs_folder().rglob("*.yaml"))},
    )
    if path.is_file() or str(name) in shipped:
        return path if path.is_file() else shipped[str(name)]
    raise SpecError(
        f"no spec {str(name)!r}: neither a file nor a shipped spec; {nearest(path.stem, shipped)}"
    )


def shipped_recording_specs() -> dict[str, RecordingSpec]:
    """Name → shipped recording spec, for those that load without an error."""
    return _recording_specs(data_specs_folder() / "recordings")


@functools.cache
def _recording_specs(folder: Path) -> dict[str, RecordingSpec]:
    found = {}
    for path in sorted(folder.glob("*.yaml")):
        with contextlib.suppress(SpecError):  # somebody is writing it
            found[path.stem] = load_recording_spec(path)
    return found


def _beside(document: Document[Any], key: str, name: str) -> Path:
    """The file that ``key`` names, relative to the document's own folder."""
    path = document.path.parent / name
    siblings = (
        [p.name for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
    )
    document.refuse(
        [
            (
                not path.is_file(),
                key,
                f"no file {name!r} beside it; {nearest(path.name, siblings)}",
            )
        ]
    )
    return path


def load_dataset_spec(path: Path) -> DatasetSpec:
    """A dataset file of ``data_specs``. Raises SpecError: with file, line, key, value and the way out."""
    document = Document(DatasetSpec, Path(path))
    spec = document.value
    check_version(document, spec.spec_version)
    sensors: dict[str, SensorSpec] = {}
    document.refuse(_dataset_rules(document, spec, sensors))
    return dataclasses.replace(spec, sensors=sensors)


def _dataset_rules(
    document: Document[Any], spec: DatasetSpec, sensors: dict[str, SensorSpec]
) -> Rules:
    """Adds to ``sensors`` what the features name."""
    text = "is missing: write `action_time: next_row`; the action of row t is then the last command sent before row t "
    text += (
        "+ 1 (`this_row` where the robot receives one target a row, right after row t)"
    )
    text = (
        text
        if ACTION in spec.features
        else f"has no effect without a feature {ACTION!r}; remove it"
    )
    yield (
        spec.sensors,
        "sensors",
        "is not a key of this file; give `sensor:` on the tactile feature",
    )
    yield spec.fps <= 0, "fps", f"{spec.fps} is not a valid rate; give a number above 0"
    yield not spec.features, "features", "holds nothing"
    yield (
        (ACTION in spec.features) != (spec.action_time is not None),
        "action_time",
        text,
    )
    for key, feature in spec.features.items():
        where, known = (
            f"features/{key}",
            key == ACTION or key.startswith("observation."),
        )
        yield (
            not known,
            where,
            "LeRobot's policies read `action` and `observation.*` only",
        )
        text = f"{key!r}: a feature's name has letters, digits, `_`, `.` and `-`: it becomes the name of a folder"
        yield not re.fullmatch(r"[\w.-]+", key), where, text
        if feature.sensor is not None:
            sensors[key] = load_sensor_spec(
                _beside(document, f"{where}/sensor", feature.sensor)
            )
        yield from _feature_rules(where, feature, sensors.get(key))


def _feature_rules(where: str, f: FeatureSpec, sensor: SensorSpec | None) -> Rules:
    shape, names, units = (
        list(f.shape),
        f.names,
        (f.unit,) if isinstance(f.unit, str) else f.unit,
    )
    by_name, is_video = (
        f.range if isinstance(f.range, dict) else None,
        f.dtype == "video",
    )
    yield not shape or min(shape) <= 0, f"{where}/shape", f"{shape} holds nothing"
    yield (
        f.rate_hz <= 0,
        f"{where}/rate_hz",
        f"{f.rate_hz:g} is not a valid rate; give a number above 0",
    )
    yield from (unit_rule(f"{where}/unit", unit) for unit in units)
    if is_video:
        sized = (
            len(shape) == 3 and shape[2] == 3 and not shape[0] % 2 and not shape[1] % 2
        )
        yield (
            not sized,
            f"{where}/shape",
            f"{shape} is not [rows, columns, 3] with even rows and columns",
        )
        for option in ("names", "pads", "sensor", "layout"):
            yield (
                getattr(f, option),
                f"{where}/{option}",
                "has no effect on pictures; remove it",
            )
        several = isinstance(f.unit, tuple) or by_name is not None or f.history != 1
        yield several, where, "pictures have one unit, one range and no history"
    else:
        flat = (
            f"{shape}: LeRobot can merge and edit only flat features; write [{f.size}]"
        )
        yield len(shape) != 1, f"{where}/shape", flat
        layout = (
            "has no effect: the sensor states it"
            if sensor
            else f"{list(f.layout)} are not {f.size} values"
        )
        yield (
            f.layout and (math.prod(f.layout) != f.size or sensor),
            f"{where}/layout",
            layout,
        )
        yield (
            names and len(names) != f.size,
            f"{where}/names",
            f"{len(names)} names for {f.size} values",
        )
        yield len(set(names)) != len(names), f"{where}/names", "a name stands twice"
        wrong_units = not isinstance(f.unit, str) and len(units) != f.size
        yield wrong_units, f"{where}/unit", f"{len(units)} units for {f.size} values"
    if by_name is not None:
        yield from (
            (n not in names, f"{where}/range/{n}", f"no such name; {nearest(n, names)}")
            for n in by_name
        )
        missing = ", ".join(n for n in names if n not in by_name)
        yield (
            missing or not names,
            f"{where}/range",
            f"no range for {missing or 'unnamed values'}",
        )
    yield (
        (f.limits[:, 0] >= f.limits[:, 1]).any(),
        f"{where}/range",
        "a lower bound is not below its upper bound",
    )
    yield (
        sensor is None and (f.pads or f.history != 1),
        where,
        "`pads` and `history` need `sensor`",
    )
    yield len(set(f.pads)) != len(f.pads), f"{where}/pads", "a pad stands twice"
    if sensor is not None:
        expected = f.history * len(f.pads) * sensor.rows * sensor.columns
        text = f"{f.dtype} [{f.size}], but {f.history} × {len(f.pads)} pads × {sensor.rows}×{sensor.columns} taxels "
        text += f"({sensor.name}) are int16 [{expected}]"
        yield f.dtype != "int16" or f.size != expected, f"{where}/shape", text


def load_recording_spec(name: str | Path) -> RecordingSpec:
    """A recording spec by its path or the name of a shipped one, checked against its dataset spec. Raises SpecError: with
    file, line, key, value and the way out."""
    document = Document(RecordingSpec, find_spec(name))
    check_version(document, document.value.spec_version)
    document.refuse(
        [
            (
                document.value.contract,
                "contract",
                "is not a key of this file; give `dataset:`",
            )
        ]
    )
    contract = load_dataset_spec(_beside(document, "dataset", document.value.dataset))
    spec = dataclasses.replace(document.value, contract=contract)
    document.refuse(_recording_rules(document, spec))
    return spec


def _recording_rules(document: Document[Any], spec: RecordingSpec) -> Rules:
    known = spec.target.features
    for key in spec.features:
        yield (
            key not in known,
            f"features/{key}",
            f"not in {spec.dataset}; {nearest(key, known)}",
        )
    missing = [k for k, f in known.items() if k not in spec.features and not f.optional]
    yield missing, "features", f"nothing fills {', '.join(missing)} of {spec.dataset}"
    for key, why in WITHOUT_EFFECT.get(spec.reader, {}).items():
        for at in (key, *(f"channels/{c}/{key}" for c in spec.channels)):
            yield (
                document.has(at),
                at,
                f"has no effect with reader: {spec.reader}: {why}; remove it",
            )
    for c in spec.channels:
        clock, order = f"channels/{c}/clock", f"channels/{c}/channel_order"
        by_header = spec.reader == "lerobot" and spec.clock_of(c) == "header"
        at = clock if document.has(clock) else "clock"
        yield (
            by_header,
            at,
            "header: rows of a LeRobot dataset have one time, write log",
        )
        no_picture = document.has(order) and c not in spec.picture_channels
        yield no_picture, order, "has no effect: it fills no video feature; remove it"
    for key, mapping in spec.features.items():
        yield from _mapping_rules(spec, key, mapping)
    used = {c for m in spec.features.values() for c in m.channels}
    pick = "names elements of a `field` (position, velocity …); none is given (needed unless `type` is a pose, a "
    pick += "wrench …)"
    for c, channel in spec.channels.items():
        where, age_s, factors, picks = (
            f"channels/{c}",
            channel.max_age_s,
            len(channel.scale),
            len(channel.pick),
        )
        yield c not in used, where, "no feature uses it; remove it or map it"
        yield (
            age_s is not None and age_s <= 0,
            f"{where}/max_age_s",
            f"{age_s} s: every row would be stale",
        )
        yield (
            channel.rate_hz <= 0,
            f"{where}/rate_hz",
            f"{channel.rate_hz} is not a valid rate; give a number above 0",
        )
        yield (
            factors and picks and factors != picks,
            f"{where}/scale",
            f"{factors} factors for {picks} picked values",
        )
        yield (
            picks and channel.field is None and vector_type(channel.type or "") is None,
            f"{where}/pick",
            pick,
        )
    spread = f"{spec.max_clock_spread_s:g} s: no two clocks agree so closely"
    yield spec.max_clock_spread_s <= 0, "max_clock_spread_s", spread
    episodes, instruction = spec.episodes, spec.instruction
    with_topic = (episodes.by == "markers") != (episodes.topic is not None)
    yield with_topic, "episodes", "`topic` goes with `by: markers`, and only with it"
    needs = {"spec": "text", "metadata": "key", "topic": "topic", "markers": None}[
        instruction.from_
    ]
    for field in ("text", "key", "topic"):
        given = getattr(instruction, field) is not None
        text = f"`{field}` {'has no effect' if given else 'is missing'} with `from: {instruction.from_}`"
        yield given != (field == needs), "instruction", text
    empty = instruction.text is not None and instruction.text.strip() in ("", "TODO")
    yield (
        empty,
        "instruction/text",
        "is empty or `TODO`; write the instruction: the policy reads it",
    )
    unmarked = instruction.from_ == "markers" and episodes.by != "markers"
    yield (
        unmarked,
        "instruction/from",
        "`from: markers` requires `episodes: by: markers`",
    )


def _mapping_rules(spec: RecordingSpec, key: str, mapping: MappingSpec) -> Rules:
    where, feature, names, align = (
        f"features/{key}",
        spec.target.features[key],
        mapping.channels,
        mapping.align,
    )
    twice = not names or len(set(names)) != len(names)
    yield twice, f"{where}/channels", "names no channel, or the same channel twice"
    for c in names:
        yield (
            c not in spec.channels,
            f"{where}/channels",
            f"no channel {c!r}; {nearest(c, spec.channels)}",
        )
        has_age, hold, at = (
            spec.channels[c].max_age_s is not None,
            align == "hold",
            f"channels/{c}",
        )
        yield (
            has_age and hold,
            f"{at}/max_age_s",
            f"has no effect: {key} has the last value; use align: asof",
        )
        yield (
            not has_age and not hold,
            at,
            f"key 'max_age_s' is missing: {key} is aligned by {align}",
        )
    is_video, is_touch = feature.dtype == "video", key in spec.target.sensors
    odd = is_video and (len(names) != 1 or align not in ("hold", "asof"))
    yield odd, where, "a picture comes from one channel, aligned by hold or asof"
    for c, option in itertools.product(
        names if is_video or is_touch else (), ("pick", "scale")
    ):
        text = f"has no effect: {key} has no named numbers"
        yield getattr(spec.channels[c], option), f"channels/{c}/{option}", text
    window = f"{align} with history: {feature.history}; a window needs history > 1"
    yield (align == "window") != (feature.history > 1), f"{where}/align", window
    pads = f"{len(names)} channels for pads {[*feature.pads]}"
    yield is_touch and len(names) != len(feature.pads), f"{where}/channels", pads
    picked = [len(spec.channels[c].pick) for c in names]
    wrong = feature.dtype == "float32" and all(picked) and sum(picked) != feature.size
    yield (
        wrong,
        f"{where}/channels",
        f"pick {sum(picked)} values together; {key} has {feature.size}",
    )
