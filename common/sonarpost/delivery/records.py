"""Data classes of the store: outbox and inbox records, received chunks, queue names."""

from __future__ import annotations

from dataclasses import dataclass, field

SITE_SEPARATOR = "@"


def queue_of(consumer: str, platform: str) -> str:
    """Return the queue name of a consumer that runs on several platforms, for example `c2@shore-2`.

    Each queue has its own sequence numbers and its own random origin. An unresponsive consumer does not delay other
    queues.
    """
    return f"{consumer}{SITE_SEPARATOR}{platform}"


def consumer_of(queue: str) -> str:
    """Return the name of the consumer of a queue, without the platform."""
    return queue.partition(SITE_SEPARATOR)[0]


def platform_of(queue: str) -> str:
    """Return the platform of a queue, empty for a plain consumer name."""
    return queue.partition(SITE_SEPARATOR)[2]


Place = tuple[int, int]
"""Priority and position of a queued record; the lowest is sent first."""


@dataclass(frozen=True, slots=True)
class Topic:
    """Subject and edition of a record: in a queue, a newer edition replaces older ones that are not in flight."""

    name: str
    edition: int


@dataclass(slots=True)
class OutboxItem:
    """A queued record that its consumer has not acknowledged yet.

    Attributes:
        queue: Name of the queue: a consumer, or a consumer on a platform (`queue_of`).
        seq: Sequence number within the queue, from 1.
        key: Key expression of the record.
        encoding: Zenoh encoding of the payload.
        priority: 1 (first) to 7 (last), as Zenoh's priorities.
        payload: The record's bytes.
        sha256: SHA-256 digest of the payload, 32 bytes.
        position: Order among records of equal priority; a newer edition inherits it from the one it replaces.
        origin: Identity of the queue when the record was queued, 16 bytes.
    """

    queue: str
    seq: int
    key: str
    encoding: str
    priority: int
    payload: bytes
    sha256: bytes
    position: int = field(default=0, compare=False)
    origin: bytes = field(default=b"", compare=False)

    @property
    def place(self) -> Place:
        """Its place in the queue; of two records of one place, the older one is sent first."""
        return (self.priority, self.position)


@dataclass(slots=True)
class ReceivedChunk:
    """A chunk of a record, as one delivery query carries it.

    Attributes:
        origin: Identity of the producer's queue, 16 bytes.
        seq: Sequence number of the record in that queue.
        size: Size of the whole record in bytes.
        sha256: SHA-256 digest of the whole record.
        offset: Position of the chunk in the record, in bytes.
        data: Bytes of the chunk.
        done_up_to: The producer states that it no longer holds this sequence number and all below it.
    """

    origin: bytes
    seq: int
    size: int
    sha256: bytes
    offset: int
    data: bytes
    done_up_to: int = 0


@dataclass(slots=True)
class InboxItem:
    """A record that was accepted and not yet handled."""

    id: int
    key: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class QuarantinedRecord:
    """A record that could not be handled.

    Attributes:
        id: Number in the quarantine.
        at_utc_s: When it was quarantined.
        direction: `in` for a received record, `out` for one that its consumer has refused.
        key: Its key; a text with a space for data that is no record.
        size_bytes: Size of the stored payload.
        reason: Why it was quarantined.
        can_be_queued: Whether it is a complete received record.
    """

    id: int
    at_utc_s: float
    direction: str
    key: str
    size_bytes: int
    reason: str
    can_be_queued: bool
