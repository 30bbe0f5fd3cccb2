"""Clocks and alignment: closed-form examples, then jitter, loss and clocks set back. Above all: no row shows the future."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_arm import (
    CAMERA,
    COMMAND,
    STATE,
    Sent,
    ingest,
    messages,
    motion,
    text,
    write_bag,
    write_mcap,
    write_spec,
)

from taccorl.data.dataset import Dataset
from taccorl.data.timing import (
    check_clocks,
    make_grid,
    match,
    read_clock,
    runs,
    steps_back,
)
from taccorl.errors import RecordingError

S = 1_000_000_000
MS = 1_000_000
NOW = 1_700_000_000 * S  # a wall clock: large enough to lose digits in a float


def ns(*milliseconds: float) -> np.ndarray:
    return NOW + np.array([round(m * MS) for m in milliseconds], dtype=np.int64)


def jittery(
    rng: np.random.Generator, rate_hz: float, duration_s: float, loss: float = 0.1
) -> np.ndarray:
    """Sample times with ±40 % jitter, each lost with probability ``loss``; strictly increasing."""
    number = int(rate_hz * duration_s)
    times = NOW + (
        (np.arange(number) + rng.uniform(-0.4, 0.4, number)) * S / rate_hz
    ).astype(np.int64)
    return times[rng.random(number) >= loss]


# --- the grid


@pytest.mark.parametrize("fps", [7, 24, 30, 50, 60, 90, 100])
def test_grid_has_every_row_that_fits_and_no_other(fps):
    """Row k is at k / fps rounded to the nanosecond; an end on, just before and just after every one of them."""
    rows = [round(k * S / fps) for k in range(12)]
    for k, row in enumerate(rows[:-1]):
        assert make_grid(0, row, fps).tolist() == rows[: k + 1]
        assert make_grid(0, row + 1, fps).tolist() == rows[: k + 1]
        assert make_grid(0, row - 1, fps).tolist() == rows[:k]


def test_grid_does_not_drift_over_ten_hours():
    grid = make_grid(NOW, NOW + 36_000 * S, 30)
    assert len(grid) == 36_000 * 30 + 1
    assert (
        grid[-1] - NOW == 36_000 * S
    )  # a step of 33,333,333 ns added up would be 0.36 ms off
    assert (grid[::30] - NOW == np.arange(36_001) * S).all()
    exact = np.arange(len(grid)) * (S / 30)
    assert np.abs((grid - NOW) - exact).max() <= 0.5


# --- which sample a row shows


def test_asof_is_stale_beyond_max_age_and_not_at_it():
    m = match(ns(4, 5, 35, 36, 50), ns(5, 50), "asof", max_age_s=0.03)
    assert m.index[:, 0].tolist() == [-1, 0, 0, 0, 1] and m.fresh.tolist() == [
        False,
        True,
        True,
        False,
        True,
    ]
    assert m.age_s[1:].tolist() == [0.0, 0.03, 0.031, 0.0]


def test_window_is_stale_while_a_gap_lies_inside_it():
    """3 readings at 100 Hz span 20 ms; with max_age 5 ms the oldest may be 25 ms old."""
    samples = ns(0, 10, 20, 50, 60, 70)
    m = match(
        ns(20, 25, 26, 50, 60, 69, 70),
        samples,
        "window",
        max_age_s=0.005,
        history=3,
        rate_hz=100,
    )
    #               oldest 20 | 25 | newest 6 old | oldest 40 | oldest 40 | newest 9 old | oldest 20
    assert m.fresh.tolist() == [True, True, False, False, False, False, True]


@pytest.mark.parametrize("align", ["hold", "asof", "window"])
def test_without_samples_no_row_is_fresh_and_without_rows_there_is_nothing(align):
    m = match(
        ns(0, 10),
        np.empty(0, dtype=np.int64),
        align,
        max_age_s=1.0,
        history=3,
        rate_hz=100,
    )
    assert not m.fresh.any() and (m.index == -1).all()
    assert m.index.shape == (2, 3 if align == "window" else 1)
    assert np.isinf(m.age_s).all()
    m = match(
        np.empty(0, dtype=np.int64),
        ns(0, 10),
        align,
        max_age_s=1.0,
        history=3,
        rate_hz=100,
    )
    assert len(m.index) == len(m.age_s) == len(m.fresh) == 0


OPTIONS = {"max_age_s": 0.04, "history": 5, "rate_hz": 100.0}


def shown(
    grid: np.ndarray, times: np.ndarray, values: np.ndarray, align: str
) -> list[tuple[float, ...] | None]:
    """What every row shows, None where it is stale."""
    m = match(grid, times, align, **OPTIONS)  # pyright: ignore[reportArgumentType]
    return [tuple(values[m.index[k]]) if m.fresh[k] else None for k in range(len(grid))]


# --- where an episode splits


def test_runs_are_the_stretches_of_true():
    assert runs(np.array([], dtype=bool)) == []
    assert runs(np.array([False, False])) == []
    assert runs(np.array([True, True])) == [(0, 2)]
    assert runs(np.array([False, True, False, True, True])) == [(1, 2), (3, 5)]


# --- which clock a channel keeps


def test_header_clock_takes_the_stamps_and_log_clock_the_log_times():
    log, stamp = ns(5, 15, 25), ns(0, 10, 20)
    header = read_clock(log, stamp, clock="header")
    assert header.time_ns.tolist() == stamp.tolist()
    assert header.skew_s == 0.005
    on_log = read_clock(log, stamp, clock="log")
    assert on_log.time_ns.tolist() == log.tolist()
    assert on_log.skew_s == 0.0
    assert read_clock(log, None, clock="log").time_ns.tolist() == log.tolist()


def test_a_header_clock_without_headers_is_never_replaced_in_silence():
    with pytest.raises(AssertionError, match="header clock without headers"):
        read_clock(ns(0), None, clock="header")


def test_order_duplicates_and_zero_stamps_are_counted_and_nothing_else_is_lost():
    stamp = np.array([0, *ns(0, 10, 10, 30, 20, 30, 40), 0])
    log = ns(1, 2, 12, 13, 32, 33, 34, 42, 43)
    c = read_clock(log, stamp, clock="header", drop_zero_stamp=True)
    assert c.time_ns.tolist() == ns(0, 10, 20, 30, 40).tolist()
    assert c.order.tolist() == [
        1,
        2,
        5,
        4,
        7,
    ]  # of equal stamps the first message counts
    assert (c.zero_stamps, c.duplicates, c.out_of_order) == (2, 2, 1)
    assert len(c.time_ns) + c.zero_stamps + c.duplicates == len(stamp)
    kept = read_clock(log, stamp, clock="header")
    assert (kept.zero_stamps, kept.duplicates) == (0, 3)
    assert kept.time_ns[0] == 0


def test_nothing_left_is_an_empty_clock():
    c = read_clock(
        ns(0, 1), np.zeros(2, dtype=np.int64), clock="header", drop_zero_stamp=True
    )
    assert len(c.time_ns) == 0
    assert (c.zero_stamps, c.skew_s) == (2, 0.0)


def test_times_keep_their_nanoseconds():
    """Wall-clock nanoseconds do not fit a float64: 256 ns would be lost."""
    stamp = NOW + np.array([1, 2, 3], dtype=np.int64)
    assert read_clock(stamp, stamp, clock="header").time_ns.tolist() == [
        NOW + 1,
        NOW + 2,
        NOW + 3,
    ]
    assert match(np.array([NOW + 2]), stamp, "asof", max_age_s=1.0).index[0, 0] == 1


# --- are all channels on one clock?

USUAL = {
    "/joints_left": 0.001,
    "/joints_right": 0.0012,
    "/camera_f": 0.030,
    "/camera_l": 0.032,
    "/pad_a": 0.009,
    "/pad_b": 0.0,
}


@pytest.mark.parametrize(
    ("skews", "named"),
    [
        (USUAL, ""),
        ({}, ""),
        ({"/alone": 1e9}, ""),  # alone, even simulation time is one clock
        ({"/a": 0.0, "/b": 0.25}, ""),
        ({"/a": 0.0, "/b": 0.2500001}, "/b are 0.250 s behind the other channels'"),
        # evo's nav2_turtlebot.mcap: log time − stamp
        (
            {**USUAL, "/odom": 1_778_233_424.927},
            "/odom are 1.77823e+09 s behind their log time (simulation time?)",
        ),
        (
            {"/joints": 1.7e9, "/camera": 1.7e9 + 0.02, "/pad": 0.0},
            "/joints, /camera are 1.7e+09 s behind",
        ),
        (
            {"/joints": 0.002, "/pad": 0.382},
            "/pad are 0.380 s behind",
        ),  # of two, the one further from log time
        ({"/joints": 0.002, "/pad": -0.378}, "/pad are 0.380 s ahead of"),
    ],
)
def test_channels_on_another_clock_are_named(skews: dict[str, float], named: str):
    if not named:
        check_clocks(skews, 0.25)
        return
    with pytest.raises(RecordingError) as caught:
        check_clocks(skews, 0.25)
    assert str(caught.value).startswith(f"stamps of {named}")
    assert "simulation time" not in named or "`clock: log`" in str(caught.value)


@pytest.mark.parametrize(
    ("offset", "word", "advice"),
    [(0.38, "behind", "add -0.380"), (-0.38, "ahead of", "add 0.380")],
)
def test_an_offset_of_380_ms_is_named_and_the_advice_mends_it(offset, word, advice):
    """Two logging processes 0.38 s apart, as measured on the velostat recordings."""
    skews = {
        "/joints": 0.001,
        "/camera": 0.001,
        "/pad_a": 0.001 + offset,
        "/pad_b": 0.001 + offset,
    }
    skews["/camera_l"] = 0.001
    with pytest.raises(RecordingError) as caught:
        check_clocks(skews, 0.25)
    message = str(caught.value)
    assert message.startswith(
        f"stamps of /pad_a, /pad_b are 0.380 s {word} the other channels'"
    )
    assert f"{advice} to their `latency_s`" in message
    assert "max_clock_spread_s" in message

    log = ns(*range(0, 100, 10))
    latency_s = float(message.split("add ")[1].split(" ")[0])
    mended = {t: read_clock(log, log - round(s * S), clock="header", latency_s=latency_s if "pad" in t else 0.0).skew_s
              for t, s in skews.items()}  # fmt: skip
    check_clocks(mended, 0.25)
    assert max(mended.values()) - min(mended.values()) < 1e-9


def test_skew_is_a_median_and_forgives_a_few_late_messages():
    stamp = ns(*range(0, 1000, 10))
    log = stamp + 10 * MS
    log[::10] += 2 * S  # the recorder hiccuped
    assert read_clock(log, stamp, clock="header").skew_s == 0.01


def ms(*values: float) -> np.ndarray:
    return np.round(np.array(values) * MS).astype(np.int64)


@pytest.mark.parametrize(
    ("times_ms", "expected"),
    [
        ([0, 10, 20, 30, 40], []),
        ([0, 10, 30, 20, 40], []),  # swapped neighbours
        (
            [0, 10, 50, 60, 20, 30, 40, 70],
            [],
        ),  # a late batch: it fills the gap that it left
        (
            [0, 10, 20, 30, 40, 15, 25, 35, 45, 55],
            [5],
        ),  # 35 ms back: 15 … 40 ms are there twice
        ([0, 10, 20, 30, 40, 10, 20, 30, 40, 50], [5]),  # by whole periods
        ([5000, 5010, 5020, 0, 10, 20, 30], [3]),  # back to before the start
        ([0, 10, 20, 30, 40, 10, 20, 30, 40, 15, 25, 35, 45], [5, 9]),  # twice
        ([0, 10, 20, 30, 5, 40, 50], []),  # one wrong stamp is no clock
    ],
)
def test_steps_are_told_from_late_messages(
    times_ms: list[float], expected: list[int]
) -> None:
    times = ms(*times_ms)
    assert steps_back(times, times) == expected


def test_messages_sent_again_while_log_times_go_on_are_no_step() -> None:
    stamps = ms(0, 10, 20, 30, 40, 10, 20, 30, 40, 50)
    sent = np.array([0, 1, 2, 3, 4, 1, 2, 3, 4, 5.0])[:, None]
    assert steps_back(stamps, ms(*range(10)), sent) == []
    assert steps_back(stamps, ms(*range(10)), np.arange(10.0)[:, None]) == [
        5
    ]  # other values: another time
    assert steps_back(stamps, stamps, sent) == [5]  # log times step, too


def test_random_jitter_and_swaps_are_never_a_step() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        times = np.arange(1000) * 10.0 + rng.uniform(-3, 3, 1000)
        at = rng.integers(0, 990, 20)
        times[at], times[at + 1] = times[at + 1], times[at]
        assert steps_back(ms(*times), ms(*times)) == []


def set_back(
    sent: list[Sent], at_s: float, by_s: float, only: str = "", *, log: bool = True
) -> list[Sent]:
    """From ``at_s`` on all stamps (those of one topic) are ``by_s`` earlier."""
    return [
        m.later(-by_s, log=log) if m.time_s >= at_s and only in (m.topic, "") else m
        for m in sent
    ]


def mcap(folder: Path, sent: list[Sent]) -> Path:
    return write_mcap(folder / "rec.mcap", sent)


WRITERS: dict[str, Callable[[Path, list[Sent]], Path]] = {
    "mcap": mcap,
    "db3": lambda folder, sent: write_bag(folder / "rec", sent, 2),
    "rosbag1": lambda folder, sent: write_bag(folder / "rec.bag", sent, 1),
}


STEPS = [("mcap", 1.5), ("mcap", 0.333), ("mcap", 6.0), ("db3", 1.5), ("rosbag1", 1.5)]
OF_LOG = [
    pytest.param("log", *step, marks=[pytest.mark.slow] * (k > 0))
    for k, step in enumerate(STEPS)
]


@pytest.mark.parametrize(
    ("clock", "reader", "by_s"), [*(("header", *step) for step in STEPS), *OF_LOG]
)
def test_a_recording_is_cut_where_its_clock_was_set_back(
    tmp_path: Path, reader: str, by_s: float, clock: str
) -> None:
    spec = write_spec(tmp_path, ("clock: header", f"clock: {clock}"), reader=reader)
    code, entry = ingest(
        WRITERS[reader](tmp_path, set_back(messages(), 2.0, by_s)), spec
    )
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
        assert np.allclose(
            np.diff(shown_s), 1 / 30, atol=0.011
        )  # no time is missing, none is there twice
    assert entry["samples"]["state"] == {"messages": 400, "kept": 400}


def test_an_episode_between_markers_is_cut_and_its_outcome_is_that_of_the_end(
    tmp_path: Path,
) -> None:
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
    assert [(e["success"], e["instruction"]) for e in entry["episodes"]] == [
        (None, "put it in"),
        (True, "put it in"),
    ]
    assert [e["rows"] for e in entry["episodes"]] == pytest.approx([45, 45], abs=2)


@pytest.mark.parametrize(
    ("only", "log", "named"),
    [
        (CAMERA, True, ("while that of /commands, /joint_states was not",)),
        (STATE, False, ("/joint_states", "clock: log")),
        ("", False, ("clock: log",)),
    ],
)
def test_a_clock_that_steps_alone_is_named(
    tmp_path: Path, only: str, log: bool, named: tuple[str, ...]
) -> None:
    sent = set_back(messages(), 2.0, 1.5, only, log=log)
    code, entry = ingest(mcap(tmp_path, sent), write_spec(tmp_path))
    assert (code, entry["outcome"]) == (1, "refused")
    assert all(text in entry["reason"] for text in ("set back by 1.5", *named)), entry[
        "reason"
    ]


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
