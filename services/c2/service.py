"""The shore side: commits what vessels relay, keeps it, shows it, and owes vessels what the shore says to them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import zenoh

from sonarpost import keys, wire
from sonarpost.archive.shore_files import decision_file_name
from sonarpost.bus.connectivity import declare_presence
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import InboxItem, OutboxItem, queue_of
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import DeliveryError, PayloadError
from sonarpost.logs import kv
from sonarpost.messages import Advice, Command, Decision, ReconstructedImage, Record, Relayed
from sonarpost.runtime.service import Service, ServiceStoppingError, UnitOfWork
from sonarpost.services.c2 import tasking
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.tasking import Tasking

__all__ = ["C2Service", "decision_file_name"]

log = logging.getLogger(__name__)

COMMAND_PRIORITY = 1
ADVICE_PRIORITY = 2
CONSUMER = "relay"
RETAIN_EVERY_S = 60.0
RETRY_S = 1.0


class C2Service(Service[C2Config]):
    """Accepts relayed records, and hands advice and commands down.

    A record is acknowledged to the vessel when it is in this service's store (that is the commit), and shown to
    subscribers when its files are written. Subscribers may see a record again after a restart; they know it by its
    identifiers.
    """

    NAME = "c2"
    BATCH = 32
    # What goes down to a vessel is shown there by its relay; a second copy would only load the radio link.
    PUBLISH = False

    def __init__(self, platform: PlatformConfig, config: C2Config) -> None:
        super().__init__(platform, config)
        self._archive = Archive(config)
        self._retain_now = threading.Event()
        self._changed = threading.Event()
        self._changed_names: set[str] = set()
        self._changed_lock = threading.Lock()
        self._background_problem: dict[str, str] = {}
        # Of the records that are handled and not committed yet.
        self._to_show: list[tuple[str, Record]] = []
        self._uncommitted: dict[str, bytes] = {}

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Whatever vessels relay to this site, and what the shore wants to say to them."""
        site = self.config.site
        return {
            keys.shore_inbox_all(site): Relayed,
            keys.tasking_advice_all(site): Advice,
            keys.tasking_command_all(site): Command,
        }

    # From the vessels

    def validate(self, key: str, record: Record) -> None:
        """Refuse what would not be understood later, while its sender can still be told."""
        if isinstance(record, Relayed):
            if key != keys.shore_inbox(record.vessel_id, self.config.site):
                # Access control lets a vessel write under its own key only: no vessel speaks for another.
                raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")
            self._open(record)
            return
        assert isinstance(record, (Advice, Command))
        vessel = keys.tasking_vessel(key)
        if isinstance(record, Advice) and record.vessel_id != vessel:
            raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")
        self._known(vessel, key, record)

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Keep and show what a vessel relays; owe a vessel what is for it."""
        if isinstance(record, Relayed):
            inner = self._open(record)
            if isinstance(inner, ReconstructedImage):
                self._keep_image(inner, record.relayed_utc_s, effects)
            else:
                self._keep_decision(inner, effects)
        else:
            assert isinstance(record, (Advice, Command))
            self._pass_down(keys.tasking_vessel(key), key, record, effects)

    def _open(self, envelope: Relayed) -> ReconstructedImage | Decision:
        vessel = envelope.vessel_id
        known: Mapping[str, type[ReconstructedImage] | type[Decision]] = {
            keys.image_reconstructed(vessel): ReconstructedImage,
            keys.contact_decision(vessel): Decision,
        }
        record_type = known.get(envelope.key)
        if record_type is None:
            raise PayloadError(keys.shore_inbox(vessel, self.config.site), "key", envelope.key, " or ".join(known))
        inner = wire.decode(record_type, envelope.payload, envelope.key)
        if inner.vessel_id != vessel:
            raise PayloadError(envelope.key, "vessel_id", inner.vessel_id, vessel)
        return inner

    def _keep_image(self, image: ReconstructedImage, relayed_utc_s: float, effects: UnitOfWork) -> None:
        new = self._archive.keep_image(image, relayed_utc_s)
        effects.count("images_stored" if new else "images_repeated")
        self._to_show.append((keys.shore_image(image.vessel_id, self.config.site), image))

    def _keep_decision(self, decision: Decision, effects: UnitOfWork) -> None:
        new = self._archive.keep_decision(decision)
        effects.count("decisions_stored" if new else "decisions_repeated")
        self._to_show.append((keys.shore_decision(decision.vessel_id, self.config.site), decision))

    def commit_batch(self, handled: Sequence[tuple[UnitOfWork, InboxItem | None]]) -> int:
        """Commit when the files of all are on the disk and have been shown.

        Raises:
            OSError, DeliveryError: They cannot be written now; all are handled again.
        """
        try:
            self._archive.flush()
            for key, record in self._to_show:
                self._show(key, record)
            superseded = super().commit_batch(handled)
        finally:
            self._to_show.clear()
            self._uncommitted.clear()
        if self.config.max_bytes is not None and any(effects.counts.get("images_stored") for effects, _ in handled):
            self._retain_now.set()
        return superseded

    # To the vessels

    def _known(self, vessel: str, key: str, record: Advice | Command) -> bool:
        """Tell whether a record was taken before.

        Raises:
            PayloadError: Another one with this identifier was.
        """
        name = tasking.name_of(vessel, *tasking.kind_and_id(record))
        kept = self._uncommitted.get(name) or self.store.get_state(name)
        if kept is None:
            return False
        tasking.refuse_another(Tasking.unpack(kept), record, key)
        return True

    def _pass_down(self, vessel: str, key: str, record: Advice | Command, effects: UnitOfWork) -> None:
        if self._known(vessel, key, record):
            effects.count("tasking_repeated")
            return
        payload = effects.payload
        kind, record_id = tasking.kind_and_id(record)
        item = Tasking(vessel, kind, payload, changed_utc_s=time.time())
        priority = ADVICE_PRIORITY if isinstance(record, Advice) else COMMAND_PRIORITY
        # One queue a vessel: one that is away holds no other back.
        effects.send_payload(item.key, queue_of(CONSUMER, vessel), payload, type(record), priority=priority)
        packed = item.pack()
        effects.put_state(item.name, packed)
        self._uncommitted[item.name] = packed
        effects.count("tasking_accepted")
        self._tell(item.name)
        log.info(
            "Accepted for a vessel",
            extra=kv(
                vessel=vessel, kind=kind, record_id=record_id, vehicle=record.vehicle_id, image_id=record.image_id
            ),
        )

    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Remember, with the acknowledgement itself, that a vessel has taken or refused a record."""
        vessel = item.queue.partition("@")[2]
        was = tasking.of_payload(vessel, item.key, item.payload)
        now = replace(
            was, state="delivered" if reason is None else "refused", reason=reason or "", changed_utc_s=time.time()
        )
        tx.put_state(now.name, now.pack())
        self._tell(now.name)

    def _tell(self, name: str) -> None:
        with self._changed_lock:
            self._changed_names.add(name)
        self._changed.set()

    def _show_states(self) -> None:
        """Show and index the states that have changed, as they are committed; after a start all of them once."""
        with self._changed_lock:
            self._changed_names.update(self.store.state_names(tasking.PREFIX))
        while not self.stopping.is_set():
            self._changed.clear()
            try:
                self._show_changed()
                self._background_problem.pop("tasking", None)
            except (OSError, DeliveryError) as error:
                self._background_problem["tasking"] = f"{type(error).__name__}: {error}"
            except ServiceStoppingError:
                return
            self._changed.wait(RETRY_S)

    def _show_changed(self) -> None:
        # Taken out before they are read: what changes from now on is told again.
        with self._changed_lock:
            names, self._changed_names = self._changed_names, set()
        try:
            for name in sorted(names):
                kept = self.store.get_state(name)
                if kept is None:
                    continue  # told before it was committed
                item = Tasking.unpack(kept)
                self._archive.keep_tasking([item.row()])
                self._show(keys.tasking_state(item.vessel_id, self.config.site), item.state_record())
                names.discard(name)
        finally:
            with self._changed_lock:
                self._changed_names |= names

    # Life

    def on_start(self) -> None:
        """Begin to remove what is too old, and to show how far advice and commands have come."""
        self.start_thread(self._retain, "retention")
        self.start_thread(self._show_states, "tasking")
        declare_presence(self.session, self.platform.id, self.NAME, self.config.site)

    def on_stop(self) -> None:
        """Wake what waits."""
        self._retain_now.set()
        self._changed.set()

    def stop(self) -> None:
        """Stop, and close the index when nothing uses it any more."""
        super().stop()
        self._archive.close()

    def _retain(self) -> None:
        while not self.stopping.is_set():
            self._retain_now.clear()
            try:
                removed = self._archive.apply_retention(time.time())
                if removed:
                    self.count("images_removed", len(removed))
                self._background_problem.pop("retention", None)
            except OSError as error:
                self._background_problem["retention"] = f"pictures cannot be removed: {error}"
                log.error("Retention cannot work", extra=kv(reason=str(error)))
            self._retain_now.wait(RETAIN_EVERY_S)

    def degraded_reason(self) -> str:
        """Return what keeps the background work from being done."""
        return "; ".join(tuple(self._background_problem.values()))

    def gauges(self) -> Mapping[str, float]:
        """Return how much is kept, and how much waits for vessels."""
        waiting = [q for q in self.store.queues() if q.startswith(CONSUMER)]
        return {
            "pictures_bytes": float(self._archive.pictures_bytes()),
            "waiting_for_vessels": float(sum(self.store.queue_depth(queue).records for queue in waiting)),
        }

    def _show(self, key: str, record: Record) -> None:
        try:
            self.session.put(key, wire.encode(record), encoding=wire.encoding_of(type(record)))
        except zenoh.ZError as error:
            if self.stopping.is_set():
                # The session closed under us: the record is shown after the next start.
                raise ServiceStoppingError from error
            log.warning("Record not shown to the shore", extra=kv(key=key, error=str(error)))
