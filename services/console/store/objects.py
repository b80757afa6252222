"""Objects with all their looks: data for the page, one verdict for all looks, and changes by a person."""

from __future__ import annotations

import math
import sqlite3
import uuid
from collections.abc import Mapping, Sequence
from itertools import product
from statistics import fmean, stdev
from typing import Final

from sonarpost.errors import BadInputError
from sonarpost.messages import Contact
from sonarpost.review.objects import AssociationRule, Look, fuse_positions, looks_within_gate
from sonarpost.review.positions import LocalFrame, destination, distance_m
from sonarpost.services.console.store.association import (
    IS_LOOK,
    assign_objects,
    looks_near,
    looks_of_object,
    object_of,
    store_pair,
)
from sonarpost.services.console.store.contacts import find_contact
from sonarpost.services.console.store.database import Actor, DisplayedImage, NotFoundError, add_audit_entry
from sonarpost.services.console.store.decisions import (
    DecisionInput,
    DeliveryStates,
    StoredDecision,
    add_decision,
    standing_decisions,
    undo_decision,
)
from sonarpost.services.console.store.serialisers import Json, contact_json, find_image

MAX_OBJECT_LOOKS: Final = 50
"""Maximum number of looks of an object that a person joins, that is displayed, and that one verdict decides."""


def aspect_deg(record: Contact) -> float | None:
    """Return the true bearing from an object to the vehicle that recorded it; None if heading or side are unknown."""
    if record.heading_deg is None or record.channel is None:
        return None
    # An object to starboard sees the vehicle on the opposite bearing, to port of the heading.
    return (record.heading_deg + (-90.0 if record.channel == "starboard" else 90.0)) % 360.0


def object_json(db: sqlite3.Connection, object_id: str, rule: AssociationRule) -> Json:
    """Return an object with its looks, ordered by aspect.

    Raises:
        NotFoundError: There is no such object.
    """
    looks = _looks(db, object_id)
    items = [_look_json(db, look) for look in looks[:MAX_OBJECT_LOOKS]]
    items.sort(key=lambda item: (item["aspect_deg"] is None, item["aspect_deg"], item["seen_utc_s"] or 0.0))
    frame = LocalFrame(looks[0].lat_deg, looks[0].lon_deg)
    points = frame.to_local([look.lat_deg for look in looks], [look.lon_deg for look in looks])
    fused = fuse_positions(looks, points, rule)
    bearing_deg = math.degrees(math.atan2(fused.x_m, fused.y_m))
    lat_deg, lon_deg = destination(frame.lat_deg, frame.lon_deg, bearing_deg, math.hypot(fused.x_m, fused.y_m))
    sized = [(look.length_m, look.width_m) for look in looks if look.length_m is not None and look.width_m is not None]
    return {
        "id": object_id,
        "number_of_looks": len(looks),
        "looks": items,
        "lat_deg": lat_deg,
        "lon_deg": lon_deg,
        # The scatter of the looks widens a standard deviation that is too small to explain it.
        "position_sigma_m": None if fused.sigma_m is None else fused.sigma_m * fused.scatter,
        "vehicles": sorted({look.vehicle_id for look in looks}),
        "length_m": _extent_json([max(pair) for pair in sized]),
        "width_m": _extent_json([min(pair) for pair in sized]),
        "height_m": _extent_json([look.height_m for look in looks if look.height_m is not None]),
        "contradictory": any(item["contact"]["contradictory"] for item in items),
        "nearby": [
            {"contact": contact_json(find_contact(db, contact_id)), "distance_m": apart_m}
            for apart_m, contact_id in sorted(_near_objects(db, looks, rule).values())
        ],
    }


def _looks(db: sqlite3.Connection, object_id: str) -> list[Look]:
    looks = looks_of_object(db, object_id)
    if not looks:
        raise NotFoundError("object", "id", object_id, "an object")
    return looks


def _look_json(db: sqlite3.Connection, look: Look) -> Json:
    row = find_contact(db, look.contact_id)
    image = find_image(db, look.contact_id)
    record = image.contact
    names = ("heading_deg", "channel", "pixel_along_m", "pixel_across_m")
    return {
        "contact": contact_json(row),
        "sha256": image.pixels_sha256,
        "has_missing": image.missing_fraction > 0,
        "seen_utc_s": look.seen_utc_s,
        "aspect_deg": None if record is None else aspect_deg(record),
        **{name: getattr(record, name, None) for name in names},
    }


def _extent_json(values_m: Sequence[float]) -> Json | None:
    """Return the mean of an extent, with the standard deviation of the mean; None without a value."""
    if not values_m:
        return None
    sigma_m = stdev(values_m) / math.sqrt(len(values_m)) if len(values_m) > 1 else None
    return {"value": fmean(values_m), "sigma": sigma_m, "looks": len(values_m)}


def _near_objects(db: sqlite3.Connection, looks: Sequence[Look], rule: AssociationRule) -> dict[str, tuple[float, str]]:
    """Return distance in metres and contact of the nearest look of each other object within the association gate."""
    found: dict[str, tuple[float, str]] = {}
    for look in looks:
        for other in looks_within_gate(look, looks_near(db, look, rule.search_m, IS_LOOK), rule):
            apart_m = distance_m(look.lat_deg, look.lon_deg, other.lat_deg, other.lon_deg)
            name = object_of(db, other.contact_id)
            found[name] = min(found.get(name, (math.inf, "")), (apart_m, other.contact_id))
    found.pop(object_of(db, looks[0].contact_id), None)
    return found


def split_look(
    db: sqlite3.Connection, object_id: str, contact_id: str, rule: AssociationRule, actor: Actor, now_utc_s: float
) -> None:
    """Separate a look from the other looks of its object for good.

    Raises:
        NotFoundError: There is no such object.
        BadInputError: The contact is not a look of this object, or its only one.
    """
    others = {look.contact_id for look in _looks(db, object_id)} - {contact_id}
    if object_of(db, contact_id) != object_id or not others:
        raise BadInputError("split", "contact", contact_id, f"one of several looks of object {object_id}")
    for other in others:
        store_pair(db, contact_id, other, joined=False)
    db.execute("UPDATE contact SET group_id = NULL WHERE id = ?", (contact_id,))
    assign_objects(db, [contact_id, *others], rule)
    detail: Json = {"object": object_id, "looks": sorted(others), "new_object": object_of(db, contact_id)}
    add_audit_entry(db, contact_id, actor, "split", now_utc_s, DisplayedImage(), detail)


def merge_objects(
    db: sqlite3.Connection, object_id: str, contact_id: str, rule: AssociationRule, actor: Actor, now_utc_s: float
) -> None:
    """Join the object of a contact with an object for good.

    Raises:
        NotFoundError: There is no such object or contact.
        BadInputError: No position of the contact's object agrees with one of the object, or it has too many looks.
    """
    ones = _looks(db, object_id)
    other_id = object_of(db, str(find_contact(db, contact_id)["id"]))
    if other_id not in _near_objects(db, ones, rule):
        raise BadInputError("merge", "contact", contact_id, "a contact of another object within the association gate")
    others = _looks(db, other_id)
    if len(ones) + len(others) > MAX_OBJECT_LOOKS:
        raise BadInputError("merge", "contact", contact_id, f"at most {MAX_OBJECT_LOOKS} looks together")
    for one, other in product(ones, others):
        store_pair(db, one.contact_id, other.contact_id, joined=True)
    assign_objects(db, [look.contact_id for look in (*ones, *others)], rule)
    detail: Json = {"object": object_id, "merged_object": other_id, "looks": sorted(o.contact_id for o in others)}
    add_audit_entry(db, contact_id, actor, "merge", now_utc_s, DisplayedImage(), detail)


def decide_object(
    db: sqlite3.Connection,
    object_id: str,
    entered: Mapping[str, DecisionInput],
    actor: Actor,
    now_utc_s: float,
    delivery: DeliveryStates,
) -> list[StoredDecision]:
    """Store one verdict as a decision on each of several looks; return the decisions.

    The decisions have a common `batch`, so that one undo withdraws all of them.

    Args:
        db: Connection in a transaction.
        object_id: The object.
        entered: Contact -> decision, with the image that was displayed.
        actor: The operator.
        now_utc_s: Time of the decision.
        delivery: Initial delivery of the decisions.

    Raises:
        NotFoundError: There is no such object.
        BadInputError: A contact is not a look of the object, or a displayed image is not a version of its contact.
    """
    known = {look.contact_id for look in _looks(db, object_id)}
    stored: list[StoredDecision] = []
    for contact_id, decision in entered.items():
        if contact_id not in known:
            raise BadInputError("decision", "looks", contact_id, f"a look of object {object_id}")
        stored.append(add_decision(db, contact_id, decision, actor, now_utc_s, delivery))
    batch = f"b-{uuid.uuid4().hex}"
    db.executemany("UPDATE decision SET batch = ? WHERE decision_id = ?", [(batch, one.decision_id) for one in stored])
    return stored


def undo_rest(
    db: sqlite3.Connection, decision_id: str, actor: Actor, now_utc_s: float, delivery: DeliveryStates
) -> None:
    """Withdraw the other decisions that were made with a decision and still stand."""
    rows = db.execute(
        "SELECT o.contact_id, o.decision_id FROM decision d"
        " JOIN decision o ON o.batch = d.batch WHERE d.decision_id = ? AND o.decision_id <> ? ORDER BY o.seq",
        (decision_id, decision_id),
    ).fetchall()
    for contact_id, other_id in rows:
        if other_id in standing_decisions(db, contact_id):
            # No image of this contact is displayed during the undo.
            undo_decision(db, contact_id, other_id, DisplayedImage(), actor, now_utc_s, delivery)
