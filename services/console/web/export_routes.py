"""Routes of exports."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import IO, Final, Literal

from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from sonarpost.delivery.store import HANDLING_RESERVE_BYTES
from sonarpost.export.contacts import ContactSet, ExportContact
from sonarpost.export.cot import cot_events
from sonarpost.export.kml import ContactImage, add_kmz
from sonarpost.export.tables import csv_bytes, geojson_bytes
from sonarpost.review import rendering
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contacts import ContactFilter, list_versions
from sonarpost.services.console.store.exports import find_export_contact, picture_lines
from sonarpost.services.console.store.measurements import list_measurements
from sonarpost.services.console.web.access import AccessControl, ApiError, Call

MAX_CONTACTS: Final = 5000
MAX_BYTES: Final = 268_435_456
MAX_EXPORTS: Final = 4
"""Exports at a time, of different users: one runs, the others wait or are downloaded."""
RETRY_S: Final = 10
CHUNK_BYTES: Final = 65536


def _cot_bytes(contacts: ContactSet) -> bytes:
    events = b"\n".join(cot_events(contacts, time.time()))
    return b'<?xml version="1.0" encoding="UTF-8"?>\n<events>\n' + events + b"\n</events>\n"


KMZ: Final = "contacts.kmz"
_FORMATS: Final[Mapping[str, tuple[Callable[[ContactSet], bytes] | None, str]]] = {
    "contacts.geojson": (geojson_bytes, "application/geo+json"),
    "contacts.csv": (csv_bytes, "text/csv; charset=utf-8"),
    KMZ: (None, "application/vnd.google-earth.kmz"),
    "contacts.cot.xml": (_cot_bytes, "application/xml"),
}


@dataclass
class ExportProgress:
    """Progress of one export.

    Attributes:
        name: Name of the file.
        state: Waiting for another export, writing the file, or sending it.
        done: Contacts in the file.
        total: Contacts of the filter; None before they are counted.
        size_bytes: Size of the file.
        cancelled: Whether the user cancelled it.
    """

    name: str
    state: Literal["waiting", "writing", "sending"] = "waiting"
    done: int = 0
    total: int | None = None
    size_bytes: int = 0
    cancelled: bool = False


class _ExportQueue:
    """Limits exports: one runs at a time, and each user has at most one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._exports: dict[str, ExportProgress] = {}
        self.worker = threading.Lock()

    def enter(self, user: str, name: str) -> ExportProgress:
        """Add an export of a user; return its progress.

        Raises:
            ApiError: 429 if the user has one already; 503 if the queue is full.
        """
        headers = {"Retry-After": str(RETRY_S)}
        with self._lock:
            if user in self._exports:
                message = f"an export of {user} is not finished: try again in {RETRY_S} s"
                raise ApiError(429, "too_many", message, headers=headers)
            if len(self._exports) >= MAX_EXPORTS:
                message = f"{MAX_EXPORTS} exports are not finished: try again in {RETRY_S} s"
                raise ApiError(503, "busy", message, headers=headers)
            self._exports[user] = progress = ExportProgress(name)
        return progress

    def find(self, user: str) -> ExportProgress | None:
        """Return the progress of a user's export; None without one."""
        with self._lock:
            return self._exports.get(user)

    def leave(self, user: str) -> None:
        """Remove the export of a user."""
        with self._lock:
            self._exports.pop(user, None)


class _TemporaryFileResponse(StreamingResponse):
    """Streams a temporary file and closes it, also if the client disconnects."""

    def __init__(self, file: IO[bytes], on_close: Callable[[], None], headers: Mapping[str, str]) -> None:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        chunks = iter(lambda: file.read(CHUNK_BYTES), b"")
        super().__init__(chunks, headers={**headers, "Content-Length": str(size)})
        self._file = file
        self._on_close = on_close

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()
            self._on_close()


class ExportRoutes:
    """Routes of exports.

    An export is written to a temporary file without a name in the folder of the database: the operating system
    deletes it when the process ends, also after a crash. The file lives as long as the request that created it.
    """

    def __init__(self, state: ConsoleState) -> None:
        self._state = state
        self._queue = _ExportQueue()
        self._stopped = False

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/export", access.endpoint(self._progress), methods=["GET"]),
            Route("/api/export/cancel", access.endpoint(self._cancel), methods=["POST"]),
            Route("/api/export/{name}", access.endpoint(self._export), methods=["GET"]),
        ]

    def stop(self) -> None:
        """End the running export, so that the process can stop."""
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
        if name not in _FORMATS:
            raise ApiError(404, "not_found", "one of " + ", ".join(_FORMATS))
        query, user = call.parse_query(ContactFilter), call.actor.user
        headers = {"Content-Disposition": f'attachment; filename="{name}"', "Content-Type": _FORMATS[name][1]}
        progress = self._queue.enter(user, name)
        try:
            with self._queue.worker:
                progress.state = "writing"
                file = self._write(name, query, progress)
        except BaseException:
            self._queue.leave(user)
            raise
        progress.state = "sending"
        return _TemporaryFileResponse(file, lambda: self._queue.leave(user), headers)

    def _write(self, name: str, query: ContactFilter, progress: ExportProgress) -> IO[bytes]:
        """Write an export to a temporary file, and return the file."""
        file: IO[bytes] = tempfile.TemporaryFile(dir=self._state.database.path.parent)  # noqa: SIM115  closed below
        try:
            convert = _FORMATS[name][0]
            contacts = self._contacts(query, file, progress, counts=convert is not None)
            if convert is None:
                add_kmz(file, contacts, lambda contact: self._image(contact, file, progress))
            else:
                file.write(convert(contacts))
            progress.size_bytes = file.tell()
        except BaseException:
            file.close()
            raise
        return file

    def _contacts(self, query: ContactFilter, file: IO[bytes], progress: ExportProgress, *, counts: bool) -> ContactSet:
        """Read the contacts; `counts` is whether reading them is the main part of the work."""
        with self._state.database.read() as db:
            versions = list_versions(db, query, MAX_CONTACTS + 1)
        if len(versions) > MAX_CONTACTS:
            raise ApiError(413, "too_large", f"more than {MAX_CONTACTS} contacts: select fewer in the queue")
        progress.total = len(versions)
        found: list[ExportContact] = []
        for contact_id, version in versions:
            self._check(file, progress)
            # Other requests use the database between two contacts.
            with self._state.database.read() as db:
                contact = find_export_contact(db, contact_id, version)
            if contact is not None:
                found.append(contact)
            progress.done += counts
        contacts = ContactSet(tuple(found), (), ())
        if not counts:
            progress.total = len(contacts.located)  # only these have an image in a KMZ
        return contacts

    def _image(self, contact: ExportContact, file: IO[bytes], progress: ExportProgress) -> ContactImage | None:
        self._check(file, progress)
        progress.done += 1
        if not contact.image.codec:
            return None
        image = self._state.image(contact.uid, contact.image.version)
        with self._state.database.read() as db:
            lines = picture_lines(list_measurements(db, contact.uid))
        return ContactImage(rendering.eight_bits(image.picture.to_array()), image.missing(), lines)

    def _check(self, file: IO[bytes], progress: ExportProgress) -> None:
        """Check for a cancellation, the size of an export and the free space between two contacts."""
        progress.size_bytes = file.tell()
        if progress.cancelled:
            raise ApiError(409, "cancelled", "the export was cancelled")
        if self._stopped:
            raise ApiError(503, "busy", "the console is stopping")
        if progress.size_bytes > MAX_BYTES:
            raise ApiError(413, "too_large", f"more than {MAX_BYTES >> 20} MiB: select fewer contacts in the queue")
        if shutil.disk_usage(self._state.database.path.parent).free < HANDLING_RESERVE_BYTES:
            raise OSError(errno.ENOSPC, "the disk reserve is reached")
