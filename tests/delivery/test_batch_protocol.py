"""Several records in one delivery query: each has its own reply, and either side can run an older version."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress

import msgpack
import pytest
import zenoh
from builders.common import eventually
from builders.records import decision_record
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery import protocol
from sonarpost.delivery.protocol import (
    CHUNK_BYTES,
    MAX_BATCH_RECORDS,
    AckReply,
    batch_attachment,
    pack_replies,
    parse_query,
    unpack_replies,
)
from sonarpost.delivery.records import OutboxItem, ReceivedChunk
from sonarpost.errors import PayloadError, RetryLaterError
from sonarpost.messages import Decision, Record
from sonarpost.runtime.service import Service, UnitOfWork

KEY = keys.contact_decision("vessel-1")
WHERE = keys.delivery_query(KEY, "consumer")
ORIGIN = b"o" * 16
PlatformMaker = Callable[[str], PlatformConfig]


def item(seq: int, payload: bytes) -> OutboxItem:
    return OutboxItem("consumer", seq, KEY, "", 4, payload, hashlib.sha256(payload).digest())


def decision(number: int) -> bytes:
    return wire.encode(decision_record(f"d{number}"))


# Bytes


@given(st.dictionaries(st.integers(1, 2**63 - 1), st.binary(max_size=200), min_size=1, max_size=MAX_BATCH_RECORDS))
def test_packed_batch_parses_unchanged(records: dict[int, bytes]) -> None:
    items = [item(seq, payload) for seq, payload in records.items()]
    settled = min(records) - 1
    chunks = parse_query(batch_attachment(ORIGIN, items, settled), b"".join(records.values()), WHERE)
    assert chunks == tuple(ReceivedChunk(ORIGIN, i.seq, len(i.payload), i.sha256, 0, i.payload, settled) for i in items)


SHA = bytes(32)


@pytest.mark.parametrize(
    ("change", "data", "field"),
    [
        ({"v": 3}, b"ab", "v"),
        ({"v": True}, b"ab", "v"),
        ({"origin": b"short"}, b"ab", "origin"),
        ({"settled": -1}, b"ab", "settled"),
        ({"settled": 4}, b"ab", "settled"),
        ({"records": []}, b"", "records"),
        ({"records": None}, b"ab", "records"),
        ({"records": [[n, 0, SHA] for n in range(1, MAX_BATCH_RECORDS + 2)]}, b"", "records"),
        ({"records": [[4, 1, SHA], [4, 1, SHA]]}, b"ab", "records"),
        ({"records": [[4, 1, SHA], 5]}, b"ab", "records.1"),
        ({"records": [[4, 1, SHA], [5, 1]]}, b"ab", "records.1.2"),
        ({"records": [[0, 2, SHA]]}, b"ab", "records.0.0"),
        ({"records": [[True, 2, SHA]]}, b"ab", "records.0.0"),
        ({"records": [[1 << 63, 2, SHA]]}, b"ab", "records.0.0"),
        ({"records": [[4, -1, SHA]]}, b"ab", "records.0.1"),
        ({"records": [[4, CHUNK_BYTES + 1, SHA]]}, b"ab", "records.0.1"),
        ({"records": [[4, 2, b"short"]]}, b"ab", "records.0.2"),
        ({"records": [[4, 2, "text"]]}, b"ab", "records.0.2"),
        ({}, b"a", "payload"),
        ({}, b"abc", "payload"),
        ({}, bytes(CHUNK_BYTES + 1), "payload"),
    ],
)
def test_query_error_names_the_field(change: dict[str, object], data: bytes, field: str) -> None:
    fields = msgpack.unpackb(batch_attachment(ORIGIN, [item(4, b"a"), item(9, b"b")])) | change
    with pytest.raises(PayloadError, match="expected") as caught:
        parse_query(msgpack.packb(fields), data, WHERE)
    assert caught.value.field == field


@given(st.binary(max_size=80), st.binary(max_size=8))
def test_arbitrary_bytes_parse_or_raise_payload_error(attached: bytes, data: bytes) -> None:
    for parse in (lambda: parse_query(attached, data, WHERE), lambda: unpack_replies(attached, 2, WHERE)):
        with suppress(PayloadError):
            parse()


@pytest.mark.parametrize(
    ("replies", "field"),
    [
        ([["stored", ""]], "replies"),
        (None, "replies"),
        ([["stored", ""], ["more", ""]], "replies.1.0"),
        ([["stored", ""], ["stored"]], "replies.1.1"),
        ([["stored", 1], ["stored", ""]], "replies.0.1"),
        (["stored", ["stored", ""]], "replies.0"),
    ],
)
def test_reply_error_names_the_field(replies: object, field: str) -> None:
    with pytest.raises(PayloadError, match="expected") as caught:
        unpack_replies(msgpack.packb({"v": 2, "replies": replies}), 2, WHERE)
    assert caught.value.field == field


def test_batch_announcement_must_be_a_number() -> None:
    fields = msgpack.unpackb(AckReply("stored").pack()) | {"takes": "many"}
    with pytest.raises(PayloadError, match="takes"):
        AckReply.unpack(msgpack.packb(fields), WHERE)


# Producer


class Producer(Service[ServiceConfig]):
    NAME = "producer"
    PUBLISH = False

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        raise AssertionError("consumes nothing")

    def send(self, *payloads: bytes) -> None:
        effects = UnitOfWork()
        for payload in payloads:
            effects.send_payload(KEY, "consumer", payload, Decision)
        self.commit(effects)


class Listener:
    """Scripted consumer: stores the queries and replies as the test requires."""

    def __init__(
        self, session: zenoh.Session, answer: Callable[[tuple[ReceivedChunk, ...] | ReceivedChunk], bytes]
    ) -> None:
        self.asked: list[tuple[ReceivedChunk, ...] | ReceivedChunk] = []
        self._answer = answer
        session.declare_queryable(WHERE, self._on_query)

    def _on_query(self, query: zenoh.Query) -> None:
        with query:
            assert query.payload is not None
            assert query.attachment is not None
            asked = parse_query(query.attachment.to_bytes(), query.payload.to_bytes(), WHERE)
            self.asked.append(asked)
            query.reply(query.key_expr, self._answer(asked))

    @property
    def records(self) -> list[int]:
        """Sequence numbers of all queries."""
        return [c.seq for asked in self.asked for c in ([asked] if isinstance(asked, ReceivedChunk) else asked)]


@contextmanager
def running(*services: Service[ServiceConfig]) -> Iterator[None]:
    for service in services:
        service.start()
    try:
        yield
    finally:
        for service in services:
            service.stop()


@pytest.fixture
def producer(platform: PlatformMaker) -> Producer:
    return Producer(platform("vessel-1"), ServiceConfig())


def stored(asked: tuple[ReceivedChunk, ...] | ReceivedChunk, takes: int) -> bytes:
    if isinstance(asked, ReceivedChunk):
        return AckReply("stored").pack(takes)
    return pack_replies([AckReply("stored")] * len(asked))


@pytest.mark.parametrize(("takes", "most"), [(0, 1), (1, 1), (5, 5), (2**60, MAX_BATCH_RECORDS)])
def test_producer_sends_batches_of_the_announced_size(
    takes: int, most: int, producer: Producer, client: zenoh.Session
) -> None:
    listener = Listener(client, lambda asked: stored(asked, takes))
    producer.send(*(decision(n) for n in range(300)))
    with running(producer):
        eventually(lambda: producer.store.outbox_depth() == 0)
    assert isinstance(listener.asked[0], ReceivedChunk), "the consumer has not announced batches yet"
    assert listener.records == list(range(1, 301))
    longest = max(len(asked) for asked in listener.asked if not isinstance(asked, ReceivedChunk)) if most > 1 else 1
    assert longest == most
    assert all(isinstance(asked, ReceivedChunk) for asked in listener.asked) == (most == 1)


def test_records_that_do_not_fit_a_batch_are_sent_alone(producer: Producer, client: zenoh.Session) -> None:
    listener = Listener(client, lambda asked: stored(asked, MAX_BATCH_RECORDS))
    sizes = [10, CHUNK_BYTES - 5, 10, 10, CHUNK_BYTES, 7]
    producer.send(*(bytes(size) for size in sizes))
    with running(producer):
        eventually(lambda: producer.store.outbox_depth() == 0)
    assert listener.records == list(range(1, 7))
    for asked in listener.asked:
        if not isinstance(asked, ReceivedChunk):
            assert sum(chunk.size for chunk in asked) <= CHUNK_BYTES


def test_single_records_are_sent_after_a_batch_was_refused(producer: Producer, client: zenoh.Session) -> None:
    """A consumer that supports version 1 only replaces another one under the same name."""

    def answer(asked: tuple[ReceivedChunk, ...] | ReceivedChunk) -> bytes:
        if isinstance(asked, ReceivedChunk):
            return AckReply("stored").pack(MAX_BATCH_RECORDS)
        return AckReply("refused", reason="v: got 2, expected 1").pack()

    listener = Listener(client, answer)
    producer.send(*(decision(n) for n in range(30)))
    with running(producer):
        eventually(lambda: producer.store.outbox_depth() == 0)
        assert producer.store.refused_count() == 0
    alone = [asked.seq for asked in listener.asked if isinstance(asked, ReceivedChunk)]
    assert alone == list(range(1, 31))
    assert sum(not isinstance(asked, ReceivedChunk) for asked in listener.asked) >= 1


def test_each_record_of_a_batch_has_its_own_reply(producer: Producer, client: zenoh.Session) -> None:
    waited: set[int] = set()

    def answer(asked: tuple[ReceivedChunk, ...] | ReceivedChunk) -> bytes:
        if isinstance(asked, ReceivedChunk):
            return AckReply("stored").pack(MAX_BATCH_RECORDS)
        replies = []
        for chunk in asked:
            if chunk.seq == 4:
                replies.append(AckReply("refused", reason="never"))
            elif chunk.seq == 7 and chunk.seq not in waited:
                waited.add(chunk.seq)
                replies.append(AckReply("later", reason="full"))
            else:
                replies.append(AckReply("stored"))
        return pack_replies(replies)

    listener = Listener(client, answer)
    producer.send(*(decision(n) for n in range(1, 11)))
    with running(producer):
        eventually(lambda: producer.store.outbox_depth() == 0)
        assert producer.store._query("SELECT payload, reason FROM refused") == [(decision(4), "never")]
        assert producer.acknowledged_count("consumer") == 9
    assert waited == {7}
    assert sorted(set(listener.records)) == list(range(1, 11))
    assert all(listener.records.count(seq) == (2 if seq == 7 else 1) for seq in range(1, 11))


# Consumer


class Consumer(Service[ServiceConfig]):
    """Consumes decisions; reports a full disk while `full` is set."""

    NAME = "consumer"

    def __init__(self, platform: PlatformConfig, config: ServiceConfig) -> None:
        super().__init__(platform, config)
        self.got: list[str] = []
        self.full = False

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        return {KEY: Decision}

    def check_capacity(self, key: str) -> None:
        if self.full:
            raise RetryLaterError("disk full")

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        assert isinstance(record, Decision)
        self.got.append(record.decision_id)


def ask(client: zenoh.Session, items: list[OutboxItem], data: bytes | None = None) -> tuple[AckReply, ...] | AckReply:
    querier = client.declare_querier(WHERE)
    eventually(lambda: querier.matching_status.matching)
    payload = b"".join(i.payload for i in items) if data is None else data
    received = client.get(WHERE, payload=payload, attachment=batch_attachment(ORIGIN, items), timeout=5).recv()
    assert received.ok is not None
    return unpack_replies(received.ok.payload.to_bytes(), len(items), WHERE)


def test_consumer_accepts_valid_records_once_and_refuses_invalid_ones_each_time(
    platform: PlatformMaker, client: zenoh.Session
) -> None:
    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    wrong_digest = OutboxItem("consumer", 4, KEY, "", 4, decision(4), bytes(32))
    items = [item(1, decision(1)), item(2, b"\x93 rubbish"), item(3, decision(3)), wrong_digest, item(5, b"")]
    with running(consumer):
        first = ask(client, items)
        again = ask(client, items)
        eventually(lambda: consumer.got == ["d1", "d3"])
        assert consumer.store.refused_count() == 4
    assert isinstance(first, tuple)
    assert isinstance(again, tuple)
    expected = ["stored", "refused", "stored", "refused", "refused"]
    assert [reply.status for reply in first] == [reply.status for reply in again] == expected
    assert "msgpack map" in first[1].reason
    assert "the digest of the record" in first[3].reason
    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    with running(consumer):
        after_restart = ask(client, items)
        assert isinstance(after_restart, tuple)
        assert [reply.status for reply in after_restart] == expected
        assert consumer.store.inbox_depth() == 0
    assert consumer.got == []


def test_malformed_batch_gets_a_single_refusal(platform: PlatformMaker, client: zenoh.Session) -> None:
    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    with running(consumer):
        reply = ask(client, [item(1, decision(1)), item(2, decision(2))], data=b"short")
        assert isinstance(reply, AckReply)
        assert reply.status == "refused"
        assert consumer.store.refused_count() == 0, "no record could be identified"
        taken = ask(client, [item(1, decision(1)), item(2, decision(2))])
        assert taken == (AckReply("stored"), AckReply("stored"))


def test_producer_keeps_records_while_the_consumer_has_no_space(
    producer: Producer, platform: PlatformMaker, client: zenoh.Session
) -> None:
    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    with running(consumer, producer):
        producer.send(decision(0))
        eventually(lambda: consumer.got == ["d0"])
        consumer.full = True
        asked = ask(client, [item(1, decision(91)), item(2, decision(92))])
        assert isinstance(asked, tuple)
        assert [reply.status for reply in asked] == ["later", "later"]
        producer.send(*(decision(n) for n in range(1, 40)))
        eventually(lambda: not producer.is_responding("consumer"))
        assert producer.store.outbox_depth() == 39
        consumer.full = False
        eventually(lambda: len(consumer.got) == 40)
    assert sorted(consumer.got) == sorted(f"d{n}" for n in range(40))


def test_store_write_error_rejects_the_whole_batch(platform: PlatformMaker, client: zenoh.Session) -> None:
    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    items = [item(n, decision(n)) for n in range(1, 60)]
    with running(consumer):
        pages = consumer.store._query("PRAGMA page_count")[0][0]
        consumer.store._db.execute(f"PRAGMA max_page_count={pages}")
        reply = ask(client, items)
        assert isinstance(reply, AckReply)
        assert reply.status == "later"
        assert consumer.store.inbox_depth() == 0
        consumer.store._db.execute("PRAGMA max_page_count=1000000")
        assert ask(client, items) == (AckReply("stored"),) * 59
        eventually(lambda: len(consumer.got) == 59)


def test_batch_with_gaps_is_accepted_and_recognised_again(platform: PlatformMaker, client: zenoh.Session) -> None:
    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    with running(consumer):
        querier = client.declare_querier(WHERE)
        eventually(lambda: querier.matching_status.matching)
        items = [item(8, decision(8)), item(9, decision(9))]
        payload = b"".join(i.payload for i in items)
        client.get(WHERE, payload=payload, attachment=batch_attachment(ORIGIN, items, done_up_to=7), timeout=5).recv()
        assert consumer.store._query("SELECT highest FROM received_window") == [(9,)]
        single = protocol.attachment(ORIGIN, items[0])
        received = client.get(WHERE, payload=items[0].payload, attachment=single, timeout=5).recv()
        assert received.ok is not None
        reply = AckReply.unpack(received.ok.payload.to_bytes(), WHERE)
        assert (reply.status, reply.max_batch) == ("stored", MAX_BATCH_RECORDS)
        eventually(lambda: consumer.got == ["d8", "d9"])
