"""Measures distances: pings the vehicles in turn, and computes distances from the travel times of their answers."""

from __future__ import annotations

import math
from typing import Final

from sonarpost.messages import VehicleRange
from sonarpost.modem.interface import RangeMeasured, RequestDone, RequestFailed
from sonarpost.services.op_modem.config import OpModemConfig

MAX_TRAVEL_S: Final = 100.0
_TIMEOUT_S: Final = 120.0
"""Time after which a ping counts as failed although the driver has not reported its end."""


class Ranging:
    """Decides which vehicle is pinged, and accepts answers to pings in progress only. Not thread-safe.

    Args:
        vessel_id: Name of the vessel in records.
        config: Configuration of op_modem; without `ranging_period_s` no vehicle is pinged.
    """

    def __init__(self, vessel_id: str, config: OpModemConfig) -> None:
        self._vessel_id = vessel_id
        self._config = config
        self._addresses = sorted(int(address) for address in config.vehicles)
        self._next = 0
        self._started_s = -math.inf
        self._pinged: tuple[int, int] | None = None  # request and modem address

    @property
    def in_progress(self) -> bool:
        """Whether an answer is awaited."""
        return self._pinged is not None

    def due_address(self, now_s: float) -> int | None:
        """Return the modem address to ping, None for none; `now_s` is monotonic."""
        if self._pinged is not None and now_s - self._started_s >= _TIMEOUT_S:
            self._pinged = None
        is_due = self._config.ranging_period_s and now_s - self._started_s >= self._config.ranging_period_s
        if not is_due or self._pinged is not None or not self._addresses:
            return None
        return self._addresses[self._next % len(self._addresses)]

    def started(self, request_id: int, address: int, now_s: float) -> None:
        """Record that a ping was queued."""
        self._pinged, self._started_s = (request_id, address), now_s
        self._next += 1

    def ended(self, event: RequestDone | RequestFailed) -> bool:
        """Record the end of a request; return whether it was the ping in progress."""
        if self._pinged is None or self._pinged[0] != event.request_id:
            return False
        self._pinged = None
        return True

    def measured(self, event: RangeMeasured, now: float) -> VehicleRange | None:
        """Return the record of an answer; None if it answers no ping in progress, or has no travel time.

        Args:
            event: The answer.
            now: UTC in seconds.
        """
        if self._pinged is None or (event.src, event.dest) != (self._pinged[1], self._config.address):
            return None
        if event.travel_s is None or not 0 <= event.travel_s <= MAX_TRAVEL_S:
            return None
        speed_mps = self._config.sound_speed_mps
        return VehicleRange(
            vessel_id=self._vessel_id,
            vehicle_id=self._config.name_of(event.src),
            measured_utc_s=now,
            travel_s=event.travel_s,
            sound_speed_mps=speed_mps,
            distance_m=round(event.travel_s * speed_mps, 2),
        )
