"""Channel parameters: sonar equation, presets, files and bounds."""

import math
from pathlib import Path

import pytest

from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.channel.acoustics import noise_db_per_hz
from sonarpost.extensions.simulation.channel.parameters import (
    ChannelParameters,
    TailDamage,
    build_parameters,
    read_parameters,
)


def test_reference_snr_follows_the_sonar_equation():
    config = ChannelParameters(source_level_db=185.0, excess_loss_db=10.0)
    noise_db = noise_db_per_hz(25_000, 5.0) + 10 * math.log10(5000)
    assert config.reference_snr_db == pytest.approx(185 - 10 - noise_db)
    assert ChannelParameters(snr_at_1m_db=41.0).reference_snr_db == 41.0


def test_parameters_from_preset_file_and_options(tmp_path: Path):
    file = tmp_path / "channel.toml"
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
def test_parameter_file_error_names_file_key_and_value(tmp_path: Path, text: str, named: str):
    file = tmp_path / "channel.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=named) as caught:
        build_parameters(read_parameters(file), str(file))
    assert "channel.toml" in str(caught.value)


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
def test_parameter_out_of_bounds_is_rejected(config: dict[str, float]):
    with pytest.raises(ValueError, match=next(iter(config))):
        ChannelParameters(**config)  # type: ignore[arg-type]
