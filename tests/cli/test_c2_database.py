"""`sonarpost c2 migrate`, and the commands that read the archive, with PostgreSQL."""

import csv
import json

import pytest
from builders.postgresql import execute
from builders.records import decision_record, reconstructed_image

from sonarpost.archive.journal import Criteria
from sonarpost.archive.rows import TaskingRow
from sonarpost.archive.shore_archive import Batch, ShoreArchive
from sonarpost.archive.shore_files import image_paths
from sonarpost.cli.console import stored_records
from sonarpost.cli.main import main
from sonarpost.errors import DatabaseUnavailableError
from sonarpost.messages import Contact, Pixels
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config

COUNT = 40


def image(number, value=1, version=1):
    pixels = Pixels(height_px=20, width_px=30, bits=8, data=bytes([value]) * 600)
    contact = Contact(contact_id="c", vehicle_id="uuv-1", lat_deg=56.0, lon_deg=-5.0 + number / 100)
    return reconstructed_image(
        pixels, vessel_id="vessel-1", image_id=f"{number:04d}", version=version, contact=contact, codec="emb"
    )


@pytest.fixture
def files(tmp_path):
    """An archive of files, with a conflict, a removed image, an exported one, decisions and a command."""
    archive = Archive(C2Config(out_dir=tmp_path / "out"))
    for number in range(COUNT):
        archive.store_image(image(number), 5.0)
    archive.store_image(image(1, value=2), 5.0)
    archive.store_image(image(2, version=2), 5.0)
    archive.store_decision(decision_record("d1", image_id="0002"))
    archive.store_decision(decision_record("d2", image_id="0003"))
    archive.flush()
    row = TaskingRow("vessel-1", "command", "c1", "uuv-1", None, "refine", "expert", 1.0, "delivered", "", 2.0)
    archive.index().write(Batch(tasking=[row]))
    index = archive.index()
    removed = [row for row in index.images() if row.image_id == "0005"]
    index.mark("removed_utc_s", removed, 9.0)
    index.mark("exported_utc_s", [row for row in index.images() if row.image_id == "0006"], 8.0)
    return archive


@pytest.fixture
def config(tmp_path, database_url):
    path = tmp_path / "shore.toml"
    path.write_text(f'[platform]\nid = "shore-1"\n[c2]\nout_dir = "{tmp_path / "out"}"\ndatabase = "{database_url}"\n')
    return path


@pytest.fixture
def archive(database):
    return ShoreArchive(database)


def test_migration_copies_everything_once(files, config, archive, capsys):
    before = files.index()
    files.verify(1e9, 86400.0)
    assert main(["c2", "migrate", "--config", str(config)]) == 0
    assert f"images {COUNT + 2} copied, 0 present; decisions 2 copied" in capsys.readouterr().out
    for rows, copied in (
        (before.images(removed=True), archive.images(removed=True)),
        (before.decisions(), archive.decisions()),
        (before.tasking(), archive.tasking()),
    ):
        changed = {"verified_utc_s"}
        assert [{k: getattr(r, k) for k in r.__slots__ if k not in changed} for r in copied] == [
            {k: getattr(r, k) for k in r.__slots__ if k not in changed} for r in rows
        ]
    assert main(["c2", "migrate", "--config", str(config)]) == 0
    out = capsys.readouterr().out
    assert f"images 0 copied, {COUNT + 2} present; decisions 0 copied, 2 present" in out
    assert f"compared {COUNT + 1};" in out
    assert len(archive.images(removed=True)) == COUNT + 2


def test_migration_keeps_the_numbers_of_the_journal(files, config, archive, tmp_path, capsys):
    """A subscriber's cursor stays valid; records that c2 has numbered after the first copy keep their numbers, too."""
    first = files.index().journal
    before = first.position()
    assert before[1] == COUNT + 4
    assert main(["c2", "migrate", "--config", str(config)]) == 0
    # One image is removed.
    assert f"numbers for queries {COUNT + 3};" in capsys.readouterr().out
    assert archive.journal.position() == before
    files.store_decision(decision_record("d9", image_id="0003"))
    [(_, later)] = files.flush()
    assert main(["c2", "migrate", "--config", str(config)]) == 0
    assert "numbers for queries 1;" in capsys.readouterr().out
    keys = first.known_keys()
    expected = [(row.accepted, row.fields, row.name) for row in first.page(keys, Criteria(), 0, 1000)]
    found = [(row.accepted, row.fields, row.name) for row in archive.journal.page(keys, Criteria(), 0, 1000)]
    assert found == expected
    assert found[-1][0] == later


def test_interrupted_migration_is_completed_by_the_next_one(files, config, archive, monkeypatch):
    write = ShoreArchive.write
    calls: list[int] = []

    def fails_second(self, *arguments):
        calls.append(1)
        if len(calls) == 2:
            raise DatabaseUnavailableError("database: connection lost")
        return write(self, *arguments)

    monkeypatch.setattr(ShoreArchive, "write", fails_second)
    assert main(["c2", "migrate", "--config", str(config)]) == 2
    assert 0 < len(archive.images()) < COUNT
    assert main(["c2", "migrate", "--config", str(config)]) == 0
    assert len(archive.images(removed=True)) == COUNT + 2


def test_damaged_and_different_records_are_rejected_by_name(files, config, archive, tmp_path, capsys):
    [row] = [row for row in files.index().images() if row.image_id == "0009"]
    image_paths(tmp_path / "out", row)[1].write_bytes(b"damaged")
    [row] = [row for row in files.index().images() if row.image_id == "0010"]
    image_paths(tmp_path / "out", row)[2].unlink()
    assert main(["c2", "migrate", "--config", str(config)]) == 1
    captured = capsys.readouterr()
    assert "rejected 2" in captured.out
    assert "_0009_v1: the files differ from their digests" in captured.err
    assert "_0010_v1.png" in captured.err
    assert len(archive.images()) == COUNT - 1


def test_change_in_the_database_is_found_by_the_comparison(files, config, archive, capsys):
    assert main(["c2", "migrate", "--config", str(config)]) == 0
    execute(archive, "UPDATE file SET content = 'x' WHERE suffix = '.png' AND name LIKE '%%0007%%'")
    assert main(["c2", "migrate", "--config", str(config)]) == 1
    assert "0007_v1: the files in the database differ" in capsys.readouterr().err


def test_image_that_the_database_has_removed_is_not_restored(files, config, archive):
    assert main(["c2", "migrate", "--config", str(config)]) == 0
    archive.mark("removed_utc_s", [row for row in archive.images() if row.image_id == "0007"], 9.0)
    assert main(["c2", "migrate", "--config", str(config)]) == 0
    assert "0007" not in {row.image_id for row in archive.images()}


def test_file_without_a_database_is_refused(tmp_path, capsys):
    path = tmp_path / "shore.toml"
    path.write_text('[platform]\nid = "shore-1"\n[c2]\n')
    assert main(["c2", "migrate", "--config", str(path)]) == 2
    assert "c2.database: got 'nothing', expected the address of a PostgreSQL database" in capsys.readouterr().err


@pytest.fixture
def places(files, config, tmp_path, database_url, capsys):
    assert main(["c2", "migrate", "--config", str(config)]) == 0
    capsys.readouterr()
    return [["--archive", str(tmp_path / "out")], ["--archive", database_url], ["--config", str(config)]]


def test_list_and_export_are_the_same_from_files_and_database(places, tmp_path, capsys, archive):
    listed, exported = [], []
    for number, options in enumerate(places):
        for more in (["--all-versions"], ["--undecided", "--json"], ["--tasking"]):
            assert main(["c2", "ls", *options, *more]) == 0
        text = capsys.readouterr().out
        listed.append([line for line in text.splitlines() if "verified_utc_s" not in line])
        out = tmp_path / f"{number}.csv"
        package = tmp_path / f"{number}.kmz"
        assert main(["c2", "export", *options, "--out", str(out), "--out", str(package)]) == 1  # the conflict
        exported.append(list(csv.reader(out.read_text(encoding="utf-8").splitlines())))
        assert package.stat().st_size > 10_000
        capsys.readouterr()
    assert listed[0] == listed[1] == listed[2]
    assert exported[0] == exported[1] == exported[2]
    assert len(exported[0]) > COUNT - 1
    assert all(row.exported_utc_s is not None for row in archive.images())


def test_files_of_an_image_are_copied_from_the_database(places, tmp_path):
    copies = []
    for number, options in enumerate(places):
        out = tmp_path / f"copy-{number}"
        assert main(["c2", "get", "uuv-1/0002", *options, "--out", str(out)]) == 0
        copies.append({path.name: path.read_bytes() for path in out.iterdir()})
    assert copies[0] == copies[1] == copies[2]
    assert len(copies[0]) == 3
    [side_car] = [json.loads(data) for name, data in copies[1].items() if name.endswith(".json")]
    assert side_car["version"] == 2


def test_console_reads_the_records_of_the_database(places, tmp_path, database_url):
    from sonarpost.archive.address import DatabaseAddress

    def read(place):
        return sorted(record.model_dump_json() for record in stored_records(place))

    from_files = read(tmp_path / "out")
    assert from_files == read(DatabaseAddress.parse(database_url))
    assert len(from_files) == COUNT + 3


def test_database_that_is_not_reached_is_named(capsys):
    assert main(["c2", "ls", "--archive", "postgresql://u:secret@127.0.0.1:9/shore"]) == 2
    captured = capsys.readouterr().err
    assert "database postgresql://u@127.0.0.1:9/shore" in captured
    assert "secret" not in captured
