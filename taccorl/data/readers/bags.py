"""ROS 2 SQLite bags (.db3, with or without metadata.yaml) and ROS 1 bags (.bag, version 2.0), read without ROS.

SQLite bags since ROS 2 Iron hold their message definitions. For older ones the definitions of ROS 2's distributions are used: the
newest whose layout fits a topic's first message to the byte. SQLite keeps no checksums: a lost page is noticed, reported and
skipped, and so is what ``PRAGMA integrity_check`` finds; changed bytes inside a message are not.

ROS 1 bags hold their message definitions, and no checksums either. One without a whole index, as a recorder that was killed
leaves it, is refused; ``rosbag reindex`` makes the index.
"""

import contextlib
import functools
import re
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from taccorl.data import decode
from taccorl.data.mcap_messages import unpacked
from taccorl.data.readers.mcap import MOST_METADATA_BYTES, BagReader, bag_sources
from taccorl.data.recording import Damage, Message, Reader, Source, Topics, TopicType, readers
from taccorl.data.spec import RecordingSpec
from taccorl.data.strict_yaml import load_yaml
from taccorl.errors import RecordingError, SpecError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as BagFile

SQLITE_MAGIC = b"SQLite format 3\0"
FARTHEST_ID = 1 << 62
MOST_FAULTS = 5
"""Most results of SQLite's integrity check that are reported; a damaged page gives one for each of its cells."""
EVERY_TIME = (-(1 << 63), (1 << 63) - 1)  # Earliest and latest log time that SQLite can hold [ns]

Decoder = Callable[[bytes], Any]
Row = tuple[int, int, int, bytes | None]  # Message id, topic id, log time [ns], data


@readers.register("db3")
class Db3Reader(BagReader):
    """One SQLite bag: a file, or the files that a bag folder's metadata.yaml names."""

    suffixes = (".db3",)

    def __init__(self, source: Source, spec: RecordingSpec | None = None) -> None:
        super().__init__(source, spec)
        self._bag = _bag_metadata(source)
        self._topics: dict[str, TopicType] = {}
        self._decoders: dict[str, Decoder] = {}

    def topics(self) -> dict[str, TopicType]:
        for path in self.source.files:
            with _File(path) as file:
                self._learn(file)
        return dict(self._topics)

    def messages(
        self, topics: Topics | None, *, stamps_only: Topics = (), start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        found: list[Damage] = []
        between = (EVERY_TIME[0] if start_ns is None else start_ns, EVERY_TIME[1] if end_ns is None else end_ns)
        for path in self.source.files:
            with _File(path) as file:
                names = self._learn(file)
                asked = {i: name for i, name in names.items() if topics is None or name in topics}
                values = {i for i, name in asked.items() if topics is not None and name not in stamps_only}
                for name in (asked[i] for i in values):
                    if self._topics[name].undecodable:
                        raise RecordingError(f"{path}: {self._topics[name].undecodable}")
                orphans = 0
                for _, topic_id, log_ns, data in file.rows(asked, between):
                    orphans += topic_id not in names
                    if data is not None:
                        yield self._message(asked[topic_id], log_ns, data, topic_id in values)
                if topics is not None and start_ns is None and end_ns is None:
                    file.check_structure()
                if orphans:
                    file.lost(f"{orphans} messages of topics that the bag does not name")
                found += [d for d in file.damage if d not in found]
        if start_ns is None and end_ns is None:
            self.damage += [d for d in found if d not in self.damage]
            self.unprotected = (
                "SQLite bags hold no checksums: changed bytes in a message that still decodes are read as values"
            )

    def _message(self, topic: str, log_ns: int, data: bytes, with_value: bool) -> Message:
        if not with_value:
            return Message(topic, log_ns, self._stamp_ns(topic, data), None)
        try:
            value = self._decoders[topic](data)
        except Exception as error:  # rosbags raises what it likes on bytes that do not fit the definition
            raise _misfit(topic, log_ns, self._topics[topic].name, error) from error
        return Message(topic, log_ns, decode.stamp_ns(value), value)

    def _stamp_ns(self, topic: str, data: bytes) -> int | None:
        """The time alone, of any message: what does not decode has none."""
        if topic not in self._decoders:
            return None
        with contextlib.suppress(Exception):
            return decode.stamp_ns(self._decoders[topic](data))
        return None

    def _learn(self, file: "_File") -> dict[int, str]:
        """Topic id → name within ``file``; learns how its topics are decoded."""
        names: dict[int, str] = {}
        definitions, distro = file.definitions(), self._bag.get("ros_distro") or file.distro()
        for topic_id, name, kind, encoding in file.topics():
            names[topic_id] = name
            if name in self._topics:
                continue
            full, problem = _full_name(kind), None
            first = file.first(topic_id) if full not in definitions else None
            with contextlib.suppress(ValueError):  # a damaged message has no layout to compare
                first = unpacked(first) if first else None
            try:
                if encoding != "cdr":
                    raise RecordingError(f"{encoding!r} messages are not supported (supported: cdr)")
                store, origin = _definition(full, definitions, distro, first)
                self._decoders[name] = functools.partial(self._decode, store, full)
                self.metadata.setdefault("definitions", {})[full] = origin
            except RecordingError as error:
                problem = f"{name}: {error}"
            self._topics[name] = TopicType(kind, encoding, problem)
        return names

    def _decode(self, store: Any, kind: str, data: bytes) -> Any:
        return store.deserialize_cdr(unpacked(data), kind)


class _File:
    """One .db3 file, opened so that nothing is ever written beside it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[Damage] = []

    def __enter__(self) -> "_File":
        with contextlib.ExitStack() as stack:
            try:
                self._connection = self._connect(stack)
            except (OSError, sqlite3.Error) as error:
                raise RecordingError(f"{self.path}: cannot be opened: {error}") from error
            self._tables = {row[0] for row in self._all("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not {"topics", "messages"} <= self._tables:
                names = ", ".join(sorted(self._tables)) or "none"
                raise RecordingError(f"{self.path}: is an SQLite file, but not a ROS 2 bag: its tables are {names}")
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
        if not header.startswith(SQLITE_MAGIC) or len(header) < 100:
            raise RecordingError(f"{self.path}: is not an SQLite file: it begins with {header[:16]!r}")
        page_bytes, pages = struct.unpack_from(">H", header, 16)[0], struct.unpack_from(">I", header, 28)[0]
        whole = (65536 if page_bytes == 1 else page_bytes) * pages
        if size < whole:
            self.lost(f"the file ends {whole - size:,} bytes early (cut off?)", (size, whole))
        path, how = self.path, "mode=ro&immutable=1"  # immutable: no lock, no journal, no shared memory file
        unfinished = [p for end in ("-wal", "-journal") if (p := path.with_name(path.name + end)).is_file()]
        if any(p.stat().st_size for p in unfinished):
            # A recorder that died left its newest messages there; SQLite merges them by writing, so into a copy.
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="taccorl_")))
            for original in (self.path, *unfinished):
                shutil.copyfile(original, folder / original.name)
            path, how = folder / self.path.name, "mode=rw"
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?{how}", uri=True)
        stack.enter_context(contextlib.closing(connection))
        connection.text_factory = lambda raw: raw.decode(errors="replace")
        connection.execute("PRAGMA writable_schema = ON")  # opens also a file that was cut off; nothing is written
        return connection

    def topics(self) -> list[tuple[int, str, str, str]]:
        """(id, name, type, encoding)"""
        return self._all("SELECT id, name, type, serialization_format FROM topics ORDER BY id")

    def definitions(self) -> dict[str, tuple[str, str]]:
        """Type → (format, text) of the definitions that the bag holds; empty before ROS 2 Iron."""
        if "message_definitions" not in self._tables:
            return {}
        rows = self._all("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        return {_full_name(kind): (encoding, text) for kind, encoding, text in rows if text}

    def distro(self) -> str | None:
        """The ROS 2 distribution that wrote the bag, where it says so."""
        if "schema" not in self._tables:
            return None
        with contextlib.suppress(RecordingError):
            return next((str(row[0]) for row in self._all("SELECT ros_distro FROM schema")), None)
        return None

    def first(self, topic_id: int) -> bytes | None:
        """The topic's first message."""
        with contextlib.suppress(RecordingError):
            found = self._all("SELECT data FROM messages WHERE topic_id = ? LIMIT 1", topic_id)
            return found[0][0] if found else None
        return None

    def rows(self, with_data: Collection[int], between: tuple[int, int]) -> Iterator[Row]:
        """Every message as it was written, with the data of some topics within a time; lost ones are reported and skipped."""
        ids = ", ".join(str(i) for i in with_data) or "NULL"
        wanted = f"CASE WHEN topic_id IN ({ids}) AND timestamp BETWEEN ? AND ? THEN data END"
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
                self.lost(f"messages {begin} to {until} cannot be read ({error})", None, after_ns, end_ns)
                if following is None:
                    return
                after, after_ns = following[0] - 1, following[1]

    def check_structure(self) -> None:
        """Note what SQLite finds wrong with the file's pages, unless a damage has been found already.

        It reads every page. Nothing else finds pages that are used twice, and a message's log time that differs from the one in
        the index of log times ("row 15 missing from index timestamp_idx": message 15).
        """
        if self.damage:
            return
        with contextlib.suppress(sqlite3.DatabaseError):
            found = [row[0] for row in self._connection.execute(f"PRAGMA integrity_check({MOST_FAULTS})")]
            for text in (" ".join(str(t).split()) for t in found if t != "ok"):
                self.lost(f"SQLite's integrity check: {text}")

    def _next_readable(self, after: int) -> tuple[int, int] | None:
        """(id, log time) of the next message that can be read, where the one after ``after`` cannot; None if there is none."""

        def look(behind: int) -> tuple[int, int] | None:
            query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id LIMIT 1"
            found = self._connection.execute(query, (behind,)).fetchone()
            if found is None:
                return None
            _check_row(found, behind)
            return found[0], found[2]

        def readable(behind: int) -> bool:
            try:
                look(behind)
            except sqlite3.DatabaseError:
                return False
            return True

        low = max(after, 0)
        step = 1
        while not readable(low + step):
            step *= 2
            if step > FARTHEST_ID // 2:
                return None
        high = low + step
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if readable(middle) else (middle, high)
        return look(high)

    def _all(self, query: str, *values: Any) -> list[Any]:
        try:
            return self._connection.execute(query, values).fetchall()
        except sqlite3.DatabaseError as error:
            raise RecordingError(f"{self.path}: damaged, its list of topics cannot be read ({error})") from error

    def lost(
        self, reason: str, where: tuple[int, int] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> None:
        """Note a damage; without ``where`` SQLite did not tell at which bytes."""
        start, end = where or (0, self.path.stat().st_size)
        self.damage.append(Damage(str(self.path), start, end, reason, start_ns, end_ns))


def _check_row(row: Any, after: int) -> None:
    """
    Raises:
        sqlite3.DatabaseError: no message can be like this: a damage that SQLite itself did not notice.
    """
    whole = all(isinstance(number, int) for number in row[:3]) and isinstance(row[3], bytes | None)
    if not whole or row[0] <= after:
        raise sqlite3.DatabaseError("a message with an invalid topic or time")


def _bag_metadata(source: Source) -> dict[str, Any]:
    """rosbag2's metadata.yaml of these files; empty where there is none."""
    folder = source.path if source.path.is_dir() else source.path.parent
    try:
        found = load_yaml(folder / "metadata.yaml", MOST_METADATA_BYTES)["rosbag2_bagfile_information"]
        named = {Path(n).name for n in found["relative_file_paths"]}
    except (SpecError, KeyError, TypeError):
        return {}
    return found if {p.name for p in source.files} <= named else {}


def _full_name(kind: str) -> str:
    """``sensor_msgs/Imu`` (oldest bags) and ``sensor_msgs/msg/Imu`` are one type."""
    return kind if kind.count("/") != 1 else kind.replace("/", "/msg/")


def _definition(
    kind: str, definitions: dict[str, tuple[str, str]], distro: str | None, first: bytes | None
) -> tuple[Any, str]:
    """(rosbags type store that knows ``kind``, where its definition is from). Raises RecordingError: no definition, or none
    that fits the first message."""
    from rosbags.typesys import Stores, get_typestore

    if kind in definitions:
        return _own_store(kind, *definitions[kind]), "in the bag"
    newest_first = [s for s in reversed(Stores) if s.value.startswith("ros2_") and s is not Stores.LATEST]
    named = [s for s in newest_first if s.value == f"ros2_{distro}"]
    known = [s for s in named or newest_first if kind in get_typestore(s).fielddefs]
    if not known:
        raise RecordingError(
            f"the bag does not define {kind}, nor does any ROS 2 distribution from {newest_first[-1].value} to "
            f"{newest_first[0].value}: convert it to MCAP where its package is installed (`ros2 bag convert`)"
        )
    for candidate in known:
        store = get_typestore(candidate)
        with contextlib.suppress(Exception):
            if first is not None:
                store.deserialize_cdr(first, kind)
            return store, f"{candidate.value}, {'as named by the bag' if named else 'the newest that fits'}"
    raise RecordingError(
        f"the bag does not define {kind}, and the definitions of all ROS 2 distributions do not fit its first message"
    )


@functools.lru_cache(maxsize=256)
def _own_store(kind: str, encoding: str, definition: str) -> Any:
    """rosbags' type store that knows ``kind`` by the definition in the bag. Raises RecordingError: the definition does not
    parse."""
    from rosbags.typesys import Stores, get_typestore

    try:
        store = get_typestore(Stores.EMPTY)
        store.register(_parse(kind, encoding, definition))
        store.get_msgdef(kind)
    except Exception as error:  # this topic only
        raise RecordingError(
            f"the bag's definition of {kind} does not parse ({type(error).__name__}: {error})"
        ) from error
    return store


def _parse(kind: str, encoding: str, text: str) -> Any:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if encoding in ("ros1msg", "ros2msg"):
        return get_types_from_msg(text, kind)
    if encoding == "ros2idl":
        types: dict[str, Any] = {}
        for part in re.split(r"^=+\nIDL: .*\n", text, flags=re.MULTILINE):
            if part.strip():
                types.update(get_types_from_idl(part))
        return types
    raise RecordingError(f"definitions in {encoding!r} are not supported (supported: ros2msg, ros2idl)")


def _misfit(topic: str, log_ns: int, kind: str, error: Exception) -> RecordingError:
    return RecordingError(
        f"{topic}: a message at log time {log_ns} ns does not fit {kind} ({type(error).__name__}: {error})"
    )


# ---- ROS 1 ----


@readers.register("rosbag1")
class Rosbag1Reader(Reader):
    """One ROS 1 bag; with ``split_bag`` the files x_0, x_1, … of a folder."""

    suffixes = (".bag",)

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        """Return a file as one recording, and with ``split_bag`` a folder whose files x_0, x_1, … belong together; None for
        another path."""
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

    def messages(
        self, topics: Topics | None, *, stamps_only: Topics = (), start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        for path in self.source.files:
            with _opened_bag(path) as bag:
                asked = [c for c in bag.connections if topics is None or c.topic in topics]
                read = {c.topic for c in asked if topics is not None and c.topic not in stamps_only}
                for connection in asked:
                    if connection.topic in read and (why := _topic_type(connection).undecodable):
                        raise RecordingError(f"{path}: {why}")
                # rosbags sorts by log time, which hides a clock that was set back
                bag.indexes = {  # pyright: ignore[reportAttributeAccessIssue]
                    number: sorted(
                        _Entry._make(entry)
                        for entry in entries
                        if (start_ns is None or entry.time >= start_ns) and (end_ns is None or entry.time <= end_ns)
                    )
                    for number, entries in bag.indexes.items()
                }
                for connection, log_ns, data in bag.messages(asked) if asked else ():
                    topic, value = connection.topic, None
                    try:
                        value = _own_store(connection.msgtype, "ros1msg", connection.msgdef.data).deserialize_ros1(
                            data, connection.msgtype
                        )
                    except Exception as error:  # rosbags raises what it likes on bytes that do not fit the definition
                        if topic in read:
                            raise _misfit(topic, log_ns, connection.msgtype, error) from error
                    stamp_ns = None if value is None else decode.stamp_ns(value)
                    yield Message(topic, log_ns, stamp_ns, value if topic in read else None)
        if start_ns is None and end_ns is None:
            self.unprotected = (
                "ROS 1 bags hold no checksums: changed bytes in a message that still decodes are read as values"
            )


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
    faults = (ReaderError, AssertionError, ValueError, LookupError, struct.error, EOFError, RuntimeError, OSError)
    try:
        with BagFile(path) as bag:
            yield bag
    except faults as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(
            f"{path}: cannot be read as a ROS 1 bag ({text}). A recorder that was killed leaves no whole index: "
            f"`rosbag reindex {path.name}`, in ROS 1, makes one"
        ) from error


def _topic_type(connection: "Connection") -> TopicType:
    try:
        _own_store(connection.msgtype, "ros1msg", connection.msgdef.data)
        problem = None
    except RecordingError as error:
        problem = f"{connection.topic}: {error}"
    return TopicType(connection.msgtype, "ros1", problem)
