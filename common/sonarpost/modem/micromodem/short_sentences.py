"""The sentences of pings, mini-packets, flexible data and the Micro-Modem 2's clock, as typed records.

Like `sentences`: each record has `parse`, which raises `SentenceError`, and `sentence`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem.fields import FieldReader
from sonarpost.modem.micromodem.nmea import Sentence

MAX_MINI_BITS = 0x1FFF
"""A user mini-packet carries 13 bits."""

_BITS = re.compile(r"[0-9A-Fa-f]{1,4}")
_MAX_RATE = 255
_MAX_BYTES = 65535
_MAX_TRAVEL_S = 3600.0
_ISO = "%Y-%m-%dT%H:%M:%SZ"


@dataclass(frozen=True, slots=True)
class PingCommand:
    """`CCMPC,src,dest`, its echo `CAMPC`, and `CAMPA` at the far side."""

    src: int
    dest: int

    @classmethod
    def parse(cls, sentence: Sentence) -> PingCommand:
        """Read `CCMPC`, `CAMPC` or `CAMPA`."""
        read = FieldReader(sentence, ("CAMPA", "CAMPC", "CCMPC"), 2)
        return cls(read.address(0, "src"), read.address(1, "dest"))

    def sentence(self, kind: str = "CCMPC") -> Sentence:
        """Build the command, its echo or its announcement."""
        return Sentence(kind, (str(self.src), str(self.dest)))


@dataclass(frozen=True, slots=True)
class PingReply:
    """`CAMPR,src,dest,travel_s`: `src` has answered the ping; the travel time is one way, None where it is absent."""

    src: int
    dest: int
    travel_s: float | None

    @classmethod
    def parse(cls, sentence: Sentence) -> PingReply:
        """Read `CAMPR`."""
        read = FieldReader(sentence, ("CAMPR",), 2)
        travel_s = read.optional_real(2, "travel time")
        if travel_s is not None and not 0.0 <= travel_s <= _MAX_TRAVEL_S:
            raise SentenceError(sentence.kind, "travel time", travel_s, f"0..{_MAX_TRAVEL_S:g} seconds")
        return cls(read.address(0, "src"), read.address(1, "dest"), travel_s)

    def sentence(self) -> Sentence:
        """Build `CAMPR`."""
        travel = () if self.travel_s is None else (f"{self.travel_s:.4f}",)
        return Sentence("CAMPR", (str(self.src), str(self.dest), *travel))


@dataclass(frozen=True, slots=True)
class MiniPacket:
    """`CCMUC,src,dest,HHHH`, its echo `CAMUC`, and `CAMUA` at the far side; `bits` is 0..0x1FFF."""

    src: int
    dest: int
    bits: int

    @classmethod
    def parse(cls, sentence: Sentence) -> MiniPacket:
        """Read `CCMUC`, `CAMUC` or `CAMUA`."""
        read = FieldReader(sentence, ("CAMUA", "CAMUC", "CCMUC"), 3)
        text = read.text(2).strip()
        if not _BITS.fullmatch(text) or int(text, 16) > MAX_MINI_BITS:
            raise SentenceError(sentence.kind, "bits", text, f"hex, at most {MAX_MINI_BITS:X}")
        return cls(read.address(0, "src"), read.address(1, "dest"), int(text, 16))

    def sentence(self, kind: str = "CCMUC") -> Sentence:
        """Build the command, its echo or its announcement."""
        return Sentence(kind, (str(self.src), str(self.dest), f"{self.bits:04X}"))


@dataclass(frozen=True, slots=True)
class MiniReply:
    """`CAMUR,src,dest`: `src` has the mini-packet."""

    src: int
    dest: int

    @classmethod
    def parse(cls, sentence: Sentence) -> MiniReply:
        """Read `CAMUR`."""
        read = FieldReader(sentence, ("CAMUR",), 2)
        return cls(read.address(0, "src"), read.address(1, "dest"))

    def sentence(self) -> Sentence:
        """Build `CAMUR`."""
        return Sentence("CAMUR", (str(self.src), str(self.dest)))


@dataclass(frozen=True, slots=True)
class FlexibleData:
    """`CCTDP,dest,rate,ack,reserved,hex`: a packet of the flexible data protocol."""

    dest: int
    rate: int
    data: bytes
    ack: bool = False

    @classmethod
    def parse(cls, sentence: Sentence) -> FlexibleData:
        """Read `CCTDP`."""
        read = FieldReader(sentence, ("CCTDP",), 5)
        rate = read.integer(1, "rate", 0, _MAX_RATE)
        return cls(read.address(0, "dest"), rate, read.data(4, "data"), read.flag(2, "ack"))

    def sentence(self) -> Sentence:
        """Build `CCTDP`."""
        return Sentence("CCTDP", (str(self.dest), str(self.rate), str(int(self.ack)), "0", self.data.hex().upper()))


@dataclass(frozen=True, slots=True)
class FlexiblePart:
    """One frame of received flexible data: whether its check was good, the bytes it holds, and what came."""

    good: bool
    nbytes: int
    data: bytes


@dataclass(frozen=True, slots=True)
class ReceivedFlexibleData:
    """`CARDP,src,dest,rate,ack,reserved,minis,datas`; each group is `crc;nbytes;hex`, any number of times.

    Attributes:
        src: Address that sent.
        dest: Address meant.
        rate: Rate number.
        ack: Whether an acknowledgement is asked for.
        parts: Mini-frames first, then data frames.
    """

    src: int
    dest: int
    rate: int
    ack: bool
    parts: tuple[FlexiblePart, ...]

    @classmethod
    def parse(cls, sentence: Sentence) -> ReceivedFlexibleData:
        """Read `CARDP`."""
        read = FieldReader(sentence, ("CARDP",), 6)
        texts = [text for index in (5, 6) if read.text(index) for text in read.text(index).split(";")]
        if len(texts) % 3:
            raise SentenceError(sentence.kind, "frames", ";".join(texts)[:60], "groups of crc;nbytes;hex")
        parts = []
        for crc, nbytes, data in zip(texts[::3], texts[1::3], texts[2::3], strict=True):
            group = FieldReader(Sentence("CARDP", (crc, nbytes, data)), ("CARDP",), 3)
            good, count = group.flag(0, "crc"), group.integer(1, "nbytes", 0, _MAX_BYTES)
            part = FlexiblePart(good, count, group.data(2, "data"))
            if good and len(part.data) != count:
                raise SentenceError(sentence.kind, "nbytes", count, f"{len(part.data)}, as many as there are")
            parts.append(part)
        rate = read.integer(2, "rate", 0, _MAX_RATE)
        return cls(read.address(0, "src"), read.address(1, "dest"), rate, read.flag(3, "ack"), tuple(parts))

    @property
    def complete(self) -> bool:
        """Whether every frame is good, and there is one."""
        return bool(self.parts) and all(part.good for part in self.parts)

    @property
    def data(self) -> bytes:
        """The bytes of all frames together, empty where one of them is bad: what is left would be in wrong places."""
        return b"".join(part.data for part in self.parts) if self.complete else b""

    def sentence(self) -> Sentence:
        """Build `CARDP`, with every frame in the first group."""
        groups = ";".join(f"{int(p.good)};{p.nbytes};{p.data.hex().upper()}" for p in self.parts)
        head = (str(self.src), str(self.dest), str(self.rate), str(int(self.ack)), "0")
        return Sentence("CARDP", (*head, groups, ""))


@dataclass(frozen=True, slots=True)
class TimeSetting:
    """`CCTMS,ISO8601Z,mode` of a Micro-Modem 2 and `CATMS,timedout,ISO8601Z`.

    Attributes:
        utc: The time, whole seconds, with time zone UTC.
    """

    utc: datetime

    @classmethod
    def parse(cls, sentence: Sentence) -> TimeSetting:
        """Read `CCTMS` or `CATMS`."""
        read = FieldReader(sentence, ("CATMS", "CCTMS"), 2)
        text = read.text(0 if sentence.kind == "CCTMS" else 1).strip()
        try:
            return cls(datetime.strptime(text, _ISO).replace(tzinfo=UTC))
        except ValueError as error:
            raise SentenceError(sentence.kind, "time", text, "YYYY-MM-DDThh:mm:ssZ") from error

    def sentence(self, kind: str = "CCTMS") -> Sentence:
        """Build the command (at once), or with "CATMS" its answer."""
        text = self.utc.astimezone(UTC).strftime(_ISO)
        return Sentence(kind, (text, "0") if kind == "CCTMS" else ("0", text))
