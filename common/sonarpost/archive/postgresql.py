"""Connections to a PostgreSQL server: address, transactions, reconnection with back-off.

The driver is pg8000, the extra `postgresql`; it is imported when the first connection opens.
"""

from __future__ import annotations

import importlib
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path
from types import ModuleType
from typing import Protocol
from urllib.parse import parse_qs, unquote, urlsplit

from typing_extensions import override

from sonarpost.errors import ConfigError, DatabaseUnavailableError, RejectedByDatabaseError

SCHEME = "postgresql://"
DEFAULT_PORT = 5432
TIMEOUT_S = 5.0
"""Time limit to connect, and to wait for the server's answer."""
BACK_OFF_S = (0.2, 0.5, 1.0, 2.0, 5.0)
MAX_IDLE = 8
_SSL_MODES = ("disable", "verify-full")
_PARAMETERS = ("host", "sslmode", "sslrootcert")
_SESSION = """
SET search_path TO sonarpost, public;
SET TIME ZONE 'UTC';
SET idle_in_transaction_session_timeout = '10s';
SELECT set_config('synchronous_commit', 'on', false) WHERE current_setting('synchronous_commit') = 'off';
"""


@dataclass(frozen=True, slots=True)
class DatabaseAddress:
    """Address of a database, as `parse` reads it.

    Attributes:
        host: Name or address of the server; the folder of its socket if it starts with "/".
        port: TCP port, or number of the socket.
        name: Name of the database.
        user: Role.
        password: Its password; None for a server that requires none.
        use_tls: Whether the connection uses TLS and checks the certificate and name of the server.
        ca: Certificate authority of the server (PEM); None for those of the system.
    """

    host: str
    port: int
    name: str
    user: str
    password: str | None = field(default=None, repr=False)
    use_tls: bool = True
    ca: Path | None = None

    @override
    def __str__(self) -> str:
        """Return the address without the password."""
        return f"{SCHEME}{self.user}@{self.host}:{self.port}/{self.name}"

    @classmethod
    def parse(cls, url: str, password_file: Path | None = None, where: str = "c2") -> DatabaseAddress:
        """Parse `postgresql://USER[:PASSWORD]@HOST[:PORT]/DATABASE[?sslmode=…][&sslrootcert=PEM][&host=/FOLDER]`.

        TLS with a check of the certificate (`verify-full`) is the default, except for sockets and loopback addresses.

        Raises:
            ConfigError: The text is not such a URL, or the password file cannot be read. No message has the password.
        """
        parts = urlsplit(url)
        shown = f"{SCHEME}…{parts.path}" if url.startswith(SCHEME) else "another address"

        def invalid(expected: str) -> ConfigError:
            return ConfigError(where, "database", shown, expected)

        try:
            port = parts.port or DEFAULT_PORT
            options = parse_qs(parts.query, strict_parsing=True) if parts.query else {}
        except ValueError:
            raise invalid("a port from 1 to 65535, and parameters NAME=VALUE") from None
        host = options.get("host", [unquote(parts.hostname or "")])[-1]
        name = unquote(parts.path.removeprefix("/"))
        if not url.startswith(SCHEME) or not parts.username or not host or not name or "/" in name:
            raise invalid(f"{SCHEME}USER:PASSWORD@HOST:PORT/DATABASE")
        if unknown := sorted(set(options) - set(_PARAMETERS)):
            raise invalid(f"the parameters {', '.join(_PARAMETERS)}, not {', '.join(unknown)}")
        mode = options.get("sslmode", ["disable" if _is_local(host) else "verify-full"])[-1]
        if mode not in _SSL_MODES:
            raise invalid("sslmode=" + " or ".join(_SSL_MODES))
        password = None if parts.password is None else unquote(parts.password)
        if password_file is not None:
            password = _read_password(password_file, where)
        ca = Path(options["sslrootcert"][-1]) if "sslrootcert" in options else None
        return cls(host, port, name, unquote(parts.username), password, mode != "disable", ca)


def _is_local(host: str) -> bool:
    if host.startswith("/") or host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def _read_password(path: Path, where: str) -> str:
    try:
        return path.read_text(encoding="utf-8").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(where, "database_password_file", str(path), f"a readable file: {error}") from error


class _Connection(Protocol):
    """The used methods of `pg8000.native.Connection`."""

    def run(self, sql: str, **values: object) -> list[list[object]] | None: ...

    def close(self) -> None: ...


class Sql:
    """Statements of one transaction; `:name` in a statement stands for a value."""

    def __init__(self, connection: _Connection, failed: Callable[[Exception], DatabaseUnavailableError]) -> None:
        self._connection = connection
        self._failed = failed

    def rows(self, statement: str, **values: object) -> list[list[object]]:
        """Run a statement and return its rows."""
        try:
            return self._connection.run(statement, **values) or []
        except (_driver().Error, OSError) as error:
            raise self._failed(error) from error

    def number(self, statement: str, **values: object) -> int:
        """Run a statement and return the first value as a number; 0 for NULL or no row."""
        rows = self.rows(statement, **values)
        value = rows[0][0] if rows else None
        return int(str(value)) if value is not None else 0


class ConnectionPool:
    """Connections to one database, for several threads.

    A connection that fails is closed, and with it all idle ones. While the server is not reached, a transaction fails
    at once until the next attempt is due.

    Args:
        address: Address of the database.
        timeout_s: Time limit to connect and to wait for an answer.

    Attributes:
        fault: Why the last transaction failed; empty if it did not.
    """

    def __init__(self, address: DatabaseAddress, timeout_s: float = TIMEOUT_S) -> None:
        self.address = address
        self.fault = ""
        self._timeout_s = timeout_s
        self._lock = threading.Lock()
        self._idle: list[_Connection] = []
        self._failures = 0
        self._retry_at_s = 0.0

    @contextmanager
    def transaction(self) -> Iterator[Sql]:
        """Open a transaction, which is committed at the end of the block and rolled back after an exception.

        Raises:
            DatabaseUnavailableError: The server is not reached or rejects a statement. Whether a failed commit has
                taken effect is unknown.
            ConfigError: The driver is not installed, or the certificate authority cannot be read.
        """
        driver = _driver()
        connection = self._take(driver)
        sql = Sql(connection, lambda error: self._failed(error, driver))
        try:
            yield sql
            sql.rows("COMMIT")
        except BaseException:
            with suppress(driver.Error, OSError):
                connection.close()  # the server rolls back
            raise
        with self._lock:
            self.fault = ""
            self._failures = 0
            if len(self._idle) < MAX_IDLE:
                self._idle.append(connection)
                return
        connection.close()

    def close(self) -> None:
        """Close the idle connections."""
        with self._lock:
            idle, self._idle = self._idle, []
        for connection in idle:
            with suppress(_driver().Error, OSError):
                connection.close()

    def _take(self, driver: ModuleType) -> _Connection:
        """Return a connection in a new transaction."""
        while (idle := self._idle_connection()) is not None:
            try:
                idle.run("BEGIN")
            except (driver.Error, OSError):
                # The server has ended it since its last use.
                with suppress(driver.Error, OSError):
                    idle.close()
            else:
                return idle
        with self._lock:
            if time.monotonic() < self._retry_at_s:
                raise DatabaseUnavailableError(self.fault)
        try:
            return self._connect(driver)
        except (driver.Error, OSError) as error:
            failed = self._failed(error, driver)
            with self._lock:
                self._retry_at_s = time.monotonic() + BACK_OFF_S[min(self._failures, len(BACK_OFF_S) - 1)]
                self._failures += 1
            raise failed from error

    def _idle_connection(self) -> _Connection | None:
        with self._lock:
            return self._idle.pop() if self._idle else None

    def _connect(self, driver: ModuleType) -> _Connection:
        address = self.address
        socket_file = f"{address.host}/.s.PGSQL.{address.port}" if address.host.startswith("/") else None
        connection: _Connection = driver.Connection(
            address.user,
            host=address.host,
            port=address.port,
            database=address.name,
            password=address.password,
            unix_sock=socket_file,
            ssl_context=_tls_context(address) if address.use_tls else False,  # None would try TLS unchecked
            timeout=self._timeout_s,
            application_name="sonarpost",
        )
        try:
            connection.run(_SESSION)
            connection.run("BEGIN")
        except BaseException:
            connection.close()
            raise
        return connection

    def _failed(self, error: Exception, driver: ModuleType) -> DatabaseUnavailableError:
        is_server_error = isinstance(error, driver.DatabaseError) and bool(error.args)
        detail = error.args[0] if is_server_error and isinstance(error.args[0], dict) else {}
        # Class 57 and 08 mean that the server has ended the connection.
        code = str(detail.get("C", ""))
        reason = str(detail.get("M", "")) or str(error) or type(error).__name__
        if not code or code.startswith(("57", "08", "25")):
            self.close()
        with self._lock:
            self.fault = f"database {self.address}: {reason}"
            # Data exception, violated constraint, limit of the server.
            return (RejectedByDatabaseError if code.startswith(("22", "23", "54")) else DatabaseUnavailableError)(
                self.fault
            )


def _tls_context(address: DatabaseAddress) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=None if address.ca is None else str(address.ca))
    except OSError as error:
        raise ConfigError("c2", "sslrootcert", str(address.ca), f"a certificate authority (PEM): {error}") from error


def _driver() -> ModuleType:
    try:
        return importlib.import_module("pg8000.native")
    except ImportError as error:
        raise ConfigError("c2", "database", "no driver", "pg8000: `pip install 'sonarpost[postgresql]'`") from error
