"""Delivery between two services over an in-process router."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

import msgpack
import pytest
import zenoh
from builders.common import eventually
from builders.records import decision_record

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery import protocol
from sonarpost.delivery.protocol import CHUNK_BYTES, AckReply
from sonarpost.delivery.records import OutboxItem
from sonarpost.errors import BadInputError, PayloadError
from sonarpost.messages import Decision, Record
from sonarpost.runtime.service import Service, UnitOfWork

KEY = keys.contact_decision("vessel-1")


def decision(number: int, remark: str = "") -> Decision:
    return decision_record(f"d{number}", remark=remark)


class Producer(Service[ServiceConfig]):
    """Sends the records of a test."""

    NAME = "producer"

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        raise AssertionError("consumes nothing")

    def send(self, number: int, remark: str = "", priority: int = 4) -> None:
        effects = UnitOfWork()
        effects.send(KEY, "consumer", decision(number, remark), priority=priority)
        self.commit(effects)


class Consumer(Service[ServiceConfig]):
    """Stores the received decisions in order."""

    NAME = "consumer"

    def __init__(self, platform: PlatformConfig, config: ServiceConfig) -> None:
        super().__init__(platform, config)
        self.got: list[str] = []
        self.fail_on: dict[str, Exception] = {}

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        return {KEY: Decision}

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        assert isinstance(record, Decision)
        error = self.fail_on.get(record.decision_id)
        if error is not None:
            if isinstance(error, OSError):
                del self.fail_on[record.decision_id]
            raise error
        self.got.append(record.decision_id)


PlatformMaker = Callable[[str], PlatformConfig]


@pytest.fixture
def producer(platform: PlatformMaker) -> Producer:
    return Producer(platform("vessel-1"), ServiceConfig())


@pytest.fixture
def consumer(platform: PlatformMaker) -> Consumer:
    return Consumer(platform("vessel-1"), ServiceConfig())


def test_records_queued_before_the_consumer_exists_arrive_once_and_in_order(
    producer: Producer, consumer: Consumer
) -> None:
    for number in range(50):
        producer.send(number)
    producer.start()
    consumer.start()
    try:
        eventually(lambda: len(consumer.got) == 50)
        eventually(lambda: producer.store.outbox_depth() == 0)
        assert consumer.got == [f"d{n}" for n in range(50)]
        # Counted at the commit, which can follow the producer's removal of the last record.
        eventually(lambda: consumer.health().counters["records_handled"] == 50)
    finally:
        producer.stop()
        consumer.stop()


def test_urgent_record_is_sent_first(producer: Producer, consumer: Consumer) -> None:
    for number in range(20):
        producer.send(number, priority=6)
    producer.send(99, priority=1)
    producer.start()
    consumer.start()
    try:
        eventually(lambda: len(consumer.got) == 21)
        assert consumer.got[0] == "d99"
    finally:
        producer.stop()
        consumer.stop()


def test_subscriber_receives_each_record_with_origin_and_sequence(
    producer: Producer, consumer: Consumer, client: zenoh.Session
) -> None:
    seen: list[tuple[bytes, dict[str, object]]] = []
    client.declare_subscriber(
        KEY, lambda s: seen.append((s.payload.to_bytes(), msgpack.unpackb(s.attachment.to_bytes())))
    )
    producer.start()
    consumer.start()
    try:
        producer.send(1)
        producer.send(2)
        eventually(lambda: len(seen) == 2)
        assert [msgpack.unpackb(p)["decision_id"] for p, _ in seen] == ["d1", "d2"]
        assert [a["seq"] for _, a in seen] == [1, 2]
        (origin,) = producer.store._query("SELECT origin FROM outbox_next")[0]
        assert {a["origin"] for _, a in seen} == {hashlib.sha256(b"watcher" + origin).digest()[:16]}
        eventually(lambda: consumer.got == ["d1", "d2"])
    finally:
        producer.stop()
        consumer.stop()


def test_restarted_consumer_discards_a_repeated_record(
    producer: Producer, platform: PlatformMaker, client: zenoh.Session
) -> None:
    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    consumer.start()
    payload = wire.encode(decision(1))
    item = OutboxItem("consumer", 1, KEY, "", 4, payload, hashlib.sha256(payload).digest())

    def ask() -> AckReply:
        replies = client.get(
            keys.delivery_query(KEY, "consumer"),
            payload=payload,
            attachment=protocol.attachment(b"o" * 16, item),
            timeout=5,
        )
        return AckReply.unpack(replies.recv().ok.payload.to_bytes(), KEY)

    querier = client.declare_querier(keys.delivery_query(KEY, "consumer"))
    eventually(lambda: bool(querier.matching_status.matching))
    assert ask().status == "stored"
    eventually(lambda: consumer.got == ["d1"])
    consumer.stop()
    eventually(lambda: not querier.matching_status.matching)
    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    consumer.start()
    try:
        eventually(lambda: bool(querier.matching_status.matching))
        # As if the acknowledgement was lost: the producer repeats the query.
        assert ask().status == "stored"
        producer.start()
        producer.send(7)
        eventually(lambda: consumer.got == ["d7"])
    finally:
        consumer.stop()
        producer.stop()


def test_chunked_record_resumes_after_a_restart(platform: PlatformMaker, client: zenoh.Session) -> None:
    payload = wire.encode(decision(1, "x" * 2000)) + b""
    # Text fields are too short for a large record: use small chunks instead.
    sha = hashlib.sha256(payload).digest()
    item = OutboxItem("consumer", 1, KEY, "", 4, payload, sha)

    def ask(offset: int, end: int) -> AckReply:
        querier = client.declare_querier(keys.delivery_query(KEY, "consumer"))
        eventually(lambda: querier.matching_status.matching)
        replies = client.get(
            keys.delivery_query(KEY, "consumer"),
            payload=payload[offset:end],
            attachment=protocol.attachment(b"o" * 16, item, offset),
            timeout=5,
        )
        return AckReply.unpack(replies.recv().ok.payload.to_bytes(), KEY)

    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    consumer.start()
    assert ask(0, 500) == AckReply("more", 500)
    assert ask(900, 1000) == AckReply("more", 500)
    consumer.stop()
    consumer = Consumer(platform("vessel-1"), ServiceConfig())
    consumer.start()
    try:
        assert ask(0, 500) == AckReply("more", 500)
        assert ask(500, len(payload)) == AckReply("stored")
        eventually(lambda: consumer.got == ["d1"])
    finally:
        consumer.stop()


class Bulky(Decision):
    """A decision with binary data of any size, for records of many chunks."""

    TYPE = "bulky"
    data: bytes


class BulkyConsumer(Consumer):
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        return {KEY: Bulky}


@pytest.mark.parametrize("size", [CHUNK_BYTES - 300, CHUNK_BYTES, 3 * CHUNK_BYTES + 5, 40 * CHUNK_BYTES])
def test_large_records_are_sent_in_chunks(size: int, producer: Producer, platform: PlatformMaker) -> None:
    consumer = BulkyConsumer(platform("vessel-1"), ServiceConfig())
    producer.start()
    consumer.start()
    try:
        for number in range(3):
            effects = UnitOfWork()
            fields = decision(number).model_dump()
            effects.send(KEY, "consumer", Bulky(**fields, data=bytes([number]) * size))
            producer.commit(effects)
        eventually(lambda: consumer.got == ["d0", "d1", "d2"])
        eventually(lambda: producer.store.outbox_depth() == 0)
    finally:
        producer.stop()
        consumer.stop()


def test_invalid_record_is_refused_and_quarantined_on_both_sides(
    producer: Producer, platform: PlatformMaker, caplog: pytest.LogCaptureFixture
) -> None:
    consumer = BulkyConsumer(platform("vessel-1"), ServiceConfig())
    producer.start()
    consumer.start()
    try:
        producer.send(1)
        eventually(lambda: producer.store.refused_count() == 1)
        assert consumer.store.refused_count() == 1
        assert producer.store.outbox_depth() == 0
        assert consumer.got == []
        refused = next(r for r in caplog.records if r.message == "Record refused")
        assert "expected 'bulky'" in str(vars(refused)["fields"])
        assert consumer.health().counters["records_refused"] == 1
    finally:
        producer.stop()
        consumer.stop()


def test_plain_publication_of_a_third_party_is_accepted(consumer: Consumer, client: zenoh.Session) -> None:
    consumer.start()
    try:
        publisher = client.declare_publisher(KEY)
        eventually(lambda: publisher.matching_status.matching)
        publisher.put(b"\x93 not a record")
        publisher.put(wire.encode(decision(5)))
        eventually(lambda: consumer.got == ["d5"])
        assert consumer.store.refused_count() == 1
        assert consumer.health().state == "ok"
    finally:
        consumer.stop()


def test_temporary_errors_are_retried_and_permanent_ones_quarantined(
    producer: Producer, consumer: Consumer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sonarpost.runtime.service.RETRY_AFTER_S", 0.05)
    consumer.fail_on = {
        "d1": OSError(28, "No space left on device"),
        "d2": BadInputError("here", "field", 1, "2"),
        "d3": ZeroDivisionError("a defect"),
    }
    producer.start()
    consumer.start()
    try:
        for number in range(1, 5):
            producer.send(number)
        eventually(lambda: consumer.got == ["d1", "d4"])
        assert consumer.store.refused_count() == 2
        assert consumer.health().counters["records_failed"] == 1
        eventually(lambda: consumer.health().state == "ok")
    finally:
        producer.stop()
        consumer.stop()


def test_producer_keeps_the_record_while_the_consumer_disk_is_full(producer: Producer, consumer: Consumer) -> None:
    producer.start()
    consumer.start()
    try:
        consumer.store._db.execute("PRAGMA max_page_count=1")
        for number in range(8):
            producer.send(number, "x" * 1900)
        eventually(lambda: consumer.health().state == "degraded")
        assert producer.store.outbox_depth() > 0
        consumer.store._db.execute("PRAGMA max_page_count=1000000")
        eventually(lambda: len(consumer.got) == 8)
        assert sorted(consumer.got) == [f"d{n}" for n in range(8)]
        eventually(lambda: consumer.health().state == "ok")
    finally:
        producer.stop()
        consumer.stop()


def test_service_can_be_stopped_while_it_waits_for_its_router(tmp_path: Path) -> None:
    lonely = PlatformConfig(id="vessel-1", router=("tcp/127.0.0.1:1",), state_dir=tmp_path)
    service = Producer(lonely, ServiceConfig())
    result: list[bool] = []
    thread = threading.Thread(target=lambda: result.append(service.start()))
    thread.start()
    service.stopping.set()
    thread.join(timeout=3)
    assert result == [False]
    service.stop()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"origin": b"short"}, "origin"),
        ({"seq": 0}, "seq"),
        ({"seq": -1}, "seq"),
        ({"size": 1 << 40}, "size"),
        ({"sha256": "text"}, "sha256"),
        ({"offset": 10}, "payload"),
        ({"v": 2}, "records"),
        ({"v": 3}, "v"),
    ],
)
def test_query_error_names_the_field(change: dict[str, object], field: str) -> None:
    item = OutboxItem("c", 1, "k", "", 4, b"data", hashlib.sha256(b"data").digest())
    fields = msgpack.unpackb(protocol.attachment(b"o" * 16, item)) | change
    with pytest.raises(PayloadError, match="expected") as caught:
        protocol.parse_query(msgpack.packb(fields), b"data", "k/handoff/c")
    assert caught.value.field == field
