"""Stand-in recordings cut into episodes: every row shows what truly was, and nothing is lost without a word."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited import (
    NATIVE,
    SIZE,
    Raw,
    changed_specs,
    garbled,
    read_raw,
    rewrite,
    with_markers,
)

from taccorl.data import cutting
from taccorl.data.cutting import Cut, Cutter, Unfit, open_episodes
from taccorl.data.episode import Episode
from taccorl.data.origin import Origin
from taccorl.data.recording import find_sources, opened
from taccorl.data.spec import RecordingSpec, load_recording_spec
from taccorl.errors import RecordingError
from taccorl.surrogate.drivers import (
    CAMERA_TOPICS,
    COMMAND_TOPICS,
    EPISODE_TOPIC,
    PAD_TOPICS,
    START_UNIX_NS,
    STATE_TOPICS,
)
from tests.recordings.pictures import read_frame_id
from tests.recordings.stand_in import StandInConfig, write_mcap

FPS = 30
STATE, ACTION, TOUCH, WINDOW = (
    "observation.state",
    "action",
    "observation.tactile",
    "observation.tactile_window",
)
PAD_LATENCY_S = 0.010  # of the shipped spec
# The dataset's pad order, and the driver's name of each.
PAD_ORDER = {
    "left_a": "left_robot_left_finger",
    "left_b": "left_robot_right_finger",
    "right_a": "right_robot_left_finger",
    "right_b": "right_robot_right_finger",
}
FRONT, LEFT = CAMERA_TOPICS["front"], CAMERA_TOPICS["left_wrist"]


class Made:
    """A recording and its truth."""

    def __init__(self, path: Path, **config: Any) -> None:
        self.path = path
        self.truth = write_mcap(
            path, StandInConfig(**({"duration_s": 3.0, "camera_size": SIZE} | config))
        )

    def sample_ns(self, topic: str, log_clock: bool = False) -> np.ndarray:
        """(N,) when each message's content was, as its own clock says; log clock: less the pads' latency."""
        times_s = (
            self.truth.log_s[topic] - PAD_LATENCY_S
            if log_clock
            else self.truth.sampled_s[topic]
        )
        return START_UNIX_NS + np.round(times_s * 1e9).astype(np.int64)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return Made(tmp_path_factory.mktemp("made") / "recording.mcap")


@pytest.fixture(scope="module")
def native(tmp_path_factory: pytest.TempPathFactory) -> RecordingSpec:
    """The shipped spec with pictures at the camera's own size, so that frame ids can be read."""
    return load_recording_spec(changed_specs(tmp_path_factory.mktemp("native"), NATIVE))


@contextmanager
def cutter(
    path: Path, spec: str | Path | RecordingSpec = "piper_flexitac_mcap"
) -> Iterator[Cutter]:
    loaded = spec if isinstance(spec, RecordingSpec) else load_recording_spec(spec)
    with opened(find_sources(path)[0][1], loaded) as recording:
        yield Cutter(recording)


def cut(path: Path, spec: str | Path | RecordingSpec = "piper_flexitac_mcap") -> Cut:
    """For its numbers and losses; pictures need the recording open."""
    with cutter(path, spec) as open_cutter:
        return open_cutter.cut()


def row_ns(episode: Episode) -> np.ndarray:
    """(T,) row times, counted here without taccorl.data.timing."""
    return episode.start_ns + np.array(
        [(2 * k * 10**9 + FPS) // (2 * FPS) for k in range(episode.num_rows)]
    )


def next_row_ns(episode: Episode) -> np.ndarray:
    """(T,) time of the row after each row."""
    return episode.start_ns + np.array(
        [(2 * k * 10**9 + FPS) // (2 * FPS) for k in range(1, episode.num_rows + 1)]
    )


def newest(times_ns: np.ndarray, rows_ns: np.ndarray) -> np.ndarray:
    """(T,) index of the first among the newest samples at or before each row; by plain search."""
    return np.array(
        [
            int(np.flatnonzero(times_ns == times_ns[times_ns <= t].max())[0])
            for t in rows_ns
        ]
    )


def frame_ids(episode: Episode, camera: str = "front") -> np.ndarray:
    return np.array(
        [
            read_frame_id(shown[f"observation.images.{camera}"])
            for shown in episode.pictures()
        ]
    )


def lost_rows(found: Cut) -> int:
    """Rows between the first and last time of each loss, both included."""
    return sum(round((loss.end_s - loss.start_s) * FPS) + 1 for loss in found.losses)


# ---- rows show what truly was ----


def test_state_and_action_are_the_truth_at_the_newest_samples_time(made):
    [episode] = cut(made.path).episodes
    rows = row_ns(episode)
    for key, topics, truth in (
        (STATE, STATE_TOPICS, partial(made.truth.story.at, "state")),
        (ACTION, COMMAND_TOPICS, partial(made.truth.story.at, "command")),
    ):
        for arm, columns in (("left", slice(0, 7)), ("right", slice(7, 14))):
            samples = made.sample_ns(topics[arm])
            # the action of row t: the last command before row t + 1
            due = rows if key == STATE else next_row_ns(episode)
            shown_s = (samples[newest(samples, due)] - START_UNIX_NS) * 1e-9
            error = np.abs(episode.arrays[key] - truth(shown_s))[:, columns]
            # CAN counts are 0.001° (half of it: 8.7e-6 rad) and 0.001 mm; float32 at 2.5 rad adds 1.2e-7.
            # The driver's wrong factor, not undone, would leave 5.3e-4 × 2 rad = 1e-3.
            assert error[:, :6].max() < 9e-6 and error[:, 6].max() < 6e-7
    assert np.ptp(episode.arrays[STATE][:, 1]) > 0.3, "the arm does move"


def test_rows_begin_at_the_start_marker_and_end_at_the_end_marker(made):
    [episode] = cut(made.path).episodes
    start_s = (episode.start_ns - START_UNIX_NS) * 1e-9
    end_s = start_s + (episode.num_rows - 1) / FPS
    # Markers are logged at 0.1 and 2.9 s; brought to the header clock by the median skew (joints: 1.2 ms and a bit).
    assert start_s == pytest.approx(0.1 - 0.0015, abs=0.0006)
    assert end_s == pytest.approx(2.9 - 0.0015, abs=0.0006)
    assert episode.num_rows == 85  # 2.8 s, both ends on a row
    assert (episode.instruction, episode.success) == (
        "insert the test tube into the rack",
        True,
    )
    assert episode.origin == Origin("surrogate", "stand-in recording, not a robot")


def test_touch_is_the_recorded_count_minus_the_median_of_the_first_30_frames(made):
    [episode] = cut(made.path).episodes
    messages = read_raw(made.path)
    touch = episode.arrays[TOUCH].reshape(-1, 4, 32, 12)
    assert touch.dtype == np.int16
    for p, pad in enumerate(PAD_ORDER.values()):
        frames = np.array(
            [
                np.frombuffer(m.data[-384:], np.uint8)
                for m in messages
                if m.topic == PAD_TOPICS[pad]
            ]
        )
        wire = frames.reshape(-1, 12, 32).astype(
            int
        )  # 12 rows of 32 columns on the wire
        baseline = np.round(np.median(wire[:30], axis=0)).astype(int)
        shown = newest(made.sample_ns(PAD_TOPICS[pad], log_clock=True), row_ns(episode))
        expected = (wire[shown] - baseline).transpose(0, 2, 1)
        np.testing.assert_array_equal(touch[:, p], expected)
        np.testing.assert_array_equal(
            episode.baselines[TOUCH].reshape(4, 32, 12)[p], baseline.T
        )
        np.testing.assert_array_equal(episode.pads(TOUCH)[list(PAD_ORDER)[p]], expected)


def test_every_row_shows_the_newest_picture_at_or_before_it(made, native):
    with cutter(made.path, native) as open_cutter:
        [episode] = open_cutter.cut().episodes
        for camera, topic in CAMERA_TOPICS.items():
            expected = made.truth.frame_ids[camera][
                newest(made.sample_ns(topic), row_ns(episode))
            ]
            np.testing.assert_array_equal(frame_ids(episode, camera), expected)


def test_no_row_depends_on_what_comes_after_it(made, tmp_path):
    """``by: whole_file``: the grid begins at the last channel's first sample, which no later message moves."""
    whole = (
        "episodes: {by: markers, topic: /episode, min_s: 1.0}",
        "episodes: {by: whole_file, min_s: 1.0}",
    )
    said = ("instruction: {from: markers}", "instruction: {from: spec, text: touch it}")
    window = ("# observation.tactile_window:", "observation.tactile_window:")
    spec = load_recording_spec(
        changed_specs(tmp_path / "specs", NATIVE, whole, said, window)
    )
    other = Made(tmp_path / "other.mcap", seed=5)
    change_s = 1.5

    def splice(messages: list[Raw]) -> list[Raw]:
        return [m for m in messages if m.time_s <= change_s] + [
            m for m in read_raw(other.path) if m.time_s > change_s
        ]

    spliced = rewrite(made.path, tmp_path / "spliced.mcap", splice)
    with cutter(made.path, spec) as a, cutter(spliced, spec) as b:
        one, two = a.cut().episodes[0], b.cut().episodes[0]
        assert one.start_ns == two.start_ns
        early = int(((row_ns(one) - START_UNIX_NS) * 1e-9 <= change_s).sum())
        for key in (STATE, ACTION, TOUCH, WINDOW):
            same = early - (key == ACTION)  # an action is what is sent from its row on
            np.testing.assert_array_equal(
                one.arrays[key][:same], two.arrays[key][:same], err_msg=key
            )
            assert (
                one.arrays[key][same : same + 5] != two.arrays[key][same : same + 5]
            ).any(), key
        for row, (x, y) in enumerate(zip(one.pictures(), two.pictures(), strict=False)):
            for key in x:
                assert row >= early or (x[key] == y[key]).all(), (row, key)


def test_window_holds_exactly_the_last_ten_frames_of_each_pad(made, tmp_path):
    window = ("# observation.tactile_window:", "observation.tactile_window:")
    [episode] = cut(made.path, changed_specs(tmp_path, window)).episodes
    windows = episode.arrays[WINDOW].reshape(-1, 10, 4, 32, 12)
    np.testing.assert_array_equal(
        windows[:, -1].reshape(len(windows), -1), episode.arrays[TOUCH]
    )
    messages = read_raw(made.path)
    for p, pad in enumerate(PAD_ORDER.values()):
        wire = np.array(
            [
                np.frombuffer(m.data[-384:], np.uint8)
                for m in messages
                if m.topic == PAD_TOPICS[pad]
            ]
        )
        wire = wire.reshape(-1, 12, 32).astype(int)
        counts = (wire - np.round(np.median(wire[:30], axis=0)).astype(int)).transpose(
            0, 2, 1
        )
        last = newest(made.sample_ns(PAD_TOPICS[pad], log_clock=True), row_ns(episode))
        for row, k in enumerate(last):
            np.testing.assert_array_equal(windows[row, :, p], counts[k - 9 : k + 1])
    # ten readings of 10 ms each begin 0.1 s after the pads, where the marker already was
    assert (episode.start_ns - START_UNIX_NS) * 1e-9 == pytest.approx(0.1, abs=0.02)


# ---- gaps ----


def test_a_silent_camera_splits_exactly_there_and_losses_add_up(tmp_path, native):
    made = Made(
        tmp_path / "gap.mcap",
        duration_s=4.0,
        gap=(LEFT, 1.6, 2.1),
        camera_loss_probability=0.0,
    )
    found = cut(made.path, native)
    whole = Made(tmp_path / "whole.mcap", duration_s=4.0, camera_loss_probability=0.0)
    [uncut] = cut(whole.path, native).episodes
    samples = made.sample_ns(LEFT)
    rows = row_ns(uncut)
    age_s = (rows - samples[newest(samples, rows)]) * 1e-9
    fresh = age_s <= 0.08  # the spec's max_age_s
    edges = np.flatnonzero(np.diff(fresh.astype(int))) + 1
    assert len(edges) == 2, "one stale stretch"
    assert [e.num_rows for e in found.episodes] == [edges[0], len(rows) - edges[1]]
    assert [e.start_ns for e in found.episodes] == [rows[0], rows[edges[1]]]
    [loss] = found.losses
    assert "left_wrist" in loss.reason
    assert loss.start_s == pytest.approx(
        (rows[edges[0]] - found.origin_ns) * 1e-9, abs=0.001
    )
    assert sum(e.num_rows for e in found.episodes) + lost_rows(found) == len(rows)
    assert [e.name.split()[-1] for e in found.episodes] == ["0", "1"]


@pytest.mark.parametrize(
    ("outcome", "gap_s", "successes"),
    [
        ("success", (1.6, 2.1), [None, True]),
        pytest.param("failure", (1.6, 2.1), [None, False], marks=pytest.mark.slow),
        # The end marker is at 3.9 s. A channel without samples from 3.2 s on ends 0.7 s before it, one from 3.75 s on 0.15 s.
        pytest.param("success", (3.2, 9.0), [None], marks=pytest.mark.slow),
        ("success", (3.75, 9.0), [True]),
        (
            "success",
            (3.0, 3.5),
            [None],
        ),  # what follows the gap is shorter than a second
    ],
)
def test_only_the_part_with_the_episodes_end_carries_its_outcome(
    tmp_path, outcome, gap_s, successes
):
    gap = (LEFT, *gap_s)
    made = Made(
        tmp_path / "a.mcap",
        duration_s=4.0,
        outcomes=(outcome,),
        gap=gap,
        camera_loss_probability=0.0,
    )
    assert [e.success for e in cut(made.path).episodes] == successes


def test_pieces_shorter_than_min_s_are_reported_and_not_written(made, tmp_path):
    # fresh from 0.1 s, stale from 0.7 + 0.08 − one frame: 0.65 s, under the spec's 1 s; then 2.9 − 1.2 = 1.7 s
    found = cut(Made(tmp_path / "early.mcap", gap=(FRONT, 0.7, 1.2)).path)
    [episode] = found.episodes
    assert episode.num_rows / FPS == pytest.approx(1.7, abs=0.1)
    assert sorted("min_s 1" in loss.reason for loss in found.losses) == [False, True]
    [uncut] = cut(made.path).episodes
    assert episode.num_rows + lost_rows(found) == uncut.num_rows


def test_silence_of_several_channels_at_once_is_one_loss_that_names_them(tmp_path):
    pad = PAD_TOPICS["left_robot_left_finger"]
    made = Made(
        tmp_path / "both.mcap", duration_s=4.0, gap=[(FRONT, 1.6, 2.2), (pad, 1.7, 2.1)]
    )
    [loss] = cut(made.path).losses
    assert "front" in loss.reason and "left_a" in loss.reason


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))]
)
def test_random_gaps_never_lose_a_row_unsaid(tmp_path, seed):
    topics = [FRONT, LEFT, PAD_TOPICS["right_robot_left_finger"], STATE_TOPICS["left"]]
    rng = np.random.default_rng(seed)
    gaps = [
        (str(rng.choice(topics)), a, a + rng.uniform(0.02, 0.3))
        for a in rng.uniform(0.3, 2.4, 4)
    ]
    made = Made(tmp_path / "gaps.mcap", gap=gaps, seed=seed)
    found = cut(made.path)
    [uncut] = cut(Made(tmp_path / "whole.mcap", seed=seed).path).episodes
    assert (
        sum(e.num_rows for e in found.episodes) + lost_rows(found) == uncut.num_rows
    ), gaps
    for episode in found.episodes:
        assert episode.num_rows / FPS >= 1.0
        assert max(t.age_max_s for t in episode.timing if t.channel == "front") <= 0.08


# ---- markers ----


def test_each_marked_episode_has_its_own_outcome_and_instruction(tmp_path):
    made = Made(tmp_path / "a.mcap", duration_s=6.0)
    marks = [
        (0.3, "start:pick it"),
        (1.8, "failure"),
        (2.0, "start: place it "),
        (3.4, "discard"),
    ]
    marks += [(3.6, "start:push it"), (5.5, "success")]
    found = cut(with_markers(made.path, tmp_path / "b.mcap", marks))
    assert [(e.instruction, e.success) for e in found.episodes] == [
        ("pick it", False),
        ("push it", True),
    ]
    assert [e.num_rows for e in found.episodes] == [
        45 + 1,
        57 + 1,
    ]  # 1.5 s and 1.9 s, both ends on a row
    [discarded] = found.losses
    assert not discarded.wanted
    assert (discarded.start_s, discarded.end_s) == (
        pytest.approx(2.0, abs=0.01),
        pytest.approx(3.4, abs=0.01),
    )


@pytest.mark.parametrize(
    ("marks", "why", "num_rows"),
    [
        (
            [(0.3, "start:a"), (1.6, "start:b"), (2.8, "success")],
            "the next episode starts",
            [40, 37],
        ),
        (
            [(0.3, "start:a"), (1.5, "success"), (1.6, "start:b")],
            "the recording ends within",
            [37, None],
        ),
    ],
)
def test_a_missing_end_marker_is_reported_and_leaves_success_unknown(
    made, tmp_path, marks, why, num_rows
):
    found = cut(with_markers(made.path, tmp_path / "b.mcap", marks))
    assert len(found.episodes) == 2
    assert [e.success for e in found.episodes].count(None) == 1
    assert any(why in loss.reason for loss in found.losses)
    for episode, expected in zip(found.episodes, num_rows, strict=True):
        assert expected is None or episode.num_rows == expected


@pytest.mark.parametrize(
    ("marks", "words"),
    [
        ([(1.0, "success")], ("'success'", "without a start", EPISODE_TOPIC)),
        ([(0.3, "start:a"), (1.5, "succes")], ("unknown marker 'succes'", "failure")),
        ([(0.3, "start:"), (1.5, "success")], ("has no instruction",)),
        ([(0.3, "start"), (1.5, "success")], ("has no instruction",)),
        ([], ("without messages", EPISODE_TOPIC)),
    ],
)
def test_markers_that_make_no_sense_are_refused_with_a_word(
    made, tmp_path, marks, words
):
    path = with_markers(made.path, tmp_path / "b.mcap", marks)
    with pytest.raises(RecordingError) as error:
        cut(path)
    for word in words:
        assert word in str(error.value)


def test_an_episode_before_a_channel_began_is_a_loss_not_a_silence(tmp_path):
    made = Made(
        tmp_path / "late.mcap", duration_s=4.0, episodes=2, gap=(FRONT, 0.0, 2.0)
    )
    found = cut(made.path)
    assert [e.name.rsplit(" ", 2)[-2:] for e in found.episodes] == [["episode", "1"]]
    assert [loss.reason for loss in found.losses] == ["front begins late"]
    assert found.losses[0].end_s == pytest.approx(1.9, abs=0.02)


def test_a_held_command_that_ends_early_costs_nothing(tmp_path):
    topics = list(COMMAND_TOPICS.values())
    made = Made(tmp_path / "quiet.mcap", gap=[(topic, 1.5, 9.0) for topic in topics])
    hold = (
        "action:            {channels: [left_command, right_command], align: asof}",
    ) * 2
    hold = (hold[0], hold[0].replace("asof", "hold"))
    spec = changed_specs(tmp_path / "specs", hold, ("max_age_s: 0.1, drop", "drop"))
    found = cut(made.path, spec)
    assert found.losses == []
    [episode] = found.episodes
    assert episode.num_rows == 85
    last = made.truth.story.at("command", made.truth.sampled_s[topics[0]][-1:])[0, :7]
    np.testing.assert_allclose(episode.arrays[ACTION][-1, :7], last, atol=1e-5)


# ---- episodes and instructions from elsewhere ----

BY_METADATA = (
    "episodes: {by: markers, topic: /episode, min_s: 1.0}",
    "episodes: {by: metadata, min_s: 1.0}",
)
FROM_METADATA = (
    "instruction: {from: markers}",
    "instruction: {from: metadata, key: what}",
)


def _at(seconds: float) -> str:
    return str(START_UNIX_NS + round(seconds * 1e9))


def test_episodes_by_metadata(made, tmp_path):
    spec = changed_specs(tmp_path / "specs", BY_METADATA, FROM_METADATA)
    metadata = {
        "episode_b": {"start": _at(1.5), "end": _at(2.7), "success": "False"},
        "episode_a": {
            "start": _at(0.2),
            "end": _at(1.4),
            "instruction": "do a",
            "success": "true",
        },
        "session": {"what": "do it"},
    }
    path = rewrite(made.path, tmp_path / "b.mcap", lambda messages: messages, metadata)
    found = cut(path, spec)
    assert [(e.instruction, e.success, e.num_rows) for e in found.episodes] == [
        ("do a", True, 37),
        ("do it", False, 37),
    ]
    assert found.losses == []


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({"session": {"what": "x"}}, ("no metadata record episode_<id>", "session")),
        (
            {"episode_1": {"start": _at(0.2)}, "session": {"what": "x"}},
            ("episode_1", "does not state start and end"),
        ),
        (
            {"episode_1": {"start": _at(2.0), "end": _at(1.0), "what": "x"}},
            ("episode_1", "before it starts"),
        ),
        (
            {"episode_1": {"start": _at(0.2), "end": _at(2.0)}},
            ("no metadata key 'what'", "start"),
        ),
        (
            {"episode_1": {"start": _at(0.2), "end": _at(2.0), "what": " "}},
            ("no metadata key 'what'",),
        ),
    ],
)
def test_metadata_that_names_no_episode_is_refused_with_a_word(
    made, tmp_path, metadata, words
):
    spec = changed_specs(tmp_path / "specs", BY_METADATA, FROM_METADATA)
    path = rewrite(made.path, tmp_path / "b.mcap", lambda messages: messages, metadata)
    with pytest.raises(RecordingError) as error:
        cut(path, spec)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("texts", "instruction"),
    [
        (["lift it", " lift it "], "lift it"),
        (["lift it", "drop it"], None),
        ([" "], None),
    ],
)
def test_instruction_from_a_topic_must_be_one(made, tmp_path, texts, instruction):
    whole = (
        "episodes: {by: markers, topic: /episode, min_s: 1.0}",
        "episodes: {by: whole_file, min_s: 1.0}",
    )
    topic = (
        "instruction: {from: markers}",
        "instruction: {from: topic, topic: /episode}",
    )
    spec = changed_specs(tmp_path / "specs", whole, topic)
    path = with_markers(
        made.path,
        tmp_path / "b.mcap",
        [(0.5 + k, text) for k, text in enumerate(texts)],
    )
    if instruction is None:
        with pytest.raises(RecordingError, match="different instructions"):
            cut(path, spec)
    else:
        assert [e.instruction for e in cut(path, spec).episodes] == [instruction]


# ---- clocks ----


def test_repeated_and_zero_stamps_are_counted_and_never_shown(made):
    [episode] = cut(made.path).episodes
    for channel, topic in (
        ("left_state", STATE_TOPICS["left"]),
        ("left_command", COMMAND_TOPICS["left"]),
    ):
        [timing] = [t for t in episode.timing if t.channel == channel]
        stamps = made.truth.sampled_s[topic]
        silent = (
            8 if "command" in channel else 0
        )  # ticks 0 to 7 at 200 Hz lie before 0.04 s
        assert timing.zero_stamps == silent
        assert timing.duplicates == len(stamps[silent:]) - len(
            np.unique(stamps[silent:])
        )
        assert timing.duplicates > 3
    assert np.abs(episode.arrays[ACTION][0, 1]) > 0.1, (
        "not the zeros of a driver without a command"
    )


def test_zero_stamps_that_the_spec_does_not_expect_are_refused(made, tmp_path):
    with pytest.raises(
        RecordingError,
        match=r"/joint_states_ctrl_left: 8 of 600 messages are stamped 0.*drop_zero_stamp",
    ):
        cut(made.path, changed_specs(tmp_path, (", drop_zero_stamp: true", "")))


def test_latency_moves_a_camera_by_as_much(made, tmp_path):
    line = (
        "/camera_f/color/image_raw/compressed, type: sensor_msgs/msg/CompressedImage, "
    )
    spec = load_recording_spec(
        changed_specs(tmp_path, NATIVE, (line, line + "latency_s: 0.1, "))
    )
    with cutter(made.path, spec) as open_cutter:
        [episode] = open_cutter.cut().episodes
        samples = made.sample_ns(FRONT) - 100_000_000
        expected = made.truth.frame_ids["front"][newest(samples, row_ns(episode))]
        np.testing.assert_array_equal(frame_ids(episode), expected)
        [timing] = [t for t in episode.timing if t.channel == "front"]
        assert 0 <= timing.age_max_s <= 0.08


def _without_touch(folder: Path) -> Path:
    """A spec of joints and cameras alone: all of them have header stamps."""
    path = changed_specs(folder, NATIVE)
    lines = (
        path.read_text()
        .replace("../taccorl_bimanual.yaml", "../cobot_magic.yaml")
        .splitlines()
    )
    path.write_text(
        "\n".join(line for line in lines if not re.search(r"finger|tactile", line))
        + "\n"
    )
    return path


def test_simulation_time_on_every_channel_is_a_clock_like_any_other(made, tmp_path):
    spec = load_recording_spec(_without_touch(tmp_path / "specs"))
    sim = Made(tmp_path / "sim.mcap", sim_time_stamps=True)
    with cutter(made.path, spec) as wall, cutter(sim.path, spec) as simulated:
        [one], [two] = wall.cut().episodes, simulated.cut().episodes
        assert abs(one.start_ns - START_UNIX_NS - two.start_ns) < 1000
        np.testing.assert_array_equal(one.arrays[STATE], two.arrays[STATE])
        np.testing.assert_array_equal(frame_ids(one), frame_ids(two))


# ---- pictures ----


def test_many_broken_pictures_in_a_row_split_the_episode(tmp_path, native):
    made = Made(tmp_path / "a.mcap", duration_s=4.0)
    with cutter(
        garbled(made.path, tmp_path / "b.mcap", list(range(50, 60))), native
    ) as open_cutter:
        assert open_cutter.drop_broken_pictures() == 10
        found = open_cutter.cut()
        assert len(found.episodes) == 2
        [loss] = found.losses
        assert "front" in loss.reason
        assert (
            sum(e.num_rows for e in found.episodes) + lost_rows(found) == 115
        )  # 3.8 s
        for episode in found.episodes:
            assert not set(range(50, 60)) & set(frame_ids(episode))


def test_a_camera_without_one_sound_picture_is_refused(made, tmp_path):
    path = garbled(made.path, tmp_path / "b.mcap", list(range(200)))
    with (
        pytest.raises(
            RecordingError, match="a picture of format 'jpeg' that OpenCV cannot decode"
        ),
        cutter(path),
    ):
        pass


def test_cameras_one_after_the_other_in_the_file_give_the_same_rows(
    made, native, tmp_path, monkeypatch
):
    order = [*CAMERA_TOPICS.values()]

    def sort(messages: list[Raw]) -> list[Raw]:
        return sorted(
            messages,
            key=lambda m: order.index(m.topic) if m.topic in order else len(order),
        )

    path = rewrite(made.path, tmp_path / "sorted.mcap", sort)
    with cutter(made.path, native) as a, cutter(path, native) as b:
        [one], [two] = a.cut().episodes, b.cut().episodes
        for camera in CAMERA_TOPICS:
            np.testing.assert_array_equal(
                frame_ids(one, camera), frame_ids(two, camera)
            )
        monkeypatch.setattr(cutting, "MAX_WAITING_PICTURES", 100)
        with pytest.raises(RecordingError, match="cameras are not interleaved"):
            list(two.pictures())


# ---- baseline ----


def test_a_pad_touched_while_the_baseline_is_taken_is_unfit(tmp_path):
    made = Made(tmp_path / "a.mcap", duration_s=4.0)
    contact_s = made.truth.contact_s["left"][0][0]
    pad = PAD_TOPICS["left_robot_left_finger"]
    touched = Made(tmp_path / "b.mcap", duration_s=4.0, gap=(pad, 0.0, contact_s - 0.1))
    with pytest.raises(Unfit, match="touched while the baseline was recorded"):
        cut(touched.path)


# ---- for looking at ----


def test_open_episodes_of_a_folder_gives_all_recordings(made, tmp_path):
    for k in range(2):
        (tmp_path / f"{k}.mcap").write_bytes(made.path.read_bytes())
    with open_episodes(tmp_path, "piper_flexitac_mcap") as episodes:
        assert len(episodes) == 2
        assert next(iter(episodes[1].pictures()))["observation.images.front"].shape == (
            224,
            224,
            3,
        )


def test_open_episodes_of_a_recording_without_rows_says_why(tmp_path):
    path = with_markers(
        Made(tmp_path / "a.mcap").path,
        tmp_path / "b.mcap",
        [(0.5, "start:a"), (0.9, "success")],
    )
    with (
        pytest.raises(RecordingError, match="no episode: 13 rows are shorter"),
        open_episodes(path, "piper_flexitac_mcap"),
    ):
        pass
