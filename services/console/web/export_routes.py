"""Routes of exports, and the documents that they and reports write: one of each user, in turn."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final, Literal

from anyio import from_thread
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send
from typing_extensions import override

from sonarpost.delivery.disk_reserve import HANDLING_RESERVE_BYTES
from sonarpost.errors import BadInputError
from sonarpost.export.contacts import ExportContact
from sonarpost.export.formats import Format, exporters
from sonarpost.export.source import ContactImage, ExportSource
from sonarpost.limits import limit
from sonarpost.logs import IntervalLog
from sonarpost.review import rendering
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contact_detail import StoredContact, find_stored_contact
from sonarpost.services.console.store.contacts import ContactFilter, list_versions
from sonarpost.services.console.store.database import Database
from sonarpost.services.console.web.access import AccessControl, ApiError, Call
from sonarpost.sonar.image_files import png_bytes

SURFACE: Final = "exports and reports of the console"
MAX_DOCUMENTS: Final = limit(4, "documents", "shares", SURFACE, "all users", "in total", "503 with Retry-After")
limit(1, "document", "shares", SURFACE, "user", "of one user", "429 with Retry-After")
RETRY_S: Final = 10
TURN_S: Final = 1.0
"""Interval at which a waiting document checks whether it is still wanted."""
CONNECTION_INTERVAL: Final = 16
"""Contacts between two checks of the connection, which take about as long as a contact."""
CHUNK_BYTES: Final = 65536
_skipped_log: Final = IntervalLog(logging.getLogger(__name__), logging.ERROR, "Contact left out of a document")

Writer = Callable[[IO[bytes], "DocumentContacts"], None]


def offered_formats() -> dict[str, Format]:
    """Return the formats that the console offers, by name."""
    return {name: one for name, one in exporters().working().items() if one.label}


@dataclass(eq=False)
class ExportProgress:
    """Progress of one export or report.

    Attributes:
        name: Name of the file.
        state: Waiting for its first turn, writing the file, or sending it.
        done: Contacts in the file.
        total: Contacts of the filter; None before they are counted.
        size_bytes: Size of the file.
        cancelled: Whether the user cancelled it.
        is_disconnected: Returns whether the browser has closed the connection.
        least_free_bytes: Free disk below which the export ends.
    """

    name: str
    state: Literal["waiting", "writing", "sending"] = "waiting"
    done: int = 0
    total: int | None = None
    size_bytes: int = 0
    cancelled: bool = False
    is_disconnected: Callable[[], bool] = lambda: False
    least_free_bytes: int = 0


class _ExportQueue:
    """Limits documents to one of each user. They are written in turn, one contact at a time."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._exports: dict[str, ExportProgress] = {}
        """Documents by user, in the order of their turns."""

    def enter(self, user: str, name: str) -> ExportProgress:
        """Add a document of a user; return its progress.

        Raises:
            ApiError: 429 if the user has one already; 503 if the queue is full.
        """
        headers = {"Retry-After": str(RETRY_S)}
        with self._condition:
            if user in self._exports:
                message = f"an export of {user} is not finished: try again in {RETRY_S} s"
                raise ApiError(429, "too_many", message, "exports", headers)
            if len(self._exports) >= MAX_DOCUMENTS:
                message = f"{MAX_DOCUMENTS} exports are not finished: try again in {RETRY_S} s"
                raise ApiError(503, "busy", message, headers=headers)
            self._exports[user] = progress = ExportProgress(name)
        return progress

    def find(self, user: str) -> ExportProgress | None:
        """Return the progress of a user's document; None without one."""
        with self._condition:
            return self._exports.get(user)

    def end_turn(self, progress: ExportProgress) -> None:
        """Let the documents of the other users continue."""
        with self._condition:
            user = next(user for user, one in self._exports.items() if one is progress)
            self._exports[user] = self._exports.pop(user)
            self._condition.notify_all()

    def wait_for_turn(self, progress: ExportProgress) -> bool:
        """Wait at most `TURN_S` for the turn of a document; return whether it has come."""
        with self._condition:
            return self._condition.wait_for(
                lambda: next(one for one in self._exports.values() if one.state != "sending") is progress, TURN_S
            )

    def start_sending(self, progress: ExportProgress) -> None:
        """End the turns of a document that is complete."""
        with self._condition:
            progress.state = "sending"
            self._condition.notify_all()

    def leave(self, user: str) -> None:
        """Remove the document of a user."""
        with self._condition:
            self._exports.pop(user, None)
            self._condition.notify_all()


class _TemporaryFileResponse(StreamingResponse):
    """Streams a temporary file and closes it, also if the client disconnects."""

    def __init__(self, file: IO[bytes], on_close: Callable[[], None], headers: Mapping[str, str]) -> None:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        chunks = iter(lambda: file.read(CHUNK_BYTES), b"")
        super().__init__(chunks, headers={**headers, "Content-Length": str(size)})
        self._file = file
        self._on_close = on_close

    @override
    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()
            self._on_close()


class ExportRoutes:
    """Routes of exports, and the writer of documents.

    A document is written to a temporary file without a name in the folder of the database: the operating system
    deletes it when the process ends, also after a crash. The file lives as long as the request that created it.
    """

    def __init__(self, state: ConsoleState) -> None:
        self._state = state
        self._queue = _ExportQueue()
        self._stopped = False

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/export", access.endpoint(self._progress)),
            access.post("/api/export/cancel", self._cancel),
            Route("/api/export/{name}", access.endpoint(self._export)),
        ]

    def stop(self) -> None:
        """End the documents that are written, so that the process can stop."""
        self._stopped = True

    def _progress(self, call: Call) -> Response:
        progress = self._queue.find(call.actor.user)
        fields = ("name", "state", "done", "total", "size_bytes")
        body = None if progress is None else {field: getattr(progress, field) for field in fields}
        return JSONResponse({"export": body})

    def _cancel(self, call: Call) -> Response:
        progress = self._queue.find(call.actor.user)
        if progress is not None:
            progress.cancelled = True
        return JSONResponse({"cancelled": progress is not None})

    def _export(self, call: Call) -> Response:
        name = str(call.request.path_params["name"])
        names = {f"contacts.{format_name}": one for format_name, one in offered_formats().items()}
        if name not in names:
            raise ApiError(404, "not_found", "one of " + ", ".join(names))
        query, chosen = call.parse_query(ContactFilter), names[name]
        headers = {"Content-Disposition": f'attachment; filename="{name}"', "Content-Type": chosen.media_type}
        path = self._state.database.path.with_name(name)

        def write(file: IO[bytes], contacts: DocumentContacts) -> None:
            chosen.write(file, ExportSource(contacts, contacts, path))

        return self.document(call, name, headers, query, write)

    def document(
        self, call: Call, name: str, headers: Mapping[str, str], query: ContactFilter, write: Writer
    ) -> Response:
        """Return the response with a document of the contacts of a filter.

        Args:
            call: The request.
            name: Name of the file.
            headers: Headers of the response.
            query: The filter.
            write: Writes the document to a binary file.

        Raises:
            ApiError: There are too many documents, or this one is not wanted any more, or is too large.
        """
        user = call.actor.user
        progress = self._queue.enter(user, name)
        progress.is_disconnected = lambda: from_thread.run(call.request.is_disconnected)
        try:
            file = self._write(query, progress, write)
        except BaseException:
            self._queue.leave(user)
            raise
        self._queue.start_sending(progress)
        return _TemporaryFileResponse(file, lambda: self._queue.leave(user), headers)

    def _write(self, query: ContactFilter, progress: ExportProgress, write: Writer) -> IO[bytes]:
        """Write a document to a temporary file, and return the file."""
        folder = self._state.database.path.parent
        file: IO[bytes] = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  closed below
        try:
            self._wait_for_turn(file, progress)
            progress.state = "writing"
            progress.least_free_bytes = shutil.disk_usage(folder).free // 2

            def next_contact() -> None:
                self._queue.end_turn(progress)
                self._wait_for_turn(file, progress)
                self._check(file, progress)

            write(file, DocumentContacts(self._state.database, query, progress, next_contact))
            progress.size_bytes = file.tell()
        except BaseException:
            file.close()
            raise
        return file

    def _wait_for_turn(self, file: IO[bytes], progress: ExportProgress) -> None:
        while not self._queue.wait_for_turn(progress):
            self._check(file, progress)

    def _check(self, file: IO[bytes], progress: ExportProgress) -> None:
        """End a document that is not wanted any more, or leaves too little of the disk; called before each contact."""
        progress.size_bytes = file.tell()
        if progress.cancelled or (progress.done % CONNECTION_INTERVAL == 0 and progress.is_disconnected()):
            raise ApiError(409, "cancelled", "the export was cancelled")
        if self._stopped:
            raise ApiError(503, "busy", "the console is stopping")
        free_bytes = shutil.disk_usage(self._state.database.path.parent).free
        if free_bytes < HANDLING_RESERVE_BYTES:
            raise OSError(errno.ENOSPC, "the disk reserve is reached")
        if free_bytes < progress.least_free_bytes:
            raise ApiError(413, "too_large", "more than half of the free disk: select fewer contacts")


class DocumentContacts:
    """The contacts of a document with their images, read from the database one at a time."""

    def __init__(
        self, database: Database, query: ContactFilter, progress: ExportProgress, next_contact: Callable[[], None]
    ) -> None:
        with database.read() as db:
            self._versions = list_versions(db, query)
        self._database = database
        self._progress = progress
        self._next_contact = next_contact
        self._last: StoredContact | None = None
        progress.total = len(self._versions)

    def __iter__(self) -> Iterator[ExportContact]:
        for contact_id, version in self._versions:
            self._next_contact()
            # Other requests use the database between two contacts.
            try:
                with self._database.read() as db:
                    self._last = find_stored_contact(db, contact_id, version)
            except BadInputError as error:
                _skipped_log.log(contact=contact_id, reason=str(error)[:300])
                self._last = None
            if self._last is not None:
                yield self._last.contact
            self._progress.done += 1

    def __len__(self) -> int:
        return len(self._versions)

    def image(self, contact: ExportContact) -> ContactImage | None:
        """Return the image of the last contact; None if it has none."""
        stored = self.stored(contact)
        if not stored.image.codec:
            return None
        pixels = rendering.eight_bits(stored.image.pixels.to_array())
        return ContactImage(pixels, stored.image.missing(), stored.lines)

    def png(self, contact: ExportContact) -> bytes | None:
        """Return the image of the last contact as PNG, as c2 stores it; None if it has none."""
        image = self.stored(contact).image
        # Without a codec only the contact record was received; its image is black.
        return png_bytes(Path(contact.uid), image.pixels.to_array()) if image.codec else None

    def stored(self, contact: ExportContact) -> StoredContact:
        """Return the last contact as it is stored."""
        assert self._last is not None
        assert self._last.contact is contact
        return self._last
