"""What a running acoustic channel is made of."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.channel_config import ChannelParameters
from sonarpost.simulation.modem.config import EmulatedModemConfig


@dataclass(frozen=True, slots=True)
class ModemSite:
    """One modem: its address and where it is."""

    address: int
    position: LocalPosition = field(default_factory=LocalPosition)


@dataclass(frozen=True, slots=True)
class EmulatorConfig:
    """What an `AcousticChannel` is made of.

    Attributes:
        sites: The modems, at least one, with different addresses; numbered from 1 in this order.
        water: What the water does.
        modem: How every modem is built; address, clock and data timeout are set by the channel. The data timeout is
            two seconds of real time at any time scale, so that a host is not hurried.
        pty_dir: Folder for the links `modem-1`, `modem-2`, …; None for TCP.
        tcp_ports: Ports to listen on, one for each modem (0 takes a free one), when `pty_dir` is None.
        tcp_host: Address to listen on.
        time_scale: Simulated seconds a real second, 0.01..10000.
        serial_baud: Speed of the serial lines, or None for lines without delay.
        log_path: Where to append the log, or None.
        transponders: Where the transponders for ranging are, by their letters A to D.

    Raises:
        ValueError: A value outside its bounds.
    """

    sites: tuple[ModemSite, ...]
    water: ChannelParameters = field(default_factory=ChannelParameters)
    modem: EmulatedModemConfig = field(default_factory=lambda: EmulatedModemConfig(address=0))
    pty_dir: Path | None = None
    tcp_ports: tuple[int, ...] = ()
    tcp_host: str = "127.0.0.1"
    time_scale: float = 1.0
    serial_baud: float | None = None
    log_path: Path | None = None
    transponders: Mapping[str, LocalPosition] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        addresses = [site.address for site in self.sites]
        if not addresses or len(set(addresses)) != len(addresses):
            raise ValueError(f"sites: got addresses {addresses}, expected at least one, and all different")
        if not all(0 <= address <= 127 for address in addresses):
            raise ValueError(f"sites: got addresses {addresses}, expected 0..127")
        if self.pty_dir is None and len(self.tcp_ports) != len(self.sites):
            raise ValueError(
                f"tcp_ports: got {len(self.tcp_ports)}, expected one for each of {len(self.sites)} modems, or pty_dir"
            )
        if unknown := set(self.transponders) - set("ABCD"):
            raise ValueError(f"transponders: got {sorted(unknown)}, expected letters A to D")
        if not 0.01 <= self.time_scale <= 10_000:
            raise ValueError(f"time_scale: got {self.time_scale!r}, expected 0.01..10000")
        if self.serial_baud is not None and not 0 < self.serial_baud < math.inf:
            raise ValueError(f"serial_baud: got {self.serial_baud!r}, expected bits a second above 0")


@dataclass(frozen=True, slots=True)
class Device:
    """What a host opens to reach a modem."""

    modem: int
    address: int
    device: str
