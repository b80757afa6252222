"""Host side of a WHOI Micro-Modem: bytes and the time go in, events and bytes come out.

The driver does no input or output and reads no clock. Its owner passes the bytes read from the port to `receive`, calls
`poll` at `next_wakeup` and writes `bytes_to_send` to the port. All times are seconds of one monotonic clock.

Every wait is limited. A lost sentence costs time, or at most one packet, which is reported as failed. After a failed
packet the modem is queried before the next one is sent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import ClassVar

from typing_extensions import override

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import (
    Modem,
    ModemCapabilities,
    ModemEvent,
    PacketFailed,
    PacketReceived,
    PollHandler,
    PollReceived,
    RequestFailed,
    SentenceRejected,
    TransmissionEnded,
    TransmissionStarted,
)
from sonarpost.modem.micromodem.carrier_sense import CarrierSense
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import (
    FailureReason,
    FlexibleDataReceived,
    FrameAcknowledged,
    MicroModemError,
    UnhandledSentence,
)
from sonarpost.modem.micromodem.nmea import FieldReader, LineAssembler, Sentence
from sonarpost.modem.micromodem.rates import CAPABILITIES, RATES
from sonarpost.modem.micromodem.reception import ReceptionTracker
from sonarpost.modem.micromodem.requests import (
    ModemRequest,
    RequestExchange,
    RequestKind,
    flexible_command,
    mini_command,
    ping_command,
    poll_command,
)
from sonarpost.modem.micromodem.sentences import (
    Acknowledgement,
    ConfigurationSetting,
    Cycle,
    DataRequest,
    ErrorReport,
    MiniPacketAnswered,
    MiniPacketReceived,
    ModemMessage,
    PingAnswered,
    PingReceived,
    ReceivedData,
    ReceivedFlexibleData,
    Revision,
    TransmitMark,
    accepted_bytes,
    transmit_data,
)
from sonarpost.modem.micromodem.statistics import TransmitStatistics
from sonarpost.modem.micromodem.supervisor import ModemSupervisor, Phase
from sonarpost.modem.micromodem.transmit_cycle import QueuedPacket, TransmitCycle
from sonarpost.modem.micromodem.transmit_monitor import TransmitMonitor
from sonarpost.modem.registry import ModemDriver, ModemSettings


class MicroModem(Modem):
    """Drives one modem: configures it, sends packets and requests one at a time, returns what it receives.

    Args:
        config: Address, settings and time-outs.
        where: Names the port in errors.
    """

    def __init__(self, config: MicroModemConfig, where: str = "modem port") -> None:
        self.config = config
        self._lines = LineAssembler(where, learn_checksums=True)
        self._supervisor = ModemSupervisor(config, self._send)
        self._reception = ReceptionTracker(config)
        self._cycle: TransmitCycle | None = None
        self._request: RequestExchange | None = None
        self._queue: deque[QueuedPacket | ModemRequest] = deque()
        self._poll_handler: PollHandler | None = None
        self._next_id = 1
        self._out = bytearray()
        self._events: list[ModemEvent] = []
        self._events_since_s = 0.0
        self._carrier = CarrierSense(config)
        self._monitor = TransmitMonitor(config)

    @property
    @override
    def capabilities(self) -> ModemCapabilities:
        return CAPABILITIES

    @property
    def phase(self) -> Phase:
        """State towards the modem."""
        return self._supervisor.phase

    @property
    @override
    def ready(self) -> bool:
        return self.phase in {Phase.CHECKING, Phase.READY}

    @property
    def firmware(self) -> str | None:
        """Firmware version reported by the modem, or None."""
        return self._supervisor.firmware

    @property
    def generation(self) -> int | None:
        """1 or 2, None until the modem has reported its version."""
        return self._supervisor.generation

    @property
    @override
    def queued(self) -> int:
        return len(self._queue) + (not self._idle)

    @property
    @override
    def receiving(self) -> bool:
        return self._reception.receiving

    @property
    def _exchange(self) -> TransmitCycle | RequestExchange | None:
        """The exchange in progress. The cycle of a poll takes precedence over the request during which it came."""
        return self._cycle or self._request

    @property
    def _idle(self) -> bool:
        return self._exchange is None

    def start(self, now: float) -> None:
        """Configure the modem; the same as `port_opened`."""
        self.port_opened(now)

    @override
    def port_opened(self, now: float) -> None:
        if self.phase is not Phase.CLOSED:
            self.port_lost(now)
        self._supervisor.open(now)
        self._advance(now)

    @override
    def port_lost(self, now: float) -> None:
        self._supervisor.close()
        self._abort(FailureReason.PORT_LOST, now)
        self._lines.reset()
        self._out.clear()
        self._events_since_s = now

    @override
    def send_packet(
        self, destination: int, rate: int, frames: Sequence[bytes], *, ack: bool = False, now: float
    ) -> int:
        CAPABILITIES.check_packet(destination, rate, frames)
        packet = QueuedPacket(self._next_id, destination, rate, tuple(bytes(f) for f in frames), ack, now)
        self._enqueue(packet, now)
        return packet.packet_id

    @override
    def ping(self, destination: int, now: float) -> int:
        """Queue a ping; `PingAnswered` carries the travel time, `RequestDone` or `RequestFailed` the result.

        Raises:
            FrameError: An address outside 0..127.
        """
        return self._enqueue_request(RequestKind.PING, destination, ping_command(self.config.address, destination), now)

    def send_mini(self, destination: int, bits: int, now: float) -> int:
        """Queue a user mini-packet of 13 bits; `RequestDone` or `RequestFailed` carries the result.

        Raises:
            FrameError: An address outside 0..127, or more than 13 bits.
        """
        command = mini_command(self.config.address, destination, bits)
        return self._enqueue_request(RequestKind.MINI_PACKET, destination, command, now)

    def send_flexible(self, destination: int, rate: int, data: bytes, now: float) -> int:
        """Queue flexible data (Micro-Modem 2); `RequestDone` or `RequestFailed` carries the result.

        Raises:
            FrameError: An address outside 0..127, a rate other than 1, 3 or 5, no data or more than 2048 bytes.
        """
        command = flexible_command(destination, rate, data)
        return self._enqueue_request(RequestKind.FLEXIBLE_DATA, destination, command, now, rate)

    @override
    def request_packet(
        self, source: int, rate: int, frames: int | None = None, *, ack: bool = False, now: float
    ) -> int:
        """Queue a poll: another modem is requested to send a packet. `RequestDone` follows the received packet.

        Args:
            source: The modem that shall send.
            rate: Rate number, 0..6.
            frames: Maximum number of frames, None for a full packet.
            ack: Whether it shall request acknowledgements.
            now: Time on the driver's clock.

        Raises:
            FrameError: An address outside 0..127, an unknown rate, or more frames than the rate has.
        """
        command = poll_command(source, self.config.address, rate, frames, ack=ack)
        return self._enqueue_request(RequestKind.POLL, source, command, now, rate)

    @override
    def set_poll_handler(self, handler: PollHandler | None) -> None:
        """Set the function that returns the frames when another modem polls this one.

        It is called inside `receive` and must not call the driver. It may return no frames. Frames that do not fit the
        poll raise `FrameError` from `receive`.
        """
        self._poll_handler = handler

    def set_clock(self, utc: datetime, now: float) -> bool:
        """Set the modem's clock if the modem is free; return whether the command was sent.

        The command is not queued, as its time must be correct when it is sent: on False, call again later. The result
        is a `ClockConfirmed` or, without an answer, a `SettingUnconfirmed`.
        """
        if self.phase is not Phase.READY or self._cycle is not None:
            return False
        self._supervisor.set_clock(utc, now)
        return True

    @override
    def receive(self, data: bytes, now: float) -> list[ModemEvent]:
        if self.phase is Phase.CLOSED:
            return self._take_events()
        for item in self._lines.feed(data):
            if isinstance(item, SentenceError):
                self._events.append(SentenceRejected(item))
                continue
            self._supervisor.note_sentence(now)
            try:
                self._HANDLERS.get(item.kind, MicroModem._on_other)(self, item, now)
            except SentenceError as error:
                self._events.append(SentenceRejected(error))
            self._advance(now)
        return self._take_events()

    @override
    def poll(self, now: float) -> list[ModemEvent]:
        self._advance(now)
        return self._take_events()

    @override
    def next_wakeup(self) -> float | None:
        times_s = [self._events_since_s if self._events else None]
        times_s += [packet.queued_s + self.config.max_defer_s for packet in self._queue]
        if self.phase is not Phase.CLOSED:
            exchange_s = None if self._exchange is None else self._exchange.deadline_s
            # The modem is not queried during an exchange, which shows by itself whether the modem answers.
            check_s = None if not self._idle and self.phase is Phase.READY else self._supervisor.deadline_s
            times_s += [exchange_s, check_s, self._reception.deadline_s, self._carrier.deadline_s]
            times_s.append(self._supervisor.dump_ends_s)
        return min((time_s for time_s in times_s if time_s is not None), default=None)

    @override
    def bytes_to_send(self) -> bytes:
        data = bytes(self._out)
        self._out.clear()
        return data

    def _advance(self, now: float) -> None:
        self._events_since_s = now
        while self._queue and now >= self._queue[0].queued_s + self.config.max_defer_s:
            self._events.append(self._queue.popleft().failed(FailureReason.DEFERRED_TOO_LONG))
        if self.phase is Phase.CLOSED:
            return
        self._on_reception(self._reception.poll(now))
        self._events += self._carrier.update(now, receiving=self._reception.receiving)
        self._advance_exchanges(now)
        self._events += self._supervisor.poll(now, may_check=self._idle)
        self._start_next(now)

    def _advance_exchanges(self, now: float) -> None:
        for exchange in (self._cycle, self._request):
            if exchange is None:
                continue
            exchange.poll(now)
            result = exchange.result
            if result is None:
                continue
            self._events += [result, *self._monitor.on_result(result, now)]
            if exchange is self._cycle:
                self._cycle = None
            else:
                self._request = None
            # A request that failed after its echo shows that the modem itself works.
            no_echo = isinstance(result, RequestFailed) and result.reason is FailureReason.NO_ECHO
            if self._monitor.take_restart(now):
                self._events += self._supervisor.restart(now)
            elif isinstance(result, PacketFailed) or no_echo:
                self._supervisor.check(now)

    def _start_next(self, now: float) -> None:
        modem_free = self._idle and self.phase is Phase.READY and self._supervisor.dump_ends_s is None
        if not (self._queue and modem_free and self._carrier.channel_free):
            return
        item = self._queue.popleft()
        if isinstance(item, QueuedPacket):
            self._cycle = TransmitCycle(item, self.config, self._send, now)
        else:
            self._request = RequestExchange(item, self.config, self._send, now)

    def _enqueue_request(self, kind: RequestKind, peer: int, command: Sentence, now: float, rate: int = 0) -> int:
        request = ModemRequest(self._next_id, kind, peer, command, rate, now)
        self._enqueue(request, now)
        return request.request_id

    def _enqueue(self, item: QueuedPacket | ModemRequest, now: float) -> None:
        self._next_id += 1
        if len(self._queue) >= self.config.queued_packets:
            self._events.append(item.failed(FailureReason.QUEUE_FULL))
        else:
            self._queue.append(item)
        self._advance(now)

    def _on_reception(self, events: list[ModemEvent]) -> None:
        self._events += events
        if self._request is not None:
            for event in events:
                if isinstance(event, PacketReceived):
                    self._request.on_answer(RequestKind.POLL, event.src)

    def _abort(self, reason: FailureReason, now: float) -> None:
        """Fail the exchange in progress and return the received frames: the modem has lost its state."""
        for exchange in (self._cycle, self._request):
            if exchange is not None:
                result = exchange.abort(reason)
                self._events += [result, *self._monitor.on_result(result, now)]
        self._cycle = self._request = None
        self._events += [*self._reception.flush(), *self._carrier.reset(now)]

    def _send(self, sentence: Sentence) -> None:
        self._out += sentence.encode()

    def _take_events(self) -> list[ModemEvent]:
        events, self._events = self._events, []
        return events

    # Handlers of the modem's sentences

    def _on_other(self, sentence: Sentence, now: float) -> None:
        self._events.append(UnhandledSentence(sentence))

    def _on_revision(self, sentence: Sentence, now: float) -> None:
        revision = Revision.parse(sentence)
        if revision.rebooted:
            self._abort(FailureReason.REBOOTED, now)
        self._events += self._supervisor.on_revision(revision, now)

    def _on_setting(self, sentence: Sentence, now: float) -> None:
        was_ready = self.ready
        if self._cycle is not None and self._cycle.on_setting(ConfigurationSetting.parse(sentence), now):
            return
        if self._request is not None:
            self._request.on_setting(now)
        self._events += self._supervisor.on_setting(sentence, now)
        if was_ready and not self.ready:
            self._abort(FailureReason.REBOOTED, now)

    def _on_clock(self, sentence: Sentence, now: float) -> None:
        self._events += self._supervisor.on_clock(sentence, now)

    def _on_cycle(self, sentence: Sentence, now: float) -> None:
        cycle = Cycle.parse(sentence)
        if self._cycle is not None and self._cycle.owns(cycle):
            self._cycle.on_echo(now)
        elif self._request is not None and self._request.owns(cycle):
            self._request.on_echo("CYC", now)
        elif cycle.src != self.config.address:
            self._on_reception(self._reception.on_cycle(cycle, now))
        elif not self._start_polled(cycle, now):
            self._events.append(UnhandledSentence(sentence))

    def _start_polled(self, cycle: Cycle, now: float) -> bool:
        """Start the cycle that answers a poll; return whether the poll can be answered."""
        if self._poll_handler is None or self._cycle is not None or cycle.rate not in RATES or cycle.nframes < 1:
            return False
        rate = RATES[cycle.rate]
        poll = PollReceived(cycle.dest, cycle.rate, min(cycle.nframes, rate.frames), rate.frame_bytes, cycle.ack)
        self._events.append(poll)
        frames = tuple(bytes(frame) for frame in self._poll_handler(poll))
        if not frames:
            return True
        CAPABILITIES.check_packet(poll.dest, poll.rate, frames)
        packet = QueuedPacket(self._next_id, poll.dest, poll.rate, frames, poll.ack, now)
        self._next_id += 1
        self._cycle = TransmitCycle(packet, self.config, self._send, now, polled=cycle)
        return True

    def _on_request(self, sentence: Sentence, now: float) -> None:
        request = DataRequest.parse(sentence)
        if self._cycle is not None and request.dest == self._cycle.packet.dest:
            self._cycle.on_request(request, now)
        else:
            # An ended cycle, or a poll without frames: the modem would wait for the data.
            self._send(transmit_data(request.src, request.dest, b"", ack=request.ack))

    def _on_data_accepted(self, sentence: Sentence, now: float) -> None:
        nbytes = accepted_bytes(sentence)
        if self._cycle is not None:
            self._cycle.on_data_accepted(nbytes, now)

    def _on_transmission(self, sentence: Sentence, now: float) -> None:
        mark = TransmitMark.parse(sentence)
        # The nominal duration of a request and of an automatic reply is that of a packet of rate 0.
        airtime_s = RATES[self._cycle.packet.rate if self._cycle is not None else 0].airtime_s
        self._events.append(TransmissionEnded(airtime_s) if mark.ends else TransmissionStarted(airtime_s))
        if self._exchange is not None:
            self._exchange.on_transmission(mark, now)
        else:
            self._carrier.on_transmission(mark, now)

    def _on_transmit_statistics(self, sentence: Sentence, now: float) -> None:
        statistics: TransmitStatistics | None = None
        try:
            statistics = TransmitStatistics.parse(sentence)
        except SentenceError as error:
            # Invalid statistics still mark the end of the transmission.
            self._events.append(SentenceRejected(error))
        if self._exchange is not None:
            self._exchange.on_statistics(statistics, now)
        else:
            self._events.append(UnhandledSentence(sentence))

    def _on_reception_started(self, sentence: Sentence, now: float) -> None:
        FieldReader(sentence).optional_integer(0, "type", 0, 255)
        self._on_reception(self._reception.on_start(now))

    def _on_frame(self, sentence: Sentence, now: float) -> None:
        self._on_reception(self._reception.on_frame(ReceivedData.parse(sentence), now))

    def _on_message(self, sentence: Sentence, now: float) -> None:
        message = ModemMessage.parse(sentence)
        self._on_reception(self._reception.on_message(message, now))
        if message.text == "PACKET_TIMEOUT" and self._request is not None:
            self._request.on_no_answer()

    def _on_link_statistics(self, sentence: Sentence, now: float) -> None:
        self._on_reception(self._reception.on_statistics(sentence, now))

    def _on_request_echo(self, sentence: Sentence, now: float) -> None:
        if self._request is not None:
            self._request.on_echo(sentence.kind[2:], now)

    def _on_ping_received(self, sentence: Sentence, now: float) -> None:
        self._events.append(PingReceived.parse(sentence))

    def _on_answer(self, sentence: Sentence, now: float) -> None:
        is_ping = sentence.kind == "CAMPR"
        answer = PingAnswered.parse(sentence) if is_ping else MiniPacketAnswered.parse(sentence)
        if self._request is not None:
            self._request.on_answer(RequestKind.PING if is_ping else RequestKind.MINI_PACKET, answer.src)
        self._events.append(answer)

    def _on_mini_received(self, sentence: Sentence, now: float) -> None:
        self._events.append(MiniPacketReceived.parse(sentence))

    def _on_flexible_data(self, sentence: Sentence, now: float) -> None:
        self._events.append(FlexibleDataReceived(ReceivedFlexibleData.parse(sentence), now))

    def _on_acknowledgement(self, sentence: Sentence, now: float) -> None:
        acknowledgement = Acknowledgement.parse(sentence)
        self._reception.on_acknowledgement(now)
        if self._cycle is not None:
            self._cycle.on_acknowledgement(acknowledgement, now)
        if acknowledgement.good:
            a = acknowledgement
            self._events.append(FrameAcknowledged(a.src, a.dest, a.frame_number))

    def _on_error(self, sentence: Sentence, now: float) -> None:
        report = ErrorReport.parse(sentence)
        self._events.append(MicroModemError(report.text, report))
        self._supervisor.on_error(report, now)
        if self._exchange is not None:
            self._exchange.on_error(report, now)

    _HANDLERS: ClassVar[Mapping[str, Callable[[MicroModem, Sentence, float], None]]] = {
        "CAREV": _on_revision,
        "CACFG": _on_setting,
        "CACLK": _on_clock,
        "CATMS": _on_clock,
        "CACYC": _on_cycle,
        "CADRQ": _on_request,
        "CATXD": _on_data_accepted,
        "CATXP": _on_transmission,
        "CATXF": _on_transmission,
        "CAXST": _on_transmit_statistics,
        "CARXP": _on_reception_started,
        "CARXD": _on_frame,
        "CARXA": _on_frame,
        "CAMSG": _on_message,
        "CACST": _on_link_statistics,
        "CAACK": _on_acknowledgement,
        "CAERR": _on_error,
        "CAMPC": _on_request_echo,
        "CAMUC": _on_request_echo,
        "CATDP": _on_request_echo,
        "CAMPA": _on_ping_received,
        "CAMPR": _on_answer,
        "CAMUA": _on_mini_received,
        "CAMUR": _on_answer,
        "CARDP": _on_flexible_data,
    }


def _create(settings: ModemSettings, where: str) -> MicroModem:
    config = MicroModemConfig(
        settings.address,
        reply_timeout_s=settings.reply_timeout_s,
        max_carrier_sense_s=settings.max_carrier_sense_s,
    )
    return MicroModem(config, where)


DRIVER = ModemDriver("micromodem", CAPABILITIES, _create, "WHOI Micro-Modem 1 and 2, on a serial line")
