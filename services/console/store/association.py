"""Objects in the database: assigns looks to objects, and keeps the states that depend on all looks of an object."""

from __future__ import annotations

import math
import sqlite3
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from sonarpost.limits import limit
from sonarpost.review.objects import (
    AssociationRule,
    Look,
    Pair,
    associate,
    looks_within_gate,
    ordered_pair,
    possible_partners,
)
from sonarpost.review.positions import distance_m
from sonarpost.services.console.store.database import (
    CONTRADICTORY,
    LATITUDE_BAND,
    LATITUDE_BANDS_PER_DEGREE,
    insert_row,
)
from sonarpost.services.console.store.serialisers import decode_image

_SURFACE: Final = "contacts of the console"
MAX_LOOKS: Final = limit(50, "looks", "claims", _SURFACE, "vehicle", "associated again", "the nearest ones")
"""Maximum number of looks that are associated again when one arrives. In a larger area whose looks are all connected
by their gates, existing objects stay as they are, and the look joins the nearest one with less than four times as
many."""
MAX_NEAR: Final = limit(50, "looks", "shares", _SURFACE, "vehicle", "compared", "the nearest ones are compared")

MAX_EARLIER: Final = 20
"""Maximum number of earlier contacts at a place."""

_METRES_PER_DEGREE: Final = 111_000.0
_LOOK: Final = "id, lat_deg, lon_deg, position_sigma_m, vehicle_id, seen_utc_s, length_m, width_m, height_m"
IS_LOOK: Final = "parent IS NULL AND sealed < 2"
"""Condition of the contacts that are looks: those in lists."""
_IS_ASSOCIATED: Final = "parent IS NULL AND sealed = 0"
"""Condition of the looks that are associated with others; a sealed contact is an object of its own."""


def find_look(db: sqlite3.Connection, contact_id: str, among: str = _IS_ASSOCIATED) -> Look | None:
    """Return a contact as a look; None without a position, or if a condition excludes it."""
    condition = f"id = ? AND {among} AND lat_deg IS NOT NULL AND lon_deg IS NOT NULL"
    row = db.execute(f"SELECT {_LOOK} FROM contact WHERE {condition}", (contact_id,)).fetchone()  # noqa: S608
    return None if row is None else Look(*row)


def looks_of_object(db: sqlite3.Connection, object_id: str) -> list[Look]:
    """Return the looks of an object, by contact identifier."""
    sql = f"SELECT {_LOOK} FROM contact WHERE group_id = ? AND {IS_LOOK} ORDER BY id"  # noqa: S608  constants only
    return [Look(*row) for row in db.execute(sql, (object_id,))]


def object_of(db: sqlite3.Connection, contact_id: str) -> str:
    """Return the object of a contact; empty if it has none."""
    row = db.execute("SELECT group_id FROM contact WHERE id = ?", (contact_id,)).fetchone()
    return "" if row is None or row[0] is None else str(row[0])


def looks_near(db: sqlite3.Connection, look: Look, limit_m: float, among: str = _IS_ASSOCIATED) -> list[Look]:
    """Return the other looks in a square around a look, at most the `MAX_NEAR` nearest ones of each vehicle.

    They are found with the index on bands of latitude and on longitude.
    """
    lat_limit = limit_m / _METRES_PER_DEGREE
    lon_limit = min(360.0, lat_limit / max(math.cos(math.radians(look.lat_deg)), 1e-6))
    first = math.floor((look.lat_deg - lat_limit) * LATITUDE_BANDS_PER_DEGREE)
    last = math.ceil((look.lat_deg + lat_limit) * LATITUDE_BANDS_PER_DEGREE)
    sql = (
        f"SELECT {_LOOK}, ROW_NUMBER() OVER (PARTITION BY vehicle_id ORDER BY"  # noqa: S608  constants only
        " ABS(lat_deg - ?) / ? + ABS(lon_deg - ?) / ?, id) AS place FROM contact"
        f" WHERE {LATITUDE_BAND} = ? AND lon_deg BETWEEN ? AND ? AND lat_deg BETWEEN ? AND ? AND id <> ? AND {among}"
    )
    sql = f"SELECT {_LOOK} FROM ({sql}) WHERE place <= {MAX_NEAR}"  # noqa: S608  constants only
    lat_range = (look.lat_deg - lat_limit, look.lat_deg + lat_limit)
    found: dict[str, Look] = {}
    for band in range(first, last + 1):
        for turn_deg in (-360.0, 0.0, 360.0):  # the square may cross the 180th meridian
            lon_deg = look.lon_deg + turn_deg
            lon_range = (lon_deg - lon_limit, lon_deg + lon_limit)
            if lon_range[0] <= 180.0 and lon_range[1] >= -180.0:
                place = (look.lat_deg, lat_limit, lon_deg, lon_limit)
                for row in db.execute(sql, (*place, band, *lon_range, *lat_range, look.contact_id)):
                    found[row["id"]] = Look(*row)
    return list(found.values())


def earlier_contacts(db: sqlite3.Connection, contact_id: str, rule: AssociationRule) -> list[str]:
    """Return contacts of earlier missions at the place of a contact, newest first, at most `MAX_EARLIER`."""
    look = find_look(db, contact_id, IS_LOOK)
    if look is None or look.seen_utc_s is None:
        return []
    limit_utc_s = look.seen_utc_s - rule.mission_gap_s
    near = looks_near(db, look, rule.search_m, IS_LOOK)
    known = [one for one in near if (one.seen_utc_s or math.inf) < limit_utc_s]
    found = looks_within_gate(look, known, rule)
    found.sort(key=lambda one: (-(one.seen_utc_s or 0.0), one.contact_id))
    return [one.contact_id for one in found[:MAX_EARLIER]]


def assign_objects(db: sqlite3.Connection, contact_ids: Iterable[str], rule: AssociationRule) -> None:
    """Associate contacts, and the looks connected with them, again.

    Args:
        db: Connection in a transaction.
        contact_ids: Contacts that are new or have changed. Without a position, a contact has no object.
        rule: Limits of the association.
    """
    seeds = sorted(set(contact_ids))
    # A look that has moved leaves looks behind whose object changes too.
    former: list[str] = []
    for seed in seeds:
        former += [look.contact_id for look in looks_of_object(db, object_of(db, seed))]
    looks, is_complete = _connected_looks(db, [*seeds, *former], rule)
    if not looks:
        return
    objects = {contact_id: object_of(db, contact_id) for contact_id in looks}
    together = _pairs(db, looks, joined=True)
    if not is_complete:
        for object_id in sorted(set(objects.values()) - {""}):
            whole = {look.contact_id: look for look in looks_of_object(db, object_id)}
            if len(whole) < 4 * MAX_LOOKS or not whole.keys().isdisjoint(seeds):
                looks |= whole
                objects |= dict.fromkeys(whole, object_id)
            else:
                looks = {name: look for name, look in looks.items() if name not in whole}
        together |= _pairs_of_objects({name: known for name, known in objects.items() if name not in seeds})
    found = associate(list(looks.values()), rule, together, _pairs(db, looks, joined=False))
    _store_objects(db, found, objects)


def _pairs_of_objects(objects: Mapping[str, str]) -> set[Pair]:
    """Return pairs that connect the looks of each object."""
    first: dict[str, str] = {}
    pairs: set[Pair] = set()
    for contact_id, object_id in sorted(objects.items()):
        if object_id and first.setdefault(object_id, contact_id) != contact_id:
            pairs.add(ordered_pair(first[object_id], contact_id))
    return pairs


def _store_objects(db: sqlite3.Connection, clusters: Sequence[tuple[str, ...]], before: Mapping[str, str]) -> None:
    """Store the objects of looks.

    An object keeps its identifier as long as most of its looks stay together.

    Args:
        db: Connection in a transaction.
        clusters: Contact identifiers of each object.
        before: Their previous object; empty without one.
    """
    claims: list[tuple[int, int, str, int]] = []
    for index, cluster in enumerate(clusters):
        for object_id, count in Counter(before[contact_id] for contact_id in cluster if before[contact_id]).items():
            claims.append((-count, int(object_id[1:]), object_id, index))
    names: dict[int, str] = {}
    for _, _, object_id, index in sorted(claims):
        if index not in names and object_id not in names.values():
            names[index] = object_id
    touched: set[str] = set()
    for index, cluster in enumerate(clusters):
        name = names.get(index) or f"g{insert_row(db, 'object', {'id': None})}"
        moved = [contact_id for contact_id in cluster if before[contact_id] != name]
        if moved:
            touched |= {name, *(before[contact_id] for contact_id in moved)} - {""}
            db.executemany("UPDATE contact SET group_id = ? WHERE id = ?", [(name, one) for one in moved])
    for object_id in sorted(touched):
        for look in looks_of_object(db, object_id)[:1]:
            _update_contradiction(db, look.contact_id)


def _update_contradiction(db: sqlite3.Connection, contact_id: str) -> None:
    """Mark all looks of a contact's object if verdicts on them contradict each other."""
    looks = "(g.id = :id OR g.group_id = (SELECT group_id FROM contact WHERE id = :id))"
    sql = f"SELECT {CONTRADICTORY} FROM contact g WHERE g.sealed < 2 AND {looks}"  # noqa: S608  constants only
    values = {"id": contact_id, "contradictory": db.execute(sql, {"id": contact_id}).fetchone()[0]}
    sql = f"UPDATE contact AS g SET contradictory = :contradictory WHERE {looks} AND contradictory <> :contradictory"  # noqa: S608
    db.execute(sql, values)


def update_decided_on(db: sqlite3.Connection, contact_id: str) -> None:
    """Update what a contact's decision was made on, and whether the verdicts of its object contradict each other."""
    row = db.execute(
        "SELECT d.version, v.contact_id, v.payload FROM contact c LEFT JOIN decision d ON d.decision_id = c.effective"
        " LEFT JOIN version v ON v.contact_id = c.id AND v.version = d.version WHERE c.id = ?",
        (contact_id,),
    ).fetchone()
    # At a shore site the version of the decision may be missing.
    received = None if row["payload"] is None else decode_image(row).bytes_received
    db.execute(
        "UPDATE contact SET decided_version = ?, decided_bytes = ? WHERE id = ?", (row["version"], received, contact_id)
    )
    _update_contradiction(db, contact_id)


def isolate_look(db: sqlite3.Connection, contact_id: str) -> None:
    """Make a new contact an object of its own, if it is not: a number of an object that is left out would show it."""
    if len(looks_of_object(db, object_of(db, contact_id))) > 1:
        object_id = f"g{insert_row(db, 'object', {'id': None})}"
        db.execute("UPDATE contact SET group_id = ? WHERE id = ?", (object_id, contact_id))


def store_pair(db: sqlite3.Connection, one: str, other: str, *, joined: bool) -> None:
    """Store that a person joined two looks, or separated them."""
    db.execute("INSERT OR REPLACE INTO look_pair (a, b, joined) VALUES (?, ?, ?)", (*ordered_pair(one, other), joined))


def _connected_looks(
    db: sqlite3.Connection, contact_ids: Sequence[str], rule: AssociationRule
) -> tuple[dict[str, Look], bool]:
    """Return the looks that are connected with contacts by gates or by a person, and whether these are all."""
    looks: dict[str, Look] = {}
    waiting = list(dict.fromkeys(contact_ids))
    for contact_id in waiting:  # `waiting` grows
        if contact_id in looks:
            continue
        look = find_look(db, contact_id)
        if look is None:
            continue
        looks[contact_id] = look
        if len(looks) > MAX_LOOKS:
            return looks, False
        partners = possible_partners(look, looks_near(db, look, rule.search_m), rule)
        if len({*looks, *(one.contact_id for one in partners)}) > MAX_LOOKS:
            lat_deg, lon_deg = look.lat_deg, look.lon_deg
            apart_m = {one: distance_m(lat_deg, lon_deg, one.lat_deg, one.lon_deg) for one in partners}
            nearest = sorted(partners, key=apart_m.__getitem__)[:MAX_LOOKS]
            return looks | {one.contact_id: one for one in nearest}, False
        waiting += [partner.contact_id for partner in partners if partner.contact_id not in looks]
        waiting += [other for other in _joined(db, contact_id) if other not in looks]
    return looks, True


def _joined(db: sqlite3.Connection, contact_id: str) -> list[str]:
    rows = db.execute(
        "SELECT b FROM look_pair WHERE a = ? AND joined = 1 UNION SELECT a FROM look_pair WHERE b = ? AND joined = 1",
        (contact_id, contact_id),
    )
    return [str(row[0]) for row in rows]


def _pairs(db: sqlite3.Connection, contact_ids: Iterable[str], *, joined: bool) -> set[Pair]:
    """Return the pairs of contacts that a person joined or separated."""
    found: set[Pair] = set()
    for contact_id in contact_ids:
        rows = db.execute("SELECT a, b FROM look_pair WHERE a = ? AND joined = ?", (contact_id, int(joined)))
        found.update((str(a), str(b)) for a, b in rows)
    return found
