"""A recording as the robot wrote it: channels with their own time stamps, read by a plug-in, kept as plain arrays.

A ``Reader`` (one per format, in ``readers/``) turns files into ``Message``s. ``load_recording`` reads a whole recording once:
numbers are decoded and spooled to disk, pictures leave only their stamps and are decoded later, when wanted, so that memory does
not grow with the recording.
"""

import contextlib
import tempfile
from abc import ABC, abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from taccorl.data import decode
from taccorl.data.file_kinds import no_recording, sniff
from taccorl.data.origin import DOMAINS, Origin
from taccorl.data.pictures import VideoStream, is_stream, picture
from taccorl.data.spec import ChannelSpec, RecordingSpec, shipped_recording_specs
from taccorl.data.spool import Spool
from taccorl.errors import RecordingError, nearest, no_such_path
from taccorl.plugins import Registry


class Message(NamedTuple):
    """One message of one topic: when the recorder received it, its own header stamp (None if its type has none) [ns], and its
    decoded value (None if only stamps were requested)."""

    topic: str
    log_ns: int
    stamp_ns: int | None
    value: Any


@dataclass(frozen=True)
class TopicType:
    """Type of a topic, as stated by the file."""

    name: str
    encoding: str
    undecodable: str | None = None
    """Reason why the values cannot be decoded; None if they can."""
    shape: tuple[int, ...] | None = None
    """Shape of one value, where the format says so (HDF5, LeRobot); ``names``: of its elements (LeRobot)."""
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Damage:
    """A damaged part of a file: its first byte, the byte after the last one, and the reason."""

    file: str
    byte_start: int
    byte_end: int
    reason: str
    start_ns: int | None = None
    """Lower bound of the log times of the damaged messages [ns], ``end_ns`` the upper one; None: unknown."""
    end_ns: int | None = None
    lost: bool = True
    """False if no message can be lost by it, as by a damaged index that only repeats what the data section holds."""
    missing: tuple[tuple[str, int], ...] = ()
    """(Topic, number of messages) that the file counts and does not hold; a topic without a name where only a sum is counted.
    Nobody knows at which bytes they were: these are then 0 to 0."""

    def __str__(self) -> str:
        name = Path(self.file).name
        lacking = [
            f"{n:,} of {topic}" if topic else f"{n:,}" for topic, n in self.missing
        ]
        more = f"; missing: {', '.join(lacking)}" if lacking else ""
        if self.byte_end == 0:
            return f"{name}: {self.reason}{more}"
        return f"{name} bytes {self.byte_start:,} to {self.byte_end:,}: {self.reason}{more}"


@dataclass(frozen=True)
class Source:
    """One recording among the user's inputs: its files, and the part of them where a file holds several recordings."""

    path: Path
    files: tuple[Path, ...]
    part: str | None = None
    beside: tuple[Path, ...] = ()
    """Files that belong to ``files`` and are read along, such as a write-ahead log."""

    @property
    def inputs(self) -> tuple[Path, ...]:
        """All files that are read."""
        return *self.files, *self.beside

    @property
    def name(self) -> str:
        """Name for messages: the path, followed by ``#part`` for a part of a file."""
        return f"{self.path}#{self.part}" if self.part else str(self.path)


Topics = Collection[str]  # Names of topics


class Query(NamedTuple):
    """What is wanted of a recording: topics (None: all, stamps only), those of them without values, and log times [ns]."""

    topics: Topics | None
    stamps_only: Topics = ()
    start_ns: int | None = None
    end_ns: int | None = None

    @property
    def whole(self) -> bool:
        """Whether it has no bounds in time, so that all damage is found."""
        return self.start_ns is None and self.end_ns is None

    def asks(self, topic: str) -> bool:
        return self.topics is None or topic in self.topics

    def reads(self, topic: str) -> bool:
        """Whether values of the topic are wanted."""
        return (
            self.topics is not None
            and topic in self.topics
            and topic not in self.stamps_only
        )

    def covers(self, log_ns: int) -> bool:
        return (self.start_ns is None or log_ns >= self.start_ns) and (
            self.end_ns is None or log_ns <= self.end_ns
        )


class Reader(ABC):
    """Base class of readers, one per recording format. A reader never writes, decodes only what is requested, and reports
    every loss. It has ``topics`` and ``read`` (or ``messages``)."""

    suffixes: ClassVar[tuple[str, ...]] = ()
    """File endings that this reader opens, for finding recordings in a folder."""

    def __init__(self, source: Source, spec: RecordingSpec | None = None) -> None:
        """``spec``: for which the file is read; None while it is only inspected. Raises RecordingError: one of the files is an
        archive, a Git LFS pointer or a picture."""
        for path in source.files:
            if (what := no_recording(path)) is not None:
                raise RecordingError(f"{path}: {what}")
        self.source, self.spec = source, spec
        self.damage: list[Damage] = []
        """Damaged parts. Complete only after ``messages`` has run to its end without time bounds."""
        self.metadata: dict[str, dict[str, str]] = {}
        """Named metadata records of the file, beside the messages; filled while reading."""
        self.unprotected = ""
        """Sentence about parts without a checksum, where changed bytes may be read as data. Complete when ``damage`` is."""

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        """The recordings that ``path`` (a file or folder) holds, in order; None if this reader does not know such a path.
        ``split_bag``: the numbered files of a folder may be one."""
        del split_bag
        return (
            [Source(path, (path,))]
            if path.is_file() and path.suffix in cls.suffixes
            else None
        )

    @abstractmethod
    def topics(self) -> dict[str, TopicType]:
        """Topic → its type. May be incomplete until ``messages`` has run over a damaged file."""

    def messages(
        self,
        topics: Topics | None,
        *,
        stamps_only: Topics = (),
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[Message]:
        """Messages of ``topics`` (None: all topics, stamps only) in file order; those of ``stamps_only`` without values. May
        skip those logged before ``start_ns`` or after ``end_ns``. Raises RecordingError: the file is not of this format, or a
        requested topic cannot be decoded."""
        query, damage = Query(topics, stamps_only, start_ns, end_ns), list[Damage]()
        unprotected = yield from self.read(query, damage)
        if query.whole:  # a partial or abandoned read saw only a part of it
            self.damage += [d for d in dict.fromkeys(damage) if d not in self.damage]
            self.unprotected = unprotected

    def read(self, query: Query, damage: list[Damage]) -> Generator[Message, None, str]:
        """The messages that ``query`` asks for; appends to ``damage`` and returns ``unprotected``."""
        raise NotImplementedError
        yield

    def check_decodable(
        self, types: Mapping[str, TopicType], query: Query, place: str
    ) -> None:
        """Raises RecordingError: values are wanted of a topic that cannot be decoded."""
        for topic, kind in types.items():
            if kind.undecodable and query.reads(topic):
                named = kind.undecodable.startswith(topic)
                raise RecordingError(
                    f"{place}: {kind.undecodable if named else f'{topic}: {kind.undecodable}'}"
                )


readers: Registry[type[Reader]] = Registry("reader", "taccorl.data.readers")


# ---- finding recordings ----

MOST_NAMED = 5  # Most entries of a folder that an error message names
DEEPEST = 4  # Levels of folders that are searched for a hint, below the level at which recordings are read


def find_sources(
    path: Path,
    *,
    reader: str | None = None,
    split_bag: bool = False,
    skipped: list[str] | None = None,
) -> list[tuple[str, Source]]:
    """All recordings at ``path`` (a file, bag folder, dataset, or folder of those) as (reader name, source). ``skipped``: if
    given, other entries of a folder and the reasons why they are not read are added to it, and an unreadable entry raises no
    error. Raises RecordingError: nothing there, or nothing that a reader opens."""
    path = Path(path)
    if not path.exists():
        raise RecordingError(no_such_path(path))
    if not (path.is_file() or path.is_dir()):  # a pipe would wait for ever
        raise RecordingError(f"{path}: no recording here: neither a file nor a folder")
    names = [reader] if reader else list(readers)
    if (found := _sources_at(path, names, split_bag)) is not None:
        return found
    if path.is_dir():
        found, left = [], dict[str, str]()
        for child in sorted(path.iterdir(), key=lambda p: decode.natural_key(p.name)):
            sources, why = None, ""
            try:
                sources = _sources_at(child, names, split_bag)
            except (RecordingError, OSError) as error:
                if skipped is None:
                    raise
                why = without_place(str(error), child)
            if sources is None and not child.name.startswith("."):
                why = why or _why_not(child, names, split_bag)
                left[child.name] = f"{child.name} ({why})"
            found += sources or []
        if found:
            beside = {p.name for _, source in found for p in source.beside}
            if skipped is not None:
                skipped += [text for name, text in left.items() if name not in beside]
            return found
        raise RecordingError(
            f"{path}: {_why_nothing(path, names, split_bag, [*left.values()])}"
        )
    opens = kind.reader if (kind := sniff(path)) else None
    if opens in names or (
        reader is not None and _other_kind(path, names, split_bag) is None
    ):
        # the reader will say what is wrong with it
        return [(opens if opens in names else names[0], Source(path, (path,)))]
    raise RecordingError(f"{path}: {_why_nothing(path, names, split_bag, [])}")


def _sources_at(
    path: Path, names: list[str], split_bag: bool
) -> list[tuple[str, Source]] | None:
    found = (
        (name, readers.get(name).sources(path, split_bag=split_bag)) for name in names
    )
    return next(
        (
            [(name, source) for source in sources]
            for name, sources in found
            if sources is not None
        ),
        None,
    )


def _other_kind(path: Path, names: list[str], split_bag: bool) -> str | None:
    """What ``path`` is, where that is known and none of the readers ``names`` opens it."""
    others = [name for name in readers if name not in names]
    reads = f"; this spec reads {', '.join(names)}" if others else ""
    if (kind := sniff(path)) is not None:
        return no_recording(path) or (
            None if kind.reader in names else kind.name + reads
        )
    try:
        found = _sources_at(path, others, split_bag) or []
    except RecordingError as error:
        return without_place(str(error), path) + reads
    name = next(
        ("a LeRobot dataset" if name == "lerobot" else name for name, _ in found), ""
    )
    return name + reads if found else None


def _why_not(path: Path, names: list[str], split_bag: bool) -> str:
    """Why an entry of a folder is not read."""
    if (other := _other_kind(path, names, split_bag)) is not None:
        return other
    if path.is_dir():
        deeper = _nearest_folder(path, names, split_bag)
        return (
            f"there are recordings in {deeper}: give that folder"
            if deeper
            else "a folder without recordings"
        )
    return (
        f"{kind.name} with another ending: give the file itself"
        if (kind := sniff(path))
        else "no recording"
    )


def _why_nothing(path: Path, names: list[str], split_bag: bool, left: list[str]) -> str:
    """Why no recording was found at ``path``, and the way to one."""
    if (other := _other_kind(path, names, split_bag)) is not None:
        opens = kind.reader if (kind := sniff(path)) else None
        fitting = [
            name
            for name, spec in shipped_recording_specs().items()
            if spec.reader == opens
        ]
        return other + (
            f" ({', '.join(fitting)} reads {opens})"
            if fitting and len(names) == 1
            else ""
        )
    if (path / "data").is_dir() and (path / "meta").is_dir() and "lerobot" in names:
        return "a LeRobot dataset without meta/info.json: copy it again"
    if (
        path.is_dir()
        and (deeper := _nearest_folder(path, names, split_bag)) is not None
    ):
        return f"no recording here, but there are some in {deeper}: give that folder"
    opened = [
        ", ".join(sorted({s for name in names for s in readers.get(name).suffixes}))
    ]
    opened += ["LeRobot datasets"] * ("lerobot" in names)
    who = (
        f"the reader {names[0]} opens"
        if len(names) == 1
        else f"readers {', '.join(names)} open"
    )
    more = f" and {len(left) - MOST_NAMED} more" if len(left) > MOST_NAMED else ""
    listed = f"; not read: {', '.join(left[:MOST_NAMED])}{more}" if left else ""
    return f"no recording here; {who} {' and '.join(filter(None, opened))}{', taccorl compare tables' * (len(names) > 1)}{listed}"


def without_place(text: str, path: Path | str) -> str:
    """Text of an error without the path, for messages that already name the file."""
    return text.removeprefix(f"{path}: ")


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
        if (
            found := next(
                (folder for folder in level if any(map(is_read, entries(folder)))), None
            )
        ) is not None:
            return found
    return None


# ---- loading ----

Identity = tuple[int, int | None, int]
"""Log time [ns], stamp [ns] and number of a message among those of its topic with the same two times: finds it again when the
file is read a second time. Times alone do not: a clock that was set back gives them twice."""


@dataclass
class Channel:
    """One stream of a recording: times and values of its N messages, in the order of the file."""

    name: str
    spec: ChannelSpec
    log_ns: np.ndarray  # (N,) int64 log times [ns]
    stamp_ns: (
        np.ndarray | None
    )  # (N,) int64 header stamps [ns]; None if the messages have no header
    values: np.ndarray | None  # (N, size) numbers; None for pictures
    place: np.ndarray  # (N,) int64 number of each message among all that were read, in the order of the file
    skipped: dict[str, int] = field(default_factory=dict)
    """Reason → number of messages of the topic that give this channel no sample."""


@dataclass
class Recording:
    """One recording in memory: its channels as arrays, read once. ``pictures`` reads pictures from the file."""

    source: Source
    spec: RecordingSpec
    reader: Reader
    channels: dict[str, Channel]
    """Name in the recording spec → channel."""
    texts: dict[str, list[tuple[int, str]]]
    """Topic → (log time [ns], text) of its messages, for topics of markers and instructions; ``text_places``: (N,) number of each
    among all messages that were read."""
    text_places: dict[str, np.ndarray] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    """Topic → number of its messages."""
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
        stated = [
            Origin.read(r) for r in records if r.get("domain") in DOMAINS
        ]  # other people's key may have any value
        named = [Origin(text=r["origin"]) for r in records if "origin" in r]
        domains = {str(origin.domain) for origin in stated}
        if len(domains) > 1:
            raise RecordingError(
                f"{self.source.name}: its metadata state the domains {', '.join(sorted(domains))}"
            )
        return next(iter(stated or named), Origin())

    def pictures(
        self, wanted: dict[str, list[Identity]]
    ) -> Iterator[tuple[str, Identity, Any]]:
        """Yield encoded pictures in the order of the file: (channel, identity, payload as the reader decodes it). ``wanted``:
        name of the channel → identities of the pictures."""
        logs = [ident[0] for ids in wanted.values() for ident in ids]
        if not logs:
            return
        sets = {name: set(ids) for name, ids in wanted.items()}
        topics = {self.spec.channels[name].topic for name in wanted}
        seen: Counter[tuple[str, int, int | None]] = Counter()
        streams: dict[str, VideoStream] = {}

        def given(
            topic: str, decoded: list[tuple[Any, np.ndarray | None]]
        ) -> Iterator[tuple[str, Identity, Any]]:
            names = [name for name in wanted if self.spec.channels[name].topic == topic]
            for (ident, value), frame in decoded:
                yield from (
                    (n, ident, value if frame is None else frame)
                    for n in names
                    if ident in sets[n]
                )

        # The frames of a video need those before them.
        start_ns = None if self._streams & topics else min(logs)
        for m in self.reader.messages(topics, start_ns=start_ns, end_ns=max(logs)):
            times = (m.topic, m.log_ns, m.stamp_ns)
            ident = (m.log_ns, m.stamp_ns, seen[times])
            seen[times] += 1
            if m.topic not in self._streams:
                yield from given(m.topic, [((ident, m.value), None)])
            elif m.topic in streams or is_stream(m.value):
                stream = streams.setdefault(
                    m.topic, VideoStream(str(decode.maybe(m.value, "format")))
                )
                yield from given(
                    m.topic,
                    stream.decode((ident, m.value), decode.maybe(m.value, "data")),
                )
        for topic, stream in streams.items():
            yield from given(topic, stream.decode(None, None))

    def check_pictures(self, name: str, identities: list[Identity]) -> None:
        """Check that pictures of a channel decode, before any work is done for them: its first one, else another one. Raises
        RecordingError: none of those does, with the reason of the first."""
        topic, number, reason = self.spec.channels[name].topic, len(identities), ""
        tried = (
            {identities[k] for k in (0, number // 2, number - 1)} if number else set()
        )
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


class _Topic:
    """Times and texts of a topic's messages while they are read; 8 bytes a number, where a list of ints takes 40."""

    def __init__(self) -> None:
        self.log, self.stamp, self.place, self.headless = (array("q") for _ in range(4))
        self.texts: list[tuple[int, str]] = []


class _Numbers:
    """Samples of a channel of numbers while they are read, and the messages that gave them."""

    def __init__(self, spool: Spool, extract: Callable[[Any], np.ndarray]) -> None:
        self.spool, self.extract, self.kept = spool, extract, array("q")
        self.skipped: Counter[str] = Counter()


def load_recording(source: Source, spec: RecordingSpec, scratch: Path) -> Recording:
    """Read a recording once, decoding the spec's topics only. ``scratch``: folder for spooled numbers; must live as long as
    the recording is used. Raises RecordingError: not readable, a topic is missing or of another type, or a message does not fit
    the spec."""
    reader = readers.get(spec.reader)(source, spec)
    number_channels = {
        n: c for n, c in spec.channels.items() if n not in spec.picture_channels
    }
    if both := spec.picture_topics & {c.topic for c in number_channels.values()}:
        raise RecordingError(
            f"{', '.join(sorted(both))}: the spec reads it both as pictures and as numbers"
        )
    pads = {
        key: sensor
        for key, sensor in spec.target.sensors.items()
        if key in spec.features
    }
    of_pads = {
        channel: sensor
        for key, sensor in pads.items()
        for channel in spec.features[key].channels
    }
    numbers: dict[str, dict[str, _Numbers]] = {}
    for k, (name, channel) in enumerate(number_channels.items()):
        extract = (
            decode.pad_extractor(channel, of_pads[name])
            if name in of_pads
            else decode.VectorExtractor(channel)
        )
        numbers.setdefault(channel.topic, {})[name] = _Numbers(
            Spool(scratch, f"channel_{k}"), extract
        )
    text_topics = {t for t in (spec.episodes.topic, spec.instruction.topic) if t}
    topics = {
        t: _Topic() for t in {*(c.topic for c in spec.channels.values()), *text_topics}
    }
    for k, m in enumerate(reader.messages(topics, stamps_only=spec.picture_topics)):
        topic = topics[m.topic]
        if m.stamp_ns is None:
            topic.headless.append(len(topic.log))
        topic.log.append(m.log_ns)
        topic.stamp.append(m.stamp_ns or 0)
        topic.place.append(k)
        if m.topic in text_topics:
            topic.texts.append((m.log_ns, decode.text(m.value, m.topic)))
        for name, found in numbers.get(m.topic, {}).items():
            try:
                found.spool.append(found.extract(m.value))
                found.kept.append(len(topic.log) - 1)
            except decode.NoSample as reason:
                found.skipped[str(reason)] += 1
            except RecordingError as error:
                _check_type(
                    spec, name, reader.topics()
                )  # another type explains more than what is odd in it
                raise RecordingError(
                    f"{m.topic}, message {len(topic.log) - 1}: {error}"
                ) from error
    present = reader.topics()
    marked = [spec.episodes.topic] if spec.episodes.topic else []
    wanted = [*sorted({c.topic for c in spec.channels.values()}), *marked]
    if missing := [t for t in wanted if not topics[t].log]:
        hints: dict[
            str, list[str]
        ] = {}  # topics that no name resembles share one list of the known ones
        for t in missing:
            hints.setdefault(
                nearest(t, present) if t not in present else "", []
            ).append(t)
        unknown = [f"{', '.join(of)}: {text}" for text, of in hints.items() if text]
        hint = (
            "; ".join(unknown[:3])
            or "the file names them, but holds no message of them"
        )
        hint = hint if present else "the file names no topics"
        hint = (
            f"the file is damaged or cut off: {reader.damage[0]}"
            if reader.damage
            else hint
        )
        way_out = (
            ". Of another robot? `taccorl ingest inspect RECORDING --draft=spec.yaml` drafts its spec"
            if present and not reader.damage
            else ""
        )
        raise RecordingError(
            f"topics in the spec but without messages in the recording: {', '.join(missing)} ({hint}){way_out}"
        )
    for name in spec.channels:
        _check_type(spec, name, present)
    channels = {
        n: _channel(spec, n, topics[c.topic], numbers.get(c.topic, {}).get(n))
        for n, c in spec.channels.items()
    }
    counts = {t: len(topic.log) for t, topic in topics.items()}
    places = {t: np.array(topics[t].place, dtype=np.int64) for t in text_topics}
    return Recording(
        source,
        spec,
        reader,
        channels,
        {t: topics[t].texts for t in text_topics},
        places,
        counts,
    )


def _check_type(spec: RecordingSpec, name: str, present: dict[str, TopicType]) -> None:
    channel = spec.channels[name]
    found = present[channel.topic].name
    if channel.type is not None and decode.type_key(found) != decode.type_key(
        channel.type
    ):
        raise RecordingError(
            f"{channel.topic} is {found}, but the spec's channel {name!r} requires {channel.type}"
        )


def _channel(
    spec: RecordingSpec, name: str, topic: _Topic, numbers: _Numbers | None
) -> Channel:
    channel, total, without = spec.channels[name], len(topic.log), topic.headless
    if numbers is not None and not numbers.kept:
        reasons = "; ".join(
            f"{count}: {reason}" for reason, count in numbers.skipped.most_common(3)
        )
        text = f"{channel.topic}: none of its {total} messages gives a sample of channel {name!r}: {reasons}"
        raise RecordingError(text)
    if without and spec.clock_of(name) == "header":
        many = (
            f" in {len(without)} of {total} messages, first in message {without[0]}"
            if len(without) < total
            else ""
        )
        raise RecordingError(
            f"{channel.topic} has no header stamp{many}: write `clock: log` on channel {name!r}"
        )
    kept = np.arange(total) if numbers is None else np.array(numbers.kept)
    log_ns, stamp_ns, place = (
        np.array(x, dtype=np.int64)[kept] for x in (topic.log, topic.stamp, topic.place)
    )
    values, skipped = (
        (None, {})
        if numbers is None
        else (numbers.spool.finish(), dict(numbers.skipped))
    )
    return Channel(
        name, channel, log_ns, None if without else stamp_ns, values, place, skipped
    )


@contextlib.contextmanager
def opened(source: Source, spec: RecordingSpec) -> Iterator[Recording]:
    """``load_recording`` with a scratch folder that is removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="taccorl_") as scratch:
        yield load_recording(source, spec, Path(scratch))
