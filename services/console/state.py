"""Everything the console knows and does, without a network: what arrives changes it, pages hear of every change."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass

from sonarpost import wire
from sonarpost.errors import BadInputError
from sonarpost.messages import (
    Advice,
    Command,
    CommandKind,
    Decision,
    DownlinkState,
    ReconstructedImage,
    TaskingState,
)
from sonarpost.review.costs import request_cost
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.events import Hub
from sonarpost.services.console.fleet import FleetPanel
from sonarpost.services.console.measures import Line, measured
from sonarpost.services.console.store import contacts, database, decisions, requests
from sonarpost.services.console.store.contacts import Counts, Filter
from sonarpost.services.console.store.database import Database, OnScreen
from sonarpost.services.console.store.decisions import DecisionInput
from sonarpost.services.console.store.requests import ID_COLUMN, Table
from sonarpost.services.console.store.serialisers import (
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
from sonarpost.services.console.store.users import Actor


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
            contact_id = requests.take_advice(db, record)
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
                changed, contact_id = False, requests.downlink(db, state)
        if changed:
            self._tell_decision(state.record_id)
        elif contact_id is not None:
            self._tell("request", contact_id, state.record_id)
            self._tell_contact(contact_id)

    def take_tasking(self, state: TaskingState) -> None:
        """Note how far advice or a command has come on its way to a vessel."""
        with self.database.writing() as db:
            changed = requests.tasking(db, state)
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
                contact_id = requests.request_state(db, record_id, state, reason or "", None, now)
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
                "advice": requests.advice_for(db, contact_id),
                "requests": requests.requests_of(db, contact_id),
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
        for kind in requests.KINDS:
            reason = requests.why_not(full, kind)
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
            command_id = requests.ask(db, contact_id, kind, airtime_s, actor, self.clock())
        self.on_unsent()
        self._tell("request", contact_id, command_id)
        self._tell_contact(contact_id)
        with self.database.reading() as db:
            return request_of(db.execute("SELECT * FROM request WHERE command_id = ?", (command_id,)).fetchone())

    def advise(self, contact_id: str, record: Advice, actor: Actor) -> Json:
        """Write advice down, to be sent; return it."""
        self.image(contact_id, record.image_version)
        with self.database.writing() as db:
            requests.advise(db, contact_id, record, actor)
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
            database.write(db, contact_id, actor, "measure", self.clock(), screen, body)
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
