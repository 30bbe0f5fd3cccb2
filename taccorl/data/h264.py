"""Frames that are lost from a stream of H.264: decoders put another picture in their place and go on, without an error.

Each picture states ``frame_num`` (ITU-T H.264, 7.4.3): 0 for a picture that refers to none, then one more with each picture
that later ones refer to, modulo 2^log2_max_frame_num of the sequence parameter set. A jump says that a picture is missing, and
that all until the next IDR picture may show remains of it.
"""

from collections.abc import Iterator

HIGH_PROFILES = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)
"""Values of profile_idc whose parameter sets state the format of the colours (7.3.2.1.1)."""
SLICE, IDR, PARAMETERS = 1, 5, 7  # nal_unit_type
LONGEST_HEADER = 64  # Bytes of a unit in which the numbers that are read must lie


class FrameNumbers:
    """Follows ``frame_num`` through the messages of one stream."""

    def __init__(self) -> None:
        self._bits = 0  # log2_max_frame_num; 0: no parameter set yet
        self._colour_planes = False
        self._may_jump = False
        self._last: int | None = None
        self._was_reference = False
        self.broken = False
        """A picture is missing since the last IDR picture."""

    def take(self, data: bytes) -> bool:
        """Take in the next message, with one picture. Returns ``broken``."""
        for unit in _units(data):
            kind, is_reference = unit[0] & 31, bool(unit[0] >> 5 & 3)
            if kind == PARAMETERS:
                self._read_parameters(_Bits(unit[1:]))
            elif kind in (SLICE, IDR) and self._bits:
                self._read_slice(_Bits(unit[1:]), kind == IDR, is_reference)
                break  # all slices of a picture have one number
        return self.broken

    def _read_parameters(self, bits: "_Bits") -> None:
        profile = bits.take(8)
        bits.take(16)  # constraints and level
        bits.golomb()  # its number
        self._colour_planes = False
        if profile in HIGH_PROFILES:
            if bits.golomb() == 3:  # chroma_format_idc
                self._colour_planes = bool(bits.take(1))
            bits.golomb()  # depths of brightness and of colours
            bits.golomb()
            bits.take(1)  # whether the transform is left out
            if bits.take(1):  # scaling matrices, of whose length nothing is known here
                self._bits = 0
                return
        self._bits = bits.golomb() + 4
        if (order := bits.golomb()) == 0:
            bits.golomb()
        elif order == 1:
            self._bits = 0
            return
        bits.golomb()  # max_num_ref_frames
        self._may_jump = bool(bits.take(1))

    def _read_slice(self, bits: "_Bits", is_idr: bool, is_reference: bool) -> None:
        for _ in ("place of its first block", "kind of slice", "parameter set"):
            bits.golomb()
        if self._colour_planes:
            bits.take(2)
        number = bits.take(self._bits)
        if is_idr:
            self.broken = False
        elif self._last is not None and not self._may_jump:
            due = (self._last + self._was_reference) % (1 << self._bits)
            self.broken |= number != due
        self._last, self._was_reference = number, is_reference


class _Bits:
    """Reads a unit bit by bit, without the bytes that keep start codes out of it."""

    def __init__(self, unit: bytes) -> None:
        data = unit[:LONGEST_HEADER].replace(b"\0\0\3", b"\0\0")
        self._text, self._at = "".join(f"{byte:08b}" for byte in data), 0

    def take(self, num: int) -> int:
        """The next ``num`` bits as a number; zeros beyond the end."""
        found = self._text[self._at : self._at + num].ljust(num, "0")
        self._at += num
        return int(found or "0", 2)

    def golomb(self) -> int:
        """The next number in Exp-Golomb code (9.1)."""
        one = self._text.find("1", self._at)
        zeros = (one if one >= 0 else len(self._text)) - self._at
        return self.take(2 * zeros + 1) - 1


def _units(data: bytes) -> Iterator[bytes]:
    """The NAL units of a message in the byte stream format (Annex B), each with its first bytes."""
    at = data.find(b"\0\0\1")
    while at >= 0:
        start = at + 3
        at = data.find(b"\0\0\1", start)
        unit = data[start : at if at >= 0 else len(data)]
        if unit:
            yield unit[: LONGEST_HEADER + 1]
