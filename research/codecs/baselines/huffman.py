"""Huffman coding of quantised grey levels, one of the four codecs that the paper compares.

The encoder chooses up to 16 grey levels that minimise the squared error, by dynamic programming over the histogram.
More than 16 levels are equally spaced; a spacing of 1 is lossless. Every pixel costs at least one bit. For small
budgets the encoder therefore also reduces the image to n/32 of its sides, for all n from 1 to 32. For each n it uses as
many levels as fit, and it sends the candidate with the smallest error after enlarging.

Body, most significant bit first: n - 1 (u8); kind (u8); levels; code lengths; the pixels in raster order.

* kind 0..15: kind + 1 levels follow, one byte each, rising.
* kind 16..30: the levels are kind - 15 apart; the lowest level (u8) and the number of levels - 1 (u8) follow.
* Code lengths, 0 (unused level) to 15, as differences d from the previous one (the first from 0), in Elias gamma code
  of 2d + 1 (d >= 0) or -2d. Absent for one level (pixels need no bits) and for two (one bit each). The codes are
  canonical.
"""

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from sonarpost.codec.interface import DecodedImage, Image, Mask, SnippetPixels, decoder_input, encoder_input
from sonarpost.errors import ConfigError, StreamError

DEFAULT_LEVELS = 4
MAX_CHOSEN_LEVELS = 16
MAX_CODE_BITS = 15
FULL_SCALE = 32

Integers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class HuffmanCodec:
    """Huffman coding of grey levels. Implements `sonarpost.codec.Codec`.

    Attributes:
        levels: Number of grey levels without a budget, 1..16.

    Raises:
        ConfigError: `levels` is out of range.
    """

    levels: int = DEFAULT_LEVELS
    name: ClassVar[str] = "huffman"
    codec_id: ClassVar[int] = 0x01
    model_hash: ClassVar[str] = ""

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= MAX_CHOSEN_LEVELS:
            raise ConfigError("codec huffman", "levels", self.levels, f"1..{MAX_CHOSEN_LEVELS}")

    def encode(self, image: SnippetPixels, budget_bytes: int | None = None) -> bytes:
        """Return the stream (see `Codec.encode`); without a budget, `levels` grey levels in full resolution."""
        grey, header = encoder_input(self, image)
        if budget_bytes is None:
            return header.pack() + next(_chosen_levels(grey, FULL_SCALE, [self.levels])).body()
        best = _best_candidate(grey, 8 * (budget_bytes - header.size))
        if best is None:
            raise StreamError("codec huffman", "budget_bytes", budget_bytes, f"at least {header.size + 3} B")
        return header.pack() + best.body()

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Reconstruct the image (see `Codec.decode`). Pixels after the first gap are missing."""
        header, body, notes = decoder_input(self, stream, received)
        shape = (header.height_px, header.width_px)
        bits = BitReader(body)
        try:
            scale, levels = _read_levels(bits)
            small_shape = (_reduced_side(shape[0], scale), _reduced_side(shape[1], scale))
            symbols, count = _read_symbols(bits, len(levels), small_shape[0] * small_shape[1])
        except EndOfBitsError:
            return DecodedImage.all_missing(header, [*notes, f"body ends after {len(body)} B, before the first pixel"])
        if count < len(symbols):
            notes.append(f"{len(symbols) - count} of {len(symbols)} pixels did not arrive")
        elif bits.bytes_left:
            notes.append(f"{bits.bytes_left} B after the body ignored")
        missing = _enlarge_mask((np.arange(len(symbols)) >= count).reshape(small_shape), shape)
        image = _enlarge(levels[symbols].reshape(small_shape).astype(np.uint8), shape)
        image[missing] = 0
        return DecodedImage(image, missing, tuple(notes))


@dataclass(frozen=True)
class QuantisedImage:
    """A quantised image.

    Attributes:
        prefix: Body bytes with scale and levels.
        levels: Grey level of each symbol, shape (symbols,).
        lengths: Code length of each symbol.
        symbols: Symbol of each pixel; shape of the reduced image.
        bits: Length of the body in bits.
    """

    prefix: bytes
    levels: Integers
    lengths: list[int]
    symbols: Integers
    bits: int

    def body(self) -> bytes:
        """Return the body, padded with zero bits."""
        codes = zip(canonical_codes(self.lengths), self.lengths, strict=True)
        text = [f"{code:0{length}b}" if length else "" for code, length in codes]
        bits = "".join(_gamma(value) for value in _differences(self.lengths)) if len(self.levels) > 2 else ""
        bits += "".join([text[symbol] for symbol in self.symbols.ravel().tolist()])
        return self.prefix + np.packbits(np.frombuffer(bits.encode(), np.uint8) - ord("0")).tobytes()


def _reduced_side(side_px: int, scale: int) -> int:
    """Return a side reduced to `scale` / 32, at least 1 px."""
    return max(1, (side_px * scale + FULL_SCALE // 2) // FULL_SCALE)


def _reduce(image: Image, scale: int) -> Image:
    size = (_reduced_side(image.shape[1], scale), _reduced_side(image.shape[0], scale))
    return np.asarray(Pillow.fromarray(image).resize(size, Pillow.Resampling.BICUBIC), dtype=np.uint8)


def _enlarge(image: Image, shape: tuple[int, ...]) -> Image:
    """Return a copy of the image with another shape (bicubic)."""
    if image.shape == shape:
        return image.copy()
    resized = Pillow.fromarray(image).resize((shape[1], shape[0]), Pillow.Resampling.BICUBIC)
    return np.array(resized, dtype=np.uint8)


def _enlarge_mask(missing: Mask, shape: tuple[int, int]) -> Mask:
    """Return the enlarged pixels that depend on a missing one. Bicubic enlarging reads 2 px around, bilinear 1 px."""
    if missing.shape == shape:
        return missing
    padded = np.pad(missing, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    wider = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    resized = Pillow.fromarray(wider.astype(np.float32)).resize((shape[1], shape[0]), Pillow.Resampling.BILINEAR)
    return np.asarray(np.array(resized) > 0, dtype=np.bool_)


def _best_candidate(image: Image, limit_bits: int) -> QuantisedImage | None:
    """Return the candidate of at most `limit_bits` with the smallest error, or None if no candidate fits."""
    best, best_error = None, 0
    for candidate in _candidates(image, limit_bits):
        reconstructed = _enlarge(candidate.levels[candidate.symbols].astype(np.uint8), image.shape)
        error = int(((reconstructed.astype(np.int64) - image) ** 2).sum())
        if best is None or error < best_error:
            best, best_error = candidate, error
        if error == 0:
            break
    return best


def _candidates(image: Image, limit_bits: int) -> Iterator[QuantisedImage]:
    """Yield the finest equally spaced levels that fit, then the finest chosen levels that fit in each resolution."""
    spaced = (_spaced(image, step) for step in range(1, MAX_CHOSEN_LEVELS))
    yield from islice((one for one in spaced if one is not None and one.bits <= limit_bits), 1)
    for scale in range(FULL_SCALE, 0, -1):
        small = _reduce(image, scale)
        if small.size > limit_bits and scale > 1:
            continue  # a pixel needs a bit unless all pixels are equal, and then every scale gives the same image
        chosen = _chosen_levels(small, scale, range(MAX_CHOSEN_LEVELS, 0, -1))
        yield from islice((one for one in chosen if one.bits <= limit_bits), 1)


def _spaced(image: Image, step: int) -> QuantisedImage | None:
    """Quantise to levels `step` apart; None if there are 16 or fewer, which can be chosen freely."""
    low, high = int(image.min()), int(image.max())
    count = (high - low) // step + 1
    if count <= MAX_CHOSEN_LEVELS:
        return None
    symbols = (image.astype(np.int64) - low) // step
    prefix = bytes([FULL_SCALE - 1, MAX_CHOSEN_LEVELS - 1 + step, low, count - 1])
    return _quantised(prefix, _spaced_levels(low, step, count), symbols)


def _spaced_levels(low: int, step: int, count: int) -> Integers:
    return np.minimum(low + step * np.arange(count, dtype=np.int64) + (step - 1) // 2, 255)


def _chosen_levels(image: Image, scale: int, counts: Iterable[int]) -> Iterator[QuantisedImage]:
    """Quantise with the smallest squared error to each number of levels in `counts`."""
    greys, pixels = np.unique(image, return_counts=True)
    starts = _optimal_group_starts(greys.astype(np.float64), pixels.astype(np.float64))
    for count in counts:
        edges = [len(greys)]
        for groups in range(min(count, len(greys)), 0, -1):
            edges.append(int(starts[groups - 1, edges[-1]]))
        first = edges[:0:-1]
        means = np.add.reduceat(greys * pixels.astype(np.float64), first) / np.add.reduceat(pixels, first)
        levels = np.floor(means + 0.5).astype(np.int64)
        symbols = np.searchsorted(greys[first], image, side="right") - 1
        yield _quantised(bytes([scale - 1, len(levels) - 1, *levels.tolist()]), levels, symbols)


def _optimal_group_starts(greys: Floats, pixels: Floats) -> Integers:
    """Return the start of the last group when the first grey levels are split with the smallest squared error.

    Dynamic programming: the best split into one more group adds the cheapest last group to a best split.

    Args:
        greys: Shape (n,): the grey levels of the image, rising.
        pixels: Shape (n,): number of pixels of each level.

    Returns:
        Shape (16, n + 1), indexed by number of groups - 1 and number of grey levels.
    """
    sums = [np.concatenate(([0.0], np.cumsum(pixels * greys**power))) for power in range(3)]
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


def _quantised(prefix: bytes, levels: Integers, symbols: Integers) -> QuantisedImage:
    counts = np.bincount(symbols.ravel(), minlength=len(levels)).tolist()
    lengths = code_lengths(counts)
    bits = 8 * len(prefix) + sum(c * length for c, length in zip(counts, lengths, strict=True))
    if len(levels) > 2:
        bits += sum(len(_gamma(value)) for value in _differences(lengths))
    return QuantisedImage(prefix, levels, lengths, symbols, bits)


def code_lengths(counts: list[int]) -> list[int]:
    """Return the Huffman code length of each symbol, at most 15; 0 for a symbol that does not occur.

    If the tree is deeper than 15, the counts are halved until it is not.

    Args:
        counts: Number of occurrences of each symbol; at least one is not 0.
    """
    used = [symbol for symbol, count in enumerate(counts) if count]
    lengths = [0] * len(counts)
    if len(used) == 1:
        return lengths
    heap: list[tuple[int, int, tuple[int, ...]]] = [(counts[symbol], symbol, (symbol,)) for symbol in used]
    heapq.heapify(heap)
    while len(heap) > 1:
        (count_a, order, symbols_a), (count_b, _, symbols_b) = heapq.heappop(heap), heapq.heappop(heap)
        for symbol in symbols_a + symbols_b:
            lengths[symbol] += 1
        heapq.heappush(heap, (count_a + count_b, order, symbols_a + symbols_b))
    if max(lengths) > MAX_CODE_BITS:
        return code_lengths([(count + 1) // 2 for count in counts])
    return lengths


def canonical_codes(lengths: list[int]) -> list[int]:
    """Return the canonical code of each symbol; 0 where the length is 0."""
    codes, code, previous = [0] * len(lengths), 0, 0
    for length, symbol in sorted((length, symbol) for symbol, length in enumerate(lengths) if length):
        code <<= length - previous
        codes[symbol], code, previous = code, code + 1, length
    return codes


def _differences(lengths: list[int]) -> Iterator[int]:
    """Yield the differences of consecutive code lengths, mapped to positive numbers."""
    for previous, length in pairwise([0, *lengths]):
        yield 2 * (length - previous) + 1 if length >= previous else 2 * (previous - length)


def _gamma(value: int) -> str:
    """Return the Elias gamma code of a positive number, as text of 0 and 1."""
    return f"{value:0{2 * value.bit_length() - 1}b}"


class EndOfBitsError(Exception):
    """The body ends inside a field."""


class BitReader:
    """Reads a body bit by bit."""

    def __init__(self, body: bytes) -> None:
        self._bits = np.unpackbits(np.frombuffer(body, np.uint8)).tolist()
        self._position = 0

    @property
    def bytes_left(self) -> int:
        """Number of whole bytes that were not read."""
        return (len(self._bits) - self._position) // 8

    def read(self, count: int) -> int:
        """Read an unsigned number of `count` bits."""
        stop = self._position + count
        if stop > len(self._bits):
            raise EndOfBitsError
        value = 0
        for bit in self._bits[self._position : stop]:
            value = value << 1 | bit
        self._position = stop
        return value

    def read_gamma(self) -> int:
        """Read an Elias gamma code of at most 9 bits, enough for every difference."""
        zeros = 0
        while zeros < 5 and not self.read(1):
            zeros += 1
        return 1 << zeros | self.read(zeros)

    def read_symbols(self, symbol_by_code: dict[int, int], count: int) -> list[int]:
        """Read up to `count` symbols, fewer at the end of the bits. The keys are a 1 bit followed by the code."""
        symbols: list[int] = []
        code = 1
        for position in range(self._position, len(self._bits)):
            if len(symbols) == count:
                break
            code = code << 1 | self._bits[position]
            symbol = symbol_by_code.get(code)
            if symbol is not None:
                symbols.append(symbol)
                code, self._position = 1, position + 1
        return symbols


def _read_levels(bits: BitReader) -> tuple[int, Integers]:
    """Read the scale, 1..32, and the grey levels, shape (levels,), int64.

    Raises:
        EndOfBitsError: The body ends before the last level.
        StreamError: Scale or levels are invalid.
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


def _read_symbols(bits: BitReader, levels: int, count: int) -> tuple[Integers, int]:
    """Read the code lengths and the symbols.

    Returns:
        Shape (count,), int64, and the number of symbols that arrived. The others are 0.

    Raises:
        EndOfBitsError: The body ends before the first symbol.
        StreamError: The code lengths are invalid.
    """
    symbols = np.zeros(count, dtype=np.int64)
    if levels == 1:
        return symbols, count
    lengths = [1, 1] if levels == 2 else _read_lengths(bits, levels)
    codes = zip(canonical_codes(lengths), lengths, strict=True)
    symbol_by_code = {1 << length | code: symbol for symbol, (code, length) in enumerate(codes) if length}
    found = bits.read_symbols(symbol_by_code, count)
    symbols[: len(found)] = found
    return symbols, len(found)


def _read_lengths(bits: BitReader, levels: int) -> list[int]:
    lengths: list[int] = []
    for _ in range(levels):
        value = bits.read_gamma()
        length = (lengths[-1] if lengths else 0) + (value // 2 if value % 2 else -(value // 2))
        if not 0 <= length <= MAX_CODE_BITS:
            raise StreamError("huffman body", "code length", length, f"0..{MAX_CODE_BITS}")
        lengths.append(length)
    if sum(1 << (MAX_CODE_BITS - length) for length in lengths if length) != 1 << MAX_CODE_BITS:
        raise StreamError("huffman body", "code lengths", lengths, "a complete prefix code")
    return lengths
