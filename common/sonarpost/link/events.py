"""What the receiver of the v1 format reports. All events are frozen and carry plain values."""

from __future__ import annotations

from dataclasses import dataclass

from sonarpost.errors import FrameError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.feedback import Feedback, FeedbackRequest


@dataclass(frozen=True, slots=True)
class ContactUpdate:
    """A contact of which more is known than before.

    Attributes:
        source: Modem address of the vehicle.
        number: Of the contact.
        version: 1 the first time, then one more each time.
        contact: The record.
        stream: As much of the picture's stream as there is without a gap, header first; may be empty. Every byte of it
            passed two checks.
        complete: Whether that is all that was planned so far; a later refinement may bring more.
        first_at: Time of the first news of the contact.
        last_at: Time of this news.
    """

    source: int
    number: int
    version: int
    contact: ContactSummary
    stream: bytes
    complete: bool
    first_at: float
    last_at: float


@dataclass(frozen=True, slots=True)
class MessageReceived:
    """A message from the other end.

    Attributes:
        source: Modem address.
        number: 0..255.
        data: The bytes.
        at: When it came.
    """

    source: int
    number: int
    data: bytes
    at: float


@dataclass(frozen=True, slots=True)
class FeedbackReceived:
    """A receiver's report or request, for the sender on this side.

    Attributes:
        source: Modem address of the receiver.
        report: What it says.
        at: When it came.
    """

    source: int
    report: Feedback | FeedbackRequest
    at: float


@dataclass(frozen=True, slots=True)
class FrameRefused:
    """A frame, or a part of one, that is not of this format.

    Attributes:
        source: Modem address.
        reason: The error that a strict parser raised.
        at: When it came.
    """

    source: int
    reason: FrameError
    at: float


Event = ContactUpdate | MessageReceived | FeedbackReceived | FrameRefused
