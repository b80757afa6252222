"""The times at which the vehicle's modem transmits, from its own events."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sonarpost.messages import MAX_TRANSMISSION_S, Transmission, Transmissions
from sonarpost.modem.interface import ModemEvent, PacketFailed, PacketSent, TransmissionEnded, TransmissionStarted

KEPT_S: Final = 1800.0
MAX_KEPT: Final = 1000
_REPORT_DELAY_S: Final = 0.5
"""The modem's report of a start may arrive this long before the start of the driver's cycle is logged, or after it."""


@dataclass(frozen=True, slots=True)
class _Open:
    """A transmission in progress: its start on both clocks and its nominal duration."""

    start_utc_s: float
    start_s: float
    airtime_s: float


class TransmissionTimes:
    """Transmissions of the last 30 minutes, at most 1000.

    A start and an end come from the modem's reports (`CATXP`, `CATXF`). Without a report of the end, the nominal air
    time is used until the packet is reported as sent or failed. A packet that was sent without any report counts from
    the start of its cycle to its end. A packet that failed without a report counts as not transmitted: a modem that
    does not work must not mask the sonar.

    Durations are measured with the monotonic clock, so a step of the UTC clock during a transmission does not change
    its length. For one thread; `transmissions` may be read from another.
    """

    def __init__(self) -> None:
        self.transmissions: tuple[Transmission, ...] = ()
        self._open: _Open | None = None
        self._reported_s: float | None = None  # when the modem last reported a start or an end

    def on_event(self, event: ModemEvent, now_utc_s: float, now_s: float) -> bool:
        """Process an event of the driver.

        Args:
            event: Any event.
            now_utc_s: Time by the vehicle's clock.
            now_s: Time on a monotonic clock.

        Returns:
            Whether the transmissions have changed.
        """
        before = self.transmissions
        match event:
            case TransmissionStarted():
                self._open = _Open(now_utc_s, now_s, event.airtime_s)
                self._reported_s = now_s
                self._add(now_utc_s, event.airtime_s, now_utc_s)
            case TransmissionEnded():
                if not self._end(now_utc_s, now_s):
                    self._add(now_utc_s - event.airtime_s, event.airtime_s, now_utc_s)
                self._reported_s = now_s
            case PacketSent():
                cycle_s = max(0.0, event.finished_s - event.started_s)
                reported = self._reported_s is not None and self._reported_s >= now_s - cycle_s - _REPORT_DELAY_S
                if not (self._end(now_utc_s, now_s) or reported):
                    self._add(now_utc_s - cycle_s, cycle_s, now_utc_s)
            case PacketFailed() if self._open is not None:
                self._end(now_utc_s, max(now_s, self._open.start_s + self._open.airtime_s))
            case _:
                pass
        return self.transmissions != before

    def record(self, platform_id: str, now_utc_s: float) -> Transmissions:
        """Return the record of this moment."""
        return Transmissions(platform_id=platform_id, time_utc_s=now_utc_s, transmissions=self.transmissions)

    def _end(self, now_utc_s: float, end_s: float) -> bool:
        """End the transmission in progress; return whether there was one."""
        if self._open is None:
            return False
        ended, self._open = self._open, None
        self._add(ended.start_utc_s, end_s - ended.start_s, now_utc_s)
        return True

    def _add(self, start_utc_s: float, duration_s: float, now_utc_s: float) -> None:
        """Add a transmission, or replace the one with this start; remove those that are too old."""
        start_utc_s = max(start_utc_s, 0.0)
        end_utc_s = start_utc_s + min(duration_s, 0.999 * MAX_TRANSMISSION_S)
        added = Transmission(start_utc_s=start_utc_s, end_utc_s=end_utc_s)
        # After a step of the clock, those before it may be in the future.
        kept = [
            each
            for each in self.transmissions
            if each.start_utc_s != start_utc_s and abs(now_utc_s - each.end_utc_s) <= KEPT_S
        ]
        self.transmissions = (*kept, added)[-MAX_KEPT:]
