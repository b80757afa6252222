"""Routes of exports, and of the printable report of a contact."""

from __future__ import annotations

import base64
import html
import sqlite3
import tempfile
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from starlette.responses import Response
from starlette.routing import Route

from sonarpost import wire
from sonarpost.archive.image_files import side_car
from sonarpost.export.contacts import ContactSet, ExportContact, SideCar
from sonarpost.export.cot import cot_events
from sonarpost.export.kml import kmz_bytes
from sonarpost.export.tables import csv_bytes, geojson_bytes
from sonarpost.messages import Decision, ReconstructedImage
from sonarpost.review import rendering
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contacts import ContactFilter, find_version, list_contacts
from sonarpost.services.console.store.serialisers import Json, decode_image
from sonarpost.services.console.web.access import AccessControl, ApiError, Call

MAX_CONTACTS: Final = 10_000
_PAGE: Final = 500


def _cot_bytes(contacts: ContactSet) -> bytes:
    events = b"\n".join(cot_events(contacts, time.time()))
    return b'<?xml version="1.0" encoding="UTF-8"?>\n<events>\n' + events + b"\n</events>\n"


_FORMATS: Final[Mapping[str, tuple[Callable[[ContactSet], bytes], str]]] = {
    "contacts.geojson": (geojson_bytes, "application/geo+json"),
    "contacts.csv": (csv_bytes, "text/csv; charset=utf-8"),
    "contacts.kmz": (lambda contacts: kmz_bytes(contacts)[0], "application/vnd.google-earth.kmz"),
    "contacts.cot.xml": (_cot_bytes, "application/xml"),
}


class ExportRoutes:
    """Routes of exports and reports."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/export/{name}", access.endpoint(self._export)),
            Route("/report/{id}", access.endpoint(self._report)),
        ]

    def _export(self, call: Call) -> Response:
        name = str(call.request.path_params["name"])
        if name not in _FORMATS:
            raise ApiError(404, "not_found", "one of " + ", ".join(_FORMATS))
        convert, media_type = _FORMATS[name]
        # The KMZ export reads images from files.
        with tempfile.TemporaryDirectory(prefix="sonarpost-export-") as folder:
            image_folder = Path(folder) if name.endswith(".kmz") else None
            data = convert(self._contacts(call.parse_query(ContactFilter), image_folder))
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return Response(data, media_type=media_type, headers=headers)

    def _contacts(self, query: ContactFilter, image_folder: Path | None) -> ContactSet:
        found: list[ExportContact] = []
        with self._state.database.read() as db:
            for offset in range(0, MAX_CONTACTS, _PAGE):
                items = list_contacts(db, query.model_copy(update={"offset": offset, "limit": _PAGE}))["items"]
                assert isinstance(items, list)
                found += [_export_contact(db, item, image_folder) for item in items]
                if len(items) < _PAGE:
                    break
        found.sort(key=lambda contact: (contact.image.first_frame_utc_s, contact.uid))
        return ContactSet(tuple(found), (), ())

    def _report(self, call: Call) -> Response:
        contact_id = str(call.request.path_params["id"])
        detail = self._state.contact_detail(contact_id)
        contact = detail["contact"]
        assert isinstance(contact, dict)
        image = self._state.image(contact_id, int(contact["version"]))
        headers = {"Content-Disposition": f'inline; filename="{contact["name"].replace("/", "-")}.html"'}
        text = report_html(detail, image, time.time())
        return Response(text, media_type="text/html; charset=utf-8", headers=headers)


def _export_contact(db: sqlite3.Connection, item: Json, image_folder: Path | None) -> ExportContact:
    row = find_version(db, str(item["id"]), int(str(item["version"])))
    assert row is not None
    image = decode_image(row)
    rows = db.execute(
        "SELECT payload FROM decision WHERE contact_id = ? ORDER BY decided_utc_s, seq", (item["id"],)
    ).fetchall()
    decisions = tuple(wire.decode(Decision, bytes(row["payload"]), "decision") for row in rows)
    path = None
    if image_folder is not None and image.codec:
        path = image_folder / f"{item['id']}.png"
        path.write_bytes(rendering.encode_png(rendering.eight_bits(image.picture.to_array())))
    return ExportContact(SideCar.model_validate(side_car(image)), decisions, path)


# Report


_LENGTHS: Final = (
    ("Ground range", "ground_range_m"),
    ("Altitude of the vehicle", "altitude_m"),
    ("Depth of the vehicle", "depth_m"),
    ("Length (detector)", "length_m"),
    ("Width (detector)", "width_m"),
    ("Shadow (detector)", "shadow_m"),
    ("Height (detector)", "height_m"),
)


_AUTHENTICATION: Final[Mapping[bool | None, str]] = {
    True: "authenticated",
    False: "UNAUTHENTICATED: any modem in range can have forged this contact",
    None: "",
}


def report_html(detail: Json, image: ReconstructedImage, now_utc_s: float) -> str:
    """Return a page about a contact for printing on one or two sheets. Text of operators is escaped.

    Args:
        detail: Result of `ConsoleState.contact_detail`.
        image: Image version to show.
        now_utc_s: Time of the report.
    """
    contact, record = detail["contact"], detail["record"] or {}
    assert isinstance(contact, dict)
    assert isinstance(record, dict)
    png = rendering.encode_png(rendering.eight_bits(image.picture.to_array()))
    name = html.escape(str(contact["name"]))
    lat, lon = contact["lat_deg"], contact["lon_deg"]
    facts = [
        ("Verdict", contact["review"]),
        ("Class", contact["mlo_class"]),
        ("Confidence of the operator", contact["confidence"]),
        ("Decided by", contact["decided_by"]),
        ("Decided", _time_text(contact["decided_utc_s"])),
        ("Latitude, longitude (WGS 84)", "" if lat is None or lon is None else f"{lat:.7f}, {lon:.7f}"),
        ("Standard deviation of the position, m", contact["position_sigma_m"]),
        ("Confidence of the detector, 0 to 2", contact["atd_confidence"]),
        ("Detected", _time_text(contact["seen_utc_s"])),
        *((f"{label}, m", record.get(key)) for label, key in _LENGTHS),
        ("Codec", image.codec),
        ("Version of the image", image.version),
        ("Received", f"{image.bytes_received} of {image.bytes_total} bytes, {contact['percent_received']} %"),
        ("Area not received", f"{100 * float(image.missing().mean()):.1f} % (black in the image)"),
        ("SHA-256 of the pixels", image.picture_sha256),
        ("Acoustic frames", _AUTHENTICATION[image.authenticated]),
    ]
    return (
        "<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'>"
        f"<title>{name}</title><link rel='icon' href='/static/icon.svg'>"
        "<link rel='stylesheet' href='/static/report.css'></head><body class='report'>"
        f"<header><h1>Contact {name}</h1>"
        f"<p>Vessel {html.escape(str(contact['vessel_id']))}, report of {_time_text(now_utc_s)}</p></header>"
        f"<figure><img alt='Sonar image of contact {name}'"
        f" src='data:image/png;base64,{base64.b64encode(png).decode()}'>"
        f"<figcaption>{_scale_text(record, image)}</figcaption></figure>"
        f"<dl>{''.join(f'<dt>{html.escape(label)}</dt><dd>{_value_html(value)}</dd>' for label, value in facts)}</dl>"
        f"{_table('Measurements', detail['measurements'], ('kind', 'value_m', 'sigma_m', 'height_m', 'user'))}"
        f"{_table('Decisions', detail['decisions'], ('operator', 'verdict', 'confidence', 'mlo_class', 'remark'))}"
        f"{_table('Comments', detail['advice'], ('author', 'verdict', 'confidence', 'mlo_class', 'remark'))}"
        f"{_table('Audit', detail['audit'], ('user', 'role', 'action', 'version', 'layer'))}"
        "</body></html>\n"
    )


def _value_html(value: object) -> str:
    if value is None or value == "":
        return '<span class="missing">unknown</span>'
    return html.escape(f"{value:.4g}" if isinstance(value, float) else str(value))


def _time_text(utc_s: object) -> str:
    return "" if not isinstance(utc_s, float) else f"{datetime.fromtimestamp(utc_s, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _scale_text(record: Json, image: ReconstructedImage) -> str:
    along, across = record.get("pixel_along_m"), record.get("pixel_across_m")
    size = f"{image.picture.width_px} x {image.picture.height_px} px"
    if not isinstance(along, float) or not isinstance(across, float):
        return f"{size}, scale unknown; raw, as received"
    metres = f"{image.picture.height_px * along:.1f} m along x {image.picture.width_px * across:.1f} m across the track"
    return f"{size}, {metres}; raw, as received; nadir {record.get('nadir_side') or 'side unknown'}"


def _table(title: str, items: object, columns: tuple[str, ...]) -> str:
    assert isinstance(items, list)
    if not items:
        return f"<h2>{title}</h2><p>none</p>"
    head = "".join(f"<th>{column.replace('_', ' ')}</th>" for column in ("time", *columns))
    rows = ""
    for item in items:
        time_column = next(name for name in ("utc_s", "decided_utc_s", "advised_utc_s") if name in item)
        cells = "".join(f"<td>{_value_html(item.get(column))}</td>" for column in columns)
        rows += f"<tr><td>{_time_text(item[time_column])}</td>{cells}</tr>"
    return f"<h2>{title}</h2><table><tr>{head}</tr>{rows}</table>"
