"""ROS messages, read without ROS: definitions and CDR through rosbags, and the numbers, with units, of vectors, poses, IMUs …

A value's name is its path in the message without the fields that only wrap: ``position.x`` is at ``pose.pose.position.x`` of an
Odometry. Quaternions are read in the order w, x, y, z of the unit ``wxyz``; ROS writes w last. Headers, covariances and names
of frames are left out. SI units (REP 103).
"""

import functools
import re
import struct
from collections.abc import Callable, Mapping
from typing import Any

import zstandard

from taccorl.errors import RecordingError

WRAPPERS = (
    "vector",
    "point",
    "quaternion",
    "pose",
    "twist",
    "wrench",
    "accel",
    "transform",
)
"""Fields of Stamped and WithCovariance types that contain the message itself."""
STRUCTURES = (
    *(
        ("w", "x", "y", "z"),
        ("x", "y", "z"),
        ("position", "orientation"),
        ("translation", "rotation"),
    ),
    *(
        ("linear", "angular"),
        ("force", "torque"),
        ("orientation", "angular_velocity", "linear_acceleration"),
    ),
    *(("pose", "twist"), *((wrapper,) for wrapper in WRAPPERS)),
)
"""Fields that hold numbers, in the order in which they are read. The first group that a message has applies."""
TYPES = (
    "Vector3",
    "Point",
    "Quaternion",
    "Pose",
    "Transform",
    "Twist",
    "Accel",
    "Wrench",
    "Imu",
    "Odometry",
)
UNITS = {
    "position": "m",
    "translation": "m",
    "orientation": "wxyz",
    "rotation": "wxyz",
    "linear": "m/s",
    "force": "N",
} | {
    "angular": "rad/s",
    "angular_velocity": "rad/s",
    "linear_acceleration": "m/s2",
    "torque": "Nm",
}
"""Name of the field that holds x, y and z → their unit."""
UNITS_OF_ACCEL = {"linear": "m/s2", "angular": "rad/s2"}
UNITS_OF_TYPE = {
    "Point": "m",
    "Quaternion": "wxyz",
}  # Of messages of x, y, z (and w) only; Vector3 states no quantity
Decoder = Callable[[bytes], Any]
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MOST_BYTES = 1 << 28
"""Most bytes of an unpacked message: 256 MiB; a compressed one of a few bytes could take all the memory."""


def vector_type(kind: str) -> str | None:
    """Name in ``TYPES`` of a message type of any package: ``geometry_msgs/msg/PoseStamped`` is a Pose; None for others."""
    name = (
        kind.replace(".", "/")
        .rpartition("/")[2]
        .removesuffix("Stamped")
        .removesuffix("WithCovariance")
    )
    return name if name in TYPES else None


def unit_of(name: str, kind: str) -> str:
    """Unit of the value ``name`` of a message of type ``kind``; empty if the type does not determine it."""
    field, own = name.rpartition(".")[0], vector_type(kind) or ""
    return (
        (UNITS_OF_ACCEL if own == "Accel" else UNITS).get(field, "")
        if field
        else UNITS_OF_TYPE.get(own, "")
    )


def unpacked(data: bytes) -> bytes:
    """A CDR message as it was before rosbag2 compressed it (compression_mode: MESSAGE). CDR begins with a zero, zstd does not.
    Raises ValueError: damaged, or larger than ``MOST_BYTES``."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            found = reader.read(MOST_BYTES + 1)
    except zstandard.ZstdError as error:
        raise ValueError(f"its zstd compression is damaged: {error}") from error
    if len(found) > MOST_BYTES:
        raise ValueError(f"it unpacks to more than {MOST_BYTES:,} bytes")
    return found


def full_name(kind: str) -> str:
    """``sensor_msgs/Imu`` (oldest bags) and ``sensor_msgs/msg/Imu`` are one type."""
    return kind if kind.count("/") != 1 else kind.replace("/", "/msg/")


def octets(types: Mapping[str, Any]) -> dict[str, Any]:
    """rosbags' definitions of messages, with the ``byte`` of ROS 2 as what it is: an
    octet, 0 … 255. rosbags reads it as int8, which it is in ROS 1 only."""

    def as_octet(field: Any) -> Any:
        node, content = field
        if content[0] == "byte":
            return node, ("uint8", *content[1:])
        if isinstance(content[0], tuple):  # an array or a sequence of fields
            return node, (as_octet(content[0]), *content[1:])
        return field

    return {
        kind: (constants, [(name, as_octet(field)) for name, field in fields])
        for kind, (constants, fields) in types.items()
    }


@functools.cache
def shipped_store(distribution: str) -> Any:
    """rosbags' type store of the messages of a ROS 2 distribution: ``ros2_humble``."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.EMPTY)
    known = get_typestore(Stores(distribution)).fielddefs
    store.register({k: d for k, d in octets(known).items() if k not in store.fielddefs})
    return store


@functools.lru_cache(maxsize=256)
def type_store(kind: str, encoding: str, definition: str, what: str = "") -> Any:
    """rosbags' type store that knows ``kind`` by a definition, named ``what``. Raises RecordingError: it does not parse."""
    from rosbags.typesys import (
        Stores,
        get_types_from_idl,
        get_types_from_msg,
        get_typestore,
    )

    try:
        if encoding not in ("ros1msg", "ros2msg", "ros2idl"):
            raise RecordingError(
                f"definitions in {encoding!r} are not supported (supported: ros2msg, ros2idl)"
            )
        types = {}
        for name in (
            "Time",
            "Duration",
        ):  # of which definitions may speak without defining them
            types |= get_types_from_msg(
                "int32 sec\nuint32 nanosec", f"builtin_interfaces/msg/{name}"
            )
        if encoding == "ros2idl":
            for part in re.split(r"^=+\nIDL: .*\n", definition, flags=re.MULTILINE):
                types |= get_types_from_idl(part) if part.strip() else {}
        else:
            types |= get_types_from_msg(
                re.sub(r"(?m)^=+\s*$", "=" * 80, definition), kind
            )
        store = get_typestore(Stores.EMPTY)
        store.register(types if encoding == "ros1msg" else octets(types))
        store.get_msgdef(kind)
    except Exception as error:  # this topic only
        what = what or f"the bag's definition of {kind}"
        raise RecordingError(
            f"{what} does not parse ({type(error).__name__}: {str(error)[:200]})"
        ) from error
    return store


def cdr_stamp(data: bytes) -> int | None:
    """header.stamp [ns] of a CDR message whose first field is a header: 4 bytes of encapsulation (second byte 1:
    little-endian), then sec, nanosec."""
    if len(data) < 12:
        return None
    sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return sec * 1_000_000_000 + nanosec
