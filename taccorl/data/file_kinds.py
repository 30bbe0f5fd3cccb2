"""Recognise kinds of files by their first bytes; for archives and Git LFS pointers, name the command that gives the file."""

import shlex
from pathlib import Path
from typing import NamedTuple


class FileKind(NamedTuple):
    """A kind of file, recognised by its first bytes."""

    name: str
    """Name with its article, such as ``an MCAP file``, for messages."""
    magic: bytes
    """Bytes that such a file holds at ``offset``."""
    offset: int = 0
    reader: str | None = None
    """Name of the reader that opens such a file; None if it is not a recording."""
    command: str = ""
    """Shell command that produces the wanted file; {path} and {folder} stand for this file and its folder."""


FILE_KINDS = (
    FileKind("an HDF5 file", b"\x89HDF\r\n\x1a\n", reader="hdf5"),
    FileKind("an SQLite bag", b"SQLite format 3\0", reader="db3"),
    FileKind("an MCAP file", b"\x89MCAP0\r\n", reader="mcap"),
    FileKind("a ROS 1 bag", b"#ROSBAG V", reader="rosbag1"),
    FileKind("a JPEG picture", b"\xff\xd8\xff"),
    FileKind("a PNG picture", b"\x89PNG\r\n"),
    FileKind("a Git LFS pointer", b"version https://git-lfs.github.com/spec/", command="git -C {folder} lfs pull"),
    FileKind("a ZIP archive", b"PK\x03\x04", command="unzip {path} -d {folder}"),
    FileKind("a gzip archive", b"\x1f\x8b", command="gunzip --keep {path}"),
    FileKind("a zstd archive", b"\x28\xb5\x2f\xfd", command="unzstd {path}"),
    FileKind("a tar archive", b"ustar", 257, command="tar -xf {path} -C {folder}"),
)
"""Known kinds of files, in the order in which they are tried."""
_HEAD_BYTES = max(kind.offset + len(kind.magic) for kind in FILE_KINDS)


def sniff(path: Path) -> FileKind | None:
    """Kind of a file by its first bytes; None if they are unknown or ``path`` is no file."""
    if not path.is_file():  # a pipe would wait for ever
        return None
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return None
    return next((kind for kind in FILE_KINDS if head.startswith(kind.magic, kind.offset)), None)


def no_recording(path: Path) -> str | None:
    """Description of a file that no reader opens (archive, LFS pointer …), with the command that helps; None for any other
    file."""
    kind = sniff(path)
    if kind is None or kind.reader is not None:
        return None
    command = kind.command.format(path=shlex.quote(str(path)), folder=shlex.quote(str(path.parent)))
    return f"{kind.name}, no recording" + (f"; this gives the file: {command}" if command else "")
