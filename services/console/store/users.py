"""Who may log in: names, roles, hashed passwords; sessions that end. A file of its own beside the database."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from cryptography.exceptions import InvalidKey
from cryptography.hazmat.primitives.kdf.scrypt import Scrypt

from sonarpost.errors import BadInputError, DeliveryError

Role = Literal["observer", "operator", "expert"]
Side = Literal["vessel", "shore"]
Act = Literal["decide", "measure", "request", "advise"]

ROLES: Final[tuple[Role, ...]] = ("observer", "operator", "expert")


@dataclass(frozen=True, slots=True)
class Actor:
    """Somebody who is logged in.

    Attributes:
        user: Name.
        role: Of the user.
        address: From where.
    """

    user: str
    role: Role
    address: str

    def may(self, act: Act, side: Side) -> bool:
        """Tell whether this person may do something on this side of the water.

        Decisions are made where the vehicle can be told at once: on a vessel. Ashore experts advise and ask.
        """
        if act == "advise":
            return side == "shore" and self.role == "expert"
        if act == "decide":
            return side == "vessel" and self.role != "observer"
        if act == "request" and side == "shore":
            return self.role == "expert"
        return self.role != "observer"


FILE_NAME = "console-users.db"
COST = 2**15
"""scrypt's n with r = 8: 32 MiB for each attempt, one attempt at a time."""
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
    """Somebody who may log in."""

    name: str
    role: Role
    changed_utc_s: float


@dataclass(frozen=True, slots=True)
class Session:
    """Somebody who has.

    Attributes:
        token: What the browser's cookie holds; only its hash is kept.
        csrf: What its page sends with everything that changes something.
        expires_utc_s: When it ends if it is not used.
    """

    token: str
    name: str
    role: Role
    csrf: str
    expires_utc_s: float


class Users:
    """The file of users and sessions, for several threads and processes.

    Args:
        path: The file.
        session_s: A session ends after so long without use ...
        session_max_s: ... and in any case after so long.
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
        self.path = path
        self._session_s = session_s
        self._session_most_s = session_max_s
        self._clock = clock
        self._lock = threading.RLock()
        self._hashing = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch(mode=0o600)
            self._db = sqlite3.connect(path, check_same_thread=False, isolation_level=None, timeout=10)
            self._db.row_factory = sqlite3.Row
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.executescript(f"BEGIN; {_SCHEMA} COMMIT;")
        except (OSError, sqlite3.Error) as error:
            raise DeliveryError(f"{path}: cannot be opened as the console's users: {error}") from error

    @contextmanager
    def _access(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                yield self._db
            except sqlite3.Error as error:
                raise DeliveryError(f"{self.path}: {error}") from error

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()

    # Users

    def add(self, name: str, role: str, password: str) -> None:
        """Add a user, or give one another role and password; sessions of that user end.

        Raises:
            BadInputError: Name, role or password is not allowed.
        """
        if not _NAME.fullmatch(name):
            raise BadInputError("user", "name", name, "1 to 40 letters, digits, '.', '_' and '-'")
        if role not in ROLES:
            raise BadInputError("user", "role", role, ", ".join(ROLES))
        self._put(name, role, password)

    def set_password(self, name: str, password: str, keep: str | None = None) -> None:
        """Give a user another password; the user's sessions end, but for the one with the token `keep`.

        Raises:
            BadInputError: There is no such user, or the password is not allowed.
        """
        user = self.find(name)
        if user is None:
            raise BadInputError("user", "name", name, "a user; `sonarpost console user ls` shows them")
        self._put(name, user.role, password, keep)

    def _put(self, name: str, role: str, password: str, keep: str | None = None) -> None:
        if not MIN_PASSWORD <= len(password) <= MAX_PASSWORD:
            expected = f"{MIN_PASSWORD} to {MAX_PASSWORD} characters"
            raise BadInputError("user", "password", f"{len(password)} characters", expected)
        salt = secrets.token_bytes(16)
        hashed = self._hash(password, salt, COST)
        with self._access() as db:
            db.execute(
                "INSERT OR REPLACE INTO user VALUES (?, ?, ?, ?, ?, ?)",
                (name, role, salt, hashed, COST, self._clock()),
            )
            db.execute(
                "DELETE FROM session WHERE name = ? AND token_sha256 <> ?", (name, b"" if keep is None else _key(keep))
            )

    def remove(self, name: str) -> bool:
        """Remove a user with the user's sessions; tell whether there was one."""
        with self._access() as db:
            db.execute("DELETE FROM session WHERE name = ?", (name,))
            return db.execute("DELETE FROM user WHERE name = ?", (name,)).rowcount > 0

    def find(self, name: str) -> User | None:
        """Return a user, None where there is none of that name."""
        with self._access() as db:
            row = db.execute("SELECT name, role, changed_utc_s FROM user WHERE name = ?", (name,)).fetchone()
        return None if row is None else User(*row)

    def all(self) -> list[User]:
        """Return all users by name."""
        with self._access() as db:
            return [User(*row) for row in db.execute("SELECT name, role, changed_utc_s FROM user ORDER BY name")]

    def right(self, name: str, password: str) -> bool:
        """Tell whether this is the user's password; takes as long where there is no such user."""
        with self._access() as db:
            row = db.execute("SELECT salt, hash, cost FROM user WHERE name = ?", (name,)).fetchone()
        if row is None:
            self._hash(password[:MAX_PASSWORD], bytes(16), COST)
            return False
        with self._hashing:
            kdf = Scrypt(salt=bytes(row["salt"]), length=32, n=int(row["cost"]), r=8, p=1)
            try:
                kdf.verify(password[:MAX_PASSWORD].encode("utf-8", "surrogatepass"), bytes(row["hash"]))
            except InvalidKey:
                return False
            return True

    def _hash(self, password: str, salt: bytes, cost: int) -> bytes:
        with self._hashing:
            return Scrypt(salt=salt, length=32, n=cost, r=8, p=1).derive(password.encode("utf-8", "surrogatepass"))

    # Sessions

    def begin(self, name: str) -> Session:
        """Begin a session of a user who exists."""
        token, csrf, now = secrets.token_urlsafe(32), secrets.token_urlsafe(24), self._clock()
        with self._access() as db:
            db.execute("DELETE FROM session WHERE used_utc_s < ? OR begun_utc_s < ?", self._oldest(now))
            db.execute("INSERT INTO session VALUES (?, ?, ?, ?, ?)", (_key(token), name, csrf, now, now))
        session = self.session(token)
        assert session is not None
        return session

    def session(self, token: str, *, use: bool = True) -> Session | None:
        """Return a session that has not ended, None for any other token.

        Args:
            token: Of the session.
            use: Whether somebody does something: a page that is merely open does not keep its session alive.
        """
        now = self._clock()
        used, begun = self._oldest(now)
        with self._access() as db:
            row = db.execute(
                "SELECT s.*, u.role FROM session s JOIN user u USING (name)"
                " WHERE token_sha256 = ? AND used_utc_s >= ? AND begun_utc_s >= ?",
                (_key(token), used, begun),
            ).fetchone()
            if row is None:
                return None
            # Not at every request: a write for each would wear the disk for nothing.
            if use and now - row["used_utc_s"] > min(60.0, self._session_s / 10):
                db.execute("UPDATE session SET used_utc_s = ? WHERE token_sha256 = ?", (now, _key(token)))
        ends = min((now if use else row["used_utc_s"]) + self._session_s, row["begun_utc_s"] + self._session_most_s)
        return Session(token, row["name"], row["role"], row["csrf"], ends)

    def end(self, token: str) -> None:
        """End a session."""
        with self._access() as db:
            db.execute("DELETE FROM session WHERE token_sha256 = ?", (_key(token),))

    def _oldest(self, now: float) -> tuple[float, float]:
        return now - self._session_s, now - self._session_most_s


def _key(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()


def same(given: str, expected: str) -> bool:
    """Compare two secrets in a time that tells nothing of them."""
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), expected.encode())


class Attempts:
    """Counts failed log-ins: so many of a user and so many from an address within a while, and no more.

    Attributes:
        most_of_user: Of one user.
        most_from: From one address.
        within_s: The while.
    """

    def __init__(self, most_of_user: int = 5, most_from: int = 20, within_s: float = 300.0) -> None:
        self.most_of_user = most_of_user
        self.most_from = most_from
        self.within_s = within_s
        self._lock = threading.Lock()
        self._failed: dict[str, list[float]] = {}

    def wait_s(self, user: str, address: str, now_s: float) -> float:
        """Return how long to wait before another attempt, 0 for not at all; `now_s` is monotonic."""
        with self._lock:
            # Names that nobody tries any more are forgotten, so that invented ones do not fill the memory.
            for name, times in list(self._failed.items()):
                recent = [at for at in times if now_s - at < self.within_s]
                if recent:
                    self._failed[name] = recent
                else:
                    del self._failed[name]
            waits = [0.0]
            for name, most in ((f"user {user}", self.most_of_user), (f"from {address}", self.most_from)):
                times = self._failed.get(name, [])
                if len(times) >= most:
                    waits.append(times[-most] + self.within_s - now_s)
            return max(waits)

    def failed(self, user: str, address: str, now_s: float) -> None:
        """Count a failure."""
        with self._lock:
            for name in (f"user {user}", f"from {address}"):
                self._failed.setdefault(name, []).append(now_s)

    def succeeded(self, user: str) -> None:
        """Forget a user's failures."""
        with self._lock:
            self._failed.pop(f"user {user}", None)
