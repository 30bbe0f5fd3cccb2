"""Errors that a user meets. Each message names the thing, the value, the place and the way out."""

import difflib
from collections.abc import Iterable


class TaccorlError(Exception):
    """Anything that is the input's fault, not the program's: shown as one line, never as a traceback."""


class SpecError(TaccorlError):
    """A data spec that cannot be obeyed: unknown key, missing field, wrong type."""


class RecordingError(TaccorlError):
    """A recording that cannot be read or does not hold what its spec promises."""


class DatasetError(TaccorlError):
    """A dataset that is incomplete, of another kind, or in the way."""


class InTheWayError(DatasetError):
    """Something else lies where a dataset is to be; it was not touched."""


class UnreachableError(TaccorlError):
    """A pose that no joint angles of an arm reach."""


class LostError(TaccorlError):
    """A state from which an expert cannot complete its task. Messages have no numbers: they are counted."""


def printable(text: object) -> str:
    """Its text with every character that a terminal would obey or hide (escape sequences, line breaks) written out: ``\\x1b``."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


_MOST_NAMES = 60  # all effects fit, the files of a large folder do not


def nearest(name: str, known: Iterable[str]) -> str:
    """`` did you mean 'x'? `` for the closest known name, else the known names, at most 60; ends without a full stop."""
    names = sorted(str(k) for k in known)
    close = difflib.get_close_matches(str(name), names, n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    rest = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"known: {', '.join(names[:_MOST_NAMES]) if names else 'none'}{rest}"
