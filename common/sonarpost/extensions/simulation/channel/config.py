"""Configuration of the channel emulator."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from sonarpost.config import ServiceConfig
from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters, build_parameters
from sonarpost.extensions.simulation.modem.emulated import emulated_drivers
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.interface import MAX_ADDRESS, MAX_RATE
from sonarpost.modem.registry import DEFAULT_DRIVER, modem_driver


class Site(ServiceConfig):
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


class ModemSite(Site):
    """One modem.

    Attributes:
        address: Its initial `SRC`.
    """

    address: Annotated[int, Field(ge=0, le=MAX_ADDRESS)]


class TransponderSite(Site):
    """One ranging transponder.

    Attributes:
        letter: A to D.
    """

    letter: Literal["A", "B", "C", "D"]


class EmulatorConfig(ChannelParameters):
    """Configuration of a `ChannelEmulator`: the parameters of the channel model, and the following keys.

    Attributes:
        modem: The modems, numbered from 1 in this order; by default addresses 1 and 2, 100 m apart.
        pty_dir: Folder of the links `modem-1`, `modem-2`, …, used unless `tcp_ports` are given.
        tcp_ports: A TCP port for each modem instead, for `socket://` URLs; 0 selects a free one.
        tcp_host: Address to listen on.
        log: File for the log of every packet; none by default.
        time_scale: Simulated seconds per real second.
        driver: Name of the driver whose modem is emulated.
        preset: A set of channel parameters; other given parameters override it.
        airtime_s: Air times by rate number, where they differ from the nominal ones.
        generation: Generation of the emulated Micro-Modem, 1 or 2.
        statistics_version: Layout of `CACST`, 6 or 8.
        transponder: Transponders for ranging, at most one of each letter.
        promiscuous: Whether hosts receive data addressed to other modems.
        serial_baud: Speed of the serial lines, 0 for lines without delay.
    """

    modem: Annotated[tuple[ModemSite, ...], Field(min_length=1, max_length=64)] = (
        ModemSite(address=1),
        ModemSite(address=2, east_m=100.0),
    )
    pty_dir: Path = Path("modems")
    tcp_ports: tuple[Annotated[int, Field(ge=0, le=65535)], ...] = ()
    tcp_host: str = "127.0.0.1"
    log: Path | None = None
    time_scale: Annotated[float, Field(ge=0.01, le=10_000)] = 1.0
    preset: Literal["still", "sea-trial"] = "still"
    driver: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")] = DEFAULT_DRIVER
    airtime_s: Mapping[Annotated[int, Field(ge=0, le=MAX_RATE)], Annotated[float, Field(gt=0, le=600)]] = {}
    generation: Annotated[int, Field(ge=1, le=2)] = 2
    statistics_version: Literal[6, 8] = 6
    transponder: Annotated[tuple[TransponderSite, ...], Field(max_length=4)] = ()
    promiscuous: bool = True
    serial_baud: Annotated[float, Field(ge=0, le=10_000_000)] = 0.0

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        addresses = [modem.address for modem in self.modem]
        if self.driver not in emulated_drivers():
            raise ValueError(f"driver: got {self.driver!r}, expected one of {', '.join(emulated_drivers())}")
        modem = modem_driver(self.driver).capabilities
        if unknown := set(self.airtime_s) - set(modem.rates):
            raise ValueError(f"airtime_s: got rates {sorted(unknown)}, expected {sorted(modem.rates)}")
        if not all(modem.min_address <= address <= modem.max_address for address in addresses):
            raise ValueError(f"modem: got addresses {addresses}, expected {modem.min_address}..{modem.max_address}")
        if len(set(addresses)) != len(addresses):
            raise ValueError(f"modem: got addresses {addresses}, expected all different")
        if self.tcp_ports and len(self.tcp_ports) != len(addresses):
            raise ValueError(f"tcp_ports: got {len(self.tcp_ports)}, expected one for each of {len(addresses)} modems")
        return self

    @property
    def parameters(self) -> ChannelParameters:
        """Parameters of the channel model, with those of the preset."""
        given = self.model_fields_set & ChannelParameters.model_fields.keys()
        values = self.model_dump(mode="json", include=given, exclude_none=True)
        return build_parameters(values | {"preset": self.preset}, "channel")

    def modem_config(self, modem: ModemSite, utc_at_zero_s: float, data_timeout_s: int) -> EmulatedModemConfig:
        """Return the configuration of one modem.

        Args:
            modem: The modem.
            utc_at_zero_s: Reading of its clock at simulated time zero, seconds since 1970 UTC.
            data_timeout_s: Its initial `DTO`.
        """
        return EmulatedModemConfig(
            modem.address,
            driver=self.driver,
            generation=self.generation,
            statistics_version=self.statistics_version,
            utc_at_zero_s=utc_at_zero_s,
            airtimes_s=self.airtime_s,
            data_timeout_s=data_timeout_s,
            promiscuous=self.promiscuous,
        )
