"""Side-car file of a store with the highest committed numbers; it shows that commits of the store were lost.

A store whose write-ahead log was deleted or damaged, or whose file was truncated or restored from a backup, opens
without an error: SQLite recovers an older state. The side-car `{store}.watermark` is written after each commit that
assigned numbers, in place and without a flush to the disk. At the next start, a store with lower numbers than its
side-car has lost commits. After a power cut the side-car can be older than the store, which is no fault.

The file has two lines: a JSON object, and the CRC-32 of the first line in hexadecimal. Bytes after them are unused.
"""

from __future__ import annotations

import json
import logging
import os
import sqlite3
import time
import uuid
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from typing_extensions import override

from sonarpost.errors import StoredFileError
from sonarpost.files import PRIVATE_FILE
from sonarpost.logs import kv

log = logging.getLogger(__name__)

SUFFIX = ".watermark"
VERSION = 1
FILE_BYTES = 4096
"""Initial size: later writes in place then need no new disk space."""
MAX_FILE_BYTES = 1 << 24
_encode = json.JSONEncoder(separators=(",", ":")).encode
LOST = "lost_records"
"""Name of the report in the store's table `meta`."""


@dataclass(frozen=True, slots=True)
class Numbers:
    """Numbers of one outbox queue or of the inbox, after a commit.

    Attributes:
        last: Highest assigned number, 0 for none.
        first_open: Lowest number whose record was still in the store; `last` + 1 if there was none.
    """

    last: int = 0
    first_open: int = 1


@dataclass(frozen=True, slots=True)
class Marks:
    """Numbers of a whole store.

    Attributes:
        inbox: Row identifiers of the inbox.
        queues: Sequence numbers of each outbox queue.
    """

    inbox: Numbers = Numbers()
    queues: Mapping[str, Numbers] = field(default_factory=dict)

    @classmethod
    def of_store(cls, db: sqlite3.Connection) -> Marks:
        """Read the numbers from the tables of a store.

        Raises:
            sqlite3.Error: The store cannot be read.
        """
        rows = db.execute(
            "SELECT consumer, seq, (SELECT MIN(seq) FROM outbox WHERE outbox.consumer = outbox_next.consumer)"
            " FROM outbox_next"
        ).fetchall()
        queues = {str(queue): Numbers(seq, seq + 1 if first is None else first) for queue, seq, first in rows}
        return cls(inbox_numbers(db), queues)


def inbox_numbers(db: sqlite3.Connection) -> Numbers:
    """Read the numbers of the inbox.

    Raises:
        sqlite3.Error: The store cannot be read.
    """
    last, first = db.execute(
        "SELECT COALESCE((SELECT seq FROM sqlite_sequence WHERE name = 'inbox'), 0), (SELECT MIN(id) FROM inbox)"
    ).fetchone()
    return Numbers(last, last + 1 if first is None else first)


@dataclass(frozen=True, slots=True)
class LostRecords:
    """Report of records that were lost with commits of a store. The counts are upper limits.

    Attributes:
        found_utc_s: When the loss was found.
        inbox: Accepted records that can be lost before they were handled.
        queues: Records of each outbox queue that can be lost before they were delivered.
    """

    found_utc_s: float
    inbox: int = 0
    queues: Mapping[str, int] = field(default_factory=dict)

    @override
    def __str__(self) -> str:
        counts = [f"{queue} {count}" for queue, count in sorted(self.queues.items())]
        return ", ".join([*counts, *([f"inbox {self.inbox}"] if self.inbox else [])])

    def plus(self, earlier: LostRecords | None) -> LostRecords:
        """Return the sum of this report and an earlier one."""
        if earlier is None:
            return self
        queues = dict(earlier.queues)
        for queue, count in self.queues.items():
            queues[queue] = queues.get(queue, 0) + count
        return LostRecords(earlier.found_utc_s, earlier.inbox + self.inbox, queues)

    def pack(self) -> bytes:
        """Return the bytes for the table `meta`."""
        return json.dumps({"at": self.found_utc_s, "inbox": self.inbox, "queues": dict(self.queues)}).encode()

    @classmethod
    def unpack(cls, data: bytes) -> LostRecords:
        """Parse the bytes of `pack`."""
        fields = json.loads(data)
        return cls(fields["at"], fields["inbox"], fields["queues"])


def compare(side_car: Marks, store: Marks, now_utc_s: float) -> LostRecords | None:
    """Return what can be lost if the store is older than its side-car, else None.

    Records that had left the store at the time of the side-car are not counted.
    """
    behind = {queue: n for queue, n in side_car.queues.items() if n.last > store.queues.get(queue, Numbers()).last}
    if not behind and side_car.inbox.last <= store.inbox.last:
        return None
    queues = {queue: _lost(n, store.queues.get(queue, Numbers())) for queue, n in behind.items()}
    return LostRecords(now_utc_s, _lost(side_car.inbox, store.inbox), queues)


def _lost(side_car: Numbers, store: Numbers) -> int:
    return max(0, side_car.last - max(store.last, side_car.first_open - 1))


def lost_records(db: sqlite3.Connection) -> LostRecords | None:
    """Return the report that is stored until an operator clears it, or None.

    Raises:
        sqlite3.Error: The store cannot be read.
    """
    row = db.execute("SELECT value FROM meta WHERE name = ?", (LOST,)).fetchone()
    return None if row is None else LostRecords.unpack(bytes(row[0]))


def read(store_path: Path) -> Marks | None:
    """Read the side-car of a store; None if there is none.

    Raises:
        StoredFileError: It cannot be read, or its checksum is wrong.
    """
    path = side_car_path(store_path)
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StoredFileError(str(path), "", error.strerror or str(error), "a readable side-car") from error
    text, _, rest = data.partition(b"\n")
    checksum = rest.partition(b"\n")[0]
    if checksum != _checksum(text):
        raise StoredFileError(str(path), "checksum", checksum[:16], "the CRC-32 of the first line")
    try:
        content = json.loads(text)
        if content["v"] != VERSION:
            raise StoredFileError(str(path), "v", content["v"], str(VERSION))
        return Marks(Numbers(*content["inbox"]), {queue: Numbers(*n) for queue, n in content["queues"].items()})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoredFileError(str(path), "", f"{type(error).__name__}: {error}", "a side-car of a store") from error


def side_car_path(store_path: Path) -> Path:
    """Return the path of a store's side-car."""
    return store_path.with_name(store_path.name + SUFFIX)


def _checksum(text: bytes) -> bytes:
    return f"{zlib.crc32(text):08x}".encode()


class Watermark:
    """Writer of the side-car of an open store.

    Args:
        store_path: File of the store.

    Attributes:
        path: File of the side-car.
    """

    def __init__(self, store_path: Path) -> None:
        self.path = side_car_path(store_path)
        self._store_path = store_path
        self._descriptor: int | None = None
        self._inbox = Numbers()
        self._queues: dict[str, Numbers] = {}
        self._warned = False

    def check(self, db: sqlite3.Connection) -> LostRecords | None:
        """Compare the store with its side-car, in an open transaction.

        If commits were lost, the report is added to the store and logged. New records of a queue that is behind get a
        new origin and numbers above the side-car's.

        Returns:
            The new report; None if the store is not older than the side-car, or if there is no readable side-car.

        Raises:
            sqlite3.Error: The store cannot be read or written.
        """
        try:
            side_car = read(self._store_path)
        except StoredFileError as error:
            log.warning("Side-car of the store cannot be read; writing a new one", extra=kv(reason=str(error)))
            return None
        lost = None if side_car is None else compare(side_car, Marks.of_store(db), time.time())
        if side_car is None or lost is None:
            return None
        for queue in lost.queues:
            db.execute(
                "INSERT OR REPLACE INTO outbox_next (consumer, seq, origin) VALUES (?, ?, ?)",
                (queue, side_car.queues[queue].last, uuid.uuid4().bytes),
            )
        report = lost.plus(lost_records(db))
        db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (LOST, report.pack()))
        log.error(
            "Commits of the store are lost; records are possibly lost",
            extra=kv(file=self._store_path, records=str(lost) or "none"),
        )
        return lost

    def start(self, db: sqlite3.Connection) -> None:
        """Write the numbers of the store, after `check`.

        Raises:
            sqlite3.Error: The store cannot be read.
        """
        marks = Marks.of_store(db)
        self._inbox, self._queues = marks.inbox, dict(marks.queues)
        try:
            self._descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, PRIVATE_FILE)
            os.posix_fallocate(self._descriptor, 0, FILE_BYTES)
        except OSError as error:
            self._failed(error)
        self._write()

    def committed(self, db: sqlite3.Connection, queues: Iterable[tuple[str, int]], *, inbox: bool) -> None:
        """Write the numbers that a commit has assigned. A failure is logged: the commit itself is complete.

        Args:
            db: Connection of the store, after the commit.
            queues: Outbox queues with new records, and the highest number of each.
            inbox: Whether the inbox has new records.
        """
        try:
            for queue, last in queues:
                first = db.execute("SELECT MIN(seq) FROM outbox WHERE consumer = ?", (queue,)).fetchone()[0]
                self._queues[queue] = Numbers(last, last + 1 if first is None else first)
            if inbox:
                self._inbox = inbox_numbers(db)
        except sqlite3.Error as error:
            self._failed(error)
            return
        self._write()

    def _write(self) -> None:
        if self._descriptor is None:
            return
        queues = {queue: [n.last, n.first_open] for queue, n in self._queues.items()}
        content = {"v": VERSION, "inbox": [self._inbox.last, self._inbox.first_open], "queues": queues}
        text = _encode(content).encode()
        try:
            os.pwrite(self._descriptor, b"%b\n%b\n" % (text, _checksum(text)), 0)
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError | sqlite3.Error) -> None:
        if not self._warned:
            self._warned = True
            log.warning("Side-car of the store not written", extra=kv(file=self.path, error=str(error)))

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
