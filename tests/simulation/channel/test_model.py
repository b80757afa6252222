"""The simulated water, its dice, its physics, and simulated time."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.modem.micromodem import RATES
from sonarpost.simulation.channel.acoustics import LocalPosition, frame_error_rate
from sonarpost.simulation.channel.emulator import TimeScale
from sonarpost.simulation.channel.events import (
    AcousticPacket,
    ArrivalEnded,
    ArrivalStarted,
    FrameOutcome,
    PacketKind,
    PacketOutcome,
)
from sonarpost.simulation.channel.model import ChannelModel, RandomDraws, damage_tail
from sonarpost.simulation.channel.parameters import ChannelParameters, TailDamage

PINNED_UNIFORM = 0.13411210046500488
PINNED_NOISE = "daef2330"


def packet(*frames: bytes, rate: int = 1, airtime_s: float = 3.0) -> AcousticPacket:
    return AcousticPacket(PacketKind.DATA, 1, 2, rate, airtime_s, frames)


def water(*positions_m: float, **config: object) -> ChannelModel:
    places = {number: LocalPosition(east_m) for number, east_m in enumerate(positions_m, start=1)}
    return ChannelModel(ChannelParameters(**config), places)  # type: ignore[arg-type]


def ended(events: list[ArrivalStarted | ArrivalEnded]) -> list[ArrivalEnded]:
    return [event for event in events if isinstance(event, ArrivalEnded)]


def fates(arrival: ArrivalEnded) -> list[FrameOutcome]:
    return [frame.outcome for frame in arrival.frames]


def test_a_packet_arrives_after_its_travel_time_and_lasts_its_air_time():
    sea = water(0.0, 750.0, sound_speed_m_per_s=1500.0)
    sea.transmit(1, packet(b"abc"), now=10.0)
    assert sea.next_event_s() == 10.5
    assert sea.poll(10.49) == []
    (start,) = sea.poll(10.5)
    assert isinstance(start, ArrivalStarted)
    assert start.receiver == 2
    assert sea.poll(13.49) == []
    (end,) = sea.poll(13.5)
    assert isinstance(end, ArrivalEnded)
    assert (end.time_s, end.delay_s, end.range_m, end.outcome) == (13.5, 0.5, 750.0, PacketOutcome.ARRIVED)
    assert end.frames[0].received == b"abc"
    assert sea.next_event_s() is None
    assert sea.in_flight == 0


def test_sound_speed_and_position_change_the_travel_time_of_later_packets_only():
    sea = water(0.0, 140.0, sound_speed_m_per_s=1400.0)
    sea.transmit(1, packet(b"a"), now=0.0)
    sea.move(2, LocalPosition(280.0))
    assert ended(sea.poll(100.0))[0].delay_s == pytest.approx(0.1)
    sea.transmit(1, packet(b"a"), now=100.0)
    assert ended(sea.poll(200.0))[0].delay_s == pytest.approx(0.2)


@pytest.mark.parametrize("start_s", [-2.9, 0.0, 2.9])
def test_half_duplex_a_modem_hears_nothing_that_overlaps_its_own_transmission(start_s: float):
    sea = water(0.0, 0.0)
    both = sorted([(10.0, 1), (10.0 + start_s, 2)])
    events: list[ArrivalEnded] = []
    for now, modem in both:
        events += ended(sea.poll(now))
        sea.transmit(modem, packet(b"x"), now)
    events += ended(sea.poll(100.0))
    assert {event.receiver: event.outcome for event in events} == {
        1: PacketOutcome.TRANSMITTING,
        2: PacketOutcome.TRANSMITTING,
    }
    assert all(fates(event) == [FrameOutcome.LOST] for event in events)


def test_transmissions_that_only_touch_are_both_heard():
    sea = water(0.0, 0.0)
    sea.transmit(1, packet(b"x", airtime_s=2.0), 0.0)
    events = ended(sea.poll(2.0))
    sea.transmit(2, packet(b"y", airtime_s=2.0), 2.0)
    events += ended(sea.poll(4.0))
    assert [event.outcome for event in events] == [PacketOutcome.ARRIVED, PacketOutcome.ARRIVED]


def test_overlapping_arrivals_destroy_each_other_at_that_receiver_only():
    # 3 stands beside 1, and hears 1 long before 2 begins; at 4 the two overlap.
    sea = water(0.0, 15000.0, 0.0, 7500.0)
    sea.transmit(1, packet(b"one"), 0.0)
    sea.transmit(2, packet(b"two"), 1.0)
    outcomes = {(e.transmission.transmitter, e.receiver): e for e in ended(sea.poll(100.0))}
    assert outcomes[1, 3].outcome is PacketOutcome.ARRIVED
    assert outcomes[1, 4].outcome is PacketOutcome.COLLISION
    assert outcomes[2, 4].outcome is PacketOutcome.COLLISION
    assert fates(outcomes[1, 4]) == [FrameOutcome.LOST]
    assert outcomes[1, 4].detected
    assert not outcomes[2, 4].detected


def test_a_collision_counts_even_with_a_packet_that_was_resolved_before():
    # The long packet overlaps two short ones in turn; the first short one is over before the long one ends.
    sea = water(0.0, 0.0, 0.0)
    sea.transmit(1, packet(b"long", airtime_s=10.0), 0.0)
    sea.transmit(2, packet(b"s1", airtime_s=1.0), 1.0)
    outcomes = [(e.transmission.transmitter, e.receiver, e.outcome) for e in ended(sea.poll(9.0))]
    assert outcomes == [(2, 1, PacketOutcome.TRANSMITTING), (2, 3, PacketOutcome.COLLISION)]
    assert [(e.receiver, e.outcome) for e in ended(sea.poll(10.0))] == [
        (2, PacketOutcome.TRANSMITTING),
        (3, PacketOutcome.COLLISION),
    ]


def test_a_modem_cannot_transmit_twice_at_once():
    sea = water(0.0, 0.0)
    sea.transmit(1, packet(b"x", airtime_s=2.0), 0.0)
    with pytest.raises(ValueError, match="transmits until"):
        sea.transmit(1, packet(b"x", airtime_s=2.0), 1.9)
    sea.transmit(1, packet(b"x", airtime_s=2.0), 2.0)


def run_packets(count: int, **config: object) -> list[ArrivalEnded]:
    sea = water(0.0, 100.0, **config)
    arrivals = []
    for n in range(count):
        sea.transmit(1, packet(*(bytes([65 + k]) * 64 for k in range(3))), now=10.0 * n)
        arrivals += ended(sea.poll(10.0 * n + 9))
    return arrivals


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.5, 1.0])
def test_frame_loss_is_what_was_asked_for(loss: float):
    lost = [
        frame.outcome is FrameOutcome.LOST for a in run_packets(1000, frame_loss=loss, seed=7) for frame in a.frames
    ]
    deviation = math.sqrt(loss * (1 - loss) / len(lost))
    assert abs(sum(lost) / len(lost) - loss) <= 3 * deviation


def test_packet_loss_takes_whole_packets_and_nothing_is_detected():
    arrivals = run_packets(1000, packet_loss=0.25, seed=3)
    lost = [a for a in arrivals if a.outcome is PacketOutcome.LOST]
    assert abs(len(lost) / 1000 - 0.25) <= 3 * math.sqrt(0.25 * 0.75 / 1000)
    assert not any(a.detected for a in lost)
    assert all(fates(a) == [FrameOutcome.LOST] * 3 for a in lost)


def test_frames_are_lost_independently_of_each_other():
    pairs = [fates(a)[:2] for a in run_packets(2000, frame_loss=0.5, seed=11)]
    both = sum(pair == [FrameOutcome.LOST, FrameOutcome.LOST] for pair in pairs) / len(pairs)
    assert abs(both - 0.25) < 3 * math.sqrt(0.25 * 0.75 / 2000)


def test_the_same_seed_gives_the_same_fates_and_another_seed_others():
    config = {"frame_loss": 0.4, "packet_loss": 0.1, "tail_damage": 0.3}
    first, second = (run_packets(60, seed=5, **config) for _ in range(2))
    assert first == second
    assert [fates(a) for a in first] != [fates(a) for a in run_packets(60, seed=6, **config)]


@given(st.lists(st.floats(0.001, 5.0), min_size=6, max_size=6), st.booleans())
def test_fates_do_not_depend_on_when_a_packet_is_sent_or_who_else_listens(pauses_s: list[float], third: bool):
    config = {"frame_loss": 0.5, "tail_damage": 0.5, "seed": 9}
    expected = [[(f.outcome, f.received) for f in a.frames] for a in run_packets(6, **config)]
    sea = water(0.0, 100.0, *([3000.0] if third else []), **config)
    now, seen = 0.0, []
    for pause_s in pauses_s:
        sea.transmit(1, packet(*(bytes([65 + k]) * 64 for k in range(3))), now)
        now += 3.0 + pause_s
        seen += [a for a in ended(sea.poll(now)) if a.receiver == 2]
    seen += [a for a in ended(sea.poll(now + 100)) if a.receiver == 2]
    assert [[(f.outcome, f.received) for f in a.frames] for a in seen] == expected


@pytest.mark.parametrize("kind", list(TailDamage))
def test_a_damaged_tail_passes_for_good_and_keeps_its_length(kind: TailDamage):
    sea = water(0.0, 100.0, tail_damage=1.0, tail_damage_kind=kind, tail_fraction=0.25)
    tails = []
    for n in range(50):
        sea.transmit(1, packet(b"\x55" * 64, b"\xaa" * 40, b""), now=10.0 * n)
        (arrival,) = ended(sea.poll(10.0 * n + 9))
        assert fates(arrival) == [FrameOutcome.DELIVERED, FrameOutcome.DAMAGED, FrameOutcome.EMPTY]
        received = arrival.frames[1].received
        assert len(received) == 40
        assert received[:30] == b"\xaa" * 30
        tails.append(received)
    zeroed = [tail.endswith(b"\x00") for tail in tails]
    if kind is TailDamage.ZEROS:
        assert all(zeroed)
    else:
        # Noise ends in a zero byte once in 256 times.
        assert sum(zeroed) < (5 if kind is TailDamage.NOISE else 40)
        assert len(set(tails)) > 20


def test_zeros_over_zeros_are_no_damage():
    sea = water(0.0, 100.0, tail_damage=1.0, tail_damage_kind=TailDamage.ZEROS)
    sea.transmit(1, packet(bytes(32)), now=0.0)
    (arrival,) = ended(sea.poll(9.0))
    assert fates(arrival) == [FrameOutcome.DELIVERED]


@given(st.binary(min_size=1, max_size=300), st.integers(0, 2**63), st.floats(0.01, 1.0), st.sampled_from(TailDamage))
def test_damage_stays_within_the_tail(frame: bytes, seed: int, fraction: float, kind: TailDamage):
    damaged = damage_tail(frame, RandomDraws(seed, 1, 1, 2), 1, kind, fraction)
    kept = len(frame) - max(1, int(len(frame) * fraction))
    assert len(damaged) == len(frame)
    assert damaged[:kept] == frame[:kept]


def test_draws_are_pinned():
    # The draws are part of what a seed means: a change here changes every recorded run.
    dice = RandomDraws(seed=1, transmitter=1, packet=1, receiver=2)
    assert dice.uniform("frame loss", 1) == pytest.approx(PINNED_UNIFORM, abs=1e-15)
    assert dice.noise(4, "tail noise", 1).hex() == PINNED_NOISE


def test_range_loss_follows_the_published_error_rates():
    assert frame_error_rate(1, -7.23) == pytest.approx(0.73)
    assert frame_error_rate(1, -20.0) == 1.0
    assert frame_error_rate(5, 6.02) == 0.0
    assert frame_error_rate(5, 3.77) == pytest.approx(0.5675)
    for rate in RATES:
        rates = [frame_error_rate(rate, level / 10) for level in range(-150, 150)]
        assert all(a >= b for a, b in itertools.pairwise(rates))
        assert (rates[0], rates[-1]) == (1.0, 0.0)


@pytest.mark.parametrize(
    "config",
    [
        {"frame_loss": -0.1},
        {"frame_loss": math.nan},
        {"packet_loss": 1.1},
        {"tail_damage": 2.0},
        {"tail_fraction": 0.0},
        {"sound_speed_m_per_s": 0.0},
        {"sound_speed_m_per_s": math.inf},
    ],
)
def test_values_out_of_bounds_are_refused(config: dict[str, float]):
    with pytest.raises(ValueError, match=next(iter(config))):
        ChannelParameters(**config)  # type: ignore[arg-type]


def test_old_arrivals_are_forgotten():
    sea = water(0.0, 100.0, 5000.0)
    for n in range(500):
        sea.transmit(1 + n % 2, packet(b"x"), now=10.0 * n)
        sea.poll(10.0 * n + 9.9)
    assert sum(len(place.arrivals) + len(place.transmissions) for place in sea._modems.values()) < 12


@given(st.floats(0.01, 1000.0), st.floats(0.0, 1e6), st.floats(0.0, 1e4))
def test_simulated_time_runs_at_its_scale(scale: float, started_s: float, real_s: float):
    clock = TimeScale(scale, started_s)
    simulated_s = clock.simulated_s(started_s + real_s)
    assert simulated_s == pytest.approx(real_s * scale, rel=1e-6, abs=1e-6 * scale)
    assert clock.wait_s(simulated_s, started_s) == pytest.approx(real_s)
    assert clock.wait_s(simulated_s - 1, started_s + real_s + 1) == 0.0


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_a_time_scale_is_above_zero(scale: float):
    with pytest.raises(ValueError, match="time scale"):
        TimeScale(scale)
