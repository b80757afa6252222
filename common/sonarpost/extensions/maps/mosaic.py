"""Ground-range mosaic of recordings: a georeferenced image of the seabed, and the polygons that it covers.

Memory does not depend on the length of the recordings: they are read twice in strips, and tiles of the image that are
not in use are in a temporary file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from sonarpost.extensions.maps.coverage import Coverage, outline_of
from sonarpost.extensions.maps.geotiff import GeoTransform, write_tiles
from sonarpost.extensions.maps.ground_canvas import MIN_RESOLUTION_M, GroundCanvas, checked_size
from sonarpost.extensions.maps.track import first_position, tracks, utm_epsg
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.projection import Projection
from sonarpost.sonar.readers import open_survey


@dataclass(frozen=True, slots=True)
class MosaicResult:
    """What was written.

    Attributes:
        transform: Place of the image.
        size_px: Rows and columns.
        coverage: The covered seabed, and the number of pings.
    """

    transform: GeoTransform
    size_px: tuple[int, int]
    coverage: Coverage


def write_mosaic(
    paths: Sequence[Path],
    out: Path,
    resolution_m: float,
    options: SurveyOptions | None = None,
) -> MosaicResult:
    """Write the mosaic of recordings as a cloud-optimised GeoTIFF in the UTM zone of the first position.

    Grey is 1 to 255, 128 at the mean echo of an angle, and 0 without data.

    Args:
        paths: Survey files.
        out: GeoTIFF to create or replace.
        resolution_m: Side of a pixel, from 0.01 m.
        options: Of the recordings.

    Raises:
        SurveyFileError: A recording cannot be read, none has a ping with position, heading and altitude, or the image
            would be too large.
        ValueError: The resolution is too fine.
        OSError: A file cannot be written.
    """
    if not resolution_m >= MIN_RESOLUTION_M:
        raise ValueError(f"resolution of {resolution_m} m, expected at least {MIN_RESOLUTION_M} m")
    with ExitStack() as stack:
        sources = [stack.enter_context(open_survey(path, options)) for path in paths]
        epsg = utm_epsg(first_position(sources))
        projection = Projection(f"EPSG:{epsg}")
        outline = outline_of(sources, projection)
        west_m = math.floor(outline.low_m[0] / resolution_m) * resolution_m
        north_m = math.ceil(outline.high_m[1] / resolution_m) * resolution_m
        width_px = math.floor((outline.high_m[0] - west_m) / resolution_m) + 1
        height_px = math.floor((north_m - outline.low_m[1]) / resolution_m) + 1
        checked_size(out, (height_px, width_px))
        transform = GeoTransform(epsg, (west_m, north_m), (resolution_m, 0.0), (0.0, -resolution_m))
        canvas = stack.enter_context(GroundCanvas((height_px, width_px), transform, out.parent))
        for source in sources:
            for track in tracks(source, projection):
                canvas.draw(track)
        write_tiles(out, (height_px, width_px), canvas.grey, transform)
        return MosaicResult(transform, (height_px, width_px), outline.coverage())
