"""The console service: receives images, sends decisions, requests and comments, and serves the web page."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Protocol, TypeVar

import zenoh
from typing_extensions import override

from sonarpost import keys, wire
from sonarpost.bus.catch_up import CatchUpSubscriber
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import BadInputError, DeliveryError, PayloadError, QueryRefusedError, can_concern_record
from sonarpost.logs import IntervalLog, kv
from sonarpost.messages import (
    AcousticFrame,
    Comment,
    Decision,
    DownlinkState,
    Health,
    QueueState,
    ReceivedStatus,
    ReconstructedImage,
    Record,
    TaskingState,
    VehicleRange,
)
from sonarpost.modem.registry import modem_driver
from sonarpost.network.connections import ConnectionLimits, TrustedProxies
from sonarpost.registry import Registry
from sonarpost.runtime.retention import Retention
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.console.chain import RouterState
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.database import (
    DATABASE_NAME,
    ID_COLUMN,
    RECORD_TYPES,
    Database,
    Table,
    UnsentRecord,
)
from sonarpost.services.console.store.users import FILE_NAME, Users
from sonarpost.services.console.web.server import ConsoleApp, WebServer

log = logging.getLogger(__name__)

COMMAND_PRIORITY = 1
COMMENT_PRIORITY = 2
DECISION_PRIORITY = 2
C2 = "c2"
OP_MODEM = "op_modem"
UPDATE_INTERVAL_S = 1.0
TOKENS_TIMEOUT_S = 1.0
BATCH_RECORDS = 50
SHORE_RECORDS: Mapping[str, type[ReconstructedImage] | type[Decision]] = {
    "image": ReconstructedImage,
    "decision": Decision,
}
"""Records of c2 that are stored, by the last part of their key."""
_CURSOR = "cursor"
"""Name of the store's state entry: position in the records of c2."""
SHORE_DELIVERY_MARGIN_S = 2.0
"""Age that a decision must have before the relay's health proves its delivery: health is older than its arrival."""
R = TypeVar("R", bound=Record)


class Watch(Protocol):
    """Adds sealed contacts with known objects to the queue of a console: see `watches`.

    It is created with the state of the console, the share of such contacts, and a function to count them.
    """

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


class ConsoleService(Service[ConsoleConfig]):
    """Serves the page for operators and experts.

    Operators' actions are first stored in the console's database and then queued in the outbox. After a crash in
    between they are queued again with the same identifier, and consumers ignore the repetition.

    Raises:
        ConfigError: `tls` is set, and the platform has no certificate.
        DeliveryError: A database cannot be opened.
    """

    NAME = "console"

    def __init__(self, platform: PlatformConfig, config: ConsoleConfig) -> None:
        config.check_with(platform)
        super().__init__(platform, config)
        self._database = Database(platform.state_dir / DATABASE_NAME)
        self._users = Users(platform.state_dir / FILE_NAME, config.session_s, config.session_max_s)
        self.state = ConsoleState(config, self._database, modem=modem_driver(platform.modem.driver).capabilities)
        self._app = ConsoleApp(self.state, self._users, platform.id)
        self._server: WebServer | None = None
        self._send_error = self._follow_error = self._fleet_error = ""
        self._fleet_log = IntervalLog(log, logging.ERROR, "Fleet state not published")
        self._ignored_log = IntervalLog(log, logging.WARNING, "Invalid record ignored")
        self._not_stored_log = IntervalLog(log, logging.ERROR, "Record not stored")
        self.state.router = RouterState(
            platform_id=platform.id, reached=False, changed_utc_s=time.time(), detail=", ".join(platform.router)
        )
        self._retention = Retention(self._apply_retention, self.stopping)
        self._watch: Watch | None = None
        if config.calibration_share > 0:
            make = watches().get("calibrated")
            self._watch = make(self.state, config.calibration_share, count=lambda: self.count("sealed_contacts"))

    @property
    def address(self) -> str:
        """URL of the page; empty before the start."""
        return "" if self._server is None else self._server.address

    @property
    def _on_vessel(self) -> bool:
        return self.config.role == "vessel"

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        if not self._on_vessel:
            return {}  # what c2 accepts is read by `_follow_c2`
        vessel = self.platform.id
        return {keys.image_reconstructed(vessel): ReconstructedImage, keys.comment(vessel): Comment}

    @override
    def validate(self, key: str, record: Record) -> None:
        assert isinstance(record, (ReconstructedImage, Comment))
        if record.vessel_id != self.platform.id:
            raise PayloadError(key, "vessel_id", record.vessel_id, self.platform.id)

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        if isinstance(record, ReconstructedImage):
            is_new = self.state.store_image(record)
            effects.count("images_taken" if is_new else "images_repeated")
            if is_new and record.version == 1 and self._watch is not None:
                self._watch.contact_arrived(record, time.monotonic())
        else:
            assert isinstance(record, Comment)
            self.state.store_comment(record)
            effects.count("comments_taken")

    def _apply_retention(self, now_utc_s: float) -> None:
        removed = self.state.remove_images(now_utc_s)
        if removed:
            self.count("images_removed", removed)
            log.warning("Images removed by retention", extra=kv(images=removed))

    # Sending

    def _send_loop(self) -> None:
        """Queue the records of operators' actions in the outbox."""
        while not self.stopping.wait(UPDATE_INTERVAL_S):
            try:
                self._send_error = self._send_all()
            except (OSError, DeliveryError) as error:
                self._send_error = f"{type(error).__name__}: {error}"
                log.error("Records not queued, trying again", extra=kv(reason=str(error)))

    def _send_all(self) -> str:
        """Queue the records; return the unexpected exception of one of them, which does not delay the others."""
        failed = ""
        for item in self.state.unsent_records():
            try:
                self._send(item)
            except (OSError, DeliveryError):
                raise
            except Exception as error:
                failed = f"{type(error).__name__}: {error}"
                if failed != self._send_error:
                    log.exception("Record not queued after an unexpected exception, trying again")
        return failed

    def _send(self, item: UnsentRecord) -> None:
        effects = UnitOfWork()
        record, vessel, site = item.record, item.vessel_id, self.config.site
        if isinstance(record, Decision):
            for consumer in self.config.decision_consumers:
                if consumer == OP_MODEM and not item.to_vehicle:
                    continue
                effects.send(keys.contact_decision(vessel), consumer, record, priority=DECISION_PRIORITY)
            effects.count("decisions_made")
        elif isinstance(record, Comment):
            effects.send(keys.tasking_comment(vessel, site), C2, record, priority=COMMENT_PRIORITY)
            effects.count("comments_given")
        elif self._on_vessel:
            for consumer in self.config.command_consumers:
                effects.send(keys.command(vessel, record.kind), consumer, record, priority=COMMAND_PRIORITY)
            effects.count("requests_made")
        else:
            effects.send(keys.tasking_command(vessel, site), C2, record, priority=COMMAND_PRIORITY)
            effects.count("requests_made")
        self.commit(effects)
        # After a crash here the record is queued again. Its consumers recognise its identifier.
        self.state.mark_sent(item)

    @override
    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Apply an acknowledgement to the console's database. After a crash it arrives again, and changes nothing."""
        table, record_id = _table_and_id(item)
        self.state.apply_acknowledgement(table, record_id, item.queue, reason)

    # Subscriptions

    @override
    def before_session(self) -> None:
        """Start the web server and the threads, so that the page is served without a router.

        Raises:
            PortError: The address cannot be bound.
            ConfigError: The certificate cannot be used.
        """
        tls = self.platform.tls if self.config.tls else None
        limits = ConnectionLimits(TrustedProxies(self.config.trusted_proxies))
        self._server = WebServer(self._app.asgi, self.config.host, self.config.port, tls, limits)
        if not self._users.all():
            log.warning("No users: add one with `sonarpost console user add NAME --role operator --config FILE`")
        self._server.start()
        self.start_thread(self._send_loop, "send")
        self.start_thread(self._update_loop, "update")
        self.start_thread(self._retention.run, "retention")
        if self._watch is not None:
            self._watch.start()

    @override
    def on_start(self) -> None:
        """Declare the subscriptions."""
        if self._on_vessel:
            vessel = self.platform.id
            self._subscribe(keys.acoustic_rx(vessel), AcousticFrame, self._on_frame)
            self._subscribe(keys.acoustic_downlink(vessel), DownlinkState, self.state.apply_downlink_state)
            self._subscribe(keys.contact_decision(vessel), Decision, self.state.store_decision)
            self._subscribe(keys.acoustic_status(vessel), ReceivedStatus, self.state.store_status)
            self._subscribe(keys.acoustic_range(vessel), VehicleRange, self.state.fleet.set_range)
            self._subscribe(keys.acoustic_queue_everywhere(), QueueState, self.state.fleet.set_queue)
        else:
            self._subscribe(keys.tasking_state_all(self.config.site), TaskingState, self.state.apply_tasking_state)
            self._subscribe(keys.shore_status_all(self.config.site), ReceivedStatus, self.state.store_status)
            self.start_thread(self._follow_c2, "c2")
        # A shore site subscribes to its own health only: the health of all vessels would load their radio links.
        health = keys.health_everywhere() if self._on_vessel else keys.health_all(self.platform.id)
        self.session.declare_subscriber(health, self._on_health)

    def _subscribe(self, key: str, record_type: type[R], apply: Callable[[R], object]) -> None:
        def on_sample(sample: zenoh.Sample) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            name = str(sample.key_expr)
            try:
                record = wire.decode(record_type, sample.payload.to_bytes(), name)
                _check_key(name, record)
                apply(record)
            except DeliveryError as error:
                self._not_stored_log.log(reason=str(error)[:300])
            except Exception as error:  # noqa: BLE001  concerns this record only
                self.count("records_ignored")
                is_expected = isinstance(error, BadInputError)
                self._ignored_log.log(None if is_expected else error, key=name, reason=str(error)[:300])

        self.session.declare_subscriber(key, on_sample)

    def _on_health(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        self.state.fleet.services.add(key, payload, time.monotonic())
        if self._on_vessel and key == keys.health(self.platform.id, "relay"):
            try:
                self._on_relay_health(wire.decode(Health, payload, key))
            except (BadInputError, DeliveryError) as error:
                log.warning("Health record of the relay ignored", extra=kv(reason=str(error)))

    def _on_relay_health(self, health: Health) -> None:
        """Mark decisions as delivered to shore if the relay has no decision in its inbox and outbox."""
        if health.gauges.get("decisions_waiting") == 0 and health.gauges.get("inbox") == 0:
            # The earlier one of both clocks, so that a wrong clock does not include newer decisions.
            self.state.mark_delivered_to_shore(min(health.time_utc_s, time.time()) - SHORE_DELIVERY_MARGIN_S)

    def _on_frame(self, frame: AcousticFrame) -> None:
        if frame.direction != "rx":
            return
        self.state.fleet.add_frame(self.config.vehicle_name(frame.source), frame)

    def _update_loop(self) -> None:
        """Publish the fleet state once a second, and fail if the web server has stopped."""
        while not self.stopping.wait(UPDATE_INTERVAL_S):
            if self._server is not None and not self._server.running and not self.stopping.is_set():
                raise RuntimeError("the web server has stopped")
            self._update_router_state()
            try:
                self.state.events.publish("fleet", self.state.fleet_state())
                self._fleet_error = ""
            except Exception as error:  # noqa: BLE001  concerns the records of one source; health shows it
                self._fleet_error = f"fleet state not published: {error}"
                self._fleet_log.log(None if isinstance(error, DeliveryError) else error, reason=str(error)[:300])

    def _update_router_state(self) -> None:
        """Observe the connection to the router, and the liveliness tokens of this platform's services."""
        before = self.state.router
        assert before is not None
        router = self.state.router = before.changed(time.time(), reached=self.is_router_reached)
        if router.reached != before.reached:
            fields = kv(router=router.detail)
            if router.reached:
                log.info("Zenoh router reached", extra=fields)
            else:
                log.error("Connection to the Zenoh router lost, reconnecting", extra=fields)
        tokens = self._tokens() if router.reached else None
        self.state.fleet.services.set_alive(tokens, time.monotonic())
        if not router.reached:
            # A session without a router does not publish: the own health is stored here.
            try:
                own = wire.encode(self.health())
            except DeliveryError as error:
                log.warning("Own health not shown", extra=kv(reason=str(error)))
                return
            self.state.fleet.services.add(keys.health(self.platform.id, self.NAME), own, time.monotonic())

    def _tokens(self) -> list[str] | None:
        """Return the liveliness tokens of this platform's services; None if the router does not reply.

        Tokens of other platforms would be queried over their radio links.
        """
        try:
            replies = self.session.liveliness().get(keys.alive_all(self.platform.id), timeout=TOKENS_TIMEOUT_S)
            tokens = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        except zenoh.ZError as error:
            if not self.stopping.is_set():
                log.warning("Liveliness tokens not received", extra=kv(error=str(error)))
            return None
        # The own token is one of them, unless the router did not reply.
        return tokens or None

    def _follow_c2(self) -> None:
        """Store the images and decisions that c2 accepts, first those since the last start."""
        key = keys.shore_contact_all(self.config.site)
        cursor = self.store.states(_CURSOR).get("", b"").decode()
        while not self.stopping.is_set():
            try:
                with CatchUpSubscriber(self.session, key, cursor) as records:
                    while not self.stopping.is_set():
                        self._disk_reserve.require()
                        batch = self._next_batch(records)
                        self._store_batch(batch)
                        if records.cursor != cursor:
                            cursor = records.cursor
                            with self.store.transaction() as tx:
                                tx.put_state(_CURSOR, cursor.encode())
                        if batch or records.is_caught_up:
                            self._follow_error = ""
            except (OSError, MemoryError, DeliveryError, QueryRefusedError, zenoh.ZError) as error:
                self._follow_error = f"{type(error).__name__}: {error}"
                self._not_stored_log.log(reason=self._follow_error[:300])
            self.stopping.wait(UPDATE_INTERVAL_S)

    def _next_batch(self, records: CatchUpSubscriber) -> list[ReconstructedImage | Decision]:
        """Return the records that are there; an empty list after a second without any."""
        batch: list[ReconstructedImage | Decision] = []
        timeout_s = UPDATE_INTERVAL_S
        while len(batch) < BATCH_RECORDS and (found := records.poll(timeout_s)) is not None:
            timeout_s = 0.0
            *_, vessel, kind = found.key.split("/")
            if kind not in SHORE_RECORDS:
                continue
            try:
                record = wire.decode(SHORE_RECORDS[kind], found.payload, found.key)
                if record.vessel_id != vessel:
                    raise PayloadError(found.key, "vessel_id", record.vessel_id, vessel)
            except BadInputError as error:
                self.count("records_ignored")
                self._ignored_log.log(key=found.key, reason=str(error)[:300])
            else:
                batch.append(record)
        return batch

    def _store_batch(self, batch: Sequence[ReconstructedImage | Decision]) -> None:
        """Store records, after a failure each by itself; one that fails then is quarantined.

        Raises:
            OSError, MemoryError, DeliveryError: A failure that concerns no single record, for example a full disk.
        """
        images = [record for record in batch if isinstance(record, ReconstructedImage)]
        try:
            new = self.state.store_images(images)
            stored = [self.state.store_decision(record) for record in batch if isinstance(record, Decision)]
        except Exception as error:
            if not can_concern_record(error):
                raise
            if len(batch) == 1:
                self._quarantine(batch[0], error)
            else:
                for record in batch:
                    self._store_batch([record])
        else:
            for name, number in (
                ("images_taken", new),
                ("images_repeated", len(images) - new),
                ("decisions_taken", sum(stored)),
                ("decisions_repeated", len(stored) - sum(stored)),
            ):
                self.count(name, number)

    def _quarantine(self, record: ReconstructedImage | Decision, error: Exception) -> None:
        reason = f"{type(error).__name__}: {error}"
        with self.store.transaction() as tx:
            # No key of the inbox: a console at a shore site has none.
            tx.quarantine("in", f"c2 {record.TYPE}/{record.vessel_id}", wire.encode(record), reason, is_accepted=True)
        self.count("records_failed")
        log.error("Record quarantined: it cannot be stored", exc_info=error, extra=kv(vessel=record.vessel_id))

    # Stop and health

    @override
    def stop(self) -> None:
        """Stop the web server, which runs also without a session, then the service; close the databases."""
        self.stopping.set()
        self._retention.wake()
        if self._watch is not None:
            self._watch.stop()
        self._app.stop()
        if self._server is not None:
            self._server.stop()
        super().stop()
        self._database.close()
        self._users.close()

    @override
    def degraded_reason(self) -> str:
        """Return why records are not queued, received or shown, or old images not removed; empty if they are."""
        router = self.state.router
        no_router = "" if router is None or router.reached else f"router {router.detail} not reached"
        return self._send_error or self._follow_error or no_router or self._fleet_error or self._retention.error

    @override
    def warning(self) -> str:
        """Return a warning if there are no users."""
        return "" if self._users.all() else "no users"

    @override
    def gauges(self) -> Mapping[str, float]:
        """Return the number of contacts, of contacts without a decision, and of open pages."""
        counts = self.state.counts()
        return {
            "contacts": float(counts.total),
            "contacts_to_do": float(counts.to_do),
            "pages_open": float(self.state.events.subscriber_count),
        }


def _check_key(key: str, record: Record) -> None:
    """Raise PayloadError if a record names another vessel or platform than its key."""
    for field in ("vessel_id", "platform_id"):
        named = getattr(record, field, None)
        if named is not None and named not in key.split("/"):
            raise PayloadError(key, field, named, "the name in the key")


def _table_and_id(item: OutboxItem) -> tuple[Table, str]:
    """Return the table and identifier of a record in the outbox."""
    table, record_type = next(
        (table, record_type)
        for table, record_type in RECORD_TYPES.items()
        if item.encoding == wire.encoding_of(record_type)
    )
    return table, str(getattr(wire.decode(record_type, item.payload, item.key), ID_COLUMN[table]))
