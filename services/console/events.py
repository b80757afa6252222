"""Events for open pages: numbered and buffered, so that a page receives the events of an interruption afterwards."""

from __future__ import annotations

import json
import threading
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from sonarpost.limits import limit
from sonarpost.services.console.store.serialisers import Json

BUFFERED_EVENTS = 2000
MAX_BUFFERED_BYTES = limit(16_000_000, "bytes", "claims", "event stream", "vessel", "events", "the oldest end")


@dataclass(frozen=True, slots=True)
class PageEvent:
    """One event of the HTTP interface: number within one run of the server, type, JSON text."""

    number: int
    name: str
    data: str


class EventHub:
    """Distributes events to subscribers, from any thread.

    Events are numbered within one run. A page with an event identifier of another run reloads all data.
    """

    def __init__(self) -> None:
        self.run = uuid.uuid4().hex[:8]
        self._lock = threading.Lock()
        self._events: deque[PageEvent] = deque()
        self._bytes = 0
        self._last = 0
        self._subscribers: set[Callable[[], None]] = set()

    def publish(self, name: str, data: Json) -> None:
        """Add an event and notify the subscribers."""
        text = json.dumps(data, allow_nan=False, separators=(",", ":"))
        with self._lock:
            self._last += 1
            self._events.append(PageEvent(self._last, name, text))
            self._bytes += len(text)
            while len(self._events) > BUFFERED_EVENTS or (self._bytes > MAX_BUFFERED_BYTES and len(self._events) > 1):
                self._bytes -= len(self._events.popleft().data)
        self.notify_all()

    def subscribe(self, notify: Callable[[], None]) -> None:
        """Call `notify` at every event, from any thread; it must not block."""
        with self._lock:
            self._subscribers.add(notify)

    def unsubscribe(self, notify: Callable[[], None]) -> None:
        """Stop calling `notify`."""
        with self._lock:
            self._subscribers.discard(notify)

    def notify_all(self) -> None:
        """Notify the subscribers, also without an event, for example when the server stops."""
        with self._lock:
            subscribers = tuple(self._subscribers)
        for notify in subscribers:
            notify()

    @property
    def subscriber_count(self) -> int:
        """Number of subscribers."""
        with self._lock:
            return len(self._subscribers)

    @property
    def last(self) -> int:
        """Number of the last event, 0 before the first one."""
        with self._lock:
            return self._last

    def events_after(self, number: int) -> tuple[PageEvent, ...] | None:
        """Return the events after a number; None if some of them are no longer buffered."""
        with self._lock:
            if number > self._last or (self._events and number < self._events[0].number - 1):
                return None
            return tuple(event for event in self._events if event.number > number)

    def event_id(self, number: int) -> str:
        """Return the identifier of an event, which a page returns as `Last-Event-ID`."""
        return f"{self.run}-{number}"

    def parse_event_id(self, identifier: str) -> int | None:
        """Return the number in an event identifier; None if it is of another run."""
        run, _, number = identifier.partition("-")
        return int(number) if run == self.run and number.isdecimal() and len(number) < 16 else None
