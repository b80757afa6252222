"""Sends one queue of a store: publishes records for subscribers, and sends them until the consumer acknowledges."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import zenoh

from sonarpost import keys
from sonarpost.delivery import congestion, protocol
from sonarpost.delivery.protocol import AckReply
from sonarpost.delivery.records import OutboxItem, Place, consumer_of
from sonarpost.delivery.scheduler import WINDOW, Chunk, DeliveryScheduler, RecordTransfer
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import DeliveryError, PayloadError
from sonarpost.logs import kv, log_context

log = logging.getLogger(__name__)

BACK_OFF_S = (0.05, 0.1, 0.2, 0.5, 1.0)
IDLE_S = 1.0
FIRST_PLACE: Place = (0, 0)
"""Before all records."""
REMOVE_AT = 512
"""Number of acknowledged records that are removed from the store at once."""
REMOVE_AFTER_S = 0.2
LOADED_BYTES = 2 * congestion.MAX_WINDOW_BYTES
"""Maximum size of the records in memory beyond the first 128."""
PRIORITIES = {
    1: zenoh.Priority.REAL_TIME,
    2: zenoh.Priority.INTERACTIVE_HIGH,
    3: zenoh.Priority.INTERACTIVE_LOW,
    4: zenoh.Priority.DATA_HIGH,
    5: zenoh.Priority.DATA,
    6: zenoh.Priority.DATA_LOW,
    7: zenoh.Priority.BACKGROUND,
}

OnAcknowledged = Callable[[Transaction, OutboxItem, str | None], bool | None]
"""Called in the transaction that removes a record, with the consumer's reason if it was refused.

It returns True if a refused record was replaced and need not be quarantined.
"""


@dataclass(frozen=True, slots=True)
class QueuePolicy:
    """Settings with which a queue is sent.

    Attributes:
        session: Returns the session to use, None while it is not open; by default the session of the outbox.
        publish: Also publish each record on its key, once after a start, for subscribers.
        bytes_per_s: Bandwidth limit, None for none.
        held: Send nothing: the consumer is no longer configured.
        is_local: The consumer is on this platform: no thin link is on the way.
    """

    session: Callable[[], zenoh.Session | None] | None = None
    publish: bool = True
    bytes_per_s: float | None = None
    held: bool = False
    is_local: bool = False


class _Query:
    """A query in flight; threads of Zenoh call `received` and `ended`.

    Args:
        chunks: What it sends.
        on_end: Called once, with the reply or at the end without one.
    """

    def __init__(self, chunks: Sequence[Chunk], on_end: Callable[[_Query], None]) -> None:
        self.chunks = chunks
        self.reply: zenoh.Reply | None = None
        self._on_end = on_end

    def received(self, reply: zenoh.Reply) -> None:
        """Use the first reply: of the consumer, or an error after the time-out."""
        if self.reply is None:
            self.reply = reply
            self._on_end(self)

    def ended(self) -> None:
        """Report an end without a reply."""
        if self.reply is None:
            self._on_end(self)


class _NoReplyError(Exception):
    """The consumer is absent, the link is down, or the consumer cannot store records."""


class QueueSender:
    """Sends one queue: several queries in flight, most urgent record first.

    Attributes:
        responding: Whether the consumer replied to the last query.
        acknowledged_count: Number of records that the consumer has accepted since the start.
        restored: Whether the consumer has accepted records that the store does not contain: it was restored from an
            older copy.
    """

    def __init__(
        self,
        session: zenoh.Session,
        store: Store,
        queue: str,
        policy: QueuePolicy,
        on_acknowledged: OnAcknowledged,
    ) -> None:
        self.responding = False
        self.acknowledged_count = 0
        self.restored = False
        self._default_session = session
        self._store = store
        self._queue = queue
        self._policy = policy
        self._on_acknowledged = on_acknowledged
        now_s = time.monotonic()
        start_bytes = congestion.LOCAL_START_BYTES if policy.is_local else congestion.START_BYTES
        self._scheduler = DeliveryScheduler(policy.bytes_per_s, now_s, time.time() - now_s, start_bytes)
        self._published: set[int] = set()
        self._in_flight: set[_Query] = set()
        self._ended: deque[_Query] = deque()
        self._failure: str | None = None
        self._timed_out = False
        self._acknowledged: dict[int, OutboxItem] = {}
        self._first_acknowledged_s = 0.0
        self._done_up_to = 0
        self._failures = 0
        self._batch_refused = False
        self._stop = threading.Event()
        self._wake = threading.Event()
        self._new_places: deque[Place] = deque([FIRST_PLACE])
        self._last_place, self._has_all = FIRST_PLACE, False
        self._thread = threading.Thread(target=self._run, name=f"outbox-{queue}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop; a query without a reply ends when the session closes."""
        self._stop.set()
        self._wake.set()
        self._thread.join(timeout=0.5)

    def on_new(self, place: Place) -> None:
        """Continue with a record that was queued at this place."""
        self._new_places.append(place)
        self._wake.set()

    def _on_end(self, query: _Query) -> None:
        self._ended.append(query)
        self._wake.set()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._step()
            except Exception as error:
                if not isinstance(error, (_NoReplyError, DeliveryError, zenoh.ZError)):
                    log.exception("Records not sent after an unexpected exception; sending them again")
                self._fail(str(error))
        try:
            self._remove_acknowledged()
        except DeliveryError as error:
            log.debug("Acknowledged records not removed; the next start sends them again", extra=kv(error=str(error)))

    def _step(self) -> None:
        """Send the allowed queries and process the available replies; wait if there is nothing to do.

        After a failure, wait until no query is in flight before anything is sent again: what a connection still holds
        must not be sent a second time behind it.
        """
        self._wake.clear()
        if self._stop.is_set():
            return
        wait_s: float | None = None
        if self._failure is None:
            self._load()
            wait_s = self._send_queries()
        elif not self._in_flight:
            self._back_off(self._failure)
            return
        if self._process_ended():
            return
        overdue = time.monotonic() - self._first_acknowledged_s > REMOVE_AFTER_S
        if self._acknowledged and self._failure is None and (overdue or not self._in_flight):
            self._remove_acknowledged()
        else:
            self._wake.wait(IDLE_S if wait_s is None else wait_s)

    def _fail(self, reason: str) -> None:
        self.responding = False
        self._failure = self._failure or reason

    # Load

    def _load(self) -> None:
        """Load the most urgent records if new ones belong to them, or if few remain and the store has more."""
        scheduler = self._scheduler
        are_enough = self._has_all or len(scheduler.active) > scheduler.lookahead // 2
        while are_enough and self._new_places:
            are_enough = not self._has_all and self._new_places.popleft() > self._last_place
        if are_enough:
            return
        self._new_places.clear()
        if len(self._acknowledged) >= REMOVE_AT:
            self._remove_acknowledged()
        self._has_all = False  # it stays so if the store cannot be read
        limit = scheduler.lookahead + len(self._acknowledged)
        numbers = self._store.queued_numbers(self._queue, limit)
        unacknowledged = [seq for seq in numbers if seq not in self._acknowledged]
        known, loaded = self._items(unacknowledged[: scheduler.lookahead])
        self._has_all = len(numbers) < limit and len(known) + len(loaded) == len(unacknowledged)
        self._last_place = max((items[-1].place for items in (known, loaded) if items), default=FIRST_PLACE)
        scheduler.update([*known, *loaded])
        self._done_up_to = self._store.done_up_to(self._queue)
        session = self._session()
        if session is not None:
            for item in loaded:
                self._publish(session, item)

    def _items(self, numbers: Sequence[int]) -> tuple[list[OutboxItem], list[OutboxItem]]:
        """Return records that are in memory and newly loaded ones; fewer of large records, to limit the memory."""
        active = self._scheduler.active
        known: list[OutboxItem] = []
        loaded: list[OutboxItem] = []
        size_bytes = 0
        for first in range(0, len(numbers), WINDOW):
            part = numbers[first : first + WINDOW]
            kept = [active[seq].item for seq in part if seq in active]
            new = self._store.queued_items(self._queue, [seq for seq in part if seq not in active])
            known += kept
            loaded += new
            size_bytes += sum(len(item.payload) for item in (*kept, *new))
            if size_bytes > LOADED_BYTES:
                break
        return known, loaded

    def _session(self) -> zenoh.Session | None:
        return self._default_session if self._policy.session is None else self._policy.session()

    # Send

    def _send_queries(self) -> float | None:
        """Send queries until the window is full; return the wait that the bandwidth limit requires."""
        while not self._stop.is_set():
            chunk, wait_s = self._scheduler.next_chunk(time.monotonic())
            if chunk is None:
                return wait_s
            chunks = self._mark_in_flight(self._scheduler.batch_with(chunk))
            if chunks:
                self._send(chunks)
        return None

    def _mark_in_flight(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        """Protect the records from replacement; omit those that a newer edition has already replaced."""
        new = [chunk.transfer.item.seq for chunk in chunks if not chunk.transfer.in_flight]
        queued = self._store.mark_in_flight(self._queue, new) if new else ()
        marked = []
        for chunk in chunks:
            if chunk.transfer.in_flight or chunk.transfer.item.seq in queued:
                chunk.transfer.in_flight = True  # before the query is sent, so that a failure clears the mark
                marked.append(chunk)
            else:
                self._scheduler.remove(chunk.transfer)
        return marked

    def _send(self, chunks: Sequence[Chunk]) -> None:
        session = self._session()
        if session is None:
            raise _NoReplyError("router of the upstream not reached yet")
        items = [chunk.transfer.item for chunk in chunks]
        for item in items:
            self._publish(session, item)
        done_up_to = min(self._done_up_to, *(item.seq - 1 for item in items))
        if len(chunks) == 1:
            start, end = chunks[0].start, chunks[0].end
            payload = items[0].payload[start:end]
            attachment = protocol.attachment(items[0].origin, items[0], start, done_up_to)
        else:
            payload = b"".join(item.payload for item in items)
            attachment = protocol.batch_attachment(items[0].origin, items, done_up_to)
        query = _Query(chunks, self._on_end)
        sent_s = time.monotonic()
        session.get(
            keys.delivery_query(items[0].key, consumer_of(items[0].queue)),
            # Without a thread of its own: it only stores the reply.
            zenoh.handlers.Callback(query.received, query.ended, indirect=False),
            timeout=self._scheduler.congestion.timeout_s,
            priority=PRIORITIES[items[0].priority],
            # Waits for the link: a dropped query would cost its whole time-out.
            congestion_control=zenoh.CongestionControl.BLOCK,
            # The first reply counts: of several consumers of one name, one may not reply at all.
            consolidation=zenoh.ConsolidationMode.NONE,
            payload=payload,
            attachment=attachment,
        )
        self._in_flight.add(query)
        self._scheduler.query_sent(chunks[0], sent_s, *chunks[1:])

    def _publish(self, session: zenoh.Session, item: OutboxItem) -> None:
        """Publish a copy for subscribers, which identify a repeated one by (origin, seq)."""
        if not self._policy.publish or item.seq in self._published:
            return
        self._published.add(item.seq)
        session.put(
            item.key,
            item.payload,
            encoding=item.encoding,
            priority=PRIORITIES[item.priority],
            attachment=protocol.attachment(protocol.watcher_origin(item.origin), item),
        )

    # Replies

    def _process_ended(self) -> bool:
        """Process the queries that have ended; return whether there was one."""
        found = bool(self._ended)
        while self._ended:
            query = self._ended.popleft()
            if query not in self._in_flight:
                continue  # it could not be sent
            self._in_flight.remove(query)
            reply = query.reply
            replied = reply is not None and reply.ok is not None
            self._scheduler.query_ended(query.chunks[0], time.monotonic(), replied=replied)
            try:
                self._process(query.chunks, reply)
            except _NoReplyError as error:
                # The others can have replies.
                self._fail(str(error))
        return found

    def _process(self, chunks: Sequence[Chunk], received: zenoh.Reply | None) -> None:
        if received is None:
            raise _NoReplyError("no reply")
        if received.ok is None:
            self._timed_out = True
            raise _NoReplyError("no reply before the time-out")
        replies = self._unpack(chunks, received.ok.payload.to_bytes())
        for chunk, reply in zip(chunks, replies, strict=True):
            if reply.status != "later":
                self._apply(chunk, reply)
        for reply in replies:
            if reply.status == "later":
                raise _NoReplyError(f"the consumer cannot store records: {reply.reason}")

    def _unpack(self, chunks: Sequence[Chunk], payload: bytes) -> Sequence[AckReply]:
        where = chunks[0].transfer.item.key
        try:
            if len(chunks) == 1:
                reply = AckReply.unpack(payload, where)
                self._scheduler.max_batch = 0 if self._batch_refused else reply.max_batch
                item = chunks[0].transfer.item
                if reply.highest and (self._scheduler.probing or reply.highest >= item.seq):
                    self._check_age(item, reply)
                return [reply]
            replies = protocol.unpack_replies(payload, len(chunks), where)
        except PayloadError as error:
            raise _NoReplyError(str(error)) from error
        if isinstance(replies, AckReply):
            if replies.status != "later":
                # An older consumer replaced the one that announced batches: send single records from now on.
                self._batch_refused = True
            raise _NoReplyError(f"batch not accepted: {replies.status} {replies.reason}")
        return replies

    def _check_age(self, item: OutboxItem, reply: AckReply) -> None:
        """Use a new origin if the store is older than what the consumer has accepted from it."""
        if self.restored or not self._store.is_older_than(
            self._queue, item.origin, reply.highest, reply.highest_sha256
        ):
            return
        with self._store.transaction() as tx:
            tx.renew_origin(self._queue)
        self.restored = True
        log.warning(
            "Store is older than its last delivery; new records get a new origin",
            extra=kv(consumer=self._queue, store=self._store.path, accepted=reply.highest),
        )

    def _apply(self, chunk: Chunk, reply: AckReply) -> None:
        transfer = chunk.transfer
        self._failures = 0
        self.responding = True
        self._scheduler.probing = False
        if transfer.item.seq not in self._scheduler.active:
            return
        if reply.status == "stored":
            if not self._acknowledged:
                self._first_acknowledged_s = time.monotonic()
            self._acknowledged[transfer.item.seq] = transfer.item
            self._scheduler.remove(transfer)
            self.acknowledged_count += 1
        elif reply.status == "refused":
            self._quarantine(transfer, reply.reason)
        elif reply.next_offset >= len(transfer.item.payload):
            size = len(transfer.item.payload)
            raise _NoReplyError(f"invalid reply: next offset {reply.next_offset} of {size} bytes")
        else:
            self._scheduler.confirm(chunk, reply.next_offset)

    def _quarantine(self, transfer: RecordTransfer, reason: str) -> None:
        item = transfer.item
        with self._store.transaction() as tx:
            replaced = self._on_acknowledged(tx, item, reason)
            if replaced:
                tx.remove_acknowledged(item.queue, (item.seq,))
            else:
                tx.quarantine_refused(item, reason)
        with log_context(item.payload):
            fields = kv(consumer=self._queue, key=item.key, reason=reason)
            if replaced:
                log.info("Refused record replaced", extra=fields)
            else:
                log.error("Record refused by its consumer and quarantined", extra=fields)
        self._scheduler.remove(transfer)
        self._clear(item.seq)

    def _remove_acknowledged(self) -> None:
        """Remove acknowledged records in one transaction; if repeated, the consumer discards them as duplicates."""
        if not self._acknowledged:
            return
        with self._store.transaction(durable=False) as tx:
            tx.remove_acknowledged(self._queue, self._acknowledged)
            for item in self._acknowledged.values():
                self._on_acknowledged(tx, item, None)
        self._clear(*self._acknowledged)
        self._acknowledged.clear()

    def _clear(self, *numbers: int) -> None:
        self._published.difference_update(numbers)
        self._store.clear_in_flight(self._queue, *numbers)

    def _back_off(self, reason: str) -> None:
        """Wait; all unconfirmed chunks are sent again."""
        self._scheduler.restart(timed_out=self._timed_out)
        self._failure = None
        self._timed_out = False
        self._new_places.append(FIRST_PLACE)  # the failure can have been that of the store
        for transfer in self._scheduler.active.values():
            if transfer.in_flight and transfer.received == 0:
                # The consumer has confirmed no part of it: a newer edition may replace it again.
                transfer.in_flight = False
                self._store.clear_in_flight(self._queue, transfer.item.seq)
        if self._failures == len(BACK_OFF_S):
            log.warning("Consumer not responding; records queued", extra=kv(consumer=self._queue, reason=reason))
        wait_s = BACK_OFF_S[min(self._failures, len(BACK_OFF_S) - 1)]
        self._failures += 1
        self._stop.wait(wait_s)
