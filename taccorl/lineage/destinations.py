"""Places of results: whether a path is free, new files, and the record of the paths to which a store published artefacts, one
small file each, so that `prune` knows which datasets exist."""

import json
import os
import tempfile
from pathlib import Path

from taccorl.errors import TaccorlError
from taccorl.lineage.digest import digest_bytes
from taccorl.lineage.files import write_durably
from taccorl.lineage.manifest import read_manifest


def is_free(path: Path) -> bool:
    """True if nothing is at ``path``, or an empty folder."""
    return not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir()))


def check_writable(folder: Path, option: str = "--out") -> None:
    """Check, before long work, that the folder of an ``option`` can be made or written. Raises TaccorlError: the folder, or the
    nearest one above it that exists, cannot be written to."""
    above = next(p for p in (folder, *folder.absolute().parents) if os.path.lexists(p))
    if not above.is_dir():
        raise TaccorlError(
            f"{option}={folder}: {above} is not a folder: give another folder"
        )
    try:
        tempfile.TemporaryFile(dir=above).close()
    except OSError as error:
        raise TaccorlError(
            f"{option}={folder}: {above} cannot be written to: give another folder"
        ) from error


def write_new(path: Path, text: str) -> None:
    """Write a text file that must not exist; if that fails, for example on a full disk, nothing remains of it. Raises OSError:
    it exists (``FileExistsError``), or cannot be written."""
    file = path.open("x", encoding="utf-8")
    try:
        with file:
            file.write(text)
    except OSError:
        path.unlink()
        raise


class Destinations:
    """Record of the paths outside a store to which it published, each with the key of the artefact published there last."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def remember(self, path: Path, key: str) -> None:
        """Record, with one atomic rename, that the artefact of ``key`` is or will be published at ``path``."""
        note = self.folder / f"{digest_bytes(os.fsencode(path))[:32]}.json"
        content = json.dumps({"path": str(path), "key": key}) + "\n"
        if not note.is_file() or note.read_text(encoding="ascii") != content:
            write_durably(note, content)

    def present(self) -> list[Path]:
        """Paths that still contain the artefact that was published there."""
        return [
            path for path, key in self._notes() if read_manifest(path).get("key") == key
        ]

    def gone(self) -> list[Path]:
        """Paths whose content was removed, moved or replaced."""
        return [
            path for path, key in self._notes() if read_manifest(path).get("key") != key
        ]

    def _notes(self) -> list[tuple[Path, str]]:
        notes = [json.loads(note.read_bytes()) for note in self.folder.glob("*.json")]
        return sorted((Path(note["path"]), note["key"]) for note in notes)
