"""Packet size and air time of every Micro-Modem rate.

Source: the tables of open Micro-Modem drivers (Goby3, WHOI's ros_acomms). Rates 0, 1, 4 and 5 agree with Table I of the
paper that sonarpost re-creates (32, 192, 512 and 2048 bytes a packet). Air times are nominal: they vary with firmware,
probe length and bandwidth, and `MicroModemConfig` can replace them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class Rate:
    """One rate of the modem.

    Attributes:
        number: 0..6, as in `CCCYC`.
        modulation: Name of modulation and code.
        airtime_s: Nominal duration of a packet on the channel, however full its frames are.
    """

    number: int
    modulation: str
    frames: int
    frame_bytes: int
    airtime_s: float

    @property
    def packet_bytes(self) -> int:
        """Bytes in a packet with every frame full."""
        return self.frames * self.frame_bytes

    @property
    def throughput_bps(self) -> float:
        """Bits per second during a full packet."""
        return 8 * self.packet_bytes / self.airtime_s


RATES: Mapping[int, Rate] = MappingProxyType(
    {
        rate.number: rate
        for rate in (
            Rate(0, "FH-FSK", frames=1, frame_bytes=32, airtime_s=3.2),
            Rate(1, "PSK BCH 128:8", frames=3, frame_bytes=64, airtime_s=6.1),
            Rate(2, "PSK DSS 1/15", frames=3, frame_bytes=64, airtime_s=3.1),
            Rate(3, "PSK DSS 1/7", frames=2, frame_bytes=256, airtime_s=3.4),
            Rate(4, "PSK BCH 64:10", frames=2, frame_bytes=256, airtime_s=3.2),
            Rate(5, "PSK Hamming 14:9", frames=8, frame_bytes=256, airtime_s=3.1),
            Rate(6, "PSK DSS 1/15 with probe", frames=6, frame_bytes=32, airtime_s=3.25),
        )
    }
)
"""Every rate by its number."""
