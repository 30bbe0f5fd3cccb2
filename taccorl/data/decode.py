"""What a decoded message means: numbers by name, pad frames, pictures, texts. The same for ROS 2, protobuf, JSON and arrays."""

import base64
import binascii
import re
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from taccorl.data.spec import ChannelSpec, SensorSpec
from taccorl.errors import RecordingError, nearest


def natural_key(name: str) -> tuple[Any, ...]:
    """Sort key that puts episode_2 before episode_10."""
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name))


def type_key(name: str) -> str:
    """``sensor_msgs/JointState`` and ``sensor_msgs/msg/JointState`` are one type."""
    return name.replace("/msg/", "/")


def get(value: Any, field: str) -> Any:
    """A dotted field of a message (attributes) or a JSON object (keys).

    Raises:
        RecordingError: there is no such field; names the nearest.
    """
    for part in field.split("."):
        if isinstance(value, dict):
            if part not in value:
                raise RecordingError(f"no field {part!r}; {nearest(part, value)}")
            value = value[part]
        elif hasattr(value, part):
            value = getattr(value, part)
        else:
            raise RecordingError(f"no field {part!r}; {nearest(part, _fields(value))}")
    return value


def _fields(value: Any) -> list[str]:
    slots = getattr(type(value), "__slots__", None) or getattr(value, "__dict__", {})
    descriptor = getattr(value, "DESCRIPTOR", None)
    return [f.name for f in descriptor.fields] if descriptor is not None else [str(s).lstrip("_") for s in slots]


def stamp_ns(value: Any) -> int | None:
    """Header stamp of a decoded message (ns): ``header.stamp``, or a Foxglove ``timestamp``; None if it has neither."""
    for field in ("header.stamp", "timestamp"):
        try:
            stamp = get(value, field)
        except RecordingError:
            continue
        for sec, nsec in (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"), ("secs", "nsecs")):
            try:
                return int(get(stamp, sec)) * 1_000_000_000 + int(get(stamp, nsec))
            except (RecordingError, TypeError, ValueError):
                continue
    return None


def text(value: Any, topic: str) -> str:
    """A std_msgs/String, a JSON string or ``{"data": …}``."""
    if isinstance(value, str):
        return value
    found = get(value, "data")
    if not isinstance(found, str):
        raise RecordingError(f"{topic}: expected a text, found {type(found).__name__}")
    return found


def vector_extractor(channel: ChannelSpec) -> Callable[[Any], np.ndarray]:
    """(size,) float64 of one message: ``field``, picked by the message's own names, times ``scale``."""
    scale = np.array(channel.scale) if channel.scale else None
    indices: dict[tuple[str, ...], list[int]] = {}

    def pick(value: Any, numbers: np.ndarray) -> np.ndarray:
        names = tuple(get(value, "name"))
        if names not in indices:
            absent = [n for n in channel.pick if n not in names]
            if absent:
                raise RecordingError(f"no {absent[0]!r} among its names; {nearest(absent[0], names)}")
            indices[names] = [names.index(n) for n in channel.pick]
        if numbers.size < len(names):
            raise RecordingError(f"{numbers.size} values for {len(names)} names in {channel.field!r}")
        return numbers[indices[names]]

    def extract(value: Any) -> np.ndarray:
        found = get(value, channel.field) if channel.field else value
        try:
            numbers = np.asarray(found, dtype=np.float64).reshape(-1)
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{channel.field or 'its value'} is no list of numbers: {error}") from error
        if channel.pick:
            numbers = pick(value, numbers)
        if scale is not None:
            if scale.size not in (1, numbers.size):
                raise RecordingError(f"{numbers.size} values, the spec scales {scale.size}")
            numbers = numbers * scale
        return numbers

    return extract


def pad_extractor(channel: ChannelSpec, sensor: SensorSpec) -> Callable[[Any], np.ndarray]:
    """(rows · columns,) counts of one pad frame in the pad's own order, as the wire's dtype."""
    wire = sensor.wire
    dtype = np.dtype(wire.dtype).newbyteorder("<")

    def extract(value: Any) -> np.ndarray:
        found = get(value, channel.field) if channel.field else value
        if isinstance(found, str):
            found = _from_base64(found)
        if isinstance(found, bytes | bytearray | memoryview):
            counts = np.frombuffer(found, dtype)
        else:
            exact = np.asarray(found).reshape(-1)
            counts = exact.astype(dtype)
            if not np.array_equal(counts, exact):
                raise RecordingError(f"counts that are not {wire.dtype} (normalised by the driver?): record raw counts")
        if counts.size != wire.rows * wire.columns:
            raise RecordingError(
                f"{counts.size} taxels, sensor {sensor.name} has {wire.rows}×{wire.columns}; "
                f"other layouts: a file in data_specs/sensors/"
            )
        frame = counts.reshape(wire.rows, wire.columns)
        return (frame.T if wire.transpose else frame).reshape(-1)

    return extract


def picture(value: Any, channel: ChannelSpec) -> np.ndarray:
    """(rows, columns, 3) uint8 RGB of a compressed (JPEG, PNG) or raw picture, or of a stored array.

    Raises:
        RecordingError: damaged, or an encoding we do not decode.
    """
    if isinstance(value, np.ndarray) and value.ndim == 3:
        return value if channel.channel_order == "rgb" else np.ascontiguousarray(value[..., ::-1])
    data = value if isinstance(value, bytes | np.ndarray) else get(value, channel.field or "data")
    if isinstance(data, str):
        data = _from_base64(data)
    encoding = _maybe(value, "encoding")
    if encoding is not None:
        return _raw_picture(value, bytes(data), str(encoding))
    # A picture is never turned by its EXIF note: the camera's frame is the pixel grid.
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if decoded is None:
        raise RecordingError(
            f"a picture of format {_maybe(value, 'format')!r} that OpenCV cannot decode (jpeg and png are read)"
        )
    return cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)


def _raw_picture(value: Any, data: bytes, encoding: str) -> np.ndarray:
    channels = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}
    if encoding not in channels:
        raise RecordingError(f"raw pictures in {encoding!r} are not read; {nearest(encoding, channels)}")
    rows, columns, depth = int(get(value, "height")), int(get(value, "width")), channels[encoding]
    step = int(_maybe(value, "step") or columns * depth)
    if len(data) < rows * step:
        raise RecordingError(f"{len(data)} bytes for a picture of {rows}×{step} bytes")
    pixels = (
        np.frombuffer(data, np.uint8, rows * step)
        .reshape(rows, step)[:, : columns * depth]
        .reshape(rows, columns, depth)
    )
    if depth == 1:
        return np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels[..., :3] if encoding.startswith("rgb") else pixels[..., 2::-1])


def letterbox(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """``image`` scaled to fit (rows, columns) with its aspect kept, black bars around it (as π0.5 pads)."""
    height, width = image.shape[:2]
    if (height, width) == (rows, columns):
        return image
    factor = min(rows / height, columns / width)
    inner = (max(1, round(height * factor)), max(1, round(width * factor)))
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    scaled = cv2.resize(image, (inner[1], inner[0]), interpolation=method)
    out = np.zeros((rows, columns, 3), np.uint8)
    top, left = (rows - inner[0]) // 2, (columns - inner[1]) // 2
    out[top : top + inner[0], left : left + inner[1]] = scaled
    return out


def _maybe(value: Any, field: str) -> Any:
    try:
        return get(value, field)
    except RecordingError:
        return None


def _from_base64(data: str) -> bytes:
    try:
        return base64.b64decode(data, validate=True)
    except binascii.Error as error:
        raise RecordingError(f"text that is not base64: {error}") from error
