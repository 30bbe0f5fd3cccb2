"""A recording as the robot wrote it: channels with their own time stamps, read by a plug-in, kept as plain arrays.

A ``Reader`` (one per format, in ``readers/``) turns files into ``Message``s. ``load_recording`` reads a whole recording
once: numbers are decoded and spooled to disk, pictures leave only their stamps and are decoded later, when wanted, so
that memory does not grow with the recording.
"""

import contextlib
import mmap
import tempfile
from abc import ABC, abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from taccorl.data import decode
from taccorl.data.file_kinds import no_recording, sniff
from taccorl.data.origin import DOMAINS, Origin
from taccorl.data.pictures import VideoStream, is_stream, picture
from taccorl.data.spec import ChannelSpec, RecordingSpec, shipped_recording_specs
from taccorl.errors import RecordingError, nearest, no_such_path
from taccorl.plugins import Registry


class Message(NamedTuple):
    """One message of one topic, with the time at which it was recorded and its own stamp."""

    topic: str
    log_ns: int
    """Time at which the recorder received the message [ns]."""
    stamp_ns: int | None
    """Header stamp of the message [ns]; None if messages of its type have none."""
    value: Any
    """Decoded message; None if only stamps were requested."""


@dataclass(frozen=True)
class TopicType:
    """Type of a topic, as stated by the file: name, encoding, and the shape and names of its values."""

    name: str
    encoding: str
    undecodable: str | None = None
    """Reason why the values cannot be decoded; None if they can."""
    shape: tuple[int, ...] | None = None
    """Shape of one value, where the format says so (HDF5, LeRobot)."""
    names: tuple[str, ...] = ()
    """Names of the elements of one value, where the format states them (LeRobot)."""


@dataclass(frozen=True)
class Damage:
    """A damaged part of a file: position, reason, times, and whether messages may be lost."""

    file: str
    byte_start: int
    """First damaged byte of the file; ``byte_end``: the byte after the last one."""
    byte_end: int
    reason: str
    start_ns: int | None = None
    """Lower bound of the log times of the damaged messages [ns], ``end_ns`` the upper one; None: unknown."""
    end_ns: int | None = None
    lost: bool = True
    """True if messages of the file may be lost by this damage; False if not, as for a damaged index that only repeats what the
    data section holds."""

    def __str__(self) -> str:
        return f"{Path(self.file).name} bytes {self.byte_start:,} to {self.byte_end:,}: {self.reason}"


@dataclass(frozen=True)
class Source:
    """One recording among the user's inputs: its files, and the part of them where a file holds several recordings."""

    path: Path
    files: tuple[Path, ...]
    part: str | None = None
    """Name of the part of the file, such as the number of an episode; None: the whole."""

    @property
    def name(self) -> str:
        """Name for messages: the path, followed by ``#part`` for a part of a file."""
        return f"{self.path}#{self.part}" if self.part else str(self.path)


Topics = Collection[str]  # Names of topics


class Reader(ABC):
    """Base class of readers, one per recording format. A reader never writes, decodes only what is requested, and reports
    every loss."""

    suffixes: ClassVar[tuple[str, ...]] = ()
    """File endings that this reader opens, for finding recordings in a folder."""

    def __init__(self, source: Source, spec: RecordingSpec | None = None) -> None:
        """Raises RecordingError: one of the files is an archive, a Git LFS pointer or a picture."""
        for path in source.files:
            if (what := no_recording(path)) is not None:
                raise RecordingError(f"{path}: {what}")
        self.source = source
        self.spec = spec
        """Recording spec for which the file is read; None while it is only inspected."""
        self.damage: list[Damage] = []
        """Damaged parts of the recording. Complete only after ``messages`` has run to its end without time bounds; a partial
        read does not change it."""
        self.metadata: dict[str, dict[str, str]] = {}
        """Named metadata records of the file, beside the messages; filled while reading."""
        self.unprotected = ""
        """Sentence for the report about the parts that no checksum protects: a changed byte there may be read as data. Empty if
        everything has a checksum. Complete when ``damage`` is."""

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        """Return the recordings that ``path`` (a file or folder) holds, in order; None if this reader does not know such a path.

        The default: a file with one of ``suffixes`` is one recording. With ``split_bag`` the numbered files of a folder may be
        one.
        """
        del split_bag
        return [Source(path, (path,))] if path.is_file() and path.suffix in cls.suffixes else None

    @abstractmethod
    def topics(self) -> dict[str, TopicType]:
        """Topic → its type, for every topic in the recording. May be incomplete until ``messages`` has run over a damaged
        file."""

    @abstractmethod
    def messages(
        self, topics: Topics | None, *, stamps_only: Topics = (), start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """Messages of ``topics`` (None: all topics, stamps only) in file order; those of ``stamps_only`` without values. May
        skip those logged before ``start_ns`` or after ``end_ns``. Raises RecordingError: the file is not of this format, or a
        requested topic cannot be decoded."""


readers: Registry[type[Reader]] = Registry("reader", "taccorl.data.readers")


MOST_NAMED = 5  # Most entries of a folder that an error message names
DEEPEST = 4  # Levels of folders that are searched for a hint, below the level at which recordings are read


def find_sources(
    path: Path, *, reader: str | None = None, split_bag: bool = False, skipped: list[str] | None = None
) -> list[tuple[str, Source]]:
    """Find all recordings at ``path`` (a file, bag folder, dataset, or folder of those) as (reader name, source).
    ``skipped``: if given, other entries of a folder and the reasons why they are not read are added to it, and an unreadable
    entry raises no error. Raises RecordingError: nothing there, or nothing that a reader opens."""
    path = Path(path)
    if not path.exists():
        raise RecordingError(no_such_path(path))
    if not (path.is_file() or path.is_dir()):  # a pipe would wait for ever
        raise RecordingError(f"{path}: no recording here: neither a file nor a folder")
    names = [reader] if reader else list(readers)
    found = _sources_at(path, names, split_bag)
    if found is not None:
        return found
    if path.is_dir():
        found, left = _sources_below(path, names, split_bag, stop=skipped is None)
        if not found:
            raise RecordingError(f"{path}: {_why_nothing(path, names, split_bag, left)}")
        if skipped is not None:
            skipped += left
        return found
    kind = sniff(path)
    opens = kind.reader if kind else None
    if opens in names or (reader is not None and _other_kind(path, names, split_bag) is None):
        # an odd ending: the reader will say what is wrong with it
        return [(opens if opens in names else names[0], Source(path, (path,)))]
    raise RecordingError(f"{path}: {_why_nothing(path, names, split_bag, [])}")


def _sources_at(path: Path, names: list[str], split_bag: bool) -> list[tuple[str, Source]] | None:
    for name in names:
        sources = readers.get(name).sources(path, split_bag=split_bag)
        if sources is not None:
            return [(name, source) for source in sources]
    return None


def _sources_below(
    folder: Path, names: list[str], split_bag: bool, *, stop: bool
) -> tuple[list[tuple[str, Source]], list[str]]:
    """Recordings directly in a folder, and what else lies there. ``stop``: raise the error of an entry that a reader knows
    and cannot open, instead of listing it."""
    found: list[tuple[str, Source]] = []
    left: list[str] = []
    for child in sorted(folder.iterdir(), key=lambda p: decode.natural_key(p.name)):
        try:
            sources, why = _sources_at(child, names, split_bag), None
        except (RecordingError, OSError) as error:
            if stop:
                raise
            sources, why = None, without_place(str(error), child)
        if sources is not None:
            found += sources
        elif not child.name.startswith("."):
            left.append(f"{child.name} ({why or _why_not(child, names, split_bag)})")
    return found, left


def _why_not(path: Path, names: list[str], split_bag: bool) -> str:
    """Why an entry of a folder is not read."""
    other = _other_kind(path, names, split_bag)
    if other is not None:
        return other
    if path.is_dir():
        deeper = _nearest_folder(path, names, split_bag)
        there = f"there are recordings in {deeper}: give that folder"
        return "a folder without recordings" if deeper is None else there
    kind = sniff(path)
    return "no recording" if kind is None else f"{kind.name} with another ending: give the file itself"


def _other_kind(path: Path, names: list[str], split_bag: bool) -> str | None:
    """What ``path`` is, where that is known and none of the readers ``names`` opens it."""
    others = [name for name in readers if name not in names]
    reads = f"; this spec reads {', '.join(names)}" if others else ""
    if (what := no_recording(path)) is not None:
        return what
    found_kind = sniff(path)
    if found_kind is not None:
        kind, opens = found_kind.name, found_kind.reader
    else:
        try:
            found = _sources_at(path, others, split_bag)
        except RecordingError as error:
            return without_place(str(error), path) + reads
        if not found:
            return None
        opens = found[0][0]
        kind = "a LeRobot dataset" if opens == "lerobot" else opens
    return None if opens in names else kind + reads


def without_place(text: str, path: Path | str) -> str:
    """Text of an error without the path, for messages that already name the file."""
    return text.removeprefix(f"{path}: ")


def _why_nothing(path: Path, names: list[str], split_bag: bool, left: list[str]) -> str:
    """Why no recording was found at ``path``, and the way to one."""
    other = _other_kind(path, names, split_bag)
    if other is not None:
        opens = kind.reader if (kind := sniff(path)) else None
        fitting = [name for name, spec in shipped_recording_specs().items() if spec.reader == opens]
        return other + (f" ({', '.join(fitting)} reads {opens})" if fitting and len(names) == 1 else "")
    deeper = _nearest_folder(path, names, split_bag) if path.is_dir() else None
    if deeper is not None:
        return f"no recording here, but there are some in {deeper}: give that folder"
    opened = [", ".join(sorted({s for name in names for s in readers.get(name).suffixes}))]
    opened += ["LeRobot datasets"] * ("lerobot" in names)
    who = f"the reader {names[0]} opens" if len(names) == 1 else f"readers {', '.join(names)} open"
    more = f" and {len(left) - MOST_NAMED} more" if len(left) > MOST_NAMED else ""
    listed = f"; not read: {', '.join(left[:MOST_NAMED])}{more}" if left else ""
    return f"no recording here; {who} {' and '.join(text for text in opened if text)}{listed}"


def _nearest_folder(path: Path, names: list[str], split_bag: bool) -> Path | None:
    """The first folder below ``path`` that holds recordings, level by level."""

    def entries(folder: Path) -> list[Path]:
        with contextlib.suppress(OSError):  # somebody else's
            return sorted(p for p in folder.iterdir() if not p.name.startswith("."))
        return []

    def is_read(child: Path) -> bool:
        with contextlib.suppress(RecordingError, OSError):
            return bool(_sources_at(child, names, split_bag))
        return False

    level = [path]
    for _ in range(DEEPEST):
        level = [p for folder in level for p in entries(folder) if p.is_dir()]
        for folder in level:
            if any(map(is_read, entries(folder))):
                return folder
    return None


Identity = tuple[int, int | None, int]
"""Log time [ns], stamp [ns] and number of a message among those of its topic with the same two times: finds it again when the
file is read a second time. Times alone do not: a clock that was set back gives them twice."""


@dataclass
class Channel:
    """One stream of a recording: times and values of its N messages, in the order of the file."""

    name: str
    spec: ChannelSpec
    log_ns: np.ndarray
    """(N,) int64 log times [ns]."""
    stamp_ns: np.ndarray | None
    """(N,) int64 header stamps [ns]; None if the messages have no header."""
    values: np.ndarray | None
    """(N, size) numbers; None for pictures."""
    place: np.ndarray
    """(N,) int64 number of each message among all that were read, in the order of the file."""
    skipped: dict[str, int] = field(default_factory=dict)
    """Reason → number of messages of the topic that give this channel no sample."""


@dataclass
class Recording:
    """One recording in memory: its channels as arrays, read once. Pictures are not kept: ``pictures`` reads them from the
    file."""

    source: Source
    spec: RecordingSpec
    reader: Reader
    channels: dict[str, Channel]
    """Name in the recording spec → channel."""
    texts: dict[str, list[tuple[int, str]]]
    """Topic → (log time [ns], text) of its messages, for topics of markers and instructions."""
    text_places: dict[str, np.ndarray] = field(default_factory=dict)
    """Topic → (N,) number of each of ``texts`` among all messages that were read."""
    counts: dict[str, int] = field(default_factory=dict)
    _streams: set[str] = field(default_factory=set)
    """Topics of videos, found by ``check_pictures``."""

    @property
    def damage(self) -> list[Damage]:
        """Damage that the reader found so far."""
        return self.reader.damage

    @property
    def origin(self) -> Origin:
        """Origin that the file's metadata state. Raises TaccorlError: they state a real domain of a simulated recording, or
        several domains (RecordingError)."""
        records = self.reader.metadata.values()
        ours = [r for r in records if r.get("domain") in DOMAINS]  # other people's key may have any value
        stated = [Origin.read(r) for r in ours]
        named = [Origin.read({"origin": r["origin"]}) for r in records if "origin" in r and r not in ours]
        found = stated or named
        domains = {origin.domain for origin in (*stated, *named) if origin.domain is not None}
        if len(domains) > 1:
            raise RecordingError(f"{self.source.name}: its metadata state the domains {', '.join(sorted(domains))}")
        return found[0] if found else Origin()

    def pictures(self, wanted: dict[str, list[Identity]]) -> Iterator[tuple[str, Identity, Any]]:
        """Yield encoded pictures in the order of the file: (channel, identity, payload as the reader decodes it). ``wanted``:
        name of the channel → identities of the pictures."""
        by_topic: dict[str, list[str]] = {}
        for name in wanted:
            by_topic.setdefault(self.spec.channels[name].topic, []).append(name)
        sets = {name: set(ids) for name, ids in wanted.items()}
        logs = [ident[0] for ids in wanted.values() for ident in ids]
        if not logs:
            return
        seen: Counter[tuple[str, int, int | None]] = Counter()
        streams: dict[str, VideoStream] = {}

        def given(topic: str, decoded: list[tuple[Any, np.ndarray | None]]) -> Iterator[tuple[str, Identity, Any]]:
            for (ident, value), frame in decoded:
                names = [name for name in by_topic[topic] if ident in sets[name]]
                yield from ((name, ident, value if frame is None else frame) for name in names)

        # The frames of a video need those before them.
        start_ns = None if self._streams & set(by_topic) else min(logs)
        for m in self.reader.messages(set(by_topic), start_ns=start_ns, end_ns=max(logs)):
            times = (m.topic, m.log_ns, m.stamp_ns)
            ident = (m.log_ns, m.stamp_ns, seen[times])
            seen[times] += 1
            if m.topic not in self._streams:
                yield from given(m.topic, [((ident, m.value), None)])
            elif m.topic in streams or is_stream(m.value):
                stream = streams.setdefault(m.topic, VideoStream(str(decode.maybe(m.value, "format"))))
                yield from given(m.topic, stream.decode((ident, m.value), decode.maybe(m.value, "data")))
        for topic, stream in streams.items():
            yield from given(topic, stream.decode(None, None))

    def check_pictures(self, name: str, identities: list[Identity]) -> None:
        """Check that pictures of a channel decode, before any work is done for them: its first one, else another one. Raises
        RecordingError: none of those does, with the reason of the first."""
        topic, number = self.spec.channels[name].topic, len(identities)
        tried = {identities[k] for k in (0, number // 2, number - 1)} if number else set()
        reason = ""
        for _, ident, value in self.pictures({name: sorted(tried, key=lambda i: i[0])}):
            if ident == identities[0] and is_stream(value):
                self._streams.add(topic)
                return self.check_pictures(name, identities)
            try:
                picture(value, self.spec.channels[name])
                return None
            except RecordingError as error:
                reason = reason or str(error)
        if reason:
            raise RecordingError(f"{topic}: {reason}")
        return None


class Spool:
    """Rows that are appended to a file on disk and read back as one memory-mapped array, so that memory use does not grow with
    their number."""

    def __init__(self, folder: Path, name: str) -> None:
        self._path = folder / f"{name}.spool"
        self._file = self._path.open("wb")
        self._dtype: np.dtype | None = None
        self._size = 0
        self._rows = 0

    def append(self, row: np.ndarray) -> None:
        """Append one row (1-D array); all rows of a channel have the same size and dtype."""
        if self._dtype is None:
            self._dtype, self._size = row.dtype, row.size
        elif row.size != self._size:
            raise RecordingError(f"{row.size} values after messages with {self._size}")
        self._file.write(row.astype(self._dtype, copy=False).tobytes())
        self._rows += 1

    def finish(self) -> np.ndarray:
        """All rows as a memory-mapped array (rows, size)."""
        self._file.close()
        if self._rows == 0 or self._dtype is None:
            return np.empty((0, 0))
        return np.memmap(self._path, dtype=self._dtype, mode="r", shape=(self._rows, self._size))


def release(values: np.ndarray) -> None:
    """Release the memory of ``values``, a memory-mapped array (rows, size). It is read from disk again at its next use."""
    mapped = getattr(values, "_mmap", None)
    if mapped is not None and hasattr(mapped, "madvise"):
        mapped.madvise(mmap.MADV_DONTNEED)


def load_recording(
    source: Source, spec: RecordingSpec, scratch: Path, progress: Callable[[int], None] | None = None
) -> Recording:
    """Read a recording once, decoding the spec's topics only. ``scratch``: folder for spooled numbers; must live as long as
    the recording is used. ``progress``: called with the number of messages read so far, now and then. Raises RecordingError:
    not readable, a topic is missing or of another type, or a message does not fit the spec."""
    reader = readers.get(spec.reader)(source, spec)
    loader = _Loader(reader, spec, scratch)
    for k, message in enumerate(reader.messages(loader.topics, stamps_only=loader.picture_topics)):
        loader.take(message)
        if progress is not None and k % 2000 == 0:
            progress(k)
    return loader.finish()


class _Loader:
    def __init__(self, reader: Reader, spec: RecordingSpec, scratch: Path) -> None:
        self.reader, self.spec = reader, spec
        pictures = set(spec.picture_channels)
        touch = [(spec.features[key], sensor) for key, sensor in spec.target.sensors.items() if key in spec.features]
        pads = {name: sensor for mapping, sensor in touch for name in mapping.channels}
        self.by_topic: dict[str, list[str]] = {}
        for name, channel in spec.channels.items():
            self.by_topic.setdefault(channel.topic, []).append(name)
        self.picture_topics = spec.picture_topics
        both = self.picture_topics & {spec.channels[c].topic for c in spec.channels if c not in pictures}
        if both:
            raise RecordingError(f"{', '.join(sorted(both))}: the spec reads it both as pictures and as numbers")
        self.text_topics = {t for t in (spec.episodes.topic, spec.instruction.topic) if t}
        self.topics = set(self.by_topic) | self.text_topics
        self.log = {t: array("q") for t in self.topics}  # 8 bytes a message; a list of ints takes 40
        self.stamp = {t: array("q") for t in self.topics}
        self.place = {t: array("q") for t in self.topics}
        self.num_messages = 0
        self.headless: dict[str, array[int]] = {}
        """Topic → numbers of its messages without a time stamp that can be read."""
        self.texts: dict[str, list[tuple[int, str]]] = {t: [] for t in self.text_topics}
        numbers = [c for c in spec.channels if c not in pictures]
        self.spools = {c: Spool(scratch, f"channel_{k}") for k, c in enumerate(numbers)}
        self.kept = {c: array("q") for c in numbers}
        self.skipped: dict[str, Counter[str]] = {c: Counter() for c in numbers}
        self.extract = {
            c: decode.pad_extractor(spec.channels[c], pads[c])
            if c in pads
            else decode.vector_extractor(spec.channels[c])
            for c in self.spools
        }

    def take(self, m: Message) -> None:
        self.log[m.topic].append(m.log_ns)
        self.stamp[m.topic].append(m.stamp_ns or 0)
        self.place[m.topic].append(self.num_messages)
        self.num_messages += 1
        if m.stamp_ns is None:
            self.headless.setdefault(m.topic, array("q")).append(len(self.log[m.topic]) - 1)
        if m.topic in self.text_topics:
            self.texts[m.topic].append((m.log_ns, decode.text(m.value, m.topic)))
        for name in self.by_topic.get(m.topic, ()):
            if name in self.spools:
                try:
                    self.spools[name].append(self.extract[name](m.value))
                    self.kept[name].append(len(self.log[m.topic]) - 1)
                except decode.NoSample as reason:
                    self.skipped[name][str(reason)] += 1
                except RecordingError as error:
                    self._check_type(name, self.reader.topics())  # another type explains more than what is odd in it
                    raise RecordingError(f"{m.topic}, message {len(self.log[m.topic]) - 1}: {error}") from error

    def finish(self) -> Recording:
        present = self.reader.topics()
        missing = [t for t in sorted(self.by_topic) if not self.log[t]]
        marker = self.spec.episodes.topic
        if marker and not self.log[marker]:
            missing.append(marker)
        if missing:
            unknown = [t for t in missing if t not in present]
            if self.reader.damage:
                hint = f"the file is damaged or cut off: {self.reader.damage[0]}"
            elif not present:
                hint = "the file names no topics"
            elif unknown:
                hint = "; ".join(f"{t}: {nearest(t, present)}" for t in unknown[:3])
            else:
                hint = "the file names them, but holds no message of them"
            raise RecordingError(
                f"topics in the spec but without messages in the recording: {', '.join(missing)} ({hint})"
            )
        for name in self.spec.channels:
            self._check_type(name, present)
        channels = {name: self._channel(name) for name in self.spec.channels}
        counts = {t: len(log) for t, log in self.log.items()}
        places = {t: np.array(self.place[t], dtype=np.int64) for t in self.texts}
        return Recording(self.reader.source, self.spec, self.reader, channels, self.texts, places, counts)

    def _check_type(self, name: str, present: dict[str, TopicType]) -> None:
        channel = self.spec.channels[name]
        found = present[channel.topic].name
        if channel.type is not None and decode.type_key(found) != decode.type_key(channel.type):
            raise RecordingError(f"{channel.topic} is {found}, but the spec's channel {name!r} requires {channel.type}")

    def _channel(self, name: str) -> Channel:
        spec = self.spec.channels[name]
        if name in self.kept and not self.kept[name]:
            reasons = "; ".join(f"{count}: {reason}" for reason, count in self.skipped[name].most_common(3))
            raise RecordingError(
                f"{spec.topic}: none of its {len(self.log[spec.topic])} messages gives a sample of channel {name!r}: {reasons}"
            )
        if spec.topic in self.headless:
            if self.spec.clock_of(name) == "header":
                without, total = self.headless[spec.topic], len(self.log[spec.topic])
                how_many = f" in {len(without)} of {total} messages, first in message {without[0]}" * (
                    len(without) < total
                )
                raise RecordingError(
                    f"{spec.topic} has no header stamp{how_many}: write `clock: log` on channel {name!r}"
                )
            stamp_ns = None
        else:
            stamp_ns = np.array(self.stamp[spec.topic], dtype=np.int64)
        values = self.spools[name].finish() if name in self.spools else None
        log_ns, place = (np.array(x[spec.topic], dtype=np.int64) for x in (self.log, self.place))
        if values is not None and len(values) < len(log_ns):
            kept = np.array(self.kept[name], dtype=np.int64)
            log_ns, place = log_ns[kept], place[kept]
            stamp_ns = None if stamp_ns is None else stamp_ns[kept]
        skipped = dict(self.skipped[name]) if name in self.skipped else {}
        return Channel(name, spec, log_ns, stamp_ns, values, place, skipped)


@contextlib.contextmanager
def opened(source: Source, spec: RecordingSpec, progress: Callable[[int], None] | None = None) -> Iterator[Recording]:
    """``load_recording`` with a scratch folder that is removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="taccorl_") as scratch:
        yield load_recording(source, spec, Path(scratch), progress)
