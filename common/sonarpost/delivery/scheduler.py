"""Order and timing of the chunks that are sent to one consumer. Pure: the time is an argument.

The most urgent record is sent first, then the oldest. Congestion control limits the bytes in flight. Urgent records
(commands, decisions, comments) have a window of their own and do not wait for the bandwidth limit, only for what is in
flight. A slow link and a bandwidth limit make chunks smaller, so that this wait is short.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

from sonarpost.delivery.congestion import START_BYTES, CongestionControl
from sonarpost.delivery.protocol import BATCH_RECORD_OVERHEAD_BYTES, CHUNK_BYTES, MAX_BATCH_RECORDS
from sonarpost.delivery.records import OutboxItem

WINDOW = 128
"""Maximum number of queries in flight: twice what a consumer commits at once, so that it never waits for the next."""
LOOKAHEAD = 2048
"""Number of records considered if the consumer accepts several in one query."""
PROBE_WINDOW = 8
"""Number of records considered until the consumer has replied."""
URGENT_RESERVE = 4
"""Queries of the window that are reserved for urgent records."""
URGENT_PRIORITY = 2
CHUNK_S = 0.5
"""Transmission time of a chunk at the bandwidth limit."""
MIN_CHUNK_BYTES = 256
QUERY_OVERHEAD_BYTES = 320
"""Attachment, key, reply, and headers of Zenoh, TCP and IP; charged to the bandwidth limit for each query."""
MIN_WAIT_S = 1e-6
"""Shorter waits are rounding errors and count as zero."""


@dataclass(slots=True, eq=False)
class RecordTransfer:
    """Transfer of one record.

    Attributes:
        item: The record.
        sent: Offset up to which chunks were sent; 1 for an empty record.
        received: Offset up to which the consumer has confirmed the record.
        in_flight: Whether the record was sent at least once, so that no newer edition may replace it.
        attempt: Number of restarts of the transfer.
    """

    item: OutboxItem
    sent: int = 0
    received: int = 0
    in_flight: bool = False
    attempt: int = 0

    @property
    def order(self) -> tuple[int, int, int]:
        """Sort key; the lowest is sent first."""
        return (self.item.priority, self.item.position, self.item.seq)

    @property
    def urgent(self) -> bool:
        """Whether it is exempt from the bandwidth limit and from the window of other records."""
        return self.item.priority <= URGENT_PRIORITY

    @property
    def untouched(self) -> bool:
        """Whether no part of it was sent yet."""
        return self.sent == 0 and self.received == 0

    @property
    def has_unsent(self) -> bool:
        """Whether a chunk of it remains to be sent."""
        return self.sent < len(self.item.payload) or self.sent == 0


@dataclass(slots=True, eq=False)
class Chunk:
    """Bytes `start` to `end` of a record, sent with one query."""

    transfer: RecordTransfer
    start: int
    end: int
    attempt: int

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.end - self.start


def chunk_bytes_for(bytes_per_s: float | None) -> int:
    """Return the maximum chunk size: half a second at the bandwidth limit, 256 B to 32 KiB."""
    if bytes_per_s is None:
        return CHUNK_BYTES
    return int(min(max(bytes_per_s * CHUNK_S, MIN_CHUNK_BYTES), CHUNK_BYTES))


class TokenBucket:
    """Bandwidth limit. Pure: the time is an argument, from any monotonic clock.

    The bucket fills at `rate_bytes_per_s` up to `burst_bytes`. Urgent data is sent at once and charged as well. The
    level then becomes negative, and other data waits until it has recovered, which keeps the mean rate.

    Args:
        rate_bytes_per_s: Mean rate, above 0.
        burst_bytes: Maximum amount after a pause, above 0.
        now_s: Start time; the bucket starts full.
    """

    def __init__(self, rate_bytes_per_s: float, burst_bytes: float, now_s: float) -> None:
        self._rate_bytes_per_s = rate_bytes_per_s
        self._burst_bytes = burst_bytes
        self._level_bytes = burst_bytes
        self._at_s = now_s

    def wait_s(self, size_bytes: int, now_s: float) -> float:
        """Return for how many seconds `size_bytes` have to wait.

        More than the burst may be sent when the bucket is full; otherwise it could never be sent.
        """
        self._fill(now_s)
        required = min(float(size_bytes), self._burst_bytes)
        wait_s = (required - self._level_bytes) / self._rate_bytes_per_s
        return wait_s if wait_s > MIN_WAIT_S else 0.0

    def take(self, size_bytes: int, now_s: float) -> None:
        """Charge `size_bytes`, also beyond the level."""
        self._fill(now_s)
        self._level_bytes -= size_bytes

    def _fill(self, now_s: float) -> None:
        gained = max(0.0, now_s - self._at_s) * self._rate_bytes_per_s
        self._level_bytes = min(self._burst_bytes, self._level_bytes + gained)
        self._at_s = max(self._at_s, now_s)


class DeliveryScheduler:
    """Transfers to one consumer.

    Args:
        bytes_per_s: Bandwidth limit, None for none.
        now_s: Start time, from the monotonic clock that all calls use.
        clock_offset_s: UTC minus this clock.
        start_bytes: Window before the first reply.

    Attributes:
        congestion: Window and time-out of the queries.
        active: Transfers by sequence number.
        probing: Whether the consumer has not replied yet; only one query is then in flight.
        max_batch: Number of records that the consumer accepts in one query.
    """

    def __init__(
        self, bytes_per_s: float | None, now_s: float, clock_offset_s: float = 0.0, start_bytes: int = START_BYTES
    ) -> None:
        self.congestion = CongestionControl(clock_offset_s, start_bytes)
        self.active: dict[int, RecordTransfer] = {}
        self.probing = True
        self.max_batch = 0
        self._order: deque[RecordTransfer] = deque()
        self._order_stale = False
        self._queries: dict[Chunk, tuple[float, int]] = {}
        self._bytes_in_flight = self._urgent_bytes_in_flight = 0
        self._max_chunk_bytes = chunk_bytes_for(bytes_per_s)
        self._bucket: TokenBucket | None = None
        if bytes_per_s is not None:
            self._bucket = TokenBucket(bytes_per_s, self._max_chunk_bytes + QUERY_OVERHEAD_BYTES, now_s)

    @property
    def chunk_bytes(self) -> int:
        """Maximum chunk size, and maximum payload of a query."""
        return min(self._max_chunk_bytes, self.congestion.query_bytes)

    @property
    def lookahead(self) -> int:
        """Number of records that the scheduler considers."""
        if self.probing:
            return PROBE_WINDOW
        return LOOKAHEAD if self.max_batch > 1 else WINDOW

    def update(self, items: Iterable[OutboxItem]) -> None:
        """Set the most urgent queued records; transfers that are not in flight and not among them are removed."""
        items_by_seq = {item.seq: item for item in items}
        for seq in [seq for seq, t in self.active.items() if not t.in_flight and seq not in items_by_seq]:
            del self.active[seq]
        for seq, item in items_by_seq.items():
            if seq not in self.active:
                self.active[seq] = RecordTransfer(item)
        self._order_stale = True

    def _first_waiting(self) -> RecordTransfer | None:
        if self._order_stale:
            waiting = (transfer for transfer in self.active.values() if transfer.has_unsent)
            self._order = deque(sorted(waiting, key=lambda transfer: transfer.order))
            self._order_stale = False
        while self._order:
            transfer = self._order[0]
            if self._is_waiting(transfer):
                return transfer
            self._order.popleft()
        return None

    def _is_waiting(self, transfer: RecordTransfer) -> bool:
        return transfer.has_unsent and self.active.get(transfer.item.seq) is transfer

    def next_chunk(self, now_s: float) -> tuple[Chunk | None, float | None]:
        """Return the chunk to send now, or (None, seconds to wait); None seconds: until a reply or a new record."""
        transfer = self._first_waiting()
        if transfer is None:
            return None, None
        if not self._queries:
            self.congestion.begins(now_s)
        end = min(transfer.sent + self.chunk_bytes, len(transfer.item.payload))
        chunk = Chunk(transfer, transfer.sent, end, transfer.attempt)
        if not self._fits_window(chunk):
            return None, None
        if self._bucket is not None and not transfer.urgent:
            wait_s = self._bucket.wait_s(chunk.size + QUERY_OVERHEAD_BYTES, now_s)
            if wait_s > 0:
                return None, wait_s
        return chunk, 0.0

    def _fits_window(self, chunk: Chunk) -> bool:
        in_flight = len(self._queries)
        if self.probing:
            # One query at a time: a consumer that starts during a full window would receive the last records first.
            return in_flight == 0
        sent_bytes = self._urgent_bytes_in_flight if chunk.transfer.urgent else self._bytes_in_flight
        # Half of a query must fit: smaller ones would consist of headers.
        fits = sent_bytes == 0 or sent_bytes + self.chunk_bytes / 2 <= self.congestion.window_bytes
        return fits and in_flight < (WINDOW if chunk.transfer.urgent else WINDOW - URGENT_RESERVE)

    def batch_with(self, chunk: Chunk) -> list[Chunk]:
        """Return the chunks of the next query: `chunk`, and complete small records that follow it in order.

        All have its key and priority, are untouched, and fit with it into one chunk size.
        """
        first = chunk.transfer
        chunks = [chunk]
        max_records = min(self.max_batch, MAX_BATCH_RECORDS)
        if max_records < 2 or self.probing or chunk.size < len(first.item.payload) or not first.untouched:
            return chunks
        free_bytes = self.chunk_bytes - chunk.size
        for transfer in islice(self._order, 1, None):
            if not self._is_waiting(transfer):
                continue
            item = transfer.item
            free_bytes -= len(item.payload) + (0 if self._bucket is None else BATCH_RECORD_OVERHEAD_BYTES)
            alike = transfer.untouched and _batch_key(item) == _batch_key(first.item)
            if free_bytes < 0 or not alike:
                break
            chunks.append(Chunk(transfer, 0, len(item.payload), transfer.attempt))
            if len(chunks) == max_records:
                break
        return chunks

    def query_sent(self, chunk: Chunk, now_s: float, *more: Chunk) -> None:
        """Record that a query with these chunks was sent."""
        size = chunk.size
        for sent in (chunk, *more):
            sent.transfer.in_flight = True
            sent.transfer.sent = max(sent.end, 1)
        size += sum(sent.size for sent in more)
        self._count(chunk, size)
        self._queries[chunk] = (now_s, size)
        if self._bucket is not None:
            self._bucket.take(size + QUERY_OVERHEAD_BYTES + len(more) * BATCH_RECORD_OVERHEAD_BYTES, now_s)

    def query_ended(self, chunk: Chunk, now_s: float, *, replied: bool) -> None:
        """Record that a query has ended, with a reply or without; `chunk` is the first one of the query."""
        sent_s, size = self._queries.pop(chunk)
        if replied:
            self.congestion.replied(size, sent_s, now_s, self._bytes_in_flight)
        self._count(chunk, -size)

    def _count(self, chunk: Chunk, size_bytes: int) -> None:
        self._bytes_in_flight += size_bytes
        self._urgent_bytes_in_flight += size_bytes if chunk.transfer.urgent else 0

    def confirm(self, chunk: Chunk, next_offset: int) -> None:
        """Record how much of a record the consumer has; continue there if it did not accept the chunk."""
        transfer = chunk.transfer
        transfer.received = next_offset
        # Chunks in flight behind a chunk that was not accepted get the same reply: only the first one rewinds.
        if next_offset != chunk.end and chunk.attempt == transfer.attempt:
            transfer.attempt += 1
            transfer.sent = next_offset
            self._order_stale = True

    def remove(self, transfer: RecordTransfer) -> None:
        """Remove a transfer that is complete, refused or superseded."""
        self.active.pop(transfer.item.seq, None)

    def restart(self, *, timed_out: bool) -> None:
        """Send again what the consumer has not confirmed, one query at first. No query is in flight.

        Args:
            timed_out: Whether a query had no reply before its time-out; otherwise its connection was lost.
        """
        self._queries.clear()
        self._bytes_in_flight = self._urgent_bytes_in_flight = 0
        self._order_stale = True
        self.max_batch = 0
        self.probing = True
        if timed_out:
            self.congestion.timed_out()
        else:
            self.congestion.interrupted()
        for transfer in self.active.values():
            transfer.attempt += 1
            transfer.sent = transfer.received


def _batch_key(item: OutboxItem) -> tuple[str, bytes, int]:
    """Return what the records of one query have in common."""
    return item.key, item.origin, item.priority
