"""A clock that is set back is found in the order of the file, before anything is sorted; late and repeated messages are not."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_arm import CAMERA, COMMAND, STATE, Sent, ingest, messages, motion, text, write_bag, write_mcap, write_spec

from taccorl.data.dataset import Dataset
from taccorl.data.timing import steps_back

MS = 1_000_000


def ms(*values: float) -> np.ndarray:
    return np.round(np.array(values) * MS).astype(np.int64)


@pytest.mark.parametrize(
    ("times_ms", "expected"),
    [
        ([0, 10, 20, 30, 40], []),
        ([0, 10, 30, 20, 40], []),  # swapped neighbours
        ([0, 10, 50, 60, 20, 30, 40, 70], []),  # a late batch: it fills the gap that it left
        ([0, 10, 20, 30, 40, 15, 25, 35, 45, 55], [5]),  # 35 ms back: 15 … 40 ms are there twice
        ([0, 10, 20, 30, 40, 10, 20, 30, 40, 50], [5]),  # by whole periods
        ([5000, 5010, 5020, 0, 10, 20, 30], [3]),  # back to before the start
        ([0, 10, 20, 30, 40, 10, 20, 30, 40, 15, 25, 35, 45], [5, 9]),  # twice
        ([0, 10, 20, 30, 5, 40, 50], []),  # one wrong stamp is no clock
    ],
)
def test_steps_are_told_from_late_messages(times_ms: list[float], expected: list[int]) -> None:
    times = ms(*times_ms)
    assert steps_back(times, times) == expected


def test_messages_sent_again_while_log_times_go_on_are_no_step() -> None:
    stamps = ms(0, 10, 20, 30, 40, 10, 20, 30, 40, 50)
    sent = np.array([0, 1, 2, 3, 4, 1, 2, 3, 4, 5.0])[:, None]
    assert steps_back(stamps, ms(*range(10)), sent) == []
    assert steps_back(stamps, ms(*range(10)), np.arange(10.0)[:, None]) == [5]  # other values: another time
    assert steps_back(stamps, stamps, sent) == [5]  # log times step, too


def test_random_jitter_and_swaps_are_never_a_step() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        times = np.arange(1000) * 10.0 + rng.uniform(-3, 3, 1000)
        at = rng.integers(0, 990, 20)
        times[at], times[at + 1] = times[at + 1], times[at]
        assert steps_back(ms(*times), ms(*times)) == []


def set_back(sent: list[Sent], at_s: float, by_s: float, only: str = "", *, log: bool = True) -> list[Sent]:
    """From ``at_s`` on all stamps (those of one topic) are ``by_s`` earlier."""
    return [m.later(-by_s, log=log) if m.time_s >= at_s and only in (m.topic, "") else m for m in sent]


def mcap(folder: Path, sent: list[Sent]) -> Path:
    return write_mcap(folder / "rec.mcap", sent)


WRITERS: dict[str, Callable[[Path, list[Sent]], Path]] = {
    "mcap": mcap,
    "db3": lambda folder, sent: write_bag(folder / "rec", sent, 2),
    "rosbag1": lambda folder, sent: write_bag(folder / "rec.bag", sent, 1),
}


STEPS = [("mcap", 1.5), ("mcap", 0.333), ("mcap", 6.0), ("db3", 1.5), ("rosbag1", 1.5)]
OF_LOG = [pytest.param("log", *step, marks=[pytest.mark.slow] * (k > 0)) for k, step in enumerate(STEPS)]


@pytest.mark.parametrize(("clock", "reader", "by_s"), [*(("header", *step) for step in STEPS), *OF_LOG])
def test_a_recording_is_cut_where_its_clock_was_set_back(tmp_path: Path, reader: str, by_s: float, clock: str) -> None:
    spec = write_spec(tmp_path, ("clock: header", f"clock: {clock}"), reader=reader)
    code, entry = ingest(WRITERS[reader](tmp_path, set_back(messages(), 2.0, by_s)), spec)
    assert (code, entry["outcome"]) == (0, "split")
    assert f"set back by {by_s:.3f} s" in entry["reason"]
    dataset = Dataset(tmp_path / "out")
    assert dataset.num_episodes == 2
    # every row shows the motion of its own part: 2 s each, less what is not common to all channels
    for index, (first_s, last_s) in enumerate([(0.0, 2.0), (2.0, 4.0)]):
        state = dataset.episode(index).arrays["observation.state"]
        assert len(state) + entry["rows_lost"] >= 59
        times_s = np.arange(int(first_s * 100), int(last_s * 100)) / 100
        truth = np.stack([motion(t) for t in times_s])
        nearest = np.abs(truth[:, None] - state[None]).max(axis=2)
        shown_s = times_s[nearest.argmin(axis=0)]
        assert nearest.min(axis=0).max() < 1e-6
        assert np.allclose(np.diff(shown_s), 1 / 30, atol=0.011)  # no time is missing, none is there twice
    assert entry["samples"]["state"] == {"messages": 400, "kept": 400}


def test_an_episode_between_markers_is_cut_and_its_outcome_is_that_of_the_end(tmp_path: Path) -> None:
    """By their log times alone, the end marker would come before the step, and 0.5 s after the start."""
    marks = [text("/episode", 0.5, "start:put it in"), text("/episode", 3.5, "success")]
    sent = sorted([*messages(), *marks], key=lambda m: m.log_ns)
    spec = write_spec(
        tmp_path,
        ("{by: whole_file, min_s: 0.5}", "{by: markers, topic: /episode, min_s: 0.5}"),
        ("{from: spec, text: put the cup on the plate}", "{from: markers}"),
    )
    _, entry = ingest(mcap(tmp_path, set_back(sent, 2.0, 1.5)), spec)
    assert entry["outcome"] == "split"
    assert [(e["success"], e["instruction"]) for e in entry["episodes"]] == [(None, "put it in"), (True, "put it in")]
    assert [e["rows"] for e in entry["episodes"]] == pytest.approx([45, 45], abs=2)


@pytest.mark.parametrize(
    ("only", "log", "named"),
    [
        (CAMERA, True, ("while that of /commands, /joint_states was not",)),
        (STATE, False, ("/joint_states", "clock: log")),
        ("", False, ("clock: log",)),
    ],
)
def test_a_clock_that_steps_alone_is_named(tmp_path: Path, only: str, log: bool, named: tuple[str, ...]) -> None:
    sent = set_back(messages(), 2.0, 1.5, only, log=log)
    code, entry = ingest(mcap(tmp_path, sent), write_spec(tmp_path))
    assert (code, entry["outcome"]) == (1, "refused")
    assert all(text in entry["reason"] for text in ("set back by 1.5", *named)), entry["reason"]


def test_swapped_neighbours_stay_sorted_and_are_counted(tmp_path: Path) -> None:
    sent = messages()
    states = [i for i, m in enumerate(sent) if m.topic == STATE]
    for k in (50, 120, 300):
        a, b = states[k : k + 2]
        sent[a], sent[b] = sent[b], sent[a]
    code, entry = ingest(mcap(tmp_path, sent), write_spec(tmp_path))
    assert (code, entry["outcome"], entry["rows_lost"]) == (0, "written", 0)
    (timing,) = [t for t in entry["episodes"][0]["timing"] if t["channel"] == "state"]
    assert timing["out_of_order"] == 3
    assert COMMAND in entry["messages"]
