"""The console shows class and probabilities of contacts, and nothing where they are not known."""

from __future__ import annotations

import sqlite3
from contextlib import closing

import pytest
from builders.console import image_record

from sonarpost.services.console.store.database import Database

CLASSES = {
    "0001": {"atd_class": "mine-like", "p_mine_like": 0.85, "p_other_object": 0.1},
    "0002": {"atd_class": "structure", "p_mine_like": 0.0, "p_other_object": 0.95},
    "0003": {"atd_class": "structure", "p_mine_like": None, "p_other_object": None},
    "0004": {"atd_class": None, "p_mine_like": None, "p_other_object": None},
}


@pytest.fixture
def watcher(console):
    for image_id, fields in CLASSES.items():
        console.state.store_image(image_record(image_id, **fields))
    console.state.store_image(image_record("0005").model_copy(update={"contact": None}))
    return console.browser("watch")


def test_rows_and_records_state_class_and_probabilities(watcher):
    rows = {row["image_id"]: row for row in watcher.get("/api/contacts").json()["items"]}
    for image_id, fields in (CLASSES | {"0005": CLASSES["0004"]}).items():
        assert {name: rows[image_id][name] for name in fields} == fields
        record = watcher.contact(rows[image_id]["id"])["record"]
        assert record is None if image_id == "0005" else {name: record[name] for name in fields} == fields


def test_map_states_the_class(watcher):
    found = {one["name"].rpartition("/")[2]: one["atd_class"] for one in watcher.get("/api/map").json()["contacts"]}
    assert found == {image_id: fields["atd_class"] for image_id, fields in CLASSES.items()}


def test_structures_are_found_by_text(watcher):
    rows = watcher.get("/api/contacts?q=structure").json()["items"]
    assert {row["image_id"] for row in rows} == {"0002", "0003"}


def test_report_states_class_and_probabilities(watcher):
    unknown = '<span class="missing">unknown</span>'
    found = {}
    for row in watcher.get("/api/contacts").json()["items"]:
        text = watcher.get(f"/report/{row['id']}").text
        found[row["image_id"]] = [
            text.partition(f"<dt>{label}</dt><dd>")[2].partition("</dd>")[0]
            for label in ("Class of the detector", "Probabilities of the detector")
        ]
    assert found == {
        "0001": ["mine-like", "mine-like 85 %, other object 10 %, seabed 5 %"],
        "0002": ["structure", "mine-like 0 %, other object 95 %, seabed 5 %"],
        "0003": ["structure", unknown],
        "0004": [unknown, unknown],
        "0005": ["", ""],  # without a contact record, the rows are left out
    }


def test_later_version_replaces_the_class(console, watcher):
    console.state.store_image(image_record("0001", 2, **CLASSES["0002"]))
    [row] = [row for row in watcher.get("/api/contacts").json()["items"] if row["image_id"] == "0001"]
    assert {name: row[name] for name in CLASSES["0002"]} == CLASSES["0002"]


def test_database_of_an_earlier_version_gains_the_columns(tmp_path):
    path = tmp_path / "console-review.db"
    Database(path).close()
    with closing(sqlite3.connect(path)) as db, db:
        for column in ("despeckle_strength", "p_mine_like", "p_other_object"):
            db.execute(f"ALTER TABLE contact DROP COLUMN {column}")
    Database(path).close()
    with closing(sqlite3.connect(path)) as db:
        columns = {row[1]: row[2] for row in db.execute("PRAGMA table_info(contact)")}
    assert {columns[name] for name in ("despeckle_strength", "p_mine_like", "p_other_object")} == {"REAL"}
