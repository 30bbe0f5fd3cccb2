"""Times of a recording's channels on one clock: which messages count as samples, when each was, and jumps back of the clock."""

from collections import Counter
from dataclasses import replace

import numpy as np

from taccorl.data.recording import Identity, Recording
from taccorl.data.timing import (
    NS_PER_S,
    SIM_TIME_S,
    ClockReading,
    Stream,
    check_clocks,
    find_set_backs,
    read_clock,
)
from taccorl.errors import RecordingError

PARTS_S = 1.0  # Time between the parts of a recording whose clock was set back [s], besides the greatest ``max_age_s``
LONGEST_S = (
    24 * 3600.0
)  # Longest recording that is read [s]. At 200 Hz a channel has 17 million messages by then


class Unfit(RecordingError):
    """Error: the recording is readable, but its data is wrong. It is quarantined, not refused."""


class TimedRecording:
    """A recording with the times of its channels' samples."""

    def __init__(self, recording: Recording) -> None:
        self.recording, self.spec = recording, recording.spec
        self.dropped: dict[str, set[Identity]] = {}
        self._identities = {
            name: self._identify(name) for name in self.spec.picture_channels
        }
        for name, identities in self._identities.items():
            recording.check_pictures(name, identities)
        gap_s = PARTS_S + max(
            (c.max_age_s or 0.0 for c in self.spec.channels.values()), default=0.0
        )
        self.set_backs = find_set_backs(
            {n: self._stream(n) for n in recording.channels}, round(gap_s * NS_PER_S)
        )
        self.clocks = self._read_clocks()
        self.origin_ns = min(int(c.time_ns[0]) for c in self.clocks.values())

    def _read_clocks(self) -> dict[str, ClockReading]:
        readings = {}
        for name, channel in self.recording.channels.items():
            topic, stamps, bad = (
                channel.spec.topic,
                channel.stamp_ns,
                self.dropped.get(name, set()),
            )
            drop, clock, total = (
                channel.spec.drop_zero_stamp,
                self.spec.clock_of(name),
                len(channel.log_ns),
            )
            # Stamps of 0 among wall-clock stamps are no times; a spec has to say so, or the recording begins in 1970.
            zeros = (
                0
                if stamps is None or drop or clock == "log"
                else int((stamps == 0).sum())
            )
            if (
                zeros
                and stamps is not None
                and int(stamps.max()) > SIM_TIME_S * NS_PER_S
            ):
                text = f"{topic}: {zeros} of {total} messages are stamped 0: add `drop_zero_stamp: true` to channel "
                raise RecordingError(f"{text}{name!r} to leave them out")
            keep = np.arange(total)
            if bad:
                keep = np.array(
                    [
                        i
                        for i, ident in enumerate(self._identities[name])
                        if ident not in bad
                    ],
                    dtype=int,
                )
            shift_ns = self._shift_ns(channel.place[keep], name)
            kept = (
                None
                if stamps is None
                else np.where(stamps[keep] == 0, 0, stamps[keep] + shift_ns)
            )
            rule = {
                "clock": clock,
                "latency_s": channel.spec.latency_s,
                "drop_zero_stamp": drop,
            }
            reading = read_clock(channel.log_ns[keep] + shift_ns, kept, **rule)
            if len(reading.time_ns) == 0:
                why = (
                    "is a picture that does not decode"
                    if bad
                    else "has a time stamp of 0 or an invalid one"
                )
                raise RecordingError(f"{topic}: each of its {total} messages {why}")
            readings[name] = replace(reading, order=keep[reading.order])
            self._check_span(name, readings[name])
        skews = {
            self.spec.channels[name].topic: r.skew_s for name, r in readings.items()
        }
        check_clocks(skews, self.spec.max_clock_spread_s)
        return readings

    def _check_span(self, name: str, clock: ClockReading) -> None:
        """Refuse time stamps that span more than ``LONGEST_S``: one damaged bit in a stamp can add years to a recording."""
        times_s = (
            clock.time_ns.astype(float) / NS_PER_S
        )  # a difference of int64 may overflow
        if times_s[-1] - times_s[0] > LONGEST_S:
            k, span_h = (
                int(np.argmax(np.diff(times_s))),
                (times_s[-1] - times_s[0]) / 3600,
            )
            (early, late), (before, after) = (
                clock.order[k : k + 2],
                clock.time_ns[k : k + 2],
            )
            topic, other = (
                self.spec.channels[name].topic,
                "log" if self.spec.clock_of(name) == "header" else "header",
            )
            text = f"{topic}: its stamps span {span_h:.0f} h; at most {LONGEST_S / 3600:g} h are accepted: message "
            text += f"{early} is at {before} ns, the next, message {late}, at {after} ns: damaged, or a clock set? "
            raise Unfit(f"{text}`clock: {other}` on channel {name!r} uses other times")

    def _stream(self, name: str) -> Stream:
        channel = self.recording.channels[name]
        by_log = self.spec.clock_of(name) == "log" or channel.stamp_ns is None
        time_ns = (
            channel.log_ns if by_log or channel.stamp_ns is None else channel.stamp_ns
        )
        good = np.ones(len(time_ns), dtype=bool) if by_log else time_ns != 0
        values = (
            channel.values
            if channel.values is None or good.all()
            else channel.values[good]
        )
        return Stream(
            channel.spec.topic,
            time_ns[good],
            channel.log_ns[good],
            channel.place[good],
            values,
        )

    def _shift_ns(self, place: np.ndarray, channel: str = "") -> np.ndarray:
        """(N,) time to add to the messages ``place`` (N,) of a channel [ns]: the parts of a recording whose clock was set back
        follow one another."""
        shift_ns = np.zeros(len(place), dtype=np.int64)
        for step in self.set_backs:
            shift_ns[place >= step.places.get(channel, step.place)] = step.shift_ns
        return shift_ns

    def _identify(self, name: str) -> list[Identity]:
        channel, seen, found = (
            self.recording.channels[name],
            Counter[tuple[int, int | None]](),
            [],
        )
        stamps = (
            [None] * len(channel.log_ns)
            if channel.stamp_ns is None
            else channel.stamp_ns.tolist()
        )
        for log_ns, stamp_ns in zip(channel.log_ns.tolist(), stamps, strict=True):
            found.append((log_ns, stamp_ns, seen[log_ns, stamp_ns]))
            seen[log_ns, stamp_ns] += 1
        return found

    @property
    def samples(self) -> dict[str, dict[str, int]]:
        """Channel → number of the messages of its topic, of the samples kept, and of those left out by reason; they add up."""
        found = {}
        for name, channel in self.recording.channels.items():
            clock, broken = self.clocks[name], len(self.dropped.get(name, ()))
            left = {
                "stamp of 0": clock.zero_stamps,
                "repeated stamp": clock.duplicates,
                "broken picture": broken,
            }
            counts = {
                "messages": self.recording.counts[channel.spec.topic],
                "kept": len(clock.time_ns),
            }
            found[name] = counts | {
                reason: count
                for reason, count in (channel.skipped | left).items()
                if count
            }
        return found

    def seconds(self, time_ns: int) -> float:
        """Convert a time [ns] on the clock of the channels to seconds since the recording's first sample, rounded to 1 ms."""
        return round((int(time_ns) - self.origin_ns) / NS_PER_S, 3)

    def _common_ns(self, log_ns: int) -> int:
        """Convert a time of the log ``log_ns`` [ns] to the clock of the message headers, by the median offset of both."""
        skews = [
            c.skew_s
            for n, c in self.clocks.items()
            if self.spec.clock_of(n) == "header"
        ]
        return log_ns - round(float(np.median(skews)) * NS_PER_S) if skews else log_ns
