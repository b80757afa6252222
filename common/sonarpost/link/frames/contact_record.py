"""The contact record: position, time, size and class of a contact in 25 bytes, in physical units.

With a frame type, an image identifier and a checksum it fills the 32 bytes of a rate-0 frame. Every value that can be
unknown has a code for it. A value that its field cannot hold is sent as unknown, never as the nearest possible one.

There are two layouts of the first 11 bytes. A record without class and probabilities has the plain layout. In the
classified layout the first bit is 1, and positions have coarser steps. docs/specifications/acoustic-paper.md specifies
every bit.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from operator import attrgetter, itemgetter
from typing import Any, Final, TypeVar, get_args

from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX
from sonarpost.errors import FrameError
from sonarpost.messages import PROBABILITY_TOLERANCE, AtdClass, Contact
from sonarpost.sonar.survey import Side

T = TypeVar("T")

RECORD_SIZE = 25

_HEAD_BYTES: Final = 11
_PLAIN_HEAD = struct.Struct(">3sii")
_TAIL = struct.Struct(">IBBBHHBBB")
_WHERE = "contact record"

_NO_FIX = -(2**31)
_UNKNOWN_U8, _UNKNOWN_U16, _UNKNOWN_U32 = 0xFF, 0xFFFF, 0xFFFF_FFFF
_LAST_U8 = 0xFE

_DEGREE_STEPS = 10_000_000  # 1e-7 degree is 11 mm on the equator
_CLASSIFIED_DEGREE_STEPS = 2_500_000  # 4e-7 degree is 44 mm on the equator
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

_CLASSIFIED_BIT: Final = 0x80
_CLASSES: Final[tuple[AtdClass | None, ...]] = (None, *get_args(AtdClass))
"""Classes by their code of 2 bits."""
_PROBABILITY_STEPS: Final = 20  # 0.05
_PROBABILITIES: Final = tuple(
    (mine_like / _PROBABILITY_STEPS, other_object / _PROBABILITY_STEPS)
    for mine_like in range(_PROBABILITY_STEPS + 1)
    for other_object in range(_PROBABILITY_STEPS + 1 - mine_like)
)
"""The 231 pairs of p_mine_like and p_other_object, by their code."""
_LAT_BITS, _LON_BITS = 29, 30
_LAT_SHIFT, _WIDTH_SHIFT, _HEIGHT_SHIFT, _PROBABILITY_SHIFT, _CLASS_SHIFT = 30, 59, 68, 77, 85

# Values by their code of one byte; the last code means unknown.
_CONFIDENCES: Final = (*(code / _CONFIDENCE_STEPS for code in range(_UNKNOWN_U8)), None)
_HEADINGS_DEG: Final = (*(code * 360 / _HEADING_STEPS for code in range(_UNKNOWN_U8)), None)
_ALTITUDES_M: Final = (*(code / _ALTITUDE_STEPS for code in range(_UNKNOWN_U8)), None)
_PIXELS_M: Final = (*(_PIXEL_MIN_M * math.exp2(code / _PIXEL_STEPS_PER_OCTAVE) for code in range(_UNKNOWN_U8)), None)
_SIGMAS_M: Final = (*(_SIGMA_MIN_M * math.exp2(code / _SIGMA_STEPS_PER_OCTAVE) for code in range(_UNKNOWN_U8)), None)


def _codes(values: Sequence[object]) -> dict[object, int]:
    return {value: code for code, value in enumerate(values)}


_CLASS_CODES, _PROBABILITY_CODES = _codes(_CLASSES), _codes(_PROBABILITIES) | {(None, None): _UNKNOWN_U8}
_CONFIDENCE_CODES, _HEADING_CODES, _ALTITUDE_CODES = map(_codes, (_CONFIDENCES, _HEADINGS_DEG, _ALTITUDES_M))
_PIXEL_CODES, _SIGMA_CODES = map(_codes, (_PIXELS_M, _SIGMAS_M))
_DEGREE_CODES: Final = range(-180 * _DEGREE_STEPS, 180 * _DEGREE_STEPS + 1)
_TIME_CODES, _DEPTH_CODES, _RANGE_CODES = range(_UNKNOWN_U32), range(_UNKNOWN_U16), range(_LAST_RANGE + 1)
_SIDE_CODES: Final = {"port": 0, "starboard": _STARBOARD_BIT}

_SIDES: Final = (None, *Side)
_LARGEST: Final = sys.float_info.max
_LIMITS: Final = (
    ("lat_deg", -90, 90),
    ("lon_deg", -180, 180),
    ("time_utc_s", 0, _UNKNOWN_U32 - 1),
    ("confidence", 0, 2),
    ("heading_deg", -_LARGEST, _LARGEST),
    ("altitude_m", -_LARGEST, _LARGEST),
    ("depth_m", -_LARGEST, _LARGEST),
    ("ground_range_m", 0, _LARGEST),
    ("pixel_along_m", 0, _LARGEST),
    ("pixel_across_m", 0, _LARGEST),
    ("position_sigma_m", 0, _LARGEST),
    ("p_mine_like", 0, 1),
    ("p_other_object", 0, 1),
)
"""Lowest and highest value of each number."""
_numbers_of = attrgetter(*(name for name, _, _ in _LIMITS))


def atd_class_of(name: str | None) -> AtdClass | None:
    """Return the class of this name if the record can carry it, else None."""
    return _CLASSES[_CLASSES.index(name)] if name in _CLASSES else None


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
        atd_class: Class that the detector assigned.
        p_mine_like: Probability that the contact is a mine-like object (0..1), together with `p_other_object` (sent in
            steps of 0.05).
        p_other_object: Probability that it is another object on the seabed (0..1); the sum is at most 1.

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
    atd_class: AtdClass | None = None
    p_mine_like: float | None = None
    p_other_object: float | None = None

    def __post_init__(self) -> None:
        _check_size_and_fix(self.height_px, self.width_px, self.lat_deg, self.lon_deg, self.position_sigma_m)
        _check_together("p_mine_like and p_other_object", self.p_mine_like, self.p_other_object)
        for (name, low, high), value in zip(_LIMITS, _numbers_of(self), strict=True):
            if value is not None and not low <= value <= high:
                limits = "" if low == -_LARGEST else f", {low} to {high}"
                raise FrameError(_WHERE, name, value, f"a finite number{limits}")
        # Any other value would be sent as port: the contact would lie on the wrong side of the track.
        if self.side not in _SIDES:
            raise FrameError(_WHERE, "side", self.side, "port, starboard or None")
        if self.ground_range_m is not None and self.side is None:
            raise FrameError(_WHERE, "side", None, "port or starboard with a ground_range_m")
        if self.atd_class not in _CLASSES:
            raise FrameError(_WHERE, "atd_class", self.atd_class, f"{', '.join(get_args(AtdClass))} or None")
        total = (self.p_mine_like or 0.0) + (self.p_other_object or 0.0)
        if total > 1 + PROBABILITY_TOLERANCE:
            raise FrameError(_WHERE, "p_mine_like + p_other_object", total, "at most 1")

    @property
    def is_classified(self) -> bool:
        """Whether class or probabilities are known, so that the record has the classified layout."""
        return self.atd_class is not None or self.p_mine_like is not None

    def pack(self) -> bytes:
        """Return the 25 bytes."""
        steps = _CLASSIFIED_DEGREE_STEPS if self.is_classified else _DEGREE_STEPS
        head = _head(
            self.height_px,
            self.width_px,
            None if self.lat_deg is None else round(self.lat_deg * steps),
            None if self.lon_deg is None else round(self.lon_deg * steps),
            _CLASS_CODES[self.atd_class],
            _probability_code(self.p_mine_like, self.p_other_object),
        )
        return head + _TAIL.pack(
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
        return cls(*_unpack(data, where))

    def rounded(self) -> ContactSummary:
        """Return the record as the receiver reads it: rounded to the steps of its fields."""
        return ContactSummary.unpack(self.pack())


_values_of = attrgetter(*(field.name for field in fields(ContactSummary)))
_SIGMA_INDEX: Final = [field.name for field in fields(ContactSummary)].index("position_sigma_m")
_CONTACT_NAMES: Final = {"confidence": "atd_confidence", "side": "channel"}
_CARRIED_FIELDS: Final = tuple(_CONTACT_NAMES.get(field.name, field.name) for field in fields(ContactSummary)[2:])
"""Fields of `Contact` that the record carries, in the order of the fields of `ContactSummary` after the size."""
_OTHER_FIELDS: Final = sorted(Contact.model_fields.keys() - {"contact_id", "vehicle_id", *_CARRIED_FIELDS})
_others = itemgetter(*_OTHER_FIELDS)
_NO_OTHERS: Final = (None,) * len(_OTHER_FIELDS)


def summary_of(contact: Contact, height_px: int | None, width_px: int | None) -> ContactSummary:
    """Return the contact record that is transmitted with an image of this size.

    Values that the record cannot hold are sent as unknown: a wrong clock on the vehicle does not lose the image.

    Args:
        contact: The contact.
        height_px: Rows of the image, 16..512; None if not known.
        width_px: Columns of the image, 16..512; None if not known.

    Raises:
        FrameError: A side of the image is out of range.
    """
    has_size = height_px is not None and width_px is not None
    time_utc_s = contact.time_utc_s
    has_fix = contact.lat_deg is not None and contact.lon_deg is not None
    return ContactSummary(
        height_px=height_px if has_size else None,
        width_px=width_px if has_size else None,
        lat_deg=contact.lat_deg if has_fix else None,
        lon_deg=contact.lon_deg if has_fix else None,
        time_utc_s=time_utc_s if time_utc_s is not None and time_utc_s <= _UNKNOWN_U32 - 1 else None,
        confidence=contact.atd_confidence,
        heading_deg=contact.heading_deg,
        altitude_m=contact.altitude_m,
        depth_m=contact.depth_m,
        side=Side(contact.channel) if contact.channel else None,
        ground_range_m=contact.ground_range_m if contact.channel else None,
        pixel_along_m=contact.pixel_along_m,
        pixel_across_m=contact.pixel_across_m,
        position_sigma_m=contact.position_sigma_m if has_fix else None,
        atd_class=atd_class_of(contact.atd_class),
        p_mine_like=contact.p_mine_like,
        p_other_object=contact.p_other_object,
    )


def exact_record(contact: Contact, height_px: int | None, width_px: int | None) -> bytes:
    """Return the record of 25 bytes if a receiver reads exactly this size and contact from it, otherwise no bytes.

    The identifiers of the contact are not compared.
    """
    side, ground_range_m = contact.channel, contact.ground_range_m
    if _others(vars(contact)) != _NO_OTHERS or (side is None and ground_range_m is not None):
        return b""
    steps = _DEGREE_STEPS if contact.atd_class is None and contact.p_mine_like is None else _CLASSIFIED_DEGREE_STEPS
    try:
        _check_size_and_fix(height_px, width_px, contact.lat_deg, contact.lon_deg, contact.position_sigma_m)
        head = _head(
            height_px,
            width_px,
            _exact_code(contact.lat_deg, steps, _DEGREE_CODES, None),
            _exact_code(contact.lon_deg, steps, _DEGREE_CODES, None),
            _CLASS_CODES[contact.atd_class],
            _PROBABILITY_CODES[contact.p_mine_like, contact.p_other_object],
        )
        range_code = _exact_code(ground_range_m, _RANGE_STEPS, _RANGE_CODES, _RANGE_UNKNOWN)
        return head + _TAIL.pack(
            _exact_code(contact.time_utc_s, 1, _TIME_CODES, _UNKNOWN_U32),
            _CONFIDENCE_CODES[contact.atd_confidence],
            _HEADING_CODES[contact.heading_deg],
            _ALTITUDE_CODES[contact.altitude_m],
            _exact_code(contact.depth_m, _DEPTH_STEPS, _DEPTH_CODES, _UNKNOWN_U16),
            _SIDE_UNKNOWN if side is None else _SIDE_CODES[side] | range_code,
            _PIXEL_CODES[contact.pixel_along_m],
            _PIXEL_CODES[contact.pixel_across_m],
            _SIGMA_CODES[contact.position_sigma_m],
        )
    except (FrameError, KeyError):
        return b""


def contact_of(summary: ContactSummary, vehicle_id: str, image_id: str) -> Contact:
    """Return the contact that a contact record describes.

    Raises:
        ValidationError: A value does not fit the record.
    """
    return _contact(_values_of(summary), vehicle_id, image_id)


def contact_and_size(
    data: bytes, vehicle_id: str, image_id: str, where: str = _WHERE
) -> tuple[Contact, int | None, int | None]:
    """Return the contact that a record of 25 bytes describes, and height and width of its image.

    Raises:
        FrameError: As for `ContactSummary.unpack`.
        ValidationError: A value does not fit the record.
    """
    height_px, width_px, lat_deg, lon_deg, *_ = values = _unpack(data, where)
    # The other values of every code are within their limits; `Contact` checks the position.
    _check_size_and_fix(height_px, width_px, lat_deg, lon_deg, values[_SIGMA_INDEX])
    return _contact(values, vehicle_id, image_id), height_px, width_px


def _contact(values: tuple[Any, ...], vehicle_id: str, image_id: str) -> Contact:
    carried = dict(zip(_CARRIED_FIELDS, values[2:], strict=True))
    return Contact.model_validate({"contact_id": f"{vehicle_id}/{image_id}", "vehicle_id": vehicle_id, **carried})


def _head(
    height_px: int | None,
    width_px: int | None,
    lat_code: int | None,
    lon_code: int | None,
    class_code: int,
    probability_code: int,
) -> bytes:
    """Return the first 11 bytes; the codes of the position have the steps of the layout."""
    if class_code == 0 and probability_code == _UNKNOWN_U8:
        size = 0 if height_px is None or width_px is None else height_px << 12 | width_px
        fix = (_NO_FIX if code is None else code for code in (lat_code, lon_code))
        return _PLAIN_HEAD.pack(size.to_bytes(3, "big"), *fix)
    packed = (
        1 << 8 * _HEAD_BYTES - 1
        | class_code << _CLASS_SHIFT
        | probability_code << _PROBABILITY_SHIFT
        | (0 if height_px is None else height_px - 1) << _HEIGHT_SHIFT
        | (0 if width_px is None else width_px - 1) << _WIDTH_SHIFT
        | _field_of(lat_code, _LAT_BITS) << _LAT_SHIFT
        | _field_of(lon_code, _LON_BITS)
    )
    return packed.to_bytes(_HEAD_BYTES, "big")


def _unpack(data: bytes, where: str) -> tuple[Any, ...]:
    """Return the values of the fields of `ContactSummary`, in their order."""
    if len(data) != RECORD_SIZE:
        raise FrameError(where, "length", len(data), f"{RECORD_SIZE} bytes")
    is_classified = bool(data[0] & _CLASSIFIED_BIT)
    *size_and_fix, classes = _unpack_classified(data, where) if is_classified else _unpack_plain(data)
    time, confidence, heading, altitude, depth, side_range, along, across, sigma = _TAIL.unpack_from(data, _HEAD_BYTES)
    return (
        *size_and_fix,
        None if time == _UNKNOWN_U32 else float(time),
        _CONFIDENCES[confidence],
        _HEADINGS_DEG[heading],
        _ALTITUDES_M[altitude],
        None if depth == _UNKNOWN_U16 else depth / _DEPTH_STEPS,
        *_side_range_value(side_range),
        _PIXELS_M[along],
        _PIXELS_M[across],
        _SIGMAS_M[sigma],
        *classes,
    )


def _unpack_plain(data: bytes) -> tuple[Any, ...]:
    """Return height, width, latitude, longitude; class and probabilities, which are unknown."""
    size, lat, lon = _PLAIN_HEAD.unpack_from(data)
    size_code = int.from_bytes(size, "big")
    return (
        (size_code >> 12) or None,
        (size_code & 0xFFF) or None,
        None if lat == _NO_FIX else lat / _DEGREE_STEPS,
        None if lon == _NO_FIX else lon / _DEGREE_STEPS,
        (None, None, None),
    )


def _unpack_classified(data: bytes, where: str) -> tuple[Any, ...]:
    """Return height, width, latitude, longitude; class and probabilities."""
    packed = int.from_bytes(data[:_HEAD_BYTES], "big")
    class_code = packed >> _CLASS_SHIFT & 3
    probabilities = packed >> _PROBABILITY_SHIFT & 0xFF
    if len(_PROBABILITIES) <= probabilities < _UNKNOWN_U8:
        raise FrameError(where, "probabilities", probabilities, f"a code below {len(_PROBABILITIES)}, or 255")
    if class_code == 0 and probabilities == _UNKNOWN_U8:
        raise FrameError(where, "class", class_code, "a class or probabilities in the classified layout")
    height, width = packed >> _HEIGHT_SHIFT & 0x1FF, packed >> _WIDTH_SHIFT & 0x1FF
    pair = (None, None) if probabilities == _UNKNOWN_U8 else _PROBABILITIES[probabilities]
    return (
        height + 1 if height else None,
        width + 1 if width else None,
        _degree_value(packed >> _LAT_SHIFT, _LAT_BITS),
        _degree_value(packed, _LON_BITS),
        (_CLASSES[class_code], *pair),
    )


def _check_together(names: str, first: object, second: object) -> None:
    if (first is None) != (second is None):
        raise FrameError(_WHERE, names, (first, second), "both or neither")


def _check_size_and_fix(
    height_px: int | None,
    width_px: int | None,
    lat_deg: float | None,
    lon_deg: float | None,
    position_sigma_m: float | None,
) -> None:
    _check_together("height_px and width_px", height_px, width_px)
    _check_together("lat_deg and lon_deg", lat_deg, lon_deg)
    for name, side in (("height_px", height_px), ("width_px", width_px)):
        if side is not None and not MIN_SIDE_PX <= side <= MAX_SIDE_PX:
            raise FrameError(_WHERE, name, side, f"a finite number, {MIN_SIDE_PX} to {MAX_SIDE_PX}")
    if position_sigma_m is not None and lat_deg is None:
        raise FrameError(_WHERE, "lat_deg", None, "a position with a position_sigma_m")


def _probability_code(p_mine_like: float | None, p_other_object: float | None) -> int:
    if p_mine_like is None or p_other_object is None:
        return _UNKNOWN_U8
    mine_like = round(p_mine_like * _PROBABILITY_STEPS)
    # The sum can exceed 1 by a rounding error.
    other_object = min(round(p_other_object * _PROBABILITY_STEPS), _PROBABILITY_STEPS - mine_like)
    return _PROBABILITY_CODES[mine_like / _PROBABILITY_STEPS, other_object / _PROBABILITY_STEPS]


def _field_of(code: int | None, bits: int) -> int:
    """Return the two's complement of the code of a latitude or longitude; the lowest value means unknown."""
    return (-(1 << bits - 1) if code is None else code) & (1 << bits) - 1


def _degree_value(code: int, bits: int) -> float | None:
    """Return the latitude or longitude of a code in the lowest bits of a number."""
    sign = 1 << bits - 1
    code &= 2 * sign - 1
    return None if code == sign else ((code ^ sign) - sign) / _CLASSIFIED_DEGREE_STEPS


def _linear_code(value: float | None, steps_per_unit: int, last: int, unknown: int) -> int:
    if value is None:
        return unknown
    scaled = value * steps_per_unit
    if not -1 < scaled < last + 1:  # also for a product that is infinite
        return unknown
    code = round(scaled)
    return code if 0 <= code <= last else unknown


def _exact_code(value: float | None, steps_per_unit: int, codes: range, unknown: T) -> int | T:
    """Return the code that represents a value exactly.

    Raises:
        KeyError: There is none.
    """
    if value is None:
        return unknown
    code = round(value * steps_per_unit)
    if code not in codes or code / steps_per_unit != value:
        raise KeyError(value)
    return code


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


def _sigma_code(sigma_m: float | None) -> int:
    if sigma_m is None:
        return _UNKNOWN_U8
    octaves = math.log2(max(sigma_m, _SIGMA_MIN_M)) - math.log2(_SIGMA_MIN_M)
    # Rounded up; the tolerance lets a decoded value give its own code again despite rounding of the logarithm.
    code = math.ceil(_SIGMA_STEPS_PER_OCTAVE * octaves - 1e-9)
    return code if code <= _LAST_U8 else _UNKNOWN_U8
