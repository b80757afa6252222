"""Receiver of the `v1` wire format: images and messages from frames, and feedback for the senders."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Annotated, Final

from sonarpost.errors import FrameError
from sonarpost.link.auth.authentication import WINDOW as REPLAY_WINDOW
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.merging import Arrival, FrameMerger
from sonarpost.link.coding.block_decoder import BlockDecoder, DecodedObject, SymbolChunk
from sonarpost.link.coding.byte_ranges import PartialBytes
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import (
    BLOCKS,
    Segment,
    SegmentKind,
    Symbol,
    parse_frame,
    parse_symbol,
)
from sonarpost.link.frames.v1.payload_objects import (
    MAX_NUMBER,
    MAX_STREAM_BYTES,
    NEVER_RECEIVED,
    WINDOW,
    Feedback,
    MessageObject,
    Preview,
    RefineRequest,
    StreamPiece,
    contact_link,
)
from sonarpost.link.receiver import Event, FeedbackReceived, FrameRejected, ImageUpdate, MessageReceived
from sonarpost.link.state import SEPARATE, Bounds, Byte, Errors, PartReader, Parts, SavedCount, pack_part

_MAX_RECENT_MESSAGES: Final = 64
_MAX_WITHOUT_RECORD: Final = 128
"""Images without a contact record that a receiver keeps of each sender."""
_PRESENCE_S: Final = 600.0
"""While frames arrive, feedback is due this long after the last one even if nothing is missing."""


@dataclass(eq=False)
class AssembledImage:
    """A contact record and the stream of its image, as far as they have arrived.

    Attributes:
        source: Modem address of the vehicle.
        number: Number of the contact.
        first_frame_s: Time of the first frame.
        last_frame_s: Time of the last frame that contributed, or earlier after the clock was set back.
        contact: The record, None while only pieces of the stream have arrived.
        link: The `contact_link` of the pieces.
        stream: The stream.
        end: Where the stream ends according to the sender's plan, 0 while that is unknown.
        version: Of the last update, 0 before the first.
        reported: Bytes before the first gap, and completeness, at the last update.
        order: Rises with every frame that contributes to an image of this source.
        stopped: Whether the vehicle has confirmed that it sends nothing more of it; until more arrives.
    """

    source: int
    number: Annotated[int, Bounds(1, MAX_NUMBER)]
    first_frame_s: float
    last_frame_s: float
    contact: ContactSummary | None = None
    link: Byte = 0
    stream: PartialBytes = field(default_factory=PartialBytes)
    end: Annotated[int, Bounds(0, MAX_STREAM_BYTES)] = 0
    version: SavedCount = 0
    reported: tuple[int, bool] = (-1, False)
    order: SavedCount = 0
    stopped: bool = False

    def belongs(self, preview: Preview) -> bool:
        """Whether a preview is of this contact, and not of another one with the same number."""
        return self.contact == preview.contact if self.contact is not None else self.link == preview.link

    def add_preview(self, preview: Preview, now: float) -> None:
        """Add a contact record and the beginning of the stream."""
        self.contact = preview.contact
        self.link = contact_link(self.number, preview.contact.pack())
        self.stream.write(0, preview.prefix)
        if preview.ended:
            self.end = max(self.end, len(preview.prefix))
        self.last_frame_s = now

    def add_piece(self, piece: StreamPiece, now: float, *, final: bool) -> None:
        """Add a piece of the stream that has the link of this contact."""
        self.stopped = self.stopped and not piece.data
        self.stream.write(piece.start, piece.data)
        if final:
            self.end = max(self.end, piece.stop)
        self.last_frame_s = now

    @property
    def complete(self) -> bool:
        """Whether everything arrived that the sender has planned so far.

        A byte beyond `end` proves that the plan has grown; its new end is then unknown.
        """
        return self.end > 0 and self.stream.prefix_bytes == self.end

    def next_update(self) -> ImageUpdate | None:
        """Return the next update, None if there is nothing new to report."""
        state = (self.stream.prefix_bytes, self.complete)
        if self.contact is None or state == self.reported:
            return None
        self.reported = state
        self.version += 1
        stream = bytes(self.stream.data[: self.stream.prefix_bytes])
        return ImageUpdate(
            source=self.source,
            image_id=image_of_number(self.number),
            version=self.version,
            contact=self.contact,
            stream=stream,
            missing=(),
            complete=self.complete,
            received_bytes=len(stream),
            total_bytes=self.end if len(stream) <= self.end else 0,
            frames=0,
            conflicts=0,
            first_frame_s=self.first_frame_s,
            last_frame_s=self.last_frame_s,
        )


@dataclass(eq=False)
class PeerState:
    """State of one sender.

    Attributes:
        address: Its modem address.
        last_frame_s: Time of its last frame.
        frames: Undamaged frames of this format.
        newest_block: Number of its newest block, -1 before the first.
        block_span: Blocks from the oldest received to the newest, at most 16.
        blocks: By number, within the window.
        rival_blocks: Blocks that may be later ones with the number of a stored block.
        images: By contact number, the one whose last frame is oldest first.
        recent_messages: Number, checksum and time of each.
        feedback_s: Time of the last feedback.
        feedback_frames: `frames` at the last feedback.
        redundant_symbols: Symbols of complete blocks since the last feedback.
        order: Rises with every frame of any sender.
        moves: With frames of several vessels: for each of the last 32 blocks that became the newest, the counter of the
            frame and the number of the block, counted without wrapping.
    """

    address: int
    last_frame_s: float
    frames: SavedCount = 0
    newest_block: Annotated[int, Bounds(-1, BLOCKS - 1)] = -1
    block_span: Annotated[int, Bounds(0, WINDOW)] = 0
    blocks: dict[int, BlockDecoder] = field(default_factory=dict, metadata=SEPARATE)
    rival_blocks: dict[int, BlockDecoder] = field(default_factory=dict, metadata=SEPARATE)
    images: dict[int, AssembledImage] = field(default_factory=dict, metadata=SEPARATE)
    recent_messages: list[tuple[Byte, int, float]] = field(default_factory=list)
    feedback_s: float = 0.0
    feedback_frames: SavedCount = 0
    redundant_symbols: SavedCount = 0
    order: SavedCount = 0
    image_order: SavedCount = 0
    moves: list[tuple[SavedCount, SavedCount]] = field(default_factory=list)

    def delete_old(self, now: float, config: ReceiverConfig) -> None:
        """Delete what has had no frame for too long; after the clock was set back nothing stays longer."""
        for block in (*self.blocks.values(), *self.rival_blocks.values()):
            block.last_symbol_s = min(block.last_symbol_s, now)
        for image in self.images.values():
            image.last_frame_s = min(image.last_frame_s, now)
        for table in (self.blocks, self.rival_blocks):
            for number in [n for n, b in table.items() if b.last_symbol_s + config.block_memory_s < now]:
                del table[number]
        if not self.blocks:
            self.newest_block, self.block_span = -1, 0
            self.moves.clear()
        for number in [n for n, i in self.images.items() if i.last_frame_s + config.contact_memory_s < now]:
            del self.images[number]
        self.recent_messages = [m for m in self.recent_messages if m[2] + config.block_memory_s >= now]

    def is_outdated(self, symbol: Symbol, counter: int) -> bool:
        """Whether a symbol is of a block before the window: its number belongs to a later block by now.

        Args:
            symbol: The symbol.
            counter: Counter of its frame. A late frame was transmitted when the block of the last move with a lower
                counter was the newest; its own block is within 16 of that one.
        """
        if not self.moves or counter >= self.moves[-1][0]:
            return False
        first_counter, first_block = self.moves[0]
        if counter < first_counter and (len(self.moves) >= BLOCKS or counter < first_counter - REPLAY_WINDOW):
            return True
        newest_then = next((block for at, block in reversed(self.moves) if at <= counter), first_block)
        after = (symbol.block - newest_then + WINDOW) % BLOCKS - WINDOW
        return newest_then + after <= self.moves[-1][1] - WINDOW

    def add_symbol(self, symbol: Symbol, now: float, config: ReceiverConfig, counter: int | None = None) -> list[Event]:
        """Add a symbol.

        Args:
            symbol: The symbol.
            now: Time of the frame.
            config: Configuration of the receiver.
            counter: Counter of the frame if frames of several vessels are merged.

        Raises:
            FrameError: It does not fit the others of its block.
        """
        self._move_window(symbol.block, counter)
        block = self._block_for(symbol, now)
        self.redundant_symbols += block.complete
        events: list[Event] = []
        for found in block.add(symbol, now):
            events += self.add_object(found, now, config)
        return events

    def _move_window(self, number: int, counter: int | None) -> None:
        ahead = (number - self.newest_block) % BLOCKS if self.newest_block >= 0 else 1
        if 0 < ahead < WINDOW or self.newest_block < 0:
            self.newest_block = number
            self.block_span = min(WINDOW, self.block_span + ahead)
            for table in (self.blocks, self.rival_blocks):
                for old in [n for n in table if (number - n) % BLOCKS >= WINDOW]:
                    del table[old]
        else:
            self.block_span = min(WINDOW, max(self.block_span, (self.newest_block - number) % BLOCKS + 1))
            ahead = 0
        if counter is not None and (ahead or not self.moves):
            last_counter, last_block = self.moves[-1] if self.moves else (counter, self.newest_block - ahead)
            move = (max(counter, last_counter), last_block + ahead)
            self.moves = [*self.moves, move][-BLOCKS:]

    def _block_for(self, symbol: Symbol, now: float) -> BlockDecoder:
        """Return the block of a symbol.

        A symbol that does not fit the stored block of its number may be of a later block, or damaged. Two such symbols
        that fit each other replace the stored block.
        """
        block = self.blocks.get(symbol.block)
        if block is None:
            block = self.blocks[symbol.block] = BlockDecoder.of(symbol, now)
        if block.matches(symbol):
            return block
        rival = self.rival_blocks.get(symbol.block)
        if rival is None or not rival.matches(symbol):
            rival = self.rival_blocks[symbol.block] = BlockDecoder.of(symbol, now)
            return rival
        if symbol.index not in rival.symbols:
            self.blocks[symbol.block] = self.rival_blocks.pop(symbol.block)
        return rival

    def add_object(self, found: DecodedObject, now: float, config: ReceiverConfig) -> list[Event]:
        """Add an object of a block or a segment."""
        if isinstance(found, MessageObject):
            return self.add_message(found, now)
        if isinstance(found, Preview):
            image = self.images.get(found.number)
            if image is None or not image.belongs(found):
                image = self._new_image(found.number, now, config)
            self._touch(image)
            image.add_preview(found, now)
            updates = [image.next_update()]
        else:
            updates = [self._add_piece(piece, now, config, final=found.final) for piece in found.pieces]
        return [update for update in updates if update]

    def _add_piece(self, piece: StreamPiece, now: float, config: ReceiverConfig, *, final: bool) -> ImageUpdate | None:
        image = self.images.get(piece.number)
        if image is None or image.link != piece.link:
            image = self._new_image(piece.number, now, config)
            image.link = piece.link
        self._touch(image)
        image.add_piece(piece, now, final=final)
        return image.next_update()

    def _touch(self, image: AssembledImage) -> None:
        """Make an image the one whose last frame is newest."""
        self.images[image.number] = self.images.pop(image.number)
        self.image_order += 1
        image.order = self.image_order

    def _new_image(self, number: int, now: float, config: ReceiverConfig) -> AssembledImage:
        self.images.pop(number, None)
        without_record = [n for n, i in self.images.items() if i.contact is None]
        if len(without_record) >= _MAX_WITHOUT_RECORD:
            del self.images[without_record[0]]
        while len(self.images) >= config.max_contacts:
            # Complete ones first: the others hold bytes of complete blocks, which the sender does not repeat.
            ended = (n for n, i in self.images.items() if i.contact is not None and (i.complete or i.stopped))
            complete = next(ended, None)
            del self.images[next(iter(self.images)) if complete is None else complete]
        image = self.images[number] = AssembledImage(self.address, number, now, now)
        return image

    def add_message(self, message: MessageObject, now: float) -> list[Event]:
        """Add a message; a repetition gives no event."""
        digest = zlib.crc32(message.data)
        repeated = any((number, check) == (message.number, digest) for number, check, _ in self.recent_messages)
        others = [m for m in self.recent_messages if m[:2] != (message.number, digest)]
        self.recent_messages = [*others, (message.number, digest, now)][-_MAX_RECENT_MESSAGES:]
        return [] if repeated else [MessageReceived(self.address, message.number, message.data, now)]

    @property
    def is_incomplete(self) -> bool:
        """Whether a block is incomplete, or no symbol of one within the span has arrived."""
        return self.newest_block >= 0 and any(self.missing_symbols)

    @property
    def missing_symbols(self) -> tuple[int, ...]:
        """Missing symbols of each block, the newest first; see `Feedback.missing`."""
        numbers = [(self.newest_block - back) % BLOCKS for back in range(self.block_span)]
        return tuple(
            min(self.blocks[n].missing_symbols, NEVER_RECEIVED - 1) if n in self.blocks else NEVER_RECEIVED
            for n in numbers
        )

    def feedback(self, now: float) -> Feedback | None:
        """Return the feedback of this moment, None before the first block."""
        if self.newest_block < 0:
            return None
        self.feedback_s, self.feedback_frames, self.redundant_symbols = now, self.frames, 0
        return Feedback(self.newest_block, self.frames % 65536, self.missing_symbols)

    def feedback_is_due(self, now: float, config: ReceiverConfig) -> bool:
        """Whether feedback is useful now and the last one is long ago, in frames or seconds.

        Feedback is useful while something is missing, and when the sender continues with complete blocks: the last
        feedback was lost then. The first feedback announces this receiver. So does one after a long time even if
        nothing is missing: a sender without feedback sends each block once, with less detail.
        """
        if self.newest_block < 0:
            return False
        since_feedback_s = now - self.feedback_s
        frames = self.frames - self.feedback_frames
        return (
            self.feedback_is_useful
            and (since_feedback_s >= config.feedback_interval_s or frames >= config.feedback_interval_frames)
        ) or (frames > 0 and since_feedback_s >= _PRESENCE_S)

    @property
    def feedback_is_useful(self) -> bool:
        """Whether feedback is useful, see `feedback_is_due`; the announcement after `_PRESENCE_S` does not count."""
        return self.newest_block >= 0 and (
            self.is_incomplete or self.redundant_symbols > 0 or self.feedback_frames == 0
        )

    def parts(self) -> dict[str, bytes]:
        """Return the state to save: the sender, its images, its blocks, and their symbols."""
        parts = {f"peer/{self.address}": pack_part(self)}
        for number, image in self.images.items():
            parts[f"image/{self.address}/{number}"] = pack_part(image)
        for table, blocks in (("block", self.blocks), ("rival", self.rival_blocks)):
            for number, block in blocks.items():
                parts[f"{table}/{self.address}/{number}"] = pack_part(block)
                for place, chunk in enumerate(block.symbol_chunks()):
                    parts[f"{table}-symbols/{self.address}/{number}/{place:02d}"] = pack_part(chunk)
        return parts


@dataclass(slots=True)
class V1ReceiverCounts:
    """Counters since the first start; they continue over restarts.

    Attributes:
        frames: Frames passed to `accept`.
        rejected: Of these, damaged or not of this format, as a whole or in part.
        updates: `ImageUpdate` events.
        complete: Of these, complete.
        messages: `MessageReceived` events.
        feedback: `FeedbackReceived` events.
        evicted_sources: Senders deleted because `max_sources` was reached.
        duplicates: Frames that another vessel had received, too.
        late: Frames of other vessels that arrived too late to be used.
    """

    frames: SavedCount = 0
    rejected: SavedCount = 0
    updates: SavedCount = 0
    complete: SavedCount = 0
    messages: SavedCount = 0
    feedback: SavedCount = 0
    evicted_sources: SavedCount = 0
    duplicates: SavedCount = 0
    late: SavedCount = 0


class V1Receiver:
    """A `FrameReceiver` of the `v1` format.

    Memory: at most `max_sources` senders, each with at most 32 blocks of 255 symbols and `max_contacts` images of
    64 KiB.

    Attributes:
        counts: The counters.

    Args:
        config: Bounds and times.
        protection: Verifies frames.
        merger: Verifies and merges the frames that other vessels received; None without other vessels.
    """

    def __init__(
        self,
        config: ReceiverConfig | None = None,
        *,
        protection: FrameAuthenticator | None = None,
        merger: FrameMerger | None = None,
    ) -> None:
        self.config = config or ReceiverConfig()
        self._protection = protection
        self._merger = merger
        self._sources: dict[int, PeerState] = {}  # the one whose last frame is oldest first
        self.counts = V1ReceiverCounts()

    @property
    def sources(self) -> tuple[int, ...]:
        """Modem addresses of the known senders, the one whose last frame is oldest first."""
        return tuple(self._sources)

    def accept(self, source: int, frame: bytes, now: float) -> list[Event]:
        """Process a frame; see `FrameReceiver.accept`."""
        return self._accept(source, frame, float(now), self._protection)

    def accept_from(self, vessel: str, source: int, frame: bytes, now: float) -> list[Event]:
        """Process a frame that another vessel received, as `accept` does; one that arrived before gives no event.

        Args:
            vessel: Name of the vessel, one of those of `merger`.
            source: Modem address of the vehicle.
            frame: The frame as the modem of the vessel delivered it.
            now: Seconds, when the frame arrived here.
        """
        protection = None if self._merger is None else self._merger.verifier(vessel)
        if protection is None:
            self.counts.frames += 1
            self.counts.rejected += 1
            reason = FrameError("acoustic frame", "vessel", vessel, "a configured vessel")
            return [FrameRejected(source, reason, float(now))]
        return self._accept(source, frame, float(now), protection)

    def _accept(self, source: int, frame: bytes, now: float, protection: FrameAuthenticator | None) -> list[Event]:
        self.counts.frames += 1
        where = f"acoustic frame from modem {source}"
        try:
            content = parse_frame(frame, source, protection, where)
        except FrameError as reason:
            self.counts.rejected += 1
            return [FrameRejected(source, reason, now)]
        counter = None
        if self._merger is not None and protection is not None:
            counter = protection.last_counter
            arrival = self._merger.arrive(source, counter)
            self.counts.duplicates += arrival is Arrival.DUPLICATE
            self.counts.late += arrival is Arrival.LATE
            if arrival is not Arrival.NEW:
                return []
        peer = self._peer(source, now)
        if self._merger is not None and counter is not None and self._merger.is_newest(source, counter):
            # Higher ones are of a key that was replaced.
            peer.moves = [move for move in peer.moves if move[0] <= counter]
        events: list[Event] = []
        for item in [content] if isinstance(content, Symbol) else content:
            try:
                events += self._process(peer, item, now, where, counter)
            except FrameError as reason:
                self.counts.rejected += 1
                events.append(FrameRejected(source, reason, now))
        for event in events:
            self.counts.updates += isinstance(event, ImageUpdate)
            self.counts.complete += isinstance(event, ImageUpdate) and event.complete
            self.counts.messages += isinstance(event, MessageReceived)
            self.counts.feedback += isinstance(event, FeedbackReceived)
        return events

    def poll(self, now: float) -> list[Event]:
        """Return no event: this format reports everything with the frame that brings it."""
        return []

    def next_deadline(self) -> float | None:
        """Return None, see `poll`."""
        return None

    def _process(
        self, peer: PeerState, item: Symbol | Segment, now: float, where: str, counter: int | None
    ) -> list[Event]:
        if isinstance(item, Symbol):
            return self._add_symbol(peer, item, now, counter)
        match item.kind:
            case SegmentKind.SYMBOL:
                return self._add_symbol(peer, parse_symbol(item.data, where), now, counter)
            case SegmentKind.MESSAGE if len(item.data) > 1:
                return peer.add_message(MessageObject(item.data[0], item.data[1:]), now)
            case SegmentKind.CONTACT | SegmentKind.PREVIEW:
                return peer.add_object(Preview.unpack(item.data, where), now, self.config)
            case SegmentKind.FEEDBACK:
                return [FeedbackReceived(peer.address, Feedback.unpack(item.data, where), now)]
            case SegmentKind.REQUEST:
                return [FeedbackReceived(peer.address, RefineRequest.unpack(item.data, where), now)]
            case _:
                raise FrameError(where, "segment kind", item.kind, "1..6, a message not empty")

    def _add_symbol(self, peer: PeerState, symbol: Symbol, now: float, counter: int | None) -> list[Event]:
        if counter is not None and peer.is_outdated(symbol, counter):
            self.counts.late += 1
            return []
        return peer.add_symbol(symbol, now, self.config, counter)

    def _peer(self, source: int, now: float) -> PeerState:
        peer = self._sources.pop(source, None)
        if peer is None:
            while len(self._sources) >= self.config.max_sources:
                del self._sources[next(iter(self._sources))]
                self.counts.evicted_sources += 1
            peer = PeerState(source, now, feedback_s=now)
        self._sources[source] = peer
        peer.last_frame_s = now
        peer.frames += 1
        peer.order = self.counts.frames
        peer.feedback_s = min(peer.feedback_s, now)
        peer.delete_old(now, self.config)
        return peer

    def feedback(self, source: int, now: float) -> Feedback | None:
        """Return the feedback for a sender, None before its first block."""
        peer = self._sources.get(source)
        return None if peer is None else peer.feedback(float(now))

    def feedback_is_due(self, source: int, now: float) -> bool:
        """Whether feedback to a sender is useful now."""
        peer = self._sources.get(source)
        return peer is not None and peer.feedback_is_due(now, self.config)

    def feedback_is_useful(self, source: int) -> bool:
        """Whether feedback to a sender is useful, now or after the interval of feedback."""
        peer = self._sources.get(source)
        return peer is not None and peer.feedback_is_useful

    @property
    def incomplete_images(self) -> int:
        """Number of known images of which not everything has arrived that their senders have planned so far."""
        images = [image for peer in self._sources.values() for image in peer.images.values()]
        return sum(not (image.complete or image.stopped) for image in images)

    def stop_image(self, source: int, number: int) -> None:
        """Treat an image as ended at what has arrived, because its sender has confirmed to send no more of it."""
        peer = self._sources.get(source)
        if peer is not None and number in peer.images:
            peer.images[number].stopped = True

    def is_incomplete(self, source: int) -> bool:
        """Whether symbols of a sender's blocks are missing."""
        peer = self._sources.get(source)
        return peer is not None and peer.is_incomplete

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`: counters, senders, their images and blocks."""
        parts = {"counts": pack_part(self.counts)}
        for peer in self._sources.values():
            parts |= peer.parts()
        return parts

    def restore(self, parts: Parts) -> Errors:
        """Replace the state by saved parts; the configuration stays. Return why parts were skipped."""
        reader = PartReader(parts, "v1 receiver state")
        self.counts = reader.read("counts", V1ReceiverCounts) or V1ReceiverCounts()
        peers = {peer.address: peer for peer in reader.read_group("peer", PeerState)}
        for image in sorted(reader.read_group("image", AssembledImage), key=lambda image: image.order):
            peers.setdefault(image.source, PeerState(image.source, image.last_frame_s)).images[image.number] = image
        for address, peer in peers.items():
            peer.blocks = _restored_blocks(reader, "block", address)
            peer.rival_blocks = _restored_blocks(reader, "rival", address)
        self._sources = {p.address: p for p in sorted(peers.values(), key=lambda p: p.order)}
        return reader.errors


def _restored_blocks(reader: PartReader, table: str, address: int) -> dict[int, BlockDecoder]:
    blocks: dict[int, BlockDecoder] = {}
    for block in reader.read_group(f"{table}/{address}", BlockDecoder):
        blocks[block.number] = block
        reader.read_group(f"{table}-symbols/{address}/{block.number}", SymbolChunk, apply=block.restore_chunk)
    return blocks
