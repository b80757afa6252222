"""What the driver and the modem say to each other: the sentences of the modem, and the exchange in progress."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import (
    ModemError,
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
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.nmea import FieldReader, Sentence
from sonarpost.modem.micromodem.rates import CAPABILITIES, RATES
from sonarpost.modem.micromodem.reception import CarrierSense, ReceptionTracker
from sonarpost.modem.micromodem.requests import FailureReason, ModemRequest, RequestExchange, RequestKind
from sonarpost.modem.micromodem.sentences import (
    Acknowledgement,
    ConfigurationSetting,
    Cycle,
    DataRequest,
    ErrorReport,
    ReceivedData,
    Revision,
    TransmitMark,
    accepted_bytes,
    message_text,
    range_measured,
    short_message,
    transmit_data,
    transmitted_type,
)
from sonarpost.modem.micromodem.supervisor import ModemSupervisor, Phase, TransmitMonitor
from sonarpost.modem.micromodem.transmit_cycle import TransmitCycle
from sonarpost.modem.packet_queue import WaitingPacket


class Dialogue:
    """Processes the sentences of the modem, and runs one packet or request at a time.

    Args:
        config: Address, settings and time-outs.
        send: Writes a sentence to the port.
        next_number: Returns the number of a packet that answers a poll.

    Attributes:
        supervisor: Configures and checks the modem.
        reception: The packet that is being received.
        poll_handler: See `Modem.set_poll_handler`.
        events: Events that the owner takes.
    """

    def __init__(
        self, config: MicroModemConfig, send: Callable[[Sentence], None], next_number: Callable[[], int]
    ) -> None:
        self._config = config
        self._send = send
        self._next_number = next_number
        self.supervisor = ModemSupervisor(config, send)
        self.reception = ReceptionTracker(config)
        self.poll_handler: PollHandler | None = None
        self.events: list[ModemEvent] = []
        self._carrier = CarrierSense(config)
        self._monitor = TransmitMonitor(config)
        self._cycle: TransmitCycle | None = None
        self._request: RequestExchange | None = None

    @property
    def exchange(self) -> TransmitCycle | RequestExchange | None:
        """The exchange in progress. The cycle of a poll takes precedence over the request during which it came."""
        return self._cycle or self._request

    @property
    def may_start(self) -> bool:
        """Whether the modem and the channel are free for a packet or request."""
        is_ready = self.supervisor.phase is Phase.READY and self.supervisor.dump_ends_s is None
        return self.exchange is None and is_ready and self._carrier.channel_free

    def start(self, item: WaitingPacket | ModemRequest, now: float) -> None:
        """Start a packet or a request; requires `may_start`."""
        if isinstance(item, WaitingPacket):
            self._cycle = TransmitCycle(item, self._config, self._send, now)
        else:
            self._request = RequestExchange(item, self._config, self._send, now)

    def deadlines_s(self) -> tuple[float | None, ...]:
        """Return the times at which `advance` has something to do."""
        exchange_s = None if self.exchange is None else self.exchange.deadline_s
        # The modem is not queried during an exchange, which shows by itself whether the modem answers.
        is_busy = self.exchange is not None and self.supervisor.phase is Phase.READY
        check_s = None if is_busy else self.supervisor.deadline_s
        return exchange_s, check_s, self.reception.deadline_s, self._carrier.deadline_s, self.supervisor.dump_ends_s

    def advance(self, now: float) -> None:
        """Do what is due."""
        self._on_reception(self.reception.poll(now))
        self.events += self._carrier.update(now, receiving=self.reception.receiving)
        self._advance_exchanges(now)
        self.events += self.supervisor.poll(now, may_check=self.exchange is None)

    def handle(self, sentence: Sentence, now: float) -> None:
        """Process a sentence of the modem. One with a wrong field is reported as an event."""
        self.supervisor.note_sentence(now)
        handler = self._HANDLERS.get(sentence.kind)
        try:
            if handler is not None:
                handler(self, sentence, now)
        except SentenceError as error:
            self.events.append(SentenceRejected(error))

    def abort(self, reason: FailureReason, now: float) -> None:
        """Fail the exchange in progress and return the received frames: the modem has lost its state."""
        for exchange in (self._cycle, self._request):
            if exchange is not None:
                result = exchange.abort(reason)
                self.events += [result, *self._monitor.on_result(result, now)]
        self._cycle = self._request = None
        self.events += [*self.reception.flush(), *self._carrier.reset(now)]

    def _advance_exchanges(self, now: float) -> None:
        for exchange in (self._cycle, self._request):
            if exchange is None:
                continue
            exchange.poll(now)
            result = exchange.result
            if result is None:
                continue
            self.events += [result, *self._monitor.on_result(result, now)]
            if exchange is self._cycle:
                self._cycle = None
            else:
                self._request = None
            # A request that failed after its echo shows that the modem itself works.
            no_echo = isinstance(result, RequestFailed) and result.reason is FailureReason.NO_ECHO
            if self._monitor.take_restart(now):
                self.events += self.supervisor.restart(now)
            elif isinstance(result, PacketFailed) or no_echo:
                self.supervisor.check(now)

    def _on_reception(self, events: list[ModemEvent]) -> None:
        self.events += events
        if self._request is not None:
            for event in events:
                if isinstance(event, PacketReceived):
                    self._request.on_answer(RequestKind.POLL, event.src)

    def _on_revision(self, sentence: Sentence, now: float) -> None:
        revision = Revision.parse(sentence)
        if revision.rebooted:
            self.abort(FailureReason.REBOOTED, now)
        self.events += self.supervisor.on_revision(revision, now)

    def _on_setting(self, sentence: Sentence, now: float) -> None:
        was_ready = self.supervisor.ready
        if self._cycle is not None and self._cycle.on_setting(ConfigurationSetting.parse(sentence), now):
            return
        if self._request is not None:
            self._request.on_setting(now)
        self.supervisor.on_setting(sentence, now)
        if was_ready and not self.supervisor.ready:
            self.abort(FailureReason.REBOOTED, now)

    def _on_cycle(self, sentence: Sentence, now: float) -> None:
        cycle = Cycle.parse(sentence)
        if self._cycle is not None and self._cycle.owns(cycle):
            self._cycle.on_echo(now)
        elif self._request is not None and self._request.owns(cycle):
            self._request.on_echo("CYC", now)
        elif cycle.src != self._config.address:
            self._on_reception(self.reception.on_cycle(cycle, now))
        else:
            self._start_polled(cycle, now)

    def _start_polled(self, cycle: Cycle, now: float) -> None:
        """Start the cycle that answers a poll, if it can be answered."""
        if self.poll_handler is None or self._cycle is not None or cycle.rate not in RATES or cycle.nframes < 1:
            return
        rate = RATES[cycle.rate]
        poll = PollReceived(cycle.dest, cycle.rate, min(cycle.nframes, rate.frames), rate.frame_bytes, cycle.ack)
        self.events.append(poll)
        frames = tuple(bytes(frame) for frame in self.poll_handler(poll))
        if not frames:
            return
        CAPABILITIES.check_packet(poll.dest, poll.rate, frames)
        packet = WaitingPacket(self._next_number(), poll.dest, poll.rate, frames, poll.ack, now)
        self._cycle = TransmitCycle(packet, self._config, self._send, now, polled=cycle)

    def _on_request(self, sentence: Sentence, now: float) -> None:
        request = DataRequest.parse(sentence)
        if self._cycle is not None and request.dest == self._cycle.packet.destination:
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
        self.events.append(TransmissionEnded(airtime_s) if mark.ends else TransmissionStarted(airtime_s))
        if self.exchange is not None:
            self.exchange.on_transmission(mark, now)
        else:
            self._carrier.on_transmission(mark, now)

    def _on_transmit_statistics(self, sentence: Sentence, now: float) -> None:
        packet_type: int | None = None
        try:
            packet_type = transmitted_type(sentence)
        except SentenceError as error:
            # Invalid statistics still mark the end of the transmission.
            self.events.append(SentenceRejected(error))
        if self.exchange is not None:
            self.exchange.on_statistics(packet_type, now)

    def _on_reception_started(self, sentence: Sentence, now: float) -> None:
        FieldReader(sentence).optional_integer(0, "type", 0, 255)
        self._on_reception(self.reception.on_start(now))

    def _on_frame(self, sentence: Sentence, now: float) -> None:
        self._on_reception(self.reception.on_frame(ReceivedData.parse(sentence), now))

    def _on_message(self, sentence: Sentence, now: float) -> None:
        text = message_text(sentence)
        self.reception.on_message(text, now)
        if text == "PACKET_TIMEOUT" and self._request is not None:
            self._request.on_no_answer()

    def _on_link_statistics(self, sentence: Sentence, now: float) -> None:
        self._on_reception(self.reception.on_statistics(sentence, now))

    def _on_request_echo(self, sentence: Sentence, now: float) -> None:
        if self._request is not None:
            self._request.on_echo(sentence.kind[2:], now)

    def _on_ping_answer(self, sentence: Sentence, now: float) -> None:
        answer = range_measured(sentence)
        if self._request is not None:
            self._request.on_answer(RequestKind.PING, answer.src)
        self.events.append(answer)

    def _on_mini_received(self, sentence: Sentence, now: float) -> None:
        self.events.append(short_message(sentence))

    def _on_acknowledgement(self, sentence: Sentence, now: float) -> None:
        acknowledgement = Acknowledgement.parse(sentence)
        self.reception.on_acknowledgement(now)
        if self._cycle is not None:
            self._cycle.on_acknowledgement(acknowledgement, now)

    def _on_error(self, sentence: Sentence, now: float) -> None:
        report = ErrorReport.parse(sentence)
        self.events.append(ModemError(report.text))
        self.supervisor.on_error(report, now)
        if self.exchange is not None:
            self.exchange.on_error(report, now)

    _HANDLERS: ClassVar[Mapping[str, Callable[[Dialogue, Sentence, float], None]]] = {
        "CAREV": _on_revision,
        "CACFG": _on_setting,
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
        "CAMPR": _on_ping_answer,
        "CAMUA": _on_mini_received,
    }
