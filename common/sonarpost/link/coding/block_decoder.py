"""Receiver's side of a block: symbols in, decoded objects out."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Final

import numpy as np

from sonarpost.errors import FrameError
from sonarpost.link.coding import erasure_code
from sonarpost.link.coding.erasure_code import DESCRIPTOR_SYMBOLS, Layering, recover_layer, recover_layering
from sonarpost.link.frames.v1.frame import BLOCKS, MAX_INDEX, Symbol, SymbolKind
from sonarpost.link.frames.v1.payload_objects import (
    MessageObject,
    PieceEnd,
    PieceList,
    Preview,
    entry_shape,
    unpack_object,
)
from sonarpost.link.state import SEPARATE, Bounds, Byte, SavedCount

DecodedObject = Preview | PieceList | MessageObject

_DIGEST_BYTES: Final = 4
_CHUNK_SYMBOLS: Final = 16


@dataclass(frozen=True, slots=True)
class SymbolChunk:
    """Symbols of a block as one part of the saved state; a new symbol changes one chunk only.

    Attributes:
        symbols: Index, data (or its digest) and descriptor symbol of each, in the order of arrival.
    """

    symbols: tuple[tuple[Annotated[int, Bounds(0, MAX_INDEX)], bytes, Byte], ...]


@dataclass(eq=False)
class BlockDecoder:
    """A block that is being received.

    Attributes:
        kind: Content of the block.
        number: 0..31.
        symbol_bytes: Length of its symbols.
        count: Number of source symbols k; 0 for a layered block.
        last_symbol_s: Time of the last symbol, or earlier after the clock was set back.
        symbols: By index, in the order of arrival. In a complete block only a digest of each: it distinguishes a later
            block with the same number.
        descriptor: Descriptor symbols of a layered block, by index.
        layering: The layers, None until they are known.
        layers: Layers recovered so far.
        layer_ends: Ends of the pieces in the highest layer recovered so far.
        complete: Whether everything is recovered.
    """

    kind: SymbolKind
    number: Annotated[int, Bounds(0, BLOCKS - 1)]
    symbol_bytes: Annotated[int, Bounds(1, 65535)]
    count: Byte
    last_symbol_s: float
    symbols: dict[int, bytes] = field(default_factory=dict, metadata=SEPARATE)
    descriptor: dict[int, int] = field(default_factory=dict, metadata=SEPARATE)
    layering: Layering | None = None
    layers: SavedCount = 0
    layer_ends: tuple[PieceEnd, ...] = ()
    complete: bool = False

    def __post_init__(self) -> None:
        if (self.count == 0) != (self.kind == SymbolKind.LAYERED):
            raise FrameError("block", "count", self.count, "0 for a layered block, 1..255 for others")

    @classmethod
    def of(cls, symbol: Symbol, now: float) -> BlockDecoder:
        """Return an empty block for a symbol, which the caller adds next."""
        count = 0 if symbol.kind == SymbolKind.LAYERED else symbol.parameter
        return cls(symbol.kind, symbol.block, len(symbol.data), count, now)

    def matches(self, symbol: Symbol) -> bool:
        """Whether a symbol can belong to this block, and not to a later one with the same number."""
        same = (self.kind, self.symbol_bytes) == (symbol.kind, len(symbol.data))
        known = self.symbols.get(symbol.index)
        data = _digest(symbol.data) if self.complete else symbol.data
        return (
            same
            and (symbol.kind == SymbolKind.LAYERED or self.count == symbol.parameter)
            and (known is None or known == data)
        )

    @property
    def missing_symbols(self) -> int:
        """Number of symbols that are still required to recover everything."""
        if self.complete:
            return 0
        if self.kind == SymbolKind.LAYERED:
            required = DESCRIPTOR_SYMBOLS if self.layering is None else self.layering.required_symbols[-1]
        else:
            required = self.count
        return max(1, required - len(self.symbols))

    def add(self, symbol: Symbol, now: float) -> list[DecodedObject]:
        """Add a symbol; return the objects that it completes.

        Raises:
            FrameError: The symbols are not all of one block. The older half of them is deleted.
        """
        self.last_symbol_s = now
        if self.complete or symbol.index in self.symbols:
            return []
        self.symbols[symbol.index] = symbol.data
        try:
            if self.kind == SymbolKind.PREVIEW:
                return list(self._previews(symbol))
            if self.kind == SymbolKind.LAYERED:
                self.descriptor[symbol.index] = symbol.parameter
                return list(self._recovered_layers())
            return self._recovered_object()
        except FrameError:
            self._delete_older_half()
            raise

    def _recovered_object(self) -> list[DecodedObject]:
        if len(self.symbols) < self.count:
            return []
        found = unpack_object(self._source().tobytes(), where=f"block {self.number}")
        self._finish()
        return [found]

    def _source(self) -> erasure_code.Bytes:
        indices = list(self.symbols)[-self.count :]
        rows = np.array([np.frombuffer(self.symbols[i], np.uint8) for i in indices], np.uint8)
        return erasure_code.recover(self.count, indices, rows)

    def _previews(self, symbol: Symbol) -> Iterator[Preview]:
        shape = entry_shape(self.symbol_bytes)
        if len(self.symbols) >= self.count:
            source = self._source().tobytes()
            found = list(_entries(source, shape.entries, shape.symbols * self.symbol_bytes, shape.entry_bytes))
            self._finish()
            yield from found
        elif symbol.index < self.count:
            first = symbol.index - symbol.index % shape.symbols
            parts = [self.symbols.get(i) for i in range(first, first + shape.symbols)]
            if None not in parts:
                data = b"".join(p for p in parts if p is not None)
                yield from _entries(data, shape.entries, len(data), shape.entry_bytes)

    def _recovered_layers(self) -> Iterator[PieceList]:
        if self.layering is None and len(self.descriptor) >= DESCRIPTOR_SYMBOLS:
            self.layering = recover_layering(self.descriptor)
        found: list[PieceList] = []
        while self.layering is not None and self.layers < len(self.layering.required_symbols):
            if len(self.symbols) < self.layering.required_symbols[self.layers]:
                break
            data = recover_layer(self.layering, self.layers, self.symbols)
            below = self.layer_ends if self.layers else None
            pieces = unpack_object(data, below, f"block {self.number}, layer {self.layers}")
            if not isinstance(pieces, PieceList):
                raise FrameError(f"block {self.number}", "layer", "a message", "pieces of images")
            self.layers += 1
            self.layer_ends = pieces.ends
            found.append(pieces)
        if self.layering is not None and self.layers == len(self.layering.required_symbols):
            self._finish()
        yield from found

    def _finish(self) -> None:
        self.complete = True
        self.symbols = {index: _digest(data) for index, data in self.symbols.items()}
        self.descriptor.clear()
        self.layers, self.layer_ends = 0, ()

    def _delete_older_half(self) -> None:
        for index in list(self.symbols)[: (len(self.symbols) + 1) // 2]:
            del self.symbols[index]
            self.descriptor.pop(index, None)
        # The descriptor may have come from another block.
        self.layering = None
        self.layers, self.layer_ends = 0, ()

    def symbol_chunks(self) -> list[SymbolChunk]:
        """Return the symbols as chunks to save."""
        symbols = [(index, data, self.descriptor.get(index, 0)) for index, data in self.symbols.items()]
        return [SymbolChunk(tuple(symbols[at : at + _CHUNK_SYMBOLS])) for at in range(0, len(symbols), _CHUNK_SYMBOLS)]

    def restore_chunk(self, chunk: SymbolChunk) -> None:
        """Add the symbols of a saved chunk.

        Raises:
            FrameError: A symbol does not have the length of this block's symbols or digests.
        """
        length = _DIGEST_BYTES if self.complete else self.symbol_bytes
        for index, data, descriptor in chunk.symbols:
            if len(data) != length:
                raise FrameError(f"block {self.number}", "symbols", f"{len(data)} bytes", f"{length} bytes")
            self.symbols[index] = data
            if self.kind == SymbolKind.LAYERED and not self.complete:
                self.descriptor[index] = descriptor


def _digest(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(_DIGEST_BYTES, "big")


def _entries(source: bytes, entries: int, span: int, entry_bytes: int) -> Iterator[Preview]:
    """Yield the previews in source symbols; a span of zeros is an unused place."""
    for base in range(0, len(source), span):
        for place in range(entries):
            entry = source[base + place * entry_bytes : base + (place + 1) * entry_bytes]
            if entry.strip(b"\0"):
                yield Preview.unpack(entry)
