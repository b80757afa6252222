"""The durable store's file: how it is written, one process at a time, closed, of another version, no store at all."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from builders.store_steps import send

from sonarpost.delivery.store import Store
from sonarpost.errors import DeliveryError


def test_a_closed_store_says_so(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.db")
    store.close()
    with pytest.raises(DeliveryError, match="closed"), store.transaction():
        pass


def test_records_are_on_the_disk_when_a_transaction_ends(store: Store) -> None:
    """FULL (2) makes SQLite wait for the disk at each commit of a write-ahead log; NORMAL (1) does not."""
    assert store._query("PRAGMA synchronous") == [(2,)]
    assert store._query("PRAGMA journal_mode") == [("wal",)]


def test_a_store_belongs_to_one_process_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    script = f"from pathlib import Path; from sonarpost.delivery.store import Store; Store(Path({str(path)!r}))"
    store = Store(path)
    other = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "DeliveryError" in other.stderr
    assert "in use by another process" in other.stderr
    send(store, b"still mine")
    store.close()
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, check=False).returncode == 0


def test_a_file_that_is_no_store_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    path.write_bytes(b"not a database, but somebody's file" * 100)
    before = path.read_bytes()
    with pytest.raises(DeliveryError, match=r"s\.db: cannot be opened as a sonarpost store"):
        Store(path)
    assert path.read_bytes() == before


def test_a_store_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    Store(path).close()
    with sqlite3.connect(path) as db:
        db.execute("UPDATE meta SET value = ? WHERE name = 'version'", (b"99",))
    db.close()
    with pytest.raises(DeliveryError, match="store version b'99', expected 2"):
        Store(path)


def test_a_folder_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "s.db").mkdir()
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "s.db", tmp_path / "file" / "s.db"):
        with pytest.raises(DeliveryError, match=str(path)):
            Store(path)


def test_reading_a_closed_store_says_so(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.db")
    store.close()
    with pytest.raises(DeliveryError, match="closed"):
        store.owed("c", 1)


def test_what_is_deleted_is_not_written_once_more(store: Store) -> None:
    assert store._query("PRAGMA secure_delete") == [(0,)]
