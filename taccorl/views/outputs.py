"""Output files of views: each contains its origin, and no file of the user is overwritten."""

import contextlib
import os
import shlex
from collections.abc import Iterator
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from taccorl.errors import DISK_FAULTS, TaccorlError

SOFTWARE = "taccorl view"
APPLICATION = "taccorl_episode"
"""Rerun's application id of taccorl's files; the viewer keeps one blueprint per id."""
RRD_MAGIC = b"RRF2"
HEAD_BYTES = 1024
"""Number of first bytes of an .rrd that are read: its first message names the application."""


class OutputError(TaccorlError):
    """Error: the output file exists and was not written by taccorl, or the disk is full."""


def check_free(path: Path) -> None:
    """Check that ``path`` may be written: it does not exist, or taccorl wrote it. Raises OutputError: another file is there, or
    the folder does not exist."""
    if not path.parent.is_dir():
        raise OutputError(
            f"{path.parent}: no such folder; make it first: mkdir -p {shlex.quote(str(path.parent))}"
        )
    if path.exists() and not _is_ours(path):
        raise OutputError(
            f"{path}: exists and was not written by `{SOFTWARE}`; give another name, or remove it"
        )


def _is_ours(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    if head.startswith(RRD_MAGIC):
        return APPLICATION.encode() in head
    try:
        with Image.open(path) as image:
            return image.info.get("Software") == SOFTWARE
    except OSError:
        return False


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Context manager that gives a temporary path beside ``path`` for writing. At the end the file replaces ``path``
    atomically, or is removed after an error. Raises OutputError: the disk is full, or the file is larger than allowed."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    except OSError as error:
        if error.errno not in DISK_FAULTS:
            raise
        place = path if error.filename in (None, str(part)) else error.filename
        kept = "; the earlier file is as it was" if path.exists() else ""
        raise OutputError(
            f"{place}: not written: {error.strerror}{kept}. Make room, or give another place"
        ) from error
    finally:
        part.unlink(missing_ok=True)


def save_png(image: Image.Image, path: Path, name: str, origin: str) -> None:
    """Write a PNG whose metadata hold the name and the origin of the data that it shows."""
    check_free(path)
    note = PngInfo()
    note.add_text("Software", SOFTWARE)
    note.add_itxt("Title", name)
    note.add_itxt("Source", origin)
    with replacing(path) as part:
        image.save(part, "PNG", pnginfo=note)
