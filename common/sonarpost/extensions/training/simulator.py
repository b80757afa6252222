"""Simulator of the training console: contacts arrive, requests and decisions are delivered, all in this process."""

import random
import sqlite3
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from sonarpost import keys, wire
from sonarpost.codec.region import RegionBox
from sonarpost.errors import ConfigError
from sonarpost.extensions.training.contacts import (
    VEHICLES,
    SimulatedContact,
    simulated_contacts,
)
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.messages import (
    AcousticFrame,
    Command,
    Comment,
    Decision,
    DownlinkState,
    DownlinkStep,
    Health,
    LinkQuality,
    QueuedImage,
    QueueState,
    ReconstructedImage,
)
from sonarpost.modem.registry import modem_driver
from sonarpost.review.costs import NEW_IMAGE_KINDS
from sonarpost.services.console.chain import RouterState
from sonarpost.services.console.fleet import DETECTOR
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.truth import Truth

VESSEL = "training"
RATE = 1
SERVICES = ("op_modem", "decompressor", "relay", "console")
SEABEDS = (
    {"expected_pd": 0.96, "worst_expected_pd": 0.91, "clutter_per_1000_m2": 5.0, "ripple_strength": 0.1},
    {"expected_pd": 0.62, "worst_expected_pd": 0.35, "clutter_per_1000_m2": 41.0, "ripple_strength": 0.12},
)
"""Difficulty of the seabed of each vehicle."""
UPDATE_INTERVAL_S = 0.5
BACKLOG_BATCH = 40
COMMENT_INTERVAL_PACKETS = 5
MAX_CACHED_CONTACTS = 300


@dataclass
class _Transfer:
    """A contact whose image versions arrive one after the other."""

    simulated: SimulatedContact
    first_frame_utc_s: float
    next_version: int = 0


@dataclass
class _DownlinkRecord:
    """A decision or command on its way to the vehicle, with the times of the remaining delivery steps."""

    record: Decision | Command
    steps: list[tuple[float, DownlinkStep]] = field(default_factory=list)


class TrainingSimulator:
    """Feeds the console state with simulated records.

    Args:
        state: State of the console.
        contacts: Total number of contacts.
        seed: Seed of all random draws.
        interval_s: Time between two packets.
    """

    def __init__(self, state: ConsoleState, contacts: int, seed: int = 1, interval_s: float = 6.0) -> None:
        self._state = state
        self._max_contacts = contacts
        self._interval_s = interval_s
        self._seed = seed
        self._shift_s = 0.0
        self._random = random.Random(seed)  # noqa: S311  not used for secrets
        self._source: Iterator[SimulatedContact] = simulated_contacts(seed, time.time() - 3600.0)
        self._contacts = 0
        self._packet = 0
        self._transfers: list[_Transfer] = []
        self._cache: dict[str, _Transfer] = {}
        # Identifiers of the new images that commands have requested, by kind and image of the command.
        self._requested: dict[tuple[str, str], str] = {}
        self._requested_images = 0
        self._stopped: dict[str, _Transfer] = {}
        self._downlink: list[_DownlinkRecord] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="training", daemon=True)

    def load_backlog(self, contacts: int) -> None:
        """Continue the training in the database, and store contacts that arrived before the start.

        Raises:
            ConfigError: The database holds a training with another seed.
        """
        with self._state.database.read() as db:
            rows = db.execute("SELECT * FROM contact WHERE vessel_id = ?", (VESSEL,)).fetchall()
        stored = {str(row["image_id"]): row for row in rows}
        while format_image_id(-self._requested_images - 1) in stored:
            self._requested_images += 1
        arrived = len(stored) - self._requested_images
        start_utc_s = time.time() - 30.0 * contacts
        records: list[ReconstructedImage] = []
        truths: dict[str, Truth] = {}
        for number in range(max(contacts, arrived)):
            contact = self._next_contact(stored.get(format_image_id(0)))
            if contact.image_id in stored:
                self._resume_contact(contact, stored[contact.image_id])
            else:
                first = start_utc_s + 30.0 * number
                versions = range(len(contact.versions))
                self._add_to_cache(_Transfer(contact, first, len(versions)))
                records += [contact.record(VESSEL, version, first, first + 6.0 * version) for version in versions]
                truths[contact.image_id] = contact.truth
            if len(records) >= BACKLOG_BATCH or number >= contacts - 1 or self._stop.is_set():
                self._state.store_images(records, truths)
                records.clear()
            if self._stop.is_set():
                return
        self._resume_downlink(time.time())

    def _next_contact(self, first: sqlite3.Row | None) -> SimulatedContact:
        """Return the next contact of the survey, with the time of the survey in the database.

        Args:
            first: The first contact of the survey in the database; None in a new training.
        """
        simulated = next(self._source)
        contact = simulated.contact
        if first is not None and self._contacts == 0:
            if (first["lat_deg"], first["lon_deg"]) != (contact.lat_deg, contact.lon_deg):
                raise ConfigError("console", "--seed", self._seed, "the seed of the training in the folder of --state")
            self._shift_s = first["seen_utc_s"] - (contact.time_utc_s or 0.0)
        self._contacts += 1
        shifted = None if contact.time_utc_s is None else contact.time_utc_s + self._shift_s
        return replace(simulated, contact=contact.model_copy(update={"time_utc_s": shifted}))

    def _resume_contact(self, contact: SimulatedContact, row: sqlite3.Row) -> None:
        """Continue a stored contact: the vehicle has sent some versions of its image, or more than planned."""
        while len(contact.versions) < row["version"]:
            contact = contact.with_next_version(refine=True)
        transfer = _Transfer(contact, row["first_frame_utc_s"], row["version"])
        if row["version"] == len(contact.versions):
            self._add_to_cache(transfer)
        elif row["review"] in ("unreviewed", "unsure"):
            self._transfers.append(transfer)
        else:
            self._stopped[contact.image_id] = transfer

    def _resume_downlink(self, now_utc_s: float) -> None:
        """Continue the delivery of decisions, and of commands without an answer."""
        with self._state.database.read() as db:
            decisions = db.execute("SELECT payload FROM decision WHERE vehicle IN ('asked', 'sent')").fetchall()
            commands = db.execute(
                "SELECT payload FROM request WHERE state IN ('asked', 'sent', 'confirmed') AND arrived_utc_s IS NULL"
            ).fetchall()
        for row in decisions:
            self._send(wire.decode(Decision, bytes(row["payload"]), "decision"), now_utc_s)
        for row in commands:
            self._send(wire.decode(Command, bytes(row["payload"]), "request"), now_utc_s)

    def start(self) -> None:
        """Start the simulation thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the simulation thread."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        now_utc_s = time.time()
        self._state.router = RouterState(
            platform_id=VESSEL,
            reached=True,
            changed_utc_s=now_utc_s,
            listening_since_utc_s=now_utc_s,
            detail="simulated",
        )
        next_packet_s = time.monotonic()
        while not self._stop.wait(UPDATE_INTERVAL_S):
            now_s = time.monotonic()
            if now_s >= next_packet_s:
                next_packet_s = now_s + self._interval_s
                self.receive_packet(time.time())
            self._update_health(time.time())
            self.accept_records(time.time())
            self.advance_downlink(time.time())
            self._state.reveal()
            self._state.events.publish("fleet", self._state.fleet_state())

    # Uplink

    def receive_packet(self, now_utc_s: float) -> None:
        """Simulate one packet of a vehicle and the image version that follows from it."""
        if self._contacts < self._max_contacts and len(self._transfers) < 3:
            self._transfers.append(_Transfer(self._next_contact(None), now_utc_s))
        self._packet += 1
        transfer = self._transfers[self._packet % len(self._transfers)] if self._transfers else None
        self._receive_frame(
            transfer.simulated.contact.vehicle_id if transfer else self._random.choice(VEHICLES), now_utc_s
        )
        self._update_queues(now_utc_s)
        if transfer is None:
            return
        record = transfer.simulated.record(VESSEL, transfer.next_version, transfer.first_frame_utc_s, now_utc_s)
        self._state.store_image(record, transfer.simulated.truth)
        if self._packet % COMMENT_INTERVAL_PACKETS == COMMENT_INTERVAL_PACKETS - 2:
            self._state.store_comment(self._comment(record))
        transfer.next_version += 1
        if transfer.next_version == len(transfer.simulated.versions):
            self._transfers.remove(transfer)
            self._add_to_cache(transfer)

    def _add_to_cache(self, transfer: _Transfer) -> None:
        """Cache a contact for later requests, and delete the oldest ones."""
        self._cache[transfer.simulated.image_id] = transfer
        while len(self._cache) > MAX_CACHED_CONTACTS:
            del self._cache[next(iter(self._cache))]

    def _execute_command(self, command: Command, now_utc_s: float) -> None:
        """Queue the image that a vehicle would send."""
        image_id = command.image_id or ""
        requested = command.kind, image_id
        # A repeated command for a new image sends this image again.
        cached = self._cache.get(self._requested.get(requested, image_id))
        if command.kind == "prioritise":
            self._prioritise(command)
            return
        if cached is None or command.kind == "revisit":
            return
        if command.kind == "region":
            assert command.box is not None
            assert command.stream_bytes is not None
            part = cached.simulated.region(self._new_image_id(), RegionBox(*command.box), command.stream_bytes)
            self._transfers.append(_Transfer(part, now_utc_s))
            return
        if command.kind in NEW_IMAGE_KINDS and requested not in self._requested:
            new_id = self._new_image_id()
            simulated = cached.simulated
            new = simulated.expanded(new_id) if command.kind == "expand" else simulated.unfiltered(new_id)
            if new is not None:
                self._requested[requested] = new_id
                self._transfers.append(_Transfer(new, now_utc_s))
            return
        refined = cached.simulated.with_next_version(refine=command.kind == "refine")
        self._transfers.append(_Transfer(refined, cached.first_frame_utc_s, len(refined.versions) - 1))

    def _new_image_id(self) -> str:
        """Return the identifier of a requested image: they count down from the last one, those of contacts up."""
        self._requested_images += 1
        return format_image_id(-self._requested_images)

    def _prioritise(self, command: Command) -> None:
        for transfer in [t for t in self._transfers if t.simulated.image_id == command.image_id]:
            self._transfers.remove(transfer)
            self._transfers.insert(0 if command.place == "first" else len(self._transfers), transfer)

    def _stop_or_resume(self, decision: Decision) -> None:
        """Stop the image of a final verdict, or queue the rest of it after a withdrawal, as a vehicle does."""
        if decision.verdict != "unsure":
            for transfer in [t for t in self._transfers if t.simulated.image_id == decision.image_id]:
                self._transfers.remove(transfer)
                self._stopped[decision.image_id] = transfer
        elif decision.image_id in self._stopped:
            self._transfers.append(self._stopped.pop(decision.image_id))

    def _comment(self, record: ReconstructedImage) -> Comment:
        """Return a comment of a simulated expert at the shore site."""
        confidence = record.contact.atd_confidence if record.contact else None
        is_likely = confidence is not None and confidence > 1.1
        return Comment(
            comment_id=f"training-{record.image_id}-{record.version}",
            vessel_id=VESSEL,
            vehicle_id=record.vehicle_id,
            image_id=record.image_id,
            image_version=record.version,
            verdict="mine_like" if is_likely else "unsure",
            confidence=0.7 if is_likely else 0.4,
            remark="Simulated: the shadow has a straight edge."
            if is_likely
            else "Simulated: wait for more of the image.",
            author="shore",
            commented_utc_s=record.last_frame_utc_s,
        )

    def _receive_frame(self, vehicle: str, now_utc_s: float) -> None:
        bad_frames = int(self._random.random() < 0.15)
        rate = modem_driver().capabilities.rates[RATE]
        quality = LinkQuality(
            snr_in_db=round(self._random.gauss(14, 2), 1),
            snr_out_db=round(self._random.gauss(9, 2), 1),
            frames=rate.frames,
            bad_frames=bad_frames,
        )
        frame = AcousticFrame(
            direction="rx",
            platform_id=VESSEL,
            time_utc_s=now_utc_s,
            source=3 + VEHICLES.index(vehicle),
            destination=1,
            rate=RATE,
            packet=self._packet,
            frame_number=1,
            frame_count=rate.frames,
            data=bytes(rate.frame_bytes),
            quality=quality,
        )
        self._state.fleet.add_frame(vehicle, frame)

    def _update_queues(self, now_utc_s: float) -> None:
        for vehicle in VEHICLES:
            transfers = [t for t in self._transfers if t.simulated.contact.vehicle_id == vehicle]
            images = tuple(
                QueuedImage(
                    image_id=transfer.simulated.image_id,
                    contact_id=transfer.simulated.contact.contact_id,
                    bytes_left=64 * (len(transfer.simulated.versions) - transfer.next_version),
                    preview_utc_s=None,
                    expected_utc_s=now_utc_s + self._interval_s * (place + 1),
                )
                for place, transfer in enumerate(transfers)
            )
            self._state.fleet.set_queue(
                QueueState(
                    platform_id=vehicle,
                    time_utc_s=now_utc_s,
                    rate=RATE,
                    frame_loss=self._state.fleet.frame_loss(vehicle),
                    packet_interval_s=self._interval_s,
                    messages_waiting=0,
                    message_bytes=0,
                    images_waiting=len(images),
                    images=images,
                )
            )

    def _update_health(self, now_utc_s: float) -> None:
        for service in SERVICES:
            self._add_health(VESSEL, service, now_utc_s, {})
        for vehicle, seabed in zip(VEHICLES, SEABEDS, strict=True):
            self._add_health(vehicle, DETECTOR, now_utc_s, seabed)

    def _add_health(self, platform: str, service: str, now_utc_s: float, gauges: dict[str, float]) -> None:
        health = Health(
            platform_id=platform,
            service=service,
            time_utc_s=now_utc_s,
            started_utc_s=now_utc_s,
            state="ok",
            detail="simulated, for training",
            counters={},
            gauges=gauges,
        )
        self._state.fleet.services.add(keys.health(platform, service), wire.encode(health), time.monotonic())

    # Downlink

    def accept_records(self, now_utc_s: float) -> None:
        """Acknowledge decisions and requests as the relay and op_modem would."""
        for item in self._state.unsent_records():
            self._state.mark_sent(item)
            if isinstance(item.record, Decision):
                self._state.apply_acknowledgement(item.table, item.record_id, "relay", None)
            if isinstance(item.record, (Decision, Command)) and item.to_vehicle:
                self._state.apply_acknowledgement(item.table, item.record_id, "op_modem", None)
                self._send(item.record, now_utc_s)

    def _send(self, record: Decision | Command, now_utc_s: float) -> None:
        steps: list[tuple[float, DownlinkStep]] = [(now_utc_s + 4.0, "sent"), (now_utc_s + 10.0, "confirmed")]
        self._downlink.append(_DownlinkRecord(record, steps))

    def advance_downlink(self, now_utc_s: float) -> None:
        """Apply all delivery steps up to now, and execute delivered commands."""
        self._state.mark_delivered_to_shore(now_utc_s - 3.0)
        for item in list(self._downlink):
            while item.steps and item.steps[0][0] <= now_utc_s:
                self._state.apply_downlink_state(_downlink_state(item.record, item.steps.pop(0)[1], now_utc_s))
            if not item.steps:
                self._downlink.remove(item)
                if isinstance(item.record, Command):
                    self._execute_command(item.record, now_utc_s)
                else:
                    self._stop_or_resume(item.record)


def _downlink_state(record: Decision | Command, step: DownlinkStep, now_utc_s: float) -> DownlinkState:
    return DownlinkState(
        vessel_id=VESSEL,
        vehicle_id=record.vehicle_id,
        kind="decision" if isinstance(record, Decision) else record.kind,
        record_id=record.decision_id if isinstance(record, Decision) else record.command_id,
        state=step,
        times_sent=1,
        expires_utc_s=now_utc_s + 3600.0,
        changed_utc_s=now_utc_s,
    )
