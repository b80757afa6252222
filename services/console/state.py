"""State of the console without a network: stores what arrives, answers queries, stores operators' actions."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType

from sonarpost import wire
from sonarpost.messages import (
    Advice,
    Command,
    CommandKind,
    Decision,
    DownlinkState,
    QueueState,
    ReceivedStatus,
    ReconstructedImage,
    TaskingState,
)
from sonarpost.modem.interface import ModemCapabilities, RateInfo
from sonarpost.modem.registry import modem_driver
from sonarpost.review.costs import NEW_IMAGE_KINDS, RequestCost, request_cost
from sonarpost.review.measurement import Line, measure_line, summary
from sonarpost.review.objects import AssociationRule
from sonarpost.services.console.chain import RouterState
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.events import EventHub
from sonarpost.services.console.fleet import FleetMonitor, fleet_json
from sonarpost.services.console.store import (
    air_time,
    association,
    contacts,
    decisions,
    measurements,
    objects,
    request_results,
    requests,
    tracks,
)
from sonarpost.services.console.store import truth as known_truth
from sonarpost.services.console.store.contacts import ContactCounts, ContactFilter, NotFoundError
from sonarpost.services.console.store.database import (
    ID_COLUMN,
    RECORD_TYPES,
    Actor,
    Database,
    DisplayedImage,
    Table,
    find_record,
)
from sonarpost.services.console.store.decisions import DecisionInput, DeliveryStates
from sonarpost.services.console.store.measurements import NOT_WITHDRAWN
from sonarpost.services.console.store.related_images import related_images_json
from sonarpost.services.console.store.retention import remove_images
from sonarpost.services.console.store.serialisers import (
    RECORD_JSON,
    Json,
    audit_json,
    contact_json,
    contact_record_json,
    decode_image,
    list_records,
    version_json,
)
from sonarpost.services.console.store.truth import Truth

FRAME_HEADER_BYTES = 13
"""Header of a frame in the format of the paper; a v1 header is shorter."""

LAST_DECISION_S = 12 * 3600.0
"""Age of the oldest decision that an operator undoes without naming it: one watch."""


OP_MODEM = "op_modem"
"""Service that transmits requests to vehicles."""


@dataclass(frozen=True, slots=True)
class UnsentRecord:
    """A stored record that is not yet in the service's outbox.

    Attributes:
        to_vehicle: Whether a decision is sent to the vehicle; false for one that a disputed contact does not follow.
    """

    table: Table
    record_id: str
    vessel_id: str
    record: Decision | Command | Advice
    to_vehicle: bool = True


class ConsoleState:
    """The console's state. Every change is stored in the database, and published as an event.

    Every method that changes the state raises DeliveryError if the database refuses the change. A method raises
    NotFoundError for an unknown contact identifier or version.

    Attributes:
        clock: UTC seconds.
        modem: Capabilities of the vessel's modem; by default those of the default driver.
        router: Connection to the router; None for a console without a network.
        rule: Limits of the association of looks.
        on_unsent: Called after an action has stored a record to send.
    """

    def __init__(
        self,
        config: ConsoleConfig,
        database: Database,
        clock: Callable[[], float] = time.time,
        modem: ModemCapabilities | None = None,
    ) -> None:
        modem = modem or modem_driver().capabilities
        self.rates = modem.rates
        self.downlink_rate = config.rate_of(modem)
        self.config = config
        self.database = database
        self.events = EventHub()
        self.fleet = FleetMonitor(config.vehicle_stale_s, modem.rates)
        self.rule = AssociationRule(config.group_radius_m, config.mission_gap_s)
        self.clock = clock
        self.router: RouterState | None = None
        self.on_unsent: Callable[[], None] = lambda: None

    # Records from other services

    def store_image(self, image: ReconstructedImage, truth: Truth | None = None) -> bool:
        """Store an image version, and its object if it is known; return whether the version is new."""
        stored = self._store_images([image], {} if truth is None else {image.image_id: truth})
        for contact_id, is_new_contact in stored:
            self.publish_contact(contact_id, new=is_new_contact)
        return bool(stored)

    def store_images(
        self, images: Sequence[ReconstructedImage], truths: Mapping[str, Truth] = MappingProxyType({})
    ) -> int:
        """Store several image versions in one transaction; return how many are new. Pages reload all data.

        Args:
            images: The image versions.
            truths: Known objects by image identifier.
        """
        stored = self._store_images(images, truths)
        if stored:
            self.events.publish("reset", {})
        return len(stored)

    def _store_images(
        self, images: Sequence[ReconstructedImage], truths: Mapping[str, Truth]
    ) -> list[tuple[str, bool]]:
        """Return the identifier of each changed contact, and whether it is new."""
        now, new_versions = self.clock(), []
        with self.database.transaction() as db:
            for image in images:
                rate = self.fleet.uplink_rate(image.vehicle_id, self.config.assumed_rate)
                stored = contacts.store_image(db, image, rate, now, self.rule)
                if stored is None:
                    continue
                contact_id, is_new_contact = stored.contact_id, stored.is_new_contact
                if is_new_contact:
                    decisions.attach_waiting_records(db, contact_id, now)
                    if image.image_id in truths:
                        known_truth.add_truth(db, contact_id, truths[image.image_id], now)
                own, *others = request_results.contacts_with_requests(db, contact_id)
                for changed in (own, *others):
                    request_results.update_results(db, changed, now)
                # An image that answers a request is a layer of its contact.
                new_versions.append((own, is_new_contact and own == contact_id))
                new_versions += [(other, False) for other in (*others, *sorted(stored.changed))]
        return new_versions

    def store_decision(self, record: Decision) -> bool:
        """Store a decision of another program or console; return whether it is new."""
        with self.database.transaction() as db:
            known = find_record(db, "decision", record.decision_id) is not None
            at_shore = self.config.role == "shore"
            contact_id = decisions.store_received_decision(db, record, self.clock(), at_shore=at_shore)
        if contact_id is not None:
            self.publish_contact(contact_id)
            self._publish_other_looks(contact_id)
            self._publish("decision", record.decision_id)
        return not known

    def store_advice(self, record: Advice) -> None:
        """Store a comment from the shore site."""
        with self.database.transaction() as db:
            contact_id = requests.store_received_advice(db, record)
        if contact_id is not None:
            self.publish_contact(contact_id)
            self._publish("advice", record.advice_id)

    def store_status(self, record: ReceivedStatus) -> None:
        """Store the status of a vehicle. The pages show it with the next fleet event."""
        with self.database.transaction() as db:
            tracks.store_status(db, record)

    def apply_downlink_state(self, state: DownlinkState) -> None:
        """Update the delivery of a decision or request to a vehicle."""
        with self.database.transaction() as db:
            if state.kind == "decision":
                changed = decisions.apply_downlink_state(db, state)
                contact_id = None
            else:
                changed, contact_id = False, requests.apply_downlink_state(db, state)
        if changed:
            self._publish("decision", state.record_id)
        elif contact_id is not None:
            self._publish("request", state.record_id)
            self.publish_contact(contact_id)

    def apply_tasking_state(self, state: TaskingState) -> None:
        """Update the delivery of a request or comment to a vessel."""
        with self.database.transaction() as db:
            changed = requests.apply_tasking_state(db, state)
        if changed is not None:
            self._publish(changed[0], state.record_id)

    def apply_acknowledgement(self, table: Table, record_id: str, consumer: str, reason: str | None) -> None:
        """Update a record after a consumer has stored it (`reason` None) or refused it."""
        now = self.clock()
        contact_id = None
        with self.database.transaction() as db:
            if table == "decision":
                contact_id = decisions.apply_acknowledgement(db, record_id, consumer, reason, now)
            elif table == "request":
                state = "asked" if reason is None else "refused"
                contact_id = requests.update_request_state(db, record_id, state, reason or "", None, now)
            elif reason is not None:
                contact_id = requests.refuse_advice(db, record_id, reason)
        if contact_id:
            self._publish(table, record_id)
            self.publish_contact(contact_id)

    def mark_delivered_to_shore(self, before_utc_s: float) -> None:
        """Mark decisions that the relay stored before a time as delivered to shore."""
        with self.database.read() as db:
            if db.execute("SELECT 1 FROM decision WHERE shore = 'relay' LIMIT 1").fetchone() is None:
                return
        with self.database.transaction() as db:
            delivered = decisions.mark_delivered_to_shore(db, before_utc_s)
        for decision_id in delivered:
            self._publish("decision", decision_id)

    # Events

    def publish_contact(self, contact_id: str, *, new: bool = False) -> None:
        """Publish a contact after a change."""
        event = {"contact": self._contact_json(contact_id), "new": new, **asdict(self.counts())}
        self.events.publish("contact", event)

    def publish_contacts(self, contact_ids: Iterable[str]) -> None:
        """Publish contacts that have changed."""
        for contact_id in sorted(contact_ids):
            self.publish_contact(contact_id)

    def _publish_other_looks(self, contact_id: str) -> None:
        """Publish the other looks of a contact's object: their state depends on its verdict."""
        with self.database.read() as db:
            others = association.other_looks(db, contact_id)
        self.publish_contacts(others)

    def _publish(self, table: Table, record_id: str) -> Json:
        """Publish a decision, request or comment; return it."""
        with self.database.read() as db:
            row = find_record(db, table, record_id)
        assert row is not None
        body = RECORD_JSON[table](row)
        if row["contact_id"]:
            self.events.publish(table, {"id": row["contact_id"], table: body})
        return body

    def _publish_action(self, table: Table, contact_id: str, record_id: str) -> Json:
        """Publish a new decision, request or comment of this console; return it."""
        self.on_unsent()
        self.publish_contact(contact_id)
        return self._publish(table, record_id)

    # Queries

    def remove_images(self, now_utc_s: float) -> int:
        """Apply the retention to stored images; return the number of removed versions."""
        with self.database.transaction() as db:
            return remove_images(db, now_utc_s, self.config.retain_days, self.config.max_bytes)

    def counts(self) -> ContactCounts:
        """Count the contacts."""
        with self.database.read() as db:
            return contacts.count_contacts(db)

    def list_contacts(self, query: ContactFilter) -> Json:
        """Return a page of the contacts."""
        with self.database.read() as db:
            return contacts.list_contacts(db, query)

    def contact_detail(self, contact_id: str) -> Json:
        """Return all data of a contact."""
        contact = self._contact_json(contact_id)
        with self.database.read() as db:
            versions = db.execute(
                "SELECT * FROM version WHERE contact_id = ? ORDER BY version", (contact_id,)
            ).fetchall()
            looks: object = []
            if contact["group"] is not None:
                looks = contacts.list_contacts(db, ContactFilter(group=str(contact["group"])))["items"]
            measured = measurements.list_measurements(db, contact_id)
            truth = known_truth.truth_json(db, contact_id, self.clock(), self.config.take_back_s)
            earlier = association.earlier_contacts(db, contact_id, self.rule)
            audit = db.execute("SELECT * FROM audit WHERE contact_id = ? ORDER BY seq", (contact_id,))
            refine_base = contacts.find_contact(db, contact_id)["refine_base"]
            return {
                "contact": contact,
                "record": contact_record_json(decode_image(versions[-1])),
                "versions": [version_json(row, self.rates, refine_base) for row in versions],
                "related": related_images_json(db, contact_id, self.rates),
                "decisions": list_records(db, "decision", contact_id),
                "standing": decisions.standing_decisions(db, contact_id),
                "advice": list_records(db, "advice", contact_id),
                "requests": list_records(db, "request", contact_id),
                "measurements": measured,
                "size": summary(measured),
                "group": looks,
                "truth": truth,
                "earlier": [contact_json(contacts.find_contact(db, one)) for one in earlier],
                "audit": [audit_json(row) for row in audit],
                "costs": self.request_costs(contact_id),
            }

    def _contact_json(self, contact_id: str) -> Json:
        with self.database.read() as db:
            return contact_json(contacts.find_contact(db, contact_id))

    def image(self, contact_id: str, version: int) -> ReconstructedImage:
        """Return the record of an image version."""
        row = None
        if version < 2**31:  # larger numbers exceed the integers of SQLite
            with self.database.read() as db:
                row = contacts.find_version(db, contact_id, version)
        if row is None:
            raise NotFoundError("contact", "version", version, f"a version of {contact_id}")
        return decode_image(row)

    def request_costs(self, contact_id: str) -> list[Json]:
        """Return the cost of each kind of request for a contact."""
        found: list[Json] = []
        with self.database.read() as db:
            row = contacts.find_contact(db, contact_id)
            now, has_downlink = self.clock(), self._has_downlink
            obstacles = {
                kind: requests.find_obstacle(db, row, kind, now, has_downlink=has_downlink)
                for kind in requests.REQUEST_KINDS
            }
        vehicle_id = row["vehicle_id"]
        rate = self.fleet.uplink_rate(vehicle_id, self.config.assumed_rate)
        for kind, obstacle in obstacles.items():
            cost = self._request_cost(row, kind)
            found.append(
                {
                    "kind": kind,
                    "available": obstacle is None,
                    "reason": obstacle.text if obstacle else "",
                    "reason_code": obstacle and obstacle.code,
                    "downlink_s": cost.downlink_s,
                    "uplink_s": cost.uplink_s,
                    "airtime_s": cost.airtime_s,
                    "bytes": cost.bytes_wanted,
                    "packets": cost.packets,
                    "rate": rate,
                    "wait_s": self.fleet.queue_wait_s(vehicle_id, self.clock()),
                    "basis": cost.basis,
                }
            )
        return found

    @property
    def _has_downlink(self) -> bool:
        """Whether requests reach a vehicle: through op_modem, or from a shore site through c2."""
        return self.config.role == "shore" or OP_MODEM in self.config.command_consumers

    def _request_cost(self, row: sqlite3.Row, kind: CommandKind, stream_bytes: object = None) -> RequestCost:
        """Return the cost of a kind of request for a contact; `stream_bytes` is the length of a region's stream."""
        is_new_image = kind in (*NEW_IMAGE_KINDS, "region")
        bytes_total = self._first_stream_bytes(row) if is_new_image else row["bytes_total"]
        if isinstance(stream_bytes, int):
            bytes_total = stream_bytes
        return request_cost(
            kind,
            downlink_rate=self.downlink_rate,
            uplink_rate=self._rate(self.fleet.uplink_rate(row["vehicle_id"], self.config.assumed_rate)),
            bytes_received=0 if is_new_image else row["bytes_received"],
            bytes_total=bytes_total,
            loss=self.fleet.frame_loss(row["vehicle_id"]),
            overhead_bytes=FRAME_HEADER_BYTES,
        )

    def _first_stream_bytes(self, row: sqlite3.Row) -> int:
        """Return the length of a contact's stream before more detail was requested: that of a new image is similar."""
        with self.database.read() as db:
            versions = db.execute("SELECT * FROM version WHERE contact_id = ? ORDER BY version LIMIT 20", (row["id"],))
            lengths = (decode_image(version).bytes_total for version in versions)
            return next((length for length in lengths if length), row["bytes_total"])

    def _rate(self, number: int | None) -> RateInfo | None:
        return None if number is None else self.rates.get(number)

    def _uplink_rate(self, vehicle_id: str, queue: QueueState | None) -> RateInfo | None:
        """Return the rate of a vehicle's queue or, without one, its latest rate; None if unknown."""
        if queue is not None:
            return self._rate(queue.rate)
        return self._rate(self.fleet.uplink_rate(vehicle_id, self.config.assumed_rate))

    def air_time(self) -> Json:
        """Return the images that vehicles still send, with cost and gain, and the air time that verdicts gave back."""
        now = self.clock()
        with self.database.read() as db:
            vehicles = [
                air_time.vehicle_json(db, name, queue, self._uplink_rate(name, queue), now)
                for name in self.fleet.vehicle_names()
                for queue in (self.fleet.queue(name),)
            ]
            return {"vehicles": vehicles, "given_back": air_time.given_back_json(db)}

    def fleet_state(self) -> Json:
        """Return the present state of services and vehicles."""
        with self.database.read() as db:
            return fleet_json(self.fleet, db, self.config, self.router, self.clock())

    # Operators' actions

    def decide(self, contact_id: str, entered: DecisionInput, actor: Actor) -> Json:
        """Store a decision to send; return it with its contact.

        Raises:
            ConflictError, BadInputError: See `add_decision`.
        """
        with self.database.transaction() as db:
            states = self._delivery_states(db, contact_id)
            stored = decisions.add_decision(db, contact_id, entered, actor, self.clock(), states)
            if entered.verdict in air_time.FINAL and states.vehicle != "none":
                vehicle_id = contacts.find_contact(db, contact_id)["vehicle_id"]
                queue = self.fleet.queue(vehicle_id)
                rate = self._uplink_rate(vehicle_id, queue)
                air_time.store_given_back(db, stored.decision_id, contact_id, queue, rate, self.clock())
        decision = self._publish_action("decision", contact_id, stored.decision_id)
        self._publish_other_looks(contact_id)
        for user in stored.notified:
            self.events.publish("notice", {"user": user})
        return {"decision": decision, "contact": self._contact_json(contact_id)}

    def undo(self, contact_id: str, decision_id: str, displayed: DisplayedImage, actor: Actor) -> Json:
        """Store a record that withdraws an own decision; return it with its contact.

        If the decision is one of several on an object, the others are withdrawn too.

        Raises:
            BadInputError: See `undo_decision`.
        """
        with self.database.transaction() as db:
            states = self._delivery_states(db, contact_id)
            new_id = decisions.undo_decision(db, contact_id, decision_id, displayed, actor, self.clock(), states)
            others = objects.undo_rest(db, decision_id, actor, self.clock(), lambda one: self._delivery_states(db, one))
        self._publish("decision", decision_id)
        for other_id, other_decision in others:
            self._publish_action("decision", other_id, other_decision)
        decision = self._publish_action("decision", contact_id, new_id)
        self._publish_other_looks(contact_id)
        return {"decision": decision, "contact": self._contact_json(contact_id)}

    def object_detail(self, object_id: str) -> Json:
        """Return an object with its looks."""
        with self.database.read() as db:
            return objects.object_json(db, object_id, self.rule)

    def decide_object(self, object_id: str, entered: Mapping[str, DecisionInput], actor: Actor) -> Json:
        """Store one verdict on several looks of an object in one transaction; return the decisions and the object.

        Raises:
            BadInputError: See `objects.decide_object`.
        """
        with self.database.transaction() as db:
            stored = objects.decide_object(
                db, object_id, entered, actor, self.clock(), lambda one: self._delivery_states(db, one)
            )
        made = [self._publish_action("decision", contact_id, one.decision_id) for contact_id, one in stored]
        for user in sorted({user for _, one in stored for user in one.notified}):
            self.events.publish("notice", {"user": user})
        self._publish_other_looks(stored[0][0])
        with self.database.read() as db:
            # A sealed contact is not listed after its decision.
            remaining = (
                objects.object_json(db, object_id, self.rule) if association.looks_of_object(db, object_id) else None
            )
        return {"decisions": made, "object": remaining}

    def split_look(self, object_id: str, contact_id: str, actor: Actor) -> Json:
        """Separate a look from its object; return the object.

        Raises:
            BadInputError: See `objects.split_look`.
        """
        with self.database.transaction() as db:
            changed = objects.split_look(db, object_id, contact_id, self.rule, actor, self.clock())
        self.publish_contacts(changed)
        return self.object_detail(object_id)

    def merge_objects(self, object_id: str, contact_id: str, actor: Actor) -> Json:
        """Join the object of a contact with an object; return the joined object.

        Raises:
            BadInputError: See `objects.merge_objects`.
        """
        with self.database.transaction() as db:
            changed = objects.merge_objects(db, object_id, contact_id, self.rule, actor, self.clock())
            joined = association.object_of(db, contact_id)
        self.publish_contacts(changed)
        return self.object_detail(joined)

    def last_decision(self, user: str) -> Json:
        """Return the last decision of a user that can be undone, with its contact; both None if there is none."""
        with self.database.read() as db:
            row = decisions.last_own_decision(db, user, self.clock() - LAST_DECISION_S)
        if row is None:
            return {"decision": None, "contact": None}
        return {"decision": RECORD_JSON["decision"](row), "contact": self._contact_json(row["contact_id"])}

    def notices(self, user: str) -> list[Json]:
        """Return the open notices of a user about disputed and overruled decisions."""
        with self.database.read() as db:
            return decisions.list_notices(db, user)

    def acknowledge_notice(self, notice_id: int, actor: Actor) -> None:
        """Mark a notice as acknowledged.

        Raises:
            NotFoundError: The user has no such notice.
        """
        with self.database.transaction() as db:
            decisions.acknowledge_notice(db, notice_id, actor, self.clock())
        self.events.publish("notice", {"user": actor.user})

    def _delivery_states(self, db: sqlite3.Connection, contact_id: str) -> DeliveryStates:
        """Return the initial delivery of a decision; one on a sealed contact is never sent."""
        consumers = () if known_truth.is_sealed(db, contact_id) else self.config.decision_consumers
        shore, vehicle = ("waiting" if name in consumers else "none" for name in ("relay", "op_modem"))
        return DeliveryStates(shore, vehicle, self.config.take_back_s)

    def add_request(
        self,
        contact_id: str,
        kind: CommandKind,
        airtime_s: float | None,
        actor: Actor,
        arguments: Mapping[str, object] | None = None,
    ) -> Json:
        """Store a request to send; return it. `arguments` are further fields of the command.

        Raises:
            BadInputError: The request is not possible, or one of this kind is in progress.
        """
        now = self.clock()
        with self.database.transaction() as db:
            row = contacts.find_contact(db, contact_id)
            command_id = requests.add_request(
                db,
                contact_id,
                kind,
                airtime_s,
                actor,
                now,
                cost=self._request_cost(row, kind, (arguments or {}).get("stream_bytes")),
                arguments=arguments or {},
                wait_s=self.fleet.queue_wait_s(row["vehicle_id"], now),
                has_downlink=self._has_downlink,
            )
            if known_truth.is_sealed(db, contact_id):
                db.execute("UPDATE request SET sent = 1 WHERE command_id = ?", (command_id,))
        return self._publish_action("request", contact_id, command_id)

    def add_advice(self, contact_id: str, record: Advice, actor: Actor) -> Json:
        """Store a comment to send; return it."""
        self.image(contact_id, record.image_version)
        with self.database.transaction() as db:
            requests.add_advice(db, contact_id, record, actor)
        return self._publish_action("advice", contact_id, record.advice_id)

    def measure(self, contact_id: str, line: Line, actor: Actor, *, keep: bool) -> Json:
        """Measure a line on an image, and optionally store the measurement.

        Raises:
            NotMeasurableError: This part of the image cannot be measured.
        """
        image = self.image(contact_id, line.version)
        now = self.clock()
        body = {**measure_line(image, line), "user": actor.user, "utc_s": now}
        if not keep:
            return {"id": None, **body, **NOT_WITHDRAWN}
        displayed = DisplayedImage(line.version, image.picture_sha256, line.layer)
        with self.database.transaction() as db:
            measurement_id = measurements.add_measurement(db, contact_id, body, displayed, actor, now)
        return {"id": measurement_id, **body, **NOT_WITHDRAWN}

    def withdraw_measurement(self, contact_id: str, measurement_id: int, actor: Actor) -> Json:
        """Withdraw a stored measurement; return it.

        Raises:
            NotFoundError: The contact has no such measurement, or it is withdrawn.
        """
        if measurement_id >= 2**31:  # larger numbers exceed the integers of SQLite
            raise NotFoundError("measurement", "id", measurement_id, f"a measurement of {contact_id}")
        with self.database.transaction() as db:
            return measurements.withdraw_measurement(db, contact_id, measurement_id, actor, self.clock())

    # Sending

    def unsent_records(self) -> list[UnsentRecord]:
        """Return the stored records that are not yet in the outbox, oldest first.

        A decision is returned after its take-back time, and cannot be taken back unsent from then on.
        """
        found: list[UnsentRecord] = []
        with self.database.transaction() as db:
            decisions.release_decisions(db, self.clock(), self.config.take_back_s)
            for table, record_type in RECORD_TYPES.items():
                condition = "sent = 0 AND send_after_utc_s IS NULL" if table == "decision" else "sent = 0"
                rows = db.execute(f"SELECT * FROM {table} WHERE {condition} ORDER BY seq")  # noqa: S608  constants only
                for row in rows:
                    record_id = row[ID_COLUMN[table]]
                    record = wire.decode(record_type, bytes(row["payload"]), f"{table} {record_id}")
                    to_vehicle = table != "decision" or row["vehicle"] != "disputed"
                    found.append(UnsentRecord(table, record_id, row["vessel_id"], record, to_vehicle))
        return found

    def mark_sent(self, item: UnsentRecord) -> None:
        """Mark a record as queued in the outbox."""
        with self.database.transaction() as db:
            db.execute(
                f"UPDATE {item.table} SET sent = 1 WHERE {ID_COLUMN[item.table]} = ?",  # noqa: S608  constants only
                (item.record_id,),
            )
