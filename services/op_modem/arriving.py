"""The frames of a packet that is not over: kept as they come, so that a process that is killed loses none of them."""

from __future__ import annotations

import msgpack

from sonarpost.modem.micromodem import FrameReceived, PacketReceived


def pack(frames: list[FrameReceived], heard_utc_s: float) -> bytes:
    """Return what is kept on the disk."""
    kept = [[f.src, f.dest, f.ack, f.frame_number, f.data, f.rate] for f in frames]
    return bytes(msgpack.packb({"heard_utc_s": heard_utc_s, "frames": kept}))


def unpack(kept: bytes) -> tuple[PacketReceived, float] | None:
    """Return the packet whose end was not seen, without statistics, and when it was heard; None for nothing."""
    state = msgpack.unpackb(kept)
    frames = tuple(
        FrameReceived(src, dest, ack, number, data, 0.0, rate, None)
        for src, dest, ack, number, data, rate in state["frames"]
    )
    if not frames:
        return None
    first = frames[0]
    packet = PacketReceived(frames, 0, None, first.src, first.dest, first.rate, None, complete=False)
    return packet, float(state["heard_utc_s"])
