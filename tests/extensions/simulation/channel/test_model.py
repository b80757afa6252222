"""Channel model: travel time, half duplex, collisions, loss, damage and random draws."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.events import (
    AcousticPacket,
    ArrivalEnded,
    ArrivalStarted,
    FrameOutcome,
    PacketKind,
    PacketOutcome,
)
from sonarpost.extensions.simulation.channel.model import ChannelModel, RandomDraws, damage_tail
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters, TailDamage

PINNED_UNIFORM = 0.13411210046500488
PINNED_NOISE = "daef2330"


def packet(*frames: bytes, rate: int = 1, airtime_s: float = 3.0) -> AcousticPacket:
    return AcousticPacket(PacketKind.DATA, 1, 2, rate, airtime_s, frames)


def make_channel(*positions_m: float, **config: object) -> ChannelModel:
    places = {number: LocalPosition(east_m) for number, east_m in enumerate(positions_m, start=1)}
    return ChannelModel(ChannelParameters(**config), places)  # type: ignore[arg-type]


def ended(events: list[ArrivalStarted | ArrivalEnded]) -> list[ArrivalEnded]:
    return [event for event in events if isinstance(event, ArrivalEnded)]


def frame_outcomes(arrival: ArrivalEnded) -> list[FrameOutcome]:
    return [frame.outcome for frame in arrival.frames]


def test_arrival_follows_travel_time_and_air_time():
    channel = make_channel(0.0, 750.0, sound_speed_m_per_s=1500.0)
    channel.transmit(1, packet(b"abc"), now=10.0)
    assert channel.next_event_s() == 10.5
    assert channel.poll(10.49) == []
    (start,) = channel.poll(10.5)
    assert isinstance(start, ArrivalStarted)
    assert start.receiver == 2
    assert channel.poll(13.49) == []
    (end,) = channel.poll(13.5)
    assert isinstance(end, ArrivalEnded)
    assert (end.time_s, end.delay_s, end.range_m, end.outcome) == (13.5, 0.5, 750.0, PacketOutcome.ARRIVED)
    assert end.frames[0].received == b"abc"
    assert channel.next_event_s() is None
    assert channel.in_flight == 0


@pytest.mark.parametrize("start_s", [-2.9, 0.0, 2.9])
def test_half_duplex(start_s: float):
    channel = make_channel(0.0, 0.0)
    both = sorted([(10.0, 1), (10.0 + start_s, 2)])
    events: list[ArrivalEnded] = []
    for now, modem in both:
        events += ended(channel.poll(now))
        channel.transmit(modem, packet(b"x"), now)
    events += ended(channel.poll(100.0))
    assert {event.receiver: event.outcome for event in events} == {
        1: PacketOutcome.TRANSMITTING,
        2: PacketOutcome.TRANSMITTING,
    }
    assert all(frame_outcomes(event) == [FrameOutcome.LOST] for event in events)


def test_transmissions_that_only_touch_are_both_received():
    channel = make_channel(0.0, 0.0)
    channel.transmit(1, packet(b"x", airtime_s=2.0), 0.0)
    events = ended(channel.poll(2.0))
    channel.transmit(2, packet(b"y", airtime_s=2.0), 2.0)
    events += ended(channel.poll(4.0))
    assert [event.outcome for event in events] == [PacketOutcome.ARRIVED, PacketOutcome.ARRIVED]


def test_collision_is_local_to_the_receiver():
    # Modem 3 is at modem 1 and receives its packet before modem 2 transmits; at modem 4 the packets overlap.
    channel = make_channel(0.0, 15000.0, 0.0, 7500.0)
    channel.transmit(1, packet(b"one"), 0.0)
    channel.transmit(2, packet(b"two"), 1.0)
    outcomes = {(e.transmission.transmitter, e.receiver): e for e in ended(channel.poll(100.0))}
    assert outcomes[1, 3].outcome is PacketOutcome.ARRIVED
    assert outcomes[1, 4].outcome is PacketOutcome.COLLISION
    assert outcomes[2, 4].outcome is PacketOutcome.COLLISION
    assert frame_outcomes(outcomes[1, 4]) == [FrameOutcome.LOST]
    assert outcomes[1, 4].detected
    assert not outcomes[2, 4].detected


def test_collision_with_a_packet_that_ended_earlier():
    # The short packet has ended before the long one it collides with.
    channel = make_channel(0.0, 0.0, 0.0)
    channel.transmit(1, packet(b"long", airtime_s=10.0), 0.0)
    channel.transmit(2, packet(b"s1", airtime_s=1.0), 1.0)
    outcomes = [(e.transmission.transmitter, e.receiver, e.outcome) for e in ended(channel.poll(9.0))]
    assert outcomes == [(2, 1, PacketOutcome.TRANSMITTING), (2, 3, PacketOutcome.COLLISION)]
    assert [(e.receiver, e.outcome) for e in ended(channel.poll(10.0))] == [
        (2, PacketOutcome.TRANSMITTING),
        (3, PacketOutcome.COLLISION),
    ]


def test_overlapping_transmissions_of_one_modem_are_rejected():
    channel = make_channel(0.0, 0.0)
    channel.transmit(1, packet(b"x", airtime_s=2.0), 0.0)
    with pytest.raises(ValueError, match="transmits until"):
        channel.transmit(1, packet(b"x", airtime_s=2.0), 1.9)
    channel.transmit(1, packet(b"x", airtime_s=2.0), 2.0)


def run_packets(count: int, **config: object) -> list[ArrivalEnded]:
    channel = make_channel(0.0, 100.0, **config)
    arrivals = []
    for n in range(count):
        channel.transmit(1, packet(*(bytes([65 + k]) * 64 for k in range(3))), now=10.0 * n)
        arrivals += ended(channel.poll(10.0 * n + 9))
    return arrivals


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.5, 1.0])
def test_frame_loss_has_the_configured_probability(loss: float):
    lost = [
        frame.outcome is FrameOutcome.LOST for a in run_packets(1000, frame_loss=loss, seed=7) for frame in a.frames
    ]
    deviation = math.sqrt(loss * (1 - loss) / len(lost))
    assert abs(sum(lost) / len(lost) - loss) <= 3 * deviation


def test_packet_loss_has_the_configured_probability():
    arrivals = run_packets(1000, packet_loss=0.25, seed=3)
    lost = [a for a in arrivals if a.outcome is PacketOutcome.LOST]
    assert abs(len(lost) / 1000 - 0.25) <= 3 * math.sqrt(0.25 * 0.75 / 1000)
    assert not any(a.detected for a in lost)
    assert all(frame_outcomes(a) == [FrameOutcome.LOST] * 3 for a in lost)


def test_frame_losses_are_independent():
    pairs = [frame_outcomes(a)[:2] for a in run_packets(2000, frame_loss=0.5, seed=11)]
    both = sum(pair == [FrameOutcome.LOST, FrameOutcome.LOST] for pair in pairs) / len(pairs)
    assert abs(both - 0.25) < 3 * math.sqrt(0.25 * 0.75 / 2000)


def test_outcomes_depend_on_the_seed():
    config = {"frame_loss": 0.4, "packet_loss": 0.1, "tail_damage": 0.3}
    first, second = (run_packets(60, seed=5, **config) for _ in range(2))
    assert first == second
    assert [frame_outcomes(a) for a in first] != [frame_outcomes(a) for a in run_packets(60, seed=6, **config)]


@given(st.lists(st.floats(0.001, 5.0), min_size=6, max_size=6), st.booleans())
def test_outcomes_are_independent_of_time_and_other_receivers(pauses_s: list[float], third: bool):
    config = {"frame_loss": 0.5, "tail_damage": 0.5, "seed": 9}
    expected = [[(f.outcome, f.received) for f in a.frames] for a in run_packets(6, **config)]
    channel = make_channel(0.0, 100.0, *([3000.0] if third else []), **config)
    now, seen = 0.0, []
    for pause_s in pauses_s:
        channel.transmit(1, packet(*(bytes([65 + k]) * 64 for k in range(3))), now)
        now += 3.0 + pause_s
        seen += [a for a in ended(channel.poll(now)) if a.receiver == 2]
    seen += [a for a in ended(channel.poll(now + 100)) if a.receiver == 2]
    assert [[(f.outcome, f.received) for f in a.frames] for a in seen] == expected


@pytest.mark.parametrize("kind", list(TailDamage))
def test_damaged_tail_is_delivered_with_its_length(kind: TailDamage):
    channel = make_channel(0.0, 100.0, tail_damage=1.0, tail_damage_kind=kind, tail_fraction=0.25)
    tails = []
    for n in range(50):
        channel.transmit(1, packet(b"\x55" * 64, b"\xaa" * 40, b""), now=10.0 * n)
        (arrival,) = ended(channel.poll(10.0 * n + 9))
        assert frame_outcomes(arrival) == [FrameOutcome.DELIVERED, FrameOutcome.DAMAGED, FrameOutcome.EMPTY]
        received = arrival.frames[1].received
        assert len(received) == 40
        assert received[:30] == b"\xaa" * 30
        tails.append(received)
    zeroed = [tail.endswith(b"\x00") for tail in tails]
    if kind is TailDamage.ZEROS:
        assert all(zeroed)
    else:
        # Random noise ends in a zero byte with probability 1/256.
        assert sum(zeroed) < (5 if kind is TailDamage.NOISE else 40)
        assert len(set(tails)) > 20


def test_zero_tail_replaced_by_zeros_is_delivered():
    channel = make_channel(0.0, 100.0, tail_damage=1.0, tail_damage_kind=TailDamage.ZEROS)
    channel.transmit(1, packet(bytes(32)), now=0.0)
    (arrival,) = ended(channel.poll(9.0))
    assert frame_outcomes(arrival) == [FrameOutcome.DELIVERED]


@given(st.binary(min_size=1, max_size=300), st.integers(0, 2**63), st.floats(0.01, 1.0), st.sampled_from(TailDamage))
def test_damage_is_limited_to_the_tail(frame: bytes, seed: int, fraction: float, kind: TailDamage):
    damaged = damage_tail(frame, RandomDraws(seed, 1, 1, 2), 1, kind, fraction)
    kept = len(frame) - max(1, int(len(frame) * fraction))
    assert len(damaged) == len(frame)
    assert damaged[:kept] == frame[:kept]


def test_random_draws_are_pinned():
    # A change of the draws changes the outcome of every recorded seed.
    draws = RandomDraws(seed=1, transmitter=1, packet=1, receiver=2)
    assert draws.uniform("frame loss", 1) == pytest.approx(PINNED_UNIFORM, abs=1e-15)
    assert draws.noise(4, "tail noise", 1).hex() == PINNED_NOISE


def test_old_arrivals_are_deleted():
    channel = make_channel(0.0, 100.0, 5000.0)
    for n in range(500):
        channel.transmit(1 + n % 2, packet(b"x"), now=10.0 * n)
        channel.poll(10.0 * n + 9.9)
    assert sum(len(place.arrivals) + len(place.transmissions) for place in channel._modems.values()) < 12
