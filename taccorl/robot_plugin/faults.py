"""The gate between drivers and the guard: what passes is finite and of its shape, all
else is a fault with a text. Also: frames that repeat, and closing of several parts."""

import math
import zlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from taccorl.errors import TaccorlError, printable

_CYCLE = 8  # different frames that may alternate and still count as one
_SURE = 25.0
"""Taxels are stuck if by chance they would stand still with probability e⁻²⁵ or less: of 44
lines at 100 Hz one in half a year."""
_LONGEST_TEXT = 40  # characters of a value that an error shows


class Unfit(TaccorlError):
    """A value that must not be used: not finite, of another shape or type, or a time
    that is impossible."""


def number(what: str, value: Any) -> float:
    """``value`` as a float: a Python number, or an array or tensor of one element.
    Raises Unfit: it is something else, or not finite."""
    try:
        item = value.item() if hasattr(value, "item") else value
        is_number = isinstance(item, int | float) and not isinstance(item, bool)
        found = float(item) if is_number else math.nan
    except Exception:  # of a foreign type; 10**400 is too large for a float
        found = math.nan
    if not math.isfinite(found):
        text = printable(value)[:_LONGEST_TEXT]
        raise Unfit(f"{what} is {text}, which is no finite number")
    return found


def vector(what: str, values: Any, names: Sequence[str]) -> np.ndarray:
    """(A,) float64 copy of ``values``, one for each of ``names``. Raises Unfit: they
    are no numbers, another number of them, or not finite."""
    try:
        found = np.array(values)
    except Exception as error:  # lists of several lengths, foreign types
        raise Unfit(f"{what}: {described(error)}") from error
    if found.dtype.kind not in "iuf":
        raise Unfit(f"{what}: of type {found.dtype}, not numbers")
    if found.shape != (len(names),):
        raise Unfit(f"{what}: of shape {found.shape}, not {(len(names),)}")
    with np.errstate(over="ignore"):
        found = found.astype(np.float64)
    if not (finite := np.isfinite(found)).all():
        k = int(np.argmin(finite))
        raise Unfit(f"{what} of {names[k]} is {found[k]}, which is not finite")
    return found


def positive(option: str, value: Any) -> float:
    """``value`` of an option as a float. Raises TaccorlError: it is not finite, or not
    above 0."""
    if not (found := number(option, value)) > 0:
        raise TaccorlError(f"{option}={found:g}: must be above 0")
    return found


def described(error: BaseException) -> str:
    """Text of an exception with its type, which says more where the text is short."""
    kind = type(error).__name__
    if isinstance(error, TaccorlError):
        return str(error)
    return f"{printable(error)} ({kind})" if str(error) else kind


def close_all(parts: Mapping[str, Callable[[], object]]) -> list[str]:
    """Call every function, also after one has failed; returns what failed and why."""
    failures = []
    for name, close in parts.items():
        try:
            close()
        except BaseException as error:  # Ctrl-C, too: the other parts are closed first
            failures.append(f"{name}: {described(error)}")
    return failures


def stuck_taxels(unchanged: np.ndarray) -> int:
    """Number of taxels in rows and columns of a pad that stand still while others do not.

    Args:
        unchanged: (rows, columns) bool: the taxel gave one number for some frames.

    Returns: 0 if no row or column stands still, if all do, or if that may be chance: of N
    taxels c have changed, and with equal chances none of these c lies in n given ones with
    probability C(N − n, c) / C(N, c); the lines were not given, any of that number would do.
    """
    rows, columns = np.all(unchanged, axis=1), np.all(unchanged, axis=0)
    lines = np.logical_or.outer(rows, columns)
    num, count, changed = unchanged.size, int(lines.sum()), int((~unchanged).sum())
    if not count or not changed:
        return 0
    of_given = math.comb(num - count, changed) / math.comb(num, changed)
    if of_given == 0.0:  # below the smallest float
        return count
    ways = math.comb(len(rows), int(rows.sum()))
    ways *= math.comb(len(columns), int(columns.sum()))
    return count if -math.log(of_given) - math.log(ways) > _SURE else 0


class Repeats:
    """Recognises frames of one sensor that were there before. The noise of a sensor is
    never twice the same, so a frame that comes again, alone or in turn with a few
    others, is one that something has stored."""

    def __init__(self) -> None:
        self._known: deque[int] = deque(maxlen=_CYCLE)

    def is_new(self, frame: np.ndarray) -> bool:
        """True if ``frame`` is none of the last different ones; it is then one."""
        digest = zlib.crc32(np.ascontiguousarray(frame))
        if digest in self._known:
            return False
        self._known.append(digest)
        return True
