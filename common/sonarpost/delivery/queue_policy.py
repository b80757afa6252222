"""How a queue of an outbox is sent, and what is said to Zenoh for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import zenoh

from sonarpost import keys
from sonarpost.delivery import batch_protocol as handoff_batch
from sonarpost.delivery import protocol as handoff
from sonarpost.delivery.scheduler import Chunk
from sonarpost.delivery.transaction import OutboxItem, Transaction, consumer_of

REPLY_TIMEOUT_S = 5.0
PRIORITIES = {
    1: zenoh.Priority.REAL_TIME,
    2: zenoh.Priority.INTERACTIVE_HIGH,
    3: zenoh.Priority.INTERACTIVE_LOW,
    4: zenoh.Priority.DATA_HIGH,
    5: zenoh.Priority.DATA,
    6: zenoh.Priority.DATA_LOW,
    7: zenoh.Priority.BACKGROUND,
}

OnAcknowledged = Callable[[Transaction, OutboxItem, str | None], None]
"""Called in the transaction that forgets a record: the record, and the consumer's reason if it was refused."""


@dataclass(frozen=True, slots=True)
class QueuePolicy:
    """How a queue is sent.

    Attributes:
        session: Returns the session to send over, None while there is none; by default the outbox's own.
        publish: Also publish each record on its key, once a run, for whoever watches.
        bytes_per_s: Bandwidth limit, None for none.
        held: Nothing is sent: the queue's consumer is not configured any more.
    """

    session: Callable[[], zenoh.Session | None] | None = None
    publish: bool = True
    bytes_per_s: float | None = None
    held: bool = False


def ask(
    session: zenoh.Session, origin: bytes, pieces: Sequence[Chunk], settled: int
) -> zenoh.handlers.Handler[zenoh.Reply]:
    """Send a hand-over query; return where its replies come.

    Args:
        session: To send over.
        origin: Identity of the queue, 16 bytes.
        pieces: One piece of a record, or several whole records of one key and priority.
        settled: The highest number with which, and with all below it, the queue is done.

    Raises:
        zenoh.ZError: It cannot be sent.
    """
    items = [piece.transfer.item for piece in pieces]
    if len(pieces) == 1:
        start, end = pieces[0].start, pieces[0].end
        payload = items[0].payload[start:end]
        attachment = handoff.attachment(origin, items[0], start, settled)
    else:
        payload = b"".join(item.payload for item in items)
        attachment = handoff_batch.attachment(origin, items, settled)
    return session.get(
        keys.handoff(items[0].key, consumer_of(items[0].consumer)),
        timeout=REPLY_TIMEOUT_S,
        priority=PRIORITIES[items[0].priority],
        # Waits for the link instead of dropping: a dropped query would cost its whole time-out.
        congestion_control=zenoh.CongestionControl.BLOCK,
        payload=payload,
        attachment=attachment,
    )


def show(session: zenoh.Session, origin: bytes, item: OutboxItem) -> None:
    """Publish a record for watchers; they know it by (origin, seq) when it comes twice.

    Raises:
        zenoh.ZError: It cannot be published.
    """
    session.put(
        item.key,
        item.payload,
        encoding=item.encoding,
        priority=PRIORITIES[item.priority],
        attachment=handoff.attachment(origin, item),
    )
