"""Transmissions of the vehicle's own modem, kept until the recordings of their time have been processed."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import msgpack
import zenoh

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.detection.transmissions import TransmitIntervals
from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.files import write_atomically
from sonarpost.logs import kv
from sonarpost.messages import Transmission, Transmissions

log = logging.getLogger(__name__)

RETAINED_S: Final = 86400.0
MAX_RETAINED: Final = 20_000
SAVE_INTERVAL_S: Final = 60.0
"""A process that is killed loses at most this much: less than the 30 minutes in each record of uuv_modem."""
QUERY_TIMEOUT_S: Final = 1.0
_HOUR_S: Final = 3600.0
_STATE_PREFIX: Final = "transmissions:"


class TransmissionLog:
    """Transmissions of the last 24 hours, at most 20,000, in memory and in the store.

    The store has one entry for each hour, so that a write changes little. Transmissions more than 24 hours before or
    after the present time are removed: the clock may have been set.

    Args:
        store: The service's store.
        commit: Commits a unit of work in one transaction.
        on_malformed: Called with the error of each record that is ignored.
        file: Where the transmissions are written, for `sonarpost detect --transmissions`; None for nowhere.
    """

    def __init__(
        self,
        store: Store,
        commit: Callable[[UnitOfWork], None],
        on_malformed: Callable[[BadInputError], None],
        file: Path | None = None,
    ) -> None:
        self._store = store
        self._commit = commit
        self._on_malformed = on_malformed
        self._file = file
        self._lock = threading.Lock()  # for `_ends`: records arrive in threads of Zenoh
        self._ends: dict[float, float] = {}  # end by start, seconds since 1970-01-01 UTC
        self._save_due_s = 0.0
        for ends in store.read_states(_STATE_PREFIX, lambda _, packed: _unpacked(packed)).values():
            self._ends |= ends
        self._stored = {_STATE_PREFIX + name: packed for name, packed in store.states(_STATE_PREFIX).items()}
        self._remove_old(time.time())

    def __len__(self) -> int:
        with self._lock:
            return len(self._ends)

    def subscribe(self, session: zenoh.Session, vehicle_id: str) -> None:
        """Subscribe to the transmissions of the vehicle's modem, and query those before the subscription.

        The query ends at once if uuv_modem does not run, and after a second if it does not reply.
        """
        key = keys.acoustic_transmissions(vehicle_id)
        session.declare_subscriber(key, lambda sample: self._on_payload(key, sample.payload.to_bytes()))
        for reply in session.get(key, timeout=QUERY_TIMEOUT_S):
            if reply.ok is not None:
                self._on_payload(key, reply.ok.payload.to_bytes())

    def _on_payload(self, key: str, payload: bytes) -> None:
        try:
            record = wire.decode(Transmissions, payload, key)
        except BadInputError as error:
            self._on_malformed(error)
            return
        self.add(record, time.time())

    def add(self, record: Transmissions, now_utc_s: float) -> None:
        """Add the transmissions of a record; one with a known start replaces the known one."""
        with self._lock:
            self._ends |= {each.start_utc_s: each.end_utc_s for each in record.transmissions}
            self._remove_old(now_utc_s)

    def intervals(self, before_s: float, after_s: float) -> TransmitIntervals:
        """Return the transmissions with these margins."""
        with self._lock:
            known = list(self._ends.items())
        return TransmitIntervals.of(known, before_s, after_s)

    def save(self, now_s: float | None = None) -> None:
        """Write changes to the store and to the file.

        Args:
            now_s: Monotonic time; nothing is written within 60 s of the last call. None: always written.

        Raises:
            DeliveryError: The store cannot be written.
            OSError: The file cannot be written.
        """
        if now_s is not None and now_s < self._save_due_s:
            return
        with self._lock:
            self._remove_old(time.time())
            known = dict(self._ends)
        hours: dict[str, dict[float, float]] = {}
        for start_s, end_s in sorted(known.items()):
            hours.setdefault(f"{_STATE_PREFIX}{int(start_s // _HOUR_S)}", {})[start_s] = end_s
        packed = {name: _packed(ends) for name, ends in hours.items()}
        effects = UnitOfWork()
        for name, payload in packed.items():
            if self._stored.get(name) != payload:
                effects.put_state(name, payload)
        for name in self._stored.keys() - packed.keys():
            effects.delete_state(name)
        if packed != self._stored:
            self._commit(effects)
            if self._file is not None:
                write_atomically(self._file, _as_json(known))
            self._stored = packed
        if now_s is not None:
            self._save_due_s = now_s + SAVE_INTERVAL_S

    def save_at_stop(self) -> None:
        """Write changes; a failure is logged."""
        try:
            self.save()
        except (OSError, DeliveryError) as error:
            log.warning("Transmissions not stored", extra=kv(reason=str(error)))

    def _remove_old(self, now_utc_s: float) -> None:
        ends = {start_s: end_s for start_s, end_s in self._ends.items() if abs(now_utc_s - start_s) <= RETAINED_S}
        if len(ends) > MAX_RETAINED:
            ends = dict(sorted(ends.items())[-MAX_RETAINED:])
        self._ends = ends


def _packed(ends: Mapping[float, float]) -> bytes:
    packed: bytes = msgpack.packb([list(each) for each in ends.items()])
    return packed


def _as_json(ends: Mapping[float, float]) -> bytes:
    """Return transmissions as `sonarpost detect --transmissions` reads them."""
    rows = [{"start_utc_s": start_s, "end_utc_s": end_s} for start_s, end_s in sorted(ends.items())]
    return (json.dumps({"transmissions": rows}) + "\n").encode()


def _unpacked(packed: bytes) -> dict[float, float]:
    """Return what `_packed` was called with."""
    checked = [Transmission(start_utc_s=start_s, end_utc_s=end_s) for start_s, end_s in msgpack.unpackb(packed)]
    return {each.start_utc_s: each.end_utc_s for each in checked}
