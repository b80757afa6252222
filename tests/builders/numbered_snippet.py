"""Snippets that show a number as a pattern of blocks, which survives the codec at 200 bytes."""

import numpy as np
import numpy.typing as npt

_ROWS, _COLUMNS, _BLOCK_PX = 4, 5, 16
_CHECK_BITS, _MODULUS = 4, 13
_BITS = _ROWS * _COLUMNS
MAX_NUMBER = (1 << (_BITS - _CHECK_BITS)) - 1


def numbered_snippet(number: int) -> npt.NDArray[np.uint8]:
    """Return a snippet that shows a number of 16 bits and a checksum of 4, shape (64, 80)."""
    if not 0 <= number <= MAX_NUMBER:
        raise ValueError(f"got {number}, expected 0 to {MAX_NUMBER}")
    code = number << _CHECK_BITS | number % _MODULUS
    bits = np.array([code >> n & 1 for n in range(_BITS)]).reshape(_ROWS, _COLUMNS)
    blocks = np.kron(bits, np.ones((_BLOCK_PX, _BLOCK_PX)))
    noise = np.random.default_rng(number).normal(0.0, 12.0, blocks.shape)
    return np.clip(60.0 + 130.0 * blocks + noise, 0, 255).astype(np.uint8)


def number_of(pixels: npt.NDArray[np.uint8]) -> int | None:
    """Return the number that a decoded snippet shows, None if the pattern is unreadable."""
    if pixels.shape != (_ROWS * _BLOCK_PX, _COLUMNS * _BLOCK_PX):
        return None
    blocks = pixels.reshape(_ROWS, _BLOCK_PX, _COLUMNS, _BLOCK_PX).mean(axis=(1, 3))
    code = sum(1 << n for n, bright in enumerate((blocks > 125).ravel()) if bright)
    number, checksum = divmod(code, 1 << _CHECK_BITS)
    return number if checksum == number % _MODULUS else None
