"""Numeric fields, and their units, of ROS messages with vectors, poses, velocities, forces and IMU readings.

A value's name is its path in the message without the fields that only wrap: ``position.x`` is at ``pose.pose.position.x`` of an
Odometry. Quaternions are read in the order w, x, y, z of the unit ``wxyz``; ROS writes w last. Headers, covariances and names
of frames are left out.
"""

WRAPPERS = ("vector", "point", "quaternion", "pose", "twist", "wrench", "accel", "transform")
"""Fields of Stamped and WithCovariance types that contain the message itself."""
STRUCTURES = (
    ("w", "x", "y", "z"),
    ("x", "y", "z"),
    ("position", "orientation"),
    ("translation", "rotation"),
    ("linear", "angular"),
    ("force", "torque"),
    ("orientation", "angular_velocity", "linear_acceleration"),
    ("pose", "twist"),
    *((wrapper,) for wrapper in WRAPPERS),
)
"""Fields that hold numbers, in the order in which they are read. The first line whose fields all exist in a message applies."""
TYPES = ("Vector3", "Point", "Quaternion", "Pose", "Transform", "Twist", "Accel", "Wrench", "Imu", "Odometry")
UNITS = {
    **dict.fromkeys(("position", "translation"), "m"),
    **dict.fromkeys(("orientation", "rotation"), "wxyz"),
    **dict.fromkeys(("angular", "angular_velocity"), "rad/s"),
    "linear": "m/s",
    "linear_acceleration": "m/s2",
    "force": "N",
    "torque": "Nm",
}
"""Name of the field that holds x, y and z → their unit. ROS messages are in SI units (REP 103)."""
UNITS_OF_ACCEL = {"linear": "m/s2", "angular": "rad/s2"}
UNITS_OF_TYPE = {"Point": "m", "Quaternion": "wxyz"}
"""Type of a message that consists of x, y, z (and w) only → their unit. Vector3 has none: its type does not state a quantity."""


def vector_type(kind: str) -> str | None:
    """Name in ``TYPES`` of the message type ``kind``, whatever its package and form: ``geometry_msgs/msg/PoseStamped`` is a Pose;
    None for other types."""
    name = kind.replace(".", "/").rpartition("/")[2].removesuffix("Stamped").removesuffix("WithCovariance")
    return name if name in TYPES else None


def unit_of(name: str, kind: str) -> str:
    """Unit of the value ``name`` of a message of type ``kind``; empty if the type does not determine it."""
    field, own = name.rpartition(".")[0], vector_type(kind) or ""
    return (UNITS_OF_ACCEL if own == "Accel" else UNITS).get(field, "") if field else UNITS_OF_TYPE.get(own, "")
