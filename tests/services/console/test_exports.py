"""Exports and the printable report."""

from __future__ import annotations

import csv
import io
import zipfile
from xml.etree import ElementTree as ET

from builders.console import image_record

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"


def test_exports_contain_the_filtered_contacts(console):
    console.state.store_image(image_record("0001"))
    console.state.store_image(image_record("0002", vehicle="uuv-2", position=None))
    anna = console.browser("anna")
    anna.decide("sonarpost.vessel-1.uuv-1.20231114T221320Z.0001")
    table = anna.get("/api/export/contacts.csv")
    assert "attachment" in table.headers["content-disposition"]
    rows = list(csv.DictReader(io.StringIO(table.content.decode("utf-8-sig"))))
    assert {row["name"]: row["review"] for row in rows} == {"uuv-1/0001": "mine_like", "uuv-2/0002": "unreviewed"}
    only = anna.get("/api/export/contacts.geojson", review="mine_like").json()
    assert [feature["properties"]["name"] for feature in only["features"]] == ["uuv-1/0001"]
    assert only["unlocated"] == []
    with zipfile.ZipFile(io.BytesIO(anna.get("/api/export/contacts.kmz").content)) as archive:
        assert any(name.endswith(".kml") for name in archive.namelist())
        assert any(name.endswith(".png") for name in archive.namelist())
    events = ET.fromstring(anna.get("/api/export/contacts.cot.xml").content)
    assert (events.tag, [child.tag for child in events]) == ("events", ["event"])
    assert anna.get("/api/export/contacts.exe").status_code == 404


def test_report_shows_known_and_unknown_values(console):
    console.state.store_image(image_record(missing_rows=10, altitude_m=None))
    anna = console.browser("anna")
    anna.decide(ID)
    page = anna.get(f"/report/{ID}").text
    assert "data:image/png;base64," in page
    assert "25.0 % (black in the image)" in page
    assert '<dt>Altitude of the vehicle, m</dt><dd><span class="missing">unknown</span></dd>' in page
    assert "clean edge" in page
    assert "style=" not in page
