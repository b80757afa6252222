"""The producer's side of the durable hand-off: publish for watchers, then hand over until acknowledged."""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import dataclass

import zenoh

from sonarpost import keys
from sonarpost.errors import HandoffError, PayloadError
from sonarpost.runtime import handoff
from sonarpost.runtime.handoff import CHUNK_BYTES, Reply
from sonarpost.runtime.logs import kv
from sonarpost.runtime.store import Store
from sonarpost.runtime.transaction import OutboxItem

log = logging.getLogger(__name__)

WINDOW = 8
REPLY_TIMEOUT_S = 5.0
BACK_OFF_S = (0.05, 0.1, 0.2, 0.5, 1.0)
PRIORITIES = {
    1: zenoh.Priority.REAL_TIME,
    2: zenoh.Priority.INTERACTIVE_HIGH,
    3: zenoh.Priority.INTERACTIVE_LOW,
    4: zenoh.Priority.DATA_HIGH,
    5: zenoh.Priority.DATA,
    6: zenoh.Priority.DATA_LOW,
    7: zenoh.Priority.BACKGROUND,
}


@dataclass(slots=True)
class _Transfer:
    """One record on its way: how much was asked, how much the consumer has."""

    item: OutboxItem
    asked: int = 0
    has: int = 0
    settled: bool = False

    @property
    def wants_sending(self) -> bool:
        return not self.settled and (self.asked < len(self.item.payload) or self.asked == 0)

    def rewind(self) -> None:
        self.asked = self.has


@dataclass(frozen=True, slots=True)
class _Asked:
    transfer: _Transfer
    end: int
    replies: zenoh.handlers.Handler[zenoh.Reply]


class _NoAnswerError(Exception):
    """The consumer is not there, or the link is down."""


class Outbox:
    """Hands every record of a store's outbox to its consumer, one thread a consumer.

    Args:
        publish: Also publish each record on its key, once a run, for whoever watches.
    """

    def __init__(self, session: zenoh.Session, store: Store, *, publish: bool = True) -> None:
        self._session = session
        self._store = store
        self._publish = publish
        self._stop = threading.Event()
        self._wake = threading.Event()
        self._senders: dict[str, _Sender] = {}
        store.listen_outbox(self._wake)
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """Start a sender for each consumer as it first appears."""
        self._wake.set()
        while not self._stop.is_set():
            self._wake.wait()
            self._wake.clear()
            try:
                consumers = self._store.consumers()
            except HandoffError:
                log.exception("The outbox cannot be read, trying again")
                self._stop.wait(1.0)
                self._wake.set()
                continue
            for consumer in consumers:
                if consumer not in self._senders and not self._stop.is_set():
                    self._senders[consumer] = _Sender(self._session, self._store, consumer, publish=self._publish)

    @property
    def rejected(self) -> int:
        """How many records consumers have refused in this run."""
        return sum(sender.rejected for sender in self._senders.values())

    @property
    def delivered(self) -> int:
        """How many records consumers have acknowledged in this run."""
        return sum(sender.delivered for sender in self._senders.values())

    def close(self) -> None:
        """Stop handing over; what is not acknowledged stays in the store."""
        self._stop.set()
        self._wake.set()
        self._thread.join()
        self._store.unlisten_outbox(self._wake)
        for sender in self._senders.values():
            sender.close()


class _Sender:
    """Hands over to one consumer, with a few queries in flight, most urgent record first."""

    def __init__(self, session: zenoh.Session, store: Store, consumer: str, *, publish: bool) -> None:
        self.rejected = 0
        self.delivered = 0
        self._session = session
        self._store = store
        self._consumer = consumer
        self._publish = publish
        self._shown: set[int] = set()
        self._active: dict[int, _Transfer] = {}
        self._in_flight: deque[_Asked] = deque()
        self._acknowledged: list[int] = []
        self._failures = 0
        # One query at a time until the consumer has answered: of a whole window, one that comes up in the middle of it
        # would take the last and not the first.
        self._window = 1
        self._stop = threading.Event()
        self._wake = threading.Event()
        store.listen_outbox(self._wake)
        self._thread = threading.Thread(target=self._run, name=f"outbox-{consumer}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop; a query that waits for its reply ends when the session closes."""
        self._stop.set()
        self._wake.set()
        self._thread.join(timeout=0.5)
        self._store.unlisten_outbox(self._wake)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._refill()
                if not self._in_flight:
                    self._wake.wait(1.0)
                    continue
                self._settle(self._in_flight.popleft())
                self._failures = 0
                self._window = WINDOW
            except _NoAnswerError as error:
                self._back_off(str(error))
            except HandoffError as error:
                self._back_off(str(error))
            except zenoh.ZError as error:
                self._back_off(str(error))

    def _refill(self) -> None:
        """Put queries in flight up to the window, the most urgent record's pieces first."""
        if len(self._active) < WINDOW:
            self._flush()
            self._wake.clear()
            for item in self._store.owed(self._consumer, WINDOW):
                if item.seq not in self._active:
                    self._active[item.seq] = _Transfer(item)
                    self._show(item)
        for transfer in sorted(self._active.values(), key=lambda t: (t.item.priority, t.item.seq)):
            while transfer.wants_sending and len(self._in_flight) < self._window:
                self._ask(transfer)

    def _show(self, item: OutboxItem) -> None:
        """Publish a copy for watchers; they know it by (origin, seq) when it comes twice."""
        if not self._publish or item.seq in self._shown:
            return
        self._shown.add(item.seq)
        self._session.put(
            item.key,
            item.payload,
            encoding=item.encoding,
            priority=PRIORITIES[item.priority],
            attachment=handoff.attachment(self._store.origin, item),
        )

    def _ask(self, transfer: _Transfer) -> None:
        item, offset = transfer.item, transfer.asked
        end = min(offset + CHUNK_BYTES, len(item.payload))
        replies = self._session.get(
            keys.handoff(item.key, self._consumer),
            timeout=REPLY_TIMEOUT_S,
            priority=PRIORITIES[item.priority],
            # Waits for the link instead of dropping: a dropped query would cost its whole time-out.
            congestion_control=zenoh.CongestionControl.BLOCK,
            payload=item.payload[offset:end],
            attachment=handoff.attachment(self._store.origin, item, offset),
        )
        transfer.asked = end if end > 0 else 1
        self._in_flight.append(_Asked(transfer, end, replies))

    def _settle(self, asked: _Asked) -> None:
        """Act on the oldest query's reply."""
        transfer = asked.transfer
        reply = self._reply(asked, transfer.item.key)
        if transfer.settled:
            return
        if reply.status == "stored":
            self._finish(transfer)
            self.delivered += 1
            self._acknowledged.append(transfer.item.seq)
        elif reply.status == "refused":
            self._reject(transfer, reply.reason)
        elif reply.status == "later":
            raise _NoAnswerError(f"the consumer cannot store: {reply.reason}")
        elif reply.next_offset >= len(transfer.item.payload):
            raise _NoAnswerError(f"a wrong reply: more from {reply.next_offset} of {len(transfer.item.payload)} bytes")
        else:
            transfer.has = reply.next_offset
            if reply.next_offset != asked.end:
                transfer.rewind()

    def _reply(self, asked: _Asked, key: str) -> Reply:
        try:
            received = asked.replies.recv()
        except zenoh.ZError as error:
            raise _NoAnswerError("nobody answers") from error
        if received.ok is None:
            raise _NoAnswerError("no reply in time")
        try:
            return Reply.unpack(received.ok.payload.to_bytes(), key)
        except PayloadError as error:
            raise _NoAnswerError(str(error)) from error

    def _reject(self, transfer: _Transfer, reason: str) -> None:
        item = transfer.item
        with self._store.transaction() as tx:
            tx.rejected(item, reason)
        log.error(
            "A record was refused and is kept apart", extra=kv(consumer=self._consumer, key=item.key, reason=reason)
        )
        self.rejected += 1
        self._finish(transfer)

    def _finish(self, transfer: _Transfer) -> None:
        transfer.settled = True
        self._active.pop(transfer.item.seq, None)
        self._shown.discard(transfer.item.seq)

    def _flush(self) -> None:
        """Forget acknowledged records; late or never is harmless, the consumer knows them."""
        if not self._acknowledged:
            return
        with self._store.transaction() as tx:
            for seq in self._acknowledged:
                tx.acknowledged(self._consumer, seq)
        self._acknowledged.clear()

    def _back_off(self, reason: str) -> None:
        """Forget what is in flight and wait a little; everything is asked again."""
        self._in_flight.clear()
        self._window = 1
        for transfer in self._active.values():
            transfer.rewind()
        if self._failures == len(BACK_OFF_S):
            log.warning("A consumer does not answer, records wait", extra=kv(consumer=self._consumer, reason=reason))
        wait_s = BACK_OFF_S[min(self._failures, len(BACK_OFF_S) - 1)]
        self._failures += 1
        self._stop.wait(wait_s)
