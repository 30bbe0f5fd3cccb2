"""Align channels with different clocks to one grid of rows: the clock of each channel, and the sample that each row shows.

Pure functions on int64 nanoseconds. No observation uses a later sample: ``hold``, ``asof`` and ``window`` use nothing after the
row's time, and ``interpolate`` (for offline study) looks ahead to one next sample, within the channel's max_age_s, and reports a
negative age. ``action`` is no observation: its samples are matched with the times of the following rows (``next_rows``). A row
without a fresh sample is stale; stale rows are never filled or deleted: the episode is split there.
"""

from dataclasses import dataclass

import numpy as np

from taccorl.data.spec import Align
from taccorl.errors import RecordingError

NS_PER_S = 1_000_000_000  # Nanoseconds in a second
SIM_TIME_S = 1e6
"""Least difference of two clocks [s] that cannot be a wrong setting: one of them counts from the start of a simulation."""


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
    """Number of samples that repeat the time of an earlier one."""
    out_of_order: int
    """Number of samples that are older than the one before them in the file."""
    zero_stamps: int
    """Number of messages that were dropped because their stamp is 0."""


def read_clock(
    log_ns: np.ndarray,
    stamp_ns: np.ndarray | None,
    *,
    clock: str,
    latency_s: float = 0.0,
    drop_zero_stamp: bool = False,
) -> ClockReading:
    """A channel's own times: chosen clock, minus latency, sorted; repeated times keep their first sample.

    Args:
        log_ns: (M,) when each message was recorded [ns].
        stamp_ns: (M,) header stamps [ns], or None where messages have none.
        clock: ``log`` or ``header``.
        latency_s: time from the event to its stamp [s].
        drop_zero_stamp: leave out messages whose stamp is 0.
    """
    assert clock == "log" or stamp_ns is not None, "load_recording refuses a header clock without headers"
    time_ns = log_ns if clock == "log" or stamp_ns is None else stamp_ns
    keep = np.ones(len(time_ns), dtype=bool)
    if drop_zero_stamp and stamp_ns is not None:
        keep = stamp_ns != 0
    zero_stamps = int((~keep).sum())
    index = np.flatnonzero(keep)
    kept = time_ns[index]
    skew_s = 0.0
    if clock == "header" and stamp_ns is not None and len(index):
        skew_s = float(np.median(log_ns[index] - stamp_ns[index])) / NS_PER_S + latency_s
    out_of_order = int((np.diff(kept) < 0).sum())
    by_time = np.argsort(kept, kind="stable")
    kept, index = kept[by_time], index[by_time]
    first = np.ones(len(kept), dtype=bool)
    first[1:] = np.diff(kept) > 0
    return ClockReading(
        time_ns=kept[first] - round(latency_s * NS_PER_S),
        order=index[first],
        skew_s=skew_s,
        duplicates=int((~first).sum()),
        out_of_order=out_of_order,
        zero_stamps=zero_stamps,
    )


def check_clocks(skew_s: dict[str, float], max_spread_s: float) -> None:
    """Check that all channels are on one clock. ``skew_s``: topic → ``ClockReading.skew_s``. Raises RecordingError: two
    channels' clocks differ by more than ``max_spread_s``."""
    ranked = sorted(skew_s.items(), key=lambda item: item[1])
    if not ranked or ranked[-1][1] - ranked[0][1] <= max_spread_s:
        return
    # Parted at the widest step, the smaller group is the odd one; of equal groups the one further from log time.
    cut = int(np.argmax(np.diff([skew for _, skew in ranked]))) + 1
    halves = [(group, float(np.median([skew for _, skew in group]))) for group in (ranked[:cut], ranked[cut:])]
    (odd, off_s), (_, usual_s) = sorted(halves, key=lambda half: (len(half[0]), -abs(half[1])))
    if abs(off_s - usual_s) > SIM_TIME_S:
        sim, sim_s = max(halves, key=lambda half: abs(half[1]))
        raise RecordingError(
            f"stamps of {', '.join(topic for topic, _ in sim)} are {sim_s:.6g} s behind their log time (simulation time?) "
            f"while other channels are on the log clock: set `clock: log` for the recording, or give every channel a "
            f"header clock"
        )
    raise RecordingError(
        f"stamps of {', '.join(topic for topic, _ in odd)} are {abs(off_s - usual_s):.3f} s "
        f"{'behind' if off_s > usual_s else 'ahead of'} the other channels' (log time − stamp: {off_s:.3f} s against "
        f"{usual_s:.3f} s, `max_clock_spread_s` allows {max_spread_s:g} s): if this difference is constant, add "
        f"{usual_s - off_s:.3f} to their `latency_s`, else set `clock: log`, and correct the recorder's clock"
    )


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
    """(T,) int64 times [ns] of the rows that follow those of ``grid_ns`` (T,), which is from ``make_grid``: entry t is the time
    of row t + 1; the last one is where another row would be."""
    if len(grid_ns) == 0:
        return grid_ns
    return np.append(grid_ns[1:], grid_ns[0] + (len(grid_ns) * NS_PER_S + fps // 2) // fps)


@dataclass(frozen=True)
class Matched:
    """Indices of the samples of one channel that each row shows. T rows, L history."""

    index: np.ndarray
    """(T, L) sample index, oldest first; −1 where the row has none."""
    weight: np.ndarray | None
    """(T,) share of the following sample (interpolate), else None."""
    age_s: np.ndarray
    """(T,) row time − time of the newest sample that is used [s]; negative with look-ahead, inf if there is no sample."""
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
    """Find the samples of one channel for every row.

    Args:
        grid_ns: (T,) row times.
        time_ns: (N,) strictly increasing sample times.
        align: ``hold`` the last sample, however old (a command stays in force); ``asof`` the last sample, stale beyond
            ``max_age_s``; ``interpolate`` between the last and the next, each within ``max_age_s``; ``window`` the last
            ``history`` samples at the channel's own rate, stale unless the newest is within ``max_age_s`` and the oldest
            within max_age_s + (history − 1) / ``rate_hz``.
    """
    last = np.searchsorted(time_ns, grid_ns, side="right") - 1
    has = last >= 0
    safe = np.maximum(last, 0)
    if len(time_ns) == 0:
        index = np.full((len(grid_ns), history if align == "window" else 1), -1)
        weight = np.zeros(len(grid_ns)) if align == "interpolate" else None
        return Matched(index, weight, np.full(len(grid_ns), np.inf), np.zeros(len(grid_ns), dtype=bool))
    age_s = np.where(has, (grid_ns - time_ns[safe]) / NS_PER_S, np.inf)
    if align == "hold":
        return Matched(np.where(has, last, -1)[:, None], None, age_s, has)
    assert max_age_s is not None, "the spec demands max_age_s for every align but hold"
    fresh = has & (age_s <= max_age_s)
    if align == "asof":
        return Matched(np.where(has, last, -1)[:, None], None, age_s, fresh)
    if align == "interpolate":
        following = np.minimum(safe + 1, len(time_ns) - 1)
        exact = has & (time_ns[safe] == grid_ns)
        ahead_s = (time_ns[following] - grid_ns) / NS_PER_S
        fresh &= exact | ((following > safe) & (ahead_s <= max_age_s))
        step = np.maximum(time_ns[following] - time_ns[safe], 1)
        weight = np.where(exact | ~has | (following == safe), 0.0, (grid_ns - time_ns[safe]) / step)
        age_s = np.where(has, np.where(exact, 0.0, -ahead_s), np.inf)
        return Matched(np.where(has, last, -1)[:, None], weight, age_s, fresh)
    oldest = last - history + 1
    span_s = np.where(oldest >= 0, (grid_ns - time_ns[np.maximum(oldest, 0)]) / NS_PER_S, np.inf)
    fresh &= (oldest >= 0) & (span_s <= max_age_s + (history - 1) / rate_hz)
    index = last[:, None] + np.arange(1 - history, 1)
    return Matched(np.where(oldest[:, None] >= 0, index, -1), None, age_s, fresh)


def runs(fresh: np.ndarray) -> list[tuple[int, int]]:
    """Return first index and last index + 1 of every run of True in ``fresh`` (T,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], fresh, [False])).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def repeated(values: np.ndarray) -> np.ndarray:
    """(T,) bool: rows of ``values`` (T, …) that equal the row before them."""
    same = (np.diff(values, axis=0) == 0).all(axis=tuple(range(1, values.ndim)))
    return np.concatenate([[False], same])


def stretches(same: np.ndarray, fps: int, least_s: float) -> list[tuple[int, int]]:
    """First row and last row + 1 of every stretch of ``least_s`` seconds or more in which ``same`` (T,) bool, the result of
    ``repeated``, says that nothing changes."""
    return [(first - 1, end) for first, end in runs(same) if (end - first + 1) / fps >= least_s]


def longest(found: list[tuple[int, int]]) -> tuple[int, int]:
    """The longest of these row ranges."""
    return max(found, key=lambda rows: rows[1] - rows[0])
