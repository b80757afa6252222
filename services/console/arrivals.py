"""What arrives changes what the console knows, and the pages that are open hear of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict

from sonarpost.errors import BadInputError
from sonarpost.messages import (
    Advice,
    Decision,
    DownlinkState,
    ReconstructedImage,
    TaskingState,
)
from sonarpost.services.console import asking, contacts, decisions
from sonarpost.services.console.asking import ID_COLUMN, Table
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.contacts import Counts
from sonarpost.services.console.database import Database
from sonarpost.services.console.events import Hub
from sonarpost.services.console.fleet import FleetPanel
from sonarpost.services.console.rows import (
    Json,
    advice_of,
    contact_row,
    decision_of,
    request_of,
)


class NoSuchError(BadInputError):
    """There is no such contact, version or file."""


class Arrivals:
    """What arrives, and what pages hear of it.

    Args:
        config: Of the console.
        database: Where everything is kept.
        clock: UTC seconds.
    """

    def __init__(self, config: ConsoleConfig, database: Database, clock: Callable[[], float] = time.time) -> None:
        self.config = config
        self.database = database
        self.hub = Hub()
        self.fleet = FleetPanel(config.vehicle_stale_s)
        self.clock = clock
        self.on_unsent: Callable[[], None] = lambda: None

    # What arrives

    def take_image(self, image: ReconstructedImage) -> bool:
        """Keep a version of a picture; tell whether it was new.

        Raises:
            HandoffError: It cannot be kept now.
        """
        now = self.clock()
        rate = self.fleet.rate_of(image.vehicle_id, self.config.assumed_rate)
        with self.database.writing() as db:
            taken = contacts.take_image(db, image, rate, now, self.config.group_radius_m)
            if taken is not None and taken[1]:
                decisions.adopt(db, taken[0], now)
        if taken is None:
            return False
        self._tell_contact(taken[0], new=taken[1])
        return True

    def take_images(self, images: Sequence[ReconstructedImage]) -> int:
        """Keep many versions with one write to the disk; return how many were new. Pages load anew.

        Raises:
            HandoffError: They cannot be kept now; none is.
        """
        now, new = self.clock(), 0
        with self.database.writing() as db:
            for image in images:
                rate = self.fleet.rate_of(image.vehicle_id, self.config.assumed_rate)
                taken = contacts.take_image(db, image, rate, now, self.config.group_radius_m)
                if taken is not None and taken[1]:
                    decisions.adopt(db, taken[0], now)
                new += taken is not None
        if new:
            self.hub.publish("reset", {})
        return new

    def take_decision(self, record: Decision) -> bool:
        """Keep a decision made elsewhere; tell whether it was new."""
        with self.database.writing() as db:
            known = decisions.find(db, record.decision_id) is not None
            contact_id = decisions.take(db, record, self.clock(), ashore=self.config.role == "shore")
        if contact_id is not None:
            self._tell_contact(contact_id)
            self._tell_decision(record.decision_id)
        return not known

    def take_advice(self, record: Advice) -> None:
        """Keep advice from ashore."""
        with self.database.writing() as db:
            contact_id = asking.take_advice(db, record)
        if contact_id is not None:
            self._tell_contact(contact_id)
            self._tell("advice", contact_id, record.advice_id)

    def take_downlink(self, state: DownlinkState) -> None:
        """Note how far something has come on its way to a vehicle."""
        with self.database.writing() as db:
            if state.kind == "decision":
                changed = decisions.downlink(db, state)
                contact_id = None
            else:
                changed, contact_id = False, asking.downlink(db, state)
        if changed:
            self._tell_decision(state.record_id)
        elif contact_id is not None:
            self._tell("request", contact_id, state.record_id)
            self._tell_contact(contact_id)

    def take_tasking(self, state: TaskingState) -> None:
        """Note how far advice or a command has come on its way to a vessel."""
        with self.database.writing() as db:
            changed = asking.tasking(db, state)
        if changed is not None:
            self._tell(changed[0], changed[1], state.record_id)

    def settled(self, table: Table, record_id: str, consumer: str, reason: str | None) -> None:
        """Note that a consumer has a record on its disk (None), or refused it for a reason."""
        now = self.clock()
        contact_id = None
        with self.database.writing() as db:
            if table == "decision":
                if decisions.handed(db, record_id, consumer, reason, now):
                    row = decisions.find(db, record_id)
                    contact_id = row and str(row["contact_id"])
            elif table == "request":
                state = "refused" if reason is not None else "asked"
                contact_id = asking.request_state(db, record_id, state, reason or "", None, now)
            elif reason is not None:
                db.execute(
                    "UPDATE advice SET state = 'refused', reason = ? WHERE advice_id = ? AND state = 'waiting'",
                    (reason, record_id),
                )
                row = db.execute("SELECT contact_id FROM advice WHERE advice_id = ?", (record_id,)).fetchone()
                contact_id = row and str(row["contact_id"])
        if contact_id:
            self._tell(table, contact_id, record_id)
            self._tell_contact(contact_id)

    def all_ashore_before(self, utc_s: float) -> None:
        """Note that decisions which the relay had before a time are ashore."""
        with self.database.reading() as db:
            waiting = db.execute("SELECT 1 FROM decision WHERE shore = 'relay' LIMIT 1").fetchone()
        if waiting is None:
            return
        with self.database.writing() as db:
            found = decisions.ashore_before(db, utc_s)
        for decision_id in found:
            self._tell_decision(decision_id)

    def counts(self) -> Counts:
        """Count the contacts."""
        with self.database.reading() as db:
            return contacts.counts(db)

    # Telling the pages

    def _row(self, contact_id: str) -> Json:
        with self.database.reading() as db:
            row = contacts.find_row(db, contact_id)
        if row is None:
            raise NoSuchError("contact", "id", contact_id, "a contact")
        return contact_row(row)

    def _tell_contact(self, contact_id: str, *, new: bool = False) -> None:
        self.hub.publish("contact", {"contact": self._row(contact_id), "new": new, **asdict(self.counts())})

    def _tell_decision(self, decision_id: str) -> None:
        with self.database.reading() as db:
            row = decisions.find(db, decision_id)
        if row is not None and row["contact_id"]:
            self.hub.publish("decision", {"id": row["contact_id"], "decision": decision_of(row)})

    def _tell(self, table: Table, contact_id: str, record_id: str) -> None:
        if table == "decision":
            self._tell_decision(record_id)
            return
        with self.database.reading() as db:
            row = db.execute(f"SELECT * FROM {table} WHERE {ID_COLUMN[table]} = ?", (record_id,)).fetchone()  # noqa: S608
        body = request_of(row) if table == "request" else advice_of(row)
        self.hub.publish(table, {"id": contact_id, table: body})
