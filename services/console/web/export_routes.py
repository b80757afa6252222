"""Routes of exports, and of the printable report of a contact."""

from __future__ import annotations

import base64
import errno
import html
import os
import shutil
import sqlite3
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import IO, Final

import numpy as np
import numpy.typing as npt
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from sonarpost import wire
from sonarpost.archive.image_files import side_car
from sonarpost.delivery.store import HANDLING_RESERVE_BYTES
from sonarpost.export.contacts import ContactSet, ExportContact, SideCar
from sonarpost.export.cot import cot_events
from sonarpost.export.kml import ContactImage, add_kmz
from sonarpost.export.tables import csv_bytes, geojson_bytes
from sonarpost.export.text import probabilities_text
from sonarpost.messages import Decision, ReconstructedImage
from sonarpost.review import rendering
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contacts import ContactFilter, find_version, list_versions
from sonarpost.services.console.store.serialisers import Json, decode_image
from sonarpost.services.console.web.access import AccessControl, ApiError, Call

MAX_CONTACTS: Final = 5000
MAX_BYTES: Final = 268_435_456
MAX_EXPORTS: Final = 4
"""Exports at a time, of different users: one runs, the others wait or are downloaded."""
RETRY_S: Final = 10
CHUNK_BYTES: Final = 65536


def _cot_bytes(contacts: ContactSet) -> bytes:
    events = b"\n".join(cot_events(contacts, time.time()))
    return b'<?xml version="1.0" encoding="UTF-8"?>\n<events>\n' + events + b"\n</events>\n"


KMZ: Final = "contacts.kmz"
_FORMATS: Final[Mapping[str, tuple[Callable[[ContactSet], bytes] | None, str]]] = {
    "contacts.geojson": (geojson_bytes, "application/geo+json"),
    "contacts.csv": (csv_bytes, "text/csv; charset=utf-8"),
    KMZ: (None, "application/vnd.google-earth.kmz"),
    "contacts.cot.xml": (_cot_bytes, "application/xml"),
}


class _ExportQueue:
    """Limits exports: one runs at a time, and each user has at most one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users: set[str] = set()
        self.worker = threading.Lock()

    def enter(self, user: str) -> None:
        """Add an export of a user.

        Raises:
            ApiError: 429 if the user has one already; 503 if the queue is full.
        """
        headers = {"Retry-After": str(RETRY_S)}
        with self._lock:
            if user in self._users:
                message = f"an export of {user} is not finished: try again in {RETRY_S} s"
                raise ApiError(429, "too_many", message, headers=headers)
            if len(self._users) >= MAX_EXPORTS:
                message = f"{MAX_EXPORTS} exports are not finished: try again in {RETRY_S} s"
                raise ApiError(503, "busy", message, headers=headers)
            self._users.add(user)

    def leave(self, user: str) -> None:
        """Remove the export of a user."""
        with self._lock:
            self._users.discard(user)


class _TemporaryFileResponse(StreamingResponse):
    """Streams a temporary file and closes it, also if the client disconnects."""

    def __init__(self, file: IO[bytes], on_close: Callable[[], None], headers: Mapping[str, str]) -> None:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        chunks = iter(lambda: file.read(CHUNK_BYTES), b"")
        super().__init__(chunks, headers={**headers, "Content-Length": str(size)})
        self._file = file
        self._on_close = on_close

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()
            self._on_close()


class ExportRoutes:
    """Routes of exports and reports.

    An export is written to a temporary file without a name in the folder of the database: the operating system
    deletes it when the process ends, also after a crash.
    """

    def __init__(self, state: ConsoleState) -> None:
        self._state = state
        self._queue = _ExportQueue()
        self._stopped = False

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/export/{name}", access.endpoint(self._export), methods=["GET"]),
            Route("/report/{id}", access.endpoint(self._report)),
        ]

    def stop(self) -> None:
        """End the running export, so that the process can stop."""
        self._stopped = True

    def _export(self, call: Call) -> Response:
        name = str(call.request.path_params["name"])
        if name not in _FORMATS:
            raise ApiError(404, "not_found", "one of " + ", ".join(_FORMATS))
        query, user = call.parse_query(ContactFilter), call.actor.user
        headers = {"Content-Disposition": f'attachment; filename="{name}"', "Content-Type": _FORMATS[name][1]}
        self._queue.enter(user)
        try:
            with self._queue.worker:
                file = self._write(name, query)
        except BaseException:
            self._queue.leave(user)
            raise
        return _TemporaryFileResponse(file, lambda: self._queue.leave(user), headers)

    def _write(self, name: str, query: ContactFilter) -> IO[bytes]:
        """Write an export to a temporary file, and return the file."""
        file: IO[bytes] = tempfile.TemporaryFile(dir=self._state.database.path.parent)  # noqa: SIM115  closed below
        try:
            contacts = self._contacts(query, file)
            convert = _FORMATS[name][0]
            if convert is None:
                add_kmz(file, contacts, lambda contact: self._image(contact, file))
            else:
                file.write(convert(contacts))
        except BaseException:
            file.close()
            raise
        return file

    def _contacts(self, query: ContactFilter, file: IO[bytes]) -> ContactSet:
        with self._state.database.read() as db:
            versions = list_versions(db, query, MAX_CONTACTS + 1)
        if len(versions) > MAX_CONTACTS:
            raise ApiError(413, "too_large", f"more than {MAX_CONTACTS} contacts: select fewer in the queue")
        found: list[ExportContact] = []
        for contact_id, version in versions:
            self._check(file)
            # Other requests use the database between two contacts.
            with self._state.database.read() as db:
                contact = _export_contact(db, contact_id, version)
            if contact is not None:
                found.append(contact)
        return ContactSet(tuple(found), (), ())

    def _image(self, contact: ExportContact, file: IO[bytes]) -> ContactImage | None:
        self._check(file)
        if not contact.image.codec:
            return None
        image = self._state.image(contact.uid, contact.image.version)
        return ContactImage(rendering.eight_bits(image.picture.to_array()), image.missing())

    def _check(self, file: IO[bytes]) -> None:
        """Check the size of an export and the free space between two contacts."""
        if self._stopped:
            raise ApiError(503, "busy", "the console is stopping")
        if file.tell() > MAX_BYTES:
            raise ApiError(413, "too_large", f"more than {MAX_BYTES >> 20} MiB: select fewer contacts in the queue")
        if shutil.disk_usage(self._state.database.path.parent).free < HANDLING_RESERVE_BYTES:
            raise OSError(errno.ENOSPC, "the disk reserve is reached")

    def _report(self, call: Call) -> Response:
        contact_id = str(call.request.path_params["id"])
        detail = self._state.contact_detail(contact_id)
        contact = detail["contact"]
        assert isinstance(contact, dict)
        image = self._state.image(contact_id, int(contact["version"]))
        headers = {"Content-Disposition": f'inline; filename="{contact["name"].replace("/", "-")}.html"'}
        text = report_html(detail, image, time.time())
        return Response(text, media_type="text/html; charset=utf-8", headers=headers)


def _export_contact(db: sqlite3.Connection, contact_id: str, version: int) -> ExportContact | None:
    """Return a contact; None if the version was deleted in the meantime."""
    row = find_version(db, contact_id, version)
    if row is None:
        return None
    rows = db.execute(
        "SELECT payload FROM decision WHERE contact_id = ? ORDER BY decided_utc_s, seq", (contact_id,)
    ).fetchall()
    decisions = tuple(wire.decode(Decision, bytes(row["payload"]), "decision") for row in rows)
    return ExportContact(SideCar.model_validate(side_car(decode_image(row))), decisions, None)


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


def _despeckling_text(strength: float | None) -> str:
    if strength is None:
        return ""
    return f"despeckled, strength {strength:.2f}" if strength > 0 else "not despeckled"


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
        ("Class of the detector", contact["atd_class"]),
        ("Probabilities of the detector", probabilities_text(contact["p_mine_like"], contact["p_other_object"])),
        ("Confidence of the detector, 0 to 2", contact["atd_confidence"]),
        ("Detected", _time_text(contact["seen_utc_s"])),
        *((f"{label}, m", record.get(key)) for label, key in _LENGTHS),
        ("Codec", image.codec),
        ("Despeckling", _despeckling_text(image.despeckle_strength)),
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
    size = f"{image.picture.width_px} × {image.picture.height_px} px"
    if not isinstance(along, float) or not isinstance(across, float):
        return f"{size}, scale unknown; raw, as received"
    metres = f"{image.picture.height_px * along:.1f} m along × {image.picture.width_px * across:.1f} m across the track"
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
