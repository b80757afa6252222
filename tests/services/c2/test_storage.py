"""Contract of the archive of c2, in files and in PostgreSQL."""

import time
from dataclasses import replace
from unittest.mock import Mock

import pytest
from builders.records import command_record, decision_record
from builders.shore import image

from sonarpost import wire
from sonarpost.archive.image_files import PREVIEW_NOTE, side_car_text
from sonarpost.archive.journal import Criteria
from sonarpost.errors import PayloadError
from sonarpost.messages import Decision
from sonarpost.services.c2.accepted import accepted_fields, accepted_payload, payload_of
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.tasking import Tasking

START_S = 1_700_000_000.0
DAY_S = 86400.0


@pytest.fixture
def archive(open_archive):
    return open_archive()


def test_records_are_read_after_the_flush_and_after_a_restart(open_archive):
    archive = open_archive()
    assert archive.store_image(image(), 5.0)[1:] == (True, False)
    assert archive.store_decision(decision_record("d1"))
    archive.flush()
    archive.close()
    archive = open_archive()
    archive.store_image(image("BBBB"), 5.0)
    archive.store_decision(decision_record("d2"))
    index = open_archive().index()
    [row] = index.images()
    assert (row.image_id, row.relayed_utc_s, row.conflict, len(row.files_sha256.split())) == ("AAAA", 5.0, False, 3)
    assert [(each.decision_id, each.verdict) for each in index.decisions()] == [("d1", "mine_like")]


def test_repeated_record_is_stored_once(archive):
    for is_flushed in (False, True):
        new = [archive.store_image(image(), 5.0).is_new, archive.store_decision(decision_record())]
        assert new == [not is_flushed] * 2
        assert not archive.store_image(image(), 5.0).is_new
        assert not archive.store_decision(decision_record())
        archive.flush()
    assert len(archive.index().images()) == 1
    assert len(archive.index().decisions()) == 1


@pytest.mark.parametrize("flush_between", [False, True])
def test_different_record_of_the_same_name_is_a_conflict(archive, flush_between):
    first, second = image(), image(value=2, start_s=START_S + 0.4)
    assert archive.store_image(first, 5.0)[1:] == (True, False)
    archive.store_decision(decision_record("d1"))
    if flush_between:
        archive.flush()
    assert archive.store_image(second, 5.0)[1:] == (True, True)
    with pytest.raises(PayloadError, match="decision_id: got 'd1', expected an identifier that no other decision has"):
        archive.store_decision(decision_record("d1", verdict="not_mine_like"))
    archive.flush()
    for repeated, is_conflict in ((first, False), (second, True)):
        assert archive.store_image(repeated, 6.0)[1:] == (False, is_conflict)
    archive.flush()
    rows = archive.index().images()
    assert [(row.first_frame_utc_s, row.conflict) for row in rows] == [(START_S, False), (START_S + 0.4, True)]
    assert [archive.index().read_files(row.vessel_id, row.name)[".json"] for row in rows] == [
        side_car_text(first),
        side_car_text(second),
    ]
    assert [row.verdict for row in archive.index().decisions()] == ["mine_like"]
    archive.apply_retention(START_S)
    assert archive.defect_counts()["conflicting"] == 1


def test_text_that_a_database_cannot_store_is_kept_in_the_record(archive):
    remark = "NUL \0, quote ', \\u0000, {}, \N{BLACK SQUARE}"
    archive.store_decision(decision_record("d1", remark=remark))
    archive.flush()
    assert not archive.store_decision(decision_record("d1", remark=remark))
    assert archive.index().decisions()[0].remark.endswith(remark[5:])


def test_retention_removes_exported_images_first(open_archive):
    archive = open_archive()
    for number in range(4):
        archive.store_image(image(f"{number:04d}"), 5.0)
    archive.flush()
    size_bytes = archive.index().images()[0].size_bytes
    archive.index().mark("exported_utc_s", [r for r in archive.index().images() if r.image_id == "0002"], 9.0)
    small = open_archive(max_bytes=3 * size_bytes + 2)
    small.index()
    assert [row.image_id for row in small.apply_retention(time.time())] == ["0002"]
    assert small.apply_retention(START_S) == []
    assert [row.image_id for row in small.index().images()] == ["0000", "0001", "0003"]
    assert [row.removed_utc_s is None for row in small.index().images(removed=True)] == [True, True, False, True]
    assert small.images_bytes() == sum(row.size_bytes for row in small.index().images())
    small.verify(1e9, DAY_S)
    assert small.defect_counts()["missing"] == 0
    # An image that arrives again is stored again.
    assert archive.store_image(image("0002"), 5.0).is_new
    archive.flush()
    assert len(archive.index().images()) == 4
    assert not archive.store_image(image("0002"), 5.0).is_new


def test_old_images_are_removed_by_default(archive):
    archive.store_image(image(), 5.0)
    archive.flush()
    assert archive.apply_retention(time.time() + 400 * DAY_S) == [], "a clock that is ahead makes no image old"
    with pytest.MonkeyPatch.context() as patch:
        later_utc_s = time.time() + 366 * DAY_S
        patch.setattr(time, "time", lambda: later_utc_s)
        archive.store_image(image("BBBB"), 5.0)
        archive.flush()
    assert archive.apply_retention(later_utc_s - 2 * DAY_S) == []
    assert [row.image_id for row in archive.apply_retention(later_utc_s)] == ["AAAA"]
    assert [row.image_id for row in archive.index().images()] == ["BBBB"]
    assert C2Config().max_bytes == 50_000_000_000


def test_verification_compares_each_record_once_in_a_cycle_unless_disabled(open_archive, caplog):
    archive = open_archive()
    for number in range(10):
        archive.store_image(image(f"{number:04d}"), 5.0)
    archive.store_decision(decision_record())
    archive.flush()
    caplog.clear()
    assert open_archive(verify_days=0).verify(1e9, DAY_S) == 0
    compared = [archive.verify(1e9 + hour * 3600.0, 3600.0 * 4) for hour in range(0, 24, 4)]
    assert compared == [3, 2, 2, 2, 2, 0]
    assert archive.verify(1e9 + 2.1 * DAY_S, DAY_S) == 11
    assert set(archive.defect_counts().values()) == {0}
    assert not caplog.records


def test_state_of_a_command_is_replaced(archive):
    waiting = Tasking("vessel-1", "command", wire.encode(command_record("refine", "0001", command_id="c1")))
    delivered = replace(waiting, state="delivered", changed_utc_s=3.0)
    assert archive.index().claim_tasking(waiting.row(), waiting.payload) is None
    for each in (waiting, delivered):
        archive.store_state(each)
    assert archive.index().tasking() == [delivered.row()]


@pytest.mark.parametrize("is_interrupted", [False, True])
def test_preview_is_replaced_by_the_whole_and_does_not_replace_it(archive, monkeypatch, is_interrupted):
    preview, whole = image(notes=(PREVIEW_NOTE,)), image(value=2)
    archive.store_image(preview, 5.0)
    [(_, first)] = archive.flush()
    if is_interrupted:
        with monkeypatch.context() as patch:
            patch.setattr(archive.shore.journal, "number", Mock(side_effect=OSError("before the commit")))
            archive.store_image(whole, 5.0)
            with pytest.raises(OSError, match="before the commit"):
                archive.flush()
    assert archive.store_image(whole, 5.0)[1:] == (True, False)
    [(entry, second)] = archive.flush()
    assert second.seq > first.seq, "its number is new, so that subscribers receive it"
    assert archive.store_image(preview, 5.0)[1:] == (False, False)
    archive.flush()
    [row] = archive.index().images()
    assert (row.name, row.conflict) == (entry.name, False)
    journal = archive.index().journal
    [found] = journal.page(journal.known_keys(), Criteria(), 0, 10)
    assert archive.fields(found)["pixels"]["data"] == whole.pixels.data


def test_publication_has_the_bytes_of_its_map(archive):
    for record in (image(), decision_record("d1")):
        if isinstance(record, Decision):
            archive.store_decision(record)
        else:
            archive.store_image(record, 5.0)
    for entry, accepted in archive.flush():
        assert accepted_payload(entry, accepted) == payload_of(accepted_fields(wire.map_of(entry.record), accepted))
