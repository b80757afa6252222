"""The bit level of `huffman`: code lengths, canonical codes, the bits of a body.

How a body is laid out is told in `sonarpost.codec.baselines.huffman`.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from sonarpost.errors import StreamError

MAX_CODE_BITS = 15

Integers = npt.NDArray[np.int64]


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


def differences(lengths: list[int]) -> Iterator[int]:
    """Return the code lengths' differences as positive numbers."""
    for before, length in pairwise([0, *lengths]):
        yield 2 * (length - before) + 1 if length >= before else 2 * (before - length)


def gamma(value: int) -> str:
    """Return a positive number in Elias gamma code, as text of 0 and 1."""
    return f"{value:0{2 * value.bit_length() - 1}b}"


class EndOfBitsError(Exception):
    """The body ends inside what is being read."""


class Bits:
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
            raise EndOfBitsError
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


def read_symbols(bits: Bits, levels: int, count: int) -> tuple[Integers, int]:
    """Read the code lengths of so many levels, and `count` symbols.

    Returns:
        Shape (count,), int64, and how many of them arrived; the others are 0.

    Raises:
        EndOfBitsError: The bits end before the first symbol.
        StreamError: The code lengths cannot be right.
    """
    symbols = np.zeros(count, dtype=np.int64)
    if levels == 1:
        return symbols, count
    lengths = [1, 1] if levels == 2 else _read_lengths(bits, levels)
    codes = zip(canonical_codes(lengths), lengths, strict=True)
    by_code = {1 << length | code: symbol for symbol, (code, length) in enumerate(codes) if length}
    found = bits.symbols(by_code, count)
    symbols[: len(found)] = found
    return symbols, len(found)


def _read_lengths(bits: Bits, levels: int) -> list[int]:
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
