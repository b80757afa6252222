"""Statuses of vehicles as records, at a limited rate for each vehicle."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sonarpost.link.downlink.status_message import StatusMessage
from sonarpost.messages import ReceivedStatus, VehicleStatus


class StatusLimiter:
    """Limits how often the status of a vehicle is published.

    Args:
        interval_s: Minimum time between two statuses of a vehicle.
        addresses: Modem addresses of the configured vehicles. All others share one limit.
    """

    def __init__(self, interval_s: float, addresses: Collection[int]) -> None:
        self._interval_s = interval_s
        self._addresses = frozenset(addresses)
        self._accepted_s: dict[int | None, float] = {}

    def latest(self, source: int, statuses: Sequence[StatusMessage], now: float) -> StatusMessage | None:
        """Return the status to publish, None if there is none or the vehicle sends too many.

        Args:
            source: Modem address of the vehicle.
            statuses: Statuses of one frame, the newest last.
            now: UTC in seconds; a clock that was set back accepts the next status.
        """
        limited = source if source in self._addresses else None
        if not statuses or 0 <= now - self._accepted_s.get(limited, float("-inf")) < self._interval_s:
            return None
        self._accepted_s[limited] = now
        return statuses[-1]


def status_record(
    status: StatusMessage, vessel_id: str, vehicle_id: str, received_utc_s: float, *, authenticated: bool
) -> ReceivedStatus:
    """Return the record of a received status."""
    return ReceivedStatus(
        vessel_id=vessel_id,
        vehicle_id=vehicle_id,
        received_utc_s=received_utc_s,
        status=VehicleStatus(
            vehicle_id=vehicle_id,
            time_utc_s=float(status.time_utc_s),
            lat_deg=status.lat_deg,
            lon_deg=status.lon_deg,
            heading_deg=status.heading_deg,
            speed_mps=status.speed_mps,
            depth_m=None if status.depth_m is None else min(12000.0, status.depth_m),
            altitude_m=status.altitude_m,
            swath_m=status.swath_m,
            battery=status.battery,
            images_waiting=status.images_waiting,
            disk_free_bytes=status.disk_free_bytes,
        ),
        authenticated=authenticated,
    )
