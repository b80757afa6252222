"""How an emulated modem is built, and what comes out of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from sonarpost.modem.micromodem import RATES
from sonarpost.simulation.channel.channel_events import ArrivalEnded

VERSIONS: Mapping[int, str] = MappingProxyType({1: "0.93.0.09", 2: "2.0.27087"})
"""What `CAREV` says by generation: four parts the first, three the second."""


@dataclass(frozen=True, slots=True)
class EmulatedModemConfig:
    """How one emulated modem is built.

    Attributes:
        address: Initial `SRC`, 0..127.
        generation: 1 or 2: version strings, and whether there is a flexible data protocol.
        statistics_version: Layout of `CACST`: 6, which every known host reads, or 8 of the newest firmware.
        utc_at_zero_s: What the modem's clock reads (seconds since 1970, UTC) at simulated time zero.
        airtimes_s: Air times by rate number, instead of the nominal ones.
        data_timeout_s: Initial `DTO`, whole seconds.
        revision_period_s: Idle time before and between `CAREV,…,AUV`.
        reboot_s: From `CCMSC` to `CAREV,…,INIT`.
        mini_airtime_s: Air time of an acknowledgement, a ping or a mini-packet.
        turnaround_s: From the end of a packet to the automatic answer.
        promiscuous: Whether the host is shown data meant for other modems.
        broadcast_addresses: Destinations that count as everybody.

    Raises:
        ValueError: A value outside its bounds.
    """

    address: int
    generation: int = 2
    statistics_version: int = 6
    utc_at_zero_s: float = 0.0
    airtimes_s: Mapping[int, float] = field(default_factory=lambda: MappingProxyType({}))
    data_timeout_s: int = 2
    revision_period_s: float = 10.0
    reboot_s: float = 1.0
    mini_airtime_s: float = 0.9
    turnaround_s: float = 0.2
    promiscuous: bool = True
    broadcast_addresses: frozenset[int] = frozenset({0, 15, 127})

    def __post_init__(self) -> None:
        if self.generation not in VERSIONS:
            raise ValueError(f"generation: got {self.generation!r}, expected 1 or 2")
        if self.statistics_version not in {6, 8}:
            raise ValueError(f"statistics_version: got {self.statistics_version!r}, expected 6 or 8")
        times = {**{f"airtimes_s of rate {rate}": time_s for rate, time_s in self.airtimes_s.items()}}
        times |= {name: getattr(self, name) for name in ("revision_period_s", "mini_airtime_s")}
        for name, time_s in times.items():
            if not (math.isfinite(time_s) and time_s > 0):
                raise ValueError(f"{name}: got {time_s!r}, expected seconds above 0")
        if unknown := set(self.airtimes_s) - set(RATES):
            raise ValueError(f"airtimes_s: got rates {sorted(unknown)}, expected {min(RATES)}..{max(RATES)}")
        for name in ("reboot_s", "turnaround_s"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected seconds, 0 or more")

    def airtime_s(self, rate: int) -> float:
        """Return how long a data packet of `rate` occupies the water."""
        return self.airtimes_s.get(rate, RATES[rate].airtime_s)


@dataclass(frozen=True, slots=True)
class PacketReport:
    """What the host learns of one packet that passed its modem.

    Attributes:
        arrival: The packet and its fate.
        address: The modem's address at that moment.
        untold: Why the host is not shown it; None when it is.
    """

    arrival: ArrivalEnded
    address: int
    untold: str | None


@dataclass(frozen=True, slots=True)
class HostOutput:
    """Bytes for the host, and the report they complete, if any."""

    data: bytes
    report: PacketReport | None = None
