"""ROS 2 SQLite bags (.db3, with or without metadata.yaml) and ROS 1 bags (.bag, version 2.0), read without ROS.

SQLite bags since ROS 2 Iron hold their message definitions. For older ones those of ROS 2's distributions are used: the newest
whose layout fits a topic's first message to the byte. SQLite keeps no checksums: a lost page is noticed, reported and skipped,
and so is what ``PRAGMA integrity_check`` finds; changed bytes inside a message are not.

ROS 1 bags hold their definitions, and no checksums either. One without a whole index, as a recorder that was killed leaves it,
is refused; ``rosbag reindex`` makes the index.
"""

import contextlib
import functools
import os
import shutil
import sqlite3
import struct
import tempfile
from collections import Counter
from collections.abc import Collection, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from taccorl.data import decode
from taccorl.data.readers.mcap import BagReader, bag_sources
from taccorl.data.recording import (
    Damage,
    Message,
    Query,
    Reader,
    Source,
    TopicType,
    readers,
)
from taccorl.data.ros import Decoder, full_name, shipped_store, type_store, unpacked
from taccorl.data.spec import RecordingSpec
from taccorl.data.stated_counts import StatedCounts, lacking_files, metadata_of
from taccorl.errors import RecordingError

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as BagFile

WRITE_AHEAD_LOG = "-wal"  # Behind the name of an SQLite file
WRITE_VERSION = 18  # Byte of an SQLite file that states how it is written
WITH_LOG = 2  # … if with a write-ahead log
FARTHEST_ID = 1 << 62
MOST_FAULTS = 5  # Most reported results of SQLite's integrity check; a damaged page gives one for each of its cells
EVERY_TIME = (
    -(1 << 63),
    (1 << 63) - 1,
)  # Earliest and latest log time that SQLite can hold [ns]
UNPROTECTED = "bags hold no checksums: changed bytes in a message that still decodes are read as values"


@readers.register("db3")
class Db3Reader(BagReader):
    """One SQLite bag: a file, or the files that a bag folder's metadata.yaml names."""

    suffixes = (".db3",)
    logs = (WRITE_AHEAD_LOG, "-shm", "-journal")

    def __init__(self, source: Source, spec: RecordingSpec | None = None) -> None:
        super().__init__(source, spec)
        self._topics: dict[str, TopicType] = {}
        self._decoders: dict[str, Decoder] = {}
        self._distro: str | None = metadata_of(source).get("ros_distro")

    def topics(self) -> dict[str, TopicType]:
        for path in self.source.files:
            with _File(path, []) as file:
                self._learn(file)
        return dict(self._topics)

    def read(self, query: Query, damage: list[Damage]) -> Generator[Message, None, str]:
        between = tuple(
            x if x is not None else e
            for x, e in zip((query.start_ns, query.end_ns), EVERY_TIME, strict=True)
        )
        counts: dict[Path, Counter[str]] = {}
        last_ns, without_log = None, []
        for path in self.source.files:
            with _File(path, damage) as file:
                names = self._learn(file)
                counts[path] = Counter()
                without_log += file.without_log
                self.check_decodable(
                    {name: self._topics[name] for name in names.values()},
                    query,
                    str(path),
                )
                asked, orphans = [i for i, name in names.items() if query.asks(name)], 0
                for _, topic_id, log_ns, data in file.rows(asked, between):
                    orphans += topic_id not in names
                    counts[path][names.get(topic_id, f"topic {topic_id}")] += 1
                    last_ns = log_ns if last_ns is None else max(last_ns, log_ns)
                    if data is not None:
                        yield self._message(names[topic_id], log_ns, data, query)
                if query.topics is not None and query.whole:
                    file.check_structure()
                if orphans:
                    file.lost(
                        f"{orphans} messages of topics that the bag does not name"
                    )
        log = ", ".join(without_log)
        if query.whole:
            way_out = f"Was {log} beside it on the robot? Copy it, too" if log else ""
            self.compare_counts(counts, last_ns, damage, way_out)
        if log and not metadata_of(self.source):
            return (
                f"SQLite {UNPROTECTED}, and nothing counts the messages: the newest "
                f"may be in {log}, which is not here"
            )
        return f"SQLite {UNPROTECTED}"

    def _message(self, topic: str, log_ns: int, data: bytes, query: Query) -> Message:
        """Without its value the time alone, of any message: what does not decode has none."""
        value = None
        try:
            value = self._decoders[topic](data)
        except Exception as error:  # rosbags raises what it likes on bytes that do not fit the definition
            if query.reads(topic):
                raise misfit(topic, log_ns, self._topics[topic].name, error) from error
        return Message(
            topic, log_ns, decode.stamp_ns(value), value if query.reads(topic) else None
        )

    def _learn(self, file: "_File") -> dict[int, str]:
        """Topic id → name within ``file``; learns how its topics are decoded."""
        names: dict[int, str] = {}
        definitions, distro = file.definitions(), self._distro or file.distro()
        for topic_id, name, kind, encoding in file.all(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            names[topic_id] = name
            if name in self._topics:
                continue
            full, problem = full_name(kind), None
            first = file.first(topic_id) if full not in definitions else None
            try:
                if encoding != "cdr":
                    raise RecordingError(
                        f"{encoding!r} messages are not supported (supported: cdr)"
                    )
                store, origin = _definition(full, definitions, distro, first)
                self._decoders[name] = functools.partial(_decode, store, full)
                self.metadata.setdefault("definitions", {})[full] = origin
            except RecordingError as error:
                problem = f"{name}: {error}"
            self._topics[name] = TopicType(kind, encoding, problem)
        return names


def _decode(store: Any, kind: str, data: bytes) -> Any:
    return store.deserialize_cdr(unpacked(data), kind)


class _File:
    """One .db3 file, opened so that nothing is ever written beside it."""

    def __init__(self, path: Path, damage: list[Damage]) -> None:
        self.path, self.damage, self._sound = path, damage, len(damage)
        self.without_log: list[str] = []
        """Name of the write-ahead log, if the file was written with one that is not beside it."""

    def __enter__(self) -> "_File":
        with contextlib.ExitStack() as stack:
            try:
                self._connection = self._connect(stack)
            except (OSError, sqlite3.Error) as error:
                raise RecordingError(
                    f"{self.path}: cannot be opened: {error}"
                ) from error
            self._tables = {
                row[0]
                for row in self.all(
                    "SELECT name FROM sqlite_master WHERE type = 'table'"
                )
            }
            if not {"topics", "messages"} <= self._tables:
                names = ", ".join(sorted(self._tables)) or "none"
                raise RecordingError(
                    f"{self.path}: is an SQLite file, but not a ROS 2 bag: its tables are {names}"
                )
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _connect(self, stack: contextlib.ExitStack) -> sqlite3.Connection:
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            header = file.read(100)
        if size == 0:
            raise RecordingError(f"{self.path}: is empty (0 bytes)")
        if not header.startswith(b"SQLite format 3\0") or len(header) < 100:
            raise RecordingError(
                f"{self.path}: is not an SQLite file: it begins with {header[:16]!r}"
            )
        log = self.path.with_name(self.path.name + WRITE_AHEAD_LOG)
        if header[WRITE_VERSION] == WITH_LOG and not log.is_file():
            self.without_log = [log.name]
        page_bytes, pages = (
            struct.unpack_from(">H", header, 16)[0],
            struct.unpack_from(">I", header, 28)[0],
        )
        page_bytes = 65536 if page_bytes == 1 else page_bytes
        whole, part = page_bytes * pages, 0
        if size < whole:
            part = size % page_bytes
            self.lost(
                f"the file ends {whole - size:,} bytes early (cut off?)",
                (size - part, whole),
            )
        path, how = (
            self.path,
            "mode=ro&immutable=1",
        )  # immutable: no lock, no journal, no shared memory file
        unfinished = [
            p
            for end in (WRITE_AHEAD_LOG, "-journal")
            if (p := path.with_name(path.name + end)).is_file()
        ]
        in_writing = any(p.stat().st_size for p in unfinished)
        if in_writing or part:
            # A recorder that died left its newest messages there; SQLite merges them by writing, so into a copy. Of a page that
            # was cut off it reads zeros for what is missing, so the copy ends before it.
            folder = Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix="taccorl_"))
            )
            for original in (self.path, *unfinished):
                shutil.copyfile(original, folder / original.name)
            path, how = folder / self.path.name, "mode=rw" if in_writing else how
            os.truncate(path, size - part)
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?{how}", uri=True)
        stack.enter_context(contextlib.closing(connection))
        connection.text_factory = lambda raw: raw.decode(errors="replace")
        connection.execute(
            "PRAGMA writable_schema = ON"
        )  # opens also a file that was cut off; nothing is written
        return connection

    def all(self, query: str, *values: Any) -> list[Any]:
        try:
            return self._connection.execute(query, values).fetchall()
        except sqlite3.DatabaseError as error:
            raise RecordingError(
                f"{self.path}: damaged, its list of topics cannot be read ({error})"
            ) from error

    def definitions(self) -> dict[str, tuple[str, str]]:
        """Type → (format, text) of the definitions that the bag holds; empty before ROS 2 Iron."""
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        rows = self.all(query) if "message_definitions" in self._tables else []
        return {
            full_name(kind): (encoding, text) for kind, encoding, text in rows if text
        }

    def distro(self) -> str | None:
        """The ROS 2 distribution that wrote the bag, where it says so."""
        with contextlib.suppress(RecordingError):
            rows = (
                self.all("SELECT ros_distro FROM schema")
                if "schema" in self._tables
                else []
            )
            return str(rows[0][0]) if rows else None
        return None

    def first(self, topic_id: int) -> bytes | None:
        """The topic's first message."""
        with contextlib.suppress(
            RecordingError, ValueError, IndexError
        ):  # a damaged one has no layout to compare
            return unpacked(
                self.all(
                    "SELECT data FROM messages WHERE topic_id = ? LIMIT 1", topic_id
                )[0][0]
            )
        return None

    def rows(
        self, with_data: Collection[int], between: tuple[int, ...]
    ) -> Iterator[tuple[int, int, int, bytes | None]]:
        """(Id, topic id, log time [ns], data) of every message as it was written, with the data of some topics within a time;
        lost ones are reported and skipped."""
        wanted = f"CASE WHEN topic_id IN ({', '.join(map(str, with_data)) or 'NULL'}) AND timestamp BETWEEN ? AND ? "
        wanted += "THEN data END"
        query = f"SELECT id, topic_id, timestamp, {wanted} FROM messages WHERE id > ? ORDER BY id"
        after, after_ns = -FARTHEST_ID, None
        while True:
            try:
                for row in self._connection.execute(query, (*between, after)):
                    _check_row(row, after)
                    after, after_ns = row[0], row[2]
                    yield row
                return
            except sqlite3.DatabaseError as error:
                following = self._next_readable(after)
                until = "the last" if following is None else str(following[0] - 1)
                begin = "the first" if after == -FARTHEST_ID else str(after + 1)
                end_ns = None if following is None else following[1]
                self.lost(
                    f"messages {begin} to {until} cannot be read ({error})",
                    None,
                    after_ns,
                    end_ns,
                )
                if following is None:
                    return
                after, after_ns = following[0] - 1, following[1]

    def check_structure(self) -> None:
        """Note what SQLite finds wrong with the file's pages, all of which it reads, unless a damage has been found already.
        Nothing else finds pages that are used twice, and a log time that differs from the one in the index of log times ("row 15
        missing from index timestamp_idx": message 15)."""
        if len(self.damage) > self._sound:
            return
        with contextlib.suppress(sqlite3.DatabaseError):
            found = [
                row[0]
                for row in self._connection.execute(
                    f"PRAGMA integrity_check({MOST_FAULTS})"
                )
            ]
            for text in (" ".join(str(t).split()) for t in found if t != "ok"):
                self.lost(f"SQLite's integrity check: {text}")

    def _next_readable(self, after: int) -> tuple[int, int] | None:
        """(id, log time) of the next message that can be read, where the one after ``after`` cannot; None if there is none."""

        def look(behind: int) -> tuple[int, int] | None:
            query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id LIMIT 1"
            if (found := self._connection.execute(query, (behind,)).fetchone()) is None:
                return None
            _check_row(found, behind)
            return found[0], found[2]

        def readable(behind: int) -> bool:
            try:
                look(behind)
            except sqlite3.DatabaseError:
                return False
            return True

        low, step = max(after, 0), 1
        while not readable(low + step):
            step *= 2
            if step > FARTHEST_ID // 2:
                return None
        high = low + step
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if readable(middle) else (middle, high)
        return look(high)

    def lost(
        self,
        reason: str,
        where: tuple[int, int] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> None:
        """Note a damage; without ``where`` SQLite did not tell at which bytes."""
        start, end = where or (0, self.path.stat().st_size)
        self.damage.append(Damage(str(self.path), start, end, reason, start_ns, end_ns))


def _check_row(row: Any, after: int) -> None:
    """Raises sqlite3.DatabaseError: no message can be like this, a damage that SQLite itself did not notice."""
    whole = all(isinstance(number, int) for number in row[:3]) and isinstance(
        row[3], bytes | None
    )
    if not whole or row[0] <= after:
        raise sqlite3.DatabaseError("a message with an invalid topic or time")


def _definition(
    kind: str,
    definitions: dict[str, tuple[str, str]],
    distro: str | None,
    first: bytes | None,
) -> tuple[Any, str]:
    """(rosbags type store that knows ``kind``, where its definition is from). Raises RecordingError: no definition, or none
    that fits the first message."""
    from rosbags.typesys import Stores, get_typestore

    if kind in definitions:
        return type_store(kind, *definitions[kind]), "in the bag"
    newest_first = [
        s
        for s in reversed(Stores)
        if s.value.startswith("ros2_") and s is not Stores.LATEST
    ]
    named = [s for s in newest_first if s.value == f"ros2_{distro}"]
    known = [s for s in named or newest_first if kind in get_typestore(s).fielddefs]
    for candidate in known:
        store = shipped_store(candidate.value)
        with contextlib.suppress(Exception):
            if first is not None:
                store.deserialize_cdr(first, kind)
            return (
                store,
                f"{candidate.value}, {'as named by the bag' if named else 'the newest that fits'}",
            )
    text = f"the bag does not define {kind}, "
    if known:
        raise RecordingError(
            f"{text}and the definitions of all ROS 2 distributions do not fit its first message"
        )
    text += f"nor does any ROS 2 distribution from {newest_first[-1].value} to {newest_first[0].value}: convert it to "
    raise RecordingError(
        f"{text}MCAP where its package is installed (`ros2 bag convert`)"
    )


def misfit(topic: str, log_ns: int, kind: str, error: Exception) -> RecordingError:
    """Error of a message that does not fit the definition of its type."""
    text = f"{topic}: a message at log time {log_ns} ns does not fit {kind}"
    return RecordingError(f"{text} ({type(error).__name__}: {error})")


# ---- ROS 1 ----


@readers.register("rosbag1")
class Rosbag1Reader(Reader):
    """One ROS 1 bag; with ``split_bag`` the files x_0, x_1, … of a folder."""

    suffixes = (".bag",)

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        if not path.is_dir():
            return super().sources(path, split_bag=split_bag)
        return bag_sources(path, ".bag", split_bag=True) if split_bag else None

    def topics(self) -> dict[str, TopicType]:
        found: dict[str, TopicType] = {}
        for path in self.source.files:
            with _opened_bag(path) as bag:
                for connection in bag.connections:
                    found.setdefault(connection.topic, _topic_type(connection))
        return found

    def read(self, query: Query, damage: list[Damage]) -> Generator[Message, None, str]:
        for path in self.source.files:
            with _opened_bag(path) as bag:
                asked = [c for c in bag.connections if query.asks(c.topic)]
                for connection in asked:
                    self.check_decodable(
                        {connection.topic: _topic_type(connection)}, query, str(path)
                    )
                # rosbags sorts by log time, which hides a clock that was set back
                if query.whole:
                    damage += _not_indexed(path, bag)
                bag.indexes = {  # pyright: ignore[reportAttributeAccessIssue]
                    number: sorted(
                        _Entry._make(entry)
                        for entry in entries
                        if query.covers(entry.time)
                    )
                    for number, entries in bag.indexes.items()
                }
                for connection, log_ns, data in bag.messages(asked) if asked else ():
                    topic, value, kind = connection.topic, None, connection.msgtype
                    try:
                        value = type_store(
                            kind, "ros1msg", connection.msgdef.data
                        ).deserialize_ros1(data, kind)
                    except Exception as error:  # rosbags raises what it likes on bytes that do not fit the definition
                        if query.reads(topic):
                            raise misfit(topic, log_ns, kind, error) from error
                    stamp_ns = None if value is None else decode.stamp_ns(value)
                    yield Message(
                        topic, log_ns, stamp_ns, value if query.reads(topic) else None
                    )
        if query.whole:
            damage += lacking_files(self.source)
        return f"ROS 1 {UNPROTECTED}"


def _not_indexed(path: Path, bag: "BagFile") -> list[Damage]:
    """Damage for messages that the infos of chunks count and that no index lists."""
    counted: Counter[str] = Counter()
    listed: Counter[str] = Counter()
    times = [entry.time for entries in bag.indexes.values() for entry in entries]
    for connection in bag.connections:
        topic, number = connection.topic, connection.id
        listed[topic] += len(bag.indexes[number])
        counted[topic] += sum(
            chunk.connection_counts.get(number, 0) for chunk in bag.chunk_infos
        )
    ends_ns = [chunk.end_time - 1 for chunk in bag.chunk_infos]
    stated = StatedCounts(
        "the list of chunks", counted, end_ns=max(ends_ns, default=None)
    )
    return stated.compared(path, listed, max(times, default=None))


class _Entry(NamedTuple):
    """Time and position of a message, as rosbags lists them, but in the order of positions."""

    time: int
    chunk_pos: int
    offset: int

    def __lt__(self, other: tuple[int, ...]) -> bool:
        return self[1:] < other[1:]


@contextlib.contextmanager
def _opened_bag(path: Path) -> "Iterator[BagFile]":
    """Raises RecordingError: not a ROS 1 bag, an incomplete one, or damaged where it was read."""
    from rosbags.rosbag1 import Reader as BagFile
    from rosbags.rosbag1 import ReaderError

    if path.is_file() and path.stat().st_size == 0:
        raise RecordingError(f"{path}: is empty (0 bytes)")
    # rosbags checks its own assumptions by assert, and decompressors and struct raise what they like
    faults = (
        ReaderError,
        AssertionError,
        ValueError,
        LookupError,
        struct.error,
        EOFError,
        RuntimeError,
        OSError,
    )
    try:
        with BagFile(path) as bag:
            yield bag
    except faults as error:
        text = f"{path}: cannot be read as a ROS 1 bag ({' '.join(str(error).split()) or type(error).__name__}). A "
        raise RecordingError(
            f"{text}killed recorder leaves no index: `rosbag reindex {path.name}`, in ROS 1"
        ) from error


def _topic_type(connection: Any) -> TopicType:
    problem = None
    try:
        type_store(connection.msgtype, "ros1msg", connection.msgdef.data)
    except RecordingError as error:
        problem = f"{connection.topic}: {error}"
    return TopicType(connection.msgtype, "ros1", problem)
