"""Errors that a user meets. Each message names the thing, the value, the place and the way out."""

import difflib
import errno
from collections.abc import Iterable
from pathlib import Path

DISK_FAULTS = {
    errno.ENOSPC: "no space left",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "a file larger than this user may write (ulimit -f)",
    errno.EROFS: "the disk is read-only",
}
"""Operating system's errors that mean that nothing more can be written: number → text. Whatever they meet stops at once."""


class TaccorlError(Exception):
    """An error in the user's input. Commands show it as one line, without a traceback."""


class SpecError(TaccorlError):
    """An invalid data spec: unknown key, missing field, wrong type."""


class RecordingError(TaccorlError):
    """A recording that cannot be read or does not contain what its spec states."""


class DatasetError(TaccorlError):
    """A dataset that is incomplete or of another kind, or a destination that is occupied."""


class InTheWayError(DatasetError):
    """The destination of a dataset is occupied by something else, which was not changed."""


class UnreachableError(TaccorlError):
    """A pose that no joint angles of an arm reach."""


class LostError(TaccorlError):
    """A state from which an expert cannot complete its task. Messages contain no numbers, so that equal ones can be counted."""


class DeadlockError(TaccorlError):
    """Both arms wait for each other, so that neither may move."""


def printable(text: object) -> str:
    """``value`` as text with control characters (escape sequences, line breaks) escaped, such as ``\\x1b``."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text)
    )


def plain_name(name: str, place: str) -> str:
    """``name``, of a joint or another part, as a user's file has it.

    Args:
        place: file, line and key, for the message.

    Raises:
        SpecError: it is blank, or has control characters, which steer a terminal, or marks of HTML.
    """
    if not name.strip():
        raise SpecError(f"{place}: the name is blank; write one")
    for c in name:
        if not c.isprintable() or c in "<>&":
            raise SpecError(
                f"{place}: the name {printable(name)[:80]!r} has the character {printable(c)!r}; names are of letters, digits "
                "and signs other than <, > and &"
            )
    return name


def no_such_path(path: Path, what: str = "file or folder") -> str:
    """Text for a path at which there is nothing: where its link leads, or the nearest name beside it."""
    if path.is_symlink():
        return f"{path}: no such {what}: it is a link to {path.readlink()}"
    if not path.parent.is_dir():
        return f"{path}: no such {what}: there is no folder {path.parent}"
    siblings = [
        p.name
        for p in path.parent.iterdir()
        if p.name[0] != "." and (p.is_dir() or "file" in what)
    ]
    return f"{path}: no such {what}; {nearest(path.name, siblings, most=10)}"


def nearest(name: str, known: Iterable[str], most: int = 60) -> str:
    """`` did you mean 'x'? `` for the closest known name, else the known names, ``most`` of them; ends without a full stop."""
    names = sorted(str(k) for k in known)
    close = difflib.get_close_matches(str(name), names, n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return f"known: {', '.join(names[:most]) if names else 'none'}{rest}"
