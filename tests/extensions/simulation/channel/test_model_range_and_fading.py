"""Channel model: loss by range, calibration to the sea trial of the paper, burst fading."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from research.channel_table import deliver
from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.events import (
    AcousticPacket,
    ArrivalEnded,
    FrameOutcome,
    PacketKind,
    PacketOutcome,
)
from sonarpost.extensions.simulation.channel.model import ChannelModel, Fading
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters, build_parameters


def send(channel: ChannelModel, count: int, now: float, airtime_s: float) -> ArrivalEnded:
    frames = tuple(bytes([n]) * 8 for n in range(1, count + 1))
    channel.transmit(1, AcousticPacket(PacketKind.DATA, 1, 2, 1, airtime_s, frames), now)
    (arrival,) = (event for event in channel.poll(now + airtime_s + 1.0) if isinstance(event, ArrivalEnded))
    return arrival


def two_modems(range_m: float, config: ChannelParameters) -> ChannelModel:
    return ChannelModel(config, {1: LocalPosition(), 2: LocalPosition(range_m)})


def test_snr_decreases_with_range():
    channel = two_modems(1.0, ChannelParameters(snr_at_1m_db=60.0))
    levels = [channel.snr_db(range_m) for range_m in (0.0, 1.0, 10.0, 100.0, 1000.0)]
    assert levels[0] == levels[1] == pytest.approx(60.0, abs=0.01)
    assert levels[3] == pytest.approx(60 - 40 - 0.51, abs=0.01)
    assert levels[1:] == sorted(levels[1:], reverse=True)
    cylinder = two_modems(1.0, ChannelParameters(snr_at_1m_db=60.0, spreading_db_per_decade=10.0))
    assert cylinder.snr_db(100.0) == pytest.approx(39.49, abs=0.01)


def test_sea_trial_preset_reproduces_the_paper():
    """The paper: at rate 1, most packets arrive below 130 m, and most are lost from there to 300 m."""
    channel = build_parameters({"preset": "sea-trial", "seed": 5}, "test")
    near = [deliver(channel, 1, range_m, 60).packets for range_m in range(2, 130, 9)]
    far = [deliver(channel, 1, range_m, 60).packets for range_m in range(135, 301, 11)]
    assert min(near) > 0.85
    assert sum(near) / len(near) > 0.9
    assert sum(far) / len(far) < 0.2
    assert far[0] > far[2] > far[4] == 0.0
    assert sum(arrived > 0.5 for arrived in far) <= 2, "most packets are lost at nearly every range beyond 130 m"


def test_fade_durations_have_the_configured_means():
    fading = Fading(3, mean_clear_s=20.0, mean_fade_s=5.0)
    states = [fading.faded(1, 2, n * 0.1) for n in range(80_000)]
    runs = [(state, 0.1 * sum(1 for _ in group)) for state, group in itertools.groupby(states)]
    for faded, mean_s in ((True, 5.0), (False, 20.0)):
        stays_s = [length_s for state, length_s in runs if state is faded]
        assert sum(stays_s) / len(stays_s) == pytest.approx(mean_s, rel=0.15)
    assert not states[0]


@given(st.lists(st.floats(0.0, 500.0), max_size=20), st.integers(0, 99))
def test_fades_are_independent_of_query_order_and_direction(times_s: list[float], seed: int):
    one, other = (Fading(seed, 10.0, 3.0) for _ in range(2))
    forward = [one.faded(1, 2, at_s) for at_s in times_s]
    assert [other.faded(2, 1, at_s) for at_s in reversed(times_s)] == forward[::-1]


def test_fade_loses_exactly_the_frames_in_it():
    fading = Fading(1, 20.0, 4.0)
    channel = two_modems(0.0, ChannelParameters(seed=1, mean_clear_s=20.0, mean_fade_s=4.0))
    lost, partly = 0, 0
    for n in range(200):
        arrival = send(channel, 8, 10.0 * n, 8.0)
        expected = [fading.faded(1, 2, 10.0 * n + k + 0.5) for k in range(8)]
        assert [frame.outcome is FrameOutcome.LOST for frame in arrival.frames] == expected
        lost += sum(expected)
        partly += 0 < sum(expected) < 8
    assert lost > 100
    assert partly > 20, "a burst covers part of a packet"


def test_packet_in_a_deep_fade_is_not_detected():
    config = ChannelParameters(range_loss=True, mean_clear_s=0.5, mean_fade_s=1e6, fade_loss=0.0, fade_depth_db=60.0)
    arrival = send(two_modems(50.0, config), 1, 1000.0, 3.0)
    assert (arrival.detected, arrival.outcome) == (False, PacketOutcome.LOST)
