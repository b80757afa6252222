"""Which piece goes next, and when, by a simulated clock: the bandwidth limit, urgency, windows, and beginning anew."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.delivery.protocol import CHUNK_BYTES
from sonarpost.delivery.scheduler import (
    KEPT_FOR_URGENT,
    MAX_WINDOW_BYTES,
    MIN_PIECE_BYTES,
    OVERHEAD_BYTES,
    PIECE_S,
    PROBE_WINDOW,
    WINDOW,
    WINDOW_BYTES,
    Chunk,
    DeliveryScheduler,
    piece_bytes_for,
)
from sonarpost.delivery.token_bucket import TokenBucket
from sonarpost.delivery.transaction import OutboxItem


def item(seq: int, size: int = 100, priority: int = 6) -> OutboxItem:
    return OutboxItem("c2", seq, "k", "", priority, bytes(size), bytes(32), place=seq)


def schedule(*items: OutboxItem, bytes_per_s: float | None = None, answered: bool = True) -> DeliveryScheduler:
    made = DeliveryScheduler(bytes_per_s, 0.0)
    made.probing = not answered
    made.put(items)
    return made


def ask(plan: DeliveryScheduler, now_s: float = 0.0) -> Chunk:
    piece, _ = plan.next_piece(now_s)
    assert piece is not None
    plan.asked(piece, now_s)
    return piece


class ThinLink:
    """Sends what the schedule gives over a link of a certain rate; every answer comes when its piece is through."""

    def __init__(self, plan: DeliveryScheduler) -> None:
        self.plan = plan
        self.now_s = 0.0
        self.sent: list[tuple[float, int, int]] = []

    def step(self) -> bool:
        piece, wait_s = self.plan.next_piece(self.now_s)
        if piece is None:
            if wait_s is None:
                return False
            assert wait_s > 0
            self.now_s += wait_s
            return True
        self.plan.asked(piece, self.now_s)
        self.sent.append((self.now_s, piece.transfer.item.seq, piece.size))
        self.plan.answered(piece, self.now_s)
        if piece.end == len(piece.transfer.item.payload):
            self.plan.settled(piece.transfer)
        else:
            self.plan.go_on_from(piece, piece.end)
        return True

    def run(self, until_s: float = 1e9) -> None:
        while self.now_s < until_s and self.step():
            pass


@given(st.floats(50, 200_000), st.lists(st.integers(0, 60_000), min_size=1, max_size=8))
@settings(max_examples=60)
def test_no_more_goes_than_the_limit_allows_and_no_less(bytes_per_s: float, sizes: list[int]) -> None:
    link = ThinLink(schedule(*(item(n, size) for n, size in enumerate(sizes, 1)), bytes_per_s=bytes_per_s))
    link.run()
    assert sum(size for _, _, size in link.sent) == sum(sizes)
    charged = 0
    for at_s, _, size in link.sent:
        charged += size + OVERHEAD_BYTES
        assert (
            charged <= bytes_per_s * at_s + link.plan.piece_bytes + OVERHEAD_BYTES + 1e-6 * charged + bytes_per_s * 1e-6
        )
    # The link is never left idle: all but the first piece's worth takes as long as the limit says, and no longer.
    assert link.now_s <= charged / bytes_per_s + 1e-6


@given(st.floats(100, 50_000), st.floats(0.0, 30.0))
@settings(max_examples=40)
def test_an_urgent_record_waits_for_no_more_than_the_piece_that_is_on_its_way(bytes_per_s: float, at_s: float) -> None:
    link = ThinLink(schedule(*(item(n, 30_000) for n in range(1, 9)), bytes_per_s=bytes_per_s))
    link.run(until_s=at_s)
    plan = link.plan
    plan.put([item(99, 200, priority=2), *(transfer.item for transfer in plan.active.values())])
    piece, wait_s = plan.next_piece(link.now_s)
    assert piece is not None
    assert piece.transfer.item.seq == 99
    assert wait_s == 0.0
    assert plan.piece_bytes <= max(bytes_per_s * PIECE_S, MIN_PIECE_BYTES)


def test_what_was_urgent_is_paid_for_by_what_is_not() -> None:
    plan = schedule(item(1, 10_000), bytes_per_s=1000)
    for seq in range(10, 20):
        plan.put([item(seq, 500, priority=1), item(1, 10_000)])
        piece = ask(plan)
        assert piece.transfer.item.seq == seq
        plan.answered(piece, 0.0)
        plan.settled(piece.transfer)
    piece, wait_s = plan.next_piece(0.0)
    assert piece is None
    assert wait_s is not None
    assert wait_s == pytest.approx(10 * (500 + OVERHEAD_BYTES) / 1000, rel=0.01)


@pytest.mark.parametrize(
    ("bytes_per_s", "expected"),
    [(None, CHUNK_BYTES), (100, MIN_PIECE_BYTES), (2000, 1000), (10_000_000, CHUNK_BYTES)],
)
def test_pieces_are_half_a_second_long(bytes_per_s: float | None, expected: int) -> None:
    assert piece_bytes_for(bytes_per_s) == expected


@given(st.lists(st.tuples(st.integers(1, 7), st.integers(0, 3)), min_size=1, max_size=20))
def test_the_most_urgent_goes_first_then_what_has_the_first_place(wanted: list[tuple[int, int]]) -> None:
    plan = schedule(
        *(
            OutboxItem("c2", seq, "k", "", priority, b"x", bytes(32), place=place)
            for seq, (priority, place) in enumerate(wanted, 1)
        )
    )
    sent = [ask(plan).transfer.order for _ in wanted]
    assert sent == sorted(sent)
    assert plan.next_piece(0.0) == (None, None)


def test_until_somebody_answers_one_query_is_in_flight_and_few_records_are_looked_at() -> None:
    plan = schedule(*(item(n) for n in range(1, 9)), answered=False)
    assert plan.looks_at == PROBE_WINDOW
    first = ask(plan)
    assert plan.next_piece(0.0) == (None, None)
    plan.answered(first, 0.1)
    plan.probing = False
    assert plan.looks_at == WINDOW
    assert ask(plan).transfer.item.seq == 2


def test_a_full_window_keeps_room_for_what_is_urgent() -> None:
    plan = schedule(*(item(n) for n in range(1, WINDOW + 1)))
    for _ in range(WINDOW - KEPT_FOR_URGENT):
        ask(plan)
    assert plan.next_piece(0.0) == (None, None)
    plan.put([item(999, priority=1), *(transfer.item for transfer in plan.active.values())])
    assert ask(plan).transfer.item.seq == 999


def test_bytes_in_flight_grow_while_answers_are_quick_and_shrink_when_they_are_slow() -> None:
    plan = schedule(*(item(n, 40 * CHUNK_BYTES) for n in range(1, 9)))

    def in_flight(answer_after_s: float, rounds: int) -> int:
        now_s, most = 0.0, 0
        for _ in range(rounds):
            pieces = []
            while plan.next_piece(now_s)[0] is not None:
                pieces.append(ask(plan, now_s))
            most = sum(piece.size for piece in pieces)
            now_s += answer_after_s
            for piece in pieces:
                plan.answered(piece, now_s)
        return most

    assert in_flight(0.01, 1) == WINDOW_BYTES
    assert in_flight(0.01, 4) > 4 * WINDOW_BYTES
    assert in_flight(0.01, 3) <= MAX_WINDOW_BYTES
    assert in_flight(2.0, 3) <= WINDOW_BYTES


def test_on_a_thin_link_no_more_is_in_flight_than_gets_through_in_a_query_s_time() -> None:
    plan = schedule(item(1, 60_000), bytes_per_s=1000)
    for now_s in range(0, 40, 10):
        while plan.next_piece(now_s)[0] is not None:
            ask(plan, now_s)
    assert sum(size for size in [plan.active[1].asked]) <= 2 * 1000


def test_a_consumer_that_has_more_or_less_is_believed_once() -> None:
    """Three pieces on their way, of which the consumer took none: three answers alike rewind once."""
    plan = schedule(item(1, 5 * CHUNK_BYTES))
    pieces = [ask(plan) for _ in range(3)]
    plan.go_on_from(pieces[0], 0)
    assert plan.active[1].asked == 0
    again = ask(plan)
    assert (again.start, again.end) == (0, CHUNK_BYTES)
    plan.go_on_from(pieces[1], 0)
    plan.go_on_from(pieces[2], 0)
    assert plan.active[1].asked == CHUNK_BYTES
    plan.go_on_from(again, 4 * CHUNK_BYTES)
    assert ask(plan).start == 4 * CHUNK_BYTES


def test_after_a_failure_everything_is_asked_again_from_what_the_consumer_has() -> None:
    plan = schedule(item(1, 3 * CHUNK_BYTES), item(2))
    pieces = [ask(plan) for _ in range(4)]
    plan.answered(pieces[0], 0.0)
    plan.go_on_from(pieces[0], CHUNK_BYTES)
    plan.start_again()
    plan.probing = False
    assert [(p.transfer.item.seq, p.start) for p in (ask(plan), ask(plan), ask(plan))] == [
        (1, CHUNK_BYTES),
        (1, 2 * CHUNK_BYTES),
        (2, 0),
    ]


def test_what_has_not_begun_makes_room_and_what_has_begun_stays() -> None:
    plan = schedule(item(1), item(2))
    ask(plan)
    plan.put([item(3, priority=1)])
    assert set(plan.active) == {1, 3}


@given(st.floats(1, 1e6), st.floats(1, 1e5), st.lists(st.tuples(st.floats(0, 10), st.integers(0, 10_000)), max_size=30))
def test_a_bucket_never_gives_more_than_burst_and_rate(
    rate: float, burst: float, takes: list[tuple[float, int]]
) -> None:
    bucket = TokenBucket(rate, burst, 0.0)
    now_s, taken, largest = 0.0, 0, 0
    for pause_s, size in takes:
        now_s += pause_s
        now_s += bucket.wait_s(size, now_s)
        bucket.take(size, now_s)
        taken, largest = taken + size, max(largest, size)
        assert taken <= burst + rate * now_s + largest + 1e-6 * (taken + burst + rate * (now_s + 1))


def test_a_clock_that_goes_back_gives_nothing() -> None:
    bucket = TokenBucket(10, 10, 100.0)
    bucket.take(10, 100.0)
    assert bucket.wait_s(10, 50.0) == pytest.approx(1.0)
    assert bucket.wait_s(10, 101.0) == pytest.approx(0.0)


@given(
    st.lists(st.tuples(st.integers(0, 12_000), st.integers(2, 4), st.sampled_from("ab")), min_size=1, max_size=60),
    st.integers(0, 40),
    st.one_of(st.none(), st.floats(500, 100_000)),
)
@settings(max_examples=80)
def test_records_go_together_in_order_alike_and_within_one_piece(
    records: list[tuple[int, int, str]], takes: int, bytes_per_s: float | None
) -> None:
    items = [
        OutboxItem("c2", seq, key, "", priority, bytes(size), bytes(32), place=seq)
        for seq, (size, priority, key) in enumerate(records, 1)
    ]
    plan = schedule(*items, bytes_per_s=bytes_per_s)
    plan.takes = takes
    now_s = charged = 0.0
    sent: list[Chunk] = []
    while plan.active:
        piece, wait_s = plan.next_piece(now_s)
        if piece is None:
            assert wait_s is not None
            now_s += wait_s
            continue
        pieces = plan.together_with(piece)
        assert pieces[0] is piece
        assert len(pieces) <= max(takes, 1)
        if len(pieces) > 1:
            assert sum(p.size for p in pieces) <= plan.piece_bytes
            assert all(p.start == 0 and p.end == len(p.transfer.item.payload) for p in pieces)
            assert len({(p.transfer.item.key, p.transfer.item.priority) for p in pieces}) == 1
        plan.asked(piece, now_s, *pieces[1:])
        plan.answered(piece, now_s)
        size = sum(p.size for p in pieces) + OVERHEAD_BYTES
        if bytes_per_s is not None and not piece.transfer.urgent:
            assert charged <= bytes_per_s * now_s + plan.piece_bytes + OVERHEAD_BYTES + 1e-3 * (charged + 1)
        charged += size
        for done in pieces:
            if done.end == len(done.transfer.item.payload):
                plan.settled(done.transfer)
            else:
                plan.go_on_from(done, done.end)
        sent += pieces
    begun = list(dict.fromkeys(p.transfer.order for p in sent))
    assert begun == sorted(begun)
    assert sum(p.size for p in sent) == sum(len(i.payload) for i in items)


def test_one_record_at_a_time_until_the_consumer_has_said_otherwise_again() -> None:
    plan = schedule(item(1), item(2), item(3))
    plan.takes = 3
    first = ask(plan)
    assert len(plan.together_with(first)) == 1, "it has begun"
    plan.answered(first, 0.0)
    piece, _ = plan.next_piece(0.0)
    assert piece is not None
    assert [p.transfer.item.seq for p in plan.together_with(piece)] == [2, 3]
    plan.start_again()
    piece, _ = plan.next_piece(0.0)
    assert piece is not None
    assert plan.together_with(piece) == [piece]
