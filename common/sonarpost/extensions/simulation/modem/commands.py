"""Commands of the hosts, read strictly: every function returns typed values or raises `SentenceError`.

The layouts are written down here independently of the driver's, so that an error in one of them is found by the other.
"""

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem import RATES
from sonarpost.modem.micromodem.nmea import FieldReader, Sentence
from sonarpost.modem.micromodem.sentences import MAX_MINI_BITS, Cycle

FLEXIBLE_MINI_BYTES = 90
"""Capacity of the mini-frame of a flexible data packet; data frames of the rate's size hold the rest."""

_FLEXIBLE_RATES = (1, 3, 5)
_ISO_SECONDS = "%Y-%m-%dT%H:%M:%SZ"
_MINI = re.compile(r"[0-9A-Fa-f]{1,4}")


@dataclass(frozen=True, slots=True)
class FrameData:
    """`CCTXD` or `CCTXA`: the data of the requested frame, as hex or as text; none means that no more follows."""

    ack_requested: bool
    data: bytes
    is_text: bool


@dataclass(frozen=True, slots=True)
class FlexibleData:
    """`CCTDP`: a packet of the flexible data protocol with its data."""

    destination: int
    rate: int
    ack_requested: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class RangingRequest:
    """`CCPDT` or `CCPNT`: request of the travel times to transponders.

    Attributes:
        timeout_s: Wait for the answers.
        transponders: Letters of the interrogated transponders.
    """

    timeout_s: float
    transponders: str


@dataclass(frozen=True, slots=True)
class MiniPacket:
    """`CCMPC` or `CCMUC`: a ping, or a user mini-packet of 13 bits."""

    source: int
    destination: int
    bits: int = 0


def start_cycle(sentence: Sentence) -> Cycle:
    """Read `CCCYC,command,source,destination,rate,ack,frames`; the rate must have that many frames."""
    read = FieldReader(sentence, strict=True)
    rate = read.integer(3, "rate", 0, max(RATES))
    return Cycle(
        command=read.integer(0, "command", 0, 1),
        src=read.address(1, "source"),
        dest=read.address(2, "destination"),
        rate=rate,
        ack=read.flag(4, "ack"),
        nframes=read.integer(5, "frames", 1, RATES[rate].frames),
    )


def frame_data(sentence: Sentence) -> FrameData:
    """Read `CCTXD,source,destination,ack,hex` or `CCTXA,source,destination,ack,text`."""
    read = FieldReader(sentence, strict=True)
    read.text(3, "data")
    read.address(0, "source")
    read.address(1, "destination")
    ack_requested = read.flag(2, "ack")
    if sentence.kind == "CCTXD":
        return FrameData(ack_requested, read.data(3, "data"), is_text=False)
    # Text may contain commas.
    return FrameData(ack_requested, ",".join(sentence.fields[3:]).encode("ascii"), is_text=True)


def flexible_data(sentence: Sentence) -> FlexibleData:
    """Read `CCTDP,destination,rate,ack,reserved,hex`, with at most the data that the rate can carry."""
    read = FieldReader(sentence, strict=True)
    rate = read.integer(1, "rate", 0, max(RATES))
    if rate not in _FLEXIBLE_RATES:
        raise SentenceError(sentence.kind, "rate", rate, f"one of {_FLEXIBLE_RATES}")
    data = read.data(4, "data")
    capacity = FLEXIBLE_MINI_BYTES + RATES[rate].packet_bytes
    if not 1 <= len(data) <= capacity:
        raise SentenceError(sentence.kind, "length", len(data), f"1..{capacity} bytes")
    return FlexibleData(read.address(0, "destination"), rate, read.flag(2, "ack"), data)


def ranging(sentence: Sentence) -> RangingRequest:
    """Read a request of travel times.

    `CCPDT,group,channel,0,0,timeout_ms,A,B,C,D` interrogates the REMUS transponders whose flag is 1.
    `CCPNT,transmit_hz,transmit_ms,receive_ms,timeout_ms,A_hz,B_hz,C_hz,D_hz,flag` interrogates the narrow-band ones
    whose frequency is not 0.
    """
    read = FieldReader(sentence, strict=True)
    remus = sentence.kind == "CCPDT"
    if remus:
        read.integer(0, "group", 1, 1)
        read.integer(1, "channel", 1, 4)
    else:
        for index, name in enumerate(("transmit frequency", "transmit length", "receive length")):
            read.integer(index, name, 0, 100_000)
    timeout_ms = read.integer(4 if remus else 3, "timeout", 0, 60_000)
    first, highest = (5, 1) if remus else (4, 100_000)
    enabled = [read.integer(first + place, f"beacon {letter}", 0, highest) for place, letter in enumerate("ABCD")]
    return RangingRequest(timeout_ms / 1000, "".join(letter for letter, on in zip("ABCD", enabled, strict=True) if on))


def mini_packet(sentence: Sentence) -> MiniPacket:
    """Read `CCMPC,source,destination` or `CCMUC,source,destination,HHHH` with at most 13 bits."""
    read = FieldReader(sentence, strict=True)
    source, destination = read.address(0, "source"), read.address(1, "destination")
    if sentence.kind == "CCMPC":
        return MiniPacket(source, destination)
    text = read.text(2, "bits")
    if not _MINI.fullmatch(text) or int(text, 16) > MAX_MINI_BITS:
        raise SentenceError(sentence.kind, "bits", text, f"hex, at most {MAX_MINI_BITS:X}")
    return MiniPacket(source, destination, int(text, 16))


def calendar_time(sentence: Sentence) -> datetime:
    """Read `CCCLK,year,month,day,hour,minute,second` (UTC); second 60 is accepted as the next minute's 0."""
    read = FieldReader(sentence, strict=True)
    limits = (("year", 9999), ("month", 12), ("day", 31), ("hour", 23), ("minute", 59), ("second", 60))
    year, month, day, hour, minute, second = (read.integer(i, name, 0, high) for i, (name, high) in enumerate(limits))
    try:
        return datetime(year, month, day, hour, minute, tzinfo=UTC) + timedelta(seconds=second)
    except (ValueError, OverflowError) as error:
        raise SentenceError(sentence.kind, "date", ",".join(sentence.fields), "a date and time") from error


def iso_time(sentence: Sentence) -> datetime:
    """Read `CCTMS,2019-12-02T03:02:59Z,mode` (UTC); only mode 0 (immediately) is accepted.

    A second Z is accepted: WHOI's client sends one.
    """
    read = FieldReader(sentence, strict=True)
    text = read.text(0, "time")
    text = text[:-1] if text.endswith("ZZ") else text
    read.integer(1, "mode", 0, 0)
    try:
        return datetime.strptime(text, _ISO_SECONDS).replace(tzinfo=UTC)
    except ValueError as error:
        raise SentenceError(sentence.kind, "time", text, "YYYY-MM-DDThh:mm:ssZ") from error
