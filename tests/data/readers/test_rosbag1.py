"""ROS 1 bags: written here by rosbags, and then damaged."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from taccorl.cli.main import main
from taccorl.data.recording import Source, find_sources, readers
from taccorl.errors import RecordingError

START_NS = 1_700_000_000_000_000_000
NUM = 60
LATE_NS = 250_000  # log time − stamp
STORE = get_typestore(Stores.ROS1_NOETIC)
STORE.register(get_types_from_msg("uint8[] counts\nuint32 frame", "flexitac_msgs/msg/Pad"))
KINDS = {
    "/joints": "sensor_msgs/msg/JointState",
    "/pad": "flexitac_msgs/msg/Pad",
    "/front": "sensor_msgs/msg/CompressedImage",
}


def header(k: int) -> Any:
    stamp_ns = START_NS + k * 5_000_000
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return STORE.types["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id="")


def messages(k: int) -> dict[str, Any]:
    angles = np.arange(6) / 10 + k
    names = [f"joint{j}" for j in range(1, 7)]
    picture = cv2.imencode(".png", np.full((4, 6, 3), k % 200, np.uint8))[1].reshape(-1)
    types = STORE.types
    return {
        "/joints": types[KINDS["/joints"]](
            header=header(k), name=names, position=angles, velocity=angles, effort=angles
        ),
        "/pad": types[KINDS["/pad"]](counts=np.full(384, k % 200, np.uint8), frame=k),
        "/front": types[KINDS["/front"]](header=header(k), format="png", data=picture),
    }


def write_bag(path: Path, compression: Writer.CompressionFormat | None = None, start: int = 0) -> Path:
    """Joints, a pad of a type of our own and pictures at 200 Hz."""
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in KINDS.items()}
        for k in range(start, start + NUM):
            for topic, message in messages(k).items():
                data = STORE.serialize_ros1(message, KINDS[topic])
                writer.write(connections[topic], START_NS + k * 5_000_000 + LATE_NS, data)
    return path


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "a.bag")


def reader_of(path: Path) -> Any:
    ((name, source),) = find_sources(path)
    assert name == "rosbag1"
    return readers.get(name)(source)


@pytest.mark.parametrize("compression", [None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4])
def test_values_stamps_and_log_times_come_back(tmp_path: Path, compression: Any) -> None:
    reader = reader_of(write_bag(tmp_path / "a.bag", compression))
    found = list(reader.messages(set(KINDS)))
    assert [m.log_ns for m in found] == [START_NS + k * 5_000_000 + LATE_NS for k in range(NUM) for _ in KINDS]
    joints, pads, pictures = ([m for m in found if m.topic == topic] for topic in KINDS)
    assert [m.stamp_ns for m in joints] == [START_NS + k * 5_000_000 for k in range(NUM)]
    assert all(np.array_equal(m.value.position, np.arange(6) / 10 + k) for k, m in enumerate(joints))
    assert [(m.value.frame, m.stamp_ns) for m in pads] == [(k, None) for k in range(NUM)]
    assert cv2.imdecode(pictures[7].value.data, cv2.IMREAD_COLOR)[0, 0].tolist() == [7, 7, 7]
    assert {topic: kind.name for topic, kind in reader.topics().items()} == KINDS
    assert reader.damage == []
    assert "no checksums" in reader.unprotected


def test_only_times_may_be_asked_for_and_only_a_part(bag: Path) -> None:
    reader = reader_of(bag)
    assert len([m for m in reader.messages(None) if m.value is None]) == 3 * NUM
    times = list(reader.messages({"/joints"}, stamps_only={"/joints"}))
    assert [(m.stamp_ns, m.value) for m in times] == [(START_NS + k * 5_000_000, None) for k in range(NUM)]
    start, end = (START_NS + k * 5_000_000 + LATE_NS for k in (10, 12))
    assert [m.value.frame for m in reader.messages({"/pad"}, start_ns=start, end_ns=end)] == [10, 11, 12]
    assert list(reader.messages({"/none"})) == []


def test_inspect_drafts_a_spec_that_names_this_reader(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ingest", "inspect", str(bag)]) == 0
    shown = capsys.readouterr().out
    for part in ("rosbag1", "names of /joints: joint1, joint2", "reader: rosbag1", *KINDS):
        assert part in shown


@pytest.mark.parametrize("share", [0.3, 0.7, 0.98])
def test_a_bag_that_was_cut_off_names_the_command_that_makes_its_index(bag: Path, share: float) -> None:
    content = bag.read_bytes()
    bag.write_bytes(content[: int(share * len(content))])
    with pytest.raises(RecordingError) as error:
        list(reader_of(bag).messages(None))
    assert str(error.value).startswith(f"{bag}: ")
    assert "`rosbag reindex a.bag`" in str(error.value)


def test_a_bag_without_a_byte_is_called_empty(bag: Path) -> None:
    bag.write_bytes(b"")
    with pytest.raises(RecordingError, match=r"a.bag: is empty \(0 bytes\)$"):
        list(reader_of(bag).messages(None))


def test_changed_bytes_give_an_error_or_a_message_and_never_anything_else(bag: Path) -> None:
    content, outcomes = bag.read_bytes(), []
    for at in np.linspace(0, len(content) - 1, 150).astype(int):
        bag.write_bytes(content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :])
        try:
            outcomes.append(len(list(readers.get("rosbag1")(Source(bag, (bag,))).messages(set(KINDS)))))
        except RecordingError as error:
            assert "\n" not in str(error)
            outcomes.append(-1)
    assert -1 in outcomes and 3 * NUM in outcomes


def test_a_definition_that_does_not_parse_is_named_only_when_asked_for(bag: Path) -> None:
    bag.write_bytes(bag.read_bytes().replace(b"uint8[] counts", b"uint8[? counts"))
    reader = reader_of(bag)
    assert "flexitac_msgs/msg/Pad does not parse" in str(reader.topics()["/pad"].undecodable)
    assert len(list(reader.messages({"/joints"}))) == NUM
    with pytest.raises(RecordingError, match=r"a\.bag: /pad: the bag's definition of flexitac_msgs/msg/Pad"):
        list(reader.messages({"/pad"}))
