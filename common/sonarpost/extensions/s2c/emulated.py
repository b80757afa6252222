r"""Emulated EvoLogics S2C modem: instant messages and burst data with their acknowledgements on the simulated channel.

It reads commands with the escape sequence of data mode, `+++AT…`, or those of command mode, and ends of line `\n` and
`\r`. In data mode all other bytes are raw data: burst data to the remote address, `AT!AR`. Raw data arrives as it is at
a modem in data mode, and as `RECV` at one in command mode; data of `AT*SEND` arrives as `RECV` in both. The modem
transmits no piggyback messages and repeats no instant message.
"""

import re
from dataclasses import dataclass
from typing import ClassVar, Final

from typing_extensions import override

from sonarpost.extensions.s2c.emulated_burst import ANSWER_LIMIT_S, BurstLink
from sonarpost.extensions.s2c.messages import MAX_DATA_BYTES
from sonarpost.extensions.s2c.rates import (
    ACK_AIRTIME_S,
    BROADCAST,
    BURST_BIT_RATE_BPS,
    BURST_BYTES,
    BURST_RATE,
    INSTANT_MESSAGE_BYTES,
    INSTANT_RATE,
    message_airtime_s,
)
from sonarpost.extensions.simulation.channel.events import (
    AcousticPacket,
    ArrivalEnded,
    ArrivalStarted,
    PacketKind,
    PacketOutcome,
)
from sonarpost.extensions.simulation.modem.packet_modem import PacketModem, good_frames
from sonarpost.extensions.simulation.modem.receiver import PacketReport
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig

FIRMWARE: Final = "1.8-sonarpost-emulator"

_ESCAPE: Final = b"+++AT"
_MESSAGE: Final = re.compile(rb"(?:\+\+\+)?AT\*SENDIM,(?:p\d{1,3},)?(\d{1,4}),(\d{1,3}),(ack|noack|force),")
_BURST: Final = re.compile(rb"(?:\+\+\+)?AT\*SEND,(?:p\d{1,3},)?(\d{1,4}),(\d{1,3}),")
_NAME: Final = re.compile(rb"(?:\+\+\+)?AT([^:,]{0,32})")
_SETTINGS: Final = {
    "L": 3, "LC": 0, "G": 0, "C": 0, "CA": 1500, "AM": 254, "RC": 3, "RT": 4000, "RI": 1, "RP": 0, "KO": 0, "DW": 0,
    "ZC": 10, "ZH": 0, "ZI": 120, "ZL": 65536, "ZP": 750, "ZS": 0, "ZU": 0, "ZX": 0,
}  # fmt: skip
"""Settings of the read sources. Their values at the start are plausible, not those of a firmware."""
_SETTING: Final = re.compile(rf"([!@](AL|AR|{'|'.join(_SETTINGS)}))(\d{{1,5}})")
_RAW_PAUSE_S: Final = 0.2  # raw data is sent after such a pause, when it fills a burst, or before a command
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

    INPUT_PAUSE_S: ClassVar[float] = 2.0  # longer than the longest command takes at 9600 bit/s

    def __init__(self, settings: EmulatedModemConfig) -> None:
        super().__init__(settings)
        self._raw = bytearray()
        self._raw_due_s = float("inf")
        self._after_cr = False
        self._travel_us = 0
        self._restart()

    def _restart(self) -> None:
        """Forget settings and messages; a transmission on the air ends without a report."""
        own = self.settings.address
        self._settings = {**_SETTINGS, "AL": own, "AR": 2 if own == 1 else 1}
        self._command_mode = False
        self._outstanding: _Outstanding | None = None
        self._bursts = BurstLink(self._transmit, self._notify)
        self._queue.clear()
        self._input.clear()

    @property
    @override
    def address(self) -> int:
        return self._settings["AL"]

    @override
    def poll(self, now: float) -> None:
        """Do what is due: transmissions, and the end of the wait for an acknowledgement."""
        if now >= self._raw_due_s:
            self._send_raw()
        self._bursts.poll(now)
        super().poll(now)
        if self._outstanding is not None and now >= self._outstanding.ack_until_s:
            self._notify(f"FAILEDIM,{self._outstanding.destination}")
            self._outstanding = None

    @override
    def next_deadline_s(self) -> float:
        waits_until_s = float("inf") if self._outstanding is None else self._outstanding.ack_until_s
        return min(super().next_deadline_s(), self._bursts.deadline_s(), waits_until_s, self._raw_due_s)

    @override
    def arrival_started(self, arrival: ArrivalStarted) -> None:
        """Report the start of a reception."""
        self._notify_extended("RECVSTART")

    @override
    def arrival_ended(self, arrival: ArrivalEnded) -> PacketReport:
        """Report the end of a reception, and its data."""
        if arrival.outcome is not PacketOutcome.ARRIVED and arrival.detected:
            self._notify_extended(f"RECVFAILED,0.0000,{_RSSI_DB},0")
        return super().arrival_ended(arrival)

    @override
    def _on_packet(self, arrival: ArrivalEnded, now: float) -> bytes:
        packet = arrival.transmission.packet
        is_own = packet.destination == self.address
        frames = good_frames(arrival)
        if packet.kind is PacketKind.DATA and None in frames:
            text = f"RECVFAILED,0.0000,{_RSSI_DB},0"
            return self._format("", text.encode()) if self._settings["ZX"] else b""
        duration_us = round(packet.airtime_s * 1e6)
        end = self._format("", f"RECVEND,{_clock_us(now)},{duration_us},{_RSSI_DB},{_INTEGRITY}".encode())
        reports = end if self._settings["ZX"] else b""
        if is_own and packet.rate == BURST_RATE:
            if reports:
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
            reply = AcousticPacket(PacketKind.ACK, self.address, packet.source, packet.rate, ACK_AIRTIME_S)
            self._transmit(reply)
        data = frames[0] or b""
        flag = "ack" if packet.ack_requested else "noack"
        head = f"RECVIM,{len(data)},{packet.source},{packet.destination},{flag},{duration_us},{_RSSI_DB},{_INTEGRITY}"
        return reports + self._format("", head.encode() + b",0.0000," + data)

    def _on_burst_packet(self, packet: AcousticPacket, frame: bytes | None, arrival: ArrivalEnded, now: float) -> bytes:
        received = self._bursts.on_packet(packet, frame, now)
        if received is None:
            return b""
        data, is_raw = received
        if is_raw and not self._command_mode:
            return data
        travel_us = round(arrival.delay_s * 1e6)
        head = f"RECV,{len(data)},{packet.source},{packet.destination},{BURST_BIT_RATE_BPS},{_RSSI_DB}"
        return self._format("", f"{head},{_INTEGRITY},{travel_us},0.0000,".encode() + data)

    @override
    def _on_started(self, packet: AcousticPacket, now: float) -> None:
        kind = _kind(packet)
        self._notify_extended(f"SENDSTART,{packet.destination},{kind},{round(packet.airtime_s * 1e6)},0")

    @override
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

    @override
    def _read_input(self, now: float) -> None:
        while self._input and self._take_first(now):
            pass

    def _take_first(self, now: float) -> bool:
        """Process the first command of the input, or the raw data before it; return whether it was complete."""
        if self._after_cr and self._input.startswith(b"\n"):
            del self._input[0]  # the command ended with CR LF
        self._after_cr = False
        if not self._command_mode and not self._input.startswith(_ESCAPE):
            return self._take_raw(now)
        self._send_raw()
        message = _MESSAGE.match(self._input) or _BURST.match(self._input)
        if message is not None:
            is_burst = message.re is _BURST
            command = "*SEND" if is_burst else "*SENDIM"
            length = int(message[1])
            end = message.end() + length
            if length <= MAX_DATA_BYTES and len(self._input) <= end:
                return False
            if length > MAX_DATA_BYTES or bytes(self._input[end : end + 1]) not in (b"\r", b"\n"):
                return self._refuse_input()
            destination, ack = int(message[2]), not is_burst and message[3] == b"ack"  # the match reads the input
            data = self._take_until(end)[message.end() :]
            answer = self._send_burst(destination, data) if is_burst else self._send_message(destination, data, ack=ack)
            self._reply(command, answer)
            return True
        line_end = re.search(rb"[\r\n]", self._input)
        if line_end is None:
            return len(self._input) > _MAX_LINE_BYTES and self._refuse_input()
        line = self._take_until(line_end.start()).removeprefix(b"+++")
        if line.startswith(b"AT"):
            self._on_command(line[2:].decode("latin-1"))
        return True

    def _take_raw(self, now: float) -> bool:
        """Take the raw data before the next command, without the end that may be a part of its escape sequence."""
        place = self._input.find(_ESCAPE)
        if place < 0:
            is_escape = (count for count in range(len(_ESCAPE) - 1, 0, -1) if self._input.endswith(_ESCAPE[:count]))
            place = len(self._input) - next(is_escape, 0)
        self._raw += self._input[:place]
        del self._input[:place]
        self._raw_due_s = now + _RAW_PAUSE_S
        if len(self._raw) >= BURST_BYTES:
            self._send_raw()
        return place > 0

    def _send_raw(self) -> None:
        data = bytes(self._raw)
        self._raw.clear()
        self._raw_due_s = float("inf")
        for start in range(0, len(data), BURST_BYTES):
            self._bursts.add_raw(self.address, self._settings["AR"], data[start : start + BURST_BYTES])

    @override
    def _on_pause(self) -> None:
        if not self._command_mode and not self._input.startswith(_ESCAPE):
            self._raw += self._input  # it looked like the beginning of an escape sequence
            self._send_raw()
        self._refuse_input()

    def _take_until(self, end: int) -> bytes:
        """Remove the input up to the end of line at `end`, and return it without that."""
        taken = bytes(self._input[:end])
        self._after_cr = self._input.startswith(b"\r", end)
        del self._input[: end + 1]
        return taken

    def _refuse_input(self) -> bool:
        """Drop the input, as its limits are unknown, and refuse its command if it has one."""
        name = _NAME.match(self._input)
        if name is not None:
            self._reply(name[1].decode("latin-1"), "ERROR WRONG FORMAT")
        self._input.clear()
        return True

    def _send_message(self, destination: int, data: bytes, *, ack: bool) -> str:
        if not 0 < len(data) <= INSTANT_MESSAGE_BYTES or destination > BROADCAST:
            return "ERROR OUT OF RANGE"
        if self._outstanding is not None or self.transmitting:
            return "BUSY DELIVERING MESSAGE"
        airtime_s = message_airtime_s(len(data))
        packet = AcousticPacket(
            PacketKind.DATA,
            self.address,
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
        return "OK" if self._bursts.add(self.address, destination, data) else "BUSY DELIVERING MESSAGE"

    def _on_command(self, command: str) -> None:
        replies = {f"?{name}": str(value) for name, value in self._settings.items()} | {
            "?BV": "24.0",
            "?ZD": str(self._bursts.dropped_bytes),
            "?T": str(self._travel_us),
            "?PC": str(self._bursts.number),
            "?S": "INITIATION LISTEN",
            "?MODE": "AT",
            "I0": FIRMWARE,
            "@CTRL": "OK",
        }
        if command in replies:
            self._reply(command, replies[command])
        elif (setting := _SETTING.fullmatch(command)) is not None:
            name, value = setting[2], int(setting[3])
            is_valid = name not in ("AL", "AR") or int(name == "AL") <= value < BROADCAST
            if is_valid:
                self._settings[name] = value
            self._reply(setting[1], "OK" if is_valid else "ERROR OUT OF RANGE")
        elif command in ("C", "O"):
            self._reply(command, "OK")
            self._command_mode = command == "C"
        elif command == "Z0":
            self._restart()
        elif command in ("Z1", "Z3", "Z4"):
            self._drop(bursts=command != "Z3", messages=command != "Z1")
            self._reply(command, "OK")
        else:
            self._reply(command[:32].partition(":")[0], "ERROR WRONG FORMAT")

    def _drop(self, *, bursts: bool, messages: bool) -> None:
        """Drop burst data or the instant message without a report; a transmission on the air is completed."""
        rates = (BURST_RATE,) * bursts + (INSTANT_RATE,) * messages
        kept = [sent for sent in self._queue if sent.kind is PacketKind.ACK or sent.rate not in rates]
        self._queue.clear()
        self._queue.extend(kept)
        if bursts:
            self._bursts.drop()
        if messages:
            self._outstanding = None

    def _reply(self, command: str, text: str) -> None:
        self._write(self._format(command, text.encode("latin-1")))

    def _notify(self, text: str) -> None:
        self._write(self._format("", text.encode()))

    def _notify_extended(self, text: str) -> None:
        if self._settings["ZX"]:
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
