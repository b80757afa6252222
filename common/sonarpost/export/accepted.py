"""Reads the folder that c2 keeps (`out_dir/{vessel}`) back into contacts with their decisions.

A contact is known by vessel, vehicle, image identifier and the second its first frame came in: the identifier alone
comes again when a vehicle starts anew. Of several versions of a picture the highest counts, of several decisions the
latest.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final, Literal, TypeVar

from pydantic import Field, ValidationError

from sonarpost.errors import BadInputError, StoredFileError
from sonarpost.messages import (
    Contact,
    Count,
    Decision,
    Fraction,
    ImageId,
    Ordinal,
    PlatformId,
    Record,
    Sha256,
    Text,
    Time,
    Verdict,
)
from sonarpost.wire import expected_text

MAX_FILE_BYTES: Final = 1 << 20
"""A side-car with 64 notes of 2000 characters is far below this; nothing larger is read."""

DECISIONS: Final = "decisions"

ReviewState = Verdict | Literal["unreviewed"]


class SideCar(Record):
    """The JSON file beside a kept picture: the record without its pixels."""

    TYPE = "reconstructed_image"

    type: Literal["reconstructed_image"]
    v: Literal[1]
    vessel_id: PlatformId
    vehicle_id: PlatformId
    image_id: ImageId
    version: Ordinal
    contact: Contact | None
    codec: str
    picture_sha256: Sha256
    complete: bool
    missing_fraction: Fraction
    missing_halves: tuple[Literal["top", "bottom"], ...]
    bytes_received: Count
    bytes_total: Count
    frames_received: Count
    first_frame_utc_s: Time
    last_frame_utc_s: Time
    notes: tuple[Text, ...] = ()
    height_px: Annotated[int, Field(ge=1, le=4096)]
    width_px: Annotated[int, Field(ge=1, le=4096)]


@dataclass(frozen=True, slots=True)
class AcceptedContact:
    """One contact as the shore knows it.

    Attributes:
        image: The side-car of the latest version of its picture.
        decisions: Every decision about it, oldest first.
        picture: The PNG of that version; None where the file is absent, or where only the contact record arrived.
    """

    image: SideCar
    decisions: tuple[Decision, ...]
    picture: Path | None

    @property
    def uid(self) -> str:
        """Identifier that stays the same whatever arrives later: sonarpost.vessel-1.uuv-1.20161012T090001Z.00A7."""
        first = datetime.fromtimestamp(int(self.image.first_frame_utc_s), UTC).strftime("%Y%m%dT%H%M%SZ")
        return f"sonarpost.{self.image.vessel_id}.{self.image.vehicle_id}.{first}.{self.image.image_id}"

    @property
    def name(self) -> str:
        """Short name for maps and tables: uuv-1/00A7."""
        return f"{self.image.vehicle_id}/{self.image.image_id}"

    @property
    def decision(self) -> Decision | None:
        """The latest decision, None while nobody has decided."""
        return self.decisions[-1] if self.decisions else None

    @property
    def review(self) -> ReviewState:
        """The latest verdict, or `unreviewed`."""
        return self.decision.verdict if self.decision else "unreviewed"

    @property
    def position(self) -> tuple[float, float] | None:
        """(lat_deg, lon_deg), WGS 84; None when either is not known."""
        contact = self.image.contact
        if contact is None or contact.lat_deg is None or contact.lon_deg is None:
            return None
        return contact.lat_deg, contact.lon_deg


@dataclass(frozen=True, slots=True)
class Accepted:
    """What `load_accepted` found.

    Attributes:
        contacts: One entry a contact, ordered by first frame, vessel, vehicle and image identifier.
        unmatched: Decisions about pictures that are not here.
        problems: Files that could not be used, each named with field, value and what was expected.
    """

    contacts: tuple[AcceptedContact, ...]
    unmatched: tuple[Decision, ...]
    problems: tuple[BadInputError, ...]

    @property
    def located(self) -> tuple[AcceptedContact, ...]:
        """Contacts with a position."""
        return tuple(c for c in self.contacts if c.position is not None)

    @property
    def unlocated(self) -> tuple[AcceptedContact, ...]:
        """Contacts whose position is not known: maps leave them out, and say how many."""
        return tuple(c for c in self.contacts if c.position is None)


def load_accepted(out_dir: Path) -> Accepted:
    """Read everything c2 has accepted.

    A file that cannot be used is left out and listed in `problems`; it never hides the others. Files may be added while
    this reads: a picture's side-car is written last, so what is found is whole.

    Args:
        out_dir: c2's `out_dir`, with one folder a vessel.

    Raises:
        StoredFileError: `out_dir` is not a readable folder.
    """
    problems: list[BadInputError] = []
    pictures: list[tuple[SideCar, Path]] = []
    decisions: list[Decision] = []
    for folder in _folders(out_dir):
        for path in _json_files(folder, problems):
            image = _read(SideCar, path, problems)
            if image is not None and _belongs(image, folder, path, problems):
                pictures.append((image, path))
        for path in _json_files(folder / DECISIONS, problems):
            decision = _read(Decision, path, problems)
            if decision is not None and _belongs(decision, folder, path, problems):
                decisions.append(decision)
    contacts, unmatched = _join(pictures, decisions)
    return Accepted(contacts, unmatched, tuple(problems))


def _folders(out_dir: Path) -> list[Path]:
    try:
        return sorted(path for path in out_dir.iterdir() if path.is_dir())
    except OSError as error:
        raise StoredFileError(str(out_dir), "", error.strerror or str(error), "the folder that c2 keeps") from error


def _json_files(folder: Path, problems: list[BadInputError]) -> list[Path]:
    try:
        # Hidden files are those that are being written.
        return sorted(p for p in folder.iterdir() if p.suffix == ".json" and not p.name.startswith("."))
    except FileNotFoundError:
        return []
    except OSError as error:
        problems.append(StoredFileError(str(folder), "", error.strerror or str(error), "a readable folder"))
        return []


R = TypeVar("R", bound=Record)


def _read(model: type[R], path: Path, problems: list[BadInputError]) -> R | None:
    try:
        with path.open("rb") as file:
            text = file.read(MAX_FILE_BYTES + 1)
        if len(text) <= MAX_FILE_BYTES:
            return model.model_validate_json(text)
        limit = f"{MAX_FILE_BYTES} bytes"
        problems.append(StoredFileError(str(path), "size", f"more than {limit}", f"at most {limit}"))
    except OSError as error:
        problems.append(StoredFileError(str(path), "", error.strerror or str(error), f"a readable {model.TYPE}"))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        value = "nothing" if first["type"] == "missing" else first["input"]
        field = ".".join(str(part) for part in first["loc"])
        problems.append(StoredFileError(str(path), field, value, expected_text(first["type"], first["msg"])))
    return None


def _belongs(record: SideCar | Decision, folder: Path, path: Path, problems: list[BadInputError]) -> bool:
    """Refuse a record that names another vessel than its folder: no vessel speaks for another."""
    if record.vessel_id == folder.name:
        return True
    problems.append(StoredFileError(str(path), "vessel_id", record.vessel_id, folder.name))
    return False


_Name = tuple[str, str, str]


def _join(
    pictures: Iterable[tuple[SideCar, Path]], decisions: Sequence[Decision]
) -> tuple[tuple[AcceptedContact, ...], tuple[Decision, ...]]:
    latest: dict[tuple[_Name, int], tuple[SideCar, Path]] = {}
    for image, path in pictures:
        key = (_name(image), int(image.first_frame_utc_s))
        if key not in latest or latest[key][0].version < image.version:
            latest[key] = (image, path)
    starts: defaultdict[_Name, list[int]] = defaultdict(list)
    for name, first_s in latest:
        starts[name].append(first_s)
    decided, unmatched = _assign(decisions, starts)
    contacts = [
        AcceptedContact(image, tuple(decided[key]), _picture_of(image, path)) for key, (image, path) in latest.items()
    ]
    contacts.sort(key=lambda c: (c.image.first_frame_utc_s, c.uid))
    return tuple(contacts), unmatched


def _assign(
    decisions: Iterable[Decision], starts: Mapping[_Name, Sequence[int]]
) -> tuple[defaultdict[tuple[_Name, int], list[Decision]], tuple[Decision, ...]]:
    """Give every decision to its contact, oldest first.

    Where an identifier came again, a decision is about the last picture that had begun to arrive when it was made.
    With one candidate it is about that one, whatever the clocks say.
    """
    decided: defaultdict[tuple[_Name, int], list[Decision]] = defaultdict(list)
    unmatched: list[Decision] = []
    for decision in sorted(decisions, key=lambda d: (d.decided_utc_s, d.decision_id)):
        name = _name(decision)
        known = starts.get(name, ())
        begun = [first_s for first_s in known if first_s <= decision.decided_utc_s]
        if begun or len(known) == 1:
            decided[name, max(begun, default=known[0])].append(decision)
        else:
            unmatched.append(decision)
    return decided, tuple(unmatched)


def _name(record: SideCar | Decision) -> _Name:
    return record.vessel_id, record.vehicle_id, record.image_id


def _picture_of(image: SideCar, sidecar: Path) -> Path | None:
    png = sidecar.with_suffix(".png")
    # A record without a codec is a contact whose picture did not arrive: its PNG is black and says nothing.
    return png if image.codec and os.access(png, os.R_OK) else None
