"""Supervision of the modem: configures it, checks that it answers, and recovers it after a restart or a failure."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from enum import Enum, auto

from sonarpost.modem.micromodem.command_queue import (
    CommandProgress,
    CommandQueue,
    ModemCommand,
    clock_command,
    query_command,
    set_command,
)
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import (
    ClockConfirmed,
    ModemEvent,
    ModemReady,
    ModemRebooted,
    ModemUnresponsive,
    SettingUnconfirmed,
    UnhandledSentence,
)
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.sentences import ConfigurationSetting, Revision, parse_clock


class Phase(Enum):
    """State of the driver towards its modem."""

    CLOSED = auto()
    CONFIGURING = auto()
    CHECKING = auto()
    READY = auto()


class ModemSupervisor:
    """Brings the modem to READY, and back to READY after any failure."""

    def __init__(self, config: MicroModemConfig, send: Callable[[Sentence], None]) -> None:
        self.phase = Phase.CLOSED
        self.firmware: str | None = None
        self._config = config
        self._commands = CommandQueue(config, send)
        self._alive_s = 0.0
        self._last_sentence_s: float | None = None
        self._attempts = 0
        self._unresponsive = False

    @property
    def deadline_s(self) -> float | None:
        """When the next command or the next check is due."""
        if self.phase is Phase.READY:
            return self._alive_s + self._config.keepalive_s
        return self._commands.deadline_s

    @property
    def generation(self) -> int | None:
        """1 or 2, from the parts of the version (four or three); None while it is unknown."""
        parts = len(self.firmware.split(".")) if self.firmware else 0
        return {3: 2, 4: 1}.get(parts)

    def open(self, now: float) -> None:
        """Configure the modem: the port was opened."""
        self._alive_s = now
        self._last_sentence_s = None
        self._configure(now)

    def close(self) -> None:
        """Stop: the port was closed."""
        self.phase = Phase.CLOSED
        self._commands.stop()

    def note_sentence(self, now: float) -> None:
        """Record that a valid sentence was received."""
        self._last_sentence_s = self._alive_s = now

    def check(self, now: float, command: ModemCommand | None = None) -> None:
        """Require the answer to a command, by default the query of the address, before anything else is sent."""
        self.phase = Phase.CHECKING
        self._commands.begin([command or query_command("SRC", self._config.address)], now)
        self._commands.poll(now)

    def set_clock(self, utc: datetime, now: float) -> None:
        """Send the time."""
        self.check(now, clock_command(utc, self.generation))

    def on_revision(self, revision: Revision, now: float) -> list[ModemEvent]:
        """Store the firmware version; configure the modem if it has restarted."""
        self.firmware = revision.version or self.firmware
        if not revision.rebooted:
            return []
        self._configure(now + self._config.init_pause_s)
        return [ModemRebooted(revision.version)]

    def on_setting(self, sentence: Sentence, now: float) -> list[ModemEvent]:
        """Process `CACFG`: the answer to a command, a line of a dump, or a change by another program.

        Raises:
            SentenceError: A wrong field.
        """
        setting = ConfigurationSetting.parse(sentence)
        if self._commands.receive(sentence, now) or self.phase is Phase.CONFIGURING:
            return []
        if setting.name == "SRC" and setting.number != self._config.address:
            # Another program has set it, or the sentence of a restart was lost.
            self._configure(now)
            return []
        return [UnhandledSentence(sentence)]

    def on_clock(self, sentence: Sentence, now: float) -> list[ModemEvent]:
        """Process `CACLK` or `CATMS`, the echo of the time.

        Raises:
            SentenceError: A wrong field.
        """
        utc = parse_clock(sentence)
        if self._commands.receive(sentence, now):
            return [ClockConfirmed(utc)]
        return [UnhandledSentence(sentence)]

    def poll(self, now: float, *, may_check: bool) -> list[ModemEvent]:
        """Do what is due; query a silent modem only with `may_check` (no exchange is in progress)."""
        if self.phase is Phase.CLOSED:
            return []
        if self.phase is Phase.READY:
            if may_check and now >= self._alive_s + self._config.keepalive_s:
                self.check(now)
            return []
        self._commands.poll(now)
        events: list[ModemEvent] = [SettingUnconfirmed(command.text) for command in self._commands.take_unconfirmed()]
        if self._commands.progress is CommandProgress.DONE:
            events += self._done(now)
        elif self._commands.progress is CommandProgress.FAILED:
            events += self._failed(now)
        return events

    def _done(self, now: float) -> list[ModemEvent]:
        self._commands.stop()
        was_configuring, self.phase = self.phase is Phase.CONFIGURING, Phase.READY
        self._alive_s = now
        self._attempts = 0
        if not was_configuring:
            return []
        self._unresponsive = False
        return [ModemReady(self._config.address, self.firmware)]

    def _failed(self, now: float) -> list[ModemEvent]:
        events: list[ModemEvent] = []
        self._attempts += self._config.tries
        if not self._unresponsive:
            self._unresponsive = True
            silent_s = None if self._last_sentence_s is None else now - self._last_sentence_s
            events.append(ModemUnresponsive(self._commands.current.text, self._attempts, silent_s))
        self._configure(now, self._attempts)
        self._commands.poll(now)
        return events

    def _configure(self, start_s: float, earlier_attempts: int = 0) -> None:
        self.phase = Phase.CONFIGURING
        self._attempts = earlier_attempts
        address = self._config.address
        commands = [set_command("SRC", address), set_command("CST", 1)]
        commands += [set_command(name, value, required=False) for name, value in self._config.settings]
        commands += [query_command("SRC", address), query_command("CST", 1)]
        self._commands.begin(commands, start_s, earlier_attempts)
