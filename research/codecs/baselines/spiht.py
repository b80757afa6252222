"""SPIHT: set partitioning in hierarchical trees, one of the four codecs that the paper compares.

A. Said, W. A. Pearlman, "A new, fast, and efficient image codec based on set partitioning in hierarchical trees", IEEE
Trans. Circuits and Systems for Video Technology 6(3), 1996, without arithmetic coding. The stream is embedded:
truncated at any bit, it decodes to the best image that the remaining bits give.

The transform is the 9/7 wavelet by lifting (Daubechies and Sweldens, 1998), with whole-sample symmetric extension, in
fixed-point integers: all machines agree to the last bit. Images of any size are transformed without padding. In bands
of odd size, the last row and column belong to the last parent.

Body, most significant bit first: mean grey level / 8 (5 bits); phase (2 bits); highest plane (5 bits); the passes; zero
bits up to a whole byte. In plane k a coefficient is significant from (4 + phase) * 2**k / 8 grey levels. The four
phases divide the octave between two planes. With a budget, the encoder sends the phase with the smallest error, which
gains about 0.1 dB.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from sonarpost.codec.interface import DecodedImage, Image, Mask, SnippetPixels, decoder_input, encoder_input
from sonarpost.errors import StreamError

Integers = npt.NDArray[np.int64]

DEFAULT_PASSES = 7  # the larger SPIHT image in Fig. 2 of the paper
MAX_PLANES = 20
"""The energy of 512 x 512 px keeps every coefficient below plane 18."""
FRACTION_BITS = 8
"""Fraction bits of wavelet coefficients."""
PHASE_STEP = 1 << (FRACTION_BITS - 3)
"""One step of the phase, 1/8 grey level, in coefficient units."""
_PREFIX_BITS = 12
_MEAN_STEP = 8

# Lifting steps of the 9/7 wavelet and the scale that makes it nearly orthonormal, times 2**16.
_LIFT = (-103949, -3472, 57862, 29066)
_LOW_GAIN, _HIGH_GAIN = 75340, 57008


@dataclass(frozen=True)
class SpihtCodec:
    """SPIHT without arithmetic coding. Implements `sonarpost.codec.Codec`."""

    name: ClassVar[str] = "spiht"
    codec_id: ClassVar[int] = 0x04
    model_hash: ClassVar[str] = ""

    def encode(self, image: SnippetPixels, budget_bytes: int | None = None) -> bytes:
        """Return the stream (see `Codec.encode`): the whole budget, or seven bit-plane passes without one."""
        grey, header = encoder_input(self, image)
        if budget_bytes is not None and budget_bytes < header.size + 2:
            raise StreamError("codec spiht", "budget_bytes", budget_bytes, f"at least {header.size + 2} B")
        trees = wavelet_trees(*grey.shape)
        mean = (int(grey.sum(dtype=np.int64)) // grey.size) // _MEAN_STEP
        coefficients = forward_transform(grey, _MEAN_STEP * mean + _MEAN_STEP // 2, trees)
        if budget_bytes is None:
            return header.pack() + _write_body(coefficients, mean, 0, trees, DEFAULT_PASSES, None)
        length = budget_bytes - header.size
        bodies = [_write_body(coefficients, mean, phase, trees, MAX_PLANES, length) for phase in range(4)]
        errors = [int(((_read_body(body, trees).astype(np.int64) - grey) ** 2).sum()) for body in bodies]
        return header.pack() + bodies[errors.index(min(errors))]

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Reconstruct the image (see `Codec.decode`).

        A truncated stream gives a coarser image without missing pixels. If the first two body bytes did not arrive, all
        pixels are missing.
        """
        header, body, notes = decoder_input(self, stream, received)
        if 8 * len(body) < _PREFIX_BITS:
            notes.append(f"{len(body)} B of the body arrived, at least 2 are needed")
            return DecodedImage.all_missing(header, notes)
        return DecodedImage.without_gaps(_read_body(body, wavelet_trees(header.height_px, header.width_px)), notes)


def _write_body(
    coefficients: Integers, mean: int, phase: int, trees: WaveletTrees, passes: int, length: int | None
) -> bytes:
    """Return a body of at most `length` bytes and at most `passes` planes."""
    state = CoderState.for_encoding(coefficients, phase, trees)
    top = state.planes - 1
    bits = bytearray()
    limit = MAX_PLANES * trees.size * 4 if length is None else 8 * length - _PREFIX_BITS

    def write(bit: int) -> int:
        if len(bits) >= limit:
            raise EndOfBits
        bits.append(bit)
        return bit

    with suppress(EndOfBits):
        run_passes(trees, range(top, max(top - passes, -1), -1), state, write)
    prefix = f"{mean:05b}{phase:02b}{top:05b}".encode()
    return np.packbits(np.frombuffer(bytes(bit - ord("0") for bit in prefix) + bits, np.uint8)).tobytes()


def _read_body(body: bytes, trees: WaveletTrees) -> Image:
    """Return the image of a body of at least 2 bytes."""
    mean, phase, top = (body[0] >> 3), (body[0] >> 1) & 3, (body[0] & 1) << 4 | body[1] >> 4
    if top >= MAX_PLANES:
        raise StreamError("spiht body", "highest plane", top, f"0..{MAX_PLANES - 1}")
    bits = iter(np.unpackbits(np.frombuffer(body, np.uint8)).tolist()[_PREFIX_BITS:])

    def read(_: int) -> int:
        bit = next(bits, None)
        if bit is None:
            raise EndOfBits
        return bit

    state = CoderState.for_decoding(trees)
    with suppress(EndOfBits):
        run_passes(trees, range(top, -1, -1), state, read)
    return inverse_transform(state.reconstructed(phase), _MEAN_STEP * mean + _MEAN_STEP // 2, trees)


class EndOfBits(Exception):  # noqa: N818  (no error: the budget is used up, or the stream ends)
    """The budget is used up, or the stream ends."""


@dataclass
class CoderState:
    """The coefficients that the encoder codes (zeros in the decoder), and what is coded so far.

    Attributes:
        magnitudes: Quantised magnitude of each coefficient.
        negative: 1 for a negative coefficient.
        below: Largest magnitude among the descendants of each coefficient.
        below_children: Largest magnitude among the descendants of its children.
        lower: Coded lower bound of each magnitude; 0 for insignificant coefficients.
        width: Width of the interval above the lower bound.
        sign: 1 or -1.
    """

    magnitudes: list[int]
    negative: list[int]
    below: list[int]
    below_children: list[int]
    lower: list[int]
    width: list[int]
    sign: list[int]

    @classmethod
    def for_decoding(cls, trees: WaveletTrees) -> CoderState:
        """Return the initial state of the decoder."""
        zeros = [0] * trees.size
        return cls(zeros, zeros, zeros, zeros, zeros.copy(), zeros.copy(), [1] * trees.size)

    @classmethod
    def for_encoding(cls, coefficients: Integers, phase: int, trees: WaveletTrees) -> CoderState:
        """Return the initial state of the encoder."""
        quantised = np.abs(coefficients) // ((4 + phase) * PHASE_STEP)
        below, below_children = np.zeros_like(quantised), np.zeros_like(quantised)
        ends = [trees.roots, *(start + h * w for start, h, w in trees.bands[2::3])]
        for start, stop in reversed(list(pairwise(ends))):
            parents = trees.parents[start:stop]
            np.maximum.at(below_children, parents, below[start:stop])
            np.maximum.at(below, parents, np.maximum(quantised[start:stop], below[start:stop]))
        state = cls.for_decoding(trees)
        state.magnitudes, state.negative = quantised.tolist(), (coefficients < 0).astype(int).tolist()
        state.below, state.below_children = below.tolist(), below_children.tolist()
        return state

    @property
    def planes(self) -> int:
        """Number of bit planes."""
        return max(max(self.magnitudes).bit_length(), 1)

    def reconstructed(self, phase: int) -> Integers:
        """Return the reconstructed coefficients, shape (trees.size,), in 2**-8 grey levels."""
        lower, width, sign = (np.array(values, dtype=np.int64) for values in (self.lower, self.width, self.sign))
        # Small coefficients are more frequent than large ones within an interval too: 3/8 of the width, not 1/2.
        return sign * ((8 * lower + 3 * width) * ((4 + phase) * PHASE_STEP) >> 3)


def run_passes(trees: WaveletTrees, planes: range, state: CoderState, code: Callable[[int], int]) -> None:
    """Code plane by plane in the order of SPIHT until `code` raises EndOfBits. Encoder and decoder share this function.

    Args:
        trees: The trees.
        planes: Bit planes in order.
        state: Coefficients; what is coded is stored in it.
        code: Writes its argument, or reads a bit and ignores its argument; returns the bit.
    """
    children = trees.children
    insignificant = list(range(trees.roots))
    significant: list[int] = []
    sets = [(node, False) for node in range(trees.roots) if children[node]]  # insignificant sets; True: type B
    for plane in planes:
        found: list[int] = []

        def classify(node: int, plane: int = plane, found: list[int] = found) -> bool:
            if not code(state.magnitudes[node] >> plane & 1):
                return False
            found.append(node)
            # A coefficient without a coded sign stays zero.
            state.sign[node] = -1 if code(state.negative[node]) else 1
            state.lower[node] = state.width[node] = 1 << plane
            return True

        insignificant = [node for node in insignificant if not classify(node)]
        remaining: list[tuple[int, bool]] = []
        for node, is_type_b in sets:  # the loop appends to the list
            if not code((state.below_children if is_type_b else state.below)[node] >> plane & 1):
                remaining.append((node, is_type_b))
            elif is_type_b:
                sets.extend((child, False) for child in children[node] if children[child])
            else:
                insignificant.extend([child for child in children[node] if not classify(child)])
                if any(children[child] for child in children[node]):
                    sets.append((node, True))
        sets = remaining
        for node in significant:
            state.lower[node] += code(state.magnitudes[node] >> plane & 1) << plane
            state.width[node] = 1 << plane
        significant += found


@dataclass(frozen=True)
class WaveletTrees:
    """The coefficients of an image size in one row, and the trees over them.

    Attributes:
        shapes: Height and width of the image and of each low band, finest first.
        size: Number of coefficients.
        roots: Number of coefficients of the lowest band, which come first.
        bands: Start, height and width of each detail band; HL, LH, HH, coarsest level first.
        parents: Parent of each coefficient, -1 for a root.
        children: Children of each coefficient.
    """

    shapes: tuple[tuple[int, int], ...]
    size: int
    roots: int
    bands: tuple[tuple[int, int, int], ...]
    parents: Integers
    children: tuple[tuple[int, ...], ...]


@lru_cache(maxsize=8)
def wavelet_trees(height_px: int, width_px: int) -> WaveletTrees:
    """Return the trees of an image size. The shorter side of the lowest band is one coefficient."""
    shapes = [(height_px, width_px)]
    while min(shapes[-1]) >= 2:
        shapes.append(((shapes[-1][0] + 1) // 2, (shapes[-1][1] + 1) // 2))
    low_h, low_w = shapes[-1]
    parents, bands, start = [np.full(low_h * low_w, -1, dtype=np.int64)], [], low_h * low_w
    coarser = [(0, low_h, low_w, 1)] * 3
    for (h, w), (half_h, half_w) in zip(reversed(shapes[:-1]), reversed(shapes[1:]), strict=True):
        level = []
        for (parent_start, parent_h, parent_w, step), size in zip(
            coarser, ((half_h, w // 2), (h // 2, half_w), (h // 2, w // 2)), strict=True
        ):
            rows = np.minimum(np.arange(size[0]) // step, parent_h - 1)
            columns = np.minimum(np.arange(size[1]) // step, parent_w - 1)
            parents.append((parent_start + rows[:, None] * parent_w + columns).ravel())
            level.append((start, *size, 2))
            bands.append((start, *size))
            start += size[0] * size[1]
        coarser = level
    flat = np.concatenate(parents)
    order = np.argsort(flat, kind="stable")
    ends = np.searchsorted(flat[order], np.arange(start + 1)).tolist()
    ordered = order.tolist()
    children = tuple(tuple(ordered[a:b]) for a, b in pairwise(ends))
    return WaveletTrees(tuple(shapes), start, low_h * low_w, tuple(bands), flat, children)


def forward_transform(image: Image, mean: int, trees: WaveletTrees) -> Integers:
    """Return the coefficients of the image minus `mean`, shape (trees.size,), in 2**-8 grey levels."""
    low = (image.astype(np.int64) - mean) << FRACTION_BITS
    flat = np.empty(trees.size, dtype=np.int64)
    for level in range(len(trees.shapes) - 1):
        top, bottom = _analyse(low)
        low, hl = (band.T for band in _analyse(top.T))
        lh, hh = (band.T for band in _analyse(bottom.T))
        first = len(trees.bands) - 3 * (level + 1)
        for (start, h, w), band in zip(trees.bands[first : first + 3], (hl, lh, hh), strict=True):
            flat[start : start + h * w] = band.ravel()
    flat[: trees.roots] = low.ravel()
    return flat


def inverse_transform(flat: Integers, mean: int, trees: WaveletTrees) -> Image:
    """Return the image of coefficients, shape `trees.shapes[0]`, uint8."""
    low = flat[: trees.roots].reshape(trees.shapes[-1])
    for level in range(len(trees.shapes) - 1):
        hl, lh, hh = (
            flat[start : start + h * w].reshape(h, w) for start, h, w in trees.bands[3 * level : 3 * level + 3]
        )
        low = _synthesise(_synthesise(low.T, hl.T).T, _synthesise(lh.T, hh.T).T)
    grey = ((low + (1 << (FRACTION_BITS - 1))) >> FRACTION_BITS) + mean
    return np.asarray(np.clip(grey, 0, 255), dtype=np.uint8)


def _analyse(samples: Integers) -> tuple[Integers, Integers]:
    """Split along axis 0 (at least 2 long) into the low band of length ceil(n / 2) and the high band."""
    even, odd = samples[0::2].copy(), samples[1::2].copy()
    for step in (0, 2):
        odd += _scale(_sum_of_even_neighbours(even, len(odd)), _LIFT[step])
        even += _scale(_sum_of_odd_neighbours(odd, len(even)), _LIFT[step + 1])
    return _scale(even, _LOW_GAIN), _scale(odd, _HIGH_GAIN)


def _synthesise(low: Integers, high: Integers) -> Integers:
    """Invert `_analyse` along axis 0, except for the rounding of the last fraction bit."""
    even, odd = _scale(low, _HIGH_GAIN), _scale(high, _LOW_GAIN)
    for step in (2, 0):
        even -= _scale(_sum_of_odd_neighbours(odd, len(even)), _LIFT[step + 1])
        odd -= _scale(_sum_of_even_neighbours(even, len(odd)), _LIFT[step])
    samples = np.empty((len(even) + len(odd), *even.shape[1:]), dtype=np.int64)
    samples[0::2], samples[1::2] = even, odd
    return samples


def _scale(values: Integers, factor: int) -> Integers:
    return (values * factor + (1 << 15)) >> 16


def _sum_of_even_neighbours(even: Integers, count: int) -> Integers:
    """Sum the even samples on both sides of each of `count` odd ones, mirrored at the end."""
    right = even[1 : count + 1]
    if len(right) < count:
        right = np.concatenate((right, even[-1:]))
    return even[:count] + right


def _sum_of_odd_neighbours(odd: Integers, count: int) -> Integers:
    """Sum the odd samples on both sides of each of `count` even ones, mirrored at both ends."""
    left = np.concatenate((odd[:1], odd))[:count]
    right = odd if len(odd) == count else np.concatenate((odd, odd[-1:]))
    return left + right
