"""JSON and protobuf channels hold what the ROS 2 channels hold."""

import pytest
from mcap_ros2._dynamic import serialize_dynamic

from taccorl.surrogate.driver_messages import JOINT_STATE, ROS2_DEFINITIONS, joint_state_cdr
from taccorl.surrogate.drivers import CAMERA_TOPICS, COMMAND_TOPICS, EPISODE_TOPIC, PAD_TOPICS, STATE_TOPICS

TOPICS = [t for topics in (STATE_TOPICS, COMMAND_TOPICS, CAMERA_TOPICS, PAD_TOPICS) for t in topics.values()]


@pytest.mark.parametrize("encoding", [pytest.param("json", marks=pytest.mark.slow), "protobuf"])
def test_content_is_the_same_in_every_encoding(record, plain, encoding):
    usual, other = record(), record(encoding=encoding)
    for topic in (*TOPICS, EPISODE_TOPIC):
        assert len(usual.messages[topic]) == len(other.messages[topic]) > 0
        assert usual.log_s[topic].tolist() == other.log_s[topic].tolist()
        for a, b in zip(usual.messages[topic], other.messages[topic], strict=True):
            assert plain(a) == plain(b)


def test_names_of_types_are_those_a_foxglove_reader_expects(record):
    json_names, proto_names = record(encoding="json").schemas, record(encoding="protobuf").schemas
    picture, joints, pad = CAMERA_TOPICS["front"], STATE_TOPICS["left"], next(iter(PAD_TOPICS.values()))
    assert json_names[picture] == proto_names[picture] == "foxglove.CompressedImage"
    assert (json_names[joints], proto_names[joints]) == ("sensor_msgs/msg/JointState", "sensor_msgs.JointState")
    assert (json_names[pad], proto_names[pad]) == ("std_msgs/msg/UInt8MultiArray", "std_msgs.UInt8MultiArray")


def test_types_that_only_ros_knows_stay_ros_2(record):
    assert record(encoding="json").schemas["/tf"] == "tf2_msgs/msg/TFMessage"


@pytest.mark.parametrize("frame_id", ["", "a", "base_link"])
@pytest.mark.parametrize(
    ("name", "lengths"), [([], (0, 0, 0)), (["a"], (1, 0, 2)), (["joint1", "joint2", "größer"], (3, 2, 3))]
)
def test_joint_states_are_serialised_as_the_mcap_package_does_it(frame_id, name, lengths):
    arrays = {
        key: [0.1 * k - 3.0 for k in range(n)]
        for key, n in zip(("position", "velocity", "effort"), lengths, strict=True)
    }
    message = {"header": {"stamp": {"sec": 1_700_000_000, "nanosec": 999_999_999}, "frame_id": frame_id}, "name": name}
    message |= arrays
    theirs = serialize_dynamic(JOINT_STATE, ROS2_DEFINITIONS[JOINT_STATE])[JOINT_STATE]
    assert joint_state_cdr(message) == theirs(message)
