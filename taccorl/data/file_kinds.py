"""Recognise kinds of files by their first bytes; for archives and Git LFS pointers, name the command that gives the file."""

import contextlib
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from taccorl.errors import DatasetError
from taccorl.extras import raised

_UNREADABLE = (OSError, ValueError, IndexError, RecursionError)


class FileKind(NamedTuple):
    """A kind of file: name with its article, the bytes that it holds at ``offset``, the reader that opens it (None: it is no
    recording), and the shell command that gives the wanted file."""

    name: str
    magic: bytes
    reader: str | None = None
    command: str = ""
    offset: int = 0


FILE_KINDS = (
    FileKind("an HDF5 file", b"\x89HDF\r\n\x1a\n", "hdf5"),
    FileKind("an SQLite bag", b"SQLite format 3\0", "db3"),
    FileKind("an MCAP file", b"\x89MCAP0\r\n", "mcap"),
    FileKind("a ROS 1 bag", b"#ROSBAG V", "rosbag1"),
    FileKind("a JPEG picture", b"\xff\xd8\xff"),
    FileKind("a PNG picture", b"\x89PNG\r\n"),
    FileKind(
        "a Git LFS pointer",
        b"version https://git-lfs.github.com/spec/",
        command="git -C {folder} lfs pull",
    ),
    FileKind("a ZIP archive", b"PK\x03\x04", command="unzip {path} -d {folder}"),
    FileKind("a gzip archive", b"\x1f\x8b", command="gunzip --keep {path}"),
    FileKind("a zstd archive", b"\x28\xb5\x2f\xfd", command="unzstd {path}"),
    FileKind(
        "a tar archive", b"ustar", command="tar -xf {path} -C {folder}", offset=257
    ),
)


def sniff(path: Path) -> FileKind | None:
    """Kind of a file by its first bytes; None if they are unknown or ``path`` is no file."""
    head = b""
    if path.is_file():  # a pipe would wait for ever
        with contextlib.suppress(OSError), path.open("rb") as file:
            head = file.read(512)
    return next(
        (kind for kind in FILE_KINDS if head.startswith(kind.magic, kind.offset)), None
    )


def no_recording(path: Path) -> str | None:
    """Description of a file that no reader opens (archive, LFS pointer …), with the command that helps; None for others."""
    kind = sniff(path)
    if kind is None or kind.reader is not None:
        return None
    command = kind.command.format(
        path=shlex.quote(str(path)), folder=shlex.quote(str(path.parent))
    )
    return f"{kind.name}, no recording" + (
        f"; this gives the file: {command}" if command else ""
    )


@contextlib.contextmanager
def plainly(path: Path, what: str) -> Iterator[None]:
    """Raise errors of libraries about ``path`` as a DatasetError in plain words."""
    try:
        yield
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: is missing: copy the whole dataset") from error
    except (
        *_UNREADABLE,
        *raised("av.error.FFmpegError"),
        *raised("pyarrow.lib.ArrowException"),
    ) as error:
        known = (
            no_recording(path)
            or f"is not {what} ({type(error).__name__}: {' '.join(str(error).split())})"
        )
        raise DatasetError(f"{path}: {known}") from error
