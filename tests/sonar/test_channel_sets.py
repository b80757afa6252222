"""Choice of the channels of a sonar with several frequencies, ranges or heads."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.sonar.channel_sets import ChannelChoice
from sonarpost.sonar.survey import ChannelPing, Ping, Side

SAMPLES = np.ones(4, np.uint8)


def channel(side, frequency_hz=None, index=0, range_m=30.0):
    return ChannelPing(side, SAMPLES, range_m, frequency_hz, index=index)


def both(frequency_hz=None, index=0, range_m=30.0):
    return tuple(channel(side, frequency_hz, index, range_m) for side in Side)


def chosen(pings, wanted_hz=None):
    """Return the choice, and the frequencies and ranges of the pings that it selects."""
    choice = ChannelChoice(wanted_hz)
    made = [Ping(number, float(number), channels) for number, channels in enumerate(pings)]
    for ping in made:
        choice.observe(ping)
    choice.choose()
    selected = [ping for each in made if (ping := choice.select(each)) is not None]
    assert choice.left_out == len(made) - len(selected)
    assert all(len({c.side for c in ping.channels}) == len(ping.channels) for ping in selected)
    return choice, selected


@given(
    low_khz=st.floats(50, 900),
    ratio=st.floats(1.5, 8),
    jitter=st.floats(0, 0.015),
    alternate=st.booleans(),
    wanted=st.sampled_from((None, "low", "high")),
)
def test_two_frequencies_are_two_sets_whether_in_one_ping_or_in_turns(low_khz, ratio, jitter, alternate, wanted):
    low_hz, high_hz = low_khz * 1e3, low_khz * 1e3 * ratio
    pings = []
    for row in range(20):
        low, high = both(low_hz * (1 + jitter * (row % 2))), both(high_hz * (1 - jitter * (row % 3)), range_m=15.0)
        pings += [low, high] if alternate else [(*low, *high)]
    choice, selected = chosen(pings, {"low": low_hz, "high": high_hz, None: None}[wanted])
    assert [each.ping_count for each in choice.sets] == [20, 20]
    assert len(selected) == 20
    expected_hz = low_hz if wanted == "low" else high_hz
    assert all(c.frequency_hz == pytest.approx(expected_hz, rel=0.04) for ping in selected for c in ping.channels)
    assert len(choice.warnings()) == 1 + alternate


def test_sides_of_different_frequency_are_one_set():
    choice, selected = chosen([(channel(Side.PORT, 380e3), channel(Side.STARBOARD, 420e3))] * 5)
    assert len(choice.sets) == 1
    assert choice.warnings() == []
    assert choice.sides == tuple(Side)
    assert all(len(ping.channels) == 2 for ping in selected)


def test_sets_without_a_frequency_are_told_apart_by_the_order_of_the_channels_on_each_side():
    # A packet a side: the subchannel tells the sides apart, not two sets.
    choice, _ = chosen([(channel(Side.PORT, index=0), channel(Side.STARBOARD, index=1))] * 5)
    assert len(choice.sets) == 1
    choice, selected = chosen([(*both(index=0), *both(index=7, range_m=60.0))] * 5)
    assert len(choice.sets) == 2
    assert {c.index for ping in selected for c in ping.channels} == {0}


def test_alternating_ranges_are_two_sets_and_a_change_of_range_is_not():
    choice, selected = chosen([both(range_m=60.0), both(range_m=30.0)] * 10)
    assert len(choice.sets) == 2
    assert {c.slant_range_m for ping in selected for c in ping.channels} == {30.0}
    choice, selected = chosen([both(range_m=60.0)] * 10 + [both(range_m=30.0)] * 10)
    assert (len(choice.sets), len(selected), choice.left_out) == (1, 20, 0)


def test_a_frequency_of_few_pings_is_not_the_default_but_can_be_chosen():
    pings = [both(100e3)] * 20 + [both(400e3)] * 5
    choice, selected = chosen(pings)
    assert {c.frequency_hz for ping in selected for c in ping.channels} == {100e3}
    assert [each.frequency_hz for each in choice.sets] == [400e3, 100e3]
    assert len(chosen(pings, 400e3)[1]) == 5
    notes = chosen(pings, 900e3)[0].warnings()
    assert any("no channels of 900 kHz" in note for note in notes)


def test_too_many_combinations_are_an_error():
    choice = ChannelChoice(None)
    for number in range(1024):
        choice.observe(Ping(number, 0.0, both(index=number)))
    with pytest.raises(ValueError, match="over 1024 combinations"):
        choice.observe(Ping(1024, 0.0, both(index=1024)))
