"""Rows of the archive of a shore site, as readers receive them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Final, Literal, TypeVar

from sonarpost.messages import Contact, Decision, DeliveryState, TaskingKind


@dataclass(frozen=True, slots=True)
class ImageRow:
    """One version of an image.

    Attributes:
        name: File name without suffix, in the vessel's folder.
        relayed_utc_s: When the vessel's relay accepted it, by the vessel's clock; None if restored from the files.
        accepted_utc_s: When c2 stored it, by the shore's clock.
        size_bytes: Size of its three files, each counted as at least `shore_files.MIN_FILE_BYTES`.
        contact: The contact with its position, if it has one.
        exported_utc_s: When it was last exported; None for never.
        removed_utc_s: When retention deleted its files; None while they exist.
        conflict: Whether another image has the plain file name, see `image_files`.
        files_sha256: SHA-256 digests of its files in the order of `image_files.SUFFIXES`, separated by spaces.
        verified_utc_s: When its files were last compared with the digests; None for never.
        fault: `missing`, `changed` or `unreadable` if the last comparison failed, else empty.
        despeckle_strength: As in `ReconstructedImage`.
    """

    vessel_id: str
    name: str
    vehicle_id: str
    image_id: str
    version: int
    first_frame_utc_s: float
    last_frame_utc_s: float
    relayed_utc_s: float | None
    accepted_utc_s: float
    complete: bool
    missing_fraction: float
    height_px: int
    width_px: int
    codec: str
    size_bytes: int
    contact: Contact | None = None
    exported_utc_s: float | None = None
    removed_utc_s: float | None = None
    conflict: bool = False
    files_sha256: str = ""
    verified_utc_s: float | None = None
    fault: str = ""
    despeckle_strength: float | None = None

    @property
    def side_car_sha256(self) -> str:
        """Digest of its JSON file, which identifies its content."""
        return self.files_sha256.partition(" ")[0]


@dataclass(frozen=True, slots=True)
class DecisionRow:
    """One decision; `files_sha256`, `verified_utc_s` and `fault` as in `ImageRow`."""

    vessel_id: str
    decision_id: str
    vehicle_id: str
    image_id: str
    image_version: int
    verdict: str
    confidence: float | None
    mlo_class: str | None
    remark: str
    operator: str
    decided_utc_s: float
    accepted_utc_s: float
    files_sha256: str = ""
    verified_utc_s: float | None = None
    fault: str = ""

    @classmethod
    def of(cls, decision: Decision, accepted_utc_s: float, files_sha256: str) -> DecisionRow:
        """Return the row of a record."""
        values = decision.model_dump(exclude={"accepted_utc_s"})
        named = {f.name: values[f.name] for f in fields(cls) if f.name in values}
        return cls(**named, accepted_utc_s=accepted_utc_s, files_sha256=files_sha256)


@dataclass(frozen=True, slots=True)
class TaskingRow:
    """A comment or a command with its delivery state."""

    vessel_id: str
    kind: TaskingKind
    record_id: str
    vehicle_id: str
    image_id: str | None
    summary: str
    author: str
    issued_utc_s: float
    state: DeliveryState
    reason: str
    changed_utc_s: float


FILE_NAME: Final = "archive.db"
"""The database in a folder."""
Row = TypeVar("Row", ImageRow, DecisionRow, TaskingRow)
MarkColumn = Literal["exported_utc_s", "removed_utc_s"]
DEFECTS: Final = ("missing", "changed", "unreadable", "conflicting")
Fault = Literal["", "missing", "changed", "unreadable"]


@dataclass(frozen=True, slots=True)
class Verified:
    """Result of the comparison of a row with its files.

    Attributes:
        row: The row as it was compared.
        fault: What differs, empty if nothing does.
    """

    row: ImageRow | DecisionRow
    fault: Fault


def document_of(row: ImageRow | DecisionRow | TaskingRow) -> dict[str, Any]:
    """Return a row as a map of JSON values; a contact is a nested map."""
    values = {each.name: getattr(row, each.name) for each in fields(row)}
    contact = values.get("contact")
    return values if contact is None else {**values, "contact": contact.model_dump()}
