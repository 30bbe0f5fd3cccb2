"""MCAP with ROS 2 CDR, protobuf or JSON messages, read without ROS; damaged files are salvaged chunk by chunk.

The file is walked record by record without trusting its index: every chunk's CRC is checked, a bad chunk costs only itself, and
after a bad record the walk goes on at the next one. (mcap's own reader checks no CRC by default and reads nothing at all from a
file without a footer.)

A record is an opcode (1 byte), a length (8) and a body. CRCs protect what is inside a chunk and the summary at the file's end,
nothing else; so a record counts as whole only if the lengths inside its body add up to its own.
"""

import io
import json
import struct
import zlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import AttachmentIndex, Channel, Chunk, ChunkIndex, Metadata, MetadataIndex, Schema
from mcap.records import Message as McapMessage

from taccorl.data import decode
from taccorl.data.recording import Damage, Message, Query, Reader, Source, TopicType, readers
from taccorl.data.ros import Decoder, cdr_stamp, full_name, type_store, unpacked
from taccorl.data.spec import RecordingSpec
from taccorl.data.strict_yaml import load_yaml
from taccorl.errors import RecordingError, SpecError

MOST_METADATA_BYTES = 1 << 20  # Largest metadata.yaml of a bag that is read; rosbag2 writes 1 to 2 kB for each topic
MAX_TIME_NS = 2**63 - 1  # Latest time that an int64 can hold [ns]
MAX_MISFITS = 10  # Most messages of a channel without CRC that may fail to decode as damage; more: its schema is wrong
MAGIC = b"\x89MCAP0\r\n"
HEADER_BYTES = 9  # Bytes of a record before its body: opcode (1), length (8)
MAX_CHUNK_BYTES = 1 << 28  # A larger chunk is not opened: a few damaged bytes must not take all the memory
BLOCK_BYTES = 1 << 20  # Number of bytes that are read at once
NO_SCHEMA = "no schema"  # Type of messages of a channel without a schema

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
MESSAGE_BYTES = 22  # channel (2), sequence (4), log time (8), publish time (8); the rest is the payload
DATA_END_BYTES = HEADER_BYTES + 4  # the whole record
# Bodies: a number of fixed bytes; "short", "long": a part behind its own length in 4 or 8 bytes.
_LAYOUTS: dict[int, tuple[int | str, ...]] = (
    {HEADER: ("short", "short"), FOOTER: (20,), DATA_END: (4,), SUMMARY_OFFSET: (17,), STATISTICS: (42, "short")}
    | {SCHEMA: (2, "short", "short", "short"), CHANNEL: (4, "short", "short", "short"), METADATA: ("short", "short")}
    | {CHUNK: (28, "short", "long"), MESSAGE_INDEX: (2, "short"), CHUNK_INDEX: (32, "short", 8, "short", 16)}
    | {ATTACHMENT: (16, "short", "short", "long", 4), ATTACHMENT_INDEX: (40, "short", "short")}
    | {METADATA_INDEX: (16, "short")}
)
_PARSERS: dict[int, Callable[[ReadDataStream], Any]] = {
    SCHEMA: Schema.read,
    CHANNEL: Channel.read,
    CHUNK: Chunk.read,
    CHUNK_INDEX: ChunkIndex.read,
} | {ATTACHMENT_INDEX: AttachmentIndex.read, METADATA: Metadata.read, METADATA_INDEX: MetadataIndex.read}
_END_BYTES = HEADER_BYTES + 20 + len(MAGIC)


class Record(NamedTuple):
    """Kind and position of a record in its file: opcode, first byte, and bytes of its body."""

    opcode: int
    offset: int
    length: int

    @property
    def body(self) -> int:
        return self.offset + HEADER_BYTES

    @property
    def end(self) -> int:
        return self.body + self.length


def parse(opcode: int, body: bytes) -> Any:
    """The body of a record as the mcap package's own type for ``opcode``, such as ``Message``."""
    if opcode == MESSAGE:
        channel, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", body)
        return McapMessage(channel, log_time, body[MESSAGE_BYTES:], publish_time, sequence)
    return _PARSERS[opcode](ReadDataStream(io.BytesIO(body)))


@dataclass
class Summary:
    """Summary section at the end of an MCAP file, as far as it can be trusted."""

    problem: str | None = None
    """Reason why the section is not used; empty if it is."""
    proven: bool = False
    """True if the section has a CRC and agrees with it."""
    definitions: list[Schema | Channel] = field(default_factory=list)
    has_chunks: bool = False
    starts: list[int] = field(default_factory=list)
    """Offsets of the file's chunks, attachments and metadata records, ascending."""
    end: int | None = None
    """Offset at which the data section ends; None without a sound footer: the file may have been cut."""

    def next_start(self, offset: int) -> int | None:
        """Offset of the first indexed record at or after ``offset``; None without one."""
        k = bisect_left(self.starts, offset)
        return self.starts[k] if k < len(self.starts) else None


class McapFile:
    """Access to the records of one open MCAP file, which may be damaged."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self.file, self.size, self.summary = file, size, Summary()
        self.end = size
        """Offset at which the data section ends, as far as known."""
        self.chunked = False
        """True if messages are known to lie in chunks; one outside is then probably a damaged message index."""
        self.summary = self._read_summary()
        self.end, self.chunked = self.summary.end or size, self.summary.has_chunks

    def record(self, offset: int) -> Record | None:
        """The whole record at ``offset``, or None if the bytes there cannot be one."""
        record = self._header(offset)
        if record is None or record.end > self.end:
            return None
        if record.opcode in _LAYOUTS:
            return record if self._fills(record) else None
        if record.opcode == MESSAGE:
            # Nothing inside a message says how long it is; and a damaged opcode must not make another record a message.
            others = (HEADER, SCHEMA, CHANNEL, CHUNK, METADATA, *((MESSAGE_INDEX,) if self.chunked else ()))
            sound = record.length >= MESSAGE_BYTES and not any(self._fills(record._replace(opcode=o)) for o in others)
        else:
            sound = self._is_private(record)
        return record if sound and self._may_begin(record.end) else None

    def find(self, start: int, stop: int, opcodes: Collection[int], channels: Collection[int] = ()) -> int | None:
        """Offset of the first whole record of one of ``opcodes`` in [start, stop), None without one; messages only of these
        channel ids."""
        wanted = np.isin(np.arange(256), list(opcodes))
        for offset in range(start, stop, BLOCK_BYTES):
            self.file.seek(offset)
            block = np.frombuffer(self.file.read(min(BLOCK_BYTES, stop - offset) + HEADER_BYTES - 1), np.uint8)
            if len(block) < HEADER_BYTES:
                return None
            heads = block[: len(block) - HEADER_BYTES + 1]
            small = (block[6:-2] == 0) & (block[7:-1] == 0) & (block[8:] == 0)  # lengths below 2⁴⁰ bytes
            for at in np.flatnonzero(wanted[heads] & small):
                record = self.record(offset + int(at))
                if record is not None and self._is_sure(record, channels):
                    return record.offset
        return None

    def body(self, record: Record) -> bytes:
        self.file.seek(record.body)
        return self.file.read(record.length)

    def data_crc_matches(self, data_end: Record) -> bool:
        """True if the data section agrees with the CRC in its last record, or if there is none."""
        crc = int.from_bytes(self.body(data_end), "little")
        return crc == 0 or self._crc(0, data_end.offset) == crc

    def _header(self, offset: int) -> Record | None:
        if not 0 <= offset <= self.end - HEADER_BYTES:
            return None
        self.file.seek(offset)
        opcode, length = struct.unpack("<BQ", self.file.read(HEADER_BYTES))
        return Record(opcode, offset, length)

    def _fills(self, record: Record) -> bool:
        """Do the lengths inside the body add up to the record's?"""
        at = record.body
        for part in _LAYOUTS[record.opcode]:
            if isinstance(part, int):
                at += part
                continue
            width = 4 if part == "short" else 8
            if at + width > record.end:
                return False
            self.file.seek(at)
            at += width + int.from_bytes(self.file.read(width), "little")
        return at == record.end

    def _may_begin(self, offset: int) -> bool:
        """Could a record begin here? Also where a file without footer was cut within one."""
        record = self._header(offset)
        if record is None:
            return offset == self.end or self.summary.end is None
        if record.end > self.end:
            known = record.opcode in _LAYOUTS or record.opcode == MESSAGE
            return self.summary.end is None and known and record.length < 1 << 40
        if record.opcode in _LAYOUTS:
            return self._fills(record)
        return record.length >= MESSAGE_BYTES if record.opcode == MESSAGE else self._is_private(record)

    def _is_private(self, record: Record) -> bool:
        """An application's own kind (0x80 and above), rather than a chunk or the end-of-data record with a damaged opcode."""
        indexed = self.summary.proven and self.summary.has_chunks
        place = len(MAGIC) < record.offset != self.summary.next_start(record.offset) and record.end != self.end
        return record.opcode >= 0x80 and indexed and place

    def _is_sure(self, record: Record, channels: Collection[int]) -> bool:
        if record.opcode == MESSAGE:
            channel = int.from_bytes(self.body(record)[:2], "little")
            return channel in channels and (record.end == self.end or self.record(record.end) is not None)
        return record.opcode != DATA_END or self._may_begin(record.end)

    def _crc(self, start: int, end: int) -> int:
        self.file.seek(start)
        crc = 0
        while start < end and (block := self.file.read(min(BLOCK_BYTES, end - start))):
            crc, start = zlib.crc32(block, crc), start + len(block)
        return crc

    def _read_summary(self) -> Summary:
        """The summary, if the file has a footer and what it points to is sound."""
        footer = self.record(self.size - _END_BYTES)
        self.file.seek(max(self.size - len(MAGIC), 0))
        if footer is None or footer.opcode != FOOTER or self.file.read() != MAGIC:
            return Summary("there is no footer")
        start, _, crc = struct.unpack("<QQI", self.body(footer))
        if start == 0:
            return Summary(end=footer.offset)
        if not len(MAGIC) <= start <= footer.offset:
            return Summary("its footer points nowhere")
        if crc and self._crc(start, footer.end - 4) != crc:
            return Summary("its CRC does not match")
        summary, offset = Summary(proven=crc != 0, end=start), start
        while offset < footer.offset:
            record = self.record(offset)
            if record is None or record.opcode in (MESSAGE, CHUNK, ATTACHMENT, METADATA, DATA_END):
                return Summary(f"no index record at byte {offset:,}")
            try:
                found = parse(record.opcode, self.body(record)) if record.opcode in _PARSERS else None
            except (ValueError, struct.error, McapError) as error:
                return Summary(f"unreadable at byte {offset:,}: {error}")
            if isinstance(found, Schema | Channel):
                summary.definitions.append(found)
            elif found is not None:
                summary.has_chunks |= record.opcode == CHUNK_INDEX
                summary.starts.append(found.chunk_start_offset if record.opcode == CHUNK_INDEX else found.offset)
            offset = record.end
        summary.definitions.sort(key=lambda d: isinstance(d, Channel))
        summary.starts.sort()
        return summary


def chunk_records(chunk: Chunk) -> Iterator[Any]:
    """Schemas, channels and messages of a chunk in order; its CRC is checked before the first one. Raises ValueError: too
    large, does not decompress, wrong CRC, or not made of whole records."""
    claims = chunk.uncompressed_size
    check_size(claims)
    if chunk.compression == "":
        data = chunk.data
    elif chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            data = reader.read(claims + BLOCK_BYTES)  # a damaged block may overrun: room to say so
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, claims + 1)
    else:
        raise ValueError(f"compression {chunk.compression!r} is not supported")
    if chunk.compression and len(data) > claims:
        raise ValueError(f"it contains more than the {claims:,} bytes that its header states")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its CRC does not match")
    if not chunk.uncompressed_crc and len(data) != claims:
        raise ValueError(f"{len(data):,} bytes uncompressed, but its header states {claims:,}")
    view, offset = memoryview(data), 0
    while offset < len(data):
        opcode, length = struct.unpack_from("<BQ", view, offset)
        start, offset = offset + HEADER_BYTES, offset + HEADER_BYTES + length
        if offset > len(data):
            raise ValueError("a record extends beyond the end of the chunk")
        if opcode in (SCHEMA, CHANNEL, MESSAGE):
            yield parse(opcode, bytes(view[start:offset]))


def check_size(num_bytes: int) -> None:
    """Raises ValueError: a chunk has more than ``MAX_CHUNK_BYTES``."""
    if num_bytes > MAX_CHUNK_BYTES:
        raise ValueError(f"its header states {num_bytes:,} bytes; at most {MAX_CHUNK_BYTES:,} are accepted")


# ---- messages ----


def message_decoder(channel: Channel, schema: Schema | None) -> Decoder:
    """Function from bytes to a message: an object with attributes (ROS 2, protobuf) or a JSON object. Raises RecordingError:
    an encoding that is not read, or a schema that does not parse."""
    encoding, found, kind = channel.message_encoding, None, schema.name if schema else NO_SCHEMA
    if encoding == "json":
        return json.loads
    if encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
        full, text = full_name(kind), schema.data.decode(errors="replace")
        store = type_store(full, "ros2msg", text, f"{channel.topic}: its schema {schema.name}")
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
        text = f"{channel.topic}: {encoding!r} messages with {described} are not supported"
        raise RecordingError(f"{text} (supported: cdr with ros2msg, protobuf, json)")
    return found


def message_stamper(channel: Channel, schema: Schema | None) -> Callable[[bytes], int | None]:
    """Function from a message's bytes to its stamp [ns]. If a ROS 2 header comes first, the rest is not decoded."""
    try:
        decoder = message_decoder(channel, schema)
        if channel.message_encoding == "cdr" and schema is not None:
            full, text = full_name(schema.name), schema.data.decode(errors="replace")
            fields = type_store(full, "ros2msg", text, f"{channel.topic}: its schema {schema.name}").fielddefs[full][1]
            if fields and fields[0][0] == "header" and fields[0][1][1] == "std_msgs/msg/Header":
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
            self.decoders[channel.id] = message_decoder(channel, self.schemas.get(channel.schema_id))
        return self.decoders[channel.id]

    def stamp(self, channel: Channel, data: bytes) -> int | None:
        if channel.id not in self.stampers:
            self.stampers[channel.id] = message_stamper(channel, self.schemas.get(channel.schema_id))
        return self.stampers[channel.id](data)


class BagReader(Reader):
    """Base class of the readers of MCAP and ``.db3`` files. The files of a ROS 2 bag folder are read as one recording."""

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        if path.is_dir():
            return bag_sources(path, cls.suffixes[0], split_bag=split_bag)
        return super().sources(path, split_bag=split_bag)


def bag_sources(path: Path, suffix: str, *, split_bag: bool) -> list[Source] | None:
    """A rosbag2 folder as one recording: order of its files from metadata.yaml, or by their numbers with ``split_bag``; None if
    ``path`` is no such folder. Raises RecordingError: a file is compressed, or metadata.yaml is damaged or differs."""
    if packed := sorted(path.glob(f"*{suffix}.zstd")):
        raise RecordingError(f"{packed[0]}: a compressed bag file: unpack it with `unzstd {packed[0].name}`")
    files = sorted((p for p in path.iterdir() if p.suffix == suffix), key=lambda p: decode.natural_key(p.name))
    index = path / "metadata.yaml"
    if not files or not index.is_file():
        return [Source(path, tuple(files))] if files and split_bag else None
    try:
        names = load_yaml(index, MOST_METADATA_BYTES)["rosbag2_bagfile_information"]["relative_file_paths"]
        named = [path / Path(n).name for n in names]
    except (SpecError, KeyError, TypeError) as error:
        raise RecordingError(f"{index}: no metadata file of rosbag2 ({type(error).__name__}: {error})") from error
    if absent := [p.name for p in named if not p.is_file()]:
        raise RecordingError(f"{index} names {', '.join(absent)}, which is not in {path}: copy the whole bag")
    if unnamed := [p.name for p in files if p not in named]:
        raise RecordingError(f"{index} does not name {', '.join(unnamed)}: run `ros2 bag reindex`, or move it away")
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
        without = any(file.unprotected for file in files)
        return "its recorder wrote messages without a CRC: changed bytes are read as values" if without else ""


class _File:
    """One walk through one MCAP file."""

    def __init__(self, path: Path, reader: McapReader, query: Query, damage: list[Damage]) -> None:
        self.path, self.reader, self.query, self.damage = path, reader, query, damage
        self.known = reader.definitions[path]
        self.misfits: Counter[int] = Counter()
        self.orphans = self.timeless = self.unchunked = self.unprotected = 0
        self.data_end: Record | None = None
        self.after_lost: int | None = None

    def messages(self) -> Iterator[Message]:
        already = len(self.damage)
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be opened: {error.strerror}") from error
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
                        self.reader.metadata[r.name] = dict(r.metadata)
                    else:
                        self._learn(r, proven, record)
            if self.query.whole:
                self._check_ends(mcap, sound=len(self.damage) == already)
                self.unprotected += self.unchunked if self.data_end is None or not any(mcap.body(self.data_end)) else 0
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
        known = first is not None and first.opcode == HEADER
        start = len(MAGIC) if known else mcap.find(0, mcap.end, {CHUNK})
        if start is None:
            text = f"{self.path}: is not an MCAP file: begins with {head!r}, not {MAGIC!r}, and holds no chunk"
            raise RecordingError(text)
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
                self._damaged(offset if offset < following else sure, following, "a record header that makes no sense")
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
        if mcap.summary.end is None and (moved := mcap.find(sure, bad, {CHUNK, DATA_END})) is not None:
            return moved
        indexed = mcap.summary.next_start(bad + 1)
        opcodes = {CHUNK, ATTACHMENT, METADATA, DATA_END} | (set() if mcap.chunked else {SCHEMA, CHANNEL, MESSAGE})
        found = mcap.find(bad + 1, mcap.end if indexed is None else indexed, opcodes, self.known.channels)
        return indexed if found is None else found

    def _contents(self, mcap: McapFile, record: Record) -> tuple[list[Any], bool]:
        """The definitions and messages of a record, and whether a CRC vouches for them."""
        if record.opcode != CHUNK:
            try:
                found = [parse(record.opcode, mcap.body(record))]
            except Exception as error:
                self._damaged(record.offset, record.end, f"record lost ({type(error).__name__}: {error})")
                return [], False
            self.unchunked += record.opcode == MESSAGE
            return found, False
        first, last = self.reader.chunk_times.get((self.path, record.offset), (None, None))
        late = first is not None and self.query.end_ns is not None and first > self.query.end_ns
        if late or (last is not None and self.query.start_ns is not None and last < self.query.start_ns):
            return [], True
        chunk = None
        try:
            check_size(record.length)
            chunk = parse(CHUNK, mcap.body(record))
            found = list(chunk_records(chunk))
        except Exception as error:  # CRC, decompression, struct: whatever it is, only this chunk is lost
            # It ends as it says, but before the next one if bytes are missing and that has moved into it.
            opcodes, moved = {CHUNK, ATTACHMENT, METADATA, DATA_END}, None
            if mcap.summary.end is None:
                moved = mcap.find(record.offset + 1, record.end, opcodes)
            self.after_lost = record.end if moved is None else moved
            reason = f"chunk lost ({type(error).__name__}: {str(error)[:120]})"
            self._damaged(record.offset, self.after_lost, reason, chunk)
            return [], True
        self.unprotected += chunk.uncompressed_crc == 0
        logged = [r.log_time for r in found if isinstance(r, McapMessage)]
        self.reader.chunk_times[self.path, record.offset] = (min(logged), max(logged)) if logged else (0, 0)
        return found, chunk.uncompressed_crc != 0

    def _check_ends(self, mcap: McapFile, *, sound: bool) -> None:
        if self.data_end is None:
            return
        if self.unchunked and sound and not mcap.data_crc_matches(self.data_end):
            reason = "the CRC of messages outside chunks does not match: at least one is wrong"
            self._damaged(len(MAGIC), self.data_end.offset, reason)
        if mcap.summary.problem or self.data_end.end != mcap.end:
            reason = f"no index behind the data ({mcap.summary.problem or 'it begins elsewhere'}): nothing there was "
            reason += "read"
            another = mcap.find(self.data_end.end, mcap.end, {CHUNK, DATA_END})  # no index holds these: joined files
            self._damaged(self.data_end.end, mcap.size, reason, lost=another is not None)

    def _message(self, m: McapMessage, proven: bool, place: Record) -> Message | None:
        channel = self.known.channels.get(m.channel_id)
        if channel is not None and not self.query.asks(channel.topic):
            return None
        with_schema = channel is not None and (channel.message_encoding == "json" or channel.schema_id == 0)
        if channel is None or not (with_schema or channel.schema_id in self.known.schemas):
            self.orphans += 1
            return None
        if m.log_time > MAX_TIME_NS:
            self.timeless += 1
            return None
        decoder = self.known.decoder(channel) if self.query.reads(channel.topic) else None
        is_cdr, value = channel.message_encoding == "cdr", None
        try:
            data = unpacked(m.data) if is_cdr else m.data
            value = None if decoder is None else decoder(data)
            stamp = decode.stamp_ns(value) if decoder and not is_cdr else self.known.stamp(channel, data)
        except Exception as error:  # decoders raise what they like on bytes that do not fit the schema
            if decoder is None:
                return Message(channel.topic, m.log_time, None, None)
            kind = schema.name if (schema := self.known.schemas.get(channel.schema_id)) else NO_SCHEMA
            problem = f"{channel.topic}: a message at log time {m.log_time} ns does not fit its schema {kind} "
            problem += f"({type(error).__name__}: {error})"
            self.misfits[channel.id] += 1
            if proven or self.misfits[channel.id] > MAX_MISFITS:
                raise RecordingError(problem) from error
            self._damaged(place.offset, place.end, problem)
            return None
        return Message(channel.topic, m.log_time, stamp, value)

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
        told = self.reader.types.get(channel.topic)
        if told is not None and told.name != NO_SCHEMA:
            return
        problem, schema = None, self.known.schemas.get(channel.schema_id)
        try:
            self.known.decoder(channel)
        except RecordingError as error:
            problem = str(error)
        kind = schema.name if schema else NO_SCHEMA
        self.reader.types[channel.topic] = TopicType(kind, channel.message_encoding, problem)

    def _damaged(self, start: int, end: int, reason: str, chunk: Chunk | None = None, *, lost: bool = True) -> None:
        times = (chunk.message_start_time, chunk.message_end_time) if chunk is not None else (None, None)
        self.damage.append(Damage(str(self.path), start, end, reason, *times, lost=lost))
