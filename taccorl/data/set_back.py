"""Clocks that were set back while a recording was made: found in the order of the file, before anything is sorted.

A computer that sets its clock (NTP, PTP) gives a stretch of time twice. Sorted by time, the two would become one. The parts
before and after are put one after the other instead, with a gap, so that the recording is cut there.
"""

from dataclasses import dataclass

import numpy as np

from taccorl.data.timing import NS_PER_S, runs
from taccorl.errors import RecordingError

LEAST_LATE = 3
"""Fewest samples in a row, all older than one before them, that show a clock which was set back: one or two are swapped."""
FAR_BACK_S = 1.0
"""Smallest backward step of the time stamps [s] that counts as a clock set back. Smaller steps are messages out of order."""
SAME_STEP_S = 0.1
"""Largest accepted difference between the channels' measures of one step [s], besides two periods of each."""


@dataclass(frozen=True)
class Stream:
    """Times of one channel's N samples in the order of the file, those with a stamp of 0 left out."""

    topic: str
    time_ns: np.ndarray
    """(N,) int64 times on the clock that the spec chose [ns]."""
    log_ns: np.ndarray
    """(N,) int64 log times [ns]."""
    place: np.ndarray
    """(N,) int64 number of each message in the file."""
    values: np.ndarray | None = None
    """(N, size) numbers; None for pictures."""

    @property
    def period_ns(self) -> float:
        """Median interval between its samples [ns]; infinite with fewer than two."""
        steps = np.diff(self.time_ns)
        return float(np.median(steps[steps > 0])) if (steps > 0).any() else float("inf")


@dataclass(frozen=True)
class SetBack:
    """One step back of the recording's clock."""

    places: dict[str, int]
    """Channel → number of its first message after the step; of every channel that has one."""
    place: int
    """Number of the first of all messages after the step."""
    by_s: float
    end_ns: int
    """Time of the last sample before the step [ns], with the parts put one after the other."""
    start_ns: int
    """Time of the first sample after the backward step [ns], on the same clock as ``end_ns``."""
    shift_ns: int
    """Time that is added to all samples from here to the next step [ns]."""

    def first(self, channel: str) -> int:
        """Number of the channel's first message after the step."""
        return self.places.get(channel, self.place)


def steps_back(time_ns: np.ndarray, log_ns: np.ndarray, values: np.ndarray | None = None) -> list[int]:
    """Indices of the first samples after a clock was set back, for times (N,) int64 [ns] in the order of the file.

    Messages that come late fill a gap, and a message that is sent again repeats stamp and values: both are no steps.

    Args:
        log_ns: (N,) log times [ns], which go on where messages are sent again.
        values: (N, size) numbers of the messages; None: unknown.
    """
    found: list[int] = []
    first = 0
    while True:
        part = time_ns[first:]
        highest = np.maximum.accumulate(part)
        late = np.concatenate([[False], part[1:] < highest[:-1]]) if len(part) else np.empty(0, dtype=bool)
        candidates = [(a, b) for a, b in runs(late) if b - a >= LEAST_LATE and _is_step(part, highest, a, b)]
        sent_again = (_sent_again(time_ns[: first + b], log_ns, values, first + a) for a, b in candidates)
        step = next((a for (a, _), again in zip(candidates, sent_again, strict=True) if not again), None)
        if step is None:
            return found
        first += step
        found.append(first)


def _sent_again(time_ns: np.ndarray, log_ns: np.ndarray, values: np.ndarray | None, start: int) -> bool:
    """Whether the samples from ``start`` on repeat stamps and values of earlier ones, while their log times go on."""
    late, before = time_ns[start:], time_ns[:start]
    if values is None or (np.diff(log_ns[start - 1 : len(time_ns)]) < 0).any() or not np.isin(late, before).all():
        return False
    by_time = np.argsort(before, kind="stable")
    first = by_time[np.searchsorted(before[by_time], late)]
    return bool(np.array_equal(values[first], values[start : len(time_ns)]))


def _is_step(time_ns: np.ndarray, highest: np.ndarray, start: int, end: int) -> bool:
    """Whether the late samples from ``start`` to ``end`` follow a step of the clock; ``highest``: running maximum."""
    late, before = time_ns[start:end], time_ns[:start]
    if late.min() < before[0] and before[-1] - late[0] >= FAR_BACK_S * NS_PER_S:
        return True
    twice = np.searchsorted(highest[:start], late.max(), side="right") - np.searchsorted(highest[:start], late.min())
    return bool(2 * twice >= end - start)


def find_set_backs(streams: dict[str, Stream], gap_ns: int) -> list[SetBack]:
    """Where the clock of all channels was set back, in the order of the file.

    Args:
        streams: channel → its times.
        gap_ns: time that is put between the parts.

    Raises:
        RecordingError: only some channels' clocks were set back, or only that of the headers.
    """
    steps = {name: steps_back(s.time_ns, s.log_ns, s.values) for name, s in streams.items()}
    shift = {name: np.zeros(len(s.time_ns), dtype=np.int64) for name, s in streams.items()}
    found: list[SetBack] = []
    for k in range(max(map(len, steps.values()), default=0)):
        own = {name: at[k] for name, at in steps.items() if k < len(at)}
        by_s = {name: _by_s(streams[name], i) for name, i in own.items()}
        place = min(int(streams[name].place[i]) for name, i in own.items())
        _check_one_clock(streams, own, by_s, place)
        places = {name: int(streams[name].place[i]) for name, i in own.items()}
        after = {name: s.place >= places.get(name, place) for name, s in streams.items()}
        end_ns = max(int((s.time_ns + shift[n])[~after[n]].max()) for n, s in streams.items() if not after[n].all())
        begin_ns = min(int(s.time_ns[after[n]].min()) for n, s in streams.items() if after[n].any())
        shift_ns = end_ns - begin_ns + gap_ns
        for name in streams:
            shift[name][after[name]] = shift_ns
        found.append(
            SetBack(places, place, float(np.median(list(by_s.values()))), end_ns, begin_ns + shift_ns, shift_ns)
        )
    return found


def _by_s(s: Stream, i: int) -> float:
    """Size of the step before sample ``i`` [s]: one period would have passed without it."""
    return (float(s.time_ns[i - 1] - s.time_ns[i]) + s.period_ns) / NS_PER_S


def _check_one_clock(streams: dict[str, Stream], own: dict[str, int], by_s: dict[str, float], place: int) -> None:
    """Raises RecordingError: channels that could show the step do not, or the log times go on."""
    name, i = min(own.items(), key=lambda item: streams[item[0]].place[item[1]])
    back_s, s = by_s[name], streams[name]
    same = {n for n in own if abs(by_s[n] - back_s) <= SAME_STEP_S + 2 * streams[n].period_ns / NS_PER_S}
    others = [
        n
        for n, other in streams.items()
        if n not in same
        and LEAST_LATE * other.period_ns < back_s * NS_PER_S
        and (other.place < place).sum() >= LEAST_LATE
        and (other.place >= place).sum() >= LEAST_LATE
    ]
    log_goes_on = [n for n in same if streams[n].log_ns[own[n]] >= streams[n].log_ns[own[n] - 1]]
    if not others and not log_goes_on:
        return
    topics = ", ".join(sorted({streams[n].topic for n in (same if others else log_goes_on)}))
    whose = (
        f"while that of {', '.join(sorted({streams[n].topic for n in others}))} was not"
        if others
        else "in mid-recording"
    )
    after_s = float(s.time_ns[i - 1] - s.time_ns[0]) / NS_PER_S
    way_out = (
        "its log times go on: `clock: log` on its channels uses those"
        if log_goes_on
        else "which of its times are right is unknown: record again with one clock, or cut the file there"
    )
    raise RecordingError(
        f"the clock of {topics} was set back by {back_s:.3f} s, {after_s:.3f} s after its first message (its message {i}), "
        f"{whose}: {way_out}"
    )
