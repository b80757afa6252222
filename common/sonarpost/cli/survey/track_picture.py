"""A recording's track on the tangent plane, with a scale, north up."""

from __future__ import annotations

import math
from collections.abc import Iterable

from PIL import Image, ImageDraw

from sonarpost.cli.survey.waterfall_picture import nice_step
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.survey import Ping

_SIDE_PX, _MARGIN_PX = 800, 60
_MAX_FIXES = 4096
_INK, _PAPER, _LINE, _START, _END = (20, 20, 20), (245, 245, 245), (20, 70, 160), (0, 140, 60), (200, 30, 30)


def thinned_track(pings: Iterable[Ping]) -> list[Position]:
    """Return at most 4096 fixes, evenly spread over the recording; the last is always among them."""
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
    """Draw a track: start green, end red, a scale bar, and the position of the start in words.

    Returns:
        RGB picture; one that says so for a recording without positions.
    """
    picture = Image.new("RGB", (_SIDE_PX, _SIDE_PX), _PAPER)
    draw = ImageDraw.Draw(picture)
    draw.text((6, 4), title, fill=_INK)
    if not track:
        draw.text((_SIDE_PX // 2, _SIDE_PX // 2), "no positions", fill=_INK, anchor="mm")
        return picture
    points_m = [offset_between_m(track[0], place) for place in track]
    norths, easts = zip(*points_m, strict=True)
    extent_m = max(max(norths) - min(norths), max(easts) - min(easts), 1.0)
    metre_px = (_SIDE_PX - 2 * _MARGIN_PX) / extent_m
    middle_n, middle_e = (max(norths) + min(norths)) / 2, (max(easts) + min(easts)) / 2
    pixels = [
        (_SIDE_PX / 2 + (east - middle_e) * metre_px, _SIDE_PX / 2 - (north - middle_n) * metre_px)
        for north, east in points_m
    ]
    if len(pixels) > 1:
        draw.line(pixels, fill=_LINE, width=2)
    for (x, y), colour, name in ((pixels[0], _START, "start"), (pixels[-1], _END, "end")):
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=colour)
        draw.text((x + 8, y - 5), name, fill=colour)
    step_m = nice_step(extent_m / 3)
    left, y = _MARGIN_PX, _SIDE_PX - 28
    draw.line((left, y, left + step_m * metre_px, y), fill=_INK, width=3)
    draw.text((left, y + 6), f"{step_m:g} m", fill=_INK)
    draw.text((_SIDE_PX - 20, 30), "N", fill=_INK, anchor="mm")
    draw.line((_SIDE_PX - 20, 40, _SIDE_PX - 20, 70), fill=_INK, width=2)
    start = track[0]
    place = (
        f"start {abs(start.lat_deg):.6f} {'NS'[start.lat_deg < 0]} {abs(start.lon_deg):.6f} {'EW'[start.lon_deg < 0]}"
    )
    draw.text((_SIDE_PX - 8, y + 6), f"{place}; {math.hypot(*points_m[-1]):.0f} m to the end", fill=_INK, anchor="ra")
    return picture
