"""Records of what the detector found: pixels, contact, snippet."""

from __future__ import annotations

import hashlib
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationInfo, field_validator

from sonarpost.errors import BadInputError
from sonarpost.messages.record import (
    Channel,
    Count,
    Fraction,
    Latitude,
    Longitude,
    Metres,
    PlatformId,
    Record,
    Text,
    Time,
)

PROBABILITY_TOLERANCE: Final = 1e-6
"""By how much the sum of the probabilities of a contact may exceed 1, because of rounding."""


class Pixels(Record):
    """A grey image, row by row from the top, each row from its first column, without padding, 16 bits little endian.

    The pixel in row r and column c (from 0) begins at byte (r * width_px + c) * bits / 8.

    Attributes:
        height_px: Rows, along-track.
        width_px: Columns, across-track.
        bits: Bits of a pixel, unsigned; 0 is black.
        data: The pixels, height_px * width_px * bits / 8 bytes.
    """

    TYPE: ClassVar[str] = "raster"

    height_px: Annotated[int, Field(ge=1, le=4096)]
    width_px: Annotated[int, Field(ge=1, le=4096)]
    bits: Literal[8, 16]
    data: bytes

    @field_validator("data")
    @classmethod
    def _check_length(cls, data: bytes, info: ValidationInfo) -> bytes:
        if not {"height_px", "width_px", "bits"} <= info.data.keys():
            return data  # one of these fields is invalid, and the error is about it
        height_px, width_px, bits = info.data["height_px"], info.data["width_px"], info.data["bits"]
        expected = height_px * width_px * bits // 8
        if len(data) != expected:
            raise ValueError(f"{expected} bytes for {width_px} × {height_px} px of {bits} bits, not {len(data)}")
        return data

    @classmethod
    def from_array(cls, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> Pixels:
        """Return the pixels of an array.

        Args:
            image: Shape (height_px, width_px), uint8 or uint16 of any byte order and memory layout.

        Raises:
            BadInputError: Another shape or type; a cast would change values silently.
        """
        if image.ndim != 2 or image.dtype.kind != "u" or image.dtype.itemsize not in (1, 2):
            raise BadInputError(
                "raster", "image", f"{image.dtype} of shape {image.shape}", "rows and columns of uint8 or uint16"
            )
        bits: Literal[8, 16] = 8 if image.dtype == np.uint8 else 16
        data = image.astype("<u1" if bits == 8 else "<u2").tobytes()
        return cls(height_px=image.shape[0], width_px=image.shape[1], bits=bits, data=data)

    def to_array(self) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
        """Return a new array, shape (height_px, width_px), uint8 or uint16."""
        shape = (self.height_px, self.width_px)
        if self.bits == 8:
            return np.frombuffer(self.data, dtype=np.uint8).reshape(shape).copy()
        return np.frombuffer(self.data, dtype="<u2").reshape(shape).astype(np.uint16)

    @property
    def sha256(self) -> str:
        """Hexadecimal SHA-256 digest of the pixel bytes, equal for the same image on every platform."""
        return hashlib.sha256(self.data).hexdigest()


class Contact(Record):
    """An object on the seabed that the detector reports.

    Attributes:
        contact_id: Unique on the vehicle. On the vessel and at the shore site `{vehicle}/{image_id}`, because the
            acoustic link does not carry the detector's identifier.
        vehicle_id: Vehicle that recorded it.
        sonar_id: Sonar, as the survey file names it. None if not known, as in all fields below.
        line_name: Survey line.
        ping_number: Ping at the middle of the object.
        channel: Side of the sonar.
        time_utc_s: Time of that ping.
        lat_deg: Position of the object, north positive.
        lon_deg: Position of the object, east positive.
        position_sigma_m: One standard deviation of the position along the worse axis of its error ellipse.
        position_note: Why the position may be wrong by more than that. The acoustic link does not carry it.
        depth_m: Depth of the vehicle below the surface.
        altitude_m: Altitude of the vehicle above the seabed.
        heading_deg: Heading of the vehicle, clockwise from true north.
        speed_mps: Speed of the vehicle, forward positive.
        slant_range_m: Distance from the sonar to the object.
        ground_range_m: The same along a flat seabed.
        atd_class: Class that the detector assigned: `mine_like`, `clutter` (any other object) or `structure` (a wreck,
            a wall, an outcrop); `picked` if only a person has marked the place. Other detectors may use other names;
            the acoustic link does not carry those.
        atd_confidence: Confidence of the detector as in the paper, 2 is the highest.
        length_m: Length along-track.
        width_m: Width across-track.
        shadow_m: Length of the shadow, up to the end of the recording.
        height_m: Height above a flat seabed: shadow * altitude / (slant range + shadow). None if the recording ends
            before the shadow does.
        pixel_along_m: Size of a pixel of the image, along-track.
        pixel_across_m: Size of a pixel of the image, across-track.
        p_mine_like: Probability that the contact is a mine-like object, together with `p_other_object`; their sum is
            at most 1. None: not classified. The acoustic link rounds both to multiples of 0.05.
        p_other_object: Probability that it is another object on the seabed. The rest is the probability that there is
            seabed alone.
    """

    TYPE: ClassVar[str] = "contact"

    contact_id: Annotated[str, Field(min_length=1, max_length=120)]
    vehicle_id: PlatformId
    sonar_id: Text | None = None
    line_name: Text | None = None
    ping_number: Count | None = None
    channel: Channel | None = None
    time_utc_s: Time | None = None
    lat_deg: Latitude | None = None
    lon_deg: Longitude | None = None
    position_sigma_m: Metres | None = None
    position_note: Text | None = None
    depth_m: Annotated[float, Field(ge=-100, le=12000)] | None = None
    altitude_m: Metres | None = None
    heading_deg: Annotated[float, Field(ge=0, lt=360)] | None = None
    speed_mps: Annotated[float, Field(ge=-50, le=50)] | None = None
    slant_range_m: Metres | None = None
    ground_range_m: Metres | None = None
    atd_class: Annotated[str, Field(max_length=60)] | None = None
    atd_confidence: Annotated[float, Field(ge=0, le=2)] | None = None
    length_m: Metres | None = None
    width_m: Metres | None = None
    shadow_m: Metres | None = None
    height_m: Metres | None = None
    pixel_along_m: Annotated[float, Field(gt=0, le=100)] | None = None
    pixel_across_m: Annotated[float, Field(gt=0, le=100)] | None = None
    p_mine_like: Fraction | None = None
    p_other_object: Annotated[Fraction | None, Field(validate_default=True)] = None

    @field_validator("p_other_object")
    @classmethod
    def _check_probabilities(cls, p_other_object: float | None, info: ValidationInfo) -> float | None:
        if "p_mine_like" not in info.data:
            return p_other_object  # `p_mine_like` is invalid, and the error is about it
        p_mine_like = info.data["p_mine_like"]
        if (p_mine_like is None) != (p_other_object is None):
            raise ValueError("a value together with p_mine_like, or neither")
        if p_mine_like is not None and p_mine_like + p_other_object > 1 + PROBABILITY_TOLERANCE:
            raise ValueError(f"at most {1 - p_mine_like:.6g}, so that the sum with p_mine_like is at most 1")
        return p_other_object


class Snippet(Record):
    """A contact and its pixels, cut from a survey (the paper's imgToCompress).

    Attributes:
        contact: The contact.
        pixels: The pixels, nadir to the left if `channel` is known. The compressor accepts sides of 16 to 512 px.
        source: Name of the file in which the contact was detected.
        wide: More seabed around the same centre, in pixels of twice the size along and across, sides of 16 to 512 px.
            It stays on the vehicle until a command of kind `expand` requests it. None if there is none.
    """

    TYPE: ClassVar[str] = "snippet"

    contact: Contact
    pixels: Pixels
    source: Text = ""
    wide: Pixels | None = None
