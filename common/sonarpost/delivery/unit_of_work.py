"""What handling one record leads to."""

from __future__ import annotations

from collections.abc import Mapping

from sonarpost import wire
from sonarpost.delivery.transaction import Topic, Transaction
from sonarpost.messages import Record


class UnitOfWork:
    """What handling one record leads to; committed all together, or not at all.

    Attributes:
        payload: The record's bytes as they came, empty for effects that no record has led to.
    """

    def __init__(self, payload: bytes = b"") -> None:
        self.payload = payload
        self._sends: list[tuple[str, str, bytes, str, int, Topic | None]] = []
        self._state: dict[str, bytes | None] = {}
        self._apart: list[tuple[str, bytes, str]] = []
        self._counts: dict[str, int] = {}

    def send(self, key: str, consumer: str, record: Record, *, priority: int = 4, topic: Topic | None = None) -> None:
        """Owe `record` to the service named `consumer`, published on `key`; see `Transaction.send`."""
        self._sends.append((key, consumer, wire.encode(record), wire.encoding_of(type(record)), priority, topic))

    def send_payload(
        self,
        key: str,
        consumer: str,
        payload: bytes,
        record_type: type[Record],
        *,
        priority: int = 4,
        topic: Topic | None = None,
    ) -> None:
        """Owe a record that is bytes already; what of it this version does not know stays in it."""
        self._sends.append((key, consumer, payload, wire.encoding_of(record_type), priority, topic))

    def put_state(self, name: str, value: bytes) -> None:
        """Remember `value` under `name`."""
        self._state[name] = value

    def delete_state(self, name: str) -> None:
        """Forget `name`."""
        self._state[name] = None

    def quarantine(self, key: str, payload: bytes, reason: str) -> None:
        """Keep something that cannot be used, with the reason, in the store's `refused` table."""
        self._apart.append((key, payload, reason))

    def count(self, name: str, by: int = 1) -> None:
        """Add to a health counter once the effects are committed."""
        self._counts[name] = self._counts.get(name, 0) + by

    def write(self, tx: Transaction) -> None:
        """Write everything into an open transaction."""
        for key, consumer, payload, encoding, priority, topic in self._sends:
            tx.send(key, consumer, payload, encoding=encoding, priority=priority, topic=topic)
        for name, value in self._state.items():
            if value is None:
                tx.delete_state(name)
            else:
                tx.put_state(name, value)
        for key, payload, reason in self._apart:
            tx.quarantine("in", key, payload, reason)

    @property
    def counts(self) -> Mapping[str, int]:
        """What `count` was called with."""
        return self._counts
