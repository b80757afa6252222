"""Contacts in the database: taken as pictures arrive and refine, listed, grouped by position."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Final

from sonarpost import wire
from sonarpost.messages import ReconstructedImage
from sonarpost.review.grouping import Place, nearest_group
from sonarpost.review.local import vehicle_position
from sonarpost.services.console.store.serialisers import CONTACT, Json, contact_row, percent_of

SORTS: Final[Mapping[str, str]] = {
    "arrived": "arrived_utc_s",
    "updated": "updated_utc_s",
    "confidence": "atd_confidence",
    "vehicle": "vehicle_id",
    "received": "percent",
    "review": "review",
    "name": "name",
    "range": "range_m",
}
REVIEWS: Final = ("unreviewed", "mine_like", "not_mine_like", "unsure", "reviewed")
_METRES_PER_DEGREE: Final = 111_000.0


@dataclass(frozen=True, slots=True)
class Filter:
    """Which contacts are wanted, and in which order.

    Attributes:
        text: Part of a name, a class or a remark.
        sort: A key of `SORTS`.
    """

    review: str | None = None
    vehicle: str | None = None
    vessel: str | None = None
    min_confidence: float | None = None
    complete: bool | None = None
    group: str | None = None
    text: str | None = None
    sort: str = "updated"
    descending: bool = True
    offset: int = 0
    limit: int = 100

    def where(self) -> tuple[str, list[object]]:
        """Return the condition in SQL, of constants only, and its values."""
        parts: list[tuple[str, list[object]]] = []
        if self.review == "reviewed":
            parts.append(("c.review <> 'unreviewed'", []))
        elif self.review is not None:
            parts.append(("c.review = ?", [self.review]))
        for column, value in (("vehicle_id", self.vehicle), ("vessel_id", self.vessel), ("group_id", self.group)):
            if value is not None:
                parts.append((f"c.{column} = ?", [value]))
        if self.min_confidence is not None:
            parts.append(("c.atd_confidence >= ?", [self.min_confidence]))
        if self.complete is not None:
            parts.append(("c.complete = ?", [int(self.complete)]))
        if self.text:
            like = "%" + self.text.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_") + "%"
            columns = ("name", "mlo_class", "atd_class", "remark")
            some = " OR ".join(f"c.{column} LIKE ? ESCAPE '\\'" for column in columns)
            parts.append((f"({some})", [like] * len(columns)))
        values = [value for _, given in parts for value in given]
        return " AND ".join(text for text, _ in parts) or "1", values


def contact_id_of(image: ReconstructedImage) -> str:
    """Return a contact's identifier, the one that exports use: the second of the first frame keeps missions apart."""
    first = datetime.fromtimestamp(int(image.first_frame_utc_s), UTC).strftime("%Y%m%dT%H%M%SZ")
    return f"sonarpost.{image.vessel_id}.{image.vehicle_id}.{first}.{image.image_id}"


def take_image(
    db: sqlite3.Connection, image: ReconstructedImage, rate: int | None, now_utc_s: float, radius_m: float
) -> tuple[str, bool] | None:
    """Keep a version of a picture and bring its contact up to date.

    Args:
        db: In a transaction.
        image: The record.
        rate: Micro-Modem rate at which its vehicle was heard last; None where it is not known.
        now_utc_s: Time of arrival.
        radius_m: For grouping; see `review.grouping.reach_m`.

    Returns:
        The contact's identifier and whether it is new; None where this version was known already.
    """
    contact_id = contact_id_of(image)
    added = db.execute(
        "INSERT OR IGNORE INTO version VALUES (?, ?, ?, ?, ?)",
        (contact_id, image.version, now_utc_s, rate, wire.encode(image)),
    )
    if added.rowcount == 0:
        return None
    known = db.execute("SELECT version FROM contact WHERE id = ?", (contact_id,)).fetchone()
    if known is None or known["version"] <= image.version:
        _put(db, contact_id, image, now_utc_s)
        _group(db, contact_id, radius_m)
    db.execute("UPDATE contact SET versions = versions + 1 WHERE id = ?", (contact_id,))
    return contact_id, known is None


def _put(db: sqlite3.Connection, contact_id: str, image: ReconstructedImage, now_utc_s: float) -> None:
    """Write what the newest version says; what people said of the contact stays."""
    record = image.contact
    vehicle = None
    if record is not None:
        vehicle = vehicle_position(
            record.lat_deg, record.lon_deg, record.heading_deg, record.channel, record.ground_range_m
        )
    values: dict[str, object] = {
        "version": image.version,
        "atd_class": record and record.atd_class,
        "atd_confidence": record and record.atd_confidence,
        "lat_deg": record and record.lat_deg,
        "lon_deg": record and record.lon_deg,
        "position_sigma_m": record and record.position_sigma_m,
        "range_m": record and record.ground_range_m,
        "vehicle_lat_deg": vehicle and vehicle[0],
        "vehicle_lon_deg": vehicle and vehicle[1],
        "seen_utc_s": record and record.time_utc_s,
        "first_frame_utc_s": image.first_frame_utc_s,
        "last_frame_utc_s": image.last_frame_utc_s,
        "updated_utc_s": now_utc_s,
        "complete": int(image.complete),
        "percent": percent_of(image),
        "bytes_received": image.bytes_received,
        "bytes_total": image.bytes_total,
        "codec": image.codec,
        "has_picture": int(bool(image.codec)),
        "height_px": image.picture.height_px,
        "width_px": image.picture.width_px,
    }
    names = {
        "id": contact_id,
        "vessel_id": image.vessel_id,
        "vehicle_id": image.vehicle_id,
        "image_id": image.image_id,
        "first_s": int(image.first_frame_utc_s),
        "name": f"{image.vehicle_id}/{image.image_id}",
        "arrived_utc_s": now_utc_s,
    }
    columns = ", ".join((*names, *values))
    places = ", ".join("?" * (len(names) + len(values)))
    updates = ", ".join(f"{name} = excluded.{name}" for name in values)
    db.execute(
        f"INSERT INTO contact ({columns}) VALUES ({places}) ON CONFLICT (id) DO UPDATE SET {updates}",  # noqa: S608
        (*names.values(), *values.values()),
    )


def _group(db: sqlite3.Connection, contact_id: str, radius_m: float) -> None:
    """Put a contact whose position is known, and that has no group yet, into the nearest group or one of its own."""
    row = db.execute(
        "SELECT group_id, lat_deg, lon_deg, position_sigma_m, vehicle_id, seen_utc_s FROM contact WHERE id = ?",
        (contact_id,),
    ).fetchone()
    if row["group_id"] is not None or row["lat_deg"] is None or row["lon_deg"] is None:
        return
    look = Place("", *tuple(row)[1:])
    # Every group within reach lies in this band; degrees of longitude shrink towards the poles.
    reach_deg = 4.0 * radius_m / _METRES_PER_DEGREE
    near = db.execute(
        "SELECT 'g' || id, lat_deg, lon_deg, sigma_m, vehicle_id, seen_utc_s FROM look_group"
        " WHERE lat_deg BETWEEN ? AND ?",
        (look.lat_deg - reach_deg, look.lat_deg + reach_deg),
    )
    group = nearest_group(look, (Place(*place) for place in near), radius_m)
    if group is None:
        inserted = db.execute(
            "INSERT INTO look_group (lat_deg, lon_deg, sigma_m, vehicle_id, seen_utc_s) VALUES (?, ?, ?, ?, ?)",
            (look.lat_deg, look.lon_deg, look.sigma_m, look.vehicle_id, look.seen_utc_s),
        )
        group = f"g{inserted.lastrowid}"
    db.execute("UPDATE contact SET group_id = ? WHERE id = ?", (group, contact_id))


def list_contacts(db: sqlite3.Connection, wanted: Filter) -> Json:
    """Return a page of the contacts, with how many there are."""
    condition, values = wanted.where()
    order = "DESC" if wanted.descending else "ASC"
    column = SORTS[wanted.sort]
    # The page is found on the index first; what is counted for each row is counted for those alone.
    page = (
        f"SELECT c.id FROM contact c WHERE {condition} "  # noqa: S608  constants only
        f"ORDER BY c.{column} {order}, c.id {order} LIMIT ? OFFSET ?"
    )
    rows = db.execute(
        f"{CONTACT} WHERE c.id IN ({page}) ORDER BY c.{column} {order}, c.id {order}",
        (*values, wanted.limit, wanted.offset),
    ).fetchall()
    matching = db.execute(f"SELECT COUNT(*) FROM contact c WHERE {condition}", values).fetchone()[0]  # noqa: S608
    vehicles = [row[0] for row in db.execute("SELECT DISTINCT vehicle_id FROM contact ORDER BY vehicle_id")]
    return {
        **asdict(counts(db)),
        "matching": matching,
        "vehicles": vehicles,
        "offset": wanted.offset,
        "items": [contact_row(row) for row in rows],
    }


@dataclass(frozen=True, slots=True)
class Counts:
    """How many contacts there are, and how many nobody has decided on."""

    total: int
    unreviewed: int


def counts(db: sqlite3.Connection) -> Counts:
    """Count the contacts."""
    total = db.execute("SELECT COUNT(*) FROM contact").fetchone()[0]
    unreviewed = db.execute("SELECT COUNT(*) FROM contact WHERE review = 'unreviewed'").fetchone()[0]
    return Counts(total, unreviewed)


def find_row(db: sqlite3.Connection, contact_id: str) -> sqlite3.Row | None:
    """Return a contact's row for `contact_row`, None where there is no such contact."""
    row: sqlite3.Row | None = db.execute(f"{CONTACT} WHERE c.id = ?", (contact_id,)).fetchone()
    return row


def find_version(db: sqlite3.Connection, contact_id: str, version: int) -> sqlite3.Row | None:
    """Return a version's row, None where there is no such version."""
    row: sqlite3.Row | None = db.execute(
        "SELECT * FROM version WHERE contact_id = ? AND version = ?", (contact_id, version)
    ).fetchone()
    return row


def contact_of_picture(
    db: sqlite3.Connection, vessel_id: str, vehicle_id: str, image_id: str, utc_s: float
) -> str | None:
    """Return the contact that a record about a picture means: the last that had begun to arrive by then.

    With one candidate it is that one, whatever the clocks say; None where there is none.
    """
    rows = db.execute(
        "SELECT id, first_s FROM contact WHERE vessel_id = ? AND vehicle_id = ? AND image_id = ? ORDER BY first_s DESC",
        (vessel_id, vehicle_id, image_id),
    ).fetchall()
    if len(rows) == 1:
        return str(rows[0]["id"])
    return next((str(row["id"]) for row in rows if row["first_s"] <= utc_s), None)
