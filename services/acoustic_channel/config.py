"""Configuration of the emulated modems and their water: the `[acoustic_channel]` table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from sonarpost.modem.rates import RATES
from sonarpost.runtime.config import ServiceConfig
from sonarpost.sim.channel_config import ChannelConfig, ModemSite
from sonarpost.sim.micromodem_config import ModemConfig
from sonarpost.sim.water_chance import TailDamage
from sonarpost.sim.water_physics import Position
from sonarpost.sim.water_records import WaterConfig

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
        sound_speed_m_per_s: Speed of sound.
        frame_loss: Chance that a frame is lost on its own.
        packet_loss: Chance that a whole packet is not detected.
        tail_damage: Chance that the tail of the last filled frame is damaged and passes for good.
        tail_damage_kind: "zeros", "noise" or "either".
        tail_fraction: Longest damaged tail as a part of its frame.
        snr_at_1m_db: Signal-to-noise ratio one metre from a transmitter.
        range_loss: Whether frames are also lost by their signal-to-noise ratio.
        airtime_s: Air times by rate number, instead of the nominal ones.
        generation: Of the emulated Micro-Modem, 1 or 2.
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
    sound_speed_m_per_s: Annotated[float, Field(gt=0, le=10_000)] = 1500.0
    frame_loss: Probability = 0.0
    packet_loss: Probability = 0.0
    tail_damage: Probability = 0.0
    tail_damage_kind: TailDamage = TailDamage.EITHER
    tail_fraction: Annotated[float, Field(gt=0, le=1)] = 0.5
    snr_at_1m_db: Annotated[float, Field(ge=-100, le=200)] = 60.0
    range_loss: bool = False
    airtime_s: Mapping[Annotated[int, Field(ge=min(RATES), le=max(RATES))], Annotated[float, Field(gt=0, le=600)]] = {}
    generation: Annotated[int, Field(ge=1, le=2)] = 2
    promiscuous: bool = True
    serial_baud: Annotated[float, Field(ge=0, le=10_000_000)] = 0.0

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        self.channel()
        return self

    def channel(self) -> ChannelConfig:
        """Return the same as the library's own configuration.

        Raises:
            ValueError: Values that do not go together, such as two modems of one address.
        """
        water = WaterConfig(
            seed=self.seed,
            sound_speed_m_per_s=self.sound_speed_m_per_s,
            frame_loss=self.frame_loss,
            packet_loss=self.packet_loss,
            tail_damage=self.tail_damage,
            tail_damage_kind=self.tail_damage_kind,
            tail_fraction=self.tail_fraction,
            snr_at_1m_db=self.snr_at_1m_db,
            range_loss=self.range_loss,
        )
        template = ModemConfig(
            address=0, generation=self.generation, airtimes_s=self.airtime_s, promiscuous=self.promiscuous
        )
        return ChannelConfig(
            sites=tuple(ModemSite(m.address, Position(m.east_m, m.north_m, m.depth_m)) for m in self.modem),
            water=water,
            modem=template,
            pty_dir=None if self.tcp_ports else self.pty_dir,
            tcp_ports=self.tcp_ports,
            tcp_host=self.tcp_host,
            time_scale=self.time_scale,
            serial_baud=self.serial_baud or None,
            log_path=self.log,
        )
