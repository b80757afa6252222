"""Which piece of which record goes next to one consumer: pure, with the time as an argument.

The most urgent record's pieces go first, then the oldest's. Urgent records (commands, decisions, advice) wait neither
for the bandwidth limit nor behind a full window, only for the piece that is on its way. Pieces are as small as the
limit makes necessary, so that this is short.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

from sonarpost.delivery.batch_protocol import MAX_RECORDS, RECORD_OVERHEAD_BYTES
from sonarpost.delivery.items import OutboxItem
from sonarpost.delivery.protocol import CHUNK_BYTES
from sonarpost.delivery.token_bucket import TokenBucket

WINDOW = 128
"""Most queries in flight: twice what a consumer commits with one write, so that it never waits for the next."""
WINDOW_BYTES = 8 * CHUNK_BYTES
"""Most bytes in flight at first: on a link of 125 kB/s these take two seconds of a query's five."""
MAX_WINDOW_BYTES = 64 * CHUNK_BYTES
"""Most bytes in flight on a fast link, so that the consumer has the next records while it writes the last."""
GROW_BELOW_S, SHRINK_ABOVE_S = 0.25, 1.0
"""Answers that come sooner let the bytes in flight grow, later ones halve them."""
LOOKS_AT = 512
"""Most records looked at with a consumer that takes several with one query."""
PROBE_WINDOW = 8
"""Most records looked at while nobody has answered yet."""
KEPT_FOR_URGENT = 4
URGENT_PRIORITY = 2
PIECE_S = 0.5
"""With a bandwidth limit, a piece takes this long."""
MIN_PIECE_BYTES = 256
OVERHEAD_BYTES = 320
"""A query's attachment, key, headers of Zenoh, TCP and IP, and its reply, charged with every piece."""


@dataclass(slots=True, eq=False)
class RecordTransfer:
    """One record on its way: how much was asked, how much the consumer has, how often it was begun anew."""

    item: OutboxItem
    asked: int = 0
    has: int = 0
    begun: bool = False
    attempt: int = 0

    @property
    def order(self) -> tuple[int, int, int]:
        """What is lower goes first."""
        return (self.item.priority, self.item.place, self.item.seq)

    @property
    def urgent(self) -> bool:
        """Whether it waits for nothing but the piece that is on its way."""
        return self.item.priority <= URGENT_PRIORITY

    @property
    def fresh(self) -> bool:
        """Whether nothing of it has been asked yet."""
        return self.asked == 0 and self.has == 0

    @property
    def wants_sending(self) -> bool:
        """Whether a piece of it is to be asked."""
        return self.asked < len(self.item.payload) or self.asked == 0


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Bytes `start` to `end` of a record, to be asked with one query."""

    transfer: RecordTransfer
    start: int
    end: int
    attempt: int

    @property
    def size(self) -> int:
        """Bytes of the record in it."""
        return self.end - self.start


def piece_bytes_for(bytes_per_s: float | None) -> int:
    """Return how long pieces are at most: half a second of the limit, 256 B to 32 kB."""
    if bytes_per_s is None:
        return CHUNK_BYTES
    return int(min(max(bytes_per_s * PIECE_S, MIN_PIECE_BYTES), CHUNK_BYTES))


class DeliveryScheduler:
    """The transfers to one consumer.

    Args:
        bytes_per_s: Bandwidth limit, None for none.
        now_s: Any clock that does not go back, the one later calls use.
    """

    def __init__(self, bytes_per_s: float | None, now_s: float) -> None:
        self.piece_bytes = piece_bytes_for(bytes_per_s)
        self.active: dict[int, RecordTransfer] = {}
        self.probing = True
        self.takes = 0
        """How many records the consumer takes with one query."""
        self._order: deque[RecordTransfer] = deque()
        self._order_stale = False
        self._in_flight = 0
        self._bytes_in_flight = 0
        self._bucket: TokenBucket | None = None
        self._asked: dict[Chunk, tuple[float, int]] = {}
        self._window_bytes = WINDOW_BYTES
        if bytes_per_s is not None:
            self._bucket = TokenBucket(bytes_per_s, self.piece_bytes + OVERHEAD_BYTES, now_s)
            # What lies in the queues of a thin link must be through before a query's time is up.
            self._window_bytes = int(min(WINDOW_BYTES, max(2 * bytes_per_s, 2 * self.piece_bytes)))
        self._first_window_bytes = self._window_bytes

    @property
    def looks_at(self) -> int:
        """Of how many records the schedule wants to know."""
        if self.probing:
            return PROBE_WINDOW
        return LOOKS_AT if self.takes > 1 else WINDOW

    def put(self, items: Iterable[OutboxItem]) -> None:
        """Take what is owed most urgently; what has not begun and is not among them makes room."""
        wanted = {item.seq: item for item in items}
        for seq in [seq for seq, t in self.active.items() if not t.begun and seq not in wanted]:
            del self.active[seq]
        for seq, item in wanted.items():
            if seq not in self.active:
                self.active[seq] = RecordTransfer(item)
        self._order_stale = True

    def _first_waiting(self) -> RecordTransfer | None:
        if self._order_stale:
            waiting = (transfer for transfer in self.active.values() if transfer.wants_sending)
            self._order = deque(sorted(waiting, key=lambda transfer: transfer.order))
            self._order_stale = False
        while self._order:
            transfer = self._order[0]
            if transfer.wants_sending and self.active.get(transfer.item.seq) is transfer:
                return transfer
            self._order.popleft()
        return None

    def next_piece(self, now_s: float) -> tuple[Chunk | None, float | None]:
        """Return the piece to ask now, or None and for how many seconds to wait (None: until something happens)."""
        transfer = self._first_waiting()
        if transfer is None:
            return None, None
        start = transfer.asked
        end = min(start + self.piece_bytes, len(transfer.item.payload))
        piece = Chunk(transfer, start, end, transfer.attempt)
        if not self._has_room(piece):
            return None, None
        if self._bucket is not None and not transfer.urgent:
            wait_s = self._bucket.wait_s(piece.size + OVERHEAD_BYTES, now_s)
            if wait_s > 0:
                return None, wait_s
        return piece, 0.0

    def _has_room(self, piece: Chunk) -> bool:
        if self.probing:
            # One query at a time until the consumer has answered: of a whole window, one that comes up in the middle
            # of it would take the last and not the first.
            return self._in_flight == 0
        if piece.transfer.urgent:
            return self._in_flight < WINDOW
        fits = self._in_flight == 0 or self._bytes_in_flight + piece.size <= self._window_bytes
        return fits and self._in_flight < WINDOW - KEPT_FOR_URGENT

    def together_with(self, piece: Chunk) -> list[Chunk]:
        """Return what goes with the same query as the piece that is next: whole small records behind it, in order.

        All are of its key and priority, have not begun, and fit with it into one piece.
        """
        first = piece.transfer
        pieces = [piece]
        if min(self.takes, MAX_RECORDS) < 2 or self.probing or piece.size < len(first.item.payload) or not first.fresh:
            return pieces
        room = self.piece_bytes - piece.size
        for transfer in islice(self._order, 1, None):
            item = transfer.item
            if not transfer.wants_sending or self.active.get(item.seq) is not transfer:
                continue
            room -= len(item.payload) + (0 if self._bucket is None else RECORD_OVERHEAD_BYTES)
            alike = item.key == first.item.key and item.priority == first.item.priority and transfer.fresh
            if room < 0 or not alike:
                break
            pieces.append(Chunk(transfer, 0, len(item.payload), transfer.attempt))
            if len(pieces) == min(self.takes, MAX_RECORDS):
                break
        return pieces

    def asked(self, piece: Chunk, now_s: float, *more: Chunk) -> None:
        """Note that a piece was sent, or that several records were, with one query."""
        size = piece.size
        for sent in (piece, *more):
            sent.transfer.begun = True
            sent.transfer.asked = max(sent.end, 1)
        size += sum(sent.size for sent in more)
        self._in_flight += 1
        self._bytes_in_flight += size
        self._asked[piece] = (now_s, size)
        if self._bucket is not None:
            self._bucket.take(size + OVERHEAD_BYTES + len(more) * RECORD_OVERHEAD_BYTES, now_s)

    def answered(self, piece: Chunk, now_s: float) -> None:
        """Note that a query has ended, however it ended; `piece` is the first that was in it."""
        asked_s, size = self._asked.pop(piece)
        self._in_flight -= 1
        self._bytes_in_flight -= size
        took_s = now_s - asked_s
        if self._bucket is not None:
            return
        if took_s < GROW_BELOW_S:
            self._window_bytes = min(MAX_WINDOW_BYTES, self._window_bytes + size)
        elif took_s > SHRINK_ABOVE_S:
            self._window_bytes = max(self.piece_bytes, self._window_bytes // 2)

    def go_on_from(self, piece: Chunk, next_offset: int) -> None:
        """Note what the consumer has of a record; where it did not take the piece, send on from there."""
        transfer = piece.transfer
        transfer.has = next_offset
        # Pieces that were on their way behind one that was not taken are answered alike: one of the answers is enough.
        if next_offset != piece.end and piece.attempt == transfer.attempt:
            transfer.attempt += 1
            transfer.asked = next_offset
            self._order_stale = True

    def settled(self, transfer: RecordTransfer) -> None:
        """Forget a record that is done with."""
        self.active.pop(transfer.item.seq, None)

    def start_again(self) -> None:
        """Nothing is in flight any more: ask again for everything that is not settled, one query at first."""
        self._in_flight = 0
        self._bytes_in_flight = 0
        self._asked.clear()
        self._order_stale = True
        self.takes = 0
        self._window_bytes = self._first_window_bytes
        self.probing = True
        for transfer in self.active.values():
            transfer.attempt += 1
            transfer.asked = transfer.has
