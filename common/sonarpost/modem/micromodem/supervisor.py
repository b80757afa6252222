"""Knows how the modem is: configures it, asks now and then whether it is still there, and never gives up."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from enum import Enum, auto

from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.dialogue import (
    CommandProgress,
    CommandQueue,
    ModemCommand,
    clock_command,
    query_command,
    set_command,
)
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
from sonarpost.modem.micromodem.settings import ClockSetting, ConfigurationSetting, Revision
from sonarpost.modem.micromodem.short_sentences import TimeSetting


class Phase(Enum):
    """What the driver does with its modem."""

    CLOSED = auto()
    CONFIGURING = auto()
    CHECKING = auto()
    READY = auto()


class ModemSupervisor:
    """Brings the modem to READY and back there, whatever it does.

    Args:
        config: Address, settings and time-outs.
        send: Takes the sentences to send.
    """

    def __init__(self, config: MicroModemConfig, send: Callable[[Sentence], None]) -> None:
        self.phase = Phase.CLOSED
        self.firmware: str | None = None
        self._config = config
        self._dialogue = CommandQueue(config, send)
        self._alive_s = 0.0
        self._heard_s: float | None = None
        self._attempts = 0
        self._unresponsive = False

    @property
    def deadline_s(self) -> float | None:
        """When the present command is due again, or the modem is to be asked whether it is there."""
        if self.phase is Phase.READY:
            return self._alive_s + self._config.keepalive_s
        return self._dialogue.deadline_s

    @property
    def generation(self) -> int | None:
        """1 or 2: the version of a Micro-Modem 1 has four parts, that of a 2 three; None while it is not known."""
        parts = len(self.firmware.split(".")) if self.firmware else 0
        return {3: 2, 4: 1}.get(parts)

    def open(self, now: float) -> None:
        """The port is open: whatever the modem knew is set anew."""
        self._alive_s = now
        self._heard_s = None
        self._configure(now)

    def close(self) -> None:
        """The port is gone."""
        self.phase = Phase.CLOSED
        self._dialogue.stop()

    def heard(self, now: float) -> None:
        """A valid sentence has come."""
        self._heard_s = self._alive_s = now

    def check(self, now: float, command: ModemCommand | None = None) -> None:
        """Ask the modem something before anything else is done: a command, or its address."""
        self.phase = Phase.CHECKING
        self._dialogue.begin([command or query_command("SRC", self._config.address)], now)
        self._dialogue.poll(now)

    def set_clock(self, utc: datetime, now: float) -> None:
        """Send the time."""
        self.check(now, clock_command(utc, self.generation))

    def on_revision(self, revision: Revision, now: float) -> list[ModemEvent]:
        """The modem tells its firmware, and perhaps that it has restarted."""
        self.firmware = revision.version or self.firmware
        if not revision.rebooted:
            return []
        self._configure(now + self._config.init_pause_s)
        return [ModemRebooted(revision.version)]

    def on_setting(self, sentence: Sentence, now: float) -> list[ModemEvent]:
        """A setting: the answer to a command, a line of a dump, or somebody else's doing.

        Raises:
            SentenceError: It is no setting.
        """
        setting = ConfigurationSetting.parse(sentence)
        if self._dialogue.receive(sentence, now) or self.phase is Phase.CONFIGURING:
            return []
        if setting.name == "SRC" and setting.number != self._config.address:
            # Another program has set it, or a restart went unnoticed.
            self._configure(now)
            return []
        return [UnhandledSentence(sentence)]

    def on_clock(self, sentence: Sentence, now: float) -> list[ModemEvent]:
        """The modem echoes the time it was given.

        Raises:
            SentenceError: It is no time.
        """
        is_old = sentence.kind == "CACLK"
        utc = ClockSetting.parse(sentence).utc if is_old else TimeSetting.parse(sentence).utc
        if self._dialogue.receive(sentence, now):
            return [ClockConfirmed(utc)]
        return [UnhandledSentence(sentence)]

    def poll(self, now: float, *, may_check: bool) -> list[ModemEvent]:
        """Do what is due.

        Args:
            now: Time on the driver's clock.
            may_check: Whether the modem may be asked whether it is there (not in the middle of a cycle).
        """
        if self.phase is Phase.CLOSED:
            return []
        if self.phase is Phase.READY:
            if may_check and now >= self._alive_s + self._config.keepalive_s:
                self.check(now)
            return []
        self._dialogue.poll(now)
        events: list[ModemEvent] = [SettingUnconfirmed(command.text) for command in self._dialogue.take_refused()]
        if self._dialogue.progress is CommandProgress.DONE:
            return events + self._done(now)
        if self._dialogue.progress is CommandProgress.FAILED:
            return events + self._failed(now)
        return events

    def _done(self, now: float) -> list[ModemEvent]:
        self._dialogue.stop()
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
            silent_s = None if self._heard_s is None else now - self._heard_s
            events.append(ModemUnresponsive(self._dialogue.current.text, self._attempts, silent_s))
        self._configure(now, self._attempts)
        self._dialogue.poll(now)
        return events

    def _configure(self, start_s: float, earlier_attempts: int = 0) -> None:
        self.phase = Phase.CONFIGURING
        self._attempts = earlier_attempts
        address = self._config.address
        commands = [set_command("SRC", address), set_command("CST", 1)]
        commands += [set_command(name, value, required=False) for name, value in self._config.settings]
        commands += [query_command("SRC", address), query_command("CST", 1)]
        self._dialogue.begin(commands, start_s, earlier_attempts)
