"""Contacts and their image versions in the database: insertion and queries."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from sonarpost import wire
from sonarpost.errors import BadInputError
from sonarpost.export.contacts import contact_uid, match_start_time
from sonarpost.messages import ReconstructedImage
from sonarpost.review.objects import AssociationRule
from sonarpost.review.positions import vehicle_position
from sonarpost.services.console.store.association import assign_objects
from sonarpost.services.console.store.related_images import link_related_images
from sonarpost.services.console.store.serialisers import (
    CONTACT_QUERY,
    LISTED,
    NEWER_DETAIL,
    Json,
    contact_json,
    percent_received,
)

Sort = Literal["arrived", "updated", "confidence", "vehicle", "received", "review", "name", "range"]
SORT_COLUMNS: Final[Mapping[Sort, str]] = {
    "arrived": "arrived_utc_s",
    "updated": "updated_utc_s",
    "confidence": "atd_confidence",
    "vehicle": "vehicle_id",
    "received": "percent",
    "review": "review",
    "name": "name",
    "range": "range_m",
}
_RECORD_COLUMNS: Final = (
    "atd_class",
    "atd_confidence",
    "p_mine_like",
    "p_other_object",
    "lat_deg",
    "lon_deg",
    "position_sigma_m",
    "length_m",
    "width_m",
    "height_m",
    "heading_deg",
    "pixel_along_m",
)
_PLACE_COLUMNS: Final = "group_id, parent, lat_deg, lon_deg, position_sigma_m, seen_utc_s, length_m, width_m, height_m"
_IMAGE_COLUMNS: Final = (
    "version",
    "codec",
    "despeckle_strength",
    "bytes_received",
    "bytes_total",
    "first_frame_utc_s",
    "last_frame_utc_s",
)


REVIEW_CONDITIONS: Final[Mapping[str, str]] = {
    "reviewed": "c.review <> 'unreviewed'",
    "mine_like": "c.review IN ('mine_like', 'disputed')",
    # The plus signs keep SQLite from an index on the state: most contacts may have it, and all would be sorted.
    "unreviewed": "+c.review = 'unreviewed'",
    "to_do": "(+c.review = 'unreviewed' OR +c.contradictory = 1)",
    "newer_detail": NEWER_DETAIL,
}
"""SQL conditions of values of `review`; any other value is one state."""


class ContactFilter(BaseModel):
    """Filter, order and page of a contact list, as in a query string; None or empty means no restriction.

    Attributes:
        review: State of the contact; `mine_like` includes disputed contacts, `reviewed` all with a decision. `to_do`:
            without a decision, disputed, or with contradictory verdicts on its object. `newer_detail`: decided on less
            than has arrived.
        min_confidence: Minimum confidence of the detector, 0 to 2.
        text: Part of a name, class or remark; `q` in a query string.
    """

    model_config = ConfigDict(frozen=True, populate_by_name=True, allow_inf_nan=False)

    review: (
        Literal["to_do", "unreviewed", "mine_like", "not_mine_like", "unsure", "disputed", "reviewed", "newer_detail"]
        | None
    ) = None
    vehicle: Annotated[str, Field(max_length=40)] = ""
    vessel: Annotated[str, Field(max_length=40)] = ""
    min_confidence: Annotated[float, Field(ge=0, le=2)] | None = None
    complete: bool | None = None
    group: Annotated[str, Field(max_length=20)] = ""
    text: Annotated[str, Field(max_length=80, alias="q")] = ""
    sort: Sort = "updated"
    order: Literal["asc", "desc"] = "desc"
    offset: Annotated[int, Field(ge=0, le=10**9)] = 0
    limit: Annotated[int, Field(ge=1, le=500)] = 100

    def where(self) -> tuple[str, list[object]]:
        """Return the SQL condition, which contains only constants, and its parameters."""
        conditions = [LISTED]
        values: list[object] = []
        special = REVIEW_CONDITIONS.get(self.review or "")
        if special is not None:
            conditions.append(special)
        for condition, value in (
            ("c.review = ?", self.review if special is None else None),
            ("c.vehicle_id = ?", self.vehicle or None),
            ("c.vessel_id = ?", self.vessel or None),
            ("c.group_id = ?", self.group or None),
            ("c.atd_confidence >= ?", self.min_confidence),
            ("c.complete = ?", None if self.complete is None else int(self.complete)),
        ):
            if value is not None:
                conditions.append(condition)
                values.append(value)
        if self.text:
            pattern = "%" + self.text.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_") + "%"
            columns = ("name", "mlo_class", "atd_class", "remark")
            conditions.append("(" + " OR ".join(f"c.{column} LIKE ? ESCAPE '\\'" for column in columns) + ")")
            values += [pattern] * len(columns)
        return " AND ".join(conditions), values


class NotFoundError(BadInputError):
    """There is no such contact, version or file."""


@dataclass(frozen=True, slots=True)
class ContactCounts:
    """Number of contacts, and of contacts without a decision."""

    total: int
    unreviewed: int


@dataclass(frozen=True, slots=True)
class StoredImage:
    """Result of storing an image version.

    Attributes:
        contact_id: Its contact.
        is_new_contact: Whether the contact is new.
        changed: Other contacts whose object has changed.
    """

    contact_id: str
    is_new_contact: bool
    changed: frozenset[str] = frozenset()


def store_image(
    db: sqlite3.Connection, image: ReconstructedImage, rate: int | None, now_utc_s: float, rule: AssociationRule
) -> StoredImage | None:
    """Store an image version, update its contact, and assign the contact to an object.

    Args:
        db: Connection in a transaction.
        image: The record.
        rate: Number of the latest rate of the vehicle; None if unknown.
        now_utc_s: Time of arrival.
        rule: Limits of the association of looks.

    Returns:
        None if the version is already stored.
    """
    contact_id = contact_uid(image)
    added = db.execute(
        "INSERT OR IGNORE INTO version (contact_id, version, received_utc_s, rate, payload) VALUES (?, ?, ?, ?, ?)",
        (contact_id, image.version, now_utc_s, rate, wire.encode(image)),
    )
    if added.rowcount == 0:
        return None
    known = db.execute(f"SELECT version, {_PLACE_COLUMNS} FROM contact WHERE id = ?", (contact_id,)).fetchone()  # noqa: S608
    changed: set[str] = set()
    if known is None or known["version"] <= image.version:
        _update_contact(db, contact_id, image, now_utc_s)
        link_related_images(db, contact_id, image)
        place = db.execute(f"SELECT {_PLACE_COLUMNS} FROM contact WHERE id = ?", (contact_id,)).fetchone()  # noqa: S608
        if known is None or tuple(known)[1:] != tuple(place):
            changed = assign_objects(db, [contact_id], rule)
    db.execute("UPDATE contact SET versions = versions + 1 WHERE id = ?", (contact_id,))
    return StoredImage(contact_id, known is None, frozenset(changed - {contact_id}))


def _update_contact(db: sqlite3.Connection, contact_id: str, image: ReconstructedImage, now_utc_s: float) -> None:
    """Insert a contact, or update the columns that depend on the newest image version."""
    record = image.contact
    vehicle = None
    if record is not None:
        vehicle = vehicle_position(
            record.lat_deg, record.lon_deg, record.heading_deg, record.channel, record.ground_range_m
        )
    constant = {
        "id": contact_id,
        **{name: getattr(image, name) for name in ("vessel_id", "vehicle_id", "image_id")},
        "first_s": int(image.first_frame_utc_s),
        "name": f"{image.vehicle_id}/{image.image_id}",
        "arrived_utc_s": now_utc_s,
    }
    variable = {
        **{name: getattr(record, name, None) for name in _RECORD_COLUMNS},
        **{name: getattr(image, name) for name in _IMAGE_COLUMNS},
        "range_m": record and record.ground_range_m,
        "vehicle_lat_deg": vehicle and vehicle[0],
        "vehicle_lon_deg": vehicle and vehicle[1],
        "seen_utc_s": record and record.time_utc_s,
        "updated_utc_s": now_utc_s,
        "complete": int(image.complete),
        "percent": percent_received(image),
        "has_picture": int(bool(image.codec)),
        "height_px": image.picture.height_px,
        "width_px": image.picture.width_px,
        "authenticated": None if image.authenticated is None else int(image.authenticated),
    }
    columns = ", ".join((*constant, *variable))
    marks = ", ".join("?" * (len(constant) + len(variable)))
    updates = ", ".join(f"{name} = excluded.{name}" for name in variable)
    db.execute(
        f"INSERT INTO contact ({columns}) VALUES ({marks}) ON CONFLICT (id) DO UPDATE SET {updates}",  # noqa: S608
        (*constant.values(), *variable.values()),
    )


def list_contacts(db: sqlite3.Connection, query: ContactFilter) -> Json:
    """Return a page of the contacts, and the counts of all contacts."""
    condition, values = query.where()
    # In the order of arrival, contacts whose verdicts contradict each other come first.
    first = "c.contradictory DESC, " if query.sort == "arrived" else ""
    order = f"ORDER BY {first}c.{SORT_COLUMNS[query.sort]} {query.order}, c.id {query.order}"
    # The inner query finds the page in an index, so that the sub-queries of the outer one run for these rows only.
    page = f"SELECT c.id FROM contact c WHERE {condition} {order} LIMIT ? OFFSET ?"  # noqa: S608  constants only
    rows = db.execute(f"{CONTACT_QUERY} WHERE c.id IN ({page}) {order}", (*values, query.limit, query.offset))
    items = [contact_json(row) for row in rows.fetchall()]
    matching = db.execute(f"SELECT COUNT(*) FROM contact c WHERE {condition}", values).fetchone()[0]  # noqa: S608
    vehicles = [row[0] for row in db.execute("SELECT DISTINCT vehicle_id FROM contact ORDER BY vehicle_id")]
    return {
        **asdict(count_contacts(db)),
        "matching": matching,
        "vehicles": vehicles,
        "offset": query.offset,
        "items": items,
    }


def list_versions(db: sqlite3.Connection, query: ContactFilter, limit: int) -> list[tuple[str, int]]:
    """Return identifier and newest version of the filtered contacts, by the time of their first frame."""
    condition, values = query.where()
    order = "ORDER BY c.first_frame_utc_s, c.id LIMIT ?"
    # Nothing about a sealed contact leaves the console.
    sql = f"SELECT c.id, c.version FROM contact c WHERE c.sealed = 0 AND {condition} {order}"  # noqa: S608
    rows = db.execute(sql, (*values, limit))
    return [(str(row["id"]), int(row["version"])) for row in rows]


def count_contacts(db: sqlite3.Connection) -> ContactCounts:
    """Count the contacts in lists."""
    total = db.execute(f"SELECT COUNT(*) FROM contact c WHERE {LISTED}").fetchone()[0]  # noqa: S608  constants only
    sql = f"SELECT COUNT(*) FROM contact c WHERE {LISTED} AND review = 'unreviewed'"  # noqa: S608
    unreviewed = db.execute(sql).fetchone()[0]
    return ContactCounts(total, unreviewed)


def find_contact(db: sqlite3.Connection, contact_id: str) -> sqlite3.Row:
    """Return the row of a contact, for `contact_json`.

    Raises:
        NotFoundError: There is no such contact.
    """
    row: sqlite3.Row | None = db.execute(f"{CONTACT_QUERY} WHERE c.id = ?", (contact_id,)).fetchone()
    if row is None:
        raise NotFoundError("contact", "id", contact_id, "a contact")
    return row


def find_version(db: sqlite3.Connection, contact_id: str, version: int) -> sqlite3.Row | None:
    """Return the row of an image version; None if there is none."""
    row: sqlite3.Row | None = db.execute(
        "SELECT * FROM version WHERE contact_id = ? AND version = ?", (contact_id, version)
    ).fetchone()
    return row


def find_contact_of_image(
    db: sqlite3.Connection, vessel_id: str, vehicle_id: str, image_id: str, utc_s: float
) -> str | None:
    """Return the identifier of the contact that a record refers to, or None; see `match_start_time`."""
    rows = db.execute(
        "SELECT first_s, id FROM contact WHERE vessel_id = ? AND vehicle_id = ? AND image_id = ?",
        (vessel_id, vehicle_id, image_id),
    )
    contact_ids: dict[int, str] = dict(rows.fetchall())
    start = match_start_time(tuple(contact_ids), utc_s)
    return None if start is None else contact_ids[start]
