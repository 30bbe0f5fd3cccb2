"""Stand-in recordings taken apart and put together again, and shipped specs with lines changed: for tests."""

import itertools
import shutil
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from taccorl.data.spec import data_specs_folder
from taccorl.surrogate.drivers import CAMERA_TOPICS, EPISODE_TOPIC, START_UNIX_NS

SIZE = (96, 128)  # rows, columns of pictures: as small as a frame id allows to be quick
NATIVE = ("[224, 224, 3]", f"[{SIZE[0]}, {SIZE[1]}, 3]")
STAMPED = ("JointState", "CompressedImage")


@dataclass(frozen=True)
class Raw:
    """One message as its bytes lie in the file."""

    topic: str
    type: str
    log_ns: int
    data: bytes

    @property
    def log_s(self) -> float:
        return (self.log_ns - START_UNIX_NS) * 1e-9

    @property
    def stamp_ns(self) -> int:
        """Header stamp: sec and nanosec behind the 4 bytes with which every CDR message begins."""
        sec, nanosec = struct.unpack_from("<iI", self.data, 4)
        return sec * 10**9 + nanosec

    @property
    def time_s(self) -> float:
        """When it happened, as the shipped spec understands it: header stamp, or log time less a pad's 10 ms."""
        if self.type.endswith(STAMPED):
            return (self.stamp_ns - START_UNIX_NS) * 1e-9
        return self.log_s - (0.010 if self.type.endswith("Array") else 0.0)


def read_raw(path: Path) -> list[Raw]:
    """Every message, in the order of the file."""
    with path.open("rb") as file:
        return [
            Raw(
                channel.topic,
                schema.name if schema else "",
                message.log_time,
                message.data,
            )
            for schema, channel, message in make_reader(file).iter_messages(
                log_time_order=False
            )
        ]


def rewrite(
    source: Path,
    path: Path,
    change: Callable[[list[Raw]], Iterable[Raw]],
    metadata: dict[str, dict[str, str]] | None = None,
    types: dict[str, str] | None = None,
) -> Path:
    """``path``: ``source`` with its messages changed, in the order that ``change`` gives them, and metadata added; ``types``:
    topic → the name under which its type's definition stands."""
    with source.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 16, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="taccorl tests")
        for name, record in (metadata or {}).items():
            writer.add_metadata(name, record)
        channels = {}
        for c in sorted(summary.channels.values(), key=lambda c: c.id):
            schema = summary.schemas[c.schema_id]
            named = writer.register_schema(
                (types or {}).get(c.topic, schema.name), schema.encoding, schema.data
            )
            channels[c.topic] = writer.register_channel(
                c.topic, c.message_encoding, named
            )
        for raw in change(read_raw(source)):
            writer.add_message(
                channels[raw.topic], raw.log_ns, raw.data, publish_time=raw.log_ns
            )
        writer.finish()
    return path


def garbled(path: Path, new: Path, broken: Iterable[int]) -> Path:
    """The front camera's pictures with these numbers are no pictures; the file itself is whole."""

    def garble(messages: list[Raw]) -> Iterable[Raw]:
        seen = itertools.count()
        for m in messages:
            is_broken = m.topic == CAMERA_TOPICS["front"] and next(seen) in broken
            yield (
                replace(m, data=m.data.replace(b"\xff\xd8\xff", b"\0\0\0"))
                if is_broken
                else m
            )

    return rewrite(path, new, garble)


def marker(at_s: float, text: str) -> Raw:
    """A std_msgs/String on the episode topic, as CDR: its length with the closing zero, its bytes."""
    data = text.encode() + b"\0"
    cdr = b"\x00\x01\x00\x00" + struct.pack("<I", len(data)) + data
    return Raw(
        EPISODE_TOPIC, "std_msgs/msg/String", START_UNIX_NS + round(at_s * 1e9), cdr
    )


def with_markers(
    source: Path, path: Path, markers: Iterable[tuple[float, str]]
) -> Path:
    """``source`` with other texts on its episode topic."""
    new = [marker(at_s, text) for at_s, text in markers]
    return rewrite(
        source,
        path,
        lambda messages: [m for m in messages if m.topic != EPISODE_TOPIC] + new,
    )


def changed_specs(
    folder: Path, *changes: tuple[str, str], spec: str = "piper_flexitac_mcap"
) -> Path:
    """A copy of the shipped specs with texts replaced wherever they stand; each must stand somewhere. The spec's path."""
    shutil.copytree(data_specs_folder(), folder, dirs_exist_ok=True)
    unmet = set(changes)
    for path in folder.rglob("*.yaml"):
        text = path.read_text()
        for old, new in changes:
            if old in text:
                text = text.replace(old, new)
                unmet.discard((old, new))
        path.write_text(text)
    assert not unmet, f"stands nowhere: {unmet}"
    return folder / "recordings" / f"{spec}.yaml"
