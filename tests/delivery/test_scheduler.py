"""Order and timing of chunks with a simulated clock: bandwidth limit, priority, windows, restart."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.delivery.congestion import MAX_WINDOW_BYTES
from sonarpost.delivery.protocol import CHUNK_BYTES
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.scheduler import (
    CHUNK_S,
    MIN_CHUNK_BYTES,
    PROBE_WINDOW,
    QUERY_OVERHEAD_BYTES,
    URGENT_RESERVE,
    WINDOW,
    DeliveryScheduler,
    TokenBucket,
    chunk_bytes_for,
)


def item(seq, size=100, priority=6):
    return OutboxItem("c2", seq, "k", "", priority, bytes(size), bytes(32), position=seq)


def schedule(*items, bytes_per_s=None, responding=True):
    made = DeliveryScheduler(bytes_per_s, 0.0)
    made.congestion.window_bytes = MAX_WINDOW_BYTES
    made.probing = not responding
    made.update(items)
    return made


def ask(scheduler, now_s=0.0):
    chunk, _ = scheduler.next_chunk(now_s)
    scheduler.query_sent(chunk, now_s)
    return chunk


class SlowLink:
    """Sends the scheduled chunks over a link of a given rate; each reply arrives when its chunk is transmitted."""

    def __init__(self, scheduler):
        self.scheduler = scheduler
        self.now_s = 0.0
        self.sent = []

    def step(self):
        chunk, wait_s = self.scheduler.next_chunk(self.now_s)
        if chunk is None:
            if wait_s is None:
                return False
            assert wait_s > 0
            self.now_s += wait_s
            return True
        self.scheduler.query_sent(chunk, self.now_s)
        self.sent.append((self.now_s, chunk.transfer.item.seq, chunk.size))
        self.scheduler.query_ended(chunk, self.now_s, replied=True)
        if chunk.end == len(chunk.transfer.item.payload):
            self.scheduler.remove(chunk.transfer)
        else:
            self.scheduler.confirm(chunk, chunk.end)
        return True

    def run(self, until_s=1e9):
        while self.now_s < until_s and self.step():
            pass


@given(st.floats(50, 200_000), st.lists(st.integers(0, 60_000), min_size=1, max_size=8))
def test_bandwidth_limit_is_kept_and_fully_used(bytes_per_s, sizes):
    link = SlowLink(schedule(*(item(n, size) for n, size in enumerate(sizes, 1)), bytes_per_s=bytes_per_s))
    link.run()
    assert sum(size for _, _, size in link.sent) == sum(sizes)
    charged = 0
    for at_s, _, size in link.sent:
        charged += size + QUERY_OVERHEAD_BYTES
        burst = link.scheduler.chunk_bytes + QUERY_OVERHEAD_BYTES
        assert charged <= bytes_per_s * at_s + burst + 1e-6 * charged + bytes_per_s * 1e-6
    # The link is never idle: apart from the first burst, the duration matches the limit.
    assert link.now_s <= charged / bytes_per_s + 1e-6


@given(st.floats(100, 50_000), st.floats(0.0, 30.0))
def test_urgent_record_waits_for_the_chunk_in_progress_only(bytes_per_s, at_s):
    link = SlowLink(schedule(*(item(n, 30_000) for n in range(1, 9)), bytes_per_s=bytes_per_s))
    link.run(until_s=at_s)
    scheduler = link.scheduler
    scheduler.update([item(99, 200, priority=2), *(transfer.item for transfer in scheduler.active.values())])
    chunk, wait_s = scheduler.next_chunk(link.now_s)
    assert chunk.transfer.item.seq == 99
    assert wait_s == 0.0
    assert scheduler.chunk_bytes <= max(bytes_per_s * CHUNK_S, MIN_CHUNK_BYTES)


def test_urgent_records_are_charged_to_the_limit():
    scheduler = schedule(item(1, 10_000), bytes_per_s=1000)
    for seq in range(10, 20):
        scheduler.update([item(seq, 500, priority=1), item(1, 10_000)])
        chunk = ask(scheduler)
        assert chunk.transfer.item.seq == seq
        scheduler.query_ended(chunk, 0.0, replied=True)
        scheduler.remove(chunk.transfer)
    chunk, wait_s = scheduler.next_chunk(0.0)
    assert chunk is None
    assert wait_s == pytest.approx(10 * (500 + QUERY_OVERHEAD_BYTES) / 1000, rel=0.01)


@pytest.mark.parametrize(
    ("bytes_per_s", "expected"), [(None, CHUNK_BYTES), (100, MIN_CHUNK_BYTES), (2000, 1000), (10_000_000, CHUNK_BYTES)]
)
def test_chunks_last_half_a_second(bytes_per_s, expected):
    assert chunk_bytes_for(bytes_per_s) == expected


@given(st.lists(st.tuples(st.integers(1, 7), st.integers(0, 3)), min_size=1, max_size=20))
def test_order_is_priority_then_position(wanted):
    scheduler = schedule(
        *(
            OutboxItem("c2", seq, "k", "", priority, b"x", bytes(32), position=place)
            for seq, (priority, place) in enumerate(wanted, 1)
        )
    )
    sent = [ask(scheduler).transfer.order for _ in wanted]
    assert sent == sorted(sent)
    assert scheduler.next_chunk(0.0) == (None, None)


def test_one_query_and_few_records_until_the_first_reply():
    scheduler = schedule(*(item(n) for n in range(1, 9)), responding=False)
    assert scheduler.lookahead == PROBE_WINDOW
    first = ask(scheduler)
    assert scheduler.next_chunk(0.0) == (None, None)
    scheduler.query_ended(first, 0.1, replied=True)
    scheduler.probing = False
    assert scheduler.lookahead == WINDOW
    assert ask(scheduler).transfer.item.seq == 2


def test_full_window_has_a_reserve_for_urgent_records():
    scheduler = schedule(*(item(n) for n in range(1, WINDOW + 1)))
    for _ in range(WINDOW - URGENT_RESERVE):
        ask(scheduler)
    assert scheduler.next_chunk(0.0) == (None, None)
    scheduler.update([item(999, priority=1), *(transfer.item for transfer in scheduler.active.values())])
    assert ask(scheduler).transfer.item.seq == 999


@given(st.lists(st.tuples(st.integers(0, 3000), st.booleans()), min_size=1, max_size=60), st.floats(4096, 40_000))
def test_bytes_in_flight_fit_the_window_and_urgent_ones_a_window_of_their_own(records, window_bytes):
    scheduler = schedule(*(item(n, size, 2 if urgent else 6) for n, (size, urgent) in enumerate(records, 1)))
    scheduler.congestion.window_bytes = window_bytes
    sent = {True: 0, False: 0}
    while scheduler.next_chunk(0.0)[0] is not None:
        chunk = ask(scheduler)
        sent[chunk.transfer.urgent] += chunk.size
    most = window_bytes + scheduler.chunk_bytes
    assert max(sent.values()) <= most
    left = [t.item.priority for t in scheduler.active.values() if t.has_unsent]
    assert not left or sent[min(left) == 2] + sent[True] * (min(left) != 2) + scheduler.chunk_bytes / 2 > window_bytes


def test_equal_replies_rewind_a_transfer_once():
    """Three chunks in flight, none accepted: the three equal replies rewind the transfer once."""
    scheduler = schedule(item(1, 5 * CHUNK_BYTES))
    chunks = [ask(scheduler) for _ in range(3)]
    scheduler.confirm(chunks[0], 0)
    assert scheduler.active[1].sent == 0
    again = ask(scheduler)
    assert (again.start, again.end) == (0, CHUNK_BYTES)
    scheduler.confirm(chunks[1], 0)
    scheduler.confirm(chunks[2], 0)
    assert scheduler.active[1].sent == CHUNK_BYTES
    scheduler.confirm(again, 4 * CHUNK_BYTES)
    assert ask(scheduler).start == 4 * CHUNK_BYTES


def test_restart_continues_at_the_confirmed_offset():
    scheduler = schedule(item(1, 3 * CHUNK_BYTES), item(2))
    chunks = [ask(scheduler) for _ in range(4)]
    scheduler.query_ended(chunks[0], 0.0, replied=True)
    scheduler.confirm(chunks[0], CHUNK_BYTES)
    scheduler.restart(timed_out=False)
    scheduler.congestion.window_bytes = MAX_WINDOW_BYTES
    scheduler.probing = False
    assert [(p.transfer.item.seq, p.start) for p in (ask(scheduler), ask(scheduler), ask(scheduler))] == [
        (1, CHUNK_BYTES),
        (1, 2 * CHUNK_BYTES),
        (2, 0),
    ]


def test_update_removes_transfers_that_are_not_in_flight():
    scheduler = schedule(item(1), item(2))
    ask(scheduler)
    scheduler.update([item(3, priority=1)])
    assert set(scheduler.active) == {1, 3}


@given(st.floats(1, 1e6), st.floats(1, 1e5), st.lists(st.tuples(st.floats(0, 10), st.integers(0, 10_000)), max_size=30))
def test_token_bucket_never_exceeds_burst_and_rate(rate, burst, takes):
    bucket = TokenBucket(rate, burst, 0.0)
    now_s, taken, largest = 0.0, 0, 0
    for pause_s, size in takes:
        now_s += pause_s
        now_s += bucket.wait_s(size, now_s)
        bucket.take(size, now_s)
        taken, largest = taken + size, max(largest, size)
        assert taken <= burst + rate * now_s + largest + 1e-6 * (taken + burst + rate * (now_s + 1))


def test_token_bucket_ignores_a_clock_that_goes_back():
    bucket = TokenBucket(10, 10, 100.0)
    bucket.take(10, 100.0)
    assert bucket.wait_s(10, 50.0) == pytest.approx(1.0)
    assert bucket.wait_s(10, 101.0) == pytest.approx(0.0)


@given(
    st.lists(st.tuples(st.integers(0, 12_000), st.integers(2, 4), st.sampled_from("ab")), min_size=1, max_size=60),
    st.integers(0, 40),
    st.one_of(st.none(), st.floats(500, 100_000)),
)
def test_batches_keep_order_key_priority_and_chunk_size(records, takes, bytes_per_s):
    items = [
        OutboxItem("c2", seq, key, "", priority, bytes(size), bytes(32), position=seq)
        for seq, (size, priority, key) in enumerate(records, 1)
    ]
    scheduler = schedule(*items, bytes_per_s=bytes_per_s)
    scheduler.max_batch = takes
    now_s = charged = 0.0
    sent = []
    while scheduler.active:
        chunk, wait_s = scheduler.next_chunk(now_s)
        if chunk is None:
            now_s += wait_s
            continue
        chunks = scheduler.batch_with(chunk)
        assert chunks[0] is chunk
        assert len(chunks) <= max(takes, 1)
        if len(chunks) > 1:
            assert sum(p.size for p in chunks) <= scheduler.chunk_bytes
            assert all(p.start == 0 and p.end == len(p.transfer.item.payload) for p in chunks)
            assert len({(p.transfer.item.key, p.transfer.item.priority) for p in chunks}) == 1
        scheduler.query_sent(chunk, now_s, *chunks[1:])
        scheduler.query_ended(chunk, now_s, replied=True)
        size = sum(p.size for p in chunks) + QUERY_OVERHEAD_BYTES
        if bytes_per_s is not None and not chunk.transfer.urgent:
            assert charged <= bytes_per_s * now_s + scheduler.chunk_bytes + QUERY_OVERHEAD_BYTES + 1e-3 * (charged + 1)
        charged += size
        for done in chunks:
            if done.end == len(done.transfer.item.payload):
                scheduler.remove(done.transfer)
            else:
                scheduler.confirm(done, done.end)
        sent += chunks
    order = list(dict.fromkeys(p.transfer.order for p in sent))
    assert order == sorted(order)
    assert sum(p.size for p in sent) == sum(len(i.payload) for i in items)


def test_restart_disables_batches_until_announced_again():
    scheduler = schedule(item(1), item(2), item(3))
    scheduler.max_batch = 3
    first = ask(scheduler)
    assert len(scheduler.batch_with(first)) == 1, "the first record is already in flight"
    scheduler.query_ended(first, 0.0, replied=True)
    chunk, _ = scheduler.next_chunk(0.0)
    assert [p.transfer.item.seq for p in scheduler.batch_with(chunk)] == [2, 3]
    scheduler.restart(timed_out=False)
    chunk, _ = scheduler.next_chunk(0.0)
    assert scheduler.batch_with(chunk) == [chunk]
