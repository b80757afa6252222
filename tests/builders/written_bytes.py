"""Bytes that a service writes into its store."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable

from sonarpost.delivery.store import Store


def written_bytes(store: Store, action: Callable[[], object]) -> int:
    """Return the bytes that SQLite appends to the write-ahead log of a store during `action`."""
    log_file = store.path.with_name(f"{store.path.name}-wal")
    connection = sqlite3.connect(store.path)
    assert connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone() == (0, 0, 0)
    connection.close()
    action()
    return log_file.stat().st_size
