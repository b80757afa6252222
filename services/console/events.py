"""Events for the pages that are open: numbered, kept for a while, so that a page that was cut off misses nothing."""

from __future__ import annotations

import json
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

Json = dict[str, object]

KEPT = 2000


@dataclass(frozen=True, slots=True)
class Event:
    """One event as it goes to a page.

    Attributes:
        number: Of this run of the server, from 1.
        name: As in the interface's description.
        data: JSON text.
    """

    number: int
    name: str
    data: str


class Hub:
    """Gives events to whoever listens, from any thread.

    Events are numbered within one run; an identifier of another run is not known here, and its page loads anew.
    """

    def __init__(self, kept: int = KEPT) -> None:
        self.run = uuid.uuid4().hex[:8]
        self._lock = threading.Lock()
        self._events: deque[Event] = deque(maxlen=kept)
        self._last = 0
        self._listeners: dict[int, Callable[[], None]] = {}
        self._next_listener = 0

    def publish(self, name: str, data: Json) -> None:
        """Add an event and wake the listeners."""
        text = json.dumps(data, allow_nan=False, separators=(",", ":"))
        with self._lock:
            self._last += 1
            self._events.append(Event(self._last, name, text))
            listeners = tuple(self._listeners.values())
        for wake in listeners:
            wake()

    def listen(self, wake: Callable[[], None]) -> int:
        """Call `wake`, from any thread and without delay, at every event; return a number for `leave`."""
        with self._lock:
            self._next_listener += 1
            self._listeners[self._next_listener] = wake
            return self._next_listener

    def leave(self, listener: int) -> None:
        """Wake a listener no more."""
        with self._lock:
            self._listeners.pop(listener, None)

    def wake_all(self) -> None:
        """Wake the listeners without an event, for the end."""
        with self._lock:
            listeners = tuple(self._listeners.values())
        for wake in listeners:
            wake()

    @property
    def listeners(self) -> int:
        """How many pages listen."""
        with self._lock:
            return len(self._listeners)

    @property
    def last(self) -> int:
        """Number of the last event, 0 before the first."""
        with self._lock:
            return self._last

    def since(self, number: int) -> tuple[Event, ...] | None:
        """Return the events after a number; None where some of them are not kept any more."""
        with self._lock:
            if number > self._last or (self._events and number < self._events[0].number - 1):
                return None
            return tuple(event for event in self._events if event.number > number)

    def identifier(self, number: int) -> str:
        """Return an event's identifier, which a page gives back as `Last-Event-ID`."""
        return f"{self.run}-{number}"

    def number_of(self, identifier: str) -> int | None:
        """Return the number in an identifier of this run, None for another's."""
        run, _, number = identifier.partition("-")
        return int(number) if run == self.run and number.isdecimal() and len(number) < 16 else None


class Pace:
    """Lets something happen so often and no more, for each of several names."""

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self._last: dict[str, float] = {}

    def allows(self, name: str, now_s: float | None = None) -> bool:
        """Tell whether it is time again for a name, and if so begin its time anew."""
        now = time.monotonic() if now_s is None else now_s
        if now - self._last.get(name, -self._every_s) < self._every_s:
            return False
        self._last[name] = now
        return True
