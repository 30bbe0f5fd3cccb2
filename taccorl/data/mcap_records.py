"""Records of an MCAP file, which may be damaged: found, delimited and parsed, without trusting the file's index.

A record is an opcode (1 byte), a length (8) and a body. CRCs protect what is inside a chunk and the summary at the file's end,
nothing else; so a record counts as whole only if the lengths inside its body add up to its own.
"""

import io
import struct
import zlib
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode as Op
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

MAGIC = b"\x89MCAP0\r\n"
HEADER_BYTES = 9  # Bytes of a record before its body: opcode (1), length (8)
MAX_CHUNK_BYTES = (
    1 << 28
)  # A larger chunk is not opened: a few damaged bytes must not take all the memory
BLOCK_BYTES = 1 << 20  # Number of bytes that are read at once
MESSAGE_BYTES = 22  # channel (2), sequence (4), log time (8), publish time (8); the rest is the payload
DATA_END_BYTES = HEADER_BYTES + 4  # the whole record
# Bodies: a number of fixed bytes; "short", "long": a part behind its own length in 4 or 8 bytes.
_LAYOUTS: Mapping[Any, tuple[int | str, ...]] = (
    {
        Op.HEADER: ("short", "short"),
        Op.FOOTER: (20,),
        Op.DATA_END: (4,),
        Op.SUMMARY_OFFSET: (17,),
    }
    | {
        Op.SCHEMA: (2, "short", "short", "short"),
        Op.CHANNEL: (4, "short", "short", "short"),
    }
    | {
        Op.CHUNK: (28, "short", "long"),
        Op.MESSAGE_INDEX: (2, "short"),
        Op.CHUNK_INDEX: (32, "short", 8, "short", 16),
    }
    | {
        Op.ATTACHMENT: (16, "short", "short", "long", 4),
        Op.ATTACHMENT_INDEX: (40, "short", "short"),
    }
    | {
        Op.METADATA: ("short", "short"),
        Op.METADATA_INDEX: (16, "short"),
        Op.STATISTICS: (42, "short"),
    }
)
_PARSERS: Mapping[Any, Callable[[ReadDataStream], Any]] = {
    Op.SCHEMA: Schema.read,
    Op.CHANNEL: Channel.read,
    Op.CHUNK: Chunk.read,
    Op.CHUNK_INDEX: ChunkIndex.read,
} | {
    Op.ATTACHMENT_INDEX: AttachmentIndex.read,
    Op.METADATA: Metadata.read,
    Op.METADATA_INDEX: MetadataIndex.read,
    Op.STATISTICS: Statistics.read,
}
BEGINNINGS = {Op.CHUNK, Op.ATTACHMENT, Op.METADATA, Op.DATA_END}
"""Kinds of records at which reading goes on behind a damaged one in data of chunks."""
_END_BYTES = HEADER_BYTES + 20 + len(MAGIC)


class Record(NamedTuple):
    """One record of an MCAP file: opcode (kind), offset of its first byte, and length of its body [bytes]."""

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
    if opcode == Op.MESSAGE:
        channel, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", body)
        return Message(channel, log_time, body[MESSAGE_BYTES:], publish_time, sequence)
    return _PARSERS[opcode](ReadDataStream(io.BytesIO(body)))


@dataclass
class Summary:
    """Summary section at the end of an MCAP file, as far as it can be trusted."""

    problem: str | None = None
    """Reason why the section is not used; empty if it is."""
    proven: bool = False
    """True if the section has a CRC and agrees with it."""
    definitions: list[Schema | Channel] = field(default_factory=list)
    chunks: list[ChunkIndex] = field(default_factory=list)
    """Index records of the file's chunks, in the order of the section."""
    statistics: Statistics | None = None
    starts: list[int] = field(default_factory=list)
    """Offsets of the file's chunks, attachments and metadata records, ascending."""
    end: int | None = None
    """Offset at which the data section ends; None without a sound footer: the file may have been cut."""

    @property
    def has_chunks(self) -> bool:
        return bool(self.chunks)

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
        if record.opcode == Op.MESSAGE:
            # Nothing inside a message says how long it is; and a damaged opcode must not make another record a message.
            others = {Op.HEADER, Op.SCHEMA, Op.CHANNEL, Op.CHUNK, Op.METADATA}
            others |= {Op.MESSAGE_INDEX} if self.chunked else set()
            sound = record.length >= MESSAGE_BYTES and not any(
                self._fills(record._replace(opcode=o)) for o in others
            )
        else:
            sound = self._is_private(record)
        return record if sound and self._may_begin(record.end) else None

    def find(
        self,
        start: int,
        stop: int,
        opcodes: Collection[int],
        channels: Collection[int] = (),
    ) -> int | None:
        """Offset of the first whole record of one of ``opcodes`` in [start, stop), None without one; messages only of these
        channel ids."""
        wanted = np.isin(np.arange(256), list(opcodes))
        for offset in range(start, stop, BLOCK_BYTES):
            self.file.seek(offset)
            block = np.frombuffer(
                self.file.read(min(BLOCK_BYTES, stop - offset) + HEADER_BYTES - 1),
                np.uint8,
            )
            if len(block) < HEADER_BYTES:
                return None
            heads = block[: len(block) - HEADER_BYTES + 1]
            small = (
                (block[6:-2] == 0) & (block[7:-1] == 0) & (block[8:] == 0)
            )  # lengths below 2⁴⁰ bytes
            for at in np.flatnonzero(wanted[heads] & small):
                record = self.record(offset + int(at))
                if record is not None and self._is_sure(record, channels):
                    return record.offset
        return None

    def body(self, record: Record) -> bytes:
        self.file.seek(record.body)
        return self.file.read(record.length)

    def chunk(self, record: Record) -> Chunk:
        """The chunk that a record is. Raises ValueError: it is too large."""
        check_size(record.length)
        return parse(Op.CHUNK, self.body(record))

    def num_indexed(self, record: Record) -> int:
        """Number of messages that a message index lists: 16 bytes each, behind the
        number of its channel (2) and their length (4)."""
        return (record.length - 6) // 16

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
            known = record.opcode in _LAYOUTS or record.opcode == Op.MESSAGE
            return self.summary.end is None and known and record.length < 1 << 40
        if record.opcode in _LAYOUTS:
            return self._fills(record)
        return (
            record.length >= MESSAGE_BYTES
            if record.opcode == Op.MESSAGE
            else self._is_private(record)
        )

    def _is_private(self, record: Record) -> bool:
        """An application's own kind (0x80 and above), rather than a chunk or the end-of-data record with a damaged opcode."""
        indexed = self.summary.proven and self.summary.has_chunks
        place = (
            len(MAGIC) < record.offset != self.summary.next_start(record.offset)
            and record.end != self.end
        )
        return record.opcode >= 0x80 and indexed and place

    def _is_sure(self, record: Record, channels: Collection[int]) -> bool:
        if record.opcode == Op.MESSAGE:
            channel = int.from_bytes(self.body(record)[:2], "little")
            return channel in channels and (
                record.end == self.end or self.record(record.end) is not None
            )
        return record.opcode != Op.DATA_END or self._may_begin(record.end)

    def _crc(self, start: int, end: int) -> int:
        self.file.seek(start)
        crc = 0
        while start < end and (block := self.file.read(min(BLOCK_BYTES, end - start))):
            crc, start = zlib.crc32(block, crc), start + len(block)
        return crc

    def summary_at(self, offset: int) -> Summary | None:
        """The summary that begins at ``offset`` and not where the footer says, because
        bytes before it are missing or too many; None if none is there."""
        found = self._read_summary(offset)
        return None if found.problem else found

    def _read_summary(self, moved: int | None = None) -> Summary:
        """The summary, if the file has a footer and what it points to is sound. ``moved``: offset at which it begins instead."""
        footer = self.record(self.size - _END_BYTES)
        self.file.seek(max(self.size - len(MAGIC), 0))
        if footer is None or footer.opcode != Op.FOOTER or self.file.read() != MAGIC:
            return Summary("there is no footer")
        start, _, crc = struct.unpack("<QQI", self.body(footer))
        if start == 0:
            return Summary(end=footer.offset)
        start = start if moved is None else moved
        if not len(MAGIC) <= start <= footer.offset:
            return Summary("its footer points nowhere")
        if crc and self._crc(start, footer.end - 4) != crc:
            return Summary("its CRC does not match")
        summary, offset = Summary(proven=crc != 0, end=start), start
        while offset < footer.offset:
            record = self.record(offset)
            if record is None or record.opcode in (
                Op.MESSAGE,
                Op.CHUNK,
                Op.ATTACHMENT,
                Op.METADATA,
                Op.DATA_END,
            ):
                return Summary(f"no index record at byte {offset:,}")
            try:
                found = (
                    parse(record.opcode, self.body(record))
                    if record.opcode in _PARSERS
                    else None
                )
            except (ValueError, struct.error, McapError) as error:
                return Summary(f"unreadable at byte {offset:,}: {error}")
            if isinstance(found, Schema | Channel):
                summary.definitions.append(found)
            elif isinstance(found, Statistics):
                summary.statistics = found
            elif isinstance(found, ChunkIndex):
                summary.chunks.append(found)
                summary.starts.append(found.chunk_start_offset)
            elif found is not None:
                summary.starts.append(found.offset)
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
            data = reader.read(
                claims + BLOCK_BYTES
            )  # a damaged block may overrun: room to say so
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, claims + 1)
    else:
        raise ValueError(f"compression {chunk.compression!r} is not supported")
    if chunk.compression and len(data) > claims:
        raise ValueError(
            f"it contains more than the {claims:,} bytes that its header states"
        )
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its CRC does not match")
    if not chunk.uncompressed_crc and len(data) != claims:
        raise ValueError(
            f"{len(data):,} bytes uncompressed, but its header states {claims:,}"
        )
    view, offset = memoryview(data), 0
    while offset < len(data):
        opcode, length = struct.unpack_from("<BQ", view, offset)
        start, offset = offset + HEADER_BYTES, offset + HEADER_BYTES + length
        if offset > len(data):
            raise ValueError("a record extends beyond the end of the chunk")
        if opcode in (Op.SCHEMA, Op.CHANNEL, Op.MESSAGE):
            yield parse(opcode, bytes(view[start:offset]))


def check_size(num_bytes: int) -> None:
    """Raises ValueError: a chunk has more than ``MAX_CHUNK_BYTES``."""
    if num_bytes > MAX_CHUNK_BYTES:
        raise ValueError(
            f"its header states {num_bytes:,} bytes; at most {MAX_CHUNK_BYTES:,} are accepted"
        )
