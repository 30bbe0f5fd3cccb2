"""Each fault switch does what it says, and only that."""

import cv2
import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.surrogate.drivers import (
    CAMERA_TOPICS,
    COMMAND_TOPICS,
    EPISODE_TOPIC,
    PAD_TOPICS,
    PADS,
    PIPER_RAD_PER_DEG,
    STATE_TOPICS,
)
from tests.recordings.pictures import read_frame_id
from tests.recordings.stand_in import StandInConfig


def test_joints_in_degrees_publishes_degrees_and_metres(record):
    usual, faulty = record(), record(joints_in_degrees=True)
    for topic in (STATE_TOPICS["left"], COMMAND_TOPICS["right"]):
        ratio = faulty.positions(topic)[20:, 1] / usual.positions(topic)[20:, 1]
        assert ratio == pytest.approx(1 / PIPER_RAD_PER_DEG)
        assert np.array_equal(faulty.positions(topic)[:, 6], usual.positions(topic)[:, 6])


@pytest.mark.slow
def test_swapped_arms_publish_under_each_others_topics(record):
    truth, faulty = record().truth, record(swap_arms=True)
    for topics, story_values in ((STATE_TOPICS, truth.story.state), (COMMAND_TOPICS, truth.story.command)):
        for arm, first in (("left", 7), ("right", 0)):
            opening_m = story_values(faulty.stamps_s(topics[arm])[20:])[:, first + 6]
            assert faulty.positions(topics[arm])[20:, 6] == pytest.approx(opening_m, abs=1e-6)
    for topic in PAD_TOPICS.values():
        assert np.array_equal(faulty.counts(topic), record().counts(topic))


def test_sim_time_stamps_count_from_zero_under_wall_clock_log_times(record):
    faulty = record(sim_time_stamps=True)
    for topic in (STATE_TOPICS["left"], CAMERA_TOPICS["front"]):
        assert max(m.header.stamp.sec for m in faulty.messages[topic]) <= 3
        assert np.array_equal(faulty.log_s[topic], record().log_s[topic])


def test_clock_offset_moves_the_stamp_or_the_log_time_where_there_is_no_stamp(record):
    camera, pad = CAMERA_TOPICS["front"], PAD_TOPICS[PADS[1]]
    usual, faulty = record(), record(clock_offset_s={camera: -0.2, pad: 0.38})
    assert faulty.stamps_s(camera) - usual.stamps_s(camera) == pytest.approx(-0.2, abs=1e-6)
    assert np.array_equal(faulty.log_s[camera], usual.log_s[camera])
    assert faulty.log_s[pad] - usual.log_s[pad] == pytest.approx(0.38, abs=1e-6)
    assert np.array_equal(faulty.truth.sampled_s[pad], usual.truth.sampled_s[pad])


def test_a_gap_removes_these_messages_and_changes_no_other(record):
    camera, pad, joints = CAMERA_TOPICS["left_wrist"], PAD_TOPICS[PADS[0]], STATE_TOPICS["right"]
    usual = record()
    faulty = record(gap=[(camera, 1.0, 1.5), (pad, 0.5, 0.7), (joints, 2.0, 2.25)])
    for topic, begin_s, end_s in ((camera, 1.0, 1.5), (pad, 0.5, 0.7), (joints, 2.0, 2.25)):
        before = usual.truth.sampled_s[topic] - (0.005 if topic == pad else 0.0)  # a scan counts from its beginning
        kept = (before < begin_s) | (before >= end_s)
        assert np.array_equal(faulty.log_s[topic], usual.log_s[topic][kept])
    assert np.array_equal(faulty.positions(joints), usual.positions(joints)[(before < 2.0) | (before >= 2.25)])
    assert len(faulty.messages[CAMERA_TOPICS["front"]]) == len(usual.messages[CAMERA_TOPICS["front"]])


def test_one_gap_may_stand_alone_and_may_hit_a_marker(record):
    assert [m.data for m in record(gap=(EPISODE_TOPIC, 2.0, 3.0)).messages[EPISODE_TOPIC]] == [
        "start:insert the test tube into the rack"
    ]


def test_a_frozen_camera_repeats_one_picture_with_new_stamps(record):
    faulty, topic = record(frozen_camera="front"), CAMERA_TOPICS["front"]
    data = [bytes(m.data) for m in faulty.messages[topic]]
    picture = cv2.imdecode(np.frombuffer(data[-1], np.uint8), cv2.IMREAD_COLOR)
    assert read_frame_id(picture) == 30  # a third of 3 s at 30 Hz
    assert 58 <= data.count(data[-1]) <= 60
    assert np.all(np.diff(faulty.stamps_s(topic)) > 0)
    assert faulty.truth.frame_ids["front"][-1] == 30
    other = CAMERA_TOPICS["left_wrist"]
    assert [m.data for m in faulty.messages[other]] == [m.data for m in record().messages[other]]


def test_broken_taxels_read_zero_full_or_one_value(record):
    pad = PADS[2]
    faulty = record(
        dead_taxels={pad: [(0, 0), (5, 20)]}, stuck_taxels={pad: [(3, 3)]}, saturated_taxels={pad: [(11, 31)]}
    )
    counts, usual = faulty.counts(PAD_TOPICS[pad]), record().counts(PAD_TOPICS[pad])
    assert np.all(counts[:, [0, 5], [0, 20]] == 0)
    assert np.all(counts[:, 11, 31] == 255)
    assert len(np.unique(counts[:, 3, 3])) == 1
    assert 60 <= counts[0, 3, 3] < 120
    changed = np.argwhere((counts != usual).any(axis=0)).tolist()
    assert changed == [[0, 0], [3, 3], [5, 20], [11, 31]]


@pytest.mark.slow
def test_swapped_pads_come_under_each_others_topic(record):
    a, b = PAD_TOPICS[PADS[0]], PAD_TOPICS[PADS[3]]
    usual, faulty = record(), record(swap_pads=(PADS[0], PADS[3]))
    assert np.array_equal(faulty.counts(a), usual.counts(b))
    assert np.array_equal(faulty.counts(b), usual.counts(a))


def test_drift_raises_the_baseline_by_so_many_counts_per_second(record):
    faulty, usual, topic = record(baseline_drift_counts_per_s=4.0), record(), PAD_TOPICS[PADS[0]]
    risen = (faulty.counts(topic) - usual.counts(topic)).mean(axis=(1, 2))
    slope = np.polyfit(usual.truth.sampled_s[topic], risen, 1)[0]
    assert slope == pytest.approx(4.0, abs=0.05)


def test_noise_only_touch_never_leaves_the_baseline(record):
    faulty = record(noise_only_touch=True)
    assert faulty.truth.contact_s == {"left": [], "right": []}
    for pad, topic in PAD_TOPICS.items():
        assert np.abs(faulty.counts(topic) - faulty.truth.baseline_counts[pad]).max() < 8.5  # 6 σ + rounding


def test_tactile_lag_delays_touch_by_that_much(record):
    usual, late = record(), record(tactile_lag_s=0.2)
    for pad, topic in PAD_TOPICS.items():
        arm = pad.split("_")[0]
        assert late.truth.contact_s[arm][0][0] - usual.truth.contact_s[arm][0][0] == pytest.approx(0.2)
        total = usual.counts(topic).sum(axis=(1, 2)), late.counts(topic).sum(axis=(1, 2))
        shifts = np.arange(0, 40)  # frames of 10 ms
        error = [np.mean((total[1][40:] - total[0][40 - s : len(total[0]) - s]) ** 2) for s in shifts]
        assert shifts[np.argmin(error)] == 20


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"gap": ("/camera_f/colour", 0.0, 1.0)}, "gap has '/camera_f/colour'"),
        ({"frozen_camera": "frond"}, "did you mean 'front'"),
        ({"swap_pads": ("left_robot_left_finger", "left_pad")}, "swap_pads has 'left_pad'"),
        ({"outcomes": ("won",)}, "known: discard, failure, success"),
        ({"encoding": "cdr"}, "encoding has 'cdr'"),
        ({"episodes": 4}, "leave 1.5 s each"),
        ({"camera_size": (16, 64)}, "no room for the frame id"),
    ],
)
def test_a_configuration_that_cannot_be_obeyed_is_refused(wrong, message):
    with pytest.raises(TaccorlError, match=message):
        StandInConfig(**wrong)
