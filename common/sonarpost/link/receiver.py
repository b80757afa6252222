"""Interface of the link's receivers: frames in, events out, the same for every wire format.

A receiver does no I/O. `now` is in seconds on a clock that continues over a restart (UTC), because another process can
restore the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from sonarpost.codec.interface import Mask, StreamHeader
from sonarpost.errors import FrameError, StreamError
from sonarpost.link.coding.byte_ranges import Ranges, covered_within, gaps_within
from sonarpost.link.frames.contact_record import ContactSummary, contact_of
from sonarpost.link.frames.paper.frame import HalfName, half_bounds, parse_frame
from sonarpost.link.frames.v1.payload_objects import Feedback, RefineRequest
from sonarpost.messages import ReceivedImage

WireFormat = Literal["v1", "paper"]


@dataclass(frozen=True, slots=True)
class ImageUpdate:
    """The received content of an image, after more of it arrived or the wait for more ended.

    Attributes:
        source: Modem address of the vehicle.
        image_id: Four characters 0-9A-Z.
        version: 1 for the first update of an image, then one more each time.
        contact: The contact record, None until it arrives.
        stream: The codec's stream, header first, with zeros in the ranges `missing`. Empty until a header arrives.
        missing: Ranges [start, stop) of `stream` that have not arrived, sorted and disjoint.
        complete: Whether everything has arrived that the vehicle has planned to send so far.
        received_bytes: Bytes of the image that arrived. The `paper` format does not count the stream header.
        total_bytes: Length of the image in the same count, 0 while it is unknown.
        frames: Frames that contributed. Always 0 with `v1`, where a frame can serve several images.
        conflicts: Frames that contradict others of the image. The modem passed damaged data, or the vehicle used an
            identifier twice.
        first_frame_s: Time of the image's first frame.
        last_frame_s: Time of the last frame that contributed.
    """

    source: int
    image_id: str
    version: int
    contact: ContactSummary | None
    stream: bytes
    missing: Ranges
    complete: bool
    received_bytes: int
    total_bytes: int
    frames: int
    conflicts: int
    first_frame_s: float
    last_frame_s: float

    @property
    def missing_halves(self) -> tuple[HalfName, ...]:
        """The halves of the image, as the `paper` format divides it, of which no byte arrived."""
        if not has_header(self.stream):
            return "top", "bottom"
        if not self.missing:
            return ()
        header_bytes = StreamHeader.unpack(self.stream).size
        received = gaps_within(self.missing, header_bytes, len(self.stream))
        halves: tuple[HalfName, ...] = ("top", "bottom")
        bounds = {half: half_bounds(len(self.stream) - header_bytes, half) for half in halves}
        return tuple(
            half
            for half, (start, stop) in bounds.items()
            if start < stop and not covered_within(received, start + header_bytes, stop + header_bytes)
        )


def has_header(stream: bytes) -> bool:
    """Return whether the received part of a stream has a header, so that a codec can decode it."""
    try:
        StreamHeader.unpack(stream)
    except StreamError:
        # Too short so far, or invalid: `MAX_SIZE` bytes always hold a header, valid or not.
        return len(stream) >= StreamHeader.MAX_SIZE
    return True


def received_mask(stream: bytes, missing: Ranges) -> Mask:
    """Return shape (bytes of the body,), True where a byte arrived: the argument `received` of `Codec.decode`.

    Args:
        stream: The stream, header first.
        missing: Ranges of `stream` that have not arrived.

    Raises:
        StreamError: The stream has no valid header.
    """
    received = np.ones(len(stream), dtype=np.bool_)
    for start, stop in missing:
        received[start:stop] = False
    return received[StreamHeader.unpack(stream).size :]


def received_image(
    update: ImageUpdate, vessel_id: str, vehicle_id: str, *, authenticated: bool | None = None
) -> ReceivedImage:
    """Return the record of an image's received content.

    The link does not carry the detector's contact identifier: the record has vehicle and image identifier instead.

    Args:
        update: The content.
        vessel_id: Name of the vessel.
        vehicle_id: Name of the vehicle.
        authenticated: Whether all frames of the image were authenticated; None if that is not known.

    Raises:
        ValidationError: A value does not fit the record.
    """
    summary = update.contact
    contact = None if summary is None else contact_of(summary, vehicle_id, update.image_id)
    return ReceivedImage(
        vessel_id=vessel_id,
        vehicle_id=vehicle_id,
        image_id=update.image_id,
        version=update.version,
        contact=contact,
        height_px=None if summary is None else summary.height_px,
        width_px=None if summary is None else summary.width_px,
        stream=update.stream,
        missing=update.missing,
        missing_halves=update.missing_halves,
        complete=update.complete,
        bytes_received=update.received_bytes,
        bytes_total=update.total_bytes,
        frames_received=update.frames,
        conflicts=update.conflicts,
        first_frame_utc_s=update.first_frame_s,
        last_frame_utc_s=update.last_frame_s,
        authenticated=authenticated,
    )


@dataclass(frozen=True, slots=True)
class MessageReceived:
    """A message of the other station.

    Attributes:
        source: Its modem address.
        number: 0..255, the same in repetitions of a message.
        data: The bytes.
        received_s: Time of the frame.
    """

    source: int
    number: int
    data: bytes
    received_s: float


@dataclass(frozen=True, slots=True)
class FeedbackReceived:
    """Feedback or a request of a receiver, for the sender of this station.

    Attributes:
        source: Modem address of the receiver.
        feedback: The content.
        received_s: Time of the frame.
    """

    source: int
    feedback: Feedback | RefineRequest
    received_s: float


@dataclass(frozen=True, slots=True)
class FrameRejected:
    """A frame, or a part of one, that is not of the wire format or contradicts earlier frames.

    Attributes:
        source: Modem address.
        reason: The parser's error.
        received_s: Time of the frame.
    """

    source: int
    reason: FrameError
    received_s: float


Event = ImageUpdate | MessageReceived | FeedbackReceived | FrameRejected


class FrameReceiver(Protocol):
    """A receiver of one or several wire formats, for any number of sources."""

    def accept(self, source: int, frame: bytes, now: float) -> list[Event]:
        """Process a frame after `poll(now)`; return the events of both.

        Never raises because of `frame`: an invalid one gives a `FrameRejected`.

        Args:
            source: Modem address of the sender.
            frame: The frame as the modem delivered it.
            now: Seconds.
        """

    def poll(self, now: float) -> list[Event]:
        """Return the events that are due without a frame, for example the end of a wait."""

    def next_deadline(self) -> float | None:
        """Return when `poll` has the next event, None when no wait is in progress."""


class CombinedReceiver:
    """Receives both wire formats, and determines the format of each frame.

    A frame is of `v1` if `v1` accepts its checksum, and otherwise of `paper` if its fields are valid there. A frame of
    one format passes as one of the other with a probability of at most 2^-16.

    Args:
        v1: Receiver of `v1`, None to reject this format.
        paper: Receiver of `paper`, None to reject this format.
    """

    def __init__(self, v1: FrameReceiver | None, paper: FrameReceiver | None) -> None:
        self.v1 = v1
        self.paper = paper

    def accept(self, source: int, frame: bytes, now: float) -> list[Event]:
        """Process a frame; see `FrameReceiver.accept`."""
        events: list[Event] = []
        if self.v1 is not None:
            events = self.v1.accept(source, frame, now)
            if self.paper is None or not _is_foreign(events) or not _is_of_paper(frame):
                return events
        return self.paper.accept(source, frame, now) if self.paper is not None else events

    def poll(self, now: float) -> list[Event]:
        """Return the events that are due without a frame."""
        return [event for receiver in self._receivers for event in receiver.poll(now)]

    def next_deadline(self) -> float | None:
        """Return when `poll` has the next event, None when no wait is in progress."""
        deadlines = [receiver.next_deadline() for receiver in self._receivers]
        return min((deadline for deadline in deadlines if deadline is not None), default=None)

    @property
    def _receivers(self) -> list[FrameReceiver]:
        return [receiver for receiver in (self.v1, self.paper) if receiver is not None]


def _is_foreign(events: Sequence[Event]) -> bool:
    """Whether the receiver rejected the frame as a whole: this gives exactly one event."""
    return len(events) == 1 and isinstance(events[0], FrameRejected)


def _is_of_paper(frame: bytes) -> bool:
    try:
        parse_frame(frame)
    except FrameError:
        return False
    return True
