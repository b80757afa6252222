"""Common steps of the tests of the durable store."""

import hashlib

from sonarpost.delivery.records import ReceivedChunk

ORIGIN = b"o" * 16


def send(store, *payloads, consumer="c", priority=4):
    with store.transaction() as tx:
        return [tx.send("k", consumer, p, encoding="e", priority=priority) for p in payloads]


def record(seq, payload, origin=ORIGIN, done_up_to=0):
    """Return a record that arrives in one chunk."""
    return ReceivedChunk(origin, seq, len(payload), hashlib.sha256(payload).digest(), 0, payload, done_up_to)


def queued_items(store, queue, limit):
    return store.queued_items(queue, store.queued_numbers(queue, limit))


def fail_within(store, write):
    """Write in a transaction that is then ended by an exception."""
    with store.transaction() as tx:
        write(tx)
        raise ZeroDivisionError
