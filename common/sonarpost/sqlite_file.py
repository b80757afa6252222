"""An SQLite file of one process or several: how it is opened, read and written."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sonarpost.errors import DeliveryError, RejectedByDatabaseError
from sonarpost.files import make_private

BUSY_TIMEOUT_S = 10.0
"""Time for which a statement waits for the transaction of another process."""


class SqliteFile:
    """An SQLite file that only its owner can read, shared by several threads, with one transaction at a time.

    Args:
        path: The file; its folder is made.
        schema: SQL that creates the tables of a new file, also if another process does so at the same time.
        version: Schema version.

    Raises:
        DeliveryError: The file cannot be opened, is damaged, or has another schema version.
    """

    def __init__(self, path: Path, schema: str, version: int) -> None:
        self.path = path
        self._lock = threading.RLock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            make_private(path)
            self._db = sqlite3.connect(path, check_same_thread=False, isolation_level=None, timeout=BUSY_TIMEOUT_S)
            try:
                self._prepare(schema, version)
            except BaseException:
                self._db.close()
                raise
        except (OSError, sqlite3.Error) as error:
            raise DeliveryError(f"{path}: cannot be opened as an SQLite file: {error}") from error

    def _prepare(self, schema: str, version: int) -> None:
        self._db.row_factory = sqlite3.Row
        self._db.execute("PRAGMA journal_mode=WAL")
        self._db.execute("PRAGMA synchronous=FULL")
        [is_new] = self._db.execute("SELECT COUNT(*) = 0 FROM sqlite_master").fetchone()
        [found] = self._db.execute("PRAGMA user_version").fetchone()
        if is_new:
            self._db.executescript(f"BEGIN IMMEDIATE; {schema} PRAGMA user_version={version}; COMMIT;")
        elif found != version:
            remedy = "written by another version of sonarpost; move it away to start with an empty file"
            raise DeliveryError(f"{self.path}: schema version {found}, expected {version}: {remedy}")

    @contextmanager
    def read(self) -> Iterator[sqlite3.Connection]:
        """Return the connection for reading.

        Raises:
            DeliveryError: The file cannot be read.
            RejectedByDatabaseError: A value of a statement violates a constraint or is too large.
        """
        with self._lock:
            try:
                yield self._db
            except (sqlite3.DataError, sqlite3.IntegrityError) as error:
                raise RejectedByDatabaseError(f"{self.path}: {error}") from error
            except sqlite3.Error as error:
                raise DeliveryError(f"{self.path}: {error}") from error

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Run the block in a transaction: committed to disk at its end, rolled back after an exception.

        Raises:
            DeliveryError: The transaction failed, for example because of a full disk, and was rolled back.
        """
        # The connection commits at the end of its block, and rolls back after an exception.
        with self.read() as db, db:
            db.execute("BEGIN IMMEDIATE")
            yield db

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()
