"""Measurements from recordings: MCAP, bags, HDF5.

A recording is read at its own command rate, not at the dataset's 30 rows per second. One file is one measurement, including the
rests before and after the motion. Its clock is an even grid through the command's stamps. A sample on the grid is used
unchanged; between samples the value is interpolated linearly, which keeps the mean time of commands and positions (holding the
last sample would delay them by half a period). Longer gaps are not interpolated.
"""

import dataclasses
import json
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from taccorl.alignment.measurements.measurement import (
    UNITS,
    Measurement,
    Touch,
    TouchPad,
)
from taccorl.alignment.measurements.quantisation import find_quantum
from taccorl.data import decode
from taccorl.data.cutting import Cutter, Unfit
from taccorl.data.episode import ChannelTiming
from taccorl.data.finding import Finding
from taccorl.data.recording import Recording, Source, opened, readers
from taccorl.data.spec import (
    ACTION,
    STATE,
    DatasetSpec,
    EpisodesSpec,
    InstructionSpec,
    RecordingSpec,
)
from taccorl.data.timing import NS_PER_S
from taccorl.errors import RecordingError

TACTILE = "observation.tactile"  # Begin of the keys of touch
_EXTRA = {"effort": ("effort",), "velocity": ("qvel", "velocity")}
"""What lies beside a position: the message's field of that name, or (HDF5) a neighbouring array so named."""


def read_recording(source: Source, spec: RecordingSpec) -> Measurement:
    """Read one recording as a measurement. Episode markers are ignored; the instruction is that of the first episode. Raises
    RecordingError: the recording is not readable, a topic of the spec is missing, or commands and states do not overlap."""
    narrow, spans = _joint_channels(source, spec)
    with opened(source, narrow) as recording:
        found: list[Finding] = []
        rows = _Rows(_cutter(recording, found), spans)
        found += [
            Finding("damaged", "warning", "file", f"{d}; copy it again")
            for d in recording.damage
            if d.lost
        ]
        found += [
            Finding(
                "touch_not_read",
                "note",
                key,
                f"{key}: no `sensor` in the dataset spec states its pads, so that it "
                "is not compared",
            )
            for key in spec.features
            if key.startswith(TACTILE) and key not in spec.target.sensors
        ]
        return rows.measurement(_notes(recording, spec), (*found, *rows.cut_short()))


def pad_features(spec: DatasetSpec) -> list[str]:
    """Keys of the features with pads' newest frames, in the spec's order: those whose
    sensor the spec states."""
    features = spec.features
    return [k for k in spec.sensors if k in features and features[k].history == 1]


def pads_of(spec: DatasetSpec, key: str) -> list[TouchPad]:
    """The pads of the feature ``key``, in its order."""
    sensor = spec.sensors[key]
    shape = sensor.rows, sensor.columns
    return [
        TouchPad(name, shape, sensor.gain_per_count) for name in spec.features[key].pads
    ]


def signal_names(spec: DatasetSpec) -> tuple[str, ...]:
    """taccorl's names for the J elements of state and action, in their order: ``left_joint_5.pos`` is ``left_joint5``. Raises
    RecordingError: state and action differ, or hold units other than rad and m."""
    state, action = (spec.features.get(key) for key in (STATE, ACTION))
    if (
        state is None
        or action is None
        or not state.names
        or state.names != action.names
    ):
        raise RecordingError(
            f"{spec.name}: {STATE} and {ACTION} must both exist, with the same names of elements"
        )
    if state.unit != action.unit or set(signal_units(spec)) - set(UNITS):
        raise RecordingError(
            f"{spec.name}: {STATE} and {ACTION} must both be in rad and m, but are in {state.unit}"
        )
    return tuple(
        re.sub(r"^(left|right)_joint_(\d+)$", r"\1_joint\2", name.removesuffix(".pos"))
        for name in state.names
    )


def signal_units(spec: DatasetSpec) -> tuple[str, ...]:
    """Unit of each of the J elements of the state, in their order."""
    state = spec.features[STATE]
    return (state.unit,) * state.size if isinstance(state.unit, str) else state.unit


@dataclasses.dataclass(frozen=True)
class _Span:
    """Where the values of one extra channel belong; ``kind``: effort or velocity."""

    kind: str
    first: int
    size: int


def _joint_channels(
    source: Source, spec: RecordingSpec
) -> tuple[RecordingSpec, dict[str, _Span]]:
    """The spec without pictures, with effort and velocity beside each state channel where the recording has them."""
    keys = (STATE, ACTION, *pad_features(spec.target))
    wanted = [key for key in keys if key in spec.features]
    names = signal_names(spec.target)
    channels = {
        c: spec.channels[c] for key in wanted for c in spec.features[key].channels
    }
    states = [spec.channels[c] for c in spec.features[STATE].channels]
    firsts = _first_messages(source, spec, [c.topic for c in states])
    present = readers.get(spec.reader)(source, spec).topics()
    spans: dict[str, _Span] = {}
    at = 0
    for name, state in zip(spec.features[STATE].channels, states, strict=True):
        width = len(state.pick) or (
            len(names) if len(states) == 1 else len(names) // len(states)
        )
        for kind, beside in _EXTRA.items():
            extra, size = None, width
            if state.field == "position" and state.pick:
                extra, size = (
                    dataclasses.replace(state, field=kind, scale=()),
                    _listed(firsts.get(state.topic), kind),
                )
                if (
                    0 < size < width
                    and tuple(decode.get(firsts[state.topic], "name"))[:size]
                    == state.pick[:size]
                ):
                    # piper_ros: six velocities for seven names, in their order
                    extra = dataclasses.replace(extra, pick=())
            elif state.topic.endswith("/qpos"):
                topic = next(
                    (
                        t
                        for b in beside
                        if (t := state.topic.removesuffix("qpos") + b) in present
                    ),
                    None,
                )
                extra = (
                    dataclasses.replace(state, topic=topic, scale=()) if topic else None
                )
            if (
                extra is not None
                and 0 < size <= width
                and (size == width or not extra.pick)
            ):
                channels[f"{name}.{kind}"] = extra
                spans[f"{name}.{kind}"] = _Span(kind, at, size)
        at += width
    narrow = dataclasses.replace(
        spec,
        channels=channels,
        features={key: spec.features[key] for key in wanted},
        episodes=EpisodesSpec(by="whole_file"),
        # Asked for as a topic, texts may be absent: a sweep needs no markers.
        instruction=InstructionSpec(
            from_="topic", topic=spec.episodes.topic or spec.instruction.topic
        ),
    )
    return narrow, spans


def _first_messages(
    source: Source, spec: RecordingSpec, topics: list[str]
) -> dict[str, Any]:
    firsts: dict[str, Any] = {}
    for message in readers.get(spec.reader)(source, spec).messages(topics):
        firsts.setdefault(message.topic, message.value)
        if len(firsts) == len(set(topics)):
            break
    return firsts


def _listed(message: Any, field: str) -> int:
    """How many numbers a message lists there."""
    try:
        return int(np.size(decode.get(message, field)))
    except RecordingError:
        return 0


def _cutter(recording: Recording, found: list[Finding]) -> Cutter:
    """Clocks and baselines; without touch where the pads were not at rest at the start."""
    try:
        return Cutter(recording)
    except Unfit as why:
        pads = pad_features(recording.spec.target)
        features = {k: f for k, f in recording.spec.features.items() if k not in pads}
        text = f"touch is left out: {why}. Record a second without touch first"
        found.append(Finding("no_baseline", "warning", ", ".join(pads), text))
        return Cutter(
            dataclasses.replace(
                recording, spec=dataclasses.replace(recording.spec, features=features)
            )
        )


def _notes(recording: Recording, spec: RecordingSpec) -> dict[str, Any]:
    """Fields of ``Measurement`` that are written down in a recording besides its channels: its origin, and metadata records of
    any name with their keys, numbers and places as JSON."""
    written = {
        k: v for record in recording.reader.metadata.values() for k, v in record.items()
    }
    texts = [text for topic in recording.texts.values() for _, text in topic]
    if spec.episodes.by == "markers":
        texts = [t.removeprefix("start:") for t in texts if t.startswith("start:")]
    told = next(
        (t.strip() for t in texts if t.strip()),
        written.get("instruction", spec.instruction.text or ""),
    )

    def stated(key: str, value: Callable[[Any], Any], example: str) -> dict[str, Any]:
        try:
            return {
                str(k): value(v) for k, v in json.loads(written.get(key, "{}")).items()
            }
        except (ValueError, TypeError, AttributeError) as error:
            text = f"metadata {key} is {written[key]!r}; expected a value such as {example}"
            raise RecordingError(f"{recording.source.name}: {text}") from error

    found = {
        key: stated(key, float, '{"left_joint5": 40.0}')
        for key in ("kp", "kd", "gain_scale", "payload_kg")
    }

    def three(values: Any) -> tuple[float, ...]:
        return tuple(np.reshape(values, 3).astype(float).tolist())

    found["payload_position_m"] = stated(
        "payload_position_m", three, '{"left": [0, 0, 0.168]}'
    )
    return {
        "origin": recording.origin,
        "instruction": told,
        "repeat_of": written.get("repeat_of") or None,
        **found,
    }


class _Rows:
    """Channels of one recording on the command's grid."""

    def __init__(self, cutter: Cutter, spans: dict[str, _Span]) -> None:
        self.cutter, self.spans, self.spec = cutter, spans, cutter.spec
        self.commands, self.states = (
            self.spec.features[key].channels for key in (ACTION, STATE)
        )
        self.rate_hz = self._rate_hz()
        self.period_ns = round(NS_PER_S / self.rate_hz)
        self.grid_ns = self._grid()

    def _rate_hz(self) -> float:
        many = [c for c in self.commands if len(self.cutter.clocks[c].time_ns) > 1]
        rates = {
            c: NS_PER_S / float(np.median(np.diff(self._time_ns(c)))) for c in many
        }
        if not rates:
            raise RecordingError(
                f"{self.cutter.recording.source.name}: fewer than two commands: nothing to replay"
            )
        name, rate_hz = max(rates.items(), key=lambda item: item[1])
        said = self.cutter.nominal_hz(name)
        # Within 2 % it is the spec's rate: the clock drifts.
        return said if abs(rate_hz / said - 1) < 0.02 else rate_hz

    def _time_ns(self, channel: str) -> np.ndarray:
        return self.cutter.clocks[channel].time_ns

    def _values(self, channel: str) -> np.ndarray:
        values = self.cutter.recording.channels[channel].values
        assert values is not None, "joint channels hold numbers"
        return np.asarray(values[self.cutter.clocks[channel].order], dtype=float)

    def _grid(self) -> np.ndarray:
        """(T,) ns from the first to the last common instant, through the stamps of the command that moves most."""
        both = (*self.commands, *self.states)
        start = max(int(self._time_ns(c)[0]) for c in both)
        end = min(int(self._time_ns(c)[-1]) for c in both)
        moves = max(
            self.commands, key=lambda c: float(np.ptp(self._values(c), axis=0).max())
        )
        stamps = self._time_ns(moves)
        half = self.period_ns // 2
        # Median distance from the nearest tick: stamps jitter about the instant at which the driver meant to send.
        first = int(stamps[0]) + int(
            np.median((stamps - stamps[0] + half) % self.period_ns - half)
        )
        first += max(0, -(-(start - first) // self.period_ns)) * self.period_ns
        if end - first < 2 * self.period_ns:
            raise RecordingError(
                f"{self.cutter.recording.source.name}: commands and states overlap for "
                f"{max(0, end - start) / NS_PER_S:.3f} s; record both from before the motion to after it"
            )
        num_rows = (end - first) // self.period_ns + 2
        # rounded one by one: no drift
        grid = first + np.rint(np.arange(num_rows) * (NS_PER_S / self.rate_hz)).astype(
            np.int64
        )
        return grid[grid <= end]

    def cut_short(self) -> list[Finding]:
        """Warning for each channel of commands or states that ends more than a second before another."""
        ends_s = {
            c: int(self._time_ns(c)[-1]) / NS_PER_S
            for c in (*self.commands, *self.states)
        }
        short = {c: max(ends_s.values()) - end_s for c, end_s in ends_s.items()}
        text = "before the last channel; rows after it are left out. Record again, or leave this recording out"
        return [
            Finding("cut_short", "warning", c, f"{c} ends {s:.3f} s {text}")
            for c, s in short.items()
            if s > 1.0
        ]

    def _on_grid(self, channel: str, *, held: bool) -> np.ndarray:
        """(T, size) of one channel; across long gaps held (a command stays in force) or NaN (nobody knows)."""
        time_ns, values = self._time_ns(channel), self._values(channel)
        before = np.clip(
            np.searchsorted(time_ns, self.grid_ns, side="right") - 1,
            0,
            len(time_ns) - 1,
        )
        after = np.minimum(before + 1, len(time_ns) - 1)
        step = np.maximum(time_ns[after] - time_ns[before], 1)
        past = np.clip(self.grid_ns - time_ns[before], 0, None)
        # A driver occasionally loses one or two samples.
        long = (step > 3.0 * self.period_ns) & (past > 0)
        # A command after a long silence: in force until one period before the next, then on the line to it.
        late = np.clip(1 - (time_ns[after] - self.grid_ns) / self.period_ns, 0.0, 1.0)
        share = np.where(long, late if held else np.nan, past / step)
        share = np.where(after == before, 0.0, share)
        return values[before] + share[:, None] * (values[after] - values[before])

    def measurement(
        self, notes: dict[str, Any], findings: tuple[Finding, ...]
    ) -> Measurement:
        names = signal_names(self.spec.target)
        extra = {
            kind: np.full((len(self.grid_ns), len(names)), np.nan) for kind in _EXTRA
        }
        for channel, span in self.spans.items():
            extra[span.kind][:, span.first : span.first + span.size] = self._on_grid(
                channel, held=False
            )
        raw = [self._values(c) for c in self.states]
        features = pad_features(self.spec.target)
        features = [key for key in features if key in self.spec.features]
        touch = self._touch(features) if features else None
        source = self.cutter.recording.source
        no_clock = self.spec.reader == "hdf5"  # row k is k / rate, whenever it was
        return Measurement(
            name=source.path.name + (f"#{source.part}" if source.part else ""),
            time_s=(self.grid_ns - self.grid_ns[0]) / NS_PER_S,
            target=np.concatenate(
                [self._on_grid(c, held=True) for c in self.commands], axis=1
            ),
            measured=np.concatenate(
                [self._on_grid(c, held=False) for c in self.states], axis=1
            ),
            velocity=extra["velocity"],
            effort=extra["effort"],
            signals=names,
            units=signal_units(self.spec.target),
            quantum=np.array(
                [find_quantum(column) for part in raw for column in part.T]
            ),
            touch=touch,
            source=source.path,
            **notes,
            start_ns=int(self.grid_ns[0]),
            time_error_s=self.period_ns / NS_PER_S if no_clock else 0.0,
            timing=tuple(
                self._timing(c, key)
                for key in (STATE, ACTION)
                for c in self.spec.features[key].channels
            ),
            findings=findings,
        )

    def _timing(self, channel: str, key: str) -> ChannelTiming:
        clock = self.cutter.clocks[channel]
        steps = np.diff(clock.time_ns) / NS_PER_S
        median = float(np.median(steps)) if len(steps) else math.inf
        off = np.abs(
            (clock.time_ns - self.grid_ns[0] + self.period_ns // 2) % self.period_ns
            - self.period_ns // 2
        )
        return ChannelTiming(
            channel=channel,
            feature=key,
            align="line",
            rate_hz=round(1.0 / median, 3),
            gaps=int((steps > 1.5 * median).sum()),
            longest_gap_s=round(float(steps.max()), 6) if len(steps) else 0.0,
            age_median_s=round(float(np.median(off)) / NS_PER_S, 6),
            age_max_s=round(float(off.max()) / NS_PER_S, 6),
            duplicates=clock.duplicates,
            out_of_order=clock.out_of_order,
            zero_stamps=clock.zero_stamps,
            nominal_hz=self.cutter.nominal_hz(channel),
        )

    def _touch(self, features: list[str]) -> Touch:
        """Frame n of the first pad, with each other pad's nearest frame; every pad keeps its own times.
        Specs take off a scan as latency, to say when a frame began; here a frame's time is the end of its scan."""
        sensors = self.spec.target.sensors
        scan_s = {
            channel: sensors[key].scan_time_s
            for key in features
            for channel in self.spec.features[key].channels
        }
        first = self._time_ns(next(iter(scan_s)))
        columns, times = [], []
        for channel in scan_s:
            time_ns = self._time_ns(channel)
            after = np.clip(np.searchsorted(time_ns, first), 1, len(time_ns) - 1)
            nearer = np.where(
                first - time_ns[after - 1] <= time_ns[after] - first, after - 1, after
            )
            columns.append(self._values(channel)[nearer])
            start_s = (time_ns[nearer] - self.grid_ns[0]) / NS_PER_S
            times.append(start_s + scan_s[channel])
        baseline = np.concatenate([self.cutter.baselines[key] for key in features])
        counts = np.concatenate(columns, axis=1) - baseline
        return Touch(
            time_s=np.stack(times, axis=1),
            counts=counts.astype(np.int16),
            baseline=baseline,
            pads=tuple(
                pad for key in features for pad in pads_of(self.spec.target, key)
            ),
        )
