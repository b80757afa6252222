"""Shore side of the relay: stores and publishes the records of vessels, and sends comments and commands to vessels."""

from __future__ import annotations

import logging
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial

from typing_extensions import override

from sonarpost import keys, wire
from sonarpost.archive import image_parts
from sonarpost.archive.backlog import BacklogRecord
from sonarpost.archive.codebook_transfer import CodebookFetcher
from sonarpost.archive.decode_worker import DecodeWorker, PackedImage
from sonarpost.archive.decoder import OTHER_PIXELS
from sonarpost.archive.journal import Accepted, JournalEntry
from sonarpost.bus.connectivity import declare_presence
from sonarpost.bus.session import open_with_retry
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import DeliveryError, PayloadError, SonarpostError
from sonarpost.logs import kv
from sonarpost.messages import (
    CodedImage,
    Command,
    Comment,
    Decision,
    ImagePart,
    ReceivedStatus,
    ReconstructedImage,
    Record,
    Relayed,
)
from sonarpost.runtime.retention import Retention
from sonarpost.runtime.service import Service, ServiceStoppingError, UnitOfWork
from sonarpost.services.c2.accepted import accepted_fields, accepted_payload
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.decoding import Decoding
from sonarpost.services.c2.inputs import inputs
from sonarpost.services.c2.json_form import ENCODING, json_payload
from sonarpost.services.c2.queries import QueryService
from sonarpost.services.c2.tasking_delivery import CONSUMER, TaskingDelivery

log = logging.getLogger(__name__)

VERIFICATION_INTERVAL_S = 60.0
RETRY_S = 1.0
TAKE_OVER_INTERVAL_S = 5.0
OWNER = "archive-owner"
"""State with the identity of this service's store."""
VERSIONS = "version/"
"""Prefix of the states with the last accepted version of an image, to which vessels send differences."""
CODEBOOKS = "codebooks"
"""Folder of state_dir with the codebooks of vessels."""


@lru_cache(1024)
def _relayed_types(vessel: str) -> Mapping[str, type[ReconstructedImage] | type[Decision] | type[ReceivedStatus]]:
    """Return the types of the records in envelopes of a vessel, by their keys."""
    return {
        keys.image_reconstructed(vessel): ReconstructedImage,
        keys.contact_decision(vessel): Decision,
        keys.acoustic_status(vessel): ReceivedStatus,
    }


class C2Service(Service[C2Config]):
    """Stores and publishes relayed records, and sends comments and commands to vessels.

    A record is acknowledged to the vessel when it is committed to this service's store, and published to subscribers
    when its files are written. Coded images are decoded by other processes, while further records are
    accepted. A restart can publish a record again; subscribers identify it by its identifiers.
    """

    NAME = "c2"
    BATCH = 32
    # The relay of the vessel publishes comments and commands; a copy from here would only load the radio link.
    PUBLISH = False

    def __init__(self, platform: PlatformConfig, config: C2Config) -> None:
        # Before the store is opened: a wrong secret ends the service.
        added = {name: each.configured(config) for name, each in inputs().working().items()}
        self._inputs = {name: each for name, each in added.items() if each is not None}
        super().__init__(platform, config)
        self._archive = Archive(config, self._owner())
        self._queries = QueryService(self._archive, config.site, self.count)
        self._retention = Retention(self._apply_retention, self.stopping)
        self._tasking = TaskingDelivery(self.store, self._archive, self._publish_stored)
        self._background_faults: dict[str, str] = {}
        self._stored_versions = Counter[str]()
        folder = platform.state_dir / CODEBOOKS
        self.decoding = Decoding(
            self.store,
            lambda: self._archive.index().backlog,
            [DecodeWorker(config.codebooks, folder, platform.state_dir) for _ in range(config.decode_workers)],
            self._keep_images,
            self._on_undecodable,
            self.stopping,
        )
        self._codebooks = CodebookFetcher(folder, self.decoding.missing.models, self.decoding.wake, self.stopping)
        self.decoding.missing.on_added = self._codebooks.wake

    def _owner(self) -> str:
        """Return the identity of this service's store, which is made once: a new store is another owner of records."""
        known = self.store.read_state(OWNER, lambda value: uuid.UUID(value.decode()).hex, None)
        if known is None:
            known = uuid.uuid4().hex
            with self.store.transaction() as tx:
                tx.put_state(OWNER, known.encode())
        return known

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Relayed records of all vessels, and comments and commands for them."""
        site = self.config.site
        return {
            keys.shore_inbox_all(site): Relayed,
            keys.shore_part_all(site): ImagePart,
            keys.tasking_comment_all(site): Comment,
            keys.tasking_command_all(site): Command,
        }

    # Records of vessels

    @override
    def validate(self, key: str, record: Record) -> Record | None:
        """Refuse records that cannot be handled later, so that their senders are informed; return a coded image."""
        if isinstance(record, Relayed):
            if key != keys.shore_inbox(record.vessel_id, self.config.site):
                # Access control restricts a vessel to its own key, so the key proves the vessel.
                raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")
            self._unpack(record)
            return None
        if isinstance(record, ImagePart):
            return image_parts.coded_image(record, keys.part_vessel(key), key) if record.b == 0 else None
        assert isinstance(record, (Comment, Command))
        vessel = keys.tasking_vessel(key)
        if isinstance(record, Comment) and record.vessel_id != vessel:
            raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")
        self._tasking.is_known(vessel, key, record)
        return None

    @override
    def expand(self, tx: Transaction, key: str, payload: bytes, record: Record) -> tuple[bytes, Record]:
        """Return the whole image of a difference; store it, because the vessel sends later differences to it.

        Raises:
            MissingBaseError: The version to which it is the difference is not known.
        """
        if isinstance(record, CodedImage):
            vehicle, image, first_frame_utc_s = record.vehicle_id, record.image_id, record.first_frame_utc_s
            version = record.version
        elif isinstance(record, ImagePart):
            vehicle, image, first_frame_utc_s, version = record.u, record.i, record.t, record.n
        else:
            return payload, record
        vessel = keys.part_vessel(key)
        prefix = f"{VERSIONS}{vessel}/"
        name = prefix + image_parts.subject(vehicle, image, first_frame_utc_s)
        if version == 1:
            tx.add_state(name, payload)  # a stored one is the same version or a later one
            self._prune_versions(tx, prefix)
            return payload, record
        known = image_parts.stored_version(tx.get_state(name), name)
        if isinstance(record, ImagePart):
            whole = image_parts.expand(record, known, key)
            record = image_parts.coded_image(whole, vessel, key)
            payload = wire.encode(whole)
        if known is None or known.n < version:
            tx.put_state(name, payload)
            self._prune_versions(tx, prefix)
        return payload, record

    def _prune_versions(self, tx: Transaction, prefix: str) -> None:
        self._stored_versions[prefix] += 1
        if (self._stored_versions[prefix] - 1) % image_parts.PRUNE_EVERY == 0:
            surplus = image_parts.surplus_names(tx.state_names(prefix))
            tx.delete_states(prefix, (name.removeprefix(prefix) for name in surplus))

    @override
    def before_accepting(self, records: Sequence[tuple[str, bytes]]) -> None:
        """Commit records to an archive that several c2 share, so that another one can handle them."""
        if self._archive.is_shared:
            self._archive.accept(records)

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Store the record of a vessel, or queue comments and commands for one."""
        accepted = BacklogRecord(key, effects.payload)
        try:
            self._handle(key, record, effects)
        except (OSError, DeliveryError, MemoryError, ServiceStoppingError):
            raise
        except Exception:
            if self._archive.is_shared:
                self._archive.discard(accepted)
            raise
        if self._archive.is_shared and not isinstance(record, (ImagePart, CodedImage)):
            self._archive.finished(accepted)

    def _handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        if isinstance(record, Relayed):
            inner = self._unpack(record)
            if isinstance(inner, ReconstructedImage):
                self._store_image(inner, record.relayed_utc_s, effects)
            elif isinstance(inner, ReceivedStatus):
                self._publish_status(inner, effects)
            else:
                self._store_decision(inner, effects)
        elif isinstance(record, CodedImage):
            self._accept_image(key, record, effects)
        elif isinstance(record, ImagePart):
            self._accept_image(key, image_parts.coded_image(record, keys.part_vessel(key), key), effects)
        else:
            assert isinstance(record, (Comment, Command))
            self._tasking.send(keys.tasking_vessel(key), key, record, effects)

    def _publish_status(self, status: ReceivedStatus, effects: UnitOfWork) -> None:
        """Publish the status of a vehicle. It is not archived: a newer one replaces it."""
        key = keys.shore_status(status.vessel_id, self.config.site)
        self.publish(key, status)
        if self.config.json_mirror:
            self.publish_payload(keys.json_mirror(key), json_payload(wire.map_of(status), "none"), ENCODING)
        effects.count("statuses_published")

    def _unpack(self, envelope: Relayed) -> ReconstructedImage | Decision | ReceivedStatus:
        vessel = envelope.vessel_id
        known = _relayed_types(vessel)
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

    def _accept_image(self, key: str, image: CodedImage, effects: UnitOfWork) -> None:
        """Add a coded image to the backlog of the decoder, and publish it in coded form."""
        self._archive.queue_image(key, effects.payload, image)
        effects.count("images_accepted")

    def _keep_images(self, images: Sequence[PackedImage], entries: Sequence[BacklogRecord]) -> None:
        """Store and publish decoded images of entries of the backlog.

        Raises:
            OSError, DeliveryError: They cannot be written.
            ServiceStoppingError: The service stops; they are decoded again after the next start.
        """
        # Records are added to the archive and flushed by one thread at a time.
        with self.handling():
            written = [self._archive.store_image(image, image.last_frame_utc_s, payload) for image, payload in images]
            for entry in entries:
                self._archive.finished(entry)
            stored = self._archive.flush()
        for (image, _), files in zip(images, written, strict=True):
            self.count("images_stored" if files.is_new else "images_repeated")
            if files.is_new and files.is_conflict:
                self.count("images_conflicting")
            if OTHER_PIXELS in image.notes:
                self.count("images_differing")
                log.warning(
                    "Image decoded with other pixels than on the vessel",
                    extra=kv(vessel=image.vessel_id, codec=image.codec),
                )
        self._publish_stored(stored)
        if any(files.is_new for files in written):
            self._retention.wake()

    def _on_undecodable(self, entry: BacklogRecord, reason: str) -> None:
        self._archive.discard(entry)
        self.count("images_undecodable")
        log.error("Image cannot be decoded", extra=kv(vessel=entry.vessel_id, reason=reason))

    @contextmanager
    @override
    def handling(self, *, wait: bool = True) -> Iterator[bool]:
        """Hold the lock under which records are handled, committed and archived; forget what was not committed."""
        with super().handling(wait=wait) as is_held:
            try:
                yield is_held
            finally:
                if is_held:
                    self._archive.forget()
                    self._tasking.forget()

    def _store_decision(self, decision: Decision, effects: UnitOfWork) -> None:
        new = self._archive.store_decision(decision)
        effects.count("decisions_stored" if new else "decisions_repeated")

    @override
    def before_commit(self) -> None:
        """Commit all records to the archive, and publish them.

        Raises:
            OSError, DeliveryError: They cannot be written; all records are handled again.
        """
        self._publish_stored(self._archive.flush())

    @override
    def after_commit(self, handled: Sequence[UnitOfWork], superseded: int) -> None:
        """Wake the decoder and the retention for new images."""
        super().after_commit(handled, superseded)
        if any(effects.counts.get("images_accepted") for effects in handled):
            self.decoding.wake()
        if any(effects.counts.get("images_stored") for effects in handled):
            self._retention.wake()

    @override
    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Store that a vessel has accepted or refused a record, in the transaction of its acknowledgement."""
        self._tasking.acknowledged(tx, item, reason)

    # Background work

    def _publish_states(self) -> None:
        """Publish and index changed states of comments and commands after their commit; after a start all states."""
        self._tasking.mark_all_changed()
        while not self.stopping.is_set():
            self._tasking.changed.clear()
            self._try("tasking", self._tasking.publish_changed)
            self._tasking.changed.wait(RETRY_S)

    def _try(self, name: str, work: Callable[[], object]) -> bool:
        """Do background work; return whether it succeeded. Why it fails is reported, and it is tried again."""
        try:
            work()
        except ServiceStoppingError:
            return True
        except Exception as error:
            if not isinstance(error, (OSError, SonarpostError)) and name not in self._background_faults:
                log.exception("Background work failed after an unexpected exception")
            self._background_faults[name] = f"{name}: {type(error).__name__}: {error}"
            return False
        self._background_faults.pop(name, None)
        return True

    def _run_verification(self) -> None:
        while not self.stopping.wait(VERIFICATION_INTERVAL_S):
            self._try("verification", lambda: self._archive.verify(time.time(), VERIFICATION_INTERVAL_S))

    def _take_over(self) -> None:
        """Handle the records that another c2 has acknowledged and not handled before it ended."""
        while not self.stopping.wait(TAKE_OVER_INTERVAL_S):
            is_reached = self._try("take-over", self._take_over_all)
            self._prefer_others(others=not is_reached)

    def _prefer_others(self, *, others: bool) -> None:
        """Leave records and queries to c2 that reach the database while there is one, or end that."""
        self.prefer_other_consumers(others=others)
        self._queries.set_preferred(is_preferred=not others)

    def _take_over_all(self) -> None:
        while taken := self._archive.take_over(self._store_taken):
            self.count("records_taken_over", taken)
            log.warning("Records of another c2 taken over", extra=kv(records=taken))

    def _store_taken(self, records: Sequence[tuple[str, bytes]]) -> None:
        with self.store.transaction() as tx:
            for key, payload in records:
                tx.accept(key, payload)

    # Start and stop

    @override
    def before_session(self) -> None:
        """Open the archive, so that a wrong database ends the start."""
        self._archive.open()

    @override
    def on_start(self) -> None:
        """Start the retention and the publication of delivery states."""
        self.start_thread(self._retention.run, "retention")
        self.start_thread(self._run_verification, "verification")
        self.start_thread(self._publish_states, "tasking")
        if self._archive.is_shared:
            self.start_thread(self._take_over, "take-over")
        self.start_thread(self.decoding.run, "decoding")
        self.start_thread(lambda: self._codebooks.run(self.session), "codebooks")
        self.start_thread(self._run_queries, "queries")
        for name, each in self._inputs.items():
            each.open(self)
            self.start_thread(partial(each.run, self.stopping), name)
        declare_presence(self.session, self.platform.id, self.NAME, self.config.site)

    @override
    def on_stop(self) -> None:
        """Close the other inputs and wake the background threads."""
        for each in self._inputs.values():
            each.close()
        self._retention.wake()
        self._tasking.changed.set()
        self.decoding.close()
        self._codebooks.wake()

    @override
    def stop(self) -> None:
        """Stop, then close the archive."""
        super().stop()
        self._archive.close()

    def _apply_retention(self, now_utc_s: float) -> None:
        removed = self._archive.apply_retention(now_utc_s)
        if removed:
            self.count("images_removed", len(removed))

    def _run_queries(self) -> None:
        """Answer queries over a session of their own until the service stops."""
        session = open_with_retry(self.platform.router, self.stopping, self.platform.tls)
        if session is not None:
            self._queries.start(session)
            self.stopping.wait()
            self._queries.close()

    @override
    def warning(self) -> str:
        """Return how many records are missing, changed or conflicting, and which codebooks are missing."""
        waiting = self.decoding.missing.warning()
        reasons = "; ".join(sorted(set(self._codebooks.faults.values())))
        waiting = f"{waiting}: {reasons}" if waiting and reasons else waiting
        counts = [f"{count} {defect}" for defect, count in self._archive.defect_counts().items() if count]
        place = self.config.out_dir if self.config.database is None else "database"
        stored = f"{place}: stored records {', '.join(counts)}" if counts else ""
        return "; ".join(text for text in (stored, waiting) if text)

    @override
    def degraded_reason(self) -> str:
        """Return the faults of the archive and of the background threads."""
        faults = (
            self._archive.fault(),
            *self._background_faults.values(),
            *(fault for each in self._inputs.values() for fault in each.faults()),
            self.decoding.fault,
            self._retention.error,
        )
        return "; ".join(dict.fromkeys(fault for fault in faults if fault))

    @override
    def gauges(self) -> Mapping[str, float]:
        """Return the size of the stored images and the number of records queued for vessels."""
        waiting = [q for q in self.store.queues() if q.startswith(CONSUMER)]
        return {
            "images_undecoded": float(self._archive.waiting_count()),
            "images_bytes": float(self._archive.images_bytes()),
            "waiting_for_vessels": float(sum(self.store.queue_depth(queue).records for queue in waiting)),
            **{f"records_{defect}": float(count) for defect, count in self._archive.defect_counts().items()},
        }

    def _publish_stored(self, stored: Sequence[tuple[JournalEntry, Accepted]]) -> None:
        """Publish records with their numbers.

        Raises:
            ServiceStoppingError: The session was closed: the records are published after the next start.
        """
        for entry, accepted in stored:
            encoding = wire.encoding_of(type(entry.record))
            payload = accepted_payload(entry, accepted)
            if not self.publish_payload(entry.key, payload, encoding) and self.stopping.is_set():
                raise ServiceStoppingError
            if self.config.json_mirror:
                fields = accepted_fields(entry.fields, accepted)
                self.publish_payload(keys.json_mirror(entry.key), json_payload(fields, "png"), ENCODING)
