"""The consumer's side of the durable hand-off: commit first, then acknowledge."""

from __future__ import annotations

import hashlib
import logging
import queue
import threading
from collections.abc import Callable, Collection
from dataclasses import dataclass

import zenoh

from sonarpost import keys
from sonarpost.delivery.batch_protocol import MAX_RECORDS, pack_replies, parse_query
from sonarpost.delivery.protocol import MAX_RECORD_BYTES, AckReply
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import ReceivedChunk, Transaction
from sonarpost.errors import BadInputError, DeliveryError, PayloadError
from sonarpost.logs import kv, lazy_log_context
from sonarpost.monitoring.log_context import context_of_payload

log = logging.getLogger(__name__)

BATCH = 64
BATCH_ATTACHED = 65_536
"""Most bytes of attachments in one batch, about 1400 small records: whoever waits for the store waits no longer."""
QUEUE_LIMIT = 256
RETRY_S = 0.5
MAX_REASON = 200


Replies = AckReply | list[AckReply]
"""What is answered: to a query of several records, for each of them."""


class RetryLaterError(DeliveryError):
    """There is no room for this record at the moment; its sender keeps it, and other records may be taken."""


@dataclass(frozen=True, slots=True)
class _PendingAck:
    """A hand-over query, or (query None) a plain publication by somebody without an outbox."""

    key: str
    payload: bytes
    attached: bytes
    query: zenoh.Query | None


class Inbox:
    """Takes records for one consumer: queries of the hand-off, and plain publications of third parties.

    A publication that carries a hand-off attachment is a copy for watchers and is left alone; the same record comes by
    query. One without comes from a program that has no outbox (somebody's own detector): it is committed like any
    other, but nobody is told, so a loss on the way to us is not repaired.

    Args:
        check: Called with (key, payload) before a record is stored; raises BadInputError to refuse it.
        on_refused: Called with every error that made a record be refused.
        check_capacity: Called with the key before a record is stored; raises RetryLaterError if there is no space.
        delivery_only_keys: Key expressions on which plain publications are not for this consumer.
    """

    def __init__(
        self,
        session: zenoh.Session,
        store: Store,
        consumer: str,
        key_expressions: tuple[str, ...],
        check: Callable[[str, bytes], None],
        on_refused: Callable[[BadInputError], None],
        *,
        check_capacity: Callable[[str], None] = lambda _: None,
        delivery_only_keys: Collection[str] = (),
    ) -> None:
        self._store = store
        self._suffix = "/handoff/" + consumer
        self._check = check
        self._on_refused = on_refused
        self._check_capacity = check_capacity
        self._arrivals: queue.Queue[_PendingAck] = queue.Queue(QUEUE_LIMIT)
        self._stop = threading.Event()
        self._storage_failing = False
        self._kept: list[_PendingAck] = []
        self._no_room: dict[str, str | None] = {}
        self._thread = threading.Thread(target=self._run, name=f"inbox-{consumer}", daemon=True)
        self._thread.start()
        self._declared: list[zenoh.Queryable[None] | zenoh.Subscriber[None]] = []
        for key in key_expressions:
            self._declared.append(session.declare_queryable(keys.handoff(key, consumer), self._on_query))
            if key not in delivery_only_keys:
                self._declared.append(session.declare_subscriber(key, self._on_sample))

    @property
    def storage_failing(self) -> bool:
        """True while records cannot be stored (a full disk, for example)."""
        return self._storage_failing

    def close(self) -> None:
        """Stop taking records; what was not committed is not acknowledged and will be sent again."""
        for declared in self._declared:
            declared.undeclare()  # type: ignore[no-untyped-call]  # the stub has no return type
        self._stop.set()
        self._thread.join()

    def _on_query(self, query: zenoh.Query) -> None:
        key = str(query.key_expr).removesuffix(self._suffix)
        payload = query.payload.to_bytes() if query.payload is not None else b""
        attached = query.attachment.to_bytes() if query.attachment is not None else b""
        self._arrive(_PendingAck(key, payload, attached, query))

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if sample.attachment is not None or sample.kind != zenoh.SampleKind.PUT:
            return
        key, size = str(sample.key_expr), len(sample.payload)
        if size > MAX_RECORD_BYTES:
            self._on_refused(PayloadError(key, "payload", f"{size} bytes", f"at most {MAX_RECORD_BYTES} bytes"))
            return
        self._arrive(_PendingAck(key, sample.payload.to_bytes(), b"", None))

    def _arrive(self, arrival: _PendingAck) -> None:
        while not self._stop.is_set():
            try:
                self._arrivals.put(arrival, timeout=0.2)
            except queue.Full:
                continue
            return

    def _run(self) -> None:
        while not self._stop.is_set():
            batch = self._next_batch()
            if batch:
                self._answer(batch, self._commit(batch))

    def _next_batch(self) -> list[_PendingAck]:
        if self._kept:
            # What nobody sends again comes first, a moment after the trouble that kept it.
            self._stop.wait(RETRY_S)
            kept, self._kept = self._kept, []
            return kept
        try:
            batch = [self._arrivals.get(timeout=0.2)]
        except queue.Empty:
            return []
        while len(batch) < BATCH and sum(len(arrival.attached) for arrival in batch) < BATCH_ATTACHED:
            try:
                batch.append(self._arrivals.get_nowait())
            except queue.Empty:
                break
        return batch

    def _commit(self, batch: list[_PendingAck]) -> list[Replies]:
        """Store a batch in one transaction, so that many records share one write to the disk."""
        self._no_room.clear()
        try:
            with self._store.transaction() as tx:
                replies = [self._take(tx, arrival) for arrival in batch]
        except DeliveryError as error:
            if not self._storage_failing:
                log.exception("Records cannot be stored, their senders keep them", extra=kv(error=str(error)))
            self._storage_failing = True
            self._kept = [arrival for arrival in batch if arrival.query is None]
            later: Replies = AckReply("later", reason=str(error)[:MAX_REASON])
            return [later] * len(batch)
        if self._storage_failing:
            log.info("Records can be stored again")
        self._storage_failing = False
        return replies

    def _take(self, tx: Transaction, arrival: _PendingAck) -> Replies:
        if arrival.query is None:
            return self._take_publication(tx, arrival)
        try:
            asked = parse_query(arrival.attached, arrival.payload, arrival.key + self._suffix)
        except PayloadError as error:
            self._on_refused(error)
            return AckReply("refused", reason=str(error))
        if isinstance(asked, ReceivedChunk):
            return self._take_chunk(tx, arrival.key, asked)
        return [self._take_chunk(tx, arrival.key, chunk) for chunk in asked]

    def _take_chunk(self, tx: Transaction, key: str, chunk: ReceivedChunk) -> AckReply:
        try:
            return self._taken(tx, key, chunk)
        except RetryLaterError as error:
            return AckReply("later", reason=str(error)[:MAX_REASON])
        except PayloadError as error:
            self._on_refused(error)
            return AckReply("refused", reason=str(error))

    def _need_room(self, key: str) -> None:
        """Ask once a batch whether there is room for what comes on a key."""
        if key not in self._no_room:
            try:
                self._check_capacity(key)
            except RetryLaterError as error:
                self._no_room[key] = str(error)
            else:
                self._no_room[key] = None
        reason = self._no_room[key]
        if reason is not None:
            raise RetryLaterError(reason)

    def _take_publication(self, tx: Transaction, arrival: _PendingAck) -> AckReply:
        try:
            self._need_room(arrival.key)
        except RetryLaterError as error:
            # Nobody sends it again, and to keep it would take the room that is not there.
            self._on_refused(PayloadError(arrival.key, "payload", "a publication that cannot be stored", str(error)))
            return AckReply("later", reason=str(error)[:MAX_REASON])
        return self._take_checked(tx, arrival.key, arrival.payload, None)

    def _taken(self, tx: Transaction, key: str, chunk: ReceivedChunk) -> AckReply:
        if chunk.settled:
            tx.settle_upto(chunk.origin, chunk.settled)
        if tx.was_refused(chunk.origin, chunk.seq):
            return AckReply("refused", reason="refused before; the reason is in the consumer's log and store")
        if tx.was_seen(chunk.origin, chunk.seq):
            return AckReply("stored")
        self._need_room(key)
        whole = tx.add_chunk(chunk)
        if isinstance(whole, int):
            return AckReply("more", next_offset=whole)
        if hashlib.sha256(whole).digest() != chunk.sha256:
            raise PayloadError(key + self._suffix, "sha256", chunk.sha256.hex(), "the digest of the record")
        return self._take_checked(tx, key, whole, chunk)

    def _take_checked(self, tx: Transaction, key: str, payload: bytes, chunk: ReceivedChunk | None) -> AckReply:
        with lazy_log_context(lambda: context_of_payload(payload, key)):
            return self._checked(tx, key, payload, chunk)

    def _checked(self, tx: Transaction, key: str, payload: bytes, chunk: ReceivedChunk | None) -> AckReply:
        try:
            self._check(key, payload)
        except DeliveryError:
            raise
        except BadInputError as error:
            self._on_refused(error)
            return self._refuse(tx, key, payload, chunk, str(error))
        except Exception as error:
            # A defect of ours must not stop the records behind this one, and must not lose this one either.
            log.exception("Record not checked, it is kept apart", extra=kv(key=key))
            return self._refuse(tx, key, payload, chunk, f"{type(error).__name__}: {error}")
        if chunk is None:
            tx.accept(key, payload)
        else:
            tx.accept(key, payload, chunk.origin, chunk.seq)
        return AckReply("stored")

    def _refuse(self, tx: Transaction, key: str, payload: bytes, chunk: ReceivedChunk | None, reason: str) -> AckReply:
        tx.quarantine("in", key, payload, reason)
        if chunk is not None:
            tx.mark_refused(chunk.origin, chunk.seq)
        return AckReply("refused", reason=reason)

    def _answer(self, batch: list[_PendingAck], replies: list[Replies]) -> None:
        for arrival, reply in zip(batch, replies, strict=True):
            if arrival.query is None:
                continue
            packed = reply.pack(takes=MAX_RECORDS) if isinstance(reply, AckReply) else pack_replies(reply)
            try:
                with arrival.query as query:
                    query.reply(query.key_expr, packed)
            except zenoh.ZError as error:
                # The asker is gone or the link is down: it asks again, and (origin, seq) is known here.
                log.debug("A reply could not be sent", extra=kv(key=arrival.key, error=str(error)))
