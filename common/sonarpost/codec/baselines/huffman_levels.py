"""The picture level of `huffman`: which grey levels, in which resolution.

How they are written is told in `sonarpost.codec.baselines.huffman`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow
from scipy import ndimage

from sonarpost.codec.baselines.huffman_code import Bits, Integers, canonical_codes, code_lengths, differences, gamma
from sonarpost.codec.interface import Image, Mask
from sonarpost.errors import StreamError

MAX_CHOSEN_LEVELS = 16
FULL_SCALE = 32

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class QuantisedImage:
    """A quantised picture, ready to be written.

    Attributes:
        scale: n, in 32nds of the picture's sides.
        prefix: The bytes that say scale and levels.
        levels: Grey level of each symbol, shape (symbols,).
        lengths: Code length of each symbol.
        symbols: Shape of the (reduced) picture.
        bits: Length of the body in bits.
    """

    scale: int
    prefix: bytes
    levels: Integers
    lengths: list[int]
    symbols: Integers
    bits: int

    def body(self) -> bytes:
        """Return the body, zero bits at its end."""
        codes = canonical_codes(self.lengths)
        head = "".join(gamma(value) for value in differences(self.lengths)) if len(self.levels) > 2 else ""
        text = [f"{code:0{length}b}" if length else "" for code, length in zip(codes, self.lengths, strict=True)]
        bits = head + "".join([text[symbol] for symbol in self.symbols.ravel().tolist()])
        return self.prefix + np.packbits(np.frombuffer(bits.encode(), np.uint8) - ord("0")).tobytes()


def reduced_side(side_px: int, scale: int) -> int:
    """Return a side reduced to `scale` / 32, at least 1 px."""
    return max(1, (side_px * scale + FULL_SCALE // 2) // FULL_SCALE)


def _reduce(image: Image, scale: int) -> Image:
    size = (reduced_side(image.shape[1], scale), reduced_side(image.shape[0], scale))
    return np.asarray(Pillow.fromarray(image).resize(size, Pillow.Resampling.BICUBIC), dtype=np.uint8)


def enlarge(image: Image, shape: tuple[int, int]) -> Image:
    """Return the picture in another size, shape `shape`, uint8 (bicubic); a copy where it has that size."""
    if image.shape == shape:
        return image.copy()
    resized = Pillow.fromarray(image).resize((shape[1], shape[0]), Pillow.Resampling.BICUBIC)
    return np.array(resized, dtype=np.uint8)


def enlarge_mask(lost: Mask, shape: tuple[int, int]) -> Mask:
    """Return which pixels depend on a lost one; bicubic enlarging looks two pixels far, bilinear one."""
    if lost.shape == shape:
        return lost
    wider = ndimage.maximum_filter(lost.astype(np.float32), size=3, mode="nearest")
    resized = Pillow.fromarray(wider).resize((shape[1], shape[0]), Pillow.Resampling.BILINEAR)
    return np.asarray(np.array(resized) > 0, dtype=np.bool_)


def nearest(image: Image, limit_bits: int) -> QuantisedImage | None:
    """Return the quantised picture, reduced or not, that fits and is nearest to `image`, or None."""
    best, least = None, 0
    for coded in _finest_each(image, limit_bits):
        rebuilt = enlarge(coded.levels[coded.symbols].astype(np.uint8), image.shape)
        error = int(((rebuilt.astype(np.int64) - image) ** 2).sum())
        if best is None or error < least:
            best, least = coded, error
        if error == 0:
            break
    return best


def _finest_each(image: Image, limit_bits: int) -> Iterator[QuantisedImage]:
    """Return the finest equally spaced levels that fit, then the finest chosen ones in each resolution."""
    spaced = (_spaced(image, step) for step in range(1, MAX_CHOSEN_LEVELS))
    yield from islice((coded for coded in spaced if coded is not None and coded.bits <= limit_bits), 1)
    for scale in range(FULL_SCALE, 0, -1):
        small = _reduce(image, scale)
        if small.size > limit_bits and scale > 1:
            continue  # a pixel takes a bit, unless all are equal: then any other scale shows the same
        chosen = chosen_levels(small, scale, range(MAX_CHOSEN_LEVELS, 0, -1))
        yield from islice((coded for coded in chosen if coded.bits <= limit_bits), 1)


def _spaced(image: Image, step: int) -> QuantisedImage | None:
    """Quantise to levels `step` apart, or return None if those are few enough to be chosen."""
    low, high = int(image.min()), int(image.max())
    count = (high - low) // step + 1
    if count <= MAX_CHOSEN_LEVELS:
        return None
    symbols = (image.astype(np.int64) - low) // step
    prefix = bytes([FULL_SCALE - 1, MAX_CHOSEN_LEVELS - 1 + step, low, count - 1])
    return _coded(FULL_SCALE, prefix, _spaced_levels(low, step, count), symbols)


def _spaced_levels(low: int, step: int, count: int) -> Integers:
    return np.minimum(low + step * np.arange(count, dtype=np.int64) + (step - 1) // 2, 255)


def chosen_levels(image: Image, scale: int, counts: Iterable[int]) -> Iterator[QuantisedImage]:
    """Quantise to so many levels with the least squared error, for each number in `counts`."""
    greys, counted = np.unique(image, return_counts=True)
    starts = _least_error_starts(greys.astype(np.float64), counted.astype(np.float64))
    for count in counts:
        edges = [len(greys)]
        for used in range(min(count, len(greys)), 0, -1):
            edges.append(int(starts[used - 1, edges[-1]]))
        first = edges[:0:-1]
        means = np.add.reduceat(greys * counted.astype(np.float64), first) / np.add.reduceat(counted, first)
        levels = np.floor(means + 0.5).astype(np.int64)
        symbols = np.searchsorted(greys[first], image, side="right") - 1
        yield _coded(scale, bytes([scale - 1, len(levels) - 1, *levels.tolist()]), levels, symbols)


def _least_error_starts(greys: _Floats, counted: _Floats) -> Integers:
    """Return where the last group starts when the first greys are cut into groups with the least squared error.

    Dynamic programming: the best cut into one group more ends with the group that adds least to a best cut before it.

    Args:
        greys: Shape (n,), float64: the picture's grey levels, rising.
        counted: Shape (n,), float64: how many pixels have them.

    Returns:
        Shape (16, n + 1): [groups - 1, how many greys are cut].
    """
    sums = [np.concatenate(([0.0], np.cumsum(counted * greys**power))) for power in range(3)]
    count, first, second = (total[None, :] - total[:, None] for total in sums)  # [start, stop]
    filled = count > 0
    cost = np.where(filled, second - first**2 / np.where(filled, count, 1.0), np.inf)
    starts = np.zeros((MAX_CHOSEN_LEVELS, len(greys) + 1), dtype=np.int64)
    least = cost[0]
    for groups in range(1, MAX_CHOSEN_LEVELS):
        total = least[:, None] + cost
        starts[groups] = np.argmin(total, axis=0)
        least = np.take_along_axis(total, starts[groups][None, :], axis=0)[0]
    return starts


def _coded(scale: int, prefix: bytes, levels: Integers, symbols: Integers) -> QuantisedImage:
    counts = np.bincount(symbols.ravel(), minlength=len(levels)).tolist()
    lengths = code_lengths(counts)
    bits = 8 * len(prefix) + sum(c * length for c, length in zip(counts, lengths, strict=True))
    if len(levels) > 2:
        bits += sum(len(gamma(value)) for value in differences(lengths))
    return QuantisedImage(scale, prefix, levels, lengths, symbols, bits)


def read_levels(bits: Bits) -> tuple[int, Integers]:
    """Read scale and grey levels, the start of a body.

    Returns:
        The scale, 1..32, and the levels, shape (levels,), int64.

    Raises:
        EndOfBitsError: The bits end before the last level.
        StreamError: Scale or levels cannot be right.
    """
    scale, kind = bits.read(8) + 1, bits.read(8)
    if scale > FULL_SCALE:
        raise StreamError("huffman body", "scale", scale, f"1..{FULL_SCALE}")
    if kind < MAX_CHOSEN_LEVELS:
        levels = np.array([bits.read(8) for _ in range(kind + 1)], dtype=np.int64)
        if (np.diff(levels) <= 0).any():
            raise StreamError("huffman body", "levels", levels.tolist(), "rising grey levels")
        return scale, levels
    if kind >= 2 * MAX_CHOSEN_LEVELS - 1:
        raise StreamError("huffman body", "kind", kind, f"0..{2 * MAX_CHOSEN_LEVELS - 2}")
    low, count = bits.read(8), bits.read(8) + 1
    return scale, _spaced_levels(low, kind - MAX_CHOSEN_LEVELS + 1, count)
