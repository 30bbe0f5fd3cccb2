"""The MCAP file: labelled, repeatable, and timed as the drivers would."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2._dynamic import serialize_dynamic
from mcap_ros2.decoder import DecoderFactory

from taccorl.surrogate import drivers
from taccorl.surrogate.driver_messages import JOINT_STATE, ROS2_DEFINITIONS, joint_state_cdr
from tests.recordings.pictures import draw_frame_id, read_frame_id
from tests.recordings.stand_in import StandInConfig, write_mcap


def _digest(path: Path, **changes) -> str:
    write_mcap(path, StandInConfig(duration_s=2.0, camera_size=(48, 64), **changes))
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("encoding", ["ros2", "json", "protobuf"])
def test_same_configuration_gives_the_same_bytes(tmp_path, encoding):
    assert _digest(tmp_path / "a.mcap", encoding=encoding) == _digest(tmp_path / "b.mcap", encoding=encoding)


def test_file_says_that_it_is_a_surrogate(record):
    with record().path.open("rb") as file:
        labels = {metadata.name: metadata.metadata for metadata in make_reader(file).iter_metadata()}
    assert labels["taccorl"]["origin"] == "stand-in recording, not a robot"
    assert labels["taccorl"]["seed"] == "0"
    assert labels["taccorl"]["instruction"] == "insert the test tube into the rack"


def test_types_are_those_of_the_data_spec(record):
    schemas = record().schemas
    for topics, kind in (
        ({**drivers.STATE_TOPICS, **drivers.COMMAND_TOPICS}, "sensor_msgs/msg/JointState"),
        (drivers.CAMERA_TOPICS, "sensor_msgs/msg/CompressedImage"),
        (drivers.PAD_TOPICS, "std_msgs/msg/UInt8MultiArray"),
        ({"": drivers.EPISODE_TOPIC}, "std_msgs/msg/String"),
    ):
        assert {schemas[topic] for topic in topics.values()} == {kind}


def test_joints_come_at_200_hz_with_six_velocities_and_a_few_repeats(record):
    recorded = record()
    for topic in (*drivers.STATE_TOPICS.values(), *drivers.COMMAND_TOPICS.values()):
        first = recorded.messages[topic][20]
        assert (first.name, len(first.position), len(first.velocity)) == (list(drivers.JOINT_NAMES), 7, 6)
        assert len(recorded.messages[topic]) == 600  # 3 s × 200 Hz
        steps_s = np.diff(recorded.stamps_s(topic)[10:])
        assert np.median(steps_s) == pytest.approx(0.005)
        assert 1 <= np.count_nonzero(steps_s == 0) <= 30  # 2 % of 590 is 12; 30 is five deviations away
        late_s = (recorded.log_s[topic] - recorded.stamps_s(topic))[10:]
        assert late_s.min() >= 0.0012
        assert np.median(late_s) < 0.002


def test_a_repeated_joint_message_repeats_stamp_and_values(record):
    recorded, topic = record(joint_repeat_probability=0.5), drivers.STATE_TOPICS["left"]
    same = np.flatnonzero(np.diff(recorded.stamps_s(topic)) == 0)
    assert len(same) > 200
    positions = recorded.positions(topic)
    assert np.array_equal(positions[same], positions[same + 1])


def test_commands_have_stamp_zero_until_one_is_seen(record):
    for arm, topic in drivers.COMMAND_TOPICS.items():
        messages = record().messages[topic]
        unseen = [n for n, m in enumerate(messages) if m.header.stamp.sec == 0]
        assert unseen == list(range(8)), arm  # 40 ms at 200 Hz
        assert list(messages[0].position) == [0.0] * 7


def test_cameras_come_at_30_hz_about_30_ms_late_each_with_its_own_phase(record):
    recorded = record()
    phases_s = []
    for topic in drivers.CAMERA_TOPICS.values():
        stamps_s = recorded.stamps_s(topic)
        phases_s.append(stamps_s[0] % (1 / 30))
        assert np.median(np.diff(stamps_s)) == pytest.approx(1 / 30, abs=0.0005)
        late_s = recorded.log_s[topic] - stamps_s
        assert late_s.min() >= 0.030
        assert late_s.max() <= 0.030 + 5 * 0.004
    assert np.ptp(phases_s) > 0.002


def test_lost_pictures_are_as_many_as_told_and_leave_their_ids_out(record):
    recorded = record(camera_loss_probability=0.2)
    ids = np.concatenate(list(recorded.truth.frame_ids.values()))
    assert 270 * 0.2 - 4 * 6.6 < 270 - len(ids) < 270 * 0.2 + 4 * 6.6  # binomial, deviation √(270·0.2·0.8) = 6.6
    for camera, topic in drivers.CAMERA_TOPICS.items():
        assert len(recorded.messages[topic]) == len(recorded.truth.frame_ids[camera])
        assert np.all(np.diff(recorded.truth.frame_ids[camera]) >= 1)


def test_pads_come_at_100_hz_ten_ms_after_the_middle_of_their_scan(record):
    recorded = record()
    for topic in drivers.PAD_TOPICS.values():
        assert len(recorded.messages[topic]) == 300
        late_s = recorded.log_s[topic] - recorded.truth.sampled_s[topic]
        assert late_s.min() >= 0.009  # half a scan 5 ms, transport 4 ms
        assert late_s.max() <= 0.009 + 5 * 0.0005
        assert [d.size for d in recorded.messages[topic][0].layout.dim] == [12, 32]


def test_truth_has_the_log_times_that_are_in_the_file(record):
    recorded = record()
    for topic, log_s in recorded.truth.log_s.items():
        assert np.allclose(recorded.log_s[topic], log_s, atol=1e-8)
        assert np.all(np.diff(log_s) >= 0)


def test_every_episode_has_its_markers(record):
    recorded = record(duration_s=6.0, episodes=3, outcomes=("success", "failure"), instruction="plug it in")
    texts = [m.data for m in recorded.messages[drivers.EPISODE_TOPIC]]
    assert texts == ["start:plug it in", "success", "start:plug it in", "failure", "start:plug it in", "success"]
    assert recorded.log_s[drivers.EPISODE_TOPIC] == pytest.approx([0.1, 1.9, 2.1, 3.9, 4.1, 5.9])


def test_a_reader_that_decodes_every_topic_stumbles_over_the_service_event(record):
    with record().path.open("rb") as file, pytest.raises(Exception, match="---"):
        list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert {"/arm_status_left", "/tf"} <= set(record().messages)


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


@pytest.mark.parametrize("frame_id", [0, 1, 0b1010101010101010, 0b0101010101010101, 719, 65535])
def test_frame_id_is_read_back(frame_id):
    picture = np.full((48, 64, 3), 128, np.uint8)
    draw_frame_id(picture, frame_id)
    assert read_frame_id(picture) == frame_id
