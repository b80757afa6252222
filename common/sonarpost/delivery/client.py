"""Delivery of a single record by a command, without a durable store."""

from __future__ import annotations

import hashlib
import time
import uuid

import zenoh

from sonarpost import keys, wire
from sonarpost.delivery.protocol import CHUNK_BYTES, AckReply, attachment
from sonarpost.delivery.records import OutboxItem
from sonarpost.errors import DeliveryError, PayloadError
from sonarpost.messages import Record

PAUSE_S = 0.2


class NotDeliveredError(DeliveryError):
    """No consumer accepted the record before the time-out. Its identifier makes it safe to send it again."""


def deliver(
    session: zenoh.Session,
    key: str,
    consumer: str,
    record: Record,
    timeout_s: float,
    *,
    origin: bytes | None = None,
    seq: int = 1,
) -> None:
    """Send a record and return when the consumer has committed it.

    Args:
        session: Session at the router of the consumer.
        key: Key of the record.
        consumer: Name of the consumer.
        record: The record.
        timeout_s: Time limit.
        origin: Identity of a queue, 16 random bytes. None: one for this record alone.
        seq: Number of the record in that queue, from 1.

    Raises:
        PayloadError: The consumer has refused it; `expected` holds the reason.
        NotDeliveredError: No consumer accepted it within `timeout_s`.
    """
    payload = wire.encode(record)
    item = OutboxItem(consumer, seq, key, "", 4, payload, hashlib.sha256(payload).digest())
    queue_origin = uuid.uuid4().bytes if origin is None else origin
    ends_s = time.monotonic() + timeout_s
    offset, reason = 0, "no reply"
    while True:
        # A broken connection ends a query at once: one that is in transit is not sent a second time behind itself.
        reply = _query(session, item, queue_origin, offset, max(ends_s - time.monotonic(), PAUSE_S))
        if reply is not None and reply.status == "stored":
            return
        if reply is not None and reply.status == "refused":
            raise PayloadError(key, "", record.TYPE, f"a record that {consumer} accepts: {reply.reason}")
        if reply is not None and reply.status == "more":
            reason = "record received in part only"
            if offset < reply.next_offset < len(payload):
                offset = reply.next_offset
                continue
            offset = 0
        elif reply is not None:
            reason = f"{consumer} cannot store it: {reply.reason}"
        if time.monotonic() + PAUSE_S > ends_s:
            raise NotDeliveredError(f"{key}: not delivered to {consumer} within {timeout_s:g} s: {reason}")
        time.sleep(PAUSE_S)


def _query(session: zenoh.Session, item: OutboxItem, origin: bytes, offset: int, timeout_s: float) -> AckReply | None:
    replies = session.get(
        keys.delivery_query(item.key, item.queue),
        payload=item.payload[offset : offset + CHUNK_BYTES],
        attachment=attachment(origin, item, offset),
        congestion_control=zenoh.CongestionControl.BLOCK,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout_s,
    )
    for received in replies:
        if received.ok is not None:
            return AckReply.unpack(received.ok.payload.to_bytes(), item.key)
    return None
