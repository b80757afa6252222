"""Registry of readers, plug-in readers, options."""

import importlib.metadata
import sys
import types

import pytest
from builders.surveys import make_xtf
from builders.xtf import write_xtf

from sonarpost import registry
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.sonar import readers
from sonarpost.sonar.options import load_options
from sonarpost.sonar.readers import open_survey, read_survey, recording_parts, supported_suffixes
from sonarpost.sonar.source import InMemorySource


@pytest.fixture
def plug_in(monkeypatch, small_survey):
    """Register a reader of `.abc` and a broken one of `.bad`, like an installed package."""
    module = types.ModuleType("plug_in_sonar")
    module.open_abc = lambda path, options: InMemorySource(small_survey(), options)
    module.open_abc.parts = lambda path: (path, path.with_suffix(".idx"))
    module.not_callable = 7
    monkeypatch.setitem(sys.modules, "plug_in_sonar", module)
    points = [
        importlib.metadata.EntryPoint("abc", "plug_in_sonar:open_abc", readers.ENTRY_POINTS),
        importlib.metadata.EntryPoint("bad", "absent_package:open", readers.ENTRY_POINTS),
        importlib.metadata.EntryPoint("odd", "plug_in_sonar:not_callable", readers.ENTRY_POINTS),
        importlib.metadata.EntryPoint("xtf", "absent_package:open", readers.ENTRY_POINTS),
    ]
    monkeypatch.setattr(registry, "installed_points", lambda group: points if group == readers.ENTRY_POINTS else [])
    readers.survey_readers.cache_clear()
    yield
    readers.survey_readers.cache_clear()


@pytest.mark.usefixtures("plug_in")
def test_plug_in_reader_opens_its_suffix(tmp_path, small_survey):
    assert {".abc", ".bad", ".xtf"} <= set(supported_suffixes())
    assert recording_parts(tmp_path / "line.abc") == (tmp_path / "line.abc", tmp_path / "line.idx")
    assert recording_parts(tmp_path / "line.xtf") == (tmp_path / "line.xtf",)
    assert len(read_survey(tmp_path / "line.ABC").pings) == 5
    with pytest.raises(SurveyFileError, match=r"survey_readers:bad: got .absent_package:open .Mod"):
        open_survey(tmp_path / "line.bad")
    with pytest.raises(SurveyFileError, match="a function"):
        open_survey(tmp_path / "line.odd")
    # Readers of this package are not replaced.
    assert len(read_survey(make_xtf(small_survey(), tmp_path)).pings) == 5


def test_reader_registry(small_survey, tmp_path):
    write_xtf(small_survey(), tmp_path / "A.XTF")
    assert len(read_survey(tmp_path / "A.XTF").pings) == 5
    assert supported_suffixes() == (".dat", ".jsf", ".sdf", ".sl2", ".sl3", ".svlog", ".waterfall.toml", ".xtf")
    with pytest.raises(SurveyFileError, match=r"suffix: got '.abc', expected .*\.xtf"):
        read_survey(tmp_path / "a.abc")


def test_options_are_read_from_file(tmp_path):
    path = tmp_path / "o.toml"
    path.write_text('projected_crs = "EPSG:32619"\n[mounting]\nlayback_m = 12\n[errors]\nposition_m = 0.5\n')
    options = load_options(path)
    assert options.mounting.ahead_m == -12
    assert options.errors.position_m == 0.5
    assert options.projected_crs == "EPSG:32619"
    with pytest.raises(ConfigError, match="No such file"):
        load_options(tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("[mounting]\nlayback = 3", "mounting.layback"),
        ("[mounting]\nlayback_m = -3", "mounting.layback_m"),
        ("[mounting]\nforward_m = nan", "mounting.forward_m"),
        ("[errors]\nposition_m = inf", "errors.position_m"),
        ('position_source = "fish"', "position_source"),
        ("x = [", "TOML"),
        ("#" * 100_000, "file size"),
    ],
)
def test_error_names_invalid_option(tmp_path, text, field):
    (tmp_path / "o.toml").write_text(text)
    with pytest.raises(ConfigError, match=field):
        load_options(tmp_path / "o.toml")
