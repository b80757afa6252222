"""Messages of the delivery protocol between a producer and a consumer.

The producer queries the consumer at `{key}/delivery/{consumer}`. The payload of the query is one chunk of a record (at
most 32 KiB) or several small records; its attachment identifies them. The consumer replies after it has committed. A
consumer that accepts several records in a query announces it in its replies (`takes`), so that either side can run an
older version. `docs/specifications/zenoh.md` specifies the messages for other languages.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Final, Literal

import msgpack
from pydantic import BaseModel, ConfigDict, Field

from sonarpost import wire
from sonarpost.delivery.records import OutboxItem, ReceivedChunk, consumer_of
from sonarpost.errors import PayloadError

CHUNK_BYTES = 32 * 1024
MAX_RECORD_BYTES = 8 * 1024 * 1024
SINGLE_VERSION = 1
BATCH_VERSION = 3
MAX_BATCH_RECORDS = 128
"""Maximum number of records in one query."""
BATCH_RECORD_OVERHEAD_BYTES = 9
"""Size of the entry of one more record in an attachment, with a number up to 2^32."""

AckStatus = Literal["stored", "more", "refused", "later"]
_Natural = Annotated[int, Field(ge=0, lt=1 << 63)]
_Seq = Annotated[int, Field(ge=1, lt=1 << 63)]
_Origin = Annotated[bytes, Field(min_length=16, max_length=16)]
_Digest = Annotated[bytes, Field(min_length=32, max_length=32)]
_BatchRecord = tuple[_Seq, Annotated[int, Field(ge=0, le=CHUNK_BYTES)]]


class _Fields(BaseModel):
    model_config = ConfigDict(strict=True)


class _Attachment(_Fields):
    """Attachment of a query with one chunk."""

    v: Annotated[int, Field(ge=1, le=1)]
    origin: _Origin
    seq: _Seq
    size: Annotated[int, Field(ge=0, le=MAX_RECORD_BYTES)]
    sha256: _Digest
    offset: _Natural
    done_up_to: _Natural = 0


class _BatchAttachment(_Fields):
    """Attachment of a query with several records: (seq, size) of each, and the digest of their digests."""

    v: Annotated[int, Field(ge=3, le=3)]
    origin: _Origin
    records: Annotated[tuple[_BatchRecord, ...], Field(min_length=1, max_length=MAX_BATCH_RECORDS)]
    sha256: _Digest
    done_up_to: _Natural = 0


class _Reply(_Fields):
    v: Annotated[int, Field(ge=1, le=1)]
    status: AckStatus
    next: _Natural
    reason: str = ""
    takes: _Natural = 0
    highest: _Natural = 0
    digest: Annotated[bytes, Field(max_length=32)] = b""


class _BatchReply(_Fields):
    v: Annotated[int, Field(ge=3, le=3)]
    replies: tuple[tuple[Literal["stored", "refused", "later"], str], ...]


@dataclass(frozen=True, slots=True)
class AckReply:
    """Reply of a consumer.

    Attributes:
        status: "stored": the complete record is committed. "more": continue at `next_offset`. "refused": the record is
            invalid, `reason` explains why. "later": the consumer cannot store it at present (full disk); retry.
        next_offset: Next offset of the record that the consumer requires, in bytes.
        reason: Explanation, for people.
        max_batch: Number of records that the consumer accepts in one query; 0 for one.
        highest: Highest sequence number that the consumer had accepted from this queue on this key before the query, or
            the number of the query if another record was accepted with it; only in replies to the first chunk of a
            record, otherwise 0. A producer that has not assigned this number, or holds it with another digest, runs on
            an older copy of its store.
        highest_sha256: Digest of the record with this number; empty if `highest` is 0.
    """

    status: AckStatus
    next_offset: int = 0
    reason: str = ""
    max_batch: int = field(default=0, compare=False)
    highest: int = field(default=0, compare=False)
    highest_sha256: bytes = field(default=b"", compare=False)

    def pack(self, max_batch: int = 0) -> bytes:
        """Return the reply as msgpack, announcing `max_batch` unless it is 0."""
        fields: dict[str, object] = {
            "v": SINGLE_VERSION,
            "status": self.status,
            "next": self.next_offset,
            "reason": self.reason,
        }
        if max_batch:
            fields["takes"] = max_batch
        if self.highest:
            fields |= {"highest": self.highest, "digest": self.highest_sha256}
        return _pack(fields)

    @classmethod
    def unpack(cls, payload: bytes, where: str) -> AckReply:
        """Parse a reply.

        Raises:
            PayloadError: It is not a reply of this protocol.
        """
        reply = wire.validated(_Reply, wire.unpack_map(payload, where), where)
        return cls(reply.status, reply.next, reply.reason, reply.takes, reply.highest, reply.digest)


STORED: Final = AckReply("stored")


def watcher_origin(origin: bytes) -> bytes:
    """Return the identity of a queue for watchers, 16 bytes.

    Only producer and consumer know the origin itself: with it, a peer that may write to the same key could send records
    in the name of the queue.
    """
    return hashlib.sha256(b"watcher" + origin).digest()[:16]


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
    return _pack(fields | ({"done_up_to": done_up_to} if done_up_to else {}))


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
        "records": [(item.seq, len(item.payload)) for item in items],
        "sha256": _digest_of(item.sha256 for item in items),
    }
    return _pack(fields | ({"done_up_to": done_up_to} if done_up_to else {}))


def parse_query(attached: bytes, data: bytes, where: str) -> tuple[ReceivedChunk, ...] | ReceivedChunk:
    """Parse a delivery query: one chunk, or a tuple of complete records.

    Raises:
        PayloadError: A field is missing, invalid or out of range.
    """
    fields = wire.unpack_map(attached, where)
    if _is_batch(fields):
        return _parse_batch(wire.validated(_BatchAttachment, fields, where), data, where)
    chunk = wire.validated(_Attachment, fields, where)
    if chunk.done_up_to >= chunk.seq:
        raise PayloadError(where, "done_up_to", chunk.done_up_to, "a number below seq")
    if len(data) > CHUNK_BYTES or chunk.offset + len(data) > chunk.size:
        expected = f"a chunk of at most {CHUNK_BYTES} bytes inside size"
        raise PayloadError(where, "payload", f"{len(data)} bytes", expected)
    return ReceivedChunk(chunk.origin, chunk.seq, chunk.size, chunk.sha256, chunk.offset, data, chunk.done_up_to)


def _parse_batch(batch: _BatchAttachment, data: bytes, where: str) -> tuple[ReceivedChunk, ...]:
    if len(data) > CHUNK_BYTES:
        raise PayloadError(where, "payload", f"{len(data)} bytes", f"at most {CHUNK_BYTES} bytes")
    chunks = []
    start = 0
    for seq, size in batch.records:
        record = data[start : start + size]
        sha256 = hashlib.sha256(record).digest()
        chunks.append(ReceivedChunk(batch.origin, seq, size, sha256, 0, record, batch.done_up_to))
        start += size
    if start != len(data):
        raise PayloadError(where, "payload", f"{len(data)} bytes", f"{start} bytes, the sum of the records' sizes")
    if _digest_of(chunk.sha256 for chunk in chunks) != batch.sha256:
        raise PayloadError(where, "sha256", batch.sha256.hex(), "the digest of the records' digests")
    numbers = {chunk.seq for chunk in chunks}
    if len(numbers) < len(chunks):
        raise PayloadError(where, "records", sorted(chunk.seq for chunk in chunks), "each seq once")
    if batch.done_up_to >= min(numbers):
        raise PayloadError(where, "done_up_to", batch.done_up_to, "a number below every seq")
    return tuple(chunks)


def pack_replies(replies: Sequence[AckReply]) -> bytes:
    """Return the reply to a query of several records: one status for each, in its order; none if all are stored."""
    all_stored = all(reply.status == "stored" for reply in replies)
    return _pack({"v": BATCH_VERSION, "replies": [] if all_stored else [(r.status, r.reason) for r in replies]})


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
    replies = wire.validated(_BatchReply, fields, where).replies
    if not replies:
        return (STORED,) * count
    if len(replies) != count:
        raise PayloadError(where, "replies", replies, f"an array of {count}, or an empty one")
    return tuple(STORED if status == "stored" else AckReply(status, reason=reason) for status, reason in replies)


def _digest_of(digests: Iterable[bytes]) -> bytes:
    return hashlib.sha256(b"".join(digests)).digest()


def _pack(fields: Mapping[str, object]) -> bytes:
    packed: bytes = msgpack.packb(fields)
    return packed


def _is_batch(fields: Mapping[str, object]) -> bool:
    return type(fields.get("v")) is int and fields["v"] == BATCH_VERSION
