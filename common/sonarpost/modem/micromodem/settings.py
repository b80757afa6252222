"""The sentences of configuration, identity, clock and complaints, as typed records (see `sentences`)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem.fields import FieldReader
from sonarpost.modem.micromodem.nmea import Sentence

_MAX_SETTING = 2**31
_INTEGER = re.compile(r"[+-]?[0-9]{1,10}")


@dataclass(frozen=True, slots=True)
class ConfigurationSetting:
    """`CCCFG,name,value` and its echo `CACFG`; Micro-Modem 2 has dotted names, some values are no integers."""

    name: str
    value: str

    @classmethod
    def parse(cls, sentence: Sentence) -> ConfigurationSetting:
        """Read `CCCFG` or `CACFG`; the value is kept as text because a dump also holds other than integers."""
        read = FieldReader(sentence, ("CACFG", "CCCFG"), 2)
        return cls(read.name(0, "name"), ",".join(sentence.fields[1:]).strip())

    @property
    def number(self) -> int | None:
        """The value as an integer, or None when it is none; leading zeros do not matter."""
        return int(self.value) if _INTEGER.fullmatch(self.value) else None

    def sentence(self, kind: str = "CCCFG") -> Sentence:
        """Build the command, or with "CACFG" its echo."""
        return Sentence(kind, (self.name, self.value))


@dataclass(frozen=True, slots=True)
class SettingQuery:
    """`CCCFQ,name`: asks for one setting, or with ALL (Micro-Modem 1) or TOP (2) for a dump without an end mark."""

    name: str

    @classmethod
    def parse(cls, sentence: Sentence) -> SettingQuery:
        """Read `CCCFQ`."""
        return cls(FieldReader(sentence, ("CCCFQ",), 1).name(0, "name"))

    def sentence(self) -> Sentence:
        """Build `CCCFQ`."""
        return Sentence("CCCFQ", (self.name,))


@dataclass(frozen=True, slots=True)
class Revision:
    """`CAREV,hhmmss,role,version`: sent periodically by AUV or COPROC, and as INIT when the modem has started.

    Attributes:
        role: AUV, INIT, COPROC or what a newer firmware says.
        version: Four parts on a Micro-Modem 1, three on a 2; empty where absent.
        modem_time: hhmmss of the modem's clock.
    """

    role: str
    version: str = ""
    modem_time: str = ""

    @classmethod
    def parse(cls, sentence: Sentence) -> Revision:
        """Read `CAREV`."""
        read = FieldReader(sentence, ("CAREV",), 2)
        return cls(role=read.name(1, "role"), version=read.text(2), modem_time=read.text(0))

    @property
    def rebooted(self) -> bool:
        """Whether this one says that the modem has just started."""
        return self.role == "INIT"

    def sentence(self) -> Sentence:
        """Build `CAREV`."""
        return Sentence("CAREV", (self.modem_time, self.role, self.version))


@dataclass(frozen=True, slots=True)
class ErrorReport:
    """`CAERR,hhmmss,module,errno,message`, or `CAERR,hhmmss,DATA_TIMEOUT,frame`.

    Attributes:
        module: Part of the modem that complains, or DATA_TIMEOUT.
        number: Error number or, for DATA_TIMEOUT, the frame nobody answered for; None where it is no integer.
        message: The rest, as text.
        modem_time: hhmmss of the modem's clock.
    """

    module: str
    number: int | None = None
    message: str = ""
    modem_time: str = ""

    @classmethod
    def parse(cls, sentence: Sentence) -> ErrorReport:
        """Read `CAERR`; a number that is none is kept as part of the message."""
        read = FieldReader(sentence, ("CAERR",), 2)
        rest = sentence.fields[2:]
        try:
            number = read.optional_integer(2, "errno", -_MAX_SETTING, _MAX_SETTING)
        except SentenceError:
            return cls(read.name(1, "module"), None, ",".join(rest), read.text(0))
        return cls(read.name(1, "module"), number, ",".join(rest[1:]), read.text(0))

    @property
    def data_timeout(self) -> bool:
        """Whether the modem has given up waiting for a frame's data."""
        return self.module == "DATA_TIMEOUT"

    def sentence(self) -> Sentence:
        """Build `CAERR`."""
        number = () if self.number is None else (str(self.number),)
        message = tuple(self.message.split(",")) if self.message else ()
        return Sentence("CAERR", (self.modem_time, self.module, *number, *message))


@dataclass(frozen=True, slots=True)
class ClockSetting:
    """`CCCLK,Y,M,D,h,m,s` and `CACLK`, which echoes the six requested values.

    Attributes:
        utc: The time, whole seconds, with time zone UTC.
    """

    utc: datetime

    @classmethod
    def parse(cls, sentence: Sentence) -> ClockSetting:
        """Read `CCCLK` or `CACLK`."""
        read = FieldReader(sentence, ("CACLK", "CCCLK"), 6)
        limits = (("year", 1970, 9999), ("month", 1, 12), ("day", 1, 31), ("hour", 0, 23))
        year, month, day, hour = (read.integer(i, *limit) for i, limit in enumerate(limits))
        minute, second = read.integer(4, "minute", 0, 59), read.integer(5, "second", 0, 59)
        try:
            return cls(datetime(year, month, day, hour, minute, second, tzinfo=UTC))
        except ValueError as error:
            raise SentenceError(sentence.kind, "day", day, "a day of that month") from error

    def sentence(self, kind: str = "CCCLK") -> Sentence:
        """Build the command, or with "CACLK" its echo; another time zone is converted to UTC."""
        t = self.utc.astimezone(UTC)
        return Sentence(kind, tuple(str(n) for n in (t.year, t.month, t.day, t.hour, t.minute, t.second)))
