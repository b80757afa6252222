"""A block on the receiver's side: symbols in, what they give out."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sonarpost.errors import FrameError
from sonarpost.link.coding import erasure_code as fec
from sonarpost.link.frames.v1.frame import Symbol, SymbolKind
from sonarpost.link.frames.v1.layers import DESCRIPTOR_SYMBOLS, Layering, recover_layer, recover_layering
from sonarpost.link.frames.v1.payload_objects import MessageObject, PieceList, unpack_object
from sonarpost.link.frames.v1.preview import Preview, entry_shape

DecodedObject = Preview | PieceList | MessageObject


@dataclass(eq=False)
class BlockDecoder:
    """A block under way.

    Attributes:
        kind: What it holds.
        number: 0..31.
        symbol_bytes: Length of its symbols.
        count: k; 0 for a layered block.
        last_at: Time of the last symbol.
        symbols: By index, the latest to arrive last. When all is recovered, a digest of each: a later block with the
            same number is told from this one by them.
        told: A layered block's descriptor symbols, by index.
        layering: When it is known.
        layers: Pieces of the layers recovered so far.
        complete: Whether all is recovered.
        mixed: How often symbols turned out not to be of one block.
    """

    kind: SymbolKind
    number: int
    symbol_bytes: int
    count: int
    last_at: float
    symbols: dict[int, bytes] = field(default_factory=dict)
    told: dict[int, int] = field(default_factory=dict)
    layering: Layering | None = None
    layers: list[PieceList] = field(default_factory=list)
    complete: bool = False
    mixed: int = 0

    @classmethod
    def of(cls, symbol: Symbol, now: float) -> BlockDecoder:
        """Begin a block with its first symbol (which is still to be added)."""
        count = 0 if symbol.kind == SymbolKind.LAYERED else symbol.parameter
        return cls(symbol.kind, symbol.block, len(symbol.data), count, now)

    def takes(self, symbol: Symbol) -> bool:
        """Whether a symbol can be of this block, and not of a later one with its number."""
        same = (self.kind, self.symbol_bytes) == (symbol.kind, len(symbol.data))
        known = self.symbols.get(symbol.index)
        data = _digest(symbol.data) if self.complete else symbol.data
        return (
            same
            and (symbol.kind == SymbolKind.LAYERED or self.count == symbol.parameter)
            and (known is None or known == data)
        )

    @property
    def need(self) -> int:
        """Symbols that are still lacking for all of it."""
        if self.complete:
            return 0
        if self.kind == SymbolKind.LAYERED:
            wanted = DESCRIPTOR_SYMBOLS if self.layering is None else self.layering.needs[-1]
        else:
            wanted = self.count
        return max(1, wanted - len(self.symbols))

    def add(self, symbol: Symbol, now: float) -> list[DecodedObject]:
        """Take a symbol; return what became known by it.

        Raises:
            FrameError: Enough symbols are there but they are not of one block. The older half of them is forgotten.
        """
        self.last_at = now
        if self.complete or symbol.index in self.symbols:
            return []
        self.symbols[symbol.index] = symbol.data
        try:
            if self.kind == SymbolKind.PREVIEW:
                return list(self._previews(symbol))
            if self.kind == SymbolKind.LAYERED:
                self.told[symbol.index] = symbol.parameter
                return list(self._more_layers())
            return self._object()
        except FrameError:
            self._forget_older_half()
            raise

    def _object(self) -> list[DecodedObject]:
        if len(self.symbols) < self.count:
            return []
        found = unpack_object(self._source().tobytes(), where=f"block {self.number}")
        self._finish()
        return [found]

    def _source(self) -> fec.Bytes:
        indices = list(self.symbols)[-self.count :]
        rows = np.array([np.frombuffer(self.symbols[i], np.uint8) for i in indices], np.uint8)
        return fec.recover(self.count, indices, rows)

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

    def _more_layers(self) -> Iterator[PieceList]:
        if self.layering is None and len(self.told) >= DESCRIPTOR_SYMBOLS:
            self.layering = recover_layering(self.told)
        found: list[PieceList] = []
        while self.layering is not None and len(self.layers) < len(self.layering.needs):
            layer = len(self.layers)
            if len(self.symbols) < self.layering.needs[layer]:
                break
            below = self.layers[-1] if self.layers else None
            data = recover_layer(self.layering, layer, self.symbols)
            pieces = unpack_object(data, below, f"block {self.number}, layer {layer}")
            if not isinstance(pieces, PieceList):
                raise FrameError(f"block {self.number}", "layer", "a message", "pieces of pictures")
            self.layers.append(pieces)
            found.append(pieces)
        if self.layering is not None and len(self.layers) == len(self.layering.needs):
            self._finish()
        yield from found

    def _finish(self) -> None:
        self.complete = True
        self.symbols = {index: _digest(data) for index, data in self.symbols.items()}
        self.told.clear()
        self.layers.clear()

    def _forget_older_half(self) -> None:
        self.mixed += 1
        for index in list(self.symbols)[: (len(self.symbols) + 1) // 2]:
            del self.symbols[index]
            self.told.pop(index, None)
        # What the descriptor said may have come from another block.
        self.layering = None
        self.layers.clear()


def _digest(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(4, "big")


def _entries(source: bytes, entries: int, span: int, entry_bytes: int) -> Iterator[Preview]:
    """Yield the previews in source symbols; spans of zeros are unused places."""
    for base in range(0, len(source), span):
        for place in range(entries):
            entry = source[base + place * entry_bytes : base + (place + 1) * entry_bytes]
            if entry.strip(b"\0"):
                yield Preview.unpack(entry)
