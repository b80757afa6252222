"""Medium access: when a station may send, on simulated time."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import ConfigError
from sonarpost.link.mac import Continuous, Csma, Polled, Tdma

TIMES = st.floats(1e9, 2e9)


def test_continuous_pauses_after_each_burst():
    mac, now = Continuous(60.0, 8.0), 1000.0
    begun, pauses = now, []
    for _ in range(40):
        wait_s = mac.wait_s(6.0, now)
        if wait_s:
            pauses.append((now - begun, wait_s))
            now += wait_s
            begun = now
            assert mac.wait_s(6.0, now) == 0.0
        mac.sent(now, now + 6.0)
        now += 6.0
    assert pauses == [(60.0, 8.0)] * 3
    now += 8.0
    mac.sent(now, now + 6.0)
    assert mac.wait_s(6.0, now + 6.0) == 0.0


def test_continuous_without_pauses_waits_only_for_other_stations():
    mac = Continuous(1.0, 0.0, holdoff_s=5.0)
    for n in range(100):
        assert mac.wait_s(6.0, 6.0 * n) == 0.0
        mac.sent(6.0 * n, 6.0 * n + 6.0)
    mac.channel_busy(1000.0)
    assert mac.wait_s(6.0, 1002.0) == 3.0
    assert mac.wait_s(6.0, 1005.0) == 0.0
    assert mac.wait_s(6.0, 900.0) == 0.0, "the clock was set back"


@given(now=TIMES, packet_s=st.floats(0.5, 9.0), start_s=st.floats(0, 40.0))
def test_tdma_packet_ends_within_its_slot(now, packet_s, start_s):
    mac = Tdma(60.0, start_s, start_s + 10.0)
    wait_s = mac.wait_s(packet_s, now)
    assert wait_s is not None
    assert 0 <= wait_s <= 60.0
    into = (now + wait_s - start_s) % 60.0
    assert into + packet_s <= 10.0 + 1e-5 or into > 60.0 - 1e-5
    if wait_s:
        assert (now - start_s) % 60.0 + packet_s > 10.0


@given(now=TIMES, packet_s=st.floats(0.5, 6.0), stations=st.integers(2, 8))
def test_tdma_stations_never_collide(now, packet_s, stations):
    slot_s, travel_s = 8.0, 1.0
    sent = []
    for n in range(stations):
        mac = Tdma(stations * slot_s, n * slot_s, (n + 1) * slot_s - 2.0)
        start = now + (mac.wait_s(packet_s, now) or 0.0)
        sent.append((start, start + packet_s + travel_s))
    sent.sort()
    assert all(first[1] <= second[0] + 1e-5 for first, second in pairwise(sent))


def test_tdma_slot_too_short_for_the_packet_returns_none():
    assert Tdma(60.0, 0.0, 4.0).wait_s(6.0, 0.0) is None


def test_polled_station_never_starts():
    mac = Polled()
    mac.sent(0.0, 1.0)
    mac.channel_busy(2.0)
    assert mac.wait_s(1.0, 1e6) is None


@given(seed=st.integers(0, 1000), mean_s=st.floats(0.1, 100.0))
def test_csma_waits_up_to_twice_the_mean(seed, mean_s):
    mac = Csma(mean_s, holdoff_s=0.0, seed=seed)
    now, waits = 1e9, []
    for _ in range(60):
        mac.sent(now - 1.0, now)
        wait_s = mac.wait_s(6.0, now)
        waits.append(wait_s)
        assert 0 <= wait_s <= 2 * mean_s
        assert mac.wait_s(6.0, now + wait_s) < 1e-5
        now += wait_s
    assert 0.5 * mean_s < sum(waits) / 60 < 1.5 * mean_s


def test_csma_defers_to_others_and_tolerates_a_clock_set_back():
    mac = Csma(1.0, holdoff_s=4.0, seed=1)
    mac.sent(0.0, 1000.0)
    mac.channel_busy(1003.0)
    assert mac.wait_s(6.0, 1003.0) == 4.0
    assert mac.wait_s(6.0, 0.0) <= 2.0


@pytest.mark.parametrize(
    "make",
    [
        lambda: Tdma(10.0, 5.0, 11.0),
        lambda: Tdma(10.0, 6.0, 5.0),
        lambda: Continuous(0.0, 1.0),
        lambda: Continuous(1.0, -1.0),
        lambda: Csma(-1.0),
        lambda: Csma(float("nan")),
    ],
)
def test_times_out_of_range_are_rejected(make):
    with pytest.raises(ConfigError, match="medium access: "):
        make()
