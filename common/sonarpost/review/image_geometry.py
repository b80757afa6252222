"""Place of the contact and range of the columns of an image, from the contact record that the link carries.

The detector cuts a snippet around the contact (`sonarpost.detection.snippets`). Along-track the contact is at the
middle row. Across-track the window is shifted outward by half the shadow, at most by a quarter of the width. The link
does not carry the length of the shadow: the contact is between a quarter and half of the width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

from sonarpost.messages import Contact

RangeAxis = Literal["slant", "ground"]

UNKNOWN_EXTENT_M: Final = 2.0
"""Extent of the box along a side if the record has no size: that of a large mine."""

_RANGE_STEP_M: Final = 0.1
"""Step in which the link transmits the ground range."""


@dataclass(frozen=True, slots=True)
class Mark:
    """Place of the contact in its image, in pixels from the upper left corner.

    Attributes:
        row: Row of the contact.
        column: Middle of `columns`.
        columns: First and last possible column of the contact.
        range_m: Slant range of the contact.
    """

    row: float
    column: float
    columns: tuple[float, float]
    range_m: float


@dataclass(frozen=True, slots=True)
class Box:
    """Area that contains the detector's object: first and last edge in pixels, limited to the image."""

    rows: tuple[float, float]
    columns: tuple[float, float]


def range_axis(contact: Contact | None) -> RangeAxis | None:
    """Return in which range the columns of an image are equidistant; None if unknown.

    Snippets have the resolution of the recording: pings by samples of slant range. `snippet_pixel_m` of atd_stub
    projects them to the ground, with square pixels; the record does not state that. The range axis of an image with
    square pixels is therefore unknown.
    """
    if contact is None or contact.pixel_along_m is None or contact.pixel_across_m is None or contact.channel is None:
        return None
    return None if math.isclose(contact.pixel_along_m, contact.pixel_across_m, rel_tol=1e-3) else "slant"


def slant_range_m(contact: Contact) -> float | None:
    """Return the slant range of a contact: that of the record, else from ground range and altitude."""
    if contact.slant_range_m is not None:
        return contact.slant_range_m
    if contact.ground_range_m is None or contact.altitude_m is None:
        return None
    return math.hypot(contact.ground_range_m, contact.altitude_m)


def contact_mark(contact: Contact | None, height_px: int, width_px: int) -> Mark | None:
    """Return the place of the contact in an image of height_px x width_px; None if range or pixel size is unknown."""
    if contact is None or contact.pixel_across_m is None or contact.channel is None:
        return None
    range_m = slant_range_m(contact)
    if range_m is None:
        return None
    # Near the nadir the window begins at the first sample.
    samples = range_m / contact.pixel_across_m
    low, high = (min(width_px // 2 - shift + 0.5, samples) for shift in (width_px // 4, 0))
    return Mark(height_px // 2 + 0.5, (low + high) / 2, (low, high), range_m)


def contact_box(contact: Contact | None, height_px: int, width_px: int) -> Box | None:
    """Return the area that contains the contact: its size around each of its possible places; None without a mark."""
    mark = contact_mark(contact, height_px, width_px)
    if mark is None or contact is None or contact.pixel_along_m is None or contact.pixel_across_m is None:
        return None
    along_px = (contact.length_m or UNKNOWN_EXTENT_M) / 2 / contact.pixel_along_m
    across_px = (contact.width_m or UNKNOWN_EXTENT_M) / 2 / contact.pixel_across_m
    return Box(
        (max(0.0, mark.row - along_px), min(float(height_px), mark.row + along_px)),
        (max(0.0, mark.columns[0] - across_px), min(float(width_px), mark.columns[1] + across_px)),
    )


def mark_sigma_m(contact: Contact, mark: Mark) -> float:
    """Return the standard deviation of the range of a column: uniform over the places of the mark, and over a step."""
    across_m = contact.pixel_across_m or 0.0
    return math.hypot((mark.columns[1] - mark.columns[0]) * across_m, _RANGE_STEP_M) / math.sqrt(12.0)
