"""A reconstructed picture on the disk: TIFF, JSON side-car and PNG, the same bytes on every platform."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sonarpost.files import AtomicFiles
from sonarpost.messages import ReconstructedImage
from sonarpost.sonar.image_files import png_bytes, tiff_bytes


def image_file_name(image: ReconstructedImage) -> str:
    """Return the file name without suffix: vehicle, time of the first frame, image identifier, version.

    The time keeps a later mission's picture apart when a vehicle starts its identifiers anew.
    """
    first = datetime.fromtimestamp(image.first_frame_utc_s, UTC).strftime("%Y%m%dT%H%M%SZ")
    return f"{image.vehicle_id}_{first}_{image.image_id}_v{image.version}"


def side_car(image: ReconstructedImage) -> dict[str, object]:
    """Return what the JSON file says: everything but the pixels, missing areas as counts and rectangles of rows."""
    fields = image.model_dump(exclude={"picture", "missing_mask"})
    rows = np.flatnonzero(image.missing().any(axis=1))
    return {
        "type": image.TYPE,
        "v": image.VERSION,
        **fields,
        "height_px": image.picture.height_px,
        "width_px": image.picture.width_px,
        "bits": image.picture.bits,
        "missing_pixels": int(image.missing().sum()),
        "missing_rows": [int(rows[0]), int(rows[-1]) + 1] if rows.size else [],
    }


def write_image(folder: Path, image: ReconstructedImage) -> tuple[Path, bool]:
    """Write the three files of a picture; return the TIFF's path and whether it was new.

    The JSON comes last: where it is, the other two are whole. A picture that is there with the same pixels is left.

    Raises:
        OSError: The folder cannot be written (a full disk).
    """
    files = AtomicFiles()
    found = add_image(files, folder, image)
    files.commit()
    return found


def add_image(files: AtomicFiles, folder: Path, image: ReconstructedImage) -> tuple[Path, bool]:
    """Add a picture's files to others that are committed together; what is returned is as of `write_image`.

    Raises:
        OSError: The folder cannot be written (a full disk); none of the three is added.
    """
    name = image_file_name(image)
    tiff, sidecar = folder / f"{name}.tiff", folder / f"{name}.json"
    text = (json.dumps(side_car(image), indent=1) + "\n").encode()
    picture = folder / f"{name}.png"
    if (added := files.text_of(sidecar)) is not None:
        known = added == text
    else:
        known = sidecar.is_file() and sidecar.read_bytes() == text and tiff.is_file() and picture.is_file()
    if known:
        return tiff, False
    folder.mkdir(parents=True, exist_ok=True)
    pixels = image.picture.to_array()
    before = len(files)
    try:
        files.add(tiff, tiff_bytes(tiff, pixels))
        files.add(picture, png_bytes(picture, pixels))
        files.add(sidecar, text, last=True)
    except BaseException:
        files.drop_from(before)
        raise
    return tiff, True
