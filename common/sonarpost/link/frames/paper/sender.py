"""From an encoded picture to acoustic packets of the `paper` wire format.

Rules, in the order in which they bind:

1. One half a packet, as in the paper: when each half fits one packet, the first packet carries the top half and the
   second the bottom half, and nothing of the other.
2. A half that does not fit is spread over several packets. The halves then share a packet when, and only when, that
   saves one: a packet costs its whole air time however little is in it.
3. The contact record fills every frame left free, which costs no air time. It leads each group of packets that has a
   free frame, because where and how sure matters before what it looks like; further copies come last.
4. When no packet of the image has a free frame (always so at one frame a packet), the contact record goes first, in
   a packet of its own.

The top half always goes before the bottom half: embedded codecs put the coarse picture first.
"""

from __future__ import annotations

from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import FrameError, StreamError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import (
    CONTACT_FRAME_SIZE,
    HALF_PREFIX_SIZE,
    MAX_HALF_HEADER_SIZE,
    ContactFrame,
    HalfFrame,
    HalfName,
    half_bounds,
)

Packet = tuple[bytes, ...]

_MAX_BODY_BYTES = 0xFFFF


def plan_packets(
    image_id: str,
    stream: bytes,
    contact: ContactSummary | None,
    frames_per_packet: int,
    frame_bytes: int,
) -> tuple[Packet, ...]:
    """Return the packets of one image in the order of sending.

    Args:
        image_id: Four characters 0-9A-Z.
        stream: The codec's stream, header and the whole body.
        contact: The contact record to send along, or None.
        frames_per_packet: Most frames in a packet at the rate in use (1 to 8 on a Micro-Modem).
        frame_bytes: Most bytes in a frame at that rate (32, 64 or 256).

    Returns:
        Packets, each a tuple of one to `frames_per_packet` frames, none longer than `frame_bytes`.

    Raises:
        FrameError: The identifier is wrong, or the frames are too few or too small for the longest header and one
            byte (or for the contact record).
        StreamError: The stream's header is wrong or its body too long.
    """
    _check_sizes(frames_per_packet, frame_bytes, with_contact=contact is not None)
    header = StreamHeader.unpack(stream)
    body = stream[header.size :]
    if len(body) > _MAX_BODY_BYTES:
        raise StreamError("stream", "body", f"{len(body)} bytes", f"at most {_MAX_BODY_BYTES} bytes")
    top = _half_frames("top", image_id, header, body, frame_bytes)
    bottom = _half_frames("bottom", image_id, header, body, frame_bytes) if len(body) > 1 else ()
    record = None if contact is None else ContactFrame(image_id, contact).pack()
    groups = _group(top, bottom, frames_per_packet, with_contact=record is not None)
    if record is not None:
        groups = _place_contact(groups, record, frames_per_packet)
    return tuple(
        group[first : first + frames_per_packet]
        for group in groups
        for first in range(0, len(group), frames_per_packet)
    )


def body_capacity_bytes(
    frames_per_packet: int, frame_bytes: int, *, with_contact: bool, header_bytes: int = StreamHeader.MAX_SIZE
) -> int:
    """Return the longest stream body of which each half fits one packet.

    With a contact record, one frame of each packet is kept for it, unless a packet has only one frame: then the
    record travels in a packet of its own and takes nothing from the body.

    Args:
        frames_per_packet: Most frames in a packet.
        frame_bytes: Most bytes in a frame.
        with_contact: Whether a contact record goes along.
        header_bytes: The `size` of the stream's header; left out, what fits whatever codec and picture size.

    Raises:
        FrameError: As for `plan_packets`, or no stream header has this length.
    """
    if not 2 <= header_bytes <= StreamHeader.MAX_SIZE:
        raise FrameError("packet plan", "header_bytes", header_bytes, f"2..{StreamHeader.MAX_SIZE}")
    _check_sizes(frames_per_packet, frame_bytes, with_contact=with_contact)
    frames = frames_per_packet - 1 if with_contact and frames_per_packet > 1 else frames_per_packet
    return min(2 * frames * (frame_bytes - HALF_PREFIX_SIZE - header_bytes), _MAX_BODY_BYTES)


def _check_sizes(frames_per_packet: int, frame_bytes: int, *, with_contact: bool) -> None:
    if frames_per_packet < 1:
        raise FrameError("packet plan", "frames_per_packet", frames_per_packet, "at least 1")
    least = CONTACT_FRAME_SIZE if with_contact else MAX_HALF_HEADER_SIZE + 1
    if frame_bytes < least:
        raise FrameError("packet plan", "frame_bytes", frame_bytes, f"at least {least}")


def _half_frames(half: HalfName, image_id: str, header: StreamHeader, body: bytes, frame_bytes: int) -> Packet:
    start, stop = half_bounds(len(body), half)
    step = frame_bytes - HALF_PREFIX_SIZE - header.size
    # An empty half still needs its start in the list: a picture with an empty body travels as one bare header.
    offsets = range(start, stop, step) or (start,)
    return tuple(
        HalfFrame(half, image_id, offset, len(body), header, body[offset : min(offset + step, stop)]).pack()
        for offset in offsets
    )


def _group(top: Packet, bottom: Packet, frames_per_packet: int, *, with_contact: bool) -> tuple[Packet, ...]:
    """Return the frames as groups; a group starts a packet and fills as many as it needs."""
    apart = tuple(half for half in (top, bottom) if half)
    if max(len(top), len(bottom)) <= frames_per_packet:
        return apart
    packets_apart = sum(_packets(len(half), frames_per_packet) for half in apart)
    # The contact record's frame counts here: where it alone would fill a packet, apart is no worse.
    together = _packets(len(top) + len(bottom) + (1 if with_contact else 0), frames_per_packet)
    return (top + bottom,) if together < packets_apart else apart


def _place_contact(groups: tuple[Packet, ...], record: bytes, frames_per_packet: int) -> tuple[Packet, ...]:
    placed: list[Packet] = []
    for group in groups:
        free = -len(group) % frames_per_packet
        placed.append((record, *group, *(record,) * (free - 1)) if free else group)
    if any(record in group for group in placed):
        return tuple(placed)
    return ((record,), *placed)


def _packets(frames: int, frames_per_packet: int) -> int:
    return -(-frames // frames_per_packet)
