"""Journal in PostgreSQL: order of the numbers, searches as in SQLite, journals of single c2, other versions."""

import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from types import SimpleNamespace

import pytest
from builders import shore
from builders.records import decision_record

from sonarpost.archive import journal as sqlite_journal
from sonarpost.archive.journal import Area, Criteria, Journal, JournalEntry, JournalRecord
from sonarpost.archive.postgresql import ConnectionPool, DatabaseAddress
from sonarpost.archive.shore_database import ShoreDatabase, StoredImage
from sonarpost.archive.shore_files import row_of_image
from sonarpost.errors import StoredFileError
from sonarpost.messages import Contact, Decision

IMAGES, DECISIONS = "sonarpost/v1/shore/contact/vessel-1/image", "sonarpost/v1/shore/contact/vessel-1/decision"
ALL = Criteria()


def image(image_id, lat=56.0, lon=-5.0, **changes):
    contact = Contact(contact_id=image_id, vehicle_id="uuv-1", lat_deg=lat, lon_deg=lon)
    return shore.image(image_id, contact=contact, **changes)


def entry(record, name=""):
    if isinstance(record, Decision):
        subject = record.decision_id
        return JournalEntry(DECISIONS, record, "vessel-1", record.vehicle_id, record.image_id, subject)
    subject = f"{record.vehicle_id}/{record.image_id}"
    version, contact = record.version, record.contact
    return JournalEntry(IMAGES, record, "vessel-1", record.vehicle_id, record.image_id, subject, version, contact, name)


def columns(*entries):
    return [JournalRecord.of(each, 100.0 + number) for number, each in enumerate(entries)]


def stored(record, name):
    contents = (name.encode(), b"tiff", b"png")
    row = row_of_image(name, record, 1.0, 5.0, contents)
    return StoredImage(row, tuple(zip((".json", ".tiff", ".png"), contents, strict=True)))


@pytest.fixture
def archive(database):
    return ShoreDatabase(database, owner="c2-a")


def seqs(numbered):
    return [accepted.seq for accepted in numbered]


def read(archive, criteria=ALL):
    journal = archive.journal()
    rows = journal.page(journal.known_keys(), criteria, 0, 1000)
    return [(r.accepted.seq, str(r.fields.get("decision_id", r.fields["image_id"]))) for r in rows]


def test_reader_of_pages_gets_every_record_once_while_several_c2_number(database_url):
    """A number that becomes visible before a lower one would be lost for a reader whose cursor is above it."""
    each, hosts, batch = 60, 4, 3
    opened = [
        ShoreDatabase(ConnectionPool(DatabaseAddress.parse(database_url)), owner=f"c2-{n}") for n in range(hosts + 1)
    ]
    opened[0].prepare()
    reader = opened[-1].journal()
    ended = threading.Event()

    def accept(host):
        for first in range(0, each, batch):
            ids = [f"{host}{number:03d}" for number in range(first, first + batch)]
            opened[host].write([], numbered=columns(*(entry(decision_record(i, image_id=i)) for i in ids)))

    def follow():
        found = []
        after = 0
        while True:
            last_round = ended.is_set()
            last = reader.position()[1]
            rows = reader.page([DECISIONS], ALL, after, 7)
            found += [str(row.fields["decision_id"]) for row in rows]
            # As in the reply of c2: without further records, the cursor is the last number.
            after = rows[-1].accepted.seq if len(rows) == 7 else max([last, *(r.accepted.seq for r in rows)])
            if last_round and len(rows) < 7:
                return found

    with ThreadPoolExecutor(hosts + 1) as pool:
        following = pool.submit(follow)
        try:
            for done in [pool.submit(accept, host) for host in range(hosts)]:
                done.result()
        finally:
            ended.set()
        found = following.result()
    assert sorted(found) == sorted(f"{host}{number:03d}" for host in range(hosts) for number in range(each))
    assert reader.position()[1] == hosts * each
    for each_host in opened:
        each_host.close()


def test_repeated_record_keeps_number_and_time(archive):
    one, two = entry(image("0001"), "a"), entry(decision_record("d1", image_id="0001"))
    first = archive.write([], numbered=columns(one, two, one))
    assert seqs(first) == [1, 2, 1]
    # The same files with a record that differs, as one that was completed from the files.
    other = entry(image("0001").model_copy(update={"notes": ("other",)}), "a")
    again = archive.write([], numbered=columns(entry(image("0002"), "b"), two, other))
    assert seqs(again) == [3, 2, 1]
    assert again[1] == first[1]
    assert archive.journal().position() == (first[0].archive, 3)


def test_failed_write_leaves_no_number(archive):
    archive.write([], [], numbered=columns(entry(image("0001"), "a")))
    broken = stored(image("0002"), "b")
    broken = StoredImage(broken.row, ((".json", None),))
    with pytest.raises(Exception, match="content"):
        archive.write([broken], numbered=columns(entry(image("0002"), "b")))
    assert read(archive) == [(1, "0001")]
    assert archive.images() == []
    assert seqs(archive.write([], numbered=columns(entry(image("0003"), "c")))) == [2]


def test_searches_find_what_those_of_sqlite_find(archive, tmp_path):
    entries = [
        entry(image("0001"), "a"),
        entry(image("0001", version=2), "b"),
        entry(image("0002", lat=-20.0, lon=179.5), "c"),
        entry(decision_record("d1", image_id="0001")),
        entry(decision_record("d2", image_id="0001", operator="other", verdict="unsure")),
        entry(decision_record("d3", image_id="0002", verdict="not_mine_like")),
    ]
    numbered = columns(*entries)
    archive.write([], numbered=numbered)
    journal = Journal(tmp_path)
    journal.append_dated([(each, record.accepted_utc_s) for each, record in zip(entries, numbered, strict=True)])
    shared = archive.journal()
    assert shared.known_keys() == journal.known_keys() == [DECISIONS, IMAGES]
    lengths = []
    for criteria in (
        ALL,
        Criteria(latest=True),
        Criteria(since_utc_s=101.0, until_utc_s=104.0),
        Criteria(vessel_id="vessel-1", vehicle_id="uuv-1"),
        Criteria(vehicle_id="uuv-2"),
        Criteria(area=Area(55.0, -6.0, 57.0, -4.0)),
        Criteria(area=Area(-30.0, 179.0, 0.0, -179.0)),
        Criteria(review="disputed"),
        Criteria(review="not_mine_like", latest=True),
        Criteria(review="unreviewed"),
    ):
        for after, limit in ((0, 100), (2, 2)):
            expected, found = (
                [
                    (row.accepted.seq, row.accepted.utc_s, row.key, row.encoding, row.fields, row.vessel_id, row.name)
                    for row in each.page([IMAGES, DECISIONS], criteria, after, limit)
                ]
                for each in (journal, shared)
            )
            assert found == expected
            lengths.append(len(found))
    assert lengths[:4] == [6, 2, 5, 2]
    journal.close()


def test_search_of_sqlite_is_limited_in_processor_time_and_not_by_a_busy_machine(tmp_path, monkeypatch):
    clocks = SimpleNamespace(monotonic=count(0, 1000).__next__, thread_time=lambda: 0.0)
    monkeypatch.setattr(sqlite_journal, "time", clocks)
    monkeypatch.setattr(sqlite_journal, "_STEPS", 1)
    journal = Journal(tmp_path)
    journal.append_dated([(entry(image("0001"), "a"), 100.0)])
    assert len(journal.page([IMAGES], ALL, 0, 100)) == 1
    clocks.thread_time = count(0, 1000).__next__
    with pytest.raises(OSError, match="interrupted"):
        journal.page([IMAGES], ALL, 0, 100)
    journal.close()


def test_removed_image_is_removed_from_the_journal(archive):
    archive.write(
        [stored(image("0001"), "a"), stored(image("0002"), "b")],
        numbered=columns(entry(image("0001"), "a"), entry(image("0002"), "b"), entry(decision_record("d1"))),
    )
    archive.mark("removed_utc_s", [row for row in archive.images() if row.name == "b"], 9.0)
    assert read(archive) == [(1, "0001"), (3, "d1")]
    assert archive.journal().position()[1] == 3


# Journals of single c2, records without a number, other versions


@pytest.fixture
def own(tmp_path):
    return lambda name: Journal(tmp_path / name)


def test_first_journal_keeps_its_numbers_and_later_ones_follow(archive, own):
    archive.write([stored(image("0001"), "a"), stored(image("0003"), "c")])
    first, second = own("first"), own("second")
    for number, each in enumerate((entry(image("0001"), "a"), entry(image("0002"), "removed"))):
        first.append([each], 10.0 + number)
    first.append([entry(decision_record("d1")), entry(image("0009"), "also-removed")], 12.0)
    first.remove([("vessel-1", "also-removed")])
    second.append([entry(decision_record("d1")), entry(image("0003"), "c"), entry(decision_record("d2"))], 13.0)
    assert archive.adopt_journal(first) == 2
    assert archive.journal().position() == (first.archive, 4)
    assert read(archive) == [(1, "0001"), (3, "d1")]
    assert archive.adopt_journal(second) == 2
    assert archive.adopt_journal(second) == archive.adopt_journal(first) == 0
    assert read(archive) == [(1, "0001"), (3, "d1"), (5, "0003"), (6, "d2")]
    assert archive.journal().position() == (first.archive, 6)
    assert seqs(archive.write([], numbered=columns(entry(decision_record("d3"))))) == [7]
    first.close()
    second.close()


def test_images_without_a_number_are_found(archive):
    archive.write([stored(image("0001"), "a")])
    assert [row.name for row in archive.images_without_number()] == ["a"]
    archive.write([], numbered=columns(entry(image("0001"), "a")))
    assert archive.images_without_number() == []


@pytest.mark.parametrize("version", [2, 4])
def test_database_of_another_version_is_refused(database, version):
    ShoreDatabase(database).prepare()
    with database.transaction() as sql:
        sql.rows("UPDATE sonarpost.archive SET version = :version", version=version)
    for writable in (True, False):
        with pytest.raises(StoredFileError, match=f"version: got {version}, expected 3"):
            ShoreDatabase(database, writable=writable).prepare()
