"""Chunks of large records in the durable store: any order, repeated, lost, damaged, too many."""

import hashlib
import itertools
import random
import time

from builders.store_steps import ORIGIN
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.delivery import received
from sonarpost.delivery.records import ReceivedChunk
from sonarpost.delivery.store import Store

KEY = "sonarpost/v1/shore/inbox/vessel-1"
OTHER_KEY = "sonarpost/v1/shore/inbox/vessel-2"


def chunks(data, *cuts, seq=1, origin=ORIGIN):
    sha = hashlib.sha256(data).digest()
    edges = [0, *cuts, len(data)]
    return [ReceivedChunk(origin, seq, len(data), sha, a, data[a:b]) for a, b in itertools.pairwise(edges)]


def add(store, chunk, key=KEY):
    with store.transaction() as tx:
        return tx.partial_records.add(key, chunk)


def partials(store):
    return len(store._query("SELECT 1 FROM partial"))


@given(data=st.binary(min_size=1, max_size=60), seed=st.integers(0, 2**32))
def test_chunks_in_any_order_and_number_complete_the_record(tmp_path_factory, data, seed):
    """Behave like a producer: repeat or lose chunks, continue at the requested offset."""
    folder, chance = tmp_path_factory.mktemp("chunks"), random.Random(seed)
    store = Store(folder / "s.db")
    sha = hashlib.sha256(data).digest()
    offset = 0
    for _ in range(1000):
        if chance.random() < 0.2:
            store.close()
            store = Store(folder / "s.db")
        start = offset if chance.random() < 0.6 else chance.randrange(len(data))
        offset = add(
            store, ReceivedChunk(ORIGIN, 1, len(data), sha, start, data[start : start + chance.randint(1, 20)])
        )
        if isinstance(offset, bytes):
            break
    assert offset == data
    assert partials(store) == 0
    store.close()


def test_chunk_out_of_order_returns_the_required_offset(store):
    first, second, third = chunks(b"0123456789", 4, 8)
    assert add(store, second) == 0
    assert add(store, first) == 4
    assert add(store, first) == 4
    assert add(store, third) == 4
    assert add(store, second) == 8
    assert add(store, third) == b"0123456789"


def test_other_record_with_the_same_number_does_not_disturb_the_transfer(store):
    first, second = chunks(b"old record", 5), chunks(b"new record", 5)
    assert add(store, first[0]) == 5
    assert add(store, second[1]) == 0
    assert add(store, second[0]) == 5
    assert add(store, first[0], OTHER_KEY) == 5
    assert add(store, first[1]) == b"old record"
    assert add(store, second[1]) == b"new record"
    assert add(store, first[1], OTHER_KEY) == b"old record"


def test_complete_record_deletes_its_chunks_only_with_the_right_digest(store):
    first, second = chunks(b"0123456789", 5)
    assert add(store, first) == 5
    forged = ReceivedChunk(ORIGIN, 1, first.size, first.sha256, 0, b"x" * first.size)
    assert add(store, forged) == forged.data
    assert partials(store) == 1
    assert add(store, second) == b"0123456789"
    assert add(store, first) == 5
    assert add(store, ReceivedChunk(ORIGIN, 1, first.size, first.sha256, 0, b"0123456789")) == b"0123456789"
    assert partials(store) == 0


def test_damaged_record_restarts_the_transfer(store):
    first, second = chunks(b"0123456789", 5)
    bad = ReceivedChunk(ORIGIN, 1, first.size, first.sha256, 0, b"0x234")
    assert add(store, bad) == 5
    assert add(store, second) == 0
    assert partials(store) == 0
    assert add(store, first) == 5
    assert add(store, second) == b"0123456789"


def test_only_the_most_recent_records_of_a_writer_are_kept(store, monkeypatch):
    monkeypatch.setattr(received, "MAX_WRITER_RECORDS", 3)
    firsts = {seq: chunks(b"0123456789", 4, seq=seq) for seq in range(1, 5)}
    for seq in (1, 2, 3):
        assert add(store, firsts[seq][0]) == 4
    assert add(store, firsts[1][0]) == 4  # touched again
    assert add(store, firsts[4][0]) == 4
    assert partials(store) == 3
    # The second record was deleted; its producer starts again at offset 0.
    assert add(store, firsts[2][1]) == 0
    assert add(store, firsts[1][1]) == b"0123456789"


def test_size_of_incomplete_records_of_a_writer_is_limited(store, monkeypatch):
    monkeypatch.setattr(received, "MAX_WRITER_BYTES", 100)
    other = chunks(bytes(200), 90)
    assert add(store, other[0], OTHER_KEY) == 90
    for seq in range(1, 6):
        assert add(store, chunks(bytes([seq]) * 200, 40, seq=seq)[0]) == 40
    assert partials(store) == 3
    assert add(store, other[1], OTHER_KEY) == bytes(200)


def test_origin_with_many_bytes_loses_its_records_first(store, monkeypatch):
    """On one key, a flood of incomplete records does not interrupt the transfer of another origin."""
    monkeypatch.setattr(received, "MAX_WRITER_RECORDS", 4)
    first, second = chunks(b"0123456789", 4)
    assert add(store, first) == 4
    for seq in range(1, 20):
        add(store, chunks(b"abcdefghij", 4, seq=seq, origin=b"f" * 16)[0])
    assert partials(store) == 4
    assert add(store, second) == b"0123456789"


def test_many_names_below_one_prefix_count_as_one_writer(store, monkeypatch):
    """A console may write below tasking under any name; the total limit then affects its own records only."""
    monkeypatch.setattr(received, "MAX_RECORDS", 6)
    monkeypatch.setattr(received, "MAX_WRITER_RECORDS", 5)
    first, second = chunks(bytes(100), 60)
    assert add(store, first) == 60
    for number in range(30):
        key = f"sonarpost/v1/shore/tasking/name-{number}/comment"
        assert add(store, chunks(b"0123456789", 1, origin=bytes([number]) * 16)[0], key) == 1
    assert partials(store) == 6
    assert add(store, second) == bytes(100)


def test_total_limit_deletes_records_of_the_largest_writer(store, monkeypatch):
    monkeypatch.setattr(received, "MAX_BYTES", 100)
    small = chunks(bytes(50), 10)
    assert add(store, small[0]) == 10
    for seq in (1, 2, 3):
        assert add(store, chunks(bytes([seq]) * 90, 40, seq=seq)[0], OTHER_KEY) == 40
    assert partials(store) == 3
    assert add(store, small[1]) == bytes(50)


def test_incomplete_record_expires(store, monkeypatch):
    now_ns = time.time_ns()
    add(store, chunks(b"0123456789", 4)[0])
    monkeypatch.setattr(time, "time_ns", lambda: now_ns + (received.EXPIRE_AFTER_S + 60) * 1_000_000_000)
    assert add(store, chunks(b"abcdefghij", 4, seq=2)[0]) == 4
    assert partials(store) == 1
    assert store._query("SELECT COUNT(*) FROM partial_piece") == [(1,)]


def test_reclaim_deletes_the_records_of_the_largest_writer(store):
    add(store, chunks(bytes(100), 40)[0])
    add(store, chunks(bytes(100), 60)[0], OTHER_KEY)
    for expected in (60, 40, 0):
        with store.transaction() as tx:
            assert tx.partial_records.reclaim() == expected
    assert partials(store) == 0
