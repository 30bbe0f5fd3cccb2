"""Values of decoded messages: numbers by name, pad frames, texts. The same code for ROS 2, protobuf, JSON and arrays."""

import base64
import re
from collections.abc import Callable
from datetime import datetime
from typing import Any

import numpy as np

from taccorl.data.ros import STRUCTURES, WRAPPERS
from taccorl.data.sensor_spec import SensorSpec
from taccorl.data.spec import ChannelSpec
from taccorl.errors import RecordingError, nearest


class NoSample(RecordingError):
    """A message that gives a channel no sample, which is no fault if others do. Its text is the reason, the same for all such
    messages."""


MISSING = object()  # Value that stands for a field which a message does not have
NAMES_FIELDS = (
    "name",
    "joint_names",
)  # Fields that may list the names of the values (JointState, JointTrajectory)
JOINED = "a part of a sample that several messages make"


def natural_key(name: str) -> tuple[Any, ...]:
    """Sort key that puts episode_2 before episode_10."""
    return tuple(
        int(part) if k % 2 else part for k, part in enumerate(re.split(r"(\d+)", name))
    )


def type_key(name: str) -> str:
    """Name of a message type without ``/msg``: ``sensor_msgs/JointState`` and ``sensor_msgs/msg/JointState`` are one type."""
    return name.replace("/msg/", "/")


def _part(value: Any, part: str) -> Any:
    if isinstance(value, dict):
        return value.get(part, MISSING)
    if (
        part.isdecimal()
        and not isinstance(value, str | bytes)
        and hasattr(value, "__getitem__")
    ):
        return value[int(part)] if int(part) < len(value) else MISSING
    return getattr(value, part, MISSING)


def maybe(value: Any, field: str) -> Any:
    """A dotted field of a message (attributes) or a JSON object (keys); a number takes that element of a list, as in
    points.0.positions. None if there is no such field."""
    for part in field.split("."):
        value = _part(value, part)
        if value is MISSING:
            return None
    return value


def get(value: Any, field: str) -> Any:
    """Like ``maybe``, but raises NoSample: a list is shorter; RecordingError: there is no such field; names the nearest."""
    for part in field.split("."):
        inner = _part(value, part)
        if inner is MISSING:
            if (
                part.isdecimal()
                and not isinstance(value, dict | str | bytes)
                and hasattr(value, "__len__")
            ):
                raise NoSample(f"no element {part} in {field!r}: {len(value)} elements")
            raise RecordingError(f"no field {part!r}; {nearest(part, _fields(value))}")
        value = inner
    return value


def _fields(value: Any) -> list[str]:
    if (descriptor := getattr(value, "DESCRIPTOR", None)) is not None:
        return [f.name for f in descriptor.fields]
    slots = getattr(type(value), "__slots__", None) or getattr(value, "__dict__", {})
    return [
        str(s).lstrip("_")
        for s in (value if isinstance(value, dict) else slots)
        if not str(s).startswith("__")
    ]


def stamp_ns(value: Any) -> int | None:
    """Header stamp of a decoded message [ns]: ``header.stamp``, or a ``timestamp`` as Foxglove has it or as a text in ISO 8601;
    None if it has neither."""
    for field in ("header.stamp", "timestamp"):
        stamp = maybe(value, field)
        if isinstance(stamp, str) and (from_text := _iso_ns(stamp)) is not None:
            return from_text
        for sec, nsec in (
            ("sec", "nanosec"),
            ("sec", "nsec"),
            ("seconds", "nanos"),
            ("secs", "nsecs"),
        ):
            try:
                found = int(maybe(stamp, sec)) * 1_000_000_000 + int(maybe(stamp, nsec))
            except (TypeError, ValueError, OverflowError):
                continue
            return found if abs(found) < 2**63 else None
    return None


def _iso_ns(text: str) -> int | None:
    """Nanoseconds since 1970 of a time in ISO 8601 (without a zone: UTC), with up to nine decimals; None for another text."""
    found = re.fullmatch(
        r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](\d{1,9}))?(Z|[+-]\d\d:?\d\d)?",
        text.strip(),
    )
    try:
        moment = datetime.fromisoformat(found[1] + (found[3] or "Z")) if found else None
    except ValueError:
        return None
    return (
        int(moment.timestamp()) * 10**9 + int((found[2] or "0").ljust(9, "0"))
        if found and moment
        else None
    )


def text(value: Any, topic: str) -> str:
    """The text of a std_msgs/String, a JSON string or ``{"data": …}``. Raises RecordingError: it is none of these."""
    found = value if isinstance(value, str) else maybe(value, "data")
    if not isinstance(found, str):
        raise RecordingError(
            f"{topic}: expected a text (std_msgs/String), found {type(found or value).__name__}"
        )
    return found


def vector_paths(value: Any) -> dict[str, str]:
    """Names of the numbers in a ROS vector, pose, twist, wrench, IMU or odometry message → their dotted paths; empty for other
    messages."""
    found: dict[str, str] = {}
    for field in next(
        (s for s in STRUCTURES if all(_part(value, f) is not MISSING for f in s)), ()
    ):
        inner = {"": ""} if len(field) == 1 else vector_paths(_part(value, field))
        if not inner:
            return {}
        prefix = "" if field in WRAPPERS else field
        found |= {
            ".".join(filter(None, (prefix, n))): ".".join(filter(None, (field, p)))
            for n, p in inner.items()
        }
    return found


def names_of(value: Any) -> tuple[str, ...] | None:
    """Names that a message lists for its values; None if it has no such field. Raises RecordingError: no list of texts."""
    for field in NAMES_FIELDS:
        if (found := maybe(value, field)) is not None:
            if isinstance(found, str | bytes) or not hasattr(found, "__len__"):
                raise RecordingError(
                    f"`{field}` is {found!r} instead of a list of names"
                )
            return tuple(map(str, found))
    return None


class VectorExtractor:
    """Function that returns the values of one message, (size,) float64: ``field``, selected by the message's own names, times
    ``scale``. A vector, a pose … (``ros``) gives its numbers with the names of their paths, a JSON object those of its keys.

    It raises ``NoSample`` for messages that are empty or lack the picked names. Where no message has all of them, several make
    one sample: it is complete, and has the time of the last of them, when each name has come again.
    """

    def __init__(self, channel: ChannelSpec) -> None:
        self.channel, self.what = channel, channel.field or "its value"
        self.scale = np.array(channel.scale) if channel.scale else None
        self.indices: dict[tuple[str, ...], list[int] | None] = {}
        self.paths: dict[str, str] = {}
        self.parts: dict[str, float] = {}
        self.ever: set[str] = set()

    def __call__(self, value: Any) -> np.ndarray:
        found = get(value, self.channel.field) if self.channel.field else value
        if not self.paths and not isinstance(found, list | tuple | np.ndarray):
            self.paths = vector_paths(found)
        names = tuple(self.paths) or None
        if self.paths:
            found = [get(found, path) for path in self.paths.values()]
        elif (
            isinstance(found, dict)
            and found
            and all(type(x) in (int, float) for x in found.values())
        ):
            names, found = tuple(found), list(found.values())
            if not self.channel.pick:
                listed = ", ".join(names[:4])
                raise RecordingError(
                    f"an object with the names {listed}: name them in `pick`, in the order to take"
                )
        try:
            plain = np.asarray(found)
            if (
                plain.dtype.kind not in "biuf"
            ):  # NumPy would read the text "1.5" as 1.5, and None as not-a-number
                raise TypeError(f"it is {type(found).__name__} of {plain.dtype}")
            numbers = plain.astype(np.float64).reshape(-1)
        except (TypeError, ValueError, OverflowError) as error:
            raise RecordingError(
                f"{self.what} is not a list of numbers: {error}"
            ) from error
        if numbers.size == 0:
            raise NoSample(f"{self.what} is empty")
        if self.channel.pick:
            names = names or names_of(value)
            if names is None:
                has = ", ".join(_fields(value))
                raise RecordingError(
                    f"no field {NAMES_FIELDS[0]!r} with a list of names, for `pick`; it has {has}"
                )
            numbers = self._picked(names, numbers)
        if self.scale is not None:
            if self.scale.size not in (1, numbers.size):
                raise RecordingError(
                    f"{numbers.size} values, but the spec has factors (`scale`) for {self.scale.size}"
                )
            numbers = numbers * self.scale
        return numbers

    def _picked(self, names: tuple[str, ...], numbers: np.ndarray) -> np.ndarray:
        pick = self.channel.pick
        if numbers.size != len(names):
            raise RecordingError(
                f"{numbers.size} values for {len(names)} names in {self.channel.field!r}"
            )
        if names not in self.indices:
            if twice := [name for name in pick if names.count(name) > 1]:
                raise RecordingError(f"{twice[0]!r} stands twice among its names")
            self.indices[names] = (
                [names.index(n) for n in pick] if set(names) >= set(pick) else None
            )
        if (at := self.indices[names]) is not None:
            return numbers[at]
        if self.paths:  # the same in every message
            wrong = next(name for name in pick if name not in self.paths)
            raise RecordingError(
                f"{wrong!r} is not among its names; {nearest(wrong, self.paths)}"
            )
        self.parts |= {
            name: x for name, x in zip(names, numbers, strict=True) if name in pick
        }
        self.ever |= set(self.parts)
        unseen = [name for name in pick if name not in self.ever]
        if unseen or not set(names) & set(pick):
            lacking = next(iter(unseen), pick[0])
            raise NoSample(
                f"{lacking!r} is not among its names; {nearest(lacking, names)}"
            )
        if len(self.parts) < len(pick):
            raise NoSample(JOINED)
        joined = np.array([self.parts[name] for name in pick])
        self.parts.clear()
        return joined


def pad_extractor(
    channel: ChannelSpec, sensor: SensorSpec
) -> Callable[[Any], np.ndarray]:
    """Function from a decoded message to the counts of one pad frame, (K,), K = rows × columns of taxels, row after row in the
    pad's own order and in the wire's dtype."""
    wire = sensor.wire
    wire_bytes = wire.rows * wire.columns * np.dtype(wire.dtype).itemsize

    def extract(value: Any) -> np.ndarray:
        found = get(value, channel.field) if channel.field else value
        if isinstance(found, np.ndarray) and (found.dtype, found.shape) == (
            np.uint8,
            (wire_bytes,),
        ):  # of ROS: uint8[]
            found = found.tobytes()
        counts = pad_counts(found, wire.dtype)
        if counts.size != wire.rows * wire.columns:
            text = f"{counts.size} taxels, but sensor {sensor.name} has {wire.rows}×{wire.columns}"
            raise RecordingError(
                f"{text}; other layouts: a file in data_specs/sensors/"
            )
        if counts.ndim == 2 and counts.shape != (wire.rows, wire.columns):
            text = f"a frame of {counts.shape[0]}×{counts.shape[1]} taxels, but the wire format of {sensor.name} is "
            raise RecordingError(
                f"{text}{wire.rows}×{wire.columns}: is the frame transposed already?"
            )
        if counts.max() > sensor.max_count:
            text = f"a count of {counts.max()}, but {sensor.name} sends at most {sensor.max_count}: another byte order"
            raise RecordingError(f"{text}, or another sensor?")
        frame = counts.reshape(wire.rows, wire.columns)
        return (frame.T if wire.transpose else frame).reshape(-1)

    return extract


def pad_counts(found: Any, dtype: str) -> np.ndarray:
    """Counts in little-endian bytes, base64 text, or a list or array (…) of whole numbers, in its own shape. Raises
    RecordingError: none of these forms, or a count does not fit ``dtype``."""
    wire = np.dtype(dtype).newbyteorder("<")
    if isinstance(found, str):
        found = from_base64(found)
    if isinstance(found, bytes | bytearray | memoryview):
        if len(found) % wire.itemsize:
            raise RecordingError(
                f"{len(found)} bytes are not a whole number of {dtype} counts"
            )
        return np.frombuffer(found, wire)
    try:
        exact, bounds = np.asarray(found), np.iinfo(wire)
        if exact.dtype.kind not in "biuf":
            raise TypeError(
                f"{type(found).__name__} of {exact.dtype}; name the field that holds the raw counts"
            )
        whole = bool(
            (
                (exact >= bounds.min)
                & (exact <= bounds.max)
                & (exact == np.floor(exact))
            ).all()
        )
    except (TypeError, ValueError) as error:
        raise RecordingError(f"not a list of counts: {error}") from error
    if exact.dtype.kind != "b" and (exact < 0).any():
        taxel = int(np.argmax(exact.reshape(-1) < 0))
        text = f"counts that are not {wire.name}: {exact.reshape(-1)[taxel]:g} (taxel "
        raise RecordingError(
            f"{text}{taxel}) is below 0. Signed bytes (int8, `byte` of ROS 1), or counts "
            f"above a baseline? Record raw counts, as {wire.name}"
        )
    if not whole:
        raise RecordingError(
            f"counts that are not {wire.name} (normalised by the driver?): record raw counts"
        )
    return exact.astype(wire)


def from_base64(data: str) -> bytes:
    """Bytes of a base64 text. Raises RecordingError: it is none."""
    try:
        return base64.b64decode(data, validate=True)
    except ValueError as error:  # not its alphabet (binascii.Error), or not even ASCII
        raise RecordingError(f"text that is not base64: {error}") from error
