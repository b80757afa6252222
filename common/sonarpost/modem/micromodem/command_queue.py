"""Configuration commands, one after the other: each is sent, repeated without an answer, and finally given up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum, auto

from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.sentences import ISO_SECONDS

_OPTIONAL_TRIES = 2


@dataclass(frozen=True, slots=True)
class ModemCommand:
    """A command and its expected answer.

    Attributes:
        sentence: The command.
        answer: The expected answer; `_answers` defines the accepted differences.
        required: Whether the driver cannot work without the answer.
        tries: How often the command is sent, None for the configured number.
    """

    sentence: Sentence
    answer: Sentence
    required: bool = True
    tries: int | None = None

    @property
    def text(self) -> str:
        """The command as text for events and logs."""
        return ",".join((self.sentence.kind, *self.sentence.fields))


def set_command(name: str, value: int, *, required: bool = True) -> ModemCommand:
    """Return the command that sets a value; the modem echoes name and value."""
    fields = (name, str(value))
    tries = None if required else _OPTIONAL_TRIES
    return ModemCommand(Sentence("CCCFG", fields), Sentence("CACFG", fields), required, tries)


def query_command(name: str, value: int) -> ModemCommand:
    """Return the command that queries a value, and expects this one."""
    return ModemCommand(Sentence("CCCFQ", (name,)), Sentence("CACFG", (name, str(value))))


def clock_command(utc: datetime, generation: int | None) -> ModemCommand:
    """Return the command that sets the modem's clock; the modem echoes the time.

    It is sent only once, as its time is past at the second try. A modem of unknown generation gets the command of the
    first.
    """
    utc = utc.astimezone(UTC)
    if generation == 2:
        text = utc.strftime(ISO_SECONDS)
        command, answer = Sentence("CCTMS", (text, "0")), Sentence("CATMS", ("0", text))
    else:
        fields = tuple(str(value) for value in utc.timetuple()[:6])
        command, answer = Sentence("CCCLK", fields), Sentence("CACLK", fields)
    return ModemCommand(command, answer, required=False, tries=1)


class CommandProgress(Enum):
    """State of a `CommandQueue`."""

    IDLE = auto()
    RUNNING = auto()
    DONE = auto()
    FAILED = auto()


class CommandQueue:
    """Runs a list of commands. Sentences that answer another command (a configuration dump) have no effect."""

    def __init__(self, config: MicroModemConfig, send: Callable[[Sentence], None]) -> None:
        self._config = config
        self._send = send
        self._commands: tuple[ModemCommand, ...] = ()
        self._index = 0
        self._attempt = 0
        self._earlier_attempts = 0
        self._sent_s = 0.0
        self._unconfirmed: list[ModemCommand] = []
        self.progress = CommandProgress.IDLE
        self.deadline_s: float | None = None

    @property
    def current(self) -> ModemCommand:
        """The command that waits for its answer, or has failed."""
        return self._commands[self._index]

    def begin(self, commands: Sequence[ModemCommand], start_s: float, earlier_attempts: int = 0) -> None:
        """Start a new list of at least one command at the first `poll` from `start_s` on.

        `earlier_attempts`, those of earlier lists, lengthen the first wait.
        """
        self._commands = tuple(commands)
        self._index = 0
        self._attempt = 0
        self._earlier_attempts = earlier_attempts
        self._unconfirmed.clear()
        self.progress = CommandProgress.RUNNING
        self.deadline_s = start_s

    def stop(self) -> None:
        """Drop the commands."""
        self.progress = CommandProgress.IDLE
        self.deadline_s = None

    def take_unconfirmed(self) -> list[ModemCommand]:
        """Remove and return the optional commands that had no answer."""
        unconfirmed, self._unconfirmed = self._unconfirmed, []
        return unconfirmed

    def receive(self, sentence: Sentence, now: float) -> bool:
        """Process a sentence of a kind that answers commands; return whether it is the expected answer."""
        if self.progress is not CommandProgress.RUNNING or self._attempt == 0:
            return False
        if _answers(sentence, self.current.answer):
            self._next(now)
            return True
        # The modem is busy with a dump: a longer wait has no cost, while a repeated query would prolong the dump.
        assert self.deadline_s is not None
        latest_s = self._sent_s + self._config.dump_limit_s
        self.deadline_s = max(self.deadline_s, min(now + self._config.dump_quiet_s, latest_s))
        return False

    def poll(self, now: float) -> None:
        """Send the command that is due; give up a command without an answer."""
        if self.progress is not CommandProgress.RUNNING or self.deadline_s is None or now < self.deadline_s:
            return
        required = self.current.required
        if self._attempt < (self.current.tries or self._config.tries):
            self._attempt += 1
            self._sent_s = now
            # Only required commands wait longer at each try.
            wait_s = self._config.reply_wait_s(self._earlier_attempts + self._attempt if required else 1)
            self.deadline_s = now + wait_s
            self._send(self.current.sentence)
        elif required:
            self.progress = CommandProgress.FAILED
            self.deadline_s = None
        else:
            self._unconfirmed.append(self.current)
            self._next(now)

    def _next(self, now: float) -> None:
        self._index += 1
        self._attempt = 0
        self._earlier_attempts = 0
        if self._index < len(self._commands):
            self.deadline_s = now
            self.poll(now)
        else:
            self.progress = CommandProgress.DONE
            self.deadline_s = None


def _answers(sentence: Sentence, expected: Sentence) -> bool:
    """Return whether a sentence is the expected answer; leading zeros and additional fields are accepted."""
    if sentence.kind != expected.kind or len(sentence.fields) < len(expected.fields):
        return False
    return all(_normalised(a) == _normalised(b) for a, b in zip(expected.fields, sentence.fields, strict=False))


def _normalised(text: str) -> str:
    text = text.strip()
    return (text.lstrip("0") or "0") if text.isdigit() else text
