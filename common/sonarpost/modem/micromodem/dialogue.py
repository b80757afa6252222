"""Commands with an answer, one after the other: sent, waited for, sent again, given up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import Enum, auto

from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.settings import ClockSetting, ConfigurationSetting, SettingQuery
from sonarpost.modem.micromodem.short_sentences import TimeSetting

_OPTIONAL_TRIES = 2


@dataclass(frozen=True, slots=True)
class ModemCommand:
    """A sentence and the answer it must have.

    Attributes:
        sentence: What is sent.
        answer: What must come back; `_same` says which differences do not matter.
        required: Whether the driver can do nothing without it.
        tries: How often it is sent where that differs from the configuration.
    """

    sentence: Sentence
    answer: Sentence
    required: bool = True
    tries: int | None = None

    @property
    def text(self) -> str:
        """The command for people."""
        return ",".join((self.sentence.kind, *self.sentence.fields))


def set_command(name: str, value: int, *, required: bool = True) -> ModemCommand:
    """Return the command that sets a value; the modem echoes name and value."""
    setting = ConfigurationSetting(name, str(value))
    tries = None if required else _OPTIONAL_TRIES
    return ModemCommand(setting.sentence(), setting.sentence("CACFG"), required, tries)


def query_command(name: str, value: int) -> ModemCommand:
    """Return the command that asks for a value, and expects this one."""
    return ModemCommand(SettingQuery(name).sentence(), ConfigurationSetting(name, str(value)).sentence("CACFG"))


def clock_command(utc: datetime, generation: int | None) -> ModemCommand:
    """Return the command that sets the modem's clock, in the words of its generation; the modem echoes the time.

    It is sent once only: a second time, the time in it would be past. A modem of unknown generation understands the
    older command.
    """
    if generation == 2:
        time = TimeSetting(utc)
        return ModemCommand(time.sentence(), time.sentence("CATMS"), required=False, tries=1)
    clock = ClockSetting(utc)
    return ModemCommand(clock.sentence(), clock.sentence("CACLK"), required=False, tries=1)


class CommandProgress(Enum):
    """Where a dialogue stands."""

    IDLE = auto()
    RUNNING = auto()
    DONE = auto()
    FAILED = auto()


class CommandQueue:
    """Runs a list of commands. An answer to something else (a configuration dump, a revision) changes nothing.

    Args:
        config: Time-outs and tries.
        send: Takes the sentences to send.
    """

    def __init__(self, config: MicroModemConfig, send: Callable[[Sentence], None]) -> None:
        self._config = config
        self._send = send
        self._commands: tuple[ModemCommand, ...] = ()
        self._index = 0
        self._attempt = 0
        self._earlier_attempts = 0
        self._sent_s = 0.0
        self._refused: list[ModemCommand] = []
        self.progress = CommandProgress.IDLE
        self.deadline_s: float | None = None

    @property
    def current(self) -> ModemCommand:
        """The command that waits for its answer, or failed."""
        return self._commands[self._index]

    def begin(self, commands: Sequence[ModemCommand], start_s: float, earlier_attempts: int = 0) -> None:
        """Start a new list at the given time, at the next `poll`.

        Args:
            commands: At least one.
            start_s: When the first may be sent.
            earlier_attempts: Attempts of earlier rounds, from which the first wait goes on doubling.
        """
        self._commands = tuple(commands)
        self._index = 0
        self._attempt = 0
        self._earlier_attempts = earlier_attempts
        self._refused.clear()
        self.progress = CommandProgress.RUNNING
        self.deadline_s = start_s

    def stop(self) -> None:
        """Forget the commands."""
        self.progress = CommandProgress.IDLE
        self.deadline_s = None

    def take_refused(self) -> list[ModemCommand]:
        """Return, once, the commands that were not required and had no answer."""
        refused, self._refused = self._refused, []
        return refused

    def receive(self, sentence: Sentence, now: float) -> bool:
        """Take a sentence of the kinds that answer commands; tell whether it was the answer waited for."""
        if self.progress is not CommandProgress.RUNNING or self._attempt == 0:
            return False
        if _same(self.current.answer, sentence):
            self._next(now)
            return True
        # A dump keeps the modem busy: waiting on costs nothing, asking again would only lengthen it.
        assert self.deadline_s is not None
        latest_s = self._sent_s + self._config.dump_limit_s
        self.deadline_s = max(self.deadline_s, min(now + self._config.dump_quiet_s, latest_s))
        return False

    def poll(self, now: float) -> None:
        """Send what is due; count a command without an answer."""
        if self.progress is not CommandProgress.RUNNING or self.deadline_s is None or now < self.deadline_s:
            return
        required = self.current.required
        if self._attempt < (self.current.tries or self._config.tries):
            self._attempt += 1
            self._sent_s = now
            # Only what the driver cannot do without is worth a growing wait.
            wait_s = self._config.reply_wait_s(self._earlier_attempts + self._attempt if required else 1)
            self.deadline_s = now + wait_s
            self._send(self.current.sentence)
        elif required:
            self.progress = CommandProgress.FAILED
            self.deadline_s = None
        else:
            self._refused.append(self.current)
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


def _same(answer: Sentence, sentence: Sentence) -> bool:
    """Compare field by field; `001` answers `1`, and more fields than asked for do not matter."""
    if answer.kind != sentence.kind or len(sentence.fields) < len(answer.fields):
        return False
    return all(_plain(a) == _plain(b) for a, b in zip(answer.fields, sentence.fields, strict=False))


def _plain(text: str) -> str:
    return (text.strip().lstrip("0") or "0") if text.strip().isdigit() else text.strip()
