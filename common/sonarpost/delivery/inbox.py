"""Consumer side of the delivery protocol: commit first, then acknowledge."""

from __future__ import annotations

import hashlib
import logging
import queue
import sqlite3
import threading
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import zenoh
from zenoh.handlers import Callback

from sonarpost import keys
from sonarpost.delivery.protocol import (
    MAX_BATCH_RECORDS,
    MAX_RECORD_BYTES,
    STORED,
    AckReply,
    pack_replies,
    parse_query,
)
from sonarpost.delivery.records import ReceivedChunk
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import (
    BadInputError,
    DeliveryError,
    MissingBaseError,
    PayloadError,
    RetryLaterError,
    can_concern_record,
)
from sonarpost.logs import kv, log_context

log = logging.getLogger(__name__)

T = TypeVar("T")

COMMIT_MESSAGES = 64
COMMIT_ATTACHMENT_BYTES = 65_536
"""Maximum size of the attachments in one transaction (about 1400 small records); it bounds the duration."""
QUEUE_LIMIT = 256
RETRY_S = 0.5
MAX_REASON = 200


Replies = AckReply | list[AckReply]
"""Reply to a query; for a batch, one for each record."""
Handle = Callable[[str, bytes, T], bool]
"""Handles an accepted record, as key, payload and what `validate` or `expand` has returned, in the open transaction;
False if it has to wait in the inbox."""
Accepting = Callable[[], AbstractContextManager[tuple[Transaction, Handle[T]]]]
"""Opens a transaction that accepts records and can handle them."""


@dataclass(frozen=True, slots=True)
class _Message:
    """A delivery query, or (query None) a plain publication of a program without an outbox."""

    key: str
    payload: bytes
    attachment: bytes
    query: zenoh.Query | None


def _wait(_key: str, _payload: bytes, _record: object) -> bool:
    return False


class Inbox(Generic[T]):
    """Receives the records of one consumer: delivery queries, and plain publications of third-party programs.

    A publication with an attachment is a copy for subscribers and is ignored; its record arrives by query. One without
    an attachment comes from a program that has no outbox (for example a custom detector). It is committed as well, but
    its sender gets no reply: a publication that is lost before it arrives is not repeated.

    Args:
        session: Session on the platform's router.
        store: Store for the accepted records.
        consumer: Name of the consumer.
        key_expressions: Keys of the records.
        validate: Called with (key, payload) before a record is stored; returns the decoded record, or raises
            BadInputError to refuse it.
        on_refused: Called with each error that caused a record to be refused.
        expand: Called with (transaction, key, payload, record) in the transaction that accepts a valid record; returns
            the payload to store in its place, and its record. Raises MissingBaseError to refuse a difference, which
            its producer then sends as a whole.
        check_capacity: Called with the key before a record is stored; raises RetryLaterError if there is no space.
        delivery_only_keys: Key expressions on which plain publications are ignored.
        before_commit: Called with the accepted records, as key and payload, before they are committed and acknowledged;
            raises DeliveryError to leave them with their senders.
        handle: Called with each record that is accepted; by default all wait in the inbox.
        accepting: Opens the transactions that accept records, with what is called in place of `handle`.

    Attributes:
        storage_failing: Whether records cannot be stored at present, for example because of a full disk.
    """

    def __init__(
        self,
        session: zenoh.Session,
        store: Store,
        consumer: str,
        key_expressions: tuple[str, ...],
        validate: Callable[[str, bytes], T],
        on_refused: Callable[[BadInputError], None],
        *,
        expand: Callable[[Transaction, str, bytes, T], tuple[bytes, T]] = lambda _tx, _key, *stored: stored,
        check_capacity: Callable[[str], None] = lambda _: None,
        delivery_only_keys: Collection[str] = (),
        before_commit: Callable[[Sequence[tuple[str, bytes]]], None] = lambda _: None,
        handle: Handle[T] = _wait,
        accepting: Accepting[T] | None = None,
    ) -> None:
        self._store = store
        self._key_suffix = "/delivery/" + consumer
        self._validate = validate
        self._on_refused = on_refused
        self._expand = expand
        self._check_capacity = check_capacity
        self._before_commit = before_commit
        self._accepting = accepting
        self._own_handle = self._handle = handle
        self._accepted: list[tuple[str, bytes]] = []
        self._messages: queue.Queue[_Message | None] = queue.Queue(QUEUE_LIMIT)
        self._stop = threading.Event()
        self.storage_failing = False
        self._retained: list[_Message] = []
        self._no_capacity: dict[str, str | None] = {}
        self._thread = threading.Thread(target=self._run, name=f"inbox-{consumer}", daemon=True)
        self._thread.start()
        self._session = session
        self._is_preferred = True
        self._queryables: dict[str, zenoh.Queryable[None]] = {}
        self._subscribers: list[zenoh.Subscriber[None]] = []
        for key in key_expressions:
            self._declare(keys.delivery_query(key, consumer))
            if key not in delivery_only_keys:
                self._subscribers.append(session.declare_subscriber(key, Callback(self._on_sample, indirect=False)))

    def _declare(self, key: str) -> None:
        # Of several consumers of one name, a query goes to the nearest one that is complete, or to all if none is.
        on_query = Callback(self._on_query, indirect=False)
        self._queryables[key] = self._session.declare_queryable(key, on_query, complete=self._is_preferred)

    def set_preferred(self, *, is_preferred: bool) -> None:
        """Leave new queries to other consumers of the same name while there is one, or end that.

        Raises:
            zenoh.ZError: The session is closed.
        """
        if is_preferred == self._is_preferred:
            return
        self._is_preferred = is_preferred
        for key, queryable in list(self._queryables.items()):
            queryable.undeclare()
            self._declare(key)

    def close(self) -> None:
        """Stop receiving; uncommitted records are not acknowledged, their producers send them again."""
        for queryable in self._queryables.values():
            queryable.undeclare()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._stop.set()
        with suppress(queue.Full):
            self._messages.put_nowait(None)
        self._thread.join()

    # Receive

    def _on_query(self, query: zenoh.Query) -> None:
        key = str(query.key_expr).removesuffix(self._key_suffix)
        payload = query.payload.to_bytes() if query.payload is not None else b""
        attachment = query.attachment.to_bytes() if query.attachment is not None else b""
        self._put(_Message(key, payload, attachment, query))

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if sample.attachment is not None or sample.kind != zenoh.SampleKind.PUT:
            return
        key, size = str(sample.key_expr), len(sample.payload)
        if size > MAX_RECORD_BYTES:
            self._on_refused(PayloadError(key, "payload", f"{size} bytes", f"at most {MAX_RECORD_BYTES} bytes"))
            return
        self._put(_Message(key, sample.payload.to_bytes(), b"", None))

    def _put(self, message: _Message) -> None:
        while not self._stop.is_set():
            try:
                self._messages.put(message, timeout=0.2)
            except queue.Full:
                continue
            return

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                if messages := self._next_messages():
                    self._reply(messages, self._commit(messages))
            except Exception:
                log.exception("Messages not answered after an unexpected exception; their senders repeat them")
                self._stop.wait(RETRY_S)

    def _next_messages(self) -> list[_Message]:
        if self._retained:
            # Publications have no sender that repeats them: retry them first, after a pause.
            self._stop.wait(RETRY_S)
            retained, self._retained = self._retained, []
            return retained
        messages: list[_Message] = []
        message = self._messages.get()
        with suppress(queue.Empty):
            while message is not None:
                messages.append(message)
                size = sum(len(m.attachment) for m in messages)
                if len(messages) >= COMMIT_MESSAGES or size >= COMMIT_ATTACHMENT_BYTES:
                    break
                message = self._messages.get_nowait()
        return messages

    def _commit(self, messages: list[_Message]) -> list[Replies]:
        """Store several messages in one transaction, which share one write to the disk; after a failure in halves."""
        try:
            replies = self._commit_together(messages)
        except Exception as error:
            if not self.storage_failing:
                log.exception("Records cannot be stored; senders keep them", extra=kv(error=str(error)))
            self.storage_failing = True
            if can_concern_record(error):
                if len(messages) > 1:
                    half = len(messages) // 2
                    return self._commit(messages[:half]) + self._commit(messages[half:])
                if messages[0].query is None:
                    # Nothing repeats it, and it must not stay in front of other messages.
                    self._on_refused(PayloadError(messages[0].key, "payload", str(error), "a record that is stored"))
            else:
                self._retained += [message for message in messages if message.query is None]
            later: Replies = AckReply("later", reason=str(error)[:MAX_REASON])
            return [later] * len(messages)
        if self.storage_failing:
            log.info("Records can be stored again")
        self.storage_failing = False
        return replies

    def _commit_together(self, messages: list[_Message]) -> list[Replies]:
        if self._accepting is not None:
            try:
                with self._accepting() as (tx, self._handle):
                    return self._store_messages(tx, messages)
            except Exception as error:  # noqa: BLE001 - an error of the transaction is raised again below
                # A record can be the cause: without handling it, it is accepted, and handled as others are.
                log.debug("Records not handled when accepted", extra=kv(error=str(error)))
            finally:
                self._handle = self._own_handle
        with self._store.transaction() as tx:
            return self._store_messages(tx, messages)

    # Store

    def _store_messages(self, tx: Transaction, messages: list[_Message]) -> list[Replies]:
        self._no_capacity.clear()
        self._accepted.clear()
        replies = [self._store_message(tx, message) for message in messages]
        if self._accepted:
            self._before_commit(self._accepted)
        return replies

    def _store_message(self, tx: Transaction, message: _Message) -> Replies:
        if message.query is None:
            return self._store_publication(tx, message)
        if "*" in message.key:
            return self._refused(PayloadError(message.key, "key", message.key, "a key without wildcards"))
        try:
            received = parse_query(message.attachment, message.payload, message.key + self._key_suffix)
        except PayloadError as error:
            return self._refused(error)
        if isinstance(received, ReceivedChunk):
            return self._store_chunk(tx, message.key, received)
        return [self._store_once(tx, message.key, chunk) for chunk in received]

    def _store_publication(self, tx: Transaction, message: _Message) -> AckReply:
        try:
            self._require_capacity(message.key)
        except RetryLaterError as error:
            # The sender does not repeat it, and there is no space to retain it.
            self._on_refused(PayloadError(message.key, "payload", "a publication that cannot be stored", str(error)))
            return AckReply("later", reason=str(error)[:MAX_REASON])
        return self._store_record(tx, message.key, message.payload, None)

    def _store_chunk(self, tx: Transaction, key: str, chunk: ReceivedChunk) -> AckReply:
        highest, sha256 = tx.accepted_number(key, chunk)
        reply = self._store_once(tx, key, chunk)
        return replace(reply, highest=highest, highest_sha256=sha256) if chunk.offset == 0 else reply

    def _store_once(self, tx: Transaction, key: str, chunk: ReceivedChunk) -> AckReply:
        if tx.was_received(key, chunk):
            return STORED
        try:
            self._require_capacity(key)
        except RetryLaterError as error:
            if tx.partial_records.reclaim():
                log.warning("Incomplete records deleted, to accept complete ones", extra=kv(reason=str(error)))
            return AckReply("later", reason=str(error)[:MAX_REASON])
        record = tx.partial_records.add(key, chunk)
        if isinstance(record, int):
            return AckReply("more", next_offset=record)
        if hashlib.sha256(record).digest() != chunk.sha256:
            where = key + self._key_suffix
            return self._refused(PayloadError(where, "sha256", chunk.sha256.hex(), "the digest of the record"))
        return self._store_record(tx, key, record, chunk)

    def _refused(self, error: PayloadError) -> AckReply:
        self._on_refused(error)
        return AckReply("refused", reason=str(error))

    def _require_capacity(self, key: str) -> None:
        """Check the capacity for a key, once in each transaction."""
        if key not in self._no_capacity:
            try:
                self._check_capacity(key)
            except RetryLaterError as error:
                self._no_capacity[key] = str(error)
            else:
                self._no_capacity[key] = None
        reason = self._no_capacity[key]
        if reason is not None:
            raise RetryLaterError(reason)

    def _store_record(self, tx: Transaction, key: str, payload: bytes, chunk: ReceivedChunk | None) -> AckReply:
        with log_context(payload):
            try:
                record = self._validate(key, payload)
                stored, record = self._expand(tx, key, payload, record)
            except (DeliveryError, sqlite3.Error):
                raise
            except MissingBaseError as error:
                # Not an error of the producer: it sends the whole record, and nothing has to be kept.
                log.info("Difference refused; its sender sends the whole record", extra=kv(reason=str(error)))
                return AckReply("refused", reason=str(error))
            except BadInputError as error:
                self._on_refused(error)
                return self._quarantine(tx, key, payload, str(error))
            except Exception as error:
                # An unexpected exception must neither block later records nor lose this one.
                log.exception("Record quarantined after an unexpected exception", extra=kv(key=key))
                return self._quarantine(tx, key, payload, f"{type(error).__name__}: {error}")
        tx.accept(key, stored, chunk, is_handled=self._handle(key, stored, record))
        self._accepted.append((key, stored))
        return STORED

    def _quarantine(self, tx: Transaction, key: str, payload: bytes, reason: str) -> AckReply:
        tx.quarantine("in", key, payload, reason)
        return AckReply("refused", reason=reason)

    def _reply(self, messages: list[_Message], replies: list[Replies]) -> None:
        for message, reply in zip(messages, replies, strict=True):
            if message.query is None:
                continue
            packed = reply.pack(MAX_BATCH_RECORDS) if isinstance(reply, AckReply) else pack_replies(reply)
            try:
                with message.query as query:
                    query.reply(query.key_expr, packed)
            except zenoh.ZError as error:
                # The producer has left or the link is down: it repeats the query, which is then a duplicate.
                log.debug("Reply not sent", extra=kv(key=message.key, error=str(error)))
