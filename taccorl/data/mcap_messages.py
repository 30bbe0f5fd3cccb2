"""Decoders for the messages of an MCAP channel, and fast extraction of their stamps and joint states."""

import contextlib
import json
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.records import Channel, Schema

from taccorl.data import decode
from taccorl.errors import RecordingError

Decoder = Callable[[bytes], Any]  # Function from a message's bytes to the decoded message
Stamper = Callable[[bytes], int | None]  # Function from a message's bytes to its stamp [ns]; None if it has none
NO_SCHEMA = "no schema"  # Type of messages of a channel without a schema
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MOST_BYTES = 1 << 28
"""Most bytes of an unpacked message: 256 MiB. A compressed one of a few bytes could take all the memory."""
HEADERS = ("std_msgs/Header", "std_msgs/msg/Header", "Header")
# "uint8 OK=1" is a constant; "float64[<=7] x" and "string<=9 x" are fields
ROS_CONSTANT = re.compile(r"\S+\s+[A-Z][A-Z0-9_]*\s*=")


def unpacked(data: bytes) -> bytes:
    """A CDR message as it was before rosbag2 compressed it (compression_mode: MESSAGE). CDR begins with a zero, zstd does
    not, so that the bag's metadata.yaml is not needed. Raises ValueError: damaged, or larger than ``MOST_BYTES``."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    import zstandard

    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            found = reader.read(MOST_BYTES + 1)
    except zstandard.ZstdError as error:
        raise ValueError(f"its zstd compression is damaged: {error}") from error
    if len(found) > MOST_BYTES:
        raise ValueError(f"it unpacks to more than {MOST_BYTES:,} bytes")
    return found


def type_name(schema: Schema | None) -> str:
    """Name of the message type; ``NO_SCHEMA`` without a schema."""
    return schema.name if schema else NO_SCHEMA


def message_decoder(channel: Channel, schema: Schema | None) -> Decoder:
    """Function from bytes to a message: an object with attributes (ROS 2, protobuf) or a JSON object. Raises RecordingError:
    an encoding that is not read, or a schema that does not parse."""
    encoding, found = channel.message_encoding, None
    try:
        if encoding == "json":
            return json.loads
        if encoding == "cdr":
            from mcap_ros2.decoder import DecoderFactory as Ros2

            with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):  # it prints what it raises
                found = Ros2().decoder_for(encoding, schema)
            if found is not None and schema is not None and decode.type_key(schema.name) == "sensor_msgs/JointState":
                found = joint_state_decoder(found)
        elif encoding == "protobuf":
            from mcap_protobuf.decoder import DecoderFactory as Protobuf

            found = Protobuf().decoder_for(encoding, schema)
    except Exception as error:  # a schema text that does not parse: this topic only
        raise RecordingError(
            f"{channel.topic}: its schema {type_name(schema)} does not parse ({type(error).__name__}: {error})"
        ) from error
    if found is None:
        described = f"{schema.encoding} schema {schema.name}" if schema else NO_SCHEMA
        raise RecordingError(
            f"{channel.topic}: {encoding!r} messages with {described} are not supported (supported: cdr with ros2msg, "
            "protobuf, json)"
        )
    return found


def message_stamper(channel: Channel, schema: Schema | None) -> Stamper:
    """Return a function from a message's bytes to its stamp [ns]. If a ROS 2 header comes first, the rest is not decoded."""
    if channel.message_encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
        fields = _top_fields(schema.data.decode(errors="replace"))
        if fields and fields[0][0] in HEADERS and fields[0][1] == "header":
            return _cdr_stamp
        if not {"header", "timestamp"} & {name for _, name in fields}:
            return lambda data: None
    try:
        decoder = message_decoder(channel, schema)
    except RecordingError:
        return lambda data: None

    def stamp(data: bytes) -> int | None:
        try:
            return decode.stamp_ns(decoder(data))
        except Exception:  # only asked for its time: its content may be anything
            return None

    return stamp


def _top_fields(definition: str) -> list[tuple[str, str]]:
    """(type, name) of the fields of a .msg text's own message."""
    fields = []
    for line in definition.splitlines():
        if line.startswith("==="):  # the messages that it refers to follow
            break
        told = line.split("#")[0].strip()
        words = told.split()
        if len(words) >= 2 and not ROS_CONSTANT.match(told):
            fields.append((words[0], words[1]))
    return fields


def _cdr_stamp(data: bytes) -> int | None:
    """header.stamp of a CDR message: 4 bytes of encapsulation (second byte 1: little-endian), then sec, nanosec."""
    if len(data) < 12:
        return None
    sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return sec * 1_000_000_000 + nanosec


# ---- JointState ----
# Several times faster than the decoder of any schema: most messages are of this type.
#
#    4 bytes encapsulation | sec, nanosec | frame_id and names | 3 × (count, padding, doubles): position, velocity, effort
#
# A driver sends the same names in every message, so that everything but stamp and doubles is the same bytes at the same places.
# The first message is read by the general decoder and gives these places; they are used only if they read it to the same values.
# A message whose other bytes or length differ goes to the general decoder, which raises where it does not fit, and gives new
# places.

KEYS = ("position", "velocity", "effort")
LITTLE_ENDIAN = b"\0\1\0\0"


@dataclass(frozen=True)
class _Places:
    """Byte positions of the values in one message, and the required content of its other bytes."""

    values: struct.Struct
    """sec, nanosec, and all doubles in order, from byte 4 on; the bytes between them are skipped."""
    fixed: tuple[tuple[int, int, bytes], ...]
    """(first byte, last byte + 1, required content) of all other byte ranges."""
    size: int
    counts: tuple[int, int, int]
    kinds: tuple[type, type, type]
    """Python classes of message, header and stamp."""
    frame_id: str
    names: tuple[str, ...]

    def fit(self, data: bytes) -> bool:
        return len(data) == self.size and all(data[first:end] == content for first, end, content in self.fixed)


def joint_state_decoder(general: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    """A decoder that reads messages with the layout of the last one directly, and all others with ``general``."""
    places: _Places | None = None

    def decode(data: bytes) -> Any:
        nonlocal places
        if places is not None and places.fit(data):
            return _read(data, places)
        found = general(data)
        places = _places(data, found)
        return found

    return decode


def _read(data: bytes, places: _Places) -> Any:
    """A message whose bytes fit ``places``."""
    sec, nanosec, *numbers = places.values.unpack_from(data, 4)
    found, header, stamp = (kind() for kind in places.kinds)
    stamp.sec, stamp.nanosec = sec, nanosec
    header.stamp, header.frame_id = stamp, places.frame_id
    found.header, found.name = header, list(places.names)
    first = 0
    for key, count in zip(KEYS, places.counts, strict=True):
        setattr(found, key, numbers[first : first + count])
        first += count
    return found


def _places(data: bytes, message: Any) -> _Places | None:
    """Places of the values in a message that the general decoder has read; None if it has not the layout of a JointState."""
    if data[:4] != LITTLE_ENDIAN or _fields(message) != ["header", "name", *KEYS]:
        return None
    at = 12  # frame_id, a text, begins here; offsets count from behind the encapsulation, and 4 does not matter below 8
    for text in (message.header.frame_id, None, *message.name):
        at += -at % 4 + (4 if text is None else _text_bytes(data, at + -at % 4))
    counts, form, fixed, read = [], "<iI", [(0, 4)], 12
    for key in KEYS:
        count = len(getattr(message, key))
        at += -at % 4 + 4
        if count:
            at += -(at - 4) % 8
        form += f"{at - read}x{count}d"
        fixed.append((read, at))
        at += 8 * count
        read = at
        counts.append(count)
    if at > len(data):
        return None
    fixed.append((at, len(data)))
    header = message.header
    found = _Places(
        values=struct.Struct(form),
        fixed=tuple((first, end, data[first:end]) for first, end in fixed),
        size=len(data),
        counts=(counts[0], counts[1], counts[2]),
        kinds=(type(message), type(header), type(header.stamp)),
        frame_id=header.frame_id,
        names=tuple(message.name),
    )
    again = _read(data, found)
    same = all(getattr(again.header.stamp, key) == getattr(header.stamp, key) for key in ("sec", "nanosec"))
    numbers = (np.array_equal(getattr(again, key), getattr(message, key), equal_nan=True) for key in KEYS)
    return found if same and all(numbers) else None


def _fields(message: Any) -> list[str]:
    return list(getattr(type(message), "__slots__", []))


def _text_bytes(data: bytes, at: int) -> int:
    """Length of a CDR text with its count and closing zero."""
    return 4 + struct.unpack_from("<I", data, at)[0] if at + 4 <= len(data) else 4
