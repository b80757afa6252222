"""A subscription to the records of a shore site that begins with the records missed before.

It subscribes first, then queries c2 page by page until no record is left, and delivers each record once: what is
published during the queries is buffered, and every record has a number. Publications can be lost on the way, so it
queries again every `refresh_s` from the last page on, and also after an overflow of its buffer.

Zenoh's advanced publisher and subscriber are not used: their history is in the memory of the publisher, ends with it,
and needs the unstable part of Zenoh's interface in every client.
"""

from __future__ import annotations

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
from sonarpost.errors import BadInputError, PayloadError, QueryRefusedError

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


class CatchUpSubscriber:
    """Iterates over the accepted records of a shore site: first those after `cursor`, then every new one.

    Records of a query are in the order of their numbers; a record that is published during the query can come before
    records with lower numbers. Close it from another thread to end the iteration.

    >>> with CatchUpSubscriber(session, "sonarpost/v1/shore/contact/*/*", saved_cursor) as records:
    ...     for record in records:
    ...         handle(record)
    ...         save(records.cursor)

    Args:
        session: A session with the shore site's router.
        key: Key expression of the records, within `sonarpost/v1/{site}/contact/*/*` or that of tasking states.
        cursor: `cursor` of an earlier subscription; empty for all records.
        refresh_s: Interval of the queries for lost publications.

    Attributes:
        cursor: Every record up to it was delivered; continue here after a restart. A record after it may have been
            delivered too, and is then delivered again.
        is_caught_up: Whether the last query was answered and had no further records.
    """

    def __init__(self, session: zenoh.Session, key: str, cursor: str = "", *, refresh_s: float = 30.0) -> None:
        self.cursor = cursor
        self.is_caught_up = False
        self._session = session
        self._key = key
        self._refresh_s = refresh_s
        self._changed = threading.Condition()
        self._buffer: deque[AcceptedRecord] = deque()
        self._overflowed = False
        self._closed = False
        self._failed: BadInputError | None = None
        # Numbers after the cursor that were delivered from publications.
        self._ahead: set[int] = set()
        self._limit = MAX_RECORDS
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
        """Deliver records until `close`.

        Raises:
            QueryRefusedError: c2 does not accept the key or the cursor, for example after its archive was replaced.
            BadInputError: A record has no number, or one of another archive.
        """
        query_at_s = time.monotonic()
        while not self._closed:
            if time.monotonic() >= query_at_s or self._overflowed:
                query_at_s = time.monotonic() + self._refresh_s
                self._overflowed = False
                answered = True
                while answered and not self._closed:
                    page, records = self._query()
                    answered = page is not None and page.more
                    yield from self._of_page(records)
                    if page is not None:
                        self._advance(page.next)
                    else:
                        query_at_s = time.monotonic() + RETRY_S
                    self.is_caught_up = page is not None and not page.more
            record = self._next_published(query_at_s)
            if record is not None and self._is_new(record):
                self._ahead.add(record.seq)
                yield record

    def _of_page(self, records: list[AcceptedRecord]) -> Iterator[AcceptedRecord]:
        for record in records:
            if self._is_new(record):
                yield record
                self._advance(f"{record.archive}.{record.seq}")

    def _is_new(self, record: AcceptedRecord) -> bool:
        archive, seq = self._position()
        if archive and record.archive != archive:
            raise BadInputError(record.key, "archive", record.archive, f"{archive}, the archive of the cursor")
        return record.seq > seq and record.seq not in self._ahead

    def _position(self) -> tuple[str, int]:
        archive, _, seq = self.cursor.partition(".")
        return archive, int(seq or 0)

    def _advance(self, cursor: str) -> None:
        self.cursor = cursor
        reached = self._position()[1]
        self._ahead = {seq for seq in self._ahead if seq > reached}

    def _next_published(self, until_s: float) -> AcceptedRecord | None:
        with self._changed:
            self._changed.wait_for(
                lambda: self._buffer or self._closed or self._overflowed or self._failed,
                max(0.0, until_s - time.monotonic()),
            )
            if self._failed is not None:
                raise self._failed
            return self._buffer.popleft() if self._buffer and not self._closed else None

    def _on_sample(self, sample: zenoh.Sample) -> None:
        with self._changed:
            try:
                where, payload = str(sample.key_expr), sample.payload.to_bytes()
                record = _accepted_record(where, payload, wire.unpack_map(payload, where))
            except PayloadError as error:
                self._failed = error
            else:
                if len(self._buffer) < MAX_BUFFERED:
                    self._buffer.append(record)
                else:
                    self._overflowed = True
            self._changed.notify_all()

    def _query(self) -> tuple[_Page | None, list[AcceptedRecord]]:
        """Return a page and its records; None and no records if not all replies have arrived.

        Raises:
            QueryRefusedError: c2 does not accept the query.
        """
        after = f";after={self.cursor}" if self.cursor else ""
        selector = f"{self._key}?limit={self._limit}{after}"
        # By number: if several c2 with one archive reply, each record arrives more than once.
        records: dict[int, AcceptedRecord] = {}
        page: _Page | None = None
        replies = self._session.get(
            selector,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=QUERY_TIMEOUT_S,
            priority=zenoh.Priority.DATA_LOW,
        )
        for reply in replies:
            if reply.ok is not None:
                where, payload = str(reply.ok.key_expr), reply.ok.payload.to_bytes()
                fields = wire.unpack_map(payload, where)
                if fields.get("type") == "page":
                    found = wire.validated(_Page, fields, where)
                    page = found if page is None or page.records < found.records else page
                else:
                    record = _accepted_record(where, payload, fields)
                    records[record.seq] = record
            elif reply.err is not None and reply.err.encoding == zenoh.Encoding.TEXT_PLAIN:
                text = reply.err.payload.to_string()
                if ": busy: " not in text:
                    raise QueryRefusedError(text)
        if page is None or page.records != len(records):
            # Replies were lost or took too long: fewer of them may pass.
            self._limit = max(1, (len(records) or self._limit) // 2)
            return None, []
        return page, [records[seq] for seq in sorted(records)]


def _accepted_record(where: str, payload: bytes, fields: Mapping[str, object]) -> AcceptedRecord:
    accepted = wire.validated(_Numbered, fields, where).accepted
    return AcceptedRecord(where, payload, accepted.archive, accepted.seq, accepted.utc_s)
