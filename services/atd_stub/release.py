"""Release of contacts to the compressor: as many as the acoustic transmit queue has credit for.

Picks of a person are released first, then the most confident contacts.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

import msgpack
import zenoh

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import DeliveryError, PayloadError
from sonarpost.logs import kv
from sonarpost.messages import QueueState, Snippet

log = logging.getLogger(__name__)

RELEASE_INTERVAL_S: Final = 0.5
"""A queue state or a new contact wakes the release thread at once; otherwise it checks at this interval."""
RELEASE_EXPIRY_S: Final = 600.0
"""A released contact that the modem service has not accepted by then was quarantined on the way."""
_COMPRESSOR: Final = "compressor"
_STATE_NAME: Final = "releases"
_PREFIX: Final = "pending/"
_MAX_CONFIDENCE: Final = 2.0
_STEPS: Final = 1_000_000
_PICK_RANK: Final = -1
"""Sorts before all ranks by confidence: `-` comes before the digits."""


class ReleaseCredit:
    """Computes how many contacts may be released, from the state of the acoustic transmit queue.

    In flight are the images in that queue and the released contacts that have not reached it. The latter are the
    release times that are left when one is removed for each image the queue has accepted. `pack` and `unpack` keep
    both in the store; later queue states bring a restored object up to date.

    Args:
        limit: Maximum number of contacts in flight; 0 for no limit.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._images_waiting: int | None = None
        self._images_accepted: int | None = None
        self._release_times_utc_s: list[float] = []

    def pack(self) -> bytes:
        """Return the durable part."""
        packed: bytes = msgpack.packb([self._images_accepted, self._release_times_utc_s])
        return packed

    def unpack(self, packed: bytes) -> None:
        """Restore the durable part."""
        accepted, times = msgpack.unpackb(packed)
        times_utc_s = [float(time_utc_s) for time_utc_s in times]
        self._images_accepted = None if accepted is None else int(accepted)
        self._release_times_utc_s = times_utc_s

    def update(self, state: QueueState, now_utc_s: float) -> None:
        """Apply a state of the transmit queue.

        Release times expire here, and not while the modem service is down: its contacts wait and are not lost.
        """
        has_gone = sum(image.bytes_left == 0 for image in state.images)
        self._images_waiting = max(state.images_waiting - has_gone, 0)
        accepted = state.images_accepted
        if accepted is not None:
            before = self._images_accepted
            if before is not None:
                # A count that decreases is that of a new store, which began at 0.
                del self._release_times_utc_s[: accepted - before if accepted >= before else accepted]
            self._images_accepted = accepted
        # A time in the future is from before the clock was set back.
        self._release_times_utc_s = [
            time_s for time_s in self._release_times_utc_s if 0 <= now_utc_s - time_s <= RELEASE_EXPIRY_S
        ]

    def released(self, count: int, now_utc_s: float) -> None:
        """Record that `count` contacts are released."""
        if self._limit:
            self._release_times_utc_s += [now_utc_s] * count

    def in_flight(self, undelivered: int) -> int:
        """Return the number of contacts that are released and not transmitted.

        Args:
            undelivered: Released contacts that the compressor has not acknowledged.
        """
        return (self._images_waiting or 0) + max(len(self._release_times_utc_s), undelivered)

    def available(self, undelivered: int) -> int | None:
        """Return how many contacts may be released now, None for any number; `undelivered` as for `in_flight`."""
        if not self._limit:
            return None
        if self._images_waiting is None:
            return 0
        return max(self._limit - self.in_flight(undelivered), 0)


class PendingContacts:
    """Durable priority list of the snippets that wait for release.

    The name of a stored snippet sorts by confidence, then by age. Picks come first, other contacts without confidence
    last. All content is in the store: a unit of work that is not committed changes nothing. One thread
    adds, one thread removes.

    Args:
        store: The service's store.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        numbers = (name.rpartition(":")[2] for name in store.state_names(_PREFIX))
        self._next_number = 1 + max((int(number) for number in numbers if number.isdecimal()), default=0)

    def __len__(self) -> int:
        return len(self._store.state_names(_PREFIX))

    def add(self, effects: UnitOfWork, snippets: Sequence[Snippet]) -> None:
        """Queue snippets by falling confidence, then in the order of detection."""
        for snippet in snippets:
            confidence = snippet.contact.atd_confidence
            self._put(effects, round((_MAX_CONFIDENCE - (confidence or 0.0)) * _STEPS) + (confidence is None), snippet)

    def add_picks(self, effects: UnitOfWork, snippets: Sequence[Snippet]) -> None:
        """Queue snippets of picks before all others. Those of the same contacts that wait here are removed."""
        picked = {snippet.contact.contact_id for snippet in snippets}
        for name in self._store.state_names(_PREFIX):
            # The other thread may have removed it.
            waiting = self._store.read_state(name, lambda payload: wire.decode(Snippet, payload, "contact"), None)
            if waiting is not None and waiting.contact.contact_id in picked:
                effects.delete_state(name)
        for snippet in snippets:
            self._put(effects, _PICK_RANK, snippet)

    def _put(self, effects: UnitOfWork, rank: int, snippet: Snippet) -> None:
        effects.put_state(f"{_PREFIX}{rank:08d}:{self._next_number:015d}", wire.encode(snippet))
        self._next_number += 1

    def remove_first(self, effects: UnitOfWork, count: int | None) -> list[bytes]:
        """Remove up to `count` (None for all) of the most confident snippets; return them encoded, in this order.

        Raises:
            DeliveryError: The store cannot be read.
        """
        payloads = []
        for name in sorted(self._store.state_names(_PREFIX))[:count]:
            payload = self._store.get_state(name)
            if payload is None:
                continue  # replaced by a pick
            effects.delete_state(name)
            payloads.append(payload)
        return payloads


class ContactRelease:
    """Stores contacts that are ready and releases the most confident first.

    Args:
        platform: The vehicle.
        store: The service's store.
        max_in_flight: Maximum number of contacts between this service and their transmission; 0 for no limit.
        commit: Commits a unit of work in one transaction.
    """

    def __init__(
        self, platform: PlatformConfig, store: Store, max_in_flight: int, commit: Callable[[UnitOfWork], None]
    ) -> None:
        self._vehicle_id = platform.id
        self._store = store
        self._commit = commit
        self._pending = PendingContacts(store)
        self._max_in_flight = max_in_flight
        # Held while the credit is used or changed.
        self._lock = threading.Lock()
        self._credit = self._restored_credit()
        self._wake = threading.Event()
        self._has_queue_state = False
        self.error = ""

    def _restored_credit(self) -> ReleaseCredit:
        credit = ReleaseCredit(self._max_in_flight)
        self._store.read_state(_STATE_NAME, credit.unpack, None)
        return credit

    @property
    def pending(self) -> int:
        """Number of contacts that wait for release."""
        return len(self._pending)

    @property
    def in_flight(self) -> int:
        """Number of contacts that are released and not transmitted."""
        with self._lock:
            return self._credit.in_flight(self._store.outbox_depth())

    @property
    def status(self) -> str:
        """Why contacts wait, for the health record; empty when none waits."""
        pending = self.pending
        if not pending:
            return ""
        if self._max_in_flight and not self._has_queue_state:
            return f"{pending} contacts wait for the first queue_state of uuv_modem"
        return f"{pending} contacts wait for space in the acoustic transmit queue"

    def subscribe(self, session: zenoh.Session) -> None:
        """Subscribe to the state of the transmit queue."""
        session.declare_subscriber(keys.acoustic_queue(self._vehicle_id), self._on_queue_state)

    def _on_queue_state(self, sample: zenoh.Sample) -> None:
        try:
            state = wire.decode(QueueState, sample.payload.to_bytes(), str(sample.key_expr))
        except PayloadError as error:
            log.warning("Ignoring malformed queue state", extra=kv(reason=str(error)))
            return
        with self._lock:
            self._credit.update(state, time.time())
            self._has_queue_state = True
        self._wake.set()

    def wake(self) -> None:
        """Let `run` check at once whether contacts can be released."""
        self._wake.set()

    def add(self, effects: UnitOfWork, snippets: tuple[Snippet, ...], *, are_picks: bool = False) -> None:
        """Commit `effects` together with snippets that are ready for release; those of picks are released first.

        Raises:
            DeliveryError: The store cannot be written; nothing was stored.
        """
        (self._pending.add_picks if are_picks else self._pending.add)(effects, snippets)
        self._commit(effects)
        self._wake.set()

    def run(self, stopping: threading.Event) -> None:
        """Release contacts until `stopping` is set."""
        while not stopping.is_set():
            self._wake.wait(RELEASE_INTERVAL_S)
            self._wake.clear()
            if stopping.is_set():
                return
            try:
                self._release()
            except DeliveryError as error:
                if not self.error:
                    log.exception("Contacts cannot be released")
                self.error = str(error)
                stopping.wait(RELEASE_INTERVAL_S)
            else:
                self.error = ""

    def _release(self) -> None:
        with self._lock:
            available = self._credit.available(self._store.outbox_depth())
            if available == 0:
                return
            effects = UnitOfWork()
            payloads = self._pending.remove_first(effects, available)
            if not payloads:
                return
            for payload in payloads:
                effects.send_payload(keys.contact_detected(self._vehicle_id), _COMPRESSOR, payload, Snippet)
            before = self._credit.pack()
            self._credit.released(len(payloads), time.time())
            effects.put_state(_STATE_NAME, self._credit.pack())
            try:
                self._commit(effects)
            except DeliveryError:
                self._credit.unpack(before)
                raise
        log.debug("Contacts released", extra=kv(contacts=len(payloads), pending=self.pending))
