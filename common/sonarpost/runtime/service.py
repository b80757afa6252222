"""The base of every service: a process that takes records, handles each once, and owes what follows from them.

A service names the records it consumes in `consumes()` and handles each in `handle()`, which returns nothing but
writes what follows into an `UnitOfWork`: records to send on and state to keep. The base commits these together with the
record's removal from the inbox. A service with other sources (a folder, a modem) starts them in `on_start()` and
commits with `self.store.transaction()`.
"""

from __future__ import annotations

import logging
import os
import shutil
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import zenoh

from sonarpost import keys, wire
from sonarpost.bus.session import open_with_retry
from sonarpost.bus.tls import TlsMonitor
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery.disk_reserve import HANDLING_RESERVE_BYTES, DiskReserve
from sonarpost.delivery.inbox import Inbox
from sonarpost.delivery.outbox import Outbox, QueuePolicy
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import InboxItem, OutboxItem, Transaction
from sonarpost.delivery.unit_of_work import UnitOfWork
from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.logs import kv, lazy_log_context
from sonarpost.messages import Health, Record, ServiceState
from sonarpost.monitoring.heartbeat import Heartbeat
from sonarpost.monitoring.log_context import LogContext

__all__ = ["Service", "ServiceStoppingError", "UnitOfWork"]

log = logging.getLogger(__name__)

C = TypeVar("C", bound=ServiceConfig)

RETRY_AFTER_S = 1.0
MAX_DETAIL = 2000
TYPES_KEPT = 1000
"""Of how many keys a service remembers what they carry."""


class ServiceStoppingError(Exception):
    """Raised by `Service.handle` when the service stops before the record is handled; it stays in the inbox."""


def disk_gauges(folder: Path) -> dict[str, float]:
    """Return how much is free on a folder's disk, nothing where that cannot be told at the moment."""
    try:
        return {"disk_free_bytes": float(shutil.disk_usage(folder).free)}
    except OSError as error:
        log.debug("Free space not told", extra=kv(folder=folder, error=str(error)))
        return {}


class Service(ABC, Generic[C]):
    """One process of the chain.

    Class attributes:
        NAME: Name in configurations, keys and hand-offs.
        PUBLISH: Whether records it owes are also published on their keys for watchers.
        BATCH: How many records are handled with one write to the disk. Above 1, what `handle` does outside its effects
            may be done again for a whole batch after a power cut.
        BATCH_BYTES: How many bytes of records at most, whatever their number; what is written lies in the write-ahead
            log once more until then.
    """

    NAME: ClassVar[str]
    PUBLISH: ClassVar[bool] = True
    BATCH: ClassVar[int] = 1
    BATCH_BYTES: ClassVar[int] = 2 * 1024 * 1024

    def __init__(self, platform: PlatformConfig, config: C) -> None:
        self.platform = platform
        self.config = config
        self.stopping = threading.Event()
        self.failed = False
        self._stopped = False
        self.started_utc_s = time.time()
        self._tls = TlsMonitor(platform.tls)
        self.store = Store(platform.state_dir / f"{self.NAME}.db")
        self._room = DiskReserve(self.store, HANDLING_RESERVE_BYTES, "records wait with their senders")
        self._counters: Counter[str] = Counter()
        self._counter_lock = threading.Lock()
        self._types: dict[str, type[Record]] = {}
        self._problem = ""
        self._session: zenoh.Session | None = None
        self._inbox: Inbox | None = None
        self._outbox: Outbox | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._threads: list[threading.Thread] = []
        self._heartbeat = Heartbeat.from_environment(os.environ, platform.state_dir, platform.health_interval_s)

    # What a service says of itself

    def consumes(self) -> Mapping[str, type[Record]]:
        """Return the key expressions this service takes records from, and what each carries."""
        return {}

    @abstractmethod
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Handle one record; called once a record, one at a time, in the order of arrival.

        Raises:
            BadInputError: The record cannot be handled, now or ever: it is kept apart, logged and counted.
            OSError, DeliveryError: It cannot be handled now (a full disk): it is tried again.
            ServiceStoppingError: The service is stopping; the record is handled after the next start.
        """

    def check(self, key: str, record: Record) -> None:
        """Refuse a record that came on `key` before it is accepted, by raising BadInputError; by default none is.

        Called within a transaction: it must not wait for a lock whose holder may begin one.
        """

    def admit(self, key: str) -> None:
        """Leave a record with its sender while there is no room for it, by raising NotNowError.

        By default while there is not even the room to handle what is here already. Called as `check` is.
        """
        self._room.need()

    def handed_only(self) -> Collection[str]:
        """Return those of the consumed key expressions on which plain publications are for somebody else."""
        return ()

    def lane(self, queue: str) -> QueuePolicy:
        """Return how a queue of the outbox is sent."""
        return QueuePolicy(publish=self.PUBLISH)

    def settled(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Act, within the transaction, on a record's consumer having taken it (None) or refused it for a reason."""

    def on_start(self) -> None:
        """Start the service's own sources; called when the session is open."""

    def on_stop(self) -> None:
        """Stop what `on_start` began, within a second."""

    def gauges(self) -> Mapping[str, float]:
        """Return momentary values for the health record."""
        return {}

    def trouble(self) -> str:
        """Return what keeps the service from working at this moment, for the health record; empty when nothing."""
        return ""

    def remark(self) -> str:
        """Return what people should know of while the service does its work, for the health record."""
        return ""

    # Life

    @property
    def session(self) -> zenoh.Session:
        """The open Zenoh session."""
        assert self._session is not None
        return self._session

    def start(self) -> bool:
        """Open the session and begin; False when stopped before a router was reached."""
        endpoints = self.platform.router
        self._session = open_with_retry(endpoints, self.stopping, self.platform.tls)
        if self._session is None:
            return False
        self._token = self._session.liveliness().declare_token(keys.alive(self.platform.id, self.NAME))
        self._outbox = Outbox(self._session, self.store, lane=self.lane, settled=self.settled)
        wanted = self.consumes()
        if wanted:
            self._inbox = Inbox(
                self._session,
                self.store,
                self.NAME,
                tuple(wanted),
                self._check_payload,
                self._refused,
                admit=self.admit,
                handed_only=self.handed_only(),
            )
            self.spawn(self._work, "work")
        self.on_start()
        self.spawn(self._report, "health")
        log.info("Service started", extra=kv(platform=self.platform.id, router=", ".join(endpoints)))
        return True

    def stop(self) -> None:
        """Stop everything and close the session; what is not finished is in the store. A second call does nothing."""
        if self._stopped:
            return
        self._stopped = True
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
            self._session.close()
        self.store.close()
        log.info("Service stopped")

    def spawn(self, target: Callable[[], None], name: str) -> None:
        """Run `target` in a thread that `stop` waits for; a defect in it ends the service instead of maiming it."""

        def guarded() -> None:
            try:
                target()
            except Exception:
                log.exception("Defect in a thread, the service ends", extra=kv(thread=name))
                self.failed = True
                self.stopping.set()

        thread = threading.Thread(target=guarded, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    # Records

    def _record_type(self, key: str) -> type[Record]:
        known = self._types.get(key)
        if known is None:
            known = self._types[key] = self._find_type(key)
            if len(self._types) > TYPES_KEPT:
                self._types.pop(next(iter(self._types)))
        return known

    def _find_type(self, key: str) -> type[Record]:
        for expression, record_type in self.consumes().items():
            if zenoh.KeyExpr(expression).intersects(key):
                return record_type
        raise BadInputError(key, "", key, "a key this service consumes: " + ", ".join(self.consumes()))

    def _check_payload(self, key: str, payload: bytes) -> None:
        self.check(key, wire.decode(self._record_type(key), payload, key))

    def _refused(self, error: BadInputError) -> None:
        self.count("records_refused")
        log.error("Record refused", extra=kv(key=error.where, field=error.field, reason=str(error)))

    def _work(self) -> None:
        while not self.stopping.is_set():
            self.store.inbox_changed.clear()
            try:
                items = self.store.pending(max(16, self.BATCH), max_bytes=self.BATCH_BYTES)
                for first in range(0, len(items), self.BATCH):
                    if self.stopping.is_set():
                        return
                    self._handle_batch(items[first : first + self.BATCH])
            except (OSError, DeliveryError) as error:
                self.problem(f"{type(error).__name__}: {error}")
                self.stopping.wait(RETRY_AFTER_S)
                continue
            except ServiceStoppingError:
                return
            self.problem("")
            if not items:
                self.store.inbox_changed.wait(1.0)

    def _handle_batch(self, items: Sequence[InboxItem]) -> None:
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
            # What comes before a record that has to wait is done with.
            if handled:
                self.commit_all(handled)

    def _handle_item(self, item: InboxItem) -> None:
        effects = self._effects_of(item)
        if effects is not None:
            self.commit(effects, item)

    def _effects_of(self, item: InboxItem) -> UnitOfWork | None:
        """Handle a record; return what follows, None where it cannot be handled and is kept apart.

        Every line that is logged meanwhile says which contact it concerns.
        """
        about = LogContext(item.payload, item.key)
        with lazy_log_context(about.fields):
            return self._handled(item, about)

    def _handled(self, item: InboxItem, about: LogContext) -> UnitOfWork | None:
        effects = UnitOfWork(item.payload)
        try:
            about.record = record = wire.decode(self._record_type(item.key), item.payload, item.key)
            self.handle(item.key, record, effects)
        except (OSError, DeliveryError, ServiceStoppingError):
            raise
        except BadInputError as error:
            self._refused(error)
            self._keep_apart(item, str(error))
            return None
        except Exception as error:
            # A defect of ours must not stop the records behind this one, and must not lose this one either.
            log.exception("Record not handled, it is kept apart", extra=kv(key=item.key))
            self.count("records_failed")
            self._keep_apart(item, f"{type(error).__name__}: {error}")
            return None
        effects.count("records_handled")
        return effects

    def _keep_apart(self, item: InboxItem, reason: str) -> None:
        with self.store.transaction() as tx:
            tx.refuse("in", item.key, item.payload, reason)
            tx.done(item)

    def commit(self, effects: UnitOfWork, item: InboxItem | None = None) -> None:
        """Write effects, and the end of the record they come from, in one transaction."""
        self.commit_all([(effects, item)])

    def commit_all(self, handled: Sequence[tuple[UnitOfWork, InboxItem | None]]) -> int:
        """Write the effects of several records, and the ends of these, in one transaction.

        Returns:
            How many records in the outbox were dropped for newer editions.
        """
        with self.store.transaction() as tx:
            for effects, item in handled:
                effects.write(tx)
                if item is not None:
                    tx.done(item)
        with self._counter_lock:
            for effects, _ in handled:
                for name, by in effects.counts.items():
                    self._counters[name] += by
        return tx.superseded

    def answering(self, queue: str) -> bool:
        """Tell whether the consumer of a queue answered what it was asked last."""
        return self._outbox is not None and self._outbox.answering(queue)

    def delivered_to(self, queue: str) -> int:
        """Return how many records the consumer of a queue has acknowledged in this run."""
        return 0 if self._outbox is None else self._outbox.delivered_to(queue)

    # Health

    def count(self, name: str, by: int = 1) -> None:
        """Add to a health counter."""
        with self._counter_lock:
            self._counters[name] += by

    def problem(self, detail: str) -> None:
        """Say in health and log that the service is degraded, or with an empty text that it is well again."""
        if detail == self._problem:
            return
        if detail:
            log.error("Service degraded", extra=kv(reason=detail))
        else:
            log.info("Service well again")
        self._problem = detail

    def health(self, state: ServiceState | None = None) -> Health:
        """Return the service's state now."""
        detail = self._problem
        if self._inbox is not None and self._inbox.in_trouble:
            detail = detail or "records cannot be stored"
        now_utc_s = time.time()
        detail = detail or self._room.trouble() or self.trouble() or self._tls.trouble(now_utc_s)
        remarks = (self.remark(), self._tls.remark(now_utc_s))
        with self._counter_lock:
            counters = dict(self._counters)
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
            detail="; ".join(text for text in (detail, *remarks) if text)[:MAX_DETAIL],
            counters=counters,
            gauges=gauges,
        )

    def _report(self) -> None:
        while not self.stopping.wait(self.platform.health_interval_s):
            self._publish_health(None)

    def _publish_health(self, state: ServiceState | None) -> None:
        try:
            record = self.health(state)
            # Before the network is asked to take anything: a router that hangs does not make this service ill.
            self._heartbeat.beat(record, time.monotonic())
            key = keys.health(self.platform.id, self.NAME)
            self.session.put(key, wire.encode(record), encoding=wire.encoding_of(Health))
        except (DeliveryError, zenoh.ZError) as error:
            log.warning("Health not published", extra=kv(error=str(error)))
