"""Hands one record over and waits until it is on its consumer's disk: for commands, which have no store."""

from __future__ import annotations

import hashlib
import time
import uuid

import zenoh

from sonarpost import keys, wire
from sonarpost.delivery import protocol as handoff
from sonarpost.delivery.protocol import CHUNK_BYTES, AckReply
from sonarpost.delivery.transaction import OutboxItem
from sonarpost.errors import DeliveryError, PayloadError
from sonarpost.messages import Record

TRY_S = 2.0
PAUSE_S = 0.2


class NotDeliveredError(DeliveryError):
    """Nobody has taken the record in time; it may be handed over again, it is known by its identifier."""


def deliver(session: zenoh.Session, key: str, consumer: str, record: Record, timeout_s: float) -> None:
    """Hand `record` over on `key` and return when the consumer has committed it.

    Raises:
        PayloadError: The consumer has refused it; `expected` is its reason.
        NotDeliveredError: Nobody has taken it within `timeout_s`.
    """
    payload = wire.encode(record)
    item = OutboxItem(consumer, 1, key, "", 4, payload, hashlib.sha256(payload).digest())
    origin = uuid.uuid4().bytes
    ends_s = time.monotonic() + timeout_s
    offset, last = 0, "nobody answers"
    while True:
        reply = _ask(session, item, origin, offset)
        if reply is not None and reply.status == "stored":
            return
        if reply is not None and reply.status == "refused":
            raise PayloadError(key, "", record.TYPE, f"something that {consumer} takes: {reply.reason}")
        if reply is not None and reply.status == "more":
            last = "not all of it was taken"
            if offset < reply.next_offset < len(payload):
                offset = reply.next_offset
                continue
            offset = 0
        elif reply is not None:
            last = f"{consumer} cannot store it: {reply.reason}"
        if time.monotonic() + PAUSE_S > ends_s:
            raise NotDeliveredError(f"{key}: not handed over to {consumer} within {timeout_s:g} s: {last}")
        time.sleep(PAUSE_S)


def _ask(session: zenoh.Session, item: OutboxItem, origin: bytes, offset: int) -> AckReply | None:
    replies = session.get(
        keys.handoff(item.key, item.consumer),
        payload=item.payload[offset : offset + CHUNK_BYTES],
        attachment=handoff.attachment(origin, item, offset),
        congestion_control=zenoh.CongestionControl.BLOCK,
        timeout=TRY_S,
    )
    for received in replies:
        if received.ok is not None:
            return AckReply.unpack(received.ok.payload.to_bytes(), item.key)
    return None
