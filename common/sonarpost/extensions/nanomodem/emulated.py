"""Emulated nanomodem v3 on the simulated channel.

It answers `$?`, `$A`, `$B`, `$U`, `$M` and `$P`. Any other command is answered with `E`: its length is not known, so it
ends with the next `$`, after 7 bytes or after a pause. A command that is cut ends in the same way. Packets take the air
time of their length. Sources are those of `sonarpost.extensions.nanomodem`; how a real modem treats a command during a
transmission is not known, here the packet waits.
"""

import math
import re
from typing import ClassVar, Final

from typing_extensions import override

from sonarpost.extensions.nanomodem.messages import TRAVEL_STEP_S
from sonarpost.extensions.nanomodem.rates import MAX_PAYLOAD_BYTES, RATE, airtime_s
from sonarpost.extensions.simulation.channel.events import AcousticPacket, ArrivalEnded, PacketKind
from sonarpost.extensions.simulation.modem.packet_modem import PacketModem, good_frames
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.interface import MAX_ADDRESS

ANSWER_TIMEOUT_S: Final = 4.0
"""Time after its transmission until the modem reports `#TO`."""
_SUPPLY: Final = round(5.0 * 65536 / 15)
"""Reading of a supply of 5 V."""
MIN_PAYLOAD_BYTES: Final = 2
_EVERYONE: Final = 255
"""Destination of a broadcast in the channel; no emulated modem has this address."""
_COMMAND: Final = re.compile(
    rb"\$(?:(?P<status>\?)|A(?P<own>\d{3})|P(?P<ping>\d{3})|(?P<kind>B|[UM](?P<to>\d{3}))(?P<length>\d\d))"
)
_LONGEST_HEAD: Final = 7


class EmulatedNanomodem(PacketModem):
    """One modem."""

    INPUT_PAUSE_S: ClassVar[float] = 0.4  # the developer's driver waits 0.5 s; the longest command takes 0.08 s

    def __init__(self, settings: EmulatedModemConfig) -> None:
        super().__init__(settings)
        self._address = settings.address
        self._awaits: int | None = None
        self._timeout_s = math.inf

    @property
    @override
    def address(self) -> int:
        """The modem's address, as the host has set it."""
        return self._address

    @override
    def _on_pause(self) -> None:
        if self._input:
            self._write(b"E\r\n")
        self._input.clear()

    @override
    def _read_input(self, now: float) -> None:
        while (start := self._input.find(b"$")) >= 0:
            del self._input[:start]
            head = bytes(self._input[:_LONGEST_HEAD])
            match = _COMMAND.match(head)
            if match is None:
                if len(head) < _LONGEST_HEAD and b"$" not in head[1:]:
                    return  # the rest of the command follows, or a pause
                self._write(b"E\r\n")
                del self._input[0]
                continue
            end = match.end() + int(match["length"] or 0)
            if len(self._input) < end:
                return
            content = bytes(self._input[match.end() : end])
            del self._input[:end]
            self._execute(match, content)
        self._input.clear()

    def _execute(self, match: re.Match[bytes], data: bytes) -> None:
        self._awaits, self._timeout_s = None, math.inf  # a command ends the wait for an answer
        if match["status"]:
            self._write(b"#A%03dV%05d\r\n" % (self._address, _SUPPLY))
            return
        address = int(match["own"] or match["ping"] or match["to"] or _EVERYONE)
        is_message = match["kind"] is not None
        is_refused = address > MAX_ADDRESS or (address == self._address and not match["own"])
        if is_refused or (is_message and not MIN_PAYLOAD_BYTES <= len(data) <= MAX_PAYLOAD_BYTES):
            self._write(b"E\r\n")
            return
        if match["own"]:
            self._address = address
            self._write(b"#A%03d\r\n" % address)
            return
        self._write(match[0] + b"\r\n")
        ack = is_message and match["kind"].startswith(b"M")
        self._awaits = address if ack or not is_message else None
        kind, frames = (PacketKind.DATA, (data,)) if is_message else (PacketKind.PING, ())
        self._transmit(AcousticPacket(kind, self._address, address, RATE, airtime_s(len(data)), frames, ack))

    @override
    def _on_sent(self, packet: AcousticPacket, now: float) -> None:
        if self._awaits is not None and packet.kind in (PacketKind.DATA, PacketKind.PING):
            self._timeout_s = now + ANSWER_TIMEOUT_S

    @override
    def poll(self, now: float) -> None:
        """Also report an answer that has not come in time."""
        super().poll(now)
        if now >= self._timeout_s:
            self._awaits, self._timeout_s = None, math.inf
            self._write(b"#TO\r\n")

    @override
    def next_deadline_s(self) -> float:
        return min(super().next_deadline_s(), self._timeout_s)

    @override
    def _on_packet(self, arrival: ArrivalEnded, now: float) -> bytes:
        packet = arrival.transmission.packet
        if packet.kind is PacketKind.DATA and packet.destination == _EVERYONE:
            return self._data(arrival, b"#B%03d" % packet.source)
        if packet.destination != self._address:
            return b""
        if packet.kind is PacketKind.ACK:
            if self._awaits != packet.source:
                return b""
            self._awaits, self._timeout_s = None, math.inf
            return b"#R%03dT%05d\r\n" % (packet.source, min(99_999, round(arrival.delay_s / TRAVEL_STEP_S)))
        text = b"" if packet.kind is PacketKind.PING else self._data(arrival, b"#U")
        if packet.kind is PacketKind.PING or (text and packet.ack_requested):
            self._transmit(AcousticPacket(PacketKind.ACK, self._address, packet.source, RATE, airtime_s(0)))
        return text

    @staticmethod
    def _data(arrival: ArrivalEnded, head: bytes) -> bytes:
        data = good_frames(arrival)[0]
        return b"" if data is None else head + b"%02d" % len(data) + data + b"\r\n"
