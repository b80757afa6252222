"""Configuration of the emulated modems and their water: the `[acoustic_channel]` table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from sonarpost.config import ServiceConfig
from sonarpost.modem.micromodem import RATES
from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.channel_config import ChannelParameters
from sonarpost.simulation.channel.channel_presets import build_parameters
from sonarpost.simulation.channel.emulator_config import EmulatorConfig, ModemSite
from sonarpost.simulation.channel.random_draws import TailDamage
from sonarpost.simulation.modem.config import EmulatedModemConfig

Probability = Annotated[float, Field(ge=0, le=1)]


class ModemTable(ServiceConfig):
    """One modem: `[[acoustic_channel.modem]]`.

    Attributes:
        address: Its initial `SRC`.
        east_m: Position.
        north_m: Position.
        depth_m: Position, down.
    """

    address: Annotated[int, Field(ge=0, le=127)]
    east_m: float = 0.0
    north_m: float = 0.0
    depth_m: float = 0.0


class TransponderTable(ServiceConfig):
    """One transponder: `[[acoustic_channel.transponder]]`.

    Attributes:
        letter: A to D.
        east_m: Position.
        north_m: Position.
        depth_m: Position, down.
    """

    letter: Literal["A", "B", "C", "D"]
    east_m: float = 0.0
    north_m: float = 0.0
    depth_m: float = 0.0


_OF_WATER = tuple(field.name for field in fields(ChannelParameters))


class AcousticChannelConfig(ServiceConfig):
    """The `[acoustic_channel]` table.

    Attributes:
        modem: The modems, numbered from 1 in this order; by default addresses 1 and 2, 100 m apart.
        pty_dir: Folder of the links `modem-1`, `modem-2`, …, used unless `tcp_ports` are given.
        tcp_ports: A TCP port for each modem instead, for `socket://` URLs; 0 takes a free one.
        tcp_host: Address to listen on.
        log: File for the record of every packet; none by default.
        seed: Seed of every draw.
        time_scale: Simulated seconds a real second.
        preset: A set of the water's parameters; what is given besides goes over it.
        sound_speed_m_per_s: Speed of sound.
        frame_loss: Chance that a frame is lost on its own.
        packet_loss: Chance that a whole packet is not detected.
        tail_damage: Chance that the tail of the last filled frame is damaged and passes for good.
        tail_damage_kind: "zeros", "noise" or "either".
        tail_fraction: Longest damaged tail as a part of its frame.
        snr_at_1m_db: Signal-to-noise ratio one metre from a transmitter.
        range_loss: Whether frames are also lost by their signal-to-noise ratio.
        source_level_db: With it the signal-to-noise ratio follows from noise and bandwidth, not from `snr_at_1m_db`.
        excess_loss_db: What else the signal loses.
        carrier_hz: Carrier, for absorption and noise.
        bandwidth_hz: Bandwidth, for noise.
        spreading_db_per_decade: 20 spherical, 15 practical, 10 cylindrical.
        temperature_c: Of the water.
        salinity_psu: Of the water.
        wind_m_per_s: For noise.
        shipping: For noise, 0 none to 1 heavy.
        snr_spread_db: Each packet's ratio is up to this above or below the mean.
        mean_clear_s: Burst fading: mean time that a path is clear.
        mean_fade_s: Mean time of a fade; 0 for no fading.
        fade_loss: Chance that a frame is lost in a fade.
        fade_depth_db: What a fade takes from the signal-to-noise ratio.
        airtime_s: Air times by rate number, instead of the nominal ones.
        generation: Of the emulated Micro-Modem, 1 or 2.
        statistics_version: Layout of `CACST`, 6 or 8.
        transponder: Transponders for ranging, at most one of each letter.
        promiscuous: Whether hosts are shown data meant for other modems.
        serial_baud: Speed of the serial lines, 0 for lines without delay.
    """

    modem: Annotated[tuple[ModemTable, ...], Field(min_length=1, max_length=64)] = (
        ModemTable(address=1),
        ModemTable(address=2, east_m=100.0),
    )
    pty_dir: Path = Path("modems")
    tcp_ports: tuple[Annotated[int, Field(ge=0, le=65535)], ...] = ()
    tcp_host: str = "127.0.0.1"
    log: Path | None = None
    seed: int = 0
    time_scale: Annotated[float, Field(ge=0.01, le=10_000)] = 1.0
    preset: Literal["still", "sea-trial"] = "still"
    sound_speed_m_per_s: Annotated[float, Field(ge=1, le=10_000)] = 1500.0
    frame_loss: Probability = 0.0
    packet_loss: Probability = 0.0
    tail_damage: Probability = 0.0
    tail_damage_kind: TailDamage = TailDamage.EITHER
    tail_fraction: Annotated[float, Field(gt=0, le=1)] = 0.5
    snr_at_1m_db: Annotated[float, Field(ge=-100, le=200)] = 60.0
    range_loss: bool = False
    source_level_db: Annotated[float, Field(ge=0, le=260)] | None = None
    excess_loss_db: Annotated[float, Field(ge=-50, le=200)] = 0.0
    carrier_hz: Annotated[float, Field(ge=100, le=1e6)] = 25_000.0
    bandwidth_hz: Annotated[float, Field(ge=1, le=1e6)] = 5_000.0
    spreading_db_per_decade: Annotated[float, Field(ge=0, le=60)] = 20.0
    temperature_c: Annotated[float, Field(ge=-2, le=40)] = 10.0
    salinity_psu: Annotated[float, Field(ge=0, le=50)] = 35.0
    wind_m_per_s: Annotated[float, Field(ge=0, le=60)] = 5.0
    shipping: Probability = 0.5
    snr_spread_db: Annotated[float, Field(ge=0, le=40)] = 1.0
    mean_clear_s: Annotated[float, Field(ge=0.01, le=1e9)] = 60.0
    mean_fade_s: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    fade_loss: Probability = 1.0
    fade_depth_db: Annotated[float, Field(ge=0, le=100)] = 0.0
    airtime_s: Mapping[Annotated[int, Field(ge=min(RATES), le=max(RATES))], Annotated[float, Field(gt=0, le=600)]] = {}
    generation: Annotated[int, Field(ge=1, le=2)] = 2
    statistics_version: Literal[6, 8] = 6
    transponder: Annotated[tuple[TransponderTable, ...], Field(max_length=4)] = ()
    promiscuous: bool = True
    serial_baud: Annotated[float, Field(ge=0, le=10_000_000)] = 0.0

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        self.channel()
        return self

    def channel(self) -> EmulatorConfig:
        """Return the same as the library's own configuration.

        Raises:
            ValueError: Values that do not go together, such as two modems of one address.
        """
        given = {
            name: value
            for name in _OF_WATER
            if name in self.model_fields_set and (value := getattr(self, name)) is not None
        }
        if "tail_damage_kind" in given:
            given["tail_damage_kind"] = self.tail_damage_kind.value
        water = build_parameters(given | {"preset": self.preset}, "acoustic_channel")
        template = EmulatedModemConfig(
            address=0,
            generation=self.generation,
            statistics_version=self.statistics_version,
            airtimes_s=self.airtime_s,
            promiscuous=self.promiscuous,
        )
        return EmulatorConfig(
            sites=tuple(ModemSite(m.address, LocalPosition(m.east_m, m.north_m, m.depth_m)) for m in self.modem),
            water=water,
            modem=template,
            pty_dir=None if self.tcp_ports else self.pty_dir,
            tcp_ports=self.tcp_ports,
            tcp_host=self.tcp_host,
            time_scale=self.time_scale,
            serial_baud=self.serial_baud or None,
            log_path=self.log,
            transponders={t.letter: LocalPosition(t.east_m, t.north_m, t.depth_m) for t in self.transponder},
        )
