"""The host side of a WHOI Micro-Modem: bytes and the time go in, events and bytes come out.

The driver does no input or output and reads no clock. Its owner gives it what the port has read (`receive`), calls
`poll` at `next_wakeup` and writes `bytes_to_send` to the port. All times are seconds of one monotonic clock.

Every wait has an end: a sentence that gets lost costs time, or at worst one packet, which is then reported as
failed, and the modem is asked for its address before the next one goes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem.events import FailureReason, ModemEvent, PollReceived, SentenceRejected
from sonarpost.modem.micromodem.machine import DriverStateMachine
from sonarpost.modem.micromodem.requests import RequestKind, flexible_command, mini_command, ping_command, poll_command
from sonarpost.modem.micromodem.supervisor import Phase
from sonarpost.modem.micromodem.transmit import OutgoingPacket, check_packet


class MicroModem(DriverStateMachine):
    """Drives one modem: configures it, sends packets one at a time, hands over what arrives.

    Args:
        config: Address, settings and time-outs.
        where: Names the port in errors.
    """

    @property
    def firmware(self) -> str | None:
        """Version the modem has told, or None."""
        return self._supervisor.firmware

    @property
    def queued(self) -> int:
        """How many packets and requests wait or are on their way."""
        return len(self._queue) + (not self._idle)

    @property
    def generation(self) -> int | None:
        """1 or 2, None while the modem has not told its version."""
        return self._supervisor.generation

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
        packet = OutgoingPacket(self._next_id, destination, rate, tuple(bytes(f) for f in frames), ack, now)
        self._enqueue(packet, now)
        return packet.packet_id

    def ping(self, destination: int, now: float) -> int:
        """Queue a ping; its `PingAnswered` tells the travel time, its `RequestDone` or `RequestFailed` the end.

        Raises:
            FrameError: An address outside 0..127.
        """
        return self._request(RequestKind.PING, destination, ping_command(self.config.address, destination), now)

    def send_mini(self, destination: int, bits: int, now: float) -> int:
        """Queue a user mini-packet of 13 bits; its end is a `RequestDone` or `RequestFailed`.

        Raises:
            FrameError: An address outside 0..127, or more than 13 bits.
        """
        command = mini_command(self.config.address, destination, bits)
        return self._request(RequestKind.MINI_PACKET, destination, command, now)

    def send_flexible(self, destination: int, rate: int, data: bytes, now: float) -> int:
        """Queue a packet of the flexible data protocol (Micro-Modem 2); its end is a `RequestDone` or `RequestFailed`.

        Raises:
            FrameError: An address outside 0..127, a rate other than 1, 3 or 5, no data or more than 2048 bytes.
        """
        command = flexible_command(destination, rate, data)
        return self._request(RequestKind.FLEXIBLE_DATA, destination, command, now, rate)

    def request_packet(
        self, source: int, rate: int, frames: int | None = None, *, ack: bool = False, now: float
    ) -> int:
        """Queue a poll: another modem is asked to send a packet here.

        What it sends comes as any packet does; the `RequestDone` follows it.

        Args:
            source: The modem that shall send.
            rate: Rate number, 0..6.
            frames: How many frames at most, None for all that the rate has.
            ack: Let it ask for acknowledgements.
            now: Time on the driver's clock.

        Raises:
            FrameError: An address outside 0..127, an unknown rate, or a number of frames it does not have.
        """
        command = poll_command(source, self.config.address, rate, frames, ack=ack)
        return self._request(RequestKind.POLL, source, command, now, rate)

    def set_poll_handler(self, uplink: Callable[[PollReceived], Sequence[bytes]] | None) -> None:
        """Give the function that is asked for frames when another modem polls this one.

        It is called inside `receive` and must not call back. No frames are a right answer: the modem then has nothing
        to send. Frames that do not fit what was asked for raise `FrameError` out of `receive`.
        """
        self._uplink = uplink

    def set_clock(self, utc: datetime, now: float) -> bool:
        """Set the modem's clock, if it is free at this moment; tell whether the command was sent.

        The time must be right when this is called, so it is not kept for later: on False, ask again. The answer
        is a `ClockConfirmed` or, without one, a `SettingRefused`.
        """
        if self.phase is not Phase.READY or self._cycle is not None:
            return False
        self._supervisor.set_clock(utc, now)
        return True

    def receive(self, data: bytes, now: float) -> list[ModemEvent]:
        """Take bytes from the port, in pieces of any size; whatever they are, the answer is events."""
        if self.phase is Phase.CLOSED:
            return self._take_events()
        for item in self._lines.feed(data):
            if isinstance(item, SentenceError):
                self._events.append(SentenceRejected(item))
                continue
            self._take(item, now)
            self._advance(now)
        return self._take_events()

    def poll(self, now: float) -> list[ModemEvent]:
        """Do what is due; call at `next_wakeup` or at any other time."""
        self._advance(now)
        return self._take_events()

    def next_wakeup(self) -> float | None:
        """Return when `poll` has something to do, or None; a time in the past means at once."""
        times_s = [self._events_since_s if self._events else None]
        times_s += [packet.queued_s + self.config.max_defer_s for packet in self._queue]
        if self.phase is not Phase.CLOSED:
            busy_s = self._requester.deadline_s if self._cycle is None else self._cycle.deadline_s
            # In the middle of a cycle the modem is not asked whether it is there: the cycle will tell.
            idle_s = None if not self._idle and self.phase is Phase.READY else self._supervisor.deadline_s
            times_s += [busy_s, idle_s, self._listener.deadline_s, self._foreign_until_s]
        return min((time_s for time_s in times_s if time_s is not None), default=None)

    def bytes_to_send(self) -> bytes:
        """Return, once, what is to be written to the port."""
        data = bytes(self._out)
        self._out.clear()
        return data
