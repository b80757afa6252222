"""The box of a region command: a part of an image, in 1/32 of its sides."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Final

from sonarpost.codec.interface import MIN_SIDE_PX
from sonarpost.errors import BadInputError

BOX_STEPS: Final = 32
"""Steps of the edges of a box along each side of the image."""
_BITS: Final = 5
_PADDING_BITS: Final = 4
PACKED_BYTES: Final = 3


@dataclass(frozen=True, slots=True)
class RegionBox:
    """A part of an image, in 1/32 of its sides.

    Attributes:
        top: Upper edge, 0..31.
        left: Left edge, 0..31.
        bottom: Lower edge, `top` + 1..32.
        right: Right edge, `left` + 1..32.

    Raises:
        BadInputError: An edge is out of range.
    """

    top: int
    left: int
    bottom: int
    right: int

    def __post_init__(self) -> None:
        for name, first, last in (("bottom", self.top, self.bottom), ("right", self.left, self.right)):
            if not 0 <= first < last <= BOX_STEPS:
                expected = f"edges from 0 to {BOX_STEPS}, this one behind the opposite one"
                raise BadInputError("region", name, (first, last), expected)

    def pack(self) -> bytes:
        """Return the box in 3 bytes: four numbers of 5 bits, the last two minus 1, and 4 zero bits."""
        packed = 0
        for value in (self.top, self.left, self.bottom - 1, self.right - 1):
            packed = packed << _BITS | value
        return (packed << _PADDING_BITS).to_bytes(PACKED_BYTES, "big")

    @classmethod
    def unpack(cls, data: bytes) -> RegionBox:
        """Return the box of 3 bytes.

        Raises:
            BadInputError: Another length, the last 4 bits are not zero, or an edge is out of range.
        """
        packed = int.from_bytes(data, "big")
        if len(data) != PACKED_BYTES or packed % (1 << _PADDING_BITS):
            raise BadInputError("region", "box", data, f"{PACKED_BYTES} bytes, the last {_PADDING_BITS} bits zero")
        packed >>= _PADDING_BITS
        top, left, bottom, right = (packed >> shift & BOX_STEPS - 1 for shift in (15, 10, 5, 0))
        return cls(top, left, bottom + 1, right + 1)

    def pixels(self, height_px: int, width_px: int) -> tuple[int, int, int, int]:
        """Return first row, first column, last row + 1 and last column + 1 of the box in an image.

        A box that is narrower than the smallest image is widened to it, around its centre and inside the image.

        Args:
            height_px: Rows of the image, at least 16.
            width_px: Columns of the image, at least 16.
        """
        top, bottom = _widened(self.top, self.bottom, height_px)
        left, right = _widened(self.left, self.right, width_px)
        return top, left, bottom, right

    def as_tuple(self) -> tuple[int, int, int, int]:
        """Return top, left, bottom and right."""
        top, left, bottom, right = astuple(self)
        return top, left, bottom, right


def _widened(first: int, last: int, side_px: int) -> tuple[int, int]:
    start, stop = first * side_px // BOX_STEPS, -(-last * side_px // BOX_STEPS)
    missing_px = max(0, MIN_SIDE_PX - (stop - start))
    start = min(max(0, start - missing_px // 2), side_px - max(MIN_SIDE_PX, stop - start))
    return start, max(stop, start + MIN_SIDE_PX)
