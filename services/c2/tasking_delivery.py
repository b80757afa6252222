"""Comments and commands of the site on their way to vessels: conflicts, queues, delivery states."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from sonarpost.archive.journal import Accepted, JournalEntry
from sonarpost.delivery.records import OutboxItem, platform_of, queue_of
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import Transaction
from sonarpost.logs import kv
from sonarpost.messages import Command, Comment
from sonarpost.runtime.service import ServiceStoppingError, UnitOfWork
from sonarpost.services.c2 import tasking
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.tasking import Tasking

log = logging.getLogger(__name__)

COMMAND_PRIORITY = 1
COMMENT_PRIORITY = 2
CONSUMER = "relay"


class TaskingDelivery:
    """Queues records for vessels, and stores and publishes their states.

    Args:
        store: Store of c2; a state is committed with the delivery that it describes.
        archive: Archive of c2.
        publish: Publishes numbered records.

    Attributes:
        changed: Set when `publish_changed` has work.
    """

    def __init__(
        self,
        store: Store,
        archive: Archive,
        publish: Callable[[Sequence[tuple[JournalEntry, Accepted]]], None],
    ) -> None:
        self._store = store
        self._archive = archive
        self._publish = publish
        self.changed = threading.Event()
        self._names: set[str] = set()
        self._lock = threading.Lock()
        # Of the records that are handled and not committed yet.
        self._uncommitted: dict[str, bytes] = {}

    def forget(self) -> None:
        """Forget the records that are handled and not committed."""
        self._uncommitted.clear()

    def is_known(self, vessel: str, key: str, record: Comment | Command) -> bool:
        """Return whether a record was accepted before.

        Raises:
            PayloadError: A different one with this identifier was.
        """
        kind, record_id = tasking.kind_and_id(record)
        name = tasking.state_name(vessel, kind, record_id)
        known = self._uncommitted.get(name) or self._store.get_state(name)
        if known is not None:
            tasking.reject_conflict(Tasking.unpack(known), record, key)
            return True
        return _is_foreign(vessel, key, record, self._archive.index().foreign_tasking(vessel, kind, record_id))

    def send(self, vessel: str, key: str, record: Comment | Command, effects: UnitOfWork) -> None:
        """Queue a record for a vessel, unless it was accepted before.

        Raises:
            PayloadError: A different one with this identifier was.
        """
        payload = effects.payload
        kind, record_id = tasking.kind_and_id(record)
        item = Tasking(vessel, kind, payload, changed_utc_s=time.time())
        # Another c2 can have accepted it at the same time.
        if self.is_known(vessel, key, record) or _is_foreign(
            vessel, key, record, self._archive.index().claim_tasking(item.row(), payload)
        ):
            effects.count("tasking_repeated")
            return
        priority = COMMENT_PRIORITY if isinstance(record, Comment) else COMMAND_PRIORITY
        # One queue for each vessel: an unreachable vessel does not delay the others.
        effects.send_payload(item.key, queue_of(CONSUMER, vessel), payload, type(record), priority=priority)
        packed = item.pack()
        effects.put_state(item.name, packed)
        self._uncommitted[item.name] = packed
        effects.count("tasking_accepted")
        self._mark_changed(item.name)
        log.info("Record queued for a vessel", extra=kv(vessel=vessel, kind=kind, record_id=record_id))

    def acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Store that a vessel has accepted a record, or why it has refused it."""
        was = tasking.of_payload(platform_of(item.queue), item.key, item.payload)
        now = replace(
            was, state="delivered" if reason is None else "refused", reason=reason or "", changed_utc_s=time.time()
        )
        tx.put_state(now.name, now.pack())
        self._mark_changed(now.name)

    def _mark_changed(self, name: str) -> None:
        with self._lock:
            self._names.add(name)
        self.changed.set()

    def mark_all_changed(self) -> None:
        """Let `publish_changed` publish all states."""
        # Outside the lock: a transaction, for which the store waits, can wait for it in `_mark_changed`.
        names = self._store.state_names(tasking.PREFIX)
        with self._lock:
            self._names.update(names)

    def publish_changed(self) -> None:
        """Index and publish the changed states that are committed.

        Raises:
            ServiceStoppingError: The session was closed.
            OSError, DeliveryError: Some could not be stored; the next call tries them again.
        """
        # Cleared before the states are read: later changes are published again.
        with self._lock:
            names, self._names = self._names, set()
        fault: Exception | None = None
        try:
            for name in sorted(names):
                item = self._store.read_state(name, Tasking.unpack, None)
                if item is None:
                    continue  # not committed yet, or it could not be read
                try:
                    self._publish([self._archive.store_state(item)])
                except ServiceStoppingError:
                    raise
                except Exception as error:  # noqa: BLE001 - the others are published
                    fault = error
                else:
                    names.discard(name)
        finally:
            with self._lock:
                self._names |= names
        if fault is not None:
            raise fault


def _is_foreign(vessel: str, key: str, record: Comment | Command, payload: bytes | None) -> bool:
    """Return whether another c2 has a record.

    Args:
        vessel: Its vessel.
        key: Its key, for errors.
        record: The record.
        payload: What the other c2 has under this identifier; empty if unknown, None if there is none.

    Raises:
        PayloadError: It is a different record.
    """
    if payload:
        tasking.reject_conflict(Tasking(vessel, tasking.kind_and_id(record)[0], payload), record, key)
    return payload is not None
