"""Editions, quotas and queues of a store, and gaps in the sequence numbers."""

import pytest
from builders.store_steps import queued_items
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.delivery.records import Topic, consumer_of, queue_of
from sonarpost.delivery.store import Store


def send(store, topic, edition, *, priority=6, queue="c2", size=3):
    with store.transaction() as tx:
        payload = f"{topic}{edition}".encode().ljust(size, b".")
        return tx.send("k", queue, payload, encoding="", priority=priority, topic=Topic(topic, edition))


def queued(store, queue="c2"):
    return [item.payload.decode().rstrip(".") for item in queued_items(store, queue, 99)]


def test_newer_edition_inherits_position_and_priority(store):
    send(store, "a", 1, priority=5)
    send(store, "b", 1, priority=5)
    send(store, "c", 1, priority=6)
    assert send(store, "a", 2, priority=6) == 4
    assert queued(store) == ["a2", "b1", "c1"]
    assert [item.priority for item in queued_items(store, "c2", 9)] == [5, 5, 6]


def test_edition_in_flight_and_newest_edition_are_kept(store):
    send(store, "a", 1)
    assert store.mark_in_flight("c2", (1,))
    send(store, "a", 2)
    send(store, "a", 3)
    assert queued(store) == ["a1", "a3"]
    store.clear_in_flight("c2", 1)
    assert not store.mark_in_flight("c2", (2,)), "a replaced edition must not be sent"


def test_late_older_edition_is_not_queued(store):
    send(store, "a", 3)
    assert send(store, "a", 2) == 0
    assert queued(store) == ["a3"]


def test_queues_and_topics_are_independent(store):
    send(store, "a", 1)
    send(store, "a", 2, queue="c2@shore-2")
    send(store, "b", 5)
    assert (queued(store), queued(store, "c2@shore-2")) == (["a1", "b5"], ["a2"])
    assert consumer_of(queue_of("c2", "shore-2")) == consumer_of("c2") == "c2"


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 6), st.booleans()), max_size=25))
def test_newest_edition_is_sent_for_any_order_of_arrival(tmp_path_factory, steps):
    store = Store(tmp_path_factory.mktemp("editions") / "s.db")
    newest = {}
    sent = {}
    for topic, edition, take_one in steps:
        send(store, topic, edition)
        newest[topic] = max(newest.get(topic, 0), edition)
        if take_one:
            for item in queued_items(store, "c2", 1):
                assert store.mark_in_flight("c2", (item.seq,))
                name = item.payload.decode().rstrip(".")
                sent.setdefault(name[0], set()).add(int(name[1:]))
                with store.transaction() as tx:
                    tx.remove_acknowledged("c2", (item.seq,))
                store.clear_in_flight("c2", item.seq)
    for name in queued(store):
        sent.setdefault(name[0], set()).add(int(name[1:]))
    assert {topic: max(editions) for topic, editions in sent.items()} == newest
    store.close()


def test_quota_drops_least_urgent_then_oldest_and_never_urgent_records(store):
    for seq, (topic, priority) in enumerate([("a", 5), ("b", 6), ("c", 6), ("d", 2), ("e", 5)], 1):
        assert send(store, topic, 1, priority=priority, size=100) == seq
    with store.transaction() as tx:
        assert tx.drop_oldest("c2", 350, 2) == 2
    assert queued(store) == ["d1", "a1", "e1"]
    with store.transaction() as tx:
        assert tx.drop_oldest("c2", 0, 2) == 2
    assert queued(store) == ["d1"]


def test_quota_drops_records_of_the_vehicle_with_the_most(store):
    for number in range(3):
        send(store, f"uuv-1/{number}", 1, size=100)
    for number in range(20):
        send(store, f"modem-{number}/0", 1, size=100)
    with store.transaction() as tx:
        assert tx.drop_oldest("c2", 700, 2) == 16
    assert queued(store)[:3] == ["uuv-1/01", "uuv-1/11", "uuv-1/21"]


def test_quota_keeps_records_in_flight(store):
    send(store, "a", 1, size=100)
    send(store, "b", 1, size=100)
    assert store.mark_in_flight("c2", (1,))
    with store.transaction() as tx:
        assert tx.drop_oldest("c2", 0, 2) == 1
    assert queued(store) == ["a1"]


def test_queue_depth_counts_records_and_bytes(store):
    assert store.queue_depth("c2").oldest_utc_s is None
    send(store, "a", 1, size=70)
    send(store, "b", 1, size=30)
    depth = store.queue_depth("c2")
    assert (depth.records, depth.size_bytes) == (2, 100)
    assert depth.oldest_utc_s is not None


def test_every_queue_has_its_own_random_origin(store):
    """A renamed site has a new queue that numbers from 1, with the same consumer."""
    with store.transaction() as tx:
        for queue in ("c2", "c2@a", "c2@b"):
            tx.send("k", queue, b"x", encoding="e")
    origins = {queued_items(store, queue, 1)[0].origin for queue in ("c2", "c2@a", "c2@b")}
    assert len(origins) == 3
    assert store.origin not in origins
    assert {len(origin) for origin in origins} == {16}


def test_renewed_origin_applies_to_new_records_only(store):
    with store.transaction() as tx:
        tx.renew_origin("c2")
    assert send(store, "a", 1) == 1
    with store.transaction() as tx:
        tx.renew_origin("c2")
    send(store, "b", 1)
    old, new = queued_items(store, "c2", 9)
    assert (old.seq, new.seq) == (1, 2)
    assert old.origin != new.origin


def test_number_below_which_nothing_is_queued(store):
    for edition in range(1, 8):
        send(store, "a", edition)
    assert store.done_up_to("c2") == 6
    with store.transaction() as tx:
        tx.remove_acknowledged("c2", (7,))
    assert store.done_up_to("c2") == 7


@pytest.mark.parametrize("statement", [1, 2])
def test_record_queued_during_the_read_is_not_reported_as_done(store, statement):
    statements = 0

    def queue_during_read(_):
        nonlocal statements
        statements += 1
        if statements == statement:
            send(store, "a", 1)

    store._reader.set_trace_callback(queue_during_read)
    done_up_to = store.done_up_to("c2")
    store._reader.set_trace_callback(None)
    assert all(done_up_to < item.seq for item in queued_items(store, "c2", 9))
