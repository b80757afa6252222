"""Rates of the UDP driver: it limits its own throughput, so that a radio behind the network interface keeps up."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from sonarpost.modem.interface import ModemCapabilities, RateInfo

RATES: Mapping[int, RateInfo] = MappingProxyType(
    {
        rate.number: rate
        for rate in (
            RateInfo(0, "9.6 kbit/s", frames=2, frame_bytes=256, airtime_s=0.45),
            RateInfo(1, "64 kbit/s", frames=8, frame_bytes=256, airtime_s=0.27),
        )
    }
)
"""Every rate by its number. The air time is that of a full packet with its headers at the named bit rate."""

CAPABILITIES = ModemCapabilities(
    RATES,
    uplink_rate=1,
    downlink_rate=0,
    max_address=254,
    broadcast=255,
    acknowledgements=True,
)
"""Capabilities of the driver."""
