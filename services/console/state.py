"""State of the console without a network: stores what arrives, answers queries, stores operators' actions."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from types import MappingProxyType

from sonarpost.messages import (
    CommandKind,
    Comment,
    Decision,
    DownlinkState,
    ReceivedStatus,
    ReconstructedImage,
    TaskingState,
)
from sonarpost.modem.interface import ModemCapabilities
from sonarpost.modem.registry import modem_driver
from sonarpost.review.measurement import Line, measure_line
from sonarpost.review.objects import AssociationRule
from sonarpost.services.console.chain import RouterState
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.events import EventHub
from sonarpost.services.console.fleet import FleetMonitor, fleet_json
from sonarpost.services.console.store import (
    association,
    contacts,
    decisions,
    objects,
    requests,
    tracks,
)
from sonarpost.services.console.store import truth as known_truth
from sonarpost.services.console.store.contact_detail import (
    NOT_WITHDRAWN,
    add_measurement,
    contact_detail_json,
    withdraw_measurement,
)
from sonarpost.services.console.store.contacts import ContactCounts, ContactFilter, remove_images
from sonarpost.services.console.store.database import (
    Actor,
    Database,
    DisplayedImage,
    Table,
    UnsentRecord,
    find_record,
    mark_sent,
    unsent_records,
)
from sonarpost.services.console.store.decisions import DecisionInput, DeliveryStates
from sonarpost.services.console.store.requests import VehicleLink, costs_json
from sonarpost.services.console.store.serialisers import RECORD_JSON, Json, contact_json, find_image
from sonarpost.services.console.store.truth import Truth

LAST_DECISION_S = 12 * 3600.0
"""Age of the oldest decision that an operator undoes without naming it: one watch."""

OP_MODEM = "op_modem"
"""Service that transmits requests to vehicles."""

MAX_CONTACT_EVENTS = 60
"""Contacts changed by one transaction that are published one by one; pages reload all data after more.

A new look changes all looks of its object, of which at most 50 are connected: it is still published as new.
"""


class ConsoleState:
    """The console's state. Every change is stored in the database.

    The database reports the contacts that a transaction has changed, and each of them is published as one event
    `contact`. No method publishes contacts itself.

    Every method that changes the state raises DeliveryError if the database refuses the change. A method raises
    NotFoundError for an unknown contact identifier or version.

    Attributes:
        clock: UTC seconds.
        modem: Capabilities of the vessel's modem; by default those of the default driver.
        router: Connection to the router; None for a console without a network.
        rule: Limits of the association of looks.
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
        self.fleet = FleetMonitor()
        self.rule = AssociationRule(config.group_radius_m, config.mission_gap_s)
        self.clock = clock
        self.router: RouterState | None = None
        database.on_change = self._publish

    # Records from other services

    def store_image(self, image: ReconstructedImage, truth: Truth | None = None) -> bool:
        """Store an image version, and its object if it is known; return whether the version is new."""
        return self.store_images([image], {} if truth is None else {image.image_id: truth}) > 0

    def store_images(
        self, images: Sequence[ReconstructedImage], truths: Mapping[str, Truth] = MappingProxyType({})
    ) -> int:
        """Store several image versions in one transaction; return how many are new.

        Args:
            images: The image versions.
            truths: Known objects by image identifier.
        """
        now, count = self.clock(), 0
        with self.database.transaction() as db:
            for image in images:
                rate = self.fleet.uplink_rate(image.vehicle_id, self.config.assumed_rate)
                stored = contacts.store_image(db, image, rate, now, self.rule)
                if stored is None:
                    continue
                count += 1
                contact_id, is_new_contact = stored
                if is_new_contact:
                    decisions.attach_waiting_records(db, contact_id, now)
                    if image.image_id in truths:
                        known_truth.add_truth(db, contact_id, truths[image.image_id], now)
                for changed in requests.contacts_with_requests(db, contact_id):
                    requests.update_results(db, changed, now)
        return count

    def store_decision(self, record: Decision) -> bool:
        """Store a decision of another program or console; return whether it is new."""
        at_shore = self.config.role == "shore"
        with self.database.transaction() as db:
            return decisions.store_received_decision(db, record, self.clock(), at_shore=at_shore)

    def store_comment(self, record: Comment) -> None:
        """Store a comment from the shore site."""
        with self.database.transaction() as db:
            decisions.store_received_comment(db, record)

    def store_status(self, record: ReceivedStatus) -> None:
        """Store the status of a vehicle. The pages show it with the next fleet event."""
        with self.database.transaction() as db:
            tracks.store_status(db, record)

    def apply_downlink_state(self, state: DownlinkState) -> None:
        """Update the delivery of a decision or request to a vehicle."""
        with self.database.transaction() as db:
            if state.kind == "decision":
                decisions.apply_downlink_state(db, state)
            else:
                progress = state.state, state.reason, state.times_sent, state.changed_utc_s
                requests.update_request_state(db, state.record_id, *progress)

    def apply_tasking_state(self, state: TaskingState) -> None:
        """Update the delivery of a request or comment to a vessel."""
        with self.database.transaction() as db:
            if state.kind == "command":
                requests.update_request_state(db, state.record_id, state.state, state.reason, None, state.changed_utc_s)
            else:
                decisions.update_comment_state(db, state.record_id, state.state, state.reason)

    def apply_acknowledgement(self, table: Table, record_id: str, consumer: str, reason: str | None) -> None:
        """Update a record after a consumer has stored it (`reason` None) or refused it."""
        now = self.clock()
        with self.database.transaction() as db:
            if table == "decision":
                decisions.apply_acknowledgement(db, record_id, consumer, reason, now)
            elif table == "request":
                state = "asked" if reason is None else "refused"
                requests.update_request_state(db, record_id, state, reason or "", None, now)
            elif reason is not None:
                decisions.update_comment_state(db, record_id, "refused", reason)

    def mark_delivered_to_shore(self, before_utc_s: float) -> None:
        """Mark decisions that the relay stored before a time as delivered to shore."""
        with self.database.transaction() as db:
            decisions.mark_delivered_to_shore(db, before_utc_s)

    def remove_images(self, now_utc_s: float) -> int:
        """Apply the retention to stored images; return the number of removed versions."""
        with self.database.transaction() as db:
            return remove_images(db, now_utc_s, self.config.retain_days, self.config.max_bytes)

    # Events

    def _publish(self, changed: Mapping[str, bool]) -> None:
        """Publish the contacts that a transaction has changed.

        Args:
            changed: Contact identifier -> whether the contact is new.
        """
        if len(changed) > MAX_CONTACT_EVENTS:
            self.events.publish("reset", {})
            return
        counts = asdict(self.counts())
        for contact_id, is_new in changed.items():
            self.events.publish("contact", {"contact": self._contact_json(contact_id), "new": is_new, **counts})

    # Queries

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
        with self.database.read() as db:
            row = contacts.find_contact(db, contact_id)
            link = self._link_to(row["vehicle_id"])
            return {
                **contact_detail_json(db, contact_id, self.rule, self.rates),
                "costs": costs_json(db, row, link, self.clock(), has_downlink=self._has_downlink),
            }

    def _contact_json(self, contact_id: str) -> Json:
        with self.database.read() as db:
            return contact_json(contacts.find_contact(db, contact_id))

    def image(self, contact_id: str, version: int) -> ReconstructedImage:
        """Return the record of an image version."""
        with self.database.read() as db:
            return find_image(db, contact_id, version)

    @property
    def _has_downlink(self) -> bool:
        """Whether requests reach a vehicle: through op_modem, or from a shore site through c2."""
        return self.config.role == "shore" or OP_MODEM in self.config.command_consumers

    def _link_to(self, vehicle_id: str) -> VehicleLink:
        number = self.fleet.uplink_rate(vehicle_id, self.config.assumed_rate)
        uplink = None if number is None else self.rates.get(number)
        return VehicleLink(self.downlink_rate, uplink, self.fleet.frame_loss(vehicle_id))

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
            stored = decisions.add_decision(db, contact_id, entered, actor, self.clock(), self._delivery_states())
        for user in stored.notified:
            self.events.publish("notice", {"user": user})
        return self._decision_json(stored.decision_id, contact_id)

    def undo(self, contact_id: str, decision_id: str, displayed: DisplayedImage, actor: Actor) -> Json:
        """Store a record that withdraws an own decision; return it with its contact.

        If the decision is one of several on an object, the others are withdrawn too.

        Raises:
            BadInputError: See `undo_decision`.
        """
        with self.database.transaction() as db:
            states = self._delivery_states()
            new_id = decisions.undo_decision(db, contact_id, decision_id, displayed, actor, self.clock(), states)
            objects.undo_rest(db, decision_id, actor, self.clock(), states)
        return self._decision_json(new_id, contact_id)

    def _decision_json(self, decision_id: str, contact_id: str) -> Json:
        return {"decision": self._record_json("decision", decision_id), "contact": self._contact_json(contact_id)}

    def _record_json(self, table: Table, record_id: str) -> Json:
        with self.database.read() as db:
            row = find_record(db, table, record_id)
        assert row is not None
        return RECORD_JSON[table](row)

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
            stored = objects.decide_object(db, object_id, entered, actor, self.clock(), self._delivery_states())
        for user in sorted({user for one in stored for user in one.notified}):
            self.events.publish("notice", {"user": user})
        with self.database.read() as db:
            # A sealed contact is not listed after its decision.
            remaining = (
                objects.object_json(db, object_id, self.rule) if association.looks_of_object(db, object_id) else None
            )
        made = [self._record_json("decision", one.decision_id) for one in stored]
        return {"decisions": made, "object": remaining}

    def split_look(self, object_id: str, contact_id: str, actor: Actor) -> Json:
        """Separate a look from its object; return the object.

        Raises:
            BadInputError: See `objects.split_look`.
        """
        with self.database.transaction() as db:
            objects.split_look(db, object_id, contact_id, self.rule, actor, self.clock())
        return self.object_detail(object_id)

    def merge_objects(self, object_id: str, contact_id: str, actor: Actor) -> Json:
        """Join the object of a contact with an object; return the joined object.

        Raises:
            BadInputError: See `objects.merge_objects`.
        """
        with self.database.transaction() as db:
            objects.merge_objects(db, object_id, contact_id, self.rule, actor, self.clock())
            joined = association.object_of(db, contact_id)
        return self.object_detail(joined)

    def last_decision(self, user: str) -> Json:
        """Return the last decision of a user that can be undone, with its contact; both None if there is none."""
        with self.database.read() as db:
            row = decisions.last_own_decision(db, user, self.clock() - LAST_DECISION_S)
        if row is None:
            return {"decision": None, "contact": None}
        return self._decision_json(row["decision_id"], row["contact_id"])

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

    def _delivery_states(self) -> DeliveryStates:
        """Return the initial delivery of a decision."""
        consumers = self.config.decision_consumers
        shore, vehicle = ("waiting" if name in consumers else "none" for name in ("relay", "op_modem"))
        return DeliveryStates(shore, vehicle, self.config.take_back_s)

    def reveal(self) -> None:
        """Reveal the objects of contacts whose decision can no longer be taken back."""
        with self.database.transaction() as db:
            known_truth.reveal(db, self.clock(), self.config.take_back_s)

    def score_sheet(self, actor: Actor) -> Json:
        """Return the scores that a user may see: experts those of all operators, others their own."""
        operator = None if actor.role == "expert" else actor.user
        with self.database.read() as db:
            return known_truth.score_sheet(db, operator, self.clock(), self.config.take_back_s)

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
        with self.database.transaction() as db:
            row = contacts.find_contact(db, contact_id)
            command_id = requests.add_request(
                db,
                row,
                kind,
                airtime_s,
                actor,
                self.clock(),
                link=self._link_to(row["vehicle_id"]),
                arguments=arguments or {},
                has_downlink=self._has_downlink,
            )
        return self._record_json("request", command_id)

    def add_comment(self, contact_id: str, record: Comment, actor: Actor) -> Json:
        """Store a comment to send; return it."""
        self.image(contact_id, record.image_version)
        with self.database.transaction() as db:
            decisions.add_comment(db, contact_id, record, actor)
        return self._record_json("comment", record.comment_id)

    def measure(self, contact_id: str, line: Line, actor: Actor, *, keep: bool) -> Json:
        """Measure a line on an image, and optionally store the measurement.

        Raises:
            NotMeasurableError: This part of the image cannot be measured.
        """
        image = self.image(contact_id, line.version)
        now = self.clock()
        body = {**measure_line(image, line, self.config.beam_width_deg), "user": actor.user, "utc_s": now}
        if not keep:
            return {"id": None, **body, **NOT_WITHDRAWN}
        displayed = DisplayedImage(line.version, image.pixels_sha256, line.layer)
        with self.database.transaction() as db:
            measurement_id = add_measurement(db, contact_id, body, displayed, actor, now)
        return {"id": measurement_id, **body, **NOT_WITHDRAWN}

    def withdraw_measurement(self, contact_id: str, measurement_id: int, actor: Actor) -> Json:
        """Withdraw a stored measurement; return it.

        Raises:
            NotFoundError: The contact has no such measurement, or it is withdrawn.
        """
        with self.database.transaction() as db:
            return withdraw_measurement(db, contact_id, measurement_id, actor, self.clock())

    # Sending

    def unsent_records(self) -> list[UnsentRecord]:
        """Return the stored records that are not yet in the outbox, oldest first.

        A decision is returned after its take-back time, and cannot be taken back unsent from then on.
        """
        with self.database.transaction() as db:
            decisions.release_decisions(db, self.clock(), self.config.take_back_s)
            known_truth.withhold_sealed(db)
            return unsent_records(db)

    def mark_sent(self, item: UnsentRecord) -> None:
        """Mark a record as queued in the outbox."""
        with self.database.transaction() as db:
            mark_sent(db, item)
