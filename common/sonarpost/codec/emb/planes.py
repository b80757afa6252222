"""Coding a picture's coefficients plane by plane: what both ends do in the same order."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import kernel, transform
from sonarpost.codec.emb.layout import HEIGHT, HH, HL, LEVEL, LH, LL, OFFSET, ORIENT, STRIDE, WIDTH, Layout
from sonarpost.codec.emb.model import Model

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]

# First threshold in coefficient units (1/64 grey) for each start step: 2880 grey, 2^(1/8) apart, each a multiple of 2^10.
STEPS: Final = tuple(round(2880 * 64 / 1024 * 2 ** (-i / 8)) * 1024 for i in range(8))
PLANES: Final = 10
_FIRST_PLANE: Final = {1: 3, 2: 2, 3: 1}
"""Plane from which a level is coded; its coefficients cannot be (or hardly ever are) larger than twice that threshold."""
_CENTRE: Final = 16


@dataclass
class State:
    """What is known of a picture's coefficients; flat arrays of `Layout.cells`, see `kernel.code_band`."""

    lay: Layout
    values: I32 = field(init=False)
    widths: I32 = field(init=False)
    signs: I32 = field(init=False)
    seen: I32 = field(init=False)
    signed: I32 = field(init=False)
    marks: I32 = field(init=False)

    def __post_init__(self) -> None:
        for name in ("values", "widths", "signs", "seen", "signed", "marks"):
            setattr(self, name, np.zeros(self.lay.cells, np.int32))


@dataclass
class Coder:
    """The range coder and where it writes to or reads from."""

    mode: int
    data: npt.NDArray[np.uint8]
    words: I64 = field(default_factory=lambda: np.zeros(kernel.CODER_WORDS, np.int64))
    good: npt.NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    curve: I64 = field(default_factory=lambda: np.zeros(1, np.int64))
    rows: npt.NDArray[np.int16] = field(default_factory=lambda: np.zeros((0, kernel.FEATURES + 3), np.int16))
    sign_rows: npt.NDArray[np.int16] = field(default_factory=lambda: np.zeros((0, kernel.SIGN_FEATURES), np.int16))

    @classmethod
    def reader(cls, body: bytes) -> Coder:
        """Read from a body."""
        coder = cls(kernel.READ, np.frombuffer(body, np.uint8).copy())
        kernel.start_reading(coder.words, coder.data)
        return coder

    @classmethod
    def writer(cls, limit_bytes: int) -> Coder:
        """Write a body of at most `limit_bytes`."""
        coder = cls(kernel.WRITE, np.zeros(limit_bytes + 8, np.uint8))
        coder.good = np.zeros(limit_bytes, np.uint8)
        coder.curve = np.full(limit_bytes + 2, -1, np.int64)
        coder.words[kernel.CODER_RANGE] = (1 << 32) - 1
        coder.words[kernel.CODER_LIMIT] = limit_bytes
        return coder

    def plain(self, bit: int, chance: int = 32768) -> int:
        """Write or read one decision; -1 at the end."""
        if self.mode == kernel.LIST:
            return bit
        if self.mode == kernel.WRITE:
            share = chance if bit else 65536 - chance
            self.words[kernel.CODER_COST] += round(256 * (16 - np.log2(share)))
        return int(kernel.code_plain(self.words, self.data, self.good, bit, chance, self.mode))


def code_planes(
    coder: Coder, state: State, model: Model, targets: I32, step: int, mean: int, price: int = 0, planes: int = PLANES
) -> None:
    """Write, read or list plane after plane until the coder stops.

    Args:
        coder: Where to.
        state: What is known; brought forward.
        model: The networks.
        targets: True coefficients, flat, int32; anything where the coder reads.
        step: Start step, index into STEPS.
        mean: The picture's mean level in grey.
        price: See `kernel.code_band`.
        planes: How many to code at most.
    """
    lay = state.lay
    features = np.zeros(kernel.FEATURES, np.int32)
    base = np.zeros((2, kernel.HIDDEN_1), np.int32)
    counts = np.zeros(len(lay.bands), np.int64)
    for plane in range(planes):
        threshold = STEPS[step] >> plane
        kernel.refresh(state.values, state.widths, state.signs, state.seen, state.signed, threshold)
        rows = [i for i, band in enumerate(lay.bands) if plane >= _FIRST_PLANE.get(int(band[LEVEL]), 0)]
        finest = min(int(lay.bands[i][LEVEL]) for i in rows)
        lows = low_pictures(state, model, mean, finest)
        for kind in (kernel.NEAR, kernel.REFINE, kernel.FAR):
            for row in rows:
                band = lay.bands[row]
                if kind == kernel.FAR and row < 4:
                    continue  # coarse bands are all near
                if row == 1 and kind != kernel.REFINE:
                    lows = low_pictures(state, model, mean, finest)
                _band_features(features, band, threshold, mean, _density(state, band, counts, row))
                for net in (0, 1):
                    kernel.band_base(features, model.w1[net], model.b1[net], 34, base[net])
                end = kernel.code_band(
                    coder.mode, kind, plane + 1, threshold, row, int(lay.sides[band[LEVEL], 1]), lay.bands, targets,
                    state.values, state.widths, state.signs, state.seen, state.signed, state.marks, lows, features,
                    base[0], base[1], model.w1, model.w2, model.b2, model.w3, model.b3, model.sign_w1, model.sign_b1,
                    model.sign_w2, model.chances, model.costs, model.gains, price, coder.words, coder.data, coder.good,
                    coder.curve, coder.rows, coder.sign_rows,
                )  # fmt: skip
                if end < 0:
                    return


def _density(state: State, band: I32, counts: I64, row: int) -> int:
    """Share of the band that is significant, 8 log2 of it per 1/1024, shifted to be about zero."""
    cells = int(band[HEIGHT]) * int(band[WIDTH])
    start = int(band[OFFSET]) - 2 * int(band[STRIDE]) - 2
    stop = start + (int(band[HEIGHT]) + 4) * int(band[STRIDE])
    significant = int(np.count_nonzero(state.values[start:stop]))
    share = (2048 * significant + 512) // (cells + 1)
    return _log2_eighths(share + 1) - 40


def _log2_eighths(value: int) -> int:
    power = value.bit_length() - 1
    return 8 * power + ((value << 3) >> power) - 8


def _band_features(features: I32, band: I32, threshold: int, mean: int, density: int) -> None:
    level, orient = int(band[LEVEL]), int(band[ORIENT])
    features[34:] = 0
    if orient != LL:
        features[33 + min(level, 4)] = 32
    for column, kind in ((38, HL), (39, LH), (40, HH)):
        features[column] = 32 if orient == kind else 0
    features[41] = _log2_eighths(threshold) - 104
    features[42] = _log2_eighths(max(mean, 4)) - 48
    features[43] = density


def low_pictures(state: State, model: Model, mean: int, down_to: int) -> I32:
    """The low-pass pictures of what is known so far, in 1/64 grey times 2^level."""
    plane = known_plane(state, model)
    _, lows = transform.inverse(plane, state.lay, down_to)
    for level in range(down_to, state.lay.levels + 1):
        at = int(state.lay.low_offsets[level])
        height, width = (int(n) + 2 for n in state.lay.sides[level])
        lows[at : at + height * width] += mean * transform.UNIT << level
    return lows


def known_plane(state: State, model: Model) -> I64:
    """Most likely value of every coefficient, in the transform's square layout."""
    size = np.minimum(state.values // np.maximum(state.widths, 1), 4)
    centre = model.centres[size]
    flat = state.signs * (state.values + ((state.widths * centre) >> 8))
    return transform.from_flat(flat, state.lay)
