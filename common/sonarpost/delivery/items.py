"""What goes in and out of a service's store, and the names of an outbox's queues."""

from __future__ import annotations

from dataclasses import dataclass, field

QUEUE_MARK = "@"


def queue_of(consumer: str, place: str) -> str:
    """Return the name of the queue for a consumer that is on several platforms, for example `c2@shore-2`.

    Queues know nothing of each other: each has numbers and an origin of its own, and one that is not answered holds no
    other back.
    """
    return f"{consumer}{QUEUE_MARK}{place}"


def consumer_of(queue: str) -> str:
    """Return the name by which a queue's consumer answers."""
    return queue.partition(QUEUE_MARK)[0]


@dataclass(frozen=True, slots=True)
class Topic:
    """What a record is an edition of: in a queue, a newer edition takes the place of older ones that have not begun."""

    name: str
    edition: int


@dataclass(frozen=True, slots=True)
class OutboxItem:
    """A record that its consumer has not acknowledged yet; `consumer` is the name of the queue."""

    consumer: str
    seq: int
    key: str
    encoding: str
    priority: int
    payload: bytes
    sha256: bytes
    place: int = field(default=0, compare=False)
    created_utc_s: float = field(default=0.0, compare=False)


@dataclass(frozen=True, slots=True)
class ReceivedChunk:
    """A piece of a record on its way, as the hand-over query carries it."""

    origin: bytes
    seq: int
    size: int
    sha256: bytes
    offset: int
    data: bytes
    settled: int = 0


@dataclass(frozen=True, slots=True)
class InboxItem:
    """A record that was accepted and not yet handled."""

    id: int
    key: str
    payload: bytes
