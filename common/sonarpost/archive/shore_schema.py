"""Tables of the archive of a shore site in PostgreSQL: creation, version, name of the site."""

from __future__ import annotations

from typing import Final

from sonarpost.archive import shared_journal
from sonarpost.archive.postgresql import Sql
from sonarpost.errors import ConfigError, StoredFileError

VERSION: Final = 3
_LOCK: Final = 0x736F6E61725F01
_ARCHIVE: Final = """
CREATE TABLE archive (version integer NOT NULL, site text);
CREATE TABLE image (
    vessel_id text NOT NULL, name text NOT NULL, vehicle_id text NOT NULL, image_id text NOT NULL,
    version bigint NOT NULL, first_frame_utc_s float8 NOT NULL, last_frame_utc_s float8 NOT NULL,
    relayed_utc_s float8, accepted_utc_s float8 NOT NULL, complete boolean NOT NULL, missing_fraction float8 NOT NULL,
    height_px integer NOT NULL, width_px integer NOT NULL, codec text NOT NULL, lat_deg float8, lon_deg float8,
    atd_class text, atd_confidence float8, size_bytes bigint NOT NULL, exported_utc_s float8, removed_utc_s float8,
    conflict boolean NOT NULL, files_sha256 text NOT NULL, verified_utc_s float8, fault text NOT NULL,
    despeckle_strength float8, p_mine_like float8, p_other_object float8,
    position geometry(Point, 4326) GENERATED ALWAYS AS (ST_SetSRID(ST_MakePoint(lon_deg, lat_deg), 4326)) STORED,
    PRIMARY KEY (vessel_id, name));
CREATE INDEX image_position ON image USING gist (position);
CREATE INDEX image_age ON image (accepted_utc_s) WHERE removed_utc_s IS NULL;
CREATE INDEX image_verified ON image (verified_utc_s NULLS FIRST) WHERE removed_utc_s IS NULL;
CREATE INDEX image_fault ON image (fault) WHERE fault <> '';
CREATE INDEX image_conflict ON image (vessel_id) WHERE conflict;
CREATE TABLE file (
    vessel_id text NOT NULL, name text NOT NULL, suffix text NOT NULL, content bytea NOT NULL,
    PRIMARY KEY (vessel_id, name, suffix), FOREIGN KEY (vessel_id, name) REFERENCES image);
ALTER TABLE file ALTER COLUMN content SET STORAGE EXTERNAL;
CREATE TABLE decision (
    vessel_id text NOT NULL, decision_id text NOT NULL, vehicle_id text NOT NULL, image_id text NOT NULL,
    image_version bigint NOT NULL, verdict text NOT NULL, confidence float8, mlo_class text, remark text NOT NULL,
    operator text NOT NULL, decided_utc_s float8 NOT NULL, accepted_utc_s float8 NOT NULL, files_sha256 text NOT NULL,
    verified_utc_s float8, fault text NOT NULL, content bytea NOT NULL, PRIMARY KEY (vessel_id, decision_id));
CREATE INDEX decision_verified ON decision (verified_utc_s NULLS FIRST);
CREATE TABLE tasking (
    vessel_id text NOT NULL, kind text NOT NULL, record_id text NOT NULL, vehicle_id text NOT NULL, image_id text,
    summary text NOT NULL, author text NOT NULL, issued_utc_s float8 NOT NULL, state text NOT NULL,
    reason text NOT NULL, changed_utc_s float8 NOT NULL, owner text NOT NULL, payload bytea NOT NULL,
    PRIMARY KEY (vessel_id, kind, record_id));
CREATE TABLE accepted (
    key text NOT NULL, sha256 bytea NOT NULL, payload bytea NOT NULL, owner text NOT NULL,
    accepted_at timestamptz NOT NULL DEFAULT clock_timestamp(), PRIMARY KEY (key, sha256));
CREATE INDEX accepted_age ON accepted (accepted_at);
CREATE TABLE member (owner text PRIMARY KEY, seen_at timestamptz NOT NULL);
"""


def create(sql: Sql, where: str) -> None:
    """Create the tables unless they exist.

    Args:
        sql: Transaction; other c2 wait for its end before they do the same.
        where: Address of the database for errors.

    Raises:
        DatabaseUnavailableError: PostGIS is missing.
        StoredFileError: The tables have another version.
    """
    sql.rows("SELECT pg_advisory_xact_lock(:lock)", lock=_LOCK)
    if _stored_version(sql) != 0:
        check_version(sql, where)
        return
    # Needs a superuser, unless an administrator has created it.
    sql.rows("CREATE EXTENSION IF NOT EXISTS postgis")
    sql.rows("CREATE SCHEMA IF NOT EXISTS sonarpost")
    sql.rows(_ARCHIVE)
    sql.rows(shared_journal.SCHEMA)
    sql.rows("INSERT INTO archive VALUES (:version, NULL)", version=VERSION)


def check_version(sql: Sql, where: str) -> None:
    """Check the version of the tables.

    Raises:
        StoredFileError: There are no tables, or they have another version.
    """
    version = _stored_version(sql)
    if version != VERSION:
        raise StoredFileError(where, "version", version, str(VERSION))


def check_site(sql: Sql, where: str, site: str) -> None:
    """Store the name of the site at the first use, compare it afterwards.

    Raises:
        ConfigError: The database belongs to another site.
    """
    sql.rows("UPDATE archive SET site = :site WHERE site IS NULL", site=site)
    stored = sql.rows("SELECT site FROM archive")[0][0]
    if stored != site:
        raise ConfigError(where, "site", site, f"{stored}, the site of this database")


def _stored_version(sql: Sql) -> int:
    exists = sql.number("SELECT count(*) FROM pg_tables WHERE schemaname = 'sonarpost' AND tablename = 'archive'")
    return sql.number("SELECT version FROM sonarpost.archive") if exists else 0
