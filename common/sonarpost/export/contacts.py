"""Contacts with their images and decisions, read from the c2 service's folder (`out_dir/{vessel}`).

A contact is identified by vessel, vehicle, image identifier and the second of its first frame. The image identifier
alone is not unique: a vehicle whose store was deleted starts its numbering again. The highest image version counts,
and the decision of `sonarpost.review.decisions`.
"""

from __future__ import annotations

import base64
import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final, Literal, TypeVar

import numpy as np
from pydantic import Field, ValidationError

from sonarpost.errors import BadInputError, StoredFileError
from sonarpost.files import read_regular
from sonarpost.messages import (
    Contact,
    Count,
    Decision,
    Fraction,
    ImageId,
    Ordinal,
    PlatformId,
    ReconstructedImage,
    Record,
    Sha256,
    Text,
    Time,
)
from sonarpost.review.decisions import ReviewResult, ReviewState, review_result
from sonarpost.review.measurement import MeasuredSize
from sonarpost.wire import first_error

MAX_FILE_BYTES: Final = 1 << 22
"""Larger JSON files are rejected. The side-car of an image of 4096 x 4096 pixels is smaller."""

DECISIONS: Final = "decisions"
_RUN_BYTES: Final = 256

N = TypeVar("N", int, float)


class ImageSideCar(Record):
    """JSON file beside a stored image: the `reconstructed_image` record without its pixels.

    Attributes:
        missing_runs: `missing_mask` of the record in base64, as pairs of bytes: one less than how often the second one
            is repeated, at most to the next multiple of 256 bytes of the mask.
    """

    TYPE = "reconstructed_image"

    type: Literal["reconstructed_image"]
    v: Literal[1]
    vessel_id: PlatformId
    vehicle_id: PlatformId
    image_id: ImageId
    version: Ordinal
    contact: Contact | None
    codec: str
    model: str
    pixels_sha256: Sha256
    complete: bool
    missing_fraction: Fraction
    missing_halves: tuple[Literal["top", "bottom"], ...]
    missing_runs: str
    bytes_received: Count
    bytes_total: Count
    frames_received: Count
    first_frame_utc_s: Time
    last_frame_utc_s: Time
    notes: tuple[Text, ...]
    authenticated: bool | None
    despeckle_strength: Fraction | None
    height_px: Annotated[int, Field(ge=1, le=4096)]
    width_px: Annotated[int, Field(ge=1, le=4096)]


def side_car(image: ReconstructedImage) -> dict[str, object]:
    """Return the content of a side-car: all fields but the pixels; see `ImageSideCar`."""
    return {
        "type": image.TYPE,
        "v": image.VERSION,
        **image.model_dump(exclude={"pixels", "missing_mask"}),
        "missing_runs": _runs_of(image.missing_mask),
        "height_px": image.pixels.height_px,
        "width_px": image.pixels.width_px,
        "bits": image.pixels.bits,
    }


def _runs_of(mask: bytes) -> str:
    if not mask:
        return ""
    values = np.frombuffer(mask, dtype=np.uint8)
    is_start = (np.arange(values.size) % _RUN_BYTES == 0) | (np.diff(values, prepend=np.uint8(0)) != 0)
    starts = np.flatnonzero(is_start)
    lengths = np.diff(starts, append=values.size)
    return base64.b64encode(np.column_stack([lengths - 1, values[starts]]).astype(np.uint8).tobytes()).decode()


def mask_of_runs(runs: str, height_px: int, width_px: int) -> bytes:
    """Return the `missing_mask` of a record.

    Args:
        runs: `missing_runs` of its side-car.
        height_px: Rows of the image.
        width_px: Columns of the image.

    Raises:
        ValueError: The text is not the mask of such an image.
    """
    pairs = np.frombuffer(base64.b64decode(runs, validate=True), dtype=np.uint8).reshape(-1, 2)
    lengths = pairs[:, 0].astype(np.int64) + 1
    expected = (height_px * width_px + 7) // 8
    if runs and lengths.sum() != expected:
        raise ValueError(f"runs of {expected} bytes, not {lengths.sum()}")
    return np.repeat(pairs[:, 1], lengths).tobytes()


def contact_uid(image: ImageSideCar | ReconstructedImage) -> str:
    """Return the permanent identifier of a contact: sonarpost.vessel-1.uuv-1.20161012T090001Z.00A7.

    The time of the first frame makes it unique over all missions.
    """
    first = datetime.fromtimestamp(int(image.first_frame_utc_s), UTC).strftime("%Y%m%dT%H%M%SZ")
    return f"sonarpost.{image.vessel_id}.{image.vehicle_id}.{first}.{image.image_id}"


@dataclass(frozen=True, slots=True)
class ExportContact:
    """One contact to export.

    Attributes:
        image: Side-car of the latest version of its image, without `missing_runs`, which no export uses.
        decisions: All decisions about it, oldest first.
        image_path: PNG of that version; None if the file is missing or only the contact record was received.
        size: Size as operators measured it; empty at the shore site, which receives no measurements.
        result: Result of the decisions.
    """

    image: ImageSideCar
    decisions: tuple[Decision, ...]
    image_path: Path | None
    size: MeasuredSize = field(default_factory=MeasuredSize)
    result: ReviewResult = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "result", review_result(self.decisions))

    @property
    def uid(self) -> str:
        """Permanent identifier, see `contact_uid`."""
        return contact_uid(self.image)

    @property
    def name(self) -> str:
        """Short name for maps and tables, for example uuv-1/00A7."""
        return f"{self.image.vehicle_id}/{self.image.image_id}"

    @property
    def decision(self) -> Decision | None:
        """Decision that counts; None without one."""
        return self.result.counting

    @property
    def review(self) -> ReviewState:
        """State of the contact."""
        return self.result.state

    @property
    def withdrawn_by(self) -> str | None:
        """Operator who withdrew the last decision; None if a decision counts or there was none."""
        result = self.result
        if not result.is_withdrawn:
            return None
        return next(d.operator for d in reversed(self.decisions) if d.decision_id in result.withdrawals)

    @property
    def position(self) -> tuple[float, float] | None:
        """(lat_deg, lon_deg), WGS 84; None if either is unknown."""
        contact = self.image.contact
        if contact is None or contact.lat_deg is None or contact.lon_deg is None:
            return None
        return contact.lat_deg, contact.lon_deg


@dataclass(frozen=True, slots=True)
class ContactSet:
    """Contacts to export.

    Attributes:
        contacts: Ordered by first frame, vessel, vehicle and image identifier.
        unmatched: Decisions without a stored image.
        problems: One error for each rejected file.
    """

    contacts: tuple[ExportContact, ...]
    unmatched: tuple[Decision, ...]
    problems: tuple[BadInputError, ...]

    def __iter__(self) -> Iterator[ExportContact]:
        return iter(self.contacts)

    @property
    def located(self) -> tuple[ExportContact, ...]:
        """Contacts with a position."""
        return tuple(c for c in self.contacts if c.position is not None)

    @property
    def unlocated(self) -> tuple[ExportContact, ...]:
        """Contacts without a position. Maps omit them and state their number."""
        return tuple(c for c in self.contacts if c.position is None)


R = TypeVar("R", ImageSideCar, Decision)


@dataclass(frozen=True, slots=True)
class StoredRecords:
    """Files of the c2 service's folder.

    Attributes:
        images: Side-car, without `missing_runs`, and path of every stored image version.
        decisions: All stored decisions.
        problems: One error for each rejected file.
    """

    images: tuple[tuple[ImageSideCar, Path], ...]
    decisions: tuple[Decision, ...]
    problems: tuple[BadInputError, ...]


def load_contacts(out_dir: Path) -> ContactSet:
    """Read all contacts from the c2 service's folder.

    A rejected file is listed in `problems`; the other files are read. c2 may write while this function reads: an
    image's side-car is written after its other files.

    Args:
        out_dir: `out_dir` of the c2 service, with one folder for each vessel.

    Raises:
        StoredFileError: `out_dir` is not a readable folder.
    """
    stored = read_stored_records(out_dir)
    problems = list(stored.problems)
    latest: dict[tuple[_Name, int], tuple[ImageSideCar, Path]] = {}
    for image, path in stored.images:
        key = (_name(image), int(image.first_frame_utc_s))
        if key in latest and latest[key][0].version == image.version:
            expected = f"one image of this name and version; {latest[key][1].name} is exported"
            problems.append(StoredFileError(str(path), "image_id", image.image_id, expected))
            continue
        if key not in latest or latest[key][0].version < image.version:
            latest[key] = (image, path)
    start_times: defaultdict[_Name, list[int]] = defaultdict(list)
    for name, first_s in latest:
        start_times[name].append(first_s)
    decisions: defaultdict[tuple[_Name, int], list[Decision]] = defaultdict(list)
    unmatched: list[Decision] = []
    for decision in sorted(stored.decisions, key=lambda d: (d.decided_utc_s, d.decision_id)):
        name = _name(decision)
        start = match_start_time(start_times.get(name, ()), decision.decided_utc_s)
        if start is None:
            unmatched.append(decision)
        else:
            decisions[name, start].append(decision)
    contacts = [
        ExportContact(image, tuple(decisions[key]), _png_path(image, path)) for key, (image, path) in latest.items()
    ]
    contacts.sort(key=lambda c: (c.image.first_frame_utc_s, c.uid))
    return ContactSet(tuple(contacts), tuple(unmatched), tuple(problems))


def read_stored_records(out_dir: Path) -> StoredRecords:
    """Read all side-cars and decisions from the c2 service's folder.

    Raises:
        StoredFileError: `out_dir` is not a readable folder.
    """
    problems: list[BadInputError] = []
    images: list[tuple[ImageSideCar, Path]] = []
    decisions: list[Decision] = []
    for folder in _vessel_folders(out_dir):
        for image, path in _records(ImageSideCar, folder, folder.name, problems):
            images.append((image.model_copy(update={"missing_runs": ""}), path))
        decisions += [decision for decision, _ in _records(Decision, folder / DECISIONS, folder.name, problems)]
    return StoredRecords(tuple(images), tuple(decisions), tuple(problems))


def match_start_time(start_times: Sequence[N], utc_s: float) -> N | None:
    """Return which of several images with one identifier a record refers to.

    It is the last image whose first frame arrived before the record was made. A single candidate always matches,
    because platform clocks differ.

    Args:
        start_times: UTC of the first frame of each image, in seconds.
        utc_s: UTC of the record, in seconds.

    Returns:
        The start time of the image, or None if no image matches.
    """
    earlier = [start for start in start_times if start <= utc_s]
    if earlier or len(start_times) == 1:
        return max(earlier, default=start_times[0])
    return None


def _vessel_folders(out_dir: Path) -> list[Path]:
    try:
        return sorted(path for path in out_dir.iterdir() if path.is_dir())
    except OSError as error:
        raise StoredFileError(str(out_dir), "", error.strerror or str(error), "the out_dir of c2") from error


def _json_files(folder: Path, problems: list[BadInputError]) -> list[Path]:
    try:
        # A hidden file is not yet completely written.
        return sorted(p for p in folder.iterdir() if p.suffix == ".json" and not p.name.startswith("."))
    except FileNotFoundError:
        return []
    except OSError as error:
        problems.append(StoredFileError(str(folder), "", error.strerror or str(error), "a readable folder"))
        return []


def _records(model: type[R], folder: Path, vessel_id: str, problems: list[BadInputError]) -> Iterator[tuple[R, Path]]:
    """Yield the records of a vessel in a folder with their files; report a problem for each other file."""
    for path in _json_files(folder, problems):
        try:
            record = model.model_validate_json(read_regular(path, MAX_FILE_BYTES))
        except OSError as error:
            problems.append(StoredFileError(str(path), "", error.strerror or str(error), f"a readable {model.TYPE}"))
        except ValidationError as error:
            problems.append(StoredFileError(str(path), *first_error(error)))
        else:
            if record.vessel_id == vessel_id:
                yield record, path
            else:
                problems.append(StoredFileError(str(path), "vessel_id", record.vessel_id, vessel_id))


_Name = tuple[str, str, str]


def _name(record: ImageSideCar | Decision) -> _Name:
    return record.vessel_id, record.vehicle_id, record.image_id


def _png_path(image: ImageSideCar, side_car: Path) -> Path | None:
    png = side_car.with_suffix(".png")
    # Without a codec only the contact record was received; its PNG is black.
    return png if image.codec and os.access(png, os.R_OK) else None
