"""The producer's side of the durable hand-off: publish for watchers, then hand over until acknowledged."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import zenoh

from sonarpost.delivery.queue_policy import PRIORITIES, REPLY_TIMEOUT_S, OnAcknowledged, QueuePolicy
from sonarpost.delivery.scheduler import PROBE_WINDOW, WINDOW
from sonarpost.delivery.sender import BACK_OFF_S, QueueSender
from sonarpost.delivery.store import Store
from sonarpost.errors import DeliveryError
from sonarpost.logs import kv

__all__ = ["BACK_OFF_S", "PRIORITIES", "PROBE_WINDOW", "REPLY_TIMEOUT_S", "WINDOW", "Outbox", "QueuePolicy"]

log = logging.getLogger(__name__)


class Outbox:
    """Hands every record of a store's outbox to its consumer, one thread a queue: none holds another back.

    Args:
        session: Of the platform's router.
        store: Whose outbox this is.
        queue_policy: Tells how a queue is sent; by default all are published and sent as fast as they are taken.
        on_acknowledged: Called in the transaction that forgets a record its consumer has taken or refused.
    """

    def __init__(
        self,
        session: zenoh.Session,
        store: Store,
        *,
        queue_policy: Callable[[str], QueuePolicy] | None = None,
        on_acknowledged: OnAcknowledged | None = None,
    ) -> None:
        self._session = session
        self._store = store
        self._queue_policy = queue_policy or (lambda _: QueuePolicy())
        self._on_acknowledged = on_acknowledged
        self._stop = threading.Event()
        self._wake = threading.Event()
        self._senders: dict[str, QueueSender] = {}
        self._held: set[str] = set()
        store.listen_outbox(self._wake)
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """Start a sender for each queue as it first appears."""
        self._wake.set()
        while not self._stop.is_set():
            self._wake.wait()
            self._wake.clear()
            try:
                queues = self._store.consumers()
            except DeliveryError:
                log.exception("The outbox cannot be read, trying again")
                self._stop.wait(1.0)
                self._wake.set()
                continue
            for queue in queues:
                if queue not in self._senders and queue not in self._held and not self._stop.is_set():
                    self._open(queue)

    def _open(self, queue: str) -> None:
        policy = self._queue_policy(queue)
        if policy.held:
            self._held.add(queue)
            log.warning("Records wait for a consumer that is not configured", extra=kv(consumer=queue))
            return
        self._senders[queue] = QueueSender(self._session, self._store, queue, policy, self._on_acknowledged)

    def is_responding(self, queue: str) -> bool:
        """Tell whether a queue's consumer answered what it was asked last; False where nothing was asked yet."""
        sender = self._senders.get(queue)
        return sender is not None and sender.is_responding

    @property
    def rejected(self) -> int:
        """How many records consumers have refused in this run."""
        return sum(sender.rejected for sender in tuple(self._senders.values()))

    @property
    def delivered(self) -> int:
        """How many records consumers have acknowledged in this run."""
        return sum(sender.delivered for sender in tuple(self._senders.values()))

    def acknowledged_count(self, queue: str) -> int:
        """How many records one queue's consumer has acknowledged in this run."""
        sender = self._senders.get(queue)
        return 0 if sender is None else sender.delivered

    def close(self) -> None:
        """Stop handing over; what is not acknowledged stays in the store."""
        self._stop.set()
        self._wake.set()
        self._thread.join()
        self._store.unlisten_outbox(self._wake)
        for sender in self._senders.values():
            sender.close()
