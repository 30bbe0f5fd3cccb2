"""MCAP with ROS 2 CDR, protobuf or JSON messages, read without ROS; damaged files are salvaged chunk by chunk.

The file is walked record by record without trusting its index: every chunk's CRC is checked, a bad chunk costs only
itself, and after a bad record the walk goes on at the next chunk. (mcap's own reader checks no CRC by default and reads
nothing at all from a file without a footer.)
"""

import contextlib
import json
import re
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any

import yaml
from mcap.data_stream import ReadDataStream
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, DataEnd, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk

from taccorl.data import decode
from taccorl.data.recording import Damage, Message, Reader, Source, TopicType, readers
from taccorl.data.spec import RecordingSpec
from taccorl.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEADER_BYTES = 9  # opcode (1), length (8)
MAX_OPCODE = 0x0F
SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0C, 0x0F
# opcode, record length, start, end, uncompressed size, CRC, then the compression's name with its length before it
CHUNK_START = re.compile(rb"\x06.{8}.{8}.{8}.{8}.{4}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0).{8}", re.DOTALL)
SEARCH_BYTES = 1 << 20

Decoder = Callable[[bytes], Any]


@readers.register("mcap")
class McapReader(Reader):
    """One MCAP file, or the files of a split bag in order."""

    suffixes = (".mcap",)

    def __init__(self, source: Source, spec: RecordingSpec | None = None) -> None:
        super().__init__(source, spec)
        self._topics: dict[str, TopicType] = {}
        self._chunk_times: dict[tuple[Path, int], tuple[int, int]] = {}
        self._definitions: dict[Path, tuple[dict[int, Schema], dict[int, Channel]]] = {}
        """By file: kept between reads, because a partial read may skip the chunk that defines a channel."""
        self._whole = False

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        """A file; a bag folder with metadata.yaml; with ``split_bag``, a folder whose files x_0, x_1, … belong together."""
        if path.is_dir():
            return bag_sources(path, ".mcap", split_bag=split_bag)
        return super().sources(path, split_bag=split_bag)

    def topics(self) -> dict[str, TopicType]:
        """Topics named by definitions met so far; reads the whole recording if that has not happened yet."""
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
        again, self.damage = self.damage, []
        whole = False
        try:
            for path in self.source.files:
                yield from _File(path, self, topics, stamps_only).messages(start_ns, end_ns)
            whole = start_ns is None and end_ns is None
        finally:
            if self._whole and not whole:
                self.damage = again  # a partial read saw only a part of it
            self._whole = self._whole or whole


def bag_sources(path: Path, suffix: str, *, split_bag: bool) -> list[Source] | None:
    """A rosbag2 folder as one recording: file order from its metadata.yaml, or by number when the spec says split_bag."""
    files = sorted((p for p in path.iterdir() if p.suffix == suffix), key=lambda p: decode.natural_key(p.name))
    if not files:
        return None
    index = path / "metadata.yaml"
    if index.is_file():
        try:
            named = yaml.safe_load(index.read_text())["rosbag2_bagfile_information"]["relative_file_paths"]
        except (yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError) as error:
            raise RecordingError(f"{index}: not rosbag2's metadata ({type(error).__name__}: {error})") from error
        named = [path / Path(n).name for n in named]
        absent = [p.name for p in named if not p.is_file()]
        if absent:
            raise RecordingError(f"{index} names {', '.join(absent)}, which is not in {path}: copy the whole bag")
        return [Source(path, tuple(named))]
    return [Source(path, tuple(files))] if split_bag else None


class _File:
    """One walk through one MCAP file."""

    def __init__(
        self, path: Path, reader: McapReader, topics: Collection[str] | None, stamps_only: Collection[str]
    ) -> None:
        self.path, self.reader = path, reader
        self.topics, self.stamps_only = topics, stamps_only
        self.schemas, self.channels = reader._definitions.setdefault(path, ({}, {}))
        self.decoders: dict[int, Decoder] = {}
        self.stampers: dict[int, Callable[[bytes], int | None]] = {}
        self.orphans = 0
        self.unchunked = 0

    def messages(self, start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be opened: {error.strerror}") from error
        with file:
            size = self.path.stat().st_size
            self._check_magic(file, size)
            self._read_summary(file)
            for opcode, offset, length in self._walk(file, size):
                if opcode == CHUNK:
                    records = self._chunk(file, offset, length, start_ns, end_ns)
                elif opcode in (SCHEMA, CHANNEL, MESSAGE, METADATA):
                    records = self._single(file, opcode, offset, length)
                else:
                    continue
                yield from self._convert(records)
            if self.unchunked:
                self._check_data_crc(file, size)
        if self.orphans:
            self._damaged(0, size, f"{self.orphans} messages of channels whose definition was lost")

    def _check_magic(self, file: BufferedReader, size: int) -> None:
        head = file.read(len(MAGIC))
        if size == 0:
            raise RecordingError(f"{self.path}: is empty (0 bytes)")
        if head != MAGIC:
            raise RecordingError(f"{self.path}: is not an MCAP file: begins with {head!r}, not {MAGIC!r}")

    def _read_summary(self, file: BufferedReader) -> None:
        """Definitions from the summary at the end, so that a bad first chunk does not take its topics' meaning along."""
        file.seek(0)
        try:
            summary = SeekingReader(file).get_summary()
        except Exception:  # mcap lets struct.error and others escape on damaged files; the walk reports the damage
            return
        if summary is not None:
            self.schemas.update(summary.schemas)
            for channel in summary.channels.values():
                self._define(channel)

    def _walk(self, file: BufferedReader, size: int) -> Iterator[tuple[int, int, int]]:
        """(opcode, offset, length) of every record of the data section; goes on at the next chunk after a bad one."""
        offset = len(MAGIC)
        while True:
            file.seek(offset)
            header = file.read(RECORD_HEADER_BYTES)
            opcode, length = struct.unpack("<BQ", header) if len(header) == RECORD_HEADER_BYTES else (0, 0)
            whole = 0 < opcode <= MAX_OPCODE and offset + RECORD_HEADER_BYTES + length <= size
            if not whole:
                following = _find_chunk(file, offset + 1, size)
                if following is None:
                    self._damaged(offset, size, "the file ends without a footer (cut by a crash?)")
                    return
                self._damaged(offset, following, "a record header that makes no sense")
                offset = following
                continue
            if opcode == DATA_END:
                return
            yield opcode, offset, length
            offset += RECORD_HEADER_BYTES + length

    def _chunk(
        self, file: BufferedReader, offset: int, length: int, start_ns: int | None, end_ns: int | None
    ) -> list[Any]:
        times = self.reader._chunk_times.get((self.path, offset))
        if times is not None and (
            (end_ns is not None and times[0] > end_ns) or (start_ns is not None and times[1] < start_ns)
        ):
            return []
        file.seek(offset + RECORD_HEADER_BYTES)
        chunk = None
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(file.read(length))))
            records = breakup_chunk(chunk, validate_crc=True)
        except Exception as error:  # CRC, decompression, struct: whatever it is, only this chunk is lost
            reason = f"chunk lost ({type(error).__name__}: {str(error)[:120]})"
            end = offset + RECORD_HEADER_BYTES + length
            self._damaged(offset, end, reason, chunk)
            return []
        logged = [r.log_time for r in records if isinstance(r, McapMessage)]
        self.reader._chunk_times[self.path, offset] = (min(logged), max(logged)) if logged else (0, 0)
        return records

    def _single(self, file: BufferedReader, opcode: int, offset: int, length: int) -> list[Any]:
        file.seek(offset + RECORD_HEADER_BYTES)
        stream = ReadDataStream(BytesIO(file.read(length)))
        try:
            if opcode == MESSAGE:
                self.unchunked += 1
                return [McapMessage.read(stream, length)]
            return [{SCHEMA: Schema, CHANNEL: Channel, METADATA: Metadata}[opcode].read(stream)]
        except Exception as error:
            self._damaged(
                offset, offset + RECORD_HEADER_BYTES + length, f"record lost ({type(error).__name__}: {error})"
            )
            return []

    def _check_data_crc(self, file: BufferedReader, size: int) -> None:
        """Messages outside chunks have only the data section's CRC."""
        offset = None
        for opcode, at, _ in self._records_quietly(file, size):
            if opcode == DATA_END:
                offset = at
        if offset is None:
            return
        file.seek(offset + RECORD_HEADER_BYTES)
        expected = DataEnd.read(ReadDataStream(file)).data_section_crc
        file.seek(0)
        crc, left = 0, offset
        while left and (block := file.read(min(left, SEARCH_BYTES))):
            crc, left = zlib.crc32(block, crc), left - len(block)
        if expected and crc != expected:
            self._damaged(len(MAGIC), offset, "unchunked messages whose CRC does not match: at least one is wrong")

    @staticmethod
    def _records_quietly(file: BufferedReader, size: int) -> Iterator[tuple[int, int, int]]:
        offset = len(MAGIC)
        while offset + RECORD_HEADER_BYTES <= size:
            file.seek(offset)
            opcode, length = struct.unpack("<BQ", file.read(RECORD_HEADER_BYTES))
            yield opcode, offset, length
            if opcode == DATA_END:
                return
            offset += RECORD_HEADER_BYTES + length

    def _convert(self, records: list[Any]) -> Iterator[Message]:
        for r in records:
            if isinstance(r, McapMessage):
                channel = self.channels.get(r.channel_id)
                if channel is None:
                    self.orphans += 1
                elif self.topics is None or channel.topic in self.topics:
                    yield self._message(channel, r)
            elif isinstance(r, Schema):
                self.schemas[r.id] = r
            elif isinstance(r, Channel):
                self._define(r)
            elif isinstance(r, Metadata):
                self.reader.metadata[r.name] = dict(r.metadata)

    def _message(self, channel: Channel, m: McapMessage) -> Message:
        stamper = self.stampers.get(channel.id)
        if stamper is None:
            stamper = self.stampers[channel.id] = self._stamper(channel)
        if self.topics is None or channel.topic in self.stamps_only:
            return Message(channel.topic, m.log_time, stamper(m.data), None)
        decoder = self.decoders.get(channel.id)
        if decoder is None:
            decoder = self.decoders[channel.id] = self._decoder(channel)
        try:
            value = decoder(m.data)
        except Exception as error:  # decoders raise what they like on bytes that do not fit the schema
            raise RecordingError(
                f"{channel.topic}: a message at log time {m.log_time} ns does not fit its schema "
                f"{self._type_name(channel)} ({type(error).__name__}: {error})"
            ) from error
        stamp = stamper(m.data) if channel.message_encoding == "cdr" else decode.stamp_ns(value)
        return Message(channel.topic, m.log_time, stamp, value)

    def _define(self, channel: Channel) -> None:
        if self.channels.get(channel.id) == channel:
            return
        self.channels[channel.id] = channel
        if channel.topic in self.reader._topics:
            return
        problem = None
        try:
            self._decoder(channel)
        except RecordingError as error:
            problem = str(error)
        self.reader._topics[channel.topic] = TopicType(self._type_name(channel), channel.message_encoding, problem)

    def _type_name(self, channel: Channel) -> str:
        schema = self.schemas.get(channel.schema_id)
        return schema.name if schema else "no schema"

    def _decoder(self, channel: Channel) -> Decoder:
        schema, encoding = self.schemas.get(channel.schema_id), channel.message_encoding
        try:
            if encoding == "json":
                return json.loads
            if encoding == "cdr":
                from mcap_ros2.decoder import DecoderFactory as Ros2

                with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):  # it prints what it raises
                    found = Ros2().decoder_for(encoding, schema)
            elif encoding == "protobuf":
                from mcap_protobuf.decoder import DecoderFactory as Protobuf

                found = Protobuf().decoder_for(encoding, schema)
            else:
                found = None
        except Exception as error:  # a schema text that does not parse: this topic only
            raise RecordingError(
                f"{channel.topic}: its schema {self._type_name(channel)} does not parse ({type(error).__name__}: {error})"
            ) from error
        if found is None:
            described = f"{schema.encoding} schema {schema.name}" if schema else "no schema"
            raise RecordingError(
                f"{channel.topic}: {encoding!r} messages with {described} are not read (cdr with ros2msg, protobuf, json are)"
            )
        return found

    def _stamper(self, channel: Channel) -> Callable[[bytes], int | None]:
        """Stamp without decoding the message: a ROS 2 header that comes first lies at a fixed place."""
        schema = self.schemas.get(channel.schema_id)
        if channel.message_encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
            return _cdr_stamp if _header_comes_first(schema.data.decode(errors="replace")) else lambda data: None
        try:
            decoder = self._decoder(channel)
        except RecordingError:
            return lambda data: None

        def stamp(data: bytes) -> int | None:
            try:
                return decode.stamp_ns(decoder(data))
            except Exception:  # only asked for its time: its content may be anything
                return None

        return stamp

    def _damaged(self, start: int, end: int, reason: str, chunk: Chunk | None = None) -> None:
        times = (chunk.message_start_time, chunk.message_end_time) if chunk is not None else (None, None)
        self.reader.damage.append(Damage(str(self.path), start, end, reason, *times))


def _header_comes_first(definition: str) -> bool:
    for line in definition.splitlines():
        words = line.split("#")[0].split()
        if words and "=" not in line.split("#")[0]:
            return words[0] in ("std_msgs/Header", "std_msgs/msg/Header", "Header")
    return False


def _cdr_stamp(data: bytes) -> int | None:
    """header.stamp of a CDR message: 4 bytes of encapsulation (second byte 1: little-endian), then sec, nanosec."""
    if len(data) < 12:
        return None
    sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return sec * 1_000_000_000 + nanosec


def _find_chunk(file: BufferedReader, start: int, size: int) -> int | None:
    """Offset of the next chunk record that is consistent in itself, at or after ``start``."""
    offset = start
    while offset < size:
        file.seek(offset)
        block = file.read(SEARCH_BYTES + 64)
        for match in CHUNK_START.finditer(block):
            at = offset + match.start()
            length = struct.unpack_from("<Q", block, match.start() + 1)[0]
            inner = struct.unpack_from("<Q", match.group(), len(match.group()) - 8)[0]
            # the compressed bytes must fill the record exactly
            if at + RECORD_HEADER_BYTES + length <= size and len(match.group()) - RECORD_HEADER_BYTES + inner == length:
                return at
        offset += SEARCH_BYTES
    return None
