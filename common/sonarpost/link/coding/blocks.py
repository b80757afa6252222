"""Blocks of the v1 sender: made from pictures, read symbol by symbol, saved and restored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sonarpost.errors import FrameError
from sonarpost.link.coding import erasure_code as fec
from sonarpost.link.coding.byte_ranges import Ranges
from sonarpost.link.coding.rate_distortion import Values
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import Symbol, SymbolKind
from sonarpost.link.frames.v1.layers import Layering, layered_symbols
from sonarpost.link.frames.v1.payload_objects import PieceList, StreamPiece
from sonarpost.link.frames.v1.preview import Preview, contact_link, entry_shape

StreamSpan = tuple[int, int, int, int]
"""Number and link of a picture, and a part of its stream `[start, stop)`."""
_AHEAD = 32
"""Symbols are made so many at a time: a matrix product of several costs little more than one."""


@dataclass(eq=False)
class OutgoingImage:
    """A picture to send.

    Attributes:
        number: Of its contact, 1..65535.
        contact: The contact's record.
        stream: The codec's stream; all of it may be sent, and what is worth most is sent first.
        curve: PSNR by bytes, see `v1_gain.quality_curve`.
        added_at: When it was handed over.
        sent: Bytes of the stream that blocks hold so far.
        goal: Up to where the stream is to be sent, where that was asked for; 0 as configured.
        settled: Parts of the stream that receivers are known to have; from 0 on, with the record.
    """

    number: int
    contact: ContactSummary
    stream: bytes
    curve: Values
    added_at: float
    sent: int = 0
    goal: int = 0
    settled: Ranges = ()

    def goal_bytes(self, usual: int) -> int:
        """Return up to where the stream is to be sent, where `usual` bytes are unless more were asked for."""
        return min(len(self.stream), max(self.goal or usual, self.sent))

    @property
    def link(self) -> int:
        """See `contact_link`."""
        return contact_link(self.number, self.contact.pack())

    def preview(self, prefix_bytes: int) -> Preview:
        """Return the preview with so much of the stream."""
        return Preview(self.number, self.contact, self.stream[:prefix_bytes], ended=len(self.stream) < prefix_bytes)

    def span(self, start: int, stop: int) -> StreamSpan:
        """Return what a block notes of a part of the stream that it holds."""
        return self.number, self.link, start, stop

    def piece(self, start: int, stop: int) -> StreamPiece:
        """Return a piece of the stream."""
        return StreamPiece(self.number, self.link, start, self.stream[start:stop])


@dataclass(eq=False)
class SendBlock:
    """A block under way.

    Attributes:
        kind: What it holds.
        number: 0..31.
        symbol_bytes: Length of a symbol.
        objects: One object, or one a layer.
        layering: Of a layered block.
        contacts: Contacts it is about.
        urgency: How much earlier than others it is sent: progress counts divided by this.
        planned: Symbols to send, by the plan so far.
        sent: Symbols sent.
        reported: Whether feedback has told of it.
        asked_at: When it was last sent or asked for.
        needs: Symbols lacking, by receiver, as last reported.
        spans: Of every picture in it number, link, and the part of the stream; from 0 on, its record too.
    """

    kind: SymbolKind
    number: int
    symbol_bytes: int
    objects: tuple[bytes, ...]
    layering: Layering | None
    contacts: tuple[int, ...]
    urgency: float
    planned: int
    sent: int = 0
    reported: bool = False
    asked_at: float = 0.0
    needs: dict[int, int] = field(default_factory=dict)
    spans: tuple[StreamSpan, ...] = ()
    _made: dict[int, Symbol] = field(default_factory=dict)

    @property
    def source_symbols(self) -> int:
        """Symbols that give all of it."""
        return self.layering.needs[-1] if self.layering else len(self.objects[0]) // self.symbol_bytes

    @property
    def lacks(self) -> int:
        """Symbols still to send."""
        return self.planned - self.sent

    @property
    def progress(self) -> float:
        """How far it is, by its urgency."""
        return (self.sent + 0.5) / (max(self.planned, 1) * self.urgency)

    @property
    def is_fresh_preview(self) -> bool:
        """Whether contacts of it have not been sent once."""
        return self.kind == SymbolKind.PREVIEW and self.sent < self.source_symbols

    def next_symbol(self) -> Symbol:
        """Return the next symbol. After all 255 they come again."""
        index = self.sent % fec.MAX_SYMBOLS
        self.sent += 1
        if index not in self._made:
            self._make(range(index, min(index + _AHEAD, fec.MAX_SYMBOLS)))
        return self._made.pop(index)

    def _make(self, indices: Sequence[int]) -> None:
        if self.layering is not None:
            for index, (told, data) in zip(indices, layered_symbols(self.layering, self.objects, indices), strict=True):
                self._made[index] = Symbol(self.kind, self.number, index, told, data)
            return
        source = np.frombuffer(self.objects[0], np.uint8).reshape(-1, self.symbol_bytes)
        for index, row in zip(indices, fec.encode(source, indices), strict=True):
            self._made[index] = Symbol(self.kind, self.number, index, source.shape[0], row.tobytes())


def preview_object(pictures: Sequence[OutgoingImage], symbol_bytes: int) -> bytes:
    """Return the source symbols of a preview block as one object."""
    shape = entry_shape(symbol_bytes)
    entries = [picture.preview(shape.prefix_bytes).pack(shape.entry_bytes) for picture in pictures]
    groups = [b"".join(entries[i : i + shape.entries]) for i in range(0, len(entries), shape.entries)]
    return b"".join(group.ljust(symbol_bytes * shape.symbols, b"\0") for group in groups)


def layer_objects(
    pictures: Sequence[OutgoingImage],
    layering: Layering,
    symbol_bytes: int,
    starts: Sequence[int],
    layer_stops: list[list[int]],
) -> tuple[bytes, ...]:
    """Return the objects of a layered block, given up to where each layer goes in each stream."""
    objects: list[bytes] = []
    below: PieceList | None = None
    begins = list(starts)
    for layer, (length, stops) in enumerate(zip(layering.lengths(symbol_bytes), layer_stops, strict=True)):
        pieces = tuple(p.piece(a, b) for p, a, b in zip(pictures, begins, stops, strict=True))
        group = PieceList(pieces, final=layer == len(layer_stops) - 1)
        objects.append(group.pack(length, below))
        below, begins = group, stops
    return tuple(objects)


def fitted_stops(
    pictures: Sequence[OutgoingImage], starts: Sequence[int], stops: list[int], room: int, below: PieceList | None
) -> list[int]:
    """Return `stops`, drawn back or pushed on until the object fills `room` bytes as well as it can.

    What lengths cost depends on the lengths, so the plan can be a few bytes off either way.

    Raises:
        FrameError: Not even empty pieces fit.
    """

    def overhead(ends: Sequence[int]) -> int:
        found = tuple(p.piece(a, b) for p, a, b in zip(pictures, starts, ends, strict=True))
        return PieceList(found, final=True).overhead_bytes(below)

    ends = [max(a, b) for a, b in zip(starts, stops, strict=True)]
    spare = room - overhead(ends) - sum(ends) + sum(starts)
    while spare < 0:
        longest = max(range(len(ends)), key=lambda i: ends[i] - starts[i])
        if ends[longest] == starts[longest]:
            raise FrameError("picture group", "room", f"{room} bytes", f"at least {overhead(ends)}")
        ends[longest] -= min(-spare, ends[longest] - starts[longest])
        spare = room - overhead(ends) - sum(ends) + sum(starts)
    for i, picture in enumerate(pictures):
        if spare < 3:  # a longer length may take a byte more itself
            break
        more = min(spare - 2, len(picture.stream) - ends[i])
        if more > 0:
            ends[i] += more
            spare = room - overhead(ends) - sum(ends) + sum(starts)
    return ends
