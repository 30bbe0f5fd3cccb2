"""Messages between a surrogate and its clients, checked before they are used.

A request of a client is one frame, a JSON object: ``{"do": "command", "target": […]}``.
A message of the surrogate is two frames: a header, which is a JSON object, and a
payload. A message of another form is dropped and counted by its receiver.
"""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from taccorl.errors import TaccorlError

MOST_REQUEST_BYTES = 4096
"""Largest frame that the surrogate receives [bytes]; a command has about 300. ZeroMQ
closes the connection of a client that sends a larger one."""
MOST_REPLY_BYTES = 1 << 24
"""Largest frame that a client receives [bytes]; a picture of 2048 × 2048 as JPEG has about 2 MB."""
MOST_NAME = 60
"""Longest name of a client [characters]."""


def read_object(text: bytes) -> dict[str, Any]:
    """JSON object of a frame. Raises TaccorlError: it is none."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise TaccorlError("is not JSON") from error
    if not isinstance(found, dict):
        raise TaccorlError("is no JSON object")
    return found


def finite_numbers(
    fields: Mapping[str, Any], key: str, count: int | None = None
) -> np.ndarray:
    """(count,) float64 of the list ``key``; ``count`` None: of any length from 1 on.
    Raises TaccorlError: it is no list of as many finite numbers."""
    values = fields.get(key)
    size = "" if count is None else f"{count} "
    if not isinstance(values, list) or not values or count not in (None, len(values)):
        raise TaccorlError(f"{key}: expected a list of {size}numbers")
    for k, value in enumerate(values):
        if type(value) not in (int, float) or not math.isfinite(_as_float(value)):
            raise TaccorlError(f"{key}[{k}]: expected a finite number")
    return np.array(values, dtype=float)


def _as_float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:  # a whole number of more than 308 digits
        return math.inf


def name_of(fields: Mapping[str, Any]) -> str:
    """Name of a client. Raises TaccorlError: it is no short text."""
    name = fields.get("name")
    if isinstance(name, str) and len(name) <= MOST_NAME and name.isprintable():
        return name
    raise TaccorlError(f"name: expected a text of at most {MOST_NAME} characters")
