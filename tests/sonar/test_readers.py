"""Readers of others, options, recordings in blocks."""

from __future__ import annotations

import importlib.metadata
import sys
import types

import pytest
from builders.surveys import make_xtf

from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.sonar import readers
from sonarpost.sonar.options import SurveyOptions, load_options
from sonarpost.sonar.readers import open_survey, read_survey, supported_suffixes
from sonarpost.sonar.source import InMemorySource, blocks, load_survey


@pytest.fixture
def plug_in(monkeypatch, small_survey):
    """Installs a reader of `.jsf` and a broken one of `.sdf`, as packages would."""
    module = types.ModuleType("others_sonar")
    module.open_jsf = lambda path, options: InMemorySource(small_survey(), options)
    module.not_callable = 7
    monkeypatch.setitem(sys.modules, "others_sonar", module)
    points = [
        importlib.metadata.EntryPoint("jsf", "others_sonar:open_jsf", readers.ENTRY_POINTS),
        importlib.metadata.EntryPoint("sdf", "absent_package:open", readers.ENTRY_POINTS),
        importlib.metadata.EntryPoint("odd", "others_sonar:not_callable", readers.ENTRY_POINTS),
        importlib.metadata.EntryPoint("xtf", "absent_package:open", readers.ENTRY_POINTS),
    ]
    monkeypatch.setattr(readers, "entry_points", lambda group: points if group == readers.ENTRY_POINTS else [])
    readers._plug_ins.cache_clear()
    yield
    readers._plug_ins.cache_clear()


@pytest.mark.usefixtures("plug_in")
def test_a_plug_in_opens_its_suffix(tmp_path, small_survey):
    assert {".jsf", ".sdf", ".xtf"} <= set(supported_suffixes())
    assert len(read_survey(tmp_path / "line.JSF").pings) == 5
    with pytest.raises(SurveyFileError, match=r"survey reader sdf: got .absent_package:open: ModuleNotFoundError"):
        open_survey(tmp_path / "line.sdf")
    with pytest.raises(SurveyFileError, match="a callable"):
        open_survey(tmp_path / "line.odd")
    # What comes with the package is not replaced.
    assert len(read_survey(make_xtf(small_survey(), tmp_path)).pings) == 5


@pytest.mark.parametrize(("length", "overlap"), [(1, 0), (3, 0), (3, 2), (5, 5), (12, 0), (12, 3), (100, 9), (2, 7)])
def test_blocks_hold_every_ping_once_and_their_neighbours(small_survey, length, overlap):
    source = InMemorySource(small_survey(pings=12), SurveyOptions())
    new = []
    for lead, survey in blocks(source, length, overlap):
        numbers = [ping.number for ping in survey]
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
        mine = numbers[lead : lead + length]
        assert lead == min(overlap, mine[0] - 10)
        assert numbers[-1] == min(mine[-1] + overlap, 21)
        new += mine
    assert new == list(range(10, 22))


def test_blocks_of_nothing_are_refused(small_survey):
    source = InMemorySource(small_survey(), SurveyOptions())
    for length, overlap in ((0, 0), (1, -1)):
        with pytest.raises(ValueError, match="block"):
            list(blocks(source, length, overlap))


def test_too_much_to_hold_is_an_error(small_survey):
    source = InMemorySource(small_survey(), SurveyOptions())
    assert len(load_survey(source, 400).pings) == 5
    with pytest.raises(SurveyFileError, match="samples"):
        load_survey(source, 399)


def test_options_from_a_file(tmp_path):
    path = tmp_path / "o.toml"
    path.write_text('projected_crs = "EPSG:32619"\n[mounting]\nlayback_m = 12\n[errors]\nposition_m = 0.5\n')
    options = load_options(path)
    assert options.mounting.ahead_m == -12
    assert options.errors.position_m == 0.5
    assert options.projected_crs == "EPSG:32619"


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("[mounting]\nlayback = 3", "mounting.layback"),
        ("[mounting]\nlayback_m = -3", "mounting.layback_m"),
        ("[mounting]\nforward_m = nan", "mounting.forward_m"),
        ("[errors]\nposition_m = inf", "errors.position_m"),
        ('position_source = "fish"', "position_source"),
        ("x = [", "TOML"),
    ],
)
def test_bad_options_are_named(tmp_path, text, field):
    (tmp_path / "o.toml").write_text(text)
    with pytest.raises(ConfigError, match=field):
        load_options(tmp_path / "o.toml")


def test_options_that_are_not_there(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        load_options(tmp_path / "absent.toml")
    (tmp_path / "big.toml").write_bytes(b"#" * 100_000)
    with pytest.raises(ConfigError, match="file size"):
        load_options(tmp_path / "big.toml")
