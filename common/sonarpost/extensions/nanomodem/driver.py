"""Driver of the nanomodem v3: one command at a time, then the air time of its packet.

A unicast message does not carry its source, and a broadcast carries no destination. The driver therefore puts one byte
in front of each frame, and sends frames as broadcasts: the modem reports their source, and the byte is the destination.
A frame that requests an acknowledgement is a unicast message; its byte is the source. An empty frame gets a zero,
because a message has at least two bytes.

The modem does not report the end of a transmission or the start of a reception. The driver waits for the air time.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from typing_extensions import override

from sonarpost.extensions.nanomodem import messages
from sonarpost.extensions.nanomodem.rates import CAPABILITIES, RATE, airtime_s
from sonarpost.modem.interface import (
    FrameReceived,
    ModemError,
    ModemEvent,
    ModemReady,
    ModemRebooted,
    ModemUnresponsive,
    PacketFailed,
    PacketReceived,
    RangeMeasured,
    RequestDone,
    RequestFailed,
    TransmissionEnded,
    TransmissionStarted,
)
from sonarpost.modem.packet_queue import QueueingModem, WaitingPacket
from sonarpost.modem.registry import ModemDriver, ModemSettings

PAUSE_S: Final = 1.0
"""After such a pause an incomplete message is given up: the modem sends the longest message in 0.1 s."""
GUARD_S: Final = 0.1
"""Added to the air time before the next command: the delays of the serial line and of the modem."""
ANSWER_LIMIT_S: Final = 8.0
"""Wait for an answer after the air time; the modem itself reports `#TO` after 4 s."""
ATTEMPTS: Final = 3
"""The modem is unresponsive after so many commands without an answer; the driver continues to send them."""
CHECK_INTERVAL_S: Final = 60.0
"""After so long without a message the driver requests the status: the modem may have lost its power."""
_STATUS: Final = b"$?"
_PING: Final = "ping"


@dataclass(slots=True)
class _Sending:
    """The packet or ping in progress: a packet without frames is a ping.

    Attributes:
        confirmation: What the modem replies to the command.
        airtime_s: Duration of the transmission.
        confirmed_s: When the modem confirmed the command.
        answered: Whether the other modem answered; None until that is decided.
    """

    packet: WaitingPacket
    confirmation: bytes
    airtime_s: float
    started_s: float
    confirmed_s: float | None = None
    on_air: bool = True
    answered: bool | None = None

    @property
    def is_ping(self) -> bool:
        return not self.packet.frames

    @property
    def expects_answer(self) -> bool:
        return self.is_ping or self.packet.ack


class NanoModem(QueueingModem[_Sending, messages.NanoMessage]):
    """One nanomodem.

    Args:
        settings: Address, and the time to wait for a confirmation.
        where: Names the port in errors.

    Raises:
        ConfigError: An address outside 0..254.
    """

    def __init__(self, settings: ModemSettings, where: str = "modem port") -> None:
        super().__init__(CAPABILITIES, settings, where, messages.NanoMessageAssembler(), PAUSE_S)
        self._question: bytes | None = None
        self._asked_s = 0.0
        self._attempts = 0
        self._is_ready = self._is_unresponsive = False
        self._message_s: float | None = None

    @property
    @override
    def ready(self) -> bool:
        """Whether the modem has the address of the settings and answers."""
        return self._is_ready

    @override
    def ping(self, destination: int, now: float) -> int:
        """Queue a ping; see `Modem.ping`."""
        CAPABILITIES.check_packet(destination, RATE, [b""])
        return self._add(destination, RATE, (), ack=False, now=now)

    @override
    def _begin(self, now: float) -> None:
        self._attempts = 0
        self._ask(_STATUS, now)

    @override
    def _end(self) -> None:
        self._is_ready = self._is_unresponsive = False
        self._question = None
        if self._sending is not None:
            self._fail("the port was lost", maybe_sent=True)

    # Time

    @override
    def _deadlines_s(self) -> Iterable[float | None]:
        if self._sending is not None:
            yield self._deadline_s(self._sending)
        elif self._question is not None:
            yield self._asked_s + self._settings.reply_timeout_s
        elif self._is_open:
            yield self._check_s()

    @override
    def _advance(self, now: float) -> None:
        super()._advance(now)
        if self._sending is not None:
            self._advance_sending(self._sending, now)
        if not self._is_open or self._sending is not None:
            return
        if self._question is not None:
            if now >= self._asked_s + self._settings.reply_timeout_s:
                self._no_reply(self._question, now)
        elif (packet := self._queue.take()) is not None:
            self._start(packet, now)
        elif now >= self._check_s():
            self._attempts = 0
            self._ask(_STATUS, now)

    def _check_s(self) -> float:
        return max(self._asked_s, self._message_s or 0.0) + CHECK_INTERVAL_S

    # Address and status

    def _ask(self, question: bytes, now: float) -> None:
        self._question, self._asked_s = question, now
        self._attempts += 1
        self._out.append(question)

    def _no_reply(self, question: bytes, now: float) -> None:
        if self._attempts >= ATTEMPTS and not self._is_unresponsive:
            self._is_ready, self._is_unresponsive = False, True
            silent_s = None if self._message_s is None else now - self._message_s
            self._events.append(ModemUnresponsive(question.decode("ascii"), self._attempts, silent_s))
        self._ask(question, now)

    def _on_status(self, status: messages.Status, now: float) -> None:
        if status.address == self._settings.address:
            if self._question is not None and not self._is_ready:
                self._is_ready, self._is_unresponsive = True, False
                self._events.append(ModemReady(status.address, status.firmware))
            self._question = None
        elif self._question == _STATUS:
            if self._is_ready:
                self._is_ready = False
                self._events.append(ModemRebooted(status.firmware or ""))
            # A wrong answer to this command waits for the reply timeout, so that the two cannot follow endlessly.
            self._ask(b"$A%03d" % self._settings.address, now)

    # Packets and pings

    def _start(self, packet: WaitingPacket, now: float) -> None:
        sending = _Sending(packet, b"", airtime_s(0), now)
        if sending.is_ping:
            command, sending.confirmation = messages.ping_command(packet.destination)
        else:
            address = self._settings.address if sending.expects_answer else packet.destination
            data = bytes((address,)) + (packet.frames[0] or b"\0")
            sending.airtime_s = airtime_s(len(data))
            if sending.expects_answer:
                command, sending.confirmation = messages.unicast_command(packet.destination, data)
            else:
                command, sending.confirmation = messages.broadcast_command(data)
        self._sending = sending
        self._out.append(command)

    def _deadline_s(self, sending: _Sending) -> float:
        if sending.confirmed_s is None:
            return sending.started_s + self._settings.reply_timeout_s
        end_s = sending.confirmed_s + sending.airtime_s + GUARD_S
        return end_s if sending.on_air or not self._is_waiting(sending) else end_s + ANSWER_LIMIT_S

    @staticmethod
    def _is_waiting(sending: _Sending) -> bool:
        return sending.expects_answer and sending.answered is None

    def _advance_sending(self, sending: _Sending, now: float) -> None:
        if now < self._deadline_s(sending):
            return
        if sending.confirmed_s is None:
            self._fail("the modem did not confirm the command", maybe_sent=True)
            self._attempts = 0
            self._ask(_STATUS, now)
            return
        if sending.on_air:
            sending.on_air = False
            self._events.append(TransmissionEnded(sending.airtime_s))
            if now < self._deadline_s(sending):
                return
        packet, self._sending = sending.packet, None
        acknowledged = (1,) if sending.answered else ()
        if not sending.is_ping:
            self._events.append(packet.sent(acknowledged, sending.started_s, now))
        elif sending.answered:
            self._events.append(RequestDone(packet.number, _PING, packet.destination))
        else:
            self._events.append(self._result(packet.failed("no answer")))

    def _fail(self, reason: str, *, maybe_sent: bool) -> None:
        sending, self._sending = self._sending, None
        if sending is not None:
            if sending.confirmed_s is not None and sending.on_air:
                self._events.append(TransmissionEnded(sending.airtime_s))
            self._events.append(self._result(sending.packet.failed(reason, maybe_sent=maybe_sent)))

    # Messages of the modem

    @override
    def _on_message(self, message: messages.NanoMessage, now: float) -> None:
        self._message_s = now
        match message:
            case messages.Status():
                self._on_status(message, now)
            case messages.NanoData():
                self._on_data(message, now)
            case messages.Refusal():
                self._events.append(ModemError("E"))
                if self._sending is not None and self._sending.confirmed_s is None:
                    self._fail("the modem refused the command", maybe_sent=False)
            case _:
                self._on_progress(message, now)

    def _on_progress(self, item: messages.NanoMessage, now: float) -> None:
        """Process what concerns the packet in progress; ignore it if it belongs to another one."""
        sending = self._sending
        if sending is None:
            return
        match item:
            case messages.Confirmation(text=text) if sending.confirmed_s is None and text == sending.confirmation:
                sending.confirmed_s = now
                self._events.append(TransmissionStarted(sending.airtime_s))
            case messages.Answer(source=source, travel_s=travel_s) if (
                sending.confirmed_s is not None and self._is_waiting(sending) and source == sending.packet.destination
            ):
                sending.answered = True
                self._events.append(RangeMeasured(source, self._settings.address, travel_s))
            case messages.NoAnswer() if sending.confirmed_s is not None and self._is_waiting(sending):
                sending.answered = False
            case _:
                pass

    def _on_data(self, received: messages.NanoData, now: float) -> None:
        address, data = received.data[0], received.data[1:]
        own = self._settings.address
        source, dest = (address, own) if received.source is None else (received.source, address)
        frame = FrameReceived(source, dest, received.source is None, 1, data, now, RATE, None)
        self._events += [frame, PacketReceived((frame,), 0, 1, source, dest, RATE, None, complete=True)]

    @override
    def _result(self, failed: PacketFailed) -> ModemEvent:
        """Return the failure of a packet, or of a ping, which is a packet without frames in the queue."""
        return failed if failed.frames else RequestFailed(failed.packet_id, _PING, failed.dest, failed.reason)


DRIVER = ModemDriver("nano", CAPABILITIES, NanoModem, "nanomodem v3 (NM3): 64-byte messages and ranging")
