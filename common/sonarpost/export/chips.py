"""Pictures for maps: the chip in a balloon, the same picture turned to lie on the seabed, and icons."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from sonarpost.export.accepted import AcceptedContact, ReviewState
from sonarpost.sonar.geometry import Position, offset_position
from sonarpost.sonar.image_files import read_image

MAX_OVERLAY_M: Final = 1000.0
_NEAR_A_POLE_DEG: Final = 85.0
ICON_PX: Final = 32


@dataclass(frozen=True, slots=True)
class Overlay:
    """A picture laid on the map: KML's box, and its turn counter-clockwise about the box's middle.

    Attributes:
        png: The picture with its top towards the vehicle's heading.
    """

    png: bytes
    north_deg: float
    south_deg: float
    east_deg: float
    west_deg: float
    rotation_deg: float


@dataclass(frozen=True, slots=True)
class Chip:
    """The picture of one contact, 8 bits, as PNG; `overlay` where it is known how it lies."""

    png: bytes
    overlay: Overlay | None


def chip_of(contact: AcceptedContact) -> Chip | None:
    """Return the contact's picture, None when there is none.

    Raises:
        SurveyFileError: The kept PNG cannot be read.
    """
    if contact.picture is None:
        return None
    pixels = _eight_bits(read_image(contact.picture))
    return Chip(_png(pixels), _overlay(contact, pixels))


def _eight_bits(pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> npt.NDArray[np.uint8]:
    """Stretch 16 bits to 8 by the brightest pixel: sonars rarely fill their 16 bits."""
    if pixels.dtype == np.uint8:
        return pixels.astype(np.uint8, copy=False)
    brightest = max(1, int(pixels.max()))
    return (pixels.astype(np.uint32) * 255 // brightest).astype(np.uint8)


def _overlay(contact: AcceptedContact, pixels: npt.NDArray[np.uint8]) -> Overlay | None:
    """Lay the picture around the contact's position, taken for its middle.

    Rows run with the vehicle, columns away from it. To starboard the picture is therefore mirrored top to bottom
    to have the heading at its top; to port it is turned half round: its rows and its columns are reversed.
    """
    record, position = contact.image.contact, contact.position
    if record is None or position is None or abs(position[0]) > _NEAR_A_POLE_DEG:
        return None
    along, across, heading = record.pixel_along_m, record.pixel_across_m, record.heading_deg
    if along is None or across is None or heading is None or record.channel is None:
        return None
    height_m, width_m = along * pixels.shape[0], across * pixels.shape[1]
    if max(height_m, width_m) > MAX_OVERLAY_M:
        return None
    turned = pixels[::-1, :] if record.channel == "starboard" else pixels[::-1, ::-1]
    middle = Position(*position)
    north, south = (offset_position(middle, bearing, height_m / 2).lat_deg for bearing in (0.0, 180.0))
    east, west = (offset_position(middle, bearing, width_m / 2).lon_deg for bearing in (90.0, 270.0))
    if west > east:
        return None  # across the date line, where readers disagree
    # KML turns counter-clockwise, headings run clockwise; the result lies in -180 to 180 as KML wants it.
    rotation_deg = math.remainder(-heading, 360.0)
    return Overlay(_png(np.ascontiguousarray(turned)), north, south, east, west, rotation_deg)


def icon_png(review: ReviewState, colour: str) -> bytes:
    """Return a mark of 32 x 32 px, told apart by form as well as by colour."""
    image = Image.new("RGBA", (ICON_PX, ICON_PX), (0, 0, 0, 0))
    draw = ImageDraw.Draw(image)
    low, middle, high = 3, ICON_PX // 2, ICON_PX - 4
    match review:
        case "mine_like":
            draw.polygon([(middle, low), (high, middle), (middle, high), (low, middle)], colour, "black", 2)
        case "not_mine_like":
            draw.ellipse((low, low, high, high), colour, "black", 2)
        case "unsure":
            draw.polygon([(middle, low), (high, high), (low, high)], colour, "black", 2)
        case "unreviewed":
            draw.rectangle((low, low, high, high), colour, "black", 2)
    return _encoded(image)


def _png(pixels: npt.NDArray[np.uint8]) -> bytes:
    return _encoded(Image.fromarray(pixels))


def _encoded(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format="PNG")
    return buffer.getvalue()
