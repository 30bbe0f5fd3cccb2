"""Records of an MCAP file that may be damaged: whether a record is whole, where the next one is, what a chunk contains.

A record is an opcode (1 byte), a length (8) and a body. CRCs protect what is inside a chunk and the summary at the file's
end, nothing else; so a record counts as whole only if the lengths inside its body add up to its own.
"""

import io
import struct
import zlib
from bisect import bisect_left
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import AttachmentIndex, Channel, Chunk, ChunkIndex, Message, Metadata, MetadataIndex, Schema

MAGIC = b"\x89MCAP0\r\n"
HEADER_BYTES = 9  # Bytes of a record before its body: opcode (1), length (8)
MAX_CHUNK_BYTES = 1 << 28
"""256 MiB. A larger chunk is not opened: a few damaged bytes must not take all the memory."""
BLOCK_BYTES = 1 << 20  # Number of bytes that are read at once

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
MESSAGE_BYTES = 22  # channel (2), sequence (4), log time (8), publish time (8); the rest is the payload
DATA_END_BYTES = HEADER_BYTES + 4  # the whole record

# Bodies: a number of fixed bytes; "short", "long": a part behind its own length in 4 or 8 bytes.
_LAYOUTS: dict[int, tuple[int | str, ...]] = {
    HEADER: ("short", "short"),
    FOOTER: (20,),
    SCHEMA: (2, "short", "short", "short"),
    CHANNEL: (4, "short", "short", "short"),
    CHUNK: (28, "short", "long"),
    MESSAGE_INDEX: (2, "short"),
    CHUNK_INDEX: (32, "short", 8, "short", 16),
    ATTACHMENT: (16, "short", "short", "long", 4),
    ATTACHMENT_INDEX: (40, "short", "short"),
    STATISTICS: (42, "short"),
    METADATA: ("short", "short"),
    METADATA_INDEX: (16, "short"),
    SUMMARY_OFFSET: (17,),
    DATA_END: (4,),
}
KNOWN_OPCODES = frozenset({*_LAYOUTS, MESSAGE})
_END_BYTES = HEADER_BYTES + 20 + len(MAGIC)


class Record(NamedTuple):
    """Kind and position of a record in its file, in bytes."""

    opcode: int
    offset: int
    """Position of its first byte in the file."""
    length: int
    """Length of its body in bytes."""

    @property
    def body(self) -> int:
        """Position of the first byte of its body in the file."""
        return self.offset + HEADER_BYTES

    @property
    def end(self) -> int:
        """Position after its last byte in the file."""
        return self.body + self.length


def parse(opcode: int, body: bytes) -> Any:
    """Decode the body of a record as the mcap package's own type for ``opcode``, such as ``Message``."""
    if opcode == MESSAGE:
        channel, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", body)
        payload = body[MESSAGE_BYTES:]
        return Message(channel, log_time, payload, publish_time, sequence)
    return _PARSERS[opcode](ReadDataStream(io.BytesIO(body)))


_PARSERS = {
    SCHEMA: Schema.read,
    CHANNEL: Channel.read,
    CHUNK: Chunk.read,
    CHUNK_INDEX: ChunkIndex.read,
    ATTACHMENT_INDEX: AttachmentIndex.read,
    METADATA: Metadata.read,
    METADATA_INDEX: MetadataIndex.read,
}


@dataclass
class Summary:
    """Summary section at the end of an MCAP file: whether it can be trusted, and the channels and positions that it lists."""

    problem: str | None = None
    """Reason why the summary section is not used; empty if it is."""
    proven: bool = False
    """True if the section has a CRC and agrees with it."""
    schemas: list[Schema] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)
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
        self.file, self.size = file, size
        self.end = size
        """Offset at which the data section ends, as far as known."""
        self.chunked = False
        """True if messages are known to lie in chunks; one outside is then probably a damaged message index."""
        self.summary = self._read_summary()
        self.end = self.summary.end or size
        self.chunked = self.summary.has_chunks

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
            if record.length < MESSAGE_BYTES or any(self._fills(record._replace(opcode=o)) for o in others):
                return None
        elif not self._is_private(record):
            return None
        return record if self._may_begin(record.end) else None

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
        """Bytes of the record's body."""
        self.file.seek(record.body)
        return self.file.read(record.length)

    def has_data_crc(self, data_end: Record | None) -> bool:
        """True if the file has a CRC of the data section."""
        return data_end is not None and any(self.body(data_end))

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
            return self.summary.end is None and record.opcode in KNOWN_OPCODES and record.length < 1 << 40
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
        self.summary = Summary()
        footer = self.record(self.size - _END_BYTES)
        self.file.seek(max(self.size - len(MAGIC), 0))
        if footer is None or footer.opcode != FOOTER or self.file.read() != MAGIC:
            return Summary(problem="there is no footer")
        start, _, crc = struct.unpack("<QQI", self.body(footer))
        if start == 0:
            return Summary(end=footer.offset)
        if not len(MAGIC) <= start <= footer.offset:
            return Summary(problem="its footer points nowhere")
        if crc and self._crc(start, footer.end - 4) != crc:
            return Summary(problem="its CRC does not match")
        summary, offset = Summary(proven=crc != 0, end=start), start
        while offset < footer.offset:
            record = self.record(offset)
            if record is None or record.opcode in (MESSAGE, CHUNK, ATTACHMENT, METADATA, DATA_END):
                return Summary(problem=f"no index record at byte {offset:,}")
            try:
                _add(summary, record.opcode, self.body(record))
            except (ValueError, struct.error, McapError) as error:
                return Summary(problem=f"unreadable at byte {offset:,}: {error}")
            offset = record.end
        summary.starts.sort()
        return summary


def _add(summary: Summary, opcode: int, body: bytes) -> None:
    if opcode == SCHEMA:
        summary.schemas.append(parse(opcode, body))
    elif opcode == CHANNEL:
        summary.channels.append(parse(opcode, body))
    elif opcode == CHUNK_INDEX:
        summary.starts.append(parse(opcode, body).chunk_start_offset)
        summary.has_chunks = True
    elif opcode in (ATTACHMENT_INDEX, METADATA_INDEX):
        summary.starts.append(parse(opcode, body).offset)


def chunk_records(chunk: Chunk) -> Iterator[Any]:
    """Schemas, channels and messages of a chunk in order; its CRC is checked before the first one.

    Raises:
        ValueError: too large, does not decompress, wrong CRC, or not made of whole records.
    """
    data = memoryview(_contents(chunk))
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its CRC does not match")
    if not chunk.uncompressed_crc and len(data) != chunk.uncompressed_size:
        raise ValueError(f"{len(data):,} bytes uncompressed, but its header states {chunk.uncompressed_size:,}")
    offset = 0
    while offset < len(data):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        start, offset = offset + HEADER_BYTES, offset + HEADER_BYTES + length
        if offset > len(data):
            raise ValueError("a record extends beyond the end of the chunk")
        if opcode in (SCHEMA, CHANNEL, MESSAGE):
            yield parse(opcode, bytes(data[start:offset]))


def check_size(num_bytes: int) -> None:
    """Check that a chunk is not too large to open.

    Raises:
        ValueError: it has more than ``MAX_CHUNK_BYTES``.
    """
    if num_bytes > MAX_CHUNK_BYTES:
        raise ValueError(f"its header states {num_bytes:,} bytes; at most {MAX_CHUNK_BYTES:,} are accepted")


def _contents(chunk: Chunk) -> bytes | bytearray:
    """Uncompressed, and never more than the chunk claims."""
    claims = chunk.uncompressed_size
    check_size(claims)
    if chunk.compression == "":
        return chunk.data
    if chunk.compression not in ("zstd", "lz4"):
        raise ValueError(f"compression {chunk.compression!r} is not supported")
    data = bytearray()
    for block in _zstd_blocks(chunk.data) if chunk.compression == "zstd" else _lz4_blocks(chunk.data):
        data += block
        if len(data) > claims:
            raise ValueError(f"it contains more than the {claims:,} bytes that its header states")
    return data


def _zstd_blocks(data: bytes) -> Iterator[bytes]:
    with zstandard.ZstdDecompressor().stream_reader(data) as reader:
        while block := reader.read(BLOCK_BYTES):
            yield block


def _lz4_blocks(data: bytes) -> Iterator[bytes]:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    block = decompressor.decompress(data, BLOCK_BYTES)
    while block:
        yield block
        block = b"" if decompressor.eof else decompressor.decompress(b"", BLOCK_BYTES)
