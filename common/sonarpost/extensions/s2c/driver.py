r"""Driver of an EvoLogics S2C modem: packets as instant messages or as burst data.

The driver sends its commands with the escape sequence of data mode, `+++AT…`: the answers then have a length and name
their command. It accepts the answers of command mode too. One command waits for its answer at a time, and one
message for its end. After a missing answer the driver configures the modem again, so that late answers of
older commands are not taken for new ones.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from typing_extensions import override

from sonarpost.errors import FrameError, SentenceError
from sonarpost.extensions.s2c.messages import (
    DeliveryReport,
    RawMessage,
    ReceptionEnd,
    ReceptionStart,
    S2cData,
    S2cMessage,
    S2cMessageAssembler,
    S2cReply,
    SendEnd,
    SendStart,
    UsblPosition,
    parse,
    parse_travel_time_s,
)
from sonarpost.extensions.s2c.rates import BURST_FRAME_BYTES, BURST_RATE, CAPABILITIES, INSTANT_RATE, RATES
from sonarpost.modem.interface import (
    FrameReceived,
    ModemError,
    ModemEvent,
    ModemReady,
    ModemUnresponsive,
    PacketFailed,
    PacketReceived,
    PacketSent,
    RangeMeasured,
    ReceptionQuality,
    RequestDone,
    RequestFailed,
    SentenceRejected,
    SettingUnconfirmed,
    TransmissionEnded,
    TransmissionStarted,
)
from sonarpost.modem.packet_queue import QueueingModem, WaitingPacket
from sonarpost.modem.registry import ModemDriver, ModemSettings

LINE_ENDS: Final = (b"\n", b"\r")
"""End of a command: the first on Ethernet, the second on a serial port. The driver uses the one that is answered."""
ATTEMPTS: Final = 3
"""How often a command or a message is sent before it has failed."""
REFUSED_WAIT_S: Final = 1.0
"""Wait before a refused message is sent again."""
PAUSE_S: Final = 2.0
"""After such a pause an incomplete message of the modem is given up."""
MAX_RECEPTION_S: Final = 5.0
"""Longest reception; after it the driver no longer waits for its end."""
CHECK_INTERVAL_S: Final = 60.0
"""After such a silence of the modem the driver checks its address."""

PING_DATA: Final = b"\0"
"""Data of a ping and of an empty frame. The driver does not report such a message as a frame."""
BURST_REPLY_TIMEOUTS: Final = 12
"""How long accepted burst data may take, in reply timeouts: the modem connects and repeats by itself."""


@dataclass(slots=True)
class _Command:
    """A command that waits for its answer."""

    text: bytes
    deadline_s: float
    attempts: int = 1


@dataclass(slots=True)
class Sending:
    """An instant message or burst data in progress.

    Attributes:
        accepted: Whether the modem has accepted it.
        ended: Whether it has been transmitted.
        deadline_s: When its end is given up, or when it is sent again after a refusal.
        refused: Whether it waits to be sent again.
    """

    packet: WaitingPacket
    is_ping: bool
    started_s: float
    deadline_s: float = 0.0
    attempts: int = 0
    accepted: bool = False
    ended: bool = False
    delivered: bool = False
    refused: bool = False

    @property
    def is_burst(self) -> bool:
        """Whether it is burst data."""
        return self.packet.rate == BURST_RATE

    def command(self) -> bytes:
        """Return the command that sends it."""
        packet = self.packet
        # The receiver divides burst data into frames by their length, so all but the last one are filled with zeros.
        data = b"".join(frame.ljust(BURST_FRAME_BYTES, b"\0") for frame in packet.frames[:-1]) + packet.frames[-1]
        data = data or PING_DATA
        if self.is_burst:
            return b"AT*SEND,%d,%d,%b" % (len(data), packet.destination, data)
        flag = b"ack" if packet.ack else b"noack"
        return b"AT*SENDIM,%d,%d,%b,%b" % (len(data), packet.destination, flag, data)

    def limit_s(self, reply_timeout_s: float) -> float:
        """Return how long its end may take after the modem has accepted it, repetitions by the modem included."""
        if self.is_burst:
            return BURST_REPLY_TIMEOUTS * reply_timeout_s
        return 4 * RATES[self.packet.rate].airtime_s + (2 * reply_timeout_s if self.packet.ack else 3.0)

    def expects(self, report: DeliveryReport) -> bool:
        """Return whether a report can be the one of this message."""
        is_same = report.address == self.packet.destination and report.kind == ("" if self.is_burst else "IM")
        return self.accepted and is_same and not self.delivered

    def sent(self, now: float, *, delivered: bool) -> PacketSent:
        """Return its result: it was transmitted, as far as known."""
        acknowledged = range(1, len(self.packet.frames) + 1) if delivered and self.packet.ack else ()
        return self.packet.sent(acknowledged, self.started_s, now, end_reported=self.ended)


class S2cModem(QueueingModem[Sending, RawMessage]):
    """One modem.

    Args:
        settings: Its address and the limits of waits.
        where: Names the port in errors.

    Raises:
        ConfigError: An address outside 1..254.
    """

    def __init__(self, settings: ModemSettings, where: str = "modem port") -> None:
        super().__init__(CAPABILITIES, settings, where, S2cMessageAssembler(), PAUSE_S)
        self._has_sent_burst = False
        self._pings: set[int] = set()
        self._ready = False
        self._unresponsive = False
        self._failures = 0
        self._line_end = 0
        self._line_end_known = False
        self._escaped = False
        self._steps: list[tuple[bytes, bool]] = []
        self._command: _Command | None = None
        self._firmware: str | None = None
        self._answered_s: float | None = None
        self._receiving_until_s: float | None = None
        self._receiving_since_s = 0.0

    @property
    @override
    def ready(self) -> bool:
        return self._ready

    @property
    @override
    def receiving(self) -> bool:
        """Whether the modem has reported the start of a reception and not yet its end."""
        return self._receiving_until_s is not None

    @override
    def send_packet(
        self, destination: int, rate: int, frames: Sequence[bytes], *, ack: bool = False, now: float
    ) -> int:
        """Queue a packet; see `Modem.send_packet`. Burst data has no broadcast."""
        if rate == BURST_RATE and destination == CAPABILITIES.broadcast:
            raise FrameError("packet to send", "destination", destination, f"the address of one modem at rate {rate}")
        return super().send_packet(destination, rate, frames, ack=ack, now=now)

    @override
    def ping(self, destination: int, now: float) -> int:
        """Queue an acknowledged message whose travel time is measured; see `Modem.ping`."""
        CAPABILITIES.check_packet(destination, INSTANT_RATE, (PING_DATA,))
        if destination == CAPABILITIES.broadcast:
            raise FrameError("ping", "destination", destination, "the address of one modem")
        self._pings.add(self._next_id)
        return self._add(destination, INSTANT_RATE, (PING_DATA,), ack=True, now=now)

    @override
    def _begin(self, now: float) -> None:
        self._line_end_known = self._escaped = False
        self._configure(now)

    @override
    def _end(self) -> None:
        self._ready = False
        self._fail("the port was lost")
        self._steps.clear()
        self._command = self._receiving_until_s = None

    @override
    def _deadlines_s(self) -> Iterable[float | None]:
        yield self._receiving_until_s
        if self._command is not None:
            yield self._command.deadline_s
        elif self._is_open:
            yield max(self._answered_s or 0.0, self._received_s) + CHECK_INTERVAL_S
        if self._sending is not None and (self._sending.accepted or self._sending.refused):
            yield self._sending.deadline_s

    @override
    def _advance(self, now: float) -> None:
        super()._advance(now)
        if self._receiving_until_s is not None and now >= self._receiving_until_s:
            self._receiving_until_s = None
        if not self._is_open:
            return
        if self._command is not None:
            if now >= self._command.deadline_s:
                self._on_no_answer(self._command, now)
        elif self._steps:
            self._send_command(b"AT" + self._steps[0][0], now)
        elif self._sending is not None:
            self._advance_sending(self._sending, now)
        elif now >= max(self._answered_s or 0.0, self._received_s) + CHECK_INTERVAL_S:
            # A modem that has restarted has lost its settings.
            self._steps.extend(((b"@ZX1", False), (b"?AL", True)))
            self._send_command(b"AT" + self._steps[0][0], now)
        # A reception delays the next message, up to a limit.
        is_late = now - self._receiving_since_s >= self._settings.max_carrier_sense_s
        is_free = self._receiving_until_s is None or is_late
        if self._ready and self._sending is None and self._command is None and is_free:
            packet = self._queue.take()
            if packet is not None:
                is_ping = packet.number in self._pings
                self._pings.discard(packet.number)
                self._sending = Sending(packet, is_ping, now)
                self._send_message(self._sending, now)

    def _configure(self, now: float) -> None:
        """Begin the configuration; packets wait for its end."""
        own = str(self._settings.address).encode()
        # The first command shows whether the modem answers. Those that are not required are missing in older firmware.
        steps = (
            (b"?AL", True),
            # Burst data of before, whose late report would be taken for the next one.
            *(((b"Z1", False),) if self._has_sent_burst else ()),
            (b"@CTRL", False),
            (b"I0", False),
            (b"@ZX1", False),
            (b"!AL" + own, True),
            (b"?AL", True),
        )
        self._steps = list(steps)
        self._command = None
        self._ready = False
        self._events_since_s = now

    def _send_command(self, text: bytes, now: float) -> None:
        self._command = _Command(text, now + self._settings.reply_timeout_s)
        self._write(text)

    def _write(self, text: bytes) -> None:
        self._out.append(b"+++" + text + LINE_ENDS[self._line_end])

    def _on_no_answer(self, command: _Command, now: float) -> None:
        if not self._line_end_known:
            self._line_end = 1 - self._line_end
        if self._sending is not None:
            self._fail("the modem has not answered the command")
            self._configure(now)
            self._send_command(b"AT" + self._steps[0][0], now)
        elif command.attempts < ATTEMPTS or self._unresponsive:
            command.attempts += 1
            command.deadline_s = now + self._settings.reply_timeout_s
            self._write(command.text)
        else:
            self._report_unresponsive(command.text, now)
            self._line_end_known = False
            self._configure(now)
            self._send_command(b"AT" + self._steps[0][0], now)

    def _report_unresponsive(self, command: bytes, now: float) -> None:
        if not self._unresponsive:
            self._unresponsive = True
            silent_s = None if self._answered_s is None else now - self._answered_s
            self._events.append(ModemUnresponsive(command.decode("latin-1"), ATTEMPTS, silent_s))

    def _send_message(self, sending: Sending, now: float) -> None:
        sending.attempts += 1
        sending.refused = False
        self._has_sent_burst = self._has_sent_burst or sending.is_burst
        self._send_command(sending.command(), now)

    def _advance_sending(self, sending: Sending, now: float) -> None:
        if now < sending.deadline_s:
            return
        if sending.refused:
            self._send_message(sending, now)
        else:
            # The modem accepted the message and the time has passed: its report was lost, or the modem has restarted.
            self._finish(sending, now, delivered=False)
            self._configure(now)
            self._send_command(b"AT" + self._steps[0][0], now)

    @override
    def _on_message(self, message: RawMessage, now: float) -> None:
        if message.command is None and self._escaped:
            # Bytes outside messages are data of another modem: it must not pass for a message.
            error = SentenceError("S2C modem", "message", message.text[:40], "a message of data mode")
            self._events.append(SentenceRejected(error))
            return
        self._escaped = self._escaped or message.command is not None
        try:
            parsed = parse(message)
        except SentenceError as error:
            self._events.append(SentenceRejected(error))
        else:
            self._on_parsed(parsed, now)

    def _on_parsed(self, message: S2cMessage, now: float) -> None:
        self._answered_s = now
        match message:
            case S2cReply():
                self._on_reply(message, now)
            case S2cData():
                self._on_received(message, now)
            case DeliveryReport():
                self._on_report(message, now)
            case SendStart():
                self._events.append(TransmissionStarted(message.duration_s))
            case SendEnd():
                self._events.append(TransmissionEnded(message.duration_s))
                self._on_send_end(message, now)
            case ReceptionStart():
                if self._receiving_until_s is None:
                    self._receiving_since_s = now
                self._receiving_until_s = now + MAX_RECEPTION_S
            case ReceptionEnd():
                self._receiving_until_s = None
                if message.failed:
                    self._events.append(PacketReceived((), 1, None, None, None, None, None, complete=False))
            case UsblPosition():
                self._events.append(message)
            case _:
                pass

    def _on_reply(self, reply: S2cReply, now: float) -> None:
        command = self._command
        if command is None or not _answers(reply, command):
            return  # a late or repeated answer
        self._line_end_known = True
        self._command = None
        is_refused = reply.text.startswith(("BUSY", "ERROR"))
        if self._steps:
            self._on_setting(command, reply.text, is_refused=is_refused, now=now)
        elif self._sending is not None and self._sending.delivered:
            self._on_travel_time(self._sending, reply.text, now)
        elif self._sending is not None and is_refused:
            self._on_refused(self._sending, reply.text, now)
        elif self._sending is not None:
            self._sending.accepted = True
            self._sending.deadline_s = now + self._sending.limit_s(self._settings.reply_timeout_s)

    def _on_setting(self, command: _Command, text: str, *, is_refused: bool, now: float) -> None:
        step, is_required = self._steps[0]
        is_last = len(self._steps) == 1
        has_wrong_address = is_last and text != str(self._settings.address)
        if is_required and (is_refused or has_wrong_address):
            self._failures += 1
            if self._failures >= ATTEMPTS:
                self._report_unresponsive(command.text, now)
            # Wait as for an answer before the next attempt.
            self._configure(now)
            self._command = _Command(b"AT" + self._steps[0][0], now + self._settings.reply_timeout_s)
            return
        if step == b"@ZX1" and is_refused:
            self._events.append(SettingUnconfirmed("AT@ZX1"))
        if step == b"I0" and not is_refused:
            self._firmware = text[:40]
        self._steps.pop(0)
        if is_last:
            self._failures = 0
            self._unresponsive = False
            if not self._ready:
                self._ready = True
                self._events.append(ModemReady(self._settings.address, self._firmware))

    def _on_refused(self, sending: Sending, text: str, now: float) -> None:
        if text.startswith("ERROR"):
            self._events.append(ModemError(text[:200]))
        self._retry(sending, text[:80], now)

    def _retry(self, sending: Sending, reason: str, now: float) -> None:
        if sending.attempts >= ATTEMPTS:
            self._fail(f"the modem has refused the message: {reason}", maybe_sent=sending.ended)
            return
        sending.accepted = sending.ended = False
        sending.refused = True
        sending.deadline_s = now + REFUSED_WAIT_S

    def _on_send_end(self, message: SendEnd, now: float) -> None:
        sending = self._sending
        if sending is None or not sending.accepted or message.kind != "im" or sending.is_burst:
            return  # the modem transmits acknowledgements of its own too; a report ends burst data
        if message.address != sending.packet.destination:
            return
        sending.ended = True
        if not sending.packet.ack:
            self._finish(sending, now, delivered=False)

    def _on_report(self, report: DeliveryReport, now: float) -> None:
        sending = self._sending
        if sending is None or not sending.expects(report):
            return
        if report.result == "CANCELED":
            self._retry(sending, "the modem has canceled it", now)
        elif report.result == "DELIVERED" and sending.packet.ack and sending.is_ping:
            sending.delivered = True
            self._send_command(b"AT?T", now)
        elif sending.packet.ack or sending.is_burst:
            sending.ended = True
            self._finish(sending, now, delivered=report.result == "DELIVERED")

    def _on_travel_time(self, sending: Sending, text: str, now: float) -> None:
        packet = sending.packet
        travel_s = parse_travel_time_s(text)
        if travel_s is None:
            self._fail("the modem has reported no travel time")
            return
        self._sending = None
        self._events.append(RangeMeasured(packet.destination, self._settings.address, travel_s))
        self._events.append(RequestDone(packet.number, "ping", packet.destination))

    def _finish(self, sending: Sending, now: float, *, delivered: bool) -> None:
        """End the message in progress: it was transmitted, as far as known."""
        if sending.is_ping:
            self._fail("the other modem has not answered")
            return
        self._sending = None
        self._events.append(sending.sent(now, delivered=delivered))

    def _fail(self, reason: str, *, maybe_sent: bool = True) -> None:
        """End the message in progress, if there is one: it has failed."""
        sending, self._sending = self._sending, None
        self._command = None
        if sending is None:
            return
        packet = sending.packet
        if sending.is_ping:
            self._events.append(RequestFailed(packet.number, "ping", packet.destination, reason))
        else:
            self._events.append(packet.failed(reason, maybe_sent=maybe_sent))

    @override
    def _result(self, failed: PacketFailed) -> ModemEvent:
        """Return the failure of a packet or a ping that left the queue."""
        if failed.packet_id not in self._pings:
            return failed
        self._pings.discard(failed.packet_id)
        return RequestFailed(failed.packet_id, "ping", failed.dest, failed.reason)

    def _on_received(self, received: S2cData, now: float) -> None:
        self._receiving_until_s = None
        if received.data == PING_DATA:
            return
        rate = {"IM": INSTANT_RATE, "": BURST_RATE}.get(received.kind)
        starts = range(0, max(1, len(received.data)), BURST_FRAME_BYTES)
        parts = [received.data[start : start + BURST_FRAME_BYTES] for start in starts]
        source, destination = received.source, received.destination
        quality = ReceptionQuality(doppler=received.velocity_mps, nframes=len(parts), nbad=0)
        frames = tuple(
            FrameReceived(source, destination, received.ack, number, part, now, rate, quality)
            for number, part in enumerate(parts, start=1)
        )
        packet = PacketReceived(frames, 0, len(frames), source, destination, rate, quality, complete=True)
        self._events += [*frames, packet]


def _answers(reply: S2cReply, command: _Command) -> bool:
    """Return whether a reply can be the one to a command. In command mode a reply does not name its command."""
    if reply.command is None:
        return True
    name, comma, _ = command.text.partition(b",")
    asked = f"AT{reply.command}".encode()
    # `*SEND` is no answer to `*SENDIM`; the answer to `@ZX1` names `@ZX`.
    return name == asked if comma else reply.command != "" and name.startswith(asked)


DRIVER = ModemDriver("s2c", CAPABILITIES, S2cModem, "EvoLogics S2C: instant messages and burst data")
