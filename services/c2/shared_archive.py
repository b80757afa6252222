"""Archive of c2 in PostgreSQL, which several c2 of one site share."""

from __future__ import annotations

import io
import logging
import threading
import time
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Final

import tifffile

from sonarpost.archive.image_files import WrittenImage, image_file_name, other_name, side_car_text
from sonarpost.archive.journal import Accepted, JournalRecord
from sonarpost.archive.postgresql import ConnectionPool, DatabaseAddress
from sonarpost.archive.retention import DAY_S
from sonarpost.archive.shared_journal import SharedJournal
from sonarpost.archive.shore_database import BacklogRecord, ShoreDatabase, StoredImage
from sonarpost.archive.shore_files import decision_text, row_of_image, select_images
from sonarpost.archive.shore_index import DEFECTS, DecisionRow, ImageRow, TaskingRow
from sonarpost.errors import DatabaseUnavailableError, StoredFileError
from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.messages import Decision, ReconstructedImage, TaskingKind
from sonarpost.services.c2.archive import decision_conflict, log_image, log_new_faults, log_removed
from sonarpost.services.c2.config import C2Config
from sonarpost.sonar.image_decoding import GreyImage
from sonarpost.sonar.image_files import png_bytes, tiff_bytes

log = logging.getLogger(__name__)

TAKE_OVER_AFTER_S = 60.0
TAKE_OVER_RECORDS = 64
TAKE_OVER_BYTES: Final = limit(
    8 * 1024 * 1024, "bytes", "claims", "records of another c2", "vessel", "records taken over at once", "others follow"
)


class SharedArchive:
    """Archive of one site in a database; see `Storage`.

    Args:
        config: The `[c2]` table.
        address: Address of the database.
        owner: Identity of this c2, the same after a restart.
    """

    def __init__(self, config: C2Config, address: DatabaseAddress, owner: str) -> None:
        self._config = config
        self._database = ShoreDatabase(ConnectionPool(address), owner=owner, site=config.site)
        # Connections of their own: a search that takes too long is no fault of the archive.
        self._searched = ShoreDatabase(ConnectionPool(address), site=config.site, writable=False)
        self._lock = threading.Lock()
        self._images: dict[tuple[str, str], StoredImage] = {}
        self._decisions: dict[tuple[str, str], tuple[DecisionRow, bytes]] = {}
        self._handled: list[BacklogRecord] = []
        self._defects = dict.fromkeys(DEFECTS, 0)
        self._images_bytes = 0
        self._take_over_records = TAKE_OVER_RECORDS

    def open(self) -> None:
        """Create the schema; a server that is not reached is logged, and tried again later.

        Raises:
            ConfigError: The database belongs to another site, or the driver is missing.
            StoredFileError: The schema has another version.
        """
        try:
            self._database.prepare()
        except DatabaseUnavailableError as error:
            log.error("Database not reached; senders keep their records", extra=kv(reason=str(error)))

    def index(self) -> ShoreDatabase:
        """Return the database."""
        return self._database

    # Images and decisions

    def store_image(self, image: ReconstructedImage, relayed_utc_s: float) -> WrittenImage:
        """Add an image to the next flush; a different image with the same name stays."""
        text = side_car_text(image)
        digest = sha256(text).hexdigest()
        name = image_file_name(image)
        found = self._find(image.vessel_id, name)
        is_conflict = found is not None and found[0] != digest
        if is_conflict:
            name = other_name(name, text)
            found = self._find(image.vessel_id, name)
        is_stored = found is not None and found[1]
        written = WrittenImage(Path(image.vessel_id, f"{name}.tiff"), not is_stored, is_conflict)
        if written.is_new:
            pixels = image.pixels.to_array()
            files = (
                (".json", text),
                (".tiff", tiff_bytes(written.tiff, pixels)),
                (".png", png_bytes(written.tiff.with_suffix(".png"), pixels)),
            )
            row = row_of_image(name, image, relayed_utc_s, time.time(), [data for _, data in files])
            with self._lock:
                self._images[image.vessel_id, name] = StoredImage(row, files)
        log_image(image, relayed_utc_s, written)
        return written

    def _find(self, vessel_id: str, name: str) -> tuple[str, bool] | None:
        """Return the digest of a side-car and whether its image is stored; None for no image."""
        with self._lock:
            added = self._images.get((vessel_id, name))
        if added is not None:
            return added.row.files_sha256.split()[0], True
        return self._database.find_side_car(vessel_id, name)

    def store_decision(self, decision: Decision) -> bool:
        """Add a decision to the next flush; return whether it is new.

        Raises:
            PayloadError: A different decision has this identifier.
        """
        key = (decision.vessel_id, decision.decision_id)
        text = decision_text(decision)
        digest = sha256(text).hexdigest()
        with self._lock:
            added = self._decisions.get(key)
        found = self._database.find_decision(*key) if added is None else added[0].files_sha256
        if found not in (None, digest):
            raise decision_conflict(decision, "database")
        if found is None:
            with self._lock:
                self._decisions[key] = (DecisionRow.of(decision, time.time(), digest), text)
        log.info("Decision stored", extra=kv(vessel=decision.vessel_id, verdict=decision.verdict))
        return found is None

    def journal(self) -> SharedJournal:
        """Return the journal of all c2 for queries."""
        return self._searched.journal()

    def flush(self) -> None:
        """Commit the records since the last call; see `flush_numbered`."""
        self.flush_numbered([])

    def flush_numbered(self, numbered: Sequence[JournalRecord]) -> list[Accepted]:
        """Commit the records since the last call, delete the handled ones from the accepted records, number records.

        Args:
            numbered: Records for the journal. They have a number exactly if the flush has succeeded.

        Raises:
            DatabaseUnavailableError: All of these records have to be stored again.
        """
        with self._lock:
            images, self._images = self._images, {}
            decisions, self._decisions = self._decisions, {}
            handled, self._handled = self._handled, []
        if not (images or decisions or handled or numbered):
            return []
        return self._database.write([*images.values()], [*decisions.values()], handled, numbered)

    def number(self, records: Sequence[JournalRecord]) -> list[Accepted]:
        """Number records without a flush."""
        return self._database.write([], numbered=records)

    def read_pixels(self, vessel_id: str, name: str) -> GreyImage:
        """Return the pixels of a stored image.

        Raises:
            StoredFileError: They are missing or unreadable.
            DatabaseUnavailableError: The database is not reached.
        """
        content = self._database.image_files(vessel_id, name).get(".tiff")
        where = f"database: image {vessel_id}/{name}.tiff"
        if content is None:
            raise StoredFileError(where, "", "nothing", "a stored image")
        try:
            return tifffile.imread(io.BytesIO(content))
        except (OSError, ValueError, tifffile.TiffFileError) as error:
            raise StoredFileError(where, "", str(error), "a readable TIFF") from error

    # Tasking

    def claim_tasking(self, row: TaskingRow, payload: bytes) -> bytes | None:
        """See `ShoreDatabase.claim_tasking`."""
        return self._database.claim_tasking(row, payload)

    def foreign_tasking(self, vessel_id: str, kind: TaskingKind, record_id: str) -> bytes | None:
        """See `ShoreDatabase.foreign_tasking`."""
        return self._database.foreign_tasking(vessel_id, kind, record_id)

    def store_tasking(self, rows: Sequence[TaskingRow]) -> None:
        """Write the states of comments and commands."""
        self._database.put_tasking(rows)

    # Accepted records

    def accept(self, records: Sequence[tuple[str, bytes]]) -> None:
        """Commit records before they are acknowledged."""
        self._database.accept([BacklogRecord(*record) for record in records])

    def handled(self, key: str, payload: bytes) -> None:
        """Add an accepted record to the next flush, which deletes it."""
        with self._lock:
            self._handled.append(BacklogRecord(key, payload))

    def discard(self, key: str, payload: bytes) -> None:
        """Delete an accepted record that is invalid."""
        self._database.discard(BacklogRecord(key, payload))

    def take_over(self, store: Callable[[Sequence[tuple[str, bytes]]], None]) -> int:
        """Take over records that another c2 has accepted and not handled in time; return their number."""
        limit_, self._take_over_records = self._take_over_records, max(1, self._take_over_records // 2)
        taken = self._database.take_over(
            TAKE_OVER_AFTER_S,
            limit_,
            TAKE_OVER_BYTES,
            lambda records: store([(record.key, record.payload) for record in records]),
        )
        self._take_over_records = TAKE_OVER_RECORDS
        return taken

    # Background work and health

    def apply_retention(self, now_utc_s: float) -> list[ImageRow]:
        """Remove images by age and total size, unless another c2 does; return them."""
        config = self._config
        self._images_bytes = self._database.size_bytes()
        self._defects = self._database.defect_counts()
        oldest_utc_s = self._database.oldest_utc_s()
        too_large = self._images_bytes > config.max_bytes
        if oldest_utc_s is None or (now_utc_s - oldest_utc_s <= config.retain_days * DAY_S and not too_large):
            return []
        rows = self._database.remove_selected(
            lambda images, decisions: select_images(images, decisions, now_utc_s, config.retain_days, config.max_bytes),
            time.time(),
        )
        log_removed(rows)
        return rows

    def verify(self, now_utc_s: float, interval_s: float) -> int:
        """Compare some contents with their digests, unless another c2 does; see `Archive.verify`."""
        cycle_s = self._config.verify_days * DAY_S
        results = self._database.verify(now_utc_s, interval_s, cycle_s) if cycle_s else []
        if results:
            self._defects = self._database.defect_counts()
        log_new_faults(results)
        return len(results)

    def defect_counts(self) -> dict[str, int]:
        """Return the numbers of the last minute: health does not wait for the database."""
        return dict(self._defects)

    def images_bytes(self) -> int:
        """Return the size of the last minute, in bytes."""
        return self._images_bytes

    def fault(self) -> str:
        """Return why the last transaction failed; empty if it did not."""
        return self._database.database.fault

    def close(self) -> None:
        """Close the connections."""
        self._searched.close()
        self._database.close()
