"""One transmit cycle of the modem: command, data requests, data, transmission, statistics, acknowledgements."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto

from sonarpost.modem.interface import PacketFailed, PacketSent
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.reception import FSK_MINI_PACKET
from sonarpost.modem.micromodem.requests import FailureReason
from sonarpost.modem.micromodem.sentences import (
    Acknowledgement,
    ConfigurationSetting,
    Cycle,
    DataRequest,
    ErrorReport,
    TransmitMark,
    transmit_data,
)
from sonarpost.modem.packet_queue import WaitingPacket


class TransmitStage(Enum):
    """What the cycle waits for."""

    ECHO = auto()
    REQUEST = auto()
    DATA_ECHO = auto()
    ON_AIR = auto()
    QUERY = auto()
    STATISTICS = auto()
    ACKNOWLEDGEMENT = auto()
    OVER = auto()


_AFTER_ECHO = frozenset({TransmitStage.REQUEST, TransmitStage.DATA_ECHO, TransmitStage.ON_AIR, TransmitStage.QUERY})


class TransmitCycle:
    """Sends one packet through the modem. The cycle is over when `result` is set.

    The host's own command starts it or, with `polled`, the command of another modem that requests data. A later
    sentence implies the earlier ones that were lost. A command without an answer is sent again, a frame is sent again
    when the modem requests it again, and every wait is limited.

    A modem that reports no end of the transmission must not cause the same packet to be sent again and again. If it has
    accepted all data without an error and the air time has passed, it is queried. If it answers, the packet counts as
    sent.
    """

    def __init__(
        self,
        packet: WaitingPacket,
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
        self._cycle = polled or Cycle(config.address, packet.destination, packet.rate, packet.ack, len(packet.frames))
        self._started_s = self._stage_s = now
        self._attempt = 0
        self._refused = False  # the last attempt
        self._frame_number = 0
        self._frames_given: set[int] = set()
        self._acknowledged: set[int] = set()
        self._on_air = False
        self._end_reported = False
        self._error_reported = False  # after the data, before the transmission
        if polled is None:
            self.poll(now)
        else:
            self._wait(TransmitStage.REQUEST, now, config.request_timeout_s)

    def owns(self, cycle: Cycle) -> bool:
        """Return whether a `CACYC` is the echo of this cycle's command."""
        return cycle == self._cycle

    def on_echo(self, now: float) -> None:
        """Process `CACYC`, the echo of the command."""
        if self.stage is TransmitStage.ECHO:
            # At rate 0 a header is transmitted before the first data request.
            header_s = self._config.on_air_limit_s(0) if self.packet.rate == 0 else 0.0
            self._wait(TransmitStage.REQUEST, now, self._config.request_timeout_s + header_s)

    def on_request(self, request: DataRequest, now: float) -> None:
        """Process `CADRQ`: send the data of a frame, again if it is requested again."""
        # A modem polled for more frames than there are continues to request after the last one.
        before_air = self.stage is TransmitStage.ON_AIR and not self._on_air
        if not before_air and self.stage not in {TransmitStage.ECHO, TransmitStage.REQUEST, TransmitStage.DATA_ECHO}:
            return
        number = request.frame_number
        frame = self._frame(number)
        if len(frame) > request.max_bytes:
            self._send_data(b"")
            self.abort(FailureReason.FRAME_REFUSED)
            return
        self._frame_number = number
        self._frames_given.add(number)
        self._send_data(frame)
        self._wait(TransmitStage.DATA_ECHO, now, self._config.reply_timeout_s)

    def on_data_accepted(self, nbytes: int, now: float) -> None:
        """Process `CATXD`: the modem has accepted `nbytes` of a frame."""
        if self.stage is not TransmitStage.DATA_ECHO:
            return
        if nbytes != len(self._frame(self._frame_number)):
            self.abort(FailureReason.FRAME_REFUSED)
        elif self._missing():
            self._wait(TransmitStage.REQUEST, now, self._config.request_timeout_s)
        else:
            # Long enough for the end of the transmission, as the sentence of its start may be lost.
            wait_s = self._config.start_timeout_s + self._config.on_air_limit_s(self.packet.rate)
            self._wait(TransmitStage.ON_AIR, now, wait_s)

    def on_transmission(self, mark: TransmitMark, now: float) -> None:
        """Process the start or end of a transmission: of the packet, or of the header of rate 0."""
        if self._frames_given and mark.nbytes == 0 and any(self.packet.frames):
            return  # an automatic reply of the modem
        if not self._frames_given:
            on_air_s = self._config.on_air_limit_s(self.packet.rate)
            self.deadline_s = max(self.deadline_s, now + self._config.request_timeout_s + on_air_s)
        elif self.stage in _AFTER_ECHO:
            self._on_air = True
            if mark.ends:
                self._end_reported = True
                self._wait(TransmitStage.STATISTICS, now, self._config.statistics_timeout_s)
            else:
                self._wait(TransmitStage.ON_AIR, now, self._config.on_air_limit_s(self.packet.rate))

    def on_statistics(self, packet_type: int | None, now: float) -> None:
        """Process `CAXST` with its packet type; those of a rate 0 header are ignored."""
        if packet_type == FSK_MINI_PACKET or not self._frames_given:
            return
        if self.stage in _AFTER_ECHO - {TransmitStage.REQUEST} or self.stage is TransmitStage.STATISTICS:
            self._on_air = self._end_reported = True
            self._transmitted(now)

    def on_acknowledgement(self, acknowledgement: Acknowledgement, now: float) -> None:
        """Process `CAACK`."""
        number = acknowledgement.frame_number
        if acknowledgement.src != self.packet.destination or not self._on_air or not acknowledgement.good:
            return
        if 1 <= number <= len(self.packet.frames):
            self._acknowledged.add(number)
        if self.stage is TransmitStage.ACKNOWLEDGEMENT and len(self._acknowledged) == len(self.packet.frames):
            self._finish(now)

    def on_error(self, report: ErrorReport, now: float) -> None:
        """Process a data timeout, a rejection of the command, or an error before the start of the transmission."""
        if report.data_timeout:
            if self.stage in {TransmitStage.REQUEST, TransmitStage.DATA_ECHO}:
                self.abort(FailureReason.DATA_TIMEOUT)
        elif self.stage is TransmitStage.ECHO:
            self._refused = True
            self.deadline_s = min(self.deadline_s, now + self._config.refused_wait_s)
        elif self.stage is TransmitStage.ON_AIR and not self._on_air:
            self._error_reported = True

    def on_setting(self, setting: ConfigurationSetting, now: float) -> bool:
        """Process `CACFG`; return whether it is the answer to the query of this cycle.

        During a configuration dump the modem answers late: a repeated command would be queued behind the dump.
        """
        if self.stage is TransmitStage.QUERY and (setting.name, setting.number) == ("SRC", self._config.address):
            self._on_air = True
            self._transmitted(now)
            return True
        if self.stage in _AFTER_ECHO or self.stage is TransmitStage.ECHO:
            latest_s = self._stage_s + self._config.dump_limit_s
            self.deadline_s = max(self.deadline_s, min(now + self._config.dump_quiet_s, latest_s))
        return False

    def abort(self, reason: FailureReason) -> PacketFailed:
        """End the cycle as failed and return the event."""
        # After an interrupted exchange, a modem that has a frame may transmit it.
        failed = self.packet.failed(reason, maybe_sent=bool(self._frames_given))
        self.result = failed
        self.stage = TransmitStage.OVER
        return failed

    def poll(self, now: float) -> None:
        """Do what is due: send again, or end the cycle."""
        if self.result is not None or now < self.deadline_s:
            return
        match self.stage:
            case TransmitStage.ECHO if self._attempt < self._config.tries:
                self._attempt += 1
                self._refused = False
                self._send(self._cycle.sentence())
                self._wait(TransmitStage.ECHO, now, self._config.reply_timeout_s)
            case TransmitStage.ECHO:
                self.abort(FailureReason.REFUSED if self._refused else FailureReason.NO_ECHO)
            case TransmitStage.REQUEST:
                self.abort(FailureReason.NO_DATA_REQUEST)
            case TransmitStage.DATA_ECHO:
                # The data is not repeated: a modem whose echo is late would take it for the next frame.
                self.abort(FailureReason.NO_DATA_ECHO)
            case TransmitStage.ON_AIR if self._error_reported and not self._on_air:
                self.abort(FailureReason.NO_TRANSMIT_START)
            case TransmitStage.ON_AIR:
                self._send(Sentence("CCCFQ", ("SRC",)))
                self._wait(TransmitStage.QUERY, now, self._config.reply_timeout_s)
            case TransmitStage.QUERY:
                self.abort(FailureReason.NO_TRANSMIT_END if self._on_air else FailureReason.NO_TRANSMIT_START)
            case TransmitStage.STATISTICS:
                self._transmitted(now)
            case TransmitStage.ACKNOWLEDGEMENT:
                self._finish(now)

    def _transmitted(self, now: float) -> None:
        """Wait for the requested acknowledgements, or finish."""
        if self._missing():
            self.abort(FailureReason.DATA_TIMEOUT)
        elif self.packet.ack and len(self._acknowledged) < len(self.packet.frames):
            self._wait(TransmitStage.ACKNOWLEDGEMENT, now, self._config.ack_wait_s)
        else:
            self._finish(now)

    def _finish(self, now: float) -> None:
        acknowledged = sorted(self._acknowledged)
        self.result = self.packet.sent(acknowledged, self._started_s, now, end_reported=self._end_reported)
        self.stage = TransmitStage.OVER

    def _wait(self, stage: TransmitStage, now: float, wait_s: float) -> None:
        self.stage = stage
        self._stage_s = now
        self.deadline_s = now + wait_s

    def _missing(self) -> bool:
        """Return whether the modem has not received the data of every frame."""
        return any(number not in self._frames_given for number in range(1, len(self.packet.frames) + 1))

    def _frame(self, number: int) -> bytes:
        return self.packet.frames[number - 1] if number <= len(self.packet.frames) else b""

    def _send_data(self, data: bytes) -> None:
        self._send(transmit_data(self._cycle.src, self._cycle.dest, data, ack=self._cycle.ack))
