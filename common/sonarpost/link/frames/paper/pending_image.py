"""One image being put together from frames of the `paper` wire format."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from sonarpost.codec.interface import StreamHeader
from sonarpost.link.coding.byte_ranges import Ranges, add_range, count_positions, covered_within, gaps_within
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.events import ContactOnly, ImageReady
from sonarpost.link.frames.paper.frame import HalfFrame, HalfName, half_bounds

MAX_CANDIDATES = 3

DeliveredState = tuple[int, int, bool]


class FrameOutcome(Enum):
    """What a frame did to its image."""

    NEWS = "news"
    DUPLICATE = "duplicate"
    REFUSED = "refused"


@dataclass(slots=True)
class ImageCandidate:
    """The body as told by all frames that agree on one stream header and body length.

    Attributes:
        header: The stream header they agree on.
        body: As many bytes as they agree on, zero where nothing arrived.
        received: The ranges that arrived.
        frames: Frames that added a byte, and the one that brought the header.
    """

    header: StreamHeader
    body: bytearray
    received: Ranges = ()
    frames: int = 1

    def fill(self, frame: HalfFrame) -> tuple[bool, bool]:
        """Put in what is new; a byte that is there stays. Return (something was new, something differed)."""
        conflict = any(
            self.body[start:stop] != frame.payload[start - frame.offset : stop - frame.offset]
            for start, stop in covered_within(self.received, frame.offset, frame.stop)
        )
        gaps = gaps_within(self.received, frame.offset, frame.stop)
        for start, stop in gaps:
            self.body[start:stop] = frame.payload[start - frame.offset : stop - frame.offset]
        self.received = add_range(self.received, frame.offset, frame.stop)
        return bool(gaps), conflict

    @property
    def received_bytes(self) -> int:
        """Number of body bytes that arrived."""
        return count_positions(self.received)

    def missing_halves(self) -> tuple[HalfName, ...]:
        """Return the halves that are not empty and of which nothing arrived."""
        names: tuple[HalfName, ...] = ("top", "bottom")
        bounds = {name: half_bounds(len(self.body), name) for name in names}
        return tuple(n for n, (a, b) in bounds.items() if a < b and not covered_within(self.received, a, b))


@dataclass(slots=True)
class PendingImage:
    """Everything known of one image of one source.

    Frames with different stream headers or body lengths are kept apart as candidates, at most `MAX_CANDIDATES`; the
    best one speaks for the image (see `leader`).

    Attributes:
        source: Modem address.
        image_id: Four characters 0-9A-Z.
        first_at: Time of the first frame.
        last_at: Time of the last frame that added anything.
        news_at: The same, on the clock's present course (see `PairingReceiver.poll`); the time-out counts from it.
        heard_at: Time of the last frame of any kind.
        candidates: In the order of their first frame.
        contact: The first contact record that arrived.
        conflicts: Frames that disagreed with another.
        version: Of what was last given out; 0 before.
        given: What was last given out (leader, body bytes, contact known), None before.
    """

    source: int
    image_id: str
    first_at: float
    last_at: float
    news_at: float
    heard_at: float
    candidates: list[ImageCandidate] = field(default_factory=list)
    contact: ContactSummary | None = None
    conflicts: int = 0
    version: int = 0
    given: DeliveredState | None = None

    @property
    def leader(self) -> ImageCandidate | None:
        """The candidate that speaks for the image, or None before the first half frame.

        It is the one whose picture size is the contact record's (which has a checksum), then the one with the most
        frames, then with the most bytes, then the one that came first.
        """
        return max(self.candidates, key=self._rank, default=None)

    def _rank(self, candidate: ImageCandidate) -> tuple[bool, int, int]:
        header, contact = candidate.header, self.contact
        agrees = contact is not None and (contact.height_px, contact.width_px) == (header.height_px, header.width_px)
        return agrees, candidate.frames, candidate.received_bytes

    @property
    def complete(self) -> bool:
        """Whether the whole body of the leading candidate has arrived."""
        leader = self.leader
        return leader is not None and leader.received_bytes == len(leader.body)

    @property
    def open(self) -> bool:
        """Whether more is known than was last given out."""
        return self._state() != self.given

    def _state(self) -> DeliveredState:
        leader = self.leader
        if leader is None:
            return -1, 0, self.contact is not None
        index = next(i for i, candidate in enumerate(self.candidates) if candidate is leader)
        return index, leader.received_bytes, self.contact is not None

    def add_half(self, frame: HalfFrame, now: float) -> FrameOutcome:
        """Put in one half frame."""
        self.heard_at = now
        agreeing = (c for c in self.candidates if c.header == frame.header and len(c.body) == frame.body_length)
        candidate = next(agreeing, None)
        if candidate is not self.leader:
            self.conflicts += 1
        if candidate is None:
            if len(self.candidates) >= MAX_CANDIDATES:
                return FrameOutcome.REFUSED
            candidate = ImageCandidate(frame.header, bytearray(frame.body_length))
            candidate.fill(frame)
            self.candidates.append(candidate)
            self._note_news(now)
            return FrameOutcome.NEWS
        added, conflict = candidate.fill(frame)
        self.conflicts += conflict
        if not added:
            return FrameOutcome.DUPLICATE
        candidate.frames += 1
        self._note_news(now)
        return FrameOutcome.NEWS

    def add_contact(self, contact: ContactSummary, now: float) -> FrameOutcome:
        """Put in one contact record; the first stays."""
        self.heard_at = now
        if self.contact is not None:
            self.conflicts += contact != self.contact
            return FrameOutcome.DUPLICATE
        self.contact = contact
        self._note_news(now)
        return FrameOutcome.NEWS

    def _note_news(self, now: float) -> None:
        self.last_at = self.news_at = now

    def give_out(self) -> ImageReady | ContactOnly:
        """Return the event that says all that is known, as the next version."""
        leader = self.leader
        self.version += 1
        self.given = self._state()
        if leader is None:
            assert self.contact is not None, "an image starts with a half frame or a contact record"
            return ContactOnly(
                self.source, self.image_id, self.version, self.contact, self.conflicts, self.first_at, self.last_at
            )
        return ImageReady(
            source=self.source,
            image_id=self.image_id,
            version=self.version,
            header=leader.header,
            body=bytes(leader.body),
            received=leader.received,
            missing_halves=leader.missing_halves(),
            contact=self.contact,
            frames=leader.frames,
            conflicts=self.conflicts,
            first_at=self.first_at,
            last_at=self.last_at,
            complete=self.complete,
        )
