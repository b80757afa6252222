"""Base class of every service: a process that receives records, handles each exactly once and queues new records.

A service lists the records that it receives in `consumed_keys()` and handles each in `handle()`. That method adds
outgoing records and state changes to a `UnitOfWork`. The base class commits them together with the removal of the
record from the inbox. A service with other inputs (a folder, a modem) starts them in `on_start()` and commits with
`self.store.transaction()`.
"""

from __future__ import annotations

import logging
import os
import shutil
import sqlite3
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Final, Generic, TypeVar

import zenoh

from sonarpost import keys, wire
from sonarpost.bus.session import lost_reason, open_with_retry
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery.inbox import Handle, Inbox
from sonarpost.delivery.outbox import Outbox, QueuePolicy
from sonarpost.delivery.records import InboxItem, OutboxItem
from sonarpost.delivery.store import HANDLING_RESERVE_BYTES, DiskReserve, Store
from sonarpost.delivery.transaction import Transaction, UnitOfWork
from sonarpost.errors import BadInputError, DeliveryError, can_concern_record
from sonarpost.limits import limit
from sonarpost.logs import IntervalLog, kv, log_context
from sonarpost.messages import Health, Record, ServiceState
from sonarpost.monitoring.heartbeat import Heartbeat
from sonarpost.monitoring.service_manager import ServiceManager
from sonarpost.security.tls_files import TlsMonitor

__all__ = ["Service", "ServiceStoppingError", "UnitOfWork"]

log = logging.getLogger(__name__)

C = TypeVar("C", bound=ServiceConfig)

RETRY_AFTER_S = 1.0
MAX_RETRY_FACTOR = 4
ALONE_AFTER: Final = limit(
    2, "failures", "isolation", "all services", "sender", "attempts of a failing batch", "its records one by one"
)
FAILURES_ALONE: Final = limit(
    3, "failures", "blame", "all services", "sender", "failures alone while others are handled", "it is quarantined"
)
MAX_DETAIL = 2000
MAX_CHECKED, MAX_CHECKED_BYTES = 2048, 4096
"""Maximum number and size of accepted records that are kept in memory to save the decoding in `handle`."""
TYPES_KEPT = 1000
"""Maximum number of keys in the cache of record types."""
MAX_REFUSAL_LOGS = 64
"""Maximum number of writers whose refused records are logged separately."""


class ServiceStoppingError(Exception):
    """Raised by `Service.handle` when the service stops before the record is handled; it stays in the inbox."""


def disk_gauges(folder: Path) -> dict[str, float]:
    """Return the free disk space of a folder as a gauge; an empty map if it cannot be determined."""
    try:
        return {"disk_free_bytes": float(shutil.disk_usage(folder).free)}
    except OSError as error:
        log.debug("Free disk space unknown", extra=kv(folder=folder, error=str(error)))
        return {}


class Service(ABC, Generic[C]):
    """One process of the chain.

    Class attributes:
        NAME: Name of the service in configuration files, key expressions and delivery queues.
        PUBLISH: Whether queued records are also published on their keys for subscribers.
        BATCH: Maximum number of records that are committed in one transaction. Above 1, a power cut can repeat the
            side effects of `handle` outside the `UnitOfWork` for a whole batch.
        MAX_AT_ONCE: Maximum number of records that are handled in the transaction that accepts them, while no earlier
            record waits; 0 if `handle` is slow, opens a transaction, or has effects outside the `UnitOfWork`, which
            stay if the transaction fails.
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
        self.started_utc_s = time.time()
        self._tls = TlsMonitor(platform.tls)
        self.store = Store(platform.state_dir / f"{self.NAME}.db", page_bytes=self.PAGE_BYTES)
        self._disk_reserve = DiskReserve(self.store, HANDLING_RESERVE_BYTES, "senders keep their records")
        self._counters: Counter[str] = Counter()
        self._counter_lock = threading.Lock()
        self._record_type = lru_cache(TYPES_KEPT)(self._find_record_type)
        self._degraded = self._router_failure = ""
        self._session: zenoh.Session | None = None
        self._inbox: Inbox[Record] | None = None
        self._outbox: Outbox | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._threads: list[threading.Thread] = []
        self._interval_logs: list[IntervalLog] = []
        self._refusal_logs: dict[str, IntervalLog] = {}
        self._failed_alone: dict[int, int] = {}
        self._handling_lock = threading.Lock()
        self._checked: dict[tuple[str, bytes], Record] = {}  # accepted records that are not handled yet
        self._heartbeat = Heartbeat.from_environment(os.environ, platform.state_dir, platform.health_interval_s)
        self._manager = ServiceManager.from_environment(os.environ, platform.health_interval_s)

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
        return QueuePolicy(publish=self.PUBLISH)

    def expand(self, tx: Transaction, key: str, payload: bytes, record: Record) -> bytes:
        """Return the payload to store for a valid record, in the transaction that accepts it; by default its own.

        Args:
            tx: The open transaction.
            key: Key of the record.
            payload: Its payload.
            record: The decoded record, or what `validate` has returned in its place.

        Raises:
            MissingBaseError: The record is a difference to a version that is not known; its producer sends the whole.
        """
        return payload

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
        self._manager.alive(f"waiting for the router {', '.join(endpoints)}")
        self._session = open_with_retry(endpoints, self.stopping, self.platform.tls, self._report_waiting)
        if self._session is None:
            return False
        self._router_failure = ""
        self._token = self._session.liveliness().declare_token(keys.alive(self.platform.id, self.NAME))
        self._outbox = Outbox(
            self._session, self.store, queue_policy=self.queue_policy, on_acknowledged=self._acknowledged
        )
        wanted = self.consumed_keys()
        if wanted:
            self._inbox = Inbox(
                self._session,
                self.store,
                self.NAME,
                tuple(wanted),
                self._check_payload,
                self._refused,
                expand=self.expand,
                check_capacity=self.check_capacity,
                delivery_only_keys=self.delivery_only_keys(),
                before_commit=self.before_accepting,
                accepting=self._accepting if self.MAX_AT_ONCE else None,
            )
            self.start_thread(self._work, "work")
        self.on_start()
        self.start_thread(self._report, "health")
        # Not joined: a probe of the router can take longer than a stop.
        threading.Thread(target=self._watch_router, name="router", daemon=True).start()
        self._manager.ready("started")
        log.info("Service started", extra=kv(platform=self.platform.id, router=", ".join(endpoints)))
        return True

    def stop(self) -> None:
        """Stop all threads, close the session and the store. A second call does nothing."""
        if self._stopped:
            return
        self._stopped = True
        self._manager.stopping()
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
        self._flush_interval_logs(stopping=True)
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

    def _find_record_type(self, key: str) -> type[Record]:
        for expression, record_type in self.consumed_keys().items():
            if zenoh.KeyExpr(expression).intersects(key):
                return record_type
        raise BadInputError(key, "", key, "a key this service consumes: " + ", ".join(self.consumed_keys()))

    def _check_payload(self, key: str, payload: bytes) -> Record:
        record = wire.decode(self._record_type(key), payload, key)
        record = self.validate(key, record) or record
        if len(self._checked) < MAX_CHECKED and len(payload) <= MAX_CHECKED_BYTES:
            self._checked[key, payload] = record
        return record

    def _refused(self, error: BadInputError) -> None:
        self.count("records_refused")
        self._refusal_log(error.where).log(key=error.where, field=error.field, reason=str(error))

    def _refusal_log(self, key: str) -> IntervalLog:
        """Return the log for refused records of one writer, so that one peer cannot hide the refusals of another."""
        writer = keys.writer_of(key)
        if writer not in self._refusal_logs and len(self._refusal_logs) >= MAX_REFUSAL_LOGS:
            writer = ""
        if writer not in self._refusal_logs:
            self._refusal_logs[writer] = self.interval_log(log, logging.ERROR, "Record refused")
        return self._refusal_logs[writer]

    def _work(self) -> None:
        failures = 0
        while True:
            self.store.inbox_changed.clear()
            if self.stopping.is_set():  # `stop` sets both, this one first
                return
            try:
                found = self._handle_in_batches() if failures < ALONE_AFTER else self._handle_each_alone(failures)
            except ServiceStoppingError:
                return
            except Exception as error:
                if not isinstance(error, (OSError, DeliveryError)):
                    log.exception("Records not handled after an unexpected exception; trying again")
                failures += 1
                self.set_degraded(f"{type(error).__name__}: {error}")
                self.stopping.wait(RETRY_AFTER_S * min(2 ** max(0, failures - ALONE_AFTER), MAX_RETRY_FACTOR))
                continue
            failures = 0
            self.set_degraded("")
            if not found:
                self._checked.clear()  # of records that were not accepted
                self.store.inbox_changed.wait()

    def _handle_in_batches(self) -> bool:
        items = self.store.inbox_items(max(16, self.BATCH), max_bytes=self.BATCH_BYTES)
        for first in range(0, len(items), self.BATCH):
            if self.stopping.is_set():
                raise ServiceStoppingError
            self._handle_batch(items[first : first + self.BATCH])
        return bool(items)

    def _handle_each_alone(self, failures: int) -> bool:
        """Handle records one by one, so that one that fails does not delay the others.

        A record is quarantined if it fails `FAILURES_ALONE` times while others are handled, with an error that is not
        one of the machine or the network.

        Args:
            failures: Number of rounds that failed. It increases the number of records, for the case that all of the
                first ones fail.

        Raises:
            Exception: A record has failed.
        """
        factor = 2 ** min(failures // 4, 4)
        items = self.store.inbox_items(factor * max(16, self.BATCH), max_bytes=factor * self.BATCH_BYTES)
        failed: list[tuple[InboxItem, Exception]] = []
        for item in items:
            if self.stopping.is_set():
                raise ServiceStoppingError
            try:
                self._handle_batch([item])
            except ServiceStoppingError:
                raise
            except Exception as error:  # noqa: BLE001  raised below
                failed.append((item, error))
        counted = self._failed_alone
        if len(failed) < len(items):
            counted = {each.id: counted.get(each.id, 0) + 1 for each, why in failed if can_concern_record(why)}
        for item, why in failed:
            if counted.get(item.id, 0) >= FAILURES_ALONE:
                log.error("Record quarantined: it fails while others are handled", extra=kv(key=item.key))
                self.count("records_failed")
                self._quarantine_record(item, f"{type(why).__name__}: {why}")
        self._failed_alone = {name: count for name, count in counted.items() if count < FAILURES_ALONE}
        if failed:
            raise failed[0][1]
        return bool(items)

    @contextmanager
    def handling(self, *, wait: bool = True) -> Iterator[bool]:
        """Hold the lock under which records are handled and committed; yield False if it is not free and not `wait`."""
        is_held = self._handling_lock.acquire(blocking=wait)
        try:
            yield is_held
        finally:
            if is_held:
                self._handling_lock.release()

    @contextmanager
    def _accepting(self) -> Iterator[tuple[Transaction, Handle]]:
        """Open a transaction that accepts records, and handles the first ones unless earlier ones wait."""
        handled: list[UnitOfWork] = []
        with self.handling(wait=False) as is_held:
            with self.store.transaction() as tx:
                limit = self.MAX_AT_ONCE if is_held and tx.is_inbox_empty() else 0

                def handle(key: str, payload: bytes) -> bool:
                    nonlocal limit
                    if len(handled) >= limit:
                        return False
                    try:
                        with log_context(payload):
                            handled.append(self._call_handle(key, payload))
                    except (DeliveryError, sqlite3.Error):
                        raise  # the transaction can have ended
                    except Exception as error:  # noqa: BLE001 - raised again when it is handled in its turn
                        # Later records do not overtake it.
                        log.debug("Record not handled when accepted", extra=kv(key=key, error=str(error)))
                        limit = 0
                    return bool(limit)

                yield tx, handle
                if handled:
                    self.before_commit()
                for effects in handled:
                    effects.write(tx)
            if is_held and not tx.wrote_inbox:
                self._checked.clear()  # of records that were not accepted
            if handled:
                try:
                    self.after_commit(handled, tx.superseded)
                except Exception:
                    # The records are accepted and handled: the inbox must not repeat them.
                    log.exception("Work after the commit of handled records failed")

    def _handle_batch(self, items: Sequence[InboxItem]) -> None:
        with self.handling():
            self._handle_locked(items)

    def _handle_locked(self, items: Sequence[InboxItem]) -> None:
        if self.BATCH == 1:
            for item in items:
                self._handle_item(item)
            return
        handled: list[tuple[UnitOfWork, InboxItem]] = []
        try:
            for item in items:
                effects = self._effects_of(item)
                if effects is not None:
                    handled.append((effects, item))
        finally:
            # Records before the one that has to be retried are complete.
            if handled:
                self.commit_batch(handled)

    def _handle_item(self, item: InboxItem) -> None:
        effects = self._effects_of(item)
        if effects is not None:
            self.commit(effects, item)

    def _effects_of(self, item: InboxItem) -> UnitOfWork | None:
        """Handle a record; return its effects, or None if it was quarantined."""
        with log_context(item.payload):
            try:
                return self._call_handle(item.key, item.payload)
            except (OSError, DeliveryError, MemoryError, ServiceStoppingError):
                raise
            except BadInputError as error:
                self._refused(error)
                self._quarantine_record(item, str(error))
                return None
            except Exception as error:
                # An unexpected exception must neither block later records nor lose this one.
                log.exception("Record quarantined after an unexpected exception", extra=kv(key=item.key))
                self.count("records_failed")
                self._quarantine_record(item, f"{type(error).__name__}: {error}")
                return None

    def _call_handle(self, key: str, payload: bytes) -> UnitOfWork:
        effects = UnitOfWork(payload)
        record = self._checked.pop((key, payload), None)
        if record is None:
            record = wire.decode(self._record_type(key), payload, key)
        self.handle(key, record, effects)
        effects.count("records_handled")
        return effects

    def _quarantine_record(self, item: InboxItem, reason: str) -> None:
        with self.store.transaction() as tx:
            tx.quarantine("in", item.key, item.payload, reason, is_accepted=True)
            tx.remove_handled(item)

    def commit(self, effects: UnitOfWork, item: InboxItem | None = None) -> None:
        """Write the effects and remove the record that caused them, in one transaction."""
        self.commit_batch([(effects, item)])

    def commit_batch(self, handled: Sequence[tuple[UnitOfWork, InboxItem | None]]) -> int:
        """Write the effects of several records and remove these records, in one transaction.

        Returns:
            Number of queued records that were replaced by newer editions.
        """
        self.before_commit()
        with self.store.transaction() as tx:
            for effects, item in handled:
                effects.write(tx)
                if item is not None:
                    tx.remove_handled(item)
        self.after_commit([effects for effects, _ in handled], tx.superseded)
        return tx.superseded

    def before_commit(self) -> None:
        """Do what has to precede the commit of handled records; by default nothing.

        Raises:
            OSError, DeliveryError: The records are handled again.
        """

    def after_commit(self, handled: Sequence[UnitOfWork], superseded: int) -> None:
        """Count what was committed; a subclass extends it.

        Args:
            handled: The committed units of work.
            superseded: Number of queued records that were replaced by newer editions.
        """
        with self._counter_lock:
            for effects in handled:
                for name, by in effects.counts.items():
                    self._counters[name] += by

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
        with self._counter_lock:
            self._counters[name] += by

    def interval_log(self, logger: logging.Logger, level: int, message: str) -> IntervalLog:
        """Return a log for a repeated event, at most one line a minute; the service also logs the end of a burst."""
        made = IntervalLog(logger, level, message)
        self._interval_logs.append(made)
        return made

    def _flush_interval_logs(self, *, stopping: bool = False) -> None:
        for interval_log in self._interval_logs:
            interval_log.flush(stopping=stopping)

    def set_degraded(self, reason: str) -> None:
        """Report the service as degraded in health and log; an empty reason reports it as recovered."""
        if reason == self._degraded:
            return
        if reason:
            log.error("Service degraded", extra=kv(reason=reason))
        else:
            log.info("Service recovered")
        self._degraded = reason

    def health(self, state: ServiceState | None = None) -> Health:
        """Return the health record of this moment."""
        detail = self._degraded
        if self._inbox is not None and self._inbox.storage_failing:
            # With the cause, for example a database that is not reached.
            detail = detail or "; ".join(filter(None, ("records cannot be stored", self.degraded_reason())))
        now_utc_s = time.time()
        detail = (
            detail
            or self._disk_reserve.degraded_reason()
            or self.degraded_reason()
            or self._lost_records()
            or self._discarded_states()
            or self._tls.degraded_reason(now_utc_s)
        )
        restored = "" if self._outbox is None else self._outbox.warning()
        router = f"router not reached: {self._router_failure}" if self._router_failure else ""
        warnings = (self.warning(), router, restored, self._tls.warning(now_utc_s))
        with self._counter_lock:
            counters = dict(self._counters)
        if discarded := self._discarded_count():
            counters["states_discarded"] = discarded
        gauges = {
            "inbox": float(self.store.inbox_depth()),
            "outbox": float(self.store.outbox_depth()),
            "refused": float(self.store.refused_count()),
            **disk_gauges(self.platform.state_dir),
            **self._tls.gauges(now_utc_s),
            **self.gauges(),
        }
        return Health(
            platform_id=self.platform.id,
            service=self.NAME,
            time_utc_s=time.time(),
            started_utc_s=self.started_utc_s,
            state=state or ("degraded" if detail else "ok"),
            detail="; ".join(text for text in (detail, *warnings) if text)[:MAX_DETAIL],
            counters=counters,
            gauges=gauges,
        )

    def _lost_records(self) -> str:
        if self.store.lost is None:
            return ""
        records = str(self.store.lost) or "none"
        return (
            f"commits of {self.store.path.name} are lost; records possibly lost: {records}; see `sonarpost store check`"
        )

    def _discarded_count(self) -> int:
        return self._counters["states_discarded"] + self.store.states_discarded

    def _discarded_states(self) -> str:
        count = self._discarded_count()
        return f"stored states discarded since the start: {count}; they are in the quarantine" if count else ""

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
        self._router_failure = reason
        self._publish_health("degraded")

    def _watch_router(self) -> None:
        while not self.stopping.wait(self.platform.health_interval_s):
            try:
                self._router_failure = lost_reason(self.session)
            except Exception:
                log.exception("Router not probed")

    def _report(self) -> None:
        while not self.stopping.wait(self.platform.health_interval_s):
            self._publish_health(None)
            self._flush_interval_logs()

    def _publish_health(self, state: ServiceState | None) -> None:
        try:
            record = self.health(state)
            # Before the publication, which can block: a router that hangs must not make this service unhealthy.
            self._heartbeat.beat(record, time.monotonic())
            self._manager.alive(f"{record.state}: {record.detail}" if record.detail else record.state)
            if self._session is not None:
                self.publish(keys.health(self.platform.id, self.NAME), record)
        except DeliveryError as error:
            self._manager.alive(f"health unknown: {error}")  # the process does not hang
            log.warning("Health not published", extra=kv(error=str(error)))
