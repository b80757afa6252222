r"""Emulated EvoLogics S2C modem: instant messages and burst data with their acknowledgements on the simulated channel.

It reads commands with the escape sequence of data mode, `+++AT…`, or those of command mode, and ends of line `\n` and
`\r`. It does not transmit piggyback messages or raw bytes of data mode, and repeats no instant message.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from sonarpost.modem.s2c.messages import MAX_DATA_BYTES
from sonarpost.modem.s2c.rates import (
    ACK_AIRTIME_S,
    BROADCAST,
    BURST_BIT_RATE_BPS,
    BURST_BYTES,
    BURST_RATE,
    INSTANT_MESSAGE_BYTES,
    INSTANT_RATE,
    message_airtime_s,
)
from sonarpost.simulation.channel.events import (
    AcousticPacket,
    ArrivalEnded,
    ArrivalStarted,
    PacketKind,
    PacketOutcome,
)
from sonarpost.simulation.modem.packet_modem import PacketModem, PacketModemSettings, good_frames
from sonarpost.simulation.modem.receiver import PacketReport
from sonarpost.simulation.modem.s2c_burst import ANSWER_LIMIT_S, BurstLink

FIRMWARE: Final = "1.8-sonarpost-emulator"

_ESCAPE: Final = b"+++"
_MESSAGE: Final = re.compile(rb"(?:\+\+\+)?AT\*SENDIM,(?:p\d{1,3},)?(\d{1,4}),(\d{1,3}),(ack|noack|force),")
_BURST: Final = re.compile(rb"(?:\+\+\+)?AT\*SEND,(?:p\d{1,3},)?(\d{1,4}),(\d{1,3}),")
_SETTING: Final = re.compile(r"!(?:L|LC|G|C|CA|AM|RC|RT)\d{1,5}|@ZU[01]")
"""Settings that have no effect: source level, gain, sound speed, retries of real burst data, USBL and others."""
_MAX_LINE_BYTES: Final = 256
_RSSI_DB: Final = -40
_INTEGRITY: Final = 150


@dataclass(slots=True)
class _Outstanding:
    """The instant message in progress; `ack_until_s` is set after its transmission when it is to be acknowledged."""

    destination: int
    ack: bool
    ack_until_s: float = float("inf")


class EmulatedS2c(PacketModem):
    """One modem."""

    def __init__(self, settings: PacketModemSettings) -> None:
        super().__init__(settings)
        self._address = settings.address
        self._input = bytearray()
        self._command_mode = False
        self._extended = False
        self._outstanding: _Outstanding | None = None
        self._travel_us = 0
        self._bursts = BurstLink(self._transmit, self._notify)

    @property
    def address(self) -> int:
        """The modem's address."""
        return self._address

    def host_disconnected(self) -> None:
        """Drop the unfinished input."""
        self._input.clear()

    def receive(self, data: bytes, now: float) -> None:
        """Process bytes from the host."""
        self._input += data
        while self._input and self._take_command(now):
            pass

    def poll(self, now: float) -> None:
        """Do what is due: transmissions, and the end of the wait for an acknowledgement."""
        self._bursts.poll(now)
        super().poll(now)
        if self._outstanding is not None and now >= self._outstanding.ack_until_s:
            self._notify(f"FAILEDIM,{self._outstanding.destination}")
            self._outstanding = None

    def next_deadline_s(self) -> float:
        """Return the simulated time at which `poll` has something to do."""
        waits_until_s = float("inf") if self._outstanding is None else self._outstanding.ack_until_s
        return min(super().next_deadline_s(), self._bursts.deadline_s(), waits_until_s)

    def arrival_started(self, arrival: ArrivalStarted) -> None:
        """Report the start of a reception."""
        self._notify_extended("RECVSTART")

    def arrival_ended(self, arrival: ArrivalEnded) -> PacketReport:
        """Report the end of a reception, and its data."""
        if arrival.outcome is not PacketOutcome.ARRIVED and arrival.detected:
            self._notify_extended(f"RECVFAILED,0.0000,{_RSSI_DB},0")
        return super().arrival_ended(arrival)

    def _on_packet(self, arrival: ArrivalEnded, now: float) -> bytes:
        packet = arrival.transmission.packet
        is_own = packet.destination == self._address
        frames = good_frames(arrival)
        if packet.kind is PacketKind.DATA and None in frames:
            text = f"RECVFAILED,0.0000,{_RSSI_DB},0"
            return self._format("", text.encode()) if self._extended else b""
        duration_us = round(packet.airtime_s * 1e6)
        end = self._format("", f"RECVEND,{_clock_us(now)},{duration_us},{_RSSI_DB},{_INTEGRITY}".encode())
        reports = end if self._extended else b""
        if is_own and packet.rate == BURST_RATE:
            self._write(reports)
            return self._on_burst_packet(packet, frames[0] if frames else None, arrival, now)
        if packet.kind is PacketKind.ACK:
            if is_own and self._outstanding is not None and self._outstanding.destination == packet.source:
                self._outstanding = None
                self._travel_us = round(arrival.delay_s * 1e6)
                reports += self._format("", b"DELIVEREDIM,%d" % packet.source)
            return reports
        if packet.kind is not PacketKind.DATA or not (is_own or packet.destination == BROADCAST):
            return reports
        if packet.ack_requested and is_own:
            reply = AcousticPacket(PacketKind.ACK, self._address, packet.source, packet.rate, ACK_AIRTIME_S)
            self._transmit(reply)
        data = frames[0] or b""
        flag = "ack" if packet.ack_requested else "noack"
        head = f"RECVIM,{len(data)},{packet.source},{packet.destination},{flag},{duration_us},{_RSSI_DB},{_INTEGRITY}"
        return reports + self._format("", head.encode() + b",0.0000," + data)

    def _on_burst_packet(self, packet: AcousticPacket, frame: bytes | None, arrival: ArrivalEnded, now: float) -> bytes:
        data = self._bursts.on_packet(packet, frame, now)
        if data is None:
            return b""
        travel_us = round(arrival.delay_s * 1e6)
        head = f"RECV,{len(data)},{packet.source},{packet.destination},{BURST_BIT_RATE_BPS},{_RSSI_DB}"
        return self._format("", f"{head},{_INTEGRITY},{travel_us},0.0000,".encode() + data)

    def _on_started(self, packet: AcousticPacket, now: float) -> None:
        kind = _kind(packet)
        self._notify_extended(f"SENDSTART,{packet.destination},{kind},{round(packet.airtime_s * 1e6)},0")

    def _on_sent(self, packet: AcousticPacket, now: float) -> None:
        kind = _kind(packet)
        duration_us = round(packet.airtime_s * 1e6)
        self._notify_extended(f"SENDEND,{packet.destination},{kind},{_clock_us(now)},{duration_us}")
        if packet.rate == BURST_RATE:
            self._bursts.on_sent(packet, now)
        elif packet.kind is PacketKind.DATA and self._outstanding is not None:
            if self._outstanding.ack:
                self._outstanding.ack_until_s = now + ANSWER_LIMIT_S
            else:
                self._outstanding = None

    def _take_command(self, now: float) -> bool:
        """Process the first command of the input; return whether it was complete."""
        message = _MESSAGE.match(self._input) or _BURST.match(self._input)
        if message is not None:
            is_burst = message.re is _BURST
            command = "*SEND" if is_burst else "*SENDIM"
            length = int(message[1])
            end = message.end() + length
            if length > MAX_DATA_BYTES:
                return self._drop_line(command, "ERROR WRONG FORMAT")
            if len(self._input) <= end:
                return False
            if bytes(self._input[end : end + 1]) not in (b"\r", b"\n"):
                return self._drop_line(command, "ERROR WRONG FORMAT")
            data = bytes(self._input[message.end() : end])
            destination, ack = int(message[2]), not is_burst and message[3] == b"ack"  # the match reads the input
            del self._input[: end + 1]
            answer = self._send_burst(destination, data) if is_burst else self._send_message(destination, data, ack=ack)
            self._reply(command, answer)
            return True
        ends = [place for mark in (b"\n", b"\r") if (place := self._input.find(mark)) >= 0]
        if not ends:
            if len(self._input) > _MAX_LINE_BYTES:
                self._input.clear()
            return False
        line = bytes(self._input[: min(ends)])
        del self._input[: min(ends) + 1]
        if line:
            self._on_line(line)
        return True

    def _drop_line(self, command: str, reason: str) -> bool:
        """Drop the input: its limits are unknown."""
        self._input.clear()
        self._reply(command, reason)
        return True

    def _send_message(self, destination: int, data: bytes, *, ack: bool) -> str:
        if not 0 < len(data) <= INSTANT_MESSAGE_BYTES or destination > BROADCAST:
            return "ERROR OUT OF RANGE"
        if self._outstanding is not None or self.transmitting:
            return "BUSY DELIVERING MESSAGE"
        airtime_s = message_airtime_s(len(data))
        packet = AcousticPacket(
            PacketKind.DATA,
            self._address,
            destination,
            INSTANT_RATE,
            airtime_s,
            (data,),
            ack_requested=ack,
            announced_frames=1,
        )
        self._outstanding = _Outstanding(destination, ack and destination != BROADCAST)
        self._transmit(packet)
        return "OK"

    def _send_burst(self, destination: int, data: bytes) -> str:
        if not 0 < len(data) <= BURST_BYTES or destination >= BROADCAST:
            return "ERROR OUT OF RANGE"
        return "OK" if self._bursts.add(self._address, destination, data) else "BUSY DELIVERING MESSAGE"

    def _on_line(self, line: bytes) -> None:
        is_escaped = line.startswith(_ESCAPE)
        if not is_escaped and not self._command_mode:
            return  # burst data of data mode
        text = line.removeprefix(_ESCAPE).decode("latin-1")
        if not text.startswith("AT"):
            return
        command = text[2:]
        replies = {
            "?AL": str(self._address),
            "?T": str(self._travel_us),
            "?PC": str(self._bursts.number),
            "?S": "INITIATION LISTEN",
            "?MODE": "AT",
            "I0": FIRMWARE,
            "@CTRL": "OK",
        }
        if command in replies:
            self._reply(command, replies[command])
        elif command in ("@ZX0", "@ZX1"):
            self._extended = command == "@ZX1"
            self._reply("@ZX", "OK")
        elif (address := re.fullmatch(r"!AL(\d{1,3})", command)) is not None and 1 <= int(address[1]) < BROADCAST:
            self._address = int(address[1])
            self._reply("!AL", "OK")
        elif command in ("C", "O"):
            self._reply(command, "OK")
            self._command_mode = command == "C"
        elif _SETTING.fullmatch(command):
            self._reply(command.rstrip("0123456789"), "OK")
        elif command == "Z0":
            self._restart()
        elif command == "Z1":
            self._bursts.drop()
            self._reply(command, "OK")
        else:
            self._reply(command[:32].partition(":")[0], "ERROR WRONG FORMAT")

    def _restart(self) -> None:
        """Forget settings and messages; a transmission on the air ends without a report."""
        self._command_mode = self._extended = False
        self._outstanding = None
        self._bursts = BurstLink(self._transmit, self._notify)
        self._queue.clear()
        self._input.clear()

    def _reply(self, command: str, text: str) -> None:
        self._write(self._format(command, text.encode("latin-1")))

    def _notify(self, text: str) -> None:
        self._write(self._format("", text.encode()))

    def _notify_extended(self, text: str) -> None:
        if self._extended:
            self._notify(text)

    def _format(self, command: str, text: bytes) -> bytes:
        if self._command_mode:
            return text + b"\r\n"
        return b"+++AT%b:%d:%b\r\n" % (command.encode("latin-1"), len(text), text)


def _clock_us(now: float) -> int:
    return int(now * 1e6) % 2**32


def _kind(packet: AcousticPacket) -> str:
    """Return the word for a packet in the reports of its transmission."""
    if packet.kind is PacketKind.DATA:
        return "im" if packet.rate == INSTANT_RATE else "burst"
    return "ack"
