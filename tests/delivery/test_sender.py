"""The sender of a queue, step by step over a network in memory: failures while queries are in flight."""

import pytest
import zenoh
from builders.delivery_machine import Network, SteppedSender

from sonarpost.delivery import outbox, queue_sender
from sonarpost.delivery.outbox import Outbox
from sonarpost.delivery.protocol import MAX_BATCH_RECORDS, AckReply
from sonarpost.delivery.records import Topic
from sonarpost.errors import DeliveryError

STORED = AckReply("stored").pack()


class FailingNetwork(Network):
    """Raises as a closed session does, which also ends the query."""

    is_closed = False

    def get(self, key, handler, **options):
        if self.is_closed:
            handler.drop()
            raise zenoh.ZError("session closed")
        super().get(key, handler, **options)


@pytest.fixture
def network():
    return FailingNetwork()


@pytest.fixture
def sender(store, network, monkeypatch):
    monkeypatch.setattr(queue_sender, "IDLE_S", 0.0)
    monkeypatch.setattr(queue_sender, "BACK_OFF_S", (0.0,))
    return SteppedSender(network, store, "c")


def queue(store, count, size_bytes=1000):
    with store.transaction() as tx:
        for number in range(count):
            tx.send("k", "c", bytes([number % 256]) * size_bytes, encoding="e")


def step(sender, times=4):
    for _ in range(times):
        sender._step()


def connect(sender, network):
    """Deliver the first record, after which several queries are in flight."""
    step(sender)
    network.sent[0].end(STORED)
    sender._scheduler.congestion.window_bytes = 4096
    step(sender)


def test_a_record_whose_query_cannot_be_sent_is_sent_later(sender, store, network):
    queue(store, 1)
    network.is_closed = True
    with pytest.raises(zenoh.ZError):
        sender._step()
    sender._fail("session closed")
    network.is_closed = False
    step(sender)
    assert len(network.sent) == 1
    network.sent[0].end(STORED)
    step(sender)
    assert store.outbox_depth() == 0


@pytest.mark.parametrize("late_reply", [STORED, None])
def test_nothing_is_sent_again_while_another_query_is_in_flight(sender, store, network, late_reply):
    queue(store, 4)
    connect(sender, network)
    assert len(network.sent) == 4
    network.sent[1].end()
    step(sender)
    assert not sender.responding
    assert len(network.sent) == 4, "two queries are in flight"
    network.sent[3].end(STORED)
    step(sender)
    assert len(network.sent) == 4
    network.sent[2].end(late_reply)
    step(sender)
    assert len(network.sent) == 5, "one query tests the connection"
    assert network.sent[4].content == network.sent[1].content
    network.sent[4].end(STORED)
    step(sender)
    assert [query.content[0] for query in network.sent[5:]] == ([2] if late_reply is None else [])


def test_replies_count_in_any_order(sender, store, network):
    queue(store, 4)
    connect(sender, network)
    for query in reversed(network.sent[1:]):
        query.end(AckReply("stored").pack(MAX_BATCH_RECORDS))
    step(sender)
    assert store.outbox_depth() == 0
    assert sender.acknowledged_count == 4


def test_a_removal_that_fails_is_not_repeated_before_all_queries_have_ended(sender, store, network, monkeypatch):
    queue(store, 4)
    connect(sender, network)
    removals = []

    def fail():
        removals.append(1)
        raise DeliveryError("disk full")

    monkeypatch.setattr(sender, "_remove_acknowledged", fail)
    monkeypatch.setattr(queue_sender, "REMOVE_AFTER_S", -1.0)
    network.sent[1].end(STORED)
    sender._step()
    with pytest.raises(DeliveryError):
        sender._step()
    sender._fail("disk full")
    step(sender, 20)
    assert len(removals) == 1


def test_an_urgent_record_is_loaded_although_the_store_could_not_be_read_once(sender, store, network, monkeypatch):
    queue(store, 2000, size_bytes=1)
    connect(sender, network)
    with store.transaction() as tx:
        tx.send("k", "c", b"urgent", encoding="e", priority=1)
    with monkeypatch.context() as patched:
        patched.setattr(store, "queued_numbers", lambda *_: fail_to_read())
        with pytest.raises(DeliveryError):
            sender._step()
        sender._fail("disk I/O error")
    for query in network.sent[1:]:
        query.end(STORED)
    before = len(network.sent)
    step(sender)
    assert network.sent[before].content == b"urgent"


def fail_to_read():
    raise DeliveryError("disk I/O error")


def test_a_new_record_is_loaded_at_once_only_if_its_place_is_among_those_in_memory(sender, store, network, monkeypatch):
    with store.transaction() as tx:
        for number in range(500):
            tx.send("k", "c", bytes(1000), encoding="e", topic=Topic(f"image-{number}", 1))
    connect(sender, network)
    read = []
    queued_numbers = store.queued_numbers
    monkeypatch.setattr(store, "queued_numbers", lambda *args: read.append(1) or queued_numbers(*args))

    def loaded_after(payload, *, topic, priority=4):
        read.clear()
        with store.transaction() as tx:
            tx.send("k", "c", payload, encoding="e", priority=priority, topic=topic)
        step(sender)
        return len(read), any(one.item.payload == payload for one in sender._scheduler.active.values())

    assert loaded_after(b"last", topic=Topic("image-500", 1)) == (0, False)
    assert loaded_after(b"edition of the last", topic=Topic("image-499", 2)) == (0, False)
    assert loaded_after(b"edition of an early one", topic=Topic("image-100", 2)) == (1, True)
    assert loaded_after(b"urgent", topic=None, priority=1) == (1, True)


class StartedSender:
    """A sender of an outbox whose first start fails, as without memory for another thread."""

    restored = False

    def __init__(self, made, *_arguments):
        self.places = []
        made.append(self)
        if len(made) == 1:
            raise RuntimeError("can't start new thread")

    def on_new(self, place):
        self.places.append(place)

    def close(self):
        """Nothing to end."""


def test_sender_that_cannot_start_fails_no_commit(store, network, monkeypatch, caplog):
    made = []
    monkeypatch.setattr(outbox, "QueueSender", lambda *arguments: StartedSender(made, *arguments))
    sending = Outbox(network, store)
    with store.transaction() as tx:
        tx.send("k", "c", b"first", encoding="e")
        tx.accept("other/key", b"to handle")
    assert (store.outbox_depth(), store.inbox_changed.is_set(), len(made)) == (1, True, 1)
    assert "Sender not started" in caplog.text
    queue(store, 1)
    assert len(made) == 2
    assert len(made[1].places) == 1
    sending.close()
