"""Events for open pages: numbered and buffered, so that a page receives the events of an interruption afterwards."""

from __future__ import annotations

import json
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from sonarpost.services.console.store.serialisers import Json

BUFFERED_EVENTS = 2000


@dataclass(frozen=True, slots=True)
class Event:
    """One event of the HTTP interface: number within one run of the server, type, JSON text."""

    number: int
    name: str
    data: str


class EventHub:
    """Distributes events to subscribers, from any thread.

    Events are numbered within one run. A page with an event identifier of another run reloads all data.
    """

    def __init__(self, buffered: int = BUFFERED_EVENTS) -> None:
        self.run = uuid.uuid4().hex[:8]
        self._lock = threading.Lock()
        self._events: deque[Event] = deque(maxlen=buffered)
        self._last = 0
        self._subscribers: set[Callable[[], None]] = set()

    def publish(self, name: str, data: Json) -> None:
        """Add an event and notify the subscribers."""
        text = json.dumps(data, allow_nan=False, separators=(",", ":"))
        with self._lock:
            self._last += 1
            self._events.append(Event(self._last, name, text))
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

    def events_after(self, number: int) -> tuple[Event, ...] | None:
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


class RateLimiter:
    """Limits how often something happens, separately for each name."""

    def __init__(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self._last_s: dict[str, float] = {}

    def allows(self, name: str, now_s: float | None = None) -> bool:
        """Return whether the interval since the last permitted call for this name has passed; `now_s` is monotonic."""
        now = time.monotonic() if now_s is None else now_s
        if now - self._last_s.get(name, -self._interval_s) < self._interval_s:
            return False
        self._last_s[name] = now
        return True
