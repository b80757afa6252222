"""Fixtures of the tests of c2: its archives, its services and readers of its archive."""

import pytest
from builders.shore import Reader

from sonarpost.services.c2 import queries
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def open_files(out):
    """Opens archives of files in `out`."""
    made = []

    def open_(**options):
        made.append(Archive(C2Config(out_dir=out, **options)))
        return made[-1]

    yield open_
    for each in made:
        each.close()


@pytest.fixture(params=["files", pytest.param("postgresql", marks=pytest.mark.system)])
def open_archive(request, out):
    """Opens archives of both kinds."""
    url = None if request.param == "files" else request.getfixturevalue("database_url")
    made = []

    def open_(**options):
        made.append(Archive(C2Config(out_dir=out, database=url, **options), "c2-a"))
        made[-1].open()
        return made[-1]

    yield open_
    for each in made:
        each.close()


@pytest.fixture
def begin(runner, platform, out):
    """Starts c2 with an archive of files."""
    return lambda **options: runner.start(C2Service(platform("shore-1"), C2Config(**{"out_dir": out, **options})))


@pytest.fixture
def relay(runner):
    return runner.peer("vessel-1", "relay")


@pytest.fixture
def fast_queries(monkeypatch):
    """Permit more queries a second than clients may send."""
    monkeypatch.setattr(queries, "BURST", 1e9)


@pytest.fixture
def reading(client):
    """Starts readers."""
    opened = []

    def start(*arguments, **options):
        opened.append(Reader(client, *arguments, **options))
        return opened[-1]

    yield start
    for reader in opened:
        reader.close()
        assert reader.error is None
