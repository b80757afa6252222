"""Reed-Solomon erasure code over GF(256): any k of up to 255 symbols give the k that were meant.

The code is the full-length (255, k) code of `reedsolo.RSCodec(255 - k, nsize=255, fcr=1, prim=0x11d)`: the k source
symbols come first, then the parity. Symbol j is the value at x_j = alpha^(254 - j) of the one polynomial of degree
below k that takes the source symbols' values at x_0 .. x_(k-1). Whoever has any k values has the polynomial (Reed and
Solomon, "Polynomial codes over certain finite fields", J. SIAM 8(2), 1960), so encoding and recovering are one
Lagrange interpolation. Bytes at the same place of all symbols form one code word each.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import FrameError

Bytes = npt.NDArray[np.uint8]
MAX_SYMBOLS: Final = 255
_POLYNOMIAL: Final = 0x11D
_ORDER: Final = 255


def _tables() -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Bytes]:
    """Powers of alpha = 2 (twice round, to add exponents without a modulus), logarithms, and all products."""
    powers, logs = np.zeros(2 * _ORDER, np.int64), np.zeros(256, np.int64)
    value = 1
    for exponent in range(_ORDER):
        powers[exponent] = powers[exponent + _ORDER] = value
        logs[value] = exponent
        value <<= 1
        if value & 0x100:
            value ^= _POLYNOMIAL
    products = powers[logs[:, None] + logs[None, :]].astype(np.uint8)
    products[0, :] = products[:, 0] = 0
    return powers, logs, products


_POWERS, _LOGS, _PRODUCTS = _tables()
_POINTS: Final = _POWERS[(_ORDER - 1 - np.arange(_ORDER)) % _ORDER]


@lru_cache(maxsize=64)
def _interpolation(known: tuple[int, ...], wanted: tuple[int, ...]) -> Bytes:
    """Return shape (wanted, known): what to multiply the known symbols with to get the wanted ones.

    The positions must be disjoint. Lagrange, in logarithms:

        prod_m (x_j - x_m) / ((x_j - x_i) prod_(m != i) (x_i - x_m)).
    """
    x_known, x_wanted = _POINTS[list(known)], _POINTS[list(wanted)]
    across = _LOGS[x_wanted[:, None] ^ x_known[None, :]]
    within = _LOGS[x_known[:, None] ^ x_known[None, :]]  # the diagonal holds log 0, stored as 0: it adds nothing
    exponents = across.sum(axis=1)[:, None] - across - within.sum(axis=1)[None, :]
    matrix: Bytes = _POWERS[exponents % _ORDER].astype(np.uint8)
    return matrix


def _multiply(matrix: Bytes, symbols: Bytes) -> Bytes:
    out = np.zeros((matrix.shape[0], symbols.shape[1]), np.uint8)
    for column, symbol in zip(matrix.T, symbols, strict=True):
        out ^= _PRODUCTS[column[:, None], symbol[None, :]]
    return out


def encode(source: Bytes, indices: Sequence[int]) -> Bytes:
    """Return symbols of a block.

    Args:
        source: Shape (k, symbol bytes), uint8, k in 1..255.
        indices: Which symbols, each 0..254; below k they are the source itself.

    Returns:
        Shape (len(indices), symbol bytes).

    Raises:
        FrameError: k or an index is out of range.
    """
    count = source.shape[0]
    _check(count, indices)
    out = np.empty((len(indices), source.shape[1]), np.uint8)
    parity = sorted({i for i in indices if i >= count})
    rows: dict[int, Bytes] = {}
    if parity:
        made = _multiply(_interpolation(tuple(range(count)), tuple(parity)), source)
        rows = dict(zip(parity, made, strict=True))
    for at, index in enumerate(indices):
        out[at] = source[index] if index < count else rows[index]
    return out


def recover(count: int, indices: Sequence[int], symbols: Bytes) -> Bytes:
    """Return the k source symbols from any k.

    Args:
        count: k, 1..255.
        indices: Which symbols these are: exactly k different ones.
        symbols: Shape (k, symbol bytes), uint8.

    Returns:
        Shape (k, symbol bytes).

    Raises:
        FrameError: Not exactly k different indices in range.
    """
    _check(count, indices)
    if len(indices) != count or len(set(indices)) != count or symbols.shape[0] != count:
        raise FrameError("erasure code", "indices", list(indices), f"{count} different ones, a symbol each")
    order = np.argsort(np.asarray(indices, np.int64), kind="stable")
    known, have = tuple(int(indices[i]) for i in order), symbols[order]
    out = np.empty_like(have)
    there = [i for i in known if i < count]
    out[there] = have[: len(there)]
    missing = tuple(sorted(set(range(count)) - set(there)))
    if missing:
        out[list(missing)] = _multiply(_interpolation(known, missing), have)
    return out


def _check(count: int, indices: Sequence[int]) -> None:
    if not 1 <= count <= MAX_SYMBOLS:
        raise FrameError("erasure code", "source symbols", count, f"1..{MAX_SYMBOLS}")
    for index in indices:
        if not 0 <= index < MAX_SYMBOLS:
            raise FrameError("erasure code", "index", index, f"0..{MAX_SYMBOLS - 1}")
