"""Archive of c2: the interface of both kinds, and the one of files with an index in SQLite (the default)."""

from __future__ import annotations

import hashlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from sonarpost import keys
from sonarpost.archive.image_files import WrittenImage, add_image
from sonarpost.archive.reader import RecordReader
from sonarpost.archive.retention import DAY_S
from sonarpost.archive.shore_files import (
    decision_path,
    decision_text,
    delete_image_files,
    image_row,
    index_missing_files,
    remove_temporary_files,
    select_images,
    verify_files,
)
from sonarpost.archive.shore_index import DEFECTS, DecisionRow, ImageRow, ShoreIndex, TaskingRow, Verified
from sonarpost.errors import PayloadError, StoredFileError
from sonarpost.files import AtomicFiles
from sonarpost.logs import kv
from sonarpost.messages import Decision, ReconstructedImage, TaskingKind
from sonarpost.services.c2.config import C2Config
from sonarpost.sonar.image_decoding import GreyImage
from sonarpost.sonar.image_files import read_image

log = logging.getLogger(__name__)


class Storage(Protocol):
    """What c2 requires of an archive; methods raise OSError or DeliveryError if it cannot be used at present.

    Images and decisions are durable after `flush`. An archive that several c2 share also stores the records that they
    have acknowledged, so that another c2 can handle them.
    """

    def open(self) -> None:
        """Create the archive at the start of c2, if it can be reached."""

    def index(self) -> RecordReader:
        """Return what reads the stored records."""

    def store_image(self, image: ReconstructedImage, relayed_utc_s: float) -> WrittenImage:
        """Add an image to the next `flush`."""

    def store_decision(self, decision: Decision) -> bool:
        """Add a decision to the next `flush`; see `Archive.store_decision`."""

    def flush(self) -> None:
        """Make the images and decisions since the last call durable."""

    def read_pixels(self, vessel_id: str, name: str) -> GreyImage:
        """Return the pixels of a stored image; `name` is that of its files without suffix.

        Raises:
            BadInputError: They are missing or unreadable.
        """

    def claim_tasking(self, row: TaskingRow, payload: bytes) -> bytes | None:
        """Claim a record for a vessel; see `ShoreDatabase.claim_tasking`."""

    def foreign_tasking(self, vessel_id: str, kind: TaskingKind, record_id: str) -> bytes | None:
        """Return a record for a vessel that another c2 has claimed; see `ShoreDatabase.foreign_tasking`."""

    def store_tasking(self, rows: Sequence[TaskingRow]) -> None:
        """Index comments and commands with their states."""

    def accept(self, records: Sequence[tuple[str, bytes]]) -> None:
        """Store records, as key and payload, before they are acknowledged."""

    def handled(self, key: str, payload: bytes) -> None:
        """Add an accepted record to the next `flush`, which deletes it."""

    def discard(self, key: str, payload: bytes) -> None:
        """Delete an accepted record that is invalid."""

    def take_over(self, store: Callable[[Sequence[tuple[str, bytes]]], None]) -> int:
        """Pass records that another c2 has not handled in time to `store`; return their number."""

    def apply_retention(self, now_utc_s: float) -> list[ImageRow]:
        """Remove images by age and total size; return them."""

    def verify(self, now_utc_s: float, interval_s: float) -> int:
        """Compare some stored records with their digests; see `Archive.verify`."""

    def defect_counts(self) -> dict[str, int]:
        """Return the numbers of missing, changed, unreadable and conflicting records, without waiting."""

    def images_bytes(self) -> int:
        """Return the size of the stored images in bytes, without waiting."""

    def fault(self) -> str:
        """Return why the archive cannot be used at present; empty if it can."""

    def close(self) -> None:
        """Release the archive."""


class Archive:
    """Files and index of one `out_dir`; the index is opened when it is first required.

    Stored records are on the disk after `flush`, so that many records share one flush. Every method raises OSError if
    the folder cannot be written, and can be called again.
    """

    def __init__(self, config: C2Config) -> None:
        self._config = config
        self._out_dir = config.out_dir
        self._index: ShoreIndex | None = None
        self._lock = threading.RLock()
        self._files = AtomicFiles()
        self._images: list[tuple[str, ReconstructedImage, float]] = []
        self._decisions: dict[Path, tuple[Decision, bytes, bool]] = {}
        """Content of the file of each, and whether it is new."""

    def index(self) -> ShoreIndex:
        """Return the open index, completed from the files.

        Raises:
            OSError: It cannot be written, or is of another version.
        """
        with self._lock:
            if self._index is None:
                try:
                    index = ShoreIndex(self._out_dir)
                except StoredFileError as error:
                    raise OSError(str(error)) from error
                try:
                    remove_temporary_files(self._out_dir)
                    added = index_missing_files(self._out_dir, index)
                except BaseException:
                    index.close()
                    raise
                self._index = index
                if added:
                    log.info("Index completed from the files", extra=kv(file=index.path, rows=added))
            return self._index

    def store_image(self, image: ReconstructedImage, relayed_utc_s: float) -> WrittenImage:
        """Write and index the files of an image; a different image with the same file name stays."""
        index = self.index()
        with self._lock:
            written = add_image(self._files, self._out_dir / image.vessel_id, image)
            name = written.tiff.stem
            if written.is_new or not index.has_image(image.vessel_id, name):
                self._images.append((name, image, relayed_utc_s))
        log_image(image, relayed_utc_s, written)
        return written

    def store_decision(self, decision: Decision) -> bool:
        """Write and index the file of a decision; return whether it is new.

        Raises:
            PayloadError: A different decision has this identifier.
        """
        index = self.index()
        path = decision_path(self._out_dir, decision.vessel_id, decision.decision_id)
        text = decision_text(decision)
        with self._lock:
            added = self._decisions.get(path)
            stored = added[1] if added else path.read_bytes() if path.is_file() else None
            if stored is not None and stored != text:
                raise decision_conflict(decision, str(path))
            if stored is None or not (added or index.has_decision(decision.vessel_id, decision.decision_id)):
                self._decisions[path] = (decision, text, stored is None)
        log.info("Decision stored", extra=kv(vessel=decision.vessel_id, verdict=decision.verdict))
        return stored is None

    def flush(self) -> None:
        """Flush the records stored since the last call to the disk and add them to the index.

        Raises:
            OSError: It failed; all of these records have to be stored again.
        """
        with self._lock:
            images, self._images = self._images, []
            decisions, self._decisions = self._decisions, {}
            files, self._files = self._files, AtomicFiles()
            try:
                for path, (_, text, is_new) in decisions.items():
                    if is_new:
                        path.parent.mkdir(parents=True, exist_ok=True)
                        files.add(path, text, last=True)
                files.commit()
            finally:
                files.drop_from(0)
            rows: list[ImageRow | DecisionRow] = [
                image_row(self._out_dir, name, image, at, time.time()) for name, image, at in images
            ]
            for decision, text, _ in decisions.values():
                rows.append(DecisionRow.of(decision, time.time(), hashlib.sha256(text).hexdigest()))
            if rows:
                self.index().put(rows)

    def store_tasking(self, rows: Sequence[TaskingRow]) -> None:
        """Index comments and commands with their states."""
        self.index().put(rows)

    # A single c2: its own store has what it has accepted and not handled.

    def open(self) -> None:
        """Do nothing: the index is opened when it is first required."""

    def read_pixels(self, vessel_id: str, name: str) -> GreyImage:
        """Return the pixels of a stored image.

        Raises:
            SurveyFileError: The file is missing or unreadable.
        """
        return read_image(self._out_dir / vessel_id / f"{name}.tiff")

    def claim_tasking(self, row: TaskingRow, payload: bytes) -> None:
        """Return None: there is no other c2."""

    def foreign_tasking(self, vessel_id: str, kind: TaskingKind, record_id: str) -> None:
        """Return None: there is no other c2."""

    def accept(self, records: Sequence[tuple[str, bytes]]) -> None:
        """Do nothing: the own store has the records."""

    def handled(self, key: str, payload: bytes) -> None:
        """Do nothing: the own store has the record."""

    def discard(self, key: str, payload: bytes) -> None:
        """Do nothing: the own store has the record."""

    def take_over(self, store: Callable[[Sequence[tuple[str, bytes]]], None]) -> int:
        """Return 0: there is no other c2."""
        return 0

    def fault(self) -> str:
        """Return an empty text: faults of the folder are errors of single calls."""
        return ""

    def apply_retention(self, now_utc_s: float) -> list[ImageRow]:
        """Remove images by age and total size; return them."""
        config = self._config
        index = self.index()
        oldest_utc_s = index.oldest_utc_s()
        too_large = index.size_bytes() > config.max_bytes
        if oldest_utc_s is None or (now_utc_s - oldest_utc_s <= config.retain_days * DAY_S and not too_large):
            return []
        # The decisions only matter above the maximum size. Records are stored during the selection.
        decisions = index.decisions() if too_large else []
        rows = select_images(index.images(), decisions, now_utc_s, config.retain_days, config.max_bytes)
        with self._lock:
            for row in rows:
                delete_image_files(self._out_dir, row)
            if rows:
                index.mark("removed_utc_s", rows, time.time())
        log_removed(rows)
        return rows

    def verify(self, now_utc_s: float, interval_s: float) -> int:
        """Compare some of the stored files with the index; log what is missing or changed.

        Args:
            now_utc_s: Time of this call.
            interval_s: Interval of the calls; all files are compared once in `verify_days`.

        Returns:
            Number of compared images and decisions.
        """
        cycle_s = self._config.verify_days * 86400.0
        if cycle_s == 0.0:
            return 0
        index = self.index()
        results = []
        for row in index.to_verify(now_utc_s - cycle_s, interval_s, cycle_s):
            # Without retention and new files in between, for one row at a time.
            with self._lock:
                if isinstance(row, DecisionRow) or index.has_image(row.vessel_id, row.name):
                    results.append(verify_files(self._out_dir, row))
        if results:
            index.mark_verified(results, now_utc_s)
        log_new_faults(results)
        return len(results)

    def defect_counts(self) -> dict[str, int]:
        """Return the numbers of missing, changed, unreadable and conflicting records; 0 while the index is not open."""
        with self._lock:
            return dict.fromkeys(DEFECTS, 0) if self._index is None else self._index.defect_counts()

    def images_bytes(self) -> int:
        """Return the size of the stored images in bytes, 0 while the index is not open."""
        with self._lock:
            return 0 if self._index is None else self._index.size_bytes()

    def close(self) -> None:
        """Close the index."""
        with self._lock:
            if self._index is not None:
                self._index.close()
                self._index = None


def log_image(image: ReconstructedImage, relayed_utc_s: float, written: WrittenImage) -> None:
    """Log that an image is stored."""
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


def decision_conflict(decision: Decision, stored: str) -> PayloadError:
    """Return the error for a decision whose identifier another one has, which is stored at `stored`."""
    key = keys.contact_decision(decision.vessel_id)
    expected = f"an identifier that no other decision has ({stored})"
    return PayloadError(key, "decision_id", decision.decision_id, expected)


def log_removed(rows: Sequence[ImageRow]) -> None:
    """Log the images that retention has removed."""
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


def log_new_faults(results: Sequence[Verified]) -> None:
    """Log the faults that a comparison has found and that were not known before."""
    new = [result for result in results if result.fault and result.fault != result.row.fault]
    if new:
        row = new[0].row
        log.error(
            "Stored files differ from the index",
            extra=kv(
                records=len(new),
                vessel=row.vessel_id,
                first=row.name if isinstance(row, ImageRow) else row.decision_id,
                fault=new[0].fault,
            ),
        )
