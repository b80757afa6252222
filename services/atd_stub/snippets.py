"""From a file to the snippets worth sending: by detection in a survey, or a picture as it is."""

from __future__ import annotations

from pathlib import Path

from services.atd_stub.config import AtdStubConfig
from services.atd_stub.folder import printable
from sonarpost.codec.interface import check_image
from sonarpost.detect.contacts import Detection, detect
from sonarpost.detect.settings import DetectorSettings
from sonarpost.detect.snippet import cut_snippet
from sonarpost.errors import StreamError, SurveyFileError
from sonarpost.messages import Contact, Raster, Snippet
from sonarpost.sonar.image_files import read_image
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Survey


def from_survey(path: Path, content: str, vehicle_id: str, config: AtdStubConfig) -> tuple[Snippet, ...]:
    """Detect the contacts of a survey file, most confident first.

    Args:
        path: The file.
        content: Hex sha256 of its content; part of the contacts' identifiers.
        vehicle_id: This vehicle.
        config: Threshold, limit and size of the snippets.

    Raises:
        SurveyFileError: The file is not a survey that can be read.
    """
    survey = read_survey(path)
    settings = DetectorSettings(
        confidence_threshold=config.confidence_threshold, max_contacts=config.max_contacts or None
    )
    found = detect(survey, settings)
    return tuple(_snippet(survey, detection, content, vehicle_id, config) for detection in found)


def _snippet(survey: Survey, found: Detection, content: str, vehicle_id: str, config: AtdStubConfig) -> Snippet:
    cut = cut_snippet(survey, found, config.snippet_height_px, config.snippet_width_px)
    line_name = printable(survey.line_name)
    contact = Contact(
        contact_id=f"{line_name[:60]}-{content[:8]}-{found.ping_number}-{found.side.value}-{found.sample}",
        vehicle_id=vehicle_id,
        sonar_id=survey.sonar_id,
        line_name=line_name,
        ping_number=found.ping_number,
        channel=found.side.value,
        time_utc_s=found.time_utc_s,
        lat_deg=found.position.lat_deg if found.position else None,
        lon_deg=found.position.lon_deg if found.position else None,
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
        height_m=found.height_m,
        pixel_along_m=found.pixel_along_m,
        pixel_across_m=found.pixel_across_m,
    )
    return Snippet(contact=contact, picture=Raster.from_array(cut.image), source=printable(survey.path.name))


def from_picture(path: Path, content: str, vehicle_id: str) -> tuple[Snippet, ...]:
    """Take a TIFF or PNG as the snippet of a contact of which nothing else is known.

    Raises:
        SurveyFileError: Not a grey picture of 8 or 16 bits, 16 to 512 px a side.
    """
    picture = read_image(path)
    try:
        check_image(picture, str(path))
    except StreamError as error:
        raise SurveyFileError(error.where, error.field, error.value, error.expected) from error
    contact = Contact(contact_id=f"{printable(path.stem)[:80]}-{content[:8]}", vehicle_id=vehicle_id)
    return (Snippet(contact=contact, picture=Raster.from_array(picture), source=printable(path.name)),)
