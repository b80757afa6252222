"""Contacts and their image versions in the database: insertion, queries, retention of the images."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from sonarpost import wire
from sonarpost.archive.retention import DAY_S, Stored, select_for_removal, vehicle_source
from sonarpost.errors import BadInputError
from sonarpost.export.contacts import contact_uid, match_start_time, side_car
from sonarpost.messages import Pixels, ReconstructedImage
from sonarpost.review.objects import AssociationRule
from sonarpost.review.positions import vehicle_position
from sonarpost.services.console.store.association import assign_objects
from sonarpost.services.console.store.database import UNDELIVERED, NotFoundError
from sonarpost.services.console.store.related_images import link_related_images
from sonarpost.services.console.store.serialisers import (
    CONTACT_QUERY,
    COUNTS,
    LISTED,
    NEWER_DETAIL,
    Json,
    contact_json,
    find_image,
    percent_received,
)

Sort = Literal["arrived", "updated", "confidence", "received", "name", "range"]
SORT_COLUMNS: Final[Mapping[Sort, str]] = {
    "arrived": "arrived_utc_s",
    "updated": "updated_utc_s",
    "confidence": "atd_confidence",
    "received": "percent",
    "name": "name",
    "range": "range_m",
}
_RECORD_COLUMNS: Final = (
    "atd_class",
    "atd_confidence",
    "lat_deg",
    "lon_deg",
    "position_sigma_m",
    "heading_deg",
    "length_m",
    "width_m",
    "height_m",
)
_PLACE_COLUMNS: Final = "group_id, parent, lat_deg, lon_deg, position_sigma_m, seen_utc_s, length_m, width_m, height_m"
_UNDELIVERED: Final = (
    f"FROM decision d WHERE {UNDELIVERED} AND {COUNTS} AND elsewhere = 0"  # noqa: S608
    f" AND seq = (SELECT MAX(seq) FROM decision WHERE contact_id = d.contact_id AND {COUNTS})"
)
"""SQL: the decisions of this console that count and are not delivered."""

REVIEW_CONDITIONS: Final[Mapping[str, str]] = {
    "mine_like": "c.review IN ('mine_like', 'disputed')",
    # The plus signs keep SQLite from an index on the state: most contacts may have it, and all would be sorted.
    "unreviewed": "+c.review = 'unreviewed'",
    "to_do": "(+c.review = 'unreviewed' OR +c.contradictory = 1)",
    "newer_detail": NEWER_DETAIL,
    "undelivered": f"c.id IN (SELECT d.contact_id {_UNDELIVERED})",
}
"""SQL conditions of values of `review`; any other value is one state."""


class ContactFilter(BaseModel):
    """Filter, order and page of a contact list, as in a query string; None or empty means no restriction.

    Attributes:
        review: State of the contact; `mine_like` includes disputed contacts. `to_do`: without a decision, disputed, or
            with contradictory verdicts on its object. `newer_detail`: decided on less than has arrived. `undelivered`:
            the verdict has not reached shore site or vehicle, or was refused.
        from_utc_s: Earliest arrival of the first frame, by the vessel's clock.
        to_utc_s: Arrival of the first frame before which contacts match.
        text: Part of a name, class or remark; `q` in a query string.
        find: Contact whose place in the filtered list is returned.
    """

    model_config = ConfigDict(frozen=True, populate_by_name=True, allow_inf_nan=False)

    review: (
        Literal[
            "to_do",
            "unreviewed",
            "mine_like",
            "not_mine_like",
            "unsure",
            "disputed",
            "newer_detail",
            "undelivered",
        ]
        | None
    ) = None
    vehicle: Annotated[str, Field(max_length=40)] = ""
    from_utc_s: Annotated[float, Field(ge=0)] | None = None
    to_utc_s: Annotated[float, Field(ge=0)] | None = None
    group: Annotated[str, Field(max_length=20)] = ""
    text: Annotated[str, Field(max_length=80, alias="q")] = ""
    find: Annotated[str, Field(max_length=200)] = ""
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
            ("c.group_id = ?", self.group or None),
            ("c.first_frame_utc_s >= ?", self.from_utc_s),
            ("c.first_frame_utc_s < ?", self.to_utc_s),
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


@dataclass(frozen=True, slots=True)
class ContactCounts:
    """Number of contacts in lists.

    Attributes:
        total: All contacts.
        to_do: Contacts without a decision, disputed, or with contradictory verdicts on their object.
        undelivered: Contacts whose verdict has not reached shore site or vehicle.
        refused: Those of them whose verdict was refused, or has expired.
        authenticated: True if acoustic frames of a contact were authenticated: others without it stand out. False if
            those of no contact were, and not those of the last one; None if it is not known.
    """

    total: int
    to_do: int
    undelivered: int
    refused: int
    authenticated: bool | None


def store_image(
    db: sqlite3.Connection, image: ReconstructedImage, rate: int | None, now_utc_s: float, rule: AssociationRule
) -> tuple[str, bool] | None:
    """Store an image version, update its contact, and assign the contact to an object.

    Args:
        db: Connection in a transaction.
        image: The record.
        rate: Number of the latest rate of the vehicle; None if unknown.
        now_utc_s: Time of arrival.
        rule: Limits of the association of looks.

    Returns:
        The contact's identifier, and whether the contact is new; None if the version is already stored.
    """
    contact_id = contact_uid(image)
    added = db.execute(
        "INSERT OR IGNORE INTO version (contact_id, version, received_utc_s, rate, payload) VALUES (?, ?, ?, ?, ?)",
        (contact_id, image.version, now_utc_s, rate, wire.encode(image)),
    )
    if added.rowcount == 0:
        return None
    known = db.execute(f"SELECT version, {_PLACE_COLUMNS} FROM contact WHERE id = ?", (contact_id,)).fetchone()  # noqa: S608
    if known is None or known["version"] <= image.version:
        _update_contact(db, contact_id, image, now_utc_s)
        link_related_images(db, contact_id, image)
        place = db.execute(f"SELECT {_PLACE_COLUMNS} FROM contact WHERE id = ?", (contact_id,)).fetchone()  # noqa: S608
        if known is None or tuple(known)[1:] != tuple(place):
            assign_objects(db, [contact_id], rule)
    return contact_id, known is None


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
        **{name: getattr(image, name) for name in ("version", "first_frame_utc_s", "bytes_received")},
        "image": json.dumps({**side_car(image), "missing_runs": ""}),
        "range_m": record and record.ground_range_m,
        "vehicle_lat_deg": vehicle and vehicle[0],
        "vehicle_lon_deg": vehicle and vehicle[1],
        "seen_utc_s": record and record.time_utc_s,
        "updated_utc_s": now_utc_s,
        "complete": int(image.complete),
        "percent": percent_received(image),
        "has_image": int(bool(image.codec)),
        "height_px": image.pixels.height_px,
        "width_px": image.pixels.width_px,
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
    index = None
    if query.find:
        places = f"SELECT c.id, ROW_NUMBER() OVER ({order}) - 1 AS place FROM contact c WHERE {condition}"  # noqa: S608
        found = db.execute(f"SELECT place FROM ({places}) WHERE id = ?", (*values, query.find)).fetchone()  # noqa: S608
        index = None if found is None else found["place"]
    vehicles = [row[0] for row in db.execute("SELECT DISTINCT vehicle_id FROM contact ORDER BY vehicle_id")]
    return {
        **asdict(count_contacts(db)),
        "matching": matching,
        "index": index,
        "vehicles": vehicles,
        "offset": query.offset,
        "items": items,
    }


def list_versions(db: sqlite3.Connection, query: ContactFilter) -> list[tuple[str, int]]:
    """Return identifier and newest version of the filtered contacts, by the time of their first frame."""
    condition, values = query.where()
    order = "ORDER BY c.first_frame_utc_s, c.id"
    # A sealed contact is listed like all others until its decision can no longer be taken back.
    listed = "(c.sealed = 0 OR c.review = 'unreviewed' OR c.id IN (SELECT contact_id FROM decision WHERE sent = 0))"
    sql = f"SELECT c.id, c.version FROM contact c WHERE {listed} AND {condition} {order}"  # noqa: S608
    rows = db.execute(sql, values)
    return [(str(row["id"]), int(row["version"])) for row in rows]


def count_contacts(db: sqlite3.Connection) -> ContactCounts:
    """Count the contacts in lists."""
    total = db.execute(f"SELECT COUNT(*) FROM contact c WHERE {LISTED}").fetchone()[0]  # noqa: S608  constants only
    sql = f"SELECT COUNT(*) FROM contact c WHERE {LISTED} AND {REVIEW_CONDITIONS['to_do']}"  # noqa: S608
    to_do = db.execute(sql).fetchone()[0]
    undelivered, refused = db.execute(
        "SELECT COUNT(*), COUNT(*) FILTER (WHERE shore = 'refused' OR vehicle IN ('refused', 'expired'))"  # noqa: S608
        f" {_UNDELIVERED} AND EXISTS (SELECT 1 FROM contact c WHERE c.id = d.contact_id AND {LISTED})"
    ).fetchone()
    one = db.execute("SELECT authenticated FROM contact WHERE authenticated = 1 LIMIT 1").fetchone()
    last = db.execute("SELECT authenticated FROM contact ORDER BY arrived_utc_s DESC LIMIT 1").fetchone()
    [authenticated] = one or last or [None]
    return ContactCounts(total, to_do, undelivered, refused, None if authenticated is None else bool(authenticated))


def find_contact(db: sqlite3.Connection, contact_id: str) -> sqlite3.Row:
    """Return the row of a contact, for `contact_json`.

    Raises:
        NotFoundError: There is no such contact.
    """
    row: sqlite3.Row | None = db.execute(f"{CONTACT_QUERY} WHERE c.id = ?", (contact_id,)).fetchone()
    if row is None:
        raise NotFoundError("contact", "id", contact_id, "a contact")
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


MAX_IMAGES_AT_ONCE: Final = 200
"""Images removed in one transaction; requests wait for it."""
_SIDE_PX: Final = 16
_NOTE: Final = "image removed by retention"


def remove_images(db: sqlite3.Connection, now_utc_s: float, retain_days: float, max_bytes: int) -> int:
    """Remove the pixels of image versions by age and total size; contacts, decisions and the audit stay.

    Because of the total size, the vehicle with the most bytes loses versions first, with several vessels the vessel:
    superseded versions before the newest ones, in both groups those of contacts without a decision before the others.

    Args:
        db: Connection in a transaction.
        now_utc_s: Current time.
        retain_days: Time after the arrival of a version.
        max_bytes: Maximum size of the stored versions.

    Returns:
        Number of versions whose pixels were removed, at most `MAX_IMAGES_AT_ONCE`.
    """
    total_bytes, oldest_utc_s = db.execute(
        "SELECT COALESCE(SUM(LENGTH(payload)), 0), MIN(received_utc_s) FROM version WHERE removed = 0"
    ).fetchone()
    if oldest_utc_s is None or (now_utc_s - oldest_utc_s <= retain_days * DAY_S and total_bytes <= max_bytes):
        return 0
    rows = db.execute(
        "SELECT v.contact_id, v.version, v.received_utc_s, LENGTH(v.payload),"
        " 2 * (v.version = c.version) + (c.review <> 'unreviewed'),"
        " CASE WHEN (SELECT COUNT(DISTINCT vessel_id) FROM contact) > 1 THEN c.vessel_id ELSE c.vehicle_id END"
        " FROM version v JOIN contact c ON c.id = v.contact_id WHERE v.removed = 0"
    )
    stored = [Stored((str(row[0]), int(row[1])), row[2], row[3], row[4], vehicle_source(row[5])) for row in rows]
    selected = select_for_removal(stored, now_utc_s, retain_days, max_bytes)[:MAX_IMAGES_AT_ONCE]
    for key in selected:
        try:
            payload = wire.encode(without_pixels(find_image(db, *key)))
        except BadInputError:
            payload = b""  # it cannot be shown either
        db.execute("UPDATE version SET payload = ?, removed = 1 WHERE contact_id = ? AND version = ?", (payload, *key))
        db.execute("UPDATE contact SET has_image = 0 WHERE id = ? AND version = ?", key)
    return len(selected)


def without_pixels(image: ReconstructedImage) -> ReconstructedImage:
    """Return the record as if only the contact record had arrived."""
    black = Pixels.from_array(np.zeros((_SIDE_PX, _SIDE_PX), dtype=np.uint8))
    changes = {
        "pixels": black,
        "pixels_sha256": black.sha256,
        "codec": "",
        "model": "",
        "missing_mask": np.packbits(np.ones((_SIDE_PX, _SIDE_PX), dtype=np.bool_)).tobytes(),
        "missing_fraction": 1.0,
        "missing_halves": ("top", "bottom"),
        "complete": False,
        "notes": (*image.notes, _NOTE),
    }
    return image.model_copy(update=changes)
