"""Archive in PostgreSQL: schema, exactly-once writes of several c2, accepted records, verification."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from hashlib import sha256

import pytest
from builders.common import eventually, free_port
from builders.records import decision_record
from builders.shore import image

from sonarpost.archive.postgresql import ConnectionPool, DatabaseAddress
from sonarpost.archive.shore_database import BacklogRecord, ShoreDatabase, StoredImage
from sonarpost.archive.shore_files import decision_text, row_of_image
from sonarpost.archive.shore_index import DecisionRow, TaskingRow
from sonarpost.errors import ConfigError, DatabaseUnavailableError, StoredFileError
from sonarpost.messages import Contact


@pytest.fixture
def open_(database):
    return lambda owner="c2-a", **options: ShoreDatabase(database, owner=owner, **options)


@pytest.fixture
def archive(open_):
    return open_()


def stored(image_id="AAAA", text=b"{}", accepted_utc_s=5.0):
    contact = Contact(contact_id="c", vehicle_id="uuv-1", lat_deg=56.0, lon_deg=-5.0, atd_class="clutter")
    contents = (text, b"tiff", b"png")
    row = row_of_image(f"name_{image_id}", image(image_id, contact=contact), 1.0, accepted_utc_s, contents)
    return StoredImage(replace(row, conflict=False), tuple(zip((".json", ".tiff", ".png"), contents, strict=True)))


def command_row(record_id="c1", **changes):
    fields = {
        "vessel_id": "vessel-1", "kind": "command", "record_id": record_id, "vehicle_id": "uuv-1", "image_id": None,
        "summary": "refine", "author": "expert", "issued_utc_s": 1.0, "state": "waiting", "reason": "",
        "changed_utc_s": 2.0,
    }  # fmt: skip
    return TaskingRow(**(fields | changes))


# Schema


def test_concurrent_starts_create_one_schema(database_url):
    made = [ShoreDatabase(ConnectionPool(DatabaseAddress.parse(database_url)), site="shore") for _ in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda each: each.prepare(), made))
    assert made[0].images() == []
    for each in made:
        each.close()


def test_schema_of_a_later_version_is_refused(archive, database):
    archive.prepare()
    with database.transaction() as sql:
        sql.rows("UPDATE archive SET version = 99")
    with pytest.raises(StoredFileError, match="version: got 99, expected 3"):
        ShoreDatabase(database).prepare()
    with pytest.raises(DatabaseUnavailableError, match="version: got 99"):
        ShoreDatabase(database).images()


def test_database_without_an_archive_is_not_created_by_a_command(open_):
    with pytest.raises(StoredFileError, match="version: got 0"):
        open_(writable=False).prepare()


def test_postgis_is_required(postgresql_server):
    postgresql_server.execute("postgres", "CREATE DATABASE plain OWNER sonarpost")
    address = DatabaseAddress.parse(f"postgresql://sonarpost@127.0.0.1:{postgresql_server.port}/plain")
    database = ConnectionPool(address)
    with pytest.raises(DatabaseUnavailableError, match='create extension "postgis"'):
        ShoreDatabase(database).prepare()
    database.close()


def test_positions_are_points_for_spatial_queries(archive, database):
    archive.write([stored()])
    with database.transaction() as sql:
        near = "ST_DWithin(position::geography, ST_MakePoint(:lon, 56)::geography, 1000)"
        assert sql.rows(f"SELECT image_id FROM image WHERE {near}", lon=-5.001) == [["AAAA"]]
        assert sql.rows(f"SELECT image_id FROM image WHERE {near}", lon=-5.1) == []


# Writes


def test_rows_and_files_are_returned_as_written(archive):
    image = stored(text=b'{"remark": "\\u0000"}')
    image = replace(image, row=replace(image.row, codec="e\0b", fault="", p_mine_like=0.1 + 0.2))
    archive.write([image])
    [row] = archive.images()
    assert row == replace(image.row, codec="e\ufffdb")
    assert archive.image_files(row.vessel_id, row.name) == dict(image.files)
    archive.mark("removed_utc_s", [row], 9.0)
    assert archive.image_files(row.vessel_id, row.name) == {}
    archive.write([image])
    assert archive.image_files(row.vessel_id, row.name) == dict(image.files)


def test_same_image_of_several_c2_is_stored_once(open_):
    images = [stored(f"{number:04d}") for number in range(20)]
    start = threading.Barrier(4)

    def write(number):
        start.wait()
        archive = open_(f"c2-{number}")
        for first in range(0, 20, 5):
            archive.write(images[first : first + 5][:: 1 if number % 2 else -1])

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(4)))
    assert len(open_().images()) == 20


def test_another_image_under_a_name_is_not_written(archive):
    archive.write([stored("AAAA")])
    with pytest.raises(DatabaseUnavailableError, match="another image under the same name"):
        archive.write([stored("BBBB"), stored("AAAA", b"other")])
    assert [row.image_id for row in archive.images()] == ["AAAA"]


def test_changed_and_missing_files_are_found_on_the_server(archive, database):
    archive.write([stored(f"{number:04d}") for number in range(3)])
    with database.transaction() as sql:
        sql.rows("UPDATE file SET content = 'x' WHERE name = 'name_0000' AND suffix = '.png'")
        sql.rows("DELETE FROM file WHERE name = 'name_0001' AND suffix = '.png'")
    assert {result.row.name: result.fault for result in archive.verify(1e9, 86400.0, 86400.0)} == {
        "name_0000": "changed",
        "name_0001": "missing",
        "name_0002": "",
    }
    assert archive.defect_counts() == {"missing": 1, "changed": 1, "unreadable": 0, "conflicting": 0}
    assert archive.verify(1e9 + 60, 60.0, 86400.0) == []
    archive.write([stored("0000"), stored("0001")])
    assert set(archive.defect_counts().values()) == {0}
    archive.verify(1e9 + 2 * 86400, 86400.0, 86400.0)
    assert set(archive.defect_counts().values()) == {0}


# Tasking


def test_one_c2_claims_a_record_for_a_vessel(open_):
    archives = [open_(f"c2-{number}") for number in range(4)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda each: each.claim_tasking(command_row(), b"payload"), archives))
    assert sorted(each is None for each in found) == [False, False, False, True]
    owner = archives[found.index(None)]
    assert owner.claim_tasking(command_row(), b"payload") is None
    assert owner.foreign_tasking("vessel-1", "command", "c1") is None
    assert next(a for a in archives if a is not owner).foreign_tasking("vessel-1", "command", "c1") == b"payload"


def test_older_state_does_not_replace_a_newer_one(archive):
    archive.claim_tasking(command_row(), b"payload")
    archive.put_tasking([command_row(state="delivered", changed_utc_s=5.0)])
    archive.put_tasking([command_row(state="waiting", changed_utc_s=2.0)])
    assert [(row.state, row.changed_utc_s) for row in archive.tasking()] == [("delivered", 5.0)]


# Accepted records


def test_accepted_record_of_another_c2_is_taken_over_once(open_):
    first, second, third = (open_(name) for name in ("c2-a", "c2-b", "c2-c"))
    record = BacklogRecord("some/key", b"\x00payload")
    first.accept([record, record])
    taken = []
    assert first.take_over(0.0, 10, 1000, taken.extend) == 0
    assert second.take_over(60.0, 10, 1000, taken.extend) == 0
    assert second.take_over(0.0, 10, 1000, taken.extend) == 1
    assert taken == [record]
    assert third.take_over(60.0, 10, 1000, taken.extend) == 0
    second.write([stored()], handled=[record])
    assert third.take_over(0.0, 10, 1000, taken.extend) == 0
    assert first.accepted_count() == 0


def test_record_stays_with_its_owner_if_it_cannot_be_taken_over(open_):
    open_("c2-a").accept([BacklogRecord("k", b"p")])

    def fails(_):
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        open_("c2-b").take_over(0.0, 10, 1000, fails)
    taken = []
    assert open_("c2-b").take_over(0.0, 10, 1000, taken.extend) == 1


def test_decision_with_another_content_is_not_written(archive):
    def row(**changes):
        decision = decision_record("d1", **changes)
        text = decision_text(decision)
        return DecisionRow.of(decision, 5.0, sha256(text).hexdigest()), text

    archive.write([], [row()])
    archive.write([], [row()])
    with pytest.raises(DatabaseUnavailableError, match="another decision"):
        archive.write([], [row(verdict="not_mine_like")])
    [stored_row] = archive.decisions()
    assert archive.decision_content(stored_row) == row()[1]


# Connection


def test_restarted_server_is_reached_again(database_url, postgresql_server):
    database = ConnectionPool(DatabaseAddress.parse(database_url))
    archive = ShoreDatabase(database, owner="c2-a")
    archive.write([stored()])
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
    archive.close()


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
    database = ConnectionPool(DatabaseAddress.parse(f"postgresql://u:secret@127.0.0.1:{free_port()}/shore"))
    with pytest.raises(DatabaseUnavailableError) as caught:
        ShoreDatabase(database).images()
    assert "127.0.0.1" in str(caught.value)
    assert "secret" not in str(caught.value)
