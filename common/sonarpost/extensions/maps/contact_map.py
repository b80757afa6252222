"""Georeferenced image of a contact: the seabed around it, north up."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sonarpost.detection.detector import Detection
from sonarpost.extensions.maps.geotiff import GeoTransform, Grey, write_image
from sonarpost.extensions.maps.ground_canvas import GroundCanvas
from sonarpost.extensions.maps.track import track_of, utm_epsg
from sonarpost.sonar.projection import Projection
from sonarpost.sonar.survey import Survey


@dataclass(frozen=True, slots=True)
class ContactMap:
    """Image of the seabed around a contact.

    Attributes:
        image: Shape (rows, columns), uint8, grey of a mosaic: 1 to 255, 0 without data.
        transform: Place of the image, in a UTM zone.
    """

    image: Grey
    transform: GeoTransform

    def write(self, path: Path) -> None:
        """Write it as GeoTIFF."""
        write_image(path, self.image, self.transform)


def contact_map(survey: Survey, detection: Detection, side_m: float, pixel_m: float) -> ContactMap | None:
    """Draw a square of seabed around a contact from the pings that recorded it, north up.

    Args:
        survey: The pings in which the contact was detected.
        detection: The contact, in the centre of the image.
        side_m: Side of the square.
        pixel_m: Side of a pixel.

    Returns:
        The image; None if position, altitude or distance between pings is unknown.

    Raises:
        SurveyFileError: The pixels are too small for the range of the sonar.
    """
    if detection.position is None or detection.altitude_m is None or detection.pixel_along_m is None:
        return None
    # The corners of the square, and as much again for a heading that differs from the course.
    reach = math.ceil(side_m * math.sqrt(2) / detection.pixel_along_m)
    rows = slice(max(detection.ping_index - reach, 0), detection.ping_index + reach + 1)
    part = replace(survey, pings=survey.pings[rows])
    altitude_m = np.array([detection.altitude_m if p.altitude_m is None else p.altitude_m for p in part.pings])
    epsg = utm_epsg(detection.position)
    projection = Projection(f"EPSG:{epsg}")
    east_m, north_m = projection.coordinates(detection.position)
    size_px = math.ceil(side_m / pixel_m)
    half_m = size_px * pixel_m / 2
    transform = GeoTransform(epsg, (east_m - half_m, north_m + half_m), (pixel_m, 0.0), (0.0, -pixel_m))
    with GroundCanvas((size_px, size_px), transform) as canvas:
        canvas.draw(track_of(part, altitude_m, projection))
        return ContactMap(canvas.image(), transform)
