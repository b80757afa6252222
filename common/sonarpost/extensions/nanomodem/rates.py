"""Rate, air times and capabilities of the nanomodem v3.

Sources: the specification of the USMART project (640 bit/s raw, 463 bit/s with 64 bytes, range above 2 km), and the
duration of a packet in the simulator of the modem's developer (`nm3-python-simulator`). Both give 1.105 s for 64
bytes.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from sonarpost.modem.interface import ModemCapabilities, RateInfo

MAX_PAYLOAD_BYTES: Final = 64
"""Greatest length of a message."""
HEADER_BYTES: Final = 1
"""Address that the driver puts in front of a frame; see `sonarpost.extensions.nanomodem.driver`."""
CHIRP_S: Final = 0.105
"""Duration of a packet without data: a ping, or an acknowledgement."""
SECONDS_PER_BYTE: Final = 0.0125
CODE_BYTES: Final = 16
"""Bytes of error correction in a packet with data."""


def airtime_s(payload_bytes: int) -> float:
    """Return the duration of a packet.

    Args:
        payload_bytes: Length of its data, 0 for a ping or an acknowledgement.
    """
    return CHIRP_S + ((payload_bytes + CODE_BYTES) * SECONDS_PER_BYTE if payload_bytes else 0.0)


RATE: Final = 1
RATES: Mapping[int, RateInfo] = MappingProxyType(
    {
        RATE: RateInfo(
            RATE,
            "640 bit/s, orthogonal code keying",
            frames=1,
            frame_bytes=MAX_PAYLOAD_BYTES - HEADER_BYTES,
            airtime_s=airtime_s(MAX_PAYLOAD_BYTES),
            range_m=2000.0,
        )
    }
)
"""The one rate by its number."""

CAPABILITIES = ModemCapabilities(
    RATES,
    uplink_rate=RATE,
    downlink_rate=RATE,
    max_address=254,
    broadcast=255,
    acknowledgements=True,
    ranging=True,
)
"""Capabilities of the driver. A modem can have the address 255; the driver uses it as the broadcast address."""
