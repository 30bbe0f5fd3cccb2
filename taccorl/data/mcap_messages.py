"""Decoders for the messages of an MCAP channel, and fast extraction of their stamps."""

import contextlib
import json
import re
import struct
from collections.abc import Callable
from typing import Any

from mcap.records import Channel, Schema

from taccorl.data import decode
from taccorl.data.joint_state_cdr import joint_state_decoder
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
    """A CDR message as it was before rosbag2 compressed it (compression_mode: MESSAGE). CDR begins with a zero, zstd does not, so
    that the bag's metadata.yaml is not needed.

    Raises:
        ValueError: damaged, or larger than ``MOST_BYTES``.
    """
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
    """Function from bytes to a message: an object with attributes (ROS 2, protobuf) or a JSON object.

    Raises:
        RecordingError: an encoding that is not read, or a schema that does not parse.
    """
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
