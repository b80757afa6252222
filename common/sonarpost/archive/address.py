"""Address of an archive in a PostgreSQL server."""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

from typing_extensions import override

from sonarpost.errors import ConfigError

SCHEME = "postgresql://"
DEFAULT_PORT = 5432
_SSL_MODES = ("disable", "verify-full")
_PARAMETERS = ("host", "sslmode", "sslrootcert")


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
