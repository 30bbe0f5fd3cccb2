"""HDF5 files of rows (ALOHA, AgileX cobot_magic, robomimic): a topic is the path of an HDF5 dataset, and sample k is row k.

A file is one episode, or each of its groups demo_0, demo_1 … is one, with paths from there. Times follow from the rate that the
spec's channels state (``clock: log``), or are the file's own time stamps (``clock: header``); where both are known and differ,
the file is refused. Pictures may be raw or compressed one by one, padded or not.
"""

import contextlib
import functools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from taccorl.data import decode
from taccorl.data.file_kinds import no_recording
from taccorl.data.finding import listed
from taccorl.data.recording import Damage, Message, Reader, Source, Topics, TopicType, readers
from taccorl.data.spec import ACTION, RecordingSpec
from taccorl.data.timing import NS_PER_S, check_stamps
from taccorl.errors import RecordingError

BLOCK_BYTES = 4 << 20  # Number of bytes that are read at once
MOST_ROWS = 1_000_000
"""Most rows that an HDF5 dataset may have: 9 hours at 30 Hz. A file of a few kilobytes can hold any number of equal rows, and a
million take some 10 s."""
MOST_BLOCK_BYTES = 1 << 30
"""Largest block that is read at once, a chunk or a row [bytes]. 1000 pictures of 480×640 are 0.9 GB."""
COMPRESSED = (b"\xff\xd8\xff", b"\x89PNG")  # how JPEG and PNG begin
RATE_ATTRIBUTES = ("fps", "frequency")  # Attributes of a file in which its rate of rows may be stated [Hz]
EPISODE_WORDS = (
    *("", "demo", "demonstration", "ep", "episode", "traj", "trajectory"),
    *("rollout", "trial", "sequence", "seq"),
)
"""Names of groups, before their number, that are one episode each: robomimic, MimicGen and their like."""
DEEPEST_EPISODES = 3  # Levels of groups that are searched for episodes
TIME_WORDS = ("time", "stamp", "clock")  # How words in the name of a dataset of time stamps begin
RATES_HZ = (0.5, 5000.0)
"""Lowest and highest plausible rate of rows, which tells the unit of time stamps that do not count from 1970 [Hz]."""
RATE_TOLERANCE = 0.02  # Largest accepted difference of the time stamps' rate from that of the spec, as a share
LONGEST_STEP = 2.5  # Longest accepted step of the time stamps, in periods of the spec's rate
BOOKKEEPING = ("/compress_len",)  # ALOHA: bytes of each padded picture; decoders find the end themselves


@dataclass(frozen=True)
class RowClock:
    """Times of the rows of a file without time stamps, at a fixed rate. Time 0 is the first row that every channel of the spec
    can fill."""

    rate_hz: float
    lead_frames: dict[str, int]
    """Topic → number of rows by which its samples are shifted: sample k is valid at row k + lead_frames
    (``ChannelSpec.lead_frames``)."""
    first_row: int = 0
    """Row of the file at time 0."""

    @classmethod
    def of(cls, rate_hz: float, spec: RecordingSpec | None) -> "RowClock":
        """Clock for the channels of a spec. Raises RecordingError: two channels of one topic state different ``lead_frames``,
        or a channel of ``action`` states none."""
        leads: dict[str, int] = {}
        firsts = [0]
        commands = spec.features[ACTION].channels if spec and ACTION in spec.features else ()
        for name, channel in spec.channels.items() if spec else ():
            if name in commands and channel.lead_frames is None:
                raise RecordingError(
                    f"channel {name!r} fills {ACTION}: key 'lead_frames' is missing in the recording spec. 1: row k of "
                    f"{channel.topic} is the command that was sent after the observation of row k (LeRobot, ALOHA, cobot_magic); "
                    f"0: it was sent before"
                )
            lead = channel.lead_frames or 0
            if leads.setdefault(channel.topic, lead) != lead:
                raise RecordingError(
                    f"channel {name!r}: lead_frames is {lead}, but another channel reads {channel.topic} with lead_frames "
                    f"{leads[channel.topic]}: a topic must have one value"
                )
            firsts.append(lead - 1 if name in commands else lead)  # the action of row t is due at row t + 1
        return cls(rate_hz, leads, max(firsts))

    def time_ns(self, topic: str, k: int) -> int:
        """Time of a topic's sample k, rounded exactly as the dataset's grid rounds its rows."""
        row = k + self.lead_frames.get(topic, 0) - self.first_row
        if self.rate_hz == int(self.rate_hz):
            rate = int(self.rate_hz)
            return (row * NS_PER_S + rate // 2) // rate
        return round(row * NS_PER_S / self.rate_hz)


@dataclass(frozen=True)
class RowStamps:
    """Time stamps that a file holds for its rows."""

    topic: str
    time_ns: np.ndarray
    """(T,) int64 [ns]."""

    @property
    def period_ns(self) -> int:
        """Median interval of the stamps [ns]."""
        return int(np.median(np.diff(self.time_ns)))

    def at(self, row: int) -> int:
        """Time of a row [ns]; those before the first and after the last one follow at the median interval."""
        inside = min(max(row, 0), len(self.time_ns) - 1)
        return int(self.time_ns[inside]) + (row - inside) * self.period_ns

    def differs_from(self, rate_hz: float) -> str:
        """How the stamps differ from rows at ``rate_hz``; empty if they do not."""
        steps_s = np.diff(self.time_ns) / NS_PER_S
        mean_hz = 1 / float(np.median(steps_s)) if np.median(steps_s) > 0 else 0.0
        if (steps_s <= 0).any():
            return f"go back or stand still at row {int(np.argmax(steps_s <= 0)) + 1}"
        if steps_s.max() > LONGEST_STEP / rate_hz or abs(mean_hz - rate_hz) > RATE_TOLERANCE * rate_hz:
            return f"say {mean_hz:.4g} Hz with a longest step of {steps_s.max():.3g} s"
        return ""


@readers.register("hdf5")
class Hdf5Reader(Reader):
    """Reader for HDF5 files: a recording is a file, or one of its numbered groups of episodes."""

    suffixes = (".hdf5", ".h5")

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        """Return a file as one recording, or each of its groups demo_0, demo_1 … as one; None for another path."""
        whole = super().sources(path, split_bag=split_bag)
        if whole is None or no_recording(path) is not None:
            return whole
        try:
            with h5py.File(path, "r", locking=False) as file:
                parts = _episode_groups(file)
        except (OSError, RuntimeError, KeyError):  # whoever reads it says what is wrong
            return whole
        return [Source(path, (path,), part) for part in parts] or whole

    def topics(self) -> dict[str, TopicType]:
        with self._open() as file:
            return {topic: _topic_type(dataset) for topic, dataset in _datasets(self._group(file)).items()}

    def _group(self, file: h5py.File) -> h5py.Group:
        """The group of the recording: the file, or that of its part."""
        if self.source.part is None:
            return file
        found = _episode_groups(file).get(self.source.part)
        if found is None:
            raise RecordingError(f"{self.source.name}: no such group of an episode")
        group = file[found]
        assert isinstance(group, h5py.Group)
        return group

    def messages(
        self, topics: Topics | None, *, stamps_only: Topics = (), start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        found: list[Damage] = []
        with self._open() as file:
            group = self._group(file)
            datasets, attributes = _datasets(group), _attributes(group)
            self.metadata["attributes"] = {name: _text(value) for name, value in attributes.items()}
            self._check_lengths(datasets)
            stamps = self._stamps(datasets)
            clock = RowClock.of(self._rate_hz(attributes, stamps), self.spec)
            self._check_stamps(stamps, clock.rate_hz)
            asked = [t for t in datasets if (t in topics if topics is not None else _unreadable(datasets[t]) is None)]
            unprotected = _unprotected({topic: datasets[topic] for topic in asked})
            wanted = [t for t in asked if topics is not None and t not in stamps_only]
            for topic in asked:
                problem = _unreadable(datasets[topic])
                if problem is None and topic in wanted:
                    problem = _topic_type(datasets[topic]).undecodable
                if problem:
                    raise RecordingError(f"{self.source.path}: {topic}: {problem}")
            read = {topic: _Blocks(datasets[topic]) for topic in wanted}
            picture_topics = self.spec.picture_topics if self.spec else set()
            for k in range(max((_length(datasets[t]) for t in asked), default=0)):
                for topic in asked:
                    log_ns = clock.time_ns(topic, k)
                    stamp_ns = None
                    if stamps is not None and self._by_stamps:
                        log_ns = stamp_ns = stamps.at(k + clock.lead_frames.get(topic, 0))
                    outside = (start_ns is not None and log_ns < start_ns) or (end_ns is not None and log_ns > end_ns)
                    if k >= _length(datasets[topic]) or outside:
                        continue
                    if topic not in read:
                        yield Message(topic, log_ns, stamp_ns, None)
                        continue
                    try:
                        value = read[topic].row(k)
                    except OSError as error:
                        value = None
                        found.append(self._lost(clock, topic, read[topic], error))
                    if value is None and (_is_compressed(datasets[topic]) or topic in picture_topics):
                        value = b""  # a broken picture: who asked for it by its time must not wait for it
                    if value is not None:
                        yield Message(topic, log_ns, stamp_ns, value)
        if start_ns is None and end_ns is None:
            self.damage += [d for d in found if d not in self.damage]
            self.unprotected = unprotected

    @contextlib.contextmanager
    def _open(self) -> Iterator[h5py.File]:
        path = self.source.path
        try:
            # HDF5 would lock the file, which read-only and network folders do not allow.
            file = h5py.File(path, "r", locking=False)
        except OSError as error:
            raise RecordingError(f"{path}: {_plain(path, str(error))}") from error
        with file:
            try:
                yield file
            except (OSError, RuntimeError, KeyError) as error:  # h5py, on damaged groups and headers
                raise RecordingError(f"{path}: is damaged ({type(error).__name__}: {error})") from error

    def _check_lengths(self, datasets: dict[str, h5py.Dataset]) -> None:
        """Row k is one instant only if all channels have as many rows."""
        wanted = {c.topic for c in self.spec.channels.values()} if self.spec else set()
        lengths = sorted((_length(d), topic) for topic, d in datasets.items() if topic in wanted)
        if lengths and lengths[0][0] != lengths[-1][0]:
            (few, short), (many, long) = lengths[0], lengths[-1]
            raise RecordingError(
                f"{self.source.path}: {short} has {few} rows, but {long} has {many}: without time stamps it is unknown which "
                "rows belong together; did the recorder die while writing?"
            )

    def _stamps(self, datasets: dict[str, h5py.Dataset]) -> RowStamps | None:
        """The file's time stamps of the rows: the first dataset of numbers that is named so or counts from 1970."""
        used = {c.topic for c in self.spec.channels.values()} if self.spec else set()
        known = (d for topic, d in datasets.items() if topic in used or (not used and d.ndim > 1))
        rows = max(map(_length, known), default=0)
        for topic, dataset in sorted(datasets.items(), key=lambda item: (item[0].count("/"), item[0])):
            numbers = dataset.dtype.kind in "iuf" and math.prod(dataset.shape) == rows == _length(dataset)
            if numbers and rows > 2 and topic not in used and _unreadable(dataset) is None:
                try:
                    time_ns = _as_times(np.asarray(dataset[()]).reshape(-1), topic)
                except RecordingError as error:
                    raise RecordingError(f"{self.source.path}: {error}") from error
                if time_ns is not None:
                    return RowStamps(topic, time_ns)
        return None

    @functools.cached_property
    def _by_stamps(self) -> bool:
        """Whether the file's time stamps, if it has some, are used: for a spec with `clock: header`, and for inspection."""
        return self.spec is None or any(self.spec.clock_of(c) == "header" for c in self.spec.channels)

    def _check_stamps(self, stamps: RowStamps | None, rate_hz: float) -> None:
        if stamps is None or self._by_stamps:
            return
        if why := stamps.differs_from(rate_hz):
            raise RecordingError(
                f"{self.source.name}: the file's time stamps {stamps.topic} {why}, the spec's channels {rate_hz:g} Hz: "
                "`clock: header` in the recording spec uses the time stamps"
            )

    def _rate_hz(self, attributes: dict[str, Any], stamps: RowStamps | None) -> float:
        told = {name: rate for name in RATE_ATTRIBUTES if (rate := _rate(attributes.get(name))) is not None}
        if self.spec is None:
            if not told and stamps is not None:
                return NS_PER_S / max(stamps.period_ns, 1)
            if not told:
                self.metadata["time"] = {"rate": "the file names no rate: sample k is shown at k seconds"}
            return next(iter(told.values()), 1.0)
        rates: dict[float, str] = {}
        for channel, c in self.spec.channels.items():
            rates.setdefault(c.rate_hz, channel)
        if len(rates) > 1:
            (a, first), (b, second) = list(rates.items())[:2]
            raise RecordingError(
                f"channels {first!r} and {second!r} have {a:g} and {b:g} Hz: all rows of one file must have the same rate"
            )
        rate_hz = next(iter(rates))
        for name, value in told.items():
            if value != rate_hz:
                raise RecordingError(
                    f"{self.source.path}: attribute {name} states {value:g} Hz, but the spec's channels {rate_hz:g} Hz"
                )
        return rate_hz

    def _lost(self, clock: RowClock, topic: str, blocks: "_Blocks", error: OSError) -> Damage:
        first, last = blocks.start, blocks.stop - 1
        start, end = blocks.bytes_in_file() or (0, self.source.path.stat().st_size)
        times_ns = clock.time_ns(topic, first), clock.time_ns(topic, last)
        reason = f"{topic}, rows {first} to {last} cannot be read ({error})"
        return Damage(str(self.source.path), start, end, reason, *times_ns)


class _Blocks:
    """Rows of one dataset, a block at a time: each chunk is unpacked once, and memory stays flat."""

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset, self._text = dataset, _is_text(dataset)
        self._step = _rows_at_once(dataset)
        self.start, self.stop = 0, 0
        self._rows: Any = None

    def row(self, k: int) -> Any:
        """Row k; None for the further rows of a damaged block. Raises OSError: the block that begins here is damaged."""
        if self._dataset.shape == ():
            return _text(self._dataset[()])
        if not self.start <= k < self.stop:
            self.start = k - k % self._step
            self.stop = min(self.start + self._step, len(self._dataset))
            self._rows = None
            if self._dataset.chunks and self.bytes_in_file() is None:
                raise OSError("never written")
            self._rows = self._dataset[self.start : self.stop]
        if self._rows is None:
            return None
        value = self._rows[k - self.start]
        if self._text:
            return _text(value)
        return bytes(value) if isinstance(value, bytes) else value

    def bytes_in_file(self) -> tuple[int, int] | None:
        """[start, end) of the block's first chunk in the file."""
        if not self._dataset.chunks:
            return None
        info = self._dataset.id.get_chunk_info_by_coord((self.start,) + (0,) * (self._dataset.ndim - 1))
        return (info.byte_offset, info.byte_offset + info.size) if info.byte_offset is not None else None


def _rows_at_once(dataset: h5py.Dataset) -> int:
    if h5py.check_vlen_dtype(dataset.dtype) is not None:
        return 1
    return dataset.chunks[0] if dataset.chunks else max(1, BLOCK_BYTES // max(1, _row_bytes(dataset)))


def _row_bytes(dataset: h5py.Dataset) -> int:
    return dataset.dtype.itemsize * math.prod(dataset.shape[1:])


def _unreadable(dataset: h5py.Dataset) -> str | None:
    """Reason why the dataset must not be read; None if it may. Opens no other file and allocates nothing large."""
    if dataset.is_virtual or dataset.external:
        others = [s.file_name for s in dataset.virtual_sources()] if dataset.is_virtual else []
        others += [name for name, _, _ in dataset.external or ()]
        kind = "a virtual dataset" if dataset.is_virtual else "external storage"
        return f"its values are in {listed(sorted(set(others)))} ({kind}), which is not opened: write the values into this file"
    rows = _length(dataset)
    chunk_bytes = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize  # wider than the rows, if they may grow
    block_bytes = max(_rows_at_once(dataset) * _row_bytes(dataset), chunk_bytes)
    if rows > MOST_ROWS:
        return f"it claims {rows:,} rows; at most {MOST_ROWS:,} are read: write shorter recordings"
    if block_bytes > MOST_BLOCK_BYTES:
        return (
            f"{_rows_at_once(dataset):,} rows of shape {list(dataset.shape[1:])}, which are read at once, are "
            f"{block_bytes / 2**30:.1f} GiB; at most {MOST_BLOCK_BYTES / 2**30:.0f} GiB are read: write smaller chunks"
        )
    if rows and not dataset.id.get_storage_size():
        return f"none of its {rows:,} rows was ever written: did the recorder die?"
    return None


def _datasets(group: h5py.Group) -> dict[str, h5py.Dataset]:
    """Topic, its path from ``group`` on → dataset with rows; a single text counts as one row."""
    found: dict[str, h5py.Dataset] = {}

    def visit(name: str, item: Any) -> None:
        topic = f"/{name}"
        if isinstance(item, h5py.Dataset) and topic not in BOOKKEEPING and (item.shape or _is_text(item)):
            found[topic] = item

    group.visititems(visit)
    return found


def _unprotected(datasets: dict[str, h5py.Dataset]) -> str:
    """Sentence that names the datasets without a checksum (Fletcher32, or gzip with its Adler-32); empty if all have one."""
    names = [topic for topic, d in datasets.items() if not d.fletcher32 and d.compression != "gzip"]
    if not names:
        return ""
    return (
        f"no checksum in {listed(names)}: changed bytes are read as values or pictures; the recorder can write one with "
        "create_dataset(…, fletcher32=True)"
    )


def _episode_groups(file: h5py.File) -> dict[str, str]:
    """Name of each episode in the file → path of its group, in natural order; empty if the file is one episode.

    A numbered group is an episode if its name says so, or if several have the same contents but not the same number of rows, and
    hold all of the file's rows.
    """
    level: list[h5py.Group] = [file]
    found: list[str] = []
    for _ in range(DEEPEST_EPISODES):
        families: dict[tuple[str, str], list[str]] = {}
        below = [g[name] for g in level for name in g if g.get(name, getclass=True, getlink=True) is h5py.HardLink]
        level = [item for item in below if isinstance(item, h5py.Group)]
        for group in level:
            parent, _, name = str(group.name).rpartition("/")
            if (number := re.fullmatch(r"(.*?)[_-]?(\d+)", name)) is not None:
                families.setdefault((parent, number[1].lower()), []).append(str(group.name))
        found = [path for (_, word), paths in families.items() if _are_episodes(file, word, paths) for path in paths]
        if found:
            break
    names = [path.rpartition("/")[2] for path in found]
    named = {name if names.count(name) == 1 else path.strip("/"): path for name, path in zip(names, found, strict=True)}
    return dict(sorted(named.items(), key=lambda item: decode.natural_key(item[0])))


def _are_episodes(file: h5py.File, word: str, paths: list[str]) -> bool:
    contents = [_datasets(group) for path in paths if isinstance(group := file[path], h5py.Group)]
    if not any(d.ndim > 0 for found in contents for d in found.values()):
        return False
    inside = {f"{path}{topic}" for path, found in zip(paths, contents, strict=True) for topic in found}
    alone = all(topic in inside or d.ndim < 2 for topic, d in _datasets(file).items())
    if word:
        if word in EPISODE_WORDS:
            return True
        lengths = [max(map(_length, found.values()), default=0) for found in contents]
        alike = len({frozenset(found) for found in contents}) == 1
        return alone and alike and len(set(lengths)) > 1
    return alone


def _attributes(group: h5py.Group) -> dict[str, Any]:
    """Attributes of a group and of those that contain it; its own win."""
    above = group.parent
    parents = [] if group.name == "/" or not isinstance(above, h5py.Group) else list(_attributes(above).items())
    return dict([*parents, *group.attrs.items()])


def _rate(value: Any) -> float | None:
    """A rate [Hz] that an attribute states, as a number or as a text such as "30" or "29.97 Hz"; None if it states none."""
    if value is None:
        return None
    found = np.asarray(value)
    if found.size != 1:
        return None
    single = found.reshape(-1)[0]
    if found.dtype.kind in "iuf":
        return float(single)
    text = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(?:hz|fps)?\s*", _text(single), re.IGNORECASE)
    return float(text[1]) if text else None


def _as_times(values: np.ndarray, topic: str) -> np.ndarray | None:
    """(T,) int64 [ns] of numbers that are time stamps: from 1970 in s, ms, µs or ns, or under a name that says so; else None.
    Raises RecordingError: one of them is no time."""
    finite = values[np.isfinite(values)].astype(float)
    steps = np.diff(finite)
    if len(steps) == 0 or ((steps == steps[0]).all() and steps[0] in (0.0, 1.0)):
        return None  # a constant, or the numbers of rows
    words = re.split(r"[^a-z]+", topic.rpartition("/")[2].lower())
    named = any(word.startswith(TIME_WORDS) or word in ("t", "ts") for word in words)
    first, period = abs(float(finite[0])), abs(float(np.median(steps)))
    for unit_ns in (NS_PER_S, 1_000_000, 1000, 1):
        first_s, rate_hz = first * unit_ns / NS_PER_S, NS_PER_S / max(period * unit_ns, 1e-9)
        from_1970 = 1e9 <= first_s < 4e9 and (named or (steps > 0).all())
        plausible = named and first_s < 1e9 and RATES_HZ[0] <= rate_hz <= RATES_HZ[1]
        if from_1970 or plausible:
            way_out = "correct it, or remove these time stamps from the file"
            check_stamps(values.astype(float) * (unit_ns / NS_PER_S), f"time stamp {topic}", way_out)
            whole = values.astype(np.int64) if values.dtype.kind in "iu" else np.floor(values).astype(np.int64)
            return whole * unit_ns + np.rint((values - whole).astype(float) * unit_ns).astype(np.int64)
    return None


def _length(dataset: h5py.Dataset) -> int:
    return len(dataset) if dataset.shape else 1


def _topic_type(dataset: h5py.Dataset) -> TopicType:
    problem = _unreadable(dataset)
    if problem:
        return TopicType(str(dataset.dtype), "hdf5", problem)
    if _is_compressed(dataset):
        return TopicType("CompressedImage", "hdf5")
    if _is_text(dataset):
        return TopicType("String", "hdf5")
    name = str(dataset.dtype)
    if dataset.dtype.kind not in "biuf":
        return TopicType(name, "hdf5", f"values of type {name} are not read (numbers, texts and pictures are)")
    return TopicType(name, "hdf5", shape=tuple(dataset.shape[1:]))


def _is_text(dataset: h5py.Dataset) -> bool:
    return h5py.check_string_dtype(dataset.dtype) is not None and not _is_compressed(dataset)


def _is_compressed(dataset: h5py.Dataset) -> bool:
    """Rows of bytes that begin as a JPEG or PNG does."""
    as_bytes = dataset.dtype.kind in "SO" and dataset.ndim == 1
    if not (as_bytes or (dataset.dtype == np.uint8 and dataset.ndim == 2)) or len(dataset) == 0:
        return False
    try:
        first = dataset[0]
    except OSError:
        return False
    head = first[:4] if isinstance(first, bytes) else np.asarray(first).ravel()[:4].tobytes()
    return head.startswith(COMPRESSED)


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _plain(path: Path, text: str) -> str:
    """h5py's words on opening a file, for people."""
    if path.is_file() and path.stat().st_size == 0:
        return "is empty (0 bytes)"
    if "truncated file" in text:
        return f"is cut off ({text}): HDF5 cannot be read without its end; copy it again from the robot"
    if "signature not found" in text:
        return "is not an HDF5 file"
    return f"cannot be opened ({text})"
