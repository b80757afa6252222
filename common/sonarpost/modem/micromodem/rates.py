"""Packet size and air time of every Micro-Modem rate.

Source: the tables of open Micro-Modem drivers (Goby3, WHOI's ros_acomms). Rates 0, 1, 4 and 5 agree with Table I of the
paper that sonarpost re-creates (32, 192, 512 and 2048 bytes a packet). Air times are nominal: they vary with firmware,
probe length and bandwidth, and `MicroModemConfig` can replace them.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from sonarpost.modem.interface import ModemCapabilities, RateInfo

RATES: Mapping[int, RateInfo] = MappingProxyType(
    {
        rate.number: rate
        for rate in (
            RateInfo(0, "FH-FSK", frames=1, frame_bytes=32, airtime_s=3.2),
            RateInfo(1, "PSK BCH 128:8", frames=3, frame_bytes=64, airtime_s=6.1),
            RateInfo(2, "PSK DSS 1/15", frames=3, frame_bytes=64, airtime_s=3.1),
            RateInfo(3, "PSK DSS 1/7", frames=2, frame_bytes=256, airtime_s=3.4),
            RateInfo(4, "PSK BCH 64:10", frames=2, frame_bytes=256, airtime_s=3.2),
            RateInfo(5, "PSK Hamming 14:9", frames=8, frame_bytes=256, airtime_s=3.1),
            RateInfo(6, "PSK DSS 1/15 with probe", frames=6, frame_bytes=32, airtime_s=3.25),
        )
    }
)
"""Every rate by its number."""

CAPABILITIES = ModemCapabilities(
    RATES,
    uplink_rate=1,
    downlink_rate=0,
    max_address=127,
    broadcast=127,
    acknowledgements=True,
    ranging=True,
    polling=True,
    short_messages=True,
)
"""Capabilities of every Micro-Modem."""
