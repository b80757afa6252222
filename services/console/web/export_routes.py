"""Contacts in other programs' formats, and one of them on a printable page."""

from __future__ import annotations

import base64
import html
import sqlite3
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
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
from sonarpost.services.console.state import Board
from sonarpost.services.console.store.contacts import Filter, list_contacts
from sonarpost.services.console.store.serialisers import Json, image_of
from sonarpost.services.console.web.access import Call, Gate, RefusedError
from sonarpost.services.console.web.contact_routes import filter_of

MOST: Final = 10_000
_PAGE: Final = 500


class ExportRoutes:
    """The routes of exports.

    Args:
        board: The console's state.
    """

    def __init__(self, board: Board) -> None:
        self._board = board
        self._makers: dict[str, tuple[Callable[[ContactSet], bytes], str]] = {
            "contacts.geojson": (geojson_bytes, "application/geo+json"),
            "contacts.csv": (csv_bytes, "text/csv; charset=utf-8"),
            "contacts.kmz": (lambda accepted: kmz_bytes(accepted)[0], "application/vnd.google-earth.kmz"),
            "contacts.cot.xml": (_cot, "application/xml"),
        }

    def routes(self, gate: Gate) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/export/{name}", gate.open(self._export)),
            Route("/report/{id}", gate.open(self._report)),
        ]

    def _export(self, call: Call) -> Response:
        name = str(call.request.path_params["name"])
        if name not in self._makers:
            raise RefusedError(404, "not_found", "one of " + ", ".join(self._makers))
        maker, media = self._makers[name]
        # KMZ reads the pictures as files; they are there for as long as that takes.
        with tempfile.TemporaryDirectory(prefix="sonarpost-export-") as folder:
            accepted = self._accepted(filter_of(call), Path(folder), pictures=name.endswith(".kmz"))
            data = maker(accepted)
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return Response(data, media_type=media, headers=headers)

    def _accepted(self, wanted: Filter, folder: Path, *, pictures: bool) -> ContactSet:
        found: list[ExportContact] = []
        with self._board.database.reading() as db:
            for offset in range(0, MOST, _PAGE):
                page = list_contacts(db, replace(wanted, offset=offset, limit=_PAGE))
                items = page["items"]
                assert isinstance(items, list)
                found += [_contact(db, item, folder if pictures else None) for item in items]
                if len(items) < _PAGE:
                    break
        found.sort(key=lambda contact: (contact.image.first_frame_utc_s, contact.uid))
        return ContactSet(tuple(found), (), ())

    def _report(self, call: Call) -> Response:
        contact_id = str(call.request.path_params["id"])
        whole = self._board.contact(contact_id)
        contact = whole["contact"]
        assert isinstance(contact, dict)
        image = self._board.image(contact_id, int(contact["version"]))
        headers = {"Content-Disposition": f'inline; filename="{contact["name"].replace("/", "-")}.html"'}
        return Response(report(whole, image, time.time()), media_type="text/html; charset=utf-8", headers=headers)


def _cot(accepted: ContactSet) -> bytes:
    # An event is a document of its own: its declaration goes, as it may stand at the beginning only.
    events = [event.partition(b"?>")[2] if event.startswith(b"<?xml") else event for event in _events(accepted)]
    return b'<?xml version="1.0" encoding="UTF-8"?>\n<events>\n' + b"\n".join(events) + b"\n</events>\n"


def _events(accepted: ContactSet) -> tuple[bytes, ...]:
    return cot_events(accepted, time.time())


def _contact(db: sqlite3.Connection, item: Json, folder: Path | None) -> ExportContact:
    row = db.execute(
        "SELECT * FROM version WHERE contact_id = ? AND version = ?", (item["id"], item["version"])
    ).fetchone()
    image = image_of(row)
    rows = db.execute(
        "SELECT payload FROM decision WHERE contact_id = ? ORDER BY decided_utc_s, seq", (item["id"],)
    ).fetchall()
    decided = tuple(wire.decode(Decision, bytes(row["payload"]), "decision") for row in rows)
    path = None
    if folder is not None and image.codec:
        path = folder / f"{item['id']}.png"
        path.write_bytes(rendering.png(rendering.eight_bits(image.picture.to_array())))
    return ExportContact(SideCar.model_validate(side_car(image)), decided, path)


def report(whole: Json, image: ReconstructedImage, now_utc_s: float) -> str:
    """Return a contact on a page that prints on one or two sheets; whatever people wrote is escaped.

    Args:
        whole: As `Board.contact` returns it.
        image: Record of the version that is shown.
        now_utc_s: When the page is made.
    """
    contact, record = whole["contact"], whole["record"] or {}
    assert isinstance(contact, dict)
    assert isinstance(record, dict)
    grey = rendering.eight_bits(image.picture.to_array())
    thumb = base64.b64encode(rendering.png(rendering.shown(grey))).decode()
    mask = image.missing()
    name = html.escape(str(contact["name"]))
    facts = [
        ("Verdict", contact["review"]),
        ("Class", contact["mlo_class"]),
        ("Confidence of the operator", contact["confidence"]),
        ("Decided by", contact["decided_by"]),
        ("Decided", _when(contact["decided_utc_s"])),
        ("Latitude, longitude (WGS 84)", _place(contact)),
        ("Standard deviation of the position, m", contact["position_sigma_m"]),
        ("Confidence of the detector, 0 to 2", contact["atd_confidence"]),
        ("Seen", _when(contact["seen_utc_s"])),
        *((f"{label}, m", record.get(key)) for label, key in _LENGTHS),
        ("Codec", image.codec),
        ("Version of the picture", image.version),
        ("Received", f"{image.bytes_received} of {image.bytes_total} bytes, {contact['percent_received']} %"),
        ("Area that was not received", f"{100 * float(mask.mean()):.1f} % (black in the picture)"),
        ("SHA-256 of the pixels", image.picture_sha256),
    ]
    return (
        "<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'>"
        f"<title>{name}</title><link rel='icon' href='/static/icon.svg'>"
        "<link rel='stylesheet' href='/static/report.css'></head><body class='report'>"
        f"<header><h1>Contact {name}</h1>"
        f"<p>Vessel {html.escape(str(contact['vessel_id']))}, report of {_when(now_utc_s)}</p></header>"
        f"<figure><img alt='Sonar picture of contact {name}' src='data:image/png;base64,{thumb}'>"
        f"<figcaption>{_scale(record, image)}</figcaption></figure>"
        f"<dl>{''.join(_fact(label, value) for label, value in facts)}</dl>"
        f"{_list('Measurements', whole['measurements'], ('kind', 'value_m', 'sigma_m', 'height_m', 'user'))}"
        f"{_list('Decisions', whole['decisions'], ('operator', 'verdict', 'confidence', 'mlo_class', 'remark'))}"
        f"{_list('Advice', whole['advice'], ('author', 'verdict', 'confidence', 'mlo_class', 'remark'))}"
        f"{_list('Audit', whole['audit'], ('user', 'role', 'action', 'version', 'layer'))}"
        "</body></html>\n"
    )


_LENGTHS: Final = (
    ("Ground range", "ground_range_m"),
    ("Altitude of the vehicle", "altitude_m"),
    ("Depth of the vehicle", "depth_m"),
    ("Length by the detector", "length_m"),
    ("Width by the detector", "width_m"),
    ("Shadow by the detector", "shadow_m"),
    ("Height by the detector", "height_m"),
)


def _fact(label: str, value: object) -> str:
    return f"<dt>{html.escape(label)}</dt><dd>{_shown(value)}</dd>"


def _shown(value: object) -> str:
    if value is None or value == "":
        return '<span class="missing">not known</span>'
    return html.escape(f"{value:.4g}" if isinstance(value, float) else str(value))


def _when(utc_s: object) -> str:
    return "" if not isinstance(utc_s, float) else f"{datetime.fromtimestamp(utc_s, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _place(contact: Json) -> str:
    lat, lon = contact["lat_deg"], contact["lon_deg"]
    return "" if lat is None or lon is None else f"{lat:.7f}, {lon:.7f}"


def _scale(record: Json, image: ReconstructedImage) -> str:
    along, across = record.get("pixel_along_m"), record.get("pixel_across_m")
    size = f"{image.picture.height_px} x {image.picture.width_px} px"
    if not isinstance(along, float) or not isinstance(across, float):
        return f"{size}, scale not known; raw, as received"
    metres = f"{image.picture.height_px * along:.1f} m along x {image.picture.width_px * across:.1f} m across the track"
    return f"{size}, {metres}; raw, as received; nadir {record.get('nadir_side') or 'side not known'}"


def _list(title: str, items: object, columns: tuple[str, ...]) -> str:
    assert isinstance(items, list)
    if not items:
        return f"<h2>{title}</h2><p>none</p>"
    head = "".join(f"<th>{column.replace('_', ' ')}</th>" for column in ("time", *columns))
    rows = ""
    for item in items:
        times = ("utc_s", "decided_utc_s", "advised_utc_s")
        at = next((item[name] for name in times if name in item), None)
        cells = "".join(f"<td>{_shown(item.get(column))}</td>" for column in columns)
        rows += f"<tr><td>{_when(at)}</td>{cells}</tr>"
    return f"<h2>{title}</h2><table><tr>{head}</tr>{rows}</table>"
