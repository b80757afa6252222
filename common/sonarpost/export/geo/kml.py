"""KML 2.2 and KMZ for Google Earth and chart programs.

Each contact is a placemark with a style by verdict and a balloon with its properties. A KMZ adds the image to the
balloon, in true metres with a scale bar, and lays it on the map if heading, side and both pixel sizes are known.
"""

from __future__ import annotations

import io
import math
import shutil
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import IO, Final, Self
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from sonarpost.export.contacts import ExportContact
from sonarpost.export.source import ExportSource, GreyImage, archive_entry
from sonarpost.export.tables import DEGREE_DECIMALS, Value, contact_properties
from sonarpost.export.text import VERDICT_WORDS, html_text, utc_text, xml_text
from sonarpost.review.decisions import ReviewState
from sonarpost.review.image_geometry import contact_mark
from sonarpost.review.true_scale import (
    ImageLine,
    draw_lines,
    north_in_image,
    pixel_size_m,
    scale_strip,
    stretched,
    true_image,
)
from sonarpost.sonar.geometry import Position, offset_position
from sonarpost.sonar.image_files import encode_png

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
_OVERLAYS: Final = "overlays"
UNAUTHENTICATED: Final = " (unauthenticated)"
"""End of the name of a contact whose acoustic frames were received without a key."""
MAX_OVERLAY_M: Final = 1000.0
ICON_PX: Final = 32
_MAX_OVERLAY_LATITUDE_DEG: Final = 85.0
_BALLOON_PX: Final = 240
"""Longer side of the image in a balloon."""
_BALLOON_QUALITY: Final = 75


@dataclass(frozen=True, slots=True)
class _Overlay:
    """Place of an image on the map, top along the heading: a KML LatLonBox and its counter-clockwise rotation."""

    box_deg: Mapping[str, float]
    rotation_deg: float


def write_kml(file: IO[bytes], source: ExportSource) -> None:
    """Write a KML document without images, UTF-8."""
    with _Document(source) as document:
        for contact in source.contacts:
            document.add(contact)
        document.write(file, icons=False)


def write_kmz(file: IO[bytes], source: ExportSource) -> None:
    """Write a KMZ archive: images, icons, and `doc.kml` as the last file. It references no network resource."""
    with zipfile.ZipFile(file, "w") as archive, _Document(source) as document:
        for contact in source.contacts:
            found = None if contact.position is None else source.images.image(contact)
            overlay = None
            if found is not None:
                pixels = _eight_bits(found.pixels)
                missing = np.zeros(pixels.shape, np.bool_) if found.missing is None else found.missing
                jpeg = _balloon_jpeg(contact, pixels, missing, found.lines)
                archive.writestr(archive_entry(f"images/{contact.uid}.jpg"), jpeg)
                overlay = _overlay(contact, pixels)
                if overlay is not None:
                    # A ground overlay has the shape of its box: pixels need not be square.
                    overlay_pixels = _heading_up(contact, stretched(pixels, missing))
                    archive.writestr(archive_entry(f"overlays/{contact.uid}.png"), _overlay_png(overlay_pixels))
            document.add(contact, has_image=found is not None, overlay=overlay)
        for review, colour in document.styles().items():
            archive.writestr(archive_entry(f"icons/{review}.png"), _icon_png(review, colour))
        with archive.open(archive_entry("doc.kml"), "w") as text:
            document.write(text, icons=True)


# Document


class _Document:
    """A KML document in parts, each in a temporary file: the contacts of each verdict, and the overlays.

    Args:
        source: The source of the export.
    """

    def __init__(self, source: ExportSource) -> None:
        self._parts = {name: source.temporary_file() for name in (*FOLDERS, _OVERLAYS)}
        self._counts = Counter[str]()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        for part in self._parts.values():
            part.close()

    def add(self, contact: ExportContact, *, has_image: bool = False, overlay: _Overlay | None = None) -> None:
        """Add a contact; one without a position is counted."""
        if contact.position is None:
            self._counts["unlocated"] += 1
            return
        self._add(contact.review, _placemark(contact, *contact.position, has_image=has_image))
        if overlay is not None:
            self._add(_OVERLAYS, _ground_overlay(contact, overlay))

    def styles(self) -> dict[ReviewState, str]:
        """Return the colours of the verdicts, that of disputed contacts only if there are any."""
        return {review: colour for review, colour in COLOURS.items() if review != "disputed" or self._counts[review]}

    def write(self, file: IO[bytes], *, icons: bool) -> None:
        """Write the document; `icons` is whether the archive has icons."""
        root = ET.Element("kml", {"xmlns": NAMESPACE})
        document = _child(root, "Document")
        _child(document, "name", "sonarpost contacts")
        located = sum(self._counts[review] for review in FOLDERS)
        unlocated = self._counts["unlocated"]
        _child(document, "description", f"{located} contacts; {unlocated} more without a position")
        for review, colour in self.styles().items():
            _add_style(document, review, colour, icons=icons)
        ET.indent(root, " ")
        head, end, tail = ET.tostring(root, encoding="utf-8", xml_declaration=True).rpartition(b"\n </Document>")
        file.write(head)
        titles: dict[str, str] = {review: f"{title} ({self._counts[review]})" for review, title in FOLDERS.items()}
        for name, title in (titles | {_OVERLAYS: "Images on the seabed"}).items():
            if self._counts[name]:
                file.write(f"\n  <Folder>\n   <name>{title}</name>".encode())
                self._parts[name].seek(0)
                shutil.copyfileobj(self._parts[name], file)
                file.write(b"\n  </Folder>")
        file.write(end + tail + b"\n")

    def _add(self, name: str, element: ET.Element) -> None:
        ET.indent(element, " ", level=3)
        self._parts[name].write(b"\n   " + ET.tostring(element, encoding="utf-8"))
        self._counts[name] += 1


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


def _placemark(contact: ExportContact, lat_deg: float, lon_deg: float, *, has_image: bool) -> ET.Element:
    values = contact_properties(contact)
    placemark = ET.Element("Placemark", {"id": xml_text(contact.uid)})
    _child(placemark, "name", contact.name + (UNAUTHENTICATED if contact.image.authenticated is False else ""))
    _child(placemark, "description", _balloon_html(values, f"images/{contact.uid}.jpg" if has_image else None))
    _child(_child(placemark, "TimeStamp"), "when", str(values["seen_utc"] or values["first_frame_utc"]))
    _child(placemark, "styleUrl", f"#{contact.review}")
    extended = _child(placemark, "ExtendedData")
    for name, value in values.items():
        if value is not None:
            _child(_child(extended, "Data", name=name), "value", _value_text(value))
    _child(_child(placemark, "Point"), "coordinates", f"{lon_deg:.{DEGREE_DECIMALS}f},{lat_deg:.{DEGREE_DECIMALS}f}")
    return placemark


def _balloon_html(values: Mapping[str, Value], image_name: str | None) -> str:
    image = f'<img src="{html_text(image_name)}"/>' if image_name else ""
    rows = "".join(
        f"<tr><td>{html_text(name)}</td><td>{html_text(_value_text(value))}</td></tr>"
        for name, value in values.items()
        if value is not None and value != ""
    )
    return f"{image}<table>{rows}</table>"


def _ground_overlay(contact: ExportContact, overlay: _Overlay) -> ET.Element:
    ground = ET.Element("GroundOverlay")
    _child(ground, "name", contact.name)
    # Initially hidden: a slant-range image is only accurate to a few metres and covers the chart.
    _child(ground, "visibility", "0")
    _child(_child(ground, "TimeStamp"), "when", utc_text(contact.image.first_frame_utc_s))
    _child(_child(ground, "Icon"), "href", f"overlays/{contact.uid}.png")
    box = _child(ground, "LatLonBox")
    for name, degrees in overlay.box_deg.items():
        _child(box, name, repr(round(degrees, DEGREE_DECIMALS)))
    _child(box, "rotation", repr(round(overlay.rotation_deg, 2)))
    return ground


def _value_text(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _child(parent: ET.Element, tag: str, text: str | None = None, /, **attributes: str) -> ET.Element:
    element = ET.SubElement(parent, tag, {name: xml_text(value) for name, value in attributes.items()})
    if text is not None:
        element.text = xml_text(text)
    return element


# Images


def _eight_bits(pixels: GreyImage) -> npt.NDArray[np.uint8]:
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
    contact: ExportContact, pixels: npt.NDArray[np.uint8], missing: npt.NDArray[np.bool_], lines: Iterable[ImageLine]
) -> bytes:
    """Return the image of a balloon: true metres, as the console shows it, with lines, scale bar and verdict."""
    record = contact.image.contact
    image = true_image(pixels, missing, *pixel_size_m(record), _BALLOON_PX)
    verdict = VERDICT_WORDS[contact.review].upper()
    strip = scale_strip(image.pixels.shape[1], _BALLOON_PX, image.px_per_m, north_in_image(record), verdict)
    mark = contact_mark(record, *pixels.shape)
    place = None if mark is None else (mark.row, mark.column)
    buffer = io.BytesIO()
    balloon = Image.fromarray(np.vstack([draw_lines(image, lines, place), strip]))
    balloon.save(buffer, format="JPEG", quality=_BALLOON_QUALITY)
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
