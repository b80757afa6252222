"""Replies of c2 to queries of subscribers for records that it has accepted.

A query is checked in Zenoh's callback and answered by a small pool of threads, over a session of its own: a slow or
hostile client delays other queries, and not the records of vessels. `docs/specifications/queries.md` specifies them.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Annotated, ClassVar, Final

import zenoh
from pydantic import BaseModel, ConfigDict, Field

from sonarpost import keys
from sonarpost.archive.journal import JournalRow
from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.services.c2.accepted import accepted_fields, payload_of
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.json_form import ENCODING, json_payload
from sonarpost.services.c2.query_parameters import QueryParameters, parse_parameters

log = logging.getLogger(__name__)

SURFACE: Final = "queries for accepted records"
MAX_BYTES: Final = limit(
    256 * 1024, "bytes", "claims", SURFACE, "client", "replies to a query, or one record", "the next page is queried"
)
LARGE_BYTES: Final = limit(
    1024 * 1024, "bytes", "claims", SURFACE, "client", "pixels of a record beside others", "larger ones one at a time"
)
THREADS: Final = 2
MAX_IN_PROGRESS: Final = limit(
    8, "queries", "shares", SURFACE, "client", "queries in progress, of all", "further ones get an error"
)
RATE_PER_S: Final = limit(
    20.0, "queries a second", "shares", SURFACE, "client", "queries of all, after 40", "further ones get an error"
)
BURST: Final = 40.0
BUSY: Final = "busy"
"""Field of the error reply to a query that the client has to repeat."""


class Page(BaseModel):
    """Last reply to a query: how many records were sent, and where the next page begins.

    Attributes:
        records: Number of records in the replies before.
        unreadable: Number of records that are omitted because their files are missing or damaged.
        more: Whether more records match.
        next: Cursor for the parameter `after`.
    """

    TYPE: ClassVar[str] = "page"
    VERSION: ClassVar[int] = 1

    model_config = ConfigDict(frozen=True, strict=True)

    records: Annotated[int, Field(ge=0)]
    unreadable: Annotated[int, Field(ge=0)]
    more: bool
    next: Annotated[str, Field(pattern=r"^[0-9a-f]{8}\.[0-9]{1,18}$")]

    def fields(self) -> dict[str, object]:
        """Return the map of the payload."""
        return {"type": self.TYPE, "v": self.VERSION, **self.model_dump()}


PAGE_ENCODING: Final = f"application/msgpack;schema=sonarpost.{Page.TYPE}.v{Page.VERSION}"


class RateLimit:
    """A token bucket of `BURST` queries that refills with `RATE_PER_S`."""

    def __init__(self) -> None:
        self._tokens = BURST
        self._at_s = time.monotonic()

    def take(self, now_s: float) -> bool:
        """Return whether one more query is allowed at this time of a monotonic clock."""
        self._tokens = min(BURST, self._tokens + (now_s - self._at_s) * RATE_PER_S)
        self._at_s = now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True


class QueryService:
    """Queryables of one c2.

    Args:
        archive: The archive of c2.
        site: Name of the site in keys.
        count: Increases a health counter.
    """

    def __init__(self, archive: Archive, site: str, count: Callable[[str, int], None]) -> None:
        self._archive = archive
        self.count = count
        self._declared = (keys.shore_contact_all(site), keys.tasking_state_all(site))
        self._pool = ThreadPoolExecutor(THREADS, "query")
        self._lock = threading.Lock()
        self._in_progress = 0
        self._rate = RateLimit()
        self._large = threading.Lock()
        self._session: zenoh.Session | None = None
        self._queryables: list[zenoh.Queryable[None]] = []
        self._is_preferred = True
        self._session_lock = threading.Lock()

    def start(self, session: zenoh.Session) -> None:
        """Answer queries that arrive over `session`, which `close` closes."""
        with self._session_lock:
            self._session = session
            self._declare(session)

    def _declare(self, session: zenoh.Session) -> None:
        # Complete: of several c2 with the same records, Zenoh queries one.
        self._queryables = [
            session.declare_queryable(declared, self._on_query, complete=self._is_preferred)
            for declared in self._declared
        ]

    def set_preferred(self, *, is_preferred: bool) -> None:
        """Leave queries to other c2 of the site while there is one, or end that."""
        with self._session_lock:
            if is_preferred == self._is_preferred:
                return
            self._is_preferred = is_preferred
            if self._session is not None and not self._session.is_closed():
                for queryable in self._queryables:
                    queryable.undeclare()
                self._declare(self._session)

    def close(self) -> None:
        """Stop; queries in progress end without further replies."""
        with self._session_lock:
            if self._session is not None:
                self._session.close()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _on_query(self, query: zenoh.Query) -> None:
        where = str(query.key_expr)
        try:
            parameters = parse_parameters(str(query.parameters), where, time.time())
            self._check_key(query.key_expr)
            self._enter(where)
        except BadInputError as error:
            self._refuse(query, error)
            return
        try:
            self._pool.submit(self._answer, query, parameters)
        except RuntimeError:  # the pool was shut down
            self._leave()
            query.drop()

    def _check_key(self, key: zenoh.KeyExpr) -> None:
        # Zenoh passes a wider query to both queryables, and one cursor cannot serve two pages.
        if not any(zenoh.KeyExpr(declared).includes(key) for declared in self._declared):
            raise BadInputError(str(key), "key", str(key), "a key expression within " + " or ".join(self._declared))

    def _enter(self, where: str) -> None:
        """Admit a query.

        Raises:
            BadInputError: A limit is reached.
        """
        with self._lock:
            if self._in_progress >= MAX_IN_PROGRESS:
                expected = f"at most {MAX_IN_PROGRESS}; repeat the query after a second"
                raise BadInputError(where, BUSY, f"{self._in_progress} queries in progress", expected)
            if not self._rate.take(time.monotonic()):
                expected = f"at most {RATE_PER_S:g} queries a second; repeat the query after a second"
                raise BadInputError(where, BUSY, "more", expected)
            self._in_progress += 1

    def _leave(self) -> None:
        with self._lock:
            self._in_progress -= 1

    def _refuse(self, query: zenoh.Query, error: BadInputError) -> None:
        self.count("queries_refused", 1)
        log.debug("Query refused", extra=kv(reason=str(error)))
        try:
            query.reply_err(str(error).encode(), encoding=zenoh.Encoding.TEXT_PLAIN)
        except zenoh.ZError as failed:
            log.debug("Error reply not sent", extra=kv(error=str(failed)))
        finally:
            query.drop()

    def _answer(self, query: zenoh.Query, parameters: QueryParameters) -> None:
        try:
            self._send_page(query, parameters)
            self.count("queries_answered", 1)
        except BadInputError as error:
            self._refuse(query, error)
        except (OSError, DeliveryError) as error:
            log.warning("Query not answered", extra=kv(key=str(query.key_expr), error=str(error)))
            self._refuse(query, BadInputError(str(query.key_expr), BUSY, "a failure", "a readable archive"))
        except zenoh.ZError as error:
            log.debug("Reply not sent", extra=kv(error=str(error)))
        finally:
            query.drop()
            self._leave()

    def _send_page(self, query: zenoh.Query, parameters: QueryParameters) -> None:
        where = str(query.key_expr)
        journal = self._archive.index().journal
        # Before the search: a record that is accepted after it has a higher number.
        archive, last = journal.position()
        if parameters.archive not in ("", archive):
            expected = f"a cursor of {archive}: the archive was replaced, begin without `after`"
            raise BadInputError(where, "after", f"{parameters.archive}.{parameters.after}", expected)
        known = [key for key in journal.known_keys() if query.key_expr.intersects(zenoh.KeyExpr(key))]
        rows = journal.page(known, parameters.criteria, parameters.after, parameters.limit + 1) if known else []
        more, rows = len(rows) > parameters.limit, rows[: parameters.limit]
        sent = size_bytes = unreadable = 0
        for row in rows:
            with self._large if _pixel_bytes(row) > LARGE_BYTES else nullcontext():
                payload = self._payload(row, parameters)
                if payload is None:
                    unreadable += 1
                    continue
                if sent and size_bytes + len(payload) > MAX_BYTES:
                    more, rows = True, rows[: rows.index(row)]
                    break
                encoding = ENCODING if parameters.format == "json" else row.encoding
                query.reply(row.key, payload, encoding=encoding)
                sent, size_bytes = sent + 1, size_bytes + len(payload)
                del payload
        end = rows[-1].accepted.seq if more else max([last, parameters.after, *(row.accepted.seq for row in rows)])
        page = Page(records=sent, unreadable=unreadable, more=more, next=f"{archive}.{end}")
        self.count("query_records", sent)
        if unreadable:
            self.count("query_records_unreadable", unreadable)
        if parameters.format == "json":
            query.reply(where, json.dumps(page.fields()).encode(), encoding=ENCODING)
        else:
            query.reply(where, payload_of(page.fields()), encoding=PAGE_ENCODING)

    def _payload(self, row: JournalRow, parameters: QueryParameters) -> bytes | None:
        try:
            fields = accepted_fields(self._archive.fields(row), row.accepted)
            return json_payload(fields, parameters.pixels) if parameters.format == "json" else payload_of(fields)
        except (OSError, BadInputError, ValueError) as error:
            log.warning("Stored record cannot be read", extra=kv(file=row.name, error=str(error)))
            return None


def _pixel_bytes(row: JournalRow) -> int:
    """Return the size of the pixels of a record."""
    pixels = row.fields.get("pixels")
    if not isinstance(pixels, dict):
        return 0
    return int(pixels["height_px"]) * int(pixels["width_px"]) * int(pixels["bits"]) // 8
