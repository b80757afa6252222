"""Database of an archive: transactions, creation of the tables, and what SQLite and PostgreSQL do differently."""

from __future__ import annotations

import secrets
import sqlite3
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, ClassVar, Final

import sqlalchemy as sa
from sqlalchemy.dialects import sqlite
from typing_extensions import override

from sonarpost.archive.rows import FILE_NAME
from sonarpost.archive.schema import ARCHIVE, METADATA, VERSION
from sonarpost.errors import ConfigError, StoredFileError
from sonarpost.files import make_private

BUSY_S: Final = 10.0
MAX_SEARCH_S: Final = 5.0
"""A search that takes more processor time is ended with an error."""
_STEPS: Final = 10_000
"""Instructions of SQLite between two checks of that time."""


class ShoreDatabase(ABC):
    """Transactions for several threads. The tables are created, or their version is compared, in the first one.

    Args:
        where: File or address, for errors.
        engine: Connections; an error of a statement is raised as `failed` returns it.
        site: Name of the site, stored at the first use and compared afterwards; empty for any.
        writable: Whether to create the tables.

    Attributes:
        is_shared: Whether several c2 use the database.
        fault: Why it cannot be used at present; empty if it can.
        is_new: Whether this object has created the tables.
    """

    is_shared: ClassVar[bool]

    def __init__(self, where: str, engine: sa.Engine, *, site: str, writable: bool) -> None:
        self.where = where
        self.fault = ""
        self.is_new = False
        self.writable = writable
        self._engine = engine
        self._site = site
        self._is_prepared = False
        self._prepare_lock = threading.RLock()
        self._is_closed = False
        sa.event.listens_for(engine, "handle_error")(self._on_error)
        sa.event.listens_for(engine, "checkin")(self._on_checkin)

    def prepare(self) -> None:
        """Create the tables, or check their version.

        Raises:
            StoredFileError: They have another version, or there are none and the database is not `writable`.
            ConfigError: The database belongs to another site, or there is no driver.
            OSError, DatabaseUnavailableError: It cannot be reached.
        """
        with self._prepare_lock:
            if self._is_prepared:
                return
            with self._begin(writing=self.writable) as sql:
                exists = self.has_tables(sql)
                if not exists and self.writable:
                    METADATA.create_all(sql, checkfirst=False)
                    identity = secrets.token_hex(4)
                    sql.execute(sa.insert(ARCHIVE).values(version=VERSION, identity=identity, last_seq=0))
                    self.is_new = True
                elif (version := sql.execute(sa.select(ARCHIVE.c.version)).scalar_one() if exists else 0) != VERSION:
                    raise StoredFileError(self.where, "version", version, str(VERSION))
                if self._site and self.writable:
                    sql.execute(sa.update(ARCHIVE).where(ARCHIVE.c.site.is_(None)).values(site=self._site))
                    stored = sql.execute(sa.select(ARCHIVE.c.site)).scalar_one()
                    if stored != self._site:
                        raise ConfigError(self.where, "site", self._site, f"{stored}, the site of this database")
            self._is_prepared = True

    @contextmanager
    def transaction(self, *, writing: bool = True) -> Iterator[sa.Connection]:
        """Open a transaction, which is committed at the end of the block and rolled back after an exception.

        Raises:
            OSError, DatabaseUnavailableError: It cannot be used at present. Whether a failed commit has taken effect is
                unknown.
        """
        if self._is_closed:
            raise self.unavailable(f"{self.where}: closed")
        try:
            self.prepare()
        except (StoredFileError, ConfigError) as error:
            # Reported at the start; a database that was replaced since then is an outage.
            self.fault = str(error)
            raise self.unavailable(str(error)) from error
        with self._begin(writing=writing) as sql:
            yield sql

    @contextmanager
    def _begin(self, *, writing: bool) -> Iterator[sa.Connection]:
        with self.begin(writing=writing) as sql:
            yield sql
        self.fault = ""

    @contextmanager
    def search(self) -> Iterator[sa.Connection]:
        """Open a transaction for reading, in which a statement that takes too long is ended.

        Raises:
            OSError, DatabaseUnavailableError: As `transaction`, or the search has taken too long.
        """
        with self.transaction(writing=False) as sql, self.limited(sql):
            yield sql

    def close(self) -> None:
        """Close the connections; those of open transactions are closed at their end."""
        self._is_closed = True
        self._engine.dispose()

    def _on_checkin(self, _connection: object, record: sa.pool.ConnectionPoolEntry) -> None:
        if self._is_closed:
            record.invalidate()

    def _on_error(self, context: sa.engine.ExceptionContext) -> Exception | None:
        error = context.original_exception
        return self.failed(context, error) if isinstance(error, (self.driver_error(), OSError)) else None

    # What the dialects do differently

    @abstractmethod
    def insert(self, table: sa.Table) -> Any:  # noqa: ANN401 - of the dialect
        """Return an INSERT statement, which has `on_conflict_do_update`."""

    @abstractmethod
    def put(self, sql: sa.Connection, statement: Any, rows: Sequence[Mapping[str, Any]]) -> int:  # noqa: ANN401
        """Run an INSERT statement for several rows; return how many were written."""

    @abstractmethod
    def begin(self, *, writing: bool) -> AbstractContextManager[sa.Connection]:
        """Open a transaction."""

    @abstractmethod
    def has_tables(self, sql: sa.Connection) -> bool:
        """Return whether the tables exist; create what they need if they do not."""

    @abstractmethod
    def limited(self, sql: sa.Connection) -> AbstractContextManager[None]:
        """Limit the time of the statements in the block."""

    @abstractmethod
    def now_utc_s(self, sql: sa.Connection) -> float:
        """Return the time of a clock that all c2 of the site have."""

    @abstractmethod
    def driver_error(self) -> type[Exception]:
        """Return the base class of the errors of the driver."""

    @abstractmethod
    def failed(self, context: sa.engine.ExceptionContext, error: BaseException) -> Exception | None:
        """Return the error for one of the driver; None for that of an idle connection, which is opened again."""

    @abstractmethod
    def unavailable(self, reason: str) -> Exception:
        """Return the error for a database that cannot be used at present."""


class SqliteDatabase(ShoreDatabase):
    """The file `archive.db` in one folder.

    Args:
        out_dir: The folder.
        site: See `ShoreDatabase`.
        writable: Whether to create the file; otherwise it is opened read-only.

    Raises:
        OSError: The folder cannot be created.
    """

    is_shared = False

    def __init__(self, out_dir: Path, *, site: str = "", writable: bool = True) -> None:
        self.path = out_dir / FILE_NAME
        self._lock = threading.RLock()
        # One connection for each thread that reads at the same time; those that write wait for the lock.
        engine = sa.create_engine(
            "sqlite://",
            creator=self._connect,
            poolclass=sa.QueuePool,
            pool_size=4,
            max_overflow=-1,
            pool_reset_on_return=None,  # `begin` ends every transaction
        )
        super().__init__(str(self.path), engine, site=site, writable=writable)

    def _connect(self) -> sqlite3.Connection:
        if self.writable:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            make_private(self.path)
        elif not self.path.is_file():
            raise StoredFileError(str(self.path), "", "no such file", "the archive in the out_dir of c2")
        uri = f"{self.path.absolute().as_uri()}?mode={'rwc' if self.writable else 'ro'}"
        db = sqlite3.connect(uri, uri=True, check_same_thread=False, isolation_level=None, timeout=BUSY_S)
        if self.writable:
            try:
                db.execute("PRAGMA journal_mode=WAL")
                # A number that was published must not be given to another record after a power cut.
                db.execute("PRAGMA synchronous=FULL")
            except sqlite3.Error as error:
                db.close()
                raise self._error(error) from error
        return db

    @override
    def insert(self, table: sa.Table) -> Any:
        return sqlite.insert(table)

    @override
    def put(self, sql: sa.Connection, statement: Any, rows: Sequence[Mapping[str, Any]]) -> int:
        return sql.execute(statement, rows).rowcount

    @override
    @contextmanager
    def begin(self, *, writing: bool) -> Iterator[sa.Connection]:
        with self._lock if writing else nullcontext(), self._engine.begin() as sql:
            sql.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")
            yield sql

    @override
    def has_tables(self, sql: sa.Connection) -> bool:
        return bool(sql.exec_driver_sql("SELECT 1 FROM sqlite_master WHERE name = 'archive'").first())

    @override
    @contextmanager
    def limited(self, sql: sa.Connection) -> Iterator[None]:
        db = sql.connection.driver_connection
        assert isinstance(db, sqlite3.Connection)
        end_s = time.thread_time() + MAX_SEARCH_S
        db.set_progress_handler(lambda: time.thread_time() > end_s, _STEPS)
        try:
            yield
        finally:
            db.set_progress_handler(None, 0)

    @override
    def now_utc_s(self, sql: sa.Connection) -> float:
        return time.time()

    @override
    def driver_error(self) -> type[Exception]:
        return sqlite3.Error

    @override
    def failed(self, context: sa.engine.ExceptionContext, error: BaseException) -> Exception:
        return self._error(error)

    def _error(self, error: BaseException) -> Exception:
        is_other_file = type(error) is sqlite3.DatabaseError or not self.writable
        if isinstance(error, sqlite3.DatabaseError) and is_other_file and not self._is_prepared:
            return StoredFileError(str(self.path), "", str(error), "the archive in the out_dir of c2")
        return self.unavailable(f"{self.path}: {error}")

    @override
    def unavailable(self, reason: str) -> Exception:
        return OSError(reason)
