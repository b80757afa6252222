"""The receiver of the `paper` wire format: pairs halves, gives out images, remembers the recent ones.

Pure: bytes and `now` in, events out. `now` is in seconds on a clock that goes on over a restart (UTC), because the
state can be saved and taken up by another process. docs/specifications/acoustic-paper.md gives the rules and their
reasons.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace

from sonarpost.errors import FrameError
from sonarpost.link.frames.paper.events import ContactOnly, Event, ImageReady, PaperFrameRejected
from sonarpost.link.frames.paper.frame import ContactFrame, HalfFrame, parse_frame
from sonarpost.link.frames.paper.pending_image import MAX_CANDIDATES, FrameOutcome, PendingImage
from sonarpost.link.frames.paper.state import export_image, import_image, read_field, read_list

__all__ = ["ContactOnly", "Event", "ImageReady", "PaperFrameRejected", "PaperReceiver", "PaperReceiverCounts"]

_STATE_FORMAT = 1
_Key = tuple[int, str]


@dataclass(frozen=True, slots=True)
class PaperReceiverCounts:
    """Counters since the beginning, restarts included.

    Attributes:
        frames: Frames handed to `accept`.
        rejected: Of these, not of the wire format or refused by their image.
        duplicates: Of these, without anything new.
        conflicts: Of these, in disagreement with other frames of their image.
        images: `ImageReady` events.
        complete_images: Of these, complete.
        contacts_only: `ContactOnly` events.
        evicted: Images forgotten early because `max_images` was reached.
    """

    frames: int = 0
    rejected: int = 0
    duplicates: int = 0
    conflicts: int = 0
    images: int = 0
    complete_images: int = 0
    contacts_only: int = 0
    evicted: int = 0


class PaperReceiver:
    """Puts images together from frames of any number of sources.

    An image that holds something not yet given out is *open*. It is given out

    - at once when its whole body is there;
    - when the first half frame of another image arrives from the same source (the paper's rule), if it has a half
      frame itself; a contact frame of another image does not do this, because contact records may be sent ahead of
      all pictures;
    - after `timeout_s` without a frame that adds anything;
    - when it must make room because `max_images` are remembered.

    An image that was given out is remembered, so that repetitions are known as such and late frames complete it:
    frames that add something open it again and lead to the next version. Late frames do not push out the image that
    is waiting.

    Memory: at most `max_images` images of at most three stream headers and 64 KiB each. The least recently heard are
    forgotten first, those without anything to give out before the others.

    Args:
        timeout_s: How long an open image waits for more.
        max_images: How many images, given out or not, are remembered.
        memory_s: How long an image is remembered after its last frame; an identifier used again after that is a
            new image.

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
        self._images: dict[_Key, PendingImage] = {}  # least recently heard first
        self._counts = PaperReceiverCounts()

    @property
    def counts(self) -> PaperReceiverCounts:
        """The counters."""
        return self._counts

    def accept(self, source: int, frame: bytes, now: float) -> list[Event]:
        """Take one frame; return what follows from it, after what `poll(now)` would have returned.

        Never raises because of `frame`: one that does not parse becomes a `PaperFrameRejected`.
        """
        now = float(now)
        events = self.poll(now)
        self._count(frames=1)
        try:
            parsed = parse_frame(frame, f"acoustic frame from modem {source}")
        except FrameError as reason:
            self._count(rejected=1)
            return [*events, PaperFrameRejected(source, reason, now)]
        return events + self._take(source, parsed, now)

    def poll(self, now: float) -> list[Event]:
        """Give out the images whose time is up at `now`, the longest waiting first.

        A clock that was set back does not make an image wait longer than `timeout_s` from then on.
        """
        now = float(now)  # a whole number would come back from a saved state as another type
        for image in self._images.values():
            image.news_at = min(image.news_at, now)
            image.heard_at = min(image.heard_at, now)
        due = [i for i in self._images.values() if i.open and i.news_at + self._timeout_s <= now]
        events = self._give_out(sorted(due, key=lambda image: image.news_at))
        for key, image in list(self._images.items()):
            if not image.open and image.heard_at + self._memory_s < now:
                del self._images[key]
        return events

    def next_deadline(self) -> float | None:
        """Return when `poll` will next have something to give out, None when nothing waits."""
        return min((i.news_at + self._timeout_s for i in self._images.values() if i.open), default=None)

    def snapshot(self) -> dict[str, object]:
        """Return the whole state as maps, lists, numbers, strings and bytes (msgpack can hold it)."""
        return {
            "format": _STATE_FORMAT,
            "images": [export_image(image) for image in self._images.values()],
            "counts": asdict(self._counts),
        }

    def restore(self, state: Mapping[str, object]) -> None:
        """Replace the whole state by one that `snapshot` returned; the settings stay those of this receiver.

        Raises:
            FrameError: The state is not one that `snapshot` made; the receiver is then as before.
        """
        if state.get("format") != _STATE_FORMAT:
            raise FrameError("receiver state", "format", state.get("format"), str(_STATE_FORMAT))
        images = [import_image(entry) for entry in read_list(state, "images")]
        counts = read_field(state, "counts", dict)
        restored = PaperReceiverCounts(**{name: read_field(counts, name, int) for name in asdict(self._counts)})
        self._images = {(image.source, image.image_id): image for image in images}
        self._counts = restored

    def _take(self, source: int, frame: HalfFrame | ContactFrame, now: float) -> list[Event]:
        key = (source, frame.image_id)
        image = self._images.pop(key, None)
        events: list[Event] = []
        if isinstance(frame, HalfFrame) and (image is None or not image.candidates):
            events += self._give_out(i for i in self._images.values() if i.source == source and i.open and i.candidates)
        if image is None:
            events += self._make_room()
            image = PendingImage(source, frame.image_id, now, now, now, now)
        self._images[key] = image  # last, as the most recently heard
        known_conflicts = image.conflicts
        outcome = image.add_half(frame, now) if isinstance(frame, HalfFrame) else image.add_contact(frame.contact, now)
        self._count(conflicts=image.conflicts - known_conflicts, duplicates=int(outcome is FrameOutcome.DUPLICATE))
        if outcome is FrameOutcome.REFUSED:
            self._count(rejected=1)
            reason = FrameError(
                f"acoustic frame from modem {source}",
                "stream header",
                f"another one for image {frame.image_id}",
                f"one of the {MAX_CANDIDATES} different ones it came with so far",
            )
            events.append(PaperFrameRejected(source, reason, now))
        if image.open and image.complete:
            events += self._give_out([image])
        return events

    def _make_room(self) -> list[Event]:
        events: list[Event] = []
        while len(self._images) >= self._max_images:
            key = min(self._images, key=lambda k: self._images[k].open)  # min is stable: the oldest not open, or oldest
            image = self._images[key]
            if image.open:
                events += self._give_out([image])
            del self._images[key]
            self._count(evicted=1)
        return events

    def _give_out(self, images: Iterable[PendingImage]) -> list[Event]:
        events: list[Event] = []
        for image in list(images):
            event = image.give_out()
            if isinstance(event, ImageReady):
                self._count(images=1, complete_images=int(event.complete))
            else:
                self._count(contacts_only=1)
            events.append(event)
        return events

    def _count(self, **more: int) -> None:
        added = {name: getattr(self._counts, name) + number for name, number in more.items()}
        self._counts = replace(self._counts, **added)
