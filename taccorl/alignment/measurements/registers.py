"""Registers of drives whose numbers state a sign, and columns of a table in which such numbers were logged without it.

A driver that reads a register as an unsigned number logs −9 as

    sign and magnitude, sign bit S   S + 9     Feetech and STS: S = 2¹⁰ (load) or 2¹⁵; numbers 0 … 2 S − 1
    two's complement, W values       W − 9     Dynamixel and others: W = 2¹⁶ or 2³²; numbers 0 … W − 1

S and W are in the column's own numbers: of a register that the logger multiplied by 0.1 they are 102.4 and 6553.6. Where the
quantity passes through 0, such a column jumps by nearly S or W, and the decoded one by no more than between other rows.
"""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from taccorl.alignment.measurements.quantisation import find_quantum

SIGN_BITS = (10, 11, 15, 31)  # Bits that are looked for as the sign of a magnitude
WIDTHS = (16, 32)  # Bits of registers in two's complement that are looked for
JUMP = 4.0
"""At a change of sign the column jumps at least so many times as far as between other rows (99 of 100). A choice."""
CONTINUES, NEARLY = 1.5, 0.05
"""At a change of sign the decoded column moves at most so many times as far as between other rows, or by this share of the
least number that means a value below 0. Choices."""
TIGHT = 0.25
"""Share of the changes of sign at which it must: where a target steps, an effort changes its sign within a row. A choice."""
LEAST_CHANGES = (
    2  # Changes of sign that must be seen: one jump may be a motor that is turned on
)
Key = Literal["sign_bit", "wraps_at"]


@dataclass(frozen=True)
class Register:
    """How the numbers of a register state a sign."""

    key: Key
    """``sign_bit``: sign and magnitude. ``wraps_at``: two's complement. Also the key of a columns file."""
    value: float
    """Weight of the sign bit, or number of values of the register, in the column's numbers."""

    @property
    def least_negative(self) -> float:
        """Least number that means a value below 0, or −0."""
        return self.value if self.key == "sign_bit" else self.value / 2

    @property
    def end(self) -> float:
        """Number that the register cannot hold, and no larger one."""
        return 2.0 * self.value if self.key == "sign_bit" else self.value

    def holds(self, numbers: np.ndarray) -> np.ndarray:
        """(T,) bool: the register can hold these ``numbers`` (T,)."""
        return (numbers >= 0.0) & (numbers < self.end)

    def decoded(self, numbers: np.ndarray) -> np.ndarray:
        """(T,) signed values of ``numbers`` (T,), in the column's numbers."""
        is_negative = numbers >= self.least_negative
        if self.key == "sign_bit":
            return np.where(is_negative, self.value - numbers, numbers)
        return np.where(is_negative, numbers - self.value, numbers)

    def words(self) -> str:
        """The kind of register, for a message."""
        if self.key == "sign_bit":
            return f"sign and magnitude, {self.value:.12g} is the sign bit"
        return (
            f"two's complement, {self.value:.12g} is one more than the largest number"
        )


@dataclass(frozen=True)
class UnsignedColumn:
    """A column of a table whose numbers look like those of a register without its sign."""

    signal: str
    quantity: str  # Key of the columns file: q, q_target or tau
    register: Register
    step: (
        float  # Value of the sign bit, or of all values, in the unit of the measurement
    )
    line: str  # Line of the columns file that reads it
    changes: int = 0
    """Number of changes of sign; 0 if all numbers mean values below 0, which only the machine's limits or law can tell."""
    row: int = 0  # First row after a change of sign

    def decoded(self, values: np.ndarray) -> np.ndarray:
        """(T,) signed ``values`` of the measurement (T,) [rad, m, N·m or N]; NaN stay."""
        size = np.abs(values)
        own = dataclasses.replace(self.register, value=abs(self.step))
        return np.where(np.isfinite(values), own.decoded(size), np.nan) * np.sign(
            self.step
        )


def _steps(numbers: np.ndarray) -> set[float]:
    """Numbers that one step of the register may be: 1 in a column of whole numbers, and what lies between the levels on one
    side of the widest gap; the gap itself would hide a step that is known to few digits."""
    whole = bool((numbers == np.round(numbers)).all())
    levels = np.unique(numbers)
    gap = int(np.diff(levels).argmax())
    parts = (numbers[numbers <= levels[gap]], numbers[numbers > levels[gap]])
    found = {float(f"{find_quantum(part):.6g}") for part in parts}
    return (found | ({1.0} if whole else set())) - {0.0}


def _candidates(numbers: np.ndarray) -> Iterator[Register]:
    """Registers that can hold all ``numbers`` (T,), by the steps between them: those with an upper half in use."""
    kinds: dict[Key, tuple[int, ...]] = {"sign_bit": SIGN_BITS, "wraps_at": WIDTHS}
    for step in sorted(_steps(numbers)):
        for key, bits in kinds.items():
            for bit in bits:
                register = Register(key, float(f"{step * 2.0**bit:.12g}"))
                upper = numbers >= register.least_negative
                if register.holds(numbers).all() and upper.any():
                    yield register


def _continuity(register: Register, numbers: np.ndarray) -> tuple[int, int, float]:
    """(changes of sign, first row after one, step at the better ones once decoded); no changes if these are no jumps of the
    column, or jumps of the decoded one."""
    upper = numbers >= register.least_negative
    at = np.flatnonzero(np.diff(upper.astype(int)))
    jumps = np.abs(np.diff(numbers))
    moves = np.abs(np.diff(register.decoded(numbers)))
    others = np.delete(jumps, at)
    if len(at) < LEAST_CHANGES or not len(others):
        return 0, 0, math.inf
    usual = max(
        float(np.quantile(others, 0.99)), float(np.diff(np.unique(numbers)).min())
    )
    bound = max(CONTINUES * usual, NEARLY * register.least_negative)
    tight = np.sort(moves[at])[: max(LEAST_CHANGES, math.ceil(TIGHT * len(at)))]
    is_jump = np.median(jumps[at]) > max(JUMP * usual, 0.5 * register.least_negative)
    varies = np.ptp(numbers[~upper]) > 0.0 and np.ptp(numbers[upper]) > 0.0
    if not (is_jump and varies and tight[-1] <= bound):
        return 0, 0, math.inf
    return len(at), int(at[0]) + 1, float(tight[-1])


def find_registers(numbers: np.ndarray) -> list[tuple[Register, int, int]]:
    """(register, changes of sign, first row after one) that explain a column of ``numbers`` (T,): the one that leaves least at
    its changes of sign; without such changes those of which all numbers mean values below 0. Empty: there is none."""
    if not np.isfinite(numbers).all() or numbers.min() < 0.0 or np.ptp(numbers) == 0.0:
        return []
    crossing = []
    negative = []
    for register in _candidates(numbers):
        changes, row, tight = _continuity(register, numbers)
        if changes:
            crossing.append((tight, register.end, register, changes, row))
        elif (numbers >= register.least_negative).all():
            negative.append((register, 0, 0))
    if crossing:
        _, _, register, changes, row = min(crossing, key=lambda found: found[:2])
        return [(register, changes, row)]
    return negative
