"""From a file to the snippets worth sending: by detection in a survey, or a picture as it is."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from sonarpost.codec.interface import check_image
from sonarpost.errors import StreamError, SurveyFileError
from sonarpost.messages import Contact, Pixels, Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.folder import printable
from sonarpost.services.atd_stub.seam import Origin, Seam
from sonarpost.services.atd_stub.survey_walk import Finding, SurveyWalk
from sonarpost.services.atd_stub.text_file import read_contact
from sonarpost.sonar.image_files import read_image
from sonarpost.sonar.readers import open_survey


def from_survey(
    path: Path,
    content: str,
    vehicle_id: str,
    config: AtdStubConfig,
    seams: Mapping[str, Seam] | None = None,
    now_utc_s: float = 0.0,
) -> Finding:
    """Detect the contacts of a survey file.

    Args:
        path: The file.
        content: Hex sha256 of its content; part of the contacts' identifiers.
        vehicle_id: This vehicle.
        config: Threshold, limit, size of the snippets, and what the file does not say.
        seams: Ends of earlier files, by sonar.
        now_utc_s: The time, for how long contacts at the file's end are held.

    Raises:
        SurveyFileError: The file is not a survey that can be read.
    """
    with open_survey(path, config.survey_options()) as source:
        origin = Origin(content, printable(path.name), printable(source.info.line_name))
        walk = SurveyWalk(source, origin, vehicle_id, config)
        return walk.run((seams or {}).get(source.info.sonar_id), now_utc_s)


def from_picture(path: Path, content: str, vehicle_id: str) -> Finding:
    """Take a TIFF or PNG as the snippet of a contact, of which a text file beside it says what is known.

    Raises:
        SurveyFileError: Not a grey picture of 8 or 16 bits, 16 to 512 px a side; or the text file is not one.
    """
    picture = read_image(path)
    try:
        check_image(picture, str(path))
    except StreamError as error:
        raise SurveyFileError(error.where, error.field, error.value, error.expected) from error
    contact_id = f"{printable(path.stem)[:80]}-{content[:8]}"
    text = path.with_suffix(".txt")
    known = text.is_file()
    contact = (
        read_contact(text, contact_id, vehicle_id) if known else Contact(contact_id=contact_id, vehicle_id=vehicle_id)
    )
    return Finding((Snippet(contact=contact, picture=Pixels.from_array(picture), source=printable(path.name)),), 1)
