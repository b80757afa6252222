"""Each surface of the product has an attack: a row of `builders.hostile_rows`."""

from fnmatch import fnmatchcase

from builders.common import REPOSITORY
from builders.hostile_rows import rows
from builders.surfaces import surfaces


def test_each_surface_has_a_row():
    patterns = {pattern for row in rows() for pattern in row.surface}
    found = surfaces()
    assert {surface for surface in found if not any(fnmatchcase(surface, pattern) for pattern in patterns)} == set()
    assert {pattern for pattern in patterns if not any(fnmatchcase(surface, pattern) for surface in found)} == set()


def test_tests_that_rows_name_exist():
    assert [
        row.function for row in rows() if isinstance(row.function, str) and not (REPOSITORY / row.function).is_file()
    ] == []
