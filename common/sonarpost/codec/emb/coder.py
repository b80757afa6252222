"""What both ends keep while they code a picture: the state of its coefficients, and the range coder."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import kernel
from sonarpost.codec.emb.layout import Layout
from sonarpost.codec.emb.transform import UNIT

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]


PLAIN_SCALE: Final = 256
"""A coefficient that is coded as it is."""


@dataclass
class State:
    """What is known of a picture's coefficients; flat arrays of `Layout.cells`, see `kernel.code_band`.

    Attributes:
        threshold: Of the plane that was coded last.
        scale: By what each coefficient is multiplied before it is coded, 1/256; see `aim`.
    """

    lay: Layout
    threshold: int = 1 << 17
    values: I32 = field(init=False)
    widths: I32 = field(init=False)
    signs: I32 = field(init=False)
    seen: I32 = field(init=False)
    signed: I32 = field(init=False)
    marks: I32 = field(init=False)
    odds: I32 = field(init=False)
    scale: I32 = field(init=False)

    def __post_init__(self) -> None:
        for name in ("values", "widths", "signs", "seen", "signed", "marks", "odds"):
            setattr(self, name, np.zeros(self.lay.cells, np.int32))
        self.scale = np.full(self.lay.cells, PLAIN_SCALE, np.int32)


@dataclass
class Coder:
    """The range coder and where it writes to or reads from."""

    mode: int
    data: npt.NDArray[np.uint8]
    words: I64 = field(default_factory=lambda: np.zeros(kernel.CODER_WORDS, np.int64))
    good: npt.NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    curve: I64 = field(default_factory=lambda: np.zeros(1, np.int64))
    rows: npt.NDArray[np.int16] = field(default_factory=lambda: np.zeros((0, kernel.FEATURES + 3), np.int16))
    sign_rows: npt.NDArray[np.int16] = field(default_factory=lambda: np.zeros((0, kernel.SIGN_FEATURES + 2), np.int16))

    @classmethod
    def reader(cls, body: bytes) -> Coder:
        """Read from a body."""
        coder = cls(kernel.READ, np.frombuffer(body, np.uint8).copy())
        kernel.start_reading(coder.words, coder.data)
        return coder

    @classmethod
    def writer(cls, limit_bytes: int, begin: bytes = b"") -> Coder:
        """Write a body of at most `limit_bytes` that begins with `begin`.

        What is written first must be what `begin` says; the decisions after that are turned where they would change it.
        """
        coder = cls(kernel.WRITE, np.zeros(limit_bytes + 8, np.uint8))
        coder.good = np.zeros(limit_bytes, np.uint8)
        coder.curve = np.full(limit_bytes + 2, -1, np.int64)
        coder.words[kernel.CODER_RANGE] = (1 << 32) - 1
        coder.words[kernel.CODER_LIMIT] = limit_bytes
        coder.words[kernel.CODER_HELD] = len(begin)
        coder.good[: len(begin)] = np.frombuffer(begin, np.uint8)
        return coder

    def record(self) -> None:
        """Note that the squared error so far is that of the bytes so far."""
        at = 1 + (int(self.words[kernel.CODER_COST]) >> 11)
        self.curve[min(at, len(self.curve) - 1)] = self.curve[0]

    def finish(self) -> bytes:
        """Return the shortest body that tells everything that was written and fits the budget."""
        kernel.finish_writing(self.words, self.data, self.good)
        return self.good[: int(self.words[kernel.CODER_GOOD_LENGTH])].tobytes()

    def plain(self, bit: int, chance: int = 32768) -> int:
        """Write or read one decision; -1 at the end."""
        if self.mode == kernel.LIST:
            return bit
        if self.mode == kernel.WRITE:
            share = chance if bit else 65536 - chance
            self.words[kernel.CODER_COST] += round(256 * (16 - np.log2(share)))
        return int(kernel.code_plain(self.words, self.data, self.good, bit, chance, self.mode))


def error_by_length(curve: I64, body_bytes: int, header_bytes: int, pixels: int) -> npt.NDArray[np.float64]:
    """Return the mean squared error by stream length, from the coder's record of squared error by bytes begun.

    Args:
        curve: See `Coder.curve`.
        body_bytes: Length of the body.
        header_bytes: Length of what stands before it.
        pixels: Of the picture.

    Returns:
        Shape (header_bytes + body_bytes + 1,), grey squared; infinite where there is no picture yet.
    """
    out = np.full(header_bytes + body_bytes + 1, np.inf)
    last = np.inf
    for n in range(body_bytes + 1):
        # What was coded within the first n bytes; the coder's record n + 1 is of the byte begun after them.
        if n < len(curve) - 1 and n > 0 and curve[n] >= 0:
            last = float(curve[n]) / UNIT**2 / pixels
        out[header_bytes + n] = last
    return out
