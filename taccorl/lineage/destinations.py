"""Record of the paths to which a store published artefacts, one small file each, so that `prune` knows which datasets exist."""

import json
import os
from pathlib import Path

from taccorl.lineage.digest import digest_bytes
from taccorl.lineage.manifest import read_manifest


def is_free(path: Path) -> bool:
    """True if nothing is at ``path``, or an empty folder."""
    return not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir()))


class Destinations:
    """Record of the paths outside a store to which it published, each with the key of the artefact published there last."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def remember(self, path: Path, key: str) -> None:
        """Record, with one atomic rename, that the artefact of ``key`` is or will be published at ``path``."""
        note = self.folder / f"{digest_bytes(os.fsencode(path))[:32]}.json"
        content = json.dumps({"path": str(path), "key": key}) + "\n"
        if note.is_file() and note.read_text(encoding="ascii") == content:
            return
        self.folder.mkdir(exist_ok=True)
        temp = note.with_name(f"{note.name}.{os.getpid()}-{os.urandom(4).hex()}")
        with temp.open("w", encoding="ascii") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temp.replace(note)

    def present(self) -> list[Path]:
        """Destinations that still contain the published artefact."""
        return [path for path, key in self._notes() if read_manifest(path).get("key") == key]

    def gone(self) -> list[Path]:
        """Destinations whose content was removed, moved or replaced."""
        return [path for path, key in self._notes() if read_manifest(path).get("key") != key]

    def _notes(self) -> list[tuple[Path, str]]:
        notes = [json.loads(note.read_bytes()) for note in self.folder.glob("*.json")]
        return sorted((Path(note["path"]), note["key"]) for note in notes)
