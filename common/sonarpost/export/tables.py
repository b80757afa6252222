"""Flat tables of contacts: CSV (RFC 4180) and GeoJSON (RFC 7946)."""

from __future__ import annotations

import codecs
import csv
import json
import shutil
from collections.abc import Callable, Mapping
from typing import IO, Any, Final

from sonarpost.export.contacts import ExportContact
from sonarpost.export.source import ExportSource
from sonarpost.export.text import csv_text, utc_text, xml_text
from sonarpost.messages import Contact
from sonarpost.review.measurement import SIZE_FIELDS

Value = str | int | float | bool | None

DEGREE_DECIMALS: Final = 7
"""One unit of the last digit is about 1 cm on the ground."""


def _degrees(contact: ExportContact, index: int) -> float | None:
    return None if contact.position is None else round(contact.position[index], DEGREE_DECIMALS)


def _utc(time_utc_s: float | None) -> str | None:
    return None if time_utc_s is None else utc_text(time_utc_s)


def _from_record(name: str) -> Callable[[ExportContact], Value]:
    """Return a function that reads a field of the contact record; None if no contact record was received."""
    return lambda contact: getattr(contact.image.contact, name, None)


def _from_decision(name: str) -> Callable[[ExportContact], Value]:
    """Return a function that reads a field of the decision that counts; None if there is none."""
    return lambda contact: getattr(contact.decision, name, None)


def _from_size(name: str) -> Callable[[ExportContact], Value]:
    """Return a function that reads a measurement of operators, rounded to 1 mm; None if it was not measured."""

    def read(contact: ExportContact) -> Value:
        value: float | None = getattr(contact.size, name)
        return None if value is None else round(value, 3)

    return read


_RECORD_FIELDS: Final = (
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
_OMITTED: Final = (
    "contact_id",
    "sonar_id",
    "line_name",
    "ping_number",
    "position_note",
    "time_utc_s",
    "speed_mps",
    "slant_range_m",
)
"""Fields of `Contact` that the tables do not have, or have under another name."""

_PLACED: Final[Mapping[str, Callable[[ExportContact], Value]]] = {
    "uid": lambda c: c.uid,
    "name": lambda c: c.name,
    "vessel_id": lambda c: c.image.vessel_id,
    "vehicle_id": lambda c: c.image.vehicle_id,
    "image_id": lambda c: c.image.image_id,
    "version": lambda c: c.image.version,
    "review": lambda c: c.review,
    "mlo_class": _from_decision("mlo_class"),
    "operator_confidence": _from_decision("confidence"),
    "operator": _from_decision("operator"),
    "decided_utc": lambda c: _utc(c.decision.decided_utc_s if c.decision else None),
    "decided_version": _from_decision("image_version"),
    "decisions": lambda c: len(c.decisions),
    "remark": _from_decision("remark"),
    "lat_deg": lambda c: _degrees(c, 0),
    "lon_deg": lambda c: _degrees(c, 1),
    "position_sigma_m": _from_record("position_sigma_m"),
    "seen_utc": lambda c: _utc(c.image.contact.time_utc_s if c.image.contact else None),
    "first_frame_utc": lambda c: utc_text(c.image.first_frame_utc_s),
    "last_frame_utc": lambda c: utc_text(c.image.last_frame_utc_s),
    **{name: _from_record(name) for name in _RECORD_FIELDS},
    "image_height_px": lambda c: c.image.height_px,
    "image_width_px": lambda c: c.image.width_px,
    "image_complete": lambda c: c.image.complete,
    "image_missing_fraction": lambda c: c.image.missing_fraction,
    "pixels_sha256": lambda c: c.image.pixels_sha256,
    "image_file": lambda c: f"{c.image.vessel_id}/{c.image_path.name}" if c.image_path else None,
    "notes": lambda c: "; ".join(c.image.notes),
    "authenticated": lambda c: c.image.authenticated,
    **{name: _from_record(name) for name in ("p_mine_like", "p_other_object")},
    "withdrawn_by": lambda c: c.withdrawn_by,
    **{f"measured_{name}": _from_size(name) for name in SIZE_FIELDS},
}

FURTHER_FIELDS: Final = tuple(name for name in Contact.model_fields if name not in {*_PLACED, *_OMITTED})
"""Fields of `Contact` that have no place of their own: tables, report, page and other exports append them by name."""

_PROPERTIES: Final = {**_PLACED, **{name: _from_record(name) for name in FURTHER_FIELDS}}

COLUMNS: Final = tuple(_PROPERTIES)
"""Names of the properties in their order. `docs/reference/exports.md` describes them."""


def contact_properties(contact: ExportContact) -> dict[str, Value]:
    """Return the properties of a contact, one for each of `COLUMNS`; None means unknown."""
    return {name: read(contact) for name, read in _PROPERTIES.items()}


def further_values(record: Contact | None) -> dict[str, Value]:
    """Return the known values of `FURTHER_FIELDS` by their name as text for people."""
    values = {name.replace("_", " "): getattr(record, name, None) for name in FURTHER_FIELDS}
    return {name: value for name, value in values.items() if value is not None}


def write_csv(file: IO[bytes], source: ExportSource) -> None:
    """Write a CSV table with one row for each contact, including contacts without a position.

    The text is UTF-8 with a byte order mark, which spreadsheet programs need to recognise the encoding. Lines end with
    CR LF.
    """
    writer = csv.writer(codecs.getwriter("utf-8-sig")(file), lineterminator="\r\n")
    writer.writerow(COLUMNS)
    for contact in source.contacts:
        writer.writerow([_cell(value) for value in contact_properties(contact).values()])


def write_geojson(file: IO[bytes], source: ExportSource) -> None:
    """Write a GeoJSON FeatureCollection of points as UTF-8 text. Equal contacts give equal bytes.

    Contacts without a position are not features. Their properties are in the foreign member `unlocated`.
    """
    counts = {True: 0, False: 0}
    file.write(b'{\n "type": "FeatureCollection",\n "features": [')
    with source.temporary_file() as unlocated:
        for contact in source.contacts:
            is_located = contact.position is not None
            item = geojson_feature(contact) if is_located else _without_control_characters(contact)
            text = json.dumps(item, ensure_ascii=False, allow_nan=False, indent=1).replace("\n", "\n  ")
            part: IO[bytes] = file if is_located else unlocated
            part.write(f"{',' if counts[is_located] else ''}\n  {text}".encode())
            counts[is_located] += 1
        file.write(b'%s],\n "unlocated": [' % (b"\n " if counts[True] else b""))
        unlocated.seek(0)
        shutil.copyfileobj(unlocated, file)
        file.write(b"%s]\n}\n" % (b"\n " if counts[False] else b""))


def geojson_feature(contact: ExportContact) -> dict[str, Any]:
    """Return a contact with a position as a GeoJSON point, longitude first, WGS 84."""
    values = _without_control_characters(contact)
    point = {"type": "Point", "coordinates": [values["lon_deg"], values["lat_deg"]]}
    return {"type": "Feature", "id": contact.uid, "geometry": point, "properties": values}


def _cell(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    # Numbers are not escaped: their minus sign would be taken for a formula.
    return csv_text(value) if isinstance(value, str) else repr(value)


def _without_control_characters(contact: ExportContact) -> dict[str, Value]:
    values = contact_properties(contact)
    return {name: xml_text(value) if isinstance(value, str) else value for name, value in values.items()}
