"""Tables of the archive of a shore site, in SQLite and in PostgreSQL.

A contact is one JSON document; beside it are only the columns that queries use. A new field of `Contact` changes
nothing here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.dialects.postgresql import JSONB

from sonarpost.archive.rows import DecisionRow, ImageRow, Row, TaskingRow, document_of
from sonarpost.messages import Contact

VERSION: Final = 1
SCHEMA: Final = "sonarpost"
"""Schema of the tables in PostgreSQL."""

_NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")  # the row number of SQLite is an INTEGER
_DOCUMENT = sa.JSON(none_as_null=True).with_variant(JSONB(none_as_null=True), "postgresql")
METADATA: Final = sa.MetaData()


def _table(name: str, keys: Mapping[str, Any], others: Mapping[str, Any], optional: Mapping[str, Any]) -> sa.Table:
    """Return a table: columns of its primary key, other columns, columns that can be NULL."""
    columns = [sa.Column(n, t, primary_key=True) for n, t in keys.items()]
    columns += [sa.Column(n, t, nullable=False) for n, t in others.items()]
    columns += [sa.Column(n, t) for n, t in optional.items()]
    # An identifier is never used again.
    return sa.Table(name, METADATA, *columns, sqlite_autoincrement="id" in keys)


ARCHIVE: Final = _table(
    "archive", {}, {"version": sa.Integer, "identity": sa.Text, "last_seq": _NUMBER}, {"site": sa.Text}
)
"""One row: version of the tables, identity and last number of the journal, name of the site."""

IMAGE: Final = _table(
    "image",
    {"vessel_id": sa.Text, "name": sa.Text},
    {
        **dict.fromkeys(("vehicle_id", "image_id", "codec", "files_sha256", "fault"), sa.Text),
        **dict.fromkeys(("version", "size_bytes"), sa.BigInteger),
        **dict.fromkeys(("first_frame_utc_s", "last_frame_utc_s", "accepted_utc_s", "missing_fraction"), sa.Double),
        **dict.fromkeys(("height_px", "width_px"), sa.Integer),
        **dict.fromkeys(("complete", "conflict"), sa.Boolean),
    },
    {
        **dict.fromkeys(("relayed_utc_s", "exported_utc_s", "removed_utc_s", "verified_utc_s"), sa.Double),
        **dict.fromkeys(("despeckle_strength", "lat_deg", "lon_deg"), sa.Double),
        "contact": _DOCUMENT,
    },
)
FILE: Final = _table(
    "file", {"vessel_id": sa.Text, "name": sa.Text, "suffix": sa.Text}, {"content": sa.LargeBinary}, {}
)
"""Files of images and decisions of an archive without a folder."""

DECISION: Final = _table(
    "decision",
    {"vessel_id": sa.Text, "decision_id": sa.Text},
    {
        **dict.fromkeys(("vehicle_id", "image_id", "verdict", "remark", "operator", "files_sha256", "fault"), sa.Text),
        "image_version": sa.BigInteger,
        **dict.fromkeys(("decided_utc_s", "accepted_utc_s"), sa.Double),
    },
    {"confidence": sa.Double, "mlo_class": sa.Text, "verified_utc_s": sa.Double},
)
TASKING: Final = _table(
    "tasking",
    {"vessel_id": sa.Text, "kind": sa.Text, "record_id": sa.Text},
    {
        **dict.fromkeys(("vehicle_id", "summary", "author", "state", "reason", "owner"), sa.Text),
        **dict.fromkeys(("issued_utc_s", "changed_utc_s"), sa.Double),
        "payload": sa.LargeBinary,
    },
    {"image_id": sa.Text},
)
BACKLOG: Final = _table(
    "backlog",
    {"id": _NUMBER},
    {
        **dict.fromkeys(("key", "vessel_id", "owner"), sa.Text),
        **dict.fromkeys(("sha256", "payload"), sa.LargeBinary),
        "is_coded": sa.Boolean,
        "accepted_utc_s": sa.Double,
    },
    {},
)
"""Records that are acknowledged and not stored yet; `is_coded`: images that wait for the decoder of `owner`."""

RECORD: Final = _table(
    "record",
    {"seq": _NUMBER},
    {
        **dict.fromkeys(("key", "encoding", "vessel_id", "vehicle_id", "image_id", "subject", "name"), sa.Text),
        **dict.fromkeys(("digest", "payload"), sa.LargeBinary),
        "accepted_utc_s": sa.Double,
        "version": sa.BigInteger,
    },
    {"lat_deg": sa.Double, "lon_deg": sa.Double},
)
"""Every numbered record, for queries; see `journal`."""

REVIEW: Final = _table(
    "review", dict.fromkeys(("vessel_id", "vehicle_id", "image_id"), sa.Text), {"state": sa.Text}, {}
)
MEMBER: Final = _table("member", {"owner": sa.Text}, {"seen_utc_s": sa.Double}, {})
"""The c2 of the site, and when each was last active."""


def _index(table: sa.Table, *names: str, where: sa.ColumnElement[bool] | None = None, unique: bool = False) -> None:
    """Add an index of columns, of the rows that match a condition."""
    columns = [table.c[name] for name in names]
    sa.Index(f"{table.name}_{names[0]}", *columns, unique=unique, sqlite_where=where, postgresql_where=where)


_index(IMAGE, "accepted_utc_s", where=IMAGE.c.removed_utc_s.is_(None))
_index(IMAGE, "verified_utc_s", where=IMAGE.c.removed_utc_s.is_(None))
_index(IMAGE, "fault", where=IMAGE.c.fault != sa.text("''"))
_index(IMAGE, "conflict", where=IMAGE.c.conflict)
_index(DECISION, "verified_utc_s")
_index(DECISION, "fault", where=DECISION.c.fault != sa.text("''"))
_index(BACKLOG, "sha256", "key", unique=True)
_index(BACKLOG, "owner", "is_coded", "vessel_id", "id")
_index(BACKLOG, "accepted_utc_s")
_index(RECORD, "digest", "key", unique=True)
_index(RECORD, "key", "subject", "version")
_index(RECORD, "image_id", "vehicle_id", "vessel_id")
_index(RECORD, "name", "vessel_id", where=RECORD.c.name != sa.text("''"))
_index(RECORD, "accepted_utc_s")


def _only_postgresql(table: sa.Table, statement: str) -> None:
    """Run a statement after the table was created in PostgreSQL."""
    ddl: Any = sa.DDL
    sa.event.listens_for(table, "after_create")(ddl(statement).execute_if(dialect="postgresql"))


_POSITION = "ST_SetSRID(ST_MakePoint(lon_deg, lat_deg), 4326)"
_POSITION_TYPE = "geometry(Point, 4326)"
_only_postgresql(IMAGE, f"ALTER TABLE image ADD position {_POSITION_TYPE} GENERATED ALWAYS AS ({_POSITION}) STORED")
_only_postgresql(IMAGE, "CREATE INDEX image_position ON image USING gist (position)")
_only_postgresql(FILE, "ALTER TABLE file ALTER COLUMN content SET STORAGE EXTERNAL")  # compressed already

TABLES: Final[Mapping[type, sa.Table]] = {ImageRow: IMAGE, DecisionRow: DECISION, TaskingRow: TASKING}


def values_of(row: ImageRow | DecisionRow | TaskingRow) -> dict[str, Any]:
    """Return the values of the columns of a row. PostgreSQL stores no NUL in text."""
    values = document_of(row)
    if isinstance(row, ImageRow):
        position = (row.contact.lat_deg, row.contact.lon_deg) if row.contact else (None, None)
        values |= {"lat_deg": position[0], "lon_deg": position[1]}
    return _without_nul(values)


def _without_nul(values: dict[str, Any]) -> dict[str, Any]:
    return {
        name: value.replace("\0", "\ufffd")
        if isinstance(value, str)
        else _without_nul(value)
        if isinstance(value, dict)
        else value
        for name, value in values.items()
    }


def select_of(row_type: type[Row]) -> sa.Select[Any]:
    """Return a selection of the columns of a row type, in the order of its fields."""
    table = TABLES[row_type]
    return sa.select(*(table.c[each.name] for each in fields(row_type)))


def row_of(row_type: type[Row], values: sa.Row[Any]) -> Row:
    """Return a row of `select_of`."""
    named = values._asdict()
    if named.get("contact") is not None:
        named["contact"] = Contact.model_validate(named["contact"])
    return row_type(**named)
