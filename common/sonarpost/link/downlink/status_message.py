"""The vehicle's status as a `v1` message: 22 bytes with its kind, so that it fits a frame of 32 bytes with a tag.

docs/specifications/link-messages.md specifies the bytes. Values are rounded to the step of their field, and limited to
its range.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Annotated, Final

from sonarpost.errors import FrameError
from sonarpost.link.state import Bounds, check_bounds

_WHERE: Final = "status message"
_LAYOUT: Final = struct.Struct(">IiiBbHBBBBB")
_DEGREE_STEPS: Final = 10_000_000
_NO_POSITION: Final = -(2**31)
_UNKNOWN: Final = 255
_UNKNOWN_SPEED: Final = -128
_UNKNOWN_DEPTH: Final = 65535
_HIGHEST: Final = 254
_HEADING_STEPS: Final = 240
_BATTERY_STEPS: Final = 100
_MB: Final = 1_000_000
_STEPS_PER_DOUBLING: Final = 8

HEADING_STEP_DEG: Final = 360 / _HEADING_STEPS
SPEED_STEP_MPS: Final = 0.1
DEPTH_STEP_M: Final = 0.2
ALTITUDE_STEP_M: Final = 0.5
SWATH_STEP_M: Final = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusMessage:
    """Position and state of a vehicle. A value that is not known is None.

    Attributes:
        time_utc_s: Time of the position, whole seconds since 1970-01-01 UTC, to 2106.
        lat_deg: WGS 84, -90..90; sent in steps of 1e-7 degree.
        lon_deg: WGS 84, -180..180, the same; known if `lat_deg` is.
        heading_deg: 0..360, in steps of 1.5 degrees; 360 is sent as 0.
        speed_mps: In steps of 0.1 m/s, limited to -12.7..12.7.
        depth_m: In steps of 0.2 m, limited to 0..13106.8.
        altitude_m: In steps of 0.5 m, limited to 0..127.
        swath_m: Range of the sonar to each side along the seabed, in steps of 2 m, limited to 0..508.
        battery: 0..1 in steps of 0.01.
        images_waiting: Limited to 254.
        disk_free_bytes: In steps of 9 %, rounded down; below 1 MB it is sent as 0.

    Raises:
        FrameError: A value out of range, or a latitude without a longitude.
    """

    time_utc_s: Annotated[int, Bounds(0, 2**32 - 1)]
    lat_deg: Annotated[float, Bounds(-90, 90)] | None = None
    lon_deg: Annotated[float, Bounds(-180, 180)] | None = None
    heading_deg: Annotated[float, Bounds(0, 360)] | None = None
    speed_mps: Annotated[float, Bounds(-50, 50)] | None = None
    depth_m: Annotated[float, Bounds(-100, 65534 * DEPTH_STEP_M)] | None = None
    altitude_m: Annotated[float, Bounds(0, 20000)] | None = None
    swath_m: Annotated[float, Bounds(0, 20000)] | None = None
    battery: Annotated[float, Bounds(0, 1)] | None = None
    images_waiting: Annotated[int, Bounds(0, 2**63 - 1)] | None = None
    disk_free_bytes: Annotated[int, Bounds(0, 2**63 - 1)] | None = None

    def __post_init__(self) -> None:
        check_bounds(self, _WHERE, FrameError)
        if (self.lat_deg is None) != (self.lon_deg is None):
            raise FrameError(_WHERE, "lon_deg", self.lon_deg, "a value together with lat_deg, or neither")

    def pack(self) -> bytes:
        """Return the bytes after the kind."""
        has_position = self.lat_deg is not None and self.lon_deg is not None
        return _LAYOUT.pack(
            self.time_utc_s,
            round((self.lat_deg or 0.0) * _DEGREE_STEPS) if has_position else _NO_POSITION,
            round((self.lon_deg or 0.0) * _DEGREE_STEPS) if has_position else _NO_POSITION,
            _UNKNOWN if self.heading_deg is None else round(self.heading_deg / HEADING_STEP_DEG) % _HEADING_STEPS,
            _steps(self.speed_mps, SPEED_STEP_MPS, -127, 127, _UNKNOWN_SPEED),
            _steps(self.depth_m, DEPTH_STEP_M, 0, _UNKNOWN_DEPTH - 1, _UNKNOWN_DEPTH),
            _steps(self.altitude_m, ALTITUDE_STEP_M, 0, _HIGHEST, _UNKNOWN),
            _steps(self.swath_m, SWATH_STEP_M, 0, _HIGHEST, _UNKNOWN),
            _steps(self.battery, 1 / _BATTERY_STEPS, 0, _BATTERY_STEPS, _UNKNOWN),
            _steps(self.images_waiting, 1, 0, _HIGHEST, _UNKNOWN),
            _disk_code(self.disk_free_bytes),
        )

    @classmethod
    def unpack(cls, body: bytes) -> StatusMessage:
        """Parse the bytes after the kind.

        Raises:
            FrameError: A wrong length, or a value out of range.
        """
        if len(body) != _LAYOUT.size:
            raise FrameError(_WHERE, "length", len(body), f"{_LAYOUT.size} bytes after the kind")
        time_utc_s, lat, lon, heading, speed, depth, altitude, swath, battery, images, disk = _LAYOUT.unpack(body)
        if heading != _UNKNOWN and heading >= _HEADING_STEPS:
            raise FrameError(_WHERE, "heading_deg", heading, f"0..{_HEADING_STEPS - 1} or {_UNKNOWN}")
        if battery != _UNKNOWN and battery > _BATTERY_STEPS:
            raise FrameError(_WHERE, "battery", battery, f"0..{_BATTERY_STEPS} or {_UNKNOWN}")
        return cls(
            time_utc_s=time_utc_s,
            lat_deg=None if lat == _NO_POSITION else lat / _DEGREE_STEPS,
            lon_deg=None if lon == _NO_POSITION else lon / _DEGREE_STEPS,
            heading_deg=_value(heading, HEADING_STEP_DEG, _UNKNOWN),
            speed_mps=_value(speed, SPEED_STEP_MPS, _UNKNOWN_SPEED),
            depth_m=_value(depth, DEPTH_STEP_M, _UNKNOWN_DEPTH),
            altitude_m=_value(altitude, ALTITUDE_STEP_M, _UNKNOWN),
            swath_m=_value(swath, SWATH_STEP_M, _UNKNOWN),
            battery=_value(battery, 1 / _BATTERY_STEPS, _UNKNOWN),
            images_waiting=None if images == _UNKNOWN else images,
            disk_free_bytes=_disk_bytes(disk),
        )


def _steps(value: float | None, step: float, low: int, high: int, unknown: int) -> int:
    return unknown if value is None else min(high, max(low, round(value / step)))


def _value(code: int, step: float, unknown: int) -> float | None:
    return None if code == unknown else round(code * step, 6)


def _disk_code(size_bytes: int | None) -> int:
    if size_bytes is None:
        return _UNKNOWN
    if size_bytes < _MB:
        return 0
    # The margin makes the decoded value of a code give that code again.
    return min(_HIGHEST, 1 + math.floor(_STEPS_PER_DOUBLING * math.log2(size_bytes / _MB) + 1e-4))


def _disk_bytes(code: int) -> int | None:
    if code == _UNKNOWN:
        return None
    return 0 if code == 0 else round(_MB * 2 ** ((code - 1) / _STEPS_PER_DOUBLING))
