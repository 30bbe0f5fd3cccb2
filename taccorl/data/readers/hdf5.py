"""HDF5 files without clocks (ALOHA, AgileX cobot_magic): each file is one episode, a topic is the path of an HDF5 dataset, and
sample k is row k.

Times follow from the rate that the spec's channels state. Pictures may be raw or compressed one by one, padded or not.
"""

import contextlib
import functools
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from taccorl.data.finding import listed
from taccorl.data.recording import Damage, Message, Reader, TopicType, readers
from taccorl.data.spec import ACTION, RecordingSpec
from taccorl.data.timing import NS_PER_S
from taccorl.errors import RecordingError

BLOCK_BYTES = 4 << 20
"""Number of bytes that are read at once."""
MOST_ROWS = 10_000_000
"""Most rows that an HDF5 dataset may have: 92 hours at 30 Hz. A file of a few kilobytes can declare any number of unwritten
rows."""
MOST_BLOCK_BYTES = 1 << 30
"""Largest block that is read at once, a chunk or a row [bytes]. 1000 pictures of 480×640 are 0.9 GB."""
COMPRESSED = (b"\xff\xd8\xff", b"\x89PNG")  # how JPEG and PNG begin
RATE_ATTRIBUTES = ("fps", "frequency")
"""Attributes of a file in which its rate of rows may be stated [Hz]."""
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
        """Clock for the channels of a spec.

        Raises:
            RecordingError: two channels of one topic state different ``lead_frames``, or a channel of ``action`` states none.
        """
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


@readers.register("hdf5")
class Hdf5Reader(Reader):
    """Reader for HDF5 files, one recording per file."""

    suffixes = (".hdf5", ".h5")

    def topics(self) -> dict[str, TopicType]:
        with self._open() as file:
            return {topic: _topic_type(dataset) for topic, dataset in _datasets(file).items()}

    def messages(
        self,
        topics: Collection[str] | None,
        *,
        stamps_only: Collection[str] = (),
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[Message]:
        found: list[Damage] = []
        with self._open() as file:
            datasets = _datasets(file)
            self.metadata["attributes"] = {name: _text(value) for name, value in file.attrs.items()}
            self._check_lengths(datasets)
            clock = RowClock.of(self._rate_hz(file), self.spec)
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
            for k in range(max((_length(datasets[t]) for t in asked), default=0)):
                for topic in asked:
                    log_ns = clock.time_ns(topic, k)
                    outside = (start_ns is not None and log_ns < start_ns) or (end_ns is not None and log_ns > end_ns)
                    if k >= _length(datasets[topic]) or outside:
                        continue
                    if topic not in read:
                        yield Message(topic, log_ns, None, None)
                        continue
                    try:
                        value = read[topic].row(k)
                    except OSError as error:
                        value = None
                        found.append(self._lost(clock, topic, read[topic], error))
                    if value is None and (_is_compressed(datasets[topic]) or topic in self._picture_topics):
                        value = b""  # a broken picture: who asked for it by its time must not wait for it
                    if value is not None:
                        yield Message(topic, log_ns, None, value)
        if start_ns is None and end_ns is None:
            self.damage += [d for d in found if d not in self.damage]
            self.unprotected = unprotected

    @functools.cached_property
    def _picture_topics(self) -> set[str]:
        return self.spec.picture_topics if self.spec else set()

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

    def _rate_hz(self, file: h5py.File) -> float:
        told = {name: np.asarray(file.attrs[name]) for name in RATE_ATTRIBUTES if name in file.attrs}
        told = {
            name: float(value.item()) for name, value in told.items() if value.size == 1 and value.dtype.kind in "iuf"
        }
        if self.spec is None:
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
        return Damage(
            str(self.source.path),
            start,
            end,
            f"{topic}, rows {first} to {last} cannot be read ({error})",
            clock.time_ns(topic, first),
            clock.time_ns(topic, last),
        )


class _Blocks:
    """Rows of one dataset, a block at a time: each chunk is unpacked once, and memory stays flat."""

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset, self._text = dataset, _is_text(dataset)
        self._step = _rows_at_once(dataset)
        self.start, self.stop = 0, 0
        self._rows: Any = None

    def row(self, k: int) -> Any:
        """Row k; None for the further rows of a damaged block.

        Raises:
            OSError: the block that begins here is damaged.
        """
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


def _datasets(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Topic → dataset with rows; a single text counts as one row."""
    found: dict[str, h5py.Dataset] = {}

    def visit(name: str, item: Any) -> None:
        topic = f"/{name}"
        if isinstance(item, h5py.Dataset) and topic not in BOOKKEEPING and (item.shape or _is_text(item)):
            found[topic] = item

    file.visititems(visit)
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
