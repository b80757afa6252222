"""Routes of printable reports."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import IO, Final

from starlette.responses import Response
from starlette.routing import Route

from sonarpost.limits import limit
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contacts import ContactFilter, NotFoundError
from sonarpost.services.console.store.exports import find_stored_contact
from sonarpost.services.console.web.access import AccessControl, ApiError, Call
from sonarpost.services.console.web.export_routes import SURFACE, DocumentContacts, ExportRoutes
from sonarpost.services.console.web.report import ReportContact, report_parts

MAX_SHEETS: Final = limit(200, "contacts", "claims", SURFACE, "user", "sheets of 0.3 MB in a document", "413")


class ReportRoutes:
    """Reports of one contact and of all contacts of a filter; `training` marks them as simulated."""

    def __init__(self, state: ConsoleState, exports: ExportRoutes, *, training: bool) -> None:
        self._state = state
        self._exports = exports
        self._training = training

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/report", access.endpoint(self._sheets)),
            Route("/report/{id}", access.endpoint(self._report)),
        ]

    def _report(self, call: Call) -> Response:
        detail = self._state.contact_detail(str(call.request.path_params["id"]))
        contact = detail["contact"]
        assert isinstance(contact, dict)
        contact_id, version = str(contact["id"]), int(contact["version"])
        with self._state.database.read() as db:
            stored = find_stored_contact(db, contact_id, version)
        if stored is None:
            raise NotFoundError("contact", "version", version, f"a version of {contact_id}")
        name = stored.contact.name
        text = "".join(self._parts([ReportContact(detail, stored)], f"Contact {name}"))
        return Response(text, headers=_headers(name.replace("/", "-")))

    def _sheets(self, call: Call) -> Response:
        def write(file: IO[bytes], contacts: DocumentContacts) -> None:
            if len(contacts) > MAX_SHEETS:
                raise ApiError(413, "too_large", f"more than {MAX_SHEETS} contacts: select fewer in the queue")
            sheets = (ReportContact(self._state.contact_detail(one.uid), contacts.stored(one)) for one in contacts)
            for part in self._parts(sheets, "Contacts"):
                file.write(part.encode())

        query = call.parse_query(ContactFilter)
        return self._exports.document(call, "contacts.html", _headers("contacts"), query, write)

    def _parts(self, contacts: Iterable[ReportContact], title: str) -> Iterator[str]:
        return report_parts(contacts, self._state.clock(), title, training=self._training)


def _headers(name: str) -> dict[str, str]:
    return {
        "Content-Disposition": f'inline; filename="{name}.html"',
        "Content-Type": "text/html; charset=utf-8",
    }
