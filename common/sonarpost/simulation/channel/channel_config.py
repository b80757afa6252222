"""How the simulated water is set; docs/explanation/channel-model.md explains every parameter and names its source."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from sonarpost.simulation.channel.acoustics import SPHERICAL_DB_PER_DECADE, absorption_db_per_km, noise_db_per_hz
from sonarpost.simulation.channel.random_draws import TailDamage

_BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "sound_speed_m_per_s": (1.0, 10_000.0),
        "frame_loss": (0.0, 1.0),
        "packet_loss": (0.0, 1.0),
        "tail_damage": (0.0, 1.0),
        "tail_fraction": (1e-9, 1.0),
        "snr_at_1m_db": (-100.0, 200.0),
        "source_level_db": (0.0, 260.0),
        "excess_loss_db": (-50.0, 200.0),
        "carrier_hz": (100.0, 1_000_000.0),
        "bandwidth_hz": (1.0, 1_000_000.0),
        "spreading_db_per_decade": (0.0, 60.0),
        "temperature_c": (-2.0, 40.0),
        "salinity_psu": (0.0, 50.0),
        "wind_m_per_s": (0.0, 60.0),
        "shipping": (0.0, 1.0),
        "snr_spread_db": (0.0, 40.0),
        "mean_clear_s": (0.01, 1e9),
        "mean_fade_s": (0.0, 1e9),
        "fade_loss": (0.0, 1.0),
        "fade_depth_db": (0.0, 100.0),
    }
)


@dataclass(frozen=True, slots=True)
class ChannelParameters:
    """What the water does to packets.

    Attributes:
        seed: Seed of every draw.
        sound_speed_m_per_s: Speed of sound.
        frame_loss: Chance that a non-empty frame is lost on its own.
        packet_loss: Chance that a packet is not detected at all.
        tail_damage: Chance that the tail of the last non-empty frame is damaged and delivered.
        tail_damage_kind: What stands in a damaged tail.
        tail_fraction: Longest damaged tail as a part of its frame, above 0.
        range_loss: Whether frames are also lost by their signal-to-noise ratio.
        snr_at_1m_db: Signal-to-noise ratio one metre from a transmitter. The default gives 19 dB at 100 m. Unused when
            there is a `source_level_db`.
        source_level_db: Source level, dB re 1 uPa at 1 m: with it the ratio follows from noise and bandwidth.
        excess_loss_db: What else the signal loses, with a `source_level_db`: directivity, shadow, multipath.
        carrier_hz: Carrier, for absorption and noise.
        bandwidth_hz: Bandwidth, for noise.
        spreading_db_per_decade: 20 spherical, 15 practical, 10 cylindrical.
        temperature_c: Of the water, for absorption.
        salinity_psu: Of the water, for absorption.
        wind_m_per_s: For noise.
        shipping: For noise, 0 none to 1 heavy.
        snr_spread_db: Each packet's ratio is up to this above or below the mean.
        mean_clear_s: Burst fading: mean time that a path is clear.
        mean_fade_s: Mean time of a fade; 0 for no fading.
        fade_loss: Chance that a frame is lost in a fade.
        fade_depth_db: What a fade takes from the signal-to-noise ratio (which loses frames with `range_loss`).

    Raises:
        ValueError: A value outside its bounds.
    """

    seed: int = 0
    sound_speed_m_per_s: float = 1500.0
    frame_loss: float = 0.0
    packet_loss: float = 0.0
    tail_damage: float = 0.0
    tail_damage_kind: TailDamage = TailDamage.EITHER
    tail_fraction: float = 0.5
    range_loss: bool = False
    snr_at_1m_db: float = 60.0
    source_level_db: float | None = None
    excess_loss_db: float = 0.0
    carrier_hz: float = 25_000.0
    bandwidth_hz: float = 5_000.0
    spreading_db_per_decade: float = SPHERICAL_DB_PER_DECADE
    temperature_c: float = 10.0
    salinity_psu: float = 35.0
    wind_m_per_s: float = 5.0
    shipping: float = 0.5
    snr_spread_db: float = 1.0
    mean_clear_s: float = 60.0
    mean_fade_s: float = 0.0
    fade_loss: float = 1.0
    fade_depth_db: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in _BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise ValueError(f"{name}: got {value!r}, expected {low:g}..{high:g}")

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
        """Signal-to-noise ratio at 1 m: given, or from source level, excess loss and noise."""
        if self.source_level_db is None:
            return self.snr_at_1m_db
        return self.source_level_db - self.excess_loss_db - self.noise_db
