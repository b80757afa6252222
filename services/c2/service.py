"""Shore side of the relay: stores and publishes the records of vessels, and sends advice and commands to vessels."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

from sonarpost import keys, wire
from sonarpost.bus.connectivity import declare_presence
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import InboxItem, OutboxItem, platform_of, queue_of
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import DeliveryError, PayloadError
from sonarpost.logs import kv
from sonarpost.messages import Advice, Command, Decision, ReconstructedImage, Record, Relayed
from sonarpost.runtime.retention import Retention
from sonarpost.runtime.service import Service, ServiceStoppingError, UnitOfWork
from sonarpost.services.c2 import tasking
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.tasking import Tasking

log = logging.getLogger(__name__)

COMMAND_PRIORITY = 1
ADVICE_PRIORITY = 2
CONSUMER = "relay"
VERIFICATION_INTERVAL_S = 60.0
RETRY_S = 1.0


class C2Service(Service[C2Config]):
    """Stores and publishes relayed records, and sends advice and commands to vessels.

    A record is acknowledged to the vessel when it is committed to this service's store, and published to subscribers
    when its files are written. A restart can publish a record again; subscribers identify it by its identifiers.
    """

    NAME = "c2"
    BATCH = 32
    # The relay of the vessel publishes advice and commands; a copy from here would only load the radio link.
    PUBLISH = False

    def __init__(self, platform: PlatformConfig, config: C2Config) -> None:
        super().__init__(platform, config)
        self._archive = Archive(config)
        self._retention = Retention(self._apply_retention, self.stopping)
        self._changed = threading.Event()
        self._changed_names: set[str] = set()
        self._changed_lock = threading.Lock()
        self._background_faults: dict[str, str] = {}
        # Of the records that are handled and not committed yet.
        self._to_publish: list[tuple[str, Record]] = []
        self._uncommitted: dict[str, bytes] = {}

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Relayed records of all vessels, and advice and commands for them."""
        site = self.config.site
        return {
            keys.shore_inbox_all(site): Relayed,
            keys.tasking_advice_all(site): Advice,
            keys.tasking_command_all(site): Command,
        }

    # Records of vessels

    def validate(self, key: str, record: Record) -> None:
        """Refuse records that cannot be handled later, so that their senders are informed."""
        if isinstance(record, Relayed):
            if key != keys.shore_inbox(record.vessel_id, self.config.site):
                # Access control restricts a vessel to its own key, so the key proves the vessel.
                raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")
            self._unpack(record)
            return
        assert isinstance(record, (Advice, Command))
        vessel = keys.tasking_vessel(key)
        if isinstance(record, Advice) and record.vessel_id != vessel:
            raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")
        self._is_known(vessel, key, record)

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Store the record of a vessel, or queue advice and commands for one."""
        if isinstance(record, Relayed):
            inner = self._unpack(record)
            if isinstance(inner, ReconstructedImage):
                self._store_image(inner, record.relayed_utc_s, effects)
            else:
                self._store_decision(inner, effects)
        else:
            assert isinstance(record, (Advice, Command))
            self._send_to_vessel(keys.tasking_vessel(key), key, record, effects)

    def _unpack(self, envelope: Relayed) -> ReconstructedImage | Decision:
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

    def _store_image(self, image: ReconstructedImage, relayed_utc_s: float, effects: UnitOfWork) -> None:
        written = self._archive.store_image(image, relayed_utc_s)
        effects.count("images_stored" if written.is_new else "images_repeated")
        if written.is_new and written.is_conflict:
            effects.count("images_conflicting")
        self._to_publish.append((keys.shore_image(image.vessel_id, self.config.site), image))

    def _store_decision(self, decision: Decision, effects: UnitOfWork) -> None:
        new = self._archive.store_decision(decision)
        effects.count("decisions_stored" if new else "decisions_repeated")
        self._to_publish.append((keys.shore_decision(decision.vessel_id, self.config.site), decision))

    def commit_batch(self, handled: Sequence[tuple[UnitOfWork, InboxItem | None]]) -> int:
        """Commit after the files of all records are on the disk and published.

        Raises:
            OSError, DeliveryError: They cannot be written; all records are handled again.
        """
        try:
            self._archive.flush()
            for key, record in self._to_publish:
                self._publish_stored(key, record)
            superseded = super().commit_batch(handled)
        finally:
            self._to_publish.clear()
            self._uncommitted.clear()
        if any(effects.counts.get("images_stored") for effects, _ in handled):
            self._retention.wake()
        return superseded

    # Records for vessels

    def _is_known(self, vessel: str, key: str, record: Advice | Command) -> bool:
        """Return whether a record was accepted before.

        Raises:
            PayloadError: A different one with this identifier was.
        """
        name = tasking.state_name(vessel, *tasking.kind_and_id(record))
        known = self._uncommitted.get(name) or self.store.get_state(name)
        if known is None:
            return False
        tasking.reject_conflict(Tasking.unpack(known), record, key)
        return True

    def _send_to_vessel(self, vessel: str, key: str, record: Advice | Command, effects: UnitOfWork) -> None:
        if self._is_known(vessel, key, record):
            effects.count("tasking_repeated")
            return
        payload = effects.payload
        kind, record_id = tasking.kind_and_id(record)
        item = Tasking(vessel, kind, payload, changed_utc_s=time.time())
        priority = ADVICE_PRIORITY if isinstance(record, Advice) else COMMAND_PRIORITY
        # One queue for each vessel: an unreachable vessel does not delay the others.
        effects.send_payload(item.key, queue_of(CONSUMER, vessel), payload, type(record), priority=priority)
        packed = item.pack()
        effects.put_state(item.name, packed)
        self._uncommitted[item.name] = packed
        effects.count("tasking_accepted")
        self._mark_changed(item.name)
        log.info("Record queued for a vessel", extra=kv(vessel=vessel, kind=kind, record_id=record_id))

    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Store that a vessel has accepted or refused a record, in the transaction of its acknowledgement."""
        vessel = platform_of(item.queue)
        was = tasking.of_payload(vessel, item.key, item.payload)
        now = replace(
            was, state="delivered" if reason is None else "refused", reason=reason or "", changed_utc_s=time.time()
        )
        tx.put_state(now.name, now.pack())
        self._mark_changed(now.name)

    def _mark_changed(self, name: str) -> None:
        with self._changed_lock:
            self._changed_names.add(name)
        self._changed.set()

    def _publish_states(self) -> None:
        """Publish and index changed states after their commit; after a start all states once."""
        with self._changed_lock:
            self._changed_names.update(self.store.state_names(tasking.PREFIX))
        while not self.stopping.is_set():
            self._changed.clear()
            try:
                self._publish_changed()
                self._background_faults.pop("tasking", None)
            except (OSError, DeliveryError) as error:
                self._background_faults["tasking"] = f"{type(error).__name__}: {error}"
            except ServiceStoppingError:
                return
            self._changed.wait(RETRY_S)

    def _publish_changed(self) -> None:
        # Cleared before the states are read: later changes are published again.
        with self._changed_lock:
            names, self._changed_names = self._changed_names, set()
        try:
            for name in sorted(names):
                packed = self.store.get_state(name)
                if packed is None:
                    continue  # not committed yet
                item = Tasking.unpack(packed)
                self._archive.store_tasking([item.row()])
                self._publish_stored(keys.tasking_state(item.vessel_id, self.config.site), item.state_record())
                names.discard(name)
        finally:
            with self._changed_lock:
                self._changed_names |= names

    # Start and stop

    def on_start(self) -> None:
        """Start the retention and the publication of delivery states."""
        self.start_thread(self._retention.run, "retention")
        self.start_thread(self._run_verification, "verification")
        self.start_thread(self._publish_states, "tasking")
        declare_presence(self.session, self.platform.id, self.NAME, self.config.site)

    def on_stop(self) -> None:
        """Wake the background threads."""
        self._retention.wake()
        self._changed.set()

    def stop(self) -> None:
        """Stop, then close the index."""
        super().stop()
        self._archive.close()

    def _apply_retention(self, now_utc_s: float) -> None:
        removed = self._archive.apply_retention(now_utc_s)
        if removed:
            self.count("images_removed", len(removed))

    def _run_verification(self) -> None:
        while not self.stopping.wait(VERIFICATION_INTERVAL_S):
            try:
                self._archive.verify(time.time(), VERIFICATION_INTERVAL_S)
                self._background_faults.pop("verification", None)
            except OSError as error:
                self._background_faults["verification"] = f"stored files cannot be verified: {error}"
                log.error("Verification of stored files failed", extra=kv(reason=str(error)))

    def warning(self) -> str:
        """Return how many records are missing, changed or conflicting in `out_dir`."""
        counts = [f"{count} {defect}" for defect, count in self._archive.defect_counts().items() if count]
        return f"{self.config.out_dir}: stored records {', '.join(counts)}" if counts else ""

    def degraded_reason(self) -> str:
        """Return the faults of the background threads."""
        return "; ".join(fault for fault in (*self._background_faults.values(), self._retention.error) if fault)

    def gauges(self) -> Mapping[str, float]:
        """Return the size of the stored images and the number of records queued for vessels."""
        waiting = [q for q in self.store.queues() if q.startswith(CONSUMER)]
        return {
            "pictures_bytes": float(self._archive.images_bytes()),
            "waiting_for_vessels": float(sum(self.store.queue_depth(queue).records for queue in waiting)),
            **{f"records_{defect}": float(count) for defect, count in self._archive.defect_counts().items()},
        }

    def _publish_stored(self, key: str, record: Record) -> None:
        """Publish a record.

        Raises:
            ServiceStoppingError: The session was closed: the record is published after the next start.
        """
        if not self.publish(key, record) and self.stopping.is_set():
            raise ServiceStoppingError
