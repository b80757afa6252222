"""SPIHT: set partitioning in hierarchical trees, one of the four codecs the paper compares.

A. Said, W. A. Pearlman, "A new, fast, and efficient image codec based on set partitioning in hierarchical trees", IEEE
Trans. Circuits and Systems for Video Technology 6(3), 1996, without arithmetic coding. The stream is embedded: cut at
any bit, it decodes to the best picture those bits can give.

The transform is the 9/7 wavelet by lifting (Daubechies and Sweldens, 1998), whole-sample symmetric at the edges, in
fixed-point integers: two machines agree to the last bit. A picture of any size is transformed as it is, unpadded, so
that no bit is spent on pixels nobody sees; trees of odd bands hang their last row and column below the last parent.

Body, most significant bit first: mean grey level / 8 (5 bits); phase (2 bits); highest plane (5 bits); then the
passes, and zero bits to a whole byte. In plane k a coefficient is significant from (4 + phase) * 2**k / 8 grey levels
on. The four phases divide the octave between two planes; with a budget, the encoder takes the one whose picture has the
smallest error, which gains about 0.1 dB.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from sonarpost.codec.huffman import arrived_body
from sonarpost.codec.interface import Decoded, Image, Mask, StreamHeader, check_image, to_uint8
from sonarpost.errors import ConfigError, StreamError

CODEC_ID = 0x04
NATURAL_MAXLOOP = 7  # the paper's larger SPIHT picture in its Fig. 2
MAX_PLANES = 20  # the energy of 512 x 512 px keeps every coefficient below plane 18
_PREFIX_BITS = 12
_MEAN_STEP = 8
_FRACTION_BITS = 8  # of wavelet coefficients
_UNIT = 1 << (_FRACTION_BITS - 3)  # a phase counts eighths of a grey level

_Integers = npt.NDArray[np.int64]

# Lifting steps of the 9/7 wavelet and the scale that makes it nearly orthonormal, times 2**16.
_LIFT = (-103949, -3472, 57862, 29066)
_LOW_GAIN, _HIGH_GAIN = 75340, 57008


class _EndOfBits(Exception):  # noqa: N818  (no error: the budget is full, or the stream is at its end)
    """There is no room for, or there are no, further bits."""


def _scale(values: _Integers, factor: int) -> _Integers:
    return (values * factor + (1 << 15)) >> 16


def _neighbours_of_odd(even: _Integers, count: int) -> _Integers:
    """Sum of the even samples on both sides of each of `count` odd ones, mirrored at the end."""
    right = even[1 : count + 1]
    if len(right) < count:
        right = np.concatenate((right, even[-1:]))
    return even[:count] + right


def _neighbours_of_even(odd: _Integers, count: int) -> _Integers:
    """Sum of the odd samples on both sides of each of `count` even ones, mirrored at both ends."""
    left = np.concatenate((odd[:1], odd))[:count]
    right = odd if len(odd) == count else np.concatenate((odd, odd[-1:]))
    return left + right


def _analyse(samples: _Integers) -> tuple[_Integers, _Integers]:
    """Split along axis 0 (at least 2 long) into the low band, ceil(n / 2) long, and the high band."""
    even, odd = samples[0::2].copy(), samples[1::2].copy()
    for step in (0, 2):
        odd += _scale(_neighbours_of_odd(even, len(odd)), _LIFT[step])
        even += _scale(_neighbours_of_even(odd, len(even)), _LIFT[step + 1])
    return _scale(even, _LOW_GAIN), _scale(odd, _HIGH_GAIN)


def _synthesise(low: _Integers, high: _Integers) -> _Integers:
    """Undo `_analyse` along axis 0, but for the rounding of the last bit of the fraction."""
    even, odd = _scale(low, _HIGH_GAIN), _scale(high, _LOW_GAIN)
    for step in (2, 0):
        even -= _scale(_neighbours_of_even(odd, len(even)), _LIFT[step + 1])
        odd -= _scale(_neighbours_of_odd(even, len(odd)), _LIFT[step])
    samples = np.empty((len(even) + len(odd), *even.shape[1:]), dtype=np.int64)
    samples[0::2], samples[1::2] = even, odd
    return samples


@dataclass(frozen=True)
class _Forest:
    """The coefficients of a picture size in one row, and the trees over them.

    Attributes:
        shapes: Height and width of the picture and of each low band, finest first.
        size: How many coefficients there are.
        roots: Those of the lowest band, which come first.
        bands: Where each detail band lies: start, height, width; HL, LH, HH, coarsest level first.
        parents: Parent of each coefficient, -1 for a root.
        children: Children of each coefficient.
    """

    shapes: tuple[tuple[int, int], ...]
    size: int
    roots: int
    bands: tuple[tuple[int, int, int], ...]
    parents: _Integers
    children: tuple[tuple[int, ...], ...]


@lru_cache(maxsize=8)
def _forest(height_px: int, width_px: int) -> _Forest:
    """Return the trees of a picture size; the lowest band is one coefficient on its shorter side."""
    shapes = [(height_px, width_px)]
    while min(shapes[-1]) >= 2:
        shapes.append(((shapes[-1][0] + 1) // 2, (shapes[-1][1] + 1) // 2))
    low_h, low_w = shapes[-1]
    parents, bands, start = [np.full(low_h * low_w, -1, dtype=np.int64)], [], low_h * low_w
    above = [(0, low_h, low_w, 1)] * 3
    for (h, w), (half_h, half_w) in zip(reversed(shapes[:-1]), reversed(shapes[1:]), strict=True):
        level = []
        for (over, over_h, over_w, step), size in zip(
            above, ((half_h, w // 2), (h // 2, half_w), (h // 2, w // 2)), strict=True
        ):
            rows = np.minimum(np.arange(size[0]) // step, over_h - 1)
            columns = np.minimum(np.arange(size[1]) // step, over_w - 1)
            parents.append((over + rows[:, None] * over_w + columns).ravel())
            level.append((start, *size, 2))
            bands.append((start, *size))
            start += size[0] * size[1]
        above = level
    flat = np.concatenate(parents)
    order = np.argsort(flat, kind="stable")
    ends = np.searchsorted(flat[order], np.arange(start + 1)).tolist()
    listed = order.tolist()
    children = tuple(tuple(listed[a:b]) for a, b in pairwise(ends))
    return _Forest(tuple(shapes), start, low_h * low_w, tuple(bands), flat, children)


def _transform(image: Image, mean: int, forest: _Forest) -> _Integers:
    """Return the coefficients of the picture less `mean`, shape (forest.size,), in 2**-8 grey levels."""
    low = (image.astype(np.int64) - mean) << _FRACTION_BITS
    flat = np.empty(forest.size, dtype=np.int64)
    for level in range(len(forest.shapes) - 1):
        top, bottom = _analyse(low)
        low, hl = (band.T for band in _analyse(top.T))
        lh, hh = (band.T for band in _analyse(bottom.T))
        first = len(forest.bands) - 3 * (level + 1)
        for (start, h, w), band in zip(forest.bands[first : first + 3], (hl, lh, hh), strict=True):
            flat[start : start + h * w] = band.ravel()
    flat[: forest.roots] = low.ravel()
    return flat


def _inverse(flat: _Integers, mean: int, forest: _Forest) -> Image:
    """Return the picture, shape `forest.shapes[0]`, uint8."""
    low = flat[: forest.roots].reshape(forest.shapes[-1])
    for level in range(len(forest.shapes) - 1):
        hl, lh, hh = (
            flat[start : start + h * w].reshape(h, w) for start, h, w in forest.bands[3 * level : 3 * level + 3]
        )
        top, bottom = _synthesise(low.T, hl.T).T, _synthesise(lh.T, hh.T).T
        low = _synthesise(top, bottom)
    grey = ((low + (1 << (_FRACTION_BITS - 1))) >> _FRACTION_BITS) + mean
    return np.asarray(np.clip(grey, 0, 255), dtype=np.uint8)


@dataclass(frozen=True)
class _Tests:
    """The questions SPIHT asks about a coefficient in a plane; answered from the picture, or from the stream."""

    significant: Callable[[int, int], bool]
    negative: Callable[[int], bool]
    descendants: Callable[[int, int], bool]
    grandchildren: Callable[[int, int], bool]
    refined: Callable[[int, int], None]


def _run_passes(forest: _Forest, planes: range, ask: _Tests) -> None:
    """Ask every question in SPIHT's order, plane by plane; ends early when a test raises _EndOfBits.

    Encoder and decoder are this one routine, so they cannot disagree about the order.
    """
    children = forest.children
    pending = list(range(forest.roots))  # the list of insignificant pixels
    known: list[int] = []  # the list of significant pixels
    sets = [(node, False) for node in range(forest.roots) if children[node]]  # of insignificant sets; True: type B
    for plane in planes:
        found: list[int] = []

        def classify(node: int, plane: int = plane, found: list[int] = found) -> bool:
            if ask.significant(node, plane):
                found.append(node)
                ask.negative(node)
                return True
            return False

        pending = [node for node in pending if not classify(node)]
        waiting: list[tuple[int, bool]] = []
        for node, is_b in sets:  # grows while it is walked
            if not (ask.grandchildren if is_b else ask.descendants)(node, plane):
                waiting.append((node, is_b))
            elif is_b:
                sets.extend((child, False) for child in children[node] if children[child])
            else:
                pending.extend([child for child in children[node] if not classify(child)])
                if any(children[child] for child in children[node]):
                    sets.append((node, True))
        sets = waiting
        for node in known:
            ask.refined(node, plane)
        known += found


class _Picture:
    """Answers from the quantised coefficients, and writes each answer."""

    def __init__(self, flat: _Integers, phase: int, forest: _Forest, limit: int | None) -> None:
        quantised = np.abs(flat) // ((4 + phase) * _UNIT)
        below = np.zeros(forest.size, dtype=np.int64)
        beyond = np.zeros(forest.size, dtype=np.int64)
        ends = [forest.roots, *(start + h * w for start, h, w in forest.bands[2::3])]
        for start, stop in reversed(list(pairwise(ends))):
            above = forest.parents[start:stop]
            np.maximum.at(beyond, above, below[start:stop])
            np.maximum.at(below, above, np.maximum(quantised[start:stop], below[start:stop]))
        self.planes = max(int(quantised.max()).bit_length(), 1)
        self.bits = bytearray()
        self._limit = MAX_PLANES * forest.size * 4 if limit is None else limit
        self._levels, self._below, self._beyond = quantised.tolist(), below.tolist(), beyond.tolist()
        self._signs = (flat < 0).tolist()

    def tests(self) -> _Tests:
        return _Tests(
            lambda node, plane: self._write(bool(self._levels[node] >> plane)),
            lambda node: self._write(self._signs[node]),
            lambda node, plane: self._write(bool(self._below[node] >> plane)),
            lambda node, plane: self._write(bool(self._beyond[node] >> plane)),
            self._refine,
        )

    def _refine(self, node: int, plane: int) -> None:
        self._write(bool(self._levels[node] >> plane & 1))

    def _write(self, answer: bool) -> bool:  # noqa: FBT001  (the answer is the bit)
        if len(self.bits) >= self._limit:
            raise _EndOfBits
        self.bits.append(answer)
        return answer


class _Stream:
    """Answers from the stream, and keeps what is known of each coefficient: a lower bound and an interval."""

    def __init__(self, bits: bytes, forest: _Forest) -> None:
        self._bits = iter(bits)
        self.lower = [0] * forest.size
        self.width = [0] * forest.size
        self.sign = [1] * forest.size
        self._last = 0

    def tests(self) -> _Tests:
        read = self._read
        return _Tests(
            self._significant, self._negative, lambda _node, _plane: read(), lambda _node, _plane: read(), self._refined
        )

    def _read(self) -> bool:
        bit = next(self._bits, None)
        if bit is None:
            raise _EndOfBits
        return bool(bit)

    def _significant(self, node: int, plane: int) -> bool:
        if self._read():
            self._last = plane
            return True
        return False

    def _negative(self, node: int) -> bool:
        # The coefficient counts from its sign on: without one it is better left at nought.
        negative = self._read()
        self.sign[node] = -1 if negative else 1
        self.lower[node] = self.width[node] = 1 << self._last
        return negative

    def _refined(self, node: int, plane: int) -> None:
        self.lower[node] += self._read() << plane
        self.width[node] = 1 << plane

    def coefficients(self, phase: int) -> _Integers:
        lower, width, sign = (np.array(values, dtype=np.int64) for values in (self.lower, self.width, self.sign))
        # Small coefficients are more frequent than large ones, also within an interval: 3/8 of the way up, not 1/2.
        return sign * ((8 * lower + 3 * width) * ((4 + phase) * _UNIT) >> 3)


@dataclass(frozen=True)
class SpihtCodec:
    """SPIHT without arithmetic coding. Satisfies `sonarpost.codec.interface.Codec`.

    Attributes:
        maxloop: Most bit-plane passes, the paper's option of that name; None for 7 without a budget and for no bound
            with one.

    Raises:
        ConfigError: `maxloop` is out of bounds.
    """

    maxloop: int | None = None

    def __post_init__(self) -> None:
        if self.maxloop is not None and not 1 <= self.maxloop <= MAX_PLANES:
            raise ConfigError("codec spiht", "maxloop", self.maxloop, f"1..{MAX_PLANES}, or none")

    @property
    def name(self) -> str:
        """Name in the registry."""
        return "spiht"

    @property
    def codec_id(self) -> int:
        """Number in the stream header."""
        return CODEC_ID

    @property
    def model_hash(self) -> str:
        """Empty: there is no model."""
        return ""

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return the stream; it may be cut anywhere behind its 12 leading bits of body.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits by `to_uint8`).
            budget_bytes: Most bytes of the whole stream. All of them are used unless `maxloop` or the last plane, half
                a grey level, comes first.

        Raises:
            StreamError: Size or dtype is not supported, or the budget leaves the body less than 2 bytes.
        """
        check_image(image)
        grey = to_uint8(image)
        header = StreamHeader(CODEC_ID, 0, grey.shape[0], grey.shape[1]).pack()
        if budget_bytes is not None and budget_bytes < len(header) + 2:
            raise StreamError("codec spiht", "budget_bytes", budget_bytes, f"at least {len(header) + 2} B")
        forest = _forest(*grey.shape)
        mean = (int(grey.sum(dtype=np.int64)) // grey.size) // _MEAN_STEP
        flat = _transform(grey, _MEAN_STEP * mean + _MEAN_STEP // 2, forest)
        if budget_bytes is None:
            return header + _write_body(flat, mean, 0, forest, self.maxloop or NATURAL_MAXLOOP, None)
        loops, length = self.maxloop or MAX_PLANES, budget_bytes - len(header)
        bodies = [_write_body(flat, mean, phase, forest, loops, length) for phase in range(4)]
        errors = [int(((_read_body(body, forest).astype(np.int64) - grey) ** 2).sum()) for body in bodies]
        return header + bodies[errors.index(min(errors))]

    def decode(self, stream: bytes, received: Mask | None = None) -> Decoded:
        """Rebuild the picture from the bytes up to the first that did not arrive.

        Every coefficient bears on a wide neighbourhood and the coarse ones come first, so a cut stream gives the whole
        picture, only less sharp: nothing is missing, unless not even the leading 12 bits arrived.

        Args:
            stream: Header and body, cut anywhere.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive.

        Raises:
            StreamError: The header is wrong, the stream is another codec's, or its highest plane cannot be right.
        """
        header, body, notes = arrived_body(stream, received, CODEC_ID, self.name)
        if 8 * len(body) < _PREFIX_BITS:
            shape = (header.height_px, header.width_px)
            notes.append(f"{len(body)} B of the body arrived, at least 2 are needed")
            return Decoded(np.zeros(shape, np.uint8), np.ones(shape, np.bool_), tuple(notes))
        image = _read_body(body, _forest(header.height_px, header.width_px))
        return Decoded(image, np.zeros(image.shape, np.bool_), tuple(notes))


def _write_body(flat: _Integers, mean: int, phase: int, forest: _Forest, loops: int, length: int | None) -> bytes:
    """Return a body of at most `length` bytes, of at most `loops` planes."""
    picture = _Picture(flat, phase, forest, None if length is None else 8 * length - _PREFIX_BITS)
    top = picture.planes - 1
    with suppress(_EndOfBits):
        _run_passes(forest, range(top, max(top - loops, -1), -1), picture.tests())
    prefix = f"{mean:05b}{phase:02b}{top:05b}".encode()
    bits = np.concatenate((np.frombuffer(prefix, np.uint8) - ord("0"), np.frombuffer(picture.bits, np.uint8)))
    return np.packbits(bits).tobytes()


def _read_body(body: bytes, forest: _Forest) -> Image:
    """Return the picture of a body of at least 2 bytes."""
    bits = np.unpackbits(np.frombuffer(body, np.uint8)).tobytes()
    mean, phase, top = (body[0] >> 3), (body[0] >> 1) & 3, (body[0] & 1) << 4 | body[1] >> 4
    if top >= MAX_PLANES:
        raise StreamError("spiht body", "highest plane", top, f"0..{MAX_PLANES - 1}")
    stream = _Stream(bits[_PREFIX_BITS:], forest)
    with suppress(_EndOfBits):
        _run_passes(forest, range(top, -1, -1), stream.tests())
    return _inverse(stream.coefficients(phase), _MEAN_STEP * mean + _MEAN_STEP // 2, forest)
