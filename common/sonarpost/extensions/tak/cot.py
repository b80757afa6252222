"""Cursor-on-Target events of contacts, version 2.0 of the event schema.

A contact without a decision is a spot on the map (`b-m-p-s-m`). Only an operator's decision makes it a mine or a bottom
return. A disputed contact counts as mine-like. The types correspond to the MIL-STD-2525 functions S*U-WM (sea mine) and
S*U-NB (bottom return, non-mine bottom object).
"""

import time
from collections.abc import Iterable, Mapping
from typing import IO, Final
from xml.etree import ElementTree as ET

from sonarpost.export.contacts import ExportContact
from sonarpost.export.formats import Format
from sonarpost.export.source import ExportSource
from sonarpost.export.tables import DEGREE_DECIMALS, further_values
from sonarpost.export.text import VERDICT_WORDS, class_text, probabilities_text, utc_text, xml_text
from sonarpost.review.decisions import ReviewState

SPOT: Final = "b-m-p-s-m"
SEA_MINE: Final = "a-s-U-W-M"
BOTTOM_RETURN: Final = "a-u-U-N-B"
MEASURED_IN_IMAGE: Final = "m-i"
"""CoT "machine, mensurated": the position was measured in imagery."""
UNAUTHENTICATED: Final = "Unauthenticated: any modem in range can have forged this contact."
"""Remark about a contact whose acoustic frames were received without a key."""
UNKNOWN: Final = "9999999.0"
"""CoT value of an unknown height or error."""
STALE_AFTER_S: Final = 86400.0
"""Lifetime of an event; it is long because contacts do not move."""

# MIL-STD-2525B, subsurface, sea mine: G on the bottom, M moored, F floating. The class may end in " mine".
MINE_POSITIONS: Final[Mapping[str, str]] = {
    "bottom": "G",
    "ground": "G",
    "moored": "M",
    "floating": "F",
    "drifting": "F",
}
# Colours of the spots as signed 32-bit ARGB.
_SPOT_COLOURS: Final[Mapping[ReviewState, int]] = {
    "unreviewed": 0xFFFFD400 - (1 << 32),
    "unsure": 0xFFFF8C00 - (1 << 32),
}
_TITLES: Final[Mapping[ReviewState, str]] = {
    "unreviewed": "Sonar contact, not reviewed",
    "mine_like": "Mine-like",
    "not_mine_like": "Not mine-like",
    "unsure": "Sonar contact, operator unsure",
    "disputed": "Disputed, counts as mine-like",
}


def cot_type(contact: ExportContact) -> str:
    """Return the event type: b-m-p-s-m, a-s-U-W-M (with -G, -M or -F for known mine classes) or a-u-U-N-B."""
    decision = contact.decision
    if decision is None or decision.verdict == "unsure":
        return SPOT
    if decision.verdict == "not_mine_like":
        return BOTTOM_RETURN
    mlo_class = " ".join((decision.mlo_class or "").casefold().replace("_", " ").replace("-", " ").split())
    position = MINE_POSITIONS.get(mlo_class.removesuffix(" mine"))
    return SEA_MINE + (f"-{position}" if position else "")


def event_element(
    contact: ExportContact, uid: str, kind: str, how: str, now_utc_s: float, stale_after_s: float, ce: str = UNKNOWN
) -> ET.Element:
    """Return an event at the position of a contact, which has one, without details.

    Args:
        contact: The contact.
        uid: Identifier of the event.
        kind: Its type.
        how: How its position was found.
        now_utc_s: Time of sending.
        stale_after_s: Its lifetime in seconds.
        ce: Error of the position in metres.
    """
    assert contact.position is not None
    lat_deg, lon_deg = contact.position
    event = ET.Element(
        "event",
        {
            "version": "2.0",
            "uid": uid,
            "type": kind,
            "time": utc_text(now_utc_s),
            "start": utc_text(now_utc_s),
            "stale": utc_text(now_utc_s + stale_after_s),
            "how": how,
        },
    )
    # The decimal type of the schema has no exponent.
    lat, lon = f"{lat_deg:.{DEGREE_DECIMALS}f}", f"{lon_deg:.{DEGREE_DECIMALS}f}"
    ET.SubElement(event, "point", {"lat": lat, "lon": lon, "hae": UNKNOWN, "ce": ce, "le": UNKNOWN})
    return event


def cot_event(contact: ExportContact, now_utc_s: float, attachment_sha256: str | None = None) -> bytes:
    """Return one event as a single line of XML, UTF-8, without XML declaration.

    `time` and `start` are the time of sending, because the clock of the vehicle may be wrong. The time of detection is
    in the remarks. `ce` is `position_sigma_m` times 1: the base schema defines an error as the one-sigma point of a
    zero-mean normal distribution, and the circle with the worse axis as radius contains the error ellipse. The height
    above the ellipsoid is unknown, because depth is measured from the surface.

    Args:
        contact: The contact; it has a position.
        now_utc_s: Time of sending.
        attachment_sha256: Digest of an attached file, hexadecimal, for `attachment_list`; None without one.
    """
    record = contact.image.contact
    sigma_m = record.position_sigma_m if record else None
    ce = UNKNOWN if sigma_m is None else f"{sigma_m:.1f}"
    event = event_element(contact, contact.uid, cot_type(contact), MEASURED_IN_IMAGE, now_utc_s, STALE_AFTER_S, ce)
    detail = _add_detail(event, contact)
    if attachment_sha256 is not None:
        ET.SubElement(detail, "attachment_list", {"hashes": f'["{attachment_sha256}"]'})
    xml: bytes = ET.tostring(event, encoding="utf-8")
    return xml


def cot_events(contacts: Iterable[ExportContact], now_utc_s: float) -> tuple[bytes, ...]:
    """Return the events of all contacts with a position. Contacts without a position are omitted."""
    return tuple(cot_event(contact, now_utc_s) for contact in contacts if contact.position is not None)


def write_cot(file: IO[bytes], source: ExportSource) -> None:
    """Write the events of all contacts with a position within one `events` element, one event a line."""
    file.write(b'<?xml version="1.0" encoding="UTF-8"?>\n<events>\n')
    file.writelines(event + b"\n" for event in cot_events(source.contacts, time.time()))
    file.write(b"</events>\n")


def _add_detail(event: ET.Element, contact: ExportContact) -> ET.Element:
    image, decision = contact.image, contact.decision
    detail = ET.SubElement(event, "detail")
    ET.SubElement(detail, "contact", {"callsign": contact.name})
    colour = _SPOT_COLOURS.get(contact.review)
    if colour is not None:
        ET.SubElement(detail, "color", {"argb": str(colour)})
    ET.SubElement(detail, "precisionlocation", {"geopointsrc": "CALC", "altsrc": "???"})
    facts = {
        "vessel": image.vessel_id,
        "vehicle": image.vehicle_id,
        "image": image.image_id,
        "version": str(image.version),
        "review": contact.review,
        "sha256": image.pixels_sha256,
    }
    if decision is not None:
        facts |= {"decision": decision.decision_id, "decided": utc_text(decision.decided_utc_s)}
    if image.authenticated is not None:
        facts["authenticated"] = "true" if image.authenticated else "false"
    ET.SubElement(detail, "sonarpost", {name: xml_text(value) for name, value in facts.items()})
    remarks = ET.SubElement(detail, "remarks", {"source": "sonarpost", "time": event.get("time", "")})
    remarks.text = xml_text(_remarks(contact))
    return detail


def _remarks(contact: ExportContact) -> str:
    """Return the remarks for the operator of the receiving program, with the free text last."""
    image, record = contact.image, contact.image.contact
    parts = [f"{_TITLES[contact.review]}."]
    if image.authenticated is False:
        parts.append(UNAUTHENTICATED)
    if record is not None:
        if record.time_utc_s is not None:
            parts.append(f"Seen {utc_text(record.time_utc_s)}.")
        if record.depth_m is not None and record.altitude_m is not None:
            parts.append(f"Water depth {record.depth_m + record.altitude_m:.1f} m.")
        if record.atd_class:
            parts.append(f"Detector's class {class_text(record.atd_class)}.")
        if probabilities := probabilities_text(record.p_mine_like, record.p_other_object):
            parts.append(f"Detector: {probabilities}.")
        if record.atd_confidence is not None:
            parts.append(f"Detector's confidence {record.atd_confidence:.2f} of 2.")
        parts += [f"{name.capitalize()} {value}." for name, value in further_values(record).items()]
    if image.missing_fraction > 0:
        parts.append(f"{100 * image.missing_fraction:.0f} % of the image is missing.")
    if contact.size.text:
        parts.append(f"Measured: {contact.size.text}.")
    return " ".join([*parts, *_decision_remarks(contact)])


def _decision_remarks(contact: ExportContact) -> list[str]:
    parts: list[str] = []
    decision = contact.decision
    if contact.withdrawn_by is not None:
        parts.append(f"Decision withdrawn by {contact.withdrawn_by}.")
    if contact.review == "disputed":
        verdicts = (f"{d.operator} {VERDICT_WORDS[d.verdict]}" for d in contact.result.standing)
        parts.append(f"Verdicts: {', '.join(verdicts)}.")
    if decision is not None:
        confidence = "" if decision.confidence is None else f", confidence {decision.confidence:.2f}"
        parts.append(f"Decided {utc_text(decision.decided_utc_s)} by {decision.operator}{confidence}.")
        if decision.image_version < contact.image.version:
            parts.append(f"The image has grown since: version {decision.image_version} was looked at.")
        parts += [f"Class: {text}." for text in (decision.mlo_class,) if text]
        parts += [f"Remark: {text}" for text in (decision.remark,) if text]
    return parts


COT_XML: Final = Format(write_cot, "application/xml", "Cursor-on-Target (TAK)")
