"""Reduction of a block that is being sent: the same number, without the pieces of some images."""

from __future__ import annotations

from collections.abc import Container
from typing import Final

from sonarpost.link.coding.blocks import SendBlock
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.coding.redundancy_plan import symbols_to_send
from sonarpost.link.frames.v1.frame import SymbolKind
from sonarpost.link.frames.v1.payload_objects import PieceList, StreamPiece, unpack_object

_SYMBOLS_TO_REPLACE: Final = 2
"""Receivers replace a block of which they have symbols when two symbols of the other content have arrived."""


def reduced_block(block: SendBlock, dropped: Container[int], channel: LossChannel) -> SendBlock | None:
    """Return the block without the pieces of some images, None if that would not end sooner.

    Receivers lose the symbols that were sent: they take the reduced block for a later one with the same number. If no
    image remains, the reduced block has one symbol with an empty piece, so that receivers do not wait for the old one.

    Args:
        block: The block.
        dropped: Contact numbers of the images to leave out.
        channel: The channel to plan for.
    """
    spans = tuple(span for span in block.spans if span[0] not in dropped)
    if block.kind == SymbolKind.PREVIEW or block.left <= 0 or len(spans) == len(block.spans):
        return None
    if block.layering is not None and spans:
        return None  # the layers of several images were optimised together
    content = unpack_object(block.objects[0])
    assert isinstance(content, PieceList)
    pieces = PieceList(tuple(piece for piece in content.pieces if piece.number not in dropped), content.final)
    if not spans:
        first = content.pieces[0]
        pieces = PieceList((StreamPiece(first.number, first.link, first.start, b""),), final=False)
    size = pieces.overhead_bytes() + sum(len(piece.data) for piece in pieces.pieces)
    source = -(-size // block.symbol_bytes)
    planned = symbols_to_send(source, channel)
    if block.sent:
        planned = max(planned, _SYMBOLS_TO_REPLACE)
        if source >= block.source_symbols or planned + _SYMBOLS_TO_REPLACE > block.left:
            return None
    return SendBlock(
        kind=SymbolKind.OBJECT,
        number=block.number,
        symbol_bytes=block.symbol_bytes,
        objects=(pieces.pack(source * block.symbol_bytes),),
        layering=None,
        contacts=tuple(span[0] for span in spans),
        urgency=block.urgency,
        spans=spans,
        planned=planned,
        last_activity_s=block.last_activity_s,
    )
