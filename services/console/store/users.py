"""Users and sessions of the console: password hashes, log-in limits. One SQLite file."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.kdf.scrypt import Scrypt

from sonarpost.errors import BadInputError
from sonarpost.services.console.store.database import ROLES, Role, SqliteFile

FILE_NAME = "console-users.db"
SCRYPT_COST = 2**15
"""Parameter n of scrypt with r = 8: 32 MiB for each attempt. Attempts run one at a time."""
MIN_PASSWORD, MAX_PASSWORD = 10, 200

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")
_SCHEMA = """
CREATE TABLE IF NOT EXISTS user (
    name TEXT PRIMARY KEY, role TEXT NOT NULL, salt BLOB NOT NULL, hash BLOB NOT NULL, cost INTEGER NOT NULL,
    changed_utc_s REAL NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS session (
    token_sha256 BLOB PRIMARY KEY, name TEXT NOT NULL, csrf TEXT NOT NULL, begun_utc_s REAL NOT NULL,
    used_utc_s REAL NOT NULL) WITHOUT ROWID;
"""


@dataclass(frozen=True, slots=True)
class User:
    """A user of the console."""

    name: str
    role: Role
    changed_utc_s: float


@dataclass(frozen=True, slots=True)
class Session:
    """A log-in session.

    Attributes:
        token: Value of the browser's cookie. Only its hash is stored.
        csrf: Token that the page sends with each POST request.
        expires_utc_s: Time at which an unused session ends.
    """

    token: str
    name: str
    role: Role
    csrf: str
    expires_utc_s: float


class Users(SqliteFile):
    """The file of users and sessions, shared by several threads and processes. It is readable by its owner only.

    Args:
        path: The file.
        session_s: Maximum time between two requests of a session.
        session_max_s: Maximum duration of a session.
        clock: UTC seconds.

    Raises:
        DeliveryError: The file cannot be opened.
    """

    def __init__(
        self,
        path: Path,
        session_s: float = 4 * 3600.0,
        session_max_s: float = 24 * 3600.0,
        clock: Callable[[], float] = time.time,
    ) -> None:
        super().__init__(path, _SCHEMA)
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
        salt = secrets.token_bytes(16)
        hashed = self._hash(password, salt, SCRYPT_COST)
        with self.transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO user VALUES (?, ?, ?, ?, ?, ?)",
                (name, role, salt, hashed, SCRYPT_COST, self._clock()),
            )
            kept = b"" if keep is None else _token_hash(keep)
            db.execute("DELETE FROM session WHERE name = ? AND token_sha256 <> ?", (name, kept))

    def remove(self, name: str) -> bool:
        """Remove a user and the user's sessions; return whether the user existed."""
        with self.transaction() as db:
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
        """Return whether a password is correct. The duration is the same for an unknown user."""
        with self.read() as db:
            row = db.execute("SELECT salt, hash, cost FROM user WHERE name = ?", (name,)).fetchone()
        salt, cost = (bytes(16), SCRYPT_COST) if row is None else (bytes(row["salt"]), int(row["cost"]))
        hashed = self._hash(password[:MAX_PASSWORD], salt, cost)
        return row is not None and hmac.compare_digest(hashed, bytes(row["hash"]))

    def _hash(self, password: str, salt: bytes, cost: int) -> bytes:
        with self._hash_lock:
            return Scrypt(salt=salt, length=32, n=cost, r=8, p=1).derive(password.encode("utf-8", "surrogatepass"))

    # Sessions

    def start_session(self, name: str) -> Session:
        """Start a session of an existing user."""
        token, csrf, now = secrets.token_urlsafe(32), secrets.token_urlsafe(24), self._clock()
        with self.transaction() as db:
            db.execute("DELETE FROM session WHERE used_utc_s < ? OR begun_utc_s < ?", self._limits(now))
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
        used_utc_s = now if is_use else row["used_utc_s"]
        expires_utc_s = min(used_utc_s + self._session_s, row["begun_utc_s"] + self._session_max_s)
        return Session(token, row["name"], row["role"], row["csrf"], expires_utc_s)

    def end_session(self, token: str) -> None:
        """End a session."""
        with self.transaction() as db:
            db.execute("DELETE FROM session WHERE token_sha256 = ?", (_token_hash(token),))

    def _limits(self, now: float) -> tuple[float, float]:
        """Return the earliest times of last use and of start of a valid session."""
        return now - self._session_s, now - self._session_max_s


def _token_hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()


def is_equal_secret(given: str, expected: str) -> bool:
    """Compare two secrets in constant time."""
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), expected.encode())


class LoginLimiter:
    """Limits failed log-in attempts of one user and from one address.

    Args:
        max_of_user: Failed attempts of one user in `window_s`.
        max_from_address: Failed attempts from one address in `window_s`.
        window_s: Duration of the window.
    """

    def __init__(self, max_of_user: int = 5, max_from_address: int = 20, window_s: float = 300.0) -> None:
        self._max_of_user = max_of_user
        self._max_from_address = max_from_address
        self._window_s = window_s
        self._lock = threading.Lock()
        self._failures: dict[str, list[float]] = {}

    def wait_s(self, user: str, address: str, now_s: float) -> float:
        """Return the time until the next permitted attempt, 0 if one is permitted now; `now_s` is monotonic."""
        with self._lock:
            # Old entries are deleted for all names, so that invented names do not fill the memory.
            recent = {
                name: [at for at in times if now_s - at < self._window_s] for name, times in self._failures.items()
            }
            self._failures = {name: times for name, times in recent.items() if times}
            waits = [0.0]
            for name, limit in ((f"user {user}", self._max_of_user), (f"from {address}", self._max_from_address)):
                times = self._failures.get(name, [])
                if len(times) >= limit:
                    waits.append(times[-limit] + self._window_s - now_s)
            return max(waits)

    def add_failure(self, user: str, address: str, now_s: float) -> None:
        """Count a failed attempt."""
        with self._lock:
            for name in (f"user {user}", f"from {address}"):
                self._failures.setdefault(name, []).append(now_s)

    def clear(self, user: str) -> None:
        """Delete a user's failed attempts after a successful one."""
        with self._lock:
            self._failures.pop(f"user {user}", None)
