"""A detection as the record that is sent."""

from __future__ import annotations

from sonarpost.codec.interface import MIN_SIDE_PX
from sonarpost.detection.detector import Detection
from sonarpost.detection.snippets import cut_expanded, cut_snippet, ground_projected_image
from sonarpost.messages import Contact, Pixels, Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.seam import Origin
from sonarpost.sonar.geometry import georeference
from sonarpost.sonar.survey import Survey


def of_detection(survey: Survey, found: Detection, origin: Origin, vehicle_id: str, config: AtdStubConfig) -> Snippet:
    """Return a detection as the record that is sent, with its picture and a wider one, where the survey has more.

    A position is given only with its standard deviation, and a height only where the shadow was recorded to its end.

    Args:
        survey: The pings in which it was found.
        found: The detection.
        origin: The file its ping was in.
        vehicle_id: This vehicle.
        config: Size of the picture, and the errors of positions.
    """
    size = (config.snippet_height_px, config.snippet_width_px)
    cut = cut_snippet(survey, found, *size)
    picture, along_m, across_m = cut.image, cut.pixel_along_m, cut.pixel_across_m
    wide = None
    if config.snippet_pixel_m > 0:
        ground = ground_projected_image(survey, found, *size, config.snippet_pixel_m)
        if ground is not None:
            picture, along_m, across_m = ground, config.snippet_pixel_m, config.snippet_pixel_m
            wide = ground_projected_image(survey, found, *size, 2 * config.snippet_pixel_m)
    if picture is cut.image:
        wide = cut_expanded(survey, found, *size)
    place = georeference(
        survey.pings[found.ping_index],
        found.side,
        found.sample,
        config.survey_options(),
        tracked_altitude_m=found.altitude_m,
    )
    position = found.position if place is not None else None
    line_name = origin.line_name
    contact = Contact(
        contact_id=f"{line_name[:60]}-{origin.content[:8]}-{found.ping_number}-{found.side.value}-{found.sample}",
        vehicle_id=vehicle_id,
        sonar_id=survey.sonar_id,
        line_name=line_name,
        ping_number=found.ping_number,
        channel=found.side.value,
        time_utc_s=found.time_utc_s,
        lat_deg=position.lat_deg if position else None,
        lon_deg=position.lon_deg if position else None,
        position_sigma_m=place.drms_m if place is not None and position else None,
        depth_m=found.depth_m,
        altitude_m=found.altitude_m,
        heading_deg=found.heading_deg,
        speed_mps=found.speed_mps,
        slant_range_m=found.slant_range_m,
        ground_range_m=found.ground_range_m,
        atd_class=found.atd_class,
        atd_confidence=found.confidence,
        length_m=found.length_m,
        width_m=found.width_m,
        shadow_m=found.shadow_m,
        height_m=None if found.shadow_is_cut else found.height_m,
        pixel_along_m=along_m,
        pixel_across_m=across_m,
    )
    return Snippet(
        contact=contact,
        picture=Pixels.from_array(picture),
        source=origin.source,
        wide=None if wide is None or min(wide.shape) < MIN_SIDE_PX else Pixels.from_array(wide),
    )
