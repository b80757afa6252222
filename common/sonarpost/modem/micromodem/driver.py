"""Host side of a WHOI Micro-Modem: bytes and the time go in, events and bytes come out.

The driver does no input or output and reads no clock. Its owner passes the bytes read from the port to `receive`, calls
`poll` at `next_wakeup` and writes `bytes_to_send` to the port. All times are seconds of one monotonic clock.

Every wait is limited. A lost sentence costs time, or at most one packet, which is reported as failed. After a failed
packet the modem is queried before the next one is sent.
"""

from __future__ import annotations

from collections.abc import Sequence

from typing_extensions import override

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import Modem, ModemCapabilities, ModemEvent, PollHandler, SentenceRejected
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.dialogue import Dialogue
from sonarpost.modem.micromodem.nmea import LineAssembler, Sentence
from sonarpost.modem.micromodem.rates import CAPABILITIES
from sonarpost.modem.micromodem.requests import (
    FailureReason,
    ModemRequest,
    RequestKind,
    ping_command,
    poll_command,
)
from sonarpost.modem.micromodem.supervisor import Phase
from sonarpost.modem.packet_queue import PacketQueue, WaitingPacket
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
        self._queue: PacketQueue[WaitingPacket | ModemRequest] = PacketQueue(config.queued_packets, config.max_defer_s)
        self._last_number = 0
        self._out = bytearray()
        self._dialogue = Dialogue(config, self._send, self._next_number)
        self._events_since_s = 0.0

    @property
    @override
    def capabilities(self) -> ModemCapabilities:
        return CAPABILITIES

    @property
    def phase(self) -> Phase:
        """State towards the modem."""
        return self._dialogue.supervisor.phase

    @property
    @override
    def ready(self) -> bool:
        return self._dialogue.supervisor.ready

    @property
    def firmware(self) -> str | None:
        """Firmware version reported by the modem, or None."""
        return self._dialogue.supervisor.firmware

    @property
    @override
    def queued(self) -> int:
        return len(self._queue) + (self._dialogue.exchange is not None)

    @property
    @override
    def receiving(self) -> bool:
        return self._dialogue.reception.receiving

    @override
    def port_opened(self, now: float) -> None:
        if self.phase is not Phase.CLOSED:
            self.port_lost(now)
        self._dialogue.supervisor.open(now)
        self._advance(now)

    @override
    def port_lost(self, now: float) -> None:
        self._dialogue.supervisor.close()
        self._dialogue.abort(FailureReason.PORT_LOST, now)
        self._lines.reset()
        self._out.clear()
        self._events_since_s = now

    @override
    def send_packet(
        self, destination: int, rate: int, frames: Sequence[bytes], *, ack: bool = False, now: float
    ) -> int:
        CAPABILITIES.check_packet(destination, rate, frames)
        packet = WaitingPacket(self._next_number(), destination, rate, tuple(map(bytes, frames)), ack, now)
        self._enqueue(packet, now)
        return packet.number

    @override
    def ping(self, destination: int, now: float) -> int:
        """Queue a ping; `RangeMeasured` carries the travel time, `RequestDone` or `RequestFailed` the result.

        Raises:
            FrameError: An address outside 0..127.
        """
        return self._enqueue_request(RequestKind.PING, destination, ping_command(self.config.address, destination), now)

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
        self._dialogue.poll_handler = handler

    @override
    def receive(self, data: bytes, now: float) -> list[ModemEvent]:
        if self.phase is Phase.CLOSED:
            return self._take_events()
        for item in self._lines.feed(data):
            if isinstance(item, SentenceError):
                self._dialogue.events.append(SentenceRejected(item))
                continue
            self._dialogue.handle(item, now)
            self._advance(now)
        return self._take_events()

    @override
    def poll(self, now: float) -> list[ModemEvent]:
        self._advance(now)
        return self._take_events()

    @override
    def next_wakeup(self) -> float | None:
        times_s = [self._events_since_s if self._dialogue.events else None, self._queue.deadline_s()]
        if self.phase is not Phase.CLOSED:
            times_s += self._dialogue.deadlines_s()
        return min((time_s for time_s in times_s if time_s is not None), default=None)

    @override
    def bytes_to_send(self) -> bytes:
        data = bytes(self._out)
        self._out.clear()
        return data

    def _advance(self, now: float) -> None:
        self._events_since_s = now
        self._dialogue.events += [item.failed(FailureReason.DEFERRED_TOO_LONG) for item in self._queue.expire(now)]
        if self.phase is Phase.CLOSED:
            return
        self._dialogue.advance(now)
        if self._dialogue.may_start and (item := self._queue.take()) is not None:
            self._dialogue.start(item, now)

    def _enqueue_request(self, kind: RequestKind, peer: int, command: Sentence, now: float, rate: int = 0) -> int:
        request = ModemRequest(self._next_number(), kind, peer, command, rate, now)
        self._enqueue(request, now)
        return request.request_id

    def _enqueue(self, item: WaitingPacket | ModemRequest, now: float) -> None:
        if not self._queue.add(item):
            self._dialogue.events.append(item.failed(FailureReason.QUEUE_FULL))
        self._advance(now)

    def _next_number(self) -> int:
        self._last_number += 1
        return self._last_number

    def _send(self, sentence: Sentence) -> None:
        self._out += sentence.encode()

    def _take_events(self) -> list[ModemEvent]:
        events, self._dialogue.events = self._dialogue.events, []
        return events


def _create(settings: ModemSettings, where: str) -> MicroModem:
    config = MicroModemConfig(
        settings.address,
        reply_timeout_s=settings.reply_timeout_s,
        max_carrier_sense_s=settings.max_carrier_sense_s,
    )
    return MicroModem(config, where)


DRIVER = ModemDriver("micromodem", CAPABILITIES, _create, "WHOI Micro-Modem 1 and 2, on a serial line")
