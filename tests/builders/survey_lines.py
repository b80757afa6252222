"""Lines over an even bottom with a bright echo at a known place, recordings with a turn, places in their images."""

import math
from pathlib import Path

import numpy as np
import tifffile
from pyproj import Transformer

from sonarpost.sonar.geometry import Position, georeference, offset_position
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

ALTITUDE_M, RANGE_M, SAMPLES = 6.0, 30.0, 600
START = Position(48.4, -68.8)


def line(heading_deg=30.0, pings=120, spacing_m=0.25, start=START, bright=(60, Side.PORT, 20.0), level=255):
    """Return a straight line over an even bottom; a ping has a bright echo at a ground range on a side."""
    rng = np.random.default_rng(5)
    made = []
    for row in range(pings):
        place = offset_position(start, heading_deg, row * spacing_m)
        channels = []
        for side in Side:
            samples = np.clip(rng.rayleigh(20, SAMPLES), 1, 200).astype(np.uint8)
            if bright is not None and abs(row - bright[0]) <= 1 and side is bright[1]:
                middle = int(math.hypot(bright[2], ALTITUDE_M) / RANGE_M * SAMPLES)
                samples[middle - 3 : middle + 4] = level
            channels.append(ChannelPing(side, samples, RANGE_M))
        navigation = {"lat_deg": place.lat_deg, "lon_deg": place.lon_deg, "heading_deg": heading_deg}
        time_utc_s = 1.5e9 + 0.2 * row
        made.append(Ping(row, time_utc_s, tuple(channels), **navigation, altitude_m=ALTITUDE_M, speed_mps=1.25))
    return Survey(Path("line.xtf"), "HDS", "line", tuple(made))


def course(headings_deg, spacing_m=0.5, start=START):
    """Return a recording that goes a step along each heading."""
    samples = np.full(SAMPLES, 20, np.uint8)
    channels = tuple(ChannelPing(side, samples, RANGE_M) for side in Side)
    pings, place = [], start
    for row, heading_deg in enumerate(headings_deg):
        place = offset_position(place, heading_deg, spacing_m)
        navigation = {"lat_deg": place.lat_deg, "lon_deg": place.lon_deg, "heading_deg": heading_deg % 360}
        time_utc_s = 1.5e9 + 0.4 * row
        pings.append(Ping(row, time_utc_s, channels, **navigation, altitude_m=ALTITUDE_M, speed_mps=1.25))
    return Survey(Path("line.xtf"), "HDS", "line", tuple(pings))


def with_turn(radius_m, leg_pings=120, spacing_m=0.5):
    """Return a recording of two parallel lines in opposite directions, with a turn to starboard between them."""
    steps = round(math.pi * radius_m / spacing_m)
    turn = np.linspace(0, 180, steps + 1)[1:].tolist()
    return course([*[0.0] * leg_pings, *turn, *[180.0] * leg_pings], spacing_m)


def pixel(path, position):
    """Return column and row of a position in a GeoTIFF, by its tags."""
    with tifffile.TiffFile(path) as file:
        tags = file.pages[0].tags
        keys = tags["GeoKeyDirectoryTag"].value
        if "ModelTransformationTag" in tags:
            matrix = np.array(tags["ModelTransformationTag"].value, float).reshape(4, 4)[:2][:, [0, 1, 3]]
        else:
            scale, tie = tags["ModelPixelScaleTag"].value, tags["ModelTiepointTag"].value
            matrix = np.array([[scale[0], 0, tie[3]], [0, -scale[1], tie[4]]])
    (epsg,) = [keys[at + 3] for at in range(4, len(keys), 4) if keys[at] == 3072]
    place = Transformer.from_crs(4326, epsg, always_xy=True).transform(position.lon_deg, position.lat_deg)
    column, row = np.linalg.solve(matrix[:, :2], place - matrix[:, 2])
    return float(column), float(row)


def brightest_px(image, column, row, radius_px=15):
    """Return the middle of the brightest pixels around a place."""
    left, top = int(column) - radius_px, int(row) - radius_px
    window = image[top : top + 2 * radius_px + 1, left : left + 2 * radius_px + 1]
    rows, columns = np.nonzero(window >= np.sort(window, axis=None)[-12])
    return left + columns.mean() + 0.5, top + rows.mean() + 0.5


def echo_position(survey, ping, side, ground_m):
    """Return the position of the bright echo of a line at a ground range."""
    sample = math.hypot(ground_m, ALTITUDE_M) / RANGE_M * SAMPLES - 0.5
    return georeference(survey.pings[ping], side, sample, SurveyOptions()).position
