"""A contact of `sonarpost detect` as JSON: the fields of the contact record, and where it lies in the picture."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from sonarpost.detection.stream import StreamContact
from sonarpost.sonar.survey import Survey


@dataclass
class FoundIn:
    """A file, what was found in it, and the time that detecting took."""

    survey: Survey
    contacts: list[StreamContact]
    seconds: float = 0.0


def contact_json(survey: Survey, contact: StreamContact, vehicle_id: str) -> dict[str, object]:
    """Return one contact as JSON types.

    Args:
        survey: The file that holds the contact's ping.
        contact: The contact.
        vehicle_id: Of the record.
    """
    d = contact.detection
    line_name = survey.line_name.encode("utf-8", "backslashreplace").decode()
    return {
        "contact_id": f"{line_name[:60]}-{_content_hash(survey.path)[:8]}-{d.ping_number}-{d.side.value}-{d.sample}",
        "vehicle_id": vehicle_id,
        "sonar_id": survey.sonar_id,
        "line_name": line_name,
        "ping_number": d.ping_number,
        "channel": d.side.value,
        "ping": contact.ping,
        "sample": d.sample,
        "time_utc": datetime.fromtimestamp(d.time_utc_s, UTC).isoformat(timespec="milliseconds"),
        "lat_deg": None if d.position is None else d.position.lat_deg,
        "lon_deg": None if d.position is None else d.position.lon_deg,
        "position_sigma_m": d.position_sigma_m,
        "depth_m": d.depth_m,
        "altitude_m": d.altitude_m,
        "heading_deg": d.heading_deg,
        "speed_mps": d.speed_mps,
        "slant_range_m": d.slant_range_m,
        "ground_range_m": d.ground_range_m,
        "atd_class": d.atd_class,
        "atd_confidence": d.confidence,
        "length_m": d.length_m,
        "width_m": d.width_m,
        "shadow_m": d.shadow_m,
        "shadow_is_cut": d.shadow_is_cut,
        "height_m": d.height_m,
        "pixel_along_m": d.pixel_along_m,
        "pixel_across_m": d.pixel_across_m,
        "scores": {
            "matched": d.scores.matched,
            "cfar": d.scores.cfar,
            "shadow": d.scores.shadow,
            "texture": d.scores.texture,
            "geometry": d.scores.geometry,
        },
    }


@cache
def _content_hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
