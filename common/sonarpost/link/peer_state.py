"""All that the v1 receiver knows of one sender."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Final

from sonarpost.link.coding.block_decoder import BlockDecoder, DecodedObject
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.events import ContactUpdate, Event, MessageReceived
from sonarpost.link.frames.v1.feedback import NEVER_RECEIVED, WINDOW, Feedback
from sonarpost.link.frames.v1.frame import BLOCKS, Symbol
from sonarpost.link.frames.v1.payload_objects import MessageObject, StreamPiece
from sonarpost.link.frames.v1.preview import Preview
from sonarpost.link.received_contact import KnownContact

_MESSAGES_REMEMBERED: Final = 64
_PIECES_WAITING: Final = 128


@dataclass(eq=False)
class PeerState:
    """One sender.

    Attributes:
        address: Its modem's.
        heard_at: When it was last heard.
        frames: Undamaged frames of this format.
        newest: Number of the newest block heard, -1 before the first.
        span: Blocks from the first heard to the newest, at most 16.
        blocks: By number, within the window.
        rivals: Blocks that may be later ones with the number of a remembered one.
        contacts: By number, least recently heard first.
        messages: Number, digest and time of those received of late.
        reported_at: When a report was last made.
        reported_frames: `frames` then.
        needless: Symbols of complete blocks since then.
    """

    address: int
    heard_at: float
    frames: int = 0
    newest: int = -1
    span: int = 0
    blocks: dict[int, BlockDecoder] = field(default_factory=dict)
    rivals: dict[int, BlockDecoder] = field(default_factory=dict)
    contacts: dict[int, KnownContact] = field(default_factory=dict)
    messages: list[tuple[int, int, float]] = field(default_factory=list)
    reported_at: float = 0.0
    reported_frames: int = 0
    needless: int = 0

    def forget_old(self, now: float, config: ReceiverConfig) -> None:
        """Forget what was not heard of for long; a clock set back makes nothing stay longer."""
        for assembly in (*self.blocks.values(), *self.rivals.values()):
            assembly.last_at = min(assembly.last_at, now)
        for known in self.contacts.values():
            known.last_at = min(known.last_at, now)
        for table in (self.blocks, self.rivals):
            for number in [n for n, a in table.items() if a.last_at + config.block_memory_s < now]:
                del table[number]
        if not self.blocks:
            self.newest, self.span = -1, 0
        for number in [n for n, c in self.contacts.items() if c.last_at + config.contact_memory_s < now]:
            del self.contacts[number]
        self.messages = [m for m in self.messages if m[2] + config.block_memory_s >= now]

    def add_symbol(self, symbol: Symbol, now: float, config: ReceiverConfig) -> list[Event]:
        """Take a symbol.

        Raises:
            FrameError: It does not fit the others of its block.
        """
        self._move_window(symbol.block)
        block = self._block_for(symbol, now)
        self.needless += block.complete
        events: list[Event] = []
        for found in block.add(symbol, now):
            events += self.add_found(found, now, config)
        return events

    def _move_window(self, number: int) -> None:
        ahead = (number - self.newest) % BLOCKS if self.newest >= 0 else 1
        if 0 < ahead < WINDOW or self.newest < 0:
            self.newest = number
            self.span = min(WINDOW, self.span + ahead)
            for table in (self.blocks, self.rivals):
                for old in [n for n in table if (number - n) % BLOCKS >= WINDOW]:
                    del table[old]
        else:
            self.span = min(WINDOW, max(self.span, (self.newest - number) % BLOCKS + 1))

    def _block_for(self, symbol: Symbol, now: float) -> BlockDecoder:
        """Return the block a symbol is of.

        One that does not fit the remembered block of its number may be of a later one, or damaged: it takes two of them
        to replace a block.
        """
        block = self.blocks.get(symbol.block)
        if block is None:
            block = self.blocks[symbol.block] = BlockDecoder.of(symbol, now)
        if block.takes(symbol):
            return block
        rival = self.rivals.get(symbol.block)
        if rival is None or not rival.takes(symbol):
            rival = self.rivals[symbol.block] = BlockDecoder.of(symbol, now)
            return rival
        if symbol.index not in rival.symbols:
            self.blocks[symbol.block] = self.rivals.pop(symbol.block)
        return rival

    def add_found(self, found: DecodedObject, now: float, config: ReceiverConfig) -> list[Event]:
        """Take what a block or segment gave."""
        if isinstance(found, MessageObject):
            return self.add_message(found, now)
        if isinstance(found, Preview):
            update = self._add_preview(found, now, config)
            return [update] if update else []
        updates = [self._add_piece(piece, now, config, final=found.final) for piece in found.pieces]
        return [update for update in updates if update]

    def add_message(self, message: MessageObject, now: float) -> list[Event]:
        """Take a message; repetitions give nothing."""
        digest = zlib.crc32(message.data)
        repeated = any((number, check) == (message.number, digest) for number, check, _ in self.messages)
        self.messages = [m for m in self.messages if m[:2] != (message.number, digest)]
        self.messages = [*self.messages, (message.number, digest, now)][-_MESSAGES_REMEMBERED:]
        return [] if repeated else [MessageReceived(self.address, message.number, message.data, now)]

    def _add_preview(self, preview: Preview, now: float, config: ReceiverConfig) -> ContactUpdate | None:
        known = self.contacts.pop(preview.number, None)
        if known is None or not known.belongs(preview):
            self._make_room(config)
            known = KnownContact(self.address, preview.number, now, now)
        self.contacts[preview.number] = known
        known.add_preview(preview, now)
        return known.update()

    def _add_piece(
        self, piece: StreamPiece, now: float, config: ReceiverConfig, *, final: bool
    ) -> ContactUpdate | None:
        known = self.contacts.pop(piece.number, None)
        if known is None or known.link != piece.link:
            self._make_room(config)
            known = KnownContact(self.address, piece.number, now, now, link=piece.link)
        self.contacts[piece.number] = known
        known.add_piece(piece, now, final=final)
        return known.update()

    def _make_room(self, config: ReceiverConfig) -> None:
        # Pieces without a record are worth least: nobody can be shown where they are.
        homeless = [n for n, c in self.contacts.items() if c.contact is None]
        if len(homeless) >= _PIECES_WAITING:
            del self.contacts[homeless[0]]
        while len(self.contacts) >= config.max_contacts:
            number = homeless[0] if homeless and homeless[0] in self.contacts else next(iter(self.contacts))
            del self.contacts[number]

    @property
    def is_lacking(self) -> bool:
        """Whether a block is not complete, or one between those heard was never heard."""
        if self.newest < 0:
            return False
        return any(need != 0 for need in self.needs)

    @property
    def needs(self) -> tuple[int, ...]:
        """What is lacking of each block, the newest first; see `Feedback.needs`."""
        numbers = [(self.newest - back) % BLOCKS for back in range(self.span)]
        return tuple(
            min(self.blocks[n].need, NEVER_RECEIVED - 1) if n in self.blocks else NEVER_RECEIVED for n in numbers
        )

    def report(self, now: float) -> Feedback | None:
        """Return the report of now, None while no block was heard."""
        if self.newest < 0:
            return None
        self.reported_at, self.reported_frames, self.needless = now, self.frames, 0
        return Feedback(self.newest, self.frames % 65536, self.needs)

    def report_is_due(self, now: float, config: ReceiverConfig) -> bool:
        """Whether a report would help and the last is long ago, in frames or seconds.

        It helps where something is lacking, and where the sender goes on with blocks that are complete: then it has not
        heard that they are. The first tells the sender that there is somebody who reports, and so does one after a long
        time even where nothing is lacking: a sender that hears none sends everything once, cut to what is sure.
        """
        if self.newest < 0:
            return False
        silent_s = now - self.reported_at
        helps = self.is_lacking or self.needless > 0 or self.reported_frames == 0
        news = self.frames - self.reported_frames
        return (helps and (silent_s >= config.feedback_interval_s or news >= config.feedback_interval_frames)) or (
            news > 0 and silent_s >= config.presence_s
        )
