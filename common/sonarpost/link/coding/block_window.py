"""Blocks that a sender has in transmission: their numbers, their order, and what feedback changes in them."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from typing import Final

from sonarpost.link.coding.blocks import OutgoingImage, SendBlock, numbers_needed
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.coding.redundancy_plan import symbols_to_send
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.v1.frame import BLOCKS, Symbol, SymbolKind
from sonarpost.link.frames.v1.payload_objects import (
    NEVER_RECEIVED,
    WINDOW,
    Feedback,
    PieceList,
    StreamPiece,
    unpack_object,
)

FIRST_URGENCY: Final = 1e3
"""Urgency of the blocks of an image that a command has moved to the front."""
LAST_URGENCY: Final = 1e-3
"""Urgency of the blocks of an image that a command has moved to the end."""
_MAX_SYMBOL_FACTOR: Final = 4
"""Maximum ratio of symbols sent to source symbols, of a block without feedback while other images wait."""
_SYMBOLS_TO_REPLACE: Final = 2
"""Receivers replace a block of which they have symbols when two symbols of the other content have arrived."""


class BlockWindow:
    """The blocks of one sender. At most `WINDOW` numbers are in use; a block beyond them replaces the oldest.

    Attributes:
        blocks: Blocks that are being sent, the oldest first.
        retired: Blocks that were sent without feedback, and that feedback can still mention.
        next_block: Number of the next block.
        may_repair: Whether a part of a kept image may be neither delivered nor in a block.

    Args:
        next_block: Number of the first block.
    """

    def __init__(self, next_block: int) -> None:
        self.blocks: list[SendBlock] = []
        self.retired: list[SendBlock] = []
        self.next_block = next_block % BLOCKS
        self.may_repair = True

    @property
    def open_blocks(self) -> list[SendBlock]:
        """The blocks of which symbols are still to be sent."""
        return [block for block in self.blocks if block.left > 0]

    @property
    def free_numbers(self) -> int:
        """Number of blocks that can begin without a replacement of the oldest."""
        if not self.blocks:
            return WINDOW
        return WINDOW - (self.next_block - self.blocks[0].number) % BLOCKS

    def has_numbers_for(self, group: Sequence[OutgoingImage], config: SenderConfig, symbol_bytes: int) -> bool:
        """Whether a group of images can begin without a replacement."""
        return self.free_numbers >= numbers_needed(group, config, symbol_bytes)

    def may_begin(self, group: Sequence[OutgoingImage], config: SenderConfig, symbol_bytes: int) -> bool:
        """Whether a group of images can begin now: fewer than `depth` groups are open, and there are numbers for it."""
        previews = sum(1 for b in self.open_blocks if b.kind == SymbolKind.PREVIEW)
        details = sum(1 for b in self.open_blocks if b.kind != SymbolKind.PREVIEW and b.urgency != LAST_URGENCY)
        if max(previews, details) >= config.depth:
            return False
        # A group that does not even fit an empty window need not wait.
        return not self.blocks or self.has_numbers_for(group, config, symbol_bytes)

    def take_number(self) -> int:
        """Return the number of a new block, and delete the oldest block if there is no free number."""
        while self.free_numbers < 1:
            self.blocks.pop(0)  # receivers delete it too
            self.may_repair = True
        number = self.next_block
        self.next_block = (number + 1) % BLOCKS
        # A new block must never be mistaken for a retired one with the same number.
        self.retired = [b for b in self.retired if (self.next_block - b.number - 1) % BLOCKS < WINDOW]
        return number

    def restore(self, blocks: Sequence[SendBlock]) -> None:
        """Replace the blocks by saved ones."""
        ordered = sorted(blocks, key=self._age)
        self.blocks = [block for block in ordered if not block.retired]
        self.retired = [block for block in ordered if block.retired]
        self.may_repair = True

    def _age(self, block: SendBlock) -> int:
        return (block.number - self.next_block) % BLOCKS

    def resize(self, symbol_bytes: int, room: int) -> set[int]:
        """Give up the blocks whose symbols do not fit another frame length.

        Args:
            symbol_bytes: Length of a symbol that fills a frame.
            room: Bytes for segments in a frame.

        Returns:
            The contact numbers of the images in them.
        """
        before = self.blocks
        self.blocks, self.retired = (
            [block for block in blocks if block.symbol_bytes == symbol_bytes or block.symbol_bytes + 5 <= room]
            for blocks in (self.blocks, self.retired)
        )
        self.may_repair = True
        return {number for block in before if block not in self.blocks for number in block.contacts}

    # Sending

    def next_symbol(self, max_bytes: int, *, feedback: bool) -> Symbol | None:
        """Return the most valuable symbol of at most a length; without feedback a completed block is retired."""
        fitting = [block for block in self.open_blocks if block.symbol_bytes <= max_bytes]
        if not fitting:
            return None
        block = min(fitting, key=_order_of_sending)
        symbol = block.next_symbol()
        if block.left <= 0 and not feedback:
            self._retire(block)
        return symbol

    def _retire(self, block: SendBlock) -> None:
        self.blocks.remove(block)
        block.retired = True
        self.retired += [block] if block.spans else []
        self.may_repair = True

    def retire_completed(self) -> None:
        """Retire the blocks of which all planned symbols were sent: no feedback is expected any more."""
        for block in [block for block in self.blocks if block.left <= 0]:
            self._retire(block)

    def overdue(self, now: float, max_defer_s: float) -> list[SendBlock]:
        """Return the completed blocks without feedback for `max_defer_s`."""
        for block in self.blocks:
            block.last_activity_s = min(block.last_activity_s, now)  # later only after the clock was set back
        return [block for block in self.blocks if block.left <= 0 and now - block.last_activity_s >= max_defer_s]

    def send_reminders(self, now: float, max_defer_s: float) -> None:
        """Send a few symbols more of blocks without feedback for long: they trigger feedback."""
        for block in self.overdue(now, max_defer_s):
            block.last_activity_s = now
            block.planned += max(1, block.source_symbols // 16)

    def extend_least_redundant(self) -> bool:
        """Send one more symbol of the block with the least redundancy; return whether there is one."""
        candidates = [b for b in self.blocks if b.sent < _MAX_SYMBOL_FACTOR * b.source_symbols]
        if candidates:
            min(candidates, key=lambda b: b.sent / b.source_symbols).planned += 1
        return bool(candidates)

    def move(self, number: int, *, first: bool) -> None:
        """Send the detail of an image before or after all others."""
        for block in self.blocks:
            if number in block.contacts and block.kind != SymbolKind.PREVIEW:
                block.urgency = FIRST_URGENCY if first else LAST_URGENCY

    # Feedback and commands

    def resume_retired(self, feedback: Feedback) -> None:
        """Continue blocks that were sent before the first feedback, if a receiver has some of their symbols."""
        reported = [block for block in self.retired if feedback.missing_of(block.number) is not None]
        self.retired = [block for block in self.retired if block not in reported]
        found = [block for block in reported if feedback.missing_of(block.number) != NEVER_RECEIVED]
        for block in found:
            block.retired = False
        if found:
            self.blocks = sorted([*self.blocks, *found], key=self._age)

    def leave_out(
        self,
        dropped: Container[int],
        channel: LossChannel,
        on_span: Callable[[int, int, int], None],
        *,
        shared_only: bool = False,
    ) -> bool:
        """Leave out images from the blocks that are being sent, where that ends sooner.

        Args:
            dropped: Contact numbers of the images.
            channel: The channel to plan for.
            on_span: Called with number, link and first byte of each part that is left out.
            shared_only: Only from blocks that other images share.

        Returns:
            Whether a block was reduced.
        """
        blocks = [b for b in self.blocks if not shared_only or any(number not in dropped for number in b.contacts)]
        reduced = {block.number: made for block in blocks if (made := _reduced(block, dropped, channel))}
        for block in [block for block in blocks if block.number in reduced]:
            for number, link, start, _ in block.spans:
                if number in dropped:
                    on_span(number, link, start)
        self.blocks = [reduced.get(block.number, block) for block in self.blocks]
        return bool(reduced)


def _order_of_sending(block: SendBlock) -> tuple[bool, bool, bool, bool, float]:
    """Return the sort key of a block: the smallest goes next, of equal ones the oldest.

    Requested symbols complete something, so they precede the others.
    """
    return (
        block.urgency == LAST_URGENCY,
        not block.is_fresh_preview,
        block.urgency != FIRST_URGENCY,
        not block.reported,
        0.0 if block.reported else block.progress,
    )


def _reduced(block: SendBlock, dropped: Container[int], channel: LossChannel) -> SendBlock | None:
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
