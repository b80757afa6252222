"""Congestion control on simulated links: use of the rate, waiting times, fairness, interruptions, time-outs."""

import pytest
from builders.link_simulation import Link, Sender, Simulation, records
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.delivery.congestion import (
    MAX_TIMEOUT_S,
    MAX_WINDOW_BYTES,
    MEASURE_EVERY_S,
    MIN_QUERY_BYTES,
    MIN_TIMEOUT_S,
    QUEUE_S,
    START_BYTES,
    CongestionControl,
)

RECORD_BYTES = 282
"""A coded image of 200 bytes as the relay sends it."""
MORE_THAN_ENOUGH = 6000
RATES = st.floats(1000, 130_000)
DELAYS_S = st.floats(0.001, 0.5)
JITTER = st.floats(0, 0.15)
"""Part of the delay."""


def link(rate_bytes_per_s, delay_s, jitter=0.0):
    return Link(rate_bytes_per_s, delay_s, jitter * delay_s)


def reply_s(rate_bytes_per_s, delay_s, size_bytes=3000):
    """Time of a query in an empty link."""
    return 2 * delay_s + size_bytes / rate_bytes_per_s


def carried(simulation, seconds):
    """Part of the rate that the link carries in the next seconds."""
    before, begins_s = simulation.link.carried_bytes, simulation.now_s
    simulation.run(begins_s + seconds)
    return (simulation.link.carried_bytes - before) / simulation.link.up.rate_bytes_per_s / seconds


@settings(max_examples=60, deadline=None)
@given(RATES, DELAYS_S, JITTER)
def test_a_link_is_used_and_its_queue_stays_short(rate_bytes_per_s, delay_s, jitter):
    sender = Sender(records(MORE_THAN_ENOUGH))
    simulation = Simulation(link(rate_bytes_per_s, delay_s, jitter), sender)
    simulation.run(15 * reply_s(rate_bytes_per_s, delay_s))
    seconds = 20 * reply_s(rate_bytes_per_s, delay_s)
    sender.add(records(int(rate_bytes_per_s * seconds / RECORD_BYTES), first=10**6))
    assert carried(simulation, seconds) > 0.85
    free_s = reply_s(rate_bytes_per_s, delay_s, sender.scheduler.chunk_bytes) * (1 + jitter)
    assert simulation.link.up.queue_s(simulation.now_s) < 1.2 * free_s + 6000 / rate_bytes_per_s + 0.1
    assert set(sender.queries.values()) == {1}, "nothing is sent again"


@pytest.mark.parametrize("rate_bytes_per_s", [2000, 8000, 16_000, 32_000, 128_000])
def test_headers_are_a_small_part_of_the_bytes(rate_bytes_per_s):
    sender = Sender(records(rate_bytes_per_s // 10))
    simulation = Simulation(link(rate_bytes_per_s, 0.3), sender).run()
    assert sender.is_done
    assert simulation.link.carried_bytes < 1.15 * 336 * len(sender.acknowledged_s)


@settings(max_examples=40, deadline=None)
@given(st.floats(2000, 130_000), DELAYS_S, st.integers(0, 5))
def test_a_decision_waits_at_most_two_round_trips(rate_bytes_per_s, delay_s, later):
    sender = Sender(records(MORE_THAN_ENOUGH))
    simulation = Simulation(link(rate_bytes_per_s, delay_s), sender)
    round_trip_s = reply_s(rate_bytes_per_s, delay_s, sender.scheduler.chunk_bytes)
    queued_s = (15 + later / 3) * round_trip_s
    simulation.run(queued_s)
    sender.add(records(1, 250, priority=2, first=10**6))
    simulation.send(sender)
    simulation.run(queued_s + 60)
    assert sender.acknowledged_s[10**6] - queued_s < 2 * round_trip_s + 3000 / rate_bytes_per_s + 3 * QUEUE_S


@pytest.mark.parametrize("hops", [1, 2, 3])
@pytest.mark.parametrize("rate_bytes_per_s", [2000, 8000, 32_000, 128_000])
def test_routers_that_forward_whole_queries_do_not_look_like_a_queue(rate_bytes_per_s, hops):
    sender = Sender(records(int(rate_bytes_per_s * 80 / RECORD_BYTES)))
    simulation = Simulation(Link(rate_bytes_per_s, 0.3, hops=hops), sender).run(20)
    assert carried(simulation, 40) > 0.85


def test_a_consumer_of_single_records_gets_a_window():
    sender = Sender(records(60_000), max_batch=0)
    simulation = Simulation(link(32_000, 0.3), sender).run(20)
    assert carried(simulation, 20) > 0.85


def test_a_backlog_of_decisions_obeys_the_window():
    sender = Sender(records(1000, 250, priority=2))
    simulation = Simulation(link(8000, 0.3), sender)
    assert carried(simulation, 20) > 0.8
    assert simulation.link.up.queue_s(simulation.now_s) < 1.5


@pytest.mark.parametrize("rate_bytes_per_s", [4000, 16_000, 64_000])
@pytest.mark.parametrize("later_s", [0.0, 25.0])
def test_two_sites_share_a_link(rate_bytes_per_s, later_s):
    sites = [Sender(records(100_000)), Sender(records(100_000), begins_s=later_s)]
    simulation = Simulation(link(rate_bytes_per_s, 0.3), *sites).run(420)
    before = [len(site.acknowledged_s) for site in sites]
    simulation.run(620)
    first, second = (len(site.acknowledged_s) - count for site, count in zip(sites, before, strict=True))
    assert 0.6 < first / second < 1.7
    assert simulation.link.up.queue_s(simulation.now_s) < 3


def test_an_interruption_keeps_what_was_learned():
    sender = Sender(records(60_000))
    simulation = Simulation(link(32_000, 0.3), sender).run(30)
    learned_bytes = sender.scheduler.congestion.window_bytes
    simulation.cut(link(32_000, 0.3))
    assert sender.scheduler.congestion.window_bytes == START_BYTES
    simulation.run(33.5)
    assert sender.scheduler.congestion.window_bytes >= learned_bytes / 2
    assert carried(simulation, 10) > 0.9


def test_a_slower_link_after_an_interruption_is_not_flooded():
    sender = Sender(records(60_000))
    simulation = Simulation(link(128_000, 0.3), sender).run(30)
    simulation.cut(link(2000, 0.3))
    for end_s in range(31, 60):
        simulation.run(end_s)
        assert simulation.link.up.queue_s(simulation.now_s) < 5
    assert carried(simulation, 30) > 0.85


def test_a_rate_that_falls_causes_no_time_out():
    sender = Sender(records(60_000))
    simulation = Simulation(link(128_000, 0.3), sender).run(30)
    simulation.link.up.rate_bytes_per_s = 16_000
    for end_s in range(31, 90):
        assert simulation.link.up.queue_s(simulation.now_s) < sender.scheduler.congestion.timeout_s
        simulation.run(end_s)
    assert simulation.link.up.queue_s(simulation.now_s) < 1.5
    assert carried(simulation, 10) > 0.85


def test_a_slower_link_after_a_pause_is_not_flooded():
    sender = Sender(records(4000))
    simulation = Simulation(link(500_000, 0.02), sender).run(30)
    assert sender.is_done
    simulation.link.up.rate_bytes_per_s = 2000
    sender.add(records(1000, first=10**6))
    simulation.send(sender)
    for end_s in range(31, 60):
        simulation.run(end_s)
        assert simulation.link.up.queue_s(simulation.now_s) < 5


@pytest.mark.parametrize(("rate_bytes_per_s", "stall_s"), [(32_000, 60), (128_000, 100)])
def test_a_stall_at_the_time_of_a_measurement_ends_with_it(rate_bytes_per_s, stall_s):
    sender = Sender(records(rate_bytes_per_s * 2))
    simulation = Simulation(link(rate_bytes_per_s, 0.3), sender).run(MEASURE_EVERY_S - stall_s / 2)
    simulation.link.up.arrival_s(rate_bytes_per_s * stall_s, simulation.now_s)
    simulation.run(MEASURE_EVERY_S + stall_s / 2 + 20)
    assert carried(simulation, 20) > 0.8
    assert set(sender.queries.values()) == {1}


@pytest.mark.parametrize(("before_s", "after_s"), [(0.15, 0.3), (0.05, 0.12)])
def test_a_longer_path_after_an_interruption_is_found(before_s, after_s):
    sender = Sender(records(200_000))
    simulation = Simulation(link(128_000, before_s), sender).run(242)
    simulation.cut(link(128_000, after_s))
    simulation.run(262)
    assert carried(simulation, 20) > 0.85


def test_measurements_begin_at_multiples_of_utc():
    control = CongestionControl(clock_offset_s=100.0)
    control.replied(4000, 0.0, 0.1, 10**7)
    small_at_s = []
    for now_s in range(1, 2 * int(MEASURE_EVERY_S)):
        control.replied(4000, now_s - 1, now_s, 10**7)
        if control.window_bytes == START_BYTES:
            small_at_s.append(now_s)
    assert small_at_s[0] == MEASURE_EVERY_S - 100
    assert MEASURE_EVERY_S < max(small_at_s) < 2 * MEASURE_EVERY_S - 90


def test_hosts_that_share_a_link_measure_at_the_same_time_by_their_synchronised_clocks():
    starts_s = [0.0, 61.0, 127.0, 190.0]
    hosts = [Sender(records(60_000), begins_s=start_s) for start_s in starts_s]
    simulation = Simulation(link(32_000, 0.3), *hosts)
    for end_s in range(600, 1500, 100):
        simulation.run(end_s)
        assert simulation.link.up.queue_s(simulation.now_s) < 1.5


def test_a_longer_path_without_an_interruption_is_found():
    sender = Sender(records(200_000))
    simulation = Simulation(link(64_000, 0.05), sender).run(30)
    simulation.link.up.delay_s = 0.4
    simulation.run(300)
    assert carried(simulation, 20) > 0.85


def test_time_outs_double_and_a_reply_ends_that():
    control = CongestionControl()
    timeouts_s = []
    for _ in range(2000):
        timeouts_s.append(control.timeout_s)
        control.timed_out()
    assert timeouts_s == [min(MIN_TIMEOUT_S * 2 ** min(n, 10), MAX_TIMEOUT_S) for n in range(2000)]
    control.replied(2000, 0.0, 1.5, 2000)
    assert MIN_TIMEOUT_S + 1.5 < control.timeout_s < MIN_TIMEOUT_S + 15


def test_a_window_that_is_not_used_does_not_grow():
    control = CongestionControl()
    for number in range(100):
        control.replied(200, number, number + 0.01, 200)
    assert control.window_bytes == 2 * MIN_QUERY_BYTES


@given(st.lists(st.tuples(st.sampled_from("rtib"), st.floats(0, 100), st.integers(0, 10**6)), max_size=60))
def test_window_and_time_out_stay_in_their_limits(events):
    control = CongestionControl()
    now_s = 0.0
    for kind, seconds, size_bytes in events:
        now_s += seconds
        if kind == "r":
            control.replied(size_bytes, now_s - seconds, now_s, 3 * size_bytes)
        elif kind == "t":
            control.timed_out()
        elif kind == "i":
            control.interrupted()
        else:
            control.begins(now_s)
        assert START_BYTES <= control.window_bytes <= MAX_WINDOW_BYTES
        assert MIN_TIMEOUT_S <= control.timeout_s <= MAX_TIMEOUT_S
