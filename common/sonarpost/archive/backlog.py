"""Records that c2 has acknowledged and not stored yet.

They are coded images that wait for the decoder, and, in an archive that several c2 share, all others: another c2 can
handle them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Final, TypeVar

import sqlalchemy as sa

from sonarpost.archive.database import ShoreDatabase
from sonarpost.archive.schema import BACKLOG, MEMBER

CHUNK: Final = 500
"""Keys of one statement."""
T = TypeVar("T")


_B: Final = BACKLOG.c
_IS_WAITING: Final = sa.and_(_B.owner == sa.bindparam("owner"), _B.is_coded)
_WAITING_VESSELS: Final = sa.select(_B.vessel_id).distinct().where(_IS_WAITING)
_WAITING_COUNT: Final = sa.select(sa.func.count()).where(_IS_WAITING)
_WAITING: Final = sa.select(_B.key, _B.payload, _B.vessel_id, _B.id).where(_IS_WAITING)
_WAITING_OF: Final = (
    _WAITING.where(_B.vessel_id == sa.bindparam("vessel"), _B.id > sa.bindparam("after"))
    .order_by(_B.id)
    .limit(sa.bindparam("limit"))
)
_WAITING_RECORD: Final = _WAITING.where(_B.id == sa.bindparam("id"))
_DELETE: Final = sa.delete(BACKLOG).where(sa.tuple_(_B.sha256, _B.key).in_(sa.bindparam("keys", expanding=True)))


def chunks(keys: Sequence[T]) -> Iterable[list[T]]:
    """Yield parts of keys for one statement each."""
    return (list(keys[first : first + CHUNK]) for first in range(0, len(keys), CHUNK))


@dataclass(frozen=True, slots=True)
class BacklogRecord:
    """A record that a c2 has acknowledged and not stored yet.

    Attributes:
        key: Its key.
        payload: Its payload.
        vessel_id: The vessel of a coded image, which waits for the decoder; empty for another record.
        id: Number in the order of acceptance, 0 if it is not read from the archive.
    """

    key: str
    payload: bytes
    vessel_id: str = ""
    id: int = 0

    @property
    def sha256(self) -> bytes:
        """Digest of the payload."""
        return hashlib.sha256(self.payload).digest()


class Backlog:
    """The records in a database; for several threads.

    Every method raises OSError or DatabaseUnavailableError if the database cannot be used.

    Args:
        database: The database.
        owner: Identity of this c2 among those that share it.

    Attributes:
        waiting_count: Number of coded images that wait for the decoder of this c2, when they last changed.
    """

    def __init__(self, database: ShoreDatabase, owner: str) -> None:
        self.waiting_count = 0
        self._database = database
        self._owner = owner
        self._insert = database.insert(BACKLOG)

    def accept(self, records: Sequence[BacklogRecord]) -> None:
        """Commit records that are acknowledged afterwards."""
        with self._database.transaction() as sql:
            self._database.put(sql, self._insert.on_conflict_do_nothing(), self._values(sql, records))

    def discard(self, records: Sequence[BacklogRecord]) -> None:
        """Delete accepted records that cannot be stored."""
        with self._database.transaction() as sql:
            self.delete(sql, records)
            self.count_waiting(sql)

    def add_waiting(self, sql: sa.Connection, records: Sequence[BacklogRecord]) -> None:
        """Add coded images in an open transaction.

        They get numbers above those of all images that the decoder has tried, also if this c2 or another one has
        accepted them before.
        """
        self.delete(sql, records)
        self._database.put(sql, self._insert, self._values(sql, records))

    def count(self) -> int:
        """Return the number of records of all c2."""
        with self._database.transaction(writing=False) as sql:
            return int(sql.execute(sa.select(sa.func.count()).select_from(BACKLOG)).scalar_one())

    def waiting(self, vessel_id: str, after: int, limit: int) -> list[BacklogRecord]:
        """Return coded images of a vessel that wait for the decoder of this c2, in the order of acceptance."""
        return self._read(_WAITING_OF, {"vessel": vessel_id, "after": after, "limit": limit})

    def waiting_vessels(self) -> list[str]:
        """Return the vessels whose coded images wait for the decoder of this c2."""
        with self._database.transaction(writing=False) as sql:
            return sorted(sql.execute(_WAITING_VESSELS, {"owner": self._owner}).scalars())

    def waiting_record(self, id_: int) -> BacklogRecord | None:
        """Return a coded image that waits for the decoder; None if it does not."""
        found = self._read(_WAITING_RECORD, {"id": id_})
        return found[0] if found else None

    def count_waiting(self, sql: sa.Connection) -> None:
        """Set `waiting_count` in an open transaction."""
        self.waiting_count = int(sql.execute(_WAITING_COUNT, {"owner": self._owner}).scalar_one())

    def _read(self, chosen: sa.Select[Any], values: Mapping[str, object]) -> list[BacklogRecord]:
        with self._database.transaction(writing=False) as sql:
            return [BacklogRecord(*row) for row in sql.execute(chosen, {"owner": self._owner, **values})]

    def _values(self, sql: sa.Connection, records: Sequence[BacklogRecord]) -> list[dict[str, Any]]:
        now_utc_s = self._database.now_utc_s(sql)
        values = {
            (record.sha256, record.key): {
                "key": record.key,
                "sha256": record.sha256,
                "payload": record.payload,
                "vessel_id": record.vessel_id,
                "is_coded": bool(record.vessel_id),
                "owner": self._owner,
                "accepted_utc_s": now_utc_s,
            }
            for record in records
        }
        return list(values.values())  # in the order of acceptance

    def delete(self, sql: sa.Connection, records: Sequence[BacklogRecord]) -> None:
        """Delete records in an open transaction."""
        for part in chunks([(record.sha256, record.key) for record in records]):
            sql.execute(_DELETE, {"keys": part})

    def take_over(
        self, age_s: float, limit: int, limit_bytes: int, store: Callable[[list[BacklogRecord]], None]
    ) -> int:
        """Take over records of other c2 that do not call this method any more; return their number.

        Args:
            age_s: Least age of the records, and time since the last call of their c2, by the clock of the server.
            limit: Maximum number of records.
            limit_bytes: Maximum size of their payloads, at least one record.
            store: Stores the records durably at this c2; called before they are assigned to it.
        """
        b = BACKLOG.c
        member = self._database.insert(MEMBER)
        seen = member.on_conflict_do_update(
            index_elements=(MEMBER.c.owner,), set_={"seen_utc_s": member.excluded.seen_utc_s}
        )
        with self._database.transaction() as sql:
            now_utc_s = self._database.now_utc_s(sql)
            sql.execute(seen, {"owner": self._owner, "seen_utc_s": now_utc_s})
        is_active = sa.exists().where(MEMBER.c.owner == b.owner, MEMBER.c.seen_utc_s >= now_utc_s - age_s)
        others = (
            sa.select(b.id, sa.func.length(b.payload))
            .where(b.owner != self._owner, ~is_active, b.accepted_utc_s < now_utc_s - age_s)
            .order_by(b.accepted_utc_s, b.id)
            .limit(limit)
            .with_for_update(skip_locked=True)
        )
        with self._database.transaction() as sql:
            found = sql.execute(others).all()
            totals = accumulate(size for _, size in found)
            chosen = [id_ for id_, _ in found[: max(1, sum(total <= limit_bytes for total in totals))]]
            if not chosen:
                return 0
            ordered = sa.select(b.key, b.payload).where(b.id.in_(chosen)).order_by(b.id)
            store([BacklogRecord(key, payload) for key, payload in sql.execute(ordered)])
            sql.execute(sa.update(BACKLOG).where(b.id.in_(chosen)).values(owner=self._owner, accepted_utc_s=now_utc_s))
        return len(chosen)
