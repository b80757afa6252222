"""KML 2.2 and KMZ: what Google Earth and most chart programs open.

A contact is a placemark with a balloon (its facts, in a KMZ its picture) and a style by verdict. Where heading, side
and pixel sizes are known, a KMZ also lays the picture on the map.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

from sonarpost.errors import BadInputError
from sonarpost.export.accepted import Accepted, AcceptedContact, ReviewState
from sonarpost.export.chips import Chip, chip_of, icon_png
from sonarpost.export.properties import DEGREE_DECIMALS, Value, properties
from sonarpost.export.text import html_text, utc_text, xml_text
from sonarpost.files import write_atomically

NAMESPACE: Final = "http://www.opengis.net/kml/2.2"
COLOURS: Final[Mapping[ReviewState, str]] = {
    "unreviewed": "#ffd400",
    "mine_like": "#e00000",
    "not_mine_like": "#00a000",
    "unsure": "#ff8c00",
}
FOLDERS: Final[Mapping[ReviewState, str]] = {
    "mine_like": "Mine-like",
    "unsure": "Unsure",
    "unreviewed": "Not reviewed",
    "not_mine_like": "Not mine-like",
}
_BALLOON_WIDTH_PX: Final = 300
_ZIP_TIME: Final = (1980, 1, 1, 0, 0, 0)
"""The earliest that ZIP can say: the same contacts give the same bytes."""


def kml_bytes(accepted: Accepted) -> bytes:
    """Return one KML document without pictures, UTF-8."""
    return _document(accepted, {}, icons=False)


def kmz_bytes(accepted: Accepted) -> tuple[bytes, tuple[BadInputError, ...]]:
    """Return a KMZ: `doc.kml`, the pictures and the icons; nothing in it is fetched from a network.

    Returns:
        The archive, and one error for each picture that could not be read (its contact is there without it).
    """
    chips: dict[str, Chip] = {}
    problems: list[BadInputError] = []
    for contact in accepted.located:
        try:
            if (chip := chip_of(contact)) is not None:
                chips[contact.uid] = chip
        except BadInputError as error:
            problems.append(error)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        _add(archive, "doc.kml", _document(accepted, chips, icons=True))
        for review, colour in COLOURS.items():
            _add(archive, f"icons/{review}.png", icon_png(review, colour))
        for uid, chip in chips.items():
            _add(archive, f"pictures/{uid}.png", chip.png)
            if chip.overlay is not None:
                _add(archive, f"overlays/{uid}.png", chip.overlay.png)
    return buffer.getvalue(), tuple(problems)


def write_kml(path: Path, accepted: Accepted) -> None:
    """Write a KML document to `path`, whole or not at all.

    Raises:
        OSError: It cannot be written.
    """
    write_atomically(path, kml_bytes(accepted))


def write_kmz(path: Path, accepted: Accepted) -> tuple[BadInputError, ...]:
    """Write a KMZ to `path`, whole or not at all; return one error for each picture that could not be read.

    Raises:
        OSError: It cannot be written.
    """
    archive, problems = kmz_bytes(accepted)
    write_atomically(path, archive)
    return problems


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    entry = zipfile.ZipInfo(name, _ZIP_TIME)
    # Pictures are compressed already; the document is text.
    entry.compress_type = zipfile.ZIP_STORED if name.endswith(".png") else zipfile.ZIP_DEFLATED
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, data)


def _document(accepted: Accepted, chips: Mapping[str, Chip], *, icons: bool) -> bytes:
    root = ET.Element("kml", {"xmlns": NAMESPACE})
    document = _child(root, "Document")
    _child(document, "name", "sonarpost contacts")
    missing = len(accepted.unlocated)
    _child(document, "description", f"{len(accepted.located)} contacts; {missing} more without a position")
    for review, colour in COLOURS.items():
        _style(document, review, colour, icons=icons)
    for review, title in FOLDERS.items():
        contacts = [contact for contact in accepted.located if contact.review == review]
        if not contacts:
            continue
        folder = _child(document, "Folder")
        _child(folder, "name", f"{title} ({len(contacts)})")
        for contact in contacts:
            _placemark(folder, contact, chips.get(contact.uid))
    _overlays(document, accepted, chips)
    ET.indent(root, " ")
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _style(document: ET.Element, review: ReviewState, colour: str, *, icons: bool) -> None:
    style = _child(document, "Style", id=review)
    icon_style = _child(style, "IconStyle")
    if icons:
        _child(_child(icon_style, "Icon"), "href", f"icons/{review}.png")
    else:
        # KML colours are aabbggrr; without an icon of our own the reader's pin is tinted.
        _child(icon_style, "color", f"ff{colour[5:7]}{colour[3:5]}{colour[1:3]}")
    # Without this, readers add a link to a web service to every balloon.
    _child(_child(style, "BalloonStyle"), "text", "<h3>$[name]</h3>$[description]")


def _placemark(folder: ET.Element, contact: AcceptedContact, chip: Chip | None) -> None:
    assert contact.position is not None
    lat_deg, lon_deg = contact.position
    values = properties(contact)
    placemark = _child(folder, "Placemark", id=contact.uid)
    _child(placemark, "name", contact.name)
    _child(placemark, "description", _balloon(values, f"pictures/{contact.uid}.png" if chip else None))
    _child(_child(placemark, "TimeStamp"), "when", str(values["seen_utc"] or values["first_frame_utc"]))
    _child(placemark, "styleUrl", f"#{contact.review}")
    extended = _child(placemark, "ExtendedData")
    for name, value in values.items():
        if value is not None:
            _child(_child(extended, "Data", name=name), "value", _shown(value))
    _child(_child(placemark, "Point"), "coordinates", f"{lon_deg:.{DEGREE_DECIMALS}f},{lat_deg:.{DEGREE_DECIMALS}f}")


def _balloon(values: Mapping[str, Value], picture: str | None) -> str:
    """HTML of the balloon; everything a stranger wrote is escaped in it."""
    image = f'<img src="{html_text(picture)}" width="{_BALLOON_WIDTH_PX}"/>' if picture else ""
    rows = "".join(
        f"<tr><td>{html_text(name)}</td><td>{html_text(_shown(value))}</td></tr>"
        for name, value in values.items()
        if value is not None and value != ""
    )
    return f"{image}<table>{rows}</table>"


def _overlays(document: ET.Element, accepted: Accepted, chips: Mapping[str, Chip]) -> None:
    laid = [(c, chips[c.uid].overlay) for c in accepted.located if c.uid in chips]
    if not any(overlay for _, overlay in laid):
        return
    folder = _child(document, "Folder")
    _child(folder, "name", "Pictures on the seabed")
    for contact, overlay in laid:
        if overlay is None:
            continue
        ground = _child(folder, "GroundOverlay")
        _child(ground, "name", contact.name)
        # Off at first: a slant-range picture laid on a chart is good to a few metres, and hides what lies below.
        _child(ground, "visibility", "0")
        _child(_child(ground, "TimeStamp"), "when", utc_text(contact.image.first_frame_utc_s))
        _child(_child(ground, "Icon"), "href", f"overlays/{contact.uid}.png")
        box = _child(ground, "LatLonBox")
        for name in ("north", "south", "east", "west"):
            _child(box, name, repr(round(getattr(overlay, f"{name}_deg"), DEGREE_DECIMALS)))
        _child(box, "rotation", repr(round(overlay.rotation_deg, 2)))


def _shown(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _child(parent: ET.Element, tag: str, text: str | None = None, /, **attributes: str) -> ET.Element:
    element = ET.SubElement(parent, tag, {name: xml_text(value) for name, value in attributes.items()})
    if text is not None:
        element.text = xml_text(text)
    return element
