"""MCAP: every encoding is read without ROS, and damage costs only what it touched. The files are written by mcap's own writer.

A recording is known message by message, and so is the place of each in the file (walked here by ten lines of their own).
Whatever is then done to its bytes: no exception but RecordingError, nothing outside the damaged chunk is lost, doubled or
changed, and what is lost lies in a byte range that ``damage`` names.
"""

import contextlib
import io
import itertools
import json
import struct
import tracemalloc
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import pytest
import yaml
import zstandard
from google.protobuf import (
    descriptor_pb2,
    descriptor_pool,
    message_factory,
    timestamp_pb2,
)
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2._dynamic import serialize_dynamic
from mcap_ros2.writer import Writer as Ros2Writer

from taccorl.data import mcap_records
from taccorl.data.readers.mcap import McapReader
from taccorl.data.recording import Source, find_sources
from taccorl.data.ros import cdr_stamp
from taccorl.errors import RecordingError

T0_NS = 1_700_000_000_000_000_000
STEP_NS = 1_000_000
NUM_MESSAGES = 48
TEXT = "=" * 80
HEADER_TEXT = (
    f"{TEXT}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
)
JOINT_STATE = (
    f"std_msgs/Header header\nstring[] name\nfloat64[] position\n{HEADER_TEXT}"
)
IMAGE = f"std_msgs/Header header\nstring format\nuint8[] data\n{HEADER_TEXT}"
SERVICE = "bool enable\n---\nbool done\n"  # what rosbag2 stores for a service; no .msg parser accepts it
TOPICS = ("/joints", "/camera", "/pad", "/proto")
LAYOUTS = ("none", "lz4", "zstd", "unchunked")


# --- a small recording, known message by message


def _protobuf() -> tuple[bytes, Any]:
    """(descriptor set, message class) of ``t.Values``: timestamp, repeated double v."""
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    file = descriptor_pb2.FileDescriptorProto(
        name="t.proto", package="t", syntax="proto3", dependency=[stamp.name]
    )
    message = file.message_type.add(name="Values")
    kinds = descriptor_pb2.FieldDescriptorProto
    stamped = {"type": kinds.TYPE_MESSAGE, "type_name": ".google.protobuf.Timestamp"}
    message.field.add(name="timestamp", number=1, label=kinds.LABEL_OPTIONAL, **stamped)
    message.field.add(
        name="v", number=2, label=kinds.LABEL_REPEATED, type=kinds.TYPE_DOUBLE
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(stamp)
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Values"))
    return descriptor_pb2.FileDescriptorSet(
        file=[stamp, file]
    ).SerializeToString(), made


DESCRIPTORS, VALUES = _protobuf()
ENCODERS = {
    "/joints": serialize_dynamic("sensor_msgs/msg/JointState", JOINT_STATE)[
        "sensor_msgs/msg/JointState"
    ],
    "/camera": serialize_dynamic("sensor_msgs/msg/CompressedImage", IMAGE)[
        "sensor_msgs/msg/CompressedImage"
    ],
}


def header(stamp_ns: int) -> dict[str, Any]:
    return {
        "stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9},
        "frame_id": "f",
    }


def values(topic: str, k: int) -> Any:
    """What message k of the recording says."""
    rng = np.random.default_rng(k)
    if topic == "/joints":
        return {
            "name": list("abcd"),
            "position": [float(k), *rng.normal(size=3).tolist()],
        }
    if topic == "/camera":
        return {
            "format": "jpeg",
            "data": rng.integers(0, 256, 150, dtype=np.uint8).tobytes(),
        }
    return [k, k + 0.5] if topic == "/proto" else rng.integers(0, 256, 12).tolist()


def payload(topic: str, k: int) -> bytes:
    """Message k of the recording in its encoding. Stamps are 5 ms before the log time."""
    stamp_ns, said = T0_NS + k * STEP_NS - 5_000_000, values(topic, k)
    if topic in ENCODERS:
        return ENCODERS[topic]({"header": header(stamp_ns), **said})
    if topic == "/proto":
        message = VALUES(v=said)
        message.timestamp.seconds, message.timestamp.nanos = divmod(stamp_ns, 10**9)
        return message.SerializeToString()
    return json.dumps({"data": said}).encode()


def known(topic: str, k: int) -> tuple[Any, ...]:
    """What the reader must say about message k."""
    log_ns = T0_NS + k * STEP_NS
    return (
        topic,
        log_ns,
        None if topic == "/pad" else log_ns - 5_000_000,
        values(topic, k),
    )


def content(topic: str, value: Any) -> Any:
    """What a decoded message says, as ``values`` does."""
    if topic == "/joints":
        return {"name": list(value.name), "position": list(value.position)}
    if topic == "/camera":
        return {"format": value.format, "data": bytes(value.data)}
    return (
        list(value.v) if topic == "/proto" else value.get("data")
    )  # absent where its key was hit


def topic_of(k: int) -> str:
    return TOPICS[k % len(TOPICS)]


def register(writer: Writer) -> dict[str, int]:
    joints = writer.register_schema(
        "sensor_msgs/msg/JointState", "ros2msg", JOINT_STATE.encode()
    )
    camera = writer.register_schema(
        "sensor_msgs/msg/CompressedImage", "ros2msg", IMAGE.encode()
    )
    pad = writer.register_schema("Pad", "jsonschema", b'{"type": "object"}')
    proto = writer.register_schema("t.Values", "protobuf", DESCRIPTORS)
    return {
        "/joints": writer.register_channel("/joints", "cdr", joints),
        "/camera": writer.register_channel("/camera", "cdr", camera),
        "/pad": writer.register_channel("/pad", "json", pad),
        "/proto": writer.register_channel("/proto", "protobuf", proto),
    }


def build(layout: str, number: int = NUM_MESSAGES, **options: Any) -> bytes:
    """The recording as a file; a chunk holds about eight messages."""
    compression = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}.get(
        layout, CompressionType.NONE
    )
    chunked = layout != "unchunked"
    usual = {
        "chunk_size": 1500,
        "compression": compression,
        "use_chunking": chunked,
        "enable_data_crcs": not chunked,
    }
    out = io.BytesIO()
    writer = Writer(out, **{**usual, **options})
    writer.start("ros2", "test")
    ids = register(writer)
    writer.add_metadata("session", {"operator": "nobody"})
    for k in range(number):
        topic, log_ns = topic_of(k), T0_NS + k * STEP_NS
        writer.add_message(ids[topic], log_ns, payload(topic, k), log_ns, k)
        if k == number // 2:
            writer.add_attachment(
                log_ns, log_ns, "notes.txt", "text/plain", bytes(range(200))
            )
    writer.add_metadata("episode_1", {"instruction": "insert"})
    writer.finish()
    return out.getvalue()


class Place(NamedTuple):
    """The piece of a file that one message shares its fate with: its chunk, or itself where there are none."""

    start: int
    end: int
    next_end: int  # End of the record behind it


def records_of(data: bytes) -> list[tuple[int, int, int]]:
    """(opcode, offset, end) of every record up to the footer."""
    found, offset = [], 8
    while offset < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        found.append((opcode, offset, offset + 9 + length))
        offset += 9 + length
    return found


def places_of(data: bytes) -> dict[int, Place]:
    """log_ns → place, by mcap's own chunk parser."""
    places, records = {}, records_of(data)
    for (opcode, offset, end), (_, _, next_end) in itertools.pairwise(records):
        body = data[offset + 9 : end]
        if opcode == 0x06:
            stream = mcap_records.ReadDataStream(io.BytesIO(body))
            logs = [
                r.log_time
                for r in breakup_chunk(Chunk.read(stream), True)
                if hasattr(r, "log_time")
            ]
        else:
            logs = [struct.unpack_from("<Q", body, 6)[0]] if opcode == 0x05 else []
        places.update({log: Place(offset, end, next_end) for log in logs})
    return places


def file_of(*messages: tuple[str, int, bytes], **options: Any) -> bytes:
    """A file of these messages: topic, log time, payload."""
    writer = Writer(out := io.BytesIO(), **options)
    writer.start()
    ids = register(writer)
    for topic, log_ns, data in messages:
        writer.add_message(ids[topic], log_ns, data, 0)
    writer.finish()
    return out.getvalue()


def reader_of(path: Path) -> McapReader:
    return McapReader(Source(path, (path,)))


def delivered(
    reader: McapReader, topics: Any = TOPICS, **options: Any
) -> list[tuple[Any, ...]]:
    return [
        (m.topic, m.log_ns, m.stamp_ns, content(m.topic, m.value))
        for m in reader.messages(topics, **options)
    ]


EXPECTED = [known(topic_of(k), k) for k in range(NUM_MESSAGES)]
FILES = {layout: build(layout) for layout in LAYOUTS}
PLACES = {layout: places_of(FILES[layout]) for layout in LAYOUTS}


def write(folder: Path, data: bytes, name: str = "a.mcap") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


# --- intact files


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_encoding_and_layout_comes_back_message_by_message(tmp_path, layout):
    reader = reader_of(write(tmp_path, FILES[layout]))
    assert delivered(reader) == EXPECTED
    assert reader.damage == []
    assert reader.metadata == {
        "session": {"operator": "nobody"},
        "episode_1": {"instruction": "insert"},
    }
    assert {
        t: (kind.name, kind.encoding, kind.undecodable)
        for t, kind in reader.topics().items()
    } == {
        "/joints": ("sensor_msgs/msg/JointState", "cdr", None),
        "/camera": ("sensor_msgs/msg/CompressedImage", "cdr", None),
        "/pad": ("Pad", "json", None),
        "/proto": ("t.Values", "protobuf", None),
    }


@pytest.mark.parametrize(
    "options",
    [
        {"enable_crcs": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False, "repeat_channels": False,
         "repeat_schemas": False},
    ],
)  # fmt: skip
@pytest.mark.parametrize("layout", LAYOUTS)
def test_crcs_indexes_and_the_summary_are_optional(tmp_path, layout, options):
    reader = reader_of(write(tmp_path, build(layout, **options)))
    assert delivered(reader) == EXPECTED
    assert reader.damage == []


@pytest.mark.parametrize("layout", ["zstd", "unchunked"])
def test_stamps_alone_are_the_same_as_with_decoding(tmp_path, layout):
    """Pictures are found again by (log time, stamp): both ways of reading must agree on them."""
    reader = reader_of(write(tmp_path, FILES[layout]))
    stamps = [(t, log, stamp) for t, log, stamp, _ in EXPECTED]
    assert [(m.topic, m.log_ns, m.stamp_ns) for m in reader.messages(None)] == stamps
    only = list(reader.messages(TOPICS, stamps_only=("/camera",)))
    assert [(m.topic, m.log_ns, m.stamp_ns) for m in only] == stamps
    assert [m.value is None for m in only] == [m.topic == "/camera" for m in only]


def extra() -> bytes:
    """Good topics beside a schema that does not parse, one that nobody knows, one without schema, one of another type."""
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start("ros2", "test")
    ids = register(writer)
    broken = writer.register_schema("srv/Enable_Event", "ros2msg", SERVICE.encode())
    idl = writer.register_schema("pkg/msg/Idl", "ros2idl", b"struct Idl { long x; };")
    proto = writer.register_schema("t.Values", "protobuf", b"not a descriptor set")
    others = {
        "/service": writer.register_channel("/service", "cdr", broken),
        "/idl": writer.register_channel("/idl", "cdr", idl),
        "/bson": writer.register_channel("/bson", "bson", 0),
        "/bad_proto": writer.register_channel("/bad_proto", "protobuf", proto),
        "/lone": writer.register_channel("/lone", "json", 0),
    }
    for k in range(8):
        topic, log_ns = topic_of(k), T0_NS + k * STEP_NS
        writer.add_message(ids[topic], log_ns, payload(topic, k), log_ns)
        for number in others.values():
            writer.add_message(number, log_ns, b'{"x": 1}', log_ns)
    writer.finish()
    return out.getvalue()


def test_topics_that_cannot_be_decoded_do_not_touch_the_others(tmp_path, capfd):
    reader = reader_of(write(tmp_path, extra()))
    assert delivered(reader) == EXPECTED[:8]
    problems = {t: kind.undecodable or "" for t, kind in reader.topics().items()}
    for topic, problem in (
        ("/service", "its schema srv/Enable_Event does not parse"),
        ("/idl", "'cdr' messages with ros2idl schema pkg/msg/Idl are not supported"),
        ("/bson", "'bson' messages with no schema are not supported"),
        ("/bad_proto", "its schema t.Values does not parse"),
    ):
        assert problem in problems[topic]
        with pytest.raises(RecordingError, match=f"^{topic}: "):
            delivered(reader, (topic,))
    assert len(list(reader.messages(None))) == 8 * 6  # their times can still be seen
    assert [t for t, p in problems.items() if not p] == [*TOPICS, "/lone"]
    assert [m.value for m in reader.messages(("/lone",))] == [
        {"x": 1}
    ] * 8  # JSON needs no schema
    assert capfd.readouterr() == ("", "")  # mcap_ros2 prints what it raises


def test_a_topic_of_two_types_is_refused(tmp_path):
    writer = Writer(out := io.BytesIO())
    writer.start()
    kinds = [
        writer.register_schema(name, "jsonschema", b"{}")
        for name in ("t.Empty", "t.Other")
    ]
    ids = [
        writer.register_channel("/t", "json", kind)
        for kind in (kinds[0], kinds[0], kinds[1])
    ]
    writer.add_message(
        ids[1], T0_NS, b'{"x": 1}', T0_NS
    )  # a recorder that began anew: one type
    writer.add_message(ids[2], T0_NS + 1, b'{"x": 2}', T0_NS + 1)
    writer.finish()
    with pytest.raises(
        RecordingError,
        match=r"/t: messages of t\.Other, but its first channel is of t\.Empty",
    ):
        list(reader_of(write(tmp_path, out.getvalue())).messages(("/t",)))


# --- where the stamp is


STAMPED = {
    "header first": ("std_msgs/Header header\nuint8[] data\n" + HEADER_TEXT, {"header": header(T0_NS), "data": b"abc"}, T0_NS),
    "header second": ("string<=9 label\nstd_msgs/Header header\n" + HEADER_TEXT, {"label": "x", "header": header(T0_NS)}, T0_NS),
    "a constant first": ("uint8 A=1\nstd_msgs/Header header\n" + HEADER_TEXT, {"header": header(T0_NS)}, T0_NS),
    "timestamp": ("builtin_interfaces/Time timestamp\nuint8[] data", {"timestamp": header(T0_NS)["stamp"], "data": b""}, T0_NS),
    "header of another name": ("std_msgs/Header head\n" + HEADER_TEXT, {"head": header(T0_NS)}, None),
    "no header": ("uint8[] data", {"data": b"\0" * 30}, None),
}  # fmt: skip


@pytest.mark.parametrize("case", STAMPED)
def test_the_stamp_is_found_wherever_the_header_stands(tmp_path, case):
    definition, message, expected = STAMPED[case]
    with (tmp_path / "a.mcap").open("wb") as file, Ros2Writer(file) as writer:
        schema = writer.register_msgdef("pkg/msg/M", definition)
        writer.write_message("/m", schema, message, log_time=T0_NS + 9)
    for options in (
        {"topics": None},
        {"topics": ("/m",)},
        {"topics": ("/m",), "stamps_only": ("/m",)},
    ):
        (found,) = reader_of(tmp_path / "a.mcap").messages(**options)
        assert found.stamp_ns == expected


def test_big_endian_messages_are_read():
    assert cdr_stamp(b"\x00\x01\x00\x00" + struct.pack("<iI", 3, 4)) == 3_000_000_004
    assert cdr_stamp(b"\x00\x00\x00\x00" + struct.pack(">iI", 3, 4)) == 3_000_000_004
    assert cdr_stamp(b"\x00\x01\x00\x00\x03") is None


# --- salvage


def check_salvage(
    path: Path, layout: str, first: int, last: int, *, shifted: bool = False
) -> McapReader:
    """Read a file whose bytes [first, last) were touched and hold the result against the intact one.

    ``shifted``: bytes were taken away or added, so the places behind differ and the index at the end points astray.
    """
    reader, places, size = reader_of(path), PLACES[layout], path.stat().st_size
    definitions = (
        layout == "unchunked"
        and shifted
        and first < min(p.start for p in places.values())
    )
    try:
        found = delivered(reader)
    except (
        RecordingError
    ) as error:  # a schema without CRC and without a copy at the end
        assert definitions and "does not parse" in str(error)
        return reader
    counts = Counter(log for _, log, _, _ in found)
    by_log = {log: message for message in EXPECTED for log in [message[1]]}
    touched = {log for log, p in places.items() if p.start < last and p.end > first}
    # A message outside chunks counts only if a record begins where it ends: it may go with the one behind it.
    # Where bytes are missing, a record may also have eaten the beginning of the one behind it.
    eaten = max(
        [
            end
            for _, start, end in records_of(FILES[layout])
            if shifted and start < last
        ],
        default=0,
    )
    reach = max(last, eaten + 1)
    neighbours = {
        log
        for log, p in places.items()
        if layout == "unchunked" and p.start < reach and p.next_end > first
    }
    first_chunk = (
        layout != "unchunked"
        and shifted
        and first < min(p.end for p in places.values())
    )
    lost = {log for log in by_log if log not in counts}

    altered = [m for m in found if m != by_log.get(m[1])]
    if (
        layout == "unchunked"
    ):  # only the data section's CRC guards these: it may pass on one message, but says so
        assert len(altered) <= len(touched)
        assert not altered or reader.damage
        lost -= {log for log in lost if altered and log in touched}
    else:
        assert altered == []
    assert all(n == 1 for n in counts.values())
    intact = [m for m in found if m not in altered]
    assert intact == [m for m in EXPECTED if m in intact]  # in the file's order
    if not (definitions or first_chunk):
        assert lost <= touched | neighbours, (
            lost - touched - neighbours,
            reader.damage,
        )
    for d in reader.damage:
        assert 0 <= d.byte_start <= d.byte_end <= size
        assert d.file == str(path)
    if not shifted:
        for log in lost:
            p = places[log]
            assert any(
                d.byte_start <= min(p.end, size) and d.byte_end > min(p.start, size - 1)
                for d in reader.damage
            ), (p, reader.damage)
    assert not lost or any(d.lost for d in reader.damage)
    assert len(list(reader.messages(None))) >= len(found) - len(
        altered
    )  # looking at times only survives it too
    return reader


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_file_cut_anywhere_keeps_what_was_written_before(tmp_path, layout):
    data, rng = FILES[layout], np.random.default_rng(1)
    data_end = next(offset for opcode, offset, _ in records_of(data) if opcode == 0x0F)
    for cut in sorted(
        {
            9,
            20,
            data_end,
            data_end + 5,
            len(data) - 1,
            len(data) - 9,
            *rng.integers(9, len(data), 25).tolist(),
        }
    ):
        reader = check_salvage(write(tmp_path, data[:cut]), layout, cut, len(data))
        assert reader.damage
        assert all(d.byte_end <= cut for d in reader.damage)
        if cut < data_end:
            assert "cut by a crash?" in reader.damage[-1].reason
            assert reader.damage[-1].byte_end == cut


@pytest.mark.parametrize(
    "layout",
    ["zstd", *(pytest.param(x, marks=pytest.mark.slow) for x in ("none", "unchunked"))],
)
def test_any_flipped_bit_in_any_kind_of_record_header_costs_only_that_record(
    tmp_path, layout
):
    """Opcode and length of two records of each kind, bit by bit: a wrong length must not step over sound records unseen."""
    data, seen = FILES[layout], Counter()
    for opcode, offset, _ in records_of(data):
        seen[opcode] += 1
        if seen[opcode] not in (1, 3):
            continue
        for byte in range(9):
            for bit in range(8) if byte == 0 else (0, 3, 7):
                broken = bytearray(data)
                broken[offset + byte] ^= 1 << bit
                reader = check_salvage(
                    write(tmp_path, bytes(broken)),
                    layout,
                    offset + byte,
                    offset + byte + 1,
                )
                if (opcode, byte, bit) == (0x07, 0, 7):
                    continue  # an application's own record, for all that anybody can tell; nothing was in it
                assert reader.damage, (opcode, byte, bit)
                assert any(
                    d.byte_start <= offset + byte < d.byte_end for d in reader.damage
                ), (opcode, byte, bit)


def place_of(layout: str, opcode: int, which: int = 0) -> tuple[int, int]:
    return [
        (offset, end)
        for kind, offset, end in records_of(FILES[layout])
        if kind == opcode
    ][which]


def flip(layout: str, at: int) -> bytes:
    data = bytearray(FILES[layout])
    data[at] ^= 0x10
    return bytes(data)


def test_a_flipped_byte_in_a_chunk_costs_that_chunk_and_names_it_with_its_times(
    tmp_path,
):
    start, end = place_of("zstd", 0x06, 2)
    reader = check_salvage(
        write(tmp_path, flip("zstd", end - 30)), "zstd", end - 30, end - 29
    )
    (damage,) = reader.damage
    logs = sorted(log for log, p in PLACES["zstd"].items() if p.start == start)
    assert (damage.byte_start, damage.byte_end, damage.start_ns, damage.end_ns) == (
        start,
        end,
        logs[0],
        logs[-1],
    )
    assert damage.reason.startswith("chunk lost")
    assert str(damage) == f"a.mcap bytes {start:,} to {end:,}: {damage.reason}"
    assert len(delivered(reader)) == NUM_MESSAGES - len(logs)


@pytest.mark.parametrize("layout", ["none", "lz4", "zstd"])
def test_the_index_at_the_end_gives_meaning_to_messages_whose_definitions_were_lost(
    tmp_path, layout
):
    """The first chunk holds all schemas and channels."""
    start, end = place_of(layout, 0x06, 0)
    lost = sum(p.start == start for p in PLACES[layout].values())
    reader = check_salvage(
        write(tmp_path, flip(layout, end - 20)), layout, end - 20, end - 19
    )
    assert len(delivered(reader)) == NUM_MESSAGES - lost
    assert reader.topics()["/joints"].name == "sensor_msgs/msg/JointState"


def test_without_index_the_messages_of_lost_definitions_are_counted_and_nothing_is_invented(
    tmp_path,
):
    _, end = place_of("zstd", 0x06, 0)
    footer = place_of("zstd", 0x02)[0]
    data = flip("zstd", end - 20)[:footer]  # neither footer nor, therefore, index
    reader = reader_of(write(tmp_path, data))
    assert delivered(reader) == []
    first = sum(
        p.start == place_of("zstd", 0x06, 0)[0] for p in PLACES["zstd"].values()
    )
    assert f"{NUM_MESSAGES - first} messages of channels whose definition was lost" in [
        d.reason for d in reader.damage
    ]


def test_a_damaged_definition_outside_chunks_is_replaced_by_the_index_copy(tmp_path):
    offset, _ = place_of("unchunked", 0x04, 1)
    at = FILES["unchunked"].index(b"/camera", offset) + 3
    reader = check_salvage(
        write(tmp_path, flip("unchunked", at)), "unchunked", at, at + 1
    )
    assert delivered(reader) == EXPECTED
    assert "a damaged channel; the index's copy is used" in [
        d.reason for d in reader.damage
    ]
    assert set(reader.topics()) == set(TOPICS)


def test_unprotected_messages_that_do_not_decode_are_damage_but_a_wrong_schema_is_an_error(
    tmp_path,
):
    data = bytearray(FILES["unchunked"])
    pads = [
        p for log, p in PLACES["unchunked"].items() if (log - T0_NS) // STEP_NS % 4 == 2
    ]
    assert len(pads) == 12
    for p in pads[:10]:
        data[p.end - 1] = ord("!")
    reader = reader_of(write(tmp_path, bytes(data)))
    assert delivered(reader) == [
        m for m in EXPECTED if PLACES["unchunked"][m[1]] not in pads[:10]
    ]
    assert [(d.byte_start, d.byte_end) for d in reader.damage] == [
        (p.start, p.end) for p in pads[:10]
    ]
    data[pads[10].end - 1] = ord("!")  # the eleventh
    with pytest.raises(RecordingError, match=r"/pad: .* does not fit its schema Pad"):
        delivered(reader_of(write(tmp_path, bytes(data))))


OUTSIDE = {
    "a wrong magic": lambda layout, end: (b"\0" + FILES[layout][1:], 0, 8, False),
    "a broken end of the data": lambda layout, end: (flip(layout, end[0]), *end, False),
    "garbage behind the file": lambda layout, end: (
        FILES[layout] + b"g" * 700,
        end[1],
        len(FILES[layout]) + 700,
        False,
    ),
    "a second recording behind it": lambda layout, end: (
        FILES[layout] * 2,
        end[1],
        2 * len(FILES[layout]),
        True,
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("case", OUTSIDE)
def test_damage_outside_of_the_messages_costs_none_of_them_and_is_told(
    tmp_path, layout, case
):
    data, first, last, lost = OUTSIDE[case](layout, place_of(layout, 0x0F))
    reader = reader_of(write(tmp_path, data))
    assert delivered(reader) == EXPECTED
    assert (
        reader.damage[0].byte_start,
        reader.damage[0].byte_end,
        reader.damage[0].lost,
    ) == (first, last, lost)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", r"is empty \(0 bytes\)"),
        (b"\x89MC", "is not an MCAP file: begins with"),
        (b"PK\x03\x04" + bytes(5000), "a ZIP archive, no recording"),
        (
            np.random.default_rng(0)
            .integers(0, 256, 300_000, dtype=np.uint8)
            .tobytes(),
            "is not an MCAP file",
        ),
        (b"\x06" * 100_000, "is not an MCAP file"),
    ],
    ids=["empty", "three bytes", "zip", "noise", "sixes"],
)
def test_what_is_no_mcap_file_is_refused_in_one_line(tmp_path, data, reason):
    path = write(tmp_path, data)
    with pytest.raises(RecordingError, match=reason) as caught:
        delivered(reader_of(path))
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(RecordingError, match=reason):
        reader_of(path).topics()


def test_a_chunk_is_found_again_beside_what_only_looks_like_one(tmp_path):
    """A search that does not overlap would swallow the true start within a false one, 20 bytes before it."""
    start, _ = place_of("none", 0x06, 3)
    data = bytearray(FILES["none"])
    data[start - 40 : start] = bytes(40)
    data[start - 20] = 0x06
    reader = reader_of(write(tmp_path, bytes(data)))
    found = delivered(reader)
    assert [m for m in EXPECTED if PLACES["none"][m[1]].start >= start] == [
        m for m in found if PLACES["none"][m[1]].start >= start
    ]


def with_bytes_before(at: int, more: bytes) -> bytes:
    """The zstd file with ``more`` put in at ``at``, behind all that its index points to, and the index made right again."""
    data, (_, summary), (footer, _) = (
        FILES["zstd"],
        place_of("zstd", 0x0F),
        place_of("zstd", 0x02),
    )
    moved = data[summary:footer] + struct.pack(
        "<BQQQ", 0x02, 20, summary + len(more), 0
    )
    return (
        data[:at]
        + more
        + data[at:summary]
        + moved
        + struct.pack("<I", zlib.crc32(moved))
        + mcap_records.MAGIC
    )


def test_an_applications_own_record_is_passed_over(tmp_path):
    """The MCAP specification leaves kinds 0x80 and above to applications."""
    private = struct.pack("<BQ", 0x90, 50) + bytes(50)
    reader = reader_of(
        write(tmp_path, with_bytes_before(place_of("zstd", 0x0F)[0], private))
    )
    assert delivered(reader) == EXPECTED
    assert reader.damage == []


def test_bytes_between_the_data_and_its_index_are_told(tmp_path):
    end = place_of("zstd", 0x0F)[1]
    reader = reader_of(write(tmp_path, with_bytes_before(end, b"x" * 77)))
    assert delivered(reader) == EXPECTED
    (damage,) = reader.damage
    assert damage.byte_start == end
    assert not damage.lost


# --- bombs


def mcap_with_chunk(chunk: Chunk) -> bytes:
    """A good chunk, ``chunk``, a good chunk: what the reader makes of the middle one must leave the others alone."""

    def good(k: int) -> bytes:
        inner = RecordBuilder()
        Channel(
            id=1, topic="/lone", message_encoding="json", metadata={}, schema_id=0
        ).write(inner)
        mcap_records.Message(1, T0_NS + k, b"1", T0_NS, k).write(inner)
        data = inner.end()
        out = RecordBuilder()
        Chunk("", data, T0_NS, T0_NS, zlib.crc32(data), len(data)).write(out)
        return out.end()

    builder = RecordBuilder()
    chunk.write(builder)
    return mcap_records.MAGIC + good(0) + builder.end() + good(1)


def zeros(compression: str, megabytes: int) -> bytes:
    block = bytes(1 << 20)
    if compression == "zstd":
        compressor = zstandard.ZstdCompressor(level=1).compressobj()
        return b"".join(
            [
                *(compressor.compress(block) for _ in range(megabytes)),
                compressor.flush(),
            ]
        )
    with lz4.frame.LZ4FrameCompressor() as frame:
        return b"".join(
            [
                frame.begin(),
                *(frame.compress(block) for _ in range(megabytes)),
                frame.flush(),
            ]
        )


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
@pytest.mark.parametrize("claim", [2**62, 2**40, 600 << 20, 1 << 20])
def test_a_decompression_bomb_takes_no_memory(tmp_path, compression, claim):
    """600 MiB of zeros in a chunk that claims 4 EiB, 1 TiB, the truth, or 1 MiB."""
    data = zeros(compression, 600) if compression else bytes(1000)
    path = write(
        tmp_path, mcap_with_chunk(Chunk(compression, data, T0_NS, T0_NS, 1, claim))
    )
    reader = reader_of(path)
    with bounded_memory(megabytes=12 + len(data) / 2**20 * 4):
        assert [m.log_ns for m in reader.messages(("/lone",))] == [T0_NS, T0_NS + 1]
    damage, end = reader.damage  # the file has no footer
    assert end.byte_start == path.stat().st_size
    assert damage.byte_end - damage.byte_start == 9 + 40 + len(compression) + len(data)
    assert "chunk lost" in damage.reason


@contextlib.contextmanager
def bounded_memory(megabytes: float) -> Iterator[None]:
    """Fails where Python takes more than that."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < megabytes * 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("compression", "beyond", "claim", "reason"),
    [
        ("br", 0, 0, "compression 'br' is not supported"),
        ("", 5, 0, "a record extends beyond the end of the chunk"),
        ("", 0, 3, "bytes uncompressed, but its header states"),
        ("zstd", 0, 0, "chunk lost (ZstdError"),
        ("lz4", 0, 0, "chunk lost (RuntimeError"),
        ("", 0, 0, None),
    ],
)
def test_a_chunk_without_crc_must_at_least_hold_together(
    tmp_path, compression, beyond, claim, reason
):
    """One message in it, whose length reaches ``beyond`` the chunk; the chunk claims ``claim`` bytes too many."""
    data = struct.pack("<BQHIQQ", 0x05, 22 + 4 + beyond, 1, 0, T0_NS + 5, 0) + b"1234"
    reader = reader_of(
        write(
            tmp_path,
            mcap_with_chunk(
                Chunk(compression, data, T0_NS, T0_NS, 0, len(data) + claim)
            ),
        )
    )
    assert [m.value for m in reader.messages(("/lone",))] == (
        [1, 1] if reason else [1, 1234, 1]
    )
    assert not reason or reason in reader.damage[0].reason


def test_a_chunk_larger_than_memory_is_not_read(tmp_path):
    """300 MiB of nothing (a hole in the file) in one uncompressed chunk, then a good one."""
    size = 300 << 20
    data = mcap_with_chunk(Chunk("", b"", T0_NS, T0_NS, 1, size))
    at = data.index(struct.pack("<Q", size))
    start, body = (
        at - 25,
        at + 8 + 4 + 4 + 8,
    )  # CRC, empty compression name, length of the data
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        file.write(
            data[:start]
            + struct.pack("<BQ", 0x06, 40 + size)
            + data[start + 9 : body - 8]
            + struct.pack("<Q", size)
        )
        file.seek(size, 1)
        file.write(data[body:])
    reader = reader_of(path)
    with bounded_memory(megabytes=20):
        assert [m.log_ns for m in reader.messages(("/lone",))] == [T0_NS, T0_NS + 1]
    assert (reader.damage[0].byte_start, reader.damage[0].byte_end) == (
        start,
        body + size,
    )
    assert (
        "314,572,840 bytes; at most 268,435,456 are accepted" in reader.damage[0].reason
    )


def test_a_log_time_beyond_int64_is_damage_and_not_an_overflow(tmp_path):
    data = file_of(
        *(
            ("/pad", log_ns, payload("/pad", 2))
            for log_ns in (2**64 - 1, T0_NS + 2 * STEP_NS)
        )
    )
    reader = reader_of(write(tmp_path, data))
    assert delivered(reader) == [EXPECTED[2]]
    assert [d.reason for d in reader.damage] == [
        "1 messages with a log time after the year 2262"
    ]


# --- partial reads


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("warm", [False, True])
def test_a_partial_read_gives_every_message_inside_its_bounds(tmp_path, layout, warm):
    """Cold: nothing is known of the chunks. Warm: chunks outside the bounds are skipped, definitions must survive that."""
    reader = reader_of(write(tmp_path, FILES[layout]))
    if warm:
        delivered(reader)
    rng = np.random.default_rng(0)
    for _ in range(25):
        first, last = sorted(rng.integers(0, NUM_MESSAGES, 2).tolist())
        start_ns, end_ns = T0_NS + first * STEP_NS, T0_NS + last * STEP_NS
        found = delivered(reader, start_ns=start_ns, end_ns=end_ns)
        assert [m for m in found if start_ns <= m[1] <= end_ns] == EXPECTED[
            first : last + 1
        ]
        assert len({m[1] for m in found}) == len(found)
        if warm and layout != "unchunked" and last - first < 8:
            assert len(found) < NUM_MESSAGES  # it does skip


def test_messages_out_of_time_order_are_found_by_a_partial_read(tmp_path):
    """A late message in an early chunk: bounds go by what a chunk holds, not by its neighbours."""
    order = [0, 1, 47, 2, 3, 4, 5, 6, 7, 8, 9, 10]
    data = file_of(
        *(("/pad", T0_NS + k * STEP_NS, payload("/pad", k)) for k in order),
        chunk_size=200,
    )
    reader = reader_of(write(tmp_path, data))
    delivered(reader)
    found = [m[1] for m in delivered(reader, start_ns=T0_NS + 20 * STEP_NS)]
    assert T0_NS + 47 * STEP_NS in found


def test_damage_stays_what_the_whole_read_found(tmp_path):
    _, end = place_of("zstd", 0x06, 2)
    reader = reader_of(write(tmp_path, flip("zstd", end - 30)))
    for _ in reader.messages(TOPICS):  # abandoned before anything was known
        break
    assert reader.damage == []
    delivered(reader)
    told = list(reader.damage)
    assert len(told) == 1
    delivered(reader, start_ns=T0_NS, end_ns=T0_NS + STEP_NS)
    assert reader.damage == told
    for _ in reader.messages(TOPICS):
        break
    assert reader.damage == told
    unfinished = reader.messages(TOPICS)
    next(unfinished)
    delivered(reader, end_ns=T0_NS)  # a partial read while another one is on its way
    list(unfinished)
    assert reader.damage == told
    delivered(reader)
    assert reader.damage == told  # not told twice


# --- split bags


def bag(folder: Path, *numbers: int) -> Path:
    """x_<n>.mcap for each number, holding message n only."""
    folder.mkdir()
    for n in numbers:
        write(
            folder,
            file_of((topic_of(n), T0_NS + n * STEP_NS, payload(topic_of(n), n))),
            f"x_{n}.mcap",
        )
    return folder


def index(folder: Path, names: Any) -> None:
    """metadata.yaml with these file names, or with any bytes."""
    about = yaml.safe_dump(
        {"rosbag2_bagfile_information": {"relative_file_paths": names}}
    ).encode()
    (folder / "metadata.yaml").write_bytes(names if isinstance(names, bytes) else about)


def read_bag(source: Source) -> list[int]:
    return [(m[1] - T0_NS) // STEP_NS for m in delivered(McapReader(source))]


def test_a_split_bag_is_one_recording_in_the_order_of_metadata_yaml_or_of_its_numbers(
    tmp_path,
):
    folder = bag(tmp_path / "b", 0, 1, 2, 9, 10, 11)
    ((name, source),) = find_sources(folder, reader="mcap", split_bag=True)
    assert (name, source.path) == ("mcap", folder)
    assert read_bag(source) == [
        0,
        1,
        2,
        9,
        10,
        11,
    ]  # by name, x_10 would come before x_2
    assert [read_bag(source) for _, source in find_sources(folder, reader="mcap")] == [
        [0],
        [1],
        [2],
        [9],
        [10],
        [11],
    ]
    folder = bag(tmp_path / "c", 0, 1, 2)
    index(
        folder, ["x_2.mcap", "c/x_0.mcap", "x_1.mcap"]
    )  # old rosbag2 wrote the folder's name before it
    ((_, source),) = find_sources(folder, reader="mcap", split_bag=False)
    assert read_bag(source) == [2, 0, 1]


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (
            ["x_0.mcap", "x_1.mcap", "x_7.mcap"],
            "names x_7.mcap, which is not in .*: copy the whole bag",
        ),
        (["x_0.mcap"], "does not name x_1.mcap: run `ros2 bag reindex`"),
        (None, "metadata"),
        ([3], "metadata"),
        *(
            (other, "metadata")
            for other in (b"", b"[", b"a: 1", b"\xff\xfe\x00", b"- 1\n")
        ),
    ],
)
def test_a_bag_that_is_not_what_its_metadata_says_is_refused(tmp_path, names, reason):
    folder = bag(tmp_path / "b", 0, 1)
    index(folder, names)
    with pytest.raises(RecordingError, match=reason):
        find_sources(folder, reader="mcap")


def test_a_bag_compressed_file_by_file_says_what_to_do(tmp_path):
    folder = bag(tmp_path / "b", 0)
    (folder / "x_0.mcap").rename(folder / "x_0.mcap.zstd")
    with pytest.raises(
        RecordingError,
        match=r"a compressed bag file: unpack it with `unzstd x_0\.mcap\.zstd`",
    ):
        find_sources(folder, reader="mcap")


def test_damage_in_a_split_bag_names_its_file_and_leaves_the_others_alone(tmp_path):
    folder = bag(tmp_path / "b", 0, 1, 2)
    whole = (folder / "x_1.mcap").read_bytes()
    (folder / "x_1.mcap").write_bytes(whole[:300])
    ((_, source),) = find_sources(folder, reader="mcap", split_bag=True)
    reader = McapReader(source)
    assert [(m[1] - T0_NS) // STEP_NS for m in delivered(reader)] == [0, 2]
    assert {Path(d.file).name for d in reader.damage} == {"x_1.mcap"}
