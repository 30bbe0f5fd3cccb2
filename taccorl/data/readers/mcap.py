"""MCAP with ROS 2 CDR, protobuf or JSON messages, read without ROS; damaged files are salvaged chunk by chunk.

The file is walked record by record without trusting its index: every chunk's CRC is checked, a bad chunk costs only itself, and
after a bad record the walk goes on at the next one. (mcap's own reader checks no CRC by default and reads nothing at all from a
file without a footer.)
"""

import json
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from mcap.opcode import Opcode as Op
from mcap.records import Channel, Chunk, ChunkIndex, Metadata, Schema
from mcap.records import Message as McapMessage

from taccorl.data import decode
from taccorl.data.mcap_records import (
    BEGINNINGS,
    DATA_END_BYTES,
    MAGIC,
    McapFile,
    Record,
    chunk_records,
    parse,
)
from taccorl.data.recording import (
    Damage,
    Message,
    Query,
    Reader,
    Source,
    TopicType,
    readers,
)
from taccorl.data.ros import Decoder, cdr_stamp, full_name, type_store, unpacked
from taccorl.data.spec import RecordingSpec
from taccorl.data.stated_counts import (
    METADATA,
    PACKED,
    StatedCounts,
    added,
    bag_counts,
    bag_metadata,
    lacking_files,
    metadata_of,
)
from taccorl.errors import RecordingError

MAX_TIME_NS = 2**63 - 1  # Latest time that an int64 can hold [ns]
MAX_MISFITS = 10  # Most messages of a channel without CRC that may fail to decode as damage; more: its schema is wrong
NO_SCHEMA = "no schema"  # Type of messages of a channel without a schema


# ---- messages ----


def message_decoder(channel: Channel, schema: Schema | None) -> Decoder:
    """Function from bytes to a message: an object with attributes (ROS 2, protobuf) or a JSON object. Raises RecordingError:
    an encoding that is not read, or a schema that does not parse."""
    encoding, found, kind = (
        channel.message_encoding,
        None,
        schema.name if schema else NO_SCHEMA,
    )
    if encoding == "json":
        return json.loads
    if encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
        full, text = full_name(kind), schema.data.decode(errors="replace")
        store = type_store(
            full, "ros2msg", text, f"{channel.topic}: its schema {schema.name}"
        )
        return lambda data: store.deserialize_cdr(data, full)
    try:
        if encoding == "protobuf":
            from mcap_protobuf.decoder import DecoderFactory as Protobuf

            found = Protobuf().decoder_for(encoding, schema)
    except Exception as error:  # a schema text that does not parse: this topic only
        text = f"{channel.topic}: its schema {kind} does not parse ({type(error).__name__}: {error})"
        raise RecordingError(text) from error
    if found is None:
        described = f"{schema.encoding} schema {kind}" if schema else NO_SCHEMA
        text = (
            f"{channel.topic}: {encoding!r} messages with {described} are not supported"
        )
        raise RecordingError(f"{text} (supported: cdr with ros2msg, protobuf, json)")
    return found


def message_stamper(
    channel: Channel, schema: Schema | None
) -> Callable[[bytes], int | None]:
    """Function from a message's bytes to its stamp [ns]. If a ROS 2 header comes first, the rest is not decoded."""
    try:
        decoder = message_decoder(channel, schema)
        if channel.message_encoding == "cdr" and schema is not None:
            full, text = full_name(schema.name), schema.data.decode(errors="replace")
            fields = type_store(
                full, "ros2msg", text, f"{channel.topic}: its schema {schema.name}"
            ).fielddefs[full][1]
            if (
                fields
                and fields[0][0] == "header"
                and fields[0][1][1] == "std_msgs/msg/Header"
            ):
                return cdr_stamp
            if not {"header", "timestamp"} & {name for name, _ in fields}:
                return lambda data: None
    except RecordingError:
        return lambda data: None

    def stamp(data: bytes) -> int | None:
        try:
            return decode.stamp_ns(decoder(data))
        except Exception:  # only asked for its time: its content may be anything
            return None

    return stamp


# ---- the reader ----


@dataclass
class _Definitions:
    """Schemas and channels of one file by their numbers. They are kept between reads, because a part that is read later may
    hold none."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    proven: set[tuple[type, int]] = field(default_factory=set)
    """(kind, id) of definitions that a CRC protects."""
    decoders: dict[int, Decoder] = field(default_factory=dict)
    stampers: dict[int, Callable[[bytes], int | None]] = field(default_factory=dict)

    def decoder(self, channel: Channel) -> Decoder:
        if channel.id not in self.decoders:
            self.decoders[channel.id] = message_decoder(
                channel, self.schemas.get(channel.schema_id)
            )
        return self.decoders[channel.id]

    def stamp(self, channel: Channel, data: bytes) -> int | None:
        if channel.id not in self.stampers:
            self.stampers[channel.id] = message_stamper(
                channel, self.schemas.get(channel.schema_id)
            )
        return self.stampers[channel.id](data)


class BagReader(Reader):
    """Base class of the readers of MCAP and ``.db3`` files. The files of a ROS 2 bag folder are read as one recording, and what
    its metadata.yaml counts is compared with what they hold."""

    logs: ClassVar[tuple[str, ...]] = ()
    """Endings, behind a file's own, of files that belong to it."""

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        if path.is_dir():
            found = bag_sources(path, cls.suffixes[0], split_bag=split_bag)
        else:
            found = super().sources(path, split_bag=split_bag)
        return found and [
            replace(source, beside=cls._beside(source)) for source in found
        ]

    @classmethod
    def _beside(cls, source: Source) -> tuple[Path, ...]:
        named = [p.with_name(p.name + end) for p in source.files for end in cls.logs]
        if metadata_of(source):
            named.append(source.files[0].with_name(METADATA))
        return tuple(path for path in named if path.is_file())

    def compare_counts(
        self,
        found: dict[Path, Counter[str]],
        last_ns: int | None,
        damage: list[Damage],
        way_out: str = "",
    ) -> None:
        """Add to ``damage`` what metadata.yaml counts and what is not there.

        Args:
            found: file → topic → number of messages that were read.
            last_ns: greatest log time of all [ns]; None without messages.
            way_out: text with the remedy.
        """
        counted = lacking_files(self.source)
        for stated, files in bag_counts(self.source):
            there: Counter[str] = sum((found[p] for p in files), Counter())
            counted += stated.compared(files[0], there, last_ns, way_out)
        added(counted, damage)


def bag_sources(path: Path, suffix: str, *, split_bag: bool) -> list[Source] | None:
    """A rosbag2 folder as one recording: order of its files from metadata.yaml, or by their numbers with ``split_bag``; None if
    ``path`` is no such folder. Raises RecordingError: a file is compressed, or metadata.yaml is damaged or differs."""
    packed = sorted(path.glob(f"*{suffix}{PACKED}"))
    if packed := [p for p in packed if not p.with_suffix("").is_file()]:
        raise RecordingError(
            f"{packed[0]}: a compressed bag file: unpack it with `unzstd {packed[0].name}`"
        )
    files = sorted(
        (p for p in path.iterdir() if p.suffix == suffix),
        key=lambda p: decode.natural_key(p.name),
    )
    index = path / METADATA
    if not files or not index.is_file():
        return [Source(path, tuple(files))] if files and split_bag else None
    named = [path / name for name in bag_metadata(path)["relative_file_paths"]]
    if absent := [p.name for p in named if not p.is_file()]:
        raise RecordingError(
            f"{index} names {', '.join(absent)}, which is not in {path}: copy the whole bag"
        )
    if unnamed := [p.name for p in files if p not in named]:
        raise RecordingError(
            f"{index} does not name {', '.join(unnamed)}: run `ros2 bag reindex`, or move it away"
        )
    return [Source(path, tuple(named))]


@readers.register("mcap")
class McapReader(BagReader):
    """One MCAP file, or the files of a split bag in order."""

    suffixes = (".mcap",)

    def __init__(self, source: Source, spec: RecordingSpec | None = None) -> None:
        super().__init__(source, spec)
        self.types: dict[str, TopicType] = {}
        self.chunk_times: dict[tuple[Path, int], tuple[int, int]] = {}
        self.definitions = {path: _Definitions() for path in source.files}
        self._whole = False

    def topics(self) -> dict[str, TopicType]:
        """An MCAP file may define topics anywhere, so this reads it to its end unless ``messages`` has done so."""
        if not self._whole:
            list(self.messages(()))
        return dict(self.types)

    def read(self, query: Query, damage: list[Damage]) -> Generator[Message, None, str]:
        files = [_File(path, self, query, damage) for path in self.source.files]
        for file in files:
            yield from file.messages()
        self._whole |= query.whole
        if query.whole:
            found = {file.path: file.by_topic for file in files}
            ends = [file.last_ns for file in files if file.last_ns is not None]
            self.compare_counts(found, max(ends, default=None), damage)
        without = any(file.unprotected for file in files)
        return (
            "its recorder wrote messages without a CRC: changed bytes are read as values"
            if without
            else ""
        )


class _File:
    """One walk through one MCAP file."""

    def __init__(
        self, path: Path, reader: McapReader, query: Query, damage: list[Damage]
    ) -> None:
        self.path, self.reader, self.query, self.damage = path, reader, query, damage
        self.known = reader.definitions[path]
        self.misfits: Counter[int] = Counter()
        self.orphans = self.timeless = self.unchunked = self.unprotected = 0
        self.data_end: Record | None = None
        self.after_lost: int | None = None
        self.counts: Counter[int] = Counter()  # Channel → number of messages read
        self.last_ns: int | None = None  # Greatest log time of these [ns]
        self.chunks: set[int] = set()  # Offsets of the chunks that were found
        self.num_indexed = 0  # Number of messages that the indexes of chunks list
        self.num_metadata = 0

    @property
    def by_topic(self) -> Counter[str]:
        """Topic → number of messages that were read, whichever were asked for."""
        found: Counter[str] = Counter()
        for number, count in self.counts.items():
            channel = self.known.channels.get(number)
            found[channel.topic if channel else f"channel {number}"] += count
        return found

    def messages(self) -> Iterator[Message]:
        already = len(self.damage)
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(
                f"{self.path}: cannot be opened: {error.strerror}"
            ) from error
        with file:
            mcap = McapFile(file, self.path.stat().st_size)
            for definition in mcap.summary.definitions:
                self._learn(definition, mcap.summary.proven, None)
            for record in self._walk(mcap):
                found, proven = self._contents(mcap, record)
                for r in found:
                    if isinstance(r, McapMessage):
                        if (message := self._message(r, proven, record)) is not None:
                            yield message
                    elif isinstance(r, Metadata):
                        self.num_metadata += 1
                        self.reader.metadata[r.name] = dict(r.metadata)
                    else:
                        self._learn(r, proven, record)
            if self.query.whole:
                self._check_ends(mcap, sound=len(self.damage) == already)
                if not any(damage.lost for damage in self.damage[already:]):
                    self._check_counts(mcap)
                self.unprotected += (
                    self.unchunked
                    if self.data_end is None or not any(mcap.body(self.data_end))
                    else 0
                )
        if self.orphans:
            self._damaged(
                0,
                mcap.size,
                f"{self.orphans} messages of channels whose definition was lost",
            )
        if self.timeless:
            self._damaged(
                0,
                mcap.size,
                f"{self.timeless} messages with a log time after the year 2262",
            )

    def _begin(self, mcap: McapFile) -> int:
        """Offset of the first record."""
        mcap.file.seek(0)
        head = mcap.file.read(len(MAGIC))
        if not head:
            raise RecordingError(f"{self.path}: is empty (0 bytes)")
        if head == MAGIC:
            return len(MAGIC)
        first = mcap.record(len(MAGIC))
        known = first is not None and first.opcode == Op.HEADER
        start = len(MAGIC) if known else mcap.find(0, mcap.end, {Op.CHUNK})
        if start is None:
            text = f"{self.path}: is not an MCAP file: begins with {head!r}, not {MAGIC!r}, and holds no chunk"
            raise RecordingError(text)
        self._damaged(
            0, start, "not the beginning of an MCAP file", lost=start != len(MAGIC)
        )
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
                    reason = (
                        "the file ends without a footer (cut by a crash?)"
                        if cut
                        else "a damaged end of the data"
                    )
                    self._damaged(
                        offset,
                        mcap.end,
                        reason,
                        lost=cut or mcap.end - offset > DATA_END_BYTES,
                    )
                    return
                self._damaged(
                    offset if offset < following else sure,
                    following,
                    "a record header that makes no sense",
                )
                offset = sure = following
                continue
            if record.opcode == Op.DATA_END:
                self.data_end = record
                return
            mcap.chunked = mcap.chunked or record.opcode == Op.CHUNK
            if record.opcode == Op.MESSAGE_INDEX:
                self.num_indexed += mcap.num_indexed(record)
            if record.opcode == Op.CHUNK:
                self.chunks.add(record.offset)
            if record.opcode in (
                Op.SCHEMA,
                Op.CHANNEL,
                Op.MESSAGE,
                Op.CHUNK,
                Op.METADATA,
            ):
                yield record
            offset, self.after_lost = self.after_lost or record.end, None
            if record.opcode in (Op.CHUNK, Op.MESSAGE):
                sure = offset  # the others may have eaten a chunk's beginning if bytes are missing
            if (
                offset == mcap.summary.end
            ):  # what was before it was no end-of-data record
                return

    def _resume(self, mcap: McapFile, sure: int, bad: int) -> int | None:
        """Where the walk goes on. Within chunked data only a chunk vouches for its messages, by its CRC."""
        if (
            mcap.summary.end is None
            and (moved := mcap.find(sure, bad, {Op.CHUNK, Op.DATA_END})) is not None
        ):
            return moved
        indexed = mcap.summary.next_start(bad + 1)
        opcodes = BEGINNINGS | (
            set() if mcap.chunked else {Op.SCHEMA, Op.CHANNEL, Op.MESSAGE}
        )
        found = mcap.find(
            bad + 1,
            mcap.end if indexed is None else indexed,
            opcodes,
            self.known.channels,
        )
        return indexed if found is None else found

    def _contents(self, mcap: McapFile, record: Record) -> tuple[list[Any], bool]:
        """The definitions and messages of a record, and whether a CRC vouches for them."""
        if record.opcode != Op.CHUNK:
            try:
                found = [parse(record.opcode, mcap.body(record))]
            except Exception as error:
                self._damaged(
                    record.offset,
                    record.end,
                    f"record lost ({type(error).__name__}: {error})",
                )
                return [], False
            self.unchunked += record.opcode == Op.MESSAGE
            return found, False
        first, last = self.reader.chunk_times.get(
            (self.path, record.offset), (None, None)
        )
        late = (
            first is not None
            and self.query.end_ns is not None
            and first > self.query.end_ns
        )
        if late or (
            last is not None
            and self.query.start_ns is not None
            and last < self.query.start_ns
        ):
            return [], True
        chunk = None
        try:
            chunk = mcap.chunk(record)
            found = list(chunk_records(chunk))
        except Exception as error:  # CRC, decompression, struct: whatever it is, only this chunk is lost
            # It ends as it says, but before the next one if bytes are missing and that has moved into it.
            cut = mcap.summary.end is None
            moved = (
                mcap.find(record.offset + 1, record.end, BEGINNINGS) if cut else None
            )
            self.after_lost = record.end if moved is None else moved
            reason = f"chunk lost ({type(error).__name__}: {str(error)[:120]})"
            self._damaged(record.offset, self.after_lost, reason, chunk)
            return [], True
        self.unprotected += chunk.uncompressed_crc == 0
        logged = [r.log_time for r in found if isinstance(r, McapMessage)]
        self.reader.chunk_times[self.path, record.offset] = (
            (min(logged), max(logged)) if logged else (0, 0)
        )
        return found, chunk.uncompressed_crc != 0

    def _check_counts(self, mcap: McapFile) -> None:
        """Compare what the file's index and statistics state with what was read."""
        summary, moved = mcap.summary, None
        if summary.problem and self.data_end is not None:
            moved = mcap.summary_at(self.data_end.end)
            summary = moved or summary
        times_ns = {self.reader.chunk_times.get((self.path, c)) for c in self.chunks}
        for index in summary.chunks:
            own_ns = index.message_start_time, index.message_end_time
            is_there = moved is not None or index.chunk_start_offset in self.chunks
            other = summary.proven and any(own_ns) and own_ns not in times_ns
            if other or not is_there:
                end = index.chunk_start_offset + index.chunk_length
                reason = "the index lists a chunk here, and there is none"
                self._damaged(index.chunk_start_offset, end, reason, index)
        found = self.by_topic
        stated = [StatedCounts("its index", total=self.num_indexed)]
        if (statistics := summary.statistics) is not None:
            topics: Counter[str] = Counter()
            for number, count in statistics.channel_message_counts.items():
                channel = self.known.channels.get(number)
                topics[channel.topic if channel else f"channel {number}"] += count
            total, end_ns = statistics.message_count, statistics.message_end_time
            own = StatedCounts("its statistics record", topics, total, end_ns)
            stated.insert(0, own)
            if (number := statistics.metadata_count) > self.num_metadata:
                reason = f"its statistics record counts {number} metadata records, "
                reason += f"{self.num_metadata} are there"
                self._damaged(0, mcap.size, reason)
        damage = [
            d for part in stated for d in part.compared(self.path, found, self.last_ns)
        ]
        self.damage += damage[:1]  # they state the same thing

    def _check_ends(self, mcap: McapFile, *, sound: bool) -> None:
        if self.data_end is None:
            return
        if self.unchunked and sound and not mcap.data_crc_matches(self.data_end):
            reason = "the CRC of messages outside chunks does not match: at least one is wrong"
            self._damaged(len(MAGIC), self.data_end.offset, reason)
        if mcap.summary.problem or self.data_end.end != mcap.end:
            why = mcap.summary.problem or "it begins elsewhere"
            reason = f"no index behind the data ({why}): nothing there was read"
            # no index holds these: joined files
            another = mcap.find(self.data_end.end, mcap.end, {Op.CHUNK, Op.DATA_END})
            self._damaged(
                self.data_end.end, mcap.size, reason, lost=another is not None
            )

    def _message(self, m: McapMessage, proven: bool, place: Record) -> Message | None:
        channel = self.known.channels.get(m.channel_id)
        self.counts[m.channel_id] += 1
        if m.log_time <= MAX_TIME_NS:
            self.last_ns = max(m.log_time, self.last_ns or 0)
        if channel is not None and not self.query.asks(channel.topic):
            return None
        with_schema = channel is not None and (
            channel.message_encoding == "json" or channel.schema_id == 0
        )
        if channel is None or not (
            with_schema or channel.schema_id in self.known.schemas
        ):
            self.orphans += 1
            return None
        schema = self.known.schemas.get(channel.schema_id)
        kind, first = (
            schema.name if schema else NO_SCHEMA,
            self.reader.types[channel.topic].name,
        )
        if full_name(kind) != full_name(first) and self.query.reads(channel.topic):
            text = f"{channel.topic}: messages of {kind}, but its first channel is of {first}: record one type a topic"
            raise RecordingError(text)
        if m.log_time > MAX_TIME_NS:
            self.timeless += 1
            return None
        decoder = (
            self.known.decoder(channel) if self.query.reads(channel.topic) else None
        )
        is_cdr, value = channel.message_encoding == "cdr", None
        try:
            data = unpacked(m.data) if is_cdr else m.data
            value = None if decoder is None else decoder(data)
            stamp = (
                decode.stamp_ns(value)
                if decoder and not is_cdr
                else self.known.stamp(channel, data)
            )
        except (
            Exception
        ) as error:  # decoders raise what they like on bytes that do not fit the schema
            if decoder is None:
                return Message(channel.topic, m.log_time, None, None)
            problem = f"{channel.topic}: a message at log time {m.log_time} ns does not fit its schema {kind} "
            problem += f"({type(error).__name__}: {error})"
            self.misfits[channel.id] += 1
            if proven or self.misfits[channel.id] > MAX_MISFITS:
                raise RecordingError(problem) from error
            self._damaged(place.offset, place.end, problem)
            return None
        return Message(channel.topic, m.log_time, stamp, value)

    def _learn(
        self, definition: Schema | Channel, proven: bool, place: Record | None
    ) -> None:
        """Take in a definition; one that no CRC vouches for does not replace one that has that."""
        kind, number = type(definition), definition.id
        table: dict[int, Any] = (
            self.known.schemas if kind is Schema else self.known.channels
        )
        if table.get(number) != definition:
            if (kind, number) in self.known.proven and not proven:
                if place is not None:
                    reason = (
                        f"a damaged {kind.__name__.lower()}; the index's copy is used"
                    )
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
        told = self.reader.types.get(channel.topic)
        if told is not None and told.name != NO_SCHEMA:
            return
        problem, schema = None, self.known.schemas.get(channel.schema_id)
        try:
            self.known.decoder(channel)
        except RecordingError as error:
            problem = str(error)
        kind = schema.name if schema else NO_SCHEMA
        self.reader.types[channel.topic] = TopicType(
            kind, channel.message_encoding, problem
        )

    def _damaged(
        self,
        start: int,
        end: int,
        reason: str,
        chunk: Chunk | ChunkIndex | None = None,
        *,
        lost: bool = True,
    ) -> None:
        times = (
            (chunk.message_start_time, chunk.message_end_time)
            if chunk is not None
            else (None, None)
        )
        self.damage.append(
            Damage(str(self.path), start, end, reason, *times, lost=lost)
        )
