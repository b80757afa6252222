"""What a stream says before its coefficients: mean level, start step, and two things that are seldom there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sonarpost.codec.emb.coder import Coder
from sonarpost.codec.emb.model import Model
from sonarpost.errors import StreamError

MEAN_STEP: Final = 4
GRAIN_BANDS: Final = 8
_RARE: Final = 1024  # chance of 1, in 1/65536, of a flag that is seldom set
_ODD_STEP: Final = 4096  # chance of an odd start step, in 1/65536: the encoder usually tries the even ones
SIXTEENTHS: Final = 16
MAX_EXTRA: Final = 6


@dataclass(frozen=True, slots=True)
class Box:
    """A part of the picture that gets more of the bits, in sixteenths of its sides.

    Attributes:
        top: First row, 0..15.
        left: First column, 0..15.
        bottom: Last row, `top`..15.
        right: Last column, `left`..15.

    Raises:
        StreamError: A value outside these limits.
    """

    top: int
    left: int
    bottom: int
    right: int

    def __post_init__(self) -> None:
        limits = (("top", self.top, 0), ("left", self.left, 0), ("bottom", self.bottom, self.top))
        for name, value, low in (*limits, ("right", self.right, self.left)):
            if not low <= value < SIXTEENTHS:
                raise StreamError("region of interest", name, value, f"{low}..{SIXTEENTHS - 1} sixteenths")

    @classmethod
    def around(cls, top_px: int, left_px: int, bottom_px: int, right_px: int, height_px: int, width_px: int) -> Box:
        """Return the smallest box that holds these rows and columns, first and last ones included.

        Raises:
            StreamError: They are not inside the picture.
        """
        return cls(
            top_px * SIXTEENTHS // height_px,
            left_px * SIXTEENTHS // width_px,
            bottom_px * SIXTEENTHS // height_px,
            right_px * SIXTEENTHS // width_px,
        )


@dataclass(frozen=True, slots=True)
class SideInfo:
    """Side information.

    Attributes:
        mean_index: Mean grey / 4, 0..63; -1 where the stream is too short to tell.
        step: Start step, 0..7; -1 where the stream is too short to tell (then nothing after it is known either).
        box: Region of interest.
        grain: Strength of the picture's texture by band, 0..15 each; see `grain`.
        extra: How many planes come above the usual first one, 0..6: for pictures that are half black, half white.
    """

    mean_index: int
    step: int
    box: Box | None = None
    grain: tuple[int, ...] | None = None
    extra: int = 0

    @property
    def mean(self) -> int:
        """Mean level in grey."""
        return self.mean_index * MEAN_STEP


class _EndOfStreamError(Exception):
    """The bytes do not tell the next decision."""


def write_side(coder: Coder, model: Model, side: SideInfo) -> None:
    """Write side information. A coder whose budget ends within it stops, which the caller sees from its length."""
    _code(coder, model, side)


def read_side(coder: Coder, model: Model) -> SideInfo:
    """Read as much as the stream tells."""
    return _code(coder, model, None)


def _code(coder: Coder, model: Model, side: SideInfo | None) -> SideInfo:
    mean_index = -1
    try:
        mean_index = _mean(coder, model, side.mean_index if side else 0)
        step = side.step if side else 0
        found = 2 * _number(coder, 2, step >> 1) + _bit(coder, step & 1, _ODD_STEP)
        extra = 0
        while extra < MAX_EXTRA and _bit(coder, int(side is not None and extra < side.extra), _RARE):
            extra += 1
        box = None
        if _bit(coder, int(side is not None and side.box is not None), _RARE):
            corners = (side.box.top, side.box.left, side.box.bottom, side.box.right) if side and side.box else (0,) * 4
            top, left, bottom, right = (_number(coder, 4, n) for n in corners)
            box = Box(min(top, bottom), min(left, right), max(top, bottom), max(left, right))
        grain = None
        if _bit(coder, int(side is not None and side.grain is not None), _RARE):
            given = side.grain if side and side.grain else (0,) * GRAIN_BANDS
            grain = tuple(_number(coder, 4, n) for n in given)
        return SideInfo(mean_index, found, box, grain, extra)
    except _EndOfStreamError:
        return SideInfo(mean_index, -1)


def _bit(coder: Coder, bit: int, chance: int = 32768) -> int:
    found = coder.plain(bit, chance)
    if found < 0:
        raise _EndOfStreamError
    return found


def _number(coder: Coder, bits: int, value: int) -> int:
    found = 0
    for place in range(bits - 1, -1, -1):
        found = 2 * found + _bit(coder, value >> place & 1)
    return found


def _mean(coder: Coder, model: Model, mean_index: int) -> int:
    node = 1
    for place in range(5, -1, -1):
        node = 2 * node + _bit(coder, mean_index >> place & 1, int(model.mean_tree[node]))
    return node - 64
