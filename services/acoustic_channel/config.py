"""Configuration of the channel emulator: the `[acoustic_channel]` table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from sonarpost.config import ServiceConfig
from sonarpost.modem.micromodem import RATES
from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.emulator import EmulatorConfig, ModemSite
from sonarpost.simulation.channel.parameters import ChannelParameters, build_parameters
from sonarpost.simulation.modem.settings import EmulatedModemConfig


class PositionTable(ServiceConfig):
    """Position of a modem or transponder.

    Attributes:
        east_m: Metres east.
        north_m: Metres north.
        depth_m: Metres down.
    """

    east_m: float = 0.0
    north_m: float = 0.0
    depth_m: float = 0.0

    @property
    def position(self) -> LocalPosition:
        """The position as the channel model uses it."""
        return LocalPosition(self.east_m, self.north_m, self.depth_m)


class ModemTable(PositionTable):
    """One modem: `[[acoustic_channel.modem]]`.

    Attributes:
        address: Its initial `SRC`.
    """

    address: Annotated[int, Field(ge=0, le=127)]


class TransponderTable(PositionTable):
    """One transponder: `[[acoustic_channel.transponder]]`.

    Attributes:
        letter: A to D.
    """

    letter: Literal["A", "B", "C", "D"]


class AcousticChannelConfig(ChannelParameters):
    """The `[acoustic_channel]` table: the parameters of the channel model, and the following keys.

    Attributes:
        modem: The modems, numbered from 1 in this order; by default addresses 1 and 2, 100 m apart.
        pty_dir: Folder of the links `modem-1`, `modem-2`, …, used unless `tcp_ports` are given.
        tcp_ports: A TCP port for each modem instead, for `socket://` URLs; 0 selects a free one.
        tcp_host: Address to listen on.
        log: File for the log of every packet; none by default.
        time_scale: Simulated seconds per real second.
        preset: A set of channel parameters; other given parameters override it.
        airtime_s: Air times by rate number, where they differ from the nominal ones.
        generation: Generation of the emulated Micro-Modem, 1 or 2.
        statistics_version: Layout of `CACST`, 6 or 8.
        transponder: Transponders for ranging, at most one of each letter.
        promiscuous: Whether hosts receive data addressed to other modems.
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
    time_scale: Annotated[float, Field(ge=0.01, le=10_000)] = 1.0
    preset: Literal["still", "sea-trial"] = "still"
    airtime_s: Mapping[Annotated[int, Field(ge=min(RATES), le=max(RATES))], Annotated[float, Field(gt=0, le=600)]] = {}
    generation: Annotated[int, Field(ge=1, le=2)] = 2
    statistics_version: Literal[6, 8] = 6
    transponder: Annotated[tuple[TransponderTable, ...], Field(max_length=4)] = ()
    promiscuous: bool = True
    serial_baud: Annotated[float, Field(ge=0, le=10_000_000)] = 0.0

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        self.emulator_config()
        return self

    def emulator_config(self) -> EmulatorConfig:
        """Return the configuration of the channel emulator.

        Raises:
            ValueError: A combination that is not allowed, such as two modems with one address.
        """
        given = self.model_fields_set & ChannelParameters.model_fields.keys()
        parameters = self.model_dump(mode="json", include=given, exclude_none=True)
        return EmulatorConfig(
            sites=tuple(ModemSite(modem.address, modem.position) for modem in self.modem),
            channel=build_parameters(parameters | {"preset": self.preset}, "acoustic_channel"),
            modem=EmulatedModemConfig(
                address=0,
                generation=self.generation,
                statistics_version=self.statistics_version,
                airtimes_s=self.airtime_s,
                promiscuous=self.promiscuous,
            ),
            pty_dir=None if self.tcp_ports else self.pty_dir,
            tcp_ports=self.tcp_ports,
            tcp_host=self.tcp_host,
            time_scale=self.time_scale,
            serial_baud=self.serial_baud or None,
            log_path=self.log,
            transponders={transponder.letter: transponder.position for transponder in self.transponder},
        )
