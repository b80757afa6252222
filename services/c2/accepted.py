"""Accepted records of c2 for subscribers: their numbers, and pages of them for queries.

The journal is opened when it is first required, as the index of the archive is, and completed from the stored files.
Several c2 with one archive have one journal, in the database.
"""

from __future__ import annotations

import hashlib
import logging
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import msgpack

from sonarpost import keys
from sonarpost.archive.image_files import stored_image
from sonarpost.archive.journal import Accepted, Journal, JournalEntry, JournalRecord, JournalRow
from sonarpost.archive.shared_journal import SharedJournal
from sonarpost.archive.shore_database import ShoreDatabase
from sonarpost.archive.shore_files import decision_path
from sonarpost.archive.shore_index import DecisionRow, ImageRow, ShoreIndex
from sonarpost.delivery.store import UNREADABLE
from sonarpost.errors import BadInputError, RejectedByDatabaseError, StoredFileError
from sonarpost.files import read_regular
from sonarpost.logs import kv
from sonarpost.messages import CodedImage, Decision, Pixels, ReconstructedImage
from sonarpost.services.c2.archive import Archive, Storage
from sonarpost.services.c2.shared_archive import SharedArchive
from sonarpost.services.c2.tasking import Tasking
from sonarpost.sonar.image_decoding import MAX_FILE_BYTES
from sonarpost.sonar.image_files import read_image

log = logging.getLogger(__name__)

BATCH = 100
"""Stored images that are added to the journal in one transaction."""


class AcceptedRecords:
    """Journal of one archive; every method can be called from several threads.

    Args:
        archive: The archive.
        folder: Folder of the journal and the files; not used if several c2 share the archive.
        site: Name of the site in keys.
    """

    def __init__(self, archive: Storage, folder: Path, site: str) -> None:
        self._archive = archive
        self._folder = folder
        self._site = site
        self._journal: Journal | SharedJournal | None = None
        self._lock = threading.Lock()

    def journal(self) -> Journal | SharedJournal:
        """Return the open journal, completed from the stored records.

        Raises:
            OSError, DeliveryError: It cannot be written, or is of another version.
        """
        with self._lock:
            if self._journal is None:
                is_shared = isinstance(self._archive, SharedArchive)
                self._journal = self._open_shared() if is_shared else self._open()
            return self._journal

    def _open(self) -> Journal:
        index = self._archive.index() if isinstance(self._archive, Archive) else None
        try:
            journal = Journal(self._folder)
        except StoredFileError as error:
            raise OSError(str(error)) from error
        try:
            added = 0 if index is None else self._complete(journal, index)
        except BaseException:
            journal.close()
            raise
        if added:
            log.info("Journal completed from the files", extra=kv(file=journal.path, records=added))
        return journal

    def image(self, image: ReconstructedImage, name: str) -> JournalEntry:
        """Return the entry of an image; `name` is that of its files without suffix."""
        return JournalEntry(
            keys.shore_image(image.vessel_id, self._site),
            image,
            image.vessel_id,
            image.vehicle_id,
            image.image_id,
            f"{image.vehicle_id}/{image.image_id}/{image.first_frame_utc_s!r}",
            image.version,
            image.contact,
            name,
        )

    def coded(self, image: CodedImage) -> JournalEntry:
        """Return the entry of an image in coded form; it has no files."""
        key = keys.shore_coded(image.vessel_id, self._site)
        subject = f"{image.vehicle_id}/{image.image_id}/{image.first_frame_utc_s!r}"
        vehicle, image_id = image.vehicle_id, image.image_id
        return JournalEntry(key, image, image.vessel_id, vehicle, image_id, subject, image.version, image.contact)

    def decision(self, decision: Decision) -> JournalEntry:
        """Return the entry of a decision."""
        key = keys.shore_decision(decision.vessel_id, self._site)
        subject = decision.decision_id
        return JournalEntry(key, decision, decision.vessel_id, decision.vehicle_id, decision.image_id, subject)

    def state(self, item: Tasking) -> JournalEntry:
        """Return the entry of the state of a comment or command."""
        key = keys.tasking_state(item.vessel_id, self._site)
        record, state = item.record, item.state_record()
        subject = f"{state.kind}/{state.record_id}"
        return JournalEntry(key, state, item.vessel_id, record.vehicle_id, record.image_id or "", subject)

    def flush(self, entries: Sequence[JournalEntry]) -> list[Accepted]:
        """Make the images and decisions that were stored since the last call durable, and number records.

        Args:
            entries: The records, in the order of their numbers.

        Raises:
            OSError, DeliveryError: All of these records have to be stored again.
        """
        journal = self.journal()  # before the flush: it is completed from files that are flushed
        if isinstance(self._archive, SharedArchive):
            return self._archive.flush_numbered(_records(entries))
        self._archive.flush()
        assert isinstance(journal, Journal)
        return journal.append(entries, time.time()) if entries else []

    def number(self, entries: Sequence[JournalEntry]) -> list[Accepted]:
        """Number records that are not in the archive, in this order; they are on the disk afterwards.

        Raises:
            OSError, DeliveryError: The journal cannot be written.
        """
        journal = self.journal()
        if isinstance(self._archive, SharedArchive):
            return self._archive.number(_records(entries))
        assert isinstance(journal, Journal)
        return journal.append(entries, time.time())

    def remove(self, images: Iterable[ImageRow]) -> None:
        """Remove images that retention has deleted; a database does it itself.

        Raises:
            OSError: The journal cannot be written.
        """
        journal = self.journal()
        if isinstance(journal, Journal):
            journal.remove([(row.vessel_id, row.name) for row in images])

    def fields(self, row: JournalRow) -> dict[str, object]:
        """Return the complete payload of a record as a map.

        Raises:
            OSError, BadInputError, DeliveryError: Its pixels are missing, unreadable or of another image.
        """
        if not row.name:
            return row.fields
        data = Pixels.from_array(self._archive.read_pixels(row.vessel_id, row.name)).data
        digest = hashlib.sha256(data).hexdigest()
        if digest != row.fields["pixels_sha256"]:
            raise BadInputError(
                f"image {row.vessel_id}/{row.name}", "pixels_sha256", digest, str(row.fields["pixels_sha256"])
            )
        pixels = row.fields["pixels"]
        assert isinstance(pixels, dict)
        return {**row.fields, "pixels": {**pixels, "data": data}}

    def close(self) -> None:
        """Close the journal."""
        with self._lock:
            if isinstance(self._journal, Journal):
                self._journal.close()
            self._journal = None

    # Records that are stored and have no number

    def _complete(self, journal: Journal, index: ShoreIndex) -> int:
        """Make journal and index agree; return the number of added records."""
        stored = {(row.vessel_id, row.name): row for row in index.images()}
        known = journal.names()
        journal.remove(known - stored.keys())
        missing = [row for name, row in stored.items() if name not in known]
        missing.sort(key=lambda row: row.accepted_utc_s)
        added = 0
        for first in range(0, len(missing), BATCH):
            added += len(journal.append_dated(self._stored_images(missing[first : first + BATCH])))
        before = journal.last_seq()
        journal.append_dated(self._stored_decisions(index.decisions()))
        return added + journal.last_seq() - before

    def _stored_images(self, rows: Iterable[ImageRow]) -> Iterator[tuple[JournalEntry, float]]:
        for row in rows:
            path = self._folder / row.vessel_id / f"{row.name}.json"
            try:
                image = stored_image(
                    read_regular(path, MAX_FILE_BYTES), read_image(path.with_suffix(".tiff")), str(path)
                )
            except (OSError, *UNREADABLE) as error:
                self._not_available(path, error)
                continue
            yield self.image(image, row.name), row.accepted_utc_s

    def _stored_decisions(self, rows: Sequence[DecisionRow]) -> Iterator[tuple[JournalEntry, float]]:
        for row in sorted(rows, key=lambda row: row.accepted_utc_s):
            path = decision_path(self._folder, row.vessel_id, row.decision_id)
            try:
                decision = Decision.model_validate_json(read_regular(path, MAX_FILE_BYTES))
            except (OSError, *UNREADABLE) as error:
                self._not_available(path, error)
                continue
            yield self.decision(decision), row.accepted_utc_s

    def _not_available(self, path: Path | str, error: Exception) -> None:
        log.warning("Stored record is not available for queries", extra=kv(file=path, reason=str(error)[:200]))

    # The same in a database

    def _open_shared(self) -> SharedJournal:
        assert isinstance(self._archive, SharedArchive)
        database = self._archive.index()
        database.prepare()
        images = database.images_without_number()
        decisions = database.decisions_without_number(keys.shore_decision_all(self._site))
        added = 0
        for first in range(0, len(images), BATCH):
            added += self._number_stored(self._images_of(database, images[first : first + BATCH]))
        added += self._number_stored(self._decisions_of(database, decisions))
        if added:
            log.info("Journal completed from the database", extra=kv(records=added))
        return self._archive.journal()

    def _number_stored(self, entries: Iterable[tuple[JournalEntry, float]]) -> int:
        return self._number_divided([JournalRecord.of(entry, utc_s) for entry, utc_s in entries])

    def _number_divided(self, records: Sequence[JournalRecord]) -> int:
        """Number records without those that the database rejects; return their number."""
        assert isinstance(self._archive, SharedArchive)
        try:
            return len(self._archive.number(records))
        except RejectedByDatabaseError as error:
            if len(records) > 1:
                half = len(records) // 2
                return self._number_divided(records[:half]) + self._number_divided(records[half:])
            self._not_available(f"database: {records[0].subject}", error)
            return 0

    def _images_of(self, database: ShoreDatabase, rows: Iterable[ImageRow]) -> Iterator[tuple[JournalEntry, float]]:
        for row in rows:
            where = f"database: image {row.vessel_id}/{row.name}"
            try:
                side_car = database.image_files(row.vessel_id, row.name).get(".json", b"")
                image = stored_image(side_car, self._archive.read_pixels(row.vessel_id, row.name), where)
            except UNREADABLE as error:
                self._not_available(where, error)
                continue
            yield self.image(image, row.name), row.accepted_utc_s

    def _decisions_of(
        self, database: ShoreDatabase, rows: Iterable[DecisionRow]
    ) -> Iterator[tuple[JournalEntry, float]]:
        for row in rows:
            try:
                decision = Decision.model_validate_json(database.decision_content(row))
            except UNREADABLE as error:
                self._not_available(f"database: decision {row.vessel_id}/{row.decision_id}", error)
                continue
            yield self.decision(decision), row.accepted_utc_s


def _records(entries: Iterable[JournalEntry]) -> list[JournalRecord]:
    now_utc_s = time.time()
    return [JournalRecord.of(entry, now_utc_s) for entry in entries]


def accepted_fields(fields: Mapping[str, object], accepted: Accepted) -> dict[str, object]:
    """Return the map of a record with its number, as c2 publishes it and sends it as a reply.

    The number is a field and no attachment: consumers ignore publications with an attachment.
    """
    return {**fields, "accepted": {"archive": accepted.archive, "seq": accepted.seq, "utc_s": accepted.utc_s}}


def payload_of(fields: dict[str, object]) -> bytes:
    """Return the payload of a record's map, as `wire.encode` does."""
    packed: bytes = msgpack.packb(fields, use_bin_type=True)
    return packed
