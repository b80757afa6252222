"""Images in the archive of c2, read as an operator's program does, and entered into an operation log."""

import contextlib
import hashlib
import json
import sqlite3
from collections import Counter
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

from builders.history import History
from sonarpost.messages import CodedImage, ReconstructedImage


def record_name(vehicle_id: str, image_id: str, version: int, first_frame_utc_s: float) -> str:
    """Return the identity of an image record; the time distinguishes missions with the same identifiers."""
    return f"{vehicle_id}/{image_id}/v{version}/{first_frame_utc_s:.3f}"


def name_of(image: CodedImage | ReconstructedImage) -> str:
    """Return the identity of an image record."""
    return record_name(image.vehicle_id, image.image_id, image.version, image.first_frame_utc_s)


def pixels_sha256(side_car: Path) -> str:
    """Return the SHA-256 of an image's pixels, which are the same in its TIFF and PNG files."""
    tiff = np.ascontiguousarray(tifffile.imread(side_car.with_suffix(".tiff")))
    with Image.open(side_car.with_suffix(".png")) as png:
        assert np.array_equal(np.asarray(png), tiff), side_car
    return hashlib.sha256(tiff.tobytes()).hexdigest()


def side_cars(folder: Path) -> list[Path]:
    """Return the JSON files of complete images in a folder; c2 writes them last."""
    return sorted(folder.glob("[!.]*.json")) if folder.is_dir() else []


class ArchiveLog:
    """Enters what c2 has stored into an operation log: as `c2` each set of files, as `c2 index` each row.

    Files that were entered before are entered again only if their pixels have changed.

    Args:
        history: The operation log.
        out: Output folder of c2.
        vessel: Vessel whose images are entered.
        key: Key of the entered records.
        vehicle: Enter the images of this vehicle only; by default of all.
    """

    def __init__(self, history: History, out: Path, vessel: str, key: str, vehicle: str | None = None) -> None:
        self._vehicle = vehicle
        self._history = history
        self._out = out
        self._vessel = vessel
        self._key = key
        self._files: dict[Path, str] = {}
        self._rows: Counter[str] = Counter()

    def update(self) -> None:
        """Enter new files and rows."""
        for path in side_cars(self._out / self._vessel):
            fields = json.loads(path.read_text())
            if self._vehicle not in (None, fields["vehicle_id"]):
                continue
            sha256 = pixels_sha256(path)
            assert sha256 == fields["pixels_sha256"], path
            if self._files.get(path) != sha256:
                self._files[path] = sha256
                name = record_name(*(fields[n] for n in ("vehicle_id", "image_id", "version", "first_frame_utc_s")))
                self._history.add("handled", "c2", name, key=self._key, sha256=sha256)
        with contextlib.closing(sqlite3.connect(f"file:{self._out / 'archive.db'}?mode=ro", uri=True)) as db:
            rows = db.execute("SELECT vehicle_id, image_id, version, first_frame_utc_s FROM image").fetchall()
        found = Counter(record_name(*row) for row in rows if self._vehicle in (None, row[0]))
        for name in (found - self._rows).elements():
            self._history.add("handled", "c2 index", name, key=self._key)
        self._rows = found
