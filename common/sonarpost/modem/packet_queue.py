"""Queue of packets and requests of a driver, limited in number and in age, and the drivers that have one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Generic, Protocol, TypeVar

from typing_extensions import override

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import (
    Modem,
    ModemCapabilities,
    ModemEvent,
    PacketFailed,
    PacketSent,
    SentenceRejected,
)
from sonarpost.modem.registry import ModemSettings

QUEUED_PACKETS: Final = 8
MAX_DEFER_S: Final = 120.0
_FULL: Final = "the driver's queue is full"
_EXPIRED: Final = "the modem or the channel was busy for too long"
S = TypeVar("S")
M = TypeVar("M")


@dataclass(frozen=True, slots=True)
class WaitingPacket:
    """A packet that waits for its transmission.

    Attributes:
        number: Its `packet_id`.
        queued_s: When it was queued.
    """

    number: int
    destination: int
    rate: int
    frames: tuple[bytes, ...]
    ack: bool
    queued_s: float

    def failed(self, reason: str, *, maybe_sent: bool = False) -> PacketFailed:
        """Return the event of a packet that was not sent."""
        return PacketFailed(self.number, self.destination, self.rate, self.frames, reason, maybe_sent)

    def sent(
        self, acknowledged: Sequence[int], started_s: float, finished_s: float, *, end_reported: bool = True
    ) -> PacketSent:
        """Return the event of a packet that was transmitted."""
        which = (self.number, self.destination, self.rate, self.frames)
        return PacketSent(*which, tuple(acknowledged), started_s, finished_s, end_reported)


class Waiting(Protocol):
    """A packet or request in a queue; `queued_s` is when it was queued."""

    @property
    def queued_s(self) -> float: ...  # noqa: D102


W = TypeVar("W", bound=Waiting)


class PacketQueue(Generic[W]):
    """Packets and requests in the order of their arrival.

    Args:
        limit: Greatest number of them.
        max_age_s: Longest wait; one that is older has failed.
    """

    def __init__(self, limit: int = QUEUED_PACKETS, max_age_s: float = MAX_DEFER_S) -> None:
        self._limit = limit
        self._max_age_s = max_age_s
        self._waiting: deque[W] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, item: W) -> bool:
        """Add a packet or request; return False when the queue is full."""
        if len(self._waiting) >= self._limit:
            return False
        self._waiting.append(item)
        return True

    def take(self) -> W | None:
        """Remove and return the next one, None without one."""
        return self._waiting.popleft() if self._waiting else None

    def expire(self, now: float) -> list[W]:
        """Remove and return those that have waited too long."""
        expired = []
        while self._waiting and now >= self._waiting[0].queued_s + self._max_age_s:
            expired.append(self._waiting.popleft())
        return expired

    def deadline_s(self) -> float | None:
        """Return when the next one has waited too long, None without one."""
        return self._waiting[0].queued_s + self._max_age_s if self._waiting else None


class Assembler(ABC, Generic[M]):
    """Divides the bytes of a stream into messages. Its buffer holds at most one incomplete message."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def incomplete(self) -> bool:
        """Whether the beginning of a message waits for its end."""
        return bool(self._buffer)

    def feed(self, data: bytes) -> list[M | SentenceError]:
        """Return the messages that are complete now, and an error for each run of bytes that is none."""
        self._buffer += data
        return self._messages()

    def abandon(self) -> list[M | SentenceError]:
        """Give up the incomplete message; return what its bytes contain."""
        self.reset()
        return []

    def reset(self) -> None:
        """Drop an incomplete message."""
        self._buffer.clear()

    @abstractmethod
    def _messages(self) -> list[M | SentenceError]:
        """Remove and return the messages that are complete, and errors."""


class QueueingModem(Modem, Generic[S, M]):
    """Base class of drivers with a `PacketQueue`, which have one packet or request in progress, `_sending`.

    A subclass starts packets and requests in `_advance` and puts what it sends into `_out`, one part for each write.

    Args:
        capabilities: Capabilities of the modem.
        settings: Settings of the driver.
        where: Names the port in errors.
        assembler: Divides received bytes.
        pause_s: After such a pause an incomplete message is given up.

    Raises:
        ConfigError: The modem does not have the address.
    """

    def __init__(
        self,
        capabilities: ModemCapabilities,
        settings: ModemSettings,
        where: str,
        assembler: Assembler[M],
        pause_s: float,
    ) -> None:
        capabilities.check_address(settings.address, where)
        self._capabilities = capabilities
        self._settings = settings
        self._assembler = assembler
        self._pause_s = pause_s
        self._queue: PacketQueue[WaitingPacket] = PacketQueue()
        self._sending: S | None = None
        self._next_id = 1
        self._is_open = False
        self._received_s = 0.0
        self._out: list[bytes] = []
        self._events: list[ModemEvent] = []
        self._events_since_s = 0.0

    @property
    @override
    def capabilities(self) -> ModemCapabilities:
        return self._capabilities

    @property
    @override
    def queued(self) -> int:
        return len(self._queue) + (self._sending is not None)

    @property
    @override
    def receiving(self) -> bool:
        """False: the modem does not report the start of a reception."""
        return False

    @override
    def port_opened(self, now: float) -> None:
        if self._is_open:
            self.port_lost(now)
        self._is_open = True
        self._begin(now)
        self._advance(now)

    @override
    def port_lost(self, now: float) -> None:
        self._is_open = False
        self._end()
        self._out.clear()
        self._assembler.reset()
        self._events_since_s = now

    @override
    def send_packet(
        self, destination: int, rate: int, frames: Sequence[bytes], *, ack: bool = False, now: float
    ) -> int:
        """Queue a packet; see `Modem.send_packet`. A broadcast is not acknowledged."""
        self._capabilities.check_packet(destination, rate, frames)
        ack = ack and destination != self._capabilities.broadcast
        return self._add(destination, rate, frames, ack=ack, now=now)

    @override
    def receive(self, data: bytes, now: float) -> list[ModemEvent]:
        self._give_up_incomplete(now)
        self._received_s = now
        if self._is_open:
            self._process(self._divided(data), now)
        self._advance(now)
        return self._take_events()

    @override
    def poll(self, now: float) -> list[ModemEvent]:
        self._advance(now)
        return self._take_events()

    @override
    def next_wakeup(self) -> float | None:
        times_s = [*self._deadlines_s(), self._queue.deadline_s()]
        if self._events:
            times_s.append(self._events_since_s)
        if self._assembler.incomplete:
            times_s.append(self._received_s + self._pause_s)
        return min((time_s for time_s in times_s if time_s is not None), default=None)

    @override
    def bytes_to_send(self) -> bytes:
        return self._out.pop(0) if self._out else b""

    def _begin(self, now: float) -> None:
        """Begin the dialogue with the modem: the port was opened."""

    def _end(self) -> None:
        """End the dialogue with the modem: the port was lost."""

    def _deadlines_s(self) -> Iterable[float | None]:
        """Return the times at which `_advance` has something to do."""
        return ()

    def _on_message(self, message: M, now: float) -> None:
        """Process a message."""

    def _advance(self, now: float) -> None:
        """Do what is due; subclasses extend it."""
        self._give_up_incomplete(now)
        self._events_since_s = now
        self._events += [self._result(packet.failed(_EXPIRED)) for packet in self._queue.expire(now)]

    def _divided(self, data: bytes) -> Sequence[M | SentenceError]:
        return self._assembler.feed(data)

    def _give_up_incomplete(self, now: float) -> None:
        if self._assembler.incomplete and now >= self._received_s + self._pause_s:
            self._process(self._assembler.abandon(), now)

    def _process(self, items: Sequence[M | SentenceError], now: float) -> None:
        for item in items:
            if isinstance(item, SentenceError):
                self._events.append(SentenceRejected(item))
            else:
                self._on_message(item, now)

    def _add(self, destination: int, rate: int, frames: Sequence[bytes], *, ack: bool, now: float) -> int:
        number, self._next_id = self._next_id, self._next_id + 1
        packet = WaitingPacket(number, destination, rate, tuple(map(bytes, frames)), ack, now)
        if not self._queue.add(packet):
            self._events.append(self._result(packet.failed(_FULL)))
        self._advance(now)
        return number

    def _result(self, failed: PacketFailed) -> ModemEvent:
        """Return the event of a packet that has failed."""
        return failed

    def _take_events(self) -> list[ModemEvent]:
        events, self._events = self._events, []
        return events
