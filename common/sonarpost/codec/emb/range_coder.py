"""The range coder of `emb`: bits of known probability. The same state serves for writing and reading."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.jit import inlined, jit

I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]

WRITE, READ, COLLECT = 0, 1, 2

# Words of the coder state.
CODER_LOW, CODER_RANGE, CODER_LENGTH, CODER_CODE, CODER_UNKNOWN, CODER_POSITION, CODER_STOP, CODER_EVENTS = range(8)
CODER_BEST_EVENTS, CODER_BEST_LENGTH, CODER_COST, CODER_ROWS, CODER_SIGN_ROWS, CODER_LIMIT, CODER_PREFIX = range(8, 15)
CODER_WORDS: Final = 15
_TOP: Final = 1 << 32
_BOTTOM: Final = 1 << 24


def start_reading(coder: I64, data: U8) -> None:
    """Load the first four bytes. Missing bytes are unknown."""
    first = bytes(data[:4])
    coder[CODER_RANGE], coder[CODER_POSITION] = _TOP - 1, 4
    coder[CODER_UNKNOWN] = (1 << 8 * (4 - len(first))) - 1
    # Only a damaged stream has a code that is not below the range.
    coder[CODER_CODE] = min(int.from_bytes(first.ljust(4, b"\0"), "big"), _TOP - 2)


@inlined
def _next_byte(coder: I64, data: U8) -> None:
    position = coder[CODER_POSITION]
    if position < data.shape[0]:
        coder[CODER_CODE] = (coder[CODER_CODE] << 8) | data[position]
        coder[CODER_UNKNOWN] <<= 8
    else:
        coder[CODER_CODE] <<= 8
        coder[CODER_UNKNOWN] = (coder[CODER_UNKNOWN] << 8) | 255
    coder[CODER_POSITION] = position + 1


@inlined
def _read_bit(coder: I64, data: U8, probability: int) -> int:
    """Read a bit with probability `probability` / 65536 of 1; -1 if the available bytes do not determine it."""
    bound = (coder[CODER_RANGE] >> 16) * probability
    code = coder[CODER_CODE]
    if code >= bound:
        bit = 0
        coder[CODER_CODE] = code - bound
        coder[CODER_RANGE] -= bound
    elif code + coder[CODER_UNKNOWN] < bound:
        bit = 1
        coder[CODER_RANGE] = bound
    else:
        coder[CODER_STOP] = 1
        return -1
    while coder[CODER_RANGE] < _BOTTOM:
        _next_byte(coder, data)
        coder[CODER_RANGE] <<= 8
    return bit


@inlined
def _bit_with_prefix(coder: I64, data: U8, best: U8, bit: int, bound: int) -> int:
    """Return `bit`, or its opposite if only that gives a stream with the first CODER_PREFIX bytes of `best`.

    The final code value lies in [low, low + range). It must also lie in [first, first + size).
    """
    length, prefix = coder[CODER_LENGTH], coder[CODER_PREFIX]
    first, size = np.int64(0), np.int64(_TOP)
    for i in range(prefix, length):
        if data[i] != 255:  # no carry passes this byte
            return bit
    for i in range(min(length, prefix)):
        if data[i] != best[i]:
            first = np.int64(_TOP)  # only a carry makes them equal
    for i in range(min(prefix - length, 4)):
        size >>= 8
        first += np.int64(best[length + i]) * size
    low, split, end = coder[CODER_LOW], coder[CODER_LOW] + bound, coder[CODER_LOW] + coder[CODER_RANGE]
    if bit == 1 and split <= first:
        return 0
    if bit == 0 and split >= first + size and low < first + size and end > first:
        return 1
    return bit


@inlined
def _write_bit(coder: I64, data: U8, best: U8, bit: int, probability: int) -> int:
    """Write a bit and return the bit written (see `_bit_with_prefix`).

    Stops when a stream of CODER_LIMIT bytes cannot distinguish it from its opposite.
    """
    bound = (coder[CODER_RANGE] >> 16) * probability
    if coder[CODER_PREFIX] > 0:
        bit = _bit_with_prefix(coder, data, best, bit, bound)
    if bit:
        coder[CODER_RANGE] = bound
    else:
        coder[CODER_LOW] += bound
        coder[CODER_RANGE] -= bound
    while coder[CODER_RANGE] < _BOTTOM:
        length = coder[CODER_LENGTH]
        if length >= coder[CODER_LIMIT]:
            coder[CODER_STOP] = 1
            return bit
        if coder[CODER_LOW] >> 32:
            _carry(data, length)
        data[length] = (coder[CODER_LOW] >> 24) & 255
        coder[CODER_LENGTH] = length + 1
        coder[CODER_LOW] = (coder[CODER_LOW] & 0xFFFFFF) << 8
        coder[CODER_RANGE] <<= 8
    coder[CODER_EVENTS] += 1
    _save_if_complete(coder, data, best)
    return bit


@inlined
def _carry(data: U8, length: int) -> None:
    position = length - 1
    while data[position] == 255:
        data[position] = 0
        position -= 1
    data[position] += 1


@jit
def _save_if_complete(coder: I64, data: U8, best: U8) -> None:
    """Store a stream of CODER_LIMIT bytes that determines all bits so far in `best`, if there is one."""
    length = coder[CODER_LENGTH]
    left = coder[CODER_LIMIT] - length
    if left > 4:
        return
    cell = 1 << (32 - 8 * left)
    value = (coder[CODER_LOW] + cell - 1) // cell * cell
    if value + cell > coder[CODER_LOW] + coder[CODER_RANGE]:
        return
    for i in range(length):
        best[i] = data[i]
    if value >> 32:
        _carry(best, length)
    for i in range(left):
        best[length + i] = (value >> (24 - 8 * i)) & 255
    coder[CODER_BEST_EVENTS] = coder[CODER_EVENTS]
    coder[CODER_BEST_LENGTH] = length + left


@jit
def code_bit(coder: I64, data: U8, best: U8, bit: int, probability: int, mode: int) -> int:
    """Write or read one bit of known probability; return it, or -1 at the end."""
    if mode == READ:
        return _read_bit(coder, data, probability)
    written = _write_bit(coder, data, best, bit, probability)
    return -1 if coder[CODER_STOP] else written


def finish_writing(coder: I64, data: U8, best: U8) -> None:
    """Store the shortest stream that determines all bits in `best`, unless the budget is used up."""
    if coder[CODER_STOP]:
        return
    limit = int(coder[CODER_LIMIT])
    coder[CODER_BEST_EVENTS] = -1
    for left in range(5):
        coder[CODER_LIMIT] = min(int(coder[CODER_LENGTH]) + left, limit)
        if coder[CODER_BEST_EVENTS] < coder[CODER_EVENTS]:
            _save_if_complete(coder, data, best)
