"""SHA-256 digests of bytes, files and folders, with a cache so that an unchanged recording is read once.

A folder's digest is the digest of its sorted relative paths and their contents: no times, no permissions, no empty
folders. Files and folders whose name starts with a dot are left out of a *source* folder: tools and desktops drop them
there (``.DS_Store``, ``.cache``), and they are no data. What a stage wrote is digested whole, dot or not.
A link to a file counts as the file; a link to a folder is refused.
"""

import contextlib
import hashlib
import json
import os
import stat
import time
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

from taccorl.lineage.errors import LineageError

READERS = 4
"""Number of threads that compute digests of files; each reads one file at a time."""
FRESH_S = 2.0  # a file touched less than this ago may change again without its times showing it: not cached


def digest_bytes(*parts: bytes) -> str:
    """SHA-256 of the parts, 64 hexadecimal digits; each part counts with its length, so that ("ab", "c") and ("a", "bc")
    differ."""
    sha = hashlib.sha256()
    for part in parts:
        sha.update(len(part).to_bytes(8, "little"))
        sha.update(part)
    return sha.hexdigest()


def digest_files(files: Mapping[str, str]) -> str:
    """The digest of a folder, 64 hexadecimal digits, given ``{relative path: digest of the file}``."""
    return digest_bytes(json.dumps(dict(sorted(files.items()))).encode())


class DigestCache:
    """Digests of files by path, valid while size, times and inode are unchanged.

    Each entry is one small file, renamed into place, so that processes need no lock and lose no entries. While the parent of
    ``folder`` does not exist, entries are kept in memory, so that a rejected command creates no store."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._kept: dict[Path, str] = {}

    def get(self, path: Path, stamp: list[int]) -> str | None:
        """The digest of ``path``, if it was recorded with the same ``stamp`` (as from `stamp`); else None."""
        file = self._entry(path)
        try:
            entry = json.loads(
                self._kept[file] if file in self._kept else file.read_text()
            )
            return entry["digest"] if entry["stamp"] == stamp else None
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
        ):  # absent, or torn by a power cut: read the file again
            return None

    def put(self, path: Path, stamp: list[int], digest: str) -> None:
        """Store ``digest`` for a path and its ``stamp``."""
        self._kept[self._entry(path)] = json.dumps(
            {"path": os.fsdecode(path), "stamp": stamp, "digest": digest}
        )
        if self.folder.parent.is_dir():
            self.write_kept()

    def write_kept(self) -> None:
        """Write the entries that exist only in memory."""
        while self._kept:
            with contextlib.suppress(KeyError):  # another thread writes them, too
                entry, text = self._kept.popitem()
                entry.parent.mkdir(parents=True, exist_ok=True)
                temp = entry.with_name(
                    f"{entry.name}.{os.getpid()}-{os.urandom(4).hex()}"
                )
                temp.write_text(text)
                temp.replace(entry)

    def _entry(self, path: Path) -> Path:
        name = digest_bytes(os.fsencode(path))[:32]
        return self.folder / name[:2] / f"{name}.json"


def digest_file(path: Path, cache: DigestCache | None = None) -> str:
    """SHA-256 of a file's content, 64 hexadecimal digits; with a ``cache`` the file is read only if it changed. Raises
    LineageError: ``path`` is no regular file, or changes while it is read."""
    path = Path(path).absolute()
    before = stamp(path)
    if cache is not None and (known := cache.get(path, before)) is not None:
        return known
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if stamp(path) != before:
        raise LineageError(
            f"{path} changed while it was read. Is it still being recorded? Run again when it is complete."
        )
    if cache is not None and is_settled(before):
        cache.put(path, before, digest)
    return digest


def is_settled(stamp: list[int]) -> bool:
    """Whether a file with this ``stamp`` was touched more than ``FRESH_S`` ago, so that a later change alters the stamp."""
    return abs(time.time() - stamp[2] / 1e9) > FRESH_S


def stamp(path: Path) -> list[int]:
    """[size in bytes, modification time in ns, change time in ns (which ``touch -d`` cannot set back), inode] of a file. Raises
    LineageError: ``path`` does not exist, or is no regular file."""
    try:
        info = path.stat()
    except FileNotFoundError:
        raise LineageError(
            f"{path} does not exist" + (" (a broken link)" if path.is_symlink() else "")
        ) from None
    if not stat.S_ISREG(info.st_mode):
        raise LineageError(
            f"{path} is not a regular file, so that it has no content to digest. Give a file, or a folder of files."
        )
    return [info.st_size, info.st_mtime_ns, info.st_ctime_ns, info.st_ino]


def list_files(
    folder: Path, *, hidden: bool = False, also: Collection[str] = ()
) -> dict[str, Path]:
    """Files below ``folder``: relative posix path → path, sorted. Hidden files are included if ``hidden``, or if their relative
    paths are in ``also``. Raises LineageError: a folder cannot be read, or is a link."""
    found: dict[str, Path] = {}
    shown = {
        path.as_posix()
        for name in map(PurePosixPath, also)
        for path in (name, *name.parents)
    }
    for where, folders, names in os.walk(folder, onerror=_cannot_read):
        base = Path(where).relative_to(folder)
        wanted = {n: (base / n).as_posix() for n in (*folders, *names)}
        wanted = {
            n: rel
            for n, rel in wanted.items()
            if hidden or not n.startswith(".") or rel in shown
        }
        folders[:] = [n for n in folders if n in wanted]
        for name in folders:
            if Path(where, name).is_symlink():
                raise LineageError(
                    f"{Path(where, name)} is a link to a folder, whose content could change unnoticed. Give the folder itself "
                    f"({Path(where, name).resolve()}), or copy it."
                )
        found |= {wanted[n]: Path(where, n) for n in names if n in wanted}
    return dict(sorted(found.items()))


def _cannot_read(error: OSError) -> None:
    raise LineageError(f"{error.filename}: {error.strerror}") from error


def digest_each(
    folder: Path,
    cache: DigestCache | None = None,
    *,
    hidden: bool = False,
    also: Collection[str] = (),
) -> dict[str, str]:
    """``{relative path: digest}`` of the files below ``folder``; ``hidden`` and ``also`` choose them as in `list_files`."""
    files = list_files(folder, hidden=hidden, also=also)
    with ThreadPoolExecutor(READERS) as pool:  # hashing lets other threads run
        return dict(
            zip(
                files,
                pool.map(lambda path: digest_file(path, cache), files.values()),
                strict=True,
            )
        )
