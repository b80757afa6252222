"""One queue of an outbox on its way to its consumer: asks, reads the answers, forgets what is acknowledged."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import zenoh

from sonarpost.delivery import batch_protocol as handoff_batch
from sonarpost.delivery import queue_policy as lane
from sonarpost.delivery.protocol import AckReply
from sonarpost.delivery.queue_policy import OnAcknowledged, QueuePolicy
from sonarpost.delivery.scheduler import MAX_WINDOW_BYTES, WINDOW, Chunk, DeliveryScheduler, RecordTransfer
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import OutboxItem
from sonarpost.errors import DeliveryError, PayloadError
from sonarpost.logs import kv
from sonarpost.monitoring.log_context import context_of_payload

log = logging.getLogger(__name__)

BACK_OFF_S = (0.05, 0.1, 0.2, 0.5, 1.0)
IDLE_S = 1.0
# Replies come in batches, one write to the consumer's disk apart: looked for soon at first, then less often.
POLL_S = (0.0005, 0.02)
FORGET_AT = 512
LOADED_BYTES = 2 * MAX_WINDOW_BYTES
"""Most bytes of records that are held ready beyond the first 128."""
FORGET_AFTER_S = 0.2


@dataclass(frozen=True, slots=True)
class _Asked:
    pieces: Sequence[Chunk]
    replies: zenoh.handlers.Handler[zenoh.Reply]


class _NoAnswerError(Exception):
    """The consumer is not there, or the link is down."""


class QueueSender:
    """Hands one queue over, with a few queries in flight, most urgent record first.

    Attributes:
        answering: Whether the consumer answered what it was asked last.
        rejected: How many records the consumer has refused in this run.
        delivered: How many it has acknowledged in this run.
    """

    def __init__(
        self, session: zenoh.Session, store: Store, queue: str, how: QueuePolicy, settled: OnAcknowledged | None
    ) -> None:
        self.is_responding = False
        self.rejected = 0
        self.delivered = 0
        self._default_session = session
        self._store = store
        self._queue = queue
        self._origin = store.origin_of(queue)
        self._lane = how
        self._on_settled = settled
        self._schedule = DeliveryScheduler(how.bytes_per_s, time.monotonic())
        self._shown: set[int] = set()
        self._in_flight: deque[_Asked] = deque()
        self._acknowledged: dict[int, OutboxItem] = {}
        self._first_acknowledged_s = 0.0
        self._settled_upto = 0
        self._failures = 0
        self._takes = 0
        self._one_by_one = False
        self._stop = threading.Event()
        self._wake = threading.Event()
        self._wake.set()
        store.listen_outbox(self._wake)
        self._thread = threading.Thread(target=self._run, name=f"outbox-{queue}", daemon=True)
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
                self._step()
            except (_NoAnswerError, DeliveryError, zenoh.ZError) as error:
                self._back_off(str(error))
        try:
            self._forget()
        except DeliveryError as error:
            log.debug("Acknowledged records are asked again after the next start: %s", error)

    def _step(self) -> None:
        """Ask what may be asked, act on the replies that are there, and wait where there is nothing else to do."""
        self._load()
        wait_s = self._ask_all()
        if self._act_on_replies():
            return
        forget_now = self._acknowledged and (
            not self._in_flight or time.monotonic() - self._first_acknowledged_s > FORGET_AFTER_S
        )
        if forget_now:
            self._forget()
            return
        if self._in_flight:
            self._wait_for_reply(IDLE_S if wait_s is None else wait_s)
        else:
            self._wake.wait(IDLE_S if wait_s is None else wait_s)

    def _load(self) -> None:
        """Look which records are most urgent, when there are new ones or few are left."""
        schedule = self._schedule
        if not self._wake.is_set() and len(schedule.active) > schedule.looks_at // 2:
            return
        if len(self._acknowledged) >= FORGET_AT:
            self._forget()
        self._wake.clear()
        numbers = self._store.owed_numbers(self._queue, schedule.looks_at + len(self._acknowledged))
        known, loaded = self._items([seq for seq in numbers if seq not in self._acknowledged][: schedule.looks_at])
        schedule.put([*known, *loaded])
        self._settled_upto = self._store.settled_upto(self._queue)
        session = self._session()
        if session is not None:
            for item in loaded:
                self._show(session, item)

    def _items(self, wanted: Sequence[int]) -> tuple[list[OutboxItem], list[OutboxItem]]:
        """Return records, known ones and such as are read now; of large ones fewer, not to hold them all in memory."""
        active = self._schedule.active
        known: list[OutboxItem] = []
        loaded: list[OutboxItem] = []
        for first in range(0, len(wanted), WINDOW):
            some = wanted[first : first + WINDOW]
            known += [active[seq].item for seq in some if seq in active]
            loaded += self._store.owed_items(self._queue, [seq for seq in some if seq not in active])
            total = sum(len(item.payload) for item in known) + sum(len(item.payload) for item in loaded)
            if total > LOADED_BYTES:
                break
        return known, loaded

    def _session(self) -> zenoh.Session | None:
        return self._default_session if self._lane.session is None else self._lane.session()

    def _ask_all(self) -> float | None:
        """Put queries in flight while there is room; return how long the bandwidth limit makes the next one wait."""
        while not self._stop.is_set():
            piece, wait_s = self._schedule.next_piece(time.monotonic())
            if piece is None:
                return wait_s
            pieces = self._begun(self._schedule.together_with(piece))
            if pieces:
                self._ask(pieces)
        return None

    def _begun(self, pieces: Sequence[Chunk]) -> list[Chunk]:
        """Let no newer edition take the place of these records any more; leave out those where one already has."""
        new = [piece.transfer.item.seq for piece in pieces if not piece.transfer.begun]
        there = self._store.begin_all(self._queue, new) if new else ()
        begun = []
        for piece in pieces:
            if piece.transfer.begun or piece.transfer.item.seq in there:
                piece.transfer.begun = True  # so that it is taken back if the query does not get away
                begun.append(piece)
            else:
                self._schedule.settled(piece.transfer)
        return begun

    def _ask(self, pieces: Sequence[Chunk]) -> None:
        session = self._session()
        if session is None:
            raise _NoAnswerError("its router has not been reached yet")
        items = [piece.transfer.item for piece in pieces]
        for item in items:
            self._show(session, item)
        settled = min(self._settled_upto, *(item.seq - 1 for item in items))
        replies = lane.ask(session, self._origin, pieces, settled)
        self._schedule.asked(pieces[0], time.monotonic(), *pieces[1:])
        self._in_flight.append(_Asked(pieces, replies))

    def _show(self, session: zenoh.Session, item: OutboxItem) -> None:
        """Publish a copy for watchers; they know it by (origin, seq) when it comes twice."""
        if not self._lane.publish or item.seq in self._shown:
            return
        self._shown.add(item.seq)
        lane.show(session, self._origin, item)

    def _act_on_replies(self) -> bool:
        """Act on every reply that is there, oldest query first; tell whether there was one."""
        some = False
        while self._in_flight:
            received = self._received(self._in_flight[0])
            if received is None:
                break
            asked = self._in_flight.popleft()
            self._schedule.answered(asked.pieces[0], time.monotonic())
            self._act(asked.pieces, received)
            some = True
        return some

    def _received(self, asked: _Asked) -> zenoh.Reply | None:
        try:
            return asked.replies.try_recv()
        except zenoh.ZError as error:
            raise _NoAnswerError("nobody answers") from error

    def _wait_for_reply(self, longest_s: float) -> None:
        """Wait for the oldest query's reply, for a new record, or for what the bandwidth limit allows next."""
        ends_s = time.monotonic() + longest_s
        poll_s = POLL_S[0]
        while not self._wake.is_set() and not self._stop.is_set():
            if self._act_on_replies() or time.monotonic() >= ends_s:
                return
            self._wake.wait(min(poll_s, max(ends_s - time.monotonic(), 0.0)))
            poll_s = min(2 * poll_s, POLL_S[1])

    def _act(self, pieces: Sequence[Chunk], received: zenoh.Reply) -> None:
        if received.ok is None:
            raise _NoAnswerError("no reply in time")
        replies = self._replies(pieces, received.ok.payload.to_bytes())
        for piece, reply in zip(pieces, replies, strict=True):
            if reply.status != "later":
                self._act_on(piece, reply)
        for reply in replies:
            if reply.status == "later":
                raise _NoAnswerError(f"the consumer cannot store: {reply.reason}")

    def _replies(self, pieces: Sequence[Chunk], payload: bytes) -> Sequence[AckReply]:
        where = pieces[0].transfer.item.key
        try:
            if len(pieces) == 1:
                reply = AckReply.unpack(payload, where)
                self._takes = reply.takes
                return [reply]
            replies = handoff_batch.unpack_replies(payload, len(pieces), where)
        except PayloadError as error:
            raise _NoAnswerError(str(error)) from error
        if isinstance(replies, AckReply):
            if replies.status != "later":
                # Another consumer than the one that said it takes several: each is asked by itself.
                self._one_by_one = True
            raise _NoAnswerError(f"several records were not taken: {replies.status} {replies.reason}")
        return replies

    def _act_on(self, piece: Chunk, reply: AckReply) -> None:
        transfer = piece.transfer
        self._failures = 0
        self.is_responding = True
        self._schedule.probing = False
        self._schedule.takes = 0 if self._one_by_one else self._takes
        if transfer.item.seq not in self._schedule.active:
            return
        if reply.status == "stored":
            self._stored(transfer)
        elif reply.status == "refused":
            self._refused(transfer, reply.reason)
        elif reply.next_offset >= len(transfer.item.payload):
            raise _NoAnswerError(f"a wrong reply: more from {reply.next_offset} of {len(transfer.item.payload)} bytes")
        else:
            self._schedule.go_on_from(piece, reply.next_offset)

    def _stored(self, transfer: RecordTransfer) -> None:
        if not self._acknowledged:
            self._first_acknowledged_s = time.monotonic()
        self._acknowledged[transfer.item.seq] = transfer.item
        self._schedule.settled(transfer)
        self.delivered += 1

    def _refused(self, transfer: RecordTransfer, reason: str) -> None:
        item = transfer.item
        with self._store.transaction() as tx:
            tx.rejected(item, reason)
            if self._on_settled is not None:
                self._on_settled(tx, item, reason)
        about = context_of_payload(item.payload, item.key)
        log.error(
            "A record was refused and is kept apart",
            extra=kv(**about, consumer=self._queue, key=item.key, reason=reason),
        )
        self.rejected += 1
        self._schedule.settled(transfer)
        self._end(item.seq)

    def _forget(self) -> None:
        """Forget acknowledged records, many with one write; late or never is harmless, the consumer knows them."""
        if not self._acknowledged:
            return
        with self._store.transaction() as tx:
            tx.all_acknowledged(self._queue, self._acknowledged)
            if self._on_settled is not None:
                for item in self._acknowledged.values():
                    self._on_settled(tx, item, None)
        self._end(*self._acknowledged)
        self._acknowledged.clear()

    def _end(self, *numbers: int) -> None:
        self._shown.difference_update(numbers)
        self._store.end(self._queue, *numbers)

    def _back_off(self, reason: str) -> None:
        """Forget what is in flight and wait a little; everything is asked again."""
        self.is_responding = False
        self._in_flight.clear()
        self._schedule.start_again()
        for transfer in self._schedule.active.values():
            if transfer.begun and transfer.has == 0:
                # Nobody is known to have anything of it: a newer edition may take its place again.
                transfer.begun = False
                self._store.end(self._queue, transfer.item.seq)
        if self._failures == len(BACK_OFF_S):
            log.warning("A consumer does not answer, records wait", extra=kv(consumer=self._queue, reason=reason))
        wait_s = BACK_OFF_S[min(self._failures, len(BACK_OFF_S) - 1)]
        self._failures += 1
        self._stop.wait(wait_s)
