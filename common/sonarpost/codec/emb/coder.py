"""State of encoder and decoder: the coefficients of an image, and the range coder."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sonarpost.codec.emb import contexts, kernel, range_coder
from sonarpost.codec.emb.kernel import I16, I32, I64, U8
from sonarpost.codec.emb.transform import Layout

UNIT_SCALE: Final = 256
"""Scale of a coefficient that is coded without a perceptual weight."""


@dataclass
class CoefficientState:
    """The decoded information about the coefficients of an image: flat arrays of `Layout.cells`.

    Attributes:
        layout: Layout of the image.
        threshold: Threshold of the plane coded last.
        lower: Lower bound of the magnitude; 0 if the coefficient is not significant.
        widths: Width of the interval above the lower bound.
        signs: -1 or 1.
        sizes: Magnitude in eighths of the threshold.
        signed: The same with sign.
        planes: Plane that decided last, or minus the plane that evaluated last.
        logits: Logit of the last decision or evaluation, in 1/256.
        scale: Factor of each coefficient before coding, in 1/256; see `perceptual_weights`.
    """

    layout: Layout
    threshold: int = 1 << 17
    lower: I32 = field(init=False)
    widths: I32 = field(init=False)
    signs: I32 = field(init=False)
    sizes: I32 = field(init=False)
    signed: I32 = field(init=False)
    planes: I32 = field(init=False)
    logits: I32 = field(init=False)
    scale: I32 = field(init=False)

    def __post_init__(self) -> None:
        for name in ("lower", "widths", "signs", "sizes", "signed", "planes", "logits"):
            setattr(self, name, np.zeros(self.layout.cells, np.int32))
        self.scale = np.full(self.layout.cells, UNIT_SCALE, np.int32)

    def update_sizes(self) -> None:
        """Compute `sizes` and `signed` for the current threshold."""
        kernel.update_sizes(self.lower, self.widths, self.signs, self.sizes, self.signed, self.threshold)


@dataclass
class Coder:
    """The range coder with its input or output.

    Attributes:
        mode: `range_coder.WRITE`, `READ` or `COLLECT`.
        data: Bytes to read, or written so far.
        words: State of the coder; see `range_coder`.
        best: The best complete stream so far (WRITE).
        curve: Squared error by number of bytes (WRITE); `curve[0]` is the current error.
        decisions: Training examples of decisions (COLLECT).
        sign_decisions: Training examples of signs (COLLECT).
    """

    mode: int
    data: U8
    words: I64 = field(default_factory=lambda: np.zeros(range_coder.CODER_WORDS, np.int64))
    best: U8 = field(default_factory=lambda: np.zeros(0, np.uint8))
    curve: I64 = field(default_factory=lambda: np.zeros(1, np.int64))
    decisions: I16 = field(default_factory=lambda: np.zeros((0, contexts.FEATURES + 3), np.int16))
    sign_decisions: I16 = field(default_factory=lambda: np.zeros((0, contexts.SIGN_FEATURES + 2), np.int16))

    @classmethod
    def reader(cls, body: bytes) -> Coder:
        """Return a coder that reads a body."""
        coder = cls(range_coder.READ, np.frombuffer(body, np.uint8).copy())
        range_coder.start_reading(coder.words, coder.data)
        return coder

    @classmethod
    def writer(cls, limit_bytes: int, prefix: bytes = b"") -> Coder:
        """Return a coder that writes a body of at most `limit_bytes` that starts with `prefix`.

        The first bits written must be those of `prefix`. Later bits are inverted if they would change the prefix.
        """
        coder = cls(range_coder.WRITE, np.zeros(limit_bytes + 8, np.uint8))
        coder.best = np.zeros(limit_bytes, np.uint8)
        coder.curve = np.full(limit_bytes + 2, -1, np.int64)
        coder.words[range_coder.CODER_RANGE] = (1 << 32) - 1
        coder.words[range_coder.CODER_LIMIT] = limit_bytes
        coder.words[range_coder.CODER_PREFIX] = len(prefix)
        coder.best[: len(prefix)] = np.frombuffer(prefix, np.uint8)
        return coder

    def record_error(self) -> None:
        """Store the current squared error as that of the bytes so far."""
        position = 1 + (int(self.words[range_coder.CODER_COST]) >> 11)
        self.curve[min(position, len(self.curve) - 1)] = self.curve[0]

    def finish(self) -> bytes:
        """Return the shortest body within the budget that determines all bits written."""
        range_coder.finish_writing(self.words, self.data, self.best)
        return self.best[: int(self.words[range_coder.CODER_BEST_LENGTH])].tobytes()

    def code_bit(self, bit: int, probability: int = 32768) -> int:
        """Write or read one bit with `probability` / 65536 of 1; return it, or -1 at the end."""
        if self.mode == range_coder.COLLECT:
            return bit
        if self.mode == range_coder.WRITE:
            own = probability if bit else 65536 - probability
            self.words[range_coder.CODER_COST] += round(256 * (16 - np.log2(own)))
        return int(range_coder.code_bit(self.words, self.data, self.best, bit, probability, self.mode))
