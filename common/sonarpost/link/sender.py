"""Interface of a vehicle's transmit queue: images and messages in, packets out, the same for every wire format.

A queue does no I/O. `now` is UTC in seconds, because another process can restore the state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from sonarpost.errors import FrameError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.payload_objects import Feedback, RefineRequest
from sonarpost.link.queue.messages import MessageQueue
from sonarpost.link.state import Bounds, Errors, Parts
from sonarpost.modem.interface import MAX_RATE

SavedRate = Annotated[int, Bounds(0, MAX_RATE)]

_SMOOTHING: Final = 0.2


@dataclass(frozen=True, slots=True)
class ImageToSend:
    """An image for the queue.

    Attributes:
        image_id: Four characters 0-9A-Z.
        contact_id: Identifier of its contact on the vehicle.
        contact: The contact record.
        stream: The codec's stream, header first.
    """

    image_id: str
    contact_id: str
    contact: ContactSummary
    stream: bytes


@dataclass(frozen=True, slots=True)
class OutgoingPacket:
    """A packet to send.

    Attributes:
        rate: Number of the modem's rate.
        frames: Its frames.
    """

    rate: SavedRate
    frames: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class ExpectedDelivery:
    """When the transmission of an image is expected to end.

    Attributes:
        image_id: Four characters 0-9A-Z.
        contact_id: Identifier of its contact on the vehicle.
        bytes_left: Length of the frames still to send for it.
        preview_s: Time when its record and a coarse image are sent, None if they have been.
        done_s: Time when everything that is planned is sent.
    """

    image_id: str
    contact_id: str
    bytes_left: int
    preview_s: float | None
    done_s: float


class SentImage(NamedTuple):
    """An image of which nothing is left to send now.

    Attributes:
        image_id: Four characters 0-9A-Z.
        contact_id: Identifier of its contact on the vehicle.
    """

    image_id: str
    contact_id: str


class ImageSender(ABC):
    """A transmit queue. By default the wire format has no messages.

    Attributes:
        messages: Messages of which nothing has been sent.
        max_messages: Maximum number of these; 0 if the wire format has no messages.
        packet_interval_s: Smoothed time from one packet to the next.
        in_flight: The packet that `next_packet` returned last, without the frames that have been sent.

    Args:
        packet_interval_s: The first value.
    """

    max_messages = 0

    def __init__(self, packet_interval_s: float) -> None:
        self.packet_interval_s = packet_interval_s
        self.messages = MessageQueue()
        self.in_flight: OutgoingPacket | None = None

    @property
    @abstractmethod
    def rate(self) -> int:
        """Number of the rate in use."""

    @property
    @abstractmethod
    def is_idle(self) -> bool:
        """Whether there is nothing to send, and nothing that feedback can request."""

    @property
    @abstractmethod
    def images_waiting(self) -> int:
        """Number of images of which something is still to be sent."""

    @abstractmethod
    def add_image(self, image: ImageToSend, now: float) -> bool:
        """Add an image; return False if nothing has to be sent for it.

        Raises:
            BadInputError: The wire format cannot carry the image.
        """

    def next_packet(self, now: float) -> OutgoingPacket | None:
        """Return the packet to send, None if there is nothing to send.

        It is the same packet until `sent` removes its frames. Save the state before it is sent: then a restart repeats
        at most one packet.
        """
        if self.in_flight is None:
            self.in_flight = self._select_packet(now)
        return self.in_flight

    @abstractmethod
    def _select_packet(self, now: float) -> OutgoingPacket | None:
        """Return the next packet, None if there is nothing to send."""

    def sent(self, frames: Sequence[bytes], interval_s: float) -> tuple[SentImage, ...]:
        """Record that frames of the packet have been sent.

        Args:
            frames: The frames.
            interval_s: Time from the packet before to this one, or the length of this one after a silence.

        Returns:
            The images of which nothing is left to send now.
        """
        self.packet_interval_s += _SMOOTHING * (interval_s - self.packet_interval_s)
        if self.in_flight is None:
            return ()
        left = tuple(frame for frame in self.in_flight.frames if frame not in frames)
        self.in_flight = OutgoingPacket(self.in_flight.rate, left) if left else None
        return () if left else self._packet_sent()

    @abstractmethod
    def _packet_sent(self) -> tuple[SentImage, ...]:
        """Return the images that the packet completes."""

    @abstractmethod
    def expected(self, now: float) -> list[ExpectedDelivery]:
        """Return when each image is expected to be sent, the first to end first."""

    def gauges(self) -> Mapping[str, float]:
        """Return figures for the health record. Another thread may call this at any time."""
        return {"images_waiting": float(self.images_waiting), "rate": float(self.rate)}

    @abstractmethod
    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`."""

    @abstractmethod
    def restore(self, parts: Parts) -> Errors:
        """Replace the state of a new queue by saved parts; the configuration stays. Return why parts were skipped."""

    def image_id_of(self, number: int) -> str | None:
        """Return the identifier of the image with a contact number, None if the queue does not have it."""
        return None

    def refine(self, number: int, stream_bytes: int, now: float) -> bool:
        """Send more of an image, up to a length of its stream (0: all); return False if the queue has no more of it."""
        return False

    def stop(self, number: int) -> bool:
        """Send nothing more of an image until a command requests it; return whether the image is stopped."""
        return False

    def resume(self, number: int, now: float) -> bool:
        """Queue the rest of a stopped image; return whether there is a stopped image with this contact number."""
        return False

    def prioritise(self, number: int, now: float, *, first: bool) -> bool:
        """Send the rest of an image before or after all others; return whether the queue has the image."""
        return False

    @property
    def measured_loss(self) -> float | None:
        """Share of frames lost according to feedback, None while it is unknown."""
        return None

    @abstractmethod
    def on_feedback(self, feedback: Feedback | RefineRequest, now: float, receiver: int) -> None:
        """Process feedback or a request of the receiver with a modem address.

        Raises:
            FrameError: A request for an image that is not kept.
        """

    @property
    def accepts_messages(self) -> bool:
        """Whether the queue has room for another message."""
        return len(self.messages.waiting) < self.max_messages

    @property
    def messages_waiting(self) -> int:
        """Number of messages of which nothing has been sent."""
        return len(self.messages.waiting)

    @property
    def message_bytes(self) -> int:
        """Total length of these messages."""
        return self.messages.waiting_bytes

    def add_message(
        self,
        message_id: str,
        source: str,
        data: bytes,
        now: float,
        *,
        priority: int = 4,
        lifetime_s: float = 3600.0,
        once: bool = False,
    ) -> bool:
        """Add a message; return False if it is known, or has expired.

        Args:
            message_id: Identifier, unique in the program.
            source: Name of the program.
            data: 1..1025 bytes.
            now: UTC in seconds.
            priority: 1 first to 7 last.
            lifetime_s: Time from `now` on after which it is not sent any more.
            once: Whether it is sent once, without copies against loss.

        Raises:
            FrameError: The wire format has no messages.
        """
        raise FrameError("transmit queue", "message", message_id, "none: this wire format carries images only")
