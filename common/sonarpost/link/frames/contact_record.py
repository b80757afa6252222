"""The contact record: position, time and size of a contact in 25 bytes, in physical units.

With a frame type, an image identifier and a checksum it fills the 32 bytes of a rate-0 frame. Every value that can be
unknown has a code for it. A value that its field cannot hold is sent as unknown, never as the nearest possible one.
docs/specifications/acoustic-paper.md specifies every bit.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX
from sonarpost.errors import FrameError
from sonarpost.sonar.survey import Side

RECORD_SIZE = 25

_LAYOUT = struct.Struct(">3siiIBBBHHBBB")
_WHERE = "contact record"

_NO_FIX = -(2**31)
_UNKNOWN_U8, _UNKNOWN_U16, _UNKNOWN_U32 = 0xFF, 0xFFFF, 0xFFFF_FFFF
_LAST_U8 = 0xFE

_DEGREE_STEPS = 10_000_000  # 1e-7 degree is 11 mm on the equator
_CONFIDENCE_STEPS = 127  # 0..254 is 0.0..2.0
_HEADING_STEPS = 255  # 255 codes for the circle, one for unknown
_ALTITUDE_STEPS = 2  # 0.5 m
_DEPTH_STEPS = 10  # 0.1 m
_RANGE_STEPS = 10  # 0.1 m

_STARBOARD_BIT = 0x8000
_RANGE_UNKNOWN = 0x7FFF
_SIDE_UNKNOWN = 0x7FFE
_LAST_RANGE = 0x7FFD

_PIXEL_MIN_M, _PIXEL_STEPS_PER_OCTAVE = 0.005, 28  # 5 mm to 2.69 m, steps of 2.5 %
_SIGMA_MIN_M, _SIGMA_STEPS_PER_OCTAVE = 0.1, 16  # 0.1 m to 6.0 km, steps of 4.4 %


@dataclass(frozen=True, slots=True)
class ContactSummary:
    """Data of a contact. None means unknown.

    Attributes:
        height_px: Height of its image (16..512), together with `width_px`.
        width_px: Width of its image (16..512).
        lat_deg: WGS 84 latitude of the contact (-90..90), together with `lon_deg`; None without a position.
        lon_deg: WGS 84 longitude of the contact (-180..180).
        time_utc_s: Time of the detection, seconds since 1970-01-01 UTC (sent as whole seconds).
        confidence: Confidence of the detection, 0.0..2.0.
        heading_deg: True heading of the vehicle at that time; any finite value, modulo 360.
        altitude_m: Altitude of the vehicle above the seabed (0..127 m can be sent).
        depth_m: Depth of the vehicle below the surface (0..6553.4 m can be sent).
        side: Side of the vehicle on which the contact lies.
        ground_range_m: Distance from the track to the contact (0..3276.5 m can be sent); requires `side`.
        pixel_along_m: Size of a pixel along the track (5 mm to 2.69 m can be sent).
        pixel_across_m: Size of a pixel across the track.
        position_sigma_m: One standard deviation of the position along the worse axis of its error ellipse; requires a
            position. It is rounded up, so that a position never appears better than it is.

    Raises:
        FrameError: A value is not finite, out of range, or present without the value that it requires.
    """

    height_px: int | None = None
    width_px: int | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    time_utc_s: float | None = None
    confidence: float | None = None
    heading_deg: float | None = None
    altitude_m: float | None = None
    depth_m: float | None = None
    side: Side | None = None
    ground_range_m: float | None = None
    pixel_along_m: float | None = None
    pixel_across_m: float | None = None
    position_sigma_m: float | None = None

    def __post_init__(self) -> None:
        _check_together("height_px and width_px", self.height_px, self.width_px)
        _check_together("lat_deg and lon_deg", self.lat_deg, self.lon_deg)
        _check_within("height_px", self.height_px, MIN_SIDE_PX, MAX_SIDE_PX)
        _check_within("width_px", self.width_px, MIN_SIDE_PX, MAX_SIDE_PX)
        _check_within("lat_deg", self.lat_deg, -90, 90)
        _check_within("lon_deg", self.lon_deg, -180, 180)
        _check_within("time_utc_s", self.time_utc_s, 0, _UNKNOWN_U32 - 1)
        _check_within("confidence", self.confidence, 0, 2)
        for name in ("heading_deg", "altitude_m", "depth_m"):
            _check_within(name, getattr(self, name), -math.inf, math.inf)
        for name in ("ground_range_m", "pixel_along_m", "pixel_across_m", "position_sigma_m"):
            _check_within(name, getattr(self, name), 0, math.inf)
        # Any other value would be sent as port: the contact would lie on the wrong side of the track.
        if self.side not in (None, Side.PORT, Side.STARBOARD):
            raise FrameError(_WHERE, "side", self.side, "port, starboard or None")
        if self.ground_range_m is not None and self.side is None:
            raise FrameError(_WHERE, "side", None, "port or starboard with a ground_range_m")
        if self.position_sigma_m is not None and self.lat_deg is None:
            raise FrameError(_WHERE, "lat_deg", None, "a position with a position_sigma_m")

    def pack(self) -> bytes:
        """Return the 25 bytes."""
        size = 0 if self.height_px is None or self.width_px is None else (self.height_px << 12) | self.width_px
        return _LAYOUT.pack(
            size.to_bytes(3, "big"),
            _NO_FIX if self.lat_deg is None else round(self.lat_deg * _DEGREE_STEPS),
            _NO_FIX if self.lon_deg is None else round(self.lon_deg * _DEGREE_STEPS),
            _UNKNOWN_U32 if self.time_utc_s is None else round(self.time_utc_s),
            _linear_code(self.confidence, _CONFIDENCE_STEPS, _LAST_U8, _UNKNOWN_U8),
            _heading_code(self.heading_deg),
            _linear_code(self.altitude_m, _ALTITUDE_STEPS, _LAST_U8, _UNKNOWN_U8),
            _linear_code(self.depth_m, _DEPTH_STEPS, _UNKNOWN_U16 - 1, _UNKNOWN_U16),
            _side_range_code(self.side, self.ground_range_m),
            _pixel_code(self.pixel_along_m),
            _pixel_code(self.pixel_across_m),
            _sigma_code(self.position_sigma_m),
        )

    @classmethod
    def unpack(cls, data: bytes, where: str = _WHERE) -> ContactSummary:
        """Parse exactly 25 bytes.

        Raises:
            FrameError: Another length, an invalid code, or values that contradict each other.
        """
        if len(data) != RECORD_SIZE:
            raise FrameError(where, "length", len(data), f"{RECORD_SIZE} bytes")
        size, lat, lon, time, confidence, heading, altitude, depth, side_range, along, across, sigma = _LAYOUT.unpack(
            data
        )
        size_code = int.from_bytes(size, "big")
        side, ground_range_m = _side_range_value(side_range)
        return cls(
            height_px=(size_code >> 12) or None,
            width_px=(size_code & 0xFFF) or None,
            lat_deg=None if lat == _NO_FIX else lat / _DEGREE_STEPS,
            lon_deg=None if lon == _NO_FIX else lon / _DEGREE_STEPS,
            time_utc_s=None if time == _UNKNOWN_U32 else float(time),
            confidence=None if confidence == _UNKNOWN_U8 else confidence / _CONFIDENCE_STEPS,
            heading_deg=None if heading == _UNKNOWN_U8 else heading * 360 / _HEADING_STEPS,
            altitude_m=None if altitude == _UNKNOWN_U8 else altitude / _ALTITUDE_STEPS,
            depth_m=None if depth == _UNKNOWN_U16 else depth / _DEPTH_STEPS,
            side=side,
            ground_range_m=ground_range_m,
            pixel_along_m=_pixel_value(along),
            pixel_across_m=_pixel_value(across),
            position_sigma_m=None
            if sigma == _UNKNOWN_U8
            else _SIGMA_MIN_M * math.exp2(sigma / _SIGMA_STEPS_PER_OCTAVE),
        )

    def rounded(self) -> ContactSummary:
        """Return the record as the receiver reads it: rounded to the steps of its fields."""
        return ContactSummary.unpack(self.pack())


def _check_together(names: str, first: object, second: object) -> None:
    if (first is None) != (second is None):
        raise FrameError(_WHERE, names, (first, second), "both or neither")


def _check_within(name: str, value: float | None, low: float, high: float) -> None:
    if value is not None and not (math.isfinite(value) and low <= value <= high):
        limits = "a finite number" if low == -math.inf else f"a finite number, {low} to {high}"
        raise FrameError(_WHERE, name, value, limits)


def _linear_code(value: float | None, steps_per_unit: int, last: int, unknown: int) -> int:
    if value is None:
        return unknown
    scaled = value * steps_per_unit
    if not -1 < scaled < last + 1:  # also for a product that is infinite
        return unknown
    code = round(scaled)
    return code if 0 <= code <= last else unknown


def _heading_code(heading_deg: float | None) -> int:
    if heading_deg is None:
        return _UNKNOWN_U8
    return round((heading_deg % 360) * _HEADING_STEPS / 360) % _HEADING_STEPS


def _side_range_code(side: Side | None, ground_range_m: float | None) -> int:
    if side is None:
        return _SIDE_UNKNOWN
    side_bit = _STARBOARD_BIT if side == Side.STARBOARD else 0
    return side_bit | _linear_code(ground_range_m, _RANGE_STEPS, _LAST_RANGE, _RANGE_UNKNOWN)


def _side_range_value(code: int) -> tuple[Side | None, float | None]:
    if code == _SIDE_UNKNOWN:
        return None, None
    if code == _SIDE_UNKNOWN | _STARBOARD_BIT:
        raise FrameError(_WHERE, "side and ground range", code, "not 0xFFFE, which is reserved")
    side = Side.STARBOARD if code & _STARBOARD_BIT else Side.PORT
    range_code = code & ~_STARBOARD_BIT
    return side, None if range_code == _RANGE_UNKNOWN else range_code / _RANGE_STEPS


def _pixel_code(size_m: float | None) -> int:
    if not size_m:  # a size of 0 means unknown
        return _UNKNOWN_U8
    code = round(_PIXEL_STEPS_PER_OCTAVE * (math.log2(size_m) - math.log2(_PIXEL_MIN_M)))
    return code if 0 <= code <= _LAST_U8 else _UNKNOWN_U8


def _pixel_value(code: int) -> float | None:
    return None if code == _UNKNOWN_U8 else _PIXEL_MIN_M * math.exp2(code / _PIXEL_STEPS_PER_OCTAVE)


def _sigma_code(sigma_m: float | None) -> int:
    if sigma_m is None:
        return _UNKNOWN_U8
    octaves = math.log2(max(sigma_m, _SIGMA_MIN_M)) - math.log2(_SIGMA_MIN_M)
    # Rounded up; the tolerance lets a decoded value give its own code again despite rounding of the logarithm.
    code = math.ceil(_SIGMA_STEPS_PER_OCTAVE * octaves - 1e-9)
    return code if code <= _LAST_U8 else _UNKNOWN_U8
