"""GeoPackage of contacts."""

import sqlite3
import struct
import subprocess
import xml.etree.ElementTree as ET
from contextlib import closing

import pytest
from builders import gdal
from builders.exports import mission

from sonarpost.export.contacts import load_contacts
from sonarpost.export.formats import write_export
from sonarpost.export.tables import COLUMNS, contact_properties


def test_rows_hold_properties_points_and_images(tmp_path):
    contacts = load_contacts(mission(tmp_path / "out"))
    path = tmp_path / "contacts.gpkg"
    assert write_export("gpkg", path, contacts) == []
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert db.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        names = ", ".join(f'"{name}"' for name in COLUMNS)
        rows = db.execute(f"SELECT geom, image, {names} FROM contacts ORDER BY fid").fetchall()
        style = db.execute("SELECT styleQML FROM layer_styles WHERE f_table_name = 'contacts'").fetchone()[0]
    states = [category.get("value") for category in ET.fromstring(style).iter("category")]
    assert sorted(map(str, states)) == ["disputed", "mine_like", "not_mine_like", "unreviewed", "unsure"]
    assert '<prop k="color" v="224,0,0,255"/>' in style  # mine-like, as in KML
    assert len(rows) == len(contacts.contacts) > 0
    for (geom, image, *values), contact in zip(rows, contacts.contacts, strict=True):
        assert values == list(contact_properties(contact).values())
        assert image == (contact.image_path.read_bytes() if contact.image_path else None)
        point = None if geom is None else struct.unpack("<dd", geom[-16:])[::-1]
        assert point == contact.position
    assert sorted(p.name for p in tmp_path.iterdir()) == ["contacts.gpkg", "out"]
    # An unreadable image is reported.
    lost = next(c.image_path for c in contacts.contacts if c.image_path)
    lost.unlink()
    problems = write_export("gpkg", tmp_path / "other.gpkg", contacts)
    assert [str(lost) in str(problem) for problem in problems] == [True]


@gdal.needs_ogr
def test_ogr_reads_the_layer(tmp_path):
    contacts = load_contacts(mission(tmp_path / "out"))
    path = tmp_path / "contacts.gpkg"
    write_export("gpkg", path, contacts)
    result = subprocess.run(["ogrinfo", "-so", path, "contacts"], capture_output=True, text=True, check=True)
    assert f"Feature Count: {len(contacts.contacts)}" in result.stdout
    assert "Geometry: Point" in result.stdout


def test_full_disk_leaves_the_former_file(tmp_path, monkeypatch):
    contacts = load_contacts(mission(tmp_path / "out"))
    path = tmp_path / "contacts.gpkg"
    path.write_bytes(b"former")

    def full(*_):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr("sonarpost.export.geo.geopackage._point", full)
    with pytest.raises(OSError, match="disk is full"):
        write_export("gpkg", path, contacts)
    assert path.read_bytes() == b"former"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["contacts.gpkg", "out"]
