"""What a host asks of its modem besides data cycles: pings, mini-packets, flexible data, and polls of other modems.

A request goes through three waits: for the modem's echo, for the end of the transmission, and for what the far side
answers. Each has its end, and a later sentence stands for the earlier ones that were lost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from sonarpost.errors import FrameError
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import FailureReason, RequestDone, RequestFailed
from sonarpost.modem.micromodem.fields import MAX_ADDRESS
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.rates import RATES
from sonarpost.modem.micromodem.sentences import Cycle
from sonarpost.modem.micromodem.settings import ErrorReport
from sonarpost.modem.micromodem.short_sentences import MAX_MINI_BITS, FlexibleData, MiniPacket, PingCommand

FLEXIBLE_RATES = (1, 3, 5)
FLEXIBLE_BYTES = 2048
_COMMAND_PARTS = ("NMEA",)


class RequestKind(Enum):
    """What is asked for."""

    PING = "ping"
    MINI_PACKET = "mini-packet"
    FLEXIBLE_DATA = "flexible data"
    POLL = "poll"


@dataclass(frozen=True, slots=True)
class ModemRequest:
    """A command to the modem that is no data cycle of its own.

    Attributes:
        request_id: Number of the request.
        kind: What it is.
        far: The other modem's address.
        command: What is sent to the modem.
        rate: Rate number; 0 for pings and mini-packets.
        queued_s: When it was handed over.
    """

    request_id: int
    kind: RequestKind
    far: int
    command: Sentence
    rate: int
    queued_s: float

    def failed(self, reason: FailureReason) -> RequestFailed:
        """Return the event that says so."""
        return RequestFailed(self.request_id, self.kind.value, self.far, reason)


def ping_command(src: int, dest: int) -> Sentence:
    """Return the command.

    Raises:
        FrameError: An address outside 0..127.
    """
    _check_address("ping", dest)
    return PingCommand(src, dest).sentence()


def mini_command(src: int, dest: int, bits: int) -> Sentence:
    """Return the command.

    Raises:
        FrameError: An address outside 0..127, or more than 13 bits.
    """
    _check_address("mini-packet", dest)
    if not 0 <= bits <= MAX_MINI_BITS:
        raise FrameError("mini-packet", "bits", bits, f"0..{MAX_MINI_BITS}")
    return MiniPacket(src, dest, bits).sentence()


def flexible_command(dest: int, rate: int, data: bytes) -> Sentence:
    """Return the command.

    Raises:
        FrameError: An address outside 0..127, a rate the protocol does not have, no data or too much.
    """
    _check_address("flexible data", dest)
    if rate not in FLEXIBLE_RATES:
        raise FrameError("flexible data", "rate", rate, f"one of {FLEXIBLE_RATES}")
    if not 1 <= len(data) <= FLEXIBLE_BYTES:
        raise FrameError("flexible data", "length", len(data), f"1..{FLEXIBLE_BYTES} bytes")
    return FlexibleData(dest, rate, data).sentence()


def poll_command(src: int, dest: int, rate: int, frames: int | None, *, ack: bool) -> Sentence:
    """Return the command.

    Args:
        src: The modem that shall send.
        dest: The modem it shall send to, usually the own one.
        rate: Rate number.
        frames: How many frames it shall send, None for all of a packet.
        ack: Whether it shall ask for acknowledgements.

    Raises:
        FrameError: An address outside 0..127, an unknown rate, or a number of frames it does not have.
    """
    _check_address("poll", src)
    _check_address("poll", dest)
    if rate not in RATES:
        raise FrameError("poll", "rate", rate, f"one of {sorted(RATES)}")
    count = RATES[rate].frames if frames is None else frames
    if not 1 <= count <= RATES[rate].frames:
        raise FrameError("poll", "frames", count, f"1..{RATES[rate].frames} frames at rate {rate}")
    return Cycle(src, dest, rate, ack, count).sentence()


def _check_address(where: str, address: int) -> None:
    if not 0 <= address <= MAX_ADDRESS:
        raise FrameError(where, "address", address, f"0..{MAX_ADDRESS}")


class _Stage(Enum):
    """What the exchange waits for."""

    ECHO = auto()
    ON_AIR = auto()
    ANSWER = auto()
    OVER = auto()


class RequestExchange:
    """Takes one request through the modem. When `result` is set it is over."""

    def __init__(
        self, request: ModemRequest, config: MicroModemConfig, send: Callable[[Sentence], None], now: float
    ) -> None:
        self.request = request
        self.result: RequestDone | RequestFailed | None = None
        self.deadline_s = now
        self._config = config
        self._send = send
        self._stage = _Stage.ECHO
        self._attempt = 0
        self.poll(now)

    def owns(self, cycle: Cycle) -> bool:
        """Tell whether a `CACYC` is the echo of this poll."""
        echo = cycle.sentence()
        return self.request.kind is RequestKind.POLL and self._stage is _Stage.ECHO and echo == self.request.command

    def on_echo(self, kind: str, now: float) -> None:
        """The modem has echoed a command of the given type (the kind without CC or CA)."""
        if self._stage is _Stage.ECHO and kind == self.request.command.kind[2:]:
            self._on_air(now)

    def on_transmission(self, *, ends: bool, now: float) -> None:
        """The modem starts or ends to transmit."""
        if self._stage is _Stage.ECHO and not ends:
            self._on_air(now)
        elif self._stage in {_Stage.ECHO, _Stage.ON_AIR} and ends:
            self._gone(now)

    def on_transmit_statistics(self, now: float) -> None:
        """The modem tells what it has sent, which is the end of it too."""
        if self._stage is _Stage.ON_AIR:
            self._gone(now)

    def on_answer(self, kind: RequestKind, src: int | None) -> None:
        """The far side has answered a ping or mini-packet, or sent the packet it was asked for."""
        if kind is self.request.kind and src == self.request.far and self._stage is not _Stage.OVER:
            self._finish()

    def on_no_answer(self) -> None:
        """The modem says that nothing came."""
        if self.request.kind is RequestKind.POLL and self._stage is _Stage.ANSWER:
            self._fail(FailureReason.NO_ANSWER)

    def on_complaint(self, complaint: ErrorReport, now: float) -> None:
        """The modem did not understand a sentence: the command, as long as its echo is not there."""
        if complaint.module in _COMMAND_PARTS and self._stage is _Stage.ECHO:
            self.deadline_s = now
            if self._attempt >= self._config.tries:
                self._fail(FailureReason.REFUSED)

    def abort(self, reason: FailureReason) -> RequestFailed:
        """End the exchange from outside."""
        self._fail(reason)
        assert isinstance(self.result, RequestFailed)
        return self.result

    def poll(self, now: float) -> None:
        """Do what is due: send again, or end the exchange."""
        if self.result is not None or now < self.deadline_s:
            return
        if self._stage is _Stage.ECHO and self._attempt < self._config.tries:
            self._attempt += 1
            self.deadline_s = now + self._config.reply_timeout_s
            self._send(self.request.command)
        elif self._stage is _Stage.ECHO:
            self._fail(FailureReason.NO_ECHO)
        elif self._stage is _Stage.ON_AIR:
            # Its end may have been lost, or this modem tells none for short packets.
            self._gone(now)
        else:
            self._fail(FailureReason.NO_ANSWER)

    def _on_air(self, now: float) -> None:
        self._stage = _Stage.ON_AIR
        flexible = self.request.kind is RequestKind.FLEXIBLE_DATA
        self.deadline_s = now + self._config.on_air_limit_s(self.request.rate if flexible else 0)

    def _gone(self, now: float) -> None:
        if self.request.kind is RequestKind.FLEXIBLE_DATA:
            self._finish()
            return
        self._stage = _Stage.ANSWER
        wait_s = self._config.ack_wait_s
        if self.request.kind is RequestKind.POLL:
            wait_s += self._config.poll_wait_s + self._config.on_air_limit_s(self.request.rate)
        self.deadline_s = now + wait_s

    def _finish(self) -> None:
        self.result = RequestDone(self.request.request_id, self.request.kind.value, self.request.far)
        self._stage = _Stage.OVER

    def _fail(self, reason: FailureReason) -> None:
        self.result = self.request.failed(reason)
        self._stage = _Stage.OVER
