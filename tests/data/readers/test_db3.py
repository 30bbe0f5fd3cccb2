"""ROS 2 SQLite bags: written here by rosbags, and then damaged; other people's are in test_bags."""

import contextlib
import hashlib
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from taccorl.data.recording import Source, find_sources, readers
from taccorl.errors import RecordingError

START_NS = 1_700_000_000_000_000_000
NUM = 400
LATE_NS = 250_000  # log time − stamp
STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(get_types_from_msg("uint8[] counts\nuint32 frame", "flexitac_msgs/msg/Pad"))


def joint_state(k: int) -> Any:
    types = STORE.types
    stamp_ns = START_NS + k * 5_000_000
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    angles = np.arange(6) / 10 + k
    return types["sensor_msgs/msg/JointState"](
        header=header, name=[f"joint{j}" for j in range(1, 7)], position=angles, velocity=angles, effort=angles
    )


def pad(k: int) -> Any:
    return STORE.types["flexitac_msgs/msg/Pad"](counts=np.full(384, k % 200, np.uint8), frame=k)


def write_bag(folder: Path, *, compression: CompressionMode | None = None, num: int = NUM) -> Path:
    """A bag folder: joints with headers at 200 Hz, a pad of a type of our own every second time, one file."""
    writer = Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        joints = writer.add_connection("/joints", "sensor_msgs/msg/JointState", typestore=STORE)
        pads = writer.add_connection("/pad", "flexitac_msgs/msg/Pad", typestore=STORE)
        for k in range(num):
            log_ns = START_NS + k * 5_000_000 + LATE_NS
            writer.write(joints, log_ns, STORE.serialize_cdr(joint_state(k), "sensor_msgs/msg/JointState"))
            if k % 2 == 0:
                writer.write(pads, log_ns, STORE.serialize_cdr(pad(k), "flexitac_msgs/msg/Pad"))
    return folder


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "bag")


def db3_of(bag: Path) -> Path:
    return next(bag.glob("*.db3"))


def reader_of(path: Path) -> Any:
    ((name, source),) = find_sources(path)
    assert name == "db3"
    return readers.get(name)(source)


def frames(found: list) -> list[int]:
    return [m.value.frame for m in found]


def test_values_stamps_and_log_times_come_back(bag: Path) -> None:
    reader = reader_of(bag)
    found = list(reader.messages({"/joints", "/pad"}))
    joints = [m for m in found if m.topic == "/joints"]
    assert [m.log_ns for m in joints] == [START_NS + k * 5_000_000 + LATE_NS for k in range(NUM)]
    assert [m.stamp_ns for m in joints] == [START_NS + k * 5_000_000 for k in range(NUM)]
    assert all(np.array_equal(m.value.position, np.arange(6) / 10 + k) for k, m in enumerate(joints))
    pads = [m for m in found if m.topic == "/pad"]
    assert frames(pads) == list(range(0, NUM, 2))
    assert all(m.stamp_ns is None for m in pads)
    assert reader.topics()["/pad"].name == "flexitac_msgs/msg/Pad"
    assert reader.metadata["definitions"]["flexitac_msgs/msg/Pad"] == "in the bag"
    assert reader.damage == []


def test_only_times_may_be_asked_for_and_only_a_part(bag: Path) -> None:
    reader = reader_of(bag)
    assert len([m for m in reader.messages(None) if m.value is None]) == NUM + NUM // 2
    times = list(reader.messages({"/joints"}, stamps_only={"/joints"}))
    assert [m.stamp_ns for m in times] == [START_NS + k * 5_000_000 for k in range(NUM)]
    start, end = (START_NS + k * 5_000_000 + LATE_NS for k in (100, 110))
    assert frames(list(reader.messages({"/pad"}, start_ns=start, end_ns=end))) == [100, 102, 104, 106, 108, 110]


def test_reading_leaves_no_trace_beside_a_bag(bag: Path) -> None:
    def state() -> dict[str, tuple[str, int]]:
        return {p.name: (hashlib.sha256(p.read_bytes()).hexdigest(), p.stat().st_mtime_ns) for p in bag.iterdir()}

    before = state()
    db3_of(bag).chmod(0o444)
    bag.chmod(0o555)
    for k, _ in enumerate(reader_of(bag).messages({"/pad", "/joints"})):
        if k % 100 == 0:
            assert {p.name for p in bag.iterdir()} == set(before)  # no -journal, -wal, -shm while reading either
    bag.chmod(0o755)
    assert state() == before


def test_what_a_dead_recorder_left_in_the_write_ahead_log_is_read_from_a_copy(bag: Path, tmp_path: Path) -> None:
    path = db3_of(bag)
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode = WAL")
    data = bytes(STORE.serialize_cdr(pad(7), "flexitac_msgs/msg/Pad"))
    (pad_id,) = writer.execute("SELECT id FROM topics WHERE name = '/pad'").fetchone()
    writer.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", (pad_id, START_NS * 2, data))
    writer.commit()
    dead = tmp_path / "dead"
    dead.mkdir()
    for name in (path.name, f"{path.name}-wal"):  # as the disk was when the power went
        shutil.copyfile(bag / name, dead / name)
    writer.close()
    before = {p.name: p.read_bytes() for p in dead.iterdir()}
    assert frames(list(reader_of(dead / path.name).messages({"/pad"}))) == [*range(0, NUM, 2), 7]
    assert {p.name: p.read_bytes() for p in dead.iterdir()} == before


def pages_of(path: Path, kind: int) -> list[int]:
    """Offsets of the SQLite pages of one kind: 13 is a table's leaf."""
    content = path.read_bytes()
    size = int.from_bytes(content[16:18], "big")
    return [at for at in range(size, len(content), size) if content[at] == kind]


def test_a_lost_page_costs_its_messages_only_and_is_reported(bag: Path) -> None:
    path = db3_of(bag)
    leaves = pages_of(path, 13)
    content = bytearray(path.read_bytes())
    at = leaves[len(leaves) // 2]
    content[at : at + 4096] = bytes(4096)
    path.write_bytes(content)
    reader = reader_of(bag)
    kept = list(reader.messages({"/joints", "/pad"}))
    lost = NUM + NUM // 2 - len(kept)
    assert 1 <= lost <= 40  # messages of 100 to 400 bytes on a page of 4096
    (damage,) = reader.damage
    first, last = (int(word) for word in damage.reason.split() if word.isdigit())
    assert last - first + 1 == lost
    assert damage.start_ns is not None and damage.end_ns is not None
    assert not [m for m in kept if damage.start_ns < m.log_ns < damage.end_ns]
    assert kept[-1].log_ns == START_NS + (NUM - 1) * 5_000_000 + LATE_NS
    list(reader.messages({"/joints", "/pad"}))
    assert len(reader.damage) == 1  # read again, it is one damage still


def test_a_file_that_was_cut_off_keeps_what_lies_before_the_cut(bag: Path) -> None:
    path = db3_of(bag)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.6)])
    reader = reader_of(bag)
    kept = frames(list(reader.messages({"/pad"})))
    assert kept == list(range(0, 2 * len(kept), 2))  # from the first on, without a hole
    assert len(kept) > 0.4 * NUM / 2
    assert "the file ends" in reader.damage[0].reason
    assert reader.damage[0].byte_end == len(content)
    assert any("to the last cannot be read" in d.reason for d in reader.damage)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", r"is empty \(0 bytes\)"),
        (b"no bag" * 50, "is not an SQLite file"),
        (b"SQLite format 3\0", "is not an SQLite"),
        (None, r"x\.db3: cannot be opened"),
        ("CREATE TABLE songs (title TEXT)", r"an.*SQLite file, but.*ROS 2 bag:.*tables.*songs"),
    ],
)
def test_what_is_no_bag_is_said_in_plain_words(tmp_path: Path, content: bytes | str | None, words: str) -> None:
    path = tmp_path / "x.db3"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        with contextlib.closing(sqlite3.connect(path)) as other:
            other.execute(content)
    with pytest.raises(RecordingError, match=words):
        list(readers.get("db3")(Source(path, (path,))).messages(None))


def forget_definitions(path: Path) -> None:
    """Makes the bag one of ROS 2 Humble or older."""
    with sqlite3.connect(path) as connection:
        connection.execute("DROP TABLE message_definitions")
        connection.execute("DROP TABLE schema")
    connection.close()


def test_an_old_bag_is_read_by_the_definitions_of_ros_2_and_says_so(bag: Path) -> None:
    forget_definitions(db3_of(bag))
    reader = reader_of(bag)
    joints = list(reader.messages({"/joints"}))
    assert np.array_equal(joints[9].value.position, np.arange(6) / 10 + 9)
    assert "newest that fits" in reader.metadata["definitions"]["sensor_msgs/msg/JointState"]


def test_a_type_that_nobody_defines_costs_its_own_topic_only(bag: Path) -> None:
    forget_definitions(db3_of(bag))
    reader = reader_of(bag)
    problem = reader.topics()["/pad"].undecodable
    assert "/pad: the bag does not define flexitac_msgs/msg/Pad, nor does any ROS 2 distribution" in problem
    assert reader.topics()["/joints"].undecodable is None
    assert len(list(reader.messages(None))) == NUM + NUM // 2
    assert len(list(reader.messages({"/joints"}))) == NUM
    with pytest.raises(RecordingError, match="does not define flexitac_msgs/msg/Pad"):
        list(reader.messages({"/joints", "/pad"}))


def edit(path: Path, statement: str, *values: Any) -> None:
    with sqlite3.connect(path) as connection:
        assert connection.execute(statement, values).rowcount > 0
    connection.close()


def test_definitions_in_idl_are_read(bag: Path) -> None:
    rule = "=" * 80
    idl = "module flexitac_msgs { module msg { struct Pad { sequence<uint8> counts; uint32 frame; }; }; };"
    text = f"{rule}\nIDL: flexitac_msgs/msg/Pad\n{idl}\n"
    change = "UPDATE message_definitions SET encoding = 'ros2idl', encoded_message_definition = ? WHERE topic_type LIKE '%Pad'"
    edit(db3_of(bag), change, text)
    assert frames(list(reader_of(bag).messages({"/pad"})))[:3] == [0, 2, 4]


def test_a_definition_that_does_not_parse_and_another_encoding_cost_their_own_topics_only(bag: Path) -> None:
    edit(db3_of(bag), "UPDATE message_definitions SET encoded_message_definition = '---' WHERE topic_type LIKE '%Pad'")
    edit(db3_of(bag), "UPDATE topics SET serialization_format = 'protobuf' WHERE name = '/joints'")
    reader = reader_of(bag)
    found = reader.topics()
    assert "the bag's definition of flexitac_msgs/msg/Pad does not parse" in found["/pad"].undecodable
    assert "'protobuf' messages are not supported" in found["/joints"].undecodable
    assert len(list(reader.messages(None))) == NUM + NUM // 2


def test_a_message_that_does_not_fit_its_definition_is_named(bag: Path) -> None:
    edit(db3_of(bag), "UPDATE messages SET data = x'000100000102' WHERE id = 3")
    with pytest.raises(RecordingError, match=r"a message at log time \d+ ns does not fit"):
        list(reader_of(bag).messages({"/joints", "/pad"}))


def test_messages_of_a_topic_that_the_bag_does_not_name_are_reported(bag: Path) -> None:
    edit(db3_of(bag), "DELETE FROM topics WHERE name = '/pad'")
    reader = reader_of(bag)
    assert len(list(reader.messages(None))) == NUM
    assert [d.reason for d in reader.damage] == [f"{NUM // 2} messages of topics that the bag does not name"]


def test_bags_compressed_message_by_message_are_read_and_compressed_files_say_what_to_do(tmp_path: Path) -> None:
    one_by_one = write_bag(tmp_path / "messages", compression=CompressionMode.MESSAGE, num=10)
    assert frames(list(reader_of(one_by_one).messages({"/pad"}))) == [0, 2, 4, 6, 8]
    assert [m.stamp_ns for m in reader_of(one_by_one).messages({"/joints"}, stamps_only={"/joints"})][0] == START_NS
    whole = write_bag(tmp_path / "whole", compression=CompressionMode.FILE, num=10)
    with pytest.raises(RecordingError, match=r"a compressed bag file: unpack it with `unzstd whole\.db3\.zstd`"):
        find_sources(whole)
