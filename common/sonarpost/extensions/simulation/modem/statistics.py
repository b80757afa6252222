"""Receive and transmit statistics of the emulated modem: `CACST` and `CAXST`.

The layouts follow public descriptions and drivers of the modem. Version 6 of both is read by every known host, while
Goby misreads later ones. Version 8 of `CACST` adds four fields after the bandwidth; version 7 of `CAXST`, which belongs
to it, adds the actual carrier. Levels are plausible and follow range and packet; they are not calibrated.
"""

import math
from datetime import datetime
from enum import IntEnum

from sonarpost.extensions.simulation.channel.events import AcousticPacket, ArrivalEnded, FrameOutcome, PacketKind
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


_PSK_ERRORS = {ReceiveMode.GOOD: 0, ReceiveMode.BAD_CRC: 3, ReceiveMode.TIMEOUT: 2}


class PacketType(IntEnum):
    """`pkt_type` of `CACST` and `CAXST`."""

    FSK = 1
    FSK_MINI = 2
    PSK = 3
    FLEXIBLE = 5


def packet_type(packet: AcousticPacket) -> PacketType:
    """Return the packet type of a packet."""
    if packet.kind is PacketKind.FLEXIBLE:
        return PacketType.FLEXIBLE
    if packet.kind is not PacketKind.DATA:
        return PacketType.FSK_MINI
    return PacketType.FSK if packet.rate == 0 else PacketType.PSK


def receive_statistics(arrival: ArrivalEnded, version: int, arrived: datetime, clock: str, *, decoded: bool) -> bytes:
    """Return the `CACST` of a received packet.

    Args:
        arrival: The packet.
        version: Layout, 6 or 8.
        arrived: Date and time at which the packet began to arrive.
        clock: Status of the modem's clock.
        decoded: Whether the packet was decoded; without, addresses and frames are 0.
    """
    packet, snr_db = arrival.transmission.packet, arrival.snr_db
    filled = [frame for frame in arrival.frames if frame.outcome is not FrameOutcome.EMPTY]
    bad = sum(frame.outcome is FrameOutcome.LOST for frame in filled)
    mode = (ReceiveMode.BAD_CRC if bad else ReceiveMode.GOOD) if decoded else ReceiveMode.TIMEOUT
    level_db = _SOURCE_LEVEL_DB - 20 * math.log10(max(1.0, arrival.range_m))
    out_db = min(snr_db - 3.0, _MAX_OUTPUT_SNR_DB)
    psk = packet_type(packet) in {PacketType.PSK, PacketType.FLEXIBLE}
    return nmea.format(
        "CACST",
        version,
        mode.value,
        arrived.strftime("%Y%m%d%H%M%S.%f"),
        clock,
        max(1, min(32767, round(32767 * 10 ** ((snr_db - 20) / 40)))),
        max(0, min(99, round(snr_db + 25))),
        f"{max(0, min(9999, round(100 + 2 * snr_db))):04d}",
        f"{max(0, round(level_db)):04d}",
        *("07", "00", "00", "00", "00"),
        packet.rate,
        f"{packet.source if decoded else 0:03d}",
        f"{packet.destination if decoded else 0:03d}",
        _PSK_ERRORS[mode] if psk else 0,
        packet_type(packet).value,
        len(filled) if decoded else 0,
        bad if decoded else 0,
        max(0, round(level_db)),
        f"{snr_db:.1f}",
        f"{out_db:.2f}" if psk else "-100",
        "-100",
        f"{-out_db:.2f}" if psk else "-100",
        "-01" if psk else f"{max(0, min(254, round(180 + snr_db))):03d}",
        *("0.00", 51, CARRIER_HZ, BANDWIDTH_HZ),
        *((0, -1, -1, "00") if version == 8 else ()),
    )


def transmit_statistics(packet: AcousticPacket, version: int, started: datetime, *, clock_was_set: bool) -> bytes:
    """Return the `CAXST` of a packet.

    Args:
        packet: The transmitted packet.
        version: Layout of `CACST` to which this sentence belongs, 6 or 8.
        started: Date and time of the start of the transmission.
        clock_was_set: Whether a host has set the modem's clock.
    """
    return nmea.format(
        "CAXST",
        7 if version == 8 else 6,
        started.strftime("%Y%m%d"),
        started.strftime("%H%M%S.%f"),
        int(clock_was_set),
        *(0, PROBE_SYMBOLS, BANDWIDTH_HZ, CARRIER_HZ),
        packet.rate,
        packet.source,
        packet.destination,
        int(packet.ack_requested),
        max(len(packet.frames), packet.announced_frames),
        sum(map(bool, packet.frames)),
        packet_type(packet).value,
        sum(map(len, packet.frames)),
        *((CARRIER_HZ,) if version == 8 else ()),
    )
