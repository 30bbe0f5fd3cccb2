"""A recording cut into episodes: channels brought to the grid, split where a channel was silent.

Nothing is invented and no middle row is deleted: what cannot become rows is listed as a ``Loss`` with its time and reason.
"""

import contextlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data import pictures, timing
from taccorl.data.episode import ChannelTiming, Episode, Pictures
from taccorl.data.finding import Finding, finding, listed
from taccorl.data.joint_checks import check_sample_jumps
from taccorl.data.origin import RATE_OF, Domain
from taccorl.data.recording import Identity, Recording, find_sources, opened
from taccorl.data.sensor_spec import SensorSpec
from taccorl.data.spec import (
    ACTION,
    STATE,
    FeatureSpec,
    RecordingSpec,
    load_recording_spec,
)
from taccorl.data.spool import release
from taccorl.data.timed_recording import TimedRecording, Unfit
from taccorl.data.timing import NS_PER_S, Matched, SetBack
from taccorl.errors import RecordingError

START_UP_S = 1.0  # Time after an unmarked start for which channels may be missing [s]: drivers need not start together
END_SLACK_S = 0.25  # Time for which a channel may be missing at any end [s]; what is cut off there is listed
ROUNDING_NS = 1000  # Time by which a whole number of rows may be shorter [ns]: times of rows and samples are rounded
MOST_INSTRUCTION = 4000  # Largest number of characters of an instruction. Policies read the first few hundred
MAX_WAITING_PICTURES = 1000  # Most pictures that wait for other cameras'; more mean that cameras are not interleaved
OUTCOMES = {"true": True, "false": False}


class BrokenPicture(RecordingError):
    """Error: a recorded picture does not decode."""


@dataclass(frozen=True)
class Loss:
    """A time range of a recording, in seconds since its first sample, that became no rows of the dataset, and the reason."""

    start_s: float
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
    """``marked``: messages on the marker topic give start and end of the episode, which is not the whole recording."""

    start_ns: int
    end_ns: int
    instruction: str
    success: bool | None
    marked: bool


class Cutter(TimedRecording):
    """Cuts one recording into episodes. ``cut`` may be called again after broken pictures were dropped."""

    def __init__(self, recording: Recording, domain: Domain | None = None) -> None:
        """``domain``: domain that the user states for a recording that states none. Raises TaccorlError: the recording states
        another domain."""
        self.origin = recording.origin.agreed(domain, "--domain")
        super().__init__(recording)
        self.fps, self._sizes = (
            self.spec.target.fps,
            dict[str, Counter[tuple[int, ...]]](),
        )
        self.broken_pictures_s: dict[str, list[float]] = {}
        """Channel → when the dropped pictures were logged, in seconds since the recording's first sample."""
        sensors = {
            key: sensor
            for key, sensor in self.spec.target.sensors.items()
            if key in self.spec.features
        }
        self.baselines = {
            key: self._baseline(key, sensor) for key, sensor in sensors.items()
        }

    def _baseline(self, key: str, sensor: SensorSpec) -> np.ndarray:
        """(pads · rows · columns,) median of the first frames of every pad."""
        rule, parts = sensor.baseline, []
        for name in self.spec.features[key].channels:
            channel = self.recording.channels[name]
            assert channel.values is not None
            first = np.asarray(
                channel.values[self.clocks[name].order[: rule.frames]], dtype=np.int64
            )
            if len(first) < rule.frames:
                raise Unfit(
                    f"{channel.spec.topic}: {len(first)} frames, but the baseline needs {rule.frames}"
                )
            baseline = np.round(np.median(first, axis=0)).astype(np.int64)
            spread = float(np.quantile(np.abs(first - baseline), 0.99))
            if spread > rule.max_spread_count:
                text = f"{channel.spec.topic}: counts spread by {spread:.0f} about their median in the first "
                raise Unfit(
                    f"{text}{rule.frames} frames: touched while the baseline was recorded?"
                )
            parts.append(baseline)
        return np.concatenate(parts)

    # ---- intervals ----

    def cut(self) -> Cut:
        """All episodes of the recording, and the time ranges that became no rows."""
        result = Cut(self.origin_ns)
        intervals = {
            "markers": self._marked,
            "metadata": self._from_metadata,
            "whole_file": self._whole,
        }
        found = intervals[self.spec.episodes.by](result)
        for step in self.set_backs:
            found = [part for interval in found for part in _parted(interval, step)]
            end_s = self.seconds(step.end_ns)
            result.losses.append(
                Loss(
                    end_s,
                    end_s,
                    f"the clock was set back by {step.by_s:.3f} s: cut there",
                )
            )
        for number, interval in enumerate(found):
            self._cut_interval(
                interval, f"episode {number}" if len(found) > 1 else "", result
            )
        result.losses += self._lost_ends()
        return result

    def _lost_ends(self) -> list[Loss]:
        """The end of the recording that its container states and that is not there."""
        topics = {channel.topic for channel in self.spec.channels.values()}
        losses = []
        for damage in self.recording.damage:
            lacking = [topic for topic, _ in damage.missing if topic in topics]
            if not lacking or damage.start_ns is None or damage.end_ns is None:
                continue
            start_ns, end_ns = map(self._common_ns, (damage.start_ns, damage.end_ns))
            span_s = self.seconds(start_ns), self.seconds(end_ns)
            reason = (
                f"messages of {', '.join(lacking)} that the file counts are missing"
            )
            rows = (end_ns - start_ns) * self.fps // NS_PER_S
            losses.append(Loss(*span_s, reason, rows=rows))
        return losses[:1]

    def _whole(self, result: Cut) -> list[_Interval]:
        last = max(int(c.time_ns[-1]) for c in self.clocks.values())
        told = {
            r["success"].lower()
            for r in self.recording.reader.metadata.values()
            if "success" in r
        }
        success = OUTCOMES.get(told.pop()) if len(told) == 1 else None
        return [
            _Interval(
                result.origin_ns, last, self._instruction(), success, marked=False
            )
        ]

    def _marked(self, result: Cut) -> list[_Interval]:
        topic = self.spec.episodes.topic
        assert topic is not None
        found, start, instruction = [], None, ""

        def end(end_ns: int, success: bool | None, why: str = "") -> None:
            assert start is not None
            found.append(_Interval(start, end_ns, instruction, success, marked=True))
            if why:
                end_s = self.seconds(end_ns)
                result.losses.append(
                    Loss(end_s, end_s, f"no end marker on {topic}: {why}")
                )

        texts, shifts_ns = (
            self.recording.texts[topic],
            self._shift_ns(self.recording.text_places[topic]),
        )
        for log_ns, text in sorted(
            (at + int(more), text)
            for (at, text), more in zip(texts, shifts_ns, strict=True)
        ):
            time_ns = self._common_ns(log_ns)
            word, _, rest = text.partition(":")
            if word not in ("start", "success", "failure", "discard", "end"):
                raise RecordingError(
                    f"{topic}: unknown marker {text!r}; use start:…, success, failure, discard, end"
                )
            if word == "start":
                if start is not None:
                    end(time_ns, None, "the next episode starts")
                start, from_markers = time_ns, self.spec.instruction.from_ == "markers"
                instruction = (
                    _of_usual_length(rest.strip())
                    if from_markers
                    else self._instruction()
                )
                if not instruction:
                    raise RecordingError(
                        f"{topic}: marker {text!r} has no instruction (`start:<instruction>`)"
                    )
                continue
            if start is None:
                raise RecordingError(
                    f"{topic}: marker {text!r} at {self.seconds(time_ns)} s without a start"
                )
            if word == "discard":
                span_s = self.seconds(start), self.seconds(time_ns)
                result.losses.append(
                    Loss(*span_s, "discarded by the operator", wanted=False)
                )
            else:
                end(time_ns, {"success": True, "failure": False}.get(word))
            start = None
        if start is not None:
            end(
                max(int(c.time_ns[-1]) for c in self.clocks.values()),
                None,
                "the recording ends within the episode",
            )
        return found

    def _from_metadata(self, _: Cut) -> list[_Interval]:
        """MCAP metadata records ``episode_<id>`` with ``start`` and ``end`` (log time, ns), ``instruction``, ``success``."""
        metadata, found = self.recording.reader.metadata, []
        if self.set_backs:
            text = f"the clock was set back by {self.set_backs[0].by_s:.3f} s in mid-recording: which times the metadata records"
            raise RecordingError(
                f"{text} of its episodes state is unknown; use `episodes: {{by: whole_file}}`"
            )
        for name, record in sorted(
            metadata.items(), key=lambda item: item[1].get("start", "")
        ):
            if not name.startswith("episode_"):
                continue
            try:
                start, end = (self._common_ns(int(record[k])) for k in ("start", "end"))
            except (KeyError, ValueError) as error:
                raise RecordingError(
                    f"metadata {name!r}: {record} does not state start and end in ns"
                ) from error
            if end < start:
                raise RecordingError(
                    f"metadata {name!r}: ends {(start - end) / NS_PER_S:.3f} s before it starts"
                )
            success = OUTCOMES.get(record.get("success", "").lower())
            instruction = (
                _of_usual_length(record.get("instruction", "").strip())
                or self._instruction()
            )
            found.append(_Interval(start, end, instruction, success, marked=True))
        if not found:
            raise RecordingError(
                f"no metadata record episode_<id>; the recording has {', '.join(metadata) or 'none'}"
            )
        return sorted(found, key=lambda i: i.start_ns)

    def _instruction(self) -> str:
        rule, metadata = self.spec.instruction, self.recording.reader.metadata.values()
        if rule.from_ == "spec":
            return _of_usual_length(rule.text or "")
        if rule.from_ == "topic":
            said = self.recording.texts[rule.topic or ""]
            texts = list(
                dict.fromkeys(text.strip() for _, text in said if text.strip())
            )
            if (n := len(texts)) != 1:
                raise RecordingError(
                    f"{rule.topic} has {n} different instructions{_when(said)}, but needs exactly one: leave the "
                    "recording out, or ingest it alone with `instruction: {from: spec, text: …}` in a copy of the spec"
                )
            return _of_usual_length(texts.pop())
        found = next(
            (
                text
                for record in metadata
                if (text := record.get(rule.key or "", "").strip())
            ),
            None,
        )
        if found is None:
            known = sorted({k for r in metadata for k in r})
            raise RecordingError(
                f"no metadata key {rule.key!r} for the instruction; there are {known or 'none'}"
            )
        return _of_usual_length(found)

    # ---- rows ----

    def _cut_interval(self, interval: _Interval, label: str, result: Cut) -> None:
        spec, fps = self.spec, self.fps
        start_ns = max(
            [interval.start_ns, *(self._first_usable_ns(key) for key in spec.mapped)]
        )
        end_ns = min([interval.end_ns, *self._last_ns().values()])
        self._report_ends(interval, start_ns, end_ns, result)
        grid_ns = timing.make_grid(start_ns, end_ns, fps)
        matches = {key: self._match(key, grid_ns) for key in spec.mapped}
        stale = {
            c: ~m.fresh
            for by_channel in matches.values()
            for c, m in by_channel.items()
        }
        fresh = (
            ~np.any(list(stale.values()), axis=0)
            if len(grid_ns)
            else np.zeros(0, dtype=bool)
        )

        def lost(a: int, b: int, reason: str) -> None:
            result.losses.append(
                Loss(
                    self.seconds(grid_ns[a]),
                    self.seconds(grid_ns[b - 1]),
                    reason,
                    rows=b - a,
                )
            )

        for a, b in timing.runs(~fresh):
            silent = sorted({c for c, s in stale.items() if s[a:b].any()})
            lost(a, b, f"no fresh sample of {', '.join(silent)} for {b - a} rows")
        pieces = timing.runs(fresh)
        for number, (a, b) in enumerate(pieces):
            if (b - a) / fps < spec.episodes.min_s:
                lost(
                    a,
                    b,
                    f"{b - a} rows are shorter than the spec's min_s {spec.episodes.min_s:g}",
                )
                continue
            part = f"part {number}" if len(pieces) > 1 else ""
            name = " ".join(w for w in (self.recording.source.name, label, part) if w)
            # The outcome is what was to be seen at the end: of a part without it, nobody said one.
            slack_ns = END_SLACK_S * NS_PER_S + NS_PER_S // fps
            has_end = (
                b == pieces[-1][1] and interval.end_ns - grid_ns[b - 1] <= slack_ns
            )
            shown = interval if has_end else replace(interval, success=None)
            result.episodes.append(
                self._episode(name, shown, grid_ns[a:b], matches, slice(a, b))
            )

    def _last_ns(self) -> dict[str, int]:
        """Channel → time of the last row that it can fill [ns]; a held channel has no end."""
        found: dict[str, int] = {}
        for key, mapping in self.spec.features.items():
            if key in self.spec.mapped and mapping.align != "hold":
                ahead_ns = (
                    NS_PER_S // self.fps if key == ACTION else 0
                )  # rounded down: rows are 1 / fps apart to 1 ns
                for c in mapping.channels:
                    last_ns = int(self.clocks[c].time_ns[-1]) - ahead_ns
                    found[c] = min(last_ns, found.get(c, last_ns))
        return found

    def _ahead_ns(self, key: str) -> int:
        """Time from a row to that at which its value of ``key`` is taken [ns], rounded as ``timing.next_rows`` rounds row 1."""
        return (NS_PER_S + self.fps // 2) // self.fps if key == ACTION else 0

    def _first_usable_ns(self, key: str) -> int:
        history, firsts = self.spec.target.features[key].history, []
        for name in self.spec.features[key].channels:
            time_ns = self.clocks[name].time_ns
            if len(time_ns) < history:
                raise Unfit(
                    f"{self.spec.channels[name].topic}: {len(time_ns)} samples, but a window needs {history}"
                )
            firsts.append(int(time_ns[history - 1]) - self._ahead_ns(key))
        return max(firsts)

    def _report_ends(
        self, interval: _Interval, start_ns: int, end_ns: int, result: Cut
    ) -> None:
        late = max(self.clocks, key=lambda c: int(self.clocks[c].time_ns[0]))
        last_ns = self._last_ns()
        early = min(last_ns, key=last_ns.__getitem__, default=late)
        if end_ns < start_ns:  # not one row
            reason = (
                f"{early} ends early"
                if start_ns <= interval.end_ns
                else f"{late} begins late"
            )
            rows = (interval.end_ns - interval.start_ns) * self.fps // NS_PER_S + 1
            span_s = self.seconds(interval.start_ns), self.seconds(interval.end_ns)
            result.losses.append(Loss(*span_s, reason, rows=rows))
            return
        # The last command has no row of its own: it is the action of the row before it.
        spare_ns = self._ahead_ns(ACTION) if ACTION in self.spec.mapped else 0
        start_up_s = 0.0 if interval.marked else START_UP_S
        for from_ns, to_ns, slack_s, why in (
            (
                interval.start_ns,
                start_ns,
                start_up_s + END_SLACK_S,
                f"{late} begins late",
            ),
            (end_ns + spare_ns, interval.end_ns, END_SLACK_S, f"{early} ends early"),
        ):
            rows = (to_ns - from_ns + ROUNDING_NS) * self.fps // NS_PER_S
            if rows > 0:
                span_s = self.seconds(from_ns), self.seconds(to_ns)
                within = to_ns - from_ns <= round(slack_s * NS_PER_S)
                result.losses.append(Loss(*span_s, why, within_slack=within, rows=rows))

    def _match(self, key: str, grid_ns: np.ndarray) -> dict[str, Matched]:
        mapping, history = (
            self.spec.features[key],
            self.spec.target.features[key].history,
        )
        # The action of row t is the last command before row t + 1: the target that is sent from row t on (action_time).
        due_ns, found = (
            timing.next_rows(grid_ns, self.fps) if key == ACTION else grid_ns,
            {},
        )
        for name in mapping.channels:
            channel, time_ns = self.spec.channels[name], self.clocks[name].time_ns
            rule = {
                "max_age_s": channel.max_age_s,
                "history": history,
                "rate_hz": channel.rate_hz,
            }
            found[name] = timing.match(due_ns, time_ns, mapping.align, **rule)
        return found

    def _episode(
        self,
        name: str,
        interval: _Interval,
        grid_ns: np.ndarray,
        matches: dict[str, dict[str, Matched]],
        rows: slice,
    ) -> Episode:
        arrays, sources, timings = {}, {}, []
        for key, feature in self.spec.mapped.items():
            timings += [
                self._timing(c, key, m.age_s[rows], grid_ns)
                for c, m in matches[key].items()
            ]
            if feature.dtype == "video":
                ((channel, m),) = matches[key].items()
                sources[key] = (channel, self.clocks[channel].order[m.index[rows, 0]])
            else:
                arrays[key] = self._array(key, feature, matches[key], rows)
        shown, seen = (
            self._pictures,
            {key: index for key, (_, index) in sources.items()},
        )
        what = (
            arrays,
            lambda: shown(sources, len(grid_ns)),
            tuple(sources),
            interval.instruction,
            interval.success,
        )
        facts = (self.origin, tuple(timings), seen, dict(self.baselines))
        jumps = tuple(self._sample_jumps(grid_ns))
        return Episode(
            name, self.spec.target, int(grid_ns[0]), *what, *facts, findings=jumps
        )

    def _sample_jumps(self, grid_ns: np.ndarray) -> Iterator[Finding]:
        """Findings of ``check_sample_jumps`` for the channels of state and action between the first and the last row. Channels
        slower than the rows are skipped: the rows hold all of their samples."""
        for key in (k for k in (STATE, ACTION) if k in self.spec.mapped):
            feature, start = self.spec.target.features[key], 0
            for name in self.spec.features[key].channels:
                values, clock = self.recording.channels[name].values, self.clocks[name]
                assert values is not None
                part = slice(start, start := start + values.shape[1])
                if self.spec.channels[name].rate_hz > self.fps:
                    inside = (clock.time_ns >= grid_ns[0]) & (
                        clock.time_ns <= grid_ns[-1]
                    )
                    time_s = (clock.time_ns[inside] - grid_ns[0]) / NS_PER_S
                    samples = np.asarray(values[clock.order[inside]], dtype=float)
                    release(values)
                    names, units = feature.element_names(key)[part], feature.units[part]
                    yield from check_sample_jumps(
                        name, samples, time_s, names, units, 1 / self.fps
                    )

    def nominal_hz(self, channel: str) -> float:
        """Rate of ``channel`` [Hz] in the metadata (``rate_hz <topic>``), else of the spec. Raises RecordingError: malformed."""
        spec, records = (
            self.spec.channels[channel],
            self.recording.reader.metadata.values(),
        )
        said = next(
            (r[key] for r in records if (key := RATE_OF + spec.topic) in r),
            spec.rate_hz,
        )
        with contextlib.suppress(ValueError):
            if 0.0 < (rate_hz := float(said)) < float("inf"):
                return rate_hz
        text = f"{self.recording.source.name}: metadata {RATE_OF + spec.topic!r} is {said!r}, no rate in Hz above 0: "
        raise RecordingError(
            f"{text}correct it, or leave it out, and the spec's {spec.rate_hz:g} Hz is used"
        )

    def _timing(
        self, channel: str, key: str, age_s: np.ndarray, grid_ns: np.ndarray
    ) -> ChannelTiming:
        clock = self.clocks[channel]
        inside = clock.time_ns[
            (clock.time_ns >= grid_ns[0]) & (clock.time_ns <= grid_ns[-1])
        ]
        steps = np.diff(inside) / NS_PER_S
        median = float(np.median(steps)) if len(steps) else float("inf")
        rate_hz, longest_s = (
            (round(1.0 / median, 3), round(float(steps.max()), 6))
            if len(steps)
            else (0.0, 0.0)
        )
        ages = (round(float(np.median(age_s)), 6), round(float(age_s.max()), 6))
        skipped, nominal_hz = (
            dict(self.recording.channels[channel].skipped),
            self.nominal_hz(channel),
        )
        counts = (
            clock.duplicates,
            clock.out_of_order,
            clock.zero_stamps,
            skipped,
            nominal_hz,
        )
        align, gaps = self.spec.features[key].align, int((steps > 1.5 * median).sum())
        return ChannelTiming(
            channel, key, align, rate_hz, gaps, longest_s, *ages, *counts
        )

    def _array(
        self, key: str, feature: FeatureSpec, matches: dict[str, Matched], rows: slice
    ) -> np.ndarray:
        """(T, size) of one feature, in its dtype."""
        parts = []
        for name, m in matches.items():
            values, order, index = (
                self.recording.channels[name].values,
                self.clocks[name].order,
                m.index[rows],
            )
            assert values is not None
            parts.append(
                np.asarray(values[order[index]])
            )  # (T, L, size of the channel)
            release(values)
        joined = np.concatenate(parts, axis=2)
        if key in self.baselines:
            joined = np.subtract(
                joined, self.baselines[key], dtype=np.int16, casting="unsafe"
            )  # max_count fits int16
        out = joined.reshape(len(joined), -1)
        if out.shape[1] != feature.size:
            raise RecordingError(
                f"{key}: {', '.join(matches)} have {out.shape[1]} values, the spec {feature.size}"
            )
        return out.astype(feature.dtype, copy=False)

    # ---- pictures ----

    def _pictures(
        self, sources: dict[str, tuple[str, np.ndarray]], num_rows: int
    ) -> Iterator[Pictures]:
        """Rows' pictures, decoded once each, in one pass over the file."""
        if not sources:
            return
        due = {
            key: [self._identities[c][int(i)] for i in index]
            for key, (c, index) in sources.items()
        }
        needed = {key: set(ids) for key, ids in due.items()}
        wanted: dict[str, list[Identity]] = {}
        for key, (channel, _) in sources.items():
            wanted.setdefault(channel, []).extend(due[key])
        waiting: dict[str, dict[Identity, Any]] = {key: {} for key in sources}
        shown: dict[str, tuple[Identity | None, Any]] = dict.fromkeys(
            sources, (None, None)
        )
        row = 0
        for channel, identity, payload in self.recording.pictures(wanted):
            for key in sources:
                if sources[key][0] == channel and identity in needed[key]:
                    waiting[key][identity] = payload
            if sum(map(len, waiting.values())) > MAX_WAITING_PICTURES:
                text = f"{MAX_WAITING_PICTURES} pictures of one camera come before any of another: cameras are not "
                raise RecordingError(f"{text}interleaved in the file")
            while row < num_rows and all(
                due[k][row] in waiting[k] or shown[k][0] == due[k][row] for k in sources
            ):
                for key in sources:
                    if shown[key][0] != (ident := due[key][row]):
                        shown[key] = (
                            ident,
                            self._decode(
                                key, sources[key][0], ident, waiting[key].pop(ident)
                            ),
                        )
                yield {key: picture for key, (_, picture) in shown.items()}
                row += 1
        if row < num_rows:
            name = self.recording.source.name
            raise RecordingError(
                f"{name}: its pictures ended at row {row} of {num_rows}: did the file change?"
            )

    def _decode(
        self, key: str, channel: str, identity: Identity, payload: Any
    ) -> np.ndarray:
        rows, columns, _ = self.spec.target.features[key].shape
        try:
            picture = pictures.picture(payload, self.spec.channels[channel])
            self._sizes.setdefault(key, Counter())[picture.shape[:2]] += 1
            return pictures.letterbox(picture, rows, columns)
        except RecordingError as error:
            raise BrokenPicture(
                f"{channel}: the picture logged at {identity[0]} ns is broken: {error}"
            ) from error

    def size_findings(self) -> list[Finding]:
        """Findings on cameras whose pictures, as far as they were decoded, changed their size."""
        found, why = (
            [],
            "the camera was set up anew in mid-recording; the same place is not the same pixel in all rows",
        )
        for key, sizes in self._sizes.items():
            several = ", ".join(
                f"{rows}×{columns} {count} times"
                for (rows, columns), count in sizes.items()
            )
            text = f"{key}: its pictures have several sizes ({several}): {why}"
            found += [finding("picture_size", key, text)] if len(sizes) > 1 else []
        return found

    def drop_broken_pictures(self) -> int:
        """Decode every picture once and drop those that do not decode: their rows show an older picture, or the episode is
        split. Returns the number of dropped pictures."""
        broken = 0
        for channel, identity, payload in self.recording.pictures(self._identities):
            try:
                pictures.picture(payload, self.spec.channels[channel])
            except RecordingError:
                self.dropped.setdefault(channel, set()).add(identity)
                self.broken_pictures_s.setdefault(channel, []).append(
                    self.seconds(self._common_ns(identity[0]))
                )
                broken += 1
        self.clocks = self._read_clocks()
        return broken


def _when(said: Sequence[tuple[int, str]]) -> str:
    """Text of when each instruction begins, such as ``: 'pick it up' from 0.00 s, 'put it down' from 0.67 s``."""
    changed = [
        (time_ns, text.strip())
        for k, (time_ns, text) in enumerate(said)
        if text.strip() and (k == 0 or text.strip() != said[k - 1][1].strip())
    ]
    each = [
        f"{text[:60]!r} from {(time_ns - said[0][0]) / NS_PER_S:.2f} s"
        for time_ns, text in changed
    ]
    return f": {listed(each)}" if each else ""


def _of_usual_length(instruction: str) -> str:
    if len(instruction) > MOST_INSTRUCTION:
        text = f"an instruction of {len(instruction):,} characters, {instruction[:40]!r} …; at most "
        raise RecordingError(f"{text}{MOST_INSTRUCTION:,} are read")
    return instruction


def _parted(interval: _Interval, step: SetBack) -> list[_Interval]:
    """The interval before and after a step of the clock; the operator's judgement is of the part in which it was given."""
    if not interval.start_ns <= step.end_ns < step.start_ns <= interval.end_ns:
        return [interval]
    before = replace(
        interval,
        end_ns=step.end_ns,
        success=None if interval.marked else interval.success,
    )
    return [before, replace(interval, start_ns=step.start_ns)]


@contextlib.contextmanager
def open_episodes(
    path: Path, spec: str | Path | RecordingSpec
) -> Iterator[list[Episode]]:
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
