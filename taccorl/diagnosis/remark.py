"""Remark about a result: an identifier and values, of which a report makes a line."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Remark:
    """A fact beside a diagnosis, found by looking at several parts together."""

    id: str
    """Key of ``taccorl/report/texts.yaml``."""
    values: Mapping[str, Any]
    """Field of that text → value."""
