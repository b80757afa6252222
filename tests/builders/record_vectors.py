"""Add golden vectors of the Zenoh wire: `PYTHONPATH=tests python -m builders.record_vectors` from the repository root.

A vector holds the bytes of a record at the time of its creation. Older programs still use these bytes, so a vector is
never changed or removed. This script adds those of `record_samples.NEW_SAMPLES` and `delivery_samples()`, and fails if
an existing one would change. A record that gains a field needs a new sample, with a new name.
"""

import hashlib
import json

import msgpack

from builders.record_samples import FOLDER, NEW_SAMPLES, vectors
from sonarpost import wire
from sonarpost.delivery import protocol
from sonarpost.delivery.protocol import AckReply, attachment
from sonarpost.delivery.records import OutboxItem

BATCH = ((7, 1), (9, 0), (2**40, 300))


def plain(value: object) -> object:
    """Return a msgpack value for JSON: bytes become {"$hex": "…"}."""
    if isinstance(value, bytes):
        return {"$hex": value.hex()}
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    return value


def delivery_samples() -> dict[str, dict[str, bytes]]:
    """Return attachments and replies by file and name."""
    item = OutboxItem("c2", 7, "k", "", 4, b"\x80", bytes.fromhex("11" * 32))
    large = OutboxItem("relay", 2**40, "k", "", 4, b"\x00" * 100_000, bytes.fromhex("22" * 32))
    return {
        "delivery-attachment": {
            "first-piece": attachment(bytes(range(16)), item),
            "second-piece": attachment(bytes(range(16)), large, 32768),
            "after-dropped-ones": attachment(bytes(range(16)), item, 0, 5),
        },
        "delivery-reply": {
            "stored": AckReply("stored").pack(),
            "more": AckReply("more", next_offset=65536).pack(),
            "refused": AckReply("refused", reason="k: v: got 2, expected 1").pack(),
            "later": AckReply("later", reason="disk is full").pack(),
            "stored-takes-several": AckReply("stored").pack(max_batch=128),
            "more-with-highest": AckReply("more", 32768, highest=41, highest_sha256=bytes.fromhex("33" * 32)).pack(),
        },
    }


def batch_samples() -> dict[str, dict[str, bytes]]:
    """Return attachments and replies of queries with several records, by file and name."""
    records = [(seq, bytes([number]) * size) for number, (seq, size) in enumerate(BATCH)]
    items = [OutboxItem("c2", seq, "k", "", 4, data, hashlib.sha256(data).digest()) for seq, data in records]
    replies = [
        AckReply("stored"),
        AckReply("refused", reason="k: v: got 2, expected 1"),
        AckReply("later", reason="full"),
    ]
    return {
        "delivery-batch-attachment": {
            "three-records": protocol.batch_attachment(bytes(range(16)), items),
            "after-dropped-ones": protocol.batch_attachment(bytes(range(16)), items, 6),
        },
        "delivery-batch-reply": {
            "one-of-each": protocol.pack_replies(replies),
            "all-stored": protocol.pack_replies(replies[:1] * 3),
        },
    }


def add(of: str, name: str, payload: bytes) -> bool:
    """Add a vector to its file; return whether it is new."""
    present = vectors(of)
    vector = {"hex": payload.hex(), "fields": plain(msgpack.unpackb(payload))}
    if name in present:
        if present[name] != vector:
            raise SystemExit(f"{of}: {name} would change; give the new one another name")
        return False
    present[name] = vector
    (FOLDER / f"{of}.json").write_text(json.dumps(present, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return True


def main() -> None:
    """Add missing vectors."""
    added = 0
    for name, record in NEW_SAMPLES.items():
        added += add(record.TYPE, name, wire.encode(record))
    for file, payloads in (delivery_samples() | batch_samples()).items():
        for name, payload in payloads.items():
            added += add(file, name, payload)
    print(f"{added} vectors added")


if __name__ == "__main__":
    main()
