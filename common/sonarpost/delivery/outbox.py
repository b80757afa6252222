"""Producer side of the delivery protocol: a sender for each queue of a store."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import zenoh

from sonarpost.delivery.queue_sender import OnAcknowledged, QueuePolicy, QueueSender
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
        store.add_outbox_listener(self._on_new)
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def _on_new(self, _place: Place) -> None:
        self._wake.set()

    def _run(self) -> None:
        """Start a sender for each queue when it first holds a record."""
        self._wake.set()
        while not self._stop.is_set():
            self._wake.wait()
            self._wake.clear()
            try:
                for queue in self._store.queues():
                    if queue not in self._senders and queue not in self._held and not self._stop.is_set():
                        self._open(queue)
            except Exception:
                log.exception("Outbox cannot be read; retrying")
                self._stop.wait(1.0)
                self._wake.set()

    def _open(self, queue: str) -> None:
        policy = self._queue_policy(queue)
        if policy.held:
            self._held.add(queue)
            log.warning("Records held for a consumer that is not configured", extra=kv(consumer=queue))
            return
        self._senders[queue] = QueueSender(self._session, self._store, queue, policy, self._on_acknowledged)

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
        queues = ", ".join(queue for queue, sender in tuple(self._senders.items()) if sender.restored)
        return f"{self._store.path.name} is older than its last delivery to {queues}" if queues else ""

    def close(self) -> None:
        """Stop sending; unacknowledged records stay in the store."""
        self._stop.set()
        self._wake.set()
        self._thread.join()
        self._store.remove_outbox_listener(self._on_new)
        for sender in self._senders.values():
            sender.close()
