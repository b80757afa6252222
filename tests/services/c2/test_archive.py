"""c2: conflicting images are kept, stored files are compared with the index, and old indexes are migrated."""

import logging
import sqlite3
from contextlib import closing
from dataclasses import replace

import pytest
from builders.common import eventually
from builders.records import decision_record, reconstructed_image

from sonarpost import keys, wire
from sonarpost.archive.shore_files import image_paths
from sonarpost.archive.shore_index import FILE_NAME, ShoreIndex
from sonarpost.cli.main import main
from sonarpost.export.contacts import load_contacts
from sonarpost.messages import Contact, Pixels, Relayed
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.sonar.image_files import read_image

DAY_S = 86400.0
START_S = 1_700_000_000.0
VESSEL = "vessel-1"


def image(image_id="AAAA", value=1, start_s=START_S, version=1):
    picture = Pixels(height_px=20, width_px=30, bits=8, data=bytes([value]) * 600)
    return reconstructed_image(
        picture,
        vessel_id=VESSEL,
        image_id=image_id,
        version=version,
        first_frame_utc_s=start_s,
        last_frame_utc_s=start_s + 1,
    )


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def archive(out):
    made = []

    def open_(**options):
        made.append(Archive(C2Config(out_dir=out, **options)))
        return made[-1]

    yield open_
    for each in made:
        each.close()


@pytest.fixture
def filled(archive):
    """Make an archive with ten images and a decision."""
    made = archive()
    for number in range(10):
        made.store_image(image(f"{number:04d}"), 5.0)
    made.store_decision(decision_record())
    made.flush()
    return made


def verify_all(archive, now_utc_s):
    return archive.verify(now_utc_s, DAY_S)


# Images of one name


def test_two_images_of_one_name_and_version_are_stored_and_reported(archive, out, caplog, capsys):
    kept = archive()
    first, second = image(), image(value=2, start_s=START_S + 0.4)
    assert kept.store_image(first, 5.0)[1:] == (True, False)
    kept.flush()
    assert kept.store_image(second, 5.0)[1:] == (True, True)
    kept.flush()
    rows = kept.index().images()
    assert [(row.first_frame_utc_s, row.conflict) for row in rows] == [(START_S, False), (START_S + 0.4, True)]
    pixels = [read_image(image_paths(out, row)[1])[0, 0] for row in rows]
    assert pixels == [1, 2]
    assert kept.defect_counts()["conflicting"] == 1
    assert [record.levelno for record in caplog.records if "conflicts" in record.message] == [logging.WARNING]
    for repeated, conflict in ((first, False), (second, True)):
        assert kept.store_image(repeated, 6.0)[1:] == (False, conflict)
    kept.flush()
    assert len(kept.index().images()) == 2
    assert main(["c2", "ls", "--archive", str(out)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "uuv-1/AAAA" in line]
    assert ["1 (conflict)" in line for line in lines] == [False, True]


def test_images_that_differ_only_in_their_pixels_are_both_listed(archive, out):
    kept = archive()
    for value in (1, 2):
        kept.store_image(image(value=value), 5.0)
    kept.flush()
    assert [row.conflict for row in kept.index().images()].count(True) == 1
    contacts = load_contacts(out)
    assert len(contacts.contacts) == 1
    assert "one image of this name and version" in str(contacts.problems[0])


def test_index_made_from_the_files_has_the_conflict(archive, out):
    kept = archive()
    for value in (1, 2):
        kept.store_image(image(value=value), 5.0)
    kept.flush()
    before = {(row.name, row.conflict, row.files_sha256) for row in kept.index().images()}
    kept.close()
    for path in out.glob(f"{FILE_NAME}*"):
        path.unlink()
    assert {(row.name, row.conflict, row.files_sha256) for row in archive().index().images()} == before


# Comparison of files and index


def test_undamaged_files_are_compared_once_in_a_cycle(filled, caplog):
    caplog.clear()
    assert verify_all(filled, 1e9) == 11
    assert verify_all(filled, 1e9 + DAY_S / 2) == 0
    assert verify_all(filled, 1e9 + 1.1 * DAY_S) == 11
    assert set(filled.defect_counts().values()) == {0}
    assert not caplog.records


def test_comparison_is_spread_over_the_cycle(filled):
    compared = [filled.verify(1e9 + hour * 3600.0, 3600.0 * 4) for hour in range(0, 24, 4)]
    assert compared == [3, 2, 2, 2, 2, 0]


def test_comparison_can_be_disabled(archive):
    kept = archive(verify_days=0)
    kept.store_image(image(), 5.0)
    kept.flush()
    assert verify_all(kept, 1e9) == 0


def test_missing_and_changed_files_are_counted_logged_once_and_listed(filled, out, caplog, capsys):
    rows = filled.index().images()
    image_paths(out, rows[0])[1].unlink()
    image_paths(out, rows[1])[0].unlink()
    tiff = image_paths(out, rows[2])[1]
    tiff.write_bytes(tiff.read_bytes()[:-1] + b"\xff")
    image_paths(out, rows[3])[2].write_bytes(b"")
    decision = next(out.glob("*/decisions/*.json"))
    decision.write_bytes(decision.read_bytes() + b" ")
    caplog.clear()
    verify_all(filled, 1e9)
    assert filled.defect_counts() == {"missing": 2, "changed": 3, "unreadable": 0, "conflicting": 0}
    verify_all(filled, 1e9 + 2 * DAY_S)
    assert [record.message for record in caplog.records] == ["Stored files differ from the index"]
    assert main(["c2", "ls", "--archive", str(out)]) == 0
    text = capsys.readouterr().out
    assert text.count("1 (missing)") == 2
    assert text.count("1 (changed)") == 2


def test_restored_files_are_no_longer_reported(filled, out):
    path = image_paths(out, filled.index().images()[0])[1]
    content = path.read_bytes()
    path.unlink()
    verify_all(filled, 1e9)
    assert filled.defect_counts()["missing"] == 1
    path.write_bytes(content)
    verify_all(filled, 1e9 + 2 * DAY_S)
    assert filled.defect_counts()["missing"] == 0


def test_image_that_arrives_again_replaces_its_damaged_files(filled, out):
    path = image_paths(out, filled.index().images()[0])[1]
    path.unlink()
    verify_all(filled, 1e9)
    assert filled.store_image(image("0000"), 5.0).is_new
    filled.flush()
    assert filled.defect_counts()["missing"] == 0
    verify_all(filled, 1e9 + 2 * DAY_S)
    assert filled.defect_counts()["missing"] == 0


def test_unreadable_file_is_reported_as_such(filled, out):
    path = image_paths(out, filled.index().images()[0])[1]
    path.unlink()
    path.mkdir()
    verify_all(filled, 1e9)
    assert filled.defect_counts()["unreadable"] == 1


def test_images_removed_by_retention_are_not_missing(archive):
    kept = archive(max_bytes=0)
    kept.store_image(image(), 5.0)
    kept.flush()
    kept.apply_retention(1e9)
    verify_all(kept, 1e9)
    assert kept.defect_counts()["missing"] == 0


def test_service_compares_its_files_and_warns(runner, platform, out, monkeypatch):
    monkeypatch.setattr("sonarpost.services.c2.service.VERIFICATION_INTERVAL_S", 0.05)
    service = runner.start(C2Service(platform("shore-1"), C2Config(out_dir=out, verify_days=1e-6)))
    relay = runner.peer(VESSEL, "relay")
    for value, start_s in ((1, START_S), (2, START_S + 0.4)):
        payload = wire.encode(image(value=value, start_s=start_s))
        envelope = Relayed(vessel_id=VESSEL, key=keys.image_reconstructed(VESSEL), payload=payload, relayed_utc_s=5.0)
        relay.send(keys.shore_inbox(VESSEL), "c2", envelope)
    eventually(lambda: service.health().counters.get("images_conflicting") == 1)
    assert service.health().state == "ok"
    assert service.health().detail == f"{out}: stored records 1 conflicting"
    next(out.glob("*/*.png")).unlink()
    eventually(lambda: service.health().gauges["records_missing"] == 1)
    assert service.health().detail == f"{out}: stored records 1 missing, 1 conflicting"


# Index of version 1

VERSION_1 = """
CREATE TABLE picture (
    vessel_id TEXT NOT NULL, name TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT NOT NULL,
    version INTEGER NOT NULL, first_frame_utc_s REAL NOT NULL, last_frame_utc_s REAL NOT NULL,
    relayed_utc_s REAL, accepted_utc_s REAL NOT NULL, complete INTEGER NOT NULL, missing_fraction REAL NOT NULL,
    height_px INTEGER NOT NULL, width_px INTEGER NOT NULL, codec TEXT NOT NULL, lat_deg REAL, lon_deg REAL,
    atd_class TEXT, atd_confidence REAL, size_bytes INTEGER NOT NULL, exported_utc_s REAL, removed_utc_s REAL,
    PRIMARY KEY (vessel_id, name)) WITHOUT ROWID;
CREATE TABLE decision (
    vessel_id TEXT NOT NULL, decision_id TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT NOT NULL,
    image_version INTEGER NOT NULL, verdict TEXT NOT NULL, confidence REAL, mlo_class TEXT, remark TEXT NOT NULL,
    operator TEXT NOT NULL, decided_utc_s REAL NOT NULL, accepted_utc_s REAL NOT NULL,
    PRIMARY KEY (vessel_id, decision_id)) WITHOUT ROWID;
CREATE TABLE tasking (
    vessel_id TEXT NOT NULL, kind TEXT NOT NULL, record_id TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT,
    summary TEXT NOT NULL, author TEXT NOT NULL, issued_utc_s REAL NOT NULL, state TEXT NOT NULL, reason TEXT NOT NULL,
    changed_utc_s REAL NOT NULL, PRIMARY KEY (vessel_id, kind, record_id)) WITHOUT ROWID;
PRAGMA user_version = 1;
"""


@pytest.fixture
def version_1(filled, out):
    """Turn the index into one of version 1; return its rows with the defaults of the new columns."""
    rows = filled.index().images()
    filled.close()
    path = out / FILE_NAME
    with closing(sqlite3.connect(path)) as db:
        old = {t: [r[1] for r in db.execute(f"PRAGMA table_info({t})")] for t in ("picture", "decision")}
        data = {t: db.execute(f"SELECT * FROM {t}").fetchall() for t in old}
    path.unlink()
    new = {"conflict", "files_sha256", "verified_utc_s", "fault", "despeckle_strength", "p_mine_like", "p_other_object"}
    with closing(sqlite3.connect(path)) as db, db:
        db.executescript(VERSION_1)
        for table, columns in old.items():
            kept = [n for n, column in enumerate(columns) if column not in new]
            marks = ", ".join("?" * len(kept))
            db.executemany(f"INSERT INTO {table} VALUES ({marks})", [[r[n] for n in kept] for r in data[table]])
    return [replace(row, files_sha256="") for row in rows]


def test_index_of_version_1_is_read_without_a_migration(version_1, out):
    before = (out / FILE_NAME).read_bytes()
    with closing(ShoreIndex(out, writable=False)) as index:
        assert index.images() == version_1
        assert len(index.decisions()) == 1
    assert (out / FILE_NAME).read_bytes() == before


def test_index_of_version_1_is_migrated_and_gets_digests(version_1, archive, out):
    image_paths(out, version_1[0])[1].write_bytes(b"other size")
    migrated = archive()
    assert migrated.index().images() == version_1
    assert verify_all(migrated, 1e9) == 11
    assert migrated.defect_counts() == {"missing": 0, "changed": 1, "unreadable": 0, "conflicting": 0}
    tiff = image_paths(out, version_1[1])[1]
    tiff.write_bytes(tiff.read_bytes()[:-1] + b"\xff")
    verify_all(migrated, 1e9 + 2 * DAY_S)
    assert migrated.defect_counts()["changed"] == 2


def test_index_of_version_2_gains_the_strength_of_despeckling(archive, filled, out):
    before = filled.index().images()
    filled.close()
    with closing(sqlite3.connect(out / FILE_NAME)) as db, db:
        for column in ("despeckle_strength", "p_mine_like", "p_other_object"):
            db.execute(f"ALTER TABLE picture DROP COLUMN {column}")
        db.execute("PRAGMA user_version = 2")
    with closing(ShoreIndex(out, writable=False)) as index:
        assert index.images() == before
    migrated = archive()
    assert migrated.index().images() == before
    migrated.store_image(image("000A").model_copy(update={"despeckle_strength": 0.5}), 5.0)
    migrated.flush()
    assert [row.despeckle_strength for row in migrated.index().images() if row.image_id == "000A"] == [0.5]


def test_index_of_version_3_gains_the_probabilities(archive, filled, out):
    before = filled.index().images()
    filled.close()
    with closing(sqlite3.connect(out / FILE_NAME)) as db, db:
        for column in ("p_mine_like", "p_other_object"):
            db.execute(f"ALTER TABLE picture DROP COLUMN {column}")
        db.execute("PRAGMA user_version = 3")
    with closing(ShoreIndex(out, writable=False)) as index:
        assert index.images() == before
    migrated = archive()
    assert migrated.index().images() == before
    classified = Contact(
        contact_id="uuv-1/000A", vehicle_id="uuv-1", atd_class="structure", p_mine_like=0.05, p_other_object=0.9
    )
    migrated.store_image(image("000A").model_copy(update={"contact": classified}), 5.0)
    migrated.flush()
    [row] = [row for row in migrated.index().images() if row.image_id == "000A"]
    assert (row.atd_class, row.p_mine_like, row.p_other_object) == ("structure", 0.05, 0.9)
