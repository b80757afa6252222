"""Rates of the S2C driver: rate 0 sends a packet as an instant message, rate 1 as burst data."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from sonarpost.modem.interface import ModemCapabilities, RateInfo

INSTANT_RATE: Final = 0
"""Rate of instant messages."""
BURST_RATE: Final = 1
"""Rate of burst data."""
INSTANT_MESSAGE_BYTES: Final = 64
"""Greatest length of an instant message."""
BURST_BYTES: Final = 1024
"""Greatest length of burst data in one command."""
BURST_FRAME_BYTES: Final = INSTANT_MESSAGE_BYTES
"""Length of the frames of burst data, except for a shorter last one. Short messages of the link fill a short frame."""
BURST_BIT_RATE_BPS: Final = 6500
"""Nominal bit rate of burst data: half of the greatest one, 13 kbit/s, that oceansystemslab's driver gives."""
BROADCAST: Final = 255
"""Destination address of all modems."""
ACK_AIRTIME_S: Final = 0.14
"""Air time of an acknowledgement, rounded from a recorded one."""

_BIT_RATE_BPS: Final = 976
_OVERHEAD_S: Final = 0.15


def message_airtime_s(length: int) -> float:
    """Return the nominal air time of an instant message of `length` bytes.

    The bit rate is the one that oceansystemslab's driver gives. The overhead follows from a recorded message of four
    bytes, 0.182 s. The time differs between models of the modem; the modem reports its own time of each message.
    """
    return _OVERHEAD_S + 8 * length / _BIT_RATE_BPS


def burst_airtime_s(length: int) -> float:
    """Return the nominal air time of burst data of `length` bytes in an open connection, without acknowledgement.

    The overhead is that of an instant message. The modem adapts the bit rate to the connection, so the time differs.
    """
    return _OVERHEAD_S + 8 * length / BURST_BIT_RATE_BPS


RATES: Mapping[int, RateInfo] = MappingProxyType(
    {
        INSTANT_RATE: RateInfo(
            INSTANT_RATE,
            "S2C instant message",
            frames=1,
            frame_bytes=INSTANT_MESSAGE_BYTES,
            airtime_s=round(message_airtime_s(INSTANT_MESSAGE_BYTES), 2),
        ),
        BURST_RATE: RateInfo(
            BURST_RATE,
            "S2C burst data",
            frames=BURST_BYTES // BURST_FRAME_BYTES,
            frame_bytes=BURST_FRAME_BYTES,
            airtime_s=round(burst_airtime_s(BURST_BYTES) + ACK_AIRTIME_S, 2),
        ),
    }
)
"""Every rate by its number."""

CAPABILITIES = ModemCapabilities(
    RATES,
    uplink_rate=INSTANT_RATE,
    downlink_rate=INSTANT_RATE,
    min_address=1,
    max_address=254,
    broadcast=BROADCAST,
    acknowledgements=True,
    ranging=True,
)
"""Capabilities of the driver."""
