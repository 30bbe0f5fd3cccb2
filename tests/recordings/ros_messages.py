"""Definitions of ROS 2 messages."""

HEADER = """
===
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
JOINT_STATE = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    + HEADER
)
PICTURE = "std_msgs/Header header\nstring format\nuint8[] data" + HEADER
