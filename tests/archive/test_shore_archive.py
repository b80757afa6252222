"""Contract of the archive of a shore site in both dialects: tables, writes, files, verification, tasking."""

import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
from builders import shore
from builders.postgresql import execute
from builders.records import decision_record

from sonarpost.archive.backlog import BacklogRecord
from sonarpost.archive.image_files import SUFFIXES
from sonarpost.archive.journal import JournalEntry
from sonarpost.archive.reader import open_archive
from sonarpost.archive.rows import DecisionRow, TaskingRow
from sonarpost.archive.shore_archive import Batch, StoredImage
from sonarpost.archive.shore_files import decision_name, decision_text, image_paths, row_of_image
from sonarpost.errors import ConfigError, DatabaseUnavailableError, StoredFileError
from sonarpost.messages import Contact

UNAVAILABLE = (OSError, DatabaseUnavailableError)
KEY = "sonarpost/v1/shore/contact/vessel-1/image"


def stored(image_id="AAAA", text=b"{}", **changes):
    contact = Contact(contact_id="c", vehicle_id="uuv-1", lat_deg=56.0, lon_deg=-5.0, atd_class="clutter")
    contents = (text, b"tiff", b"png")
    row = row_of_image(f"name_{image_id}", shore.image(image_id, contact=contact), 1.0, 5.0, contents)
    return StoredImage(replace(row, conflict=False, **changes), tuple(zip(SUFFIXES, contents, strict=True)))


def decided(decision_id="d1", **changes):
    decision = decision_record(decision_id, **changes)
    text = decision_text(decision)
    return DecisionRow.of(decision, 5.0, sha256(text).hexdigest()), text


def columns(image_id):
    record = shore.image(image_id)
    return JournalEntry(KEY, record, "vessel-1", "uuv-1", image_id, image_id, name=f"name_{image_id}").columns(5.0)


def command_row(record_id="c1", **changes):
    fields = {
        "vessel_id": "vessel-1", "kind": "command", "record_id": record_id, "vehicle_id": "uuv-1", "image_id": None,
        "summary": "refine", "author": "expert", "issued_utc_s": 1.0, "state": "waiting", "reason": "",
        "changed_utc_s": 2.0,
    }  # fmt: skip
    return TaskingRow(**(fields | changes))


# Tables


def test_concurrent_starts_create_one_archive(open_):
    made = [open_(site="shore") for _ in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda each: each.database.prepare(), made))
    assert {each.journal.position() for each in made} == {made[0].journal.position()}
    assert [each.database.is_new for each in made].count(True) == 1


@pytest.mark.parametrize("version", [0, 2])
def test_archive_of_another_version_is_refused(open_, archive, version):
    archive.database.prepare()
    execute(archive, f"UPDATE archive SET version = {version}")
    for writable in (True, False):
        with pytest.raises(StoredFileError, match=f"version: got {version}, expected 1"):
            open_(writable=writable).database.prepare()
    with pytest.raises(UNAVAILABLE, match=f"version: got {version}, expected 1"):
        open_().images()


def test_archive_of_another_site_is_refused(open_):
    open_(site="shore").database.prepare()
    with pytest.raises(ConfigError, match="site: got 'north', expected shore"):
        open_(site="north").database.prepare()


def test_archive_is_not_created_by_a_command(open_):
    for _ in range(2):
        with pytest.raises(StoredFileError, match=r"no such file|version: got 0"):
            open_(writable=False).database.prepare()


# Writes


def test_rows_and_files_are_returned_as_written(archive):
    image = stored(text=b'{"remark": "\\u0000"}', codec="e\0b")
    archive.write(Batch(images=[image], decisions=[decided()]))
    [row] = archive.images()
    assert row == replace(image.row, codec="e\ufffdb")
    assert archive.decisions() == [decided()[0]]
    files = dict(image.files)
    assert archive.read_files(row.vessel_id, row.name) == files
    assert archive.read_files("vessel-1", decision_name("d1"), SUFFIXES[:1]) == {".json": decided()[1]}
    assert archive.mark("removed_utc_s", [row], 9.0) == [row]
    assert archive.mark("removed_utc_s", [row], 9.0) == []
    with pytest.raises(StoredFileError, match=r"name_AAAA\.json"):
        archive.read_files(row.vessel_id, row.name)
    archive.write(Batch(images=[image]))
    assert archive.read_files(row.vessel_id, row.name) == files


def test_same_image_of_several_c2_is_stored_once(open_):
    images = [stored(f"{number:04d}") for number in range(20)]
    start = threading.Barrier(4)

    def write(number):
        archive = open_(f"c2-{number}")
        start.wait()
        for first in range(0, 20, 5):
            archive.write(Batch(images=images[first : first + 5][:: 1 if number % 2 else -1]))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(4)))
    assert len(open_().images()) == 20


def test_another_content_under_a_name_is_not_written(archive):
    archive.write(Batch(images=[stored("AAAA")], decisions=[decided()] * 1))
    with pytest.raises(DatabaseUnavailableError, match="another image under the same name"):
        archive.write(Batch(images=[stored("BBBB"), stored("AAAA", b"other")]))
    with pytest.raises(DatabaseUnavailableError, match="another decision"):
        archive.write(Batch(decisions=[decided(verdict="not_mine_like")]))
    archive.write(Batch(decisions=[decided()]))
    assert [row.image_id for row in archive.images()] == ["AAAA"]
    assert [row.verdict for row in archive.decisions()] == ["mine_like"]
    # Unless the first one is replaced, with its number.
    before = archive.write(Batch(numbered=[columns("AAAA")]))
    archive.write(Batch(images=[stored("AAAA", b"other")], replaced=[("vessel-1", "name_AAAA")]))
    assert archive.read_files("vessel-1", "name_AAAA")[".json"] == b"other"
    assert archive.write(Batch(numbered=[columns("AAAA")]))[0].seq == before[0].seq + 1


def test_row_number_and_end_of_the_acceptance_are_one_transaction(archive):
    part = BacklogRecord("some/key", b"part", "vessel-1")
    archive.write(Batch(waiting=[part], numbered=[columns("0001")]))
    broken = StoredImage(replace(stored("0002").row, codec=None), stored("0002").files)
    with pytest.raises(Exception, match="codec"):
        archive.write(Batch(images=[broken], finished=[part], numbered=[columns("0002")]))
    assert (archive.images(), archive.backlog.count(), archive.journal.position()[1]) == ([], 1, 1)
    archive.write(Batch(images=[stored("0002")], finished=[part], numbered=[columns("0002")]))
    assert (len(archive.images()), archive.backlog.count(), archive.journal.position()[1]) == (1, 0, 2)


def test_coded_images_wait_in_the_order_of_their_acceptance(open_):
    first, other = open_("c2-a"), open_("c2-b")
    parts = [BacklogRecord("key", b"part %d" % number, "vessel-1") for number in range(40)]
    if first.database.is_shared:
        first.backlog.accept([replace(part, vessel_id="") for part in parts])
        assert first.backlog.waiting_vessels() == other.backlog.waiting_vessels() == []
    first.write(Batch(waiting=parts[:20]))
    first.write(Batch(waiting=parts[20:]))
    first.write(Batch(waiting=parts[20:]))  # received again
    assert (first.backlog.waiting_vessels(), first.backlog.waiting_count) == (["vessel-1"], 40)
    found = first.backlog.waiting("vessel-1", 0, 30)
    assert [record.payload for record in found] == [part.payload for part in parts[:30]]
    rest = first.backlog.waiting("vessel-1", found[-1].id, 30)
    assert [record.payload for record in rest] == [part.payload for part in parts[30:]]
    first.write(Batch(finished=rest))
    assert first.backlog.waiting_record(rest[0].id) is None
    first.write(Batch(waiting=parts[30:]))
    again = first.backlog.waiting("vessel-1", rest[-1].id, 30)
    assert len(again) == 10, "a number is never used again"


# Verification


def test_changed_and_missing_files_are_found(archive):
    archive.write(Batch(images=[stored(f"{number:04d}") for number in range(3)], decisions=[decided()]))
    if archive.folder is None:
        execute(archive, "UPDATE file SET content = 'x' WHERE name = 'name_0000' AND suffix = '.png'")
        execute(archive, "DELETE FROM file WHERE name = 'name_0001' AND suffix = '.png'")
    else:
        image_paths(archive.folder, stored("0000").row)[2].write_bytes(b"x")
        image_paths(archive.folder, stored("0001").row)[2].unlink()
    found = {getattr(r.row, "name", "decision"): r.fault for r in archive.verify(1e9, 86400.0, 86400.0)}
    assert found == {"name_0000": "changed", "name_0001": "missing", "name_0002": "", "decision": ""}
    assert archive.defect_counts() == {"missing": 1, "changed": 1, "unreadable": 0, "conflicting": 0}
    assert archive.verify(1e9 + 60, 60.0, 86400.0) == []
    archive.write(Batch(images=[stored("0000"), stored("0001")]))
    assert set(archive.defect_counts().values()) == {0}
    archive.verify(1e9 + 2 * 86400, 86400.0, 86400.0)
    assert set(archive.defect_counts().values()) == {0}


# Tasking


def test_older_state_does_not_replace_a_newer_one(archive):
    assert archive.claim_tasking(command_row(), b"payload") is None
    archive.write(Batch(tasking=[command_row(state="delivered", changed_utc_s=5.0)]))
    archive.write(Batch(tasking=[command_row(state="waiting", changed_utc_s=2.0)]))
    assert [(row.state, row.changed_utc_s) for row in archive.tasking()] == [("delivered", 5.0)]
    assert archive.foreign_tasking("vessel-1", "command", "c1") is None


# Files in a folder


def files_in(folder):
    return sorted(path.name for path in folder.glob("vessel-1/*.*"))


def test_image_whose_files_cannot_be_written_is_not_stored(tmp_path):
    archive = open_archive(tmp_path / "out")
    archive.write(Batch(images=[stored("0001")]))
    (archive.folder / "vessel-1").rename(tmp_path / "elsewhere")
    (archive.folder / "vessel-1").write_text("not a folder")
    batch = Batch(images=[stored("0002")], numbered=[columns("0002")])
    with pytest.raises(OSError, match="vessel-1"):
        archive.write(batch)
    assert (len(archive.images()), archive.journal.position()[1]) == (1, 0)
    (archive.folder / "vessel-1").unlink()
    (tmp_path / "elsewhere").rename(archive.folder / "vessel-1")
    archive.write(batch)
    assert (len(archive.images()), archive.journal.position()[1]) == (2, 1)
    assert files_in(archive.folder) == [f"name_000{n}{suffix}" for n in (1, 2) for suffix in (".json", ".png", ".tiff")]
    assert execute(archive, "SELECT count(*) FROM file")[0][0] == 0
    archive.close()


KILLED = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from archive.test_shore_archive import Batch, columns, decided, stored
from pathlib import Path
from sonarpost.archive import shore_archive
from sonarpost.archive.backlog import BacklogRecord
from sonarpost.archive.reader import open_archive
archive = open_archive(Path({folder!r}))
part = BacklogRecord("some/key", b"part", "vessel-1")
batch = Batch(images=[stored()], decisions=[decided()], finished=[part], numbered=[columns("AAAA")])
if {first}:
    archive.write(Batch(waiting=[part]))
    archive.journal.number = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
archive.write(batch)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_kill_before_or_after_the_commit_leaves_no_row_or_everything(tmp_path):
    folder = tmp_path / "out"
    for first in (True, False):
        script = KILLED.format(tests=str(Path(__file__).parents[1]), folder=str(folder), first=first)
        status = subprocess.run([sys.executable, "-c", script], env=dict(os.environ), check=False).returncode
        assert status == -signal.SIGKILL
        archive = open_archive(folder)
        last = archive.journal.position()[1]
        found = (len(archive.images()), len(archive.decisions()), last, archive.backlog.count())
        assert found == ((0, 0, 0, 1) if first else (1, 1, 1, 0))
        if not first:
            assert len(files_in(folder)) == 3
            assert [result.fault for result in archive.verify(1e9, 86400.0, 86400.0)] == ["", ""]
        archive.close()


def test_no_connection_outlives_the_end(archive):
    with archive.database.transaction() as sql:
        used = sql.connection
        archive.close()
        assert used.is_valid
    assert not used.is_valid
    with pytest.raises((OSError, DatabaseUnavailableError), match="closed"):
        archive.images()
