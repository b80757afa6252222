"""Several small records in one hand-over query: what the two ends say to each other.

A query and a reply cost far more than a small record. A consumer that takes several says so in its replies (`takes`);
only then does a producer send them together, so that either end may be older than the other. Every record is answered
for by itself. `docs/specifications/zenoh.md` describes the same for other languages.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgpack

from sonarpost import wire
from sonarpost.delivery import protocol as handoff
from sonarpost.delivery.items import OutboxItem, ReceivedChunk, consumer_of
from sonarpost.delivery.protocol import CHUNK_BYTES, AckReply
from sonarpost.errors import PayloadError

BATCH_VERSION = 2
MAX_RECORDS = 128
"""Most records in one query."""
RECORD_OVERHEAD_BYTES = 48
"""What one more record in a query costs besides its payload: its entries in attachment and reply."""

_STORED = AckReply("stored")


def attachment(origin: bytes, items: Sequence[OutboxItem], settled: int = 0) -> bytes:
    """Return the attachment of a query with several whole records of one key, their payloads one after the other.

    Args:
        origin: Identity of the queue, 16 bytes.
        items: The records, one at least.
        settled: The highest number with which, and with all below it, the producer is done; left out when 0.
    """
    fields: dict[str, object] = {
        "v": BATCH_VERSION,
        "origin": origin,
        "consumer": consumer_of(items[0].consumer),
        "records": [(item.seq, len(item.payload), item.sha256) for item in items],
    }
    if settled:
        fields["settled"] = settled
    packed: bytes = msgpack.packb(fields)
    return packed


def parse_query(attached: bytes, data: bytes, where: str) -> tuple[ReceivedChunk, ...] | ReceivedChunk:
    """Parse a hand-over query, of a piece or of several records.

    Raises:
        PayloadError: A field is missing, wrong or out of bounds.
    """
    fields = wire.unpack_map(attached, where)
    if type(fields.get("v")) is int and fields["v"] == BATCH_VERSION:
        return _parse_batch(fields, data, where)
    return handoff.parse_fields(fields, data, where)


def _parse_batch(fields: dict[str, object], data: bytes, where: str) -> tuple[ReceivedChunk, ...]:
    origin = handoff.binary(fields, "origin", 16, where)
    settled = handoff.integer(fields, "settled", where) if "settled" in fields else 0
    records = fields.get("records")
    if not isinstance(records, tuple) or not 0 < len(records) <= MAX_RECORDS:
        raise PayloadError(where, "records", records, f"an array of 1 to {MAX_RECORDS} records")
    if len(data) > CHUNK_BYTES:
        raise PayloadError(where, "payload", f"{len(data)} bytes", f"at most {CHUNK_BYTES} bytes")
    chunks = []
    start = 0
    for number, record in enumerate(records):
        seq, size, sha256 = _entry(record, f"records.{number}", where)
        chunks.append(ReceivedChunk(origin, seq, size, sha256, 0, data[start : start + size], settled))
        start += size
    if start != len(data):
        raise PayloadError(where, "payload", f"{len(data)} bytes", f"{start} bytes, the sum of the records' sizes")
    numbers = {chunk.seq for chunk in chunks}
    if len(numbers) < len(chunks):
        raise PayloadError(where, "records", sorted(chunk.seq for chunk in chunks), "each seq once")
    if settled >= min(numbers):
        raise PayloadError(where, "settled", settled, "a number below every seq")
    return tuple(chunks)


def _entry(record: object, field: str, where: str) -> tuple[int, int, bytes]:
    if isinstance(record, tuple) and len(record) == 3:
        seq, size, sha256 = record
        # bool is a whole number in Python, and is none on the wire.
        numbers = type(seq) is int and type(size) is int and 0 < seq < 1 << 63 and 0 <= size <= CHUNK_BYTES
        if numbers and isinstance(sha256, bytes) and len(sha256) == 32:
            return seq, size, sha256
    raise PayloadError(where, field, record, f"[seq from 1, size to {CHUNK_BYTES}, sha256 of 32 bytes]")


def pack_replies(replies: Sequence[AckReply]) -> bytes:
    """Return the reply to a query of several records: what became of each, in the order of the query."""
    packed: bytes = msgpack.packb({"v": BATCH_VERSION, "replies": [(reply.status, reply.reason) for reply in replies]})
    return packed


def unpack_replies(payload: bytes, count: int, where: str) -> tuple[AckReply, ...] | AckReply:
    """Parse the reply to a query of `count` records; a single one is of a consumer that took none of them.

    Raises:
        PayloadError: No such reply.
    """
    fields = wire.unpack_map(payload, where)
    if type(fields.get("v")) is not int or fields["v"] != BATCH_VERSION:
        return AckReply.unpack(payload, where)
    replies = fields.get("replies")
    if not isinstance(replies, tuple) or len(replies) != count:
        raise PayloadError(where, "replies", replies, f"an array of {count}")
    return tuple(_reply(reply, f"replies.{number}", where) for number, reply in enumerate(replies))


def _reply(reply: object, field: str, where: str) -> AckReply:
    if isinstance(reply, tuple) and len(reply) == 2:
        status, reason = reply
        if status == "stored" and reason == "":
            return _STORED
        for known in ("stored", "refused", "later"):
            if status == known and isinstance(reason, str):
                return AckReply(known, reason=reason)
    raise PayloadError(where, field, reply, "[stored, refused or later, reason]")
