"""The receiver of the v1 format: frames in, contacts, pictures and messages out, and what it lacks.

Pure: bytes and `now` in, events out. `now` is in seconds on a clock that goes on over a restart (UTC), because the
state can be saved and taken up by another process.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.events import ContactUpdate, Event, FeedbackReceived, FrameRefused, MessageReceived
from sonarpost.link.frames.v1.feedback import Feedback, FeedbackRequest, pack_mini
from sonarpost.link.frames.v1.frame import FrameProtection, Segment, SegmentKind, Symbol, parse_frame, parse_symbol
from sonarpost.link.frames.v1.payload_objects import MessageObject
from sonarpost.link.frames.v1.preview import Preview
from sonarpost.link.peer_state import PeerState
from sonarpost.link.receiver_state import export_source, import_source, read_list, read_map

_STATE_FORMAT = 1


@dataclass(frozen=True, slots=True)
class ReceiverCounts:
    """Counters since the beginning, restarts included.

    Attributes:
        frames: Frames handed to `accept`.
        refused: Of these, damaged or not of this format, as a whole or in part.
        updates: `ContactUpdate` events.
        complete: Of these, complete.
        messages: `MessageReceived` events.
        reports: `FeedbackReceived` events.
        forgotten_sources: Senders forgotten because `max_sources` was reached.
    """

    frames: int = 0
    refused: int = 0
    updates: int = 0
    complete: int = 0
    messages: int = 0
    reports: int = 0
    forgotten_sources: int = 0


class LinkReceiver:
    """Receives from any number of senders.

    Memory: at most `max_sources` senders; of each at most 32 blocks of 255 symbols, `max_contacts` contacts of 64 KiB.

    Args:
        config: Bounds and times.
        seal: Authenticates frames.
    """

    def __init__(self, config: ReceiverConfig | None = None, *, seal: FrameProtection | None = None) -> None:
        self.config = config or ReceiverConfig()
        self._seal = seal
        self._sources: dict[int, PeerState] = {}  # least recently heard first
        self._counts = ReceiverCounts()

    @property
    def counts(self) -> ReceiverCounts:
        """The counters."""
        return self._counts

    @property
    def sources(self) -> tuple[int, ...]:
        """Modem addresses of the senders that are remembered, the least recently heard first."""
        return tuple(self._sources)

    def accept(self, source: int, frame: bytes, now: float) -> list[Event]:
        """Take a frame; return what follows from it.

        Never raises because of `frame`: what does not parse becomes a `FrameRefused`.
        """
        now = float(now)
        self._count(frames=1)
        where = f"acoustic frame from modem {source}"
        try:
            content = parse_frame(frame, source, self._seal, where)
        except FrameError as reason:
            self._count(refused=1)
            return [FrameRefused(source, reason, now)]
        sender = self._sender(source, now)
        events: list[Event] = []
        for item in [content] if isinstance(content, Symbol) else content:
            try:
                events += self._take(sender, item, now, where)
            except BadInputError as error:
                told = error if isinstance(error, FrameError) else _as_frame_error(error, where)
                self._count(refused=1)
                events.append(FrameRefused(source, told, now))
        self._count_events(events)
        return events

    def _take(self, sender: PeerState, item: Symbol | Segment, now: float, where: str) -> list[Event]:
        if isinstance(item, Symbol):
            return sender.add_symbol(item, now, self.config)
        match item.kind:
            case SegmentKind.SYMBOL:
                return sender.add_symbol(parse_symbol(item.data, where), now, self.config)
            case SegmentKind.MESSAGE if len(item.data) > 1:
                return sender.add_message(MessageObject(item.data[0], item.data[1:]), now)
            case SegmentKind.CONTACT | SegmentKind.PREVIEW:
                return sender.add_found(Preview.unpack(item.data, where), now, self.config)
            case SegmentKind.FEEDBACK:
                return [FeedbackReceived(sender.address, Feedback.unpack(item.data, where), now)]
            case SegmentKind.REQUEST:
                return [FeedbackReceived(sender.address, FeedbackRequest.unpack(item.data, where), now)]
            case _:
                raise FrameError(where, "segment kind", item.kind, "1..6, a message not empty")

    def _sender(self, source: int, now: float) -> PeerState:
        found = self._sources.pop(source, None)
        if found is None:
            while len(self._sources) >= self.config.max_sources:
                del self._sources[next(iter(self._sources))]
                self._count(forgotten_sources=1)
            found = PeerState(source, now, reported_at=now)
        self._sources[source] = found
        found.heard_at = now
        found.frames += 1
        found.reported_at = min(found.reported_at, now)
        found.forget_old(now, self.config)
        return found

    def report(self, source: int, now: float) -> Feedback | None:
        """Return what to tell a sender of what is lacking, None while nothing of it was heard."""
        found = self._sources.get(source)
        return None if found is None else found.report(float(now))

    def report_is_due(self, source: int, now: float) -> bool:
        """Whether a report would be of use now."""
        found = self._sources.get(source)
        return found is not None and found.report_is_due(now, self.config)

    def mini_report(self, source: int) -> int | None:
        """Return 13 bits for a mini-packet: the oldest block that lacks something; None when none does."""
        found = self._sources.get(source)
        if found is None or not found.is_lacking:
            return None
        report = Feedback(found.newest, 0, found.needs)
        back = max(i for i, need in enumerate(report.needs) if need)
        return pack_mini((report.newest - back) % 32, report.needs[back])

    def snapshot(self) -> dict[str, object]:
        """Return the whole state as maps, lists, numbers, strings and bytes (msgpack can hold it)."""
        return {
            "format": _STATE_FORMAT,
            "sources": [export_source(source) for source in self._sources.values()],
            "counts": asdict(self._counts),
        }

    def restore(self, state: Mapping[str, object]) -> None:
        """Replace the whole state by one that `snapshot` returned; the settings stay those of this receiver.

        Raises:
            FrameError: The state is not one that `snapshot` made; the receiver is then as before.
        """
        if state.get("format") != _STATE_FORMAT:
            raise FrameError("receiver state", "format", state.get("format"), str(_STATE_FORMAT))
        sources = [import_source(entry) for entry in read_list(state, "sources")]
        counts = read_map(state, "counts")
        if set(counts) != set(asdict(self._counts)) or not all(type(n) is int and n >= 0 for n in counts.values()):
            raise FrameError("receiver state", "counts", dict(counts), f"numbers for {sorted(asdict(self._counts))}")
        self._sources = {source.address: source for source in sources}
        self._counts = replace(ReceiverCounts(), **{name: n for name, n in counts.items() if isinstance(n, int)})

    def _count_events(self, events: list[Event]) -> None:
        updates = [e for e in events if isinstance(e, ContactUpdate)]
        self._count(
            updates=len(updates),
            complete=sum(e.complete for e in updates),
            messages=sum(isinstance(e, MessageReceived) for e in events),
            reports=sum(isinstance(e, FeedbackReceived) for e in events),
        )

    def _count(self, **more: int) -> None:
        added = {name: getattr(self._counts, name) + number for name, number in more.items()}
        self._counts = replace(self._counts, **added)


def _as_frame_error(error: BadInputError, where: str) -> FrameError:
    return FrameError(where, error.field, error.value, error.expected)
