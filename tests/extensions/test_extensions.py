"""Rules for every extension: a README, entry points that load, tests of its own, requirements that its README names."""

import re
import tomllib
from importlib.metadata import EntryPoint

import check_extensions
import pytest
from builders.common import REPOSITORY

from sonarpost.registry import ENTRY_POINTS_FILE, EXTENSIONS

NAMES = check_extensions.names()


@pytest.mark.parametrize("name", NAMES)
def test_readme_names_the_extensions_that_an_extension_needs(name):
    named = re.findall(r"\]\(\.\./(\w+)/README\.md\)", (EXTENSIONS / name / "README.md").read_text())
    assert check_extensions.requirements(name) == set(named)


@pytest.mark.parametrize("name", NAMES)
def test_every_entry_point_loads(name):
    groups = tomllib.loads((EXTENSIONS / name / ENTRY_POINTS_FILE).read_text())
    assert groups
    for group, points in groups.items():
        for point, value in points.items():
            assert EntryPoint(point, value, group).load() is not None


@pytest.mark.parametrize("name", NAMES)
def test_extension_has_tests(name):
    assert list((REPOSITORY / "tests" / "extensions" / name).rglob("test_*.py"))


def test_every_folder_is_an_extension():
    folders = {path.name for path in EXTENSIONS.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders == set(NAMES)
