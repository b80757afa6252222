"""Two c2 share an archive in PostgreSQL: a record that one has acknowledged is stored exactly once by either."""

import shutil
import threading
import uuid

import pytest
from builders.common import eventually, free_port
from builders.records import decision_record, reconstructed_image

from sonarpost import keys, wire
from sonarpost.archive.journal import Criteria
from sonarpost.archive.shore_database import ShoreDatabase
from sonarpost.codec.registry import default_registry
from sonarpost.delivery.client import deliver
from sonarpost.errors import ConfigError, PayloadError
from sonarpost.messages import Command, ImagePart, Pixels, ReconstructedImage, Relayed
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

VESSEL = "vessel-1"
INBOX = keys.shore_inbox(VESSEL)


def image(number, value=1):
    picture = Pixels(height_px=20, width_px=30, bits=8, data=bytes([value]) * 600)
    return reconstructed_image(picture, vessel_id=VESSEL, image_id=f"{number:04d}")


def envelope(record):
    is_image = isinstance(record, ReconstructedImage)
    key = keys.image_reconstructed(VESSEL) if is_image else keys.contact_decision(VESSEL)
    return Relayed(vessel_id=VESSEL, key=key, payload=wire.encode(record), relayed_utc_s=5.0)


def command(command_id, kind="refine"):
    return Command(
        command_id=command_id, kind=kind, vehicle_id="uuv-1", image_id="0001", issued_by="expert", issued_utc_s=1.0
    )


@pytest.fixture(autouse=True)
def short_intervals(monkeypatch):
    monkeypatch.setattr("sonarpost.services.c2.service.TAKE_OVER_INTERVAL_S", 0.1)


@pytest.fixture
def begin(runner, platform, database_url, tmp_path):
    def start(host, **options):
        config = C2Config(**{"database": database_url, "out_dir": tmp_path / "unused", **options})
        return runner.start(C2Service(platform(host), config))

    return start


@pytest.fixture
def relay(runner):
    return runner.peer(VESSEL, "relay")


@pytest.fixture
def archive(database):
    return ShoreDatabase(database)


def counter(name, *services):
    return sum(service.health().counters.get(name, 0) for service in services)


def test_record_goes_to_one_of_two_c2_and_is_stored_once(begin, relay, archive, tmp_path):
    hosts = [begin("shore-1"), begin("shore-2")]
    relay.send(INBOX, "c2", *(envelope(image(number)) for number in range(30)), envelope(decision_record()))
    eventually(lambda: relay.store.outbox_depth() == 0 and counter("records_handled", *hosts) == 31)
    assert counter("images_stored", *hosts) == 30
    assert counter("images_repeated", *hosts) == 0
    assert len(archive.images()) == 30
    assert archive.accepted_count() == 0
    assert not (tmp_path / "unused").exists()


def test_other_c2_receives_records_after_one_has_ended(begin, relay, archive, runner):
    first, second = begin("shore-1"), begin("shore-2")
    relay.send(INBOX, "c2", envelope(image(1)))
    eventually(lambda: len(archive.images()) == 1)
    receiver = first if counter("records_handled", first) else second
    runner.stop(receiver)
    relay.send(INBOX, "c2", envelope(image(2)))
    eventually(lambda: len(archive.images()) == 2)


def test_other_c2_receives_records_while_one_does_not_reach_the_database(begin, relay, archive):
    broken = begin("shore-1", database=f"postgresql://sonarpost@127.0.0.1:{free_port()}/shore")
    eventually(lambda: "127.0.0.1" in broken.health().detail)
    assert broken.health().state == "degraded"
    begin("shore-2")
    relay.send(INBOX, "c2", *(envelope(image(number)) for number in range(5)))
    eventually(lambda: len(archive.images()) == 5)
    eventually(lambda: relay.store.outbox_depth() == 0)


def test_acknowledged_record_of_a_host_that_never_returns_is_handled_by_the_other(
    begin, relay, archive, runner, monkeypatch
):
    monkeypatch.setattr("sonarpost.services.c2.shared_archive.TAKE_OVER_AFTER_S", 0.5)
    lost = begin("shore-1")
    monkeypatch.setattr(lost, "_handle_batch", lambda _: lost.stopping.wait(0.05))
    relay.send(INBOX, "c2", *(envelope(image(number)) for number in range(5)), envelope(decision_record()))
    eventually(lambda: relay.store.outbox_depth() == 0, what="acknowledgement")
    assert archive.images() == []
    runner.stop(lost)
    shutil.rmtree(lost.platform.state_dir)
    second = begin("shore-2")
    eventually(lambda: len(archive.images()) == 5 and len(archive.decisions()) == 1)
    eventually(lambda: archive.accepted_count() == 0)
    assert counter("records_taken_over", second) == 6


def test_host_that_returns_after_the_take_over_repeats_its_records(begin, relay, archive, runner, monkeypatch):
    monkeypatch.setattr("sonarpost.services.c2.shared_archive.TAKE_OVER_AFTER_S", 0.5)
    first = begin("shore-1")
    monkeypatch.setattr(first, "_handle_batch", lambda _: first.stopping.wait(0.05))
    relay.send(INBOX, "c2", *(envelope(image(number)) for number in range(5)))
    eventually(lambda: relay.store.outbox_depth() == 0)
    monkeypatch.setattr(first._archive, "take_over", lambda _: 0)  # as if it did not run
    second = begin("shore-2")
    eventually(lambda: len(archive.images()) == 5)
    runner.stop(first)
    again = begin("shore-1")
    eventually(lambda: counter("images_repeated", again) == 5)
    assert counter("images_stored", again, second) == 5
    assert len(archive.images()) == 5


def test_nothing_is_acknowledged_while_the_database_is_down(begin, relay, archive, postgresql_server):
    service = begin("shore-1")
    relay.send(INBOX, "c2", envelope(image(1)))
    eventually(lambda: len(archive.images()) == 1)
    postgresql_server.stop("immediate")
    try:
        relay.send(INBOX, "c2", envelope(image(2)), envelope(decision_record()))
        eventually(lambda: service.health().state == "degraded" and "database" in service.health().detail)
        assert relay.store.outbox_depth() == 2
        assert service.store.inbox_depth() == 0
    finally:
        postgresql_server.start()
    eventually(lambda: relay.store.outbox_depth() == 0)
    eventually(lambda: service.health().state == "ok")
    eventually(lambda: counter("records_handled", service) == 3)
    assert archive.accepted_count() == 0


def test_invalid_record_is_quarantined_and_not_taken_over(begin, relay, archive, refused):
    service = begin("shore-1")
    relay.send(INBOX, "c2", envelope(decision_record("d1")), envelope(decision_record("d1", verdict="not_mine_like")))
    eventually(lambda: len(refused(service)) == 1)
    assert "decision_id: got 'd1'" in refused(service)[0][1]
    eventually(lambda: archive.accepted_count() == 0)


def test_command_that_both_c2_have_accepted_is_sent_once(begin, client, runner, archive):
    hosts = [begin("shore-1"), begin("shore-2")]
    received = runner.peer(VESSEL, "relay", {keys.command_all(VESSEL): Command}).received
    key, record = keys.tasking_command(VESSEL), command("c1")
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
    deliver(client, key, "c2", record, 30.0)
    deliver(client, key, "c2", command("c2"), 30.0)
    eventually(lambda: {"c1", "c2"} == {each.command_id for each in received})
    eventually(lambda: [row.state for row in archive.tasking()] == ["delivered"] * 2)
    assert len(received) == 2
    assert counter("tasking_accepted", *hosts) == 2


def test_another_command_under_the_identifier_of_the_other_c2_is_refused(begin, runner, client):
    first = begin("shore-1")
    key = keys.tasking_command(VESSEL)
    deliver(client, key, "c2", command("c1"), 30.0)
    eventually(lambda: counter("tasking_accepted", first) == 1)
    runner.stop(first)
    begin("shore-2")
    deliver(client, key, "c2", command("c1"), 30.0)
    with pytest.raises(PayloadError, match="command_id: got 'c1'"):
        deliver(client, key, "c2", command("c1", "resend"), 30.0)


def test_database_of_another_site_ends_the_start(begin, platform, database_url):
    begin("shore-1")
    service = C2Service(platform("shore-9"), C2Config(database=database_url, site="north"))
    with pytest.raises(ConfigError, match="site: got 'north', expected shore"):
        service.start()
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
    """Coded images of spiht, which needs no compilation."""
    streams = [default_registry().create("spiht").encode(texture(seed=seed), 200) for seed in range(4)]
    return [
        ImagePart(u="uuv-1", i=f"{number:04d}", n=1, t=1000.0 + number, p=stream)
        for number, stream in enumerate(streams)
    ]


def test_coded_image_that_a_lost_host_has_not_decoded_is_decoded_by_the_other(
    begin, relay, archive, runner, parts, monkeypatch
):
    monkeypatch.setattr("sonarpost.services.c2.shared_archive.TAKE_OVER_AFTER_S", 0.5)
    with monkeypatch.context() as patch:
        patch.setattr("sonarpost.services.c2.decoding.Decoding.run", lambda _: None)
        lost = begin("shore-1")
    relay.send(keys.shore_part(VESSEL), "c2", *parts)
    eventually(lambda: lost.health().gauges["images_undecoded"] == 4.0)
    eventually(lambda: relay.store.outbox_depth() == 0)
    assert archive.accepted_count() == 4
    runner.stop(lost)
    shutil.rmtree(lost.platform.state_dir)
    second = begin("shore-2")
    eventually(lambda: len(archive.images()) == 4 and archive.accepted_count() == 0)
    eventually(lambda: counter("images_stored", second) == 4)
    # The coded images have the numbers that the lost host has given them.
    journal = archive.journal()
    rows = journal.page(journal.known_keys(), Criteria(), 0, 100)
    assert [row.fields["type"] for row in rows] == ["coded_image"] * 4 + ["reconstructed_image"] * 4
    assert [row.accepted.seq for row in rows] == list(range(1, 9))


def test_records_of_a_busy_c2_are_not_taken_over(begin, relay, archive, parts, monkeypatch):
    monkeypatch.setattr("sonarpost.services.c2.shared_archive.TAKE_OVER_AFTER_S", 30.0)
    with monkeypatch.context() as patch:
        patch.setattr("sonarpost.services.c2.decoding.Decoding.run", lambda _: None)
        busy = begin("shore-1")
    relay.send(keys.shore_part(VESSEL), "c2", *parts)
    eventually(lambda: busy.health().gauges["images_undecoded"] == 4.0)
    second = begin("shore-2")

    def members():
        with archive.database.transaction() as sql:
            return sql.number("SELECT count(*) FROM sonarpost.member")

    eventually(lambda: members() == 2)
    with archive.database.transaction() as sql:
        # The records are old; their c2 is not.
        sql.rows("UPDATE sonarpost.accepted SET accepted_at = accepted_at - interval '1 day'")
    taken = []
    assert archive.take_over(30.0, 10, taken.extend) == 0
    assert counter("records_taken_over", second) == 0
    assert archive.accepted_count() == 4
