"""One part of what a verb reports: title, lines, rows, figures and a command. ``page`` and ``terminal`` render it."""

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple


class Cell(NamedTuple):
    """Text with a style. A plain string stands for a cell without one."""

    text: str
    style: str = ""
    """good, bad, high, moderate, low, error, warning, note, bold, code, or link (a path relative to the page)."""
    hint: str = ""
    """Text that a page shows when the cell is pointed at."""
    more: Sequence[str] = ()
    """Lines that a page unfolds below the text."""


class Picture(NamedTuple):
    """Figure of a page."""

    draw: Callable[[], Any]
    """Makes the matplotlib figure, or the bytes of a PNG or JPEG file, when a page is rendered."""
    caption: str


Value = str | Cell


@dataclass(frozen=True, kw_only=True)
class Section:
    """Parts in the order in which they are shown; empty ones are left out."""

    title: str = ""
    text: Sequence[Value] = ()
    """Lines above the rows."""
    heads: Sequence[str] = ()
    """Headings of the columns; none if all are empty."""
    rows: Sequence[Sequence[Value]] = ()
    """Rows of the table; of two columns without headings: names and values."""
    right: Container[int] = ()
    """Indices of the columns that are right-aligned."""
    marks: Sequence[str] = ()
    """Style of each row: added, tie, or empty."""
    figures: Sequence[Picture] = ()
    notes: Sequence[Value] = ()
    """Remarks below the rows."""
    command: str = ""
    """Command line that follows from the section."""
    parts: Sequence["Section"] = ()
    """Sections below this one."""
    style: str = ""
    """Frame of the lines on a page and their colour in a terminal: high, moderate, low, or data."""
    folded: bool | None = None
    """True, False: a page shows a title to be unfolded, closed or open."""
    only: Literal["", "page"] = ""
    """Where it is shown; empty: everywhere."""


def cell(value: Value) -> Cell:
    """``value`` as a cell."""
    return value if isinstance(value, Cell) else Cell(value)


def floors(error: float) -> str:
    """An error in noise floors as text: three digits, all before the point."""
    return f"{error:.3g}" if error < 1000.0 else f"{error:.0f}"


def change(before: float, after: float) -> str:
    """Change from ``before`` to ``after`` as text: ``-92%`` of ``before``; ``+0%`` if it is less than half a percent."""
    return f"{round(after / before - 1, 2) + 0.0:+.0%}"
