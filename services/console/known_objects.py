"""Contacts whose object is known: those of training, and the sealed contacts of the calibrated watch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Protocol

from sonarpost.messages import CommandKind, ReconstructedImage
from sonarpost.registry import Registry
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store import requests, truth
from sonarpost.services.console.store.contacts import find_contact
from sonarpost.services.console.store.database import Actor
from sonarpost.services.console.store.serialisers import Json


@dataclass(frozen=True, slots=True)
class SealedRequest:
    """A request for a sealed contact without an answer.

    Attributes:
        contact_id: The contact.
        command_id: The request.
        kind: Kind of request.
        age_s: Time since the request.
        airtime_s: Displayed estimate of its air time; None if unknown.
    """

    contact_id: str
    command_id: str
    kind: CommandKind
    age_s: float
    airtime_s: float | None


class Watch(Protocol):
    """Adds sealed contacts to the queue of a console. Created with the state of the console and their share."""

    def start(self) -> None:
        """Start to add contacts and to answer their requests."""

    def stop(self) -> None:
        """Stop."""

    def contact_arrived(self, image: ReconstructedImage, now_s: float) -> None:
        """Note a new contact of a vehicle; `now_s` is monotonic."""


@cache
def watches() -> Registry[Callable[..., Watch]]:
    """Return the kinds of watch: see `sonarpost.registry`. The group of entry points is `sonarpost.watches`."""
    return Registry("sonarpost.watches", "a class of watches", lambda found, _: callable(found), {})


class KnownObjects:
    """Stores contacts with known objects, reveals the objects after decisions, and reads the score.

    Args:
        state: State of the console.
    """

    def __init__(self, state: ConsoleState) -> None:
        self._state = state

    def sealed_requests(self) -> list[SealedRequest]:
        """Return the requests for sealed contacts that have no answer."""
        now = self._state.clock()
        with self._state.database.read() as db:
            rows = db.execute(
                "SELECT r.contact_id, r.command_id, r.kind, r.asked_utc_s, r.airtime_s FROM request r"
                " JOIN truth t ON t.contact_id = r.contact_id"
                " WHERE t.sealed = 1 AND r.state IN ('waiting', 'asked', 'sent') ORDER BY r.seq"
            ).fetchall()
        return [SealedRequest(row[0], row[1], row[2], max(0.0, now - row[3]), row[4]) for row in rows]

    def advance_request(self, request: SealedRequest, step: str) -> None:
        """Set the delivery state of a request for a sealed contact."""
        with self._state.database.transaction() as db:
            requests.update_request_state(db, request.command_id, step, "", 1, self._state.clock())

    def newest_image(self, contact_id: str) -> ReconstructedImage:
        """Return the newest image version of a contact."""
        with self._state.database.read() as db:
            version = find_contact(db, contact_id)["version"]
        return self._state.image(contact_id, version)

    def reveal(self) -> None:
        """Reveal the objects of contacts whose decision can no longer be taken back."""
        with self._state.database.read() as db:
            if not truth.has_unrevealed(db):
                return
        with self._state.database.transaction() as db:
            truth.reveal(db, self._state.clock(), self._state.config.take_back_s)

    def score_sheet(self, actor: Actor) -> Json:
        """Return the scores that a user may see: experts those of all operators, others their own."""
        operator = None if actor.role == "expert" else actor.user
        with self._state.database.read() as db:
            return truth.score_sheet(db, operator, self._state.clock(), self._state.config.take_back_s)
