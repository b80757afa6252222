"""Contacts that are ready: they wait in the pool and set out, the most confident first, as the water takes them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence

import zenoh

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import DeliveryError, PayloadError
from sonarpost.logs import kv
from sonarpost.messages import Health, QueueState, Snippet
from sonarpost.services.atd_stub.pool import ContactPool
from sonarpost.services.atd_stub.way import COMPRESSOR, MODEM, WayToTheWater

log = logging.getLogger(__name__)

RELEASE_S = 0.5
"""Reports and new contacts wake the thread that lets contacts go; this is for what nothing tells of."""
MOST_DELAY_S = 10.0
"""A report that seems older when it is heard was made by another clock."""
_RELEASED = "released"


class Outgoing:
    """The pool, and what is known of the way from here to the water.

    Args:
        platform: The vehicle.
        store: The service's store.
        most: Most pictures on their way.
        commit: Commits effects, in one transaction.
    """

    def __init__(self, platform: PlatformConfig, store: Store, most: int, commit: Callable[[UnitOfWork], None]) -> None:
        self._vehicle = platform.id
        self._store = store
        self._most = most
        self._commit = commit
        self._pool = ContactPool(store)
        is_first_run = store.get_state(_RELEASED) is None
        self._way = WayToTheWater(2 * platform.health_interval_s + 1.0, time.monotonic(), is_first_run=is_first_run)
        self._wanted = threading.Event()
        self.trouble = ""

    @property
    def waiting(self) -> int:
        """Contacts in the pool."""
        return len(self._pool)

    @property
    def on_the_way(self) -> int:
        """Pictures between here and the water, as far as reports tell."""
        return self._way.on_the_way(self._store.outbox_depth(), time.monotonic())

    def listen(self, session: zenoh.Session) -> None:
        """Hear what waits on the way to the water."""
        for service in (COMPRESSOR, MODEM):
            session.declare_subscriber(keys.health(self._vehicle, service), self._hear_health)
        session.declare_subscriber(keys.acoustic_queue(self._vehicle), self._hear_queue)

    def _hear_health(self, sample: zenoh.Sample) -> None:
        try:
            report = wire.decode(Health, sample.payload.to_bytes(), str(sample.key_expr))
        except PayloadError as error:
            log.warning("A report is left out", extra=kv(reason=str(error)))
            return
        self._way.heard_health(report, _moment(report.time_utc_s))
        self._wanted.set()

    def _hear_queue(self, sample: zenoh.Sample) -> None:
        try:
            report = wire.decode(QueueState, sample.payload.to_bytes(), str(sample.key_expr))
        except PayloadError as error:
            log.warning("A report is left out", extra=kv(reason=str(error)))
            return
        self._way.heard_queue(report, _moment(report.time_utc_s))
        self._wanted.set()

    def taken(self) -> None:
        """Note that the compressor has taken one more; takes no lock that a transaction waits for."""
        self._way.taken(time.monotonic())
        self._wanted.set()

    def wake(self) -> None:
        """Let `run` look whether there is something to do."""
        self._wanted.set()

    def add(self, effects: UnitOfWork, ready: Sequence[Snippet]) -> None:
        """Commit effects, and with them contacts that are ready.

        Raises:
            DeliveryError: The store cannot be written; nothing was kept.
        """
        with self._pool.lock:
            committed = self._pool.add(effects, [wire.encode(snippet) for snippet in ready])
            self._commit(effects)
            committed()
        self._wanted.set()

    def run(self, stopping: threading.Event) -> None:
        """Let contacts go until `stopping` is set."""
        while not stopping.is_set():
            self._wanted.wait(RELEASE_S)
            self._wanted.clear()
            if stopping.is_set():
                return
            try:
                self._let_go()
            except DeliveryError as error:
                if not self.trouble:
                    log.exception("Contacts cannot be handed on")
                self.trouble = str(error)
                stopping.wait(RELEASE_S)
            else:
                self.trouble = ""

    def _let_go(self) -> None:
        """Hand on the most confident contacts that there is room for."""
        with self._pool.lock:
            if not len(self._pool):
                return
            room = self._way.room(self._store.outbox_depth(), self._most, time.monotonic())
            if not room:
                return
            effects = UnitOfWork()
            count, committed = self._pool.release(effects, room, self._owe)
            effects.put_state(_RELEASED, b"1")
            self._commit(effects)
            committed()
        log.debug("Contacts handed on", extra=kv(contacts=count, waiting=len(self._pool)))

    def _owe(self, effects: UnitOfWork, payload: bytes) -> None:
        effects.send_payload(keys.contact_detected(self._vehicle), COMPRESSOR, payload, Snippet)


def _moment(time_utc_s: float) -> float:
    """Return when a report was made, on the clock that never goes back; now where its maker has another time."""
    age_s = time.time() - time_utc_s
    return time.monotonic() - (age_s if 0 <= age_s <= MOST_DELAY_S else 0.0)
