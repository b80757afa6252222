"""What hosts say to the emulated modem, from sentences to typed commands.

Every function takes a sentence and either returns a command or raises `SentenceError`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem import RATES
from sonarpost.modem.micromodem.nmea import Sentence

MOST_ADDRESS = 127
FLEXIBLE_RATES = (1, 3, 5)
FLEXIBLE_MINI_BYTES = 90
"""What the mini-frame of a flexible data packet holds; data frames of the rate's size hold the rest."""

_INTEGER = re.compile(r"-?[0-9]{1,10}")
_HEX = re.compile(r"(?:[0-9A-Fa-f]{2})*")
_MINI = re.compile(r"[0-9A-Fa-f]{1,4}")


@dataclass(frozen=True, slots=True)
class StartCycle:
    """`CCCYC`: ask for a packet of `frames` frames to be filled and sent."""

    command: int
    source: int
    destination: int
    rate: int
    ack_requested: bool
    frames: int


@dataclass(frozen=True, slots=True)
class FillFrame:
    """`CCTXD`: the data of the frame that was asked for; none means that there is no more."""

    source: int
    destination: int
    ack_requested: bool
    data: bytes
    is_text: bool = False


@dataclass(frozen=True, slots=True)
class Flexible:
    """`CCTDP`: a packet of the flexible data protocol, data and all."""

    destination: int
    rate: int
    ack_requested: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class Ranging:
    """`CCPDT` or `CCPNT`: ask transponders for their travel times.

    Attributes:
        timeout_s: How long answers are waited for.
        beacons: Letters of the transponders that are asked.
    """

    timeout_s: float
    beacons: str


@dataclass(frozen=True, slots=True)
class Mini:
    """`CCMPC` or `CCMUC`: a ping, or a user mini-packet of 13 bits."""

    source: int
    destination: int
    bits: int = 0


def integer(sentence: Sentence, index: int, name: str, low: int, high: int) -> int:
    """Return field `index` (from 0, after the kind) as an integer within `low`..`high`.

    Raises:
        SentenceError: The field is absent, not an integer, or out of bounds.
    """
    text = field(sentence, index, name)
    if not _INTEGER.fullmatch(text) or not low <= int(text) <= high:
        raise SentenceError(sentence.kind, name, text, f"an integer {low}..{high}")
    return int(text)


def field(sentence: Sentence, index: int, name: str) -> str:
    """Return field `index` as text.

    Raises:
        SentenceError: The sentence is too short.
    """
    if index >= len(sentence.fields):
        raise SentenceError(sentence.kind, name, ",".join(sentence.fields), f"at least {index + 1} fields")
    return sentence.fields[index]


def start_cycle(sentence: Sentence) -> StartCycle:
    """Read `$CCCYC,command,source,destination,rate,ack,frames`.

    Raises:
        SentenceError: A field that is absent or out of bounds, a rate without so many frames.
    """
    rate = integer(sentence, 3, "rate", 0, max(RATES))
    return StartCycle(
        integer(sentence, 0, "command", 0, 1),
        integer(sentence, 1, "source", 0, MOST_ADDRESS),
        integer(sentence, 2, "destination", 0, MOST_ADDRESS),
        rate,
        bool(integer(sentence, 4, "ack", 0, 1)),
        integer(sentence, 5, "frames", 1, RATES[rate].frames),
    )


def fill_frame(sentence: Sentence) -> FillFrame:
    """Read `$CCTXD,source,destination,ack,hex` or `$CCTXA,source,destination,ack,text`.

    Raises:
        SentenceError: A field that is absent, out of bounds or not hex.
    """
    is_text = sentence.kind == "CCTXA"
    # Text may hold commas, which no other field does.
    field(sentence, 3, "data")
    text = ",".join(sentence.fields[3:]).encode("ascii")
    return FillFrame(
        integer(sentence, 0, "source", 0, MOST_ADDRESS),
        integer(sentence, 1, "destination", 0, MOST_ADDRESS),
        bool(integer(sentence, 2, "ack", 0, 1)),
        text if is_text else hexadecimal(sentence, 3, "data"),
        is_text,
    )


def flexible(sentence: Sentence) -> Flexible:
    """Read `$CCTDP,destination,rate,ack,reserved,hex`.

    Raises:
        SentenceError: A field that is absent, out of bounds or not hex, no data, a rate the protocol does not have, or
            more data than that holds.
    """
    rate = integer(sentence, 1, "rate", 0, max(RATES))
    if rate not in FLEXIBLE_RATES:
        raise SentenceError(sentence.kind, "rate", rate, f"one of {FLEXIBLE_RATES}")
    data = hexadecimal(sentence, 4, "data")
    most = FLEXIBLE_MINI_BYTES + RATES[rate].packet_bytes
    if not 1 <= len(data) <= most:
        raise SentenceError(sentence.kind, "length", len(data), f"1..{most} bytes")
    destination = integer(sentence, 0, "destination", 0, MOST_ADDRESS)
    return Flexible(destination, rate, bool(integer(sentence, 2, "ack", 0, 1)), data)


def ranging(sentence: Sentence) -> Ranging:
    """Read a request for travel times.

    `$CCPDT,group,channel,0,0,timeout_ms,A,B,C,D` asks the REMUS transponders whose flag is 1,
    `$CCPNT,transmit_hz,transmit_ms,receive_ms,timeout_ms,A_hz,B_hz,C_hz,D_hz,flag` the narrow-band ones whose
    frequency is not 0.

    Raises:
        SentenceError: A field that is absent or out of bounds.
    """
    remus = sentence.kind == "CCPDT"
    if remus:
        integer(sentence, 0, "group", 1, 1)
        integer(sentence, 1, "channel", 1, 4)
    else:
        for index, name in enumerate(("transmit frequency", "transmit length", "receive length")):
            integer(sentence, index, name, 0, 100_000)
    timeout_ms = integer(sentence, 4 if remus else 3, "timeout", 0, 60_000)
    first, most = (5, 1) if remus else (4, 100_000)
    asked = [integer(sentence, first + place, f"beacon {letter}", 0, most) for place, letter in enumerate("ABCD")]
    return Ranging(timeout_ms / 1000, "".join(letter for letter, on in zip("ABCD", asked, strict=True) if on))


def hexadecimal(sentence: Sentence, index: int, name: str) -> bytes:
    """Return field `index` as bytes.

    Raises:
        SentenceError: The field is absent or not pairs of hex digits.
    """
    text = field(sentence, index, name)
    if not _HEX.fullmatch(text):
        raise SentenceError(sentence.kind, name, text, "pairs of hex digits")
    return bytes.fromhex(text)


def mini(sentence: Sentence) -> Mini:
    """Read `$CCMPC,source,destination` or `$CCMUC,source,destination,HHHH`.

    Raises:
        SentenceError: A field that is absent, out of bounds or more than 13 bits.
    """
    source = integer(sentence, 0, "source", 0, MOST_ADDRESS)
    destination = integer(sentence, 1, "destination", 0, MOST_ADDRESS)
    if sentence.kind == "CCMPC":
        return Mini(source, destination)
    text = field(sentence, 2, "bits")
    if not _MINI.fullmatch(text) or int(text, 16) > 0x1FFF:
        raise SentenceError(sentence.kind, "bits", text, "hex, at most 1FFF")
    return Mini(source, destination, int(text, 16))


def calendar_fields(sentence: Sentence) -> datetime:
    """Read `$CCCLK,year,month,day,hour,minute,second` (UTC); a host that counts on from 59 may say second 60.

    Raises:
        SentenceError: A field that is absent, or no such date or time.
    """
    names = ("year", "month", "day", "hour", "minute", "second")
    most = (9999, 12, 31, 23, 59, 60)
    year, month, day, hour, minute, second = (
        integer(sentence, i, name, 0, high) for i, (name, high) in enumerate(zip(names, most, strict=True))
    )
    try:
        return datetime(year, month, day, hour, minute, tzinfo=UTC) + timedelta(seconds=second)
    except (ValueError, OverflowError) as error:
        raise SentenceError(sentence.kind, "date", ",".join(sentence.fields), "a date and time") from error


def iso_time(sentence: Sentence) -> datetime:
    """Read `$CCTMS,2019-12-02T03:02:59Z,mode` (UTC; the mode has to be 0, at once).

    Raises:
        SentenceError: A field that is absent, not such a time, or another mode.
    """
    text = field(sentence, 0, "time")
    integer(sentence, 1, "mode", 0, 0)
    try:
        return datetime.strptime(text, "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC)
    except ValueError as error:
        raise SentenceError(sentence.kind, "time", text, "YYYY-MM-DDThh:mm:ssZ") from error
