"""Sender of the `paper` wire format: images in, packets out in a fixed order.

Rules for the packets of an image, earlier ones first:

1. One half per packet, as in the paper: if each half fits one packet, the first packet carries the top half and the
   second the bottom half.
2. A half that does not fit is divided over several packets. The halves then share a packet if, and only if, that saves
   one: a packet costs the same airtime however few bytes it carries.
3. The contact record fills every free frame, which costs no airtime. It goes first in each group of packets that has a
   free frame, because position and confidence matter before the image; further copies go last.
4. If no packet of the image has a free frame (always so at one frame per packet), the contact record goes first, in a
   packet of its own.

The top half always precedes the bottom half: embedded codecs put the coarse image first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from typing_extensions import override

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
from sonarpost.link.frames.v1.payload_objects import Feedback, RefineRequest
from sonarpost.link.sender import ExpectedDelivery, ImageSender, ImageToSend, OutgoingPacket, SentImage
from sonarpost.link.state import Bounds, Errors, PartReader, Parts, SavedCount, pack_part
from sonarpost.modem.interface import RateInfo

Packet = tuple[bytes, ...]

_MAX_BODY_BYTES: Final = 0xFFFF


@dataclass(frozen=True, slots=True)
class WaitingImage:
    """An image of which packets are still to be sent.

    Attributes:
        order: Position in the order of arrival.
        image_id: Four characters 0-9A-Z.
        contact_id: Identifier of its contact on the vehicle.
        contact: The contact record.
        stream: The codec's stream.
    """

    order: SavedCount
    image_id: str
    contact_id: str
    contact: ContactSummary
    stream: bytes


@dataclass(frozen=True, slots=True)
class PaperProgress:
    """Progress of the first image.

    Attributes:
        order: Its `WaitingImage.order`.
        rate: Number of the rate that its packets were planned for.
        packets_sent: Number of its packets that have been sent.
        packet_interval_s: Smoothed time from one packet to the next.
    """

    order: SavedCount
    rate: SavedCount
    packets_sent: SavedCount
    packet_interval_s: Annotated[float, Bounds(0, 1e9)]


class PaperSender(ImageSender):
    """Transmit queue of the `paper` format: each image's packets are sent once, images in the order of arrival.

    Attributes:
        images: Images of which packets are still to be sent, in the order of sending.

    Args:
        rate: The modem's rate.
    """

    def __init__(self, rate: RateInfo) -> None:
        super().__init__(rate.airtime_s)
        self._rate = rate
        self.images: list[WaitingImage] = []
        self._next_order = 1
        self._packets_sent = 0

    @property
    @override
    def rate(self) -> int:
        return self._rate.number

    @property
    @override
    def is_idle(self) -> bool:
        """Whether there is nothing to send."""
        return not self.images

    @property
    @override
    def images_waiting(self) -> int:
        return len(self.images)

    @override
    def add_image(self, image: ImageToSend, now: float) -> bool:
        """Add an image and return True: an image that arrives again is sent again.

        Raises:
            FrameError: The identifier is invalid.
            StreamError: The stream is invalid or too long.
        """
        contact = image.contact.rounded()
        added = WaitingImage(self._next_order, image.image_id, image.contact_id, contact, image.stream)
        self._plan(added)
        self.images.append(added)
        self._next_order += 1
        return True

    def _plan(self, image: WaitingImage) -> tuple[Packet, ...]:
        frames, frame_bytes = self._rate.frames, self._rate.frame_bytes
        return plan_packets(image.image_id, image.stream, image.contact, frames, frame_bytes)

    @override
    def _select_packet(self, now: float) -> OutgoingPacket | None:
        if not self.images:
            return None
        return OutgoingPacket(self.rate, self._plan(self.images[0])[self._packets_sent])

    @override
    def _packet_sent(self) -> tuple[SentImage, ...]:
        self._packets_sent += 1
        if self._packets_sent < len(self._plan(self.images[0])):
            return ()
        self._packets_sent = 0
        image = self.images.pop(0)
        return (SentImage(image.image_id, image.contact_id),)

    @override
    def on_feedback(self, feedback: Feedback | RefineRequest, now: float, receiver: int) -> None:
        """Do nothing: the format has no feedback."""

    @override
    def expected(self, now: float) -> list[ExpectedDelivery]:
        """Return when each image is expected to be sent, in the order of sending."""
        found: list[ExpectedDelivery] = []
        packets_before = 0
        for place, image in enumerate(self.images):
            packets = self._plan(image)
            left = packets[self._packets_sent :] if place == 0 else packets
            preview_s = now + (packets_before + 1) * self.packet_interval_s if len(left) == len(packets) else None
            frame_bytes = sum(len(frame) for packet in left for frame in packet)
            packets_before += len(left)
            done_s = now + packets_before * self.packet_interval_s
            found.append(ExpectedDelivery(image.image_id, image.contact_id, frame_bytes, preview_s, done_s))
        return found

    @override
    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`: the images, and the progress of the first."""
        parts = {f"image/{image.order}": pack_part(image) for image in self.images}
        order = self.images[0].order if self.images else self._next_order
        progress = PaperProgress(order, self.rate, self._packets_sent, self.packet_interval_s)
        return {**parts, "progress": pack_part(progress)}

    @override
    def restore(self, parts: Parts) -> Errors:
        """Replace the state by saved parts; return why parts were skipped.

        An image that was planned for another rate is sent from its beginning.
        """
        reader = PartReader(parts, "paper sender state")
        images = reader.read_group("image", WaitingImage, apply=self._plan)
        self.images = sorted(images, key=lambda image: image.order)
        progress = reader.read("progress", PaperProgress) or PaperProgress(1, self.rate, 0, self.packet_interval_s)
        self._next_order = max([progress.order, *(image.order + 1 for image in images)])
        self.packet_interval_s = progress.packet_interval_s
        if self.images and (progress.order, progress.rate) == (self.images[0].order, self.rate):
            self._packets_sent = min(progress.packets_sent, len(self._plan(self.images[0])) - 1)
        # The state may be restored while the modem sends this packet.
        self.in_flight = self._select_packet(0.0)
        return reader.errors


def plan_packets(
    image_id: str,
    stream: bytes,
    contact: ContactSummary | None,
    frames_per_packet: int,
    frame_bytes: int,
) -> tuple[Packet, ...]:
    """Return the packets of an image in the order of sending.

    Args:
        image_id: Four characters 0-9A-Z.
        stream: The codec's stream, header and the whole body.
        contact: The contact record, or None to send none.
        frames_per_packet: Frames in a packet at the rate in use (1 to 8 on a Micro-Modem).
        frame_bytes: Length of a frame at that rate (32, 64 or 256).

    Returns:
        Packets, each a tuple of one to `frames_per_packet` frames, none longer than `frame_bytes`.

    Raises:
        FrameError: The identifier is invalid, or the frames are too few or too small for the longest header and one
            byte (or for the contact record).
        StreamError: The stream's header is invalid or its body too long.
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


def _check_sizes(frames_per_packet: int, frame_bytes: int, *, with_contact: bool) -> None:
    if frames_per_packet < 1:
        raise FrameError("packet plan", "frames_per_packet", frames_per_packet, "at least 1")
    least = CONTACT_FRAME_SIZE if with_contact else MAX_HALF_HEADER_SIZE + 1
    if frame_bytes < least:
        raise FrameError("packet plan", "frame_bytes", frame_bytes, f"at least {least}")


def _half_frames(half: HalfName, image_id: str, header: StreamHeader, body: bytes, frame_bytes: int) -> Packet:
    start, stop = half_bounds(len(body), half)
    step = frame_bytes - HALF_PREFIX_SIZE - header.size
    # An empty body is sent as one frame with a header only.
    offsets = range(start, stop, step) or (start,)
    return tuple(
        HalfFrame(half, image_id, offset, len(body), header, body[offset : min(offset + step, stop)]).pack()
        for offset in offsets
    )


def _group(top: Packet, bottom: Packet, frames_per_packet: int, *, with_contact: bool) -> tuple[Packet, ...]:
    """Return the frames in groups; a group starts a new packet and fills as many as it needs."""
    separate = tuple(half for half in (top, bottom) if half)
    if max(len(top), len(bottom)) <= frames_per_packet:
        return separate
    separate_packets = sum(_packets(len(half), frames_per_packet) for half in separate)
    # The frame of the contact record counts: if it alone needs a packet, separate halves are no worse.
    together = _packets(len(top) + len(bottom) + (1 if with_contact else 0), frames_per_packet)
    return (top + bottom,) if together < separate_packets else separate


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
