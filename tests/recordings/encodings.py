"""The drivers' messages as JSON and protobuf channels of an MCAP file, with the same content.

``protobuf`` uses messages of the same fields, described at run time. Pictures are ``foxglove.CompressedImage``: ``timestamp``
instead of ``header.stamp``; in JSON their data is base64, while touch data is a list of numbers.
"""

import base64
import json

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer

from taccorl.surrogate.driver_messages import (
    COMPRESSED_IMAGE,
    JOINT_STATE,
    ROS2_DEFINITIONS,
    STRING,
    UINT8_ARRAY,
    Encoder,
    Message,
    MessageWriter,
)

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


def _to_json(ros_type: str) -> Encoder:
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


class JsonWriter(MessageWriter):
    """Types that only exist in ROS (status, transforms, service events) stay ROS 2 channels."""

    profile = ""

    def register(self, ros_type: str) -> tuple[int, str, Encoder]:
        if ros_type not in _OTHER_NAMES:
            return super().register(ros_type)
        name = _OTHER_NAMES[ros_type][0]
        schema_id = self.writer.register_schema(name, SchemaEncoding.JSONSchema, _json_schema(ros_type))
        return schema_id, MessageEncoding.JSON, _to_json(ros_type)


class ProtobufWriter(MessageWriter):
    """As ``JsonWriter``."""

    profile = ""

    def __init__(self, writer: Writer) -> None:
        super().__init__(writer)
        self._files = _proto_files()

    def register(self, ros_type: str) -> tuple[int, str, Encoder]:
        if ros_type not in _OTHER_NAMES:
            return super().register(ros_type)
        name = _OTHER_NAMES[ros_type][1]
        data = self._files.SerializeToString(deterministic=True)
        schema_id = self.writer.register_schema(name, SchemaEncoding.Protobuf, data)
        pool = descriptor_pool.DescriptorPool()
        for file in self._files.file:
            pool.Add(file)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))

        def encode(message: Message) -> bytes:
            if ros_type == COMPRESSED_IMAGE:
                message = _foxglove_picture(message, "seconds", "nanos")
            return kind(**message).SerializeToString(deterministic=True)

        return schema_id, MessageEncoding.Protobuf, encode


WRITERS: dict[str, type[MessageWriter]] = {"ros2": MessageWriter, "json": JsonWriter, "protobuf": ProtobufWriter}
"""Encoding → its writer."""
