"""Known objects of contacts: all contacts of training, and sealed contacts of the calibrated watch.

The table `truth` states what a contact shows. The page receives it after a decision, when the operator can no longer
take the decision back. The score counts the first decision of each operator on each contact that is not withdrawn, if
the operator made it before the page received the object.

The column `contact.sealed` is 1 for a sealed contact, and 2 after its object was revealed: then lists omit it.
"""

from __future__ import annotations

import sqlite3
import statistics
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass
from typing import Final

from sonarpost.review.scoring import ScoredDecision, score, score_by_bytes
from sonarpost.services.console.store.association import isolate_look
from sonarpost.services.console.store.database import insert_row
from sonarpost.services.console.store.serialisers import Json

MAX_LISTED: Final = 500
"""Contacts in the list of a score sheet: the most recently decided ones."""

_SCORED: Final = """
SELECT d.contact_id, d.operator, d.verdict, d.shown_s, d.decided_utc_s, d.bytes_received, c.name, t.is_mine_like,
    t.label, MIN(d.seq)
FROM truth t JOIN decision d ON d.contact_id = t.contact_id JOIN contact c ON c.id = d.contact_id
WHERE d.undoes IS NULL AND NOT d.undone AND d.decided_utc_s <= ?
    AND d.decided_utc_s <= COALESCE(t.revealed_utc_s, d.decided_utc_s)
GROUP BY d.contact_id, d.operator ORDER BY d.decided_utc_s DESC
"""


@dataclass(frozen=True, slots=True)
class Truth:
    """What a contact shows.

    Attributes:
        is_mine_like: Whether the object is mine-like.
        label: Name of the object, for example "cylinder".
        sealed: Whether the contact was added by the calibrated watch.
    """

    is_mine_like: bool
    label: str
    sealed: bool


def add_truth(db: sqlite3.Connection, contact_id: str, truth: Truth, now_utc_s: float) -> None:
    """Store the object of a contact; a known one is not changed."""
    if db.execute("SELECT 1 FROM truth WHERE contact_id = ?", (contact_id,)).fetchone() is None:
        insert_row(db, "truth", {"contact_id": contact_id, **asdict(truth), "added_utc_s": now_utc_s})
        if truth.sealed:
            # A sealed contact is no look at an object of the survey.
            db.execute("UPDATE contact SET sealed = 1 WHERE id = ?", (contact_id,))
            isolate_look(db, contact_id)


def withhold_sealed(db: sqlite3.Connection) -> None:
    """Mark the released decisions and the requests about sealed contacts as sent: none of them is ever queued."""
    unsent = "sent = 0 AND contact_id IN (SELECT contact_id FROM truth WHERE sealed)"
    db.execute(
        "UPDATE decision SET sent = 1, shore = iif(shore = 'waiting', 'none', shore),"  # noqa: S608  constants only
        f" vehicle = iif(vehicle = 'waiting', 'none', vehicle) WHERE send_after_utc_s IS NULL AND {unsent}"
    )
    db.execute(f"UPDATE request SET sent = 1 WHERE {unsent}")  # noqa: S608  constants only


def truth_json(db: sqlite3.Connection, contact_id: str) -> Json | None:
    """Return the object of a contact; None before a decision that can no longer be taken back."""
    sql = "SELECT * FROM truth WHERE contact_id = ? AND revealed_utc_s IS NOT NULL"
    row = db.execute(sql, (contact_id,)).fetchone()
    if row is None:
        return None
    return {"is_mine_like": bool(row["is_mine_like"]), "label": row["label"], "sealed": bool(row["sealed"])}


def has_unrevealed(db: sqlite3.Connection) -> bool:
    """Return whether a contact with a decision has an object that was not published."""
    sql = "SELECT 1 FROM truth t JOIN decision d USING (contact_id) WHERE t.revealed_utc_s IS NULL LIMIT 1"
    return db.execute(sql).fetchone() is not None


def reveal(db: sqlite3.Connection, now_utc_s: float, take_back_s: float) -> None:
    """Mark the objects that may be shown since the last call."""
    sql = f"SELECT * FROM ({_SCORED}) WHERE contact_id IN (SELECT contact_id FROM truth WHERE revealed_utc_s IS NULL)"  # noqa: S608
    rows = db.execute(sql, (now_utc_s - take_back_s,)).fetchall()
    reveals = [(now_utc_s, row["contact_id"]) for row in rows]
    db.executemany("UPDATE truth SET revealed_utc_s = ? WHERE contact_id = ? AND revealed_utc_s IS NULL", reveals)
    db.executemany("UPDATE contact SET sealed = 2 WHERE sealed = 1 AND id = ?", [(row["contact_id"],) for row in rows])


def score_sheet(db: sqlite3.Connection, operator: str | None, now_utc_s: float, take_back_s: float) -> Json:
    """Return the scores of all operators, or of one, and the decisions of all operators on all contacts.

    A withdrawn decision does not count.

    Args:
        db: Connection for reading.
        operator: Name of the operator; None for all.
        now_utc_s: Current time.
        take_back_s: Time in which an operator can take a decision back.
    """
    rows = db.execute(_SCORED, (now_utc_s - take_back_s,)).fetchall()
    if operator is not None:
        rows = [row for row in rows if row["operator"] == operator]
    operators: list[Json] = []
    for name in sorted({row["operator"] for row in rows}):
        decisions = [_scored(row) for row in rows if row["operator"] == name]
        groups = [
            {"above_bytes": low, "up_to_bytes": high, **asdict(one)} for low, high, one in score_by_bytes(decisions)
        ]
        operators.append({"operator": name, **asdict(score(decisions)), "by_bytes": groups})
    return {
        "operators": operators,
        "decisions": [_decided_json(row) for row in rows[:MAX_LISTED]],
        "watch": _decisions_by_operator(db),
    }


def _decisions_by_operator(db: sqlite3.Connection) -> list[Json]:
    """Return the contacts of each operator by latest verdict, and the median time from arrival to first verdict."""
    rows = db.execute(
        "SELECT d.operator, d.verdict, d.contact_id, d.decided_utc_s, d.decided_utc_s - c.arrived_utc_s AS delay_s"
        " FROM decision d JOIN contact c ON c.id = d.contact_id WHERE d.undoes IS NULL AND NOT d.undone ORDER BY d.seq"
    )
    latest: dict[str, dict[str, str]] = defaultdict(dict)  # operator, contact: verdict
    delays: defaultdict[str, list[float]] = defaultdict(list)
    newest_utc_s: dict[str, float] = {}
    decided: set[str] = set()
    for row in rows:
        operator = row["operator"]
        latest[operator][row["contact_id"]] = row["verdict"]
        newest_utc_s[operator] = row["decided_utc_s"]
        if row["contact_id"] not in decided:
            decided.add(row["contact_id"])
            delays[operator].append(max(0.0, row["delay_s"]))
    return [
        {
            "operator": operator,
            "verdicts": dict(Counter(of_contacts.values())),
            "median_s": round(statistics.median(delays[operator]), 1) if delays[operator] else None,
            "time_utc_s": newest_utc_s[operator],
        }
        for operator, of_contacts in sorted(latest.items())
    ]


def _scored(row: sqlite3.Row) -> ScoredDecision:
    is_mine_like = bool(row["is_mine_like"])
    return ScoredDecision(row["operator"], row["verdict"], is_mine_like, row["bytes_received"], row["shown_s"])


def _decided_json(row: sqlite3.Row) -> Json:
    names = ("contact_id", "name", "operator", "verdict", "label", "bytes_received", "shown_s", "decided_utc_s")
    return {**{name: row[name] for name in names}, "is_mine_like": bool(row["is_mine_like"])}
