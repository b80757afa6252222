"""The vehicle's status for the acoustic link: the latest navigation, the transmit queue, the disk."""

from __future__ import annotations

import threading
from typing import Final

from sonarpost.errors import PayloadError
from sonarpost.link.downlink.status_message import StatusMessage
from sonarpost.messages import VehicleStatus

FRESH_S: Final = 60.0
"""Time after its arrival for which a status is not replaced by an older one of another program."""
_LAST_TIME_UTC_S: Final = 2**32 - 1


class StatusBeacon:
    """Keeps the latest status of the vehicle, and decides when it is sent. Safe for several threads.

    Args:
        vehicle_id: The vehicle.
        period_s: Time between two statuses, 0 for none.
    """

    def __init__(self, vehicle_id: str, period_s: float) -> None:
        self._vehicle_id = vehicle_id
        self._period_s = period_s
        self._lock = threading.Lock()
        self._status: VehicleStatus | None = None
        self._arrived_s = 0.0
        self._queued_utc_s: float | None = None

    def set_status(self, status: VehicleStatus, now_s: float) -> None:
        """Keep a status, except an older one than the present one of the last minute.

        Args:
            status: Status that a program of the vehicle published.
            now_s: Monotonic time.

        Raises:
            PayloadError: It is the status of another vehicle.
        """
        if status.vehicle_id != self._vehicle_id:
            raise PayloadError(VehicleStatus.TYPE, "vehicle_id", status.vehicle_id, self._vehicle_id)
        with self._lock:
            is_fresh = self._status is not None and now_s - self._arrived_s < FRESH_S
            if self._status is None or not is_fresh or status.time_utc_s >= self._status.time_utc_s:
                self._status, self._arrived_s = status, now_s

    def is_due(self, now: float) -> bool:
        """Return whether a status is to be sent at `now`, UTC in seconds."""
        if not self._period_s:
            return False
        # A clock that was set back makes it due too.
        return self._queued_utc_s is None or not 0 <= now - self._queued_utc_s < self._period_s

    def queued(self, now: float) -> None:
        """Record that a status was added to the transmit queue."""
        self._queued_utc_s = now

    def message(self, now: float, images_waiting: int, disk_free_bytes: int | None) -> StatusMessage:
        """Return the message to send. Without navigation its time is `now`, and its position is not known.

        Args:
            now: UTC in seconds.
            images_waiting: Images in the transmit queue.
            disk_free_bytes: Free space on the disk, None if it cannot be read.
        """
        with self._lock:
            status = self._status or VehicleStatus(vehicle_id=self._vehicle_id, time_utc_s=now)
        fields = status.model_dump(exclude={"vehicle_id"}) | {
            "time_utc_s": min(_LAST_TIME_UTC_S, int(status.time_utc_s)),
            "images_waiting": images_waiting,
            "disk_free_bytes": disk_free_bytes,
        }
        return StatusMessage(**fields)
