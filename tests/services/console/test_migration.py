"""Databases of earlier versions are opened, and gain what they lack."""

from __future__ import annotations

import sqlite3
from contextlib import closing

import pytest
from builders.console import PASSWORD

from sonarpost.services.console.store.contacts import ContactFilter, list_contacts
from sonarpost.services.console.store.database import DATABASE_NAME, Database
from sonarpost.services.console.store.measurements import list_measurements
from sonarpost.services.console.store.tracks import tracks_json
from sonarpost.services.console.store.users import FILE_NAME, Users


@pytest.mark.parametrize(
    ("table", "columns", "dropped"),
    [
        ("contact", ("authenticated",), ()),
        ("contact", ("despeckle_strength", "p_mine_like", "p_other_object"), ()),
        ("contact", ("heading_deg",), ()),
        ("contact", ("pixel_along_m",), ()),
        ("contact", ("parent", "relation"), ("INDEX contact_answers", "INDEX contact_listed")),
        ("request", ("result_bytes",), ("INDEX contact_answers", "INDEX contact_listed")),
        ("decision", ("send_after_utc_s", "overrules"), ("TABLE notice", "INDEX decision_operator")),
        ("measurement", ("withdrawn_by", "withdrawn_utc_s"), ("TABLE track",)),
    ],
)
def test_database_of_an_earlier_version_gains_columns_tables_and_indexes(table, columns, dropped, tmp_path):
    path = tmp_path / DATABASE_NAME

    def schema():
        with closing(sqlite3.connect(path)) as db:
            names = {row[0] for row in db.execute("SELECT name FROM sqlite_master")}
            return names, {row[1]: row[2] for row in db.execute(f"PRAGMA table_info({table})")}

    Database(path).close()
    present = schema()
    with closing(sqlite3.connect(path)) as old:
        for name in dropped:
            old.execute(f"DROP {name}")
        for column in columns:
            old.execute(f"ALTER TABLE {table} DROP COLUMN {column}")
        if table == "measurement":
            old.execute("INSERT INTO measurement (contact_id, utc_s, body) VALUES ('c', 0, '{}')")
        old.commit()
    assert schema() != present
    database = Database(path)
    with database.read() as db:
        assert list_contacts(db, ContactFilter())["matching"] == 0
        assert tracks_json(db) == []
        for found in list_measurements(db, "c"):
            assert (found["withdrawn_by"], found["withdrawn_utc_s"]) == (None, None)
    database.close()
    assert schema() == present
    Database(path).close()


def test_users_file_of_an_earlier_version_opens(tmp_path):
    users = Users(tmp_path / FILE_NAME)
    users.add("anna", "operator", PASSWORD)
    users.close()
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db:
        db.execute("DROP TABLE link")
        db.execute("DROP TABLE setting")
    users = Users(tmp_path / FILE_NAME)
    users.store_settings("anna", {"theme": "night"})
    assert users.settings("anna") == {"theme": "night"}
    assert users.use_login_link(users.make_login_link("anna")) == ("valid", "anna")
    users.close()
