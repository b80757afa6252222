"""The driver's inside: what the time brings, what the modem says, and which exchange is under way.

`micromodem.MicroModem` is what its owner uses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import (
    FailureReason,
    FrameAcknowledged,
    ModemError,
    ModemEvent,
    PacketFailed,
    PollReceived,
    SentenceRejected,
    UnhandledSentence,
)
from sonarpost.modem.micromodem.listener import ReceptionTracker
from sonarpost.modem.micromodem.nmea import LineAssembler, Sentence
from sonarpost.modem.micromodem.rates import RATES
from sonarpost.modem.micromodem.requester import RequestTracker, is_modems_fault
from sonarpost.modem.micromodem.requests import ModemRequest, RequestKind
from sonarpost.modem.micromodem.sentences import (
    Acknowledgement,
    Cycle,
    DataAccepted,
    DataRequest,
    ModemMessage,
    ReceivedData,
    ReceptionStarted,
    TransmitData,
    TransmitMark,
)
from sonarpost.modem.micromodem.settings import ErrorReport, Revision
from sonarpost.modem.micromodem.statistics import TransmitStatistics
from sonarpost.modem.micromodem.supervisor import ModemSupervisor, Phase
from sonarpost.modem.micromodem.transmit import OutgoingPacket, TransmitCycle, check_packet


class DriverStateMachine:
    """One cycle or request at a time, one reception, and a supervisor that keeps the modem configured."""

    def __init__(self, config: MicroModemConfig, where: str = "modem port") -> None:
        self.config = config
        self._lines = LineAssembler(where, learn_checksums=True)
        self._supervisor = ModemSupervisor(config, self._send)
        self._listener = ReceptionTracker(config)
        self._requester = RequestTracker(config, self._send)
        self._cycle: TransmitCycle | None = None
        self._queue: deque[OutgoingPacket | ModemRequest] = deque()
        self._uplink: Callable[[PollReceived], Sequence[bytes]] | None = None
        self._next_id = 1
        self._out = bytearray()
        self._events: list[ModemEvent] = []
        self._events_since_s = 0.0
        # Until when a transmission that is not this driver's keeps the modem busy.
        self._foreign_until_s: float | None = None

    @property
    def phase(self) -> Phase:
        """What the driver does with its modem."""
        return self._supervisor.phase

    @property
    def ready(self) -> bool:
        """Whether the modem is configured and, as far as is known, answers."""
        return self.phase in {Phase.CHECKING, Phase.READY}

    # What the time brings.

    def _advance(self, now: float) -> None:
        self._events_since_s = now
        while self._queue and now >= self._queue[0].queued_s + self.config.max_defer_s:
            self._events.append(self._queue.popleft().failed(FailureReason.WAITED_TOO_LONG))
        if self.phase is Phase.CLOSED:
            return
        self._hear(self._listener.poll(now))
        if self._foreign_until_s is not None and now >= self._foreign_until_s:
            self._foreign_until_s = None
        self._advance_cycle(now)
        self._advance_request(now)
        self._events += self._supervisor.poll(now, may_check=self._idle)
        self._start_next(now)

    def _advance_cycle(self, now: float) -> None:
        if self._cycle is None:
            return
        self._cycle.poll(now)
        if self._cycle.result is not None:
            self._events.append(self._cycle.result)
            if isinstance(self._cycle.result, PacketFailed):
                self._supervisor.check(now)
            self._cycle = None

    def _advance_request(self, now: float) -> None:
        events = self._requester.poll(now)
        self._events += events
        if any(is_modems_fault(event) for event in events):
            self._supervisor.check(now)

    def _start_next(self, now: float) -> None:
        water_free = self._listener.reception is None and self._foreign_until_s is None
        if not (self._queue and water_free and self._idle and self.phase is Phase.READY):
            return
        following = self._queue.popleft()
        if isinstance(following, OutgoingPacket):
            self._cycle = TransmitCycle(following, self.config, self._send, now)
        else:
            self._requester.start(following, now)

    @property
    def _idle(self) -> bool:
        return self._cycle is None and self._requester.exchange is None

    def _request(self, kind: RequestKind, far: int, command: Sentence, now: float, rate: int = 0) -> int:
        request = ModemRequest(self._next_id, kind, far, command, rate, now)
        self._enqueue(request, now)
        return request.request_id

    def _enqueue(self, item: OutgoingPacket | ModemRequest, now: float) -> None:
        self._next_id += 1
        if len(self._queue) >= self.config.queued_packets:
            self._events.append(item.failed(FailureReason.QUEUE_FULL))
        else:
            self._queue.append(item)
        self._advance(now)

    def _hear(self, events: list[ModemEvent]) -> None:
        self._events += events
        self._requester.heard(events)

    def _abort(self, reason: FailureReason) -> None:
        """The modem no longer knows what it was doing; what has been received is handed over."""
        if self._cycle is not None:
            self._events.append(self._cycle.abort(reason))
            self._cycle = None
        self._events += self._requester.abort(reason)
        self._events += self._listener.flush()
        self._foreign_until_s = None

    def _send(self, sentence: Sentence) -> None:
        self._out += sentence.encode()

    def _take_events(self) -> list[ModemEvent]:
        events, self._events = self._events, []
        return events

    # What the modem says.

    def _take(self, sentence: Sentence, now: float) -> None:
        self._supervisor.heard(now)
        try:
            self._HANDLERS.get(sentence.kind, DriverStateMachine._on_other)(self, sentence, now)
        except SentenceError as error:
            self._events.append(SentenceRejected(error))

    def _on_other(self, sentence: Sentence, now: float) -> None:
        self._events.append(UnhandledSentence(sentence))

    def _on_revision(self, sentence: Sentence, now: float) -> None:
        revision = Revision.parse(sentence)
        if revision.rebooted:
            self._abort(FailureReason.REBOOTED)
        self._events += self._supervisor.on_revision(revision, now)

    def _on_setting(self, sentence: Sentence, now: float) -> None:
        was_ready = self.ready
        self._events += self._supervisor.on_setting(sentence, now)
        if was_ready and not self.ready:
            self._abort(FailureReason.REBOOTED)

    def _on_clock(self, sentence: Sentence, now: float) -> None:
        self._events += self._supervisor.on_clock(sentence, now)

    def _on_cycle(self, sentence: Sentence, now: float) -> None:
        cycle = Cycle.parse(sentence)
        if self._cycle is not None and self._cycle.owns(cycle):
            self._cycle.on_echo(now)
        elif self._requester.exchange is not None and self._requester.exchange.owns(cycle):
            self._requester.exchange.on_echo("CYC", now)
        elif cycle.src != self.config.address:
            self._hear(self._listener.on_cycle(cycle, now))
        elif not self._start_polled(cycle, now):
            self._events.append(UnhandledSentence(sentence))

    def _start_polled(self, cycle: Cycle, now: float) -> bool:
        """Give another modem, or one's own after all, the packet it asks for; tell whether there is one."""
        if self._uplink is None or self._cycle is not None or cycle.rate not in RATES or cycle.nframes < 1:
            return False
        rate = RATES[cycle.rate]
        polled = PollReceived(cycle.dest, cycle.rate, min(cycle.nframes, rate.frames), rate.frame_bytes, cycle.ack)
        self._events.append(polled)
        frames = tuple(bytes(frame) for frame in self._uplink(polled))
        if not frames:
            return True
        check_packet(polled.dest, polled.rate, frames)
        packet = OutgoingPacket(self._next_id, polled.dest, polled.rate, frames, polled.ack, now)
        self._next_id += 1
        self._cycle = TransmitCycle(packet, self.config, self._send, now, polled=cycle)
        return True

    def _on_request(self, sentence: Sentence, now: float) -> None:
        request = DataRequest.parse(sentence)
        if self._cycle is not None and request.dest == self._cycle.packet.dest:
            self._cycle.on_request(request, now)
        else:
            # A cycle that was given up, or one that another modem asked for: without an answer the modem would wait.
            self._send(TransmitData(request.src, request.dest, request.ack, b"").sentence())

    def _on_data_accepted(self, sentence: Sentence, now: float) -> None:
        accepted = DataAccepted.parse(sentence)
        if self._cycle is not None:
            self._cycle.on_data_accepted(accepted, now)

    def _on_transmission(self, sentence: Sentence, now: float) -> None:
        mark = TransmitMark.parse(sentence)
        if self._cycle is not None:
            self._cycle.on_transmission(mark, now)
        elif self._requester.exchange is not None:
            self._requester.exchange.on_transmission(ends=mark.ends, now=now)
        else:
            self._foreign_until_s = None if mark.ends else now + self.config.on_air_limit_s(None)

    def _on_transmit_statistics(self, sentence: Sentence, now: float) -> None:
        statistics: TransmitStatistics | None = None
        try:
            statistics = TransmitStatistics.parse(sentence)
        except SentenceError as error:
            # Unreadable, they still tell that the transmission is over.
            self._events.append(SentenceRejected(error))
        if self._cycle is not None:
            self._cycle.on_statistics(statistics, now)
        elif self._requester.exchange is not None:
            self._requester.exchange.on_transmit_statistics(now)
        else:
            self._events.append(UnhandledSentence(sentence))

    def _on_reception_started(self, sentence: Sentence, now: float) -> None:
        ReceptionStarted.parse(sentence)
        self._hear(self._listener.on_start(now))

    def _on_frame(self, sentence: Sentence, now: float) -> None:
        self._hear(self._listener.on_frame(ReceivedData.parse(sentence), now))

    def _on_message(self, sentence: Sentence, now: float) -> None:
        message = ModemMessage.parse(sentence)
        self._hear(self._listener.on_message(message, now))
        if message.text == "PACKET_TIMEOUT" and self._requester.exchange is not None:
            self._requester.exchange.on_no_answer()

    def _on_link_statistics(self, sentence: Sentence, now: float) -> None:
        self._hear(self._listener.on_statistics(sentence, now))

    def _on_short(self, sentence: Sentence, now: float) -> None:
        self._events += self._requester.receive(sentence, now)

    def _on_acknowledgement(self, sentence: Sentence, now: float) -> None:
        acknowledgement = Acknowledgement.parse(sentence)
        self._listener.on_acknowledgement(now)
        if self._cycle is not None:
            self._cycle.on_acknowledgement(acknowledgement, now)
        if acknowledgement.good:
            a = acknowledgement
            self._events.append(FrameAcknowledged(a.src, a.dest, a.frame_number))

    def _on_complaint(self, sentence: Sentence, now: float) -> None:
        complaint = ErrorReport.parse(sentence)
        self._events.append(ModemError(complaint))
        if self._cycle is not None:
            self._cycle.on_complaint(complaint)
        elif self._requester.exchange is not None:
            self._requester.exchange.on_complaint(complaint, now)

    _HANDLERS: ClassVar[Mapping[str, Callable[[DriverStateMachine, Sentence, float], None]]] = {
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
        "CAERR": _on_complaint,
        **dict.fromkeys(RequestTracker.KINDS, _on_short),
    }
