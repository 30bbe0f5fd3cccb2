"""ROS 1 bags and ROS 2 bags of SQLite: written here by rosbags, and then damaged."""

import contextlib
import hashlib
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from taccorl.cli.main import main
from taccorl.data.recording import Source, find_sources, readers
from taccorl.errors import RecordingError

START_NS, STEP_NS = 1_700_000_000_000_000_000, 5_000_000
LATE_NS = 250_000  # log time − stamp
NUM = 400
FEW = 60
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
for _store in STORES.values():
    _store.register(
        get_types_from_msg("uint8[] counts\nuint32 frame", "flexitac_msgs/msg/Pad")
    )
KINDS = {
    "/front": "sensor_msgs/msg/CompressedImage",
    "/joints": "sensor_msgs/msg/JointState",
    "/pad": "flexitac_msgs/msg/Pad",
}


def angles(k: int) -> np.ndarray:
    """(6,) joint angles [rad] of sample k."""
    return np.arange(6) / 10 + k


def messages(k: int, ros: int) -> dict[str, Any]:
    """Topic → its message number ``k``: joint states and a picture with headers, pad counts of a custom message type."""
    types, stamp_ns = STORES[ros].types, START_NS + k * STEP_NS
    stamp = types["builtin_interfaces/msg/Time"](
        sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
    )
    header = types["std_msgs/msg/Header"](
        **({"seq": k} if ros == 1 else {}), stamp=stamp, frame_id=""
    )
    at, names = angles(k), [f"joint{j}" for j in range(1, 7)]
    picture = cv2.imencode(".png", np.full((4, 6, 3), k % 200, np.uint8))[1].reshape(-1)
    return {
        "/front": types[KINDS["/front"]](header=header, format="png", data=picture),
        "/joints": types[KINDS["/joints"]](
            header=header, name=names, position=at, velocity=at, effort=at
        ),
        "/pad": types[KINDS["/pad"]](counts=np.full(384, k % 200, np.uint8), frame=k),
    }


def write_bag(path: Path, ros: int = 2, *compression: Any, num: int = NUM) -> Path:
    """Write a bag with ``num`` messages of each topic at 200 Hz; return its path: a .bag file (ROS 1) or a folder (ROS 2)."""
    sqlite = {"version": 8, "storage_plugin": rosbag2.StoragePlugin.SQLITE3}
    writer = rosbag1.Writer(path) if ros == 1 else rosbag2.Writer(path, **sqlite)
    store = STORES[ros]
    serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    if compression:
        writer.set_compression(*compression)
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in KINDS.items()
        }
        for k in range(num):
            for topic, message in messages(k, ros).items():
                data = serialize(message, KINDS[topic])
                writer.write(connections[topic], START_NS + k * STEP_NS + LATE_NS, data)
    return path


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "bag")


@pytest.fixture
def bag1(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "a.bag", 1, num=FEW)


def db3_of(bag: Path) -> Path:
    return next(bag.glob("*.db3"))


def reader_of(path: Path) -> Any:
    ((name, source),) = find_sources(path)
    assert name == ("rosbag1" if path.suffix == ".bag" else "db3")
    return readers.get(name)(source)


def frames(found: list) -> list[int]:
    return [m.value.frame for m in found]


ROS1 = rosbag1.Writer.CompressionFormat
MODE, ZSTD = rosbag2.CompressionMode, rosbag2.CompressionFormat.ZSTD


@pytest.mark.parametrize(
    ("ros", "compression"), [(2, ()), (1, ()), (1, (ROS1.BZ2,)), (1, (ROS1.LZ4,))]
)
def test_values_stamps_and_log_times_come_back(
    tmp_path: Path, ros: int, compression: tuple
) -> None:
    reader = reader_of(
        write_bag(
            tmp_path / ("a.bag" if ros == 1 else "bag"), ros, *compression, num=FEW
        )
    )
    found = list(reader.messages(set(KINDS)))
    assert [m.log_ns for m in found] == [
        START_NS + k * STEP_NS + LATE_NS for k in range(FEW) for _ in KINDS
    ]
    pictures, joints, pads = ([m for m in found if m.topic == topic] for topic in KINDS)
    assert [m.stamp_ns for m in joints] == [START_NS + k * STEP_NS for k in range(FEW)]
    assert all(
        np.array_equal(m.value.position, angles(k)) for k, m in enumerate(joints)
    )
    assert [(m.value.frame, m.stamp_ns) for m in pads] == [
        (k, None) for k in range(FEW)
    ]
    assert cv2.imdecode(pictures[7].value.data, cv2.IMREAD_COLOR)[0, 0].tolist() == [
        7,
        7,
        7,
    ]
    assert {topic: kind.name for topic, kind in reader.topics().items()} == KINDS
    assert reader.damage == []
    assert "no checksums" in reader.unprotected
    assert (
        ros == 1
        or reader.metadata["definitions"]["flexitac_msgs/msg/Pad"] == "in the bag"
    )


@pytest.mark.parametrize("of", ["bag", "bag1"])
def test_only_times_may_be_asked_for_and_only_a_part(
    of: str, request: pytest.FixtureRequest
) -> None:
    reader, num = reader_of(request.getfixturevalue(of)), NUM if of == "bag" else FEW
    assert len([m for m in reader.messages(None) if m.value is None]) == 3 * num
    times = list(reader.messages({"/joints"}, stamps_only={"/joints"}))
    assert [(m.stamp_ns, m.value) for m in times] == [
        (START_NS + k * STEP_NS, None) for k in range(num)
    ]
    start, end = (START_NS + k * STEP_NS + LATE_NS for k in (10, 12))
    assert frames(list(reader.messages({"/pad"}, start_ns=start, end_ns=end))) == [
        10,
        11,
        12,
    ]
    assert list(reader.messages({"/none"})) == []


# --- ROS 2


def test_reading_leaves_no_trace_beside_a_bag(bag: Path) -> None:
    def state() -> dict[str, tuple[str, int]]:
        return {
            p.name: (hashlib.sha256(p.read_bytes()).hexdigest(), p.stat().st_mtime_ns)
            for p in bag.iterdir()
        }

    before = state()
    db3_of(bag).chmod(0o444)
    bag.chmod(0o555)
    for k, _ in enumerate(reader_of(bag).messages({"/pad", "/joints"})):
        if k % 100 == 0:
            assert {p.name for p in bag.iterdir()} == set(
                before
            )  # no -journal, -wal, -shm while reading either
    bag.chmod(0o755)
    assert state() == before


def test_what_a_dead_recorder_left_in_the_write_ahead_log_is_read_from_a_copy(
    bag: Path, tmp_path: Path
) -> None:
    path = db3_of(bag)
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode = WAL")
    data = bytes(STORES[2].serialize_cdr(messages(7, 2)["/pad"], KINDS["/pad"]))
    (pad_id,) = writer.execute("SELECT id FROM topics WHERE name = '/pad'").fetchone()
    writer.execute(
        "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)",
        (pad_id, START_NS * 2, data),
    )
    writer.commit()
    dead = tmp_path / "dead"
    dead.mkdir()
    for name in (path.name, f"{path.name}-wal"):  # as the disk was when the power went
        shutil.copyfile(bag / name, dead / name)
    writer.close()
    before = {p.name: p.read_bytes() for p in dead.iterdir()}
    assert frames(list(reader_of(dead / path.name).messages({"/pad"}))) == [
        *range(NUM),
        7,
    ]
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
    kept = list(reader.messages(set(KINDS)))
    lost = 3 * NUM - len(kept)
    assert 1 <= lost <= 40  # messages of 100 to 400 bytes on a page of 4096
    (damage,) = reader.damage
    first, last = (int(word) for word in damage.reason.split() if word.isdigit())
    assert last - first + 1 == lost
    assert damage.start_ns is not None and damage.end_ns is not None
    assert not [m for m in kept if damage.start_ns < m.log_ns < damage.end_ns]
    assert kept[-1].log_ns == START_NS + (NUM - 1) * STEP_NS + LATE_NS
    list(reader.messages(set(KINDS)))
    assert len(reader.damage) == 1  # read again, it is one damage still


@pytest.mark.parametrize("share", [0.41, 0.5, 0.58, 0.65, 0.83])
@pytest.mark.parametrize("whole_pages", [False, True])
def test_a_file_that_was_cut_off_keeps_what_lies_before_the_cut(
    bag: Path, share: float, whole_pages: bool
) -> None:
    path = db3_of(bag)
    content = path.read_bytes()
    path.write_bytes(
        content[
            : int(share * len(content)) // 4096 * 4096 + (0 if whole_pages else 2391)
        ]
    )
    reader = reader_of(bag)
    pads = list(reader.messages({"/pad"}))
    kept = frames(pads)
    assert kept == list(range(len(kept)))  # from the first on, without a hole
    assert all(
        (m.value.counts == m.value.frame % 200).all() for m in pads
    )  # none of zeros for what is missing
    assert len(kept) > (share - 0.1) * NUM
    assert "the file ends" in reader.damage[0].reason
    assert (reader.damage[0].byte_start, reader.damage[0].byte_end) == (
        path.stat().st_size // 4096 * 4096,
        len(content),
    )
    assert any("to the last cannot be read" in d.reason for d in reader.damage)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", r"is empty \(0 bytes\)"),
        (b"no bag" * 50, "is not an SQLite file"),
        (b"SQLite format 3\0", "is not an SQLite"),
        (None, r"x\.db3: cannot be opened"),
        (
            "CREATE TABLE songs (title TEXT)",
            r"an.*SQLite file, but.*ROS 2 bag:.*tables.*songs",
        ),
    ],
)
def test_what_is_no_bag_is_said_in_plain_words(
    tmp_path: Path, content: bytes | str | None, words: str
) -> None:
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
    assert np.array_equal(joints[9].value.position, angles(9))
    assert (
        "newest that fits"
        in reader.metadata["definitions"]["sensor_msgs/msg/JointState"]
    )


def test_a_type_that_nobody_defines_costs_its_own_topic_only(bag: Path) -> None:
    forget_definitions(db3_of(bag))
    reader = reader_of(bag)
    problem = reader.topics()["/pad"].undecodable
    assert (
        "/pad: the bag does not define flexitac_msgs/msg/Pad, nor does any ROS 2 distribution"
        in problem
    )
    assert reader.topics()["/joints"].undecodable is None
    assert len(list(reader.messages(None))) == 3 * NUM
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
    assert frames(list(reader_of(bag).messages({"/pad"})))[:3] == [0, 1, 2]


def test_a_definition_that_does_not_parse_and_another_encoding_cost_their_own_topics_only(
    bag: Path,
) -> None:
    edit(
        db3_of(bag),
        "UPDATE message_definitions SET encoded_message_definition = '---' WHERE topic_type LIKE '%Pad'",
    )
    edit(
        db3_of(bag),
        "UPDATE topics SET serialization_format = 'protobuf' WHERE name = '/joints'",
    )
    reader = reader_of(bag)
    found = reader.topics()
    assert (
        "the bag's definition of flexitac_msgs/msg/Pad does not parse"
        in found["/pad"].undecodable
    )
    assert "'protobuf' messages are not supported" in found["/joints"].undecodable
    assert len(list(reader.messages(None))) == 3 * NUM


def test_a_message_that_does_not_fit_its_definition_is_named(bag: Path) -> None:
    edit(db3_of(bag), "UPDATE messages SET data = x'000100000102' WHERE id = 5")
    with pytest.raises(
        RecordingError, match=r"a message at log time \d+ ns does not fit"
    ):
        list(reader_of(bag).messages({"/joints", "/pad"}))


def test_messages_of_a_topic_that_the_bag_does_not_name_are_reported(bag: Path) -> None:
    edit(db3_of(bag), "DELETE FROM topics WHERE name = '/pad'")
    reader = reader_of(bag)
    assert len(list(reader.messages(None))) == 2 * NUM
    assert [d.reason for d in reader.damage] == [
        f"{NUM} messages of topics that the bag does not name"
    ]


def test_bags_compressed_message_by_message_are_read_and_compressed_files_say_what_to_do(
    tmp_path: Path,
) -> None:
    one_by_one = write_bag(tmp_path / "messages", 2, MODE.MESSAGE, ZSTD, num=10)
    assert frames(list(reader_of(one_by_one).messages({"/pad"}))) == list(range(10))
    assert [
        m.stamp_ns
        for m in reader_of(one_by_one).messages({"/joints"}, stamps_only={"/joints"})
    ][0] == START_NS
    whole = write_bag(tmp_path / "whole", 2, MODE.FILE, ZSTD, num=10)
    with pytest.raises(
        RecordingError,
        match=r"a compressed bag file: unpack it with `unzstd whole\.db3\.zstd`",
    ):
        find_sources(whole)


# --- ROS 1


def test_inspect_drafts_a_spec_that_names_this_reader(
    bag1: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ingest", "inspect", str(bag1)]) == 0
    shown = capsys.readouterr().out
    for part in (
        "rosbag1",
        "names of /joints: joint1, joint2",
        "reader: rosbag1",
        *KINDS,
    ):
        assert part in shown


@pytest.mark.parametrize("share", [0.3, 0.7, 0.98])
def test_a_bag_that_was_cut_off_names_the_command_that_makes_its_index(
    bag1: Path, share: float
) -> None:
    content = bag1.read_bytes()
    bag1.write_bytes(content[: int(share * len(content))])
    with pytest.raises(RecordingError) as error:
        list(reader_of(bag1).messages(None))
    assert str(error.value).startswith(f"{bag1}: ")
    assert "`rosbag reindex a.bag`" in str(error.value)


def test_a_bag_without_a_byte_is_called_empty(bag1: Path) -> None:
    bag1.write_bytes(b"")
    with pytest.raises(RecordingError, match=r"a.bag: is empty \(0 bytes\)$"):
        list(reader_of(bag1).messages(None))


def test_changed_bytes_give_an_error_or_a_message_and_never_anything_else(
    bag1: Path,
) -> None:
    content, outcomes = bag1.read_bytes(), []
    for at in np.linspace(0, len(content) - 1, 150).astype(int):
        bag1.write_bytes(content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :])
        try:
            outcomes.append(
                len(
                    list(
                        readers.get("rosbag1")(Source(bag1, (bag1,))).messages(
                            set(KINDS)
                        )
                    )
                )
            )
        except RecordingError as error:
            assert "\n" not in str(error)
            outcomes.append(-1)
    assert -1 in outcomes and 3 * FEW in outcomes


def test_a_definition_that_does_not_parse_is_named_only_when_asked_for(
    bag1: Path,
) -> None:
    bag1.write_bytes(bag1.read_bytes().replace(b"uint8[] counts", b"uint8[? counts"))
    reader = reader_of(bag1)
    assert "flexitac_msgs/msg/Pad does not parse" in str(
        reader.topics()["/pad"].undecodable
    )
    assert len(list(reader.messages({"/joints"}))) == FEW
    with pytest.raises(
        RecordingError,
        match=r"a\.bag: /pad: the bag's definition of flexitac_msgs/msg/Pad",
    ):
        list(reader.messages({"/pad"}))
