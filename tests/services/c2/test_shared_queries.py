"""Two c2 with one archive in PostgreSQL: each replies to queries for the records of both."""

import shutil
import threading
from contextlib import contextmanager

import msgpack
import numpy as np
import pytest
import zenoh
from builders.common import eventually, free_port
from builders.records import decision_record, reconstructed_image

from sonarpost import keys, wire
from sonarpost.archive.journal import FILE_NAME, Journal
from sonarpost.archive.shore_database import ShoreDatabase
from sonarpost.bus.catch_up import CatchUpSubscriber
from sonarpost.messages import Pixels, ReconstructedImage, Relayed
from sonarpost.services.c2 import queries
from sonarpost.services.c2.accepted import AcceptedRecords
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

VESSEL = "vessel-1"
CONTACTS = "sonarpost/v1/shore/contact/*/*"


def image(number):
    pixels = np.full((20, 30), number + 1, np.uint8)
    return reconstructed_image(Pixels.from_array(pixels), vessel_id=VESSEL, image_id=f"{number:04d}")


@pytest.fixture(autouse=True)
def short_intervals(monkeypatch):
    monkeypatch.setattr("sonarpost.services.c2.service.TAKE_OVER_INTERVAL_S", 0.1)
    monkeypatch.setattr("sonarpost.services.c2.shared_archive.TAKE_OVER_AFTER_S", 0.5)
    # These tests query faster than clients may.
    monkeypatch.setattr(queries, "BURST", 1e9)


@pytest.fixture
def begin(runner, platform, database_url):
    def start(host, **options):
        config = C2Config(**{"database": database_url, **options})
        return runner.start(C2Service(platform(host), config))

    return start


def give(host, *records):
    """Let this c2 accept records, as its inbox does."""
    pairs = []
    for record in records:
        is_image = isinstance(record, ReconstructedImage)
        key = keys.image_reconstructed(VESSEL) if is_image else keys.contact_decision(VESSEL)
        envelope = Relayed(vessel_id=VESSEL, key=key, payload=wire.encode(record), relayed_utc_s=5.0)
        pairs.append((keys.shore_inbox(VESSEL), wire.encode(envelope)))
    host.before_accepting(pairs)
    host._store_taken(pairs)


def handled(*hosts):
    return sum(host.health().counters.get("records_handled", 0) for host in hosts)


def identity(payload):
    fields = msgpack.unpackb(payload)
    return str(fields.get("decision_id", fields["image_id"]))


class Reader:
    """A subscriber in a thread, with the records that it has received."""

    def __init__(self, session, cursor=""):
        self.records = []
        self.subscriber = CatchUpSubscriber(session, CONTACTS, cursor, refresh_s=0.5)
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self):
        self.records.extend(self.subscriber)

    def identities(self):
        return [identity(record.payload) for record in self.records]

    def wait_for(self, count):
        """Wait for so many records and for a complete query after them; return what was received."""
        eventually(lambda: len(self.records) >= count, what=f"{count} records")
        eventually(lambda: self.subscriber.is_caught_up)
        return self.identities()

    def close(self):
        self.subscriber.close()
        self._thread.join()


@pytest.fixture
def reading(client):
    opened = []

    def start(cursor=""):
        opened.append(Reader(client, cursor))
        return opened[-1]

    yield start
    for reader in opened:
        reader.close()


def page(session, selector=CONTACTS):
    replies = list(session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=60))
    values = [msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]
    return [v for v in values if v["type"] != "page"], values[-1]


def test_late_subscriber_gets_the_records_of_a_c2_that_never_returns(begin, reading, runner, client):
    first, second = begin("shore-1"), begin("shore-2")
    early = reading()
    for number in range(0, 20, 2):
        give(first, image(number), decision_record(f"first-{number}"))
        give(second, image(number + 1), decision_record(f"second-{number}"))
    eventually(lambda: handled(first, second) == 40)
    # Both have accepted this one: it has one number.
    give(first, image(99))
    give(second, image(99))
    eventually(lambda: handled(first, second) == 42)
    expected = {
        *(f"{number:04d}" for number in (*range(20), 99)),
        *(f"{host}-{number}" for host in ("first", "second") for number in range(0, 20, 2)),
    }
    runner.stop(first)
    shutil.rmtree(first.platform.state_dir)
    late = reading()
    assert sorted(late.wait_for(41)) == sorted(expected)
    assert [record.seq for record in late.records] == list(range(1, 42))
    give(second, image(50))
    assert sorted(late.wait_for(42)) == sorted({*expected, "0050"})
    assert sorted(early.wait_for(42)) == sorted(late.identities())
    assert {record.archive for record in (*early.records, *late.records)} == {late.records[0].archive}
    [latest], end = page(client, f"{CONTACTS}?after={late.records[0].archive}.41")
    assert (latest["image_id"], end["records"], end["more"]) == ("0050", 1, False)


def test_record_that_was_committed_and_not_published_is_available_from_the_other(
    begin, reading, runner, database, monkeypatch
):
    """The record, its number and the end of its acceptance are one transaction."""
    lost = begin("shore-1")
    monkeypatch.setattr(lost, "_publish_stored", lambda *_: (lost.stopping.wait(), lost.stopping.set()))
    give(lost, image(1), decision_record("d1"))
    archive = ShoreDatabase(database)
    eventually(lambda: len(archive.images()) == 1)
    runner.stop(lost)
    shutil.rmtree(lost.platform.state_dir)
    assert archive.accepted_count() == 0
    begin("shore-2")
    assert reading().wait_for(2) == ["0001", "d1"]


def test_repetition_has_the_number_of_the_first_publication(begin, watch):
    hosts = [begin("shore-1"), begin("shore-2")]
    seen = watch(CONTACTS)
    for host in hosts:
        give(host, image(1), decision_record("d1"))
    eventually(lambda: len(seen) == 4)
    numbers = {(identity(s.payload.to_bytes()), msgpack.unpackb(s.payload.to_bytes())["accepted"]["seq"]) for s in seen}
    assert len(numbers) == 2


def test_two_replies_to_one_query_are_one_page_for_a_subscriber(begin, reading, client):
    hosts = [begin("shore-1"), begin("shore-2")]
    give(hosts[0], *(image(number) for number in range(10)))
    eventually(lambda: handled(hosts[0]) == 10)
    # Of two that reach the database, one replies.
    records, end = page(client)
    assert (len(records), end["records"]) == (10, 10)
    # Without a preferred one, both reply: for a short time after an outage of the database.
    with both_reply(hosts):
        # The router learns of the change later.
        eventually(lambda: len(page(client)[0]) == 20)
        records, end = page(client)
        assert (len(records), end["records"]) == (20, 10)
        identities = {(record["accepted"]["archive"], record["accepted"]["seq"]) for record in records}
        assert len(identities) == 10
        assert reading().wait_for(10) == [f"{number:04d}" for number in range(10)]


@contextmanager
def both_reply(hosts):
    with pytest.MonkeyPatch.context() as patch:
        for host in hosts:
            patch.setattr(host, "_prefer_others", lambda **_: None)
            host._queries.set_preferred(is_preferred=False)
        yield


def test_query_goes_to_the_c2_that_reaches_the_database(begin, client):
    broken = begin("shore-1", database=f"postgresql://sonarpost@127.0.0.1:{free_port()}/shore")
    eventually(lambda: not broken._queries._is_preferred)
    second = begin("shore-2")
    give(second, image(1))
    eventually(lambda: handled(second) == 1)
    for _ in range(5):
        records, end = page(client)
        assert [record["image_id"] for record in records] == ["0001"]
        assert end["type"] == "page"


def test_journals_of_an_earlier_version_are_imported_and_the_archive_is_numbered(
    begin, platform, runner, reading, database, monkeypatch
):
    def stored_before(host):
        """Store records without numbers, as an earlier version has done; return them with their names."""
        number = 1 if host.platform.id == "shore-1" else 2
        records = (image(number), decision_record(f"d{number}"))
        name = host._archive.store_image(records[0], 5.0).tiff.stem
        host._archive.store_decision(records[1])
        host._archive.flush()
        return [(records[0], name), (records[1], "")]

    cursors = []
    hosts = [begin("shore-1"), begin("shore-2")]
    for host in hosts:
        stored = stored_before(host)
        runner.stop(host)
        if host.platform.id == "shore-1":
            journal = Journal(host.platform.state_dir)
            names = AcceptedRecords(host._archive, host.platform.state_dir, "shore")
            for record, name in stored:
                is_image = isinstance(record, ReconstructedImage)
                journal.append([names.image(record, name) if is_image else names.decision(record)], 7.0)
            cursors.append(f"{journal.archive}.1")
            journal.close()
    # shore-2 does not return, and with it its journal: its records are numbered from the database.
    again = begin("shore-1")
    reader = reading()
    assert sorted(reader.wait_for(4)) == ["0001", "0002", "d1", "d2"]
    assert reader.identities()[:2] == ["0001", "d1"]
    # A cursor of the journal that was imported first stays valid.
    assert sorted(reading(cursors[0]).wait_for(3)) == ["0002", "d1", "d2"]
    assert not (again.platform.state_dir / FILE_NAME).exists()
    assert (again.platform.state_dir / f"{FILE_NAME}.imported").exists()
    runner.stop(again)
    begin("shore-1")
    assert sorted(reading().wait_for(4)) == ["0001", "0002", "d1", "d2"]


def test_image_that_retention_of_another_c2_has_removed_is_no_longer_sent(begin, client):
    first = begin("shore-1", max_bytes=1)
    begin("shore-2", max_bytes=1)
    give(first, image(1), decision_record("d1"))
    eventually(lambda: [r["type"] for r in page(client)[0]] == ["decision"], what="retention")
