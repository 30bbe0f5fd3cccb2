"""One command at a time writes to a place: a lock for what ``--out`` names, held until the command ends.

The lock is a file beside the place, ``.NAME.lock``, which is removed when the command ends. A second command waits, as those with
a store do, and then finds what the first one made: it goes on from there, finds the same result, or refuses to overwrite it.
"""

import contextlib
import fcntl
import hashlib
import os
import shlex
import socket
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from taccorl.errors import DatasetError

_held: dict[Path, int] | None = None
"""Lock file → its descriptor, of the command that runs; None outside of a command."""


@contextlib.contextmanager
def released_at_the_end() -> Iterator[None]:
    """Context of one command: what it locks by ``hold`` is released when it ends, however it does."""
    global _held
    before, _held = _held, {}
    try:
        yield
    finally:
        for lock, descriptor in _held.items():
            with contextlib.suppress(OSError):
                lock.unlink()  # while it is held: who waits for it sees that it is gone, and makes another one
            os.close(descriptor)
        _held = before


def hold(out: Path) -> None:
    """Lock the place ``out`` for the command that runs; wait while another command has it. Nothing is locked outside of a
    command, or in a folder in which nothing can be written."""
    lock = lock_file(out)
    if _held is None or lock in _held:
        return
    waited = False
    while True:
        try:
            descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        except OSError:
            return  # what writes there says so
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if not waited:
                by = os.pread(descriptor, 1000, 0).decode("utf-8", "replace") or "another process"
                print(f"waiting for --out={out}, held by {by}; Ctrl-C ends this run", file=sys.stderr, flush=True)
                waited = True
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            except BaseException:
                os.close(descriptor)
                raise
        except OSError:  # a file system without locks
            os.close(descriptor)
            return
        if _is_there(lock, descriptor):
            break
        os.close(descriptor)
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, _this_process().encode(), 0)
    _held[lock] = descriptor


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
            raise DatasetError(f"--out={out} and {option}={place} contain one another: choose another --out")


def lock_file(out: Path) -> Path:
    """Lock file of a place: beside it, or in the nearest folder above that exists."""
    whole = out.absolute()
    folder = next((parent for parent in whole.parents if parent.is_dir()), whole.parent).resolve()
    if folder == whole.parent.resolve():
        return folder / f".{whole.name}.lock"
    return folder / f".{hashlib.sha256(str(whole).encode()).hexdigest()[:16]}.lock"


def _is_there(lock: Path, descriptor: int) -> bool:
    """Whether the file that was locked is still the one of that name."""
    try:
        return os.path.samestat(lock.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _this_process() -> str:
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return f"process {os.getpid()} on {socket.gethostname()} since {time.strftime('%H:%M:%S')} ({command[:200]})"
