"""Layered blocks of the v1 format: priority encoding transmission.

Each symbol of a layered block has a slice of every layer; layer l is Reed-Solomon coded so that any k_l symbols give
it. Whoever has more symbols has more layers, whichever they are (Albanese, Blomer, Edmonds, Luby, Sudan, "Priority
encoding transmission", IEEE Trans. Information Theory 42, 1996). What the layers are is told by a descriptor of four
bytes, itself coded so that any four symbols give it: a byte a frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sonarpost.errors import FrameError
from sonarpost.link.coding import erasure_code as fec

DESCRIPTOR_SYMBOLS: Final = 4
MAX_LAYERS: Final = 4
SHARES: Final = 16
MAX_STEP: Final = 63


@dataclass(frozen=True, slots=True)
class Layering:
    """The layers of a block.

    Attributes:
        first: Symbols that give the lowest layer, 4..255.
        step: How many more each next layer needs, 1..63; 0 with one layer.
        shares: Of each symbol, in 1/16, each at least 1; one to four that make 16.

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
            and self.first + (layers - 1) * self.step <= fec.MAX_SYMBOLS
        )
        if not fits:
            expected = "4..255 symbols, steps of 1..63, one to four shares of 1 or more that make 16"
            raise FrameError("layered block", "layers", (self.first, self.step, self.shares), expected)

    @property
    def needs(self) -> tuple[int, ...]:
        """Symbols that give each layer."""
        return tuple(self.first + i * self.step for i in range(len(self.shares)))

    def bounds(self, symbol_bytes: int) -> tuple[int, ...]:
        """Return where in a symbol each layer's slice begins, and the symbol's length."""
        totals = np.concatenate([[0], np.cumsum(self.shares)])
        return tuple(int(symbol_bytes * total // SHARES) for total in totals)

    def lengths(self, symbol_bytes: int) -> tuple[int, ...]:
        """Return the length of each layer's object."""
        bounds = self.bounds(symbol_bytes)
        return tuple(k * (b - a) for k, a, b in zip(self.needs, bounds, bounds[1:], strict=False))

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
            raise FrameError("layered block", "descriptor", data, "a check that fits")
        layers = (data[1] >> 6) + 1
        nibbles = [data[2] >> 4, data[2] & 15, data[3] >> 4]
        if any(nibbles[layers - 1 :]):
            raise FrameError("layered block", "descriptor", data, f"shares of {layers} layers only")
        told = nibbles[: layers - 1]
        return cls(data[0], data[1] & 63, (*told, SHARES - sum(told)))


def _nibble_sum(body: Sequence[int]) -> int:
    """Exclusive-or of all nibbles, and of 9, so that zeros are no descriptor."""
    total = 9
    for byte in body:
        total ^= byte >> 4 ^ byte & 15
    return total


def layered_symbols(layering: Layering, objects: Sequence[bytes], indices: Sequence[int]) -> list[tuple[int, bytes]]:
    """Return, for each index, the descriptor's symbol and the block's symbol.

    Args:
        layering: The layers.
        objects: Of each layer, of `Layering.lengths`.
        indices: Which symbols, 0..254.
    """
    descriptor = fec.encode(np.frombuffer(layering.pack(), np.uint8)[:, None], indices)[:, 0]
    slices = [
        fec.encode(np.frombuffer(data, np.uint8).reshape(need, -1), indices)
        for need, data in zip(layering.needs, objects, strict=True)
    ]
    rows = np.concatenate(slices, axis=1)
    return [(int(told), row.tobytes()) for told, row in zip(descriptor, rows, strict=True)]


def recover_layering(told: Mapping[int, int]) -> Layering:
    """Return the layering from the descriptor's symbols by index, at least four (the last four are used).

    Raises:
        FrameError: They are not of one descriptor.
    """
    indices = list(told)[-DESCRIPTOR_SYMBOLS:]
    column = np.array([[told[i]] for i in indices], np.uint8)
    return Layering.unpack(fec.recover(DESCRIPTOR_SYMBOLS, indices, column).tobytes())


def recover_layer(layering: Layering, layer: int, symbols: Mapping[int, bytes]) -> bytes:
    """Return the object of a layer from symbols by index, at least as many as it needs (the last are used)."""
    need = layering.needs[layer]
    indices = list(symbols)[-need:]
    size = len(symbols[indices[0]])
    start, stop = layering.bounds(size)[layer : layer + 2]
    rows = np.array([np.frombuffer(symbols[i], np.uint8)[start:stop] for i in indices], np.uint8)
    return fec.recover(need, indices, rows.reshape(need, stop - start)).tobytes()
