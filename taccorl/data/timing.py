"""Align channels with different clocks to one grid of rows: the clock of each channel, and the sample that each row shows.

Pure functions on int64 nanoseconds. No observation uses a later sample. ``action`` is no observation: its samples are matched
with the times of the following rows (``next_rows``). A row without a fresh sample is stale; stale rows are never filled or
deleted: the episode is split there.
"""

from dataclasses import dataclass

import numpy as np

from taccorl.data.spec import Align
from taccorl.errors import RecordingError

NS_PER_S = 1_000_000_000  # Nanoseconds in a second
MOST_S = (
    9e9  # Largest time stamp [s], of the year 2255: what int64 holds in nanoseconds
)
SIM_TIME_S = 1e6  # Least difference of two clocks [s] that is no wrong setting: one counts from a simulation's start


@dataclass(frozen=True)
class ClockReading:
    """One channel's times on the clock that its spec chose. N samples kept, in time order."""

    time_ns: np.ndarray
    """(N,) int64, strictly increasing; latency subtracted."""
    order: np.ndarray
    """(N,) index of each kept sample among the channel's messages."""
    skew_s: float
    """Median of log time − event time on the header clock, event time being stamp − latency; 0 on the log clock."""
    duplicates: int
    out_of_order: int
    zero_stamps: int


def read_clock(
    log_ns: np.ndarray,
    stamp_ns: np.ndarray | None,
    *,
    clock: str,
    latency_s: float = 0.0,
    drop_zero_stamp: bool = False,
) -> ClockReading:
    """Sorted times of a channel's samples: log times (M,) [ns] or header stamps (M,) [ns], as ``clock`` says, minus ``latency_s``
    (from the event to its stamp). Of samples at one time the first is kept; ``drop_zero_stamp`` drops those stamped 0."""
    by_header = clock == "header" and stamp_ns is not None
    assert clock == "log" or by_header, (
        "load_recording refuses a header clock without headers"
    )
    keep = (
        stamp_ns != 0
        if drop_zero_stamp and stamp_ns is not None
        else np.ones(len(log_ns), dtype=bool)
    )
    index = np.flatnonzero(keep)
    time_ns = (stamp_ns if by_header and stamp_ns is not None else log_ns)[index]
    skewed = by_header and len(index)
    skew_s = (
        float(np.median(log_ns[index] - time_ns)) / NS_PER_S + latency_s
        if skewed
        else 0.0
    )
    by_time = np.argsort(time_ns, kind="stable")
    kept = time_ns[by_time]
    first = np.diff(kept, prepend=kept[:1] - 1) > 0
    late, twice, zero = (
        int((np.diff(time_ns) < 0).sum()),
        int((~first).sum()),
        int((~keep).sum()),
    )
    return ClockReading(
        kept[first] - round(latency_s * NS_PER_S),
        index[by_time][first],
        skew_s,
        twice,
        late,
        zero,
    )


def check_stamps(stamps_s: np.ndarray, what: str, way_out: str) -> None:
    """Raise a RecordingError if a time of ``stamps_s`` (T,) [s] is NaN, infinite or beyond ``MOST_S``: "``what`` of row 7 is nan:
    ``way_out``"."""
    possible = np.abs(stamps_s) <= MOST_S
    if not possible.all():
        row = int(np.argmin(possible))
        raise RecordingError(f"{what} of row {row} is {stamps_s[row]:g}: {way_out}")


def check_clocks(skew_s: dict[str, float], max_spread_s: float) -> None:
    """Check that all channels are on one clock. ``skew_s``: topic → ``ClockReading.skew_s``. Raises RecordingError: two
    channels' clocks differ by more than ``max_spread_s``."""
    ranked = sorted(skew_s.items(), key=lambda item: item[1])
    if not ranked or ranked[-1][1] - ranked[0][1] <= max_spread_s:
        return
    # Parted at the widest step, the smaller group is the odd one; of equal groups the one further from log time.
    cut = int(np.argmax(np.diff([skew for _, skew in ranked]))) + 1
    halves = [
        (group, float(np.median([skew for _, skew in group])))
        for group in (ranked[:cut], ranked[cut:])
    ]
    (odd, off_s), (_, usual_s) = sorted(
        halves, key=lambda half: (len(half[0]), -abs(half[1]))
    )
    if abs(off_s - usual_s) > SIM_TIME_S:
        sim, sim_s = max(halves, key=lambda half: abs(half[1]))
        text = f"stamps of {', '.join(topic for topic, _ in sim)} are {sim_s:.6g} s behind their log time (simulation "
        raise RecordingError(
            f"{text}time?), others are not: set `clock: log`, or give all a header clock"
        )
    text = f"stamps of {', '.join(topic for topic, _ in odd)} are {abs(off_s - usual_s):.3f} s "
    text += f"{'behind' if off_s > usual_s else 'ahead of'} the other channels' (`max_clock_spread_s` allows "
    text += f"{max_spread_s:g} s): if constant, add {usual_s - off_s:.3f} to their `latency_s`, else set `clock: log`"
    raise RecordingError(text)


def make_grid(start_ns: int, end_ns: int, fps: int) -> np.ndarray:
    """(T,) int64 row times [ns] from ``start_ns`` at ``fps``, the last one at or before ``end_ns``. No drift: each is rounded
    alone."""
    if end_ns < start_ns:
        return np.empty(0, dtype=np.int64)
    # Row k is at k / fps rounded to a nanosecond: it may lie up to half a nanosecond before k / fps.
    half = fps // 2
    num_rows = ((end_ns - start_ns + 1) * fps - half - 1) // NS_PER_S + 1
    return start_ns + (np.arange(num_rows, dtype=np.int64) * NS_PER_S + half) // fps


def next_rows(grid_ns: np.ndarray, fps: int) -> np.ndarray:
    """(T,) int64 times [ns] of the rows that follow those of ``grid_ns`` (T,), which is from ``make_grid``."""
    if len(grid_ns) == 0:
        return grid_ns
    return np.append(
        grid_ns[1:], grid_ns[0] + (len(grid_ns) * NS_PER_S + fps // 2) // fps
    )


@dataclass(frozen=True)
class Matched:
    """Indices of the samples of one channel that each row shows. T rows, L history."""

    index: np.ndarray
    """(T, L) sample index, oldest first; −1 where the row has none."""
    age_s: np.ndarray
    """(T,) row time − time of the newest sample that is used [s]; inf if there is no sample."""
    fresh: np.ndarray
    """(T,) bool: False for a stale row, which has no sample within the accepted age."""


def match(
    grid_ns: np.ndarray,
    time_ns: np.ndarray,
    align: Align,
    *,
    max_age_s: float | None = None,
    history: int = 1,
    rate_hz: float = 0.0,
) -> Matched:
    """Find the samples of one channel, at strictly increasing times (N,), for every row of ``grid_ns`` (T,), by ``align``:
    ``hold`` the last sample, however old (a command stays in force); ``asof`` the last sample, stale beyond ``max_age_s``;
    ``window`` the last ``history`` samples at the channel's own rate, stale unless the newest is within max_age_s and the oldest
    within max_age_s + (history − 1) / ``rate_hz``.
    """
    if len(time_ns) == 0:
        none, index = (
            np.zeros(len(grid_ns)),
            np.full((len(grid_ns), history if align == "window" else 1), -1),
        )
        return Matched(index, none + np.inf, none > 0)
    last = np.searchsorted(time_ns, grid_ns, side="right") - 1
    has, safe = last >= 0, np.maximum(last, 0)
    index = np.where(has, last, -1)[:, None]
    age_s = np.where(has, (grid_ns - time_ns[safe]) / NS_PER_S, np.inf)
    if align == "hold":
        return Matched(index, age_s, has)
    assert max_age_s is not None, "the spec demands max_age_s for every align but hold"
    fresh = has & (age_s <= max_age_s)
    if align == "asof":
        return Matched(index, age_s, fresh)
    oldest = last - history + 1
    span_s = np.where(
        oldest >= 0, (grid_ns - time_ns[np.maximum(oldest, 0)]) / NS_PER_S, np.inf
    )
    fresh &= (oldest >= 0) & (span_s <= max_age_s + (history - 1) / rate_hz)
    index = last[:, None] + np.arange(1 - history, 1)
    return Matched(np.where(oldest[:, None] >= 0, index, -1), age_s, fresh)


def runs(fresh: np.ndarray) -> list[tuple[int, int]]:
    """First index and last index + 1 of every run of True in ``fresh`` (T,) bool."""
    edges = np.flatnonzero(
        np.diff(np.concatenate(([False], fresh, [False])).astype(np.int8))
    )
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def repeated(values: np.ndarray) -> np.ndarray:
    """(T,) bool: rows of ``values`` (T, …) that equal the row before them."""
    same = (np.diff(values, axis=0) == 0).all(axis=tuple(range(1, values.ndim)))
    return np.concatenate([[False], same])


def stretches(same: np.ndarray, fps: int, least_s: float) -> list[tuple[int, int]]:
    """First row and last row + 1 of every stretch of ``least_s`` seconds or more in which ``same`` (T,) bool, the result of
    ``repeated``, says that nothing changes."""
    return [
        (first - 1, end)
        for first, end in runs(same)
        if (end - first + 1) / fps >= least_s
    ]


def longest(found: list[tuple[int, int]]) -> tuple[int, int]:
    """The longest of these row ranges."""
    return max(found, key=lambda rows: rows[1] - rows[0])


# ---- clocks that were set back ----
# A computer that sets its clock (NTP, PTP) gives a stretch of time twice. Sorted by time, the two would become one, so the step
# is found in the order of the file. The parts are put one after the other, with a gap: the recording is cut there.

LEAST_LATE = 3
"""Fewest samples in a row, older than one before them, that show a set-back clock: one or two are swapped."""
FAR_BACK_S = 1.0  # Smallest backward step [s] that counts as a clock set back; smaller ones are messages out of order
SAME_STEP_S = 0.1  # Largest difference between the channels' measures of one step [s], besides two periods of each


@dataclass(frozen=True)
class Stream:
    """Times of one channel's N samples in the order of the file, those with a stamp of 0 left out."""

    topic: str
    time_ns: np.ndarray
    """(N,) int64 times on the clock that the spec chose [ns]; ``log_ns``: (N,) int64 log times [ns]."""
    log_ns: np.ndarray
    place: np.ndarray
    """(N,) int64 number of each message in the file."""
    values: np.ndarray | None = None
    """(N, size) numbers; None for pictures."""

    @property
    def period_ns(self) -> float:
        """Median time between successive samples of the channel [ns]; infinite with fewer than two samples."""
        steps = np.diff(self.time_ns)
        return float(np.median(steps[steps > 0])) if (steps > 0).any() else float("inf")


@dataclass(frozen=True)
class SetBack:
    """One step back of the recording's clock."""

    places: dict[str, int]
    """Channel → number of its first message after the step; of every channel that has one. ``place``: of the first of all."""
    place: int
    by_s: float
    end_ns: int
    """Times of the last sample before the step and the first one after it [ns], with the parts put one after the other."""
    start_ns: int
    shift_ns: int
    """Time that is added to all samples from here to the next step [ns]."""


def steps_back(
    time_ns: np.ndarray, log_ns: np.ndarray, values: np.ndarray | None = None
) -> list[int]:
    """Indices of the first samples after a clock was set back, for times (N,) int64 [ns] in the order of the file; ``log_ns``
    (N,) go on where messages are sent again, and ``values`` (N, size) are the same then. Messages that come late fill a gap, and
    a message that is sent again repeats stamp and values: both are no steps."""
    found: list[int] = []
    first = 0
    while True:
        part = time_ns[first:]
        highest = np.maximum.accumulate(part)
        late = (
            np.concatenate([[False], part[1:] < highest[:-1]])
            if len(part)
            else np.empty(0, dtype=bool)
        )
        candidates = [
            (a, b)
            for a, b in runs(late)
            if b - a >= LEAST_LATE and _is_step(part, highest, a, b)
        ]
        new = (
            a
            for a, b in candidates
            if not _sent_again(time_ns[: first + b], log_ns, values, first + a)
        )
        if (step := next(new, None)) is None:
            return found
        first += step
        found.append(first)


def _sent_again(
    time_ns: np.ndarray, log_ns: np.ndarray, values: np.ndarray | None, start: int
) -> bool:
    """Whether the samples from ``start`` on repeat stamps and values of earlier ones, while their log times go on."""
    late, before = time_ns[start:], time_ns[:start]
    if (
        values is None
        or (np.diff(log_ns[start - 1 : len(time_ns)]) < 0).any()
        or not np.isin(late, before).all()
    ):
        return False
    by_time = np.argsort(before, kind="stable")
    first = by_time[np.searchsorted(before[by_time], late)]
    return bool(np.array_equal(values[first], values[start : len(time_ns)]))


def _is_step(time_ns: np.ndarray, highest: np.ndarray, start: int, end: int) -> bool:
    """Whether the late samples from ``start`` to ``end`` follow a step of the clock; ``highest``: running maximum."""
    late, before = time_ns[start:end], time_ns[:start]
    if late.min() < before[0] and before[-1] - late[0] >= FAR_BACK_S * NS_PER_S:
        return True
    twice = np.searchsorted(
        highest[:start], late.max(), side="right"
    ) - np.searchsorted(highest[:start], late.min())
    return bool(2 * twice >= end - start)


def find_set_backs(streams: dict[str, Stream], gap_ns: int) -> list[SetBack]:
    """Where the clock of all channels was set back, in the order of the file. ``streams``: channel → its times. ``gap_ns``:
    time that is put between the parts. Raises RecordingError: only some channels' clocks were set back, or only that of the
    headers."""
    steps = {
        name: steps_back(s.time_ns, s.log_ns, s.values) for name, s in streams.items()
    }
    shift = {
        name: np.zeros(len(s.time_ns), dtype=np.int64) for name, s in streams.items()
    }
    found: list[SetBack] = []
    for k in range(max(map(len, steps.values()), default=0)):
        own = {name: at[k] for name, at in steps.items() if k < len(at)}
        places = {name: int(streams[name].place[i]) for name, i in own.items()}
        place = min(places.values())
        # one period would have passed without the step
        back_ns = {
            n: float(streams[n].time_ns[i - 1] - streams[n].time_ns[i])
            + streams[n].period_ns
            for n, i in own.items()
        }
        by_s = {name: ns / NS_PER_S for name, ns in back_ns.items()}
        _check_one_clock(streams, own, by_s, place)
        after = {
            name: s.place >= places.get(name, place) for name, s in streams.items()
        }
        end_ns = max(
            int((s.time_ns + shift[n])[~after[n]].max())
            for n, s in streams.items()
            if not after[n].all()
        )
        begin_ns = min(
            int(s.time_ns[after[n]].min()) for n, s in streams.items() if after[n].any()
        )
        shift_ns = end_ns - begin_ns + gap_ns
        for name in streams:
            shift[name][after[name]] = shift_ns
        found.append(
            SetBack(
                places,
                place,
                float(np.median([*by_s.values()])),
                end_ns,
                begin_ns + shift_ns,
                shift_ns,
            )
        )
    return found


def _check_one_clock(
    streams: dict[str, Stream], own: dict[str, int], by_s: dict[str, float], place: int
) -> None:
    """Raises RecordingError: channels that could show the step do not, or the log times go on."""
    name, i = min(own.items(), key=lambda item: streams[item[0]].place[item[1]])
    back_s, s = by_s[name], streams[name]
    same = {
        n
        for n in own
        if abs(by_s[n] - back_s) <= SAME_STEP_S + 2 * streams[n].period_ns / NS_PER_S
    }
    could_show = [
        n
        for n, other in streams.items()
        if LEAST_LATE * other.period_ns < back_s * NS_PER_S
    ]
    parts = {
        n: (
            int((streams[n].place < place).sum()),
            int((streams[n].place >= place).sum()),
        )
        for n in could_show
    }
    others = [n for n in could_show if n not in same and min(parts[n]) >= LEAST_LATE]
    log_goes_on = [
        n for n in same if streams[n].log_ns[own[n]] >= streams[n].log_ns[own[n] - 1]
    ]
    if not others and not log_goes_on:
        return
    topics = ", ".join(
        sorted({streams[n].topic for n in (same if others else log_goes_on)})
    )
    steady = ", ".join(sorted({streams[n].topic for n in others}))
    text = f"the clock of {topics} was set back by {back_s:.3f} s, "
    text += f"{float(s.time_ns[i - 1] - s.time_ns[0]) / NS_PER_S:.3f} s after its first message (its message {i}), "
    text += f"{f'while that of {steady} was not' if others else 'in mid-recording'}: "
    way_out = "which of its times are right is unknown: record again with one clock, or cut the file there"
    way_out = (
        "its log times go on: `clock: log` on its channels uses those"
        if log_goes_on
        else way_out
    )
    raise RecordingError(text + way_out)
