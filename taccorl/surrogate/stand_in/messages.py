"""Message types of the stand-in as ROS 2, JSON and protobuf channels of an MCAP file, with the same content.

A message is a plain dict shaped like its ROS type. ``ros2`` serialises it as CDR; ``json`` keeps its shape; ``protobuf``
uses messages of the same fields, described at run time. Pictures in JSON and protobuf are ``foxglove.CompressedImage``:
``timestamp`` instead of ``header.stamp``; in JSON their data is base64, while touch data is a list of numbers.
"""

import base64
import functools
import json
import struct
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
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
ENCODINGS = ("ros2", "json", "protobuf")
"""Values of ``StandInConfig.encoding``."""

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

# Protobuf: message name -> fields in order of number; "*" marks a list, a dotted name another message
_PROTO_MESSAGES = {
    "builtin_interfaces.Time": "sec:int32 nanosec:uint32",
    "std_msgs.Header": "stamp:builtin_interfaces.Time frame_id:string",
    "std_msgs.MultiArrayDimension": "label:string size:uint32 stride:uint32",
    "std_msgs.MultiArrayLayout": "dim*:std_msgs.MultiArrayDimension data_offset:uint32",
    "sensor_msgs.JointState": "header:std_msgs.Header name*:string position*:double velocity*:double effort*:double",
    "std_msgs.UInt8MultiArray": "layout:std_msgs.MultiArrayLayout data:bytes",
    "std_msgs.String": "data:string",
    "foxglove.CompressedImage": "timestamp:google.protobuf.Timestamp frame_id:string data:bytes format:string",
}
_OTHER_NAMES = {  # ROS type -> name in JSON, name in protobuf
    JOINT_STATE: (JOINT_STATE, "sensor_msgs.JointState"),
    COMPRESSED_IMAGE: ("foxglove.CompressedImage", "foxglove.CompressedImage"),
    UINT8_ARRAY: (UINT8_ARRAY, "std_msgs.UInt8MultiArray"),
    STRING: (STRING, "std_msgs.String"),
}


def _proto_files() -> descriptor_pb2.FileDescriptorSet:
    """What ``protoc --descriptor_set_out`` would have made of the table above."""
    timestamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    files = {"google.protobuf": timestamp}
    kinds = descriptor_pb2.FieldDescriptorProto
    for full_name, fields in _PROTO_MESSAGES.items():
        package, name = full_name.split(".")
        if package not in files:
            files[package] = descriptor_pb2.FileDescriptorProto(
                name=f"{package}.proto", package=package, syntax="proto3"
            )
        message = files[package].message_type.add(name=name)
        for number, field in enumerate(fields.split(), start=1):
            field_name, kind = field.split(":")
            label = kinds.LABEL_REPEATED if field_name.endswith("*") else kinds.LABEL_OPTIONAL
            added = message.field.add(name=field_name.rstrip("*"), number=number, label=label)
            if "." in kind:
                added.type, added.type_name = kinds.TYPE_MESSAGE, f".{kind}"
                needed = files[kind.rsplit(".", 1)[0]].name
                if needed != files[package].name and needed not in files[package].dependency:
                    files[package].dependency.append(needed)
            else:
                added.type = getattr(kinds, f"TYPE_{kind.upper()}")
    return descriptor_pb2.FileDescriptorSet(file=files.values())


def _foxglove_picture(message: Message, seconds: str, nanoseconds: str) -> Message:
    stamp = message["header"]["stamp"]
    return {
        "timestamp": {seconds: stamp["sec"], nanoseconds: stamp["nanosec"]},
        "frame_id": message["header"]["frame_id"],
        "data": message["data"],
        "format": message["format"],
    }


def _to_json(ros_type: str) -> Callable[[Message], bytes]:
    def encode(message: Message) -> bytes:
        if ros_type == COMPRESSED_IMAGE:
            message = _foxglove_picture(message, "sec", "nsec")
            message["data"] = base64.b64encode(message["data"]).decode()
        elif ros_type == UINT8_ARRAY:
            message = message | {"data": list(message["data"])}
        return json.dumps(message, separators=(",", ":")).encode()

    return encode


def _json_schema(ros_type: str) -> bytes:
    if ros_type == COMPRESSED_IMAGE:
        names = ["timestamp", "frame_id", "data", "format"]
    else:
        names = [line.split()[-1] for line in ROS2_DEFINITIONS[ros_type].split("\n=")[0].splitlines()]
    return json.dumps({"title": _OTHER_NAMES[ros_type][0], "type": "object", "required": names}).encode()


def joint_state_cdr(message: Message) -> bytes:
    """Serialise a JointState to CDR: the same bytes as ``serialize_dynamic``, in a sixth of its time, because more than half of
    a recording's messages are joint states.

    Numbers lie at multiples of their size, counted from behind the four bytes that say little-endian CDR.
    """
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


class MessageWriter:
    """Writes messages to an MCAP writer, opening a channel when a topic first appears.

    Types that only exist in ROS (status, transforms, service events) stay ROS 2 channels whatever the encoding is.
    """

    def __init__(self, writer: Writer, encoding: str) -> None:
        self._writer, self._encoding = writer, encoding
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, tuple[int, Callable[[Message], bytes]]] = {}
        self._encoders: dict[str, Callable[[Message], bytes]] = {}
        self._counts: dict[str, int] = {}
        self._proto = _proto_files() if encoding == "protobuf" else None

    def write(self, topic: str, ros_type: str, message: Message | bytes, log_ns: int) -> None:
        """Write one message; a message given as bytes is written unchanged.

        Args:
            ros_type: name of the ROS type, such as ``JOINT_STATE``.
            log_ns: log time [ns].
        """
        if topic not in self._channels:
            self._channels[topic] = self._open(topic, ros_type)
            self._counts[topic] = 0
        channel_id, encode = self._channels[topic]
        self._counts[topic] += 1
        data = message if isinstance(message, bytes) else encode(message)
        self._writer.add_message(channel_id, log_ns, data, publish_time=log_ns, sequence=self._counts[topic])

    def _open(self, topic: str, ros_type: str) -> tuple[int, Callable[[Message], bytes]]:
        encoding = self._encoding if ros_type in _OTHER_NAMES else "ros2"
        if ros_type not in self._schemas:
            register = {"ros2": self._ros2_schema, "json": self._json_schema, "protobuf": self._protobuf_schema}
            self._schemas[ros_type], self._encoders[ros_type] = register[encoding](ros_type)
        wire = {"ros2": MessageEncoding.CDR, "json": MessageEncoding.JSON, "protobuf": MessageEncoding.Protobuf}
        return self._writer.register_channel(topic, wire[encoding], self._schemas[ros_type]), self._encoders[ros_type]

    def _ros2_schema(self, ros_type: str) -> tuple[int, Callable[[Message], bytes]]:
        text = ROS2_DEFINITIONS[ros_type]
        schema_id = self._writer.register_schema(ros_type, SchemaEncoding.ROS2, text.encode())
        if ros_type == SERVICE_EVENT:
            return schema_id, lambda _: b""
        if ros_type == JOINT_STATE:
            return schema_id, joint_state_cdr
        return schema_id, serialize_dynamic(ros_type, text)[ros_type]

    def _json_schema(self, ros_type: str) -> tuple[int, Callable[[Message], bytes]]:
        name = _OTHER_NAMES[ros_type][0]
        schema_id = self._writer.register_schema(name, SchemaEncoding.JSONSchema, _json_schema(ros_type))
        return schema_id, _to_json(ros_type)

    def _protobuf_schema(self, ros_type: str) -> tuple[int, Callable[[Message], bytes]]:
        assert self._proto is not None
        name = _OTHER_NAMES[ros_type][1]
        data = self._proto.SerializeToString(deterministic=True)
        schema_id = self._writer.register_schema(name, SchemaEncoding.Protobuf, data)
        pool = descriptor_pool.DescriptorPool()
        for file in self._proto.file:
            pool.Add(file)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))

        def encode(message: Message) -> bytes:
            if ros_type == COMPRESSED_IMAGE:
                message = _foxglove_picture(message, "seconds", "nanos")
            return kind(**message).SerializeToString(deterministic=True)

        return schema_id, encode
