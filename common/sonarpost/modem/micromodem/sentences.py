"""Typed sentences of the Micro-Modem.

`parse` reads a `Sentence` or raises `SentenceError` with kind, field, value and expectation. `CC` sentences go from
host to modem, `CA` sentences from modem to host. Addresses are 0..127, frame numbers start at 1, binary data is hex.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import RangeMeasured, ReceptionQuality, ShortMessageReceived
from sonarpost.modem.micromodem.nmea import FieldReader, Sentence

MAX_MINI_BITS = 0x1FFF
"""A user mini-packet carries 13 bits."""

_MAX_FRAME_NUMBER = 255
_MAX_BYTES = 65535
_MAX_RATE = 255
_MAX_SETTING = 2**31
_MAX_TRAVEL_S = 3600.0
_SETTING_INTEGER = re.compile(r"[+-]?[0-9]{1,10}")
_MINI_BITS = re.compile(r"[0-9A-Fa-f]{1,4}")

_FIRST_VERSIONED = 6
"""First version of `CACST` that includes its version."""
_INTEGER_STATISTICS = {
    "spl_db": 6, "rate": 12, "src": 13, "dest": 14, "packet_type": 16, "nframes": 17, "nbad": 18,
}  # fmt: skip
_REAL_STATISTICS = {"snr_in_db": 20, "snr_out_db": 21, "mse_db": 23, "doppler": 25}
"""Fields of `CACST` that the driver uses, by their index after the version."""


@dataclass(frozen=True, slots=True)
class Cycle:
    """`CCCYC,command,src,dest,rate,ack,nframes`, its echo `CACYC`, and the announcement `CACYC` at the far modem.

    Attributes:
        rate: Rate number (newer firmware may announce others than those in `RATES`).
        command: First field, 0 for a data cycle.
    """

    src: int
    dest: int
    rate: int
    ack: bool
    nframes: int
    command: int = 0

    @classmethod
    def parse(cls, sentence: Sentence) -> Cycle:
        """Read `CCCYC` or `CACYC`."""
        read = FieldReader(sentence, ("CACYC", "CCCYC"), 6)
        return cls(
            command=read.integer(0, "command", 0, 255),
            src=read.address(1, "src"),
            dest=read.address(2, "dest"),
            rate=read.integer(3, "rate", 0, _MAX_RATE),
            ack=read.flag(4, "ack"),
            nframes=read.integer(5, "nframes", 0, _MAX_FRAME_NUMBER),
        )

    def sentence(self, kind: str = "CCCYC") -> Sentence:
        """Return the command, or with "CACYC" its echo."""
        fields = (self.command, self.src, self.dest, self.rate, int(self.ack), self.nframes)
        return Sentence(kind, tuple(str(field) for field in fields))


@dataclass(frozen=True, slots=True)
class DataRequest:
    """`CADRQ,hhmmss,src,dest,ack,maxbytes,frame`: the modem requests the data of a frame."""

    src: int
    dest: int
    ack: bool
    max_bytes: int
    frame_number: int

    @classmethod
    def parse(cls, sentence: Sentence) -> DataRequest:
        """Read `CADRQ`."""
        read = FieldReader(sentence, ("CADRQ",), 6)
        return cls(
            src=read.address(1, "src"),
            dest=read.address(2, "dest"),
            ack=read.flag(3, "ack"),
            max_bytes=read.integer(4, "maxbytes", 0, _MAX_BYTES),
            frame_number=read.integer(5, "frame", 1, _MAX_FRAME_NUMBER),
        )


def transmit_data(src: int, dest: int, data: bytes, *, ack: bool) -> Sentence:
    """Return `CCTXD,src,dest,ack,hex`, the answer to a `DataRequest`; empty data means that no more follows."""
    return Sentence("CCTXD", (str(src), str(dest), str(int(ack)), data.hex().upper()))


def accepted_bytes(sentence: Sentence) -> int:
    """Return how many bytes of a frame the modem has accepted: `nbytes` of `CATXD,src,dest,ack,nbytes`."""
    read = FieldReader(sentence, ("CATXD",), 4)
    read.address(0, "src")
    read.address(1, "dest")
    read.flag(2, "ack")
    return read.integer(3, "nbytes", 0, _MAX_BYTES)


@dataclass(frozen=True, slots=True)
class TransmitMark:
    """`CATXP,nbytes` (a transmission starts) or `CATXF,nbytes` (it ends); the count may be absent."""

    ends: bool
    nbytes: int | None = None

    @classmethod
    def parse(cls, sentence: Sentence) -> TransmitMark:
        """Read `CATXP` or `CATXF`."""
        read = FieldReader(sentence, ("CATXP", "CATXF"))
        return cls(sentence.kind == "CATXF", read.optional_integer(0, "nbytes", 0, _MAX_BYTES))


@dataclass(frozen=True, slots=True)
class ReceivedData:
    """`CARXD,src,dest,ack,frame,hex`: one good frame of a packet.

    A frame that was given to the far modem as text comes as `CARXA`, with text instead of hex.
    """

    src: int
    dest: int
    ack: bool
    frame_number: int
    data: bytes

    @classmethod
    def parse(cls, sentence: Sentence) -> ReceivedData:
        """Read `CARXD` or `CARXA`."""
        read = FieldReader(sentence, ("CARXA", "CARXD"), 4)
        is_text = sentence.kind == "CARXA"
        # Text may contain commas.
        data = ",".join(sentence.fields[4:]).encode("ascii") if is_text else read.data(4, "data")
        frame_number = read.integer(3, "frame", 1, _MAX_FRAME_NUMBER)
        return cls(read.address(0, "src"), read.address(1, "dest"), read.flag(2, "ack"), frame_number, data)


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """`CAACK,src,dest,frame,1`: an acoustic acknowledgement by the modem `src`; a missing flag means good."""

    src: int
    dest: int
    frame_number: int
    good: bool = True

    @classmethod
    def parse(cls, sentence: Sentence) -> Acknowledgement:
        """Read `CAACK`."""
        read = FieldReader(sentence, ("CAACK",), 3)
        frame_number = read.integer(2, "frame", 1, _MAX_FRAME_NUMBER)
        good = read.optional_integer(3, "flag", 0, 1) != 0
        return cls(read.address(0, "src"), read.address(1, "dest"), frame_number, good)


def message_text(sentence: Sentence) -> str:
    """Return the first field of `CAMSG`: BAD_CRC for a damaged frame, PACKET_TIMEOUT for an incomplete packet."""
    return FieldReader(sentence, ("CAMSG",), 1).name(0, "text")


@dataclass(frozen=True, slots=True)
class ConfigurationSetting:
    """`CACFG,name,value`: a setting; a Micro-Modem 2 has dotted names, and some values are not integers."""

    name: str
    value: str

    @classmethod
    def parse(cls, sentence: Sentence) -> ConfigurationSetting:
        """Read `CACFG`."""
        read = FieldReader(sentence, ("CACFG",), 2)
        return cls(read.name(0, "name"), ",".join(sentence.fields[1:]).strip())

    @property
    def number(self) -> int | None:
        """The value as an integer, or None; leading zeros are accepted."""
        return int(self.value) if _SETTING_INTEGER.fullmatch(self.value) else None


@dataclass(frozen=True, slots=True)
class Revision:
    """`CAREV,hhmmss,role,version`: sent periodically, and as INIT after a restart.

    Attributes:
        role: AUV, INIT, COPROC or a value of newer firmware.
        version: Four parts on a Micro-Modem 1, three on a 2; empty where absent.
    """

    role: str
    version: str = ""

    @classmethod
    def parse(cls, sentence: Sentence) -> Revision:
        """Read `CAREV`."""
        read = FieldReader(sentence, ("CAREV",), 2)
        return cls(role=read.name(1, "role"), version=read.text(2))

    @property
    def rebooted(self) -> bool:
        """Whether the modem has just started."""
        return self.role == "INIT"


@dataclass(frozen=True, slots=True)
class ErrorReport:
    """`CAERR,hhmmss,module,errno,message`, or `CAERR,hhmmss,DATA_TIMEOUT,frame`.

    Attributes:
        module: Module of the modem that reports the error, or DATA_TIMEOUT.
        number: Error number or, for DATA_TIMEOUT, the frame without data; None where it is not an integer.
        message: The remaining fields, as text.
    """

    module: str
    number: int | None = None
    message: str = ""

    @property
    def text(self) -> str:
        """The report as one line of text."""
        return ", ".join(
            part for part in (self.module, "" if self.number is None else str(self.number), self.message) if part
        )

    @classmethod
    def parse(cls, sentence: Sentence) -> ErrorReport:
        """Read `CAERR`; an invalid number becomes part of the message."""
        read = FieldReader(sentence, ("CAERR",), 2)
        module, rest = read.name(1, "module"), sentence.fields[2:]
        try:
            number = read.optional_integer(2, "errno", -_MAX_SETTING, _MAX_SETTING)
        except SentenceError:
            return cls(module, None, ",".join(rest))
        return cls(module, number, ",".join(rest[1:]))

    @property
    def data_timeout(self) -> bool:
        """Whether the modem has received no data for a frame in time."""
        return self.module == "DATA_TIMEOUT"


def range_measured(sentence: Sentence) -> RangeMeasured:
    """Read `CAMPR,src,dest,travel_s`: the reply of `src` to a ping; the one-way travel time may be absent."""
    read = FieldReader(sentence, ("CAMPR",), 2)
    travel_s = read.optional_real(2, "travel time")
    if travel_s is not None and not 0.0 <= travel_s <= _MAX_TRAVEL_S:
        raise SentenceError(sentence.kind, "travel time", travel_s, f"0..{_MAX_TRAVEL_S:g} seconds")
    return RangeMeasured(read.address(0, "src"), read.address(1, "dest"), travel_s)


def short_message(sentence: Sentence) -> ShortMessageReceived:
    """Read `CAMUA,src,dest,HHHH`: a user mini-packet of 13 bits."""
    read = FieldReader(sentence, ("CAMUA",), 3)
    text = read.text(2).strip()
    if not _MINI_BITS.fullmatch(text) or int(text, 16) > MAX_MINI_BITS:
        raise SentenceError(sentence.kind, "bits", text, f"hex, at most {MAX_MINI_BITS:X}")
    return ShortMessageReceived(read.address(0, "src"), read.address(1, "dest"), int(text, 16))


@dataclass(frozen=True, slots=True)
class LinkStatistics(ReceptionQuality):
    """`CACST`: the measurements of a reception that the driver uses. None where this modem does not report a value.

    The layout is that of version 6 and later; older firmware has the same order, without the version.

    Attributes:
        mode: 0 good, 1 bad CRC, 2 time-out.
        packet_type: 1 FSK, 2 FSK mini, 3 PSK, 4 PSK mini, 5 flexible data.
    """

    mode: int = 0
    rate: int | None = None
    src: int | None = None
    dest: int | None = None
    packet_type: int | None = None

    @classmethod
    def parse(cls, sentence: Sentence) -> LinkStatistics:
        """Read `CACST`."""
        first = FieldReader(sentence, ("CACST",), 2).integer(0, "version", 0, 99)
        fields = sentence.fields[1:] if first >= _FIRST_VERSIONED else sentence.fields
        read = FieldReader(Sentence(sentence.kind, fields))
        return cls(
            mode=read.integer(0, "mode", 0, 255),
            **{name: read.optional_integer(index, name) for name, index in _INTEGER_STATISTICS.items()},
            **{name: read.optional_real(index, name) for name, index in _REAL_STATISTICS.items()},  # type: ignore[arg-type]
        )

    @property
    def good(self) -> bool:
        """Whether the packet was received without an error."""
        return self.mode == 0


def transmitted_type(sentence: Sentence) -> int | None:
    """Return the packet type in `CAXST`, the statistics of a transmission; None where the modem does not report it."""
    return FieldReader(sentence, ("CAXST",), 3).optional_integer(14, "packet_type")
