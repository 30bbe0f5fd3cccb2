"""One command at a time writes to a place: a lock for what ``--out`` names, held until the command ends.

The lock is a file beside the place, ``.NAME.lock``, which is removed when the command ends. A second command waits, as those with
a store do, and then finds what the first one made: it goes on from there, finds the same result, or refuses to overwrite it.
"""

import contextlib
import hashlib
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from taccorl.errors import DatasetError

if TYPE_CHECKING:
    from filelock import FileLock

_held: "dict[Path, FileLock] | None" = None
"""Lock file → its lock, of the command that runs; None outside of a command."""


@contextlib.contextmanager
def released_at_the_end() -> Iterator[None]:
    """Context of one command: what it locks by ``hold`` is released when it ends, however it does."""
    global _held
    before, _held = _held, {}
    try:
        yield
    finally:
        for path, lock in _held.items():
            with contextlib.suppress(OSError):
                path.unlink()  # while it is held: filelock sees that it is gone, and makes another one for who waits
            lock.release()
        _held = before


def hold(out: Path) -> None:
    """Lock the place ``out`` for the command that runs; wait while another command has it. Nothing is locked outside of a
    command, or in a folder in which nothing can be written."""
    for path in lock_files(out):
        if _held is not None and path not in _held:
            _acquire(path, out)


def _acquire(path: Path, out: Path) -> None:
    from filelock import FileLock, Timeout

    from taccorl.lineage.files import this_process

    assert _held is not None
    lock = FileLock(path, fallback_to_soft=False)
    try:
        path.touch()  # where that fails, filelock would try for ever
        lock.acquire(timeout=0)
    except Timeout:
        by = "another process"
        with contextlib.suppress(OSError):  # it may have ended meanwhile
            by = path.read_text("utf-8", "replace") or by
        print(
            f"waiting for --out={out}, held by {by}; Ctrl-C ends this run",
            file=sys.stderr,
            flush=True,
        )
        lock.acquire()
    except OSError:  # what writes there says so; or a file system without locks
        return
    path.write_text(this_process(), encoding="utf-8")
    _held[path] = lock


def check_apart(out: Path, places: Iterable[tuple[str, Path]]) -> None:
    """Raises DatasetError: ``out`` cannot be a dataset's folder, or it and one of ``places`` (option, path) contain one
    another: writing would change what is being read."""
    from taccorl.data.lerobot_format import check_path
    from taccorl.extras import require

    require("lerobot")
    check_path(out)
    whole = out.resolve()
    for option, place in places:
        other = place.resolve()
        if whole.is_relative_to(other) or other.is_relative_to(whole):
            raise DatasetError(
                f"--out={out} and {option}={place} contain one another: choose another --out"
            )


def lock_files(out: Path) -> list[Path]:
    """Lock files of a place, in the order in which they are locked; the last one is its own. Symbolic links are resolved.

    The own one lies beside the place, or in the nearest folder above that exists. A command that creates the folders between
    moves that spot down, but keeps its lock further up: such locks come first."""
    # Unlike Path.resolve, it does not raise for links that form a loop.
    place = Path(os.path.realpath(out))
    parents = [parent for parent in place.parents if parent.is_dir()]
    early = f".{hashlib.sha256(os.fsencode(place)).hexdigest()[:16]}.lock"
    own = f".{place.name}.lock" if place.parent in parents else early
    above = [folder / early for folder in parents if (folder / early).exists()]
    return [*(path for path in above if path != parents[0] / own), parents[0] / own]
