"""One transmit cycle as its master: command, requests, data, transmission, statistics, acknowledgements."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import ClassVar

from sonarpost.errors import FrameError
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import FailureReason, PacketFailed, PacketSent
from sonarpost.modem.micromodem.fields import MAX_ADDRESS
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.rates import RATES
from sonarpost.modem.micromodem.sentences import (
    Acknowledgement,
    Cycle,
    DataAccepted,
    DataRequest,
    TransmitData,
    TransmitMark,
)
from sonarpost.modem.micromodem.settings import ErrorReport
from sonarpost.modem.micromodem.statistics import TransmitStatistics

_FSK_MINI_PACKET = 2


@dataclass(frozen=True, slots=True)
class OutgoingPacket:
    """A packet to send.

    Attributes:
        packet_id: Number of the packet.
        dest: Address meant.
        rate: Rate number.
        frames: Their bytes.
        ack: Whether to ask for acknowledgements.
        queued_s: When it was handed over.
    """

    packet_id: int
    dest: int
    rate: int
    frames: tuple[bytes, ...]
    ack: bool
    queued_s: float

    def failed(self, reason: FailureReason, *, maybe_sent: bool = False) -> PacketFailed:
        """Return the event that says so."""
        return PacketFailed(self.packet_id, self.dest, self.rate, self.frames, reason, maybe_sent)


def check_packet(destination: int, rate: int, frames: Sequence[bytes]) -> None:
    """Refuse what the modem cannot send.

    Raises:
        FrameError: An address outside 0..127, an unknown rate, no frame, more frames or longer ones than the rate has.
    """
    where = "packet to send"
    if not 0 <= destination <= MAX_ADDRESS:
        raise FrameError(where, "destination", destination, f"0..{MAX_ADDRESS}")
    if rate not in RATES:
        raise FrameError(where, "rate", rate, f"one of {sorted(RATES)}")
    limit = RATES[rate]
    if not 1 <= len(frames) <= limit.frames:
        raise FrameError(where, "frames", len(frames), f"1..{limit.frames} frames at rate {rate}")
    for number, frame in enumerate(frames, start=1):
        if len(frame) > limit.frame_bytes:
            expected = f"at most {limit.frame_bytes} bytes at rate {rate}"
            raise FrameError(where, f"length of frame {number}", len(frame), expected)


class TransmitStage(Enum):
    """What the cycle waits for."""

    ECHO = auto()
    REQUEST = auto()
    DATA_ECHO = auto()
    ON_AIR = auto()
    STATISTICS = auto()
    ACKNOWLEDGEMENT = auto()
    OVER = auto()


class TransmitCycle:
    """Takes one packet through the modem. When `result` is set the cycle is over, whatever was lost on the way.

    The host's own command starts it or, with `polled`, that of another modem which asks for data.

    A later sentence stands for the earlier ones that must have gone before it: a lost echo does no harm. A cycle
    command without an answer is sent again, a frame when the modem asks again, and every wait has its end.
    """

    def __init__(
        self,
        packet: OutgoingPacket,
        config: MicroModemConfig,
        send: Callable[[Sentence], None],
        now: float,
        polled: Cycle | None = None,
    ) -> None:
        self.packet = packet
        self.result: PacketSent | PacketFailed | None = None
        self.stage = TransmitStage.ECHO
        self.deadline_s = now
        self._config = config
        self._send = send
        self._cycle = polled or Cycle(config.address, packet.dest, packet.rate, packet.ack, len(packet.frames))
        self._started_s = now
        self._attempt = 0
        self._frame_number = 0
        self._given: set[int] = set()
        self._acknowledged: set[int] = set()
        self._on_air = False
        self._statistics: TransmitStatistics | None = None
        if polled is None:
            self.poll(now)
        else:
            self._wait(TransmitStage.REQUEST, now, config.request_timeout_s)

    def owns(self, cycle: Cycle) -> bool:
        """Tell whether a `CACYC` is the echo of this cycle's command."""
        return cycle == self._cycle

    def on_echo(self, now: float) -> None:
        """The modem has echoed the cycle command."""
        if self.stage is TransmitStage.ECHO:
            # At rate 0 a mini-packet that announces the cycle goes on the air before the first request.
            announcement_s = self._config.on_air_limit_s(0) if self.packet.rate == 0 else 0.0
            self._wait(TransmitStage.REQUEST, now, self._config.request_timeout_s + announcement_s)

    def on_request(self, request: DataRequest, now: float) -> None:
        """The modem asks for a frame: answer, again if it asks again."""
        # A modem that was polled for more frames than there are asks on when all have been given.
        asking = self.stage is TransmitStage.ON_AIR and not self._on_air
        if not asking and self.stage not in {TransmitStage.ECHO, TransmitStage.REQUEST, TransmitStage.DATA_ECHO}:
            return
        number = request.frame_number
        frame = self._frame(number)
        if len(frame) > request.max_bytes:
            self._send(self._data(b""))
            self._fail(FailureReason.FRAME_REFUSED)
            return
        self._frame_number = number
        self._given.add(number)
        self._send(self._data(frame))
        self._wait(TransmitStage.DATA_ECHO, now, self._config.reply_timeout_s)

    def on_data_accepted(self, accepted: DataAccepted, now: float) -> None:
        """The modem has taken a frame, or not all of it."""
        if self.stage is not TransmitStage.DATA_ECHO:
            return
        if accepted.nbytes != len(self._frame(self._frame_number)):
            self._fail(FailureReason.FRAME_REFUSED)
        elif self._missing():
            self._wait(TransmitStage.REQUEST, now, self._config.request_timeout_s)
        else:
            self._wait_for_transmission(now)

    def on_transmission(self, mark: TransmitMark, now: float) -> None:
        """The modem starts or ends to transmit: the packet, or at rate 0 before any data its announcement."""
        if self._given and mark.nbytes == 0 and any(self.packet.frames):
            return  # an answer that the modem gives by itself
        if not self._given:
            on_air_s = self._config.on_air_limit_s(self.packet.rate)
            self.deadline_s = max(self.deadline_s, now + self._config.request_timeout_s + on_air_s)
        elif self.stage in {TransmitStage.REQUEST, TransmitStage.DATA_ECHO, TransmitStage.ON_AIR}:
            self._on_air = True
            if mark.ends:
                self._wait(TransmitStage.STATISTICS, now, self._config.statistics_timeout_s)
            else:
                self._wait(TransmitStage.ON_AIR, now, self._config.on_air_limit_s(self.packet.rate))

    def on_statistics(self, statistics: TransmitStatistics | None, now: float) -> None:
        """The modem tells what it has sent (None: it did, in a form nobody can read)."""
        announcement = statistics is not None and statistics.packet_type == _FSK_MINI_PACKET
        if announcement or not self._given:
            return
        if self.stage in {TransmitStage.DATA_ECHO, TransmitStage.ON_AIR, TransmitStage.STATISTICS}:
            self._on_air = True
            self._statistics = statistics
            self._transmitted(now)

    def on_acknowledgement(self, acknowledgement: Acknowledgement, now: float) -> None:
        """The far side has a frame."""
        number = acknowledgement.frame_number
        if acknowledgement.src != self.packet.dest or not self._on_air or not acknowledgement.good:
            return
        if 1 <= number <= len(self.packet.frames):
            self._acknowledged.add(number)
        if self.stage is TransmitStage.ACKNOWLEDGEMENT and len(self._acknowledged) == len(self.packet.frames):
            self._finish(now)

    def on_complaint(self, complaint: ErrorReport) -> None:
        """The modem has given up waiting for data."""
        if complaint.data_timeout and self.stage in {TransmitStage.REQUEST, TransmitStage.DATA_ECHO}:
            self._fail(FailureReason.DATA_TIMEOUT)

    def abort(self, reason: FailureReason) -> PacketFailed:
        """End the cycle from outside (the modem restarted, the port went away)."""
        self._fail(reason)
        assert isinstance(self.result, PacketFailed)
        return self.result

    def poll(self, now: float) -> None:
        """Do what is due: send again, or end the cycle."""
        if self.result is None and now >= self.deadline_s:
            self._WHEN_LATE[self.stage](self, now)

    def _echo_late(self, now: float) -> None:
        if self._attempt >= self._config.tries:
            self._fail(FailureReason.NO_ECHO)
            return
        self._attempt += 1
        self._send(self._cycle.sentence())
        self._wait(TransmitStage.ECHO, now, self._config.reply_timeout_s)

    def _request_late(self, now: float) -> None:
        self._fail(FailureReason.NO_DATA_REQUEST)

    def _data_echo_late(self, now: float) -> None:
        # Not sent again unasked: a modem whose echo is only late would take it for the next frame.
        self._fail(FailureReason.NO_DATA_ECHO)

    def _on_air_late(self, now: float) -> None:
        reason = FailureReason.NO_TRANSMIT_END if self._on_air else FailureReason.NO_TRANSMIT_START
        self._fail(reason)

    def _transmitted(self, now: float) -> None:
        """The packet is out; wait for acknowledgements where they were asked for."""
        if self._missing():
            self._fail(FailureReason.DATA_TIMEOUT)
        elif self.packet.ack and len(self._acknowledged) < len(self.packet.frames):
            self._wait(TransmitStage.ACKNOWLEDGEMENT, now, self._config.ack_wait_s)
        else:
            self._finish(now)

    def _finish(self, now: float) -> None:
        p = self.packet
        acknowledged = tuple(sorted(self._acknowledged))
        self.result = PacketSent(
            p.packet_id, p.dest, p.rate, p.frames, acknowledged, self._started_s, now, self._statistics
        )
        self.stage = TransmitStage.OVER

    def _fail(self, reason: FailureReason) -> None:
        # With a frame in the modem nobody knows what it does after an exchange that broke off.
        self.result = self.packet.failed(reason, maybe_sent=bool(self._given))
        self.stage = TransmitStage.OVER

    def _wait_for_transmission(self, now: float) -> None:
        # Long enough for the end of the transmission, should the sentence that tells its start be lost.
        wait_s = self._config.start_timeout_s + self._config.on_air_limit_s(self.packet.rate)
        self._wait(TransmitStage.ON_AIR, now, wait_s)

    def _wait(self, stage: TransmitStage, now: float, wait_s: float) -> None:
        self.stage = stage
        self.deadline_s = now + wait_s

    def _missing(self) -> bool:
        return any(n not in self._given for n in range(1, len(self.packet.frames) + 1))

    def _frame(self, number: int) -> bytes:
        return self.packet.frames[number - 1] if number <= len(self.packet.frames) else b""

    def _data(self, data: bytes) -> Sentence:
        return TransmitData(self._cycle.src, self._cycle.dest, self._cycle.ack, data).sentence()

    _WHEN_LATE: ClassVar[Mapping[TransmitStage, Callable[[TransmitCycle, float], None]]] = {
        TransmitStage.ECHO: _echo_late,
        TransmitStage.REQUEST: _request_late,
        TransmitStage.DATA_ECHO: _data_echo_late,
        TransmitStage.ON_AIR: _on_air_late,
        TransmitStage.STATISTICS: _transmitted,
        TransmitStage.ACKNOWLEDGEMENT: _finish,
    }
