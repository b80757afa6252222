"""Frames that a vessel receives, for the tests of its services."""

import numpy as np

from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.frames.v1.payload_objects import ENTRY_HEAD_BYTES, Preview
from sonarpost.modem.interface import FrameReceived, PacketReceived, ReceptionQuality

CONTACT = ContactSummary(height_px=40, width_px=60, lat_deg=56.4, lon_deg=-5.6, time_utc_s=1_475_568_000.0)


def preview_frame(number: int, prefix_bytes: int = 0, frame_bytes: int = 32) -> bytes:
    """Return a `v1` frame with the contact record of image `number`, and the first bytes of a stream."""
    prefix = b"\x20" + np.random.default_rng(number).bytes(prefix_bytes - 1) if prefix_bytes else b""
    entry = Preview(number, CONTACT, prefix, ended=False).pack(ENTRY_HEAD_BYTES + len(prefix))
    kind = SegmentKind.PREVIEW if prefix else SegmentKind.CONTACT
    return pack_segments([Segment(kind, entry)], frame_bytes)


def received(data: bytes = b"x", number: int = 1, *, src: int = 3, dest: int = 1, rate: int = 1) -> FrameReceived:
    """Return a frame as the driver reports it."""
    return FrameReceived(src, dest, False, number, data, 0.0, rate, None)


def packet(
    *frames: FrameReceived | bytes,
    src: int = 3,
    dest: int = 1,
    bad: int = 0,
    nframes: int | None = None,
    rate: int = 1,
    statistics: ReceptionQuality | None = None,
) -> PacketReceived:
    """Return a packet as the driver reports it; bytes become frames with consecutive numbers."""
    found = tuple(
        received(frame, number, src=src, dest=dest, rate=rate) if isinstance(frame, bytes) else frame
        for number, frame in enumerate(frames, start=1)
    )
    count = len(found) if nframes is None else nframes
    return PacketReceived(found, bad, count, src, dest, rate, statistics, not bad)
