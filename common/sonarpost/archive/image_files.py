"""Files of a reconstructed image: TIFF, JSON side-car and PNG, with the same bytes on every platform."""

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

    The time distinguishes images of a later mission, if the vehicle has restarted its identifiers.
    """
    first = datetime.fromtimestamp(image.first_frame_utc_s, UTC).strftime("%Y%m%dT%H%M%SZ")
    return f"{image.vehicle_id}_{first}_{image.image_id}_v{image.version}"


def side_car(image: ReconstructedImage) -> dict[str, object]:
    """Return the content of the JSON file: all fields but the pixels, missing areas as a count and a range of rows.

    `authenticated` is absent if it is not known, as in files of earlier versions.
    """
    unknown = {"authenticated"} if image.authenticated is None else set()
    fields = image.model_dump(exclude={"picture", "missing_mask", *unknown})
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
    """Write the three files of an image; existing files of the same image are not changed.

    The JSON file is written last: if it exists, the other two are complete.

    Returns:
        Path of the TIFF file, and whether the image is new.

    Raises:
        OSError: The folder cannot be written, for example because of a full disk.
    """
    files = AtomicFiles()
    found = add_image(files, folder, image)
    files.commit()
    return found


def add_image(files: AtomicFiles, folder: Path, image: ReconstructedImage) -> tuple[Path, bool]:
    """Add the files of an image to others that are committed together; see `write_image`.

    Raises:
        OSError: The folder cannot be written; none of the three files is added.
    """
    name = image_file_name(image)
    tiff, sidecar = folder / f"{name}.tiff", folder / f"{name}.json"
    text = (json.dumps(side_car(image), indent=1) + "\n").encode()
    png = folder / f"{name}.png"
    if (added := files.text_of(sidecar)) is not None:
        known = added == text
    else:
        known = sidecar.is_file() and sidecar.read_bytes() == text and tiff.is_file() and png.is_file()
    if known:
        return tiff, False
    folder.mkdir(parents=True, exist_ok=True)
    pixels = image.picture.to_array()
    before = len(files)
    try:
        files.add(tiff, tiff_bytes(tiff, pixels))
        files.add(png, png_bytes(png, pixels))
        files.add(sidecar, text, last=True)
    except BaseException:
        files.drop_from(before)
        raise
    return tiff, True
