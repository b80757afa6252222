"""The sentences of the data cycle and of the configuration, as typed records.

Each record has `parse`, which reads a `Sentence` or raises `SentenceError` naming kind, field, value and
what was expected, and `sentence`, which builds it. `CC` travels from host to modem, `CA` from modem to
host. Addresses are 0..127, frame numbers start at 1, binary data travels as hex. The statistics are in
`statistics`.
"""

from __future__ import annotations

from dataclasses import dataclass

from sonarpost.modem.micromodem.fields import FieldReader
from sonarpost.modem.micromodem.nmea import Sentence

_MAX_FRAME_NUMBER = 255
_MAX_BYTES = 65535
_MAX_RATE = 255


@dataclass(frozen=True, slots=True)
class Cycle:
    """`CCCYC,command,src,dest,rate,ack,nframes` and its echo `CACYC`, which the far modem gives too.

    Attributes:
        src: Address that transmits.
        dest: Address meant.
        rate: Number in `rates.RATES` (a newer firmware may announce others).
        ack: Whether an acoustic acknowledgement is asked for.
        nframes: Frames announced.
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
        """Build the command, or with "CACYC" its echo."""
        return _sentence(kind, self.command, self.src, self.dest, self.rate, int(self.ack), self.nframes)


@dataclass(frozen=True, slots=True)
class DataRequest:
    """`CADRQ,hhmmss,src,dest,ack,maxbytes,frame`: the modem asks for a frame's bytes."""

    src: int
    dest: int
    ack: bool
    max_bytes: int
    frame_number: int
    modem_time: str = ""

    @classmethod
    def parse(cls, sentence: Sentence) -> DataRequest:
        """Read `CADRQ`."""
        read = FieldReader(sentence, ("CADRQ",), 6)
        return cls(
            modem_time=read.text(0),
            src=read.address(1, "src"),
            dest=read.address(2, "dest"),
            ack=read.flag(3, "ack"),
            max_bytes=read.integer(4, "maxbytes", 0, _MAX_BYTES),
            frame_number=read.integer(5, "frame", 1, _MAX_FRAME_NUMBER),
        )

    def sentence(self) -> Sentence:
        """Build `CADRQ`."""
        fields = (self.modem_time, self.src, self.dest, int(self.ack), self.max_bytes, self.frame_number)
        return _sentence("CADRQ", *fields)


@dataclass(frozen=True, slots=True)
class TransmitData:
    """`CCTXD,src,dest,ack,hex`: the answer to a request; empty data means no more."""

    src: int
    dest: int
    ack: bool
    data: bytes

    @classmethod
    def parse(cls, sentence: Sentence) -> TransmitData:
        """Read `CCTXD`."""
        read = FieldReader(sentence, ("CCTXD",), 3)
        return cls(read.address(0, "src"), read.address(1, "dest"), read.flag(2, "ack"), read.data(3, "data"))

    def sentence(self) -> Sentence:
        """Build `CCTXD`, with an empty last field when there is no data."""
        return _sentence("CCTXD", self.src, self.dest, int(self.ack), self.data.hex().upper())


@dataclass(frozen=True, slots=True)
class DataAccepted:
    """`CATXD,src,dest,ack,nbytes`: the modem has taken a frame."""

    src: int
    dest: int
    ack: bool
    nbytes: int

    @classmethod
    def parse(cls, sentence: Sentence) -> DataAccepted:
        """Read `CATXD`."""
        read = FieldReader(sentence, ("CATXD",), 4)
        nbytes = read.integer(3, "nbytes", 0, _MAX_BYTES)
        return cls(read.address(0, "src"), read.address(1, "dest"), read.flag(2, "ack"), nbytes)

    def sentence(self) -> Sentence:
        """Build `CATXD`."""
        return _sentence("CATXD", self.src, self.dest, int(self.ack), self.nbytes)


@dataclass(frozen=True, slots=True)
class TransmitMark:
    """`CATXP,nbytes` (the transmission starts) or `CATXF,nbytes` (it ends); the count may be absent."""

    ends: bool
    nbytes: int | None = None

    @classmethod
    def parse(cls, sentence: Sentence) -> TransmitMark:
        """Read `CATXP` or `CATXF`."""
        read = FieldReader(sentence, ("CATXP", "CATXF"), 0)
        return cls(sentence.kind == "CATXF", read.optional_integer(0, "nbytes", 0, _MAX_BYTES))

    def sentence(self) -> Sentence:
        """Build `CATXP` or `CATXF`."""
        return _sentence("CATXF" if self.ends else "CATXP", "" if self.nbytes is None else self.nbytes)


@dataclass(frozen=True, slots=True)
class ReceptionStarted:
    """`CARXP,type`: a packet begins to arrive; 0 FSK, 1 PSK, None where the field is absent."""

    packet_type: int | None = None

    @classmethod
    def parse(cls, sentence: Sentence) -> ReceptionStarted:
        """Read `CARXP`."""
        return cls(FieldReader(sentence, ("CARXP",), 0).optional_integer(0, "type", 0, 255))

    def sentence(self) -> Sentence:
        """Build `CARXP`."""
        return _sentence("CARXP", "" if self.packet_type is None else self.packet_type)


@dataclass(frozen=True, slots=True)
class ReceivedData:
    """`CARXD,src,dest,ack,frame,hex`: one good frame of the packet that arrives.

    A frame that was given to the far modem as text comes as `CARXA`, with the text instead of the hex.
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
        # Text may hold commas, which no other field does.
        data = ",".join(sentence.fields[4:]).encode("ascii") if is_text else read.data(4, "data")
        return cls(
            read.address(0, "src"),
            read.address(1, "dest"),
            read.flag(2, "ack"),
            read.integer(3, "frame", 1, _MAX_FRAME_NUMBER),
            data,
        )

    def sentence(self) -> Sentence:
        """Build `CARXD`."""
        return _sentence("CARXD", self.src, self.dest, int(self.ack), self.frame_number, self.data.hex().upper())


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """`CAACK,src,dest,frame,1`: an acoustic acknowledgement; `src` is the side that acknowledges."""

    src: int
    dest: int
    frame_number: int
    good: bool = True

    @classmethod
    def parse(cls, sentence: Sentence) -> Acknowledgement:
        """Read `CAACK`; a missing flag means acknowledged."""
        read = FieldReader(sentence, ("CAACK",), 3)
        frame_number = read.integer(2, "frame", 1, _MAX_FRAME_NUMBER)
        good = read.optional_integer(3, "flag", 0, 1) != 0
        return cls(read.address(0, "src"), read.address(1, "dest"), frame_number, good)

    def sentence(self) -> Sentence:
        """Build `CAACK`."""
        return _sentence("CAACK", self.src, self.dest, self.frame_number, int(self.good))


@dataclass(frozen=True, slots=True)
class ModemMessage:
    """`CAMSG,text,…`: BAD_CRC for a damaged frame, PACKET_TIMEOUT for a packet that did not go on, and others."""

    text: str
    details: tuple[str, ...] = ()

    @classmethod
    def parse(cls, sentence: Sentence) -> ModemMessage:
        """Read `CAMSG`."""
        return cls(FieldReader(sentence, ("CAMSG",), 1).name(0, "text"), sentence.fields[1:])

    def sentence(self) -> Sentence:
        """Build `CAMSG`."""
        return _sentence("CAMSG", self.text, *self.details)


def _sentence(kind: str, *fields: str | int) -> Sentence:
    return Sentence(kind, tuple(str(field) for field in fields))
