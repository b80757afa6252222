"""File of the durable store: write mode, exclusive use, closed, other versions, other files."""

import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from builders.store_steps import queued_items, send

from sonarpost.delivery.store import Store
from sonarpost.errors import DeliveryError


def test_closed_store_raises(store):
    store.close()
    with pytest.raises(DeliveryError, match="closed"), store.transaction():
        pass
    with pytest.raises(DeliveryError, match="closed"):
        queued_items(store, "c", 1)


def test_commit_waits_for_the_disk_and_deleted_records_are_not_overwritten(store):
    """FULL (2) makes SQLite wait for the disk at each commit of a write-ahead log; NORMAL (1) does not."""
    settings = [store._query(f"PRAGMA {name}")[0][0] for name in ("synchronous", "journal_mode", "secure_delete")]
    assert settings == [2, "wal", 0]
    for durable in (False, True):
        with store.transaction(durable=durable) as tx:
            tx.put_state("name", b"")
        assert store._query("PRAGMA synchronous") == [(1 + durable,)]


def test_store_is_locked_by_one_process(store):
    script = f"from pathlib import Path; from sonarpost.delivery.store import Store; Store(Path({str(store.path)!r}))"
    other = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "DeliveryError" in other.stderr
    assert "in use by another process" in other.stderr
    send(store, b"still mine")
    store.close()
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, check=False).returncode == 0


def test_other_file_is_rejected_and_unchanged(tmp_path):
    path = tmp_path / "s.db"
    path.write_bytes(b"not a database, but another file" * 100)
    before = path.read_bytes()
    with pytest.raises(DeliveryError, match=r"s\.db: cannot be opened as a sonarpost store") as error:
        Store(path)
    assert error.tb is not None  # keeps the store alive: nothing was closed by the garbage collector
    assert path not in [link.readlink() for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    assert path.read_bytes() == before


@pytest.mark.parametrize("version", [b"3", b"5"])
def test_store_of_another_version_is_rejected_and_unchanged(version, open_store, tmp_path):
    path = tmp_path / "s.db"
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("CREATE TABLE meta (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID")
        db.execute("INSERT INTO meta VALUES ('version', ?)", (version,))
    with pytest.raises(DeliveryError, match=f"s.db: store version {version!r}, expected 4"):
        open_store(page_bytes=512)
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall() == [("meta",)]
        assert db.execute("PRAGMA page_size").fetchone() == (4096,)


def test_error_names_a_path_that_is_not_a_folder(tmp_path):
    (tmp_path / "s.db").mkdir()
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "s.db", tmp_path / "file" / "s.db"):
        with pytest.raises(DeliveryError, match=str(path)):
            Store(path)


def test_store_keeps_the_page_size_with_which_it_was_made(store, open_store):
    send(store, b"queued")
    store.close()
    store = open_store(page_bytes=512)
    assert store._query("PRAGMA page_size") == [(4096,)]
    assert [item.payload for item in queued_items(store, "c", 9)] == [b"queued"]
