"""Known objects of contacts: all contacts of training, and sealed contacts of the calibrated watch.

The table `truth` states what a contact shows. The page receives it after a decision, when the operator can no longer
take the decision back. The score counts the first decision of each operator on each contact that is not withdrawn, if
the operator made it before the page received the object.

The column `contact.sealed` is 1 for a sealed contact, and 2 after its object was revealed: then lists omit it.
"""

from __future__ import annotations

import math
import sqlite3
import statistics
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Final

from sonarpost.services.console.store.association import isolate_look
from sonarpost.services.console.store.database import insert_row
from sonarpost.services.console.store.serialisers import Json

MAX_LISTED: Final = 500
"""Contacts in the list of a score sheet: the most recently decided ones."""

BYTE_LIMITS: Final = (32, 64, 128, 256, 512)
"""Upper limits of the groups of decisions by received bytes; the last group has no limit."""
_Z_95: Final = 1.959963984540054
"""Quantile of the standard normal distribution for an interval of 95 %."""

_Decision = Mapping[str, Any]
"""A row of `_SCORED`."""

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
    rows = [dict(row) for row in db.execute(_SCORED, (now_utc_s - take_back_s,))]
    if operator is not None:
        rows = [row for row in rows if row["operator"] == operator]
    operators: list[Json] = []
    for name in sorted({row["operator"] for row in rows}):
        decisions = [row for row in rows if row["operator"] == name]
        operators.append({"operator": name, **score(decisions), "by_bytes": score_by_bytes(decisions)})
    names = ("contact_id", "name", "operator", "verdict", "label", "bytes_received", "shown_s", "decided_utc_s")
    return {
        "operators": operators,
        "decisions": [
            {**{name: row[name] for name in names}, "is_mine_like": bool(row["is_mine_like"])}
            for row in rows[:MAX_LISTED]
        ],
        "watch": _decisions_by_operator(db),
    }


def score(decisions: Sequence[_Decision]) -> Json:
    """Return the score of a set of decisions: probability of detection, false alarms, medians of time and bytes.

    `detected`: mine-like objects with the verdict mine-like; `false_alarms`: other objects with it. A median is None
    without a value.
    """
    verdicts: dict[bool, list[str]] = {True: [], False: []}
    for one in decisions:
        verdicts[bool(one["is_mine_like"])].append(one["verdict"])
    shown_s = [one["shown_s"] for one in decisions if one["shown_s"] is not None]
    return {
        "decided": len(decisions),
        "detected": wilson_share(verdicts[True].count("mine_like"), len(verdicts[True])),
        "false_alarms": wilson_share(verdicts[False].count("mine_like"), len(verdicts[False])),
        "unsure": sum(one["verdict"] == "unsure" for one in decisions),
        "median_shown_s": statistics.median(shown_s) if shown_s else None,
        "median_bytes": statistics.median(one["bytes_received"] for one in decisions) if decisions else None,
    }


def score_by_bytes(decisions: Sequence[_Decision]) -> list[Json]:
    """Return the score of each group of `BYTE_LIMITS` with decisions; its upper limit is inclusive, None for none."""
    found: list[Json] = []
    for low, high in pairwise((0, *BYTE_LIMITS, None)):
        group = [one for one in decisions if (low or 0) < one["bytes_received"] <= (high or math.inf)]
        if group:
            found.append({"above_bytes": low, "up_to_bytes": high, **score(group)})
    return found


def wilson_share(count: int, total: int) -> Json:
    """Return a share with its score interval of Wilson (1927), 95 %; None for all three without a case.

    Args:
        count: Number of cases with the property, 0 to `total`.
        total: Number of cases.
    """
    if total == 0:
        return {"count": count, "total": total, "share": None, "low": None, "high": None}
    share, z2 = count / total, _Z_95**2
    centre = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = _Z_95 / (1 + z2 / total) * math.sqrt(share * (1 - share) / total + z2 / (4 * total**2))
    return {
        "count": count,
        "total": total,
        "share": share,
        "low": max(0.0, centre - half),
        "high": min(1.0, centre + half),
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
