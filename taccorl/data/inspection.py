"""What a recording holds: channels, rates, gaps, clock skew, damage; and a draft spec to start from."""

import itertools
import json
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from taccorl.data import decode
from taccorl.data.recording import Damage, Source, TopicType, readers
from taccorl.data.spec import DatasetSpec, data_specs_folder, load_dataset_spec, load_recording_spec
from taccorl.data.timing import NS_PER_S, SIM_TIME_S
from taccorl.errors import SpecError

PICTURES = ("CompressedImage", "Image")
VECTORS = ("JointState", "MultiArray", "Imu", "Pose", "Twist", "Wrench")
TEXTS = ("String",)
YAML_WORDS = ("true", "false", "yes", "no", "on", "off", "null", "y", "n")


@dataclass(frozen=True)
class TopicSummary:
    """One topic, measured over the whole recording."""

    topic: str
    type: TopicType
    num_messages: int
    first_ns: int
    last_ns: int
    rate_hz: float
    """1 / median interval of its own stamps (log times where it has none); 0 with fewer than two messages."""
    longest_gap_s: float
    num_gaps: int
    """Intervals longer than 1.5 median intervals."""
    stamped: bool
    skew_s: float
    """Median of log time − header stamp; 0 without a header."""
    skew_p99_s: float
    repeated: int
    """Messages with the stamp of an earlier one."""
    zero_stamps: int
    """Messages stamped 0, where others have a time."""

    @property
    def problem(self) -> str:
        """Why its values cannot be decoded, with its name; empty where they can."""
        why = self.type.undecodable or ""
        return why if not why or why.startswith(self.topic) else f"{self.topic}: {why}"

    @property
    def sim_time(self) -> bool:
        """The header counts from a simulation's start (or from boot), not from 1970."""
        return self.stamped and abs(self.skew_s) > SIM_TIME_S


@dataclass(frozen=True)
class Inventory:
    """One recording, looked at."""

    source: Source
    reader: str
    topics: tuple[TopicSummary, ...]
    metadata: dict[str, dict[str, str]]
    damage: tuple[Damage, ...]
    fits: tuple[str, ...] = field(default=())
    """Shipped recording specs whose topics are all here."""

    @property
    def duration_s(self) -> float:
        spans = [(t.first_ns, t.last_ns) for t in self.topics if t.num_messages]
        return (max(b for _, b in spans) - min(a for a, _ in spans)) / NS_PER_S if spans else 0.0


def inspect_source(reader_name: str, source: Source) -> Inventory:
    """Read every message's times, decode nothing.

    Raises:
        RecordingError: not of that format, or empty.
    """
    reader = readers.get(reader_name)(source)
    times: dict[str, tuple[list[int], list[int | None]]] = {}
    for m in reader.messages(None):
        log, stamp = times.setdefault(m.topic, ([], []))
        log.append(m.log_ns)
        stamp.append(m.stamp_ns)
    types = reader.topics()
    summaries = [_summary(topic, types[topic], *times.get(topic, ([], []))) for topic in sorted(types)]
    with_messages = {t.topic: t.type.name for t in summaries if t.num_messages}
    return Inventory(
        source,
        reader_name,
        tuple(summaries),
        dict(reader.metadata),
        tuple(reader.damage),
        _fitting(reader_name, with_messages),
    )


def _summary(topic: str, kind: TopicType, log: list[int], stamps: list[int | None]) -> TopicSummary:
    log_ns = np.array(log, dtype=np.int64)
    stamped = bool(stamps) and all(s is not None and s != 0 for s in stamps[len(stamps) // 2 :])
    stamp_ns = np.array([s or 0 for s in stamps], dtype=np.int64)
    good = stamp_ns != 0
    own = np.sort(stamp_ns[good]) if stamped else np.sort(log_ns)
    steps = np.diff(own)[np.diff(own) > 0] / NS_PER_S
    median = float(np.median(steps)) if len(steps) else 0.0
    skew = (log_ns[good] - stamp_ns[good]) / NS_PER_S if stamped else np.zeros(1)
    return TopicSummary(
        topic=topic,
        type=kind,
        num_messages=len(log),
        first_ns=int(log_ns[0]) if len(log) else 0,
        last_ns=int(log_ns[-1]) if len(log) else 0,
        rate_hz=1.0 / median if median else 0.0,
        longest_gap_s=float(steps.max()) if len(steps) else 0.0,
        num_gaps=int((steps > 1.5 * median).sum()),
        stamped=stamped,
        skew_s=float(np.median(skew)),
        skew_p99_s=float(np.quantile(np.abs(skew - np.median(skew)), 0.99)),
        repeated=int((np.diff(own) == 0).sum()),
        zero_stamps=int((~good).sum()) if stamped else 0,
    )


def _fitting(reader_name: str, topics: dict[str, str]) -> tuple[str, ...]:
    """Shipped specs whose topics are all there, with their types."""
    names = []
    for path in sorted((data_specs_folder() / "recordings").glob("*.yaml")):
        try:
            spec = load_recording_spec(path)
        except SpecError:
            continue
        texts = {t for t in (spec.episodes.topic, spec.instruction.topic) if t}
        there = all(
            c.topic in topics and (c.type is None or decode.type_key(c.type) == decode.type_key(topics[c.topic]))
            for c in spec.channels.values()
        )
        if spec.reader == reader_name and there and texts <= set(topics):
            names.append(path.stem)
    return tuple(names)


def draft_spec(inventory: Inventory, folder: Path | None = None) -> str:
    """A recording spec to start from, as YAML text: the channels as measured, the features left to fill in.

    Args:
        folder: where the draft will lie; ``data_specs/recordings`` if not given.
    """
    useful = [t for t in inventory.topics if t.num_messages and t.type.undecodable is None]
    vectors = [t for t in useful if _is(t, VECTORS) or (t.type.shape is not None and len(t.type.shape) <= 1)]
    pictures = [t for t in useful if _is(t, PICTURES) or (t.type.shape is not None and len(t.type.shape) == 3)]
    texts = [t for t in useful if _is(t, TEXTS)]
    stamped = [t for t in vectors + pictures if t.stamped]
    clock = "header" if stamped and not any(t.sim_time for t in stamped) else "log"
    names = _channel_names(vectors + pictures)
    rate_known = "rate" not in inventory.metadata.get("time", {})  # how the HDF5 reader says that it had to guess
    dataset_path = data_specs_folder() / "taccorl_bimanual.yaml"
    away = folder is not None and folder.resolve() != (data_specs_folder() / "recordings").resolve()
    dataset = _yaml(str(dataset_path)) if away else f"../{dataset_path.name}"
    lines = [
        f"# Draft from {' '.join(inventory.source.name.split())}: replace every TODO and check every line;",
        "# `taccorl ingest … --dry_run=true` tells what is still wrong.",
        "spec_version: 1",
        f"dataset: {dataset}   # what the dataset shall hold; cobot_magic.yaml beside it is the same without touch",
        f"reader: {inventory.reader}",
        f"clock: {clock}",
        "episodes: {by: whole_file, min_s: 1.0}"
        + (f"   # or {{by: markers, topic: {texts[0].topic}, min_s: 1.0}}" if texts else ""),
        "instruction: {from: spec, text: TODO}",
        "channels:   # keep what a feature below uses, remove the rest",
    ]
    lines += [f"  {names[t.topic]}: {_channel(t, clock, rate_known)}" for t in vectors + pictures]
    skipped = [t for t in inventory.topics if t not in vectors and t not in pictures and t not in texts]
    lines += [f"  # not used: {' '.join((t.problem or f'{t.topic} ({t.type.name})').split())}" for t in skipped]
    lines.append("features:   # several channels are joined in the order of the list")
    lines += _features(load_dataset_spec(dataset_path), [names[t.topic] for t in pictures])
    return "\n".join(lines) + "\n"


def _features(dataset: DatasetSpec, pictures: list[str]) -> list[str]:
    lines = []
    for key, feature in dataset.features.items():
        todo, hint = ["TODO"], f"{feature.size} values: {' … '.join(feature.names[:: max(1, feature.size - 1)])}"
        if feature.dtype == "video":
            hint = f"one of {', '.join(pictures)}" if pictures else "no pictures were found"
        elif feature.pads:
            todo, hint = ["TODO"] * len(feature.pads), f"pads {', '.join(feature.pads)}"
        if not feature.optional:
            lines.append(f"  {key}: {{channels: [{', '.join(todo)}], align: asof}}   # {hint}")
    return lines


def _is(t: TopicSummary, words: tuple[str, ...]) -> bool:
    return any(word in decode.type_key(t.type.name).rsplit("/", 1)[-1] for word in words)


def _channel_names(topics: list[TopicSummary]) -> dict[str, str]:
    """Topic → a short name of its own."""
    names: dict[str, str] = {}
    for t in topics:
        words = re.sub(r"[^A-Za-z0-9/]+", "_", t.topic).strip("/_").split("/")
        short = [w for w in words if w not in ("image_raw", "compressed", "color")]
        name = "_".join(short) or "channel"
        name = "_".join(words) if name in names.values() else name
        name = name if name[0].isalpha() and name.lower() not in YAML_WORDS else f"channel_{name}"
        numbered = (f"{name}_{k}" for k in itertools.count(2))
        names[t.topic] = name if name not in names.values() else next(n for n in numbered if n not in names.values())
    return names


def _channel(t: TopicSummary, clock: str, rate_known: bool) -> str:
    rate = float(f"{t.rate_hz:.3g}") if t.rate_hz else 1.0
    parts = [f"topic: {_yaml(t.topic)}"]
    if t.type.name and t.type.name != "no schema" and t.type.shape is None:
        parts.append(f"type: {_yaml(t.type.name)}")
    if _is(t, ("JointState",)):
        parts += ["field: position", "pick: [TODO]"]
    elif _is(t, ("MultiArray",)):
        parts.append("field: data")
    if clock == "header" and not t.stamped:
        parts.append("clock: log")
    if clock == "header" and t.zero_stamps:
        parts.append("drop_zero_stamp: true")
    if rate_known:
        parts += [f"rate_hz: {rate:g}", f"max_age_s: {max(0.03, round(2.4 / rate, 3)):g}"]
    else:
        parts += ["rate_hz: TODO", "max_age_s: TODO"]
    return "{" + ", ".join(parts) + "}"


def _yaml(text: str) -> str:
    """A text as YAML reads it back; quoted unless it is plainly a name or path."""
    plain = re.fullmatch(r"/?[A-Za-z_][A-Za-z0-9_/.-]*", text)
    return text if plain and text.lower() not in YAML_WORDS else json.dumps(text, ensure_ascii=False)
