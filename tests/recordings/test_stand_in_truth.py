"""The story is consistent: joints inside their limits, the arms behind their commands, touch behind the grip."""

import numpy as np
import pytest

from taccorl.surrogate.drivers import COMMAND_TOPICS, PAD_TOPICS, PADS, PIPER_RAD_PER_DEG, STATE_TOPICS
from tests.recordings.stand_in import JOINT_LIMITS_RAD
from tests.recordings.story import GRIPPER_OPEN_M, PART_WIDTH_M, Story, plan_episodes

RAD_AS_PUBLISHED = PIPER_RAD_PER_DEG / np.radians(1)


def _story(seed: int = 0, duration_s: float = 6.0, episodes: int = 1, lead_s: float = 0.08) -> Story:
    plans = plan_episodes(duration_s, episodes, ("success", "failure"), seed)
    return Story(plans, duration_s, command_lead_s=lead_s, contact_delay_s=0.03, seed=seed)


@pytest.mark.parametrize("seed", range(5))
def test_joints_and_commands_stay_inside_their_limits(seed):
    story = _story(seed, duration_s=24.0, episodes=4)
    time_s = np.arange(0, 24.0, 0.005)
    for values in (story.state(time_s), story.command(time_s)):
        for first in (0, 7):
            joints, gripper_m = values[:, first : first + 6], values[:, first + 6]
            assert np.all((joints >= JOINT_LIMITS_RAD[:, 0]) & (joints <= JOINT_LIMITS_RAD[:, 1]))
            assert gripper_m.min() >= 0.0
            assert gripper_m.max() <= 0.070  # PiPER's stroke


def test_velocity_is_the_rate_of_the_state():
    story, step_s = _story(), 0.002
    time_s = np.arange(0.5, 5.5, step_s)
    joints = [0, 1, 2, 4, 5, 7, 8, 9, 11, 12]
    rate = (story.state(time_s + step_s) - story.state(time_s - step_s)) / (2 * step_s)
    assert story.velocity(time_s)[:, joints] == pytest.approx(rate[:, joints], abs=0.02)


@pytest.mark.parametrize("lead_s", [0.08, 0.15])
def test_commands_lead_states_by_the_stated_lag(lead_s):
    """A first-order lag τ delays motion of frequency ω by atan(ωτ)/ω: τ for slow, at most 12 % less for this motion."""
    story, time_s, shifts_s = _story(lead_s=lead_s), np.arange(0.5, 5.5, 0.005), np.arange(0.0, 0.3, 0.002)
    for joint in (0, 1, 2, 7, 8, 9):
        error = [np.mean((story.command(time_s - s)[:, joint] - story.state(time_s)[:, joint]) ** 2) for s in shifts_s]
        assert shifts_s[np.argmin(error)] == pytest.approx(0.94 * lead_s, rel=0.06)
        behind = story.command(time_s)[:, joint] - story.state(time_s)[:, joint]
        assert behind == pytest.approx(lead_s * story.velocity(time_s)[:, joint], abs=1e-6)


def test_published_lag_is_the_true_one(record):
    recorded = record()
    for arm in ("left", "right"):
        stamps_s = recorded.stamps_s(COMMAND_TOPICS[arm])[10:]
        command = recorded.positions(COMMAND_TOPICS[arm])[10:, 1]
        time_s = np.arange(0.4, 2.9, 0.005)
        state = np.interp(time_s, recorded.stamps_s(STATE_TOPICS[arm]), recorded.positions(STATE_TOPICS[arm])[:, 1])
        shifts_s = np.arange(0.0, 0.2, 0.005)
        error = [np.mean((np.interp(time_s - s, stamps_s, command) - state) ** 2) for s in shifts_s]
        assert shifts_s[np.argmin(error)] == pytest.approx(0.08, abs=0.015)


def test_published_positions_carry_the_drivers_factor(record):
    recorded = record()
    for a, arm in enumerate(("left", "right")):
        stamps_s = recorded.stamps_s(STATE_TOPICS[arm])
        truth = recorded.truth.story.state(stamps_s)[:, 7 * a : 7 * a + 7]
        published = recorded.positions(STATE_TOPICS[arm])
        can_step_rad = np.radians(0.001)
        assert published[:, :6] == pytest.approx(truth[:, :6] * RAD_AS_PUBLISHED, abs=can_step_rad)
        assert published[:, 6] == pytest.approx(truth[:, 6], abs=1e-6)


def test_touch_begins_30_ms_after_the_fingers_stop_and_only_while_they_are_closed():
    story = _story(duration_s=12.0, episodes=2)
    for a, arm in enumerate(("left", "right")):
        time_s = np.arange(0, 12.0, 0.001)
        opening_m = story.state(time_s)[:, 7 * a + 6]
        assert len(story.contact_s(arm)) == 2
        for plan, (begin_s, end_s) in zip(story.plans, story.contact_s(arm), strict=True):
            inside = (time_s > begin_s) & (time_s < end_s - 0.035)
            assert opening_m[inside] == pytest.approx(PART_WIDTH_M[arm])
            before = (time_s > plan.start_s) & (time_s < begin_s)
            stopped_s = time_s[before & (opening_m <= PART_WIDTH_M[arm] + 1e-9)].min()
            assert begin_s - stopped_s == pytest.approx(0.03, abs=0.003)
        grip = story.grip(arm, time_s)
        touched = np.any([(time_s > a) & (time_s < b) for a, b in story.contact_s(arm)], axis=0)
        assert np.all(grip[~touched] <= 1e-9)
        assert 0.9 < grip.max() <= 1.0
        assert opening_m.max() == pytest.approx(GRIPPER_OPEN_M)


@pytest.mark.parametrize("duration_s", [2.0, 6.0])
def test_nothing_touches_in_the_first_half_second_of_an_episode(duration_s):
    story = _story(duration_s=2 * duration_s, episodes=2)
    for arm in ("left", "right"):
        for plan, (begin_s, _) in zip(story.plans, story.contact_s(arm), strict=True):
            assert begin_s - plan.start_s >= 0.5


def test_pads_read_baseline_without_touch_and_more_with_it(record):
    recorded = record()
    for pad, topic in PAD_TOPICS.items():
        counts, time_s = recorded.counts(topic), recorded.truth.sampled_s[topic]
        (begin_s, end_s), baseline = recorded.truth.contact_s[pad.split("_")[0]][0], recorded.truth.baseline_counts[pad]
        assert baseline.min() >= 10
        assert baseline.max() <= 40
        away = (time_s < begin_s - 0.01) | (time_s > end_s + 0.01)
        assert np.abs(counts[away].mean(axis=0) - baseline).max() < 0.6  # 1.3 counts of noise, ≥ 100 frames
        held = (time_s > begin_s + 0.3) & (time_s < end_s - 0.3)
        above = (counts - baseline)[held]
        assert above.max(axis=(1, 2)).min() > 60
        assert counts.max() < 255


def test_first_counts_appear_where_the_truth_says(record):
    """Pads and grippers carry times good enough to find a clock error: the rise is seen within three frames of contact."""
    recorded = record()
    for pad, topic in PAD_TOPICS.items():
        above = recorded.counts(topic) - recorded.truth.baseline_counts[pad]
        begin_s = recorded.truth.contact_s[pad.split("_")[0]][0][0]
        first_s = recorded.truth.sampled_s[topic][np.argmax(np.sort(above.reshape(len(above), -1))[:, -5] > 8)]
        assert 0.0 <= first_s - begin_s <= 0.035


def test_facing_pads_see_mirror_images():
    story, time_s = _story(), np.array([2.6, 3.5, 4.3])
    for arm in ("left", "right"):
        left, right = (story.clean_counts(f"{arm}_robot_{side}_finger", time_s) for side in ("left", "right"))
        assert left.max() > 50
        assert np.array_equal(left, right[:, ::-1])


def test_rows_are_scanned_one_after_the_other():
    """Each row of a rolling scan is the same row of a picture taken at that row's time."""
    story, pad = _story(), PADS[2]
    row_time_s = 2.60 + 0.010 * (np.arange(12) + 0.5) / 12
    scanned = story.clean_counts(pad, row_time_s[None])[0]
    for row in range(12):
        assert scanned[row] == pytest.approx(story.clean_counts(pad, row_time_s[row : row + 1])[0, row])


def test_insertion_moves_the_footprint_and_a_miss_presses_harder():
    hit, miss = (Story(plan_episodes(6.0, 1, (outcome,), 0), 6.0, 0.08, 0.03, 0) for outcome in ("success", "failure"))
    for story, harder in ((hit, 1.0), (miss, 1.1)):
        before, pushed = story.clean_counts(PADS[2], np.array([3.9, 4.55]))
        assert np.abs(pushed - before).max() > 30 * harder
    released_s = hit.contact_s("right")[0][1]
    late = np.array([released_s - 0.2])
    assert miss.clean_counts(PADS[2], late).max() > hit.clean_counts(PADS[2], late).max()
