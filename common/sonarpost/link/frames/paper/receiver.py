"""Receiver of the `paper` wire format: assembles images from half frames and contact frames of any order.

docs/specifications/acoustic-paper.md gives the rules and their reasons.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import FrameError
from sonarpost.link.coding.byte_ranges import PartialBytes, gaps_within
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame, HalfFrame, is_image_id, parse_frame
from sonarpost.link.receiver import Event, FrameRejected, ImageUpdate
from sonarpost.link.state import Errors, PartReader, Parts, SavedCount, pack_part

MAX_CANDIDATES: Final = 3
"""Different stream headers or body lengths that an image keeps."""

ReportedState = tuple[int, int, bool]
"""Index of the best candidate, bytes of its body, whether there is a contact record."""


class FrameEffect(Enum):
    """Effect of a frame on its image."""

    ADDED = "added"
    DUPLICATE = "duplicate"
    REJECTED = "rejected"


@dataclass(eq=False, slots=True)
class ImageCandidate:
    """The body according to the frames that agree on one stream header and body length.

    Attributes:
        header: The stream header.
        body: The body, with its full length.
        frames: Frames that added a byte, and the first frame.
    """

    header: StreamHeader
    body: PartialBytes
    frames: SavedCount = 1

    @property
    def complete(self) -> bool:
        """Whether the whole body has arrived."""
        return self.body.received_bytes == len(self.body.data)


@dataclass(slots=True)
class PendingImage:
    """One image of one source.

    Frames with different stream headers or body lengths form separate candidates, at most `MAX_CANDIDATES`.

    Attributes:
        source: Modem address.
        image_id: Four characters 0-9A-Z.
        first_frame_s: Time of the first frame.
        last_frame_s: Time of the last frame that added something.
        wait_from_s: Start of the wait for more: `last_frame_s`, or earlier after the clock was set back.
        last_seen_s: Time of the last frame of any kind, or earlier after the clock was set back.
        candidates: In the order of their first frame.
        contact: The first contact record that arrived.
        conflicts: Frames that contradict others.
        version: Of the last update, 0 before the first.
        reported: State at the last update, None before the first.
        order: Rises with every frame of any image.
    """

    source: int
    image_id: str
    first_frame_s: float
    last_frame_s: float
    wait_from_s: float
    last_seen_s: float
    candidates: list[ImageCandidate] = field(default_factory=list)
    contact: ContactSummary | None = None
    conflicts: SavedCount = 0
    version: SavedCount = 0
    reported: ReportedState | None = None
    order: SavedCount = 0

    @property
    def best(self) -> ImageCandidate | None:
        """The candidate to report, None before the first half frame.

        The criteria, in this order: it has the size of the contact record (which has a checksum); most frames; most
        bytes; first to arrive.
        """
        return max(self.candidates, key=self._rank, default=None)

    def _rank(self, candidate: ImageCandidate) -> tuple[bool, int, int]:
        header, contact = candidate.header, self.contact
        agrees = contact is not None and (contact.height_px, contact.width_px) == (header.height_px, header.width_px)
        return agrees, candidate.frames, candidate.body.received_bytes

    @property
    def complete(self) -> bool:
        """Whether the whole body of the best candidate has arrived."""
        best = self.best
        return best is not None and best.complete

    @property
    def open(self) -> bool:
        """Whether more is known than the last update reported."""
        return self._state() != self.reported

    def _state(self) -> ReportedState:
        best = self.best
        if best is None:
            return -1, 0, self.contact is not None
        return self.candidates.index(best), best.body.received_bytes, self.contact is not None

    def add_half(self, frame: HalfFrame, now: float) -> FrameEffect:
        """Add a half frame."""
        self.last_seen_s = now
        agreeing = (c for c in self.candidates if c.header == frame.header and len(c.body.data) == frame.body_length)
        candidate = next(agreeing, None)
        if candidate is not self.best:
            self.conflicts += 1
        if candidate is None:
            if len(self.candidates) >= MAX_CANDIDATES:
                return FrameEffect.REJECTED
            candidate = ImageCandidate(frame.header, PartialBytes(bytearray(frame.body_length)), frames=0)
            self.candidates.append(candidate)
        added, conflict = candidate.body.write(frame.offset, frame.payload)
        self.conflicts += conflict
        if not added and candidate.frames:
            return FrameEffect.DUPLICATE
        candidate.frames += 1
        self.last_frame_s = self.wait_from_s = now
        return FrameEffect.ADDED

    def add_contact(self, contact: ContactSummary, now: float) -> FrameEffect:
        """Add a contact record; the image keeps the first one."""
        self.last_seen_s = now
        if self.contact is not None:
            self.conflicts += contact != self.contact
            return FrameEffect.DUPLICATE
        self.contact = contact
        self.last_frame_s = self.wait_from_s = now
        return FrameEffect.ADDED

    def next_update(self) -> ImageUpdate:
        """Return all that is known, as the next version."""
        self.version += 1
        self.reported = self._state()
        best = self.best
        header = b"" if best is None else best.header.pack()
        body = PartialBytes() if best is None else best.body
        gaps = gaps_within(body.received, 0, len(body.data))
        return ImageUpdate(
            source=self.source,
            image_id=self.image_id,
            version=self.version,
            contact=self.contact,
            stream=header + bytes(body.data),
            missing=tuple((start + len(header), stop + len(header)) for start, stop in gaps),
            complete=self.complete,
            received_bytes=body.received_bytes,
            total_bytes=len(body.data),
            frames=0 if best is None else best.frames,
            conflicts=self.conflicts,
            first_frame_s=self.first_frame_s,
            last_frame_s=self.last_frame_s,
        )


@dataclass(slots=True)
class PaperReceiverCounts:
    """Counters since the first start; they continue over restarts.

    Attributes:
        frames: Frames passed to `accept`.
        rejected: Of these, not of the wire format or rejected by their image.
        duplicates: Of these, without new content.
        conflicts: Contradictions between frames of an image.
        images: Updates with image data.
        complete_images: Of these, complete.
        contacts_only: Updates with a contact record only.
        evicted: Images deleted because `max_images` was reached.
    """

    frames: SavedCount = 0
    rejected: SavedCount = 0
    duplicates: SavedCount = 0
    conflicts: SavedCount = 0
    images: SavedCount = 0
    complete_images: SavedCount = 0
    contacts_only: SavedCount = 0
    evicted: SavedCount = 0


class PaperReceiver:
    """A `FrameReceiver` of the `paper` format.

    An image is *open* while more of it is known than the last update reported. The receiver reports an open image

    - immediately when its whole body has arrived;
    - when the first half frame of another image arrives from the same source (the rule of the paper), if the open image
      has a half frame itself. A contact frame does not trigger this: contact records can precede all images;
    - after `timeout_s` without a frame that adds something;
    - before it is deleted because `max_images` are stored.

    A reported image stays stored. Repeated frames are then duplicates, and a late frame that adds something opens the
    image again and leads to its next version. A late frame does not trigger a report of another image.

    Memory: at most `max_images` images, each with at most three bodies of 64 KiB. The image that was least recently
    seen is deleted first, images that are not open before the others.

    Attributes:
        counts: The counters.

    Args:
        timeout_s: Wait for more of an open image.
        max_images: Images to store, reported or not.
        memory_s: Time after its last frame at which an image is deleted. An identifier used again after that is a new
            image.

    Raises:
        ValueError: A time is not positive, `memory_s` is below `timeout_s`, or `max_images` is below 1.
    """

    def __init__(self, timeout_s: float, *, max_images: int = 64, memory_s: float = 6 * 3600.0) -> None:
        if not timeout_s > 0 or not memory_s >= timeout_s or max_images < 1:
            raise ValueError(
                f"timeout_s {timeout_s}, max_images {max_images}, memory_s {memory_s}: expected "
                "timeout_s > 0, max_images >= 1, memory_s >= timeout_s"
            )
        self._timeout_s = timeout_s
        self._max_images = max_images
        self._memory_s = memory_s
        self._images: dict[tuple[int, str], PendingImage] = {}  # the least recently seen first
        self.counts = PaperReceiverCounts()

    def accept(self, source: int, frame: bytes, now: float) -> list[Event]:
        """Process a frame; see `FrameReceiver.accept`."""
        now = float(now)
        events = self.poll(now)
        self.counts.frames += 1
        try:
            parsed = parse_frame(frame, f"acoustic frame from modem {source}")
        except FrameError as reason:
            self.counts.rejected += 1
            return [*events, FrameRejected(source, reason, now)]
        return events + self._add(source, parsed, now)

    def poll(self, now: float) -> list[Event]:
        """Return an update of every image whose wait has ended, the longest wait first.

        After the clock was set back, no image waits longer than `timeout_s` from the new time.
        """
        now = float(now)
        for image in self._images.values():
            image.wait_from_s = min(image.wait_from_s, now)
            image.last_seen_s = min(image.last_seen_s, now)
        due = [i for i in self._images.values() if i.open and i.wait_from_s + self._timeout_s <= now]
        events = self._report(sorted(due, key=lambda image: image.wait_from_s))
        for key, image in list(self._images.items()):
            if not image.open and image.last_seen_s + self._memory_s < now:
                del self._images[key]
        return events

    def next_deadline(self) -> float | None:
        """Return when the next wait ends, None when no image is open."""
        return min((i.wait_from_s + self._timeout_s for i in self._images.values() if i.open), default=None)

    @property
    def incomplete_images(self) -> int:
        """Number of stored images whose body has not arrived completely."""
        return sum(not image.complete for image in self._images.values())

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`: counters and images."""
        images = {f"image/{image.source}/{image.image_id}": pack_part(image) for image in self._images.values()}
        return {"counts": pack_part(self.counts), **images}

    def restore(self, parts: Parts) -> Errors:
        """Replace the state by saved parts; the settings stay. Return why parts were skipped."""
        reader = PartReader(parts, "paper receiver state")
        self.counts = reader.read("counts", PaperReceiverCounts) or PaperReceiverCounts()
        images = reader.read_group("image", PendingImage, apply=_check)
        self._images = {(i.source, i.image_id): i for i in sorted(images, key=lambda image: image.order)}
        return reader.errors

    def _add(self, source: int, frame: HalfFrame | ContactFrame, now: float) -> list[Event]:
        key = (source, frame.image_id)
        image = self._images.pop(key, None)
        events: list[Event] = []
        if isinstance(frame, HalfFrame) and (image is None or not image.candidates):
            events += self._report(i for i in self._images.values() if i.source == source and i.open and i.candidates)
        if image is None:
            events += self._make_room()
            image = PendingImage(source, frame.image_id, now, now, now, now)
        self._images[key] = image
        image.order = self.counts.frames
        earlier_conflicts = image.conflicts
        outcome = image.add_half(frame, now) if isinstance(frame, HalfFrame) else image.add_contact(frame.contact, now)
        self.counts.conflicts += image.conflicts - earlier_conflicts
        self.counts.duplicates += outcome is FrameEffect.DUPLICATE
        if outcome is FrameEffect.REJECTED:
            self.counts.rejected += 1
            reason = FrameError(
                f"acoustic frame from modem {source}",
                "stream header",
                f"another one for image {frame.image_id}",
                f"one of the {MAX_CANDIDATES} different ones of its earlier frames",
            )
            events.append(FrameRejected(source, reason, now))
        if image.open and image.complete:
            events += self._report([image])
        return events

    def _make_room(self) -> list[Event]:
        events: list[Event] = []
        while len(self._images) >= self._max_images:
            # Of the source with the most images: the least recently seen one that is not open, or else that of all.
            counts = Counter(source for source, _ in self._images)
            key = min(self._images, key=lambda k: (-counts[k[0]], self._images[k].open))
            image = self._images[key]
            if image.open:
                events += self._report([image])
            del self._images[key]
            self.counts.evicted += 1
        return events

    def _report(self, images: Iterable[PendingImage]) -> list[Event]:
        events: list[Event] = []
        for image in list(images):
            update = image.next_update()
            self.counts.images += bool(update.stream)
            self.counts.complete_images += bool(update.stream) and update.complete
            self.counts.contacts_only += not update.stream
            events.append(update)
        return events


def _check(image: PendingImage) -> None:
    """Raise FrameError if no frames can lead to this image."""
    if not is_image_id(image.image_id):
        raise FrameError("image", "image_id", image.image_id, "four characters 0-9A-Z")
    if len(image.candidates) > MAX_CANDIDATES or (not image.candidates and image.contact is None):
        raise FrameError("image", "candidates", len(image.candidates), f"0..{MAX_CANDIDATES}, or a contact record")
