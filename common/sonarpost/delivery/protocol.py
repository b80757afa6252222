"""Messages of the delivery protocol between a producer and a consumer.

The producer queries the consumer at `{key}/handoff/{consumer}`. The payload of the query is one chunk of a record (at
most 32 KiB) or several small records; its attachment identifies them. The consumer replies after it has committed. A
consumer that accepts several records in a query announces it in its replies (`takes`), so that either side can run an
older version. `docs/specifications/zenoh.md` specifies the messages for other languages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import msgpack

from sonarpost import wire
from sonarpost.delivery.records import OutboxItem, ReceivedChunk, consumer_of
from sonarpost.errors import PayloadError

CHUNK_BYTES = 32 * 1024
MAX_RECORD_BYTES = 8 * 1024 * 1024
SINGLE_VERSION = 1
BATCH_VERSION = 2
MAX_BATCH_RECORDS = 128
"""Maximum number of records in one query."""
BATCH_RECORD_OVERHEAD_BYTES = 48
"""Size of the entries of one more record in attachment and reply."""

DONE_UP_TO = "settled"
"""Field of the attachment: the producer no longer holds this sequence number and all below it."""

AckStatus = Literal["stored", "more", "refused", "later"]
_STATUSES: Final[tuple[AckStatus, ...]] = ("stored", "more", "refused", "later")


@dataclass(frozen=True, slots=True)
class AckReply:
    """Reply of a consumer.

    Attributes:
        status: "stored": the complete record is committed. "more": continue at `next_offset`. "refused": the record is
            invalid, `reason` explains why. "later": the consumer cannot store it at present (full disk); retry.
        next_offset: Next offset of the record that the consumer requires, in bytes.
        reason: Explanation, for people.
        max_batch: Number of records that the consumer accepts in one query; 0 for one.
    """

    status: AckStatus
    next_offset: int = 0
    reason: str = ""
    max_batch: int = field(default=0, compare=False)

    def pack(self, max_batch: int = 0) -> bytes:
        """Return the reply as msgpack, announcing `max_batch` unless it is 0."""
        fields = {"v": SINGLE_VERSION, "status": self.status, "next": self.next_offset, "reason": self.reason}
        return _pack(fields | ({"takes": max_batch} if max_batch else {}))

    @classmethod
    def unpack(cls, payload: bytes, where: str) -> AckReply:
        """Parse a reply.

        Raises:
            PayloadError: It is not a reply of this protocol.
        """
        fields = wire.unpack_map(payload, where)
        _require_version(fields, where)
        status, reason = fields.get("status"), fields.get("reason", "")
        if not isinstance(reason, str):
            raise PayloadError(where, "reason", reason, "text")
        max_batch = _integer(fields, "takes", where) if "takes" in fields else 0
        return cls(_status(status, where), _integer(fields, "next", where), reason, max_batch)


def attachment(origin: bytes, item: OutboxItem, offset: int = 0, done_up_to: int = 0) -> bytes:
    """Return the attachment that identifies a record and, in a delivery query, the chunk.

    It names the consumer as well: sequence numbers are counted for each consumer, and a key can have several.

    Args:
        origin: Identity of the queue, 16 bytes.
        item: The record.
        offset: Position of the chunk in the record.
        done_up_to: The producer no longer holds this number and all below it; omitted if 0.
    """
    fields = {
        "v": SINGLE_VERSION,
        "origin": origin,
        "consumer": consumer_of(item.queue),
        "seq": item.seq,
        "size": len(item.payload),
        "sha256": item.sha256,
        "offset": offset,
    }
    return _pack(fields | ({DONE_UP_TO: done_up_to} if done_up_to else {}))


def batch_attachment(origin: bytes, items: Sequence[OutboxItem], done_up_to: int = 0) -> bytes:
    """Return the attachment of a query with several complete records of one key; the payloads are concatenated.

    Args:
        origin: Identity of the queue, 16 bytes.
        items: The records, at least one.
        done_up_to: The producer no longer holds this number and all below it; omitted if 0.
    """
    fields: dict[str, object] = {
        "v": BATCH_VERSION,
        "origin": origin,
        "consumer": consumer_of(items[0].queue),
        "records": [(item.seq, len(item.payload), item.sha256) for item in items],
    }
    return _pack(fields | ({DONE_UP_TO: done_up_to} if done_up_to else {}))


def parse_query(attached: bytes, data: bytes, where: str) -> tuple[ReceivedChunk, ...] | ReceivedChunk:
    """Parse a delivery query: one chunk, or a tuple of complete records.

    Raises:
        PayloadError: A field is missing, invalid or out of range.
    """
    fields = wire.unpack_map(attached, where)
    if _is_batch(fields):
        return _parse_batch(fields, data, where)
    _require_version(fields, where)
    chunk = ReceivedChunk(
        origin=_binary(fields, "origin", 16, where),
        seq=_integer(fields, "seq", where),
        size=_integer(fields, "size", where),
        sha256=_binary(fields, "sha256", 32, where),
        offset=_integer(fields, "offset", where),
        data=data,
        done_up_to=_integer(fields, DONE_UP_TO, where) if DONE_UP_TO in fields else 0,
    )
    if chunk.size > MAX_RECORD_BYTES:
        raise PayloadError(where, "size", chunk.size, f"at most {MAX_RECORD_BYTES} bytes")
    if chunk.seq < 1:
        raise PayloadError(where, "seq", chunk.seq, "at least 1")
    if chunk.done_up_to >= chunk.seq:
        raise PayloadError(where, DONE_UP_TO, chunk.done_up_to, "a number below seq")
    if len(data) > CHUNK_BYTES or chunk.offset + len(data) > chunk.size:
        expected = f"a chunk of at most {CHUNK_BYTES} bytes inside size"
        raise PayloadError(where, "payload", f"{len(data)} bytes", expected)
    return chunk


def _parse_batch(fields: Mapping[str, object], data: bytes, where: str) -> tuple[ReceivedChunk, ...]:
    origin = _binary(fields, "origin", 16, where)
    done_up_to = _integer(fields, DONE_UP_TO, where) if DONE_UP_TO in fields else 0
    records = fields.get("records")
    if not isinstance(records, tuple) or not 0 < len(records) <= MAX_BATCH_RECORDS:
        raise PayloadError(where, "records", records, f"an array of 1 to {MAX_BATCH_RECORDS} records")
    if len(data) > CHUNK_BYTES:
        raise PayloadError(where, "payload", f"{len(data)} bytes", f"at most {CHUNK_BYTES} bytes")
    chunks = []
    start = 0
    for number, record in enumerate(records):
        seq, size, sha256 = _batch_record(record, f"records.{number}", where)
        chunks.append(ReceivedChunk(origin, seq, size, sha256, 0, data[start : start + size], done_up_to))
        start += size
    if start != len(data):
        raise PayloadError(where, "payload", f"{len(data)} bytes", f"{start} bytes, the sum of the records' sizes")
    numbers = {chunk.seq for chunk in chunks}
    if len(numbers) < len(chunks):
        raise PayloadError(where, "records", sorted(chunk.seq for chunk in chunks), "each seq once")
    if done_up_to >= min(numbers):
        raise PayloadError(where, DONE_UP_TO, done_up_to, "a number below every seq")
    return tuple(chunks)


def _batch_record(record: object, field: str, where: str) -> tuple[int, int, bytes]:
    if isinstance(record, tuple) and len(record) == 3:
        seq, size, sha256 = record
        # `type(...) is int` excludes bool, which is a subclass of int.
        valid = type(seq) is int and type(size) is int and 0 < seq < 1 << 63 and 0 <= size <= CHUNK_BYTES
        if valid and isinstance(sha256, bytes) and len(sha256) == 32:
            return seq, size, sha256
    raise PayloadError(where, field, record, f"[seq from 1, size to {CHUNK_BYTES}, sha256 of 32 bytes]")


def pack_replies(replies: Sequence[AckReply]) -> bytes:
    """Return the reply to a query of several records: one status for each, in the order of the query."""
    return _pack({"v": BATCH_VERSION, "replies": [(reply.status, reply.reason) for reply in replies]})


def unpack_replies(payload: bytes, count: int, where: str) -> tuple[AckReply, ...] | AckReply:
    """Parse the reply to a query of `count` records.

    Returns:
        A reply for each record, or a single one from a consumer that accepted none of them.

    Raises:
        PayloadError: It is not such a reply.
    """
    fields = wire.unpack_map(payload, where)
    if not _is_batch(fields):
        return AckReply.unpack(payload, where)
    replies = fields.get("replies")
    if not isinstance(replies, tuple) or len(replies) != count:
        raise PayloadError(where, "replies", replies, f"an array of {count}")
    return tuple(_batch_reply(reply, f"replies.{number}", where) for number, reply in enumerate(replies))


_STORED = AckReply("stored")


def _batch_reply(reply: object, field: str, where: str) -> AckReply:
    if isinstance(reply, tuple) and len(reply) == 2:
        status, reason = reply
        if status == "stored" and reason == "":
            return _STORED
        if status in ("stored", "refused", "later") and isinstance(reason, str):
            return AckReply(_status(status, where), reason=reason)
    raise PayloadError(where, field, reply, "[stored, refused or later, reason]")


def _pack(fields: Mapping[str, object]) -> bytes:
    packed: bytes = msgpack.packb(fields)
    return packed


def _is_batch(fields: Mapping[str, object]) -> bool:
    return type(fields.get("v")) is int and fields["v"] == BATCH_VERSION


def _require_version(fields: Mapping[str, object], where: str) -> None:
    if _integer(fields, "v", where) != SINGLE_VERSION:
        raise PayloadError(where, "v", fields["v"], str(SINGLE_VERSION))


def _status(status: object, where: str) -> AckStatus:
    for known in _STATUSES:
        if status == known:
            return known
    raise PayloadError(where, "status", status, "stored, more, refused or later")


def _integer(fields: Mapping[str, object], name: str, where: str) -> int:
    value = fields.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 63:
        raise PayloadError(where, name, value, "a whole number from 0")
    return value


def _binary(fields: Mapping[str, object], name: str, length: int, where: str) -> bytes:
    value = fields.get(name)
    if not isinstance(value, bytes) or len(value) != length:
        raise PayloadError(where, name, value, f"{length} bytes")
    return value
