"""What the receiver of the `paper` wire format reports. All events are frozen and carry plain values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarpost.codec.interface import Mask, StreamHeader
from sonarpost.errors import FrameError
from sonarpost.link.coding.byte_ranges import Ranges
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import HalfName


@dataclass(frozen=True, slots=True)
class ImageReady:
    """An image to decode: all of it, or what there is of it.

    Attributes:
        source: Modem address it came from.
        image_id: Four characters 0-9A-Z.
        version: 1 for the first time anything of this image is given out, one more each time more is known.
        header: Of the codec stream.
        body: As long as the sender said; zero where nothing arrived.
        received: Byte ranges [start, stop) of the body that arrived, sorted, disjoint, not touching.
        missing_halves: The halves of which not one byte arrived.
        contact: The contact record, or None when it has not arrived.
        frames: Half frames that contributed to `header` and `body`.
        conflicts: Frames that disagreed with others of the same image; not zero means that damage got through the
            modem's own checks, or that an identifier was used twice.
        first_at: Time of the first frame of the image, as given to the receiver.
        last_at: Time of the last frame that contributed.
        complete: The whole body arrived.
    """

    source: int
    image_id: str
    version: int
    header: StreamHeader
    body: bytes
    received: Ranges
    missing_halves: tuple[HalfName, ...]
    contact: ContactSummary | None
    frames: int
    conflicts: int
    first_at: float
    last_at: float
    complete: bool

    @property
    def stream(self) -> bytes:
        """Header and zero-padded body, as `Codec.decode` takes it."""
        return self.header.pack() + self.body

    def received_mask(self) -> Mask:
        """Return shape (len(body),), True where a body byte arrived, as `Codec.decode` takes it."""
        mask = np.zeros(len(self.body), dtype=np.bool_)
        for start, stop in self.received:
            mask[start:stop] = True
        return mask


@dataclass(frozen=True, slots=True)
class ContactOnly:
    """A contact record of which no piece of the picture has arrived.

    Attributes:
        source: Modem address it came from.
        image_id: Four characters 0-9A-Z.
        version: As in `ImageReady`; a picture that arrives later has a higher one.
        contact: The record, with the size of the picture that was to come.
        conflicts: Contact frames of the same image that said something else.
        first_at: Time of the first frame.
        last_at: Time of the last frame that contributed.
    """

    source: int
    image_id: str
    version: int
    contact: ContactSummary
    conflicts: int
    first_at: float
    last_at: float


@dataclass(frozen=True, slots=True)
class PaperFrameRejected:
    """A frame that is not of this wire format, or that cannot belong to its image.

    Attributes:
        source: Modem address it came from.
        reason: The error that a strict parser would have raised.
        at: When it was met.
    """

    source: int
    reason: FrameError
    at: float


Event = ImageReady | ContactOnly | PaperFrameRejected
