"""``byte`` is an octet in ROS 2 (0 … 255) and int8 in ROS 1 (-128 … 127)."""

import contextlib
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from small_arm import ingest

from taccorl.data.recording import find_sources, readers

OCTETS = [0, 1, 127, 128, 195, 255]
INT8 = [0, 1, 127, -128, -61, -1]  # The same bits: 195 - 256 = -61
KINDS = {
    "/single": "pads_msgs/msg/Single",
    "/list": "pads_msgs/msg/List",
    "/six": "pads_msgs/msg/Six",
    "/within": "pads_msgs/msg/Within",
    "/array": "std_msgs/msg/ByteMultiArray",
}
TEXTS = {
    "pads_msgs/msg/Single": "byte data",
    "pads_msgs/msg/List": "byte[] data",
    "pads_msgs/msg/Six": "byte[6] data",
    "pads_msgs/msg/Within": "List pad",
}

SENSOR = """spec_version: 1
name: small
rows: 2
columns: 3
wire: {rows: 2, columns: 3, dtype: uint8, transpose: false}
adc_bits: 8
wire_shift_bits: 0
rate_hz: 100
scan_time_s: 0.01
unit: adc_count
baseline: {rule: median_of_first, frames: 1, max_spread_count: 12}
noise_count: 15
scheme: fixed_scale
gain_per_count: 0.01
"""
DATASET = """spec_version: 1
name: pads
robot_type: pads
fps: 30
features:
  observation.tactile:
    dtype: int16
    shape: [6]
    sensor: sensor.yaml
    pads: [left]
    unit: adc_count
    frame: pad
    rate_hz: 100
    range: [-255, 255]
"""
SPEC = """spec_version: 1
dataset: dataset.yaml
reader: rosbag1
clock: log
episodes: {by: whole_file}
instruction: {from: spec, text: press}
channels:
  pad: {topic: /list, field: data, rate_hz: 100, max_age_s: 0.1}
features:
  observation.tactile: {channels: [pad], align: asof}
"""


def store_of(ros: int, kind: str = "byte") -> Any:
    """Store of the messages above, with ``kind`` in the place of ``byte``."""
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for name, text in TEXTS.items():
        store.register(get_types_from_msg(text.replace("byte", kind), name))
    return store


def payloads(ros: int) -> dict[str, bytes]:
    """Topic → its message of the octets above, written by way of uint8."""
    store = store_of(ros, "uint8")
    octets = np.array(OCTETS, np.uint8)
    types = store.types
    pad = types["pads_msgs/msg/List"](data=octets)
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    messages = {
        "/single": types["pads_msgs/msg/Single"](data=195),
        "/list": pad,
        "/six": types["pads_msgs/msg/Six"](data=octets),
        "/within": types["pads_msgs/msg/Within"](pad=pad),
        "/array": types["std_msgs/msg/UInt8MultiArray"](layout=layout, data=octets),
    }
    encode = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    return {
        topic: bytes(encode(message, message.__msgtype__))
        for topic, message in messages.items()
    }


def write_bag(path: Path, ros: int, plugin: Any = None) -> Path:
    """One message of each topic, of the types with ``byte``."""
    if ros == 1:
        writer = rosbag1.Writer(path)
    else:
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    store = store_of(ros)
    with writer:
        for k, (topic, data) in enumerate(payloads(ros).items()):
            connection = writer.add_connection(topic, KINDS[topic], typestore=store)
            writer.write(connection, 10**18 + k, data)
    return path


def write_mcap(path: Path) -> Path:
    from mcap.writer import Writer

    definitions = {
        kind: store_of(2).generate_msgdef(kind)[0]
        for kind in KINDS.values()  # with those of the types within
    }
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, data in payloads(2).items():
            text = definitions[KINDS[topic]].encode()
            schema = writer.register_schema(KINDS[topic], "ros2msg", text)
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, 10**18, data, 10**18)
        writer.finish()
    return path


def values_of(path: Path) -> dict[str, Any]:
    ((name, source),) = find_sources(path)
    messages = readers.get(name)(source).messages(set(KINDS))
    values = {m.topic: m.value for m in messages}
    values["/within"] = values["/within"].pad
    return {
        topic: value.data if topic == "/single" else value.data.tolist()
        for topic, value in values.items()
    }


@pytest.mark.parametrize("container", ["mcap", "bag of mcap", "bag of db3"])
def test_a_byte_of_ros_2_is_an_octet(tmp_path: Path, container: str) -> None:
    if container == "mcap":
        path = write_mcap(tmp_path / "a.mcap")
    else:
        kind = "MCAP" if container.endswith("mcap") else "SQLITE3"
        path = write_bag(tmp_path / "bag", 2, rosbag2.StoragePlugin[kind])
    found = values_of(path)
    assert found.pop("/single") == 195
    assert found == dict.fromkeys(("/list", "/six", "/within", "/array"), OCTETS)


@pytest.mark.parametrize(
    ("change", "values", "topic"),
    [
        # Before ROS 2 Iron the definitions are those of the distribution.
        ("DELETE FROM message_definitions", (), "/array"),
        (
            "UPDATE message_definitions SET encoding = 'ros2idl', "
            "encoded_message_definition = ? WHERE topic_type = 'pads_msgs/msg/List'",
            (
                f"{'=' * 80}\nIDL: pads_msgs/msg/List\n"
                "module pads_msgs { module msg { struct List { sequence<octet> data; }; "
                "}; };",
            ),
            "/list",
        ),
    ],
    ids=["without definitions", "IDL"],
)
def test_a_byte_of_a_bag_of_other_definitions_is_an_octet(
    tmp_path: Path, change: str, values: tuple[str, ...], topic: str
) -> None:
    bag = write_bag(tmp_path / "bag", 2, rosbag2.StoragePlugin.SQLITE3)
    with contextlib.closing(sqlite3.connect(next(bag.glob("*.db3")))) as file:
        assert file.execute(change, values).rowcount > 0
        file.commit()
    reader = readers.get("db3")(find_sources(bag)[0][1])
    (message,) = reader.messages({topic})
    assert message.value.data.tolist() == OCTETS


def test_a_byte_of_ros_1_is_signed(tmp_path: Path) -> None:
    found = values_of(write_bag(tmp_path / "a.bag", 1))
    assert found.pop("/single") == -61
    for topic in ("/list", "/six", "/within"):
        assert found[topic] == INT8


def test_signed_counts_of_a_pad_are_refused_with_message_taxel_and_way_out(
    tmp_path: Path,
) -> None:
    """A ROS 1 pad of `byte`: 195 counts are stored as -61."""
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    (tmp_path / "dataset.yaml").write_text(DATASET)
    (tmp_path / "spec.yaml").write_text(SPEC)
    write_bag(tmp_path / "a.bag", 1)
    code, entry = ingest(tmp_path / "a.bag", tmp_path / "spec.yaml")
    assert (code, entry["outcome"]) == (1, "refused")
    for fact in ("/list, message 0", "-128 (taxel 3)", "int8", "as uint8"):
        assert fact in entry["reason"]
