"""The files that c2 keeps: where they are, rows of them for the index, and what retention removes."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from pydantic import ValidationError

from sonarpost.archive.image_files import image_file_name
from sonarpost.archive.shore_index import DecisionRow, ImageRow, ShoreIndex
from sonarpost.errors import StoredFileError
from sonarpost.export.contacts import DECISIONS, SideCar
from sonarpost.logs import kv
from sonarpost.messages import Decision, ReconstructedImage

log = logging.getLogger(__name__)

# The side-car first: where it is, the others are whole.
SUFFIXES = (".json", ".tiff", ".png")


def files_of(out_dir: Path, row: ImageRow) -> tuple[Path, ...]:
    """Return the paths of a picture's files."""
    return tuple(out_dir / row.vessel_id / f"{row.name}{suffix}" for suffix in SUFFIXES)


def decision_file_name(decision_id: str) -> str:
    """Return the file name of a decision.

    The identifier is the operator's text: only its hexadecimal form is safe as a file name. `RecordId` bounds it to 64
    characters of one byte, so that no file system refuses the name for its length.
    """
    return f"{decision_id.encode().hex()}.json"


def picture_row(
    out_dir: Path, name: str, image: ReconstructedImage | SideCar, relayed_utc_s: float | None, accepted_utc_s: float
) -> ImageRow:
    """Return the index's row of a picture whose files are written.

    Raises:
        OSError: A file is not there.
    """
    height_px, width_px = (
        (image.height_px, image.width_px)
        if isinstance(image, SideCar)
        else (image.picture.height_px, image.picture.width_px)
    )
    contact = image.contact
    folder = out_dir / image.vessel_id
    return ImageRow(
        vessel_id=image.vessel_id,
        name=name,
        vehicle_id=image.vehicle_id,
        image_id=image.image_id,
        version=image.version,
        first_frame_utc_s=image.first_frame_utc_s,
        last_frame_utc_s=image.last_frame_utc_s,
        relayed_utc_s=relayed_utc_s,
        accepted_utc_s=accepted_utc_s,
        complete=image.complete,
        missing_fraction=image.missing_fraction,
        height_px=height_px,
        width_px=width_px,
        codec=image.codec,
        lat_deg=contact.lat_deg if contact else None,
        lon_deg=contact.lon_deg if contact else None,
        atd_class=contact.atd_class if contact else None,
        atd_confidence=contact.atd_confidence if contact else None,
        size_bytes=sum((folder / f"{name}{suffix}").stat().st_size for suffix in SUFFIXES),
    )


def row_of_image(out_dir: Path, image: ReconstructedImage, relayed_utc_s: float) -> ImageRow:
    """Return the row of a picture that was just written."""
    return picture_row(out_dir, image_file_name(image), image, relayed_utc_s, time.time())


def add_missing(out_dir: Path, index: ShoreIndex) -> int:
    """Add to the index what is in the files and not in it; return how many rows that were.

    A file that cannot be read is logged and left alone.

    Raises:
        OSError: The index or a folder cannot be used.
    """
    rows: list[ImageRow | DecisionRow] = [*_missing_pictures(out_dir, index), *_missing_decisions(out_dir, index)]
    if rows:
        index.put(rows)
    return len(rows)


def remove_unfinished(out_dir: Path) -> int:
    """Remove what a c2 that was killed was writing; return how many files that were.

    Raises:
        OSError: One cannot be removed.
    """
    count = 0
    for pattern in ("*/.*.tmp", f"*/{DECISIONS}/.*.tmp"):
        for path in out_dir.glob(pattern):
            path.unlink(missing_ok=True)
            count += 1
    return count


def _missing_pictures(out_dir: Path, index: ShoreIndex) -> Iterator[ImageRow]:
    for path in sorted(out_dir.glob("*/[!.]*.json")):
        if index.has_picture(path.parent.name, path.stem):
            continue
        try:
            side_car = SideCar.model_validate_json(path.read_bytes())
            yield picture_row(out_dir, path.stem, side_car, None, path.stat().st_mtime)
        except (ValidationError, OSError) as error:
            log.error("A kept picture cannot be read", extra=kv(file=path, reason=str(error)[:200]))


def _missing_decisions(out_dir: Path, index: ShoreIndex) -> Iterator[DecisionRow]:
    for path in sorted(out_dir.glob(f"*/{DECISIONS}/[!.]*.json")):
        try:
            decision = Decision.model_validate_json(path.read_bytes())
            if not index.has_decision(decision.vessel_id, decision.decision_id):
                yield DecisionRow.of(decision, path.stat().st_mtime)
        except (ValidationError, OSError) as error:
            log.error("A kept decision cannot be read", extra=kv(file=path, reason=str(error)[:200]))


def to_remove(
    pictures: Sequence[ImageRow], now_utc_s: float, retain_days: float | None, max_bytes: int | None
) -> list[ImageRow]:
    """Choose the pictures that retention removes: pure.

    Everything accepted longer than `retain_days` ago goes. Of what is left, pictures that have been exported go first
    and then the others, each oldest first, until no more than `max_bytes` are left. Decisions are not pictures.
    """
    old: list[ImageRow] = []
    kept: list[ImageRow] = []
    for row in pictures:
        too_old = retain_days is not None and now_utc_s - row.accepted_utc_s > retain_days * 86400.0
        (old if too_old else kept).append(row)
    if max_bytes is None:
        return old
    total = sum(row.size_bytes for row in kept)
    for row in sorted(kept, key=lambda r: (r.exported_utc_s is None, r.accepted_utc_s, r.vessel_id, r.name)):
        if total <= max_bytes:
            break
        total -= row.size_bytes
        old.append(row)
    return old


def remove_files(out_dir: Path, row: ImageRow) -> None:
    """Remove a picture's files; those that are gone already do no harm.

    Raises:
        OSError: One cannot be removed.
    """
    for path in files_of(out_dir, row):
        path.unlink(missing_ok=True)


def find_picture(pictures: Sequence[ImageRow], name: str, vessel: str | None, version: int | None) -> ImageRow:
    """Return the picture that a person means.

    Args:
        pictures: Rows whose files are there.
        name: VEHICLE/IMAGE_ID as tables show it, or the name of the files.
        vessel: Its vessel, None for any.
        version: Its version, None for the newest.

    Raises:
        StoredFileError: There is none, or there are several that are not versions of one.
    """
    vehicle, _, image_id = name.partition("/")
    named = [r for r in pictures if r.name == name or (r.vehicle_id, r.image_id) == (vehicle, image_id)]
    found = [r for r in named if vessel in (None, r.vessel_id) and version in (None, r.version)]
    if not found:
        raise StoredFileError("index", "picture", name, "a picture that `sonarpost c2 ls` shows")
    if len({(r.vessel_id, r.vehicle_id, r.image_id, r.first_frame_utc_s) for r in found}) > 1:
        names = ", ".join(f"{r.vessel_id}/{r.name}" for r in found)
        raise StoredFileError(
            "index", "picture", name, f"one picture, with --vessel or by the name of its files: {names}"
        )
    return max(found, key=lambda r: r.version)
