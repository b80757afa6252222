"""Archive of c2: what was handled and is not committed, names of files, retention, verification, health."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextvars import copy_context
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import tifffile

from sonarpost import keys
from sonarpost.archive.backlog import BacklogRecord
from sonarpost.archive.image_files import (
    PREVIEW_NOTE,
    SUFFIXES,
    WrittenImage,
    image_file_name,
    other_name,
    same_version,
    side_car_text,
)
from sonarpost.archive.journal import Accepted, JournalEntry, JournalRow
from sonarpost.archive.reader import open_archive
from sonarpost.archive.retention import DAY_S
from sonarpost.archive.rows import DEFECTS, DecisionRow, ImageRow, Verified
from sonarpost.archive.shore_archive import Batch, ShoreArchive, StoredImage
from sonarpost.archive.shore_files import (
    decision_text,
    remove_temporary_files,
    row_of_image,
    select_images,
    stored_records,
)
from sonarpost.errors import BadInputError, DatabaseUnavailableError, PayloadError, StoredFileError
from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.messages import CodedImage, Decision, Pixels, ReconstructedImage
from sonarpost.services.c2.accepted import coded_entry, decision_entry, image_entry, state_entry
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.tasking import Tasking
from sonarpost.sonar.image_decoding import GreyImage
from sonarpost.sonar.image_files import png_bytes, tiff_bytes

log = logging.getLogger(__name__)

TAKE_OVER_AFTER_S = 60.0
TAKE_OVER_RECORDS = 64
TAKE_OVER_BYTES: Final = limit(
    8 * 1024 * 1024, "bytes", "claims", "records of another c2", "vessel", "records taken over at once", "others follow"
)


class Archive:
    """Archive of one site, in `out_dir` or in the database of the configuration.

    Records are added by the methods of one thread at a time, and durable after `flush`, so that many share one commit.
    Methods raise OSError or DeliveryError if the archive cannot be used at present, and can be called again.

    Args:
        config: The `[c2]` table.
        owner: Identity of this c2 among those that share a database, the same after a restart.

    Attributes:
        shore: The stored records.
        is_shared: Whether several c2 can use the archive.
    """

    def __init__(self, config: C2Config, owner: str = "") -> None:
        self._config = config
        self.shore: ShoreArchive = open_archive(
            config.database_address() or config.out_dir, site=config.site, owner=owner
        )
        self.is_shared = self.shore.database.is_shared
        self._open_lock = threading.Lock()
        self._is_open = False
        self._batch = Batch()
        self._entries: list[JournalEntry] = []
        self._logs: list[Callable[[], None]] = []  # to write after the commit
        self._defects = dict.fromkeys(DEFECTS, 0)
        self._images_bytes = 0
        self._take_over_records = TAKE_OVER_RECORDS

    def open(self) -> None:
        """Open or create the archive; one that cannot be used at present is logged, and tried again later.

        Raises:
            ConfigError: It belongs to another site.
            StoredFileError: It is of another version.
        """
        try:
            self.shore.database.prepare()
            self.index()
        except (OSError, DatabaseUnavailableError) as error:
            log.error("Archive not reached; senders keep their records", extra=kv(reason=str(error)))

    def index(self) -> ShoreArchive:
        """Return the stored records; the first call completes what a crash or the loss of the archive has left."""
        with self._open_lock:
            if not self._is_open:
                with self.shore.database.transaction(writing=False):
                    pass
                folder = self.shore.folder
                if folder is not None:
                    remove_temporary_files(folder)
                    if self.shore.database.is_new:
                        self._restore(folder)
                self._is_open = True
                self._measure()
        return self.shore

    def _restore(self, folder: Path) -> None:
        """Add the records of the files of a folder to a new archive."""
        count = 0
        for record, utc_s in stored_records(folder):
            try:
                if isinstance(record, Decision):
                    self._add_decision(record, utc_s)
                else:
                    self._add_image(record, None, utc_s)
                self._commit(lambda entry: entry.columns(utc_s))  # noqa: B023 - called at once
            except PayloadError as error:
                log.error("Stored record cannot be read", extra=kv(reason=str(error)[:200]))
            count += 1
        if count:
            log.info("Archive restored from the files", extra=kv(folder=folder, records=count))

    def close(self) -> None:
        """Release the archive."""
        self.shore.close()

    # Records of vessels

    def store_image(self, image: ReconstructedImage, relayed_utc_s: float, payload: bytes = b"") -> WrittenImage:
        """Add an image with its payload, if known, to the next `flush`; another one with its file name stays."""
        self.index()
        written = self._add_image(image, relayed_utc_s, time.time(), payload)
        self._logs.append(partial(copy_context().run, _log_image, image, relayed_utc_s, written))
        return written

    def _add_image(
        self, image: ReconstructedImage, relayed_utc_s: float | None, accepted_utc_s: float, payload: bytes = b""
    ) -> WrittenImage:
        text = side_car_text(image)
        name, is_stored, is_conflict = self._place(image, text)
        written = WrittenImage(Path(image.vessel_id, f"{name}.tiff"), not is_stored, is_conflict)
        if written.is_new:
            pixels = image.pixels.to_array()
            contents = (
                text,
                tiff_bytes(written.tiff, pixels),
                png_bytes(written.tiff.with_suffix(".png"), pixels),
            )
            row = row_of_image(name, image, relayed_utc_s, accepted_utc_s, contents)
            self._batch.images.append(StoredImage(row, tuple(zip(SUFFIXES, contents, strict=True))))
        self._entries.append(image_entry(image, name, self._config.site, payload))
        return written

    def _place(self, image: ReconstructedImage, text: bytes) -> tuple[str, bool, bool]:
        """Return the name of an image's files, whether they are stored, whether another image has the plain name."""
        name, digest = image_file_name(image), sha256(text).hexdigest()
        found = self._find(image.vessel_id, name)
        if found is None or found[0] == digest:
            return name, found is not None and found[1], False
        other = other_name(name, text)
        found_other = self._find(image.vessel_id, other)
        if found_other is None and same_version(stored := self._side_car(image.vessel_id, name), image):
            if PREVIEW_NOTE in image.notes:
                return name, True, False
            if PREVIEW_NOTE in stored.get("notes", ()) or stored == json.loads(text):
                # The whole replaces its preview; its files are there already after a crash before the commit.
                self._batch.images = [
                    i for i in self._batch.images if (i.row.vessel_id, i.row.name) != (image.vessel_id, name)
                ]
                self._batch.replaced.append((image.vessel_id, name))
                return name, False, False
        return other, found_other is not None and found_other[1], True

    def _find(self, vessel_id: str, name: str) -> tuple[str, bool] | None:
        """Return the digest of a side-car and whether its image is stored; None for no image."""
        added = self._added(vessel_id, name)
        return self.shore.find_image(vessel_id, name) if added is None else (added.row.side_car_sha256, True)

    def _added(self, vessel_id: str, name: str) -> StoredImage | None:
        return next((i for i in self._batch.images if (i.row.vessel_id, i.row.name) == (vessel_id, name)), None)

    def _side_car(self, vessel_id: str, name: str) -> dict[str, Any]:
        """Return the fields of a side-car; none if it is missing or unreadable."""
        added = self._added(vessel_id, name)
        try:
            content = added.files[0][1] if added else self.shore.read_files(vessel_id, name, SUFFIXES[:1])[SUFFIXES[0]]
            fields = json.loads(content)
        except (ValueError, BadInputError):
            return {}
        return fields if isinstance(fields, dict) else {}

    def store_decision(self, decision: Decision) -> bool:
        """Add a decision to the next `flush`; return whether it is new.

        Raises:
            PayloadError: A different decision has this identifier.
        """
        self.index()
        is_new = self._add_decision(decision, time.time())
        fields = kv(vessel=decision.vessel_id, verdict=decision.verdict)
        self._logs.append(partial(copy_context().run, log.info, "Decision stored", extra=fields))
        return is_new

    def _add_decision(self, decision: Decision, accepted_utc_s: float) -> bool:
        text = decision_text(decision)
        digest = sha256(text).hexdigest()
        own = (decision.vessel_id, decision.decision_id)
        added = [row for row, _ in self._batch.decisions if (row.vessel_id, row.decision_id) == own]
        found = added[0].files_sha256 if added else self.shore.find_decision(*own)
        if found not in (None, digest):
            expected = f"an identifier that no other decision has ({self.shore.database.where})"
            raise PayloadError(keys.contact_decision(own[0]), "decision_id", decision.decision_id, expected)
        if found is None:
            self._batch.decisions.append((DecisionRow.of(decision, accepted_utc_s, digest), text))
        self._entries.append(decision_entry(decision, self._config.site))
        return found is None

    def queue_image(self, key: str, payload: bytes, image: CodedImage) -> None:
        """Add a coded image to the backlog of the decoder, with the next `flush`."""
        self._batch.waiting.append(BacklogRecord(key, payload, image.vessel_id))
        self._entries.append(coded_entry(image, self._config.site))

    def finished(self, record: BacklogRecord) -> None:
        """Delete an accepted record with the next `flush`."""
        self._batch.finished.append(record)

    def discard(self, record: BacklogRecord) -> None:
        """Delete an accepted record that cannot be stored."""
        self.shore.backlog.discard([record])

    def flush(self) -> list[tuple[JournalEntry, Accepted]]:
        """Commit the records since the last call, with their numbers, and return these.

        Raises:
            OSError, DeliveryError: All of these records have to be stored again.
        """
        self.index()
        now_utc_s = time.time()
        return self._commit(lambda entry: entry.columns(now_utc_s))

    def _commit(self, columns: Callable[[JournalEntry], dict[str, Any]]) -> list[tuple[JournalEntry, Accepted]]:
        batch, entries, logs = self._batch, self._entries, self._logs
        self.forget()
        batch.numbered = [columns(entry) for entry in entries]
        numbers = self.shore.write(batch) if batch != Batch() else []
        for write_log in logs:
            write_log()
        return list(zip(entries, numbers, strict=True))

    def forget(self) -> None:
        """Drop the records since the last `flush`."""
        self._batch, self._entries, self._logs = Batch(), [], []

    def store_state(self, item: Tasking) -> tuple[JournalEntry, Accepted]:
        """Store the state of a comment or command, and return its number."""
        self.index()
        entry = state_entry(item, self._config.site)
        numbers = self.shore.write(Batch(tasking=[item.row()], numbered=[entry.columns(time.time())]))
        return entry, numbers[0]

    def fields(self, row: JournalRow) -> dict[str, object]:
        """Return the complete payload of a record as a map.

        Raises:
            BadInputError: Its pixels are missing, unreadable or of another image.
        """
        if not row.name:
            return row.fields
        where = f"image {row.vessel_id}/{row.name}"
        tiff = self.shore.read_files(row.vessel_id, row.name, SUFFIXES[1:2])[SUFFIXES[1]]
        data = Pixels.from_array(_pixels(tiff, where)).data
        digest = hashlib.sha256(data).hexdigest()
        if digest != row.fields["pixels_sha256"]:
            raise BadInputError(where, "pixels_sha256", digest, str(row.fields["pixels_sha256"]))
        pixels = row.fields["pixels"]
        assert isinstance(pixels, dict)
        return {**row.fields, "pixels": {**pixels, "data": data}}

    # Records of other c2

    def accept(self, records: Sequence[tuple[str, bytes]]) -> None:
        """Store records, as key and payload, before they are acknowledged, so that another c2 can handle them."""
        self.shore.backlog.accept([BacklogRecord(*record) for record in records])

    def take_over(self, store: Callable[[Sequence[tuple[str, bytes]]], None]) -> int:
        """Pass records that another c2 has not handled in time to `store`; return their number."""
        # Fewer after a failure.
        limit_, self._take_over_records = self._take_over_records, max(1, self._take_over_records // 2)
        taken = self.shore.backlog.take_over(
            TAKE_OVER_AFTER_S,
            limit_,
            TAKE_OVER_BYTES,
            lambda records: store([(record.key, record.payload) for record in records]),
        )
        self._take_over_records = TAKE_OVER_RECORDS
        return taken

    # Background work and health

    def apply_retention(self, now_utc_s: float) -> list[ImageRow]:
        """Remove images by age and total size; return them."""
        config, index = self._config, self.index()
        self._measure()
        oldest_utc_s = index.oldest_utc_s()
        too_large = self._images_bytes > config.max_bytes
        if oldest_utc_s is None or (now_utc_s - oldest_utc_s <= config.retain_days * DAY_S and not too_large):
            return []
        # The decisions only matter above the maximum size. Records are stored during the selection.
        decisions = index.decisions() if too_large else []
        rows = select_images(index.images(), decisions, now_utc_s, config.retain_days, config.max_bytes)
        removed = index.mark("removed_utc_s", rows, time.time())
        self._measure()
        _log_removed(removed)
        return removed

    def verify(self, now_utc_s: float, interval_s: float) -> int:
        """Compare some of the stored files with their digests; log what is missing or changed.

        Args:
            now_utc_s: Time of this call.
            interval_s: Interval of the calls; all files are compared once in `verify_days`.

        Returns:
            Number of compared images and decisions.
        """
        cycle_s = self._config.verify_days * DAY_S
        if cycle_s == 0.0:
            return 0
        results = self.index().verify(now_utc_s, interval_s, cycle_s)
        if results:
            self._measure()
        _log_new_faults(results)
        return len(results)

    def _measure(self) -> None:
        self._images_bytes = self.shore.size_bytes()
        self._defects = self.shore.defect_counts()
        with self.shore.database.transaction(writing=False) as sql:
            self.shore.backlog.count_waiting(sql)

    def defect_counts(self) -> dict[str, int]:
        """Return the numbers of missing, changed, unreadable and conflicting records at the last measurement.

        Health does not wait for the archive.
        """
        return dict(self._defects)

    def images_bytes(self) -> int:
        """Return the size of the stored images at the last measurement, in bytes."""
        return self._images_bytes

    def waiting_count(self) -> int:
        """Return the number of coded images that wait for the decoder."""
        return self.shore.backlog.waiting_count

    def fault(self) -> str:
        """Return why the archive cannot be used at present; empty if it can."""
        return self.shore.database.fault


def _pixels(content: bytes, where: str) -> GreyImage:
    try:
        return tifffile.imread(io.BytesIO(content))
    except (OSError, ValueError, tifffile.TiffFileError) as error:
        raise StoredFileError(where, "", str(error), "a readable TIFF") from error


def _log_image(image: ReconstructedImage, relayed_utc_s: float, written: WrittenImage) -> None:
    fields = kv(
        vessel=image.vessel_id,
        vehicle=image.vehicle_id,
        image_id=image.image_id,
        version=image.version,
        transit_s=round(time.time() - relayed_utc_s, 1),
        file=written.tiff,
    )
    if written.is_new and written.is_conflict:
        log.warning("Image conflicts with a stored one of the same name; both are kept", extra=fields)
    else:
        log.info("Image stored" if written.is_new else "Image already stored", extra=fields)


def _log_removed(rows: Sequence[ImageRow]) -> None:
    for row in rows:
        log.warning(
            "Image removed by retention",
            extra=kv(
                vessel=row.vessel_id,
                vehicle=row.vehicle_id,
                image_id=row.image_id,
                version=row.version,
                exported=row.exported_utc_s is not None,
                file=row.name,
            ),
        )


def _log_new_faults(results: Sequence[Verified]) -> None:
    """Log the faults that a comparison has found and that were not known before."""
    new = [result for result in results if result.fault and result.fault != result.row.fault]
    if new:
        row = new[0].row
        log.error(
            "Stored files differ from the archive",
            extra=kv(
                records=len(new),
                vessel=row.vessel_id,
                first=row.name if isinstance(row, ImageRow) else row.decision_id,
                fault=new[0].fault,
            ),
        )
