"""Store, outbox and inbox of the product without threads, over a network in memory.

Each step of `Delivery` is one event: a record is queued, queries are sent, some of them arrive, replies arrive or are
lost, a process is killed, a store is restored from a backup. A kill keeps only the files of the store.
"""

import hashlib
import shutil
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace

import msgpack
import zenoh

from sonarpost import keys
from sonarpost.delivery.inbox import Inbox
from sonarpost.delivery.protocol import AckReply
from sonarpost.delivery.queue_sender import QueuePolicy, QueueSender
from sonarpost.delivery.records import Topic
from sonarpost.delivery.store import Store
from sonarpost.errors import PayloadError

CONSUMER = "relay"
WAIT_LIMIT = 60
"""Rounds after which all records must be delivered when no fault occurs."""


@dataclass(eq=False)
class SentQuery:
    """A query in the network; it can arrive any number of times. It ends once: with a reply, or by its time-out."""

    key: str
    content: bytes
    attached: bytes
    handler: zenoh.handlers.Callback = None
    has_ended: bool = False
    replies: list[bytes] = field(default_factory=list)

    @property
    def key_expr(self):
        return self.key

    @property
    def payload(self):
        return zenoh.ZBytes(self.content)

    @property
    def attachment(self):
        return zenoh.ZBytes(self.attached)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return

    def reply(self, key, payload):
        assert key == self.key
        self.replies.append(payload)

    def end(self, reply=None):
        """End the query at its sender, unless it has ended before; None for the time-out."""
        if not self.has_ended:
            self.has_ended = True
            ok = None if reply is None else SimpleNamespace(payload=zenoh.ZBytes(reply))
            self.handler.callback(SimpleNamespace(ok=ok))
            self.handler.drop()


class Network:
    """Stands for the session of a producer."""

    def __init__(self):
        self.sent = []
        self.published = []

    def get(self, key, handler, *, payload, attachment, **_):
        self.sent.append(SentQuery(key, payload, attachment, handler))

    def put(self, key, payload, *, attachment, **_):
        del key, payload
        self.published.append(msgpack.unpackb(attachment))


class SteppedSender(QueueSender):
    """The product's sender; the test calls its parts in place of its thread."""

    def __init__(self, network, store, queue):
        super().__init__(network, store, queue, QueuePolicy(), lambda _tx, _item, _reason: None)
        store.on_queued = lambda _, place: self.on_new(place)

    def _run(self):
        return


class SteppedInbox(Inbox):
    """The product's inbox; the test calls its parts in place of its thread."""

    def _run(self):
        return

    def receive(self, queries):
        """Commit queries in one transaction and reply."""
        for query in queries:
            self._on_query(query)
        while not self._messages.empty():
            messages = self._next_messages()
            self._reply(messages, self._commit(messages))


def validate(key, payload):
    """Require that a record starts with its key and is not marked as invalid."""
    if not payload.startswith(key.encode() + b" valid"):
        raise PayloadError(key, "payload", payload[:60], "a valid record of this key")


def copy_store(source, target):
    """Copy the files of a store as they are after a kill: without the shared memory file."""
    target.mkdir()
    for path in source.parent.iterdir():
        if not path.name.endswith(("-shm", ".lock")):
            shutil.copy(path, target / path.name)
    return target / source.name


class Sending:
    """A producer: its store, its sender and what the test expects of it."""

    def __init__(self, path, network):
        path.parent.mkdir()
        self.network = network
        self.store = Store(path)
        self.sender = self._new_sender()
        self.backup = None
        self.was_restored = False

    def _new_sender(self):
        return SteppedSender(self.network, self.store, CONSUMER)

    def reopen(self, path):
        """Start with another copy of the store; what was in memory is lost."""
        self.store.close()
        self.store = Store(path)
        self.sender = self._new_sender()

    def queued(self):
        """Payloads of the outbox."""
        return {bytes(row[0]) for row in self.store._query("SELECT payload FROM outbox")}

    def send(self):
        if self.sender._failure is None:
            self.sender._load()
            self.sender._send_queries()

    def use_replies(self):
        self.sender._process_ended()
        if self.sender._failure is not None and not self.sender._in_flight:
            self.sender._back_off(self.sender._failure)


class Delivery:
    """Two producers and a consumer, with a ledger of all records."""

    def __init__(self, folder, producer_keys, hostile_keys):
        self._folder = folder
        self._copies = 0
        self.network = Network()
        self.producer_keys = producer_keys
        self.hostile_keys = hostile_keys
        self.producers = [Sending(folder / f"producer-{n}" / "p.db", self.network) for n in range(len(producer_keys))]
        (folder / "consumer").mkdir()
        self.store = Store(folder / "consumer" / "c.db")
        self.refused = []
        self.handles_at_once = False
        self.inbox = self._new_inbox()
        self.handled = Counter()
        self.valid = {}
        self.excused = set()
        self.serial = 0

    def _new_inbox(self):
        accepting = self._accepting
        return SteppedInbox(None, self.store, CONSUMER, (), validate, self.refused.append, accepting=accepting)

    @contextmanager
    def _accepting(self):
        handled = []

        def handle(key, payload, _record):
            if may_handle:
                handled.append((key, payload))
            return may_handle

        with self.store.transaction() as tx:
            may_handle = self.handles_at_once and tx.is_inbox_empty()
            yield tx, handle
        self.handled.update(handled)

    def _copy(self, store):
        self._copies += 1
        return copy_store(store.path, self._folder / f"copy-{self._copies}")

    # Producers

    def queue(self, which, key, size_bytes, *, valid=True, topic=""):
        self.serial += 1
        mark = "valid" if valid else "invalid"
        payload = f"{key} {mark} {self.serial} ".encode()
        payload += hashlib.shake_128(payload).digest(max(0, size_bytes - len(payload)))
        producer = self.producers[which]
        before = producer.queued()
        with producer.store.transaction() as tx:
            edition = Topic(topic, self.serial) if topic else None
            assert tx.send(key, CONSUMER, payload, encoding="e", topic=edition)
        self.excused |= before - producer.queued()  # replaced by the newer edition
        if valid:
            self.valid[payload] = key

    def kill_producer(self, which):
        producer = self.producers[which]
        producer.reopen(self._copy(producer.store))

    def back_up(self, which):
        self.producers[which].backup = self._copy(self.producers[which].store)

    def restore(self, which):
        producer = self.producers[which]
        assert producer.backup is not None
        before = producer.queued()
        self._copies += 1
        producer.reopen(copy_store(producer.backup, self._folder / f"copy-{self._copies}"))
        producer.was_restored = True
        self.excused |= before - producer.queued()  # lost with the replaced store

    # Consumer

    def kill_consumer(self):
        path = self._copy(self.store)
        self.store.close()
        self.store = Store(path)
        self.inbox = self._new_inbox()

    def receive(self, queries):
        self.inbox.receive(queries)
        assert not self.inbox.storage_failing

    def handle(self, limit):
        items = self.store.inbox_items(limit)
        with self.store.transaction() as tx:
            for item in items:
                tx.remove_handled(item)
        self.handled.update((item.key, item.payload) for item in items)

    def consumer_state_of_producers(self):
        """Duplicate windows and chunks of all keys to which the hostile peer may not write."""
        allowed = tuple(self.hostile_keys)
        other_key = f"key NOT IN ({', '.join('?' * len(allowed))})"
        windows = "SELECT key, origin, seq, received.sha256 FROM received_window JOIN received ON window = id"
        chunks = "SELECT key, origin, seq, sha256, start, data FROM partial JOIN partial_piece ON partial = id"
        return [
            self.store._query(f"{select} WHERE {other_key} ORDER BY 1, 2, 3, 4", allowed)
            for select in (windows, chunks, "SELECT key, payload, origin, seq FROM inbox")
        ]

    # Invariants

    def check(self):
        """Check I1 to I3, I6 and that no publication holds an origin."""
        accepted = self.handled.copy()
        accepted.update((str(key), bytes(p)) for key, p in self.store._query("SELECT key, payload FROM inbox"))
        held = set().union(*(producer.queued() for producer in self.producers))
        for payload, key in self.valid.items():
            assert accepted[key, payload] <= 1, f"I2: {payload[:60]!r} was accepted more than once"
            arrived = accepted[key, payload] == 1
            assert arrived or payload in held or payload in self.excused, f"I1: {payload[:60]!r} is lost"
        for key, payload in accepted:
            assert key in self.hostile_keys or self.valid.get(payload) == key, f"I3: {payload[:60]!r} on {key}"
        for producer in self.producers:
            assert producer.was_restored or not producer.sender.restored, "I6: a restore without a restored store"
        origins = {msgpack.unpackb(query.attached).get("origin") for query in self.network.sent}
        for fields in self.network.published:
            assert fields["origin"] not in origins
        self.network.published.clear()

    def deliver_everything(self):
        """Run without faults until all outboxes are empty."""
        for query in self.network.sent:
            query.end()
        for _ in range(WAIT_LIMIT):
            for producer in self.producers:
                producer.use_replies()
                producer.sender._remove_acknowledged()
                before = len(self.network.sent)
                producer.send()
                for query in self.network.sent[before:]:
                    self.receive([query])
                    query.end(query.replies[-1])
                    assert _status(query.replies[-1]) != "later"
            if not any(producer.queued() for producer in self.producers):
                break
        assert not any(producer.queued() for producer in self.producers), "P1: records stay queued"

    def close(self):
        self.store.close()
        for producer in self.producers:
            producer.store.close()


def _status(reply):
    if msgpack.unpackb(reply)["v"] != 1:
        return "batch"
    return AckReply.unpack(reply, "reply").status


def query_of(key, origin, records, done_up_to, *, whole_bytes=0):
    """Return a query of a peer that is not bound to the rules of a producer.

    Args:
        key: Key of the records.
        origin: Origin that it states.
        records: (number, bytes, digest) of each; more than one makes a batch.
        done_up_to: Number that it states.
        whole_bytes: Size of the record if the bytes are its first chunk only.
    """
    if len(records) == 1:
        seq, data, digest = records[0]
        size = max(whole_bytes, len(data))
        fields = {"v": 1, "seq": seq, "size": size, "sha256": digest, "offset": 0}
    else:
        digests = b"".join(digest for _, _, digest in records)
        fields = {"v": 3, "records": [(seq, len(data)) for seq, data, _ in records]}
        fields["sha256"] = hashlib.sha256(digests).digest()
    attached = msgpack.packb(fields | {"origin": origin, "consumer": CONSUMER, "done_up_to": done_up_to})
    content = b"".join(data for _, data, _ in records)
    return SentQuery(keys.delivery_query(key, CONSUMER), content, attached)
