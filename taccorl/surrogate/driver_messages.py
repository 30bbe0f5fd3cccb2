"""Messages of the robot's drivers: ROS 2 types as rosbag2 stores them in MCAP files. A message is a dict shaped like its type."""

import functools
import struct
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from mcap_ros2._dynamic import serialize_dynamic  # its public Writer cannot mix encodings in one file

JOINT_STATE = "sensor_msgs/msg/JointState"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
UINT8_ARRAY = "std_msgs/msg/UInt8MultiArray"
STRING = "std_msgs/msg/String"
ARM_STATUS = "piper_msgs/msg/PiperStatusMsg"
TF = "tf2_msgs/msg/TFMessage"
SERVICE_EVENT = "piper_msgs/srv/Enable_Event"

Message = dict[str, Any]
"""Fields of a ROS message; nested messages are dicts."""


def _definition(fields: str, used: Mapping[str, str] = MappingProxyType({})) -> str:
    """A .msg text followed by the texts of the types it uses, as rosbag2 stores them; commas stand for line ends."""
    text = fields.replace(", ", "\n")
    for name, part in used.items():
        text += f"\n{'=' * 80}\nMSG: {name}\n" + part.replace(", ", "\n")
    return text


_HEADER = {
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
}
_LAYOUT = {
    "std_msgs/MultiArrayLayout": "MultiArrayDimension[] dim, uint32 data_offset",
    "std_msgs/MultiArrayDimension": "string label, uint32 size, uint32 stride",
}
_TRANSFORM = {
    "geometry_msgs/TransformStamped": "std_msgs/Header header, string child_frame_id, Transform transform",
    "geometry_msgs/Transform": "Vector3 translation, Quaternion rotation",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
}
ROS2_DEFINITIONS = {
    JOINT_STATE: _definition(
        "std_msgs/Header header, string[] name, float64[] position, float64[] velocity, float64[] effort", _HEADER
    ),
    COMPRESSED_IMAGE: _definition("std_msgs/Header header, string format, uint8[] data", _HEADER),
    UINT8_ARRAY: _definition("std_msgs/MultiArrayLayout layout, uint8[] data", _LAYOUT),
    STRING: "string data",
    ARM_STATUS: _definition(
        "uint8 ctrl_mode, uint8 arm_status, uint8 mode_feedback, uint8 teach_status, uint8 motion_status, "
        "uint8 trajectory_num, int64 err_code"
    ),
    TF: _definition("geometry_msgs/TransformStamped[] transforms", _TRANSFORM | _HEADER),
    # rosbag2 stores the three parts of a service type like this; no .msg parser accepts the separators
    SERVICE_EVENT: "bool enable_request\n---\nbool enable_response\n---\n",
}
"""ROS type → definition of its message, with those of nested types."""


def joint_state_cdr(message: Message) -> bytes:
    """Serialise a JointState to CDR: the same bytes as ``serialize_dynamic``, in a sixth of its time, because more than half of
    a recording's messages are joint states.

    Numbers lie at multiples of their size, counted from behind the four bytes that say little-endian CDR."""
    header = message["header"]
    body = bytearray(struct.pack("<iI", header["stamp"]["sec"], header["stamp"]["nanosec"]))
    body += _names_cdr(header["frame_id"], tuple(message["name"]))
    for key in ("position", "velocity", "effort"):
        values = message[key]
        body += bytes(-len(body) % 4) + struct.pack("<I", len(values))
        if values:
            body += bytes(-len(body) % 8) + struct.pack(f"<{len(values)}d", *values)
    return b"\0\1\0\0" + bytes(body)


@functools.lru_cache
def _names_cdr(frame_id: str, names: tuple[str, ...]) -> bytes:
    """Frame and names; they begin at a multiple of 8."""
    body = bytearray(_string_cdr(frame_id))
    body += bytes(-len(body) % 4) + struct.pack("<I", len(names))
    for name in names:
        body += bytes(-len(body) % 4) + _string_cdr(name)
    return bytes(body)


def _string_cdr(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


Encoder = Callable[[Message], bytes]
"""Function that serialises the messages of one type."""


class MessageWriter:
    """Writes messages to an MCAP writer, opening a channel when a topic first appears."""

    profile = "ros2"
    """Profile of the file."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self._types: dict[str, tuple[int, str, Encoder]] = {}
        self._channels: dict[str, tuple[int, Encoder]] = {}
        self._counts: dict[str, int] = {}

    def write(self, topic: str, ros_type: str, message: Message | bytes, log_ns: int) -> None:
        """Write one message; a message given as bytes is written unchanged.

        Args:
            ros_type: name of the ROS type, such as ``JOINT_STATE``.
            log_ns: log time [ns].
        """
        if topic not in self._channels:
            if ros_type not in self._types:
                self._types[ros_type] = self.register(ros_type)
            schema_id, encoding, encode = self._types[ros_type]
            self._channels[topic] = self.writer.register_channel(topic, encoding, schema_id), encode
            self._counts[topic] = 0
        channel_id, encode = self._channels[topic]
        self._counts[topic] += 1
        data = message if isinstance(message, bytes) else encode(message)
        self.writer.add_message(channel_id, log_ns, data, publish_time=log_ns, sequence=self._counts[topic])

    def register(self, ros_type: str) -> tuple[int, str, Encoder]:
        """Write the schema of a type; returns its id, the encoding of its messages, and their encoder."""
        text = ROS2_DEFINITIONS[ros_type]
        schema_id = self.writer.register_schema(ros_type, SchemaEncoding.ROS2, text.encode())
        if ros_type == SERVICE_EVENT:
            return schema_id, MessageEncoding.CDR, lambda _: b""
        encode = joint_state_cdr if ros_type == JOINT_STATE else serialize_dynamic(ros_type, text)[ros_type]
        return schema_id, MessageEncoding.CDR, encode
