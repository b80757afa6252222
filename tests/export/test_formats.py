"""Export formats: agreement with their specifications, and escaping of untrusted text."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
import zipfile
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import xmlschema
from builders.common import GOLDEN_FOLDER
from builders.exports import (
    FIRST_UTC_S,
    as_of_golden_file,
    authenticated_mission,
    classified_mission,
    decision,
    golden_files,
    image,
    mission,
    reviewed_mission,
    store,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from sonarpost.archive.image_files import side_car
from sonarpost.export.contacts import ContactSet, ExportContact, SideCar, load_contacts
from sonarpost.export.cot import CotOptions, cot_event, cot_events, cot_type
from sonarpost.export.kml import kml_bytes, kmz_bytes, write_kml, write_kmz
from sonarpost.export.tables import (
    COLUMNS,
    contact_properties,
    csv_bytes,
    geojson,
    geojson_bytes,
    write_csv,
    write_geojson,
)
from sonarpost.export.text import csv_text, html_text, probabilities_text, xml_text
from sonarpost.messages import Decision, Pixels
from sonarpost.review.measured_size import MeasuredSize

GOLDEN = GOLDEN_FOLDER / "export"
KML = "{http://www.opengis.net/kml/2.2}"
NOW_UTC_S = FIRST_UTC_S + 3600


@pytest.fixture(scope="module")
def schema() -> xmlschema.XMLSchema:
    return xmlschema.XMLSchema(Path(__file__).with_name("cot_event.xsd"))


@pytest.fixture
def contacts(tmp_path: Path) -> ContactSet:
    return load_contacts(mission(tmp_path / "out"))


def single(record: object, *decisions: Decision) -> ContactSet:
    """One contact without files."""
    side = SideCar.model_validate_json(json.dumps(side_car(record)))  # type: ignore[arg-type]
    return ContactSet((ExportContact(side, decisions, None),), (), ())


@pytest.mark.parametrize("name", ["mission.geojson", "mission.kml", "mission.csv", "mission.cot"])
def test_output_equals_golden_file(contacts: ContactSet, name: str) -> None:
    assert as_of_golden_file(name, golden_files("mission", contacts)[name]) == (GOLDEN / name).read_bytes()


@pytest.mark.parametrize("kind", ["geojson", "kml", "csv", "cot"])
def test_every_export_states_class_and_probabilities(tmp_path: Path, kind: str) -> None:
    name = f"classified.{kind}"
    output = as_of_golden_file(name, golden_files("classified", load_contacts(classified_mission(tmp_path)))[name])
    assert output == (GOLDEN / name).read_bytes()
    marks = {
        "geojson": (b'"atd_class": "structure"', b'"p_mine_like": 0.85,', b'"p_other_object": 0.1'),
        "kml": (b'<Data name="p_mine_like">\n      <value>0.85<', b'<Data name="p_other_object">\n      <value>0.1<'),
        "csv": (b",true,0.85,0.1\r\n", b",,0.0,1.0\r\n", b",,,\r\n", b",,0.5,0.25\r\n"),
        "cot": (
            b"Detector's class mine-like. Detector: mine-like 85 %, other object 10 %, seabed 5 %.",
            b"Detector's class structure. Detector's confidence",
            b"Z. Water depth 15.8 m. Detector: mine-like 50 %, other object 25 %, seabed 25 %.",
        ),
    }
    for mark in marks[kind]:
        assert output.count(mark) == 1, mark


@pytest.mark.parametrize(
    ("p_mine_like", "p_other_object", "text"),
    [
        (None, None, ""),
        (0.5, None, ""),
        (0.83, 0.12, "mine-like 83 %, other object 12 %, seabed 5 %"),
        (1.0, 0.0, "mine-like 100 %, other object 0 %, seabed 0 %"),
        (0.006, 0.994, "mine-like 1 %, other object 99 %, seabed 0 %"),
        (0.3333, 0.3333, "mine-like 33 %, other object 33 %, seabed 34 %"),
    ],
)
def test_percentages_add_up_to_100(p_mine_like: float | None, p_other_object: float | None, text: str) -> None:
    assert probabilities_text(p_mine_like, p_other_object) == text


@pytest.mark.parametrize("kind", ["geojson", "kml", "csv", "cot"])
def test_every_export_marks_unauthenticated_contacts(tmp_path: Path, kind: str) -> None:
    name = f"authenticated.{kind}"
    output = as_of_golden_file(
        name, golden_files("authenticated", load_contacts(authenticated_mission(tmp_path)))[name]
    )
    assert output == (GOLDEN / name).read_bytes()
    marks = {
        "geojson": b'"authenticated": false',
        "kml": b"<name>uuv-1/0002 (unauthenticated)</name>",
        "csv": b",false\r\n",
        "cot": b"Unauthenticated: any modem in range",
    }
    assert output.count(marks[kind]) == 1


@pytest.mark.parametrize("kind", ["geojson", "kml", "csv", "cot"])
def test_every_export_states_withdrawn_disputed_and_settled_decisions(tmp_path: Path, kind: str) -> None:
    name = f"reviewed.{kind}"
    output = golden_files("reviewed", load_contacts(reviewed_mission(tmp_path)))[name]
    assert output == (GOLDEN / name).read_bytes()
    marks = {
        "geojson": (b'"review": "unreviewed"', b'"withdrawn_by": "anna"', b'"review": "disputed"'),
        "kml": (b"#unreviewed<", b'<Data name="withdrawn_by">\n      <value>anna<', b"Disputed (1)", b"#disputed<"),
        "csv": (b",unreviewed,", b",anna,,,,,,,,\r\n", b",disputed,manta,"),
        "cot": (
            b"Sonar contact, not reviewed.",
            b"Decision withdrawn by anna.",
            b"Disputed, counts as mine-like.",
            b"Verdicts: anna mine-like, ben not mine-like.",
        ),
    }
    for mark in marks[kind]:
        assert output.count(mark) == 1, mark
    assert b"unsure<" not in output.replace(b'Style id="unsure"', b"")


def test_withdrawal_of_an_older_console_is_not_exported_as_unsure(tmp_path: Path) -> None:
    later = {"decided_utc_s": FIRST_UTC_S + 700, "verdict": "unsure"}
    store(tmp_path, image(), decision(), decision(decision_id="d-2", remark="withdraws decision d-1", **later))
    (contact,) = load_contacts(tmp_path).contacts
    assert (contact.review, contact.withdrawn_by, cot_type(contact)) == ("unreviewed", "A. Operator", "b-m-p-s-m")
    assert contact_properties(contact)["operator"] is None


def test_every_export_states_the_measurements_of_operators() -> None:
    measured = {"length_m": 1.2345, "length_sigma_m": 0.06, "height_m": 0.5, "height_sigma_m": 0.125}
    (contact,) = single(image(contact={"length_m": 2.5})).contacts
    contacts = ContactSet((dataclasses.replace(contact, size=MeasuredSize(**measured)),), (), ())
    properties = geojson(contacts)["features"][0]["properties"]  # type: ignore[index]
    assert (properties["length_m"], properties["measured_length_m"]) == (2.5, 1.234)
    assert (properties["measured_height_sigma_m"], properties["measured_width_m"]) == (0.125, None)
    assert csv_bytes(contacts).endswith(b",1.234,0.06,,,,,0.5,0.125\r\n")
    assert b'<Data name="measured_height_m">\n      <value>0.5<' in kml_bytes(contacts)
    assert "Measured: L 1.23 ± 0.06 m, H 0.50 ± 0.12 m." in cot_event(contacts.contacts[0], NOW_UTC_S).decode()


def test_images_of_earlier_versions_have_no_statement_about_authentication_and_despeckling(
    contacts: ContactSet,
) -> None:
    assert {contact.image.authenticated for contact in contacts.contacts} == {None}
    assert "authenticated" not in side_car(image())
    assert side_car(image(authenticated=False))["authenticated"] is False
    assert "despeckle_strength" not in side_car(image())
    assert side_car(image(despeckle_strength=0.0))["despeckle_strength"] == 0.0
    files = golden_files("mission", contacts)
    assert not any(b"nauthenticated" in data for data in files.values())


def test_written_files_equal_the_bytes(contacts: ContactSet, tmp_path: Path) -> None:
    write_geojson(tmp_path / "a", contacts)
    write_kml(tmp_path / "b", contacts)
    write_csv(tmp_path / "c", contacts)
    assert write_kmz(tmp_path / "d", contacts) == ()
    expected = [geojson_bytes(contacts), kml_bytes(contacts), csv_bytes(contacts), kmz_bytes(contacts)[0]]
    assert [(tmp_path / name).read_bytes() for name in "abcd"] == expected


# GeoJSON


def test_geojson_has_longitude_first_and_lists_unlocated_contacts(contacts: ContactSet) -> None:
    collection = json.loads(geojson_bytes(contacts))
    assert collection["type"] == "FeatureCollection"
    assert "crs" not in collection  # RFC 7946, section 4: WGS 84 and nothing else
    points = [f["geometry"]["coordinates"] for f in collection["features"]]
    assert len(points) == 5
    assert points[0] == [-70.6712456, 41.5251334]
    assert len({f["id"] for f in collection["features"]}) == 5
    assert [p["name"] for p in collection["unlocated"]] == ["uuv-1/0005"]
    assert [p["lat_deg"] for p in collection["unlocated"]] == [None]
    assert all(tuple(f["properties"]) == COLUMNS for f in collection["features"])


# CSV


def test_csv_round_trip(contacts: ContactSet) -> None:
    data = csv_bytes(contacts)
    assert data.count(b"\r\n") == data.count(b"\n") == 7
    rows = list(csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline="")))
    assert [tuple(row) for row in rows] == [COLUMNS] * 6
    assert (rows[0]["lat_deg"], rows[0]["lon_deg"], rows[0]["atd_class"]) == ("41.5251334", "-70.6712456", "")
    assert rows[1]["remark"] == '\'=1+1 <b>& "both"</b>'
    assert (rows[4]["lat_deg"], rows[4]["lon_deg"]) == ("", "")


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "  =1", "\t=1", "\r\n=1", "\uff1d1", "\u3000=1"])
def test_csv_formula_is_escaped(text: str) -> None:
    assert csv_text(text)[0] in ("'", "\N{REPLACEMENT CHARACTER}")


@given(st.text())
def test_csv_cell_is_never_a_formula_or_several_lines(text: str) -> None:
    cell = csv_text(text)
    assert not cell.lstrip().startswith(("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20"))
    assert len(cell.splitlines()) <= 1
    cell.encode()


# KML


def test_kml_groups_contacts_by_verdict(contacts: ContactSet) -> None:
    root = ET.fromstring(kml_bytes(contacts))
    folders = {f.findtext(f"{KML}name"): f.findall(f"{KML}Placemark") for f in root.iter(f"{KML}Folder")}
    assert {name: len(marks) for name, marks in folders.items()} == {
        "Mine-like (1)": 1,
        "Unsure (1)": 1,
        "Not reviewed (2)": 2,
        "Not mine-like (1)": 1,
    }
    styles = {f"#{style.get('id')}" for style in root.iter(f"{KML}Style")}
    assert {mark.findtext(f"{KML}styleUrl") for mark in root.iter(f"{KML}Placemark")} <= styles
    assert root.findtext(f"{KML}Document/{KML}description") == "5 contacts; 1 more without a position"
    assert "-70.6712456,41.5251334" in [c.text for c in root.iter(f"{KML}coordinates")]


def test_kmz_contains_all_referenced_files(contacts: ContactSet) -> None:
    data, problems = kmz_bytes(contacts)
    assert problems == ()
    archive = zipfile.ZipFile(io.BytesIO(data))
    assert archive.namelist()[-1] == "doc.kml"
    text = archive.read("doc.kml").decode()
    root = ET.fromstring(text)
    named = {h.text for h in root.iter(f"{KML}href")}
    for mark in root.iter(f"{KML}Placemark"):
        named |= set(re.findall(r'<img src="([^"]+)"', mark.findtext(f"{KML}description") or ""))
    assert named == set(archive.namelist()[:-1])
    assert len([n for n in named if n and n.startswith("pictures/")]) == 4
    assert "http" not in text.replace("http://www.opengis.net/kml/2.2", "")
    for name in archive.namelist()[:-1]:
        kind = "JPEG" if name.startswith("pictures/") else "PNG"
        assert Image.open(io.BytesIO(archive.read(name))).format == kind


def test_unreadable_image_is_omitted_from_kmz(contacts: ContactSet) -> None:
    path = contacts.contacts[0].image_path
    assert path is not None
    path.write_bytes(b"no PNG")
    data, problems = kmz_bytes(contacts)
    assert [p.where for p in problems] == [str(path)]
    assert zipfile.ZipFile(io.BytesIO(data)).read("doc.kml").count(b"<Placemark") == 5


@pytest.mark.parametrize(
    ("channel", "heading_deg", "corner", "rotation"),
    # Row 0 is the first ping, column 0 is nearest the track. With the heading at the top, row 0 is at the bottom.
    # Column 0 is on the left of a starboard image and on the right of a port image.
    [("starboard", 30.0, (-1, 0), -30.0), ("port", 30.0, (-1, -1), -30.0), ("port", 350.0, (-1, -1), 10.0)],
)
def test_overlay_orientation(
    tmp_path: Path, channel: str, heading_deg: float, corner: tuple[int, int], rotation: float
) -> None:
    pixels = np.zeros((16, 24), np.uint8)
    pixels[0, 0] = 255
    record = image(contact={"channel": channel, "heading_deg": heading_deg}, picture=Pixels.from_array(pixels))
    data, _ = kmz_bytes(load_contacts(store(tmp_path, record)))
    archive = zipfile.ZipFile(io.BytesIO(data))
    (name,) = (n for n in archive.namelist() if n.startswith("overlays/"))
    overlay = np.asarray(Image.open(io.BytesIO(archive.read(name))))
    assert overlay[corner] == 255
    box = ET.fromstring(archive.read("doc.kml")).find(f".//{KML}LatLonBox")
    assert box is not None
    north, south, east, west, turn = (float(element.text or "") for element in box)
    assert turn == rotation
    # 16 rows of 0.25 m, 24 columns of 0.125 m.
    assert (north - south) * 111_100 == pytest.approx(4.0, rel=0.01)
    assert (east - west) * 111_320 * np.cos(np.radians(41.525)) == pytest.approx(3.0, rel=0.01)


@pytest.mark.parametrize(
    "contact",
    [
        {"heading_deg": None},
        {"channel": None, "ground_range_m": None},
        {"pixel_along_m": None},
        {"lon_deg": 179.999999},
    ],
)
def test_image_of_unknown_orientation_has_no_overlay(tmp_path: Path, contact: dict[str, object]) -> None:
    data, _ = kmz_bytes(load_contacts(store(tmp_path, image(contact=contact))))
    names = zipfile.ZipFile(io.BytesIO(data)).namelist()
    assert not [n for n in names if n.startswith("overlays/")]
    assert [n for n in names if n.startswith("pictures/")]


def test_sixteen_bit_image_is_scaled_to_eight(tmp_path: Path) -> None:
    pixels = np.array([[0, 500, 1000]], np.uint16)
    data, _ = kmz_bytes(load_contacts(store(tmp_path, image(picture=Pixels.from_array(pixels)))))
    archive = zipfile.ZipFile(io.BytesIO(data))
    (name,) = (n for n in archive.namelist() if n.startswith("overlays/"))
    assert np.asarray(Image.open(io.BytesIO(archive.read(name)))).tolist() == [[0, 127, 255]]


def test_image_in_a_balloon_has_the_shape_of_the_seabed(tmp_path: Path) -> None:
    # 16 x 24 px of 0.25 m x 0.125 m: 4 m along, 3 m across the track.
    black = Pixels.from_array(np.zeros((16, 24), np.uint8))
    data, _ = kmz_bytes(load_contacts(store(tmp_path, image(picture=black), decision())))
    archive = zipfile.ZipFile(io.BytesIO(data))
    (name,) = (n for n in archive.namelist() if n.startswith("pictures/"))
    picture = np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("L"))
    # The strip with the scale bar below the image is white.
    height = int(np.argmax(picture[:, 5] > 250))
    assert (height, picture.shape[1]) == pytest.approx((240, 180), abs=3)
    assert picture.shape[0] > height + 15


# Cursor-on-Target


def test_cot_events_match_the_schema(contacts: ContactSet, schema: xmlschema.XMLSchema) -> None:
    events = cot_events(contacts, NOW_UTC_S)
    assert len(events) == 5
    for event in events:
        schema.validate(event.decode())


def test_cot_schema_rejects_invalid_events(contacts: ContactSet, schema: xmlschema.XMLSchema) -> None:
    event = cot_events(contacts, NOW_UTC_S)[0].decode()
    changes = (
        ('type="b-m-p-s-m"', 'type="b m"'),
        ('lat="41.', 'lat="141.'),
        (' how="m-i"', ""),
        ('ce="4.5"', 'ce="4e1"'),
    )
    for right, wrong in changes:
        assert right in event
        assert not schema.is_valid(event.replace(right, wrong))


@pytest.mark.parametrize(
    ("verdict", "mlo_class", "expected"),
    [
        (None, None, "b-m-p-s-m"),
        ("unsure", "bottom mine", "b-m-p-s-m"),
        ("not_mine_like", None, "a-u-U-N-B"),
        ("not_mine_like", "bottom mine", "a-u-U-N-B"),
        ("mine_like", None, "a-s-U-W-M"),
        ("mine_like", "Bottom_Mine", "a-s-U-W-M-G"),
        ("mine_like", " moored  MINE", "a-s-U-W-M-M"),
        ("mine_like", "drifting", "a-s-U-W-M-F"),
        ("mine_like", "cylinder", "a-s-U-W-M"),
        ("mine_like", "not a bottom mine", "a-s-U-W-M"),
    ],
)
def test_only_a_decision_gives_a_mine_type(verdict: str | None, mlo_class: str | None, expected: str) -> None:
    decisions = () if verdict is None else (decision(verdict=verdict, mlo_class=mlo_class),)
    (contact,) = single(image(contact={"atd_confidence": 2.0, "atd_class": "mine"}), *decisions).contacts
    assert cot_type(contact) == expected
    assert cot_type(contact, CotOptions(mine_affiliation="h")) == expected.replace("a-s-", "a-h-")


def attributes(event: bytes) -> tuple[dict[str, str], dict[str, str], str]:
    root = ET.fromstring(event)
    point = root.find("point")
    assert point is not None
    return dict(root.attrib), dict(point.attrib), root.findtext("detail/remarks") or ""


def test_cot_event_times_and_accuracy() -> None:
    (contact,) = single(image()).contacts
    event, point, remarks = attributes(cot_event(contact, NOW_UTC_S, CotOptions(stale_after_s=60.0)))
    assert (event["time"], event["start"], event["stale"]) == (
        "2016-10-12T10:00:01.250Z",
        "2016-10-12T10:00:01.250Z",
        "2016-10-12T10:01:01.250Z",
    )
    assert point == {"lat": "41.5251334", "lon": "-70.6712456", "hae": "9999999.0", "ce": "4.5", "le": "9999999.0"}
    assert "Seen 2016-10-12T08:59:50.500Z" in remarks
    (contact,) = single(image(contact={"position_sigma_m": None})).contacts
    assert attributes(cot_event(contact, NOW_UTC_S))[1]["ce"] == "9999999.0"


def test_tiny_coordinate_has_no_exponent(schema: xmlschema.XMLSchema) -> None:
    found = single(image(contact={"lat_deg": -0.00000012, "lon_deg": 1e-9}))
    event = cot_event(found.contacts[0], NOW_UTC_S)
    schema.validate(event.decode())
    assert attributes(event)[1]["lat"] == "-0.0000001"
    assert b"e-" not in kml_bytes(found).split(b"<coordinates>")[1].split(b"</")[0]


def test_contact_without_position_has_no_event() -> None:
    found = single(image(contact={"lat_deg": None, "lon_deg": None}))
    assert cot_events(found, NOW_UTC_S) == ()
    with pytest.raises(ValueError, match="no position"):
        cot_event(found.contacts[0], NOW_UTC_S)
    with pytest.raises(ValueError, match="stale_after_s"):
        CotOptions(stale_after_s=0)


def test_image_without_contact_record_has_no_position() -> None:
    found = single(image().model_copy(update={"contact": None}))
    assert (len(found.unlocated), cot_events(found, NOW_UTC_S)) == (1, ())
    assert geojson(found)["features"] == []


# Untrusted text

HOSTILE = st.text(
    st.one_of(st.characters(), st.sampled_from("<>&\"'=\x00\x08\x1b\x7f\x85\u2028\ufffe\ufdd0]]>%$[name]")), max_size=60
).filter(lambda text: not any("\ud800" <= c <= "\udfff" for c in text))


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(remark=HOSTILE, mlo_class=HOSTILE, operator=HOSTILE.filter(bool), note=HOSTILE)
def test_untrusted_text_is_escaped_in_all_formats(
    schema: xmlschema.XMLSchema, remark: str, mlo_class: str, operator: str, note: str
) -> None:
    found = single(
        image(notes=(note,)), decision(remark=remark, mlo_class=mlo_class, operator=operator, verdict="mine_like")
    )
    event = cot_events(found, NOW_UTC_S)[0]
    schema.validate(event.decode())
    assert b"\n" not in event.replace(b"\n", b"", remark.count("\n") + mlo_class.count("\n") + operator.count("\n"))
    remarks = attributes(event)[2]
    # XML readers normalise line ends.
    if "\r" not in remark + mlo_class + operator:
        assert remarks.endswith(f"Remark: {xml_text(remark)}" if remark else ".")
    root = ET.fromstring(kml_bytes(found))
    data = {d.get("name"): d.findtext(f"{KML}value") for d in root.iter(f"{KML}Data")}
    balloon = root.findtext(f".//{KML}Placemark/{KML}description") or ""
    if "\r" not in remark:
        assert data["remark"] == xml_text(remark)
        assert html_text(remark) in balloon
    assert set(re.findall(r"<(/?\w+)", balloon)) <= {"table", "/table", "tr", "/tr", "td", "/td"}
    properties = json.loads(geojson_bytes(found))["features"][0]["properties"]
    assert (properties["remark"], properties["notes"]) == (xml_text(remark), xml_text(note))
    rows = list(csv.reader(io.StringIO(csv_bytes(found).decode("utf-8-sig"), newline="")))
    assert [len(row) for row in rows] == [len(COLUMNS)] * 2


@given(st.text(st.characters(categories=None), max_size=40))
def test_xml_text_is_accepted_by_a_parser(text: str) -> None:
    assert ET.fromstring(f"<a>{html_text(text)}</a>") is not None
    xml_text(text).encode()
