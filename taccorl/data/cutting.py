"""A recording cut into episodes: clocks read, channels brought to the grid, split where a channel was silent.

Nothing is invented and no middle row is deleted: what cannot become rows is listed as a ``Loss`` with its time and reason.
"""

import contextlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data import pictures, timing
from taccorl.data.episode import ChannelTiming, Episode, Pictures
from taccorl.data.finding import CHECKS, Finding, finding
from taccorl.data.joint_checks import check_sample_jumps
from taccorl.data.origin import Domain
from taccorl.data.recording import Identity, Recording, find_sources, opened, release
from taccorl.data.spec import ACTION, STATE, FeatureSpec, MappingSpec, RecordingSpec, SensorSpec, load_recording_spec
from taccorl.data.timing import NS_PER_S, SetBack, Stream, find_set_backs
from taccorl.errors import RecordingError

START_UP_S = 1.0
"""Time after the start of a recording, where no marker gives the start of the episode, for which channels may be missing without
being a loss [s]: drivers need not start together."""
END_SLACK_S = 0.25
"""Time for which a channel may be missing at any end without being a loss [s]. What is cut off there is listed all the same."""
PARTS_S = 1.0
"""Time that is put between the parts of a recording whose clock was set back [s], besides the greatest ``max_age_s``."""
LONGEST_S = 24 * 3600.0
"""Longest recording that is read. At 200 Hz a channel has 17 million messages by then."""
ROUNDING_NS = 1000
"""Time by which a stretch that is to be a whole number of rows may be shorter [ns]: times of rows and of samples are rounded."""
MOST_INSTRUCTION = 4000
"""Largest number of characters of an instruction. Policies read the first few hundred."""
MAX_WAITING_PICTURES = 1000
"""Most pictures that wait for those of the other cameras. A recording interleaves its cameras; more waiting pictures mean that
this one does not."""

CHECKS["picture_size"] = "warning"


class Unfit(RecordingError):
    """Error: the recording is readable, but its data is wrong. It is quarantined, not refused."""


@dataclass(frozen=True)
class Loss:
    """A time range of a recording that became no rows of the dataset, and the reason. Times are in seconds since the recording's
    first sample."""

    start_s: float
    """Start of the range; ``end_s`` is its end."""
    end_s: float
    reason: str
    wanted: bool = True
    """False: the operator discarded the stretch on purpose."""
    within_slack: bool = False
    """True: an end of the recording before the last channel began, or after the first one ended, of usual length
    (``START_UP_S``, ``END_SLACK_S``): listed, but no reason to call the recording split."""
    rows: int = 0
    """Number of rows of the dataset that it took."""


@dataclass
class Cut:
    """Result of cutting one recording into episodes: the episodes, and the time ranges that became no rows."""

    origin_ns: int = 0
    """Time of the recording's first sample on its channels' clock [ns]; ``Loss`` counts its seconds from here."""
    episodes: list[Episode] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)


@dataclass(frozen=True)
class _Interval:
    start_ns: int
    end_ns: int
    instruction: str
    success: bool | None
    marked: bool
    """True if messages on the marker topic give start and end of the episode; False if it is the whole recording."""


class BrokenPicture(RecordingError):
    """Error: a recorded picture does not decode."""

    def __init__(self, channel: str, log_ns: int, reason: str) -> None:
        super().__init__(f"{channel}: the picture logged at {log_ns} ns is broken: {reason}")


class Cutter:
    """Cuts one recording into episodes. ``cut`` may be called again after broken pictures were dropped."""

    def __init__(self, recording: Recording, domain: Domain | None = None) -> None:
        """``domain``: domain that the user states for a recording that states none. Raises TaccorlError: the recording states
        another domain."""
        self.recording, self.spec = recording, recording.spec
        self.origin = recording.origin.agreed(domain, "--domain")
        self.dropped: dict[str, set[Identity]] = {}
        self.broken_pictures_s: dict[str, list[float]] = {}
        """Channel → when the dropped pictures were logged, in seconds since the recording's first sample."""
        self._identities: dict[str, list[Identity]] = {}
        self._sizes: dict[str, Counter[tuple[int, ...]]] = {}
        for name in self.spec.picture_channels:
            count = len(recording.channels[name].log_ns)
            recording.check_pictures(name, [self._identity(name, i) for i in range(count)])
        gap_s = PARTS_S + max((c.max_age_s or 0.0 for c in self.spec.channels.values()), default=0.0)
        self.set_backs = find_set_backs({n: self._stream(n) for n in recording.channels}, round(gap_s * NS_PER_S))
        self.clocks = self._read_clocks()
        sensors = {key: sensor for key, sensor in self.spec.target.sensors.items() if key in self.spec.features}
        self.baselines = {key: self._baseline(key, sensor) for key, sensor in sensors.items()}
        self.origin_ns = min(int(c.time_ns[0]) for c in self.clocks.values())

    def _read_clocks(self) -> dict[str, timing.ClockReading]:
        readings = {}
        for name, channel in self.recording.channels.items():
            bad = self.dropped.get(name, set())
            stamps = channel.stamp_ns
            self._check_zero_stamps(name)
            keep = np.arange(len(channel.log_ns))
            if bad:
                keep = np.array([i for i in range(len(keep)) if self._identity(name, i) not in bad], dtype=int)
            shift_ns = self._shift_ns(channel.place[keep], name)
            reading = timing.read_clock(
                channel.log_ns[keep] + shift_ns,
                None if stamps is None else np.where(stamps[keep] == 0, 0, stamps[keep] + shift_ns),
                clock=self.spec.clock_of(name),
                latency_s=channel.spec.latency_s,
                drop_zero_stamp=channel.spec.drop_zero_stamp,
            )
            if len(reading.time_ns) == 0:
                why = "is a picture that does not decode" if bad else "has a time stamp of 0 or an invalid one"
                raise RecordingError(f"{channel.spec.topic}: each of its {len(channel.log_ns)} messages {why}")
            readings[name] = timing.ClockReading(**{**vars(reading), "order": keep[reading.order]})
            self._check_span(name, readings[name])
        timing.check_clocks(
            {self.spec.channels[name].topic: r.skew_s for name, r in readings.items()}, self.spec.max_clock_spread_s
        )
        return readings

    def _check_span(self, name: str, clock: timing.ClockReading) -> None:
        """Refuse a recording that lasts longer than ``LONGEST_S``: a single changed bit in a stamp would make it last
        for years."""
        times_s = clock.time_ns.astype(float) / NS_PER_S  # a difference of int64 may overflow
        if times_s[-1] - times_s[0] <= LONGEST_S:
            return
        k, span_h = int(np.argmax(np.diff(times_s))), (times_s[-1] - times_s[0]) / 3600
        (early, late), (before, after) = clock.order[k : k + 2], clock.time_ns[k : k + 2]
        raise Unfit(
            f"{self.spec.channels[name].topic}: its stamps span {span_h:.0f} h; at most {LONGEST_S / 3600:g} h are accepted: "
            f"message {early} is at {before} ns, the next in time, message {late}, at {after} ns. Was the file damaged, or a "
            f"clock set? `clock: {'log' if self.spec.clock_of(name) == 'header' else 'header'}` on channel {name!r} uses other "
            "times"
        )

    def _check_zero_stamps(self, name: str) -> None:
        """Stamps of 0 among wall-clock stamps are no times; a spec has to say so, or the recording begins in 1970."""
        channel = self.recording.channels[name]
        if channel.stamp_ns is None or channel.spec.drop_zero_stamp or self.spec.clock_of(name) == "log":
            return
        zeros = int((channel.stamp_ns == 0).sum())
        if zeros and int(channel.stamp_ns.max()) > timing.SIM_TIME_S * NS_PER_S:
            raise RecordingError(
                f"{channel.spec.topic}: {zeros} of {len(channel.stamp_ns)} messages are stamped 0: add "
                f"`drop_zero_stamp: true` to channel {name!r} to leave them out"
            )

    def _stream(self, name: str) -> Stream:
        channel = self.recording.channels[name]
        by_log = self.spec.clock_of(name) == "log" or channel.stamp_ns is None
        time_ns = channel.log_ns if by_log or channel.stamp_ns is None else channel.stamp_ns
        good = np.ones(len(time_ns), dtype=bool) if by_log else time_ns != 0
        values = channel.values if channel.values is None or good.all() else channel.values[good]
        return Stream(channel.spec.topic, time_ns[good], channel.log_ns[good], channel.place[good], values)

    def _shift_ns(self, place: np.ndarray, channel: str = "") -> np.ndarray:
        """(N,) time to add to the messages ``place`` (N,) of a channel [ns]: the parts of a recording whose clock was set back
        follow one another."""
        shift_ns = np.zeros(len(place), dtype=np.int64)
        for step in self.set_backs:
            shift_ns[place >= step.first(channel)] = step.shift_ns
        return shift_ns

    def _identity(self, name: str, index: int) -> Identity:
        if name not in self._identities:
            channel = self.recording.channels[name]
            stamps = [None] * len(channel.log_ns) if channel.stamp_ns is None else channel.stamp_ns.tolist()
            seen: Counter[tuple[int, int | None]] = Counter()
            found: list[Identity] = []
            for log_ns, stamp_ns in zip(channel.log_ns.tolist(), stamps, strict=True):
                found.append((log_ns, stamp_ns, seen[log_ns, stamp_ns]))
                seen[log_ns, stamp_ns] += 1
            self._identities[name] = found
        return self._identities[name][index]

    def _baseline(self, key: str, sensor: SensorSpec) -> np.ndarray:
        """(pads · rows · columns,) median of the first frames of every pad."""
        rule, parts = sensor.baseline, []
        for name in self.spec.features[key].channels:
            channel = self.recording.channels[name]
            assert channel.values is not None
            first = np.asarray(channel.values[self.clocks[name].order[: rule.frames]], dtype=np.int64)
            if len(first) < rule.frames:
                raise Unfit(f"{channel.spec.topic}: {len(first)} frames, but the baseline needs {rule.frames}")
            baseline = np.round(np.median(first, axis=0)).astype(np.int64)
            spread = float(np.quantile(np.abs(first - baseline), 0.99))
            if spread > rule.max_spread_count:
                raise Unfit(
                    f"{channel.spec.topic}: counts spread by {spread:.0f} about their median in the first {rule.frames} "
                    f"frames, but at most by {rule.max_spread_count:g} at rest: was the pad touched while the baseline was "
                    "recorded?"
                )
            parts.append(baseline)
        return np.concatenate(parts)

    @property
    def samples(self) -> dict[str, dict[str, int]]:
        """Channel → number of the messages of its topic, of the samples kept, and of those left out by reason; they add up."""
        found = {}
        for name, channel in self.recording.channels.items():
            clock, broken = self.clocks[name], len(self.dropped.get(name, ()))
            left = {
                **channel.skipped,
                "stamp of 0": clock.zero_stamps,
                "repeated stamp": clock.duplicates,
                "broken picture": broken,
            }
            found[name] = {
                "messages": self.recording.counts[channel.spec.topic],
                "kept": len(clock.time_ns),
                **{reason: count for reason, count in left.items() if count},
            }
        return found

    def seconds(self, time_ns: int) -> float:
        """Seconds since the recording's first sample, for a time [ns] on its channels' clock; rounded to 1 ms."""
        return round((int(time_ns) - self.origin_ns) / NS_PER_S, 3)

    def size_findings(self) -> list[Finding]:
        """Findings on cameras whose pictures, as far as they were decoded, changed their size."""
        several = {
            key: ", ".join(f"{rows}×{columns} {count} times" for (rows, columns), count in sizes.items())
            for key, sizes in self._sizes.items()
            if len(sizes) > 1
        }
        why = "the camera was set up anew in mid-recording; the same place is not the same pixel in all rows"
        return [
            finding("picture_size", key, f"{key}: its pictures have several sizes ({sizes}): {why}")
            for key, sizes in several.items()
        ]

    def cut(self) -> Cut:
        """All episodes of the recording, and the time ranges that became no rows."""
        result = Cut(self.origin_ns)
        intervals = self._intervals(result)
        for number, interval in enumerate(intervals):
            self._cut_interval(interval, f"episode {number}" if len(intervals) > 1 else "", result)
        return result

    def _intervals(self, result: Cut) -> list[_Interval]:
        by = self.spec.episodes.by
        if by == "markers":
            intervals = self._marked(result)
        elif by == "metadata":
            intervals = self._from_metadata()
        else:
            last = max(int(c.time_ns[-1]) for c in self.clocks.values())
            intervals = [_Interval(self.origin_ns, last, self._instruction(), self._success(), marked=False)]
        for step in self.set_backs:
            intervals = [part for interval in intervals for part in _parted(interval, step)]
            end_s = self.seconds(step.end_ns)
            result.losses.append(Loss(end_s, end_s, f"the clock was set back by {step.by_s:.3f} s: cut there"))
        return intervals

    def _common_ns(self, log_ns: int) -> int:
        """A log time on the channels' clock."""
        skews = [c.skew_s for n, c in self.clocks.items() if self.spec.clock_of(n) == "header"]
        return log_ns - round(float(np.median(skews)) * NS_PER_S) if skews else log_ns

    def _marked(self, result: Cut) -> list[_Interval]:
        topic = self.spec.episodes.topic
        assert topic is not None
        intervals, start, instruction = [], None, ""
        last = max(int(c.time_ns[-1]) for c in self.clocks.values())

        def unfinished(end_ns: int, why: str) -> None:
            assert start is not None
            intervals.append(_Interval(start, end_ns, instruction, None, marked=True))
            result.losses.append(Loss(self.seconds(end_ns), self.seconds(end_ns), f"no end marker on {topic}: {why}"))

        texts = self.recording.texts[topic]
        shifts_ns = self._shift_ns(self.recording.text_places[topic])
        for log_ns, text in sorted((at + int(more), text) for (at, text), more in zip(texts, shifts_ns, strict=True)):
            time_ns = self._common_ns(log_ns)
            word, _, rest = text.partition(":")
            if word == "start":
                if start is not None:
                    unfinished(time_ns, "the next episode starts")
                start = time_ns
                from_markers = self.spec.instruction.from_ == "markers"
                instruction = _of_usual_length(rest.strip()) if from_markers else self._instruction()
                if not instruction:
                    raise RecordingError(f"{topic}: marker {text!r} has no instruction (`start:<instruction>`)")
            elif word in ("success", "failure", "discard"):
                if start is None:
                    raise RecordingError(f"{topic}: marker {text!r} at {self.seconds(time_ns)} s without a start")
                if word == "discard":
                    span_s = self.seconds(start), self.seconds(time_ns)
                    result.losses.append(Loss(*span_s, "discarded by the operator", wanted=False))
                else:
                    intervals.append(_Interval(start, time_ns, instruction, word == "success", marked=True))
                start = None
            else:
                raise RecordingError(
                    f"{topic}: unknown marker {text!r}; known: start:<instruction>, success, failure, discard"
                )
        if start is not None:
            unfinished(last, "the recording ends within the episode")
        return intervals

    def _from_metadata(self) -> list[_Interval]:
        """MCAP metadata records ``episode_<id>`` with ``start`` and ``end`` (log time, ns), ``instruction``, ``success``."""
        found = []
        if self.set_backs:
            raise RecordingError(
                f"the clock was set back by {self.set_backs[0].by_s:.3f} s in mid-recording: which times the metadata records "
                "of its episodes state is unknown; use `episodes: {by: whole_file}`"
            )
        for name, record in sorted(self.recording.reader.metadata.items(), key=lambda item: item[1].get("start", "")):
            if not name.startswith("episode_"):
                continue
            try:
                start, end = (self._common_ns(int(record[k])) for k in ("start", "end"))
            except (KeyError, ValueError) as error:
                raise RecordingError(f"metadata {name!r}: {record} does not state start and end in ns") from error
            if end < start:
                raise RecordingError(f"metadata {name!r}: ends {(start - end) / NS_PER_S:.3f} s before it starts")
            told = record.get("success", "").lower()
            success = {"true": True, "false": False}.get(told)
            instruction = _of_usual_length(record.get("instruction", "").strip()) or self._instruction()
            found.append(_Interval(start, end, instruction, success, marked=True))
        if not found:
            raise RecordingError(
                "no metadata record episode_<id> in the recording; it has "
                + (", ".join(self.recording.reader.metadata) or "none")
            )
        return sorted(found, key=lambda i: i.start_ns)

    def _instruction(self) -> str:
        return _of_usual_length(self._stated_instruction())

    def _stated_instruction(self) -> str:
        rule = self.spec.instruction
        if rule.from_ == "spec":
            return rule.text or ""
        if rule.from_ == "topic":
            assert rule.topic is not None
            texts = {text.strip() for _, text in self.recording.texts[rule.topic]} - {""}
            if len(texts) != 1:
                raise RecordingError(
                    f"{rule.topic} has {len(texts)} different instructions {sorted(texts)[:3]}, but needs exactly one"
                )
            return texts.pop()
        for record in self.recording.reader.metadata.values():
            if record.get(rule.key or "", "").strip():
                return record[rule.key or ""].strip()
        known = sorted({k for r in self.recording.reader.metadata.values() for k in r})
        raise RecordingError(f"no metadata key {rule.key!r} for the instruction; the recording has {known or 'none'}")

    def _success(self) -> bool | None:
        told = {r["success"].lower() for r in self.recording.reader.metadata.values() if "success" in r}
        return {"true": True, "false": False}.get(told.pop()) if len(told) == 1 else None

    def _cut_interval(self, interval: _Interval, label: str, result: Cut) -> None:
        start_ns = max([interval.start_ns, *(self._first_usable_ns(key) for key in self.spec.mapped)])
        end_ns = min([interval.end_ns, *self._last_ns().values()])
        self._report_ends(interval, start_ns, end_ns, result)
        grid_ns = timing.make_grid(start_ns, end_ns, self.spec.target.fps)
        matches = {key: self._match(key, grid_ns) for key in self.spec.mapped}
        stale = {c: ~m.fresh for by_channel in matches.values() for c, m in by_channel.items()}
        fresh = ~np.any(list(stale.values()), axis=0) if len(grid_ns) else np.zeros(0, dtype=bool)
        for a, b in timing.runs(~fresh):
            silent = sorted({c for c, s in stale.items() if s[a:b].any()})
            reason = f"no fresh sample of {', '.join(silent)} for {b - a} rows"
            result.losses.append(Loss(self.seconds(grid_ns[a]), self.seconds(grid_ns[b - 1]), reason, rows=b - a))
        pieces = timing.runs(fresh)
        for number, (a, b) in enumerate(pieces):
            if (b - a) / self.spec.target.fps < self.spec.episodes.min_s:
                reason = f"{b - a} rows are shorter than the spec's min_s {self.spec.episodes.min_s:g}"
                result.losses.append(Loss(self.seconds(grid_ns[a]), self.seconds(grid_ns[b - 1]), reason, rows=b - a))
                continue
            part = f"part {number}" if len(pieces) > 1 else ""
            name = " ".join(w for w in (self.recording.source.name, label, part) if w)
            # The outcome is what was to be seen at the end: of a part without it, nobody said one.
            row_ns = NS_PER_S // self.spec.target.fps
            has_end = b == pieces[-1][1] and interval.end_ns - grid_ns[b - 1] <= END_SLACK_S * NS_PER_S + row_ns
            shown = interval if has_end else replace(interval, success=None)
            result.episodes.append(self._episode(name, shown, grid_ns[a:b], matches, slice(a, b)))

    def _last_ns(self) -> dict[str, int]:
        """Channel → time of the last row that it can fill [ns]; a held channel has no end."""
        found: dict[str, int] = {}
        for key in self.spec.mapped:
            if self.spec.features[key].align == "hold":
                continue
            # Rounded down: rows are 1 / fps apart to a nanosecond.
            ahead_ns = NS_PER_S // self.spec.target.fps if key == ACTION else 0
            for c in self.spec.features[key].channels:
                last_ns = int(self.clocks[c].time_ns[-1]) - ahead_ns
                found[c] = min(last_ns, found.get(c, last_ns))
        return found

    def _ahead_ns(self, key: str) -> int:
        """Time from a row to that at which its value of ``key`` is taken [ns], rounded as ``timing.next_rows`` rounds row 1."""
        fps = self.spec.target.fps
        return (NS_PER_S + fps // 2) // fps if key == ACTION else 0

    def _first_usable_ns(self, key: str) -> int:
        mapping, history = self.spec.features[key], self.spec.target.features[key].history
        firsts = []
        for name in mapping.channels:
            time_ns = self.clocks[name].time_ns
            if len(time_ns) < history:
                raise Unfit(f"{self.spec.channels[name].topic}: {len(time_ns)} samples, but a window needs {history}")
            firsts.append(int(time_ns[history - 1]) - self._ahead_ns(key))
        return max(firsts)

    def _report_ends(self, interval: _Interval, start_ns: int, end_ns: int, result: Cut) -> None:
        late = max(self.clocks, key=lambda c: int(self.clocks[c].time_ns[0]))
        last_ns = self._last_ns()
        early = min(last_ns, key=last_ns.__getitem__, default=late)
        begin_s, finish_s = self.seconds(interval.start_ns), self.seconds(interval.end_ns)
        if end_ns < start_ns:  # not one row
            reason = f"{early} ends early" if start_ns <= interval.end_ns else f"{late} begins late"
            rows = (interval.end_ns - interval.start_ns) * self.spec.target.fps // NS_PER_S + 1
            result.losses.append(Loss(begin_s, finish_s, reason, rows=rows))
            return
        # The last command has no row of its own: it is the action of the row before it.
        spare_ns = self._ahead_ns(ACTION) if ACTION in self.spec.mapped else 0
        end_slack_ns = round(END_SLACK_S * NS_PER_S)
        start_slack_ns = round(((0.0 if interval.marked else START_UP_S) + END_SLACK_S) * NS_PER_S)
        for from_ns, to_ns, slack_ns, why in (
            (interval.start_ns, start_ns, start_slack_ns, f"{late} begins late"),
            (end_ns + spare_ns, interval.end_ns, end_slack_ns, f"{early} ends early"),
        ):
            rows = (to_ns - from_ns + ROUNDING_NS) * self.spec.target.fps // NS_PER_S
            if rows > 0:
                within = to_ns - from_ns <= slack_ns
                span_s = (self.seconds(from_ns), self.seconds(to_ns))
                result.losses.append(Loss(*span_s, why, within_slack=within, rows=rows))

    def _match(self, key: str, grid_ns: np.ndarray) -> dict[str, timing.Matched]:
        mapping, feature = self.spec.features[key], self.spec.target.features[key]
        # The action of row t is the last command before row t + 1: the target that is sent from row t on (action_time).
        due_ns = timing.next_rows(grid_ns, self.spec.target.fps) if key == ACTION else grid_ns
        return {
            name: timing.match(
                due_ns,
                self.clocks[name].time_ns,
                mapping.align,
                max_age_s=self.spec.channels[name].max_age_s,
                history=feature.history,
                rate_hz=self.spec.channels[name].rate_hz,
            )
            for name in mapping.channels
        }

    def _episode(
        self,
        name: str,
        interval: _Interval,
        grid_ns: np.ndarray,
        matches: dict[str, dict[str, timing.Matched]],
        rows: slice,
    ) -> Episode:
        arrays, sources, timings = {}, {}, []
        for key, feature in self.spec.mapped.items():
            mapping = self.spec.features[key]
            timings += [self._timing(c, key, mapping, m, rows, grid_ns) for c, m in matches[key].items()]
            if feature.dtype == "video":
                channel = mapping.channels[0]
                sources[key] = (channel, self.clocks[channel].order[matches[key][channel].index[rows, 0]])
            else:
                arrays[key] = self._array(key, feature, matches[key], rows)
        return Episode(
            name=name,
            spec=self.spec.target,
            start_ns=int(grid_ns[0]),
            arrays=arrays,
            pictures=lambda: self._pictures(sources, len(grid_ns)),
            picture_keys=tuple(sources),
            instruction=interval.instruction,
            success=interval.success,
            origin=self.origin,
            timing=tuple(timings),
            picture_rows={key: index for key, (_, index) in sources.items()},
            baselines=dict(self.baselines),
            findings=tuple(self._sample_jumps(grid_ns)),
        )

    def _sample_jumps(self, grid_ns: np.ndarray) -> Iterator[Finding]:
        """Findings of ``check_sample_jumps`` for the channels of state and action between the first and the last row. Channels
        slower than the rows are skipped: the rows hold all of their samples."""
        fps = self.spec.target.fps
        for key in (STATE, ACTION):
            feature, start = self.spec.target.features.get(key), 0
            for name in self.spec.features[key].channels if feature and key in self.spec.features else ():
                values, clock = self.recording.channels[name].values, self.clocks[name]
                assert values is not None and feature is not None
                part = slice(start, start := start + values.shape[1])
                if self.spec.channels[name].rate_hz <= fps:
                    continue
                inside = (clock.time_ns >= grid_ns[0]) & (clock.time_ns <= grid_ns[-1])
                names, units = feature.element_names(key), feature.units
                time_s = (clock.time_ns[inside] - grid_ns[0]) / NS_PER_S
                samples = np.asarray(values[clock.order[inside]], dtype=float)
                release(values)
                yield from check_sample_jumps(name, samples, time_s, names[part], units[part], 1 / fps)

    def _timing(
        self, channel: str, key: str, mapping: MappingSpec, m: timing.Matched, rows: slice, grid_ns: np.ndarray
    ) -> ChannelTiming:
        clock = self.clocks[channel]
        inside = clock.time_ns[(clock.time_ns >= grid_ns[0]) & (clock.time_ns <= grid_ns[-1])]
        steps = np.diff(inside) / NS_PER_S
        median = float(np.median(steps)) if len(steps) else float("inf")
        age = m.age_s[rows]
        return ChannelTiming(
            channel=channel,
            feature=key,
            align=mapping.align,
            rate_hz=round(1.0 / median, 3) if len(steps) else 0.0,
            gaps=int((steps > 1.5 * median).sum()),
            longest_gap_s=round(float(steps.max()), 6) if len(steps) else 0.0,
            age_median_s=round(float(np.median(age)), 6),
            age_max_s=round(float(age.max()), 6),
            duplicates=clock.duplicates,
            out_of_order=clock.out_of_order,
            zero_stamps=clock.zero_stamps,
            skipped=dict(self.recording.channels[channel].skipped),
            nominal_hz=self.spec.channels[channel].rate_hz,
        )

    def _array(self, key: str, feature: FeatureSpec, matches: dict[str, timing.Matched], rows: slice) -> np.ndarray:
        """(T, size) of one feature, in its dtype."""
        parts = []
        for name, m in matches.items():
            values = self.recording.channels[name].values
            assert values is not None
            order, index = self.clocks[name].order, m.index[rows]
            part = np.asarray(values[order[index]])  # (T, L, size of the channel)
            if m.weight is not None:
                following = np.asarray(values[order[np.minimum(index + 1, len(order) - 1)]])
                part = part + m.weight[rows, None, None] * (following - part)
            parts.append(part)
            release(values)
        joined = np.concatenate(parts, axis=2)
        if key in self.baselines:
            joined = np.subtract(joined, self.baselines[key], dtype=np.int16, casting="unsafe")  # max_count fits int16
        out = joined.reshape(len(joined), -1)
        if out.shape[1] != feature.size:
            raise RecordingError(
                f"{key}: channels {', '.join(matches)} have {out.shape[1]} values, but the dataset spec states {feature.size}"
            )
        return out.astype(feature.dtype, copy=False)

    def _pictures(self, sources: dict[str, tuple[str, np.ndarray]], num_rows: int) -> Iterator[Pictures]:
        """Rows' pictures, decoded once each, in one pass over the file."""
        if not sources:
            return
        identities = {key: [self._identity(c, int(i)) for i in index] for key, (c, index) in sources.items()}
        keys_of: dict[str, list[str]] = {}
        for key, (channel, _) in sources.items():
            keys_of.setdefault(channel, []).append(key)
        waiting: dict[str, dict[Identity, Any]] = {key: {} for key in sources}
        shown: dict[str, tuple[Identity, np.ndarray]] = {}
        row = 0
        wanted = {channel: [i for key in keys for i in identities[key]] for channel, keys in keys_of.items()}
        needed = {key: set(ids) for key, ids in identities.items()}
        for channel, identity, payload in self.recording.pictures(wanted):
            for key in keys_of[channel]:
                if identity in needed[key]:
                    waiting[key][identity] = payload
            if sum(map(len, waiting.values())) > MAX_WAITING_PICTURES:
                raise RecordingError(
                    f"{MAX_WAITING_PICTURES} pictures of one camera come before any of another: cameras are not interleaved in "
                    "the file"
                )
            while row < num_rows and all(
                identities[k][row] in waiting[k] or (k in shown and shown[k][0] == identities[k][row]) for k in sources
            ):
                for key in sources:
                    if key not in shown or shown[key][0] != identities[key][row]:
                        identity = identities[key][row]
                        shown[key] = (
                            identity,
                            self._decode(key, sources[key][0], identity, waiting[key].pop(identity)),
                        )
                yield {key: picture for key, (_, picture) in shown.items()}
                row += 1
        if row < num_rows:
            raise RecordingError(
                f"{self.recording.source.name}: its pictures ended at row {row} of {num_rows}: did the file change?"
            )

    def _decode(self, key: str, channel: str, identity: Identity, payload: Any) -> np.ndarray:
        rows, columns, _ = self.spec.target.features[key].shape
        try:
            picture = pictures.picture(payload, self.spec.channels[channel])
            self._sizes.setdefault(key, Counter())[picture.shape[:2]] += 1
            return pictures.letterbox(picture, rows, columns)
        except RecordingError as error:
            raise BrokenPicture(channel, identity[0], str(error)) from error

    def drop_broken_pictures(self) -> int:
        """Decode every picture once and drop those that do not decode: their rows show an older picture, or the episode is
        split. Returns the number of dropped pictures."""
        everything = {
            c: [self._identity(c, i) for i in range(len(self.recording.channels[c].log_ns))]
            for c in self.spec.picture_channels
        }
        broken = 0
        for channel, identity, payload in self.recording.pictures(everything):
            try:
                pictures.picture(payload, self.spec.channels[channel])
            except RecordingError:
                self.dropped.setdefault(channel, set()).add(identity)
                self.broken_pictures_s.setdefault(channel, []).append(self.seconds(self._common_ns(identity[0])))
                broken += 1
        self.clocks = self._read_clocks()
        return broken


def _of_usual_length(instruction: str) -> str:
    if len(instruction) > MOST_INSTRUCTION:
        raise RecordingError(
            f"an instruction of {len(instruction):,} characters, {instruction[:40]!r} …; at most {MOST_INSTRUCTION:,} are read"
        )
    return instruction


def _parted(interval: _Interval, step: SetBack) -> list[_Interval]:
    """The interval before and after a step of the clock; the operator's judgement is of the part in which it was given."""
    if not interval.start_ns <= step.end_ns < step.start_ns <= interval.end_ns:
        return [interval]
    before = replace(interval, end_ns=step.end_ns, success=None if interval.marked else interval.success)
    return [before, replace(interval, start_ns=step.start_ns)]


@contextlib.contextmanager
def open_episodes(path: Path, spec: str | Path | RecordingSpec) -> Iterator[list[Episode]]:
    """Context manager that gives the episodes of one recording, for looking at; usable inside the ``with`` only (numbers live
    in a scratch folder). Raises RecordingError: not readable, more than one recording, or nothing in it fits the spec."""
    loaded = spec if isinstance(spec, RecordingSpec) else load_recording_spec(spec)
    sources = find_sources(path, reader=loaded.reader, split_bag=loaded.split_bag)
    with contextlib.ExitStack() as stack:
        episodes: list[Episode] = []
        for _, source in sources:
            cut = Cutter(stack.enter_context(opened(source, loaded))).cut()
            episodes += cut.episodes
            if not cut.episodes and len(sources) == 1:
                reasons = "; ".join(loss.reason for loss in cut.losses)
                raise RecordingError(f"{path}: no episode: {reasons or 'no rows'}")
        yield episodes
