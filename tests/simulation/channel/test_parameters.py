"""The channel model: sonar equation, fading, calibration to the paper's sea trial, where parameters come from."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from research.channel_table import RANGES_M, deliver, table
from sonarpost.errors import ConfigError
from sonarpost.simulation.channel.acoustics import LocalPosition, absorption_db_per_km, noise_db_per_hz
from sonarpost.simulation.channel.events import AcousticPacket, ArrivalEnded, FrameOutcome, PacketKind, PacketOutcome
from sonarpost.simulation.channel.model import ChannelModel, Fading
from sonarpost.simulation.channel.parameters import ChannelParameters, TailDamage, build_parameters, read_parameters


def send(sea: ChannelModel, count: int, now: float, airtime_s: float) -> ArrivalEnded:
    frames = tuple(bytes([n]) * 8 for n in range(1, count + 1))
    sea.transmit(1, AcousticPacket(PacketKind.DATA, 1, 2, 1, airtime_s, frames), now)
    (arrival,) = (event for event in sea.poll(now + airtime_s + 1.0) if isinstance(event, ArrivalEnded))
    return arrival


def two_modems(range_m: float, config: ChannelParameters) -> ChannelModel:
    return ChannelModel(config, {1: LocalPosition(), 2: LocalPosition(range_m)})


def test_the_sea_trial_comes_out():
    """The paper's: 2 to 300 m at rate 1, most packets arrive below 130 m, most are lost beyond."""
    sea = build_parameters({"preset": "sea-trial", "seed": 5}, "test")
    near = [deliver(sea, 1, range_m, 60).packets for range_m in range(2, 130, 9)]
    far = [deliver(sea, 1, range_m, 60).packets for range_m in range(135, 301, 11)]
    assert min(near) > 0.85
    assert sum(near) / len(near) > 0.9
    assert sum(far) / len(far) < 0.2
    assert far[0] > far[2] > far[4] == 0.0
    assert sum(arrived > 0.5 for arrived in far) <= 2, "most are lost at nearly every range beyond"


def test_snr_falls_with_range():
    sea = two_modems(1.0, ChannelParameters(snr_at_1m_db=60.0))
    levels = [sea.snr_db(range_m) for range_m in (0.0, 1.0, 10.0, 100.0, 1000.0)]
    assert levels[0] == levels[1] == pytest.approx(60.0, abs=0.01)
    assert levels[3] == pytest.approx(60 - 40 - 0.51, abs=0.01)
    assert levels[1:] == sorted(levels[1:], reverse=True)
    cylinder = two_modems(1.0, ChannelParameters(snr_at_1m_db=60.0, spreading_db_per_decade=10.0))
    assert cylinder.snr_db(100.0) == pytest.approx(39.49, abs=0.01)


@pytest.mark.parametrize(("frequency_hz", "db_per_km"), [(1_000, 0.06), (10_000, 1.0), (25_000, 5.1), (100_000, 33.6)])
def test_absorption_is_that_of_the_tables(frequency_hz: float, db_per_km: float):
    # Sea water of 10 degrees and 35 psu at the surface, after Francois and Garrison; the formula is within 10 %.
    assert absorption_db_per_km(frequency_hz) == pytest.approx(db_per_km, rel=0.12)


def test_absorption_falls_with_salt_and_with_depth():
    assert absorption_db_per_km(25_000, salinity_psu=0.0) < 0.4
    assert absorption_db_per_km(25_000, depth_m=5000.0) < 0.6 * absorption_db_per_km(25_000)


def test_noise_is_that_of_wenz():
    # 25 kHz: wind rules; at sea state 3 (5 to 8 m/s) Wenz's chart has 35 to 42 dB.
    assert 35.0 < noise_db_per_hz(25_000, wind_m_per_s=5.0) < 42.0
    assert noise_db_per_hz(25_000, wind_m_per_s=15.0) > noise_db_per_hz(25_000, wind_m_per_s=5.0) + 8.0
    assert noise_db_per_hz(100, shipping=1.0) > noise_db_per_hz(100, shipping=0.0) + 15.0
    assert noise_db_per_hz(500_000, wind_m_per_s=0.0) == pytest.approx(-15 + 20 * math.log10(500), abs=0.5)


def test_the_sonar_equation_adds_up():
    config = ChannelParameters(source_level_db=185.0, excess_loss_db=10.0)
    noise_db = noise_db_per_hz(25_000, 5.0) + 10 * math.log10(5000)
    assert config.reference_snr_db == pytest.approx(185 - 10 - noise_db)
    assert ChannelParameters(snr_at_1m_db=41.0).reference_snr_db == 41.0


def test_fades_are_as_long_and_as_frequent_as_asked_for():
    fading = Fading(3, mean_clear_s=20.0, mean_fade_s=5.0)
    states = [fading.faded(1, 2, n * 0.05) for n in range(400_000)]
    runs = [(state, 0.05 * sum(1 for _ in group)) for state, group in itertools.groupby(states)]
    for faded, mean_s in ((True, 5.0), (False, 20.0)):
        stays_s = [length_s for state, length_s in runs if state is faded]
        assert sum(stays_s) / len(stays_s) == pytest.approx(mean_s, rel=0.15)
    assert not states[0]


@given(st.lists(st.floats(0.0, 500.0), max_size=20), st.integers(0, 99))
def test_a_fade_does_not_depend_on_when_it_is_looked_at_or_from_which_end(times_s: list[float], seed: int):
    one, other = (Fading(seed, 10.0, 3.0) for _ in range(2))
    forward = [one.faded(1, 2, at_s) for at_s in times_s]
    assert [other.faded(2, 1, at_s) for at_s in reversed(times_s)] == forward[::-1]


def test_a_fade_takes_the_frames_in_it_and_only_those():
    fading = Fading(1, 20.0, 4.0)
    sea = two_modems(0.0, ChannelParameters(seed=1, mean_clear_s=20.0, mean_fade_s=4.0))
    lost, partly = 0, 0
    for n in range(200):
        arrival = send(sea, 8, 10.0 * n, 8.0)
        expected = [fading.faded(1, 2, 10.0 * n + k + 0.5) for k in range(8)]
        assert [frame.outcome is FrameOutcome.LOST for frame in arrival.frames] == expected
        lost += sum(expected)
        partly += 0 < sum(expected) < 8
    assert lost > 100
    assert partly > 20, "a burst hits part of a packet"


def test_a_deep_fade_hides_a_packet():
    config = ChannelParameters(range_loss=True, mean_clear_s=0.5, mean_fade_s=1e6, fade_loss=0.0, fade_depth_db=60.0)
    arrival = send(two_modems(50.0, config), 1, 1000.0, 3.0)
    assert (arrival.detected, arrival.outcome) == (False, PacketOutcome.LOST)


def test_water_from_preset_file_and_options(tmp_path: Path):
    file = tmp_path / "water.toml"
    file.write_text('preset = "sea-trial"\nsnr_at_1m_db = 45\ntail_damage_kind = "zeros"\n', encoding="utf-8")
    config = build_parameters(read_parameters(file) | {"seed": 9}, "test")
    assert (config.snr_at_1m_db, config.seed, config.range_loss) == (45, 9, True)
    assert config.tail_damage_kind is TailDamage.ZEROS


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("frame_loss = 2.0", "frame_loss.*less than or equal to 1"),
        ("frame_loss = true", "frame_loss.*a valid number"),
        ("seed = 1.5", "seed.*a valid integer"),
        ("range_loss = 1", "range_loss.*a valid boolean"),
        ('preset = "calm"', "preset.*still, sea-trial"),
        ('tail_damage_kind = "ones"', "tail_damage_kind.*zeros"),
        ("frame_los = 0.1", "frame_los"),
        ("frame_loss = ", "TOML"),
    ],
)
def test_a_water_file_that_is_wrong_names_file_key_and_value(tmp_path: Path, text: str, named: str):
    file = tmp_path / "water.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=named) as caught:
        build_parameters(read_parameters(file), str(file))
    assert "water.toml" in str(caught.value)


def test_the_table_shows_every_rate_and_range():
    lines = table(ChannelParameters(), packets=2).splitlines()
    assert len(lines) == 2 + len(RANGES_M)
    assert lines[2].split("|")[1:4] == [" 2 ", " 54.0 ", " 100 / 100 "]
