"""Detection of a modem that answers but does not transmit, and the times at which it is restarted."""

from __future__ import annotations

from sonarpost.modem.interface import (
    ModemEvent,
    PacketFailed,
    PacketSent,
    RequestDone,
    RequestFailed,
    TransmissionFailing,
    TransmissionRecovered,
)
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import FailureReason
from sonarpost.modem.micromodem.requests import RequestKind

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
