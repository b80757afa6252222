"""Parameters of the channel model: bounds, presets and TOML files.

docs/explanation/channel-model.md names the source of each parameter.
"""

import json
import math
import tomllib
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from pydantic import Field, ValidationError

from sonarpost.config import ServiceConfig
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.channel.acoustics import (
    SPHERICAL_DB_PER_DECADE,
    absorption_db_per_km,
    noise_db_per_hz,
)
from sonarpost.wire import first_error

ParameterValue = float | int | bool | str
Probability = Annotated[float, Field(ge=0, le=1)]

PRESETS: Mapping[str, Mapping[str, ParameterValue]] = MappingProxyType(
    {
        "still": MappingProxyType({}),
        # The paper's trial in Bedford Basin: most packets arrive below 130 m, most are lost beyond.
        "sea-trial": MappingProxyType(
            {
                "range_loss": True,
                "snr_at_1m_db": 37.0,
                "snr_spread_db": 1.0,
                "mean_clear_s": 120.0,
                "mean_fade_s": 2.0,
                "fade_loss": 1.0,
            }
        ),
    }
)
"""Named sets of parameters."""


class TailDamage(Enum):
    """Content of a damaged tail."""

    ZEROS = "zeros"
    NOISE = "noise"
    EITHER = "either"


class ChannelParameters(ServiceConfig):
    """Parameters of the channel model.

    Attributes:
        seed: Seed of every random draw.
        sound_speed_m_per_s: Sound speed.
        frame_loss: Probability that a non-empty frame is lost.
        packet_loss: Probability that a packet is not detected at all.
        tail_damage: Probability that the tail of the last non-empty frame is damaged and delivered as good.
        tail_damage_kind: Content of a damaged tail.
        tail_fraction: Longest damaged tail as a fraction of its frame, above 0.
        range_loss: Whether frames are also lost by their signal-to-noise ratio.
        snr_at_1m_db: Signal-to-noise ratio at 1 m. The default gives 19 dB at 100 m. Unused with `source_level_db`.
        source_level_db: Source level, dB re 1 uPa at 1 m: the ratio then follows from noise and bandwidth.
        excess_loss_db: Further loss with `source_level_db`: directivity, shadowing, multipath.
        carrier_hz: Carrier frequency, for absorption and noise.
        bandwidth_hz: Bandwidth, for noise.
        spreading_db_per_decade: 20 spherical, 15 practical, 10 cylindrical.
        temperature_c: Water temperature, for absorption.
        salinity_psu: Salinity, for absorption.
        wind_m_per_s: Wind speed, for noise.
        shipping: Shipping activity for noise, 0 none to 1 heavy.
        snr_spread_db: The ratio of each packet is uniform within this distance of the mean.
        mean_clear_s: Burst fading (Gilbert-Elliott): mean duration of the clear state of a path.
        mean_fade_s: Mean duration of a fade; 0 disables fading.
        fade_loss: Probability that a frame in a fade is lost.
        fade_depth_db: Reduction of the signal-to-noise ratio in a fade (it loses frames with `range_loss`).
    """

    seed: int = 0
    sound_speed_m_per_s: Annotated[float, Field(ge=1, le=10_000)] = 1500.0
    frame_loss: Probability = 0.0
    packet_loss: Probability = 0.0
    tail_damage: Probability = 0.0
    tail_damage_kind: TailDamage = TailDamage.EITHER
    tail_fraction: Annotated[float, Field(gt=0, le=1)] = 0.5
    range_loss: bool = False
    snr_at_1m_db: Annotated[float, Field(ge=-100, le=200)] = 60.0
    source_level_db: Annotated[float, Field(ge=0, le=260)] | None = None
    excess_loss_db: Annotated[float, Field(ge=-50, le=200)] = 0.0
    carrier_hz: Annotated[float, Field(ge=100, le=1e6)] = 25_000.0
    bandwidth_hz: Annotated[float, Field(ge=1, le=1e6)] = 5_000.0
    spreading_db_per_decade: Annotated[float, Field(ge=0, le=60)] = SPHERICAL_DB_PER_DECADE
    temperature_c: Annotated[float, Field(ge=-2, le=40)] = 10.0
    salinity_psu: Annotated[float, Field(ge=0, le=50)] = 35.0
    wind_m_per_s: Annotated[float, Field(ge=0, le=60)] = 5.0
    shipping: Probability = 0.5
    snr_spread_db: Annotated[float, Field(ge=0, le=40)] = 1.0
    mean_clear_s: Annotated[float, Field(ge=0.01, le=1e9)] = 60.0
    mean_fade_s: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    fade_loss: Probability = 1.0
    fade_depth_db: Annotated[float, Field(ge=0, le=100)] = 0.0

    @property
    def absorption_db_per_km(self) -> float:
        """Absorption at the carrier."""
        return absorption_db_per_km(self.carrier_hz, self.temperature_c, self.salinity_psu)

    @property
    def noise_db(self) -> float:
        """Ambient noise within the bandwidth, dB re 1 uPa."""
        spectrum_db = noise_db_per_hz(self.carrier_hz, self.wind_m_per_s, self.shipping)
        return spectrum_db + 10.0 * math.log10(self.bandwidth_hz)

    @property
    def reference_snr_db(self) -> float:
        """Signal-to-noise ratio at 1 m: as configured, or from source level, excess loss and noise."""
        if self.source_level_db is None:
            return self.snr_at_1m_db
        return self.source_level_db - self.excess_loss_db - self.noise_db


def read_parameters(path: Path) -> dict[str, ParameterValue]:
    """Read a TOML file of channel parameters, with or without `preset`.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or has an unknown key or a wrong value.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(path), "", str(error), "a TOML file of channel parameters") from error
    build_parameters(table, str(path))
    return table


def build_parameters(values: Mapping[str, ParameterValue], where: str) -> ChannelParameters:
    """Return the parameters of `values`, on top of those of the preset that `values` names.

    Raises:
        ConfigError: An unknown preset or parameter, or a value of the wrong type or out of bounds; names `where`.
    """
    preset = values.get("preset", "still")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise ConfigError(where, "preset", preset, f"one of {', '.join(PRESETS)}")
    merged = {**PRESETS[preset], **{name: value for name, value in values.items() if name != "preset"}}
    try:
        # As JSON, where strict validation accepts the text of an enumeration.
        return ChannelParameters.model_validate_json(json.dumps(merged, default=str), strict=True)
    except ValidationError as error:
        raise config_error(where, error) from error


def config_error(where: str, error: ValidationError) -> ConfigError:
    """Return the error that names the first wrong parameter."""
    field, value, expected = first_error(error)
    if error.errors()[0]["type"] == "extra_forbidden":
        expected = f"one of {', '.join(['preset', *ChannelParameters.model_fields])}"
    if not field:  # keys that do not fit together: the text has the form of a ConfigError
        field, _, rest = expected.partition(": got ")
        value, _, expected = rest.partition(", expected ")
    return ConfigError(where, field, value, expected)
