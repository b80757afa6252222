"""Archive of files of c2: restoration from the files, comparison with the digests, retention."""

import logging
import os
import threading
from dataclasses import replace

import pytest
from builders.common import WAIT_S, eventually
from builders.records import decision_record
from builders.shore import image, relayed
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import keys
from sonarpost.archive.reader import open_archive
from sonarpost.archive.rows import FILE_NAME, DecisionRow, ImageRow
from sonarpost.archive.shore_files import find_image, image_paths, select_images
from sonarpost.cli.main import main
from sonarpost.errors import StoredFileError
from sonarpost.export.contacts import load_contacts
from sonarpost.services.c2 import archive as c2_archive
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

DAY_S = 86400.0
START_S = 1_700_000_000.0
INBOX = keys.shore_inbox("vessel-1")


@pytest.fixture
def filled(open_files):
    """Make an archive with ten images and a decision."""
    made = open_files()
    for number in range(10):
        made.store_image(image(f"{number:04d}"), 5.0)
    made.store_decision(decision_record())
    made.flush()
    return made


def delete_archive(out):
    for path in out.glob(f"{FILE_NAME}*"):
        path.unlink()


def test_two_images_of_one_name_and_version_are_reported(open_files, out, caplog, capsys):
    kept = open_files()
    for value in (1, 2):
        kept.store_image(image(value=value), 5.0)
        kept.flush()
    assert [record.levelno for record in caplog.records if "conflicts" in record.message] == [logging.WARNING]
    assert main(["c2", "ls", "--archive", str(out)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "uuv-1/AAAA" in line]
    assert ["1 (conflict)" in line for line in lines] == [False, True]
    contacts = load_contacts(out)
    assert len(contacts.contacts) == 1
    assert "one image of this name and version" in str(contacts.problems[0])


def test_archive_is_restored_from_the_files(open_files, out):
    first = open_files()
    for each in (image(), image(value=2), image(version=2)):
        first.store_image(each, 5.0)
        first.flush()
    first.store_decision(decision_record())
    first.flush()
    before = [replace(row, relayed_utc_s=None, accepted_utc_s=0.0) for row in first.index().images()]
    assert [row.conflict for row in before].count(True) == 1
    first.close()
    delete_archive(out)
    (out / "vessel-1" / "broken.json").write_text("{")
    os.mkfifo(out / "vessel-1" / "pipe.json")
    (out / "vessel-1" / "zero.json").symlink_to("/dev/zero")
    (out / "vessel-1" / os.fsdecode(b"not\xffutf-8.json")).write_text("{}")
    (out / "vessel-1" / "decisions" / "folder.json").mkdir()
    again = open_files().index()
    assert [replace(row, accepted_utc_s=0.0) for row in again.images()] == before
    assert [d.decision_id for d in again.decisions()] == ["d1"]
    assert again.journal.position()[1] == 4


# Comparison of files and digests


def test_missing_and_changed_files_are_counted_logged_once_and_listed(filled, out, caplog, capsys):
    rows = filled.index().images()
    first = image_paths(out, rows[0])[1]
    content = first.read_bytes()
    first.unlink()
    image_paths(out, rows[1])[0].unlink()
    tiff = image_paths(out, rows[2])[1]
    tiff.write_bytes(tiff.read_bytes()[:-1] + b"\xff")
    image_paths(out, rows[3])[2].write_bytes(b"")
    unreadable = image_paths(out, rows[4])[1]
    unreadable.unlink()
    unreadable.mkdir()
    decision = next(out.glob("*/decisions/*.json"))
    decision.write_bytes(decision.read_bytes() + b" ")
    caplog.clear()
    filled.verify(1e9, DAY_S)
    assert filled.defect_counts() == {"missing": 2, "changed": 3, "unreadable": 1, "conflicting": 0}
    filled.verify(1e9 + 2 * DAY_S, DAY_S)
    assert [record.message for record in caplog.records] == ["Stored files differ from the archive"]
    assert main(["c2", "ls", "--archive", str(out)]) == 0
    text = capsys.readouterr().out
    assert [text.count(f"1 ({fault})") for fault in ("missing", "changed", "unreadable")] == [2, 2, 1]
    # Restored files, and those of an image that arrives again, are no longer reported.
    first.write_bytes(content)
    assert filled.store_image(image("0001"), 5.0).is_new
    filled.flush()
    assert filled.index().defect_counts()["missing"] == 1
    filled.verify(1e9 + 4 * DAY_S, DAY_S)
    assert filled.defect_counts()["missing"] == 0


def test_service_compares_its_files_and_warns(begin, relay, out, monkeypatch):
    monkeypatch.setattr("sonarpost.services.c2.service.VERIFICATION_INTERVAL_S", 0.05)
    service = begin(verify_days=1e-6)
    relay.send(INBOX, "c2", *(relayed(image(value=n, start_s=START_S + 0.4 * n)) for n in (0, 1)))
    eventually(lambda: service.health().counters.get("images_conflicting") == 1)
    eventually(lambda: service.health().detail == f"{out}: stored records 1 conflicting")
    assert service.health().state == "ok"
    next(out.glob("*/*.png")).unlink()
    eventually(lambda: service.health().gauges["records_missing"] == 1)
    assert service.health().detail == f"{out}: stored records 1 missing, 1 conflicting"


# Retention


def row(name, accepted_utc_s=0.0, size_bytes=100, exported_utc_s=None, **changes):
    fields = dict.fromkeys(("relayed_utc_s",))
    fields |= dict.fromkeys(("first_frame_utc_s", "last_frame_utc_s", "missing_fraction"), 0.0)
    fields |= {"vessel_id": "vessel-1", "vehicle_id": "uuv-1", "image_id": "AAAA", "version": 1, "complete": True}
    fields |= {"height_px": 1, "width_px": 1, "codec": "vq", "accepted_utc_s": accepted_utc_s}
    return ImageRow(name=name, size_bytes=size_bytes, exported_utc_s=exported_utc_s, **fields | changes)


def test_retention_removes_exported_images_first_then_the_oldest():
    rows = [row("a", 1), row("b", 2), row("c", 3, exported_utc_s=9.0), row("d", 4, exported_utc_s=9.0)]
    assert [r.name for r in select_images(rows, (), 10.0, None, 250)] == ["c", "d"]
    assert [r.name for r in select_images(rows, (), 10.0, None, 100)] == ["c", "d", "a"]
    assert select_images(rows, (), 10.0, None, 400) == []


def test_vessel_that_floods_displaces_no_image_of_another():
    good = [row(f"good-{n}", n, vessel_id="vessel-1", exported_utc_s=9.0) for n in range(20)]
    junk = [row(f"junk-{n}", 100 + n, vessel_id="vessel-2") for n in range(3000)]
    removed = select_images([*junk, *good], (), 10.0, None, 5000)
    assert [r.name for r in removed] == [f"junk-{n}" for n in range(2970)]


def test_images_with_a_decision_are_removed_last():
    decision = DecisionRow.of(decision_record(vehicle_id="uuv-1", image_id="BBBB"), 5.0, "")
    rows = [row("a", 1), row("b", 2, image_id="BBBB"), row("c", 3, exported_utc_s=9.0)]
    assert [r.name for r in select_images(rows, [decision], 10.0, None, 100)] == ["c", "a"]
    assert [r.name for r in select_images(rows, [decision], 10.0, None, 0)] == ["c", "a", "b"]


def test_retention_removes_old_images_below_the_size_limit():
    rows = [row("old", START_S), row("new", START_S + 5 * DAY_S)]
    now_utc_s = START_S + 6 * DAY_S
    assert [r.name for r in select_images(rows, (), now_utc_s, 3.0, None)] == ["old"]
    assert [r.name for r in select_images(rows, (), now_utc_s, 3.0, 10)] == ["old", "new"]


@given(
    st.lists(st.tuples(st.floats(0, 1e6), st.integers(0, 1000), st.booleans()), max_size=20),
    st.none() | st.floats(0.001, 20),
    st.none() | st.integers(0, 5000),
)
def test_retention_keeps_the_limits_and_removes_no_more_than_needed(images, days, limit):
    rows = [row(str(n), START_S + at, size, 1.0 if done else None) for n, (at, size, done) in enumerate(images)]
    now_utc_s = max((r.accepted_utc_s for r in rows), default=START_S)
    removed = select_images(rows, (), now_utc_s + 1e6, days, limit)
    assert removed == select_images(rows, (), now_utc_s, days, limit)
    kept = [r for r in rows if r not in removed]
    assert len(removed) == len(set(removed))
    if days is not None:
        assert all(now_utc_s - r.accepted_utc_s <= days * DAY_S for r in kept)
    if limit is not None:
        assert sum(r.size_bytes for r in kept) <= limit
    if removed and limit is not None and (days is None or now_utc_s - removed[-1].accepted_utc_s <= days * DAY_S):
        assert sum(r.size_bytes for r in kept) + removed[-1].size_bytes > limit
    if days is None and limit is None:
        assert removed == []


def test_retention_deletes_files_and_keeps_decisions(open_files, out):
    kept = open_files(max_bytes=0)
    for image_id in ("AAAA", "BBBB"):
        kept.store_image(image(image_id), 5.0)
    kept.store_decision(decision_record())
    kept.flush()
    assert [r.image_id for r in kept.apply_retention(1e9)] == ["BBBB", "AAAA"]
    assert [p.name for p in out.rglob("*") if p.is_file() and FILE_NAME not in p.name] == [f"{b'd1'.hex()}.json"]
    assert kept.images_bytes() == 0
    assert [r.removed_utc_s is None for r in kept.index().images(removed=True)] == [False, False]
    assert len(kept.index().decisions()) == 1
    assert kept.apply_retention(2e9) == []


def test_images_are_stored_while_retention_selects(open_files, monkeypatch):
    archive = open_files(max_bytes=0)
    archive.store_image(image("AAAA"), 5.0)
    archive.flush()

    def store():
        archive.store_image(image("BBBB"), 5.0)
        archive.flush()

    def select(images, *_):
        thread = threading.Thread(target=store)
        thread.start()
        thread.join(WAIT_S)
        return images

    monkeypatch.setattr(c2_archive, "select_images", select)
    assert [r.image_id for r in archive.apply_retention(1e9)] == ["AAAA"]
    assert [r.image_id for r in archive.index().images()] == ["BBBB"]


def test_service_removes_counts_and_logs(begin, relay, out, caplog):
    service = begin(max_bytes=0)
    relay.send(INBOX, "c2", relayed(image()))
    eventually(lambda: service.health().counters.get("images_removed") == 1)
    assert service.health().gauges["images_bytes"] == 0
    assert list(out.glob("*/*.tiff")) == []
    assert "Image removed by retention" in [record.message for record in caplog.records]


# Version


def test_c2_does_not_start_with_an_archive_of_another_version(filled, platform, out):
    with filled.index().database.transaction() as sql:
        sql.exec_driver_sql("UPDATE archive SET version = 7")
    filled.close()
    service = C2Service(platform("shore-1"), C2Config(out_dir=out))
    with pytest.raises(StoredFileError, match=r"archive\.db: version: got 7, expected 1"):
        service.start()
    service._archive.close()
    service.store.close()


def test_other_file_is_not_an_archive(tmp_path):
    (tmp_path / FILE_NAME).write_bytes(b"no database" * 100)
    for writable in (True, False):
        archive = open_archive(tmp_path, writable=writable)
        with pytest.raises(StoredFileError, match=r"archive\.db"):
            archive.database.prepare()
        archive.close()


def test_image_is_found_by_name_and_newest_version():
    rows = [row("f1", version=1), row("f2", version=2), row("g", vessel_id="vessel-2", vehicle_id="uuv-2")]
    assert find_image(rows, "uuv-1/AAAA", None, None).name == "f2"
    assert find_image(rows, "uuv-1/AAAA", None, 1).name == "f1"
    assert find_image(rows, "g", None, None).name == "g"
    with pytest.raises(StoredFileError, match="an image that"):
        find_image(rows, "uuv-1/ZZZZ", None, None)
    twice = [*rows, row("h", first_frame_utc_s=9.0)]
    with pytest.raises(StoredFileError, match="one image, with --vessel or by the name of its files"):
        find_image(twice, "uuv-1/AAAA", None, None)
