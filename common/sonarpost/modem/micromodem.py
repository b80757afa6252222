"""The host side of a WHOI Micro-Modem: bytes and the time go in, events and bytes come out.

The driver does no input or output and reads no clock. Its owner gives it what the port has read (`receive`), calls
`poll` at `next_wakeup` and writes `bytes_to_send` to the port. All times are seconds of one monotonic clock.

Every wait has an end: a sentence that gets lost costs time, or at worst one packet, which is then reported as
failed, and the modem is asked for its address before the next one goes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import ClassVar

from sonarpost.errors import SentenceError
from sonarpost.modem.config import MicroModemConfig
from sonarpost.modem.events import (
    Event,
    FailureReason,
    FrameAcknowledged,
    ModemComplained,
    OtherSentence,
    PacketFailed,
    SentenceRejected,
)
from sonarpost.modem.listener import Listener
from sonarpost.modem.nmea import LineAssembler, Sentence
from sonarpost.modem.sentences import (
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
from sonarpost.modem.settings import ModemComplaint, Revision
from sonarpost.modem.statistics import TransmitStatistics
from sonarpost.modem.supervisor import Phase, Supervisor
from sonarpost.modem.transmit import Packet, TransmitCycle, check_packet


class MicroModem:
    """Drives one modem: configures it, sends packets one at a time, hands over what arrives.

    Args:
        config: Address, settings and time-outs.
        where: Names the port in errors.
    """

    def __init__(self, config: MicroModemConfig, where: str = "modem port") -> None:
        self.config = config
        self._lines = LineAssembler(where, learn_checksums=True)
        self._supervisor = Supervisor(config, self._send)
        self._listener = Listener(config)
        self._cycle: TransmitCycle | None = None
        self._queue: deque[Packet] = deque()
        self._next_id = 1
        self._out = bytearray()
        self._events: list[Event] = []
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

    @property
    def firmware(self) -> str | None:
        """Version the modem has told, or None."""
        return self._supervisor.firmware

    @property
    def queued(self) -> int:
        """How many packets wait or are on their way."""
        return len(self._queue) + (self._cycle is not None)

    @property
    def receiving(self) -> bool:
        """Whether a packet is arriving, as far as the driver knows."""
        return self._listener.reception is not None

    def start(self, now: float) -> None:
        """Begin to configure the modem; the port is open."""
        self.port_opened(now)

    def port_opened(self, now: float) -> None:
        """The port is open (again): whatever the modem knew is set anew."""
        if self.phase is not Phase.CLOSED:
            self.port_lost(now)
        self._supervisor.open(now)
        self._advance(now)

    def port_lost(self, now: float) -> None:
        """The port is gone: the packet on its way has failed, received frames are handed over, the others wait."""
        self._supervisor.close()
        self._abort(FailureReason.PORT_LOST)
        self._lines.reset()
        self._out.clear()
        self._events_since_s = now

    def send_packet(
        self, destination: int, rate: int, frames: Sequence[bytes], *, ack: bool = False, now: float
    ) -> int:
        """Queue a packet; its `PacketSent` or `PacketFailed` carries the number returned here.

        Args:
            destination: Address meant, 0..127.
            rate: Rate number, 0..6.
            frames: At least one, at most as many and as long as the rate allows; an empty frame is allowed.
            ack: Ask the far modem for acoustic acknowledgements, and wait for them.
            now: Time on the driver's clock.

        Raises:
            FrameError: An address, a rate or frames that the modem cannot send.
        """
        check_packet(destination, rate, frames)
        packet = Packet(self._next_id, destination, rate, tuple(bytes(f) for f in frames), ack, now)
        self._next_id += 1
        if len(self._queue) >= self.config.queued_packets:
            self._events.append(packet.failed(FailureReason.QUEUE_FULL))
        else:
            self._queue.append(packet)
        self._advance(now)
        return packet.packet_id

    def set_clock(self, utc: datetime, now: float) -> bool:
        """Set the modem's clock, if it is free at this moment; tell whether the command was sent.

        The time must be right when this is called, so it is not kept for later: on False, ask again. The answer
        is a `ClockConfirmed` or, without one, a `SettingRefused`.
        """
        if self.phase is not Phase.READY or self._cycle is not None:
            return False
        self._supervisor.set_clock(utc, now)
        return True

    def receive(self, data: bytes, now: float) -> list[Event]:
        """Take bytes from the port, in pieces of any size; whatever they are, the answer is events."""
        if self.phase is Phase.CLOSED:
            return self._take_events()
        for item in self._lines.feed(data):
            if isinstance(item, SentenceError):
                self._events.append(SentenceRejected(item))
                continue
            self._supervisor.heard(now)
            try:
                self._HANDLERS.get(item.kind, MicroModem._on_other)(self, item, now)
            except SentenceError as error:
                self._events.append(SentenceRejected(error))
            self._advance(now)
        return self._take_events()

    def poll(self, now: float) -> list[Event]:
        """Do what is due; call at `next_wakeup` or at any other time."""
        self._advance(now)
        return self._take_events()

    def next_wakeup(self) -> float | None:
        """Return when `poll` has something to do, or None; a time in the past means at once."""
        times_s = [self._events_since_s if self._events else None]
        times_s += [packet.queued_s + self.config.patience_s for packet in self._queue]
        if self.phase is not Phase.CLOSED:
            busy_s = None if self._cycle is None else self._cycle.deadline_s
            # In the middle of a cycle the modem is not asked whether it is there: the cycle will tell.
            idle_s = None if self._cycle is not None and self.phase is Phase.READY else self._supervisor.deadline_s
            times_s += [busy_s, idle_s, self._listener.deadline_s, self._foreign_until_s]
        return min((time_s for time_s in times_s if time_s is not None), default=None)

    def bytes_to_send(self) -> bytes:
        """Return, once, what is to be written to the port."""
        data = bytes(self._out)
        self._out.clear()
        return data

    # What the time brings.

    def _advance(self, now: float) -> None:
        self._events_since_s = now
        while self._queue and now >= self._queue[0].queued_s + self.config.patience_s:
            self._events.append(self._queue.popleft().failed(FailureReason.WAITED_TOO_LONG))
        if self.phase is Phase.CLOSED:
            return
        self._events += self._listener.poll(now)
        if self._foreign_until_s is not None and now >= self._foreign_until_s:
            self._foreign_until_s = None
        self._advance_cycle(now)
        self._events += self._supervisor.poll(now, may_check=self._cycle is None)
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

    def _start_next(self, now: float) -> None:
        water_free = self._listener.reception is None and self._foreign_until_s is None
        if self._queue and water_free and self._cycle is None and self.phase is Phase.READY:
            self._cycle = TransmitCycle(self._queue.popleft(), self.config, self._send, now)

    def _abort(self, reason: FailureReason) -> None:
        """The modem no longer knows what it was doing; what has been received is handed over."""
        if self._cycle is not None:
            self._events.append(self._cycle.abort(reason))
            self._cycle = None
        self._events += self._listener.flush()
        self._foreign_until_s = None

    def _send(self, sentence: Sentence) -> None:
        self._out += sentence.encode()

    def _take_events(self) -> list[Event]:
        events, self._events = self._events, []
        return events

    # What the modem says.

    def _on_other(self, sentence: Sentence, now: float) -> None:
        self._events.append(OtherSentence(sentence))

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
        elif cycle.src != self.config.address:
            self._events += self._listener.on_cycle(cycle, now)
        else:
            self._events.append(OtherSentence(sentence))

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
        else:
            self._events.append(OtherSentence(sentence))

    def _on_reception_started(self, sentence: Sentence, now: float) -> None:
        ReceptionStarted.parse(sentence)
        self._events += self._listener.on_start(now)

    def _on_frame(self, sentence: Sentence, now: float) -> None:
        self._events += self._listener.on_frame(ReceivedData.parse(sentence), now)

    def _on_message(self, sentence: Sentence, now: float) -> None:
        self._events += self._listener.on_message(ModemMessage.parse(sentence), now)

    def _on_link_statistics(self, sentence: Sentence, now: float) -> None:
        self._events += self._listener.on_statistics(sentence, now)

    def _on_acknowledgement(self, sentence: Sentence, now: float) -> None:
        acknowledgement = Acknowledgement.parse(sentence)
        self._listener.on_acknowledgement(now)
        if self._cycle is not None:
            self._cycle.on_acknowledgement(acknowledgement, now)
        if acknowledgement.good:
            a = acknowledgement
            self._events.append(FrameAcknowledged(a.src, a.dest, a.frame_number))

    def _on_complaint(self, sentence: Sentence, now: float) -> None:
        complaint = ModemComplaint.parse(sentence)
        self._events.append(ModemComplained(complaint))
        if self._cycle is not None:
            self._cycle.on_complaint(complaint)

    _HANDLERS: ClassVar[Mapping[str, Callable[[MicroModem, Sentence, float], None]]] = {
        "CAREV": _on_revision,
        "CACFG": _on_setting,
        "CACLK": _on_clock,
        "CACYC": _on_cycle,
        "CADRQ": _on_request,
        "CATXD": _on_data_accepted,
        "CATXP": _on_transmission,
        "CATXF": _on_transmission,
        "CAXST": _on_transmit_statistics,
        "CARXP": _on_reception_started,
        "CARXD": _on_frame,
        "CAMSG": _on_message,
        "CACST": _on_link_statistics,
        "CAACK": _on_acknowledgement,
        "CAERR": _on_complaint,
    }
