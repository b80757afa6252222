"""Contract of the journal in both dialects: order of the numbers, searches, decisions, numbers of other archives."""

import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from types import SimpleNamespace

import pytest
from builders import shore
from builders.records import decision_record

from sonarpost.archive import database as database_module
from sonarpost.archive import journal as module
from sonarpost.archive.image_files import SUFFIXES
from sonarpost.archive.journal import Area, Criteria, JournalEntry
from sonarpost.archive.reader import open_archive
from sonarpost.archive.shore_archive import Batch, StoredImage
from sonarpost.archive.shore_files import row_of_image
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
    return [each.columns(100.0 + number) for number, each in enumerate(entries)]


def stored(record, name):
    contents = (name.encode(), b"tiff", b"png")
    row = row_of_image(name, record, 1.0, 5.0, contents)
    return StoredImage(row, tuple(zip(SUFFIXES, contents, strict=True)))


def number(archive, *entries):
    return archive.write(Batch(numbered=columns(*entries)))


def seqs(numbered):
    return [accepted.seq for accepted in numbered]


def read(archive, criteria=ALL):
    journal = archive.journal
    rows = journal.page(journal.known_keys(), criteria, 0, 1000)
    return [(r.accepted.seq, str(r.fields.get("decision_id", r.fields["image_id"]))) for r in rows]


def test_reader_of_pages_gets_every_record_once_while_several_c2_number(open_):
    """A number that becomes visible before a lower one would be lost for a reader whose cursor is above it."""
    each, hosts, batch = 60, 4, 3
    opened = [open_(f"c2-{n}") for n in range(hosts + 1)]
    opened[0].database.prepare()
    reader = opened[-1].journal
    ended = threading.Event()

    def accept(host):
        for first in range(0, each, batch):
            ids = [f"{host}{n:03d}" for n in range(first, first + batch)]
            number(opened[host], *(entry(decision_record(i, image_id=i)) for i in ids))

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
    assert sorted(found) == sorted(f"{host}{n:03d}" for host in range(hosts) for n in range(each))
    assert reader.position()[1] == hosts * each


def test_repeated_record_keeps_number_and_time(archive):
    one, two = entry(image("0001"), "a"), entry(decision_record("d1", image_id="0001"))
    first = number(archive, one, two, one)
    assert seqs(first) == [1, 2, 1]
    # The same files with a record that differs, as one that was restored from the files.
    other = entry(image("0001").model_copy(update={"notes": ("other",)}), "a")
    again = number(archive, entry(image("0002"), "b"), two, other)
    assert seqs(again) == [3, 2, 1]
    assert again[1] == first[1]
    assert archive.journal.position() == (first[0].archive, 3)


def test_searches_find_the_records_of_their_criteria(archive):
    number(
        archive,
        entry(image("0001"), "a"),
        entry(image("0001", version=2), "b"),
        entry(image("0002", lat=-20.0, lon=179.5), "c"),
        entry(decision_record("d1", image_id="0001")),
        entry(decision_record("d2", image_id="0001", operator="other", verdict="unsure")),
        entry(decision_record("d3", image_id="0002", verdict="not_mine_like")),
    )
    assert archive.journal.known_keys() == [DECISIONS, IMAGES]
    for criteria, expected in (
        (ALL, [1, 2, 3, 4, 5, 6]),
        (Criteria(latest=True), [2, 3, 4, 5, 6]),
        (Criteria(since_utc_s=101.0, until_utc_s=104.0), [2, 3, 4]),
        (Criteria(vessel_id="vessel-1", vehicle_id="uuv-1"), [1, 2, 3, 4, 5, 6]),
        (Criteria(vehicle_id="uuv-2"), []),
        (Criteria(area=Area(55.0, -6.0, 57.0, -4.0)), [1, 2, 4, 5]),
        (Criteria(area=Area(-30.0, 179.0, 0.0, -179.0)), [3, 6]),
        (Criteria(review="disputed"), [1, 2, 4, 5]),
        (Criteria(review="not_mine_like", latest=True), [3, 6]),
        (Criteria(review="unreviewed"), []),
    ):
        found = archive.journal.page([IMAGES, DECISIONS], criteria, 0, 100)
        assert [row.accepted.seq for row in found] == expected, criteria
        part = archive.journal.page([IMAGES, DECISIONS], criteria, 2, 2)
        assert [row.accepted.seq for row in part] == [seq for seq in expected if seq > 2][:2]
    [row] = archive.journal.page([IMAGES], ALL, 2, 1)
    assert (row.accepted.utc_s, row.key, row.vessel_id, row.name) == (102.0, IMAGES, "vessel-1", "c")
    assert (row.fields["image_id"], row.fields["pixels"]["data"]) == ("0002", b"")


def test_search_of_sqlite_is_limited_in_processor_time_and_not_by_a_busy_machine(tmp_path, monkeypatch):
    archive = open_archive(tmp_path)
    number(archive, entry(image("0001"), "a"))
    clocks = SimpleNamespace(monotonic=count(0, 1000).__next__, thread_time=lambda: 0.0)
    monkeypatch.setattr(database_module, "time", clocks)
    monkeypatch.setattr(database_module, "_STEPS", 1)
    assert len(archive.journal.page([IMAGES], ALL, 0, 100)) == 1
    clocks.thread_time = count(0, 1000).__next__
    with pytest.raises(OSError, match="interrupted"):
        archive.journal.page([IMAGES], ALL, 0, 100)
    archive.close()


def test_removed_image_is_removed_from_the_journal(archive):
    archive.write(
        Batch(
            images=[stored(image("0001"), "a"), stored(image("0002"), "b")],
            numbered=columns(entry(image("0001"), "a"), entry(image("0002"), "b"), entry(decision_record("d1"))),
        )
    )
    archive.mark("removed_utc_s", [row for row in archive.images() if row.name == "b"], 9.0)
    assert read(archive) == [(1, "0001"), (3, "d1")]
    assert archive.journal.position()[1] == 3


# Results of decisions


def decision(number, verdict, operator="op"):
    return entry(decision_record(f"d{number}", verdict=verdict, operator=operator, decided_utc_s=float(number)))


def state(archive):
    states = ("unreviewed", "mine_like", "not_mine_like", "unsure", "disputed")
    (found,) = [each for each in states if archive.journal.page([DECISIONS], Criteria(review=each), 0, 1)]
    return found


def test_the_newest_decisions_on_an_image_count_for_its_state(archive, monkeypatch):
    monkeypatch.setattr(module, "MAX_REVIEWED", 3)
    number(archive, decision(1, "mine_like", "ann"), decision(2, "not_mine_like", "ben"))
    assert state(archive) == "disputed"
    number(archive, decision(3, "not_mine_like", "ben"), decision(4, "not_mine_like", "ben"))
    assert state(archive) == "not_mine_like"


def test_decisions_on_an_image_that_arrive_together_are_read_once(archive, monkeypatch):
    read_rows = []
    review_state = module.review_state

    def counted(payloads, where):
        payloads = list(payloads)
        read_rows.append(len(payloads))
        return review_state(payloads, where)

    monkeypatch.setattr(module, "review_state", counted)
    number(archive, *(decision(n, "unsure") for n in range(100)))
    assert read_rows == [100]
    assert state(archive) == "unsure"


# Numbers of another archive


def test_first_journal_keeps_its_numbers_and_later_ones_follow(archive, tmp_path):
    archive.write(Batch(images=[stored(image("0001"), "a"), stored(image("0003"), "c")]))
    first, second = open_archive(tmp_path / "first"), open_archive(tmp_path / "second")
    for each in (entry(image("0001"), "a"), entry(image("0002"), "removed")):
        number(first, each)
    number(first, entry(decision_record("d1")), entry(image("0009"), "also-removed"))
    first.mark("removed_utc_s", [stored(image("0009"), "also-removed").row], 9.0)
    number(second, entry(decision_record("d1")), entry(image("0003"), "c"), entry(decision_record("d2")))
    assert archive.adopt_numbers(first) == 2
    assert archive.journal.position() == (first.journal.position()[0], 4)
    assert read(archive) == [(1, "0001"), (3, "d1")]
    assert archive.adopt_numbers(second) == 2
    assert archive.adopt_numbers(second) == archive.adopt_numbers(first) == 0
    assert read(archive) == [(1, "0001"), (3, "d1"), (5, "0003"), (6, "d2")]
    assert seqs(number(archive, entry(decision_record("d3")))) == [7]
    first.close()
    second.close()
