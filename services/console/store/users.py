"""Users of the console with password hashes, log-in links, sessions, known browsers and settings. One SQLite file."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sonarpost.errors import BadInputError
from sonarpost.limits import limit
from sonarpost.services.console.store.database import ROLES, UserRole
from sonarpost.sqlite_file import SqliteFile

FILE_NAME = "console-users.db"
SCHEMA_VERSION = 1
SCRYPT_COST, SCRYPT_PARALLEL = 2**15, 3
"""Parameters n and p of scrypt with r = 8: 32 MiB for each check, and three times the time of p = 1. This is one of the
minimum settings of OWASP's password storage cheat sheet. Checks run one at a time."""
SCRYPT_MAX_BYTES = 2**26
MIN_PASSWORD, MAX_PASSWORD = 10, 200
MAX_SESSIONS_OF_USER = limit(
    10, "sessions", "shares", "log-in of the console", "user", "sessions", "the least recently used session ends"
)
MAX_DEVICES_OF_USER = 20
DEVICE_S = 90 * 86400.0
"""A browser is known for this time after its last log-in."""
LINK_S = 600.0
"""A log-in link is valid for this time."""
MAX_LINKS_OF_USER = 5
_LINK_KEPT_S = 86400.0
"""A used or expired link is known for this time, so that its user sees the reason for the refusal."""

LinkState = Literal["valid", "used", "expired", "unknown"]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")
_SCHEMA = """
CREATE TABLE IF NOT EXISTS user (
    name TEXT PRIMARY KEY, role TEXT NOT NULL, salt BLOB NOT NULL, hash BLOB NOT NULL, cost INTEGER NOT NULL,
    parallel INTEGER NOT NULL, changed_utc_s REAL NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS session (
    token_sha256 BLOB PRIMARY KEY, name TEXT NOT NULL, csrf TEXT NOT NULL, begun_utc_s REAL NOT NULL,
    used_utc_s REAL NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS device (
    token_sha256 BLOB NOT NULL, name TEXT NOT NULL, used_utc_s REAL NOT NULL,
    PRIMARY KEY (token_sha256, name)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS link (
    token_sha256 BLOB PRIMARY KEY, name TEXT NOT NULL, made_utc_s REAL NOT NULL, used INTEGER NOT NULL DEFAULT 0)
    WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS setting (
    user TEXT NOT NULL, name TEXT NOT NULL, value TEXT NOT NULL, PRIMARY KEY (user, name)) WITHOUT ROWID;
"""


@dataclass(frozen=True, slots=True)
class User:
    """A user of the console."""

    name: str
    role: UserRole
    changed_utc_s: float


@dataclass(frozen=True, slots=True)
class Session:
    """A log-in session.

    Attributes:
        token: Value of the browser's cookie. Only its hash is stored.
        csrf: Token that the page sends with each POST request.
        begun_utc_s: Time of the log-in.
    """

    token: str
    name: str
    role: UserRole
    csrf: str
    begun_utc_s: float


class Users(SqliteFile):
    """The file of users and sessions, shared by several threads and processes. It is readable by its owner only.

    Args:
        path: The file.
        session_s: Maximum time between two requests of a session.
        session_max_s: Maximum duration of a session.
        clock: UTC seconds.

    Raises:
        DeliveryError: The file cannot be opened, or has another schema version.
    """

    def __init__(
        self,
        path: Path,
        session_s: float = 4 * 3600.0,
        session_max_s: float = 24 * 3600.0,
        clock: Callable[[], float] = time.time,
    ) -> None:
        super().__init__(path, _SCHEMA, SCHEMA_VERSION)
        self._session_s = session_s
        self._session_max_s = session_max_s
        self._clock = clock
        self._hash_lock = threading.Lock()

    # Users

    def add(self, name: str, role: str, password: str) -> None:
        """Add a user, or replace role and password of a user and end the user's sessions.

        Raises:
            BadInputError: Name, role or password is invalid.
        """
        if not _NAME.fullmatch(name):
            raise BadInputError("user", "name", name, "1 to 40 letters, digits, '.', '_' and '-'")
        if role not in ROLES:
            raise BadInputError("user", "role", role, ", ".join(ROLES))
        self._put(name, role, password)

    def set_password(self, name: str, password: str, keep: str | None = None) -> None:
        """Change a user's password, and end the user's sessions except the one with the token `keep`.

        Raises:
            BadInputError: The user does not exist, or the password is invalid.
        """
        user = self.find(name)
        if user is None:
            raise BadInputError("user", "name", name, "a user; `sonarpost console user ls` lists them")
        self._put(name, user.role, password, keep)

    def _put(self, name: str, role: str, password: str, keep: str | None = None) -> None:
        if not MIN_PASSWORD <= len(password) <= MAX_PASSWORD:
            expected = f"{MIN_PASSWORD} to {MAX_PASSWORD} characters"
            raise BadInputError("user", "password", f"{len(password)} characters", expected)
        new = self._new_hash(password)
        with self.transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO user (name, role, changed_utc_s, salt, hash, cost, parallel)"
                " VALUES (?, ?, ?, ?, ?, ?, ?)",
                (name, role, self._clock(), *new),
            )
            kept = b"" if keep is None else _token_hash(keep)
            db.execute("DELETE FROM session WHERE name = ? AND token_sha256 <> ?", (name, kept))
            db.execute("DELETE FROM link WHERE name = ?", (name,))

    def remove(self, name: str) -> bool:
        """Remove a user with sessions, known browsers, links and settings; return whether the user existed."""
        with self.transaction() as db:
            db.execute("DELETE FROM link WHERE name = ?", (name,))
            db.execute("DELETE FROM setting WHERE user = ?", (name,))
            db.execute("DELETE FROM device WHERE name = ?", (name,))
            db.execute("DELETE FROM session WHERE name = ?", (name,))
            return db.execute("DELETE FROM user WHERE name = ?", (name,)).rowcount > 0

    def find(self, name: str) -> User | None:
        """Return a user; None if there is none."""
        return next((user for user in self.all() if user.name == name), None)

    def all(self) -> list[User]:
        """Return all users by name."""
        with self.read() as db:
            return [User(*row) for row in db.execute("SELECT name, role, changed_utc_s FROM user ORDER BY name")]

    def verify_password(self, name: str, password: str) -> bool:
        """Return whether a password is correct. A correct one is hashed again if its hash has weaker parameters.

        The duration is the same for an unknown user.
        """
        with self.read() as db:
            row = db.execute("SELECT salt, hash, cost, parallel FROM user WHERE name = ?", (name,)).fetchone()
        password = password[:MAX_PASSWORD]
        if row is None:
            self._hash(password, bytes(16), SCRYPT_COST, SCRYPT_PARALLEL)
            return False
        salt, expected, cost, parallel = row
        if not hmac.compare_digest(self._hash(password, salt, cost, parallel), expected):
            return False
        if (cost, parallel) != (SCRYPT_COST, SCRYPT_PARALLEL):
            new = self._new_hash(password)
            with self.transaction() as db:
                # The condition keeps a password that was changed in the meantime.
                db.execute(
                    "UPDATE user SET salt = ?, hash = ?, cost = ?, parallel = ? WHERE name = ? AND hash = ?",
                    (*new, name, expected),
                )
        return True

    def _new_hash(self, password: str) -> tuple[bytes, bytes, int, int]:
        """Return salt, hash and the parameters n and p."""
        salt = secrets.token_bytes(16)
        return salt, self._hash(password, salt, SCRYPT_COST, SCRYPT_PARALLEL), SCRYPT_COST, SCRYPT_PARALLEL

    def _hash(self, password: str, salt: bytes, cost: int, parallel: int) -> bytes:
        with self._hash_lock:
            return hashlib.scrypt(
                password.encode("utf-8", "surrogatepass"),
                salt=salt,
                n=cost,
                r=8,
                p=parallel,
                maxmem=SCRYPT_MAX_BYTES,
                dklen=32,
            )

    # Known browsers

    def is_known_device(self, name: str, token: str) -> bool:
        """Return whether a user has logged in with this browser before."""
        with self.read() as db:
            found = db.execute(
                "SELECT 1 FROM device WHERE token_sha256 = ? AND name = ? AND used_utc_s >= ?",
                (_token_hash(token), name, self._clock() - DEVICE_S),
            ).fetchone()
        return found is not None

    def add_device(self, name: str, token: str) -> str:
        """Store that a user has logged in with a browser, and delete the oldest of too many; return its token.

        Args:
            name: Name of an existing user.
            token: Token of the browser; replaced if it is not known for any user.
        """
        now = self._clock()
        with self.transaction() as db:
            db.execute("DELETE FROM device WHERE used_utc_s < ?", (now - DEVICE_S,))
            if not db.execute("SELECT 1 FROM device WHERE token_sha256 = ?", (_token_hash(token),)).fetchone():
                token = secrets.token_urlsafe(32)
            db.execute("INSERT OR REPLACE INTO device VALUES (?, ?, ?)", (_token_hash(token), name, now))
            _delete_oldest(db, "device", name, MAX_DEVICES_OF_USER)
        return token

    # Log-in links

    def make_login_link(self, name: str) -> str:
        """Return the token of a link that logs a user in once, within `LINK_S`. Only its hash is stored.

        A user has at most `MAX_LINKS_OF_USER` links; another one ends the oldest. A new password ends all of them.

        Raises:
            BadInputError: The user does not exist.
        """
        if self.find(name) is None:
            raise BadInputError("user", "name", name, "a user; `sonarpost console user ls` lists them")
        token, now = secrets.token_urlsafe(32), self._clock()
        with self.transaction() as db:
            db.execute("DELETE FROM link WHERE made_utc_s < ?", (now - LINK_S - _LINK_KEPT_S,))
            db.execute(
                "INSERT INTO link (token_sha256, name, made_utc_s) VALUES (?, ?, ?)", (_token_hash(token), name, now)
            )
            _delete_oldest(db, "link", name, MAX_LINKS_OF_USER, "made_utc_s")
        return token

    def use_login_link(self, token: str) -> tuple[LinkState, str]:
        """Use up a log-in link; return its state before, and the user's name, which is empty for an unknown link."""
        digest = _token_hash(token)
        with self.transaction() as db:
            row = db.execute("SELECT name, made_utc_s, used FROM link WHERE token_sha256 = ?", (digest,)).fetchone()
            if row is None:
                return "unknown", ""
            name, made_utc_s, used = row
            db.execute("UPDATE link SET used = 1 WHERE token_sha256 = ?", (digest,))
        if used:
            return "used", name
        return ("valid" if 0 <= self._clock() - made_utc_s <= LINK_S else "expired"), name

    # Settings

    def settings(self, name: str) -> dict[str, str]:
        """Return the settings of a user."""
        with self.read() as db:
            return dict(db.execute("SELECT name, value FROM setting WHERE user = ?", (name,)).fetchall())

    def store_settings(self, name: str, values: Mapping[str, str]) -> None:
        """Store settings of a user; those that are not in `values` remain."""
        with self.transaction() as db:
            db.executemany(
                "INSERT OR REPLACE INTO setting VALUES (?, ?, ?)", [(name, *item) for item in values.items()]
            )

    # Sessions

    def start_session(self, name: str) -> Session:
        """Start a session of an existing user; it ends the user's least recently used session of too many."""
        token, csrf, now = secrets.token_urlsafe(32), secrets.token_urlsafe(24), self._clock()
        with self.transaction() as db:
            db.execute("DELETE FROM session WHERE used_utc_s < ? OR begun_utc_s < ?", self._limits(now))
            _delete_oldest(db, "session", name, MAX_SESSIONS_OF_USER - 1)
            db.execute("INSERT INTO session VALUES (?, ?, ?, ?, ?)", (_token_hash(token), name, csrf, now, now))
        session = self.find_session(token)
        assert session is not None
        return session

    def find_session(self, token: str, *, is_use: bool = True) -> Session | None:
        """Return a session that has not ended; None for any other token.

        Args:
            token: Token of the session.
            is_use: Whether this extends the session. An open page alone does not.
        """
        now = self._clock()
        with self.read() as db:
            row = db.execute(
                "SELECT s.*, u.role FROM session s JOIN user u USING (name)"
                " WHERE token_sha256 = ? AND used_utc_s >= ? AND begun_utc_s >= ?",
                (_token_hash(token), *self._limits(now)),
            ).fetchone()
        if row is None:
            return None
        # The time is not updated at every request, to save disk writes.
        if is_use and now - row["used_utc_s"] > min(60.0, self._session_s / 10):
            with self.transaction() as db:
                db.execute("UPDATE session SET used_utc_s = ? WHERE token_sha256 = ?", (now, _token_hash(token)))
        return Session(token, row["name"], row["role"], row["csrf"], row["begun_utc_s"])

    def end_session(self, token: str) -> None:
        """End a session."""
        with self.transaction() as db:
            db.execute("DELETE FROM session WHERE token_sha256 = ?", (_token_hash(token),))

    def _limits(self, now: float) -> tuple[float, float]:
        """Return the earliest times of last use and of start of a valid session."""
        return now - self._session_s, now - self._session_max_s


def _delete_oldest(db: sqlite3.Connection, table: str, name: str, kept: int, time_column: str = "used_utc_s") -> None:
    """Delete a user's rows of a table except the newest ones by a column."""
    db.execute(
        f"DELETE FROM {table} WHERE name = ? AND token_sha256 NOT IN ("  # noqa: S608  constants only
        f"SELECT token_sha256 FROM {table} WHERE name = ? ORDER BY {time_column} DESC LIMIT ?)",
        (name, name, kept),
    )


def _token_hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()


def login_link(address: str, token: str) -> str:
    """Return the log-in link of a token. Browsers do not send the part after `#`, so that no log contains the token.

    Args:
        address: URL of the console, with a final slash.
        token: Token of `Users.make_login_link`.
    """
    return f"{address}login#{token}"
