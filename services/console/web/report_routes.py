"""Routes of printable reports."""

from __future__ import annotations

from typing import Final

from starlette.responses import Response
from starlette.routing import Route

from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contacts import ContactFilter, NotFoundError, list_versions
from sonarpost.services.console.store.exports import find_export_contact, picture_lines
from sonarpost.services.console.store.measurements import list_measurements
from sonarpost.services.console.web.access import AccessControl, ApiError, Call
from sonarpost.services.console.web.report import ReportContact, report_html

MAX_SHEETS: Final = 200
"""Contacts of one document; a sheet is about 0.3 MB."""


class ReportRoutes:
    """Reports of one contact and of all contacts of a filter; `training` marks them as simulated."""

    def __init__(self, state: ConsoleState, *, training: bool) -> None:
        self._state = state
        self._training = training

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/report", access.endpoint(self._sheets)),
            Route("/report/{id}", access.endpoint(self._report)),
        ]

    def _report(self, call: Call) -> Response:
        contact_id = str(call.request.path_params["id"])
        contact = self._contact(contact_id)
        return self._response([contact], f"Contact {contact.contact.name}", contact.contact.name.replace("/", "-"))

    def _sheets(self, call: Call) -> Response:
        query = call.parse_query(ContactFilter)
        with self._state.database.read() as db:
            versions = list_versions(db, query, MAX_SHEETS + 1)
        if len(versions) > MAX_SHEETS:
            raise ApiError(413, "too_large", f"more than {MAX_SHEETS} contacts: select fewer in the queue")
        return self._response([self._contact(contact_id) for contact_id, _ in versions], "Contacts", "contacts")

    def _contact(self, contact_id: str) -> ReportContact:
        detail = self._state.contact_detail(contact_id)
        contact = detail["contact"]
        assert isinstance(contact, dict)
        version = int(contact["version"])
        with self._state.database.read() as db:
            exported = find_export_contact(db, contact_id, version)
            lines = picture_lines(list_measurements(db, contact_id))
        if exported is None:
            raise NotFoundError("contact", "version", version, f"a version of {contact_id}")
        return ReportContact(detail, exported, self._state.image(contact_id, version), lines)

    def _response(self, contacts: list[ReportContact], title: str, name: str) -> Response:
        text = report_html(contacts, self._state.clock(), title, training=self._training)
        headers = {"Content-Disposition": f'inline; filename="{name}.html"'}
        return Response(text, media_type="text/html; charset=utf-8", headers=headers)
