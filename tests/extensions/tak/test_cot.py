"""Cursor-on-Target events: agreement with their schema, golden files, untrusted text."""

import dataclasses
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
import xmlschema
from builders.common import GOLDEN_FOLDER
from builders.console import image_record
from builders.exports import FIRST_UTC_S, HOSTILE, MISSIONS, decision, export, image, mission, single
from hypothesis import given

from sonarpost.export.contacts import load_contacts
from sonarpost.export.text import xml_text
from sonarpost.extensions.tak.cot import cot_event, cot_events, cot_type
from sonarpost.review.measurement import MeasuredSize

NOW_UTC_S = FIRST_UTC_S + 3600


@pytest.fixture(scope="module")
def schema():
    return xmlschema.XMLSchema(Path(__file__).with_name("cot_event.xsd"))


@pytest.fixture
def contacts(tmp_path):
    return load_contacts(mission(tmp_path / "out"))


MARKS = {
    "classified": (
        b"Detector's class mine-like. Detector: mine-like 85 %, other object 10 %, seabed 5 %.",
        b"Detector's class structure. Detector's confidence",
        b"Z. Water depth 15.8 m. Detector: mine-like 50 %, other object 25 %, seabed 25 %.",
    ),
    "authenticated": (b"Unauthenticated: any modem in range",),
    "reviewed.geojson": (b'"review": "unreviewed"', b'"withdrawn_by": "anna"', b'"review": "disputed"'),
    "reviewed.kml": (
        b"#unreviewed<",
        b'<Data name="withdrawn_by">\n      <value>anna<',
        b"Disputed (1)",
        b"#disputed<",
    ),
    "reviewed": (
        b"Sonar contact, not reviewed.",
        b"Decision withdrawn by anna.",
        b"Disputed, counts as mine-like.",
        b"Verdicts: anna mine-like, ben not mine-like.",
    ),
}
"""What a golden file contains once."""


@pytest.mark.parametrize("mission_name", MISSIONS)
def test_events_equal_the_golden_file(tmp_path, mission_name):
    events = cot_events(load_contacts(MISSIONS[mission_name](tmp_path)), NOW_UTC_S)
    output = b"\n".join(events) + b"\n"
    assert output == (GOLDEN_FOLDER / "export" / f"{mission_name}.cot").read_bytes()
    assert {mark: output.count(mark) for mark in MARKS.get(mission_name, ())} == dict.fromkeys(
        MARKS.get(mission_name, ()), 1
    )


def test_file_has_the_events_of_contacts_with_a_position(contacts, schema):
    events = ET.fromstring(export("cot.xml", contacts))
    assert (events.tag, len(events)) == ("events", 5)
    for event in events:
        schema.validate(event)


def test_event_states_the_measurements_of_operators():
    (contact,) = single(image()).contacts
    size = MeasuredSize(length_m=1.2345, length_sigma_m=0.06, height_m=0.5, height_sigma_m=0.125)
    event = cot_event(dataclasses.replace(contact, size=size), NOW_UTC_S).decode()
    assert "Measured: L 1.23 ± 0.06 m, H 0.50 ± 0.12 m." in event


def test_console_offers_the_format(console):
    console.state.store_image(image_record())
    anna = console.browser("anna")
    assert anna.get("/api/info").json()["exports"]["cot.xml"] == "Cursor-on-Target (TAK)"
    answer = anna.get("/api/export/contacts.cot.xml")
    assert (answer.headers["content-type"], [child.tag for child in ET.fromstring(answer.content)]) == (
        "application/xml",
        ["event"],
    )


def test_cot_events_match_the_schema(contacts, schema):
    events = cot_events(contacts, NOW_UTC_S)
    assert len(events) == 5
    for event in events:
        schema.validate(event.decode())
    # The schema rejects invalid events.
    event = events[0].decode()
    changes = (
        ('type="b-m-p-s-m"', 'type="b m"'),
        ('lat="41.', 'lat="141.'),
        (' how="m-i"', ""),
        ('ce="4.5"', 'ce="4e1"'),
    )
    for right, wrong in changes:
        assert right in event
        assert not schema.is_valid(event.replace(right, wrong))


def test_only_a_decision_gives_a_mine_type():
    for verdict, mlo_class, expected in (
        (None, None, "b-m-p-s-m"),
        ("unsure", "bottom mine", "b-m-p-s-m"),
        ("not_mine_like", "bottom mine", "a-u-U-N-B"),
        ("mine_like", None, "a-s-U-W-M"),
        ("mine_like", "Bottom_Mine", "a-s-U-W-M-G"),
        ("mine_like", " moored  MINE", "a-s-U-W-M-M"),
        ("mine_like", "drifting", "a-s-U-W-M-F"),
        ("mine_like", "not a bottom mine", "a-s-U-W-M"),
    ):
        decisions = () if verdict is None else (decision(verdict=verdict, mlo_class=mlo_class),)
        (contact,) = single(image(contact={"atd_confidence": 2.0, "atd_class": "mine"}), *decisions).contacts
        assert cot_type(contact) == expected


def attributes(event):
    root = ET.fromstring(event)
    point = root.find("point")
    return dict(root.attrib), dict(point.attrib), root.findtext("detail/remarks") or ""


def test_cot_event_times_and_accuracy():
    (contact,) = single(image()).contacts
    event, point, remarks = attributes(cot_event(contact, NOW_UTC_S))
    times = ["2016-10-12T10:00:01.250Z", "2016-10-12T10:00:01.250Z", "2016-10-13T10:00:01.250Z"]
    assert [event[name] for name in ("time", "start", "stale")] == times
    assert point == {"lat": "41.5251334", "lon": "-70.6712456", "hae": "9999999.0", "ce": "4.5", "le": "9999999.0"}
    assert "Seen 2016-10-12T08:59:50.500Z" in remarks
    (contact,) = single(image(contact={"position_sigma_m": None})).contacts
    assert attributes(cot_event(contact, NOW_UTC_S))[1]["ce"] == "9999999.0"


def test_tiny_coordinate_has_no_exponent(schema):
    found = single(image(contact={"lat_deg": -0.00000012, "lon_deg": 1e-9}))
    event = cot_event(found.contacts[0], NOW_UTC_S)
    schema.validate(event.decode())
    assert attributes(event)[1]["lat"] == "-0.0000001"


def test_contact_without_position_has_no_event():
    found = single(image(contact={"lat_deg": None, "lon_deg": None}))
    assert cot_events(found, NOW_UTC_S) == ()
    found = single(image().model_copy(update={"contact": None}))
    assert (len(found.unlocated), cot_events(found, NOW_UTC_S)) == (1, ())


@given(remark=HOSTILE, mlo_class=HOSTILE, operator=HOSTILE.filter(bool), note=HOSTILE)
def test_untrusted_text_is_escaped(schema, remark, mlo_class, operator, note):
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
