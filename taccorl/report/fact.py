"""Facts of a report, and the table of their texts, ``texts.yaml``.

A fact is an identifier with named values, computed from results and never from texts. The
table has one text per identifier, with the names of these values as fields; its order is
the order of lines in a report. No text depends on another fact.
"""

import math
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from taccorl.data.finding import listed
from taccorl.report.section import floors

Severity = Literal["error", "warning", "note"]
"""``error``: the result may be wrong; ``warning``: something speaks against it."""
Level = Literal["low", "moderate", "high"]
"""Confidence: that of the gravest of the facts, in the order of ``Severity``."""
MOST_NAMES = 3
"""Names in one line, beyond which only their number is stated. A choice."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number with its unit and its 95 % interval."""

    value: float
    unit: str = "1"
    low: float = math.nan
    """Ends of the interval; NaN if the number was not fitted."""
    high: float = math.nan

    @classmethod
    def of(
        cls, value: float, unit: str, ends: Sequence[float] | None = None
    ) -> "Quantity":
        """A number with the (low, high) ``ends`` of its interval; None: not fitted."""
        low, high = ends or (math.nan, math.nan)
        return cls(value=float(value), unit=unit, low=low, high=high)

    @property
    def shown(self) -> str:
        """The number with its unit: ``0.0285 N·m``."""
        return f"{clean(self.value, self.high - self.low)}{unit_words(self.unit)}"

    @property
    def ends(self) -> str:
        """The interval: ``0.0278 … 0.0292``; empty if it was not fitted."""
        width = self.high - self.low
        if math.isnan(width):
            return ""
        return f"{clean(self.low, width)} … {clean(self.high, width)}"

    def __str__(self) -> str:
        """Such as ``0.0285 N·m (0.0278 … 0.0292)``."""
        return f"{self.shown} ({self.ends})" if self.ends else self.shown


@dataclass(frozen=True)
class Fact:
    """One fact, which is one line of a report."""

    id: str
    """Key of ``texts.yaml``."""
    values: Mapping[str, Any]
    """Field of the text → number, name, ``Quantity``, or several names."""

    @property
    def severity(self) -> Severity:
        return texts()[self.id].severity

    @property
    def label(self) -> str:
        return texts()[self.id].label

    @property
    def text(self) -> str:
        """The line, without its label."""
        return _FORMAT.vformat(texts()[self.id].text, (), self.values)

    def as_json(self) -> dict[str, Any]:
        """The fact as ``report.json`` stores it: identifier, severity, label, text and values."""
        return {
            "id": self.id,
            "severity": self.severity,
            "label": self.label,
            "text": self.text,
            "values": dict(self.values),
        }


def fact(id: str, **values: Any) -> Fact:
    """Make a ``Fact``, which is one line of a report.

    Args:
        id: key of the line's text in texts.yaml.
        values: numbers and names that replace the placeholders of that text.
    """
    return Fact(id, values)


def when(is_so: object, id: str, **values: Any) -> list[Fact]:
    """The fact, if it is one."""
    return [fact(id, **values)] if is_so else []


@dataclass(frozen=True)
class Account:
    """What is known about one part: its facts, in the order of the table."""

    part: str
    facts: tuple[Fact, ...]
    """The first is the title, whose identifier is the kind of the result."""

    @classmethod
    def of_facts(cls, part: str, found: Sequence[Fact]) -> "Account":
        """An account of these facts, one of which is a title."""
        order = list(texts())
        return cls(part, tuple(sorted(found, key=lambda f: order.index(f.id))))

    @property
    def kind(self) -> str:
        return self.facts[0].id

    @property
    def title(self) -> str:
        return self.facts[0].text

    @property
    def level(self) -> Level:
        """Confidence: low with any error, moderate with any warning, else high."""
        ranks = [get_args(Severity).index(f.severity) for f in self.facts]
        return get_args(Level)[min(ranks)]

    @property
    def rows(self) -> tuple[tuple[str, str], ...]:
        """Label and text of each line below the title."""
        return tuple((f.label, f.text) for f in self.facts[1:])

    def get(self, id: str) -> tuple[Fact, ...]:
        """The facts of one identifier."""
        return tuple(f for f in self.facts if f.id == id)

    def values(self, id: str, field: str) -> list[Any]:
        """The values of one field of all facts of one identifier."""
        return [f.values[field] for f in self.get(id)]

    @property
    def ids(self) -> tuple[str, ...]:
        return tuple(f.id for f in self.facts)

    @property
    def command(self) -> str:
        """Command that plans the next recording; empty without one."""
        return next(iter(self.values("plan", "command")), "")

    def as_json(self) -> dict[str, Any]:
        """Title, confidence and facts for ``report.json``."""
        return {
            "kind": self.kind,
            "title": self.title,
            "confidence": self.level,
            "facts": [f.as_json() for f in self.facts],
        }


@dataclass(frozen=True)
class Text:
    """Entry of the table of texts."""

    label: str
    severity: Severity
    text: str
    """With fields in braces, in the syntax of ``str.format``."""

    @property
    def fields(self) -> set[str]:
        """Names of the values that the text needs."""
        return {name for _, name, _, _ in _FORMAT.parse(self.text) if name}


@cache
def texts() -> dict[str, Text]:
    """The table: identifier → text."""
    table = Path(__file__).with_name("texts.yaml").read_text(encoding="utf-8")
    return {id: Text(*entry) for id, entry in yaml.safe_load(table).items()}


class _Format(string.Formatter):
    """``str.format`` with ``floors``, ``share``, ``percent`` and ``number`` as specifications, and
    several names as a list."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, list | tuple):
            return listed(list(map(str, value)), most=MOST_NAMES)
        if format_spec == "floors":
            return floors(value)
        if format_spec == "share":  # never 100 % of what is not gone entirely
            digits = 1 if value >= 0.99 else 0
            return f"{100.0 * min(max(value, 0.0), 0.999):.{digits}f} %"
        if format_spec == "percent":
            return f"{100.0 * value:.2g} %"
        if format_spec == "number":
            return f"{value:.4g}"
        return super().format_field(value, format_spec)


_FORMAT = _Format()


def clean(value: float, width: float) -> str:
    """A number with four digits, or those of which the half ``width`` of its interval
    has two; 0 if it is nothing beside it."""
    known = 0.0 < width < math.inf and 0.0 < abs(value) < math.inf
    digits = 2 + math.ceil(math.log10(2.0 * abs(value) / width)) if known else 4
    is_nothing = width < math.inf and abs(value) < 1e-6 * width
    return f"{0.0 if is_nothing else value + 0.0:.{max(4, digits)}g}"


def unit_words(unit: str) -> str:
    """Unit behind a number, with a space before it; empty for a dimensionless one."""
    return "" if unit == "1" else f" {unit}"
