"""The operator's console as a service: pictures in, decisions, requests and advice out, a page in between."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from itertools import islice
from typing import TypeVar

import zenoh

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import BadInputError, ConfigError, DeliveryError, PayloadError
from sonarpost.logs import kv
from sonarpost.messages import (
    AcousticFrame,
    Advice,
    Command,
    Decision,
    DownlinkState,
    Health,
    QueueState,
    ReconstructedImage,
    Record,
    TaskingState,
)
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.events import Pace
from sonarpost.services.console.fleet import frame_event
from sonarpost.services.console.shore_import import kept_in
from sonarpost.services.console.state import Board, Unsent
from sonarpost.services.console.store.database import Database
from sonarpost.services.console.store.requests import Table
from sonarpost.services.console.store.users import FILE_NAME, Users
from sonarpost.services.console.web.map_routes import fleet
from sonarpost.services.console.web.server import ConsoleApp, WebServer

log = logging.getLogger(__name__)

DATABASE_NAME = "console-review.db"
COMMAND_PRIORITY = 1
ADVICE_PRIORITY = 2
DECISION_PRIORITY = 2
C2 = "c2"
TICK_S = 1.0
CATCH_UP_AT_ONCE = 50
FRAMES_EVERY_S = 0.2
_SETTLED = "settled/"
# The relay's health is as of a moment before it was sent.
ASHORE_MARGIN_S = 2.0

R = TypeVar("R", bound=Record)


class ConsoleService(Service[ConsoleConfig]):
    """Shows people what arrives and carries what they say.

    What people do is written down first and owed to its consumers afterwards, under the same identifier however often:
    they take it once.

    Raises:
        ConfigError: TLS is wanted and the platform has no certificate.
        PortError: The address cannot be listened on.
        DeliveryError: A database cannot be opened.
    """

    NAME = "console"

    def __init__(self, platform: PlatformConfig, config: ConsoleConfig) -> None:
        if config.tls and platform.tls is None:
            raise ConfigError("[console]", "tls", "true", "a certificate in [platform] tls")
        super().__init__(platform, config)
        self._database = Database(platform.state_dir / DATABASE_NAME)
        self._users = Users(platform.state_dir / FILE_NAME, config.session_s, config.session_max_s)
        self.board = Board(config, self._database)
        self._app = ConsoleApp(self.board, self._users, platform.id)
        self._server: WebServer | None = None
        self._wake = threading.Event()
        self.board.on_unsent = self._wake.set
        self._pace = Pace(FRAMES_EVERY_S)
        self._send_problem = ""

    @property
    def address(self) -> str:
        """Where a browser finds the page; empty before the start."""
        return "" if self._server is None else self._server.address

    @property
    def _on_vessel(self) -> bool:
        return self.config.role == "vessel"

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """On a vessel its pictures and the shore's advice; ashore what c2 shows."""
        if self._on_vessel:
            vessel = self.platform.id
            return {keys.image_reconstructed(vessel): ReconstructedImage, keys.advice(vessel): Advice}
        site = self.config.site
        return {keys.shore_image_all(site): ReconstructedImage, keys.shore_decision_all(site): Decision}

    def validate(self, key: str, record: Record) -> None:
        """Refuse what speaks for another vessel, while its sender can be told."""
        if self._on_vessel and isinstance(record, (ReconstructedImage, Advice)):
            if record.vessel_id != self.platform.id:
                raise PayloadError(key, "vessel_id", record.vessel_id, self.platform.id)
        elif isinstance(record, (ReconstructedImage, Decision)):
            site = self.config.site
            expected = (keys.shore_image(record.vessel_id, site), keys.shore_decision(record.vessel_id, site))
            if key not in expected:
                raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Keep what has come; a second time it changes nothing."""
        if isinstance(record, ReconstructedImage):
            effects.count("images_taken" if self.board.take_image(record) else "images_repeated")
        elif isinstance(record, Decision):
            effects.count("decisions_taken" if self.board.take_decision(record) else "decisions_repeated")
        else:
            assert isinstance(record, Advice)
            self.board.take_advice(record)
            effects.count("advice_taken")

    # Out

    def _send_unsent(self) -> None:
        """Owe what people did to those who take it, as soon as it is written down."""
        while not self.stopping.is_set():
            self._wake.clear()
            try:
                self._apply_settled()
                for item in self.board.unsent():
                    self._send(item)
                self._send_problem = ""
            except (OSError, DeliveryError) as error:
                self._send_problem = f"{type(error).__name__}: {error}"
                log.error("Not handed on, trying again", extra=kv(reason=str(error)))
            self._wake.wait(TICK_S)

    def _send(self, item: Unsent) -> None:
        effects = UnitOfWork()
        record, vessel, site = item.record, item.vessel_id, self.config.site
        if isinstance(record, Decision):
            for consumer in self.config.decision_consumers:
                effects.send(keys.contact_decision(vessel), consumer, record, priority=DECISION_PRIORITY)
            effects.count("decisions_made")
        elif isinstance(record, Advice):
            effects.send(keys.tasking_advice(vessel, site), C2, record, priority=ADVICE_PRIORITY)
            effects.count("advice_given")
        elif self._on_vessel:
            for consumer in self.config.command_consumers:
                effects.send(keys.command(vessel, record.kind), consumer, record, priority=COMMAND_PRIORITY)
            effects.count("requests_made")
        else:
            effects.send(keys.tasking_command(vessel, site), C2, record, priority=COMMAND_PRIORITY)
            effects.count("requests_made")
        self.commit(effects)
        # Killed in between, it is owed once more, and its consumers know it by its identifier.
        self.board.mark_sent(item)

    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Remember that a consumer has taken a record or refused it; the board is told outside of this transaction."""
        table, record_id = _what(item)
        tx.put_state(f"{_SETTLED}{table}/{item.queue}/{record_id}", b"" if reason is None else reason.encode())
        self._wake.set()

    def _apply_settled(self) -> None:
        for name in self.store.state_names(_SETTLED):
            value = self.store.get_state(name)
            table, consumer, record_id = name.removeprefix(_SETTLED).split("/", 2)
            if value is not None:
                # A reason, or nothing: refusals always have one.
                tables: Mapping[str, Table] = {"decision": "decision", "request": "request", "advice": "advice"}
                self.board.settled(tables[table], record_id, consumer, value.decode() or None)
            with self.store.transaction() as tx:
                tx.delete_state(name)

    # Watching

    def on_start(self) -> None:
        """Serve the page, watch, and take what came ashore meanwhile.

        Raises:
            PortError: The address cannot be listened on.
        """
        tls = self.platform.tls if self.config.tls else None
        self._server = WebServer(self._app.asgi, self.config.host, self.config.port, tls)
        if not self._users.all():
            log.warning("Nobody may log in yet: `sonarpost console user add NAME --role operator --config FILE`")
        if self._on_vessel:
            vessel = self.platform.id
            self._watch(keys.acoustic_rx(vessel), AcousticFrame, self._on_frame)
            self._watch(keys.acoustic_downlink(vessel), DownlinkState, self.board.take_downlink)
            self._watch(keys.contact_decision(vessel), Decision, self._on_decision)
            self._watch(keys.acoustic_queue_everywhere(), QueueState, self.board.fleet.take_queue)
        else:
            self._watch(keys.tasking_state_all(self.config.site), TaskingState, self.board.take_tasking)
        # Ashore only the site's own: the health of every service of every vessel would load their radios for ever.
        health = keys.health_everywhere() if self._on_vessel else keys.health_all(self.platform.id)
        self.session.declare_subscriber(health, self._on_health)
        self._server.start()
        self.start_thread(self._send_unsent, "send")
        self.start_thread(self._tick, "tick")
        if not self._on_vessel and self.config.out_dir is not None:
            self.start_thread(self._catch_up, "catch-up")

    def _watch(self, key: str, record_type: type[R], take: Callable[[R], object]) -> None:
        def on_sample(sample: zenoh.Sample) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            try:
                take(wire.decode(record_type, sample.payload.to_bytes(), str(sample.key_expr)))
            except BadInputError as error:
                self.count("records_ignored")
                log.warning("Record ignored", extra=kv(reason=str(error)))
            except DeliveryError as error:
                log.error("Record not kept", extra=kv(reason=str(error)))

        self.session.declare_subscriber(key, on_sample)

    def _on_health(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        self.board.fleet.services.take(key, payload, time.monotonic())
        if self._on_vessel and key == keys.health(self.platform.id, "relay"):
            try:
                self._on_relay(wire.decode(Health, payload, key))
            except (BadInputError, DeliveryError) as error:
                log.warning("Relay's health not used", extra=kv(reason=str(error)))

    def _on_relay(self, health: Health) -> None:
        """Learn that decisions are ashore: none waits in the relay, and nothing that it has not looked at."""
        waiting = health.gauges.get("decisions_waiting")
        if waiting == 0 and health.gauges.get("inbox") == 0:
            # By the earlier of both clocks: neither may make a record out that came since.
            self.board.all_ashore_before(min(health.time_utc_s, time.time()) - ASHORE_MARGIN_S)

    def _on_frame(self, frame: AcousticFrame) -> None:
        if frame.direction != "rx":
            return
        vehicle = self.config.name_of(frame.source)
        self.board.fleet.hear(vehicle, frame)
        if self._pace.allows(vehicle):
            self.board.hub.publish("frame", frame_event(vehicle, frame))

    def _on_decision(self, record: Decision) -> None:
        if record.vessel_id != self.platform.id:
            raise PayloadError(keys.contact_decision(self.platform.id), "vessel_id", record.vessel_id, self.platform.id)
        self.board.take_decision(record)

    def _tick(self) -> None:
        """Tell the pages once a second how everything is, and let the service end where the page's server has."""
        while not self.stopping.wait(TICK_S):
            if self._server is not None and not self._server.running:
                raise RuntimeError("the web server has ended")
            # Tokens are not asked for here: what has been silent for long is forgotten by its age.
            self.board.fleet.services.set_alive(None, time.monotonic())
            try:
                self.board.hub.publish("fleet", fleet(self.board))
            except DeliveryError as error:
                log.error("Fleet not told", extra=kv(reason=str(error)))

    def _catch_up(self) -> None:
        assert self.config.out_dir is not None
        kept = kept_in(self.config.out_dir)
        try:
            while not self.stopping.is_set() and (some := list(islice(kept, CATCH_UP_AT_ONCE))):
                new = self.board.take_images([record for record in some if isinstance(record, ReconstructedImage)])
                new += sum(self.board.take_decision(record) for record in some if isinstance(record, Decision))
                self.count("records_caught_up", new)
        except DeliveryError as error:
            log.error("What c2 keeps is not taken, the next start tries again", extra=kv(reason=str(error)))

    # Life

    def on_stop(self) -> None:
        """End the page."""
        self._wake.set()
        self._app.end()
        if self._server is not None:
            self._server.stop()

    def stop(self) -> None:
        """Stop, and close the databases when nothing uses them any more."""
        super().stop()
        self._database.close()
        self._users.close()

    def degraded_reason(self) -> str:
        """Return what keeps decisions from being handed on."""
        return self._send_problem

    def warning(self) -> str:
        """Say that nobody may log in."""
        return "" if self._users.all() else "nobody may log in yet"

    def gauges(self) -> Mapping[str, float]:
        """Return how many contacts there are, and how many wait for a decision."""
        counts = self.board.counts()
        return {
            "contacts": float(counts.total),
            "contacts_unreviewed": float(counts.unreviewed),
            "pages_open": float(self.board.hub.listeners),
        }


def _what(item: OutboxItem) -> tuple[Table, str]:
    """Return of which kind a record in the outbox is, and its identifier."""
    types: Mapping[Table, type[Decision] | type[Command] | type[Advice]] = {
        "decision": Decision,
        "request": Command,
        "advice": Advice,
    }
    for table, record_type in types.items():
        if item.encoding == wire.encoding_of(record_type):
            record = wire.decode(record_type, item.payload, item.key)
            if isinstance(record, Decision):
                return table, record.decision_id
            return table, record.command_id if isinstance(record, Command) else record.advice_id
    raise BadInputError(item.key, "encoding", item.encoding, "a decision, a command or advice")
