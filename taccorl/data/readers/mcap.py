"""MCAP with ROS 2 CDR, protobuf or JSON messages, read without ROS; damaged files are salvaged chunk by chunk.

The file is walked record by record without trusting its index: every chunk's CRC is checked, a bad chunk costs only
itself, and after a bad record the walk goes on at the next one. (mcap's own reader checks no CRC by default and reads
nothing at all from a file without a footer.)
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.records import Message as McapMessage

from taccorl.data import decode, mcap_records
from taccorl.data.mcap_messages import (
    NO_SCHEMA,
    Decoder,
    Stamper,
    message_decoder,
    message_stamper,
    type_name,
    unpacked,
)
from taccorl.data.mcap_records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    DATA_END_BYTES,
    MAGIC,
    MESSAGE,
    METADATA,
    SCHEMA,
    McapFile,
    Record,
)
from taccorl.data.recording import Damage, Message, Reader, Source, TopicType, readers
from taccorl.data.spec import RecordingSpec
from taccorl.data.strict_yaml import load_yaml
from taccorl.errors import RecordingError, SpecError

MOST_METADATA_BYTES = 1 << 20
"""Largest metadata.yaml of a bag that is read [bytes]; rosbag2 writes 1 to 2 kB for each topic."""
MAX_TIME_NS = 2**63 - 1  # Latest time that an int64 can hold [ns]
MAX_MISFITS = 10
"""Most messages of a channel without a CRC that may fail to decode as damage; more mean that the channel's schema is wrong."""


@dataclass
class _Definitions:
    """Definitions (schemas, channels) of one file. They are kept between reads, because a part that is read later may
    hold none."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    proven: set[tuple[type, int]] = field(default_factory=set)
    """(kind, id) of definitions that a CRC protects."""
    decoders: dict[int, Decoder] = field(default_factory=dict)
    """Channel id → decoder."""
    stampers: dict[int, Stamper] = field(default_factory=dict)

    def schema(self, channel: Channel) -> Schema | None:
        return self.schemas.get(channel.schema_id)

    def decoder(self, channel: Channel) -> Decoder:
        if channel.id not in self.decoders:
            self.decoders[channel.id] = message_decoder(channel, self.schema(channel))
        return self.decoders[channel.id]

    def stamper(self, channel: Channel) -> Stamper:
        if channel.id not in self.stampers:
            self.stampers[channel.id] = message_stamper(channel, self.schema(channel))
        return self.stampers[channel.id]


@readers.register("mcap")
class McapReader(Reader):
    """One MCAP file, or the files of a split bag in order."""

    suffixes = (".mcap",)

    def __init__(self, source: Source, spec: RecordingSpec | None = None) -> None:
        super().__init__(source, spec)
        self._topics: dict[str, TopicType] = {}
        self._chunk_times: dict[tuple[Path, int], tuple[int, int]] = {}
        self._definitions: dict[Path, _Definitions] = {}
        self._whole = False

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        """Return a file as one recording, also a bag folder with metadata.yaml, and with ``split_bag`` a folder whose files x_0,
        x_1, … belong together; None for another path."""
        if path.is_dir():
            return bag_sources(path, ".mcap", split_bag=split_bag)
        return super().sources(path, split_bag=split_bag)

    def topics(self) -> dict[str, TopicType]:
        """Topic → its type, for all topics of the file. An MCAP file may define topics anywhere, so this reads it to its end
        unless ``messages`` has done so."""
        if not self._whole:
            for _ in self.messages(()):
                pass
        return dict(self._topics)

    def messages(
        self,
        topics: Collection[str] | None,
        *,
        stamps_only: Collection[str] = (),
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[Message]:
        damage: list[Damage] = []
        for path in self.source.files:
            yield from _File(path, self, topics, stamps_only, damage).messages(start_ns, end_ns)
        if start_ns is None and end_ns is None:  # a partial or abandoned read saw only a part of it
            self.damage, self._whole = damage, True


def bag_sources(path: Path, suffix: str, *, split_bag: bool) -> list[Source] | None:
    """Return a rosbag2 folder as one recording: order of its files from metadata.yaml, or by their numbers if the spec sets
    split_bag; None if ``path`` is no such folder.

    Raises:
        RecordingError: a file is compressed, or metadata.yaml is damaged or differs from the files.
    """
    if packed := sorted(path.glob(f"*{suffix}.zstd")):
        raise RecordingError(f"{packed[0]}: a compressed bag file: unpack it with `unzstd {packed[0].name}`")
    files = sorted((p for p in path.iterdir() if p.suffix == suffix), key=lambda p: decode.natural_key(p.name))
    if not files:
        return None
    index = path / "metadata.yaml"
    if index.is_file():
        try:
            names = load_yaml(index, MOST_METADATA_BYTES)["rosbag2_bagfile_information"]["relative_file_paths"]
            named = [path / Path(n).name for n in names]
        except (SpecError, KeyError, TypeError) as error:
            raise RecordingError(
                f"{index}: not a metadata file of rosbag2 ({type(error).__name__}: {error})"
            ) from error
        absent = [p.name for p in named if not p.is_file()]
        if absent:
            raise RecordingError(f"{index} names {', '.join(absent)}, which is not in {path}: copy the whole bag")
        unnamed = [p.name for p in files if p not in named]
        if unnamed:
            raise RecordingError(f"{index} does not name {', '.join(unnamed)}: run `ros2 bag reindex`, or move it away")
        return [Source(path, tuple(named))]
    return [Source(path, tuple(files))] if split_bag else None


class _File:
    """One walk through one MCAP file."""

    def __init__(
        self,
        path: Path,
        reader: McapReader,
        topics: Collection[str] | None,
        stamps_only: Collection[str],
        damage: list[Damage],
    ) -> None:
        self.path, self.reader = path, reader
        self.topics, self.stamps_only = topics, stamps_only
        self.damage, self.already = damage, len(damage)
        self.known = reader._definitions.setdefault(path, _Definitions())
        self.misfits: dict[int, int] = {}
        self.orphans = self.timeless = self.unchunked = self.unprotected = 0
        self.data_end: Record | None = None
        self.after_lost: int | None = None

    def messages(self, start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be opened: {error.strerror}") from error
        with file:
            mcap = McapFile(file, self.path.stat().st_size)
            for definition in (*mcap.summary.schemas, *mcap.summary.channels):
                self._learn(definition, mcap.summary.proven, None)
            for record in self._walk(mcap):
                if record.opcode == CHUNK:
                    found, proven = self._chunk(mcap, record, start_ns, end_ns)
                else:
                    found, proven = self._single(mcap, record), False
                yield from self._convert(found, proven, record)
            if start_ns is None and end_ns is None:
                self._check_ends(mcap)
                if self.unprotected or (self.unchunked and not mcap.has_data_crc(self.data_end)):
                    self.reader.unprotected = (
                        "its recorder wrote messages without a CRC: changed bytes are read as values"
                    )
        if self.orphans:
            self._damaged(0, mcap.size, f"{self.orphans} messages of channels whose definition was lost")
        if self.timeless:
            self._damaged(0, mcap.size, f"{self.timeless} messages with a log time after the year 2262")

    def _begin(self, mcap: McapFile) -> int:
        """Offset of the first record."""
        mcap.file.seek(0)
        head = mcap.file.read(len(MAGIC))
        if not head:
            raise RecordingError(f"{self.path}: is empty (0 bytes)")
        if head == MAGIC:
            return len(MAGIC)
        first = mcap.record(len(MAGIC))
        known = first is not None and first.opcode == mcap_records.HEADER
        start = len(MAGIC) if known else mcap.find(0, mcap.end, {CHUNK})
        if start is None:
            raise RecordingError(
                f"{self.path}: is not an MCAP file: begins with {head!r}, not {MAGIC!r}, and holds no chunk"
            )
        self._damaged(0, start, "not the beginning of an MCAP file", lost=start != len(MAGIC))
        return start

    def _walk(self, mcap: McapFile) -> Iterator[Record]:
        """Every record of the data section that may be read; goes on at the next one after a bad one."""
        offset = sure = self._begin(mcap)
        while True:
            record = mcap.record(offset)
            if record is None:
                following = self._resume(mcap, sure, offset)
                if following is None:
                    cut = mcap.summary.end is None
                    reason = "the file ends without a footer (cut by a crash?)" if cut else "a damaged end of the data"
                    self._damaged(offset, mcap.end, reason, lost=cut or mcap.end - offset > DATA_END_BYTES)
                    return
                start = offset if offset < following else sure
                self._damaged(start, following, "a record header that makes no sense")
                offset = sure = following
                continue
            if record.opcode == DATA_END:
                self.data_end = record
                return
            mcap.chunked = mcap.chunked or record.opcode == CHUNK
            if record.opcode in (SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA):
                yield record
            offset, self.after_lost = self.after_lost or record.end, None
            if record.opcode in (CHUNK, MESSAGE):  # the others may have eaten a chunk's beginning if bytes are missing
                sure = offset
            if offset == mcap.summary.end:  # what was before it was no end-of-data record
                return

    def _resume(self, mcap: McapFile, sure: int, bad: int) -> int | None:
        """Where the walk goes on. Within chunked data only a chunk vouches for its messages, by its CRC."""
        if mcap.summary.end is None:
            moved = mcap.find(sure, bad, {CHUNK, DATA_END})
            if moved is not None:
                return moved
        indexed = mcap.summary.next_start(bad + 1)
        opcodes = {CHUNK, ATTACHMENT, METADATA, DATA_END} | (set() if mcap.chunked else {SCHEMA, CHANNEL, MESSAGE})
        found = mcap.find(bad + 1, mcap.end if indexed is None else indexed, opcodes, self.known.channels)
        return indexed if found is None else found

    @staticmethod
    def _end_of_lost(mcap: McapFile, record: Record) -> int:
        """Where a lost chunk ends: as it says, but before the next one if bytes are missing and that has moved into it."""
        moved = None
        if mcap.summary.end is None:
            moved = mcap.find(record.offset + 1, record.end, {CHUNK, ATTACHMENT, METADATA, DATA_END})
        return record.end if moved is None else moved

    def _chunk(
        self, mcap: McapFile, record: Record, start_ns: int | None, end_ns: int | None
    ) -> tuple[list[Any], bool]:
        """Its records, and whether a CRC vouches for them."""
        times = self.reader._chunk_times.get((self.path, record.offset))
        if times is not None and (
            (end_ns is not None and times[0] > end_ns) or (start_ns is not None and times[1] < start_ns)
        ):
            return [], True
        chunk = None
        try:
            mcap_records.check_size(record.length)
            chunk = mcap_records.parse(CHUNK, mcap.body(record))
            found = list(mcap_records.chunk_records(chunk))
        except Exception as error:  # CRC, decompression, struct: whatever it is, only this chunk is lost
            self.after_lost = self._end_of_lost(mcap, record)
            reason = f"chunk lost ({type(error).__name__}: {str(error)[:120]})"
            self._damaged(record.offset, self.after_lost, reason, chunk)
            return [], True
        self.unprotected += chunk.uncompressed_crc == 0
        logged = [r.log_time for r in found if isinstance(r, McapMessage)]
        self.reader._chunk_times[self.path, record.offset] = (min(logged), max(logged)) if logged else (0, 0)
        return found, chunk.uncompressed_crc != 0

    def _single(self, mcap: McapFile, record: Record) -> list[Any]:
        try:
            found = [mcap_records.parse(record.opcode, mcap.body(record))]
        except Exception as error:
            self._damaged(record.offset, record.end, f"record lost ({type(error).__name__}: {error})")
            return []
        self.unchunked += record.opcode == MESSAGE
        return found

    def _check_ends(self, mcap: McapFile) -> None:
        if self.data_end is None:
            return
        sound = len(self.damage) == self.already
        if self.unchunked and sound and not mcap.data_crc_matches(self.data_end):
            reason = "the CRC of messages outside chunks does not match: at least one is wrong"
            self._damaged(len(MAGIC), self.data_end.offset, reason)
        if mcap.summary.problem or self.data_end.end != mcap.end:
            problem = mcap.summary.problem or "it begins elsewhere"
            reason = f"no index behind the data ({problem}): nothing there was read"
            another = mcap.find(self.data_end.end, mcap.end, {CHUNK, DATA_END})  # no index holds these: joined files
            self._damaged(self.data_end.end, mcap.size, reason, lost=another is not None)

    def _convert(self, found: list[Any], proven: bool, place: Record) -> Iterator[Message]:
        for r in found:
            if isinstance(r, McapMessage):
                message = self._message(r, proven, place)
                if message is not None:
                    yield message
            elif isinstance(r, Metadata):
                self.reader.metadata[r.name] = dict(r.metadata)
            else:
                self._learn(r, proven, place)

    def _message(self, m: McapMessage, proven: bool, place: Record) -> Message | None:
        channel = self.known.channels.get(m.channel_id)
        if channel is not None and self.topics is not None and channel.topic not in self.topics:
            return None
        if channel is None or (channel.message_encoding != "json" and self._lacks_schema(channel)):
            self.orphans += 1
            return None
        if m.log_time > MAX_TIME_NS:
            self.timeless += 1
            return None
        stamper = self.known.stamper(channel)
        with_value = self.topics is not None and channel.topic not in self.stamps_only
        decoder = (
            self.known.decoder(channel) if with_value else None
        )  # a schema that has none is no damage of a message
        value = stamp = None
        try:
            data = unpacked(m.data) if channel.message_encoding == "cdr" else m.data
            value = None if decoder is None else decoder(data)
            stamp = decode.stamp_ns(value) if with_value and channel.message_encoding != "cdr" else stamper(data)
        except Exception as error:  # decoders raise what they like on bytes that do not fit the schema
            if not with_value:
                return Message(channel.topic, m.log_time, None, None)
            problem = (
                f"{channel.topic}: a message at log time {m.log_time} ns does not fit its schema "
                f"{type_name(self.known.schema(channel))} ({type(error).__name__}: {error})"
            )
            self.misfits[channel.id] = self.misfits.get(channel.id, 0) + 1
            if proven or self.misfits[channel.id] > MAX_MISFITS:
                raise RecordingError(problem) from error
            self._damaged(place.offset, place.end, problem)
            return None
        return Message(channel.topic, m.log_time, stamp, value)

    def _lacks_schema(self, channel: Channel) -> bool:
        return channel.schema_id != 0 and channel.schema_id not in self.known.schemas

    def _learn(self, definition: Schema | Channel, proven: bool, place: Record | None) -> None:
        """Take in a definition; one that no CRC vouches for does not replace one that has that."""
        kind, number = type(definition), definition.id
        table: dict[int, Any] = self.known.schemas if kind is Schema else self.known.channels
        if table.get(number) != definition:
            if (kind, number) in self.known.proven and not proven:
                if place is not None:
                    reason = f"a damaged {kind.__name__.lower()}; the index's copy is used"
                    self._damaged(place.offset, place.end, reason, lost=False)
                return
            table[number] = definition
            for channel in self.known.channels.values():
                if number == (channel.schema_id if kind is Schema else channel.id):
                    self._describe(channel)
        if proven:
            self.known.proven.add((kind, number))

    def _describe(self, channel: Channel) -> None:
        self.known.decoders.pop(channel.id, None)
        self.known.stampers.pop(channel.id, None)
        told = self.reader._topics.get(channel.topic)
        if told is not None and told.name != NO_SCHEMA:
            return
        problem = None
        try:
            self.known.decoder(channel)
        except RecordingError as error:
            problem = str(error)
        self.reader._topics[channel.topic] = TopicType(
            type_name(self.known.schema(channel)), channel.message_encoding, problem
        )

    def _damaged(self, start: int, end: int, reason: str, chunk: Chunk | None = None, *, lost: bool = True) -> None:
        times = (chunk.message_start_time, chunk.message_end_time) if chunk is not None else (None, None)
        self.damage.append(Damage(str(self.path), start, end, reason, *times, lost=lost))
