"""The one flat list of what an export says of a contact: the columns of CSV, the properties of GeoJSON and KML."""

from __future__ import annotations

from typing import Final

from sonarpost.export.accepted import AcceptedContact
from sonarpost.export.text import utc_text

Value = str | int | float | bool | None

DEGREE_DECIMALS: Final = 7
"""A hundredth of a metre; more digits would be invented."""

COLUMNS: Final[tuple[str, ...]] = (
    "uid",
    "name",
    "vessel_id",
    "vehicle_id",
    "image_id",
    "version",
    "review",
    "mlo_class",
    "operator_confidence",
    "operator",
    "decided_utc",
    "decided_version",
    "decisions",
    "remark",
    "lat_deg",
    "lon_deg",
    "position_sigma_m",
    "seen_utc",
    "first_frame_utc",
    "last_frame_utc",
    "depth_m",
    "altitude_m",
    "heading_deg",
    "channel",
    "ground_range_m",
    "atd_class",
    "atd_confidence",
    "length_m",
    "width_m",
    "shadow_m",
    "height_m",
    "pixel_along_m",
    "pixel_across_m",
    "picture_height_px",
    "picture_width_px",
    "picture_complete",
    "picture_missing_fraction",
    "picture_sha256",
    "picture_file",
    "notes",
)
"""Names of the properties in their order; `docs/reference/exports.md` says what each means."""


def properties(contact: AcceptedContact) -> dict[str, Value]:
    """Return everything known of a contact under the names of `COLUMNS`; None is not known."""
    image, decision, position = contact.image, contact.decision, contact.position
    values: dict[str, Value] = {
        "uid": contact.uid,
        "name": contact.name,
        "vessel_id": image.vessel_id,
        "vehicle_id": image.vehicle_id,
        "image_id": image.image_id,
        "version": image.version,
        "review": contact.review,
        "mlo_class": decision.mlo_class if decision else None,
        "operator_confidence": decision.confidence if decision else None,
        "operator": decision.operator if decision else None,
        "decided_utc": utc_text(decision.decided_utc_s) if decision else None,
        "decided_version": decision.image_version if decision else None,
        "decisions": len(contact.decisions),
        "remark": decision.remark if decision else None,
        "lat_deg": round(position[0], DEGREE_DECIMALS) if position else None,
        "lon_deg": round(position[1], DEGREE_DECIMALS) if position else None,
        "first_frame_utc": utc_text(image.first_frame_utc_s),
        "last_frame_utc": utc_text(image.last_frame_utc_s),
        "picture_height_px": image.height_px,
        "picture_width_px": image.width_px,
        "picture_complete": image.complete,
        "picture_missing_fraction": image.missing_fraction,
        "picture_sha256": image.picture_sha256,
        "picture_file": f"{image.vessel_id}/{contact.picture.name}" if contact.picture else None,
        "notes": "; ".join(image.notes),
        **_of_the_record(contact),
    }
    return {name: values[name] for name in COLUMNS}


_RECORD_FIELDS: Final = (
    "position_sigma_m",
    "depth_m",
    "altitude_m",
    "heading_deg",
    "channel",
    "ground_range_m",
    "atd_class",
    "atd_confidence",
    "length_m",
    "width_m",
    "shadow_m",
    "height_m",
    "pixel_along_m",
    "pixel_across_m",
)


def _of_the_record(contact: AcceptedContact) -> dict[str, Value]:
    record = contact.image.contact
    if record is None:
        return dict.fromkeys(("seen_utc", *_RECORD_FIELDS))
    seen = None if record.time_utc_s is None else utc_text(record.time_utc_s)
    return {"seen_utc": seen, **{name: getattr(record, name) for name in _RECORD_FIELDS}}
