"""The picture of a contact over a fixed piece of seabed: the same scale whatever the range, speed and sonar."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.detect.contacts import Detection
from sonarpost.detect.snippet import to_grey
from sonarpost.sonar.survey import Survey

MAX_SIDE_PX = 4096


@dataclass(frozen=True, slots=True)
class GroundSnippet:
    """A square of seabed with a contact in its middle.

    Attributes:
        image: Shape (n, n), uint8; rows along-track in the order of recording, columns over ground range, nadir to
            the left on both sides; 0 where nothing was recorded.
        known: Same shape, True where something was.
        pixel_m: Side of a pixel on the bottom, along and across the same.
    """

    image: npt.NDArray[np.uint8]
    known: npt.NDArray[np.bool_]
    pixel_m: float


def cut_ground_snippet(
    survey: Survey, detection: Detection, size_m: float = 10.0, pixel_m: float = 0.1
) -> GroundSnippet | None:
    """Cut the seabed around a contact at a fixed size and scale.

    Each pixel is the mean of the samples whose slant range falls into it over a flat bottom at the contact's altitude
    (between the two nearest, where samples are coarser), in the pings that it spans, or the nearest one. Unlike
    `cut_snippet` the contact's highlight is always the middle pixel; what lies beyond the recording is unknown.

    Args:
        survey: The survey the contact was found in.
        detection: The contact.
        size_m: Side of the square.
        pixel_m: Side of a pixel.

    Returns:
        The picture; None where the contact's altitude or the travel between pings is not known.

    Raises:
        ValueError: A size or pixel that is not above 0, or more than 4096 pixels a side.
    """
    if not (size_m > 0 and pixel_m > 0 and 1 <= size_m / pixel_m <= MAX_SIDE_PX):
        raise ValueError(f"size_m, pixel_m: got {size_m}, {pixel_m}, expected above 0 and 1 to {MAX_SIDE_PX} pixels")
    if detection.altitude_m is None or detection.ground_range_m is None or detection.pixel_along_m is None:
        return None
    count = math.ceil(size_m / pixel_m)
    edges_m = detection.ground_range_m + (np.arange(count + 1) - count / 2) * pixel_m
    slant_m = np.hypot(np.maximum(edges_m, 0.0), detection.altitude_m)
    first = detection.ping_index + 0.5 - count / 2 * pixel_m / detection.pixel_along_m
    values = np.full((count, count), np.nan)
    for row in range(count):
        top = first + row * pixel_m / detection.pixel_along_m
        bottom = top + pixel_m / detection.pixel_along_m
        rows = range(max(round(top), 0), min(round(bottom), len(survey.pings))) or range(
            math.floor(top), math.floor(top) + 1
        )
        lines = [_line(survey, detection, ping, slant_m) for ping in rows if 0 <= ping < len(survey.pings)]
        if lines:
            stacked = np.stack(lines)
            some = np.isfinite(stacked).any(axis=0)
            values[row, some] = np.nanmean(stacked[:, some], axis=0)
    values[:, edges_m[:-1] < 0] = np.nan
    known = np.isfinite(values)
    raw = np.rint(np.where(known, values, 0.0)).astype(np.uint32)
    return GroundSnippet(to_grey(raw, known), known, pixel_m)


def _line(survey: Survey, detection: Detection, ping: int, slant_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the mean of one ping's samples between neighbouring slant ranges, NaN beyond its end."""
    channel = survey.pings[ping].channel(detection.side)
    if channel is None or not len(channel.samples):
        return np.full(len(slant_m) - 1, np.nan)
    places = slant_m / channel.sample_spacing_m
    sums = np.concatenate([[0.0], np.cumsum(channel.samples, dtype=np.float64)])
    width = np.maximum(np.diff(places), 1e-9)
    line: npt.NDArray[np.float64] = np.diff(np.interp(places, np.arange(len(sums)), sums)) / width
    line[(places[1:] > len(channel.samples)) | (np.diff(places) <= 1e-9)] = np.nan
    return line
