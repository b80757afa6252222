"""Contacts received without acoustic authentication are marked in lists, versions, exports and the report."""

from __future__ import annotations

import sqlite3

import pytest
from builders.console import image_record

from sonarpost.services.console.store.contacts import ContactFilter, list_contacts
from sonarpost.services.console.store.database import Database

NUMBERS = {"0001": True, "0002": False, "0003": None}


@pytest.fixture
def watcher(console):
    for image_id, authenticated in NUMBERS.items():
        console.state.store_image(image_record(image_id).model_copy(update={"authenticated": authenticated}))
    return console.browser("watch")


def test_lists_and_versions_state_the_authentication(watcher):
    rows = watcher.get("/api/contacts").json()["items"]
    assert {row["image_id"]: row["authenticated"] for row in rows} == NUMBERS
    for row in rows:
        [version] = watcher.contact(row["id"])["versions"]
        assert version["authenticated"] == NUMBERS[row["image_id"]]


@pytest.mark.parametrize(
    ("name", "mark"),
    [
        ("contacts.csv", b",false" + b"," * 11 + b"\r\n"),
        ("contacts.geojson", b'"authenticated": false'),
        ("contacts.cot.xml", b"Unauthenticated: any modem in range"),
    ],
)
def test_exports_mark_the_unauthenticated_contact(watcher, name, mark):
    assert watcher.get(f"/api/export/{name}").content.count(mark) == 1


def test_report_states_the_authentication(watcher):
    rows = watcher.get("/api/contacts").json()["items"]
    marked = {row["image_id"] for row in rows if "UNAUTHENTICATED" in watcher.get(f"/report/{row['id']}").text}
    assert marked == {"0002"}


def test_a_later_version_replaces_the_mark(console, watcher):
    console.state.store_image(image_record("0002", 2).model_copy(update={"authenticated": True}))
    rows = watcher.get("/api/contacts").json()["items"]
    assert next(row["authenticated"] for row in rows if row["image_id"] == "0002") is True


@pytest.mark.parametrize("column", ["authenticated", "despeckle_strength"])
def test_database_of_an_earlier_version_gains_the_column(column, tmp_path):
    path = tmp_path / "console-review.db"
    Database(path).close()
    old = sqlite3.connect(path)
    old.execute(f"ALTER TABLE contact DROP COLUMN {column}")
    old.commit()
    old.close()
    database = Database(path)
    with database.read() as db:
        assert list_contacts(db, ContactFilter())["matching"] == 0
        assert column in {row["name"] for row in db.execute("PRAGMA table_info(contact)")}
    database.close()
    Database(path).close()
