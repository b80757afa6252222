"""Packets of the modem: as records, and the frames of an unfinished packet as saved state."""

from __future__ import annotations

from collections.abc import Sequence

import msgpack

from sonarpost.errors import FrameError
from sonarpost.messages import AcousticFrame, LinkQuality
from sonarpost.modem.interface import FrameReceived, ModemCapabilities, PacketReceived, ReceptionQuality


def pack_partial(frames: Sequence[FrameReceived], received_utc_s: float) -> bytes:
    """Return the frames of an unfinished packet as bytes for the store."""
    saved = [[f.src, f.dest, f.ack, f.frame_number, f.data, f.rate] for f in frames]
    return bytes(msgpack.packb({"heard_utc_s": received_utc_s, "frames": saved}))


def unpack_partial(saved: bytes) -> tuple[PacketReceived, float] | None:
    """Return the packet of `pack_partial`, without statistics, and its time; None if it has no frames."""
    state = msgpack.unpackb(saved)
    frames = tuple(
        FrameReceived(
            int(src), int(dest), bool(ack), int(number), memoryview(data).tobytes(), 0.0, rate and int(rate), None
        )
        for src, dest, ack, number, data, rate in state["frames"]
    )
    if not frames:
        return None
    first = frames[0]
    packet = PacketReceived(frames, 0, None, first.src, first.dest, first.rate, None, complete=False)
    return packet, float(state["heard_utc_s"])


def received_frame(
    vessel_id: str,
    frame: FrameReceived,
    packet: PacketReceived,
    number: int,
    received_utc_s: float,
    modem: ModemCapabilities,
) -> AcousticFrame:
    """Return the record of a received frame.

    Args:
        vessel_id: Name of the vessel.
        frame: The frame.
        packet: Its packet.
        number: Number of the packet on this vessel.
        received_utc_s: End of the packet.
        modem: Capabilities of the modem.

    Raises:
        FrameError: This modem does not send such a frame.
        ValidationError: No modem sends such a frame.
    """
    most = max(rate.frames for rate in modem.rates.values())
    if not modem.min_address <= frame.src <= modem.max_address:
        raise FrameError("acoustic frame", "source", frame.src, f"{modem.min_address}..{modem.max_address}")
    if not 1 <= frame.frame_number <= most:
        raise FrameError("acoustic frame", "frame_number", frame.frame_number, f"1..{most}")
    rate = None if frame.rate is None else modem.rates.get(frame.rate)
    return AcousticFrame(
        direction="rx",
        platform_id=vessel_id,
        time_utc_s=received_utc_s,
        source=frame.src,
        destination=frame.dest,
        rate=None if rate is None else rate.number,
        packet=number,
        frame_number=frame.frame_number,
        frame_count=_within(packet.nframes, most),
        data=frame.data,
        quality=quality_of(packet.statistics),
        airtime_s=None if rate is None else rate.airtime_s,
    )


def quality_of(statistics: ReceptionQuality | None) -> LinkQuality | None:
    """Return the modem's statistics as a record; an impossible count becomes None."""
    if statistics is None:
        return None
    return LinkQuality(
        snr_in_db=statistics.snr_in_db,
        snr_out_db=statistics.snr_out_db,
        spl_db=None if statistics.spl_db is None else float(statistics.spl_db),
        mse_db=statistics.mse_db,
        doppler=statistics.doppler,
        frames=_within(statistics.nframes),
        bad_frames=_within(statistics.nbad),
    )


def _within(number: int | None, high: int | None = None) -> int | None:
    """Return a count if it is in 0..high, else None."""
    return number if number is not None and number >= 0 and (high is None or number <= high) else None
