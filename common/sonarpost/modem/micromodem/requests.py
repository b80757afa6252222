"""Requests other than data packets: pings, and polls of other modems.

A request waits for the modem's echo, for the end of the transmission and for the answer of the far modem. Every wait is
limited, and a later sentence implies the earlier ones that were lost. The functions that build commands raise
`FrameError` for values that the modem cannot send.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, StrEnum, auto

from sonarpost.errors import FrameError
from sonarpost.modem.interface import RequestDone, RequestFailed
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.nmea import MAX_ADDRESS, Sentence
from sonarpost.modem.micromodem.rates import RATES
from sonarpost.modem.micromodem.sentences import Cycle, ErrorReport, TransmitMark


class FailureReason(StrEnum):
    """Why a packet or request failed."""

    NO_ECHO = "no echo of the command (CACYC)"
    NO_DATA_REQUEST = "no data request for a frame (CADRQ)"
    NO_DATA_ECHO = "no confirmation of a frame's data (CATXD)"
    NO_TRANSMIT_START = "no start of the transmission (CATXP)"
    NO_TRANSMIT_END = "no end of the transmission (CATXF)"
    DATA_TIMEOUT = "the modem continued without the data of a frame"
    FRAME_REFUSED = "the modem accepts fewer bytes than the frame has"
    REBOOTED = "the modem restarted during the exchange"
    PORT_LOST = "the port to the modem was lost"
    QUEUE_FULL = "the driver's queue is full"
    NO_ANSWER = "no answer from the far modem"
    REFUSED = "the modem rejected the command"
    DEFERRED_TOO_LONG = "the modem or the channel was busy for too long"


class RequestKind(Enum):
    """Kind of a request."""

    PING = "ping"
    POLL = "poll"


@dataclass(frozen=True, slots=True)
class ModemRequest:
    """A queued request.

    Attributes:
        rate: Rate number; 0 for pings.
    """

    request_id: int
    kind: RequestKind
    peer: int
    command: Sentence
    rate: int
    queued_s: float

    def failed(self, reason: str) -> RequestFailed:
        """Return the event of a failed request."""
        return RequestFailed(self.request_id, self.kind.value, self.peer, reason)


def ping_command(src: int, dest: int) -> Sentence:
    """Return `CCMPC,src,dest`."""
    _check_address("ping", dest)
    return Sentence("CCMPC", (str(src), str(dest)))


def poll_command(src: int, dest: int, rate: int, frames: int | None, *, ack: bool) -> Sentence:
    """Return the `CCCYC` by which the modem `src` sends a packet to `dest`; without `frames`, a full packet."""
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
    """Runs one request. It is over when `result` is set."""

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
        self._sent_s = now
        self._refused = False  # the last attempt
        self.poll(now)

    def owns(self, cycle: Cycle) -> bool:
        """Return whether a `CACYC` is the echo of this poll."""
        is_poll = self.request.kind is RequestKind.POLL and self._stage is _Stage.ECHO
        return is_poll and cycle.sentence() == self.request.command

    def on_echo(self, kind: str, now: float) -> None:
        """Process the echo of a command, whose kind is given without CC or CA."""
        if self._stage is _Stage.ECHO and kind == self.request.command.kind[2:]:
            self._wait_on_air(now)

    def on_transmission(self, mark: TransmitMark, now: float) -> None:
        """Process the start or the end of a transmission."""
        if self._stage is _Stage.ECHO and not mark.ends:
            self._wait_on_air(now)
        elif self._stage in {_Stage.ECHO, _Stage.ON_AIR} and mark.ends:
            self._transmitted(now)

    def on_statistics(self, _packet_type: int | None, now: float) -> None:
        """Process `CAXST`, which implies the end of the transmission."""
        if self._stage is _Stage.ON_AIR:
            self._transmitted(now)

    def on_answer(self, kind: RequestKind, src: int | None) -> None:
        """Process an answer of the far modem: to a ping, or the packet of a poll."""
        if kind is self.request.kind and src == self.request.peer and self._stage is not _Stage.OVER:
            self._finish()

    def on_no_answer(self) -> None:
        """Process the modem's report that no packet followed the poll."""
        if self.request.kind is RequestKind.POLL and self._stage is _Stage.ANSWER:
            self.abort(FailureReason.NO_ANSWER)

    def on_error(self, report: ErrorReport, now: float) -> None:
        """Process an error before the echo: the modem rejects the command."""
        is_poll = self.request.kind is RequestKind.POLL
        if self._stage is _Stage.ECHO and (report.module == "NMEA" or is_poll):
            self._refused = True
            self.deadline_s = min(self.deadline_s, now + self._config.refused_wait_s)

    def on_setting(self, now: float) -> None:
        """Process `CACFG`: during a configuration dump the modem answers late."""
        if self._stage is _Stage.ECHO:
            latest_s = self._sent_s + self._config.dump_limit_s
            self.deadline_s = max(self.deadline_s, min(now + self._config.dump_quiet_s, latest_s))

    def abort(self, reason: FailureReason) -> RequestFailed:
        """End the exchange as failed and return the event."""
        failed = self.request.failed(reason)
        self.result = failed
        self._stage = _Stage.OVER
        return failed

    def poll(self, now: float) -> None:
        """Do what is due: send again, or end the exchange."""
        if self.result is not None or now < self.deadline_s:
            return
        if self._stage is _Stage.ECHO and self._attempt < self._config.tries:
            self._attempt += 1
            self._refused = False
            self._sent_s = now
            self.deadline_s = now + self._config.reply_timeout_s
            self._send(self.request.command)
        elif self._stage is _Stage.ECHO:
            self.abort(FailureReason.REFUSED if self._refused else FailureReason.NO_ECHO)
        elif self._stage is _Stage.ON_AIR:
            # CATXF may have been lost, or this modem sends none for short packets.
            self._transmitted(now)
        else:
            self.abort(FailureReason.NO_ANSWER)

    def _wait_on_air(self, now: float) -> None:
        self._stage = _Stage.ON_AIR
        self.deadline_s = now + self._config.on_air_limit_s(0)

    def _transmitted(self, now: float) -> None:
        self._stage = _Stage.ANSWER
        wait_s = self._config.ack_wait_s
        if self.request.kind is RequestKind.POLL:
            wait_s += self._config.poll_wait_s + self._config.on_air_limit_s(self.request.rate)
        self.deadline_s = now + wait_s

    def _finish(self) -> None:
        self.result = RequestDone(self.request.request_id, self.request.kind.value, self.request.peer)
        self._stage = _Stage.OVER
