"""Base class of every service: a process that receives records, handles each exactly once and queues new records.

A service lists the records that it receives in `consumed_keys()` and handles each in `handle()`. That method adds
outgoing records and state changes to a `UnitOfWork`. The base class commits them together with the removal of the
record from the inbox. A service with other inputs (a folder, a modem) starts them in `on_start()` and commits with
`self.store.transaction()`.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import ClassVar, Generic, TypeVar

import zenoh

from sonarpost import keys, wire
from sonarpost.bus.session import lost_reason, open_with_retry
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery.disk_reserve import HANDLING_RESERVE_BYTES, DiskReserve
from sonarpost.delivery.inbox import Inbox
from sonarpost.delivery.outbox import Outbox
from sonarpost.delivery.queue_sender import QueuePolicy
from sonarpost.delivery.records import OutboxItem, platform_of
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import Transaction, UnitOfWork
from sonarpost.errors import DeliveryError
from sonarpost.logs import IntervalLog, kv
from sonarpost.messages import Health, Record, ServiceState
from sonarpost.runtime.health import ServiceHealth
from sonarpost.runtime.record_handler import RecordHandler, ServiceStoppingError
from sonarpost.security.tls_files import TlsMonitor

__all__ = ["Service", "ServiceStoppingError", "UnitOfWork"]

log = logging.getLogger(__name__)

C = TypeVar("C", bound=ServiceConfig)


class Service(ABC, Generic[C]):
    """One process of the chain.

    Class attributes:
        NAME: Name of the service in configuration files, key expressions and delivery queues.
        PUBLISH: Whether queued records are also published on their keys for subscribers.
        BATCH: Maximum number of records that are committed in one transaction. Above 1, a power cut can repeat the
            side effects of `handle` outside the `UnitOfWork` for a whole batch.
        MAX_AT_ONCE: Maximum number of records that are handled in the transaction that accepts them, while no earlier
            record waits; 0 if `handle` opens a transaction, or must not be repeated because it has effects outside the
            `UnitOfWork`, which stay if the transaction fails. See `is_quick`.
        BATCH_BYTES: Maximum size of the records of one batch; it bounds the write-ahead log.
        PAGE_BYTES: Page size of the store; small pages for a service whose transactions change few bytes.
    """

    NAME: ClassVar[str]
    PUBLISH: ClassVar[bool] = True
    BATCH: ClassVar[int] = 1
    BATCH_BYTES: ClassVar[int] = 2 * 1024 * 1024
    PAGE_BYTES: ClassVar[int] = 4096
    MAX_AT_ONCE: ClassVar[int] = 0

    def __init__(self, platform: PlatformConfig, config: C) -> None:
        self.platform = platform
        self.config = config
        self.stopping = threading.Event()
        self.failed = False
        self._stopped = False
        tls = TlsMonitor(platform.tls)
        self.store = Store(platform.state_dir / f"{self.NAME}.db", page_bytes=self.PAGE_BYTES)
        self._disk_reserve = DiskReserve(self.store, HANDLING_RESERVE_BYTES, "senders keep their records")
        self._health = ServiceHealth(self, self._disk_reserve, tls)
        self._handler = RecordHandler(self, self._health)
        self._handling_lock = threading.Lock()
        self._session: zenoh.Session | None = None
        self._inbox: Inbox[Record] | None = None
        self._outbox: Outbox | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._threads: list[threading.Thread] = []

    # Hooks of a subclass

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Return the key expressions that this service consumes, with the record type of each."""
        return {}

    @abstractmethod
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Handle one record. Records are handled one at a time, in the order of arrival.

        A record that has failed twice is handled again after later ones.

        Args:
            key: Key on which the record arrived.
            record: The decoded record.
            effects: Collects the records to send and the state to change; committed by the caller.

        Raises:
            BadInputError: The record is invalid: it is quarantined, logged and counted.
            OSError, DeliveryError: A temporary failure, for example a full disk: the record is retried.
            ServiceStoppingError: The service is stopping; the record is handled after the next start.
        """

    def validate(self, key: str, record: Record) -> Record | None:
        """Check a record before it is accepted; the default accepts every record.

        Called inside a store transaction: it must not wait for a lock whose holder opens another one.

        Returns:
            What `handle` receives in place of the record, unless it reads it from the store; None for the record.

        Raises:
            BadInputError: The record is refused; its sender quarantines it.
        """

    def is_quick(self, record: Record) -> bool:
        """Return whether a record can be handled in the transaction that accepts it; by default every record.

        Its sender, and transactions of other threads, wait until it is handled, and so does the end of the service.
        """
        return True

    def check_capacity(self, key: str) -> None:
        """Check that a record on `key` can be stored; the default checks the disk reserve.

        Called inside a store transaction, as `validate` is.

        Raises:
            RetryLaterError: The record is not accepted now; its sender keeps it and retries.
        """
        self._disk_reserve.require()

    def before_accepting(self, records: Sequence[tuple[str, bytes]]) -> None:
        """Store records outside the service's own store before they are committed and acknowledged; by default nothing.

        Called inside a store transaction, as `validate` is. The records can be stored although they are not accepted
        afterwards; their senders repeat them.

        Args:
            records: Key and payload of each record.

        Raises:
            DeliveryError: No record is accepted now; the senders keep them and retry.
        """

    def delivery_only_keys(self) -> Collection[str]:
        """Return the consumed key expressions on which plain publications are ignored."""
        return ()

    def queue_policy(self, queue: str) -> QueuePolicy:
        """Return the settings with which an outbox queue is sent."""
        return QueuePolicy(publish=self.PUBLISH, is_local=not platform_of(queue))

    def expand(self, tx: Transaction, key: str, payload: bytes, record: Record) -> tuple[bytes, Record]:
        """Return the payload to store for a valid record, and what `handle` receives; by default the given ones.

        Called in the transaction that accepts the record.

        Args:
            tx: The open transaction.
            key: Key of the record.
            payload: Its payload.
            record: The decoded record, or what `validate` has returned in its place.

        Raises:
            MissingBaseError: The record is a difference to a version that is not known; its producer sends the whole.
        """
        return payload, record

    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> bool | None:
        """React to a consumer's acknowledgement, in the transaction that removes the record from the outbox.

        Args:
            tx: The open transaction.
            item: The record.
            reason: None if the consumer accepted the record, else its reason for refusing it.

        Returns:
            True if a refused record was replaced: it is removed without a copy in the quarantine.
        """
        return None

    def before_session(self) -> None:
        """Start what needs no router; called before the session opens, which can take any time."""

    def on_start(self) -> None:
        """Start the service's own inputs; called after the session has opened."""

    def on_stop(self) -> None:
        """Stop what `on_start` started, within one second."""

    def gauges(self) -> Mapping[str, float]:
        """Return current values for the health record."""
        return {}

    def degraded_reason(self) -> str:
        """Return why the service cannot work at present, for the health record; empty if it can."""
        return ""

    def warning(self) -> str:
        """Return a warning for the health record that does not make the service degraded; empty for none."""
        return ""

    # Start and stop

    @property
    def is_router_reached(self) -> bool:
        """Whether the session is open and connected to a router; a router that hangs counts for the lease of 3 s."""
        session = self._session
        return session is not None and not session.is_closed() and bool(session.info.routers_zid())

    @property
    def session(self) -> zenoh.Session:
        """The open Zenoh session."""
        assert self._session is not None
        return self._session

    def start(self) -> bool:
        """Open the session and start all threads; waits until a router is reached.

        Returns:
            False if the service was stopped before it reached a router.
        """
        endpoints = self.platform.router
        self.before_session()
        self._health.manager.alive(f"waiting for the router {', '.join(endpoints)}")
        self._session = open_with_retry(endpoints, self.stopping, self.platform.tls, self._report_waiting)
        if self._session is None:
            return False
        self._health.router_failure = ""
        self._token = self._session.liveliness().declare_token(keys.alive(self.platform.id, self.NAME))
        self._outbox = Outbox(
            self._session, self.store, queue_policy=self.queue_policy, on_acknowledged=self._acknowledged
        )
        self._health.outbox = self._outbox
        wanted = self.consumed_keys()
        if wanted:
            self._inbox = self._health.inbox = Inbox(
                self._session,
                self.store,
                self.NAME,
                tuple(wanted),
                self._handler.check,
                self._handler.refused,
                expand=self.expand,
                check_capacity=self.check_capacity,
                delivery_only_keys=self.delivery_only_keys(),
                before_commit=self.before_accepting,
                handle=self._handler.keep_decoded,
                accepting=self._handler.accepting if self.MAX_AT_ONCE else None,
            )
            self.start_thread(self._handler.run, "work")
        self.on_start()
        self.start_thread(self._report, "health")
        # Not joined: a probe of the router can take longer than a stop.
        threading.Thread(target=self._watch_router, name="router", daemon=True).start()
        self._health.manager.ready("started")
        log.info("Service started", extra=kv(platform=self.platform.id, router=", ".join(endpoints)))
        return True

    def stop(self) -> None:
        """Stop all threads, close the session and the store. A second call does nothing."""
        if self._stopped:
            return
        self._stopped = True
        self._health.manager.stopping()
        self.stopping.set()
        self.store.inbox_changed.set()
        if self._session is not None:
            self._publish_health("stopping")
            self.on_stop()
            for part in (self._inbox, self._outbox):
                if part is not None:
                    part.close()
        for thread in self._threads:
            thread.join(timeout=1.0)
        if self._session is not None:
            self._session.close()
        self.store.close()
        self._health.flush_logs(stopping=True)
        log.info("Service stopped")

    def start_thread(self, target: Callable[[], None], name: str) -> None:
        """Run `target` in a thread that `stop` joins. An unhandled exception in it stops the service."""

        def guarded() -> None:
            try:
                target()
            except Exception:
                log.exception("Unhandled exception in a thread; stopping the service", extra=kv(thread=name))
                self.failed = True
                self.stopping.set()

        thread = threading.Thread(target=guarded, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    # Records

    @contextmanager
    def handling(self, *, wait: bool = True) -> Iterator[bool]:
        """Hold the lock under which records are handled and committed; yield False if it is not free and not `wait`.

        A subclass that extends it encloses the handling and the commit of each batch.
        """
        is_held = self._handling_lock.acquire(blocking=wait)
        try:
            yield is_held
        finally:
            if is_held:
                self._handling_lock.release()

    def commit(self, effects: UnitOfWork) -> None:
        """Write a unit of work in a transaction of its own."""
        self.commit_batch([effects])

    def commit_batch(self, handled: Sequence[UnitOfWork]) -> None:
        """Write several units of work in one transaction."""
        self.before_commit()
        all_effects = [*handled, *self.further_effects()]
        with self.store.transaction() as tx:
            for effects in all_effects:
                effects.write(tx)
        self.after_commit(all_effects, tx.superseded)

    def before_commit(self) -> None:
        """Do what has to precede the commit of handled records; by default nothing.

        Raises:
            OSError, DeliveryError: The records are handled again.
        """

    def further_effects(self) -> Sequence[UnitOfWork]:
        """Return what is committed together with handled records; by default nothing."""
        return ()

    def after_commit(self, handled: Sequence[UnitOfWork], superseded: int) -> None:
        """Count what was committed; a subclass extends it.

        Args:
            handled: The committed units of work.
            superseded: Number of queued records that were replaced by newer editions.
        """
        self._health.count_committed(handled)

    def publish(self, key: str, record: Record) -> bool:
        """Publish a record for subscribers, without durable delivery; return whether Zenoh has taken it."""
        return self.publish_payload(key, wire.encode(record), wire.encoding_of(type(record)))

    def publish_payload(self, key: str, payload: bytes, encoding: str) -> bool:
        """Publish bytes as `publish` does."""
        try:
            self.session.put(key, payload, encoding=encoding)
        except zenoh.ZError as error:
            if not self.stopping.is_set():
                log.warning("Record not published", extra=kv(key=key, error=str(error)))
            return False
        return True

    def is_responding(self, queue: str) -> bool:
        """Return whether the consumer of a queue replied to the last request."""
        return self._outbox is not None and self._outbox.is_responding(queue)

    def acknowledged_count(self, queue: str) -> int:
        """Return the number of records that the consumer of a queue has acknowledged since the start."""
        return 0 if self._outbox is None else self._outbox.acknowledged_count(queue)

    def prefer_other_consumers(self, *, others: bool) -> None:
        """Leave new records to other services of the same name while there is one, or end that."""
        if self._inbox is not None and not self.session.is_closed():
            self._inbox.set_preferred(is_preferred=not others)

    # Health

    def count(self, name: str, by: int = 1) -> None:
        """Increase a health counter."""
        self._health.count(name, by)

    def interval_log(self, logger: logging.Logger, level: int, message: str) -> IntervalLog:
        """Return a log for a repeated event, at most one line a minute; the service also logs the end of a burst."""
        return self._health.interval_log(logger, level, message)

    def set_degraded(self, reason: str) -> None:
        """Report the service as degraded in health and log; an empty reason reports it as recovered."""
        self._health.set_degraded(reason)

    def health(self, state: ServiceState | None = None) -> Health:
        """Return the health record of this moment."""
        return self._health.record(state)

    def _acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> bool | None:
        """Call `on_acknowledged`; an unexpected exception about one record does not stop its queue."""
        try:
            return self.on_acknowledged(tx, item, reason)
        except (OSError, DeliveryError, sqlite3.Error):
            raise
        except Exception:
            log.exception("Acknowledgement not processed", extra=kv(key=item.key, consumer=item.queue))
            self.count("acknowledgements_failed")
            return None

    def _report_waiting(self, reason: str) -> None:
        self._health.router_failure = reason
        self._publish_health("degraded")

    def _watch_router(self) -> None:
        while not self.stopping.wait(self.platform.health_interval_s):
            try:
                self._health.router_failure = lost_reason(self.session)
            except Exception:
                log.exception("Router not probed")

    def _report(self) -> None:
        while not self.stopping.wait(self.platform.health_interval_s):
            self._publish_health()
            self._health.flush_logs()

    def _publish_health(self, state: ServiceState | None = None) -> None:
        # The supervisor is informed first: a router that hangs must not make this service unhealthy.
        record = self._health.report(state)
        if record is not None and self._session is not None:
            self.publish(keys.health(self.platform.id, self.NAME), record)
