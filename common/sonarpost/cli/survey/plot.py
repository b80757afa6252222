"""`sonarpost survey plot FILE…`: waterfall with scales, and track, as PNG; rows of pings are averaged to fit."""

import argparse
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import (
    add_survey_options,
    flag,
    make_output_folder,
    option,
    print_notes,
    survey_options_of,
    utc_text,
)
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.ground_range import beam_normalised, ground_range_image
from sonarpost.sonar.image_files import encode_png
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.source import SurveySource, strips
from sonarpost.sonar.survey import Ping, Side, Survey

FloatArray = npt.NDArray[np.float64]

SIDE_PX = 500
"""Width of one side of the waterfall."""
MAX_ROWS = 1500
_MAX_ROWS_OPTION = 20_000
_LEFT_PX, _BOTTOM_PX, _TOP_PX, _RIGHT_PX = 150, 34, 22, 30
_STRIP_PINGS, _MARGIN_PINGS = 1000, 50
_TRACK_PX, _MARGIN_PX = 800, 60
_MAX_FIXES = 4096
_INK, _PAPER, _BOTTOM_COLOUR = (20, 20, 20), (245, 245, 245), (255, 190, 0)
_LINE, _START, _END = (20, 70, 160), (0, 140, 60), (200, 30, 30)


def add_actions(parser: CommandParser) -> None:
    """Add the action."""
    parser = parser.add_action(
        "plot",
        "draw waterfalls and tracks",
        run,
        "line.xtf --ground --out plots",
        "Write NAME-waterfall.png and NAME-track.png for every survey file NAME.",
    )
    option(parser, "files FILE", "survey file", Path, nargs="+")
    option(parser, "--out DIR", "output folder", Path, Path())
    flag(parser, "--ground", "ground range, without the water column")
    flag(parser, "--even", "with --ground: divide by the mean echo at each angle")
    option(parser, "--rows N", "maximum rows, by averaging pings", int, MAX_ROWS)
    add_survey_options(parser)


def run(parsed: argparse.Namespace) -> int:
    """Draw every file; print the names of the images; return 0."""
    if not 1 <= parsed.rows <= _MAX_ROWS_OPTION:
        raise ConfigError("survey plot", "--rows", parsed.rows, f"1 to {_MAX_ROWS_OPTION}")
    if parsed.even and not parsed.ground:
        raise ConfigError("survey plot", "--even", "without --ground", "--even together with --ground")
    options = survey_options_of(parsed)
    make_output_folder(parsed.out)
    for path in parsed.files:
        with ProgressDisplay(step=f"drawing {path}"), open_survey(path, options) as source:
            print_notes(source.info)
            name = source.info.line_name
            title = f"{name}   {source.info.sonar_id}   {source.info.ping_count} pings"
            reduced = reduce_survey(source, over_ground=parsed.ground, max_rows=parsed.rows)
            if parsed.even:
                reduced = angle_normalised(reduced)
            images = {
                "waterfall": draw_waterfall(reduced, title, over_ground=parsed.ground),
                "track": draw_track(thinned_track(source.pings()), title),
            }
        for kind, image in images.items():
            target = parsed.out / f"{name}-{kind}.png"
            write_atomically(target, encode_png(image))
            print(target)
    return 0


def thinned_track(pings: Iterable[Ping]) -> list[Position]:
    """Return at most 4096 fixes, evenly distributed over the recording, including the last one."""
    kept: list[Position] = []
    every, number = 1, 0
    last: Position | None = None
    for ping in pings:
        if ping.lat_deg is None or ping.lon_deg is None:
            continue
        last = Position(ping.lat_deg, ping.lon_deg)
        if number % every == 0:
            kept.append(last)
            if len(kept) >= _MAX_FIXES - 1:
                kept, every = kept[::2], every * 2
        number += 1
    if last is not None and kept[-1] != last:
        kept.append(last)
    return kept


def draw_track(track: list[Position], title: str) -> Image.Image:
    """Draw a track, north up: start green, end red, a scale bar, and the position of the start as text.

    Returns:
        RGB image; with the text "no positions" for a recording without fixes.
    """
    image = Image.new("RGB", (_TRACK_PX, _TRACK_PX), _PAPER)
    draw = ImageDraw.Draw(image)
    draw.text((6, 4), title, fill=_INK)
    if not track:
        draw.text((_TRACK_PX // 2, _TRACK_PX // 2), "no positions", fill=_INK, anchor="mm")
        return image
    points_m = [offset_between_m(track[0], position) for position in track]
    norths, easts = zip(*points_m, strict=True)
    extent_m = max(max(norths) - min(norths), max(easts) - min(easts), 1.0)
    metre_px = (_TRACK_PX - 2 * _MARGIN_PX) / extent_m
    centre_n, centre_e = (max(norths) + min(norths)) / 2, (max(easts) + min(easts)) / 2
    pixels = [
        (_TRACK_PX / 2 + (east - centre_e) * metre_px, _TRACK_PX / 2 - (north - centre_n) * metre_px)
        for north, east in points_m
    ]
    if len(pixels) > 1:
        draw.line(pixels, fill=_LINE, width=2)
    for (x, y), colour, name in ((pixels[0], _START, "start"), (pixels[-1], _END, "end")):
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=colour)
        draw.text((x + 8, y - 5), name, fill=colour)
    step_m = nice_step(extent_m / 3)
    left, y = _MARGIN_PX, _TRACK_PX - 28
    draw.line((left, y, left + step_m * metre_px, y), fill=_INK, width=3)
    draw.text((left, y + 6), f"{step_m:g} m", fill=_INK)
    draw.text((_TRACK_PX - 20, 30), "N", fill=_INK, anchor="mm")
    draw.line((_TRACK_PX - 20, 40, _TRACK_PX - 20, 70), fill=_INK, width=2)
    start = track[0]
    text = (
        f"start {abs(start.lat_deg):.6f} {'NS'[start.lat_deg < 0]} {abs(start.lon_deg):.6f} {'EW'[start.lon_deg < 0]}"
    )
    draw.text((_TRACK_PX - 8, y + 6), f"{text}; {math.hypot(*points_m[-1]):.0f} m to the end", fill=_INK, anchor="ra")
    return image


@dataclass
class Reduced:
    """A recording averaged to the size of an image.

    Attributes:
        echo: Mean echo, shape (rows, 2 * side_px), port mirrored to the left; NaN where not recorded.
        altitude_m: Mean altitude of each row; NaN if unknown.
        times_utc_s: Time of the first ping of each row.
        numbers: Number of the first ping of each row.
        max_range_m: Range of the outer edges.
        pings_per_row: Number of pings averaged in a row.
    """

    echo: FloatArray
    altitude_m: FloatArray
    times_utc_s: list[float]
    numbers: list[int]
    max_range_m: float
    pings_per_row: int

    @property
    def side_px(self) -> int:
        """Columns of one side."""
        return int(self.echo.shape[1]) // 2

    def x(self, side: Side, slant_range_m: float) -> float:
        """Return the column of a slant range in the drawn image."""
        distance = slant_range_m / self.max_range_m * self.side_px
        return _LEFT_PX + self.side_px + (-distance if side is Side.PORT else distance)

    def y(self, ping_index: float) -> float:
        """Return the row of a ping in the drawn image."""
        return _TOP_PX + ping_index / self.pings_per_row


def reduce_survey(
    source: SurveySource, *, over_ground: bool, max_rows: int = MAX_ROWS, side_px: int = SIDE_PX
) -> Reduced:
    """Read a recording and average it into at most `max_rows` rows.

    Args:
        source: The recording.
        over_ground: Ground range without the water column, in place of slant range.
        max_rows: Maximum rows of the image, at least 1.
        side_px: Columns of one side.

    Raises:
        SurveyFileError: The file cannot be read.
    """
    ranges_m = (ping.max_slant_range_m() for ping in source.pings())
    max_range_m = max(range_m for range_m in ranges_m if range_m is not None)
    per_row = math.ceil(source.info.ping_count / max_rows)
    rows = math.ceil(source.info.ping_count / per_row)
    total, count = np.zeros((rows, 2 * side_px)), np.zeros((rows, 2 * side_px))
    heights, known = np.zeros(rows), np.zeros(rows)
    times: list[float] = []
    numbers: list[int] = []
    first = 0
    for survey, altitude_m in parts_with_altitude(source):
        row_of_ping = (first + np.arange(len(survey.pings))) // per_row
        image = both_sides(survey, altitude_m if over_ground else np.zeros_like(altitude_m), max_range_m, side_px)
        valid = np.isfinite(image)
        np.add.at(total, row_of_ping, np.where(valid, image, 0))
        np.add.at(count, row_of_ping, valid)
        np.add.at(heights, row_of_ping, np.nan_to_num(altitude_m))
        np.add.at(known, row_of_ping, np.isfinite(altitude_m))
        for row, ping in zip(row_of_ping.tolist(), survey.pings, strict=True):
            if row == len(times):
                times.append(ping.time_utc_s)
                numbers.append(ping.number)
        first += len(survey.pings)
    echo = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    altitudes = np.where(known > 0, heights / np.maximum(known, 1), np.nan)
    return Reduced(echo, altitudes, times, numbers, max_range_m, per_row)


def parts_with_altitude(source: SurveySource) -> Iterator[tuple[Survey, FloatArray]]:
    """Yield the recording in parts with their altitudes; bottom tracking includes pings of the neighbouring parts."""
    info = source.info
    for strip in strips(source.pings(), _STRIP_PINGS, 2 * _MARGIN_PINGS):
        survey = Survey(info.path, info.sonar_id, info.line_name, strip.pings)
        begin = _MARGIN_PINGS if strip.first_row else 0
        end = len(strip.pings) - (0 if strip.is_last else _MARGIN_PINGS)
        yield replace(survey, pings=strip.pings[begin:end]), altitudes_m(survey)[begin:end]


def both_sides(survey: Survey, altitude_m: FloatArray, max_range_m: float, side_px: int) -> FloatArray:
    """Return both sides over ground range, port mirrored to the left; an altitude of 0 gives slant range.

    Args:
        survey: The pings.
        altitude_m: Altitude of each ping, shape (pings,), in metres; NaN if unknown.
        max_range_m: Range of the outer edges.
        side_px: Columns of one side.

    Returns:
        Mean echo, shape (pings, 2 * side_px), float64; NaN where not recorded.
    """
    image = np.full((len(survey.pings), 2 * side_px), np.nan)
    for side in survey.sides():
        half = ground_range_image(survey, side, altitude_m, max_range_m / side_px)[:, :side_px]
        if side is Side.PORT:
            image[:, side_px - half.shape[1] : side_px] = half[:, ::-1]
        else:
            image[:, side_px : side_px + half.shape[1]] = half
    return image


def angle_normalised(reduced: Reduced) -> Reduced:
    """Return a recording over ground range, each side divided by the mean echo at each angle."""
    spacing_m = reduced.max_range_m / reduced.side_px
    port = reduced.echo[:, : reduced.side_px][:, ::-1].astype(np.float32)
    starboard = reduced.echo[:, reduced.side_px :].astype(np.float32)
    halves = [beam_normalised(half, reduced.altitude_m, spacing_m) for half in (port, starboard)]
    return replace(reduced, echo=np.hstack([halves[0][:, ::-1], halves[1]]).astype(np.float64))


def draw_waterfall(reduced: Reduced, title: str, *, over_ground: bool) -> Image.Image:
    """Draw a waterfall: first ping at the top, port on the left, ranges below, times and ping numbers on the left.

    Returns:
        RGB image. In slant range, the first bottom return is drawn in yellow where the altitude is known.
    """
    rows = reduced.echo.shape[0]
    image = Image.new("RGB", (_LEFT_PX + 2 * reduced.side_px + _RIGHT_PX, _TOP_PX + rows + _BOTTOM_PX), _PAPER)
    image.paste(Image.fromarray(GreyScale.of(reduced.echo).grey(reduced.echo)), (_LEFT_PX, _TOP_PX))
    draw = ImageDraw.Draw(image)
    axis = "ground range, m" if over_ground else "slant range, m"
    draw.text((6, 4), f"{title}   {axis}", fill=_INK)
    if not over_ground:
        _draw_bottom(draw, reduced)
    _draw_ranges(draw, reduced, _TOP_PX + rows)
    step = max(rows // 12, 24)
    for row in range(0, rows, step):
        y = _TOP_PX + row
        draw.line((_LEFT_PX - 6, y, _LEFT_PX, y), fill=_INK)
        clock = utc_text(reduced.times_utc_s[row])[11:21]
        draw.text((6, y - 5), f"{clock}  {reduced.numbers[row]}", fill=_INK)
    return image


@dataclass(frozen=True, slots=True)
class GreyScale:
    """Mapping of echo to grey: the logarithm, stretched between the 1st and the 99.5th percentile.

    Attributes:
        unit: Median of the positive echo.
        low: Logarithm that is black.
        high: Logarithm that is white.
    """

    unit: float
    low: float
    high: float

    @classmethod
    def of(cls, echo: FloatArray) -> Self:
        """Return the scale for an image; NaN is not recorded."""
        known = echo[np.isfinite(echo)]
        if not known.size:
            return cls(1.0, 0.0, 1.0)
        positive = known[known > 0]
        unit = float(np.median(positive)) if positive.size else 1.0
        low, high = np.percentile(np.log1p(known / unit * 4), (1, 99.5))
        return cls(unit, float(low), float(high))

    def grey(self, echo: FloatArray) -> npt.NDArray[np.uint8]:
        """Return an image as uint8 of the same shape; 30 where it is not recorded (NaN)."""
        known = np.isfinite(echo)
        value = np.log1p(np.where(known, echo, 0) / self.unit * 4)
        grey = np.clip((value - self.low) / max(self.high - self.low, 1e-9), 0, 1) * 255
        return np.where(known, grey, 30).astype(np.uint8)


def _draw_bottom(draw: ImageDraw.ImageDraw, reduced: Reduced) -> None:
    for row, altitude_m in enumerate(reduced.altitude_m.tolist()):
        if math.isfinite(altitude_m) and altitude_m < reduced.max_range_m:
            port_x, starboard_x = (round(reduced.x(side, altitude_m)) for side in Side)
            draw.point([(port_x - 1, _TOP_PX + row), (starboard_x, _TOP_PX + row)], fill=_BOTTOM_COLOUR)


def _draw_ranges(draw: ImageDraw.ImageDraw, reduced: Reduced, y: int) -> None:
    step_m = nice_step(reduced.max_range_m / 5)
    for number in range(int(reduced.max_range_m / step_m) + 1):
        range_m = number * step_m
        for side in Side if number else (Side.STARBOARD,):
            x = round(reduced.x(side, range_m))
            draw.line((x, y, x, y + 6), fill=_INK)
            draw.text((x, y + 8), f"{range_m:g}", fill=_INK, anchor="mt")
    for side in Side:
        draw.text((reduced.x(side, reduced.max_range_m / 2), y + 22), side.value, fill=_INK, anchor="mt")


def nice_step(limit: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten up to `limit`, which is positive."""
    power = 10.0 ** math.floor(math.log10(limit))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= limit * (1 + 1e-9))
