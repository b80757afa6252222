"""What is peculiar to PostgreSQL: address, connections, positions, and records that several c2 hand over."""

from concurrent.futures import ThreadPoolExecutor

import pytest
from archive.test_shore_archive import command_row, stored
from builders.common import eventually, free_port
from builders.postgresql import execute

from sonarpost.archive.address import DatabaseAddress
from sonarpost.archive.backlog import BacklogRecord
from sonarpost.archive.postgresql import PostgresDatabase
from sonarpost.archive.shore_archive import Batch, ShoreArchive
from sonarpost.errors import ConfigError, DatabaseUnavailableError


@pytest.fixture
def open_(database):
    return lambda owner="c2-a": ShoreArchive(database, owner=owner)


def test_postgis_is_required(postgresql_server):
    postgresql_server.execute("postgres", "CREATE DATABASE plain OWNER sonarpost")
    address = DatabaseAddress.parse(f"postgresql://sonarpost@127.0.0.1:{postgresql_server.port}/plain")
    database = PostgresDatabase(address)
    with pytest.raises(DatabaseUnavailableError, match='create extension "postgis"'):
        database.prepare()
    database.close()


def test_positions_are_points_for_spatial_queries(open_):
    archive = open_()
    archive.write(Batch(images=[stored()]))
    for lon, expected in ((-5.001, [("AAAA",)]), (-5.1, [])):
        near = f"ST_DWithin(position::geography, ST_MakePoint({lon}, 56)::geography, 1000)"
        assert execute(archive, f"SELECT image_id FROM image WHERE {near}") == expected
    assert execute(archive, "SELECT contact ->> 'atd_class' FROM image") == [("clutter",)]


def test_one_c2_claims_a_record_for_a_vessel(open_):
    archives = [open_(f"c2-{number}") for number in range(4)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda each: each.claim_tasking(command_row(), b"payload"), archives))
    assert sorted(each is None for each in found) == [False, False, False, True]
    owner = archives[found.index(None)]
    assert owner.claim_tasking(command_row(), b"payload") is None
    assert owner.foreign_tasking("vessel-1", "command", "c1") is None
    assert next(a for a in archives if a is not owner).foreign_tasking("vessel-1", "command", "c1") == b"payload"


def test_accepted_record_of_another_c2_is_taken_over_once(open_):
    first, second, third = (open_(name).backlog for name in ("c2-a", "c2-b", "c2-c"))
    record = BacklogRecord("some/key", b"\x00payload")
    first.accept([record, record])
    taken = []
    assert first.take_over(0.0, 10, 1000, taken.extend) == 0
    assert second.take_over(60.0, 10, 1000, taken.extend) == 0
    assert second.take_over(0.0, 10, 1000, taken.extend) == 1
    assert taken == [record]
    assert third.take_over(60.0, 10, 1000, taken.extend) == 0
    open_("c2-b").write(Batch(images=[stored()], finished=[record]))
    assert third.take_over(0.0, 10, 1000, taken.extend) == 0
    assert first.count() == 0


def test_record_stays_with_its_owner_if_it_cannot_be_taken_over(open_):
    open_("c2-a").backlog.accept([BacklogRecord("k", b"p")])

    def fails(_):
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        open_("c2-b").backlog.take_over(0.0, 10, 1000, fails)
    taken = []
    assert open_("c2-b").backlog.take_over(0.0, 10, 1000, taken.extend) == 1


def test_restarted_server_is_reached_again(database, open_, postgresql_server):
    archive = open_()
    archive.write(Batch(images=[stored()]))
    postgresql_server.stop("immediate")
    try:
        for _ in range(3):
            with pytest.raises(DatabaseUnavailableError, match=r"database postgresql://sonarpost@127\.0\.0\.1"):
                archive.images()
        assert database.fault
    finally:
        postgresql_server.start()

    def is_reached():
        try:
            return len(archive.images()) == 1
        except DatabaseUnavailableError:
            return False

    eventually(is_reached)
    assert not database.fault


ADDRESS = "postgresql://USER:PASSWORD@HOST:PORT/DATABASE"


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("mysql://u:secret@h/d", ADDRESS),
        ("postgresql://h/d", ADDRESS),
        ("postgresql://u:secret@h", ADDRESS),
        ("postgresql://u:secret@h:99999/d", "a port from 1 to 65535"),
        ("postgresql://u:secret@h/d?sslmode=require", "sslmode=disable or verify-full"),
        ("postgresql://u:secret@h/d?options=x", "not options"),
    ],
)
def test_invalid_address_is_refused_without_its_password(url, expected):
    with pytest.raises(ConfigError, match="c2: database") as caught:
        DatabaseAddress.parse(url)
    assert expected in str(caught.value)
    assert "secret" not in str(caught.value)


def test_address_has_tls_unless_the_server_is_local(tmp_path):
    parse = DatabaseAddress.parse
    assert parse("postgresql://u:p%40ss@db.example.org/shore").use_tls
    assert parse("postgresql://u:p%40ss@db.example.org/shore").password == "p@ss"
    assert not parse("postgresql://u@db/shore?sslmode=disable").use_tls
    assert not parse("postgresql://u@/shore?host=/run/postgresql").use_tls
    assert not parse("postgresql://u@127.0.0.1/shore").use_tls
    assert "secret" not in repr(parse("postgresql://u:secret@db/shore"))


def test_password_file_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "password"
    path.write_bytes(b"\xff\x00")
    with pytest.raises(ConfigError, match="database_password_file"):
        DatabaseAddress.parse("postgresql://u@127.0.0.1/shore", path)


def test_unreachable_server_is_named_without_the_password():
    database = PostgresDatabase(DatabaseAddress.parse(f"postgresql://u:secret@127.0.0.1:{free_port()}/shore"))
    with pytest.raises(DatabaseUnavailableError) as caught:
        ShoreArchive(database).images()
    assert "127.0.0.1" in str(caught.value)
    assert "secret" not in str(caught.value)
