"""Registers of drives whose numbers state a sign, and columns of a table in which such
numbers were logged without it.

A driver that reads a register of B bits as an unsigned number, H = 2ᴮ⁻¹, logs −9 as

    sign and magnitude, sign bit H    H + 9     Feetech and STS: H = 2¹⁰ (load) or 2¹⁵
    two's complement                  2 H − 9   Dynamixel and others: 2 H = 2¹⁶ or 2³²
    offset binary                     H − 9     analogue converters: H = 2¹¹, 2¹⁵

with numbers 0 … 2 H − 1, B from 8 to 64. H is in the column's own numbers: of a
register that the logger multiplied by 0.1 it is 102.4 for 2¹⁰. A logger that multiplied
by a negative number gives the same numbers below 0.

Where the quantity passes through 0, a column of the first two kinds jumps by nearly H
or 2 H, and the decoded one by no more than between other rows. Offset binary never
jumps: the law of the drive or its limit tell it (``alignment.checks.robot``).
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from taccorl.alignment.measurements.quantisation import find_quantum

LEAST_BITS, MOST_BITS = 8, 64  # Widths of registers that are looked for
CONTINUES, NEARLY = 1.5, 0.05
"""At a change of sign the decoded column moves at most so many times as far as between other rows, or by this share of the
least number that means a value below 0. Choices."""
LEAST_CHANGES = (
    2  # Changes of sign that must be seen: one jump may be a motor that is turned on
)
Key = Literal["sign_bit", "wraps_at", "zero"]


@dataclass(frozen=True)
class Layout:
    """How a register of half range H states a sign."""

    words: str  # The kind, for a message; {} is the value of the key
    value: int  # Value of the key of a columns file, in H
    decode: Callable[[np.ndarray, float], np.ndarray]
    """Function of (numbers (T,) from 0 on, H) that returns the signed numbers (T,)."""


LAYOUTS: Mapping[Key, Layout] = {
    "sign_bit": Layout(
        "sign and magnitude, {} is the sign bit",
        1,
        lambda n, half: np.where(n < half, n, half - n),
    ),
    "wraps_at": Layout(
        "two's complement, {} is one more than the largest number",
        2,
        lambda n, half: np.where(n < half, n, n - 2 * half),
    ),
    "zero": Layout("offset binary, {} is 0", 1, lambda n, half: n - half),
}
"""Key of a columns file → the layout that it reads."""


@dataclass(frozen=True)
class Register:
    """How the numbers of a register state a sign."""

    key: Key
    """Layout, and key of a columns file."""
    value: float
    """Weight of the sign bit, number of values of the register, or its number at 0, in
    the column's numbers; above 0 also where these lie below."""

    @property
    def least_negative(self) -> float:
        """H: in the first two layouts the least number that means a value below 0, or
        −0."""
        return self.value / LAYOUTS[self.key].value

    @property
    def end(self) -> float:
        """Number that the register cannot hold, and no larger one."""
        return 2.0 * self.least_negative

    def holds(self, numbers: np.ndarray) -> np.ndarray:
        """(T,) bool: the register can hold these ``numbers`` (T,), which all lie on one
        side of 0."""
        above = numbers.max() >= -numbers.min()
        size = numbers if above else -numbers
        return (size >= 0.0) & (size < self.end)

    def decoded(self, numbers: np.ndarray) -> np.ndarray:
        """(T,) signed values of ``numbers`` (T,), in the column's numbers. Python's own
        integers, of which 64 bits fit into no float, are decoded exactly."""
        half = self.least_negative
        if numbers.dtype == object:
            half = int(half)
        size = LAYOUTS[self.key].decode(np.abs(numbers), half)
        return np.where(numbers < 0, -size, size).astype(float)

    def words(self) -> str:
        """The kind of register, for a message."""
        return LAYOUTS[self.key].words.format(as_text(self.value))


def as_text(value: float) -> str:
    """``value`` as it stands in a columns file: 2⁶⁴ with all its digits."""
    return str(int(value)) if value == int(value) else f"{value:.12g}"


@dataclass(frozen=True)
class UnsignedColumn:
    """A column of a table whose numbers look like those of a register without its sign."""

    signal: str
    quantity: str  # Key of the columns file: q, q_target or tau
    register: Register
    step: float  # Value of the register in the unit of the measurement
    line: str  # Line of the columns file that reads it
    changes: int = 0
    """Number of changes of sign at which the column jumps; 0 if only the limits or the
    law of the machine can tell."""
    row: int = 0  # First row after a change of sign

    @property
    def half(self) -> float:
        """H of its register in the unit of the measurement."""
        return abs(self.step) / LAYOUTS[self.register.key].value

    def decoded(self, values: np.ndarray) -> np.ndarray:
        """(T,) signed ``values`` of the measurement (T,) [rad, m, N·m or N]; NaN stay."""
        own = dataclasses.replace(self.register, value=abs(self.step))
        return np.where(np.isfinite(values), own.decoded(values), np.nan)


def _steps(numbers: np.ndarray) -> set[float]:
    """Numbers that one step of the register may be: 1 in a column of whole numbers, and what lies between the levels on one
    side of the widest gap; the gap itself would hide a step that is known to few digits."""
    whole = bool((numbers == np.round(numbers)).all())
    levels = np.unique(numbers)
    gap = int(np.diff(levels).argmax())
    parts = (numbers[numbers <= levels[gap]], numbers[numbers > levels[gap]])
    found = {float(f"{find_quantum(part):.6g}") for part in parts}
    return (found | ({1.0} if whole else set())) - {0.0}


def _bits(numbers: np.ndarray, step: float) -> int:
    """Bits of the largest of ``numbers`` (T,) of a register with this ``step``."""
    largest = numbers.max()
    if numbers.dtype == object:
        return int(largest).bit_length()
    return round(float(largest) / step).bit_length()


def _candidates(numbers: np.ndarray, keys: Iterable[Key]) -> Iterator[Register]:
    """Registers that can hold all ``numbers`` (T,) from 0 on, by the steps between
    them. Where the upper half states a sign, it is in use; offset binary has an even
    number of bits, as converters have, and most of its numbers may be below its 0."""
    steps = {1.0} if numbers.dtype == object else _steps(numbers)
    for key, step in itertools.product(keys, sorted(steps)):
        least = _bits(numbers, step)
        widths = range(least, least + 3) if key == "zero" else (least,)
        for bits in widths:
            half = step * 2.0 ** (bits - 1)
            if step != int(step):
                half = float(f"{half:.12g}")
            register = Register(key, half * LAYOUTS[key].value)
            known = LEAST_BITS <= bits <= MOST_BITS
            if (
                known
                and register.holds(numbers).all()
                and (key != "zero" or not bits % 2)
            ):
                yield register


def _continuity(register: Register, numbers: np.ndarray) -> tuple[int, int, float]:
    """(changes of sign, first row after one, step at the better ones once decoded); no changes if these are no jumps of the
    column, or jumps of the decoded one."""
    signed = register.decoded(numbers)
    upper = (numbers >= register.least_negative).astype(bool)
    numbers = numbers.astype(float)
    at = np.flatnonzero(np.diff(upper.astype(int)))
    jumps = np.abs(np.diff(numbers))
    moves = np.abs(np.diff(signed))
    others = np.delete(jumps, at)
    if len(at) < LEAST_CHANGES or not len(others):
        return 0, 0, math.inf
    usual = max(
        float(np.quantile(others, 0.99)), float(np.diff(np.unique(numbers)).min())
    )
    bound = max(CONTINUES * usual, NEARLY * register.least_negative)
    # At a quarter of the changes of sign it must: where a target steps, an effort changes
    # its sign within a row. A choice.
    tight = np.sort(moves[at])[: max(LEAST_CHANGES, math.ceil(0.25 * len(at)))]
    # At a change of sign the column jumps four times as far as between 99 of 100 other
    # rows. A choice.
    is_jump = np.median(jumps[at]) > max(4.0 * usual, 0.5 * register.least_negative)
    varies = np.ptp(signed[~upper]) > 0.0 and np.ptp(signed[upper]) > 0.0
    if not (is_jump and varies and tight[-1] <= bound):
        return 0, 0, math.inf
    return len(at), int(at[0]) + 1, float(tight[-1])


def _all_above(numbers: np.ndarray) -> np.ndarray:
    """``numbers`` (T,), or their opposite, all from 0 on; none where that is neither, or
    where they show nothing."""
    known = np.isfinite(numbers.astype(float)).all()
    if not known or numbers.min() == numbers.max():
        return numbers[:0]
    if numbers.min() >= 0:
        return numbers
    return -numbers if numbers.max() <= 0 else numbers[:0]


def find_registers(numbers: np.ndarray) -> list[tuple[Register, int, int]]:
    """(register, changes of sign, first row after one) that explain a column of
    ``numbers`` (T,) by its jumps: the one that leaves least at its changes of sign;
    without such changes those of which all numbers mean values below 0. Empty: there is
    none."""
    numbers = _all_above(numbers)
    if not len(numbers):
        return []
    crossing = []
    negative = []
    for register in _candidates(numbers, ("sign_bit", "wraps_at")):
        changes, row, tight = _continuity(register, numbers)
        if changes:
            crossing.append((tight, register.end, register, changes, row))
        elif (numbers >= register.least_negative).all():
            negative.append((register, 0, 0))
    if crossing:
        _, _, register, changes, row = min(crossing, key=lambda found: found[:2])
        return [(register, changes, row)]
    return negative


def possible_registers(numbers: np.ndarray) -> list[Register]:
    """Registers of all layouts that can hold a column of ``numbers`` (T,), whose jumps
    do not tell."""
    numbers = _all_above(numbers)
    return list(_candidates(numbers, LAYOUTS)) if len(numbers) else []
