"""Two c2 share an archive in PostgreSQL: what one has acknowledged is stored exactly once, and read from either."""

import shutil
import threading
import uuid
from contextlib import contextmanager

import msgpack
import pytest
import zenoh
from builders.common import WAIT_S, eventually, free_port
from builders.postgresql import execute
from builders.records import command_record, decision_record
from builders.shore import CONTACTS, identity, image, relayed

from sonarpost import keys, wire
from sonarpost.archive.journal import Criteria
from sonarpost.archive.shore_archive import ShoreArchive
from sonarpost.codec.registry import default_registry
from sonarpost.delivery.client import deliver
from sonarpost.errors import ConfigError, PayloadError
from sonarpost.messages import Command, ImagePart
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

VESSEL = "vessel-1"
INBOX = keys.shore_inbox(VESSEL)
COMMAND = command_record("refine", "0001", command_id="c1")


def numbered(*numbers):
    return [image(f"{number:04d}") for number in numbers]


@pytest.fixture(autouse=True)
def short_intervals(monkeypatch, fast_queries):
    monkeypatch.setattr("sonarpost.services.c2.service.TAKE_OVER_INTERVAL_S", 0.1)


@pytest.fixture
def begin(runner, platform, database_url, tmp_path):
    def start(host, **options):
        config = C2Config(**{"database": database_url, "out_dir": tmp_path / "unused", **options})
        return runner.start(C2Service(platform(host), config))

    return start


@pytest.fixture
def archive(database):
    return ShoreArchive(database)


@pytest.fixture
def deaf(begin, monkeypatch):
    """A c2 that acknowledges records and does not handle them."""
    host = begin("shore-1")
    monkeypatch.setattr(host._handler, "handle_batch", lambda _: host.stopping.wait(0.05))
    return host


@pytest.fixture
def short_take_over(monkeypatch):
    return lambda: monkeypatch.setattr("sonarpost.services.c2.archive.TAKE_OVER_AFTER_S", 0.5)


@pytest.fixture
def lose(runner, short_take_over):
    """Ends a c2 for ever, with its store."""

    def end(host):
        short_take_over()
        runner.stop(host)
        shutil.rmtree(host.platform.state_dir)

    return end


def counter(name, *services):
    return sum(service.health().counters.get(name, 0) for service in services)


def test_record_goes_to_one_of_two_c2_and_is_stored_once(begin, relay, archive, tmp_path):
    hosts = [begin("shore-1"), begin("shore-2")]
    relay.send(INBOX, "c2", *map(relayed, numbered(*range(30))), relayed(decision_record()))
    eventually(lambda: relay.store.outbox_depth() == 0 and counter("records_handled", *hosts) == 31)
    assert counter("images_stored", *hosts) == 30
    assert counter("images_repeated", *hosts) == 0
    assert len(archive.images()) == 30
    assert archive.backlog.count() == 0
    assert not (tmp_path / "unused").exists()


def test_other_c2_receives_records_after_one_has_ended(begin, relay, archive, runner):
    first, second = begin("shore-1"), begin("shore-2")
    relay.send(INBOX, "c2", relayed(image("0001")))
    eventually(lambda: len(archive.images()) == 1)
    receiver = first if counter("records_handled", first) else second
    runner.stop(receiver)
    relay.send(INBOX, "c2", relayed(image("0002")))
    eventually(lambda: len(archive.images()) == 2)


def test_other_c2_receives_records_while_one_does_not_reach_the_database(begin, relay, archive):
    broken = begin("shore-1", database=f"postgresql://sonarpost@127.0.0.1:{free_port()}/shore")
    eventually(lambda: "127.0.0.1" in broken.health().detail)
    assert broken.health().state == "degraded"
    begin("shore-2")
    relay.send(INBOX, "c2", *map(relayed, numbered(*range(5))))
    eventually(lambda: len(archive.images()) == 5)
    eventually(lambda: relay.store.outbox_depth() == 0)


def test_acknowledged_record_of_a_host_that_never_returns_is_handled_by_the_other(begin, deaf, relay, archive, lose):
    relay.send(INBOX, "c2", *map(relayed, numbered(*range(5))), relayed(decision_record()))
    eventually(lambda: relay.store.outbox_depth() == 0, what="acknowledgement")
    assert archive.images() == []
    lose(deaf)
    second = begin("shore-2")
    eventually(lambda: len(archive.images()) == 5 and len(archive.decisions()) == 1)
    eventually(lambda: archive.backlog.count() == 0)
    assert counter("records_taken_over", second) == 6


def test_host_that_returns_after_the_take_over_repeats_its_records(
    begin, deaf, relay, archive, runner, monkeypatch, short_take_over
):
    relay.send(INBOX, "c2", *map(relayed, numbered(*range(5))))
    eventually(lambda: relay.store.outbox_depth() == 0)
    monkeypatch.setattr(deaf._archive, "take_over", lambda _: 0)  # as if it did not run
    short_take_over()
    second = begin("shore-2")
    eventually(lambda: len(archive.images()) == 5)
    runner.stop(deaf)
    again = begin("shore-1")
    eventually(lambda: counter("images_repeated", again) == 5)
    assert counter("images_stored", again, second) == 5
    assert len(archive.images()) == 5


def test_nothing_is_acknowledged_while_the_database_is_down(begin, relay, archive, postgresql_server):
    service = begin("shore-1")
    relay.send(INBOX, "c2", relayed(image("0001")))
    eventually(lambda: len(archive.images()) == 1)
    postgresql_server.stop("immediate")
    try:
        relay.send(INBOX, "c2", relayed(image("0002")), relayed(decision_record()))
        eventually(lambda: service.health().state == "degraded" and "database" in service.health().detail)
        assert relay.store.outbox_depth() == 2
        assert service.store.inbox_depth() == 0
    finally:
        postgresql_server.start()
    eventually(lambda: relay.store.outbox_depth() == 0)
    eventually(lambda: service.health().state == "ok")
    eventually(lambda: counter("records_handled", service) == 3)
    assert archive.backlog.count() == 0


def test_invalid_record_is_quarantined_and_not_taken_over(begin, relay, archive, refused):
    service = begin("shore-1")
    relay.send(INBOX, "c2", relayed(decision_record("d1")), relayed(decision_record("d1", verdict="not_mine_like")))
    eventually(lambda: len(refused(service)) == 1)
    assert "decision_id: got 'd1'" in refused(service)[0][1]
    eventually(lambda: archive.backlog.count() == 0)


def test_command_that_both_c2_have_accepted_is_sent_once(begin, client, runner, archive):
    hosts = [begin("shore-1"), begin("shore-2")]
    received = runner.peer(VESSEL, "relay", {keys.command_all(VESSEL): Command}).received
    key, record = keys.tasking_command(VESSEL), COMMAND
    start = threading.Barrier(2)

    def accept(host):
        start.wait()
        host.before_accepting([(key, wire.encode(record))])
        host._store_taken([(key, wire.encode(record))])

    threads = [threading.Thread(target=accept, args=(host,)) for host in hosts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    eventually(lambda: counter("tasking_repeated", *hosts) == 1)
    deliver(client, key, "c2", record, 120.0)
    deliver(client, key, "c2", COMMAND.model_copy(update={"command_id": "c2"}), 120.0)
    eventually(lambda: {"c1", "c2"} == {each.command_id for each in received})
    eventually(lambda: [row.state for row in archive.tasking()] == ["delivered"] * 2)
    assert len(received) == 2
    assert counter("tasking_accepted", *hosts) == 2


def test_another_command_under_the_identifier_of_the_other_c2_is_refused(begin, runner, client):
    first = begin("shore-1")
    key = keys.tasking_command(VESSEL)
    deliver(client, key, "c2", COMMAND, 120.0)
    eventually(lambda: counter("tasking_accepted", first) == 1)
    runner.stop(first)
    begin("shore-2")
    deliver(client, key, "c2", COMMAND, 120.0)
    with pytest.raises(PayloadError, match="command_id: got 'c1'"):
        deliver(client, key, "c2", COMMAND.model_copy(update={"kind": "resend"}), 120.0)


def test_database_of_another_site_ends_the_start(begin, platform, database_url):
    begin("shore-1")
    service = C2Service(platform("shore-9"), C2Config(database=database_url, site="north"))
    with pytest.raises(ConfigError, match="site: got 'north', expected shore"):
        service.start()
    service._archive.close()
    service.store.close()


def test_owner_is_the_same_after_a_restart(begin, runner):
    service = begin("shore-1")
    owner = service._owner()
    runner.stop(service)
    assert begin("shore-1")._owner() == owner
    assert begin("shore-2")._owner() != owner
    assert uuid.UUID(owner)


# Coded images, which are decoded after their acceptance


@pytest.fixture
def parts(texture):
    """Coded images."""
    streams = [default_registry().create("emb").encode(texture(seed=seed), 200) for seed in range(4)]
    return [
        ImagePart(u="uuv-1", i=f"{number:04d}", n=1, t=1000.0 + number, p=stream)
        for number, stream in enumerate(streams)
    ]


def test_coded_image_that_a_lost_host_has_not_decoded_is_decoded_by_the_other(
    begin, relay, archive, lose, parts, monkeypatch
):
    with monkeypatch.context() as patch:
        patch.setattr("sonarpost.services.c2.decoding.Decoding.run", lambda _: None)
        lost = begin("shore-1")
    relay.send(keys.shore_part(VESSEL), "c2", *parts)
    eventually(lambda: lost.health().gauges["images_undecoded"] == 4.0)
    eventually(lambda: relay.store.outbox_depth() == 0)
    assert archive.backlog.count() == 4
    lose(lost)
    second = begin("shore-2")
    eventually(lambda: len(archive.images()) == 4 and archive.backlog.count() == 0)
    eventually(lambda: counter("images_stored", second) == 4)
    # The coded images have the numbers that the lost host has given them.
    journal = archive.journal
    rows = journal.page(journal.known_keys(), Criteria(), 0, 100)
    assert [row.fields["type"] for row in rows] == ["coded_image"] * 4 + ["reconstructed_image"] * 4
    assert [row.accepted.seq for row in rows] == list(range(1, 9))


def test_image_that_the_database_rejects_is_quarantined_alone(begin, relay, archive, parts, refused, monkeypatch):
    for name in ("RETRY_S", "MAX_RETRY_S"):
        monkeypatch.setattr(f"sonarpost.services.c2.decoding.{name}", 0.0)
    host = begin("shore-1", decode_workers=1)
    execute(archive, "ALTER TABLE image ADD CONSTRAINT only_others CHECK (image_id <> '0001')")
    relay.send(keys.shore_part(VESSEL), "c2", *parts)
    eventually(lambda: len(archive.images()) == 3 and host.health().state == "degraded")
    for number in range(10, 20):
        relay.send(keys.shore_part(VESSEL), "c2", parts[0].model_copy(update={"i": f"00{number}"}))
        eventually(lambda: any(row.image_id == f"00{number}" for row in archive.images()))  # noqa: B023
        if refused(host):
            break
    [(key, reason)] = refused(host)
    assert key == keys.shore_part(VESSEL)
    assert "only_others" in reason
    eventually(lambda: host.health().state == "ok" and archive.backlog.count() == 0)


def test_records_of_a_busy_c2_are_not_taken_over(begin, relay, archive, parts, monkeypatch):
    monkeypatch.setattr("sonarpost.services.c2.archive.TAKE_OVER_AFTER_S", 120.0)
    with monkeypatch.context() as patch:
        patch.setattr("sonarpost.services.c2.decoding.Decoding.run", lambda _: None)
        busy = begin("shore-1")
    relay.send(keys.shore_part(VESSEL), "c2", *parts)
    eventually(lambda: busy.health().gauges["images_undecoded"] == 4.0)
    second = begin("shore-2")

    eventually(lambda: execute(archive, "SELECT count(*) FROM member")[0][0] == 2)
    # The records are old; their c2 is not.
    execute(archive, "UPDATE backlog SET accepted_utc_s = accepted_utc_s - 86400")
    taken = []
    assert archive.backlog.take_over(30.0, 10, 1000, taken.extend) == 0
    assert counter("records_taken_over", second) == 0
    assert archive.backlog.count() == 4


# Queries


def give(host, *records):
    """Let this c2 accept records, as its inbox does."""
    pairs = [(INBOX, wire.encode(relayed(record))) for record in records]
    host.before_accepting(pairs)
    host._store_taken(pairs)


def page(session, selector=CONTACTS):
    replies = list(session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=WAIT_S))
    values = [msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]
    return [v for v in values if v["type"] != "page"], values[-1]


def test_late_subscriber_gets_the_records_of_a_c2_that_never_returns(begin, reading, lose, client):
    first, second = begin("shore-1"), begin("shore-2")
    early = reading()
    for number in range(0, 20, 2):
        give(first, image(f"{number:04d}"), decision_record(f"first-{number}"))
        give(second, image(f"{number + 1:04d}"), decision_record(f"second-{number}"))
    eventually(lambda: counter("records_handled", first, second) == 40)
    # Both have accepted this one: it has one number.
    give(first, image("0099"))
    give(second, image("0099"))
    eventually(lambda: counter("records_handled", first, second) == 42)
    expected = {
        *(f"{number:04d}" for number in (*range(20), 99)),
        *(f"{host}-{number}" for host in ("first", "second") for number in range(0, 20, 2)),
    }
    lose(first)
    late = reading()
    assert sorted(late.wait_for(41)) == sorted(expected)
    assert [record.seq for record in late.records] == list(range(1, 42))
    give(second, image("0050"))
    assert sorted(late.wait_for(42)) == sorted({*expected, "0050"})
    assert sorted(early.wait_for(42)) == sorted(late.identities())
    assert {record.archive for record in (*early.records, *late.records)} == {late.records[0].archive}
    [latest], end = page(client, f"{CONTACTS}?after={late.records[0].archive}.41")
    assert (latest["image_id"], end["records"], end["more"]) == ("0050", 1, False)


def test_record_that_was_committed_and_not_published_is_available_from_the_other(
    begin, reading, lose, archive, monkeypatch
):
    """The record, its number and the end of its acceptance are one transaction."""
    lost = begin("shore-1")
    monkeypatch.setattr(lost, "_publish_stored", lambda *_: (lost.stopping.wait(), lost.stopping.set()))
    give(lost, image("0001"), decision_record("d1"))
    eventually(lambda: len(archive.images()) == 1)
    lose(lost)
    assert archive.backlog.count() == 0
    begin("shore-2")
    assert reading().wait_for(2) == ["0001", "d1"]


def test_repetition_has_the_number_of_the_first_publication(begin, watch):
    hosts = [begin("shore-1"), begin("shore-2")]
    seen = watch(CONTACTS)
    for host in hosts:
        give(host, image("0001"), decision_record("d1"))
    eventually(lambda: len(seen) == 4)
    numbers = {(identity(s.payload.to_bytes()), msgpack.unpackb(s.payload.to_bytes())["accepted"]["seq"]) for s in seen}
    assert len(numbers) == 2


def test_two_replies_to_one_query_are_one_page_for_a_subscriber(begin, reading, client):
    hosts = [begin("shore-1"), begin("shore-2")]
    give(hosts[0], *numbered(*range(10)))
    eventually(lambda: counter("records_handled", hosts[0]) == 10)
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
            set_preferred = host._queries.set_preferred
            patch.setattr(host._queries, "set_preferred", lambda **_: None)
            set_preferred(is_preferred=False)
        yield


def test_query_goes_to_the_c2_that_reaches_the_database(begin, client):
    broken = begin("shore-1", database=f"postgresql://sonarpost@127.0.0.1:{free_port()}/shore")
    eventually(lambda: not broken._queries._is_preferred)
    second = begin("shore-2")
    give(second, image("0001"))
    eventually(lambda: counter("records_handled", second) == 1)
    for _ in range(5):
        records, end = page(client)
        assert [record["image_id"] for record in records] == ["0001"]
        assert end["type"] == "page"


def test_image_that_retention_of_another_c2_has_removed_is_no_longer_sent(begin, client):
    first = begin("shore-1", max_bytes=1)
    begin("shore-2", max_bytes=1)
    give(first, image("0001"), decision_record("d1"))
    eventually(lambda: [r["type"] for r in page(client)[0]] == ["decision"], what="retention")
