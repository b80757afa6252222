"""A subscription to the records of a shore site that begins with the records missed before.

It subscribes first, then queries c2 page by page until no record is left, and delivers each record once: every record
has a number. Publications are delivered also while a query waits for c2. They can be lost on the way, so it queries
again every `refresh_s` from the last page on, and also after an overflow of its buffer.

Zenoh's advanced publisher and subscriber are not used: their history is in the memory of the publisher, ends with it,
and needs the unstable part of Zenoh's interface in every client.
"""

from __future__ import annotations

import hashlib
import logging
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Annotated, Final, Self

import zenoh
from pydantic import BaseModel, ConfigDict, Field

from sonarpost import wire
from sonarpost.delivery.protocol import MAX_RECORD_BYTES
from sonarpost.errors import PayloadError, QueryRefusedError
from sonarpost.logs import IntervalLog, kv

log = logging.getLogger(__name__)

QUERY_TIMEOUT_S: Final = 30.0
RETRY_S: Final = 1.0
MAX_RECORDS: Final = 256
"""Maximum number of records of one query."""
MAX_BUFFERED: Final = 256
"""Publications that wait for the consumer, as many as the records of a query; after an overflow c2 is queried again."""


@dataclass(frozen=True, slots=True)
class AcceptedRecord:
    """A record that c2 has accepted.

    Attributes:
        key: Key on which c2 publishes it.
        payload: Its payload, see `sonarpost.decode_record`.
        archive: Identity of c2's journal.
        seq: Its number in this journal.
        accepted_utc_s: When c2 accepted it.
    """

    key: str
    payload: bytes
    archive: str
    seq: int
    accepted_utc_s: float


class _Accepted(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True)

    archive: Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")]
    seq: Annotated[int, Field(ge=1)]
    utc_s: float


class _Numbered(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True)

    accepted: _Accepted


class _Page(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True)

    records: Annotated[int, Field(ge=0)]
    more: bool
    next: Annotated[str, Field(pattern=r"^[0-9a-f]{8}\.[0-9]{1,18}$")]


class _Replies:
    """Replies to one query; Zenoh adds them in a thread of its own.

    Attributes:
        records: By number: if several c2 with one archive reply, each record arrives more than once.
        page: The last reply of c2, or None.
        error: Error reply of c2, or empty.
        has_ended: Whether no further replies arrive.
    """

    def __init__(self, invalid_log: IntervalLog) -> None:
        self.records: dict[int, AcceptedRecord] = {}
        self.page: _Page | None = None
        self.error = ""
        self.has_ended = False
        self._invalid_log = invalid_log

    def add(self, reply: zenoh.Reply) -> None:
        """Add a record, a page or an error reply."""
        if reply.ok is not None:
            where, payload = str(reply.ok.key_expr), reply.ok.payload.to_bytes()
            try:
                fields = wire.unpack_map(payload, where)
                if fields.get("type") == "page":
                    found = wire.validated(_Page, fields, where)
                    self.page = found if self.page is None or self.page.records < found.records else self.page
                else:
                    record = _accepted_record(where, payload, fields)
                    self.records[record.seq] = record
            except PayloadError as error:
                self._invalid_log.log(reason=str(error)[:300])
        elif reply.err is not None and reply.err.encoding == zenoh.Encoding.TEXT_PLAIN:
            self.error = reply.err.payload.to_bytes().decode(errors="replace")


class CatchUpSubscriber:
    """Delivers the accepted records of a shore site: first those after `cursor`, then every new one.

    Records of a query are in the order of their numbers; a record that is published during the query can come before
    records with lower numbers. After the archive of c2 was replaced, the new one is delivered from its first record on;
    with `only_new`, only what is published.

    >>> with CatchUpSubscriber(session, "sonarpost/v1/shore/contact/*/*", saved_cursor) as records:
    ...     for record in records:
    ...         handle(record)
    ...         save(records.cursor)

    Args:
        session: A session with the shore site's router.
        key: Key expression of the records, within `sonarpost/v1/{site}/contact/*/*` or that of tasking states.
        cursor: `cursor` of an earlier subscription; empty for all records.
        refresh_s: Interval of the queries for lost publications.
        only_new: Whether an empty cursor, or one of a replaced archive, stands for the records accepted from now on.

    Attributes:
        cursor: Every record up to it was delivered; continue here after a restart. A record after it may have been
            delivered too, and is then delivered again.
        is_caught_up: Whether the last query was answered and had no further records.
    """

    def __init__(
        self, session: zenoh.Session, key: str, cursor: str = "", *, refresh_s: float = 30.0, only_new: bool = False
    ) -> None:
        self.cursor = cursor
        self.is_caught_up = False
        self._session = session
        self._key = key
        self._refresh_s = refresh_s
        self._only_new = only_new
        self._changed = threading.Condition()
        self._buffer: deque[AcceptedRecord] = deque()
        self._overflowed = False
        self._closed = False
        self._query_at_s = time.monotonic()
        self._found: deque[AcceptedRecord] = deque()
        self._replies: _Replies | None = None
        self._page: _Page | None = None
        self._delivered: AcceptedRecord | None = None
        # Numbers and digests of the records after the cursor that were delivered from publications. An invalid
        # publication with the number of a record does not suppress it.
        self._ahead: set[tuple[int, bytes]] = set()
        self._limit = MAX_RECORDS
        self._invalid_log = IntervalLog(log, logging.WARNING, "Invalid record ignored")
        self._subscriber = session.declare_subscriber(key, self._on_sample)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End the subscription."""
        self.close()

    def close(self) -> None:
        """End the subscription and the iteration. A second call does nothing."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        self._subscriber.undeclare()

    def __iter__(self) -> Iterator[AcceptedRecord]:
        """Deliver records until another thread calls `close`.

        Raises:
            QueryRefusedError: c2 does not accept the key.
            zenoh.ZError: The session is closed.
        """
        while not self._closed:
            record = self.poll(self._refresh_s)
            if record is not None:
                yield record

    def poll(self, timeout_s: float) -> AcceptedRecord | None:
        """Return the next record; None if there is none for this time, or after the replies to a query.

        Raises:
            QueryRefusedError: c2 does not accept the key.
            zenoh.ZError: The session is closed.
        """
        self._confirm()
        if self._replies is not None and self._replies.has_ended:
            self._read_page(self._replies)
        elif self._replies is None and self._page is None and self._is_query_due():
            self._query()
        while self._found:
            self._delivered = self._found.popleft()
            if self._is_new(self._delivered):
                return self._delivered
            self._confirm()
        self._confirm()
        record = self._next_published(time.monotonic() + timeout_s)
        if record is None or not self._is_new(record):
            return None
        self._ahead.add(_identity(record))
        return record

    def _is_query_due(self) -> bool:
        return self._overflowed or time.monotonic() >= self._query_at_s

    def _confirm(self) -> None:
        """Move the cursor behind the record that was delivered, or behind the page after its last record."""
        if self._page is not None and not self._found:
            self._advance(self._page.next)
            self.is_caught_up = not self._page.more
            self._page = None
        elif self._delivered is not None:
            self._advance(f"{self._delivered.archive}.{self._delivered.seq}")
        self._delivered = None

    def _is_new(self, record: AcceptedRecord) -> bool:
        archive, seq = _position(self.cursor)
        # A publication of another archive comes before the query that finds that the archive was replaced.
        is_before = record.archive == archive and record.seq <= seq
        return not is_before and _identity(record) not in self._ahead

    def _advance(self, cursor: str) -> None:
        (archive, seq), (before, reached) = _position(cursor), _position(self.cursor)
        if archive == before and seq <= reached:
            return
        self.cursor = cursor
        self._ahead = {identity for identity in self._ahead if identity[0] > seq}

    def _next_published(self, until_s: float) -> AcceptedRecord | None:
        replies = self._replies
        if replies is None:
            until_s = min(until_s, self._query_at_s)

        def is_over() -> bool:
            return self._closed or (self._overflowed if replies is None else replies.has_ended)

        with self._changed:
            self._changed.wait_for(lambda: self._buffer or is_over(), max(0.0, until_s - time.monotonic()))
            return self._buffer.popleft() if self._buffer and not self._closed else None

    def _on_sample(self, sample: zenoh.Sample) -> None:
        where, size = str(sample.key_expr), len(sample.payload)
        if size > MAX_RECORD_BYTES:
            self._invalid_log.log(reason=f"{where}: payload: got {size} bytes, expected at most {MAX_RECORD_BYTES}")
            return
        payload = sample.payload.to_bytes()
        try:
            record = _accepted_record(where, payload, wire.unpack_map(payload, where))
        except PayloadError as error:
            self._invalid_log.log(reason=str(error)[:300])
            return
        with self._changed:
            if len(self._buffer) < MAX_BUFFERED:
                self._buffer.append(record)
            else:
                self._overflowed = True
            self._changed.notify_all()

    def _query(self) -> None:
        """Query c2 for the next page, without waiting for the replies."""
        self._overflowed = False
        self._query_at_s = time.monotonic() + self._refresh_s
        after = f";after={self.cursor}" if self.cursor else ""
        # No record is from the future: the page has no records, and the position of the last one.
        only_new = ";_time=[now(36500d)..]" if self._only_new and not self.cursor else ""
        replies = _Replies(self._invalid_log)

        def end() -> None:
            with self._changed:
                replies.has_ended = True
                self._changed.notify_all()

        self._session.get(
            f"{self._key}?limit={self._limit}{after}{only_new}",
            zenoh.handlers.Callback(replies.add, end),
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=QUERY_TIMEOUT_S,
            priority=zenoh.Priority.DATA_LOW,
        )
        self._replies = replies

    def _read_page(self, replies: _Replies) -> None:
        """Take the page and its records if all replies have arrived, else query again later.

        Raises:
            QueryRefusedError: c2 does not accept the query.
        """
        self._replies = None
        page, records = replies.page, replies.records
        if self.cursor and ": after: " in replies.error:
            log.warning("Archive of c2 was replaced, reading the new one", extra=kv(reason=replies.error[:300]))
            self.cursor = ""
        elif replies.error and ": busy: " not in replies.error:
            raise QueryRefusedError(replies.error)
        if page is not None and page.records == len(records):
            self._limit = min(MAX_RECORDS, 2 * self._limit)
            self._page = page
            self._found.extend(records[seq] for seq in sorted(records))
            if page.more:
                self._query_at_s = time.monotonic()
            return
        if page is not None or records:
            # Replies were lost or took too long: fewer of them may pass.
            self._limit = max(1, (len(records) or self._limit) // 2)
        self._query_at_s = time.monotonic() + RETRY_S
        self.is_caught_up = False


def _position(cursor: str) -> tuple[str, int]:
    archive, _, seq = cursor.partition(".")
    return archive, int(seq or 0)


def _identity(record: AcceptedRecord) -> tuple[int, bytes]:
    return record.seq, hashlib.sha256(record.payload).digest()


def _accepted_record(where: str, payload: bytes, fields: Mapping[str, object]) -> AcceptedRecord:
    accepted = wire.validated(_Numbered, fields, where).accepted
    return AcceptedRecord(where, payload, accepted.archive, accepted.seq, accepted.utc_s)
