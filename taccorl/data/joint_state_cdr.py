"""sensor_msgs/JointState from CDR bytes, several times faster than the decoder of any schema: most messages are of this type.

    4 bytes encapsulation | sec, nanosec | frame_id and names | 3 × (count, padding, doubles): position, velocity, effort

A driver sends the same names in every message, so that everything but stamp and doubles is the same bytes at the same places. The
first message is read by the general decoder and gives these places; they are used only if they read it to the same values. A
message whose other bytes or length differ goes to the general decoder, which raises where it does not fit, and gives new places.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

KEYS = ("position", "velocity", "effort")
LITTLE_ENDIAN = b"\0\1\0\0"


@dataclass(frozen=True)
class _Places:
    """Byte positions of the values in one message, and the required content of its other bytes."""

    values: struct.Struct
    """sec, nanosec, and all doubles in order, from byte 4 on; the bytes between them are skipped."""
    fixed: tuple[tuple[int, int, bytes], ...]
    """(first byte, last byte + 1, required content) of all other byte ranges."""
    size: int
    counts: tuple[int, int, int]
    kinds: tuple[type, type, type]
    """Python classes of message, header and stamp."""
    frame_id: str
    names: tuple[str, ...]

    def fit(self, data: bytes) -> bool:
        return len(data) == self.size and all(data[first:end] == content for first, end, content in self.fixed)


def joint_state_decoder(general: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    """A decoder that reads messages with the layout of the last one directly, and all others with ``general``."""
    places: _Places | None = None

    def decode(data: bytes) -> Any:
        nonlocal places
        if places is not None and places.fit(data):
            return _read(data, places)
        found = general(data)
        places = _places(data, found)
        return found

    return decode


def _read(data: bytes, places: _Places) -> Any:
    """A message whose bytes fit ``places``."""
    sec, nanosec, *numbers = places.values.unpack_from(data, 4)
    found, header, stamp = (kind() for kind in places.kinds)
    stamp.sec, stamp.nanosec = sec, nanosec
    header.stamp, header.frame_id = stamp, places.frame_id
    found.header, found.name = header, list(places.names)
    first = 0
    for key, count in zip(KEYS, places.counts, strict=True):
        setattr(found, key, numbers[first : first + count])
        first += count
    return found


def _places(data: bytes, message: Any) -> _Places | None:
    """Places of the values in a message that the general decoder has read; None if it has not the layout of a JointState."""
    if data[:4] != LITTLE_ENDIAN or _fields(message) != ["header", "name", *KEYS]:
        return None
    at = 12  # frame_id, a text, begins here; offsets count from behind the encapsulation, and 4 does not matter below 8
    for text in (message.header.frame_id, None, *message.name):
        at += -at % 4 + (4 if text is None else _text_bytes(data, at + -at % 4))
    counts, form, fixed, read = [], "<iI", [(0, 4)], 12
    for key in KEYS:
        count = len(getattr(message, key))
        at += -at % 4 + 4
        if count:
            at += -(at - 4) % 8
        form += f"{at - read}x{count}d"
        fixed.append((read, at))
        at += 8 * count
        read = at
        counts.append(count)
    if at > len(data):
        return None
    fixed.append((at, len(data)))
    header = message.header
    found = _Places(
        values=struct.Struct(form),
        fixed=tuple((first, end, data[first:end]) for first, end in fixed),
        size=len(data),
        counts=(counts[0], counts[1], counts[2]),
        kinds=(type(message), type(header), type(header.stamp)),
        frame_id=header.frame_id,
        names=tuple(message.name),
    )
    again = _read(data, found)
    same = all(getattr(again.header.stamp, key) == getattr(header.stamp, key) for key in ("sec", "nanosec"))
    numbers = (np.array_equal(getattr(again, key), getattr(message, key), equal_nan=True) for key in KEYS)
    return found if same and all(numbers) else None


def _fields(message: Any) -> list[str]:
    return list(getattr(type(message), "__slots__", []))


def _text_bytes(data: bytes, at: int) -> int:
    """Length of a CDR text with its count and closing zero."""
    return 4 + struct.unpack_from("<I", data, at)[0] if at + 4 <= len(data) else 4
