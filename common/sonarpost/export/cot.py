"""Cursor-on-Target events (version 2.0 of the event schema) of accepted contacts.

A contact that nobody has decided about is a spot on the map (`b-m-p-s-m`) and nothing else: only an operator's decision
makes it a mine or a bottom return. Types are CoT's spelling of the MIL-STD-2525 functions S*U-WM (sea mine) and S*U-NB
(bottom return, non-mine bottom object).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal
from xml.etree import ElementTree as ET

from sonarpost.export.accepted import Accepted, AcceptedContact, ReviewState
from sonarpost.export.properties import DEGREE_DECIMALS
from sonarpost.export.text import utc_text, xml_text

SPOT: Final = "b-m-p-s-m"
SEA_MINE: Final = "U-W-M"
BOTTOM_RETURN: Final = "a-u-U-N-B"
MEASURED_IN_A_PICTURE: Final = "m-i"
"""CoT's "machine, mensurated": the position was measured in imagery."""
UNKNOWN: Final = "9999999.0"
"""What CoT writes for a height or an error of which nothing is known."""

# MIL-STD-2525B, subsurface, sea mine: G on the bottom, M moored, F floating, O in another position.
MINE_POSITIONS: Final[Mapping[str, str]] = {
    "bottom": "G",
    "bottom mine": "G",
    "ground": "G",
    "ground mine": "G",
    "moored": "M",
    "moored mine": "M",
    "floating": "F",
    "floating mine": "F",
    "drifting": "F",
    "drifting mine": "F",
}
# Colours of the spots, as signed 32-bit ARGB: what clients of the format read.
_SPOT_COLOURS: Final[Mapping[ReviewState, int]] = {
    "unreviewed": 0xFFFFD400 - (1 << 32),
    "unsure": 0xFFFF8C00 - (1 << 32),
}
_TITLES: Final[Mapping[ReviewState, str]] = {
    "unreviewed": "Sonar contact, not reviewed",
    "mine_like": "Mine-like",
    "not_mine_like": "Not mine-like",
    "unsure": "Sonar contact, operator unsure",
}


@dataclass(frozen=True, slots=True)
class CotOptions:
    """How events are made.

    Attributes:
        stale_after_s: An event's life; contacts lie still, so it is long.
        mine_affiliation: Of what an operator called mine-like: `u` unknown, `s` suspect, `h` hostile.

    Raises:
        ValueError: `stale_after_s` is not above 0.
    """

    stale_after_s: float = 86400.0
    mine_affiliation: Literal["u", "s", "h"] = "s"

    def __post_init__(self) -> None:
        if not self.stale_after_s > 0:
            raise ValueError(f"stale_after_s: got {self.stale_after_s}, expected above 0")


def cot_type(contact: AcceptedContact, options: CotOptions | None = None) -> str:
    """Return the event's type: b-m-p-s-m, a-s-U-W-M (with -G, -M or -F where the class says so) or a-u-U-N-B."""
    decision = contact.decision
    if decision is None or decision.verdict == "unsure":
        return SPOT
    if decision.verdict == "not_mine_like":
        return BOTTOM_RETURN
    affiliation = (options or CotOptions()).mine_affiliation
    words = " ".join((decision.mlo_class or "").casefold().replace("_", " ").replace("-", " ").split())
    position = MINE_POSITIONS.get(words)
    return f"a-{affiliation}-{SEA_MINE}" + (f"-{position}" if position else "")


def cot_event(contact: AcceptedContact, now_utc_s: float, options: CotOptions | None = None) -> bytes:
    """Return one event as XML, UTF-8, without a declaration, on one line.

    `time` and `start` are the moment of sending: by a vehicle's wrong clock a contact would not be shown, or be stale
    before it came. When it was seen stands in the remarks and in `detail/sonarpost`. `ce` is `position_sigma_m`, as CoT
    defines it (one standard deviation). The height is unknown: depth is against the surface, not the ellipsoid.

    Args:
        contact: One with a position.
        now_utc_s: Time of sending.
        options: Life and affiliation.

    Raises:
        ValueError: The contact has no position.
    """
    options = options or CotOptions()
    if contact.position is None:
        raise ValueError(f"{contact.uid}: got no position, expected one")
    lat_deg, lon_deg = contact.position
    record = contact.image.contact
    sigma_m = record.position_sigma_m if record else None
    event = ET.Element(
        "event",
        {
            "version": "2.0",
            "uid": contact.uid,
            "type": cot_type(contact, options),
            "time": utc_text(now_utc_s),
            "start": utc_text(now_utc_s),
            "stale": utc_text(now_utc_s + options.stale_after_s),
            "how": MEASURED_IN_A_PICTURE,
        },
    )
    point = {
        # Written out: the schema's decimals know no exponent.
        "lat": f"{lat_deg:.{DEGREE_DECIMALS}f}",
        "lon": f"{lon_deg:.{DEGREE_DECIMALS}f}",
        "hae": UNKNOWN,
        "ce": UNKNOWN if sigma_m is None else f"{sigma_m:.1f}",
        "le": UNKNOWN,
    }
    ET.SubElement(event, "point", point)
    _detail(event, contact)
    text: bytes = ET.tostring(event, encoding="utf-8")
    return text


def cot_events(accepted: Accepted, now_utc_s: float, options: CotOptions | None = None) -> tuple[bytes, ...]:
    """Return the events of all contacts with a position; `len(accepted.unlocated)` are left out."""
    return tuple(cot_event(contact, now_utc_s, options) for contact in accepted.located)


def _detail(event: ET.Element, contact: AcceptedContact) -> None:
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
        "sha256": image.picture_sha256,
    }
    if decision is not None:
        facts |= {"decision": decision.decision_id, "decided": utc_text(decision.decided_utc_s)}
    ET.SubElement(detail, "sonarpost", {name: xml_text(value) for name, value in facts.items()})
    remarks = ET.SubElement(detail, "remarks", {"source": "sonarpost", "time": event.get("time", "")})
    remarks.text = xml_text(_remarks(contact))


def _remarks(contact: AcceptedContact) -> str:
    """What a person reads, in sentences; text of the operator last."""
    image, record, decision = contact.image, contact.image.contact, contact.decision
    parts = [f"{_TITLES[contact.review]}."]
    if record is not None:
        if record.time_utc_s is not None:
            parts.append(f"Seen {utc_text(record.time_utc_s)}.")
        if record.depth_m is not None and record.altitude_m is not None:
            parts.append(f"Water depth {record.depth_m + record.altitude_m:.1f} m.")
        if record.atd_confidence is not None:
            parts.append(f"Detector's confidence {record.atd_confidence:.2f} of 2.")
    if image.missing_fraction > 0:
        parts.append(f"{100 * image.missing_fraction:.0f} % of the picture is missing.")
    if decision is not None:
        surely = "" if decision.confidence is None else f", confidence {decision.confidence:.2f}"
        parts.append(f"Decided {utc_text(decision.decided_utc_s)} by {decision.operator}{surely}.")
        if decision.image_version < image.version:
            parts.append(f"The picture has grown since: version {decision.image_version} was looked at.")
        parts += [f"Class: {text}." for text in (decision.mlo_class,) if text]
        parts += [f"Remark: {text}" for text in (decision.remark,) if text]
    return " ".join(parts)
