"""Files of an archive with a folder: paths, writing, comparison, records of existing files; and retention."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from sonarpost.archive.image_files import SUFFIXES, image_file_name, stored_image
from sonarpost.archive.retention import Stored, select_for_removal
from sonarpost.archive.rows import DecisionRow, Fault, ImageRow
from sonarpost.errors import BadInputError, StoredFileError
from sonarpost.export.contacts import DECISIONS
from sonarpost.files import AtomicFiles, read_regular
from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.messages import Decision, ReconstructedImage
from sonarpost.sonar.image_decoding import MAX_FILE_BYTES
from sonarpost.sonar.image_files import read_image

log = logging.getLogger(__name__)

MIN_FILE_BYTES: Final = limit(
    16384, "bytes a file", "claims", "archive of c2", "vessel", "least size for max_bytes", "small files count as this"
)


def image_paths(out_dir: Path, row: ImageRow) -> tuple[Path, ...]:
    """Return the paths of an image's files."""
    return tuple(out_dir / row.vessel_id / f"{row.name}{suffix}" for suffix in SUFFIXES)


def decision_name(decision_id: str) -> str:
    """Return the name of a decision's file without suffix, in the vessel's folder.

    The identifier is external text: only its hexadecimal form is safe as a file name. `RecordId` limits it to 64
    characters, so that the name is not too long for any file system.
    """
    return f"{DECISIONS}/{decision_id.encode().hex()}"


def decision_path(out_dir: Path, vessel_id: str, decision_id: str) -> Path:
    """Return the path of a decision's file."""
    return out_dir / vessel_id / f"{decision_name(decision_id)}.json"


def write_files(out_dir: Path, files: Iterable[tuple[str, str, str, bytes]]) -> None:
    """Write files, each as vessel, name, suffix and content; the JSON file of an image after its others.

    Raises:
        OSError: They cannot be written; each is complete or absent.
    """
    written = AtomicFiles()
    try:
        for vessel_id, name, suffix, content in files:
            path = out_dir / vessel_id / f"{name}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            written.add(path, content, last=suffix == SUFFIXES[0])
        written.commit()
    finally:
        written.drop_from(0)


def files_digest(paths: Iterable[Path]) -> str:
    """Return the SHA-256 digests of files, separated by spaces.

    Raises:
        OSError: A file is missing or cannot be read.
    """
    return " ".join(hashlib.sha256(read_regular(path, MAX_FILE_BYTES)).hexdigest() for path in paths)


def decision_text(decision: Decision) -> bytes:
    """Return the content of a decision's file."""
    return (json.dumps(decision.model_dump(), indent=1) + "\n").encode()


def verify_files(out_dir: Path, row: ImageRow | DecisionRow) -> Fault:
    """Compare the files of a row with its digests; return what differs."""
    if isinstance(row, ImageRow):
        paths = image_paths(out_dir, row)
    else:
        paths = (decision_path(out_dir, row.vessel_id, row.decision_id),)
    try:
        found = files_digest(paths)
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        log.debug("Stored file cannot be read", extra=kv(file=paths[0], error=str(error)))
        return "unreadable"
    return "" if found == row.files_sha256 else "changed"


def row_of_image(
    name: str,
    image: ReconstructedImage,
    relayed_utc_s: float | None,
    accepted_utc_s: float,
    contents: Sequence[bytes],
) -> ImageRow:
    """Return the row of an image.

    Args:
        name: File name without suffix.
        image: The image.
        relayed_utc_s: See `ImageRow`.
        accepted_utc_s: See `ImageRow`.
        contents: Content of its files, in the order of `SUFFIXES`.
    """
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
        height_px=image.pixels.height_px,
        width_px=image.pixels.width_px,
        codec=image.codec,
        size_bytes=sum(max(len(content), MIN_FILE_BYTES) for content in contents),
        contact=image.contact,
        conflict=name != image_file_name(image),
        files_sha256=" ".join(hashlib.sha256(content).hexdigest() for content in contents),
        despeckle_strength=image.despeckle_strength,
    )


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


def stored_records(out_dir: Path) -> Iterator[tuple[ReconstructedImage | Decision, float]]:
    """Yield the records of the files of a folder and their times, for an archive that was lost; oldest first.

    An unreadable file is logged and ignored.

    Raises:
        OSError: A folder cannot be read.
    """
    paths = [*out_dir.glob("*/[!.]*.json"), *out_dir.glob(f"*/{DECISIONS}/[!.]*.json")]
    for utc_s, path in sorted((path.lstat().st_mtime, path) for path in paths):
        try:
            content = read_regular(path, MAX_FILE_BYTES)
            if path.parent.name == DECISIONS:
                yield Decision.model_validate_json(content), utc_s
            else:
                yield stored_image(content, read_image(path.with_suffix(".tiff")), str(path)), utc_s
        except (ValueError, OSError, BadInputError) as error:  # a name that is not UTF-8 is a ValueError too
            log.error("Stored record cannot be read", extra=kv(file=path, reason=str(error)[:200]))


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
