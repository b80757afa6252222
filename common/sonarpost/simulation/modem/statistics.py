"""Receive and transmit statistics of the emulated modem: `CACST` and `CAXST`.

The layouts follow public descriptions and drivers of the modem. Version 6 of both is read by every known host, while
Goby misreads later ones. Version 8 of `CACST` adds four fields after the bandwidth; version 7 of `CAXST`, which belongs
to it, adds the actual carrier. Levels are plausible and follow range and packet; they are not calibrated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum

from sonarpost.modem.micromodem import nmea

CARRIER_HZ = 25000
BANDWIDTH_HZ = 5000
PROBE_SYMBOLS = 200

_SOURCE_LEVEL_DB = 185.0
_MAX_OUTPUT_SNR_DB = 20.0


class ReceiveMode(IntEnum):
    """`mode` of `CACST`."""

    GOOD = 0
    BAD_CRC = 1
    TIMEOUT = 2


class PacketType(IntEnum):
    """`pkt_type` of `CACST` and `CAXST`."""

    FSK = 1
    FSK_MINI = 2
    PSK = 3
    FLEXIBLE = 5


@dataclass(frozen=True, slots=True)
class ReceivedPacket:
    """Contents of `CACST`.

    Attributes:
        mode: How the reception ended.
        arrived: Date and time at which the packet began to arrive.
        clock: Status of the modem's clock.
        rate: Rate number.
        source: Source address, 0 when the header was not decoded.
        destination: Destination address, 0 when the header was not decoded.
        packet_type: Type of packet.
        frames: Frames in the packet.
        bad_frames: Frames with a bad CRC.
        snr_db: Signal-to-noise ratio at the receiver.
        range_m: Distance to the transmitter.
    """

    mode: ReceiveMode
    arrived: datetime
    clock: str
    rate: int
    source: int
    destination: int
    packet_type: PacketType
    frames: int
    bad_frames: int
    snr_db: float
    range_m: float


@dataclass(frozen=True, slots=True)
class TransmittedPacket:
    """Contents of `CAXST`.

    Attributes:
        started: Date and time of the start of the transmission.
        clock: Status of the modem's clock.
        rate: Rate number.
        source: Source address.
        destination: Destination address.
        ack_requested: Whether acknowledgement was requested.
        frames_expected: Frames announced by the cycle.
        frames_sent: Frames with data.
        packet_type: Type of packet.
        data_bytes: Data bytes in the packet.
    """

    started: datetime
    clock: str
    rate: int
    source: int
    destination: int
    ack_requested: bool
    frames_expected: int
    frames_sent: int
    packet_type: PacketType
    data_bytes: int


def receive_statistics(packet: ReceivedPacket, version: int) -> bytes:
    """Return the `CACST` of one packet, in the layout of `version` (6 or 8)."""
    level_db = _SOURCE_LEVEL_DB - 20 * math.log10(max(1.0, packet.range_m))
    out_db = min(packet.snr_db - 3.0, _MAX_OUTPUT_SNR_DB)
    psk = packet.packet_type in {PacketType.PSK, PacketType.FLEXIBLE}
    psk_error = {ReceiveMode.GOOD: 0, ReceiveMode.BAD_CRC: 3, ReceiveMode.TIMEOUT: 2}[packet.mode] if psk else 0
    return nmea.format(
        "CACST",
        version,
        packet.mode.value,
        packet.arrived.strftime("%Y%m%d%H%M%S.%f"),
        packet.clock,
        max(1, min(32767, round(32767 * 10 ** ((packet.snr_db - 20) / 40)))),
        max(0, min(99, round(packet.snr_db + 25))),
        f"{max(0, min(9999, round(100 + 2 * packet.snr_db))):04d}",
        f"{max(0, round(level_db)):04d}",
        *("07", "00", "00", "00", "00"),
        packet.rate,
        f"{packet.source:03d}",
        f"{packet.destination:03d}",
        psk_error,
        packet.packet_type.value,
        packet.frames,
        packet.bad_frames,
        max(0, round(level_db)),
        f"{packet.snr_db:.1f}",
        f"{out_db:.2f}" if psk else "-100",
        "-100",
        f"{-out_db:.2f}" if psk else "-100",
        "-01" if psk else f"{max(0, min(254, round(180 + packet.snr_db))):03d}",
        *("0.00", 51, CARRIER_HZ, BANDWIDTH_HZ),
        *((0, -1, -1, "00") if version == 8 else ()),
    )


def transmit_statistics(packet: TransmittedPacket, version: int) -> bytes:
    """Return the `CAXST` of one packet, in the layout that belongs to `version` (6 or 8) of `CACST`."""
    return nmea.format(
        "CAXST",
        7 if version == 8 else 6,
        packet.started.strftime("%Y%m%d"),
        packet.started.strftime("%H%M%S.%f"),
        packet.clock,
        *(0, PROBE_SYMBOLS, BANDWIDTH_HZ, CARRIER_HZ),
        packet.rate,
        packet.source,
        packet.destination,
        int(packet.ack_requested),
        packet.frames_expected,
        packet.frames_sent,
        packet.packet_type.value,
        packet.data_bytes,
        *((CARRIER_HZ,) if version == 8 else ()),
    )
