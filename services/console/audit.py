"""Who did what, when, and what was on the screen: only ever added to."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass

from sonarpost.services.console.people import Actor


@dataclass(frozen=True, slots=True)
class OnScreen:
    """What somebody was looking at.

    Attributes:
        version: Of the picture.
        sha256: Of its pixels.
        layer: How it was shown.
    """

    version: int | None = None
    sha256: str | None = None
    layer: str | None = None


def write(
    db: sqlite3.Connection,
    contact_id: str,
    actor: Actor,
    action: str,
    utc_s: float,
    screen: OnScreen,
    detail: Mapping[str, object],
) -> None:
    """Add an entry, within the transaction of what it tells of."""
    db.execute(
        "INSERT INTO audit (contact_id, utc_s, user, role, address, action, version, sha256, layer, detail)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (
            contact_id,
            utc_s,
            actor.user,
            actor.role,
            actor.address,
            action,
            screen.version,
            screen.sha256,
            screen.layer,
            json.dumps(dict(detail)),
        ),
    )
