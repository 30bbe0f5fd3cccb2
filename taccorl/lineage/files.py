"""Files that survive a power cut, files that share their blocks with another, and the text of who holds a lock."""

import fcntl
import os
import shlex
import shutil
import socket
import sys
import time
from pathlib import Path

_FICLONE = 0x40049409  # fcntl.FICLONE, which only Linux's Python has


def write_durably(path: Path, text: str) -> None:
    """Write an ASCII file with one atomic rename; when the function returns, it survives a power cut. Its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}-{os.urandom(4).hex()}.new")
    with unfinished.open("w", encoding="ascii") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)


def clone_or_link(source: Path, path: Path) -> bool:
    """Replace the file ``path`` by a clone of ``source``, which has the same content, else by a hard link to it if ``source`` has
    no other name yet. Returns False, and changes nothing, where the file system can do neither."""
    new = path.with_name(f".{path.name}.shared")
    try:
        with source.open("rb") as old, new.open("wb") as clone:
            fcntl.ioctl(clone, _FICLONE, old.fileno())
        shutil.copymode(path, new)
    except OSError:  # not a file system that clones, or another one
        new.unlink(missing_ok=True)
        try:
            if source.stat().st_nlink > 1:
                return False
            new.hardlink_to(source)
        except OSError:  # another file system, or one without links
            return False
    new.replace(path)
    return True


def this_process() -> str:
    """Text by which a lock names its holder to those who wait for it: process, machine, time and command."""
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return f"process {os.getpid()} on {socket.gethostname()} since {time.strftime('%H:%M:%S')} ({command[:200]})"


def flush(path: Path) -> None:
    """Bring a file or a folder (POSIX: the same call) to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
