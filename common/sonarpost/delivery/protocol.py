"""What the two ends of the durable hand-off say to each other.

The producer asks the consumer's queryable at `{key}/handoff/{consumer}`; the query's payload is a piece of the record
of at most 32 kB, its attachment says which record and which piece; the reply, given after the consumer has committed,
says what it has. `docs/specifications/zenoh.md` describes the same for other languages.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import msgpack

from sonarpost import wire
from sonarpost.delivery.items import OutboxItem, ReceivedChunk, consumer_of
from sonarpost.errors import PayloadError

CHUNK_BYTES = 32 * 1024
MAX_RECORD_BYTES = 8 * 1024 * 1024
HANDOFF_VERSION = 1

AckStatus = Literal["stored", "more", "refused", "later"]


@dataclass(frozen=True, slots=True)
class AckReply:
    """The consumer's answer.

    Attributes:
        status: "stored": the whole record is on the consumer's disk. "more": send on from `next_offset`. "refused": the
            record is wrong and will never be taken, `reason` says why. "later": the consumer cannot store at the
            moment (a full disk), try again.
        takes: How many records the consumer takes with one query (`handoff_batch`); 0 for one.
    """

    status: AckStatus
    next_offset: int = 0
    reason: str = ""
    takes: int = field(default=0, compare=False)

    def pack(self, takes: int = 0) -> bytes:
        """Return the reply as msgpack.

        Args:
            takes: How many records the consumer takes with one query; left out when 0.
        """
        fields = {"v": HANDOFF_VERSION, "status": self.status, "next": self.next_offset, "reason": self.reason}
        if takes:
            fields["takes"] = takes
        packed: bytes = msgpack.packb(fields)
        return packed

    @classmethod
    def unpack(cls, payload: bytes, where: str) -> AckReply:
        """Parse a reply.

        Raises:
            PayloadError: Not a hand-off reply.
        """
        fields = wire.unpack_map(payload, where)
        _need_version(fields, where)
        status = fields.get("status")
        next_offset = integer(fields, "next", where)
        takes = integer(fields, "takes", where) if "takes" in fields else 0
        for known in ("stored", "more", "refused", "later"):
            if status == known:
                return cls(known, next_offset, _reason(fields, where), takes)
        raise PayloadError(where, "status", status, "stored, more, refused or later")


def attachment(origin: bytes, item: OutboxItem, offset: int = 0, settled: int = 0) -> bytes:
    """Return the attachment that names a record and, in a hand-over query, a piece of it.

    Sequence numbers run per consumer, so a watcher of a key with two consumers needs the consumer's name as well.

    Args:
        origin: Identity of the queue, 16 bytes.
        item: The record.
        offset: Where the piece begins.
        settled: The highest number with which, and with all below it, the producer is done; left out when 0.
    """
    fields = {
        "v": HANDOFF_VERSION,
        "origin": origin,
        "consumer": consumer_of(item.consumer),
        "seq": item.seq,
        "size": len(item.payload),
        "sha256": item.sha256,
        "offset": offset,
    }
    if settled:
        fields["settled"] = settled
    packed: bytes = msgpack.packb(fields)
    return packed


def parse_chunk(attached: bytes, data: bytes, where: str) -> ReceivedChunk:
    """Parse a hand-over query.

    Raises:
        PayloadError: A field is missing, wrong or out of bounds.
    """
    return parse_fields(wire.unpack_map(attached, where), data, where)


def parse_fields(fields: dict[str, object], data: bytes, where: str) -> ReceivedChunk:
    """Parse the unpacked attachment of a hand-over query of one piece.

    Raises:
        PayloadError: A field is missing, wrong or out of bounds.
    """
    _need_version(fields, where)
    chunk = ReceivedChunk(
        origin=binary(fields, "origin", 16, where),
        seq=integer(fields, "seq", where),
        size=integer(fields, "size", where),
        sha256=binary(fields, "sha256", 32, where),
        offset=integer(fields, "offset", where),
        data=data,
        settled=integer(fields, "settled", where) if "settled" in fields else 0,
    )
    if chunk.size > MAX_RECORD_BYTES:
        raise PayloadError(where, "size", chunk.size, f"at most {MAX_RECORD_BYTES} bytes")
    if chunk.seq < 1:
        raise PayloadError(where, "seq", chunk.seq, "at least 1")
    if chunk.settled >= chunk.seq:
        raise PayloadError(where, "settled", chunk.settled, "a number below seq")
    if len(data) > CHUNK_BYTES or chunk.offset + len(data) > chunk.size:
        raise PayloadError(
            where, "payload", f"{len(data)} bytes", f"a piece of at most {CHUNK_BYTES} bytes inside size"
        )
    return chunk


def _need_version(fields: dict[str, object], where: str) -> None:
    if integer(fields, "v", where) != HANDOFF_VERSION:
        raise PayloadError(where, "v", fields["v"], str(HANDOFF_VERSION))


def integer(fields: dict[str, object], name: str, where: str) -> int:
    """Return a field that is a whole number from 0.

    Raises:
        PayloadError: It is missing or another thing.
    """
    value = fields.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 63:
        raise PayloadError(where, name, value, "a whole number from 0")
    return value


def _reason(fields: dict[str, object], where: str) -> str:
    value = fields.get("reason", "")
    if not isinstance(value, str):
        raise PayloadError(where, "reason", value, "text")
    return value


def binary(fields: dict[str, object], name: str, length: int, where: str) -> bytes:
    """Return a field that is a certain number of bytes.

    Raises:
        PayloadError: It is missing or another thing.
    """
    value = fields.get(name)
    if not isinstance(value, bytes) or len(value) != length:
        raise PayloadError(where, name, value, f"{length} bytes")
    return value
