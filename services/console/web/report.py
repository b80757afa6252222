"""Printable report of contacts: its routes, and HTML for A4 paper, one sheet for each contact, in English."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import IO, Final

import numpy as np
from starlette.responses import Response
from starlette.routing import Route

from sonarpost.export.contacts import ExportContact
from sonarpost.export.tables import further_values
from sonarpost.export.text import VERDICT_WORDS, class_text, probabilities_text
from sonarpost.limits import limit
from sonarpost.messages import Contact, ReconstructedImage
from sonarpost.review import rendering
from sonarpost.review.image_geometry import contact_mark
from sonarpost.review.true_scale import (
    auto_gain,
    draw_lines,
    north_in_image,
    pixel_size_m,
    scale_strip,
    true_image,
)
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contact_detail import StoredContact, find_stored_contact
from sonarpost.services.console.store.contacts import ContactFilter
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.web.access import AccessControl, ApiError, Call
from sonarpost.services.console.web.export_routes import SURFACE, DocumentContacts, ExportRoutes

IMAGE_PX: Final = 900
MAX_AUDIT_ROWS: Final = 12
"""Latest entries of the audit on a sheet; the console has all of them."""

Fact = tuple[str, object]

_SIZES: Final = (("L", "length_m"), ("W", "width_m"), ("shadow", "shadow_m"), ("H", "height_m"))
_AUTHENTICATION: Final[Mapping[bool | None, str]] = {
    True: "authenticated",
    False: "UNAUTHENTICATED: any modem in range can have forged this contact",
    None: "",
}


@dataclass(frozen=True, slots=True)
class ReportContact:
    """A contact to report.

    Attributes:
        detail: Result of `ConsoleState.contact_detail`.
        stored: The contact with its decisions, measured lines and the image version to show.
    """

    detail: Json
    stored: StoredContact


def report_parts(contacts: Iterable[ReportContact], now_utc_s: float, title: str, *, training: bool) -> Iterator[str]:
    """Yield the parts of a document with one sheet for each contact. Text of operators is escaped.

    Args:
        contacts: The contacts.
        now_utc_s: Time of the report.
        title: Title of the document.
        training: Whether the contacts are simulated.
    """
    yield (
        "<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'>"
        f"<title>{html.escape(title)}</title><link rel='icon' href='/static/icon.svg'>"
        "<link rel='stylesheet' href='/static/report.css'></head><body class='report'><main>"
    )
    for each in contacts:
        yield _sheet(each, now_utc_s, training=training)
    yield "</main></body></html>\n"


def degrees_minutes(value_deg: float, letters: str) -> str:
    """Return an angle as on a chart; `letters` are those of positive and negative values.

    -5.5125 gives 5° 30.7500' W, with a prime.
    """
    units = round(abs(value_deg) * 600_000)  # 1/10000 of a minute
    return f"{units // 600_000}° {units % 600_000 / 10_000:07.4f}\N{PRIME} {letters[value_deg < 0]}"


def _sheet(given: ReportContact, now_utc_s: float, *, training: bool) -> str:
    contact, detail = given.stored.contact, given.detail
    name = html.escape(contact.name)
    mark = "<p class='training'>TRAINING: simulated contact</p>" if training else ""
    return (
        f"<article class='sheet'><header><h1>Contact {name}</h1>"
        f"<p class='stamp {contact.review}'>{VERDICT_WORDS[contact.review]}</p>"
        f"<p>Vessel {html.escape(contact.image.vessel_id)}, report of {_time_text(now_utc_s)}</p></header>{mark}"
        f"<div class='columns'>{_figure(given)}<dl>{_facts_html(_facts(given))}</dl></div>"
        f"{_table('Measurements', detail['measurements'], _MEASUREMENT_COLUMNS)}"
        f"{_table('Decisions', detail['decisions'], _DECISION_COLUMNS)}"
        f"{_table('Comments', detail['comments'], _COMMENT_COLUMNS)}"
        f"{_table('Audit, latest entries', detail['audit'][: -MAX_AUDIT_ROWS - 1 : -1], _AUDIT_COLUMNS)}"
        f"<footer><p>{html.escape(_integrity_text(given))}</p></footer></article>"
    )


def _figure(given: ReportContact) -> str:
    """Return the image in true metres with its caption."""
    image, record = given.stored.image, given.stored.image.contact
    grey, missing = rendering.eight_bits(image.pixels.to_array()), image.missing()
    scaled = true_image(grey, missing, *pixel_size_m(record), IMAGE_PX)
    strip = scale_strip(scaled.pixels.shape[1], IMAGE_PX, scaled.px_per_m, north_in_image(record))
    mark = contact_mark(record, *grey.shape)
    place = None if mark is None else (mark.row, mark.column)
    png = rendering.encode_png(np.vstack([draw_lines(scaled, given.stored.lines, place), strip]))
    low, high = auto_gain(grey, missing)
    caption = [_scale_text(image), f"automatic gain {low:.0f} to {high:.0f} % (98 % of the received pixels)"]
    if record is not None and record.channel is not None:
        caption.append("nadir left, heading down" + ("; mirror image" if record.channel == "starboard" else ""))
    return (
        f"<figure><img alt='Sonar image of contact {html.escape(given.stored.contact.name)}'"
        f" src='data:image/png;base64,{base64.b64encode(png).decode()}'>"
        f"<figcaption>{html.escape('; '.join(caption))}</figcaption></figure>"
    )


def _facts(given: ReportContact) -> list[Fact]:
    """Return the facts; those that are None are left out, those that are empty are unknown."""
    return [
        *_decision_facts(given.stored.contact),
        *_position_facts(given.stored.contact),
        *_detector_facts(given.stored.contact),
        *_image_facts(given),
    ]


def _decision_facts(contact: ExportContact) -> list[Fact]:
    decision, verdict = contact.decision, VERDICT_WORDS[contact.review]
    if contact.withdrawn_by is not None:
        verdict += f" (decision withdrawn by {contact.withdrawn_by})"
    if contact.review == "disputed":
        verdict += ": " + ", ".join(f"{d.operator} {VERDICT_WORDS[d.verdict]}" for d in contact.result.standing)
    facts: list[Fact] = [("Verdict", verdict)]
    if decision is not None:
        confidence = None if decision.confidence is None else f"{100 * decision.confidence:.0f} %"
        facts += [
            ("Class", decision.mlo_class),
            ("Confidence of the operator", confidence),
            ("Decided by", decision.operator),
            ("Decided", _time_text(decision.decided_utc_s)),
        ]
    return [*facts, ("Measured", contact.size.text or None)]


def _position_facts(contact: ExportContact) -> list[Fact]:
    record = contact.image.contact or Contact(contact_id="-", vehicle_id=contact.image.vehicle_id)
    minutes = decimal = ""
    if contact.position is not None:
        lat, lon = contact.position
        minutes = f"{degrees_minutes(lat, 'NS')}, {degrees_minutes(lon, 'EW')}"
        decimal = f"{lat:.7f}, {lon:.7f}"
    ranges = [
        f"{name} {value_m:.1f} m"
        for name, value_m in (("slant", record.slant_range_m), ("ground", record.ground_range_m))
        if value_m is not None
    ]
    heading = "" if record.heading_deg is None else f"{record.heading_deg:05.1f}°"
    return [
        ("Position (WGS 84)", minutes),
        ("Latitude, longitude in degrees", decimal or None),
        ("Standard deviation of the position", _metres(record.position_sigma_m)),
        ("Detected", _time_text(record.time_utc_s)),
        ("Heading, side", ", ".join(part for part in (heading, record.channel or "") if part)),
        ("Range", ", ".join(ranges)),
        ("Altitude of the vehicle", _metres(record.altitude_m)),
        ("Depth of the vehicle", _metres(record.depth_m)),
    ]


def _detector_facts(contact: ExportContact) -> list[Fact]:
    record = contact.image.contact
    if record is None:
        return []
    sizes = [(letter, getattr(record, name)) for letter, name in _SIZES]
    confidence = None if record.atd_confidence is None else f"{record.atd_confidence:.2f} of 2"
    return [
        (
            "Size (detector)",
            ", ".join(f"{letter} {value:.2f} m" for letter, value in sizes if value is not None) or None,
        ),
        ("Class of the detector", class_text(record.atd_class or "")),
        ("Probabilities of the detector", probabilities_text(record.p_mine_like, record.p_other_object)),
        ("Confidence of the detector", confidence),
        *((name.capitalize(), value) for name, value in further_values(record).items()),
    ]


def _image_facts(given: ReportContact) -> list[Fact]:
    image = given.stored.image
    total = f" of {image.bytes_total}" if image.bytes_total else ""
    missing = 100 * float(image.missing().mean())
    return [
        ("Image", f"version {image.version}, codec {image.codec or 'none'}, {image.bytes_received}{total} bytes"),
        ("Despeckling", _despeckling_text(image.despeckle_strength)),
        ("Area not received", f"{missing:.1f} % (hatched in the image)" if missing else None),
        ("Acoustic frames", _AUTHENTICATION[image.authenticated] or None),
    ]


def _integrity_text(given: ReportContact) -> str:
    """Return which part of the original image was received, and how fine its detail is."""
    image = given.stored.image
    version: Json = next((v for v in given.detail["versions"] if v["version"] == image.version), {})
    if not image.codec:
        return "No image was received, only the contact record."
    complete = "complete" if image.complete else "incomplete: more was announced than received"
    sharp_to_m = version.get("sharp_to_m")
    detail = "" if sharp_to_m is None else f" Detail below about {sharp_to_m:.2g} m is not in it."
    return (
        f"Decoded from {image.bytes_received} bytes, {complete}. The compression is lossy.{detail} Apart from the gain"
        f" and the resampling to square pixels nothing was changed. SHA-256 of the pixels: {image.pixels_sha256}"
    )


def _despeckling_text(strength: float | None) -> str:
    if strength is None:
        return ""
    return f"despeckled, strength {strength:.2f}" if strength > 0 else "not despeckled"


def _scale_text(image: ReconstructedImage) -> str:
    along_m, across_m = pixel_size_m(image.contact)
    size = f"{image.pixels.width_px} × {image.pixels.height_px} px as received"
    if along_m is None or across_m is None:
        return f"scale unknown; {size}"
    length_m, width_m = image.pixels.height_px * along_m, image.pixels.width_px * across_m
    return f"{length_m:.1f} m along × {width_m:.1f} m across the track, true to scale; {size}"


def _facts_html(facts: Iterable[Fact]) -> str:
    return "".join(
        f"<dt>{html.escape(label)}</dt><dd>{_value_html(value)}</dd>" for label, value in facts if value is not None
    )


def _metres(value_m: float | None) -> str:
    return "" if value_m is None else f"{value_m:.1f} m"


def _time_text(utc_s: object) -> str:
    return "" if not isinstance(utc_s, float) else f"{datetime.fromtimestamp(utc_s, UTC):%Y-%m-%d %H:%M:%S} UTC"


# Tables: title of a column and field of the records.
_MEASUREMENT_COLUMNS: Final = {
    "time": "utc_s",
    "quantity": "kind",
    "value, m": "value_m",
    "±, m": "sigma_m",
    "height, m": "height_m",
    "± height, m": "height_sigma_m",
    "user": "user",
}
_DECISION_COLUMNS: Final = {
    "time": "decided_utc_s",
    "operator": "operator",
    "verdict": "verdict",
    "confidence": "confidence",
    "class": "mlo_class",
    "remark": "remark",
}
_COMMENT_COLUMNS: Final = {**_DECISION_COLUMNS, "time": "commented_utc_s", "operator": "author"}
_AUDIT_COLUMNS: Final = {
    "time": "utc_s",
    "user": "user",
    "role": "role",
    "action": "action",
    "version": "version",
    "layer": "layer",
}


def _table(title: str, items: Sequence[Json], columns: Mapping[str, str]) -> str:
    """Return a table with one row for each item; empty without items."""
    if not items:
        return ""
    head = "".join(f"<th>{column}</th>" for column in columns)
    rows = "".join(f"<tr>{''.join(_cell(item, name) for name in columns.values())}</tr>" for item in items)
    return f"<h2>{title}</h2><table><tr>{head}</tr>{rows}</table>"


def _cell(item: Json, name: str) -> str:
    value = item.get(name)
    if name.endswith("utc_s"):
        return f"<td>{_time_text(value)}</td>"
    if name == "verdict":
        # Records have no verdict for a withdrawal: theirs repeats the decision before.
        value = "withdrawn" if item.get("undoes") else VERDICT_WORDS.get(value) if value else ""
        value = f"{value} (taken back)" if item.get("undone") else value
    text = "" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)
    mark = " class='withdrawn'" if item.get("withdrawn_utc_s") or item.get("undone") else ""
    return f"<td{mark}>{html.escape(text)}</td>"


def _value_html(value: object) -> str:
    return html.escape(str(value)) if value else '<span class="missing">unknown</span>'


MAX_SHEETS: Final = limit(200, "contacts", "claims", SURFACE, "user", "sheets of 0.3 MB in a document", "413")


class ReportRoutes:
    """Reports of one contact and of all contacts of a filter; `training` marks them as simulated."""

    def __init__(self, state: ConsoleState, exports: ExportRoutes, *, training: bool) -> None:
        self._state = state
        self._exports = exports
        self._training = training

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/report", access.endpoint(self._sheets)),
            Route("/report/{id}", access.endpoint(self._report)),
        ]

    def _report(self, call: Call) -> Response:
        contact_id = str(call.request.path_params["id"])
        detail = self._state.contact_detail(contact_id)
        with self._state.database.read() as db:
            stored = find_stored_contact(db, contact_id, detail["contact"]["version"])
        name = stored.contact.name
        text = "".join(self._parts([ReportContact(detail, stored)], f"Contact {name}"))
        return Response(text, headers=_headers(name.replace("/", "-")))

    def _sheets(self, call: Call) -> Response:
        def write(file: IO[bytes], contacts: DocumentContacts) -> None:
            if len(contacts) > MAX_SHEETS:
                raise ApiError(413, "too_large", f"more than {MAX_SHEETS} contacts: select fewer in the queue")
            sheets = (ReportContact(self._state.contact_detail(one.uid), contacts.stored(one)) for one in contacts)
            for part in self._parts(sheets, "Contacts"):
                file.write(part.encode())

        query = call.parse_query(ContactFilter)
        return self._exports.document(call, "contacts.html", _headers("contacts"), query, write)

    def _parts(self, contacts: Iterable[ReportContact], title: str) -> Iterator[str]:
        return report_parts(contacts, self._state.clock(), title, training=self._training)


def _headers(name: str) -> dict[str, str]:
    return {
        "Content-Disposition": f'inline; filename="{name}.html"',
        "Content-Type": "text/html; charset=utf-8",
    }
