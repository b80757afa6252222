"""The files of the console in SQLite: their schema versions."""

import re
import sqlite3
from contextlib import closing

import pytest

from sonarpost.errors import DeliveryError
from sonarpost.services.console.store.database import Database
from sonarpost.services.console.store.users import Users


@pytest.mark.parametrize(("opened", "found", "expected"), [(Database, 1, 2), (Users, 0, 1)])
def test_file_of_another_schema_version_is_refused_and_left_unchanged(opened, found, expected, tmp_path):
    path = tmp_path / "file.db"
    opened(path).close()
    opened(path).close()
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA user_version").fetchone() == (expected,)
        db.execute(f"PRAGMA user_version = {found}")
        schema = db.execute("SELECT * FROM sqlite_master").fetchall()
    with pytest.raises(DeliveryError, match=re.escape(f"{path}: schema version {found}, expected {expected}: ")):
        opened(path)
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("SELECT * FROM sqlite_master").fetchall() == schema
