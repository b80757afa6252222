"""The long sentences of the emulated modem: receive and transmit statistics.

Field lists as public descriptions and drivers of the modem give them. Version 6 of both sentences is what every known
host reads; Goby takes a later one for an older one. Version 8 of `CACST` has four fields more after the bandwidth, and
version 7 of `CAXST`, which goes with it, the actual carrier last.
Levels are plausible, not physical: they follow range and packet, and nothing should be calibrated on them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum

from sonarpost.modem.micromodem import nmea

CARRIER_HZ = 25000
BANDWIDTH_HZ = 5000
PROBE_SYMBOLS = 200

_SOURCE_LEVEL_DB = 185.0
_BEST_OUTPUT_SNR_DB = 20.0


class ReceiveMode(IntEnum):
    """The `mode` of `CACST`."""

    GOOD = 0
    BAD_CRC = 1
    TIMEOUT = 2


class PacketType(IntEnum):
    """The `pkt_type` of `CACST` and `CAXST`."""

    FSK = 1
    FSK_MINI = 2
    PSK = 3
    FLEXIBLE = 5


@dataclass(frozen=True, slots=True)
class ReceivedPacket:
    """What `CACST` tells about one packet.

    Attributes:
        mode: How the reception ended.
        arrived: Date and time at which the packet's first sound arrived.
        clock: Status of the modem's clock.
        rate: Rate number.
        source: Address, 0 when the header was not understood.
        destination: Address, 0 when the header was not understood.
        packet_type: Kind of packet.
        frames: Frames it held.
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
    """What `CAXST` tells about one packet.

    Attributes:
        started: Date and time at which the transmission began.
        clock: Status of the modem's clock.
        rate: Rate number.
        source: Address.
        destination: Address.
        ack_requested: Whether acknowledgement was asked for.
        frames_expected: Frames the cycle announced.
        frames_sent: Frames that held data.
        packet_type: Kind of packet.
        data_bytes: Bytes of data in the packet.
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


def receive_statistics(heard: ReceivedPacket, version: int) -> bytes:
    """Return the `CACST` sentence for one packet, in the layout of `version` (6 or 8)."""
    level_db = _SOURCE_LEVEL_DB - 20 * math.log10(max(1.0, heard.range_m))
    out_db = min(heard.snr_db - 3.0, _BEST_OUTPUT_SNR_DB)
    psk = heard.packet_type in {PacketType.PSK, PacketType.FLEXIBLE}
    psk_error = {ReceiveMode.GOOD: 0, ReceiveMode.BAD_CRC: 3, ReceiveMode.TIMEOUT: 2}[heard.mode] if psk else 0
    fields: Sequence[str | int] = (
        version,
        heard.mode.value,
        heard.arrived.strftime("%Y%m%d%H%M%S.%f"),
        heard.clock,
        max(1, min(32767, round(32767 * 10 ** ((heard.snr_db - 20) / 40)))),
        max(0, min(99, round(heard.snr_db + 25))),
        f"{max(0, min(9999, round(100 + 2 * heard.snr_db))):04d}",
        f"{max(0, round(level_db)):04d}",
        "07",
        "00",
        "00",
        "00",
        "00",
        heard.rate,
        f"{heard.source:03d}",
        f"{heard.destination:03d}",
        psk_error,
        heard.packet_type.value,
        heard.frames,
        heard.bad_frames,
        max(0, round(level_db)),
        f"{heard.snr_db:.1f}",
        f"{out_db:.2f}" if psk else "-100",
        "-100",
        f"{-out_db:.2f}" if psk else "-100",
        "-01" if psk else f"{max(0, min(254, round(180 + heard.snr_db))):03d}",
        "0.00",
        51,
        CARRIER_HZ,
        BANDWIDTH_HZ,
    )
    return nmea.format("CACST", *fields, *((0, -1, -1, "00") if version == 8 else ()))


def transmit_statistics(sent: TransmittedPacket, version: int) -> bytes:
    """Return the `CAXST` sentence for one packet, in the layout that goes with `version` (6 or 8) of `CACST`."""
    return nmea.format(
        "CAXST",
        7 if version == 8 else 6,
        sent.started.strftime("%Y%m%d"),
        sent.started.strftime("%H%M%S.%f"),
        sent.clock,
        0,
        PROBE_SYMBOLS,
        BANDWIDTH_HZ,
        CARRIER_HZ,
        sent.rate,
        sent.source,
        sent.destination,
        int(sent.ack_requested),
        sent.frames_expected,
        sent.frames_sent,
        sent.packet_type.value,
        sent.data_bytes,
        *((CARRIER_HZ,) if version == 8 else ()),
    )
