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
from taccorl.data.strict_yaml import Document
from taccorl.errors import DatasetError, SpecError, nearest

Align = Literal["hold", "asof", "interpolate", "window"]
"""Rule by which samples are assigned to rows, see ``timing.match``."""
ActionTime = Literal["next_row", "this_row"]
SPEC_VERSION = 1  # Version of the files' format that this code reads
ACTION = "action"
STATE = "observation.state"  # Key of the robot's state, which names the arms
UNITS = (
    *("rad", "rad/s", "rad/s2", "m", "m/s", "m/s2", "wxyz"),
    *("N", "Nm", "Pa", "kg", "A", "V", "W", "K", "s", "Hz", "1"),
    *("adc_count", "rgb8", "unknown"),
)
"""Units of features and sensors: SI; wxyz: a unit quaternion; 1: a number without unit; unknown: of others' datasets."""
OTHER_UNITS = {
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°"), ("rad", "0.0174533")),
    **dict.fromkeys(("deg/s", "degrees/s", "°/s", "dps"), ("rad/s", "0.0174533")),
    **dict.fromkeys(("mm", "millimetre", "millimeter"), ("m", "0.001")),
    **dict.fromkeys(("cm", "centimetre", "centimeter"), ("m", "0.01")),
    "mm/s": ("m/s", "0.001"),
    "rpm": ("rad/s", "0.104720"),
    "Ncm": ("Nm", "0.01"),
    "mA": ("A", "0.001"),
    "mV": ("V", "0.001"),
    "ms": ("s", "0.001"),
    "kPa": ("Pa", "1000"),
    "%": ("1", "0.01"),
}
"""Unit that drivers send → the unit of the dataset and the factor to it."""


_TIMED = {"lead_frames": "its messages have times of their own"}
_ROWS = {
    "split_bag": "each file is whole",
    "max_clock_spread_s": "all channels have the clock of the rows",
    "drop_zero_stamp": "rows have no header",
    "field": "the topic itself is the value",
    "pick": "the elements of a row have no names in the file: the order is that of the file",
}
WITHOUT_EFFECT: dict[str, dict[str, str]] = {
    **dict.fromkeys(("mcap", "db3", "rosbag1"), _TIMED),
    "hdf5": _ROWS,
    "lerobot": _ROWS,
}
"""Reader → key of a recording spec or a channel that does nothing with it → reason."""


@dataclass(frozen=True, kw_only=True)
class WireSpec:
    """Format of one pad frame as sent by the sensor: ``rows × columns`` values of ``dtype``, row after row."""

    rows: int
    columns: int
    dtype: Literal["uint8", "uint16"]
    transpose: bool
    """True: wire rows are pad columns, so the frame is transposed to the pad's rows × columns."""


@dataclass(frozen=True, kw_only=True)
class BaselineSpec:
    """Rule for the counts without contact: per taxel, the median of the recording's first ``frames`` frames."""

    rule: Literal["median_of_first"]
    frames: int
    max_spread_count: float
    """Largest accepted spread of the frames about their median [counts, 0.99 quantile]. A pad with more spread is not at rest
    and gets no baseline."""


@dataclass(frozen=True, kw_only=True)
class SensorSpec:
    """One kind of tactile pad: its taxels, the format of its frames, and the rules from counts to readings."""

    spec_version: int
    name: str
    rows: int
    columns: int
    wire: WireSpec
    adc_bits: int
    wire_shift_bits: int
    """The firmware drops this many low bits of the ADC before sending (10-bit ADC as a byte: 2)."""
    rate_hz: float
    """Scans of a pad per second [Hz]."""
    scan_time_s: float
    """Time to scan the whole pad [s]; the stamp is its end."""
    unit: str
    baseline: BaselineSpec
    noise_count: float
    """Largest value of an untouched taxel [counts above baseline]."""
    scheme: Literal["fixed_scale"]
    gain_per_count: float
    """Normalised reading = counts above baseline × gain; the policy's processor applies it, never the dataset."""

    @property
    def max_count(self) -> int:
        """Largest count that the sensor sends: (2^bits − 1) >> shift."""
        return (2**self.adc_bits - 1) >> self.wire_shift_bits


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
    """Tactile features only: sensor file, relative to this file."""
    pads: tuple[str, ...] = ()
    """Tactile features only: order of the pads. The feature holds the taxels of these pads, row after row, pad after pad."""
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
    Files of ``data_specs/`` with an ``action`` must state it. None: nobody stated it (other people's datasets, and those
    that taccorl wrote before it had this key: ingested rows then hold the command in force at row t)."""
    video_codec: Literal["h264", "libsvtav1"] = "h264"
    sensors: dict[str, SensorSpec] = dataclasses.field(default_factory=dict)
    """Filled on loading: feature key → its sensor. Not a key of the file."""

    def require_action_time(self, name: str) -> None:
        """Check that the spec states when an action is reached. ``name``: name of the dataset or episode for the message.
        Raises DatasetError: nobody stated at which row its actions are reached."""
        if self.action_time is None:
            raise DatasetError(
                f"{name}: nothing states when its actions are reached (action_time in meta/taccorl/dataset_spec.json): that of "
                "row t may be in force at row t (as ingest stored it) or reached at row t + 1 (as the twin stored it). Ingest "
                "its recordings again, or collect or augment it again; of other people's LeRobot datasets: taccorl ingest "
                "DATASET --spec=…, with reader: lerobot and lead_frames on the channel of action"
            )

    def keys(self, kind: Literal["video", "tactile", "vector", "simulator"]) -> list[str]:
        """Return the feature keys of one kind, in the spec's order; ``sim.*`` are a simulator's own: its state, seeds and
        labels."""

        def kind_of(key: str) -> str:
            if key.startswith("sim."):
                return "simulator"
            f = self.features[key]
            return "video" if f.dtype == "video" else "tactile" if key in self.sensors else "vector"

        return [key for key in self.features if kind_of(key) == kind]


@dataclass(frozen=True, kw_only=True)
class ChannelSpec:
    """One recorded stream: its topic, the part of the message that is used, its clock, and the age at which a sample is
    too old."""

    topic: str
    """Topic (MCAP, bag), path inside the file (HDF5) or feature key (LeRobot)."""
    rate_hz: float
    max_age_s: float | None = None
    """Largest accepted age of a row's newest sample [s]; the episode is split at older ones. Required unless ``align`` is hold.
    """
    type: str | None = None
    """Required schema name; a recording with another type is refused. None: not checked."""
    field: str | None = None
    """Dotted name of the message's field to read."""
    pick: tuple[str, ...] = ()
    """Names of the elements to take: from the message's own ``name`` list, or paths in a pose, a wrench … (``ros_vectors``).
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
    """Source of one feature: channels whose values are joined in this order and aligned to the rows by ``align``."""

    channels: tuple[str, ...]
    align: Align
    """``hold``, ``asof``, ``interpolate`` or ``window``, see ``timing.match``."""


@dataclass(frozen=True, kw_only=True)
class EpisodesSpec:
    """Rule for the start and end of episodes in a recording."""

    by: Literal["whole_file", "markers", "metadata"]
    """``whole_file``: one episode a file; ``markers``: from a start to a success, failure or discard; ``metadata``: as the
    file states."""
    topic: str | None = None
    """Topic of the markers: std_msgs/String "start:<instruction>", then "success", "failure" or "discard". Required for
    ``markers``."""
    min_s: float = 1.0
    """Shortest episode that is written [s]; shorter pieces are only reported."""


@dataclass(frozen=True, kw_only=True)
class InstructionSpec:
    """The sentence the policy reads (LeRobot's task)."""

    from_: Literal["spec", "metadata", "markers", "topic"]
    text: str | None = None
    """Instruction of every episode, such as "insert the plug". Required with ``from: spec``."""
    key: str | None = None
    """Key of the MCAP metadata record that holds the instruction, for ``from: metadata``."""
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
        assert self.contract is not None, "load a RecordingSpec with load_recording_spec"
        return self.contract

    @property
    def mapped(self) -> dict[str, FeatureSpec]:
        """The dataset's features that this spec fills, in the dataset's order."""
        return {key: f for key, f in self.target.features.items() if key in self.features}

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
        return hashlib.sha256(json.dumps(dataclasses.asdict(self), sort_keys=True).encode()).hexdigest()


def data_specs_folder() -> Path:
    """Folder of the shipped specs: ``data_specs`` of the clone, or the copy in an installed package."""
    package = Path(__file__).resolve().parents[1]
    clone = package.parent / "data_specs"
    return clone if clone.is_dir() else package / "_data_specs"


def find_spec(name: str | Path) -> Path:
    """Path of a spec: ``name`` itself if it is a file, else the shipped spec of that name. Raises SpecError: neither exists;
    the message names the nearest shipped spec."""
    path = Path(name)
    if path.is_file():
        return path
    shipped = {p.stem: p for p in sorted(data_specs_folder().rglob("*.yaml"))}
    if str(name) in shipped:
        return shipped[str(name)]
    raise SpecError(f"no spec {str(name)!r}: neither a file nor a shipped spec; {nearest(path.stem, shipped)}")


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


def load_sensor_spec(path: Path) -> SensorSpec:
    """Load a sensor file, as those in ``data_specs/sensors``."""
    document = Document(SensorSpec, path)
    spec = document.value
    check_version(document, spec.spec_version)
    for key in ("rows", "columns", "adc_bits", "rate_hz", "scan_time_s", "gain_per_count", "baseline/frames"):
        value = getattr(spec.baseline if "/" in key else spec, key.rpartition("/")[2])
        if value <= 0:
            raise document.error(key, f"{value:g} is not above 0")
    if not 0 <= spec.wire_shift_bits < spec.adc_bits <= 32:
        text = f"{spec.wire_shift_bits} of {spec.adc_bits} bits leave no bit for the count"
        raise document.error("wire_shift_bits", text)
    pad, wire = (spec.rows, spec.columns), (spec.wire.rows, spec.wire.columns)
    if (wire[::-1] if spec.wire.transpose else wire) != pad:
        raise document.error(
            "wire",
            f"{wire[0]}×{wire[1]} with transpose: {spec.wire.transpose} does not give the pad's {pad[0]}×{pad[1]}",
        )
    _check_unit(document, "unit", spec.unit)
    if spec.max_count > np.iinfo(spec.wire.dtype).max:
        raise document.error("wire/dtype", f"{spec.max_count} counts do not fit the wire's {spec.wire.dtype}")
    if spec.max_count > np.iinfo(np.int16).max:
        raise document.error("adc_bits", f"{spec.max_count} counts do not fit the dataset's int16")
    return spec


def load_dataset_spec(path: Path) -> DatasetSpec:
    """A dataset file of ``data_specs``. Raises SpecError: with file, line, key, value and the way out."""
    path = Path(path)
    document = Document(DatasetSpec, path)
    spec = document.value
    check_version(document, spec.spec_version)
    if spec.sensors:
        raise document.error("sensors", "is not a key of this file; give `sensor:` on the tactile feature")
    if spec.fps <= 0:
        raise document.error("fps", f"{spec.fps} is not a valid rate; give a number above 0")
    if not spec.features:
        raise document.error("features", "holds nothing")
    if (ACTION in spec.features) != (spec.action_time is not None):
        raise document.error(
            "action_time",
            "is missing: write `action_time: next_row`; the action of row t is then the last command sent before row t + 1 "
            "(`this_row` where the robot receives one target a row, right after row t)"
            if ACTION in spec.features
            else f"has no effect without a feature {ACTION!r}; remove it",
        )
    sensors: dict[str, SensorSpec] = {}
    for key, feature in spec.features.items():
        where = f"features/{key}"
        if not (key == ACTION or key.startswith("observation.")):
            raise document.error(where, "LeRobot's policies read `action` and `observation.*` only")
        if not re.fullmatch(r"[\w.-]+", key):
            raise document.error(
                where,
                f"{key!r}: a feature's name has letters, digits, `_`, `.` and `-`: it becomes the name of a folder",
            )
        if feature.sensor is not None:
            sensors[key] = load_sensor_spec(_beside(document, f"{where}/sensor", feature.sensor))
        _check_feature(document, where, feature, sensors.get(key))
    return dataclasses.replace(spec, sensors=sensors)


def _check_unit(document: Document[Any], where: str, unit: str) -> None:
    if unit in UNITS:
        return
    if unit in OTHER_UNITS:
        other, factor = OTHER_UNITS[unit]
        raise document.error(
            where,
            f"{unit!r}: datasets hold {other}; convert with `scale: [{factor}]` on the channel (one factor for each value "
            f"that it picks) and write {other} here",
        )
    raise document.error(where, f"{unit!r} is not a unit of datasets; {nearest(unit, UNITS)}")


def _check_feature(document: Document[Any], where: str, feature: FeatureSpec, sensor: SensorSpec | None) -> None:
    if any(n <= 0 for n in feature.shape) or not feature.shape:
        raise document.error(f"{where}/shape", f"{list(feature.shape)} holds nothing")
    if feature.rate_hz <= 0:
        raise document.error(f"{where}/rate_hz", f"{feature.rate_hz:g} is not a valid rate; give a number above 0")
    for unit in (feature.unit,) if isinstance(feature.unit, str) else feature.unit:
        _check_unit(document, f"{where}/unit", unit)
    if feature.dtype == "video":
        if len(feature.shape) != 3 or feature.shape[2] != 3 or feature.shape[0] % 2 or feature.shape[1] % 2:
            raise document.error(
                f"{where}/shape", f"{list(feature.shape)} is not [rows, columns, 3] with even rows and columns"
            )
        for option in ("names", "pads", "sensor", "layout"):
            if getattr(feature, option):
                raise document.error(f"{where}/{option}", "has no effect on pictures; remove it")
        if isinstance(feature.unit, tuple) or isinstance(feature.range, dict) or feature.history != 1:
            raise document.error(where, "pictures have one unit, one range and no history")
        if feature.range[0] >= feature.range[1]:
            raise document.error(f"{where}/range", "a lower bound is not below its upper bound")
        return
    if len(feature.shape) != 1:
        raise document.error(
            f"{where}/shape",
            f"{list(feature.shape)}: LeRobot can merge and edit only flat features; write [{feature.size}]",
        )
    if feature.layout and (math.prod(feature.layout) != feature.size or sensor is not None):
        raise document.error(
            f"{where}/layout",
            "has no effect: the sensor states it"
            if sensor
            else f"{list(feature.layout)} are not {feature.size} values",
        )
    if feature.names and len(feature.names) != feature.size:
        raise document.error(f"{where}/names", f"{len(feature.names)} names for {feature.size} values")
    if len(set(feature.names)) != len(feature.names):
        raise document.error(f"{where}/names", "a name stands twice")
    if isinstance(feature.unit, tuple) and len(feature.unit) != feature.size:
        raise document.error(f"{where}/unit", f"{len(feature.unit)} units for {feature.size} values")
    if isinstance(feature.range, dict):
        for name in feature.range:
            if name not in feature.names:
                raise document.error(f"{where}/range/{name}", f"no such name; {nearest(name, feature.names)}")
        missing = [n for n in feature.names if n not in feature.range]
        if missing or not feature.names:
            raise document.error(f"{where}/range", f"no range for {', '.join(missing) or 'unnamed values'}")
    if (feature.limits[:, 0] >= feature.limits[:, 1]).any():
        raise document.error(f"{where}/range", "a lower bound is not below its upper bound")
    if sensor is None:
        if feature.pads or feature.history != 1:
            raise document.error(where, "`pads` and `history` need `sensor`")
        return
    if len(set(feature.pads)) != len(feature.pads):
        raise document.error(f"{where}/pads", "a pad stands twice")
    expected = feature.history * len(feature.pads) * sensor.rows * sensor.columns
    if feature.dtype != "int16" or feature.size != expected:
        raise document.error(
            f"{where}/shape",
            f"{feature.dtype} [{feature.size}], but {feature.history} × {len(feature.pads)} pads × "
            f"{sensor.rows}×{sensor.columns} taxels ({sensor.name}) are int16 [{expected}]",
        )


def load_recording_spec(name: str | Path) -> RecordingSpec:
    """A recording spec by its path or the name of a shipped one, checked against its dataset spec. Raises SpecError: with
    file, line, key, value and the way out."""
    path = find_spec(name)
    document = Document(RecordingSpec, path)
    spec = document.value
    check_version(document, spec.spec_version)
    if spec.contract is not None:
        raise document.error("contract", "is not a key of this file; give `dataset:`")
    contract = load_dataset_spec(_beside(document, "dataset", spec.dataset))
    spec = dataclasses.replace(spec, contract=contract)
    for key in spec.features:
        if key not in contract.features:
            raise document.error(f"features/{key}", f"not in {spec.dataset}; {nearest(key, contract.features)}")
    missing = [k for k, f in contract.features.items() if k not in spec.features and not f.optional]
    if missing:
        raise document.error("features", f"nothing fills {', '.join(missing)} of {spec.dataset}")
    _check_keys_of_reader(document, spec)
    for key, mapping in spec.features.items():
        _check_mapping(document, spec, key, mapping)
    used = {c for m in spec.features.values() for c in m.channels}
    for name_, channel in spec.channels.items():
        where = f"channels/{name_}"
        if name_ not in used:
            raise document.error(where, "no feature uses it; remove it or map it")
        if channel.max_age_s is not None and channel.max_age_s <= 0:
            raise document.error(f"{where}/max_age_s", f"{channel.max_age_s} s: every row would be stale")
        if channel.rate_hz <= 0:
            raise document.error(f"{where}/rate_hz", f"{channel.rate_hz} is not a valid rate; give a number above 0")
        if channel.scale and channel.pick and len(channel.scale) != len(channel.pick):
            text = f"{len(channel.scale)} factors for {len(channel.pick)} picked values"
            raise document.error(f"{where}/scale", text)
        if channel.pick and channel.field is None and vector_type(channel.type or "") is None:
            raise document.error(
                f"{where}/pick",
                "names elements of a `field` (position, velocity …); none is given (needed unless `type` is a pose, a wrench …)",
            )
    if spec.max_clock_spread_s <= 0:
        raise document.error("max_clock_spread_s", f"{spec.max_clock_spread_s:g} s: no two clocks agree so closely")
    _check_sources(document, spec)
    return spec


def _check_keys_of_reader(document: Document[Any], spec: RecordingSpec) -> None:
    """Check that every key that the file states does something with its reader."""
    for key, why in WITHOUT_EFFECT.get(spec.reader, {}).items():
        for where in (key, *(f"channels/{name}/{key}" for name in spec.channels)):
            if document.has(where):
                raise document.error(where, f"has no effect with reader: {spec.reader}: {why}; remove it")
    for name in spec.channels:
        if spec.reader == "lerobot" and spec.clock_of(name) == "header":
            raise document.error(
                f"channels/{name}/clock" if document.has(f"channels/{name}/clock") else "clock",
                "header: rows of a LeRobot dataset have one time, write log",
            )
        if document.has(f"channels/{name}/channel_order") and name not in spec.picture_channels:
            text = "has no effect: it fills no video feature; remove it"
            raise document.error(f"channels/{name}/channel_order", text)


def _check_mapping(document: Document[Any], spec: RecordingSpec, key: str, mapping: MappingSpec) -> None:
    where, feature = f"features/{key}", spec.target.features[key]
    if not mapping.channels or len(set(mapping.channels)) != len(mapping.channels):
        raise document.error(f"{where}/channels", "names no channel, or the same channel twice")
    for name in mapping.channels:
        if name not in spec.channels:
            raise document.error(f"{where}/channels", f"no channel {name!r}; {nearest(name, spec.channels)}")
        has_age = spec.channels[name].max_age_s is not None
        if has_age and mapping.align == "hold":
            text = f"has no effect: {key} has the last value; use align: asof"
            raise document.error(f"channels/{name}/max_age_s", text)
        if not has_age and mapping.align != "hold":
            raise document.error(f"channels/{name}", f"key 'max_age_s' is missing: {key} is aligned by {mapping.align}")
    if feature.dtype == "video" and (len(mapping.channels) != 1 or mapping.align not in ("hold", "asof")):
        raise document.error(where, "a picture comes from one channel, aligned by hold or asof")
    if feature.dtype == "video" or key in spec.target.sensors:
        for name, option in itertools.product(mapping.channels, ("pick", "scale")):
            if getattr(spec.channels[name], option):
                raise document.error(f"channels/{name}/{option}", f"has no effect: {key} has no named numbers")
    if (mapping.align == "window") != (feature.history > 1):
        text = f"{mapping.align} with history: {feature.history}; a window needs history > 1"
        raise document.error(f"{where}/align", text)
    if mapping.align == "interpolate" and feature.dtype != "float32":
        raise document.error(f"{where}/align", f"{feature.dtype} values are not interpolated")
    if key in spec.target.sensors and len(mapping.channels) != len(feature.pads):
        raise document.error(f"{where}/channels", f"{len(mapping.channels)} channels for pads {list(feature.pads)}")
    picked = [len(spec.channels[c].pick) for c in mapping.channels]
    if feature.dtype == "float32" and all(picked) and sum(picked) != feature.size:
        raise document.error(f"{where}/channels", f"pick {sum(picked)} values together; {key} has {feature.size}")


def _check_sources(document: Document[Any], spec: RecordingSpec) -> None:
    episodes, instruction = spec.episodes, spec.instruction
    if (episodes.by == "markers") != (episodes.topic is not None):
        raise document.error("episodes", "`topic` goes with `by: markers`, and only with it")
    needs = {"spec": "text", "metadata": "key", "topic": "topic", "markers": None}[instruction.from_]
    for field in ("text", "key", "topic"):
        given = getattr(instruction, field) is not None
        if given != (field == needs):
            verb = "is missing" if not given else "has no effect"
            raise document.error("instruction", f"`{field}` {verb} with `from: {instruction.from_}`")
    if instruction.text is not None and instruction.text.strip() in ("", "TODO"):
        raise document.error("instruction/text", "is empty or `TODO`; write the instruction: the policy reads it")
    if instruction.from_ == "markers" and episodes.by != "markers":
        raise document.error("instruction/from", "`from: markers` requires `episodes: by: markers`")


def _beside(document: Document[Any], key: str, name: str) -> Path:
    """The file that ``key`` names, relative to the document's own folder."""
    path = document.path.parent / name
    if not path.is_file():
        siblings = [p.name for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
        raise document.error(key, f"no file {name!r} beside it; {nearest(path.name, siblings)}")
    return path


def check_version(document: Document[Any], version: int) -> None:
    """Raise a SpecError if this code does not read files of that version."""
    if version != SPEC_VERSION:
        raise document.error("spec_version", f"{version}; this taccorl reads version {SPEC_VERSION}")
