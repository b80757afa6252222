"""Everything the console knows and does, without a network: what arrives changes it, pages hear of every change."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

from sonarpost import wire
from sonarpost.messages import (
    Advice,
    Command,
    CommandKind,
    Decision,
    ReconstructedImage,
)
from sonarpost.review.costs import request_cost
from sonarpost.services.console import asking, audit, contacts, decisions
from sonarpost.services.console.arrivals import Arrivals, NoSuchError
from sonarpost.services.console.asking import ID_COLUMN, Table
from sonarpost.services.console.audit import OnScreen
from sonarpost.services.console.contacts import Filter
from sonarpost.services.console.decisions import DecisionInput
from sonarpost.services.console.measures import Line, measured
from sonarpost.services.console.people import Actor
from sonarpost.services.console.rows import (
    Json,
    advice_of,
    audit_of,
    contact_row,
    decision_of,
    image_of,
    record_of,
    request_of,
    version_of,
)

FRAME_HEADER_BYTES = 13
"""Of a frame of the paper's format; v1's are shorter."""


@dataclass(frozen=True, slots=True)
class Unsent:
    """A record that is written down and not handed on yet."""

    table: Table
    record_id: str
    vessel_id: str
    record: Decision | Command | Advice


class Board(Arrivals):
    """The console's state: what has arrived, what people see of it, and what they do."""

    # What people see

    def contacts(self, wanted: Filter) -> Json:
        """Return a page of the contacts."""
        with self.database.reading() as db:
            return contacts.list_contacts(db, wanted)

    def contact(self, contact_id: str) -> Json:
        """Return everything about a contact.

        Raises:
            NoSuchError: There is none.
        """
        with self.database.reading() as db:
            row = contacts.find_row(db, contact_id)
            if row is None:
                raise NoSuchError("contact", "id", contact_id, "a contact")
            versions = db.execute("SELECT * FROM version WHERE contact_id = ? ORDER BY version", (contact_id,))
            rows = versions.fetchall()
            group = wanted = contact_row(row)["group"]
            looks = [] if group is None else contacts.list_contacts(db, Filter(group=str(wanted), limit=100))["items"]
            measurements = db.execute(
                "SELECT id, body FROM measurement WHERE contact_id = ? ORDER BY id", (contact_id,)
            )
            entries = db.execute("SELECT * FROM audit WHERE contact_id = ? ORDER BY seq", (contact_id,))
            return {
                "contact": contact_row(row),
                "record": record_of(image_of(rows[-1])),
                "versions": [version_of(version) for version in rows],
                "decisions": decisions.of_contact(db, contact_id),
                "advice": asking.advice_for(db, contact_id),
                "requests": asking.requests_of(db, contact_id),
                "measurements": [{**json.loads(m["body"]), "id": m["id"]} for m in measurements],
                "group": looks,
                "audit": [audit_of(entry) for entry in entries],
            }

    def image(self, contact_id: str, version: int) -> ReconstructedImage:
        """Return the record of a version of a contact's picture.

        Raises:
            NoSuchError: There is none.
        """
        row = None
        if version < 2**31:  # SQLite's integers end, a request's do not
            with self.database.reading() as db:
                row = contacts.find_version(db, contact_id, version)
        if row is None:
            raise NoSuchError("contact", "version", version, f"a version of {contact_id}")
        return image_of(row)

    def costs(self, contact_id: str) -> list[Json]:
        """Return what can be asked about a contact, and what it costs."""
        row = self._row(contact_id)
        rate = self.fleet.rate_of(str(row["vehicle_id"]), self.config.assumed_rate)
        loss = self.fleet.loss_of(str(row["vehicle_id"]))
        found: list[Json] = []
        with self.database.reading() as db:
            full = contacts.find_row(db, contact_id)
            assert full is not None
            first = contacts.find_version(db, contact_id, 1)
        # A wider picture is as long as this one was before more of it was asked for.
        new_bytes = (0 if first is None else image_of(first).bytes_total) or full["bytes_total"]
        for kind in asking.KINDS:
            reason = asking.why_not(full, kind)
            cost = request_cost(
                kind,
                downlink_rate=self.config.downlink_rate,
                uplink_rate=rate,
                bytes_received=0 if kind == "wider" else full["bytes_received"],
                bytes_total=new_bytes if kind == "wider" else full["bytes_total"],
                loss=loss,
                overhead_bytes=FRAME_HEADER_BYTES,
            )
            found.append(
                {
                    "kind": kind,
                    "available": not reason,
                    "reason": reason,
                    "downlink_s": cost.downlink_s,
                    "uplink_s": cost.uplink_s,
                    "airtime_s": cost.airtime_s,
                    "bytes": cost.bytes_wanted,
                    "packets": cost.packets,
                    "rate": rate,
                    "wait_s": self.fleet.wait_s(str(row["vehicle_id"]), self.clock()),
                    "basis": cost.basis,
                }
            )
        return found

    # What people do

    def decide(self, contact_id: str, judgement: DecisionInput, actor: Actor) -> Json:
        """Write a decision down, to be sent; return it with the contact.

        Raises:
            NoSuchError, ConflictError, BadInputError: There is no such contact, somebody was faster, or it is about a
                picture that this contact does not have.
            HandoffError: It cannot be kept now.
        """
        self._row(contact_id)
        with self.database.writing() as db:
            made = decisions.decide(db, contact_id, judgement, actor, self.clock(), self._ends())
        return self._decided(contact_id, made)

    def undo(self, contact_id: str, decision_id: str, revision: int, actor: Actor) -> Json:
        """Undo a decision by another; return that with the contact.

        Raises:
            NoSuchError, ConflictError, BadInputError, HandoffError: As `decide`.
        """
        self._row(contact_id)
        with self.database.writing() as db:
            made = decisions.undo(db, contact_id, decision_id, revision, actor, self.clock(), self._ends())
        return self._decided(contact_id, made)

    def _ends(self) -> tuple[str, str]:
        consumers = self.config.decision_consumers
        return "waiting" if "relay" in consumers else "none", "waiting" if "op_modem" in consumers else "none"

    def _decided(self, contact_id: str, decision_id: str) -> Json:
        self.on_unsent()
        self._tell_contact(contact_id)
        self._tell_decision(decision_id)
        with self.database.reading() as db:
            decision = decisions.find(db, decision_id)
            assert decision is not None
            return {"decision": decision_of(decision), "contact": self._row(contact_id)}

    def ask(self, contact_id: str, kind: CommandKind, airtime_s: float | None, actor: Actor) -> Json:
        """Write a request down, to be sent; return it."""
        self._row(contact_id)
        with self.database.writing() as db:
            command_id = asking.ask(db, contact_id, kind, airtime_s, actor, self.clock())
        self.on_unsent()
        self._tell("request", contact_id, command_id)
        self._tell_contact(contact_id)
        with self.database.reading() as db:
            return request_of(db.execute("SELECT * FROM request WHERE command_id = ?", (command_id,)).fetchone())

    def advise(self, contact_id: str, record: Advice, actor: Actor) -> Json:
        """Write advice down, to be sent; return it."""
        self.image(contact_id, record.image_version)
        with self.database.writing() as db:
            asking.advise(db, contact_id, record, actor)
        self.on_unsent()
        self._tell("advice", contact_id, record.advice_id)
        self._tell_contact(contact_id)
        with self.database.reading() as db:
            return advice_of(db.execute("SELECT * FROM advice WHERE advice_id = ?", (record.advice_id,)).fetchone())

    def measure(self, contact_id: str, line: Line, actor: Actor, *, keep: bool) -> Json:
        """Measure a line on a picture.

        Raises:
            NoSuchError: There is no such contact or version.
            NotMeasurableError: It cannot be measured there.
        """
        image = self.image(contact_id, line.version)
        body = measured(image, line)
        body |= {"user": actor.user, "utc_s": self.clock()}
        if not keep:
            return {"id": None, **body}
        with self.database.writing() as db:
            added = db.execute(
                "INSERT INTO measurement (contact_id, utc_s, body) VALUES (?, ?, ?)",
                (contact_id, body["utc_s"], json.dumps(body)),
            )
            screen = OnScreen(line.version, image.picture_sha256, line.layer)
            audit.write(db, contact_id, actor, "measure", self.clock(), screen, body)
        return {"id": added.lastrowid, **body}

    # Sending

    def unsent(self) -> list[Unsent]:
        """Return what is written down and not handed on, the oldest first."""
        types: Mapping[Table, type[Decision] | type[Command] | type[Advice]] = {
            "decision": Decision,
            "request": Command,
            "advice": Advice,
        }
        found: list[Unsent] = []
        with self.database.reading() as db:
            for table, record_type in types.items():
                rows = db.execute(
                    f"SELECT {ID_COLUMN[table]} AS id, vessel_id, payload FROM {table} WHERE sent = 0 ORDER BY seq"  # noqa: S608
                )
                for row in rows:
                    record = wire.decode(record_type, bytes(row["payload"]), f"{table} {row['id']}")
                    found.append(Unsent(table, row["id"], row["vessel_id"], record))
        return found

    def mark_sent(self, item: Unsent) -> None:
        """Note that a record is in the outbox."""
        with self.database.writing() as db:
            db.execute(
                f"UPDATE {item.table} SET sent = 1 WHERE {ID_COLUMN[item.table]} = ?",  # noqa: S608  constants only
                (item.record_id,),
            )
