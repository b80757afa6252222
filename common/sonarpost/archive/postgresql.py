"""An archive in a PostgreSQL server: connections, reconnection with back-off.

The driver is pg8000, the extra `postgresql`; it is imported when the first connection opens.
"""

from __future__ import annotations

import importlib
import logging
import ssl
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from types import ModuleType
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql
from typing_extensions import override

from sonarpost.archive.address import DatabaseAddress
from sonarpost.archive.database import ShoreDatabase
from sonarpost.archive.schema import SCHEMA
from sonarpost.errors import ConfigError, DatabaseUnavailableError, RejectedByDatabaseError

# The end of a lost connection fails; the loss itself is reported.
logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)

TIMEOUT_S = 5.0
"""Time limit to connect, and to wait for the server's answer."""
BACK_OFF_S = (0.2, 0.5, 1.0, 2.0, 5.0)
MAX_IDLE = 8
MAX_SEARCH_S = 4.0
"""A search that takes longer is ended with an error; less than `TIMEOUT_S`."""
_SESSION = (
    f"SET search_path TO {SCHEMA}, public",
    "SET TIME ZONE 'UTC'",
    "SET idle_in_transaction_session_timeout = '10s'",
    "SELECT set_config('synchronous_commit', 'on', false) WHERE current_setting('synchronous_commit') = 'off'",
)
_TABLES_LOCK = 0x736F6E61725F01
_CANCELED = "57014"


class PostgresDatabase(ShoreDatabase):
    """A database with PostGIS, which several c2 share.

    A connection that fails is closed, and with it all idle ones. While the server is not reached, a transaction fails
    at once until the next attempt is due.

    Args:
        address: Address of the database.
        timeout_s: Time limit to connect and to wait for an answer.
        site: See `ShoreDatabase`.
        writable: See `ShoreDatabase`.
    """

    is_shared = True

    def __init__(
        self, address: DatabaseAddress, timeout_s: float = TIMEOUT_S, *, site: str = "", writable: bool = True
    ) -> None:
        self.address = address
        self._timeout_s = timeout_s
        self._driver = _driver()
        self._connect_lock = threading.Lock()
        self._failures = 0
        self._retry_at_s = 0.0
        engine = sa.create_engine(
            "postgresql+pg8000://",
            creator=self._connect,
            pool_size=MAX_IDLE,
            max_overflow=-1,
            pool_use_lifo=True,
            pool_pre_ping=True,  # the server can have ended an idle connection
        )
        super().__init__(str(address), engine, site=site, writable=writable)

    def _connect(self) -> Any:  # noqa: ANN401 - of the driver
        with self._connect_lock:
            if time.monotonic() < self._retry_at_s:
                raise DatabaseUnavailableError(self.fault)
        try:
            connection = self._open()
        except (self._driver.Error, OSError) as error:
            failed = self._error(error, _detail(error))
            with self._connect_lock:
                self._retry_at_s = time.monotonic() + BACK_OFF_S[min(self._failures, len(BACK_OFF_S) - 1)]
                self._failures += 1
            raise failed from error
        with self._connect_lock:
            self._failures = 0
        return connection

    def _open(self) -> Any:  # noqa: ANN401
        address = self.address
        connection = self._driver.connect(
            address.user,
            host=address.host,
            port=address.port,
            database=address.name,
            password=address.password,
            unix_sock=f"{address.host}/.s.PGSQL.{address.port}" if address.host.startswith("/") else None,
            ssl_context=_tls_context(address) if address.use_tls else False,  # None would try TLS unchecked
            timeout=self._timeout_s,
            application_name="sonarpost",
        )
        try:
            cursor = connection.cursor()
            for statement in _SESSION:
                cursor.execute(statement)
            connection.commit()
        except BaseException:
            connection.close()
            raise
        return connection

    @override
    def insert(self, table: sa.Table) -> Any:
        return postgresql.insert(table)

    @override
    def put(self, sql: sa.Connection, statement: Any, rows: Sequence[Mapping[str, Any]]) -> int:
        # With RETURNING, SQLAlchemy sends the rows in one statement.
        return len(sql.execute(statement.returning(sa.literal_column("1")), rows).all())

    @override
    def begin(self, *, writing: bool) -> AbstractContextManager[sa.Connection]:
        return self._engine.begin()

    @override
    def has_tables(self, sql: sa.Connection) -> bool:
        # Other c2 wait before they create the tables.
        sql.execute(sa.select(sa.func.pg_advisory_xact_lock(_TABLES_LOCK)))
        exists = sql.execute(sa.select(sa.func.to_regclass(f"{SCHEMA}.archive"))).scalar_one() is not None
        if not exists and self.writable:
            # Needs a superuser, unless an administrator has created it.
            sql.exec_driver_sql("CREATE EXTENSION IF NOT EXISTS postgis")
            sql.exec_driver_sql(f"CREATE SCHEMA IF NOT EXISTS {SCHEMA}")
        return exists

    @override
    @contextmanager
    def limited(self, sql: sa.Connection) -> Iterator[None]:
        sql.exec_driver_sql(f"SET LOCAL statement_timeout = '{MAX_SEARCH_S}s'")
        yield

    @override
    def now_utc_s(self, sql: sa.Connection) -> float:
        return float(sql.execute(sa.select(sa.extract("epoch", sa.func.clock_timestamp()))).scalar_one())

    @override
    def driver_error(self) -> type[Exception]:
        error: type[Exception] = self._driver.Error
        return error

    @override
    def failed(self, context: sa.engine.ExceptionContext, error: BaseException) -> Exception | None:
        detail = _detail(error)
        code = detail.get("C", "")
        # Class 57 and 08 mean that the server has ended the connection; 57014, that it has ended a search.
        context.is_disconnect = not code or (code.startswith(("57", "08", "25")) and code != _CANCELED)
        return None if context.is_pre_ping else self._error(error, detail)

    def _error(self, error: BaseException, detail: Mapping[str, str]) -> DatabaseUnavailableError:
        code = detail.get("C", "")
        reason = f"database {self.address}: {detail.get('M') or str(error) or type(error).__name__}"
        if code != _CANCELED:
            self.fault = reason
        # Data exception, violated constraint, limit of the server.
        return (RejectedByDatabaseError if code.startswith(("22", "23", "54")) else DatabaseUnavailableError)(reason)

    @override
    def unavailable(self, reason: str) -> Exception:
        return DatabaseUnavailableError(reason)


def _detail(error: BaseException) -> Mapping[str, str]:
    """Return the fields of an error of the server, by their letters; empty for another error."""
    return error.args[0] if error.args and isinstance(error.args[0], dict) else {}


def _tls_context(address: DatabaseAddress) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=None if address.ca is None else str(address.ca))
    except OSError as error:
        raise ConfigError("c2", "sslrootcert", str(address.ca), f"a certificate authority (PEM): {error}") from error


def _driver() -> ModuleType:
    try:
        return importlib.import_module("pg8000.dbapi")
    except ImportError as error:
        raise ConfigError("c2", "database", "no driver", "pg8000: `pip install 'sonarpost[postgresql]'`") from error
