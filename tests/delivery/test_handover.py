"""Delivery between two services over an in-process router; either side can run a version without batches."""

import hashlib
import shutil
import sqlite3
import threading
from collections import Counter

import msgpack
import pytest
from builders.common import WAIT_S, eventually, publish_once
from builders.records import decision_record, encoded_image, reconstructed_image

from sonarpost import keys, wire
from sonarpost.config import ServiceConfig
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
from sonarpost.delivery.watermark import read
from sonarpost.errors import BadInputError, RejectedByDatabaseError, RetryLaterError
from sonarpost.messages import Decision, Pixels, ReconstructedImage
from sonarpost.runtime.service import Service

KEY = keys.contact_decision("vessel-1")
WHERE = keys.delivery_query(KEY, "consumer")
ORIGIN = b"o" * 16


class Consumer(Service[ServiceConfig]):
    """Keeps the identifiers of decisions; raises `fail_on`, and reports a full disk while `full` is set."""

    NAME = "consumer"

    def __init__(self, platform, config):
        super().__init__(platform, config)
        self.got = []
        self.fail_on = {}
        self.full = False
        self.invalid_states = set()
        self.threads = {}

    def consumed_keys(self):
        return {KEY: Decision}

    def check_capacity(self, key):
        if self.full:
            raise RetryLaterError("disk full")

    def handle(self, key, record, effects):
        error = self.fail_on.get(record.decision_id)
        if error is not None:
            if isinstance(error, OSError):
                del self.fail_on[record.decision_id]
            raise error
        if record.decision_id in self.invalid_states:
            effects.put_state("name", object())
        self.threads[record.decision_id] = threading.current_thread().name
        self.got.append(record.decision_id)


@pytest.fixture
def begin(runner, platform):
    """Starts a consumer."""
    return lambda: runner.start(Consumer(platform("vessel-1"), ServiceConfig()))


@pytest.fixture
def consumer(begin):
    return begin()


@pytest.fixture
def producer(runner):
    return runner.peer("vessel-1", "producer")


@pytest.fixture
def send(producer):
    """Sends decisions of these numbers."""
    return lambda *numbers, **options: producer.send(
        KEY, "consumer", *(decision_record(f"d{n}") for n in numbers), **options
    )


def decision(number):
    return wire.encode(decision_record(f"d{number}"))


def item(seq, payload):
    return OutboxItem("consumer", seq, KEY, "", 4, payload, hashlib.sha256(payload).digest())


def test_records_queued_before_the_consumer_exists_arrive_once_urgent_first_and_are_published(
    producer, send, begin, client, runner
):
    seen = []
    send(*range(50), priority=6)
    send(99, priority=1)
    runner.stop(producer)
    client.declare_subscriber(
        KEY, lambda s: seen.append((s.payload.to_bytes(), msgpack.unpackb(s.attachment.to_bytes())))
    )
    consumer = begin()
    producer = runner.peer("vessel-1", "producer")
    eventually(lambda: len(consumer.got) == 51)
    eventually(lambda: producer.store.outbox_depth() == 0)
    assert consumer.got == ["d99", *(f"d{n}" for n in range(50))]
    # Counted at the commit, which can follow the producer's removal of the last record.
    eventually(lambda: consumer.health().counters["records_handled"] == 51)
    # Subscribers receive each record once with its number, and another origin than the consumer.
    producer.send(KEY, "consumer", decision_record("d-last"))
    eventually(lambda: 52 in {attached["seq"] for _, attached in seen})
    assert len(seen) == 52
    found = {attached["seq"]: msgpack.unpackb(payload)["decision_id"] for payload, attached in seen}
    assert found == {**{n + 1: f"d{n}" for n in range(50)}, 51: "d99", 52: "d-last"}
    (origin,) = producer.store._query("SELECT origin FROM outbox_next")[0]
    assert {attached["origin"] for _, attached in seen} == {hashlib.sha256(b"watcher" + origin).digest()[:16]}


def test_large_records_are_sent_in_chunks(producer, runner):
    key = keys.image_reconstructed("vessel-1")
    consumer = runner.peer("vessel-1", "consumer", {key: ReconstructedImage})
    sizes = ((64, 500), (64, 512), (1000, 1300))
    images = [Pixels(height_px=h, width_px=w, bits=8, data=bytes(h * w)) for h, w in sizes]
    images = [reconstructed_image(image) for image in images]
    assert len(wire.encode(images[0])) < CHUNK_BYTES
    producer.send(key, "consumer", *images)
    eventually(lambda: consumer.received == images)
    eventually(lambda: producer.store.outbox_depth() == 0)


def test_invalid_record_is_refused_and_quarantined_on_both_sides(producer, send, consumer, refused, caplog):
    producer.send_bytes(KEY, "consumer", wire.encode(encoded_image(1)))
    send(1)
    eventually(lambda: consumer.got == ["d1"])
    assert refused(producer) == refused(consumer)
    [(key, reason)] = refused(consumer)
    assert key == KEY
    assert "expected 'decision'" in reason
    logged = next(r for r in caplog.records if r.message == "Record refused")
    assert "expected 'decision'" in str(vars(logged)["fields"])
    assert consumer.health().counters["records_refused"] == 1


def test_plain_publication_of_a_third_party_is_accepted(consumer, publish):
    publish(KEY, b"\x93 not a record")
    publish(KEY, decision(5))
    eventually(lambda: consumer.got == ["d5"])
    assert consumer.store.refused_count() == 1
    assert consumer.health().state == "ok"


def test_temporary_errors_are_retried_and_permanent_ones_quarantined(send, consumer, monkeypatch):
    monkeypatch.setattr("sonarpost.runtime.record_handler.RETRY_AFTER_S", 0.05)
    consumer.fail_on = {
        "d1": OSError(28, "No space left on device"),
        "d2": BadInputError("here", "field", 1, "2"),
        "d3": ZeroDivisionError("a defect"),
    }
    send(1, 2, 3, 4)
    eventually(lambda: consumer.got == ["d1", "d4"])
    assert consumer.store.refused_count() == 2
    assert consumer.health().counters["records_failed"] == 1
    eventually(lambda: consumer.health().state == "ok")


def test_record_that_fails_while_others_are_handled_delays_and_harms_none(send, consumer, monkeypatch):
    monkeypatch.setattr("sonarpost.runtime.record_handler.RETRY_AFTER_S", 0.0)
    failing = {"d1": RejectedByDatabaseError("rejected"), "d2": OSError(28, "No space left on device")}
    commit = consumer.commit_batch

    def refuse(handled):
        [effects] = handled
        name = str(wire.decode(Decision, effects.payload, "").decision_id)
        if name in failing:
            raise failing[name]
        return commit(handled)

    monkeypatch.setattr(consumer, "commit_batch", refuse)
    send(1, 2)
    eventually(lambda: consumer.health().state == "degraded")
    for number in range(3, 9):
        send(number)
        eventually(lambda: consumer.store.inbox_depth() <= 2 and f"d{number}" in consumer.got)  # noqa: B023
    eventually(lambda: consumer.store.refused_count() == 1)
    assert [record.reason for record in consumer.store.quarantined()] == ["RejectedByDatabaseError: rejected"]
    # A full disk is no fault of the record: it is kept, and handled later.
    assert consumer.store.inbox_depth() == 1
    failing.clear()
    eventually(lambda: consumer.store.inbox_depth() == 0 and consumer.health().state == "ok")


def test_lack_of_memory_quarantines_no_record(send, consumer, monkeypatch):
    monkeypatch.setattr("sonarpost.runtime.record_handler.RETRY_AFTER_S", 0.0)
    consumer.fail_on = {"d1": MemoryError()}
    send(1, 2)
    eventually(lambda: consumer.got == ["d2"])
    consumer.fail_on.clear()
    eventually(lambda: consumer.got == ["d2", "d1"])
    assert consumer.store.refused_count() == 0


def test_publication_that_cannot_be_stored_does_not_stay_in_front_of_other_messages(begin, runner, send, monkeypatch):
    def before_accepting(_self, records):
        if any(wire.decode(Decision, payload, "").decision_id == "bad" for _, payload in records):
            raise RejectedByDatabaseError("rejected")

    monkeypatch.setattr(Consumer, "before_accepting", before_accepting)
    consumer = begin()
    publish_once(runner.peer("vessel-1", "other").session, KEY, wire.encode(decision_record("bad")))
    eventually(lambda: consumer.health().counters.get("records_refused") == 1)
    send(1)
    eventually(lambda: consumer.got == ["d1"])


# Producer with a scripted consumer


class Listener:
    """Stores the queries and replies as the test requires."""

    def __init__(self, session, answer):
        self.asked = []
        self._answer = answer
        session.declare_queryable(WHERE, self._on_query)

    def _on_query(self, query):
        with query:
            asked = parse_query(query.attachment.to_bytes(), query.payload.to_bytes(), WHERE)
            self.asked.append(asked)
            query.reply(query.key_expr, self._answer(asked))

    @property
    def records(self):
        """Sequence numbers of all queries."""
        return [c.seq for asked in self.asked for c in ([asked] if isinstance(asked, ReceivedChunk) else asked)]


@pytest.mark.parametrize(("takes", "least", "most"), [(0, 1, 1), (1, 1, 1), (5, 5, 5), (2**60, 5, MAX_BATCH_RECORDS)])
def test_producer_sends_batches_of_the_announced_size(takes, least, most, producer, send, client):
    def answer(asked):
        if isinstance(asked, ReceivedChunk):
            return AckReply("stored").pack(takes)
        return pack_replies([AckReply("stored")] * len(asked))

    send(*range(300))
    listener = Listener(client, answer)
    eventually(lambda: producer.store.outbox_depth() == 0)
    assert isinstance(listener.asked[0], ReceivedChunk), "the consumer has not announced batches yet"
    assert listener.records == list(range(1, 301))
    largest = max(1 if isinstance(asked, ReceivedChunk) else len(asked) for asked in listener.asked)
    # More than `least` if the window grows, which depends on the reply times.
    assert least <= largest <= most
    assert all(isinstance(asked, ReceivedChunk) for asked in listener.asked) == (most == 1)


def test_single_records_are_sent_after_a_batch_was_refused(producer, send, client):
    """A consumer that supports version 1 only replaces another one under the same name."""

    def answer(asked):
        if isinstance(asked, ReceivedChunk):
            return AckReply("stored").pack(MAX_BATCH_RECORDS)
        return AckReply("refused", reason="v: got 2, expected 1").pack()

    send(*range(30))
    listener = Listener(client, answer)
    eventually(lambda: producer.store.outbox_depth() == 0)
    assert producer.store.refused_count() == 0
    alone = [asked.seq for asked in listener.asked if isinstance(asked, ReceivedChunk)]
    assert alone == list(range(1, 31))
    assert sum(not isinstance(asked, ReceivedChunk) for asked in listener.asked) >= 1


def test_each_record_of_a_batch_has_its_own_reply(producer, send, client, refused):
    waited = set()

    def reply_to(seq):
        if seq == 4:
            return AckReply("refused", reason="never")
        if seq == 7 and seq not in waited:
            waited.add(seq)
            return AckReply("later", reason="full")
        return AckReply("stored")

    def answer(asked):
        if isinstance(asked, ReceivedChunk):
            return AckReply("stored").pack(MAX_BATCH_RECORDS)
        return pack_replies([reply_to(chunk.seq) for chunk in asked])

    send(*range(1, 11))
    listener = Listener(client, answer)
    eventually(lambda: producer.store.outbox_depth() == 0)
    assert refused(producer) == [(KEY, "never")]
    assert producer.acknowledged_count("consumer") == 9
    assert Counter(listener.records) == Counter([*range(1, 11), 7])


# Consumer with scripted queries


@pytest.fixture
def ask(client):
    """Sends records in one query, after the consumer has appeared; returns the replies."""

    def query(items, data=None):
        querier = client.declare_querier(WHERE)
        eventually(lambda: querier.matching_status.matching)
        payload = b"".join(i.payload for i in items) if data is None else data
        attached = protocol.attachment(ORIGIN, items[0]) if len(items) == 1 else batch_attachment(ORIGIN, items)
        content = client.get(WHERE, payload=payload, attachment=attached, timeout=WAIT_S).recv().ok.payload.to_bytes()
        return AckReply.unpack(content, WHERE) if len(items) == 1 else unpack_replies(content, len(items), WHERE)

    return query


def test_consumer_accepts_valid_records_once_and_refuses_invalid_ones_each_time(begin, runner, ask):
    consumer = begin()
    items = [item(1, decision(1)), item(2, b"\x93 rubbish"), item(3, decision(3)), item(5, b"")]
    expected = ["stored", "refused", "stored", "refused"]
    for _ in range(2):
        replies = ask(items)
        assert [reply.status for reply in replies] == expected
    assert "msgpack map" in replies[1].reason
    eventually(lambda: consumer.got == ["d1", "d3"])
    assert consumer.store.refused_count() == 4
    damaged = ask([item(4, decision(4)), OutboxItem("consumer", 6, KEY, "", 4, decision(6), bytes(32))])
    assert isinstance(damaged, AckReply), "of a batch with a wrong digest no record is accepted"
    assert "the digest of the records' digests" in damaged.reason
    runner.stop(consumer)
    consumer = begin()
    assert [reply.status for reply in ask(items)] == expected
    # A record of a batch is recognised alone; the reply announces batches.
    single = ask(items[2:3])
    assert (single.status, single.max_batch, single.highest) == ("stored", MAX_BATCH_RECORDS, 3)
    assert consumer.store.inbox_depth() == 0
    assert consumer.got == []


def test_malformed_batch_gets_a_single_refusal(consumer, ask):
    items = [item(1, decision(1)), item(2, decision(2))]
    assert ask(items, data=b"short").status == "refused"
    assert consumer.store.refused_count() == 0, "no record could be identified"
    assert ask(items) == (AckReply("stored"), AckReply("stored"))


def test_producer_keeps_records_while_the_consumer_has_no_space(producer, send, consumer, ask):
    send(0)
    eventually(lambda: consumer.got == ["d0"])
    consumer.full = True
    assert [reply.status for reply in ask([item(1, decision(91)), item(2, decision(92))])] == ["later", "later"]
    send(*range(1, 40))
    eventually(lambda: not producer.is_responding("consumer"))
    assert producer.store.outbox_depth() == 39
    consumer.full = False
    eventually(lambda: len(consumer.got) == 40)
    assert sorted(consumer.got) == sorted(f"d{n}" for n in range(40))


def test_store_write_error_rejects_the_whole_batch(consumer, ask):
    items = [item(n, decision(n)) for n in range(1, 60)]
    pages = consumer.store._query("PRAGMA page_count")[0][0]
    consumer.store._db.execute(f"PRAGMA max_page_count={pages}")
    assert ask(items).status == "later"
    assert consumer.store.inbox_depth() == 0
    eventually(lambda: consumer.health().state == "degraded")
    consumer.store._db.execute("PRAGMA max_page_count=1000000")
    assert ask(items) == (AckReply("stored"),) * 59
    eventually(lambda: len(consumer.got) == 59)
    eventually(lambda: consumer.health().state == "ok")


@pytest.mark.parametrize(("in_copy", "after_restore"), [(0, 3), (10, 15)])
def test_restored_store_loses_and_doubles_nothing(runner, begin, platform, caplog, in_copy, after_restore):
    """The store of a producer is replaced by a copy from before its last deliveries; numbers are assigned again."""
    consumer = begin()

    def start(*names):
        producer = runner.peer("vessel-1", "producer")
        producer.send(KEY, "consumer", *(decision_record(name) for name in names))
        return producer

    def deliver(*names):
        producer = start(*names)
        eventually(lambda: producer.store.outbox_depth() == 0)
        return producer

    def origins(producer):
        return {bytes(row[0]) for row in producer.store._query("SELECT origin FROM outbox_next")}

    sent = {part: [f"{part}{n}" for n in range(count)] for part, count in (("early", 5), ("late", 10))}
    sent["copied"], sent["new"] = ([f"c{n}" for n in range(in_copy)], [f"n{n}" for n in range(after_restore)])
    runner.stop(deliver(*sent["early"]))
    consumer.full = True
    runner.stop(start(*sent["copied"]))
    state, copy = platform("vessel-1").state_dir, platform("vessel-1").state_dir.parent / "copy"
    copy.mkdir()
    for path in state.glob("producer.db*"):
        shutil.copy2(path, copy)
    consumer.full = False
    last = deliver(*sent["late"])
    assert last.health().detail == ""
    before = origins(last)
    runner.stop(last)
    assert "older than" not in caplog.text
    for path in state.glob("producer.db*"):
        path.unlink()
    for path in copy.iterdir():
        shutil.copy2(path, state)
    producer = deliver(*sent["new"])
    expected = Counter(name for names in sent.values() for name in names)
    eventually(lambda: len(consumer.got) >= expected.total())
    assert Counter(consumer.got) == expected
    assert "Store is older than its last delivery" in caplog.text
    assert "producer.db is older than its last delivery to consumer" in producer.health().detail
    assert origins(producer) != before
    producer.send(KEY, "consumer", decision_record("after"))
    eventually(lambda: consumer.got[-1] == "after")


def test_unexpected_exceptions_do_not_stop_delivery(producer, send, consumer, monkeypatch):
    """Of the producer's reaction to an acknowledgement, of its queue, and of the consumer's check of the capacity."""
    failed = Counter()

    def once(name, error):
        def fail(*arguments):
            failed[name] += 1
            if failed[name] == 1:
                raise error

        return fail

    monkeypatch.setattr(producer, "on_acknowledged", once("acknowledgement", RuntimeError("a defect")))
    monkeypatch.setattr(consumer, "check_capacity", once("capacity", ValueError("a defect")))
    fail_queue = once("queue", KeyError("a defect"))
    monkeypatch.setattr(producer.store, "done_up_to", lambda queue: fail_queue() or 0)
    send(1, 2, 3)
    eventually(lambda: sorted(consumer.got) == ["d1", "d2", "d3"])
    eventually(lambda: producer.store.outbox_depth() == 0)
    assert producer.health().counters["acknowledgements_failed"] == 1
    assert min(failed.values()) >= 1


@pytest.fixture
def consumer_at_once(begin, monkeypatch):
    monkeypatch.setattr("sonarpost.runtime.record_handler.RETRY_AFTER_S", 0.0)
    monkeypatch.setattr(Consumer, "MAX_AT_ONCE", 2)
    return begin()


def test_first_records_are_handled_in_the_transaction_that_accepts_them(consumer_at_once, ask, runner, begin):
    items = [item(n, decision(n)) for n in range(1, 5)]
    for _ in range(2):
        assert ask(items) == (AckReply("stored"),) * 4
        eventually(lambda: consumer_at_once.got == ["d1", "d2", "d3", "d4"])
    eventually(lambda: consumer_at_once.store.inbox_depth() == 0)
    assert list(consumer_at_once.threads.values()) == ["inbox-consumer"] * 2 + ["work"] * 2
    eventually(lambda: consumer_at_once.health().counters["records_handled"] == 4)
    # All have a number, with which a later start finds that their commit was lost.
    assert read(consumer_at_once.store.path).inbox.last == 4
    runner.stop(consumer_at_once)
    assert begin().store.lost is None


def test_record_that_cannot_be_handled_when_it_is_accepted_waits_in_the_inbox(consumer_at_once, ask, refused):
    consumer_at_once.fail_on = {"d1": OSError(28, "No space left on device"), "d3": BadInputError("here", "f", 1, "2")}
    assert ask([item(1, decision(1)), item(2, decision(2))]) == (AckReply("stored"),) * 2
    eventually(lambda: consumer_at_once.got == ["d1", "d2"])
    assert set(consumer_at_once.threads.values()) == {"work"}
    eventually(lambda: consumer_at_once.store.inbox_depth() == 0)
    assert ask([item(3, decision(3))]).status == "stored"
    eventually(lambda: [key for key, _ in refused(consumer_at_once)] == [KEY])
    assert consumer_at_once.store.inbox_depth() == 0


def test_record_that_is_not_quick_waits_in_the_inbox_and_no_later_one_overtakes_it(consumer_at_once, ask, monkeypatch):
    monkeypatch.setattr(consumer_at_once, "is_quick", lambda record: record.decision_id != "d2")
    assert ask([item(n, decision(n)) for n in (1, 2, 3)]) == (AckReply("stored"),) * 3
    eventually(lambda: consumer_at_once.got == ["d1", "d2", "d3"])
    assert list(consumer_at_once.threads.values()) == ["inbox-consumer", "work", "work"]


def test_record_whose_effects_cannot_be_written_is_accepted_once(consumer_at_once, ask):
    consumer_at_once.invalid_states = {"d1"}
    assert ask([item(1, decision(1))]).status == "stored"
    eventually(lambda: consumer_at_once.health().state == "degraded")
    # It waits, and no later record is handled before it is.
    assert ask([item(2, decision(2))]).status == "stored"
    eventually(lambda: "d2" in consumer_at_once.got)
    assert set(consumer_at_once.threads.values()) <= {"inbox-consumer", "work"}
    assert consumer_at_once.threads["d2"] == "work"
    consumer_at_once.invalid_states.clear()
    eventually(lambda: consumer_at_once.store.inbox_depth() == 0)
    eventually(lambda: consumer_at_once.health().counters["records_handled"] == 2)
    assert consumer_at_once.store.refused_count() == 0


def test_failure_after_the_commit_repeats_no_publication(consumer_at_once, client, monkeypatch):
    def fail(*_):
        raise RetryLaterError("quota not applied")

    monkeypatch.setattr(consumer_at_once, "after_commit", fail)
    publish_once(client, KEY, decision(1))
    eventually(lambda: consumer_at_once.got == ["d1"])
    monkeypatch.undo()
    publish_once(client, KEY, decision(2))
    eventually(lambda: "d2" in consumer_at_once.got)
    assert consumer_at_once.got == ["d1", "d2"]


def test_error_of_the_database_quarantines_no_record(begin, ask, monkeypatch):
    consumer = begin()
    fails = [True]

    def expand(tx, key, payload, record):
        if fails.pop() if fails else False:
            raise sqlite3.OperationalError("database or disk is full")
        return payload, record

    monkeypatch.setattr(consumer._inbox, "_expand", expand)
    assert ask([item(1, decision(1))]).status == "later"
    assert ask([item(1, decision(1))]).status == "stored"
    assert consumer.store.refused_count() == 0
