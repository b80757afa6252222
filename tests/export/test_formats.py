"""Export formats: agreement with their specifications, and escaping of untrusted text."""

import csv
import dataclasses
import io
import json
import re
import tempfile
import zipfile
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.exports import (
    HOSTILE,
    MISSIONS,
    decision,
    export,
    golden_files,
    image,
    mission,
    single,
    store,
)
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from sonarpost.export.contacts import ContactSet, load_contacts
from sonarpost.export.formats import write_export
from sonarpost.export.source import ExportSource, StoredImages
from sonarpost.export.tables import COLUMNS
from sonarpost.export.text import csv_text, html_text, probabilities_text, xml_text
from sonarpost.messages import Pixels
from sonarpost.review.measurement import MeasuredSize

GOLDEN = GOLDEN_FOLDER / "export"
KML = "{http://www.opengis.net/kml/2.2}"


@pytest.fixture
def contacts(tmp_path):
    return load_contacts(mission(tmp_path / "out"))


MARKS = {
    "classified.geojson": (b'"atd_class": "structure"', b'"p_mine_like": 0.85,', b'"p_other_object": 0.1'),
    "classified.kml": (
        b'<Data name="p_mine_like">\n      <value>0.85<',
        b'<Data name="p_other_object">\n      <value>0.1<',
    ),
    "classified.csv": (b",true,0.85,0.1,", b",,0.0,1.0,", b",,0.5,0.25,"),
    "authenticated.geojson": (b'"authenticated": false',),
    "authenticated.kml": (b"<name>uuv-1/0002 (unauthenticated)</name>",),
    "authenticated.csv": (b",,false,",),
    "reviewed.csv": (b",unreviewed,", b",anna,,,,,,,,\r\n", b",disputed,manta,"),
}
"""What a golden file contains once, beside what is compared with it."""


@pytest.mark.parametrize("mission_name", MISSIONS)
def test_every_export_equals_its_golden_file(tmp_path, mission_name):
    """Withdrawn, disputed and settled decisions, classes with probabilities, unauthenticated contacts."""
    files = golden_files(mission_name, load_contacts(MISSIONS[mission_name](tmp_path)))
    for name, data in files.items():
        output = data
        assert output == (GOLDEN / name).read_bytes()
        assert {mark: output.count(mark) for mark in MARKS.get(name, ())} == dict.fromkeys(MARKS.get(name, ()), 1)
        assert mission_name != "reviewed" or b"unsure<" not in output.replace(b'Style id="unsure"', b"")


def test_percentages_add_up_to_100():
    texts = {
        (None, None): "",
        (0.5, None): "",
        (0.83, 0.12): "mine-like 83 %, other object 12 %, seabed 5 %",
        (1.0, 0.0): "mine-like 100 %, other object 0 %, seabed 0 %",
        (0.006, 0.994): "mine-like 1 %, other object 99 %, seabed 0 %",
        (0.3333, 0.3333): "mine-like 33 %, other object 33 %, seabed 34 %",
    }
    assert {probabilities: probabilities_text(*probabilities) for probabilities in texts} == texts


def test_every_export_states_the_measurements_of_operators():
    measured = {"length_m": 1.2345, "length_sigma_m": 0.06, "height_m": 0.5, "height_sigma_m": 0.125}
    (contact,) = single(image(contact={"length_m": 2.5})).contacts
    contacts = ContactSet((dataclasses.replace(contact, size=MeasuredSize(**measured)),), (), ())
    properties = json.loads(export("geojson", contacts))["features"][0]["properties"]
    assert (properties["length_m"], properties["measured_length_m"]) == (2.5, 1.234)
    assert (properties["measured_height_sigma_m"], properties["measured_width_m"]) == (0.125, None)
    assert export("csv", contacts).endswith(b",1.234,0.06,,,,,0.5,0.125\r\n")
    assert b'<Data name="measured_height_m">\n      <value>0.5<' in export("kml", contacts)


def test_unknown_authentication_is_not_stated(contacts):
    assert {contact.image.authenticated for contact in contacts.contacts} == {None}
    files = golden_files("mission", contacts)
    assert not any(b"nauthenticated" in data for data in files.values())


def test_written_files_equal_the_bytes(contacts, tmp_path):
    for name in ("geojson", "kml", "csv", "kmz"):
        assert write_export(name, tmp_path / "file", contacts) == []
        assert (tmp_path / "file").read_bytes() == export(name, contacts)
    assert {path.name for path in tmp_path.iterdir()} == {"file", "out"}


def test_parts_of_a_large_export_are_in_files_without_a_name(contacts, monkeypatch, tmp_path):
    expected = {name: export(name, contacts) for name in ("geojson", "kml")}
    files = []

    def temporary_file(source):
        files.append(tempfile.TemporaryFile(dir=source.path.parent))  # noqa: SIM115  the writer closes it
        return files[-1]

    monkeypatch.setattr(ExportSource, "temporary_file", temporary_file)
    assert {name: export(name, contacts) for name in ("geojson", "kml")} == expected
    assert len(files) == 7
    assert all(file.closed for file in files)


def test_geojson_has_longitude_first_and_lists_unlocated_contacts(contacts):
    collection = json.loads(export("geojson", contacts))
    assert collection["type"] == "FeatureCollection"
    assert "crs" not in collection  # RFC 7946, section 4: WGS 84 and nothing else
    points = [f["geometry"]["coordinates"] for f in collection["features"]]
    assert len(points) == 5
    assert points[0] == [-70.6712456, 41.5251334]
    assert len({f["id"] for f in collection["features"]}) == 5
    assert [p["name"] for p in collection["unlocated"]] == ["uuv-1/0005"]
    assert [p["lat_deg"] for p in collection["unlocated"]] == [None]
    assert all(tuple(f["properties"]) == COLUMNS for f in collection["features"])


def test_csv_round_trip(contacts):
    data = export("csv", contacts)
    assert data.count(b"\r\n") == data.count(b"\n") == 7
    rows = list(csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline="")))
    assert [tuple(row) for row in rows] == [COLUMNS] * 6
    assert (rows[0]["lat_deg"], rows[0]["lon_deg"], rows[0]["atd_class"]) == ("41.5251334", "-70.6712456", "")
    assert rows[1]["remark"] == '\'=1+1 <b>& "both"</b>'
    assert (rows[4]["lat_deg"], rows[4]["lon_deg"]) == ("", "")


@given(st.text())
@example("=1+1")
@example("  =1")
@example("\r\n=1")
@example("\uff1d1")
@example("\u3000=1")
@example("@SUM(A1)")
def test_csv_cell_is_never_a_formula_or_several_lines(text):
    cell = csv_text(text)
    assert not cell.lstrip().startswith(("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20"))
    assert len(cell.splitlines()) <= 1
    cell.encode()


def kmz_of(folder, *records):
    """Return the KMZ of records, and a function that opens its only image in a folder."""
    archive = zipfile.ZipFile(io.BytesIO(export("kmz", load_contacts(store(folder, *records)))))

    def open_image(kind):
        (name,) = (n for n in archive.namelist() if n.startswith(f"{kind}/"))
        return Image.open(io.BytesIO(archive.read(name)))

    return archive, open_image


def test_kml_groups_contacts_by_verdict(contacts):
    root = ET.fromstring(export("kml", contacts))
    folders = {f.findtext(f"{KML}name"): f.findall(f"{KML}Placemark") for f in root.iter(f"{KML}Folder")}
    counts = {"Mine-like (1)": 1, "Unsure (1)": 1, "Not reviewed (2)": 2, "Not mine-like (1)": 1}
    assert {name: len(marks) for name, marks in folders.items()} == counts
    styles = {f"#{style.get('id')}" for style in root.iter(f"{KML}Style")}
    assert {mark.findtext(f"{KML}styleUrl") for mark in root.iter(f"{KML}Placemark")} <= styles
    assert root.findtext(f"{KML}Document/{KML}description") == "5 contacts; 1 more without a position"
    assert "-70.6712456,41.5251334" in [c.text for c in root.iter(f"{KML}coordinates")]


def test_kmz_contains_all_referenced_files(contacts):
    data = export("kmz", contacts)
    archive = zipfile.ZipFile(io.BytesIO(data))
    assert archive.namelist()[-1] == "doc.kml"
    text = archive.read("doc.kml").decode()
    root = ET.fromstring(text)
    named = {h.text for h in root.iter(f"{KML}href")}
    for mark in root.iter(f"{KML}Placemark"):
        named |= set(re.findall(r'<img src="([^"]+)"', mark.findtext(f"{KML}description") or ""))
    assert named == set(archive.namelist()[:-1])
    assert len([n for n in named if n and n.startswith("images/")]) == 4
    assert "http" not in text.replace("http://www.opengis.net/kml/2.2", "")
    for name in archive.namelist()[:-1]:
        kind = "JPEG" if name.startswith("images/") else "PNG"
        assert Image.open(io.BytesIO(archive.read(name))).format == kind


def test_unreadable_image_is_omitted_from_kmz(contacts):
    path = contacts.contacts[0].image_path
    path.write_bytes(b"no PNG")
    images = StoredImages()
    data = export("kmz", contacts, images)
    assert [p.where for p in images.problems] == [str(path)]
    assert zipfile.ZipFile(io.BytesIO(data)).read("doc.kml").count(b"<Placemark") == 5


@pytest.mark.parametrize(
    ("channel", "heading_deg", "corner", "rotation"),
    # Row 0 is the first ping, column 0 is nearest the track. With the heading at the top, row 0 is at the bottom.
    # Column 0 is on the left of a starboard image and on the right of a port image.
    [("starboard", 30.0, (-1, 0), -30.0), ("port", 30.0, (-1, -1), -30.0), ("port", 350.0, (-1, -1), 10.0)],
)
def test_overlay_orientation(tmp_path, channel, heading_deg, corner, rotation):
    pixels = np.zeros((16, 24), np.uint8)
    pixels[0, 0] = 255
    record = image(contact={"channel": channel, "heading_deg": heading_deg}, pixels=Pixels.from_array(pixels))
    archive, open_image = kmz_of(tmp_path, record)
    assert np.asarray(open_image("overlays"))[corner] == 255
    box = ET.fromstring(archive.read("doc.kml")).find(f".//{KML}LatLonBox")
    north, south, east, west, turn = (float(element.text or "") for element in box)
    assert turn == rotation
    # 16 rows of 0.25 m, 24 columns of 0.125 m.
    assert (north - south) * 111_100 == pytest.approx(4.0, rel=0.01)
    assert (east - west) * 111_320 * np.cos(np.radians(41.525)) == pytest.approx(3.0, rel=0.01)


def test_image_of_unknown_orientation_has_no_overlay(tmp_path):
    unknown = ({"heading_deg": None}, {"channel": None, "ground_range_m": None}, {"pixel_along_m": None})
    for number, contact in enumerate((*unknown, {"lon_deg": 179.999999})):
        names = kmz_of(tmp_path / str(number), image(contact=contact))[0].namelist()
        assert [n.split("/")[0] for n in names if "/" in n].count("overlays") == 0
        assert [n for n in names if n.startswith("images/")]


def test_sixteen_bits_are_scaled_to_eight_and_an_image_has_the_shape_of_the_seabed(tmp_path):
    deep = Pixels.from_array(np.array([[0, 500, 1000]], np.uint16))
    _, open_image = kmz_of(tmp_path / "deep", image(pixels=deep))
    assert np.asarray(open_image("overlays")).tolist() == [[0, 127, 255]]
    # 16 x 24 px of 0.25 m x 0.125 m: 4 m along, 3 m across the track.
    black = Pixels.from_array(np.zeros((16, 24), np.uint8))
    _, open_image = kmz_of(tmp_path / "black", image(pixels=black), decision())
    pixels = np.asarray(open_image("images").convert("L"))
    # The strip with the scale bar below the image is white.
    height = int(np.argmax(pixels[:, 5] > 250))
    assert (height, pixels.shape[1]) == pytest.approx((240, 180), abs=3)
    assert pixels.shape[0] > height + 15


def test_tiny_coordinate_has_no_exponent():
    found = single(image(contact={"lat_deg": -0.00000012, "lon_deg": 1e-9}))
    assert b"e-" not in export("kml", found).split(b"<coordinates>")[1].split(b"</")[0]


def test_contact_without_position_is_no_feature():
    found = single(image().model_copy(update={"contact": None}))
    assert len(found.unlocated) == 1
    assert json.loads(export("geojson", found))["features"] == []


# Untrusted text


@given(remark=HOSTILE, mlo_class=HOSTILE, operator=HOSTILE.filter(bool), note=HOSTILE)
def test_untrusted_text_is_escaped_in_all_formats(remark, mlo_class, operator, note):
    found = single(
        image(notes=(note,)), decision(remark=remark, mlo_class=mlo_class, operator=operator, verdict="mine_like")
    )
    root = ET.fromstring(export("kml", found))
    data = {d.get("name"): d.findtext(f"{KML}value") for d in root.iter(f"{KML}Data")}
    balloon = root.findtext(f".//{KML}Placemark/{KML}description") or ""
    if "\r" not in remark:  # XML readers normalise line ends
        assert data["remark"] == xml_text(remark)
        assert html_text(remark) in balloon
    assert set(re.findall(r"<(/?\w+)", balloon)) <= {"table", "/table", "tr", "/tr", "td", "/td"}
    properties = json.loads(export("geojson", found))["features"][0]["properties"]
    assert (properties["remark"], properties["notes"]) == (xml_text(remark), xml_text(note))
    rows = list(csv.reader(io.StringIO(export("csv", found).decode("utf-8-sig"), newline="")))
    assert [len(row) for row in rows] == [len(COLUMNS)] * 2


@given(st.text(st.characters(categories=None), max_size=40))
def test_xml_text_is_accepted_by_a_parser(text):
    assert ET.fromstring(f"<a>{html_text(text)}</a>") is not None
    xml_text(text).encode()
