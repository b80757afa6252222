"""Common steps of the tests of the durable store."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

from sonarpost.delivery.records import OutboxItem, ReceivedChunk
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import Transaction

ORIGIN = b"o" * 16


def send(store: Store, *payloads: bytes, consumer: str = "c", priority: int = 4) -> list[int]:
    with store.transaction() as tx:
        return [tx.send("k", consumer, p, encoding="e", priority=priority) for p in payloads]


def record(seq: int, payload: bytes, origin: bytes = ORIGIN, done_up_to: int = 0) -> ReceivedChunk:
    """Return a record that arrives in one chunk."""
    return ReceivedChunk(origin, seq, len(payload), hashlib.sha256(payload).digest(), 0, payload, done_up_to)


def queued_items(store: Store, queue: str, limit: int) -> tuple[OutboxItem, ...]:
    return store.queued_items(queue, store.queued_numbers(queue, limit))


def fail_within(store: Store, write: Callable[[Transaction], object]) -> None:
    """Write in a transaction that is then ended by an exception."""
    with store.transaction() as tx:
        write(tx)
        raise ZeroDivisionError
