"""Supervision of the modem: configures it, checks that it answers and transmits, and recovers it after a failure.

Configuration commands are sent one after the other. Each is repeated without an answer, and finally given up.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum, auto

from sonarpost.modem.interface import (
    ModemEvent,
    ModemReady,
    ModemRebooted,
    ModemUnresponsive,
    PacketFailed,
    PacketSent,
    RequestDone,
    RequestFailed,
    RestartRequested,
    SettingUnconfirmed,
    TransmissionFailing,
    TransmissionRecovered,
)
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.requests import FailureReason, RequestKind
from sonarpost.modem.micromodem.sentences import ConfigurationSetting, ErrorReport, Revision

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


class Phase(Enum):
    """State of the driver towards its modem."""

    CLOSED = auto()
    CONFIGURING = auto()
    CHECKING = auto()
    READY = auto()


class ModemSupervisor:
    """Brings the modem to READY, and back to READY after any failure.

    Attributes:
        phase: State towards the modem. While CONFIGURING or CHECKING, commands wait for their answers.
        firmware: Version reported by the modem, or None.
        dump_ends_s: End of the configuration dump in progress, as far as known; None without a dump.
    """

    def __init__(self, config: MicroModemConfig, send: Callable[[Sentence], None]) -> None:
        self.phase = Phase.CLOSED
        self.firmware: str | None = None
        self._config = config
        self._send = send
        self._alive_s = 0.0
        self._last_sentence_s: float | None = None
        self._unresponsive = False
        self._commands: deque[ModemCommand] = deque()  # the one that waits for its answer first
        self._attempts = 0  # of the first command
        self._earlier_attempts = 0  # of the first command before the configuration began again
        self._failed_attempts = 0
        self._sent_s = self._due_s = 0.0
        self._dump_started_s = self._dump_line_s = -math.inf
        self.dump_ends_s: float | None = None

    @property
    def deadline_s(self) -> float:
        """When the next command or the next check is due."""
        return self._alive_s + self._config.keepalive_s if self.phase is Phase.READY else self._due_s

    @property
    def ready(self) -> bool:
        """Whether the modem is configured and, as far as known, answers."""
        return self.phase in {Phase.CHECKING, Phase.READY}

    def open(self, now: float) -> None:
        """Configure the modem: the port was opened."""
        self._alive_s = now
        self._last_sentence_s = None
        self._configure(now)

    def close(self) -> None:
        """Stop: the port was closed."""
        self.phase = Phase.CLOSED
        self._commands.clear()
        self.dump_ends_s = None

    def note_sentence(self, now: float) -> None:
        """Record that a valid sentence was received. A command whose wait has grown is sent again soon."""
        self._last_sentence_s = self._alive_s = now
        if self._commands and self._attempts:
            self._due_s = min(self._due_s, max(now, self._sent_s + self._config.reply_timeout_s))

    def restart(self, now: float) -> list[ModemEvent]:
        """Restart the modem, and configure it after its restart."""
        address = str(self._config.address)
        self._send(Sentence("CCMSC", (address, address, "0")))
        self._configure(now + self._config.restart_wait_s)
        return [RestartRequested()]

    def check(self, now: float) -> None:
        """Query the address, and require the answer before anything else is sent."""
        self._begin(Phase.CHECKING, [query_command("SRC", self._config.address)], now)
        self.poll(now, may_check=False)

    def on_revision(self, revision: Revision, now: float) -> list[ModemEvent]:
        """Store the firmware version; configure the modem if it has restarted."""
        self.firmware = revision.version or self.firmware
        if not revision.rebooted:
            return []
        self._configure(now + self._config.init_pause_s)
        return [ModemRebooted(revision.version)]

    def on_setting(self, sentence: Sentence, now: float) -> None:
        """Process `CACFG`: the answer to a command, a line of a dump, or a change by another program.

        Raises:
            SentenceError: A wrong field.
        """
        setting = ConfigurationSetting.parse(sentence)
        if self._is_answered(sentence, now):
            return
        self._note_dump(now)
        if self.phase is not Phase.CONFIGURING and setting.name == "SRC" and setting.number != self._config.address:
            # Another program has set it, or the sentence of a restart was lost.
            self._configure(now)

    def on_error(self, report: ErrorReport, now: float) -> None:
        """Process an error of the modem: it may have rejected an optional command, which is sent again soon."""
        if self._commands and self._attempts and not self._commands[0].required and not report.data_timeout:
            self._due_s = min(self._due_s, now + self._config.refused_wait_s)

    def _note_dump(self, now: float) -> None:
        """Record a setting that this driver has not requested: a line of a dump."""
        if now >= self._dump_line_s + self._config.dump_quiet_s:
            self._dump_started_s = now
        self._dump_line_s = now
        self.dump_ends_s = min(now + self._config.dump_quiet_s, self._dump_started_s + self._config.dump_limit_s)

    def _is_answered(self, sentence: Sentence, now: float) -> bool:
        """Return whether a sentence is the answer to the first command, which is then removed."""
        if not self._commands or self._attempts == 0:
            return False
        if _answers(sentence, self._commands[0].answer):
            self._remove_first(now)
            return True
        # The modem is busy with a dump: a longer wait has no cost, while a repeated query would prolong the dump.
        latest_s = self._sent_s + self._config.dump_limit_s
        self._due_s = max(self._due_s, min(now + self._config.dump_quiet_s, latest_s))
        return False

    def poll(self, now: float, *, may_check: bool) -> list[ModemEvent]:
        """Do what is due; query a silent modem only with `may_check` (no exchange is in progress)."""
        if self.phase is Phase.CLOSED:
            return []
        if self.dump_ends_s is not None and now >= self.dump_ends_s:
            self.dump_ends_s = None
        if self.phase is Phase.READY:
            if may_check and now >= self.deadline_s:
                self.check(now)
            return []
        events: list[ModemEvent] = []
        while self._commands and now >= self._due_s:
            command = self._commands[0]
            if self._attempts < (command.tries or self._config.tries):
                self._attempts += 1
                # Only required commands wait longer at each try.
                attempt = self._earlier_attempts + self._attempts if command.required else 1
                self._sent_s, self._due_s = now, now + self._config.reply_wait_s(attempt)
                self._send(command.sentence)
            elif command.required:
                events += self._failed(command, now)
            else:
                events.append(SettingUnconfirmed(command.text))
                self._remove_first(now)
        if not self._commands:
            events += self._done(now)
        return events

    def _done(self, now: float) -> list[ModemEvent]:
        was_configuring, self.phase = self.phase is Phase.CONFIGURING, Phase.READY
        self._alive_s = now
        self._failed_attempts = 0
        if not was_configuring:
            return []
        self._unresponsive = False
        return [ModemReady(self._config.address, self.firmware)]

    def _failed(self, command: ModemCommand, now: float) -> list[ModemEvent]:
        """Configure the modem again; report the first failure."""
        events: list[ModemEvent] = []
        self._failed_attempts += self._config.tries
        if not self._unresponsive:
            self._unresponsive = True
            silent_s = None if self._last_sentence_s is None else now - self._last_sentence_s
            events.append(ModemUnresponsive(command.text, self._failed_attempts, silent_s))
        self._configure(now, self._failed_attempts)
        return events

    def _configure(self, start_s: float, failed_attempts: int = 0) -> None:
        self._failed_attempts = failed_attempts
        address = self._config.address
        commands = [set_command("SRC", address), set_command("CST", 1)]
        commands += [set_command(name, value, required=False) for name, value in self._config.settings]
        commands += [query_command("SRC", address), query_command("CST", 1)]
        self._begin(Phase.CONFIGURING, commands, start_s, failed_attempts)

    def _begin(self, phase: Phase, commands: Iterable[ModemCommand], start_s: float, earlier_attempts: int = 0) -> None:
        """Send commands from `start_s` on; `earlier_attempts` lengthen the first wait."""
        self.phase = phase
        self._commands = deque(commands)
        self._attempts, self._earlier_attempts = 0, earlier_attempts
        self._due_s = start_s

    def _remove_first(self, now: float) -> None:
        self._commands.popleft()
        self._attempts = self._earlier_attempts = 0
        self._due_s = now


def _answers(sentence: Sentence, expected: Sentence) -> bool:
    """Return whether a sentence is the expected answer; leading zeros and additional fields are accepted."""
    if sentence.kind != expected.kind or len(sentence.fields) < len(expected.fields):
        return False
    return all(_normalised(a) == _normalised(b) for a, b in zip(expected.fields, sentence.fields, strict=False))


def _normalised(text: str) -> str:
    text = text.strip()
    return (text.lstrip("0") or "0") if text.isdigit() else text


CycleResult = PacketSent | PacketFailed | RequestDone | RequestFailed

_OTHER_CAUSES = frozenset({FailureReason.PORT_LOST, FailureReason.QUEUE_FULL, FailureReason.DEFERRED_TOO_LONG})
_REFUSALS = frozenset({FailureReason.NO_ECHO, FailureReason.REFUSED})


class TransmitMonitor:
    """Counts failed packets and polls in a row.

    After `failures_before_restart` of them the modem is due to be restarted. The wait before the next restart doubles
    up to `restart_backoff_cap_s`. It is short again if the modem has transmitted since, and twice the wait has passed.
    """

    def __init__(self, config: MicroModemConfig) -> None:
        self._config = config
        self._failures = 0
        self._first_failure_s = 0.0
        self._transmitted = False  # since the last restart
        self._restarted_s: float | None = None
        self._backoff_s = config.restart_backoff_s

    @property
    def _failing(self) -> bool:
        return self._failures >= self._config.failures_before_restart

    def on_result(self, result: CycleResult, now: float) -> list[ModemEvent]:
        """Process the result of an exchange; report the beginning and the end of a failure."""
        reason = _failure(result)
        was_failing = self._failing
        if reason is not None:
            self._failures += 1
            if self._failures == 1:
                self._first_failure_s = now
            return [TransmissionFailing(self._failures, reason)] if self._failing and not was_failing else []
        if _transmitted(result):
            failures, self._failures = self._failures, 0
            self._transmitted = True
            if was_failing:
                return [TransmissionRecovered(failures, now - self._first_failure_s)]
        return []

    def take_restart(self, now: float) -> bool:
        """Return whether the modem is to be restarted now; a True starts the wait before the next restart."""
        if not self._failing:
            return False
        if self._restarted_s is not None:
            since_s = now - self._restarted_s
            if since_s < self._backoff_s:
                return False
            has_worked = self._transmitted and since_s >= 2 * self._backoff_s
            doubled_s = min(2 * self._backoff_s, self._config.restart_backoff_cap_s)
            self._backoff_s = self._config.restart_backoff_s if has_worked else doubled_s
        self._restarted_s = now
        self._transmitted = False
        return True


def _transmitted(result: CycleResult) -> bool:
    """Return whether a result shows that the modem transmits."""
    no_answer = isinstance(result, RequestFailed) and result.reason is FailureReason.NO_ANSWER
    return isinstance(result, (PacketSent, RequestDone)) or no_answer


def _failure(result: CycleResult) -> str | None:
    """Return why the modem did not transmit; None if the result has another cause or does not show it."""
    if isinstance(result, PacketFailed):
        return None if result.reason in _OTHER_CAUSES else result.reason
    if isinstance(result, RequestFailed) and result.kind == RequestKind.POLL.value and result.reason in _REFUSALS:
        return result.reason
    # The modem may not support requests of other kinds than polls.
    return None
