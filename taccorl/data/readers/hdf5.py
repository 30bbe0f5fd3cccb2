"""HDF5 files of rows (ALOHA, AgileX cobot_magic, robomimic): a topic is the path of an HDF5 dataset, and sample k is row k.

A file is one episode, or each of its groups demo_0, demo_1 … is one, with paths from there. Times follow from the rate that the
spec's channels state (``clock: log``), or are the file's own time stamps (``clock: header``); where both are known and differ,
the file is refused. Pictures may be raw or compressed one by one, padded or not.
"""

import contextlib
import functools
import math
import re
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from taccorl.data import decode
from taccorl.data.file_kinds import no_recording
from taccorl.data.finding import listed
from taccorl.data.recording import (
    Damage,
    Message,
    Query,
    Reader,
    Source,
    TopicType,
    readers,
)
from taccorl.data.spec import ACTION, RecordingSpec
from taccorl.data.stated_counts import StatedCounts
from taccorl.data.timing import NS_PER_S, check_stamps
from taccorl.errors import RecordingError

NUM_ROWS = "num_samples"  # Attribute of a demonstration of robomimic
BLOCK_BYTES = 4 << 20  # Number of bytes that are read at once
MOST_ROWS = 1_000_000  # Most rows of a dataset: 9 h at 30 Hz; a file of a few kB can hold any number
FREE_ROWS = 200_000
"""Rows of all topics of a recording, together, that are read whatever the file holds of
them; more must have a byte of the file each."""
FREE_BYTES = 1 << 28
"""Bytes of values that are read whatever the file holds of them; of more, the file must
hold at least one in ``MOST_SHRUNK``. Deflate leaves one of 1032 at best."""
MOST_SHRUNK = 300
MOST_EPISODES = 10_000  # Most groups of a file that are episodes
MOST_BLOCK_BYTES = (
    1 << 30
)  # Largest block read at once, a chunk or a row; 1000 pictures of 480×640 are 0.9 GB
COMPRESSED = (b"\xff\xd8\xff", b"\x89PNG")  # how JPEG and PNG begin
RATE_ATTRIBUTES = (
    "fps",
    "frequency",
)  # Attributes of a file in which its rate of rows may be stated [Hz]
EPISODE_WORDS = (
    *("", "demo", "demonstration", "ep", "episode", "traj", "trajectory"),
    *("rollout", "trial", "sequence", "seq"),
)
"""Names of groups, before their number, that are one episode each: robomimic, MimicGen and their like."""
DEEPEST_EPISODES = 3  # Levels of groups that are searched for episodes
TIME_WORDS = (
    "time",
    "stamp",
    "clock",
)  # How words in the name of a dataset of time stamps begin
RATES_HZ = (
    0.5,
    5000.0,
)  # Plausible rates of rows, which tell the unit of time stamps that do not count from 1970 [Hz]
RATE_TOLERANCE = 0.02  # Largest accepted difference of the time stamps' rate from that of the spec, as a share
LONGEST_STEP = (
    2.5  # Longest accepted step of the time stamps, in periods of the spec's rate
)
BOOKKEEPING = (
    "/compress_len",
)  # ALOHA: bytes of each padded picture; decoders find the end themselves


@dataclass(frozen=True)
class RowClock:
    """Times of the rows of a file without time stamps, at a fixed rate. Time 0 is the first row that every channel of the spec
    can fill, row ``first_row`` of the file."""

    rate_hz: float
    lead_frames: dict[str, int]
    """Topic → number of rows by which its samples are shifted (``ChannelSpec.lead_frames``)."""
    first_row: int = 0

    @classmethod
    def of(cls, rate_hz: float, spec: RecordingSpec | None) -> "RowClock":
        """Clock for the channels of a spec. Raises RecordingError: two channels of one topic state different ``lead_frames``,
        or a channel of ``action`` states none."""
        leads: dict[str, int] = {}
        firsts = [0]
        commands = (
            spec.features[ACTION].channels if spec and ACTION in spec.features else ()
        )
        for name, channel in spec.channels.items() if spec else ():
            if name in commands and channel.lead_frames is None:
                text = f"channel {name!r} fills {ACTION}: key 'lead_frames' is missing. 1: row k of {channel.topic} "
                raise RecordingError(
                    f"{text}was sent after the observation of row k (LeRobot, ALOHA); 0: before"
                )
            lead = channel.lead_frames or 0
            if leads.setdefault(channel.topic, lead) != lead:
                text = f"channel {name!r}: lead_frames is {lead}, of another channel of {channel.topic}"
                raise RecordingError(
                    f"{text} lead_frames {leads[channel.topic]}: a topic must have one value"
                )
            firsts.append(
                lead - 1 if name in commands else lead
            )  # the action of row t is due at row t + 1
        return cls(rate_hz, leads, max(firsts))

    def time_ns(self, topic: str, k: int) -> int:
        """Time of a topic's sample k, rounded exactly as the dataset's grid rounds its rows."""
        row = k + self.lead_frames.get(topic, 0) - self.first_row
        if self.rate_hz == (rate := int(self.rate_hz)):
            return (row * NS_PER_S + rate // 2) // rate
        return round(row * NS_PER_S / self.rate_hz)


@dataclass(frozen=True)
class RowStamps:
    """Time stamps ``time_ns`` (T,) int64 [ns] that a file holds for its rows, in the dataset ``topic``."""

    topic: str
    time_ns: np.ndarray

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
        if (
            steps_s.max() > LONGEST_STEP / rate_hz
            or abs(mean_hz - rate_hz) > RATE_TOLERANCE * rate_hz
        ):
            return f"say {mean_hz:.4g} Hz with a longest step of {steps_s.max():.3g} s"
        return ""


@readers.register("hdf5")
class Hdf5Reader(Reader):
    """Reader for HDF5 files: a recording is a file, or one of its numbered groups of episodes."""

    suffixes = (".hdf5", ".h5")

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        whole = super().sources(path, split_bag=split_bag)
        if whole is not None and no_recording(path) is None:
            # whoever reads it says what is wrong
            with contextlib.suppress(OSError, RuntimeError, KeyError):
                parts = _groups_of_file(path, *_version(path))
                return [Source(path, (path,), part) for part in parts] or whole
        return whole

    def topics(self) -> dict[str, TopicType]:
        with self._open() as group:
            return {
                topic: _topic_type(dataset)
                for topic, dataset in _datasets(group).items()
            }

    def read(self, query: Query, damage: list[Damage]) -> Generator[Message, None, str]:
        with self._open() as group:
            datasets, attributes = _datasets(group), _attributes(group)
            self.metadata["attributes"] = {
                name: _text(value) for name, value in attributes.items()
            }
            stamps = self._stamps(datasets)
            clock = RowClock.of(self._rate_hz(attributes, stamps), self.spec)
            # The file's time stamps, if it has some, are used for a spec with `clock: header`, and for inspection.
            by_stamps = self.spec is None or any(
                self.spec.clock_of(c) == "header" for c in self.spec.channels
            )
            if (
                stamps is not None
                and not by_stamps
                and (why := stamps.differs_from(clock.rate_hz))
            ):
                text = f"{self.source.name}: the file's time stamps {stamps.topic} {why}, the spec's channels "
                raise RecordingError(
                    f"{text}{clock.rate_hz:g} Hz: `clock: header` uses the time stamps"
                )
            asked = [
                t
                for t in datasets
                if query.asks(t)
                and (query.topics is not None or not _unreadable(datasets[t]))
            ]
            for topic in asked:
                if problem := _unreadable(datasets[topic]) or (
                    query.reads(topic) and _topic_type(datasets[topic]).undecodable
                ):
                    raise RecordingError(f"{self.source.path}: {topic}: {problem}")
            if problem := _hollow([datasets[topic] for topic in asked]):
                raise RecordingError(f"{self.source.path}: {problem}")
            blocks = {
                topic: _Blocks(datasets[topic]) for topic in asked if query.reads(topic)
            }
            pictures = {t for t in blocks if _is_compressed(datasets[t])} | (
                self.spec.picture_topics if self.spec else set()
            )
            lengths = {topic: _length(datasets[topic]) for topic in asked}
            for k in range(max(lengths.values(), default=0)):
                for topic in asked:
                    log_ns, stamp_ns, value = clock.time_ns(topic, k), None, None
                    if stamps is not None and by_stamps:
                        log_ns = stamp_ns = stamps.at(
                            k + clock.lead_frames.get(topic, 0)
                        )
                    if k >= lengths[topic] or not query.covers(log_ns):
                        continue
                    if topic in blocks:
                        try:
                            value = blocks[topic].row(k)
                        except OSError as error:
                            damage.append(
                                self._lost(clock, topic, blocks[topic], error)
                            )
                        if value is None and topic not in pictures:
                            continue
                        value = (
                            b"" if value is None else value
                        )  # a broken picture: who asked by its time must not wait
                    yield Message(topic, log_ns, stamp_ns, value)
            if query.whole:
                damage += self._lacking_rows(attributes, datasets)
            return _unprotected({topic: datasets[topic] for topic in asked})

    def _lacking_rows(
        self, attributes: dict[str, Any], datasets: dict[str, h5py.Dataset]
    ) -> list[Damage]:
        """Damage for rows that the attribute of robomimic's demonstrations counts and
        that no dataset holds."""
        number = attributes.get(NUM_ROWS)
        if not isinstance(number, int | np.integer):
            return []
        longest = max(map(_length, datasets.values()), default=0)
        stated = StatedCounts(f"its attribute {NUM_ROWS}", total=int(number))
        return stated.compared(self.source.path, Counter(rows=longest), None)

    @contextlib.contextmanager
    def _open(self) -> Iterator[h5py.Group]:
        """The group of the recording: the file, or that of its part."""
        path = self.source.path
        try:
            file = h5py.File(
                path, "r", locking=False
            )  # it would lock the file, which read-only folders do not allow
        except OSError as error:
            text, size = str(error), path.stat().st_size if path.is_file() else -1
            cut = "HDF5 cannot be read without its end; copy it again from the robot"
            why = (
                f"is cut off ({text}): {cut}"
                if "truncated file" in text
                else f"cannot be opened ({text})"
            )
            why = "is not an HDF5 file" if "signature not found" in text else why
            raise RecordingError(
                f"{path}: {why if size else 'is empty (0 bytes)'}"
            ) from error
        with file:
            try:
                part = self.source.part
                groups = {} if part is None else _groups_of_file(path, *_version(path))
                found = "/" if part is None else groups.get(part, "")
                if not isinstance(group := file[found] if found else None, h5py.Group):
                    raise RecordingError(
                        f"{self.source.name}: no such group of an episode"
                    )
                yield group
            except (
                OSError,
                RuntimeError,
                KeyError,
            ) as error:  # h5py, on damaged groups and headers
                raise RecordingError(
                    f"{path}: is damaged ({type(error).__name__}: {error})"
                ) from error

    def _stamps(self, datasets: dict[str, h5py.Dataset]) -> RowStamps | None:
        """The file's time stamps of the rows: the first dataset of numbers that is named so or counts from 1970. Raises
        RecordingError: the channels have different numbers of rows: row k is one instant only if all have as many."""
        used = {c.topic for c in self.spec.channels.values()} if self.spec else set()
        if lengths := sorted(
            (_length(d), topic) for topic, d in datasets.items() if topic in used
        ):
            (few, short), (many, long) = lengths[0], lengths[-1]
            if few != many:
                text = f"{self.source.path}: {short} has {few} rows, but {long} has {many}: without time stamps it is "
                raise RecordingError(
                    f"{text}unknown which rows belong together; did the recorder die while writing?"
                )
        known = (
            d
            for topic, d in datasets.items()
            if topic in used or (not used and d.ndim > 1)
        )
        rows = max(map(_length, known), default=0)
        for topic, d in sorted(
            datasets.items(), key=lambda item: (item[0].count("/"), item[0])
        ):
            numbers = d.dtype.kind in "iuf" and math.prod(d.shape) == rows == _length(d)
            if numbers and rows > 2 and topic not in used and _unreadable(d) is None:
                try:
                    time_ns = _as_times(np.asarray(d[()]).reshape(-1), topic)
                except RecordingError as error:
                    raise RecordingError(f"{self.source.path}: {error}") from error
                if time_ns is not None:
                    return RowStamps(topic, time_ns)
        return None

    def _rate_hz(self, attributes: dict[str, Any], stamps: RowStamps | None) -> float:
        told = {
            name: rate
            for name in RATE_ATTRIBUTES
            if (rate := _rate(attributes.get(name))) is not None
        }
        if self.spec is None:
            if not told and stamps is not None:
                return NS_PER_S / max(stamps.period_ns, 1)
            if not told:
                self.metadata["time"] = {
                    "rate": "the file names no rate: sample k is shown at k seconds"
                }
            return next(iter(told.values()), 1.0)
        rates: dict[float, str] = {}
        for channel, c in self.spec.channels.items():
            rates.setdefault(c.rate_hz, channel)
        (rate_hz, first), *others = rates.items()
        if others:
            text = f"channels {first!r} and {others[0][1]!r} have {rate_hz:g} and {others[0][0]:g} Hz: "
            raise RecordingError(f"{text}all rows of one file must have the same rate")
        for name, value in told.items():
            if value != rate_hz:
                raise RecordingError(
                    f"{self.source.path}: attribute {name}: {value:g} Hz, the spec: {rate_hz:g} Hz"
                )
        return rate_hz

    def _lost(
        self, clock: RowClock, topic: str, blocks: "_Blocks", error: OSError
    ) -> Damage:
        first, last = blocks.start, blocks.stop - 1
        start, end = blocks.bytes_in_file() or (0, self.source.path.stat().st_size)
        times_ns = clock.time_ns(topic, first), clock.time_ns(topic, last)
        reason = f"{topic}, rows {first} to {last} cannot be read ({error})"
        return Damage(str(self.source.path), start, end, reason, *times_ns)


class _Blocks:
    """Rows of one dataset, a block at a time: each chunk is unpacked once, and memory stays flat."""

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset, self._text = dataset, _is_text(dataset)
        self._step, self._rows = _rows_at_once(dataset), None
        self.start, self.stop = 0, 0

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
        return (
            _text(value)
            if self._text
            else bytes(value)
            if isinstance(value, bytes)
            else value
        )

    def bytes_in_file(self) -> tuple[int, int] | None:
        """[start, end) of the block's first chunk in the file."""
        if not self._dataset.chunks:
            return None
        info = self._dataset.id.get_chunk_info_by_coord(
            (self.start,) + (0,) * (self._dataset.ndim - 1)
        )
        return (
            (info.byte_offset, info.byte_offset + info.size)
            if info.byte_offset is not None
            else None
        )


# ---- one HDF5 dataset ----


def _length(dataset: h5py.Dataset) -> int:
    return len(dataset) if dataset.shape else 1


def _row_bytes(dataset: h5py.Dataset) -> int:
    return dataset.dtype.itemsize * math.prod(dataset.shape[1:])


def _rows_at_once(dataset: h5py.Dataset) -> int:
    if h5py.check_vlen_dtype(dataset.dtype) is not None:
        return 1
    return (
        dataset.chunks[0]
        if dataset.chunks
        else max(1, BLOCK_BYTES // max(1, _row_bytes(dataset)))
    )


def _unreadable(dataset: h5py.Dataset) -> str | None:
    """Reason why the dataset must not be read; None if it may. Opens no other file and allocates nothing large."""
    if dataset.is_virtual or dataset.external:
        others = (
            [s.file_name for s in dataset.virtual_sources()]
            if dataset.is_virtual
            else []
        )
        others += [name for name, _, _ in dataset.external or ()]
        kind = "a virtual dataset" if dataset.is_virtual else "external storage"
        return f"its values are in {listed(sorted(set(others)))} ({kind}), which is not opened: write the values into this file"
    rows, at_once = _length(dataset), _rows_at_once(dataset)
    chunk_bytes = (
        math.prod(dataset.chunks or ()) * dataset.dtype.itemsize
    )  # wider than the rows, if they may grow
    block_bytes = max(at_once * _row_bytes(dataset), chunk_bytes)
    if rows > MOST_ROWS:
        return f"it claims {rows:,} rows; at most {MOST_ROWS:,} are read: write shorter recordings"
    if block_bytes > MOST_BLOCK_BYTES:
        text = f"{at_once:,} rows of shape {list(dataset.shape[1:])} are {block_bytes / 2**30:.1f} GiB; "
        return f"{text}at most {MOST_BLOCK_BYTES / 2**30:.0f} GiB are read: write smaller chunks"
    stored = dataset.id.get_storage_size()
    if rows and not stored:
        return f"none of its {rows:,} rows was ever written: did the recorder die?"
    if rows and block_bytes > max(FREE_BYTES, MOST_SHRUNK * stored):
        return f"{at_once:,} rows at once are {block_bytes:,} bytes, of which the file holds {stored:,}: write smaller chunks"
    return None


def _hollow(datasets: Sequence[h5py.Dataset]) -> str | None:
    """Reason why the datasets must not be read: they state far more rows or bytes than the
    file holds; None if they may. Reads no values."""
    rows = sum(map(_length, datasets))
    values = sum(_length(d) * _row_bytes(d) for d in datasets)
    stored = sum(d.id.get_storage_size() for d in datasets)
    if rows > FREE_ROWS and rows > stored:
        claimed = f"{rows:,} rows"
    elif values > FREE_BYTES and values > MOST_SHRUNK * stored:
        claimed = f"{values:,} bytes of values"
    else:
        return None
    return (
        f"its {len(datasets)} datasets claim {claimed}, of which the file holds {stored:,} bytes: did the recorder die "
        "before it wrote them? Write recordings with the rows that were measured"
    )


def _topic_type(dataset: h5py.Dataset) -> TopicType:
    name = str(dataset.dtype)
    if problem := _unreadable(dataset):
        return TopicType(name, "hdf5", problem)
    if _is_compressed(dataset) or _is_text(dataset):
        return TopicType(
            "CompressedImage" if _is_compressed(dataset) else "String", "hdf5"
        )
    if dataset.dtype.kind not in "biuf":
        return TopicType(
            name,
            "hdf5",
            f"values of type {name} are not read (numbers, texts and pictures are)",
        )
    return TopicType(name, "hdf5", shape=tuple(dataset.shape[1:]))


def _is_text(dataset: h5py.Dataset) -> bool:
    return h5py.check_string_dtype(dataset.dtype) is not None and not _is_compressed(
        dataset
    )


def _is_compressed(dataset: h5py.Dataset) -> bool:
    """Rows of bytes that begin as a JPEG or PNG does."""
    as_bytes = dataset.dtype.kind in "SO" and dataset.ndim == 1
    if (
        not (as_bytes or (dataset.dtype == np.uint8 and dataset.ndim == 2))
        or len(dataset) == 0
    ):
        return False
    try:
        first = dataset[0]
    except OSError:
        return False
    head = (
        first[:4]
        if isinstance(first, bytes)
        else np.asarray(first).ravel()[:4].tobytes()
    )
    return head.startswith(COMPRESSED)


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


# ---- a group ----


def _datasets(group: h5py.Group) -> dict[str, h5py.Dataset]:
    """Topic, its path from ``group`` on → dataset with rows; a single text counts as one row."""
    found: dict[str, h5py.Dataset] = {}

    def visit(name: str, item: Any) -> None:
        if (
            isinstance(item, h5py.Dataset)
            and f"/{name}" not in BOOKKEEPING
            and (item.shape or _is_text(item))
        ):
            found[f"/{name}"] = item

    group.visititems(visit)
    return found


def _unprotected(datasets: dict[str, h5py.Dataset]) -> str:
    """Sentence that names the datasets without a checksum (Fletcher32, or gzip with its Adler-32); empty if all have one."""
    names = [
        topic
        for topic, d in datasets.items()
        if not d.fletcher32 and d.compression != "gzip"
    ]
    text = f"no checksum in {listed(names)}: changed bytes are read as values or pictures; the recorder can write one "
    return f"{text}with create_dataset(…, fletcher32=True)" if names else ""


def _version(path: Path) -> tuple[int, int]:
    """Time of the last change [ns] and size [bytes] of a file."""
    found = path.stat()
    return found.st_mtime_ns, found.st_size


@functools.lru_cache(maxsize=16)
def _groups_of_file(path: Path, changed_ns: int, size: int) -> dict[str, str]:
    """``_episode_groups`` of a file in one version: each of its episodes asks for them."""
    with h5py.File(path, "r", locking=False) as file:
        return _episode_groups(file)


def _episode_groups(file: h5py.File) -> dict[str, str]:
    """Name of each episode in the file → path of its group, in natural order; empty if the file is one episode. A numbered group
    is an episode if its name says so, or if several have the same contents but not the same number of rows, and hold all rows."""
    level: list[h5py.Group] = [file]
    found: list[str] = []
    for _ in range(DEEPEST_EPISODES):
        families: dict[tuple[str, str], list[str]] = {}
        below = [
            g[name]
            for g in level
            for name in g
            if g.get(name, getclass=True, getlink=True) is h5py.HardLink
        ]
        level = [item for item in below if isinstance(item, h5py.Group)]
        for group in level:
            parent, _, name = str(group.name).rpartition("/")
            if (number := re.fullmatch(r"(.*?)[_-]?(\d+)", name)) is not None:
                families.setdefault((parent, number[1].lower()), []).append(
                    str(group.name)
                )
        found = [
            path
            for (_, word), paths in families.items()
            if _are_episodes(file, word, paths)
            for path in paths
        ]
        if len(found) > MOST_EPISODES:
            raise RecordingError(
                f"{file.filename}: {len(found):,} groups are episodes; at most {MOST_EPISODES:,} of a file are read: write "
                "several files"
            )
        if found:
            break
    names = [path.rpartition("/")[2] for path in found]
    named = {
        name if names.count(name) == 1 else path.strip("/"): path
        for name, path in zip(names, found, strict=True)
    }
    return dict(sorted(named.items(), key=lambda item: decode.natural_key(item[0])))


def _are_episodes(file: h5py.File, word: str, paths: list[str]) -> bool:
    contents = [
        _datasets(group)
        for path in paths
        if isinstance(group := file[path], h5py.Group)
    ]
    if not any(d.ndim > 0 for found in contents for d in found.values()):
        return False
    inside = {
        f"{path}{topic}"
        for path, found in zip(paths, contents, strict=True)
        for topic in found
    }
    alone = all(topic in inside or d.ndim < 2 for topic, d in _datasets(file).items())
    if not word or word in EPISODE_WORDS:
        return bool(word) or alone
    lengths = {max(map(_length, found.values()), default=0) for found in contents}
    return (
        alone
        and len({frozenset(found) for found in contents}) == 1
        and len(lengths) > 1
    )


def _attributes(group: h5py.Group) -> dict[str, Any]:
    """Attributes of a group and of those that contain it; its own win."""
    above = group.parent
    parents = (
        {}
        if group.name == "/" or not isinstance(above, h5py.Group)
        else _attributes(above)
    )
    return parents | dict(group.attrs.items())


def _rate(value: Any) -> float | None:
    """A rate [Hz] that an attribute states, as a number or as a text such as "30" or "29.97 Hz"; None if it states none."""
    found = np.asarray(value)
    if value is None or found.size != 1:
        return None
    single = found.reshape(-1)[0]
    if found.dtype.kind in "iuf":
        return float(single)
    text = re.fullmatch(
        r"\s*(\d+(?:\.\d+)?)\s*(?:hz|fps)?\s*", _text(single), re.IGNORECASE
    )
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
        first_s, rate_hz = (
            first * unit_ns / NS_PER_S,
            NS_PER_S / max(period * unit_ns, 1e-9),
        )
        from_1970 = 1e9 <= first_s < 4e9 and (named or (steps > 0).all())
        if from_1970 or (
            named and first_s < 1e9 and RATES_HZ[0] <= rate_hz <= RATES_HZ[1]
        ):
            way_out = "correct it, or remove these time stamps from the file"
            check_stamps(
                values.astype(float) * (unit_ns / NS_PER_S),
                f"time stamp {topic}",
                way_out,
            )
            whole = (
                values.astype(np.int64)
                if values.dtype.kind in "iu"
                else np.floor(values).astype(np.int64)
            )
            return whole * unit_ns + np.rint(
                (values - whole).astype(float) * unit_ns
            ).astype(np.int64)
    return None
