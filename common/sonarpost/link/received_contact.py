"""What the v1 receiver knows of one contact."""

from __future__ import annotations

from dataclasses import dataclass, field

from sonarpost.link.coding.byte_ranges import Ranges, add_range, covered_within
from sonarpost.link.events import ContactUpdate
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.payload_objects import StreamPiece
from sonarpost.link.frames.v1.preview import Preview, contact_link


@dataclass(eq=False)
class KnownContact:
    """A contact and its stream as far as they have arrived.

    Attributes:
        source: Modem address of the vehicle.
        number: Of the contact.
        first_at: Time of the first news.
        last_at: Time of the latest.
        contact: The record, None while only pieces of the picture are there.
        link: Which `contact_link` the pieces name.
        stream: Bytes of the stream, zero where none arrived.
        there: Which of them arrived.
        end: Where the stream ends as planned so far, 0 while nobody has said so.
        version: Of the latest update, 0 before the first.
        told: Bytes without a gap and completeness that the latest update had.
    """

    source: int
    number: int
    first_at: float
    last_at: float
    contact: ContactSummary | None = None
    link: int = 0
    stream: bytearray = field(default_factory=bytearray)
    there: Ranges = ()
    end: int = 0
    version: int = 0
    told: tuple[int, bool] = (-1, False)

    def belongs(self, preview: Preview) -> bool:
        """Whether a preview is of this contact, and not of another with the same number."""
        return self.contact == preview.contact if self.contact is not None else self.link == preview.link

    def add_preview(self, preview: Preview, now: float) -> None:
        """Take record and beginning."""
        self.contact = preview.contact
        self.link = contact_link(self.number, preview.contact.pack())
        self._write(0, preview.prefix)
        if preview.ended:
            self.end = max(self.end, len(preview.prefix))
        self.last_at = now

    def add_piece(self, piece: StreamPiece, now: float, *, final: bool) -> None:
        """Take a piece whose link is this contact's."""
        self._write(piece.start, piece.data)
        if final:
            self.end = max(self.end, piece.stop)
        self.last_at = now

    def _write(self, start: int, data: bytes) -> None:
        stop = start + len(data)
        if len(self.stream) < stop:
            self.stream.extend(bytes(stop - len(self.stream)))
        kept = covered_within(self.there, start, stop)
        old = bytes(self.stream)
        self.stream[start:stop] = data
        for a, b in kept:  # what was there first stays
            self.stream[a:b] = old[a:b]
        self.there = add_range(self.there, start, stop)

    @property
    def unbroken(self) -> int:
        """Bytes of the stream from its beginning to the first gap."""
        return self.there[0][1] if self.there and self.there[0][0] == 0 else 0

    @property
    def complete(self) -> bool:
        """Whether all is there that was planned so far."""
        return self.end > 0 and self.unbroken >= self.end

    def update(self) -> ContactUpdate | None:
        """Return the next update, None when there is nothing to tell."""
        state = (self.unbroken, self.complete)
        if self.contact is None or state == self.told:
            return None
        self.told = state
        self.version += 1
        return ContactUpdate(
            self.source,
            self.number,
            self.version,
            self.contact,
            bytes(self.stream[: self.unbroken]),
            self.complete,
            self.first_at,
            self.last_at,
        )
