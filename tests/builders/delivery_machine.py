"""Store, outbox and inbox of the product without threads, over a network in memory.

Each step of `Delivery` is one event: a record is queued, queries are sent, some of them arrive, replies arrive or are
lost, a process is killed, a store is restored from a backup. A kill keeps only the files of the store.
"""

from __future__ import annotations

import hashlib
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import msgpack
import zenoh

from sonarpost import keys
from sonarpost.delivery.inbox import Inbox
from sonarpost.delivery.outbox import QueuePolicy, QueueSender, _NoReplyError
from sonarpost.delivery.protocol import AckReply, watcher_origin
from sonarpost.delivery.records import Topic
from sonarpost.delivery.store import Store
from sonarpost.errors import BadInputError, PayloadError

CONSUMER = "relay"
WAIT_LIMIT = 60
"""Rounds after which all records must be delivered when no fault occurs."""


@dataclass(frozen=True)
class Bytes:
    """Stands for `zenoh.ZBytes`."""

    content: bytes

    def to_bytes(self) -> bytes:
        return self.content


@dataclass(frozen=True)
class Received:
    """Stands for `zenoh.Reply` and its sample."""

    payload: Bytes

    @property
    def ok(self) -> Received:
        return self


class Handler:
    """Stands for the handler of a query: one reply, or an error after the time-out."""

    def __init__(self) -> None:
        self.reply: bytes | None = None
        self.timed_out = False

    def try_recv(self) -> Received | None:
        if self.timed_out:
            raise zenoh.ZError("no reply")
        return None if self.reply is None else Received(Bytes(self.reply))


@dataclass(eq=False)
class SentQuery:
    """A query in the network; it can arrive any number of times."""

    key: str
    content: bytes
    attached: bytes
    handler: Handler = field(default_factory=Handler)
    replies: list[bytes] = field(default_factory=list)

    @property
    def key_expr(self) -> str:
        return self.key

    @property
    def payload(self) -> Bytes:
        return Bytes(self.content)

    @property
    def attachment(self) -> Bytes:
        return Bytes(self.attached)

    def __enter__(self) -> SentQuery:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def reply(self, key: str, payload: bytes) -> None:
        assert key == self.key
        self.replies.append(payload)


class Network:
    """Stands for the session of a producer."""

    def __init__(self) -> None:
        self.sent: list[SentQuery] = []
        self.published: list[dict[str, Any]] = []

    def get(self, key: str, *, payload: bytes, attachment: bytes, **_: object) -> Handler:
        query = SentQuery(key, payload, attachment)
        self.sent.append(query)
        return query.handler

    def put(self, key: str, payload: bytes, *, attachment: bytes, **_: object) -> None:
        del key, payload
        self.published.append(msgpack.unpackb(attachment))


class SteppedSender(QueueSender):
    """The product's sender; the test calls its parts in place of its thread."""

    def _run(self) -> None:
        return


class SteppedInbox(Inbox):
    """The product's inbox; the test calls its parts in place of its thread."""

    def _run(self) -> None:
        return

    def receive(self, queries: Sequence[SentQuery]) -> None:
        """Commit queries in one transaction and reply."""
        for query in queries:
            self._on_query(cast(zenoh.Query, query))
        while not self._messages.empty():
            messages = self._next_messages()
            self._reply(messages, self._commit(messages))


def validate(key: str, payload: bytes) -> None:
    """Require that a record starts with its key and is not marked as invalid."""
    if not payload.startswith(key.encode() + b" valid"):
        raise PayloadError(key, "payload", payload[:60], "a valid record of this key")


def copy_store(source: Path, target: Path) -> Path:
    """Copy the files of a store as they are after a kill: without the shared memory file."""
    target.mkdir()
    for path in source.parent.iterdir():
        if not path.name.endswith(("-shm", ".lock")):
            shutil.copy(path, target / path.name)
    return target / source.name


def open_store(path: Path) -> Store:
    """Open a store; commits need no flush, because only processes are killed here."""
    store = Store(path)
    store._db.execute("PRAGMA synchronous=OFF")
    return store


class Sending:
    """A producer: its store, its sender and what the test expects of it."""

    def __init__(self, path: Path, network: Network) -> None:
        path.parent.mkdir()
        self.network = network
        self.store = open_store(path)
        self.sender = self._new_sender()
        self.backup: Path | None = None
        self.was_restored = False

    def _new_sender(self) -> SteppedSender:
        session = cast(zenoh.Session, self.network)
        return SteppedSender(session, self.store, CONSUMER, QueuePolicy(), None)

    def reopen(self, path: Path) -> None:
        """Start with another copy of the store; what was in memory is lost."""
        self.store.close()
        self.store = open_store(path)
        self.sender = self._new_sender()

    def queued(self) -> set[bytes]:
        """Payloads of the outbox."""
        return {bytes(row[0]) for row in self.store._query("SELECT payload FROM outbox")}

    def send(self) -> None:
        self.sender._load()
        self.sender._send_queries()

    def use_replies(self) -> None:
        try:
            self.sender._process_replies()
        except _NoReplyError as error:
            self.sender._back_off(str(error))


class Delivery:
    """Two producers and a consumer, with a ledger of all records."""

    def __init__(self, folder: Path, producer_keys: Sequence[Sequence[str]], hostile_keys: Sequence[str]) -> None:
        self._folder = folder
        self._copies = 0
        self.network = Network()
        self.producer_keys = producer_keys
        self.hostile_keys = hostile_keys
        self.producers = [Sending(folder / f"producer-{n}" / "p.db", self.network) for n in range(len(producer_keys))]
        (folder / "consumer").mkdir()
        self.store = open_store(folder / "consumer" / "c.db")
        self.refused: list[BadInputError] = []
        self.inbox = self._new_inbox()
        self.handled: Counter[tuple[str, bytes]] = Counter()
        self.valid: dict[bytes, str] = {}
        self.excused: set[bytes] = set()
        self.serial = 0

    def _new_inbox(self) -> SteppedInbox:
        session = cast(zenoh.Session, None)  # no key expressions are declared
        return SteppedInbox(session, self.store, CONSUMER, (), validate, self.refused.append)

    def _copy(self, store: Store) -> Path:
        self._copies += 1
        return copy_store(store.path, self._folder / f"copy-{self._copies}")

    # Producers

    def queue(self, which: int, key: str, size_bytes: int, *, valid: bool = True, topic: str = "") -> None:
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

    def kill_producer(self, which: int) -> None:
        producer = self.producers[which]
        producer.reopen(self._copy(producer.store))

    def back_up(self, which: int) -> None:
        self.producers[which].backup = self._copy(self.producers[which].store)

    def restore(self, which: int) -> None:
        producer = self.producers[which]
        assert producer.backup is not None
        before = producer.queued()
        self._copies += 1
        producer.reopen(copy_store(producer.backup, self._folder / f"copy-{self._copies}"))
        producer.was_restored = True
        self.excused |= before - producer.queued()  # lost with the replaced store

    # Consumer

    def kill_consumer(self) -> None:
        path = self._copy(self.store)
        self.store.close()
        self.store = open_store(path)
        self.inbox = self._new_inbox()

    def receive(self, queries: Sequence[SentQuery]) -> None:
        self.inbox.receive(queries)
        assert not self.inbox.storage_failing

    def handle(self, limit: int) -> None:
        items = self.store.inbox_items(limit)
        with self.store.transaction() as tx:
            for item in items:
                tx.remove_handled(item)
        self.handled.update((item.key, item.payload) for item in items)

    def consumer_state_of_producers(self) -> list[list[tuple[Any, ...]]]:
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

    def check(self) -> None:
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

    def deliver_everything(self) -> None:
        """Run without faults until all outboxes are empty."""
        for query in self.network.sent:
            query.handler.timed_out = query.handler.reply is None
        for _ in range(WAIT_LIMIT):
            for producer in self.producers:
                producer.use_replies()
                producer.sender._remove_acknowledged()
                before = len(self.network.sent)
                producer.send()
                for query in self.network.sent[before:]:
                    self.receive([query])
                    query.handler.reply = query.replies[-1]
                    assert _status(query.replies[-1]) != "later"
            if not any(producer.queued() for producer in self.producers):
                break
        assert not any(producer.queued() for producer in self.producers), "P1: records stay queued"

    def close(self) -> None:
        self.store.close()
        for producer in self.producers:
            producer.store.close()


def _status(reply: bytes) -> str:
    if msgpack.unpackb(reply)["v"] != 1:
        return "batch"
    return AckReply.unpack(reply, "reply").status


def query_of(
    key: str, origin: bytes, records: Sequence[tuple[int, bytes, bytes]], settled: int, *, whole_bytes: int = 0
) -> SentQuery:
    """Return a query of a peer that is not bound to the rules of a producer.

    Args:
        key: Key of the records.
        origin: Origin that it states.
        records: (number, bytes, digest) of each; more than one makes a batch.
        settled: Number that it states.
        whole_bytes: Size of the record if the bytes are its first chunk only.
    """
    if len(records) == 1:
        seq, data, digest = records[0]
        size = max(whole_bytes, len(data))
        fields: dict[str, Any] = {"v": 1, "seq": seq, "size": size, "sha256": digest, "offset": 0}
    else:
        fields = {"v": 2, "records": [(seq, len(data), digest) for seq, data, digest in records]}
    attached = msgpack.packb(fields | {"origin": origin, "consumer": CONSUMER, "settled": settled})
    content = b"".join(data for _, data, _ in records)
    return SentQuery(keys.delivery_query(key, CONSUMER), content, attached)


def origin_for_watchers(query: SentQuery) -> bytes:
    """Return the origin that watchers receive for the records of a query."""
    return watcher_origin(msgpack.unpackb(query.attached)["origin"])
