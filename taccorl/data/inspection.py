"""Inspect a recording: channels, rates, gaps, clock skew, names of joints, damage, and the shipped specs that fit it."""

import contextlib
import math
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np

from taccorl.data import decode, pictures
from taccorl.data.recording import (
    Damage,
    Message,
    Reader,
    Source,
    TopicType,
    find_sources,
    readers,
)
from taccorl.data.ros import unit_of, vector_type
from taccorl.data.sensor_spec import SensorSpec, WireSpec, load_sensor_spec
from taccorl.data.spec import ChannelSpec, data_specs_folder
from taccorl.data.spec import shipped_recording_specs as shipped
from taccorl.data.timing import NS_PER_S, SIM_TIME_S
from taccorl.errors import RecordingError

PICTURES = ("CompressedImage", "Image", "CompressedVideo")
PICTURE_WORDS = (
    "image",
    "camera",
    "cam",
    "picture",
    "rgb",
    "color",
    "colour",
)  # In the names of topics of pictures
JOINTS = ("JointState",)
ARRAYS = ("MultiArray",)
TEXTS = ("String",)
WIRE_DTYPES = get_args(
    get_type_hints(WireSpec)["dtype"]
)  # Data types that a pad's counts may have
IMU_PARTS = ("orientation", "angular_velocity", "linear_acceleration")


@dataclass(frozen=True)
class TopicSummary:
    """One topic, measured over the whole recording."""

    topic: str
    type: TopicType
    num_messages: int
    first_ns: int  # Log time of the first message [ns]; ``last_ns``: of the last one
    last_ns: int
    rate_hz: float
    """1 / median interval of the topic's own stamps, or of log times if it has none [Hz]; 0 with fewer than two messages."""
    longest_gap_s: float
    num_gaps: int  # Intervals longer than 1.5 median intervals
    stamped: bool  # True if its messages have a header stamp
    skew_s: float
    """Median of log time − header stamp [s], and 0.99 quantile of the distance from it; 0 without a header."""
    skew_p99_s: float
    repeated: int  # Number of messages with the stamp of an earlier one
    zero_stamps: int  # Number of messages whose stamp is 0, on a topic where other stamps are times
    names: tuple[str, ...] = ()
    """Names of the values: the ``name`` list of its messages (a topic with several such lists has a summary for each), the
    type's, or paths such as ``force.x`` in a wrench."""
    units: tuple[str, ...] = ()
    """Unit of each value of a vector, pose and the like, empty where the type does not state one; () for other messages."""
    frame: str = ""
    """``header.frame_id`` of a vector, pose and the like; empty for odometry, whose twist is in another frame than its pose."""
    num_values: int | None = None
    """Number of numbers in a message of joints or of an array; None if it holds no list of numbers."""
    sensor: str | None = None
    """Name of the shipped sensor whose pad frames have the same type and size; None if there is none."""
    counts: tuple[str, tuple[int, ...]] | None = None
    """Wire dtype and shape of a message of unsigned counts that no shipped sensor fits, possibly a pad of another kind."""
    unusable: int = 0
    """Number of the topic's messages that give no sample: they hold no names or no values, or come before the first key frame."""
    first: Any = field(default=None, repr=False, compare=False)
    """First message with these names, where the topic has joint states."""
    like: str = ""
    """Name of a known type whose fields its first message has, where its own type is not known; else empty."""
    misfit: str = ""
    """Reason why its first message cannot be used, such as a picture in an unknown encoding; empty if it can."""

    @property
    def key(self) -> tuple[str, tuple[str, ...]]:
        """Topic and names of its values, which no other summary of the recording has."""
        return self.topic, self.names

    @property
    def problem(self) -> str:
        """Name of the topic and the reason why its values cannot be decoded; empty if they can."""
        why = self.type.undecodable or self.misfit
        return why if not why or why.startswith(self.topic) else f"{self.topic}: {why}"

    @property
    def is_picture(self) -> bool:
        """Whether its messages are pictures: by their type, or stored as arrays of three axes, or of two under a fitting name."""
        if self.type.shape is None:
            return self.holds(PICTURES)
        named = any(
            word.startswith(PICTURE_WORDS)
            for word in re.split(r"[^a-z]+", self.topic.lower())
        )
        return len(self.type.shape) == 3 or (len(self.type.shape) == 2 and named)

    @property
    def sim_time(self) -> bool:
        """True if header stamps count from the start of a simulation (or from boot), not from 1970."""
        return self.stamped and abs(self.skew_s) > SIM_TIME_S

    def holds(self, kinds: tuple[str, ...]) -> bool:
        """Whether the name of its message type, or of the one that it is like, ends in one of ``kinds``, in any package."""
        name = self.like or self.type.name
        return any(kind in decode.type_key(name).rsplit("/", 1)[-1] for kind in kinds)


@dataclass(frozen=True)
class Inventory:
    """Contents of one recording."""

    source: Source
    reader: str
    topics: tuple[TopicSummary, ...]
    metadata: dict[str, dict[str, str]]
    damage: tuple[Damage, ...]
    fits: tuple[str, ...] = ()
    """Shipped recording specs whose topics are all in the recording."""

    @property
    def times_known(self) -> bool:
        """False: the file states neither times nor a rate, so that the reader assumed a rate."""
        return "rate" not in self.metadata.get("time", {})

    @property
    def faults(self) -> tuple[str, ...]:
        """Reasons why the recording cannot be read as a whole even with a spec that fits."""
        simulated, lost = (
            [t.topic for t in self.topics if t.sim_time],
            [d for d in self.damage if d.lost],
        )
        found = (
            [
                f"{len(simulated)} topics are stamped in simulation time, first {simulated[0]}"
            ]
            if simulated
            else []
        )
        more = f" (and {len(lost) - 1} more)" if len(lost) > 1 else ""
        return (*found, *([f"it is damaged: {lost[0]}{more}"] if lost else []))

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message of all topics [s]."""
        spans = [(t.first_ns, t.last_ns) for t in self.topics if t.num_messages]
        return (
            (max(b for _, b in spans) - min(a for a, _ in spans)) / NS_PER_S
            if spans
            else 0.0
        )


def inspect_source(reader_name: str, source: Source) -> Inventory:
    """Read every message's times; decode one message of each topic of joints, arrays and pictures. Raises RecordingError: not
    of that format, or empty."""
    reader = readers.get(reader_name)(source)
    times: dict[str, tuple[list[int], list[int | None]]] = {}
    for m in reader.messages(None):
        log, stamp = times.setdefault(m.topic, ([], []))
        log.append(m.log_ns)
        stamp.append(m.stamp_ns)
    types = reader.topics()
    summaries = [
        _summary(topic, types[topic], *times.get(topic, ([], [])))
        for topic in sorted(types)
    ]
    summaries = [replace(t, like=_like(reader, t)) for t in summaries]
    summaries = [part for t in summaries for part in _by_names(reader, t)]
    sensors = {
        p.stem: load_sensor_spec(p)
        for p in sorted((data_specs_folder() / "sensors").glob("*.yaml"))
    }
    summaries = tuple(
        replace(t, first=None, **_first_message(reader, t, sensors)) for t in summaries
    )
    fits = _fitting(
        reader_name, {t.topic: t.type.name for t in summaries if t.num_messages}
    )
    return Inventory(
        source,
        reader_name,
        summaries,
        dict(reader.metadata),
        tuple(reader.damage),
        fits,
    )


def choose_spec(paths: Sequence[Path]) -> str:
    """Name of the shipped recording spec that all recordings at ``paths`` fit by their topics. Raises RecordingError: none
    fits, or several do; the message has the command that helps."""
    fits: list[str] | None = None
    for path in paths:
        for reader_name, source in find_sources(path, skipped=[]):
            topics = {
                topic: kind.name
                for topic, kind in readers.get(reader_name)(source).topics().items()
            }
            own = _fitting(reader_name, topics)
            if not own:
                it = shlex.quote(str(path))
                text = f"no shipped spec fits. `taccorl compare {it}` checks joints or pads without cameras; "
                raise RecordingError(
                    f"{source.name}: {text}`taccorl ingest inspect {it} --draft=FILE` drafts a --spec"
                )
            fits = [name for name in own if fits is None or name in fits]
            if not fits:
                raise RecordingError(
                    f"{source.name}: fits {', '.join(own)}, those before it do not: give --spec=…"
                )
            if (
                source.part is not None
            ):  # the other episodes of one file or dataset are like it
                break
    if fits is None or len(fits) != 1:
        raise RecordingError(
            f"{paths[0]}: fits the specs {', '.join(fits or ())}: choose one with --spec=…"
        )
    return fits[0]


def _summary(
    topic: str, kind: TopicType, log: list[int], stamps: list[int | None]
) -> TopicSummary:
    log_ns, stamp_ns = (
        np.array(log, dtype=np.int64),
        np.array([s or 0 for s in stamps], dtype=np.int64),
    )
    stamped = bool(stamps) and all(stamps[len(stamps) // 2 :])
    good = stamp_ns != 0
    own = np.sort(stamp_ns[good]) if stamped else np.sort(log_ns)
    steps = np.diff(own)[np.diff(own) > 0] / NS_PER_S
    median = float(np.median(steps)) if len(steps) else 0.0
    skew = (log_ns[good] - stamp_ns[good]) / NS_PER_S if stamped else np.zeros(1)
    ends = (int(log_ns[0]), int(log_ns[-1])) if len(log) else (0, 0)
    gaps = (
        float(steps.max()) if len(steps) else 0.0,
        int((steps > 1.5 * median).sum()),
    )
    skews = (
        float(np.median(skew)),
        float(np.quantile(np.abs(skew - np.median(skew)), 0.99)),
    )
    odd = (int((np.diff(own) == 0).sum()), int((~good).sum()) if stamped else 0)
    return TopicSummary(
        topic,
        kind,
        len(log),
        *ends,
        1.0 / median if median else 0.0,
        *gaps,
        stamped,
        *skews,
        *odd,
    )


def _like(reader: Reader, t: TopicSummary) -> str:
    """``TopicSummary.like`` of a topic, by the fields of its first message: JSON, and types of one's own."""
    known = t.holds((*JOINTS, *ARRAYS, *PICTURES, *TEXTS))
    is_told = known or vector_type(t.type.name) is not None
    if is_told or t.type.undecodable or t.type.shape is not None or not t.num_messages:
        return ""
    try:
        messages = reader.messages({t.topic}, start_ns=t.first_ns, end_ns=t.first_ns)
        value = next((m.value for m in messages), None)
        positions, data = (decode.maybe(value, key) for key in ("position", "data"))
        if decode.names_of(value) and isinstance(positions, list | np.ndarray):
            return "JointState"
        if isinstance(data, str | bytes) and decode.maybe(value, "format"):
            return "CompressedVideo" if pictures.is_stream(value) else "CompressedImage"
        if isinstance(data, str | bytes) and decode.maybe(value, "encoding"):
            return "Image"
        numbers = np.asarray(data if isinstance(data, list | np.ndarray) else [])
    except (RecordingError, TypeError, ValueError):
        return ""
    if numbers.ndim != 1 or numbers.size == 0 or numbers.dtype.kind not in "iuf":
        return ""
    is_count = numbers.dtype.kind in "iu" and numbers.min() >= 0
    return "UInt16MultiArray" if is_count else "Float64MultiArray"


def _layout(value: Any, size: int) -> tuple[int, ...]:
    """Sizes of the axes that a message states for its ``size`` numbers (``layout.dim``); (size,) where it states none."""
    dimensions = decode.maybe(decode.maybe(value, "layout"), "dim") or ()
    try:
        sizes = tuple(int(decode.get(axis, "size")) for axis in dimensions)
    except (RecordingError, TypeError, ValueError):
        return (size,)
    return sizes if len(sizes) > 1 and math.prod(sizes) == size else (size,)


def _by_names(reader: Reader, t: TopicSummary) -> list[TopicSummary]:
    """One summary for each set of names that occurs in a topic of joint states: several drivers may publish on one topic."""
    if (
        t.type.undecodable
        or t.type.shape is not None
        or not t.num_messages
        or not t.holds(JOINTS)
    ):
        return [t]
    times: dict[tuple[str, ...], tuple[list[int], list[int | None], Any]] = {}
    unusable = 0
    try:
        for m in reader.messages({t.topic}):
            names, positions = (
                decode.names_of(m.value) or (),
                decode.maybe(m.value, "position"),
            )
            if not names or positions is None or len(positions) == 0:
                unusable += 1
                continue
            log, stamp, _ = times.setdefault(names, ([], [], m.value))
            log.append(m.log_ns)
            stamp.append(m.stamp_ns)
    except (RecordingError, TypeError):
        return [t]
    parts = [
        (_summary(t.topic, t.type, log, stamp), n, first)
        for n, (log, stamp, first) in times.items()
    ]
    return [
        replace(part, names=names, unusable=unusable, first=first, like=t.like)
        for part, names, first in parts
    ] or [t]


def _first_message(
    reader: Reader, t: TopicSummary, sensors: dict[str, SensorSpec]
) -> dict[str, Any]:
    """Facts that only a decoded message gives: names, number of values, whether it is a pad frame, why it cannot be used."""
    if t.type.undecodable or not t.num_messages:
        return {}

    def first() -> (
        Message | None
    ):  # read by its time where the reader can; the file is let go after it
        return next(
            iter(reader.messages({t.topic}, start_ns=t.first_ns, end_ns=t.first_ns)),
            None,
        )

    try:
        if (shape := t.type.shape) is not None:
            if t.is_picture:
                if t.type.encoding == "hdf5" and (found := first()) is not None:
                    pictures.picture(
                        found.value, ChannelSpec(topic=t.topic, rate_hz=1.0)
                    )
                return {}
            frames = {
                n: ((s.wire.rows * s.wire.columns,), (s.wire.rows, s.wire.columns))
                for n, s in sensors.items()
            }
            fitting = [
                n
                for n, s in sensors.items()
                if t.type.name == s.wire.dtype and shape in frames[n]
            ]
            size = (
                math.prod(shape)
                if len(shape) <= 1 or t.type.encoding == "lerobot"
                else None
            )
            is_wire = (
                not fitting and t.type.name in WIRE_DTYPES and len(shape) in (1, 2)
            )
            counts = (t.type.name, shape) if is_wire else None
            return {
                "names": t.type.names,
                "num_values": size,
                "sensor": next(iter(fitting), None),
                "counts": counts,
            }
        if (
            not t.holds((*JOINTS, *ARRAYS, *PICTURES))
            and vector_type(t.type.name) is None
        ):
            return {}
        if t.first is not None:
            return _content(t, t.first, sensors)
        return (
            _content(t, found.value, sensors, reader.messages({t.topic}))
            if (found := first()) is not None
            else {}
        )
    except RecordingError as error:
        return {"misfit": str(error)}


def _stream_content(messages: Iterable[Message]) -> dict[str, Any]:
    """How many messages of a video come before the first frame that decodes: recordings begin between two key frames."""
    stream, taken = None, 0
    for message in messages:
        if stream is None:
            stream = pictures.VideoStream(str(decode.get(message.value, "format")))
        data = decode.get(message.value, "data")
        if any(frame is not None for _, frame in stream.decode(message, data)):
            return {"unusable": taken}
        taken += 1
    if stream is not None and any(
        frame is not None for _, frame in stream.decode(None, None)
    ):
        return {"unusable": 0}
    return {"misfit": f"none of its {taken} messages decodes: no key frame is there"}


def _content(
    t: TopicSummary,
    value: Any,
    sensors: dict[str, SensorSpec],
    messages: Iterable[Message] = (),
) -> dict[str, Any]:
    """``messages``: of the topic, read as far as needed. Raises RecordingError: a spec could not use it either."""
    if vector_type(t.type.name) is not None:
        return _vector_content(t, value)
    channel, dtype_of = (
        ChannelSpec(topic=t.topic, rate_hz=1.0, field="data"),
        (t.like or t.type.name).lower(),
    )
    if t.holds(PICTURES):
        if pictures.is_stream(value):
            return _stream_content(messages)
        pictures.picture(value, replace(channel, field=None))
        return {}
    if t.holds(JOINTS):
        names = tuple(str(n) for n in decode.get(value, "name"))
        size = decode.VectorExtractor(replace(channel, field="position", pick=names))(
            value
        ).size
        return {"names": names, "num_values": size}
    for name, sensor in sensors.items():
        if sensor.wire.dtype in dtype_of:
            with contextlib.suppress(RecordingError):
                return {
                    "sensor": name,
                    "num_values": decode.pad_extractor(channel, sensor)(value).size,
                }
    for dtype in WIRE_DTYPES:
        if dtype in dtype_of:
            size = decode.pad_counts(decode.get(value, "data"), dtype).size
            return (
                {"num_values": size, "counts": (dtype, _layout(value, size))}
                if size
                else {"misfit": "data is empty"}
            )
    return {"num_values": decode.VectorExtractor(channel)(value).size}


def _vector_content(t: TopicSummary, value: Any) -> dict[str, Any]:
    """Names and units of a vector, a pose …; of an IMU only what it measures (else its covariance begins with −1). Raises
    RecordingError: a field that holds no number."""
    decode.VectorExtractor(ChannelSpec(topic=t.topic, rate_hz=1.0))(value)
    covariances = {
        part: np.ravel(decode.maybe(value, f"{part}_covariance")) for part in IMU_PARTS
    }
    absent = [
        part
        for part, covariance in covariances.items()
        if covariance[:1].tolist() == [-1.0]
    ]
    names = tuple(
        name
        for name in decode.vector_paths(value)
        if name.partition(".")[0] not in absent
    )
    units = tuple(unit_of(name, t.type.name) for name in names)
    # An odometry's pose is in header.frame_id, its twist in child_frame_id (nav_msgs/Odometry): no frame is that of all.
    is_odometry = all(
        decode.maybe(value, f) is not None
        for f in ("child_frame_id", "pose.pose", "twist.twist")
    )
    frame = "" if is_odometry else decode.maybe(value, "header.frame_id")
    return {
        "names": names,
        "num_values": len(names),
        "units": units,
        "frame": str(frame or ""),
    }


def _fitting(reader_name: str, topics: dict[str, str]) -> tuple[str, ...]:
    """Shipped specs whose topics are all there, with their types."""

    def fits(c: ChannelSpec) -> bool:
        found = topics.get(c.topic)
        return found is not None and decode.type_key(
            c.type or found
        ) == decode.type_key(found)

    texts = {
        n: {t for t in (s.episodes.topic, s.instruction.topic) if t}
        for n, s in shipped().items()
    }
    own = [
        (n, s)
        for n, s in shipped().items()
        if s.reader == reader_name and texts[n] <= set(topics)
    ]
    return tuple(name for name, spec in own if all(map(fits, spec.channels.values())))
