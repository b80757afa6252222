"""The base of every service: a process that takes records, handles each once, and owes what follows from them.

A service names the records it consumes in `consumes()` and handles each in `handle()`, which returns nothing but
writes what follows into an `Effects`: records to send on and state to keep. The base commits these together with the
record's removal from the inbox. A service with other sources (a folder, a modem) starts them in `on_start()` and
commits with `self.store.transaction()`.
"""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from typing import ClassVar, Generic, TypeVar

import zenoh

from sonarpost import keys, wire
from sonarpost.errors import BadInputError, HandoffError
from sonarpost.messages import Health, Record, ServiceState
from sonarpost.runtime.config import PlatformConfig, ServiceConfig
from sonarpost.runtime.inbox import Inbox
from sonarpost.runtime.logs import kv
from sonarpost.runtime.outbox import Outbox
from sonarpost.runtime.session import open_with_retry
from sonarpost.runtime.store import Store
from sonarpost.runtime.transaction import InboxItem, Transaction

log = logging.getLogger(__name__)

C = TypeVar("C", bound=ServiceConfig)

RETRY_AFTER_S = 1.0
MAX_DETAIL = 2000


class InterruptedByStopError(Exception):
    """Raised by `Service.handle` when the service stops before the record is handled; it stays in the inbox."""


class Effects:
    """What handling one record leads to; committed all together, or not at all.

    Attributes:
        payload: The record's bytes as they came, empty for effects that no record has led to.
    """

    def __init__(self, payload: bytes = b"") -> None:
        self.payload = payload
        self._sends: list[tuple[str, str, Record, int]] = []
        self._state: dict[str, bytes | None] = {}
        self._apart: list[tuple[str, bytes, str]] = []
        self._counts: Counter[str] = Counter()

    def send(self, key: str, consumer: str, record: Record, *, priority: int = 4) -> None:
        """Owe `record` to the service named `consumer`, published on `key`."""
        self._sends.append((key, consumer, record, priority))

    def put_state(self, name: str, value: bytes) -> None:
        """Remember `value` under `name`."""
        self._state[name] = value

    def delete_state(self, name: str) -> None:
        """Forget `name`."""
        self._state[name] = None

    def keep_apart(self, key: str, payload: bytes, reason: str) -> None:
        """Keep something that cannot be used, with the reason, in the store's `refused` table."""
        self._apart.append((key, payload, reason))

    def count(self, name: str, by: int = 1) -> None:
        """Add to a health counter once the effects are committed."""
        self._counts[name] += by

    def write(self, tx: Transaction) -> None:
        """Write everything into an open transaction."""
        for key, consumer, record, priority in self._sends:
            encoding = wire.encoding_of(type(record))
            tx.send(key, consumer, wire.encode(record), encoding=encoding, priority=priority)
        for name, value in self._state.items():
            if value is None:
                tx.delete_state(name)
            else:
                tx.put_state(name, value)
        for key, payload, reason in self._apart:
            tx.refuse("in", key, payload, reason)

    @property
    def counts(self) -> Mapping[str, int]:
        """What `count` was called with."""
        return self._counts


class Service(ABC, Generic[C]):
    """One process of the chain.

    Class attributes:
        NAME: Name in configurations, keys and hand-offs.
        PUBLISH: Whether records it owes are also published on their keys for watchers.
    """

    NAME: ClassVar[str]
    PUBLISH: ClassVar[bool] = True

    def __init__(self, platform: PlatformConfig, config: C) -> None:
        self.platform = platform
        self.config = config
        self.stopping = threading.Event()
        self.failed = False
        self._stopped = False
        self.started_utc_s = time.time()
        self.store = Store(platform.state_dir / f"{self.NAME}.db")
        self._counters: Counter[str] = Counter()
        self._counter_lock = threading.Lock()
        self._problem = ""
        self._session: zenoh.Session | None = None
        self._inbox: Inbox | None = None
        self._outbox: Outbox | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._threads: list[threading.Thread] = []

    # What a service says of itself

    def consumes(self) -> Mapping[str, type[Record]]:
        """Return the key expressions this service takes records from, and what each carries."""
        return {}

    @abstractmethod
    def handle(self, key: str, record: Record, effects: Effects) -> None:
        """Handle one record; called once a record, one at a time, in the order of arrival.

        Raises:
            BadInputError: The record cannot be handled, now or ever: it is kept apart, logged and counted.
            OSError, HandoffError: It cannot be handled now (a full disk): it is tried again.
            InterruptedByStopError: The service is stopping; the record is handled after the next start.
        """

    def check(self, record: Record) -> None:
        """Refuse a record before it is accepted, by raising BadInputError; by default none is."""

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

    # Life

    @property
    def session(self) -> zenoh.Session:
        """The open Zenoh session."""
        assert self._session is not None
        return self._session

    def start(self) -> bool:
        """Open the session and begin; False when stopped before a router was reached."""
        endpoints = self.platform.router
        self._session = open_with_retry(endpoints, self.stopping)
        if self._session is None:
            return False
        self._token = self._session.liveliness().declare_token(keys.alive(self.platform.id, self.NAME))
        self._outbox = Outbox(self._session, self.store, publish=self.PUBLISH)
        wanted = self.consumes()
        if wanted:
            self._inbox = Inbox(self._session, self.store, self.NAME, tuple(wanted), self._check_payload, self._refused)
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
        for expression, record_type in self.consumes().items():
            if zenoh.KeyExpr(expression).intersects(key):
                return record_type
        raise BadInputError(key, "", key, "a key this service consumes: " + ", ".join(self.consumes()))

    def _check_payload(self, key: str, payload: bytes) -> None:
        self.check(wire.decode(self._record_type(key), payload, key))

    def _refused(self, error: BadInputError) -> None:
        self.count("records_refused")
        log.error("Record refused", extra=kv(key=error.where, field=error.field, reason=str(error)))

    def _work(self) -> None:
        while not self.stopping.is_set():
            self.store.inbox_changed.clear()
            try:
                items = self.store.pending(limit=16)
                for item in items:
                    if self.stopping.is_set():
                        return
                    self._handle_item(item)
            except (OSError, HandoffError) as error:
                self.problem(f"{type(error).__name__}: {error}")
                self.stopping.wait(RETRY_AFTER_S)
                continue
            except InterruptedByStopError:
                return
            self.problem("")
            if not items:
                self.store.inbox_changed.wait(1.0)

    def _handle_item(self, item: InboxItem) -> None:
        effects = Effects(item.payload)
        try:
            self.handle(item.key, wire.decode(self._record_type(item.key), item.payload, item.key), effects)
        except (OSError, HandoffError, InterruptedByStopError):
            raise
        except BadInputError as error:
            self._refused(error)
            self._keep_apart(item, str(error))
            return
        except Exception as error:
            # A defect of ours must not stop the records behind this one, and must not lose this one either.
            log.exception("Record not handled, it is kept apart", extra=kv(key=item.key))
            self.count("records_failed")
            self._keep_apart(item, f"{type(error).__name__}: {error}")
            return
        effects.count("records_handled")
        self.commit(effects, item)

    def _keep_apart(self, item: InboxItem, reason: str) -> None:
        with self.store.transaction() as tx:
            tx.refuse("in", item.key, item.payload, reason)
            tx.done(item)

    def commit(self, effects: Effects, item: InboxItem | None = None) -> None:
        """Write effects, and the end of the record they come from, in one transaction."""
        with self.store.transaction() as tx:
            effects.write(tx)
            if item is not None:
                tx.done(item)
        with self._counter_lock:
            self._counters.update(effects.counts)

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
        detail = detail or self.trouble()
        with self._counter_lock:
            counters = dict(self._counters)
        gauges = {
            "inbox": float(self.store.inbox_depth()),
            "outbox": float(self.store.outbox_depth()),
            "refused": float(self.store.refused_count()),
            **self.gauges(),
        }
        return Health(
            platform_id=self.platform.id,
            service=self.NAME,
            time_utc_s=time.time(),
            started_utc_s=self.started_utc_s,
            state=state or ("degraded" if detail else "ok"),
            detail=detail[:MAX_DETAIL],
            counters=counters,
            gauges=gauges,
        )

    def _report(self) -> None:
        while not self.stopping.wait(self.platform.health_interval_s):
            self._publish_health(None)

    def _publish_health(self, state: ServiceState | None) -> None:
        try:
            record = self.health(state)
            key = keys.health(self.platform.id, self.NAME)
            self.session.put(key, wire.encode(record), encoding=wire.encoding_of(Health))
        except (HandoffError, zenoh.ZError) as error:
            log.warning("Health not published", extra=kv(error=str(error)))
