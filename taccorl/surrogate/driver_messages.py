"""Messages of the robot's drivers: ROS 2 types as rosbag2 stores them in MCAP files. A message is a dict shaped like its type."""

import functools
from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from mcap_ros2._dynamic import (
    serialize_dynamic,
)  # its public Writer cannot mix encodings in one file

JOINT_STATE = "sensor_msgs/msg/JointState"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
UINT8_ARRAY = "std_msgs/msg/UInt8MultiArray"
STRING = "std_msgs/msg/String"
ARM_STATUS = "piper_msgs/msg/PiperStatusMsg"
TF = "tf2_msgs/msg/TFMessage"
SERVICE_EVENT = "piper_msgs/srv/Enable_Event"

Message = dict[str, Any]  # Fields of a ROS message; nested messages are dicts


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
        "std_msgs/Header header, string[] name, float64[] position, float64[] velocity, float64[] effort",
        _HEADER,
    ),
    COMPRESSED_IMAGE: _definition(
        "std_msgs/Header header, string format, uint8[] data", _HEADER
    ),
    UINT8_ARRAY: _definition("std_msgs/MultiArrayLayout layout, uint8[] data", _LAYOUT),
    STRING: "string data",
    ARM_STATUS: _definition(
        "uint8 ctrl_mode, uint8 arm_status, uint8 mode_feedback, uint8 teach_status, uint8 motion_status, "
        "uint8 trajectory_num, int64 err_code"
    ),
    TF: _definition(
        "geometry_msgs/TransformStamped[] transforms", _TRANSFORM | _HEADER
    ),
    # rosbag2 stores the three parts of a service type like this; no .msg parser accepts the separators
    SERVICE_EVENT: "bool enable_request\n---\nbool enable_response\n---\n",
}
"""ROS type → definition of its message, with those of nested types."""


class MessageWriter:
    """Writes messages to an MCAP writer, opening a channel when a topic first appears."""

    profile = "ros2"  # Profile of the file

    def __init__(self, writer: Writer) -> None:
        self.writer, self._counts = writer, Counter[str]()
        self._channels: dict[str, tuple[int, Callable[[Message], bytes]]] = {}
        self._types = functools.cache(self._register)

    def write(
        self, topic: str, ros_type: str, message: Message | bytes, log_ns: int
    ) -> None:
        """Write one message; a message given as bytes is written unchanged. ``ros_type``: name of the ROS type, such as
        ``JOINT_STATE``. ``log_ns``: log time [ns]."""
        if topic not in self._channels:
            schema_id, encode = self._types(ros_type)
            self._channels[topic] = (
                self.writer.register_channel(topic, MessageEncoding.CDR, schema_id),
                encode,
            )
        channel_id, encode = self._channels[topic]
        self._counts[topic] += 1
        data = message if isinstance(message, bytes) else encode(message)
        self.writer.add_message(
            channel_id, log_ns, data, publish_time=log_ns, sequence=self._counts[topic]
        )

    def _register(self, ros_type: str) -> tuple[int, Callable[[Message], bytes]]:
        """Write the schema of a type; returns its id and the encoder of its messages."""
        text = ROS2_DEFINITIONS[ros_type]
        schema_id = self.writer.register_schema(
            ros_type, SchemaEncoding.ROS2, text.encode()
        )
        return schema_id, bytes if ros_type == SERVICE_EVENT else serialize_dynamic(
            ros_type, text
        )[ros_type]
