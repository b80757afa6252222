"""Archives of both dialects, for the contract of their tests."""

import pytest

from sonarpost.archive.address import DatabaseAddress
from sonarpost.archive.reader import open_archive


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.system)])
def open_(request, tmp_path):
    """Opens archives that share their records."""
    is_sqlite = request.param == "sqlite"
    place = tmp_path / "out" if is_sqlite else DatabaseAddress.parse(request.getfixturevalue("database_url"))
    made = []

    def open_one(owner="c2-a", **options):
        made.append(open_archive(place, owner=owner, **options))
        return made[-1]

    yield open_one
    for each in made:
        each.close()


@pytest.fixture
def archive(open_):
    return open_()
