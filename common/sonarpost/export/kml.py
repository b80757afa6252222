"""KML 2.2 and KMZ for Google Earth and chart programs.

Each contact is a placemark with a style by verdict and a balloon with its properties. A KMZ adds the image to the
balloon, in true metres with a scale bar, and lays it on the map if heading, side and both pixel sizes are known.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from sonarpost.errors import BadInputError
from sonarpost.export.contacts import ContactSet, ExportContact
from sonarpost.export.tables import DEGREE_DECIMALS, Value, contact_properties
from sonarpost.export.text import VERDICT_WORDS, html_text, utc_text, xml_text
from sonarpost.files import write_atomically
from sonarpost.review.decisions import ReviewState
from sonarpost.review.image_geometry import contact_mark
from sonarpost.review.true_scale import (
    PictureLine,
    draw_lines,
    north_in_image,
    pixel_size_m,
    scale_strip,
    stretched,
    true_image,
)
from sonarpost.sonar.geometry import Position, offset_position
from sonarpost.sonar.image_files import encode_png, read_image

NAMESPACE: Final = "http://www.opengis.net/kml/2.2"
COLOURS: Final[Mapping[ReviewState, str]] = {
    "unreviewed": "#ffd400",
    "mine_like": "#e00000",
    "not_mine_like": "#00a000",
    "unsure": "#ff8c00",
    "disputed": "#c000c0",
}
FOLDERS: Final[Mapping[ReviewState, str]] = {
    "disputed": "Disputed",
    "mine_like": "Mine-like",
    "unsure": "Unsure",
    "unreviewed": "Not reviewed",
    "not_mine_like": "Not mine-like",
}
UNAUTHENTICATED: Final = " (unauthenticated)"
"""End of the name of a contact whose acoustic frames were received without a key."""
MAX_OVERLAY_M: Final = 1000.0
ICON_PX: Final = 32
_MAX_OVERLAY_LATITUDE_DEG: Final = 85.0
_BALLOON_PX: Final = 240
"""Longer side of the image in a balloon."""
_BALLOON_QUALITY: Final = 75
_ZIP_TIME: Final = (1980, 1, 1, 0, 0, 0)
"""Earliest time of the ZIP format. A constant time makes equal contacts give equal bytes."""


Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class ContactImage:
    """Image of a contact to export.

    Attributes:
        pixels: Shape (rows, columns).
        missing: Same shape, true for pixels that were not received; None if unknown.
        lines: Measured lines to draw.
    """

    pixels: Pixels
    missing: npt.NDArray[np.bool_] | None = None
    lines: tuple[PictureLine, ...] = ()


@dataclass(frozen=True, slots=True)
class _Overlay:
    """Place of an image on the map, top along the heading: a KML LatLonBox and its counter-clockwise rotation."""

    box_deg: Mapping[str, float]
    rotation_deg: float


def kml_bytes(contacts: ContactSet) -> bytes:
    """Return a KML document without images, UTF-8."""
    return _document(contacts, {}, icons=False)


def read_stored_image(contact: ExportContact) -> ContactImage | None:
    """Return the image in a contact's image file; None without a file.

    Raises:
        BadInputError: The file cannot be read.
    """
    return None if contact.image_path is None else ContactImage(read_image(contact.image_path))


def add_kmz(
    file: IO[bytes],
    contacts: ContactSet,
    read_contact_image: Callable[[ExportContact], ContactImage | None] = read_stored_image,
) -> tuple[BadInputError, ...]:
    """Write a KMZ archive with `doc.kml`, images and icons. It references no network resource.

    One image at a time is in memory, and `doc.kml` is the last file of the archive.

    Args:
        file: Binary file, open for writing, at its start.
        contacts: The contacts.
        read_contact_image: Returns the image of a contact with a position; None if it has no image.

    Returns:
        One error for each image for which `read_contact_image` raised BadInputError. Its contact has no image.

    Raises:
        OSError: The file cannot be written.
    """
    images: dict[str, _Overlay | None] = {}
    problems: list[BadInputError] = []
    with zipfile.ZipFile(file, "w") as archive:
        for contact in contacts.located:
            try:
                found = read_contact_image(contact)
            except BadInputError as error:
                problems.append(error)
                continue
            if found is None:
                continue
            pixels = _eight_bits(found.pixels)
            missing = np.zeros(pixels.shape, np.bool_) if found.missing is None else found.missing
            _add_file(archive, f"pictures/{contact.uid}.jpg", _balloon_jpeg(contact, pixels, missing, found.lines))
            images[contact.uid] = overlay = _overlay(contact, pixels)
            if overlay is not None:
                # A ground overlay has the shape of its box: pixels need not be square.
                overlay_pixels = _heading_up(contact, stretched(pixels, missing))
                _add_file(archive, f"overlays/{contact.uid}.png", _overlay_png(overlay_pixels))
        for review, colour in _styles(contacts).items():
            _add_file(archive, f"icons/{review}.png", _icon_png(review, colour))
        _add_file(archive, "doc.kml", _document(contacts, images, icons=True))
    return tuple(problems)


def kmz_bytes(contacts: ContactSet) -> tuple[bytes, tuple[BadInputError, ...]]:
    """Return a KMZ archive and the errors of its images; see `add_kmz`."""
    buffer = io.BytesIO()
    problems = add_kmz(buffer, contacts)
    return buffer.getvalue(), problems


def write_kml(path: Path, contacts: ContactSet) -> None:
    """Write a KML document atomically.

    Raises:
        OSError: The file cannot be written.
    """
    write_atomically(path, kml_bytes(contacts))


def write_kmz(path: Path, contacts: ContactSet) -> tuple[BadInputError, ...]:
    """Write a KMZ archive atomically; return one error for each unreadable image.

    Raises:
        OSError: The file cannot be written.
    """
    archive, problems = kmz_bytes(contacts)
    write_atomically(path, archive)
    return problems


def _add_file(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    entry = zipfile.ZipInfo(name, _ZIP_TIME)
    # Images are already compressed.
    entry.compress_type = zipfile.ZIP_DEFLATED if name.endswith(".kml") else zipfile.ZIP_STORED
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, data)


# Document


def _document(contacts: ContactSet, images: Mapping[str, _Overlay | None], *, icons: bool) -> bytes:
    root = ET.Element("kml", {"xmlns": NAMESPACE})
    document = _child(root, "Document")
    _child(document, "name", "sonarpost contacts")
    unlocated = len(contacts.unlocated)
    _child(document, "description", f"{len(contacts.located)} contacts; {unlocated} more without a position")
    for review, colour in _styles(contacts).items():
        _add_style(document, review, colour, icons=icons)
    for review, title in FOLDERS.items():
        reviewed = [contact for contact in contacts.located if contact.review == review]
        if not reviewed:
            continue
        folder = _child(document, "Folder")
        _child(folder, "name", f"{title} ({len(reviewed)})")
        for contact in reviewed:
            _add_placemark(folder, contact, has_image=contact.uid in images)
    _add_overlays(document, contacts, images)
    ET.indent(root, " ")
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _add_style(document: ET.Element, review: ReviewState, colour: str, *, icons: bool) -> None:
    style = _child(document, "Style", id=review)
    icon_style = _child(style, "IconStyle")
    if icons:
        _child(_child(icon_style, "Icon"), "href", f"icons/{review}.png")
    else:
        # Tints the default icon of the reader. KML colours are aabbggrr.
        _child(icon_style, "color", f"ff{colour[5:7]}{colour[3:5]}{colour[1:3]}")
    # Without a BalloonStyle, readers add a link to a web service to every balloon.
    _child(_child(style, "BalloonStyle"), "text", "<h3>$[name]</h3>$[description]")


def _styles(contacts: ContactSet) -> dict[ReviewState, str]:
    """Return the colours of the verdicts, that of disputed contacts only if there are any."""
    disputed = any(contact.review == "disputed" for contact in contacts.located)
    return {review: colour for review, colour in COLOURS.items() if review != "disputed" or disputed}


def _add_placemark(folder: ET.Element, contact: ExportContact, *, has_image: bool) -> None:
    assert contact.position is not None
    lat_deg, lon_deg = contact.position
    values = contact_properties(contact)
    placemark = _child(folder, "Placemark", id=contact.uid)
    _child(placemark, "name", contact.name + (UNAUTHENTICATED if contact.image.authenticated is False else ""))
    _child(placemark, "description", _balloon_html(values, f"pictures/{contact.uid}.jpg" if has_image else None))
    _child(_child(placemark, "TimeStamp"), "when", str(values["seen_utc"] or values["first_frame_utc"]))
    _child(placemark, "styleUrl", f"#{contact.review}")
    extended = _child(placemark, "ExtendedData")
    for name, value in values.items():
        if value is not None:
            _child(_child(extended, "Data", name=name), "value", _value_text(value))
    _child(_child(placemark, "Point"), "coordinates", f"{lon_deg:.{DEGREE_DECIMALS}f},{lat_deg:.{DEGREE_DECIMALS}f}")


def _balloon_html(values: Mapping[str, Value], image_name: str | None) -> str:
    image = f'<img src="{html_text(image_name)}"/>' if image_name else ""
    rows = "".join(
        f"<tr><td>{html_text(name)}</td><td>{html_text(_value_text(value))}</td></tr>"
        for name, value in values.items()
        if value is not None and value != ""
    )
    return f"{image}<table>{rows}</table>"


def _add_overlays(document: ET.Element, contacts: ContactSet, images: Mapping[str, _Overlay | None]) -> None:
    overlays = [(c, images[c.uid]) for c in contacts.located if c.uid in images]
    if not any(overlay for _, overlay in overlays):
        return
    folder = _child(document, "Folder")
    _child(folder, "name", "Images on the seabed")
    for contact, overlay in overlays:
        if overlay is None:
            continue
        ground = _child(folder, "GroundOverlay")
        _child(ground, "name", contact.name)
        # Initially hidden: a slant-range image is only accurate to a few metres and covers the chart.
        _child(ground, "visibility", "0")
        _child(_child(ground, "TimeStamp"), "when", utc_text(contact.image.first_frame_utc_s))
        _child(_child(ground, "Icon"), "href", f"overlays/{contact.uid}.png")
        box = _child(ground, "LatLonBox")
        for name, degrees in overlay.box_deg.items():
            _child(box, name, repr(round(degrees, DEGREE_DECIMALS)))
        _child(box, "rotation", repr(round(overlay.rotation_deg, 2)))


def _value_text(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _child(parent: ET.Element, tag: str, text: str | None = None, /, **attributes: str) -> ET.Element:
    element = ET.SubElement(parent, tag, {name: xml_text(value) for name, value in attributes.items()})
    if text is not None:
        element.text = xml_text(text)
    return element


# Images


def _eight_bits(pixels: Pixels) -> npt.NDArray[np.uint8]:
    """Scale 16-bit pixels to 8 bits by the brightest pixel; sonars rarely use the full range of 16 bits."""
    if pixels.dtype == np.uint8:
        return pixels.astype(np.uint8, copy=False)
    brightest = max(1, int(pixels.max()))
    return (pixels.astype(np.uint32) * 255 // brightest).astype(np.uint8)


def _overlay(contact: ExportContact, pixels: npt.NDArray[np.uint8]) -> _Overlay | None:
    """Return the place of an image centred on the contact's position; None if its orientation is unknown."""
    record, position = contact.image.contact, contact.position
    if record is None or position is None or abs(position[0]) > _MAX_OVERLAY_LATITUDE_DEG:
        return None
    along, across, heading = record.pixel_along_m, record.pixel_across_m, record.heading_deg
    if along is None or across is None or heading is None or record.channel is None:
        return None
    height_m, width_m = along * pixels.shape[0], across * pixels.shape[1]
    if max(height_m, width_m) > MAX_OVERLAY_M:
        return None
    centre = Position(*position)
    north, south = (offset_position(centre, bearing, height_m / 2).lat_deg for bearing in (0.0, 180.0))
    east, west = (offset_position(centre, bearing, width_m / 2).lon_deg for bearing in (90.0, 270.0))
    if west > east:
        return None  # Readers disagree about boxes across the date line.
    # KML rotates counter-clockwise, and its range is -180 to 180 degrees.
    rotation_deg = math.remainder(-heading, 360.0)
    return _Overlay({"north": north, "south": south, "east": east, "west": west}, rotation_deg)


def _balloon_jpeg(
    contact: ExportContact, pixels: npt.NDArray[np.uint8], missing: npt.NDArray[np.bool_], lines: Iterable[PictureLine]
) -> bytes:
    """Return the image of a balloon: true metres, as the console shows it, with lines, scale bar and verdict."""
    record = contact.image.contact
    image = true_image(pixels, missing, *pixel_size_m(record), _BALLOON_PX)
    verdict = VERDICT_WORDS[contact.review].upper()
    strip = scale_strip(image.pixels.shape[1], _BALLOON_PX, image.px_per_m, north_in_image(record), verdict)
    mark = contact_mark(record, *pixels.shape)
    place = None if mark is None else (mark.row, mark.column)
    buffer = io.BytesIO()
    picture = Image.fromarray(np.vstack([draw_lines(image, lines, place), strip]))
    picture.save(buffer, format="JPEG", quality=_BALLOON_QUALITY)
    return buffer.getvalue()


def _overlay_png(pixels: npt.NDArray[np.uint8]) -> bytes:
    # Level 1 needs half the time of level 6, for 10 % more bytes.
    return encode_png(Image.fromarray(np.ascontiguousarray(pixels)), 1)


def _heading_up(contact: ExportContact, pixels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return an image with the heading at the top.

    Row 0 is the first ping and column 0 is nearest the track. A starboard image is therefore mirrored top to bottom,
    and a port image is rotated by 180 degrees.
    """
    record = contact.image.contact
    starboard = record is not None and record.channel == "starboard"
    return pixels[::-1, :] if starboard else pixels[::-1, ::-1]


def _icon_png(review: ReviewState, colour: str) -> bytes:
    """Return an icon of 32 x 32 px. Verdicts differ in shape and in colour."""
    image = Image.new("RGBA", (ICON_PX, ICON_PX), (0, 0, 0, 0))
    draw = ImageDraw.Draw(image)
    low, middle, high = 3, ICON_PX // 2, ICON_PX - 4
    match review:
        case "mine_like":
            draw.polygon([(middle, low), (high, middle), (middle, high), (low, middle)], colour, "black", 2)
        case "not_mine_like":
            draw.ellipse((low, low, high, high), colour, "black", 2)
        case "unsure":
            draw.polygon([(middle, low), (high, high), (low, high)], colour, "black", 2)
        case "disputed":
            draw.polygon([(middle, low), (high, middle), (middle, high), (low, middle)], colour, "black", 2)
            draw.line([(middle, low + 7), (middle, high - 11)], "white", 4)
            draw.line([(middle, high - 9), (middle, high - 6)], "white", 4)
        case "unreviewed":
            draw.rectangle((low, low, high, high), colour, "black", 2)
    return encode_png(image)
