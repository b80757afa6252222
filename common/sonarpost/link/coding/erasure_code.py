"""Erasure code: any k of up to 255 symbols give the k source symbols; and layered blocks, which use it per layer.

The code is the full-length (255, k) Reed-Solomon code over GF(256) with the polynomial 0x11D and the first root
alpha^1: the source symbols come first, then the parity. Symbol j is the value at x_j = alpha^(254 - j) of the only
polynomial of degree below k with the source symbols at x_0 .. x_(k-1). Any k values determine the polynomial (Reed and
Solomon, "Polynomial codes over certain finite fields", J. SIAM 8(2), 1960), so encoding and recovery are one Lagrange
interpolation. The bytes at the same position of all symbols form one code word.

In a layered block each symbol has a slice of every layer, and layer l can be recovered from any k_l symbols. Only the
number of symbols determines the number of layers (Albanese, Blomer, Edmonds, Luby, Sudan, "Priority encoding
transmission", IEEE Trans. Information Theory 42, 1996). A descriptor of four bytes defines the layers. Each symbol
carries one byte of the coded descriptor; any four symbols recover it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import FrameError

Bytes = npt.NDArray[np.uint8]
MAX_SYMBOLS: Final = 255
DESCRIPTOR_SYMBOLS: Final = 4
MAX_LAYERS: Final = 4
SHARES: Final = 16
MAX_STEP: Final = 63
_POLYNOMIAL: Final = 0x11D
_ORDER: Final = 255


def _tables() -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Bytes]:
    """Return powers of alpha = 2 (two periods, to add exponents without a modulus), logarithms, and all products."""
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
def _interpolation(known: tuple[int, ...], missing: tuple[int, ...]) -> Bytes:
    """Return the matrix, shape (missing, known), that gives the missing symbols from the known ones.

    The positions must be disjoint. In logarithms, Lagrange's formula:

        prod_m (x_j - x_m) / ((x_j - x_i) prod_(m != i) (x_i - x_m)).
    """
    x_known, x_missing = _POINTS[list(known)], _POINTS[list(missing)]
    across = _LOGS[x_missing[:, None] ^ x_known[None, :]]
    within = _LOGS[x_known[:, None] ^ x_known[None, :]]  # the diagonal has log 0, stored as 0
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
        indices: Indices of the symbols, each 0..254; below k they are the source symbols.

    Returns:
        Shape (len(indices), symbol bytes).

    Raises:
        FrameError: k or an index is out of range.
    """
    count = source.shape[0]
    _check(count, indices)
    chosen = np.asarray(indices, np.int64)
    is_source = chosen < count
    out = np.empty((chosen.size, source.shape[1]), np.uint8)
    out[is_source] = source[chosen[is_source]]
    if not is_source.all():
        parity = tuple(chosen[~is_source].tolist())
        out[~is_source] = _multiply(_interpolation(tuple(range(count)), parity), source)
    return out


def recover(count: int, indices: Sequence[int], symbols: Bytes) -> Bytes:
    """Return the k source symbols from any k symbols.

    Args:
        count: k, 1..255.
        indices: Indices of the symbols: exactly k different ones.
        symbols: Shape (k, symbol bytes), uint8.

    Returns:
        Shape (k, symbol bytes).

    Raises:
        FrameError: Not exactly k different indices in range.
    """
    _check(count, indices)
    if len(indices) != count or len(set(indices)) != count or symbols.shape[0] != count:
        raise FrameError("erasure code", "indices", list(indices), f"{count} different ones, one for each symbol")
    order = np.argsort(np.asarray(indices, np.int64), kind="stable")
    known, have = tuple(int(indices[i]) for i in order), symbols[order]
    out = np.empty_like(have)
    received = [i for i in known if i < count]
    out[received] = have[: len(received)]
    missing = tuple(sorted(set(range(count)) - set(received)))
    if missing:
        out[list(missing)] = _multiply(_interpolation(known, missing), have)
    return out


def _check(count: int, indices: Sequence[int]) -> None:
    if not 1 <= count <= MAX_SYMBOLS:
        raise FrameError("erasure code", "source symbols", count, f"1..{MAX_SYMBOLS}")
    for index in indices:
        if not 0 <= index < MAX_SYMBOLS:
            raise FrameError("erasure code", "index", index, f"0..{MAX_SYMBOLS - 1}")


@dataclass(frozen=True, slots=True)
class Layering:
    """The layers of a block.

    Attributes:
        first: Symbols required for the lowest layer, 4..255.
        step: Additional symbols for each next layer, 1..63; 0 with one layer.
        shares: Share of each layer in a symbol, in 1/16: one to four values of at least 1 with the sum 16.

    Raises:
        FrameError: A value out of range.
    """

    first: int
    step: int
    shares: tuple[int, ...]

    def __post_init__(self) -> None:
        layers = len(self.shares)
        fits = (
            1 <= layers <= MAX_LAYERS
            and min(self.shares) >= 1
            and sum(self.shares) == SHARES
            and self.first >= DESCRIPTOR_SYMBOLS
            and (1 <= self.step <= MAX_STEP if layers > 1 else self.step == 0)
            and self.first + (layers - 1) * self.step <= MAX_SYMBOLS
        )
        if not fits:
            expected = "4..255 symbols, steps of 1..63, one to four shares of 1 or more with the sum 16"
            raise FrameError("layered block", "layers", (self.first, self.step, self.shares), expected)

    @property
    def required_symbols(self) -> tuple[int, ...]:
        """Symbols required for each layer."""
        return tuple(self.first + i * self.step for i in range(len(self.shares)))

    def bounds(self, symbol_bytes: int) -> tuple[int, ...]:
        """Return where the slice of each layer begins in a symbol, and the length of the symbol."""
        totals = np.concatenate([[0], np.cumsum(self.shares)])
        return tuple(int(symbol_bytes * total // SHARES) for total in totals)

    def lengths(self, symbol_bytes: int) -> tuple[int, ...]:
        """Return the length of the object of each layer."""
        bounds = self.bounds(symbol_bytes)
        return tuple(k * (b - a) for k, a, b in zip(self.required_symbols, bounds, bounds[1:], strict=False))

    def pack(self) -> bytes:
        """Return the four bytes of the descriptor."""
        nibbles = [*self.shares[:-1], 0, 0, 0][:3]
        body = [self.first, (len(self.shares) - 1) << 6 | self.step, nibbles[0] << 4 | nibbles[1], nibbles[2] << 4]
        return bytes([*body[:3], body[3] | _nibble_sum(body)])

    @classmethod
    def unpack(cls, data: bytes) -> Layering:
        """Parse a descriptor.

        Raises:
            FrameError: A wrong check, or values out of range.
        """
        if len(data) != 4:
            raise FrameError("layered block", "descriptor", data, "4 bytes")
        body = [*data[:3], data[3] & 0xF0]
        if _nibble_sum(body) != data[3] & 0x0F:
            raise FrameError("layered block", "descriptor", data, "a correct check")
        layers = (data[1] >> 6) + 1
        nibbles = [data[2] >> 4, data[2] & 15, data[3] >> 4]
        if any(nibbles[layers - 1 :]):
            raise FrameError("layered block", "descriptor", data, f"shares of {layers} layers only")
        shares = nibbles[: layers - 1]
        return cls(data[0], data[1] & 63, (*shares, SHARES - sum(shares)))


def _nibble_sum(body: Sequence[int]) -> int:
    """Return the exclusive-or of all nibbles and 9, so that zeros are not a valid descriptor."""
    total = 9
    for byte in body:
        total ^= byte >> 4 ^ byte & 15
    return total


def layered_symbols(layering: Layering, objects: Sequence[bytes], indices: Sequence[int]) -> list[tuple[int, bytes]]:
    """Return the descriptor symbol and the symbol of the block for each index.

    Args:
        layering: The layers.
        objects: The object of each layer, with the lengths `Layering.lengths`.
        indices: Indices of the symbols, 0..254.
    """
    descriptor = encode(np.frombuffer(layering.pack(), np.uint8)[:, None], indices)[:, 0]
    slices = [
        encode(np.frombuffer(data, np.uint8).reshape(need, -1), indices)
        for need, data in zip(layering.required_symbols, objects, strict=True)
    ]
    rows = np.concatenate(slices, axis=1)
    return [(int(value), row.tobytes()) for value, row in zip(descriptor, rows, strict=True)]


def recover_layering(symbols: Mapping[int, int]) -> Layering:
    """Return the layers from at least four descriptor symbols by index; the last four are used.

    Raises:
        FrameError: The symbols are not of one descriptor.
    """
    indices = list(symbols)[-DESCRIPTOR_SYMBOLS:]
    column = np.array([[symbols[i]] for i in indices], np.uint8)
    return Layering.unpack(recover(DESCRIPTOR_SYMBOLS, indices, column).tobytes())


def recover_layer(layering: Layering, layer: int, symbols: Mapping[int, bytes]) -> bytes:
    """Return the object of a layer from symbols by index, at least as many as it requires; the last are used."""
    need = layering.required_symbols[layer]
    indices = list(symbols)[-need:]
    size = len(symbols[indices[0]])
    start, stop = layering.bounds(size)[layer : layer + 2]
    rows = np.array([np.frombuffer(symbols[i], np.uint8)[start:stop] for i in indices], np.uint8)
    return recover(need, indices, rows.reshape(need, stop - start)).tobytes()
