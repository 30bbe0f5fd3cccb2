"""ROS 1 bags (.bag, version 2.0), read without ROS: message definitions are in the bag.

The format keeps no checksums: changed bytes inside a message are not noticed. A bag without a whole index, as a recorder that was
killed leaves it, is refused; ``rosbag reindex`` makes the index.
"""

import contextlib
import functools
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from taccorl.data import decode
from taccorl.data.readers.mcap import bag_sources
from taccorl.data.recording import Message, Reader, Source, TopicType, readers
from taccorl.errors import RecordingError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as BagFile


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
            with _opened(path) as bag:
                for connection in bag.connections:
                    found.setdefault(connection.topic, _topic_type(connection))
        return found

    def messages(
        self,
        topics: Collection[str] | None,
        *,
        stamps_only: Collection[str] = (),
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[Message]:
        for path in self.source.files:
            with _opened(path) as bag:
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
                        value = _store(connection.msgtype, connection.msgdef.data).deserialize_ros1(
                            data, connection.msgtype
                        )
                    except Exception as error:  # rosbags raises what it likes on bytes that do not fit the definition
                        if topic in read:
                            raise RecordingError(
                                f"{topic}: a message at log time {log_ns} ns does not fit {connection.msgtype} "
                                f"({type(error).__name__}: {error})"
                            ) from error
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
def _opened(path: Path) -> "Iterator[BagFile]":
    """
    Raises:
        RecordingError: not a ROS 1 bag, an incomplete one, or damaged where it was read.
    """
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
        _store(connection.msgtype, connection.msgdef.data)
        problem = None
    except RecordingError as error:
        problem = f"{connection.topic}: {error}"
    return TopicType(connection.msgtype, "ros1", problem)


@functools.lru_cache(maxsize=256)
def _store(kind: str, definition: str) -> Any:
    """rosbags' type store that knows ``kind``.

    Raises:
        RecordingError: the definition does not parse.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    try:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(definition, kind))
        store.get_msgdef(kind)
    except Exception as error:  # this topic only
        raise RecordingError(
            f"the bag's definition of {kind} does not parse ({type(error).__name__}: {error})"
        ) from error
    return store
