"""Huffman coding of quantised grey levels, one of the four codecs the paper compares.

Up to 16 grey levels are chosen for the picture so that the squared error is least (by dynamic programming over its
histogram); more are equally spaced, and with a spacing of 1 the picture is exact. Every pixel costs at least one bit,
so for small budgets the picture is first reduced to n/32 of its sides. Of all n, each with as many levels as fit, the
one with the least error after enlarging again is sent: a few levels in full resolution are often worse than many in
less.

Body, most significant bit first: n - 1 (u8); kind (u8); levels; code lengths; the pixels in raster order.

* kind 0..15: kind + 1 levels follow, one byte each, rising.
* kind 16..30: levels are spaced by kind - 15; lowest level (u8) and number of levels - 1 (u8) follow.
* Code lengths, 0 (level unused) to 15, as differences from the one before (the first from 0) in Elias gamma code of
  2d + 1 (d >= 0) or -2d. Absent for one level (no pixel needs a bit) and for two (one bit each). The codes
  are canonical.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice, pairwise

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow
from scipy import ndimage

from sonarpost.codec.interface import Decoded, Image, Mask, StreamHeader, check_image, to_uint8
from sonarpost.errors import ConfigError, StreamError

CODEC_ID = 0x01
NATURAL_LEVELS = 4
MAX_CHOSEN_LEVELS = 16
MAX_CODE_BITS = 15
FULL_SCALE = 32

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]


def arrived_body(
    stream: bytes, received: Mask | None, codec_id: int, name: str
) -> tuple[StreamHeader, bytes, list[str]]:
    """Return a stream's header, its body up to the first byte that did not arrive, and notes.

    Shared by the codecs that cannot decode anything behind a gap.

    Raises:
        StreamError: The header is wrong, the stream is another codec's, or `received` has not one bool for each
            body byte.
    """
    header = StreamHeader.unpack(stream)
    if header.codec_id != codec_id:
        raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", f"{codec_id:#04x} ({name})")
    body = stream[header.size :]
    if received is None:
        return header, body, []
    if received.shape != (len(body),) or received.dtype != np.bool_:
        met = f"{received.dtype} {received.shape}"
        raise StreamError("stream", "received", met, f"bool ({len(body)},), one for each body byte")
    gaps = np.flatnonzero(~received)
    if not len(gaps):
        return header, body, []
    return header, body[: gaps[0]], [f"body byte {gaps[0]} of {len(body)} did not arrive; what follows it is not used"]


@dataclass(frozen=True)
class _Coded:
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
    levels: _Integers
    lengths: list[int]
    symbols: _Integers
    bits: int

    def body(self) -> bytes:
        """Return the body, zero bits at its end."""
        codes = canonical_codes(self.lengths)
        head = "".join(_gamma(value) for value in _differences(self.lengths)) if len(self.levels) > 2 else ""
        text = [f"{code:0{length}b}" if length else "" for code, length in zip(codes, self.lengths, strict=True)]
        bits = head + "".join([text[symbol] for symbol in self.symbols.ravel().tolist()])
        return self.prefix + np.packbits(np.frombuffer(bits.encode(), np.uint8) - ord("0")).tobytes()


@dataclass(frozen=True)
class HuffmanCodec:
    """Huffman coding of grey levels. Satisfies `sonarpost.codec.interface.Codec`.

    Attributes:
        levels: Grey levels when no budget is given, 1..16.

    Raises:
        ConfigError: `levels` is out of bounds.
    """

    levels: int = NATURAL_LEVELS

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= MAX_CHOSEN_LEVELS:
            raise ConfigError("codec huffman", "levels", self.levels, f"1..{MAX_CHOSEN_LEVELS}")

    @property
    def name(self) -> str:
        """Name in the registry."""
        return "huffman"

    @property
    def codec_id(self) -> int:
        """Number in the stream header."""
        return CODEC_ID

    @property
    def model_hash(self) -> str:
        """Empty: there is no model."""
        return ""

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return the stream.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits by `to_uint8`).
            budget_bytes: Most bytes of the whole stream; the number of levels and the resolution that show most within
                it are used. None for `levels` grey levels in full resolution, as in the paper.

        Raises:
            StreamError: Size or dtype is not supported, or not even one level fits the budget.
        """
        check_image(image)
        grey = to_uint8(image)
        header = StreamHeader(CODEC_ID, 0, grey.shape[0], grey.shape[1]).pack()
        if budget_bytes is None:
            return header + next(_chosen(grey, FULL_SCALE, [self.levels])).body()
        limit = 8 * (budget_bytes - len(header))
        coded = _nearest(grey, limit)
        if coded is None:
            raise StreamError("codec huffman", "budget_bytes", budget_bytes, f"at least {len(header) + 3} B")
        return header + coded.body()

    def decode(self, stream: bytes, received: Mask | None = None) -> Decoded:
        """Rebuild the picture; pixels behind the first byte that did not arrive are black and missing.

        Args:
            stream: Header and body; bytes beyond the last pixel's are ignored and noted.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive.

        Raises:
            StreamError: The header is wrong, the stream is another codec's, or levels or code lengths cannot be
                right.
        """
        header, body, notes = arrived_body(stream, received, CODEC_ID, self.name)
        shape = (header.height_px, header.width_px)
        bits = _Bits(body)
        try:
            scale, levels = _read_levels(bits)
            symbols, count = _read_symbols(bits, len(levels), _side(shape[0], scale) * _side(shape[1], scale))
        except _EndOfBitsError:
            notes.append(f"body ends after {len(body)} B, before the first pixel")
            return Decoded(np.zeros(shape, np.uint8), np.ones(shape, np.bool_), tuple(notes))
        if count < len(symbols):
            notes.append(f"{len(symbols) - count} of {len(symbols)} pixels did not arrive")
        elif bits.bytes_left:
            notes.append(f"{bits.bytes_left} B after the body ignored")
        small = (_side(shape[0], scale), _side(shape[1], scale))
        lost = (np.arange(len(symbols)) >= count).reshape(small)
        rebuilt = _enlarge(levels[symbols].reshape(small).astype(np.uint8), shape)
        missing = _enlarge_mask(lost, shape)
        rebuilt[missing] = 0
        return Decoded(rebuilt, missing, tuple(notes))


def _side(side_px: int, scale: int) -> int:
    return max(1, (side_px * scale + FULL_SCALE // 2) // FULL_SCALE)


def _reduce(image: Image, scale: int) -> Image:
    size = (_side(image.shape[1], scale), _side(image.shape[0], scale))
    return np.asarray(Pillow.fromarray(image).resize(size, Pillow.Resampling.BICUBIC), dtype=np.uint8)


def _enlarge(image: Image, shape: tuple[int, int]) -> Image:
    if image.shape == shape:
        return image.copy()
    resized = Pillow.fromarray(image).resize((shape[1], shape[0]), Pillow.Resampling.BICUBIC)
    return np.array(resized, dtype=np.uint8)


def _enlarge_mask(lost: Mask, shape: tuple[int, int]) -> Mask:
    """Return which pixels depend on a lost one; bicubic enlarging looks two pixels far, bilinear one."""
    if lost.shape == shape:
        return lost
    wider = ndimage.maximum_filter(lost.astype(np.float32), size=3, mode="nearest")
    resized = Pillow.fromarray(wider).resize((shape[1], shape[0]), Pillow.Resampling.BILINEAR)
    return np.asarray(np.array(resized) > 0, dtype=np.bool_)


def _nearest(image: Image, limit_bits: int) -> _Coded | None:
    """Return the quantised picture, reduced or not, that fits and is nearest to `image`, or None."""
    best, least = None, 0
    for coded in _finest_each(image, limit_bits):
        rebuilt = _enlarge(coded.levels[coded.symbols].astype(np.uint8), image.shape)
        error = int(((rebuilt.astype(np.int64) - image) ** 2).sum())
        if best is None or error < least:
            best, least = coded, error
        if error == 0:
            break
    return best


def _finest_each(image: Image, limit_bits: int) -> Iterator[_Coded]:
    """Return the finest equally spaced levels that fit, then the finest chosen ones in each resolution."""
    spaced = (_spaced(image, step) for step in range(1, MAX_CHOSEN_LEVELS))
    yield from islice((coded for coded in spaced if coded is not None and coded.bits <= limit_bits), 1)
    for scale in range(FULL_SCALE, 0, -1):
        small = _reduce(image, scale)
        if small.size > limit_bits and scale > 1:
            continue  # a pixel takes a bit, unless all are equal: then any other scale shows the same
        chosen = _chosen(small, scale, range(MAX_CHOSEN_LEVELS, 0, -1))
        yield from islice((coded for coded in chosen if coded.bits <= limit_bits), 1)


def _spaced(image: Image, step: int) -> _Coded | None:
    """Quantise to levels `step` apart, or return None if those are few enough to be chosen."""
    low, high = int(image.min()), int(image.max())
    count = (high - low) // step + 1
    if count <= MAX_CHOSEN_LEVELS:
        return None
    symbols = (image.astype(np.int64) - low) // step
    prefix = bytes([FULL_SCALE - 1, MAX_CHOSEN_LEVELS - 1 + step, low, count - 1])
    return _coded(FULL_SCALE, prefix, _spaced_levels(low, step, count), symbols)


def _spaced_levels(low: int, step: int, count: int) -> _Integers:
    return np.minimum(low + step * np.arange(count, dtype=np.int64) + (step - 1) // 2, 255)


def _chosen(image: Image, scale: int, counts: Iterable[int]) -> Iterator[_Coded]:
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


def _least_error_starts(greys: _Floats, counted: _Floats) -> _Integers:
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


def _coded(scale: int, prefix: bytes, levels: _Integers, symbols: _Integers) -> _Coded:
    counts = np.bincount(symbols.ravel(), minlength=len(levels)).tolist()
    lengths = code_lengths(counts)
    bits = 8 * len(prefix) + sum(c * length for c, length in zip(counts, lengths, strict=True))
    if len(levels) > 2:
        bits += sum(len(_gamma(value)) for value in _differences(lengths))
    return _Coded(scale, prefix, levels, lengths, symbols, bits)


def code_lengths(counts: list[int]) -> list[int]:
    """Return the Huffman code length of each symbol, 0 for one that does not occur, at most 15.

    Where the tree is deeper, counts are halved until it is not, which costs next to nothing.

    Args:
        counts: How often each symbol occurs; at least one does.
    """
    used = [symbol for symbol, count in enumerate(counts) if count]
    lengths = [0] * len(counts)
    if len(used) == 1:
        return lengths
    heap: list[tuple[int, int, tuple[int, ...]]] = [(counts[symbol], symbol, (symbol,)) for symbol in used]
    heapq.heapify(heap)
    while len(heap) > 1:
        (few, order, some), (more, _, others) = heapq.heappop(heap), heapq.heappop(heap)
        for symbol in some + others:
            lengths[symbol] += 1
        heapq.heappush(heap, (few + more, order, some + others))
    if max(lengths) > MAX_CODE_BITS:
        return code_lengths([(count + 1) // 2 for count in counts])
    return lengths


def canonical_codes(lengths: list[int]) -> list[int]:
    """Return each symbol's code: shorter codes first, symbols in rising order; 0 where the length is 0."""
    codes, code, before = [0] * len(lengths), 0, 0
    for length, symbol in sorted((length, symbol) for symbol, length in enumerate(lengths) if length):
        code <<= length - before
        codes[symbol], code, before = code, code + 1, length
    return codes


def _differences(lengths: list[int]) -> Iterator[int]:
    """Return the code lengths' differences as positive numbers."""
    for before, length in pairwise([0, *lengths]):
        yield 2 * (length - before) + 1 if length >= before else 2 * (before - length)


def _gamma(value: int) -> str:
    return f"{value:0{2 * value.bit_length() - 1}b}"


class _EndOfBitsError(Exception):
    """The body ends inside what is being read."""


class _Bits:
    """A body, bit by bit."""

    def __init__(self, body: bytes) -> None:
        self._bits = np.unpackbits(np.frombuffer(body, np.uint8)).tolist()
        self._at = 0

    @property
    def bytes_left(self) -> int:
        """Whole bytes that were not read."""
        return (len(self._bits) - self._at) // 8

    def read(self, count: int) -> int:
        """Read an unsigned number."""
        stop = self._at + count
        if stop > len(self._bits):
            raise _EndOfBitsError
        value = 0
        for bit in self._bits[self._at : stop]:
            value = value << 1 | bit
        self._at = stop
        return value

    def gamma(self) -> int:
        """Read a number in Elias gamma code; at most 9 bits of it, more than any difference takes."""
        zeros = 0
        while zeros < 5 and not self.read(1):
            zeros += 1
        return 1 << zeros | self.read(zeros)

    def symbols(self, by_code: dict[int, int], count: int) -> list[int]:
        """Read up to `count` symbols, fewer where the bits end; `by_code` maps 1 followed by the code's bits."""
        found: list[int] = []
        code = 1
        start = self._at
        for at in range(start, len(self._bits)):
            if len(found) == count:
                break
            code = code << 1 | self._bits[at]
            symbol = by_code.get(code)
            if symbol is not None:
                found.append(symbol)
                code, self._at = 1, at + 1
        return found


def _read_levels(bits: _Bits) -> tuple[int, _Integers]:
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


def _read_symbols(bits: _Bits, levels: int, count: int) -> tuple[_Integers, int]:
    """Return `count` symbols and how many of them arrived; the others are 0."""
    symbols = np.zeros(count, dtype=np.int64)
    if levels == 1:
        return symbols, count
    lengths = [1, 1] if levels == 2 else _read_lengths(bits, levels)
    codes = zip(canonical_codes(lengths), lengths, strict=True)
    by_code = {1 << length | code: symbol for symbol, (code, length) in enumerate(codes) if length}
    found = bits.symbols(by_code, count)
    symbols[: len(found)] = found
    return symbols, len(found)


def _read_lengths(bits: _Bits, levels: int) -> list[int]:
    lengths: list[int] = []
    for _ in range(levels):
        value = bits.gamma()
        length = (lengths[-1] if lengths else 0) + (value // 2 if value % 2 else -(value // 2))
        if not 0 <= length <= MAX_CODE_BITS:
            raise StreamError("huffman body", "code length", length, f"0..{MAX_CODE_BITS}")
        lengths.append(length)
    if sum(1 << (MAX_CODE_BITS - length) for length in lengths if length) != 1 << MAX_CODE_BITS:
        raise StreamError("huffman body", "code lengths", lengths, "a complete prefix code")
    return lengths
