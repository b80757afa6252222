"""Images of contacts in true metres: square pixels, automatic gain, measured lines, scale bar and north arrow.

Pixels of a recording are not square: along the track they follow from speed and ping rate, across from the sampling.
Every image outside the page (thumbnail, report, KMZ) is made here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from sonarpost.messages import Contact

Grey = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Rgb = npt.NDArray[np.uint8]
Point = tuple[float, float]

THUMBNAIL_PX: Final = 96
GAIN_PARTS: Final = (0.01, 0.99)
"""The automatic gain of the page: 98 % of the received pixels are within the range of grey levels."""

_HATCH_PX: Final = 6
_BAR_PART: Final = 0.4
"""Longest scale bar, as part of the width of the image."""
_LINE_COLOURS: Final[Mapping[str, tuple[int, int, int]]] = {
    "length": (255, 212, 0),
    "width": (0, 220, 255),
    "shadow": (255, 120, 220),
}


@dataclass(frozen=True, slots=True)
class ImageLine:
    """A measured line.

    Attributes:
        kind: Quantity: length, width or shadow.
        start: (row, column) in pixels of the image.
        end: (row, column) of the other end.
        text: Value with unit.
    """

    kind: str
    start: Point
    end: Point
    text: str


@dataclass(frozen=True, slots=True)
class TrueImage:
    """An image with square pixels.

    Attributes:
        pixels: Shape (height, width), uint8.
        px_per_m: Pixels in a metre; None if the size of the original pixels is unknown, and the shape is not true.
        factors: Pixels per original pixel, along the columns (rows) and along the rows (columns).
    """

    pixels: Grey
    px_per_m: float | None
    factors: tuple[float, float]


def auto_gain(image: Grey, missing: Mask) -> tuple[float, float]:
    """Return black and white point in percent of full scale; (0, 100) without received pixels.

    Args:
        image: Shape (rows, columns).
        missing: Same shape; pixels that do not count.
    """
    reached = np.cumsum(np.bincount(image[~missing], minlength=256))
    low, high = (int(np.searchsorted(reached, part * reached[-1])) for part in GAIN_PARTS)
    return (low / 2.55, high / 2.55) if reached[-1] and high > low else (0.0, 100.0)


def stretched(image: Grey, missing: Mask) -> Grey:
    """Apply the automatic gain; see `auto_gain`."""
    low, high = auto_gain(image, missing)
    levels = (np.linspace(0.0, 100.0, 256) - low) / (high - low)
    table: Grey = (255 * levels.clip(0, 1)).round().astype(np.uint8)
    return table[image]


def true_image(
    image: Grey, missing: Mask, pixel_along_m: float | None, pixel_across_m: float | None, longest_px: int
) -> TrueImage:
    """Apply the automatic gain and resample to square pixels, with anti-aliasing; missing areas are hatched.

    Args:
        image: Shape (rows, columns); rows are along the track.
        missing: Same shape.
        pixel_along_m: Size of a pixel along the track; None if unknown.
        pixel_across_m: Size of a pixel across the track; None if unknown.
        longest_px: Length of the longer side of the result.
    """
    rows, columns = image.shape
    known = pixel_along_m is not None and pixel_across_m is not None
    height, width = (rows * pixel_along_m, columns * pixel_across_m) if known else (rows, columns)
    scale = longest_px / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    pixels = np.array(Image.fromarray(stretched(image, missing)).resize(size, Image.Resampling.BICUBIC))
    if missing.any():
        mask = np.asarray(Image.fromarray(missing).resize(size, Image.Resampling.NEAREST))
        row, column = np.indices(mask.shape)
        hatch = np.where((row + column) % _HATCH_PX < _HATCH_PX // 2, 160, 70).astype(np.uint8)
        pixels[mask] = hatch[mask]
    return TrueImage(pixels, scale if known else None, (size[1] / rows, size[0] / columns))


def thumbnail(image: Grey, missing: Mask, contact: Contact | None) -> Grey:
    """Return a thumbnail in true metres of at most `THUMBNAIL_PX` a side."""
    along_m, across_m = pixel_size_m(contact)
    return true_image(image, missing, along_m, across_m, THUMBNAIL_PX).pixels


def pixel_size_m(contact: Contact | None) -> tuple[float | None, float | None]:
    """Return the size of a pixel (along, across) of a contact record."""
    return (None, None) if contact is None else (contact.pixel_along_m, contact.pixel_across_m)


def north_in_image(contact: Contact | None) -> Point | None:
    """Return the direction of north in an image as (down, right), length 1; None if heading or side is unknown.

    Row 0 is the first ping and column 0 is nearest the track. Down is the heading, right is the side of the channel. A
    starboard image is therefore a mirror image of the seabed.
    """
    if contact is None or contact.heading_deg is None or contact.channel is None:
        return None
    heading = math.radians(contact.heading_deg)
    to_starboard = -math.sin(heading)
    return math.cos(heading), to_starboard if contact.channel == "starboard" else -to_starboard


def bar_length_m(width_m: float) -> float:
    """Return the length of the scale bar of an image: 1, 2 or 5 times a power of ten, at most 40 % of the width."""
    longest_m = _BAR_PART * width_m
    power = 10.0 ** math.floor(math.log10(longest_m))
    return next(step * power for step in (5, 2, 1) if step * power <= longest_m * (1 + 1e-9))


def draw_lines(image: TrueImage, lines: Iterable[ImageLine] = (), mark: Point | None = None) -> Rgb:
    """Draw measured lines with their values at the top, and the mark of the contact at the edges.

    Args:
        image: The image.
        lines: Lines in pixels of the original image.
        mark: (row, column) of the contact in pixels of the original image; None for no mark.

    Returns:
        Shape (height, width, 3).
    """
    drawn = Image.fromarray(image.pixels).convert("RGB")
    draw = ImageDraw.Draw(drawn)
    size_px = _font_px(max(drawn.size))
    if mark is not None:
        _draw_mark(draw, drawn.size, _place(image, mark), size_px)
    for number, line in enumerate(lines):
        colour = _LINE_COLOURS.get(line.kind, (255, 255, 255))
        ends = [_place(image, line.start), _place(image, line.end)]
        thickness = max(1, size_px // 8)
        draw.line(ends, (0, 0, 0), thickness + 2)
        draw.line(ends, colour, thickness)
        # The values are at the top, where they do not hide the object; the colours tell the lines apart.
        top = 2 + round(1.3 * number * size_px)
        draw.text((3, top), line.text, colour, font=_font(size_px), stroke_width=2, stroke_fill=(0, 0, 0))
    return np.asarray(drawn)


def scale_strip(
    width_px: int, longest_px: int, px_per_m: float | None, north: Point | None = None, title: str = ""
) -> Rgb:
    """Return a strip for the foot of an image: scale bar or `scale unknown`, north arrow, title.

    Args:
        width_px: Width of the image, and of the strip.
        longest_px: Longer side of the image, from which the size of the text follows.
        px_per_m: Pixels in a metre; None if unknown.
        north: Result of `north_in_image`; None for no arrow.
        title: Text, for example the verdict; empty for none.

    Returns:
        Shape (strip height, width_px, 3), black on white.
    """
    size_px = _font_px(longest_px)
    lines = 2 if title else 1
    arrow_px = round(2.4 * size_px) if north is not None else 0
    strip = Image.new("RGB", (width_px, max(round(lines * 1.5 * size_px), arrow_px) + 4), "white")
    draw = ImageDraw.Draw(strip)
    if px_per_m is None:
        draw.text((2, 2), "scale unknown", "black", font=_font(size_px))
    else:
        _draw_bar(draw, bar_length_m(width_px / px_per_m), px_per_m, size_px)
    if title:
        draw.text((2, 2 + round(1.4 * size_px)), title, "black", font=_font(size_px))
    if north is not None:
        _draw_north(draw, (width_px - arrow_px / 2 - 2, arrow_px / 2 + 2), north, arrow_px / 2)
    return np.asarray(strip)


def _font_px(longest_px: int) -> int:
    return max(10, longest_px // 28)


@cache
def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size_px)


def _place(image: TrueImage, point: Point) -> Point:
    """Return (x, y) in the result of a point (row, column) of the original image."""
    return point[1] * image.factors[1], point[0] * image.factors[0]


def _draw_mark(draw: ImageDraw.ImageDraw, size: tuple[int, int], centre: Point, size_px: int) -> None:
    """Draw a wedge at each edge that points to the contact; the contact itself stays free."""
    (width, height), (x, y), base = size, centre, size_px / 3
    for wedge in (
        [(0, y - base), (2 * base, y), (0, y + base)],
        [(width - 1, y - base), (width - 1 - 2 * base, y), (width - 1, y + base)],
        [(x - base, 0), (x, 2 * base), (x + base, 0)],
        [(x - base, height - 1), (x, height - 1 - 2 * base), (x + base, height - 1)],
    ):
        draw.polygon(wedge, (255, 255, 255), (0, 0, 0))


def _draw_bar(draw: ImageDraw.ImageDraw, length_m: float, px_per_m: float, size_px: int) -> None:
    length_px = length_m * px_per_m
    top, bottom = 3 + size_px // 3, 3 + 2 * size_px // 3
    draw.rectangle((2, top, 2 + length_px, bottom), "white", "black")
    draw.rectangle((2, top, 2 + length_px / 2, bottom), "black")
    draw.text((8 + length_px, 2), f"{length_m:g} m", "black", font=_font(size_px))


def _draw_north(draw: ImageDraw.ImageDraw, centre: Point, north: Point, radius_px: float) -> None:
    x, y = centre
    down, right = north
    tip = (x + right * radius_px, y + down * radius_px)
    wings = [
        (
            x - 0.6 * right * radius_px + side * 0.45 * down * radius_px,
            y - 0.6 * down * radius_px - side * 0.45 * right * radius_px,
        )
        for side in (1, -1)
    ]
    draw.polygon([tip, *wings], "white", "black")
    draw.text((x, y), "N", "black", font=_font(max(9, round(0.7 * radius_px))), anchor="mm")
