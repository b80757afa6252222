"""Producer side of the delivery protocol: a sender for each queue of a store."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import zenoh

from sonarpost.delivery.queue_sender import FIRST_PLACE, OnAcknowledged, QueuePolicy, QueueSender
from sonarpost.delivery.records import Place
from sonarpost.delivery.store import Store
from sonarpost.logs import kv

log = logging.getLogger(__name__)


class Outbox:
    """Sends the outbox of a store to its consumers, with one thread for each queue.

    Args:
        session: Session on the platform's router.
        store: Store with the outbox.
        queue_policy: Returns the settings of a queue; by default records are published and sent without a limit.
        on_acknowledged: Called in the transaction that removes an accepted or refused record.

    Raises:
        DeliveryError: The store cannot be read.
    """

    def __init__(
        self,
        session: zenoh.Session,
        store: Store,
        *,
        queue_policy: Callable[[str], QueuePolicy] = lambda _: QueuePolicy(),
        on_acknowledged: OnAcknowledged = lambda _tx, _item, _reason: None,
    ) -> None:
        self._session = session
        self._store = store
        self._queue_policy = queue_policy
        self._on_acknowledged = on_acknowledged
        self._lock = threading.Lock()
        self._senders: dict[str, QueueSender | None] = {}  # None: the queue is held
        store.on_queued = self._on_queued
        for queue in store.queues():
            self._on_queued(queue, FIRST_PLACE)

    def _on_queued(self, queue: str, place: Place) -> None:
        """Start the sender of a queue when it first holds a record; pass the place of a new record to it."""
        try:
            with self._lock:
                if queue not in self._senders and self._store.on_queued is not None:
                    self._senders[queue] = self._new_sender(queue)
                sender = self._senders.get(queue)
        except Exception:
            # The record is committed. The next one of the queue starts its sender.
            log.exception("Sender not started", extra=kv(consumer=queue))
            return
        if sender is not None:
            sender.on_new(place)

    def _new_sender(self, queue: str) -> QueueSender | None:
        policy = self._queue_policy(queue)
        if policy.held:
            log.warning("Records held for a consumer that is not configured", extra=kv(consumer=queue))
            return None
        return QueueSender(self._session, self._store, queue, policy, self._on_acknowledged)

    def is_responding(self, queue: str) -> bool:
        """Return whether a queue's consumer replied to the last query; False before the first one."""
        sender = self._senders.get(queue)
        return sender is not None and sender.responding

    def acknowledged_count(self, queue: str) -> int:
        """Return the number of records that a queue's consumer has accepted since the start."""
        sender = self._senders.get(queue)
        return 0 if sender is None else sender.acknowledged_count

    def warning(self) -> str:
        """Return a warning if the store was restored from an older copy; empty if it was not."""
        queues = ", ".join(queue for queue, sender in tuple(self._senders.items()) if sender and sender.restored)
        return f"{self._store.path.name} is older than its last delivery to {queues}" if queues else ""

    def close(self) -> None:
        """Stop sending; unacknowledged records stay in the store."""
        with self._lock:
            self._store.on_queued = None  # no sender starts from now on
        for sender in self._senders.values():
            if sender is not None:
                sender.close()
