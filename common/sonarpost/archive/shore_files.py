"""Files that c2 stores: paths, rows for the index, and retention."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from sonarpost.archive.image_files import SUFFIXES, image_file_name
from sonarpost.archive.retention import Stored, select_for_removal
from sonarpost.archive.shore_index import DecisionRow, ImageRow, ShoreIndex, Verified
from sonarpost.errors import StoredFileError
from sonarpost.export.contacts import DECISIONS, ImageSideCar
from sonarpost.files import read_regular
from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.messages import Decision, ReconstructedImage
from sonarpost.sonar.image_decoding import MAX_FILE_BYTES

log = logging.getLogger(__name__)

MIN_FILE_BYTES: Final = limit(
    16384, "bytes a file", "claims", "archive of c2", "vessel", "least size for max_bytes", "small files count as this"
)


def image_paths(out_dir: Path, row: ImageRow) -> tuple[Path, ...]:
    """Return the paths of an image's files."""
    return tuple(out_dir / row.vessel_id / f"{row.name}{suffix}" for suffix in SUFFIXES)


def decision_path(out_dir: Path, vessel_id: str, decision_id: str) -> Path:
    """Return the path of a decision's file."""
    return out_dir / vessel_id / DECISIONS / decision_file_name(decision_id)


def files_digest(paths: Iterable[Path]) -> str:
    """Return the SHA-256 digests of files, separated by spaces.

    Raises:
        OSError: A file is missing or cannot be read.
    """
    return " ".join(hashlib.sha256(read_regular(path, MAX_FILE_BYTES)).hexdigest() for path in paths)


def decision_text(decision: Decision) -> bytes:
    """Return the content of a decision's file."""
    return (json.dumps(decision.model_dump(), indent=1) + "\n").encode()


def verify_files(out_dir: Path, row: ImageRow | DecisionRow) -> Verified:
    """Compare the files of a row with the index: existence and digests."""
    if isinstance(row, ImageRow):
        paths = image_paths(out_dir, row)
    else:
        paths = (decision_path(out_dir, row.vessel_id, row.decision_id),)
    try:
        found = files_digest(paths)
    except FileNotFoundError:
        return Verified(row, "missing")
    except OSError as error:
        log.debug("Stored file cannot be read", extra=kv(file=paths[0], error=str(error)))
        return Verified(row, "unreadable")
    return Verified(row, "" if found == row.files_sha256 else "changed")


def decision_file_name(decision_id: str) -> str:
    """Return the file name of a decision.

    The identifier is external text: only its hexadecimal form is safe as a file name. `RecordId` limits it to 64
    characters, so that the name is not too long for any file system.
    """
    return f"{decision_id.encode().hex()}.json"


def image_row(
    out_dir: Path,
    name: str,
    image: ReconstructedImage | ImageSideCar,
    relayed_utc_s: float | None,
    accepted_utc_s: float,
) -> ImageRow:
    """Return the index row of an image whose files are written.

    Raises:
        OSError: A file is missing.
    """
    folder = out_dir / image.vessel_id
    contents = [read_regular(folder / f"{name}{suffix}", MAX_FILE_BYTES) for suffix in SUFFIXES]
    return row_of_image(name, image, relayed_utc_s, accepted_utc_s, contents)


def row_of_image(
    name: str,
    image: ReconstructedImage | ImageSideCar,
    relayed_utc_s: float | None,
    accepted_utc_s: float,
    contents: Sequence[bytes],
) -> ImageRow:
    """Return the index row of an image.

    Args:
        name: File name without suffix.
        image: The image, or its side-car.
        relayed_utc_s: See `ImageRow`.
        accepted_utc_s: See `ImageRow`.
        contents: Content of its files, in the order of `SUFFIXES`.
    """
    height_px, width_px = (
        (image.height_px, image.width_px)
        if isinstance(image, ImageSideCar)
        else (image.pixels.height_px, image.pixels.width_px)
    )
    contact = image.contact
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
        size_bytes=sum(max(len(content), MIN_FILE_BYTES) for content in contents),
        conflict=name != image_file_name(image),
        files_sha256=" ".join(hashlib.sha256(content).hexdigest() for content in contents),
        despeckle_strength=image.despeckle_strength,
        p_mine_like=contact.p_mine_like if contact else None,
        p_other_object=contact.p_other_object if contact else None,
    )


def index_missing_files(out_dir: Path, index: ShoreIndex) -> int:
    """Add files that are not in the index; return the number of rows.

    An unreadable file is logged and ignored.

    Raises:
        OSError: The index or a folder cannot be read or written.
    """
    rows: list[ImageRow | DecisionRow] = [*_missing_images(out_dir, index), *_missing_decisions(out_dir, index)]
    if rows:
        index.put(rows)
    return len(rows)


def remove_temporary_files(out_dir: Path) -> int:
    """Delete temporary files of an interrupted c2; return their number.

    Raises:
        OSError: A file cannot be deleted.
    """
    count = 0
    for pattern in ("*/.*.tmp", f"*/{DECISIONS}/.*.tmp"):
        for path in out_dir.glob(pattern):
            path.unlink(missing_ok=True)
            count += 1
    return count


def _missing_images(out_dir: Path, index: ShoreIndex) -> Iterator[ImageRow]:
    for path in sorted(out_dir.glob("*/[!.]*.json")):
        try:
            if index.has_image(path.parent.name, path.stem):
                continue
            side_car = ImageSideCar.model_validate_json(read_regular(path, MAX_FILE_BYTES))
            yield image_row(out_dir, path.stem, side_car, None, path.stat().st_mtime)
        except (ValueError, OSError) as error:  # a name that is not UTF-8 is a ValueError too
            log.error("Stored image cannot be read", extra=kv(file=path, reason=str(error)[:200]))


def _missing_decisions(out_dir: Path, index: ShoreIndex) -> Iterator[DecisionRow]:
    for path in sorted(out_dir.glob(f"*/{DECISIONS}/[!.]*.json")):
        try:
            decision = Decision.model_validate_json(read_regular(path, MAX_FILE_BYTES))
            if not index.has_decision(decision.vessel_id, decision.decision_id):
                yield DecisionRow.of(decision, path.stat().st_mtime, files_digest([path]))
        except (ValueError, OSError) as error:  # a name that is not UTF-8 is a ValueError too
            log.error("Stored decision cannot be read", extra=kv(file=path, reason=str(error)[:200]))


def select_images(
    images: Sequence[ImageRow],
    decisions: Iterable[DecisionRow],
    now_utc_s: float,
    retain_days: float | None,
    max_bytes: int | None,
) -> list[ImageRow]:
    """Select the images that retention removes; see `select_for_removal`.

    Because of the total size, the vessel with the most bytes loses images first: exported ones, of which a copy exists,
    before others, then those without a decision before those with one, then the one that was accepted first.
    """
    decided = {(d.vessel_id, d.vehicle_id, d.image_id) for d in decisions}

    def order(row: ImageRow) -> int:
        return 2 * (row.exported_utc_s is None) + ((row.vessel_id, row.vehicle_id, row.image_id) in decided)

    rows = sorted(images, key=lambda row: (row.vessel_id, row.name))
    stored = [Stored(row, row.accepted_utc_s, row.size_bytes, order(row), row.vessel_id) for row in rows]
    return select_for_removal(stored, now_utc_s, retain_days, max_bytes)


def delete_image_files(out_dir: Path, row: ImageRow) -> None:
    """Delete the files of an image that still exist.

    Raises:
        OSError: A file cannot be deleted.
    """
    for path in image_paths(out_dir, row):
        path.unlink(missing_ok=True)


def find_image(images: Sequence[ImageRow], name: str, vessel: str | None, version: int | None) -> ImageRow:
    """Find an image by the name that a user has given.

    Args:
        images: Rows whose files exist.
        name: VEHICLE/IMAGE_ID as shown in tables, or the name of the files.
        vessel: Its vessel, None for any.
        version: Its version, None for the newest.

    Raises:
        StoredFileError: There is no such image, or several that are not versions of one.
    """
    vehicle, _, image_id = name.partition("/")
    named = [r for r in images if r.name == name or (r.vehicle_id, r.image_id) == (vehicle, image_id)]
    found = [r for r in named if vessel in (None, r.vessel_id) and version in (None, r.version)]
    if not found:
        raise StoredFileError("index", "image", name, "an image that `sonarpost c2 ls` shows")
    if len({(r.vessel_id, r.vehicle_id, r.image_id, r.first_frame_utc_s) for r in found}) > 1:
        names = ", ".join(f"{r.vessel_id}/{r.name}" for r in found)
        raise StoredFileError("index", "image", name, f"one image, with --vessel or by the name of its files: {names}")
    return max(found, key=lambda r: r.version)
