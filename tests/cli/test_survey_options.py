"""Survey options: one file and one pair of options for `detect`, `survey`, `run atd_stub` and the vehicle."""

import json
import os
import runpy

import pytest
from builders.surveys import small_survey
from builders.xtf import write_xtf
from pyproj import Transformer

from sonarpost.cli.main import main, parser
from sonarpost.cli.shared import survey_options_of
from sonarpost.config import load
from sonarpost.errors import ConfigError
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.sonar.options import SurveyOptions, load_options
from sonarpost.sonar.readers import read_survey

EVERY_OPTION = """
projected_crs = "EPSG:32616"
frequency_hz = 455e3
heading_source = "gyro"
position_source = "ship"
recorded_layback = "ignore"
port_order = "nearest_first"
humminbird_sample_spacing_m = 0.02
humminbird_depth_as_altitude = true
mounting = { forward_m = 0.4, starboard_m = -0.1, layback_m = 3, heading_offset_deg = 180.0 }
[errors]
position_m = 1.5
heading_deg = 1
gyro_heading_deg = 2
course_heading_deg = 6
altitude_m = 0.1
tracked_altitude_m = 0.7
sound_speed = 0.02
bottom_slope_deg = 1.0
time_s = 0.1
layback_m = 2.0
"""
WRONG = [
    (["--crs", "EPSG:4326"], "--crs: projected_crs: got 'EPSG:4326', expected a projected coordinate system"),
    (["--crs", "nonsense"], "--crs: projected_crs: got 'nonsense', expected a projected coordinate system"),
    (["--options", "absent.toml"], "absent.toml: got 'No such file or directory'"),
]


@pytest.fixture
def options(tmp_path):
    (tmp_path / "line options.toml").write_text(EVERY_OPTION)
    return tmp_path / "line options.toml"


@pytest.fixture
def config(tmp_path):
    (tmp_path / "uuv.toml").write_text('[platform]\nid = "uuv-1"\n[atd_stub]\nprojected_crs = "EPSG:32620"\n')
    return tmp_path / "uuv.toml"


def as_options(config):
    return SurveyOptions(**{name: getattr(config, name) for name in SurveyOptions.model_fields})


def test_the_example_sets_every_option(options):
    given, default = load_options(options), SurveyOptions()
    for name in SurveyOptions.model_fields:
        assert getattr(given, name) != getattr(default, name), name
    for part in (given.mounting, given.errors):
        assert part.model_fields_set == type(part).model_fields.keys()


@pytest.mark.parametrize("crs", [[], ["--crs", "EPSG:32617"]])
def test_every_command_and_the_vehicle_use_the_same_options(crs, options, tmp_path, monkeypatch, config):
    given = ["--options", str(options), *crs]
    want = load_options(options).model_copy(update={"projected_crs": (crs or ["", "EPSG:32616"])[1]})
    for command in (["detect", "x.xtf"], *(["survey", name, "x.xtf"] for name in ("info", "plot"))):
        assert survey_options_of(parser(command[0]).parse_args([*command, *given])) == want

    found = []

    def run_module(name, **_):
        assert name == "sonarpost.services.atd_stub"
        found.append(load(config, "atd_stub", AtdStubConfig, os.environ)[1])

    monkeypatch.setattr(runpy, "run_module", run_module)
    monkeypatch.setattr(os, "environ", dict(os.environ))
    assert main(["run", "atd_stub", "--config", str(config), *given]) == 0
    assert [as_options(each) for each in found] == [want]


def test_keys_of_the_vehicle_can_be_in_a_file_or_in_the_table(options, tmp_path):
    def vehicle(table):
        (tmp_path / "uuv.toml").write_text(f'[platform]\nid = "uuv-1"\n[atd_stub]\n{table}')
        return load(tmp_path / "uuv.toml", "atd_stub", AtdStubConfig, {})[1]

    in_table = EVERY_OPTION.replace("[errors]", "[atd_stub.errors]")
    named = f"survey_options = {json.dumps(str(options))}\n"
    assert as_options(vehicle(in_table)) == as_options(vehicle(named)) == load_options(options)
    assert vehicle(named + 'projected_crs = "EPSG:32617"').projected_crs == "EPSG:32617"
    with pytest.raises(ConfigError, match=r"atd_stub: mounting, port_order: got 'keys beside survey_options'"):
        vehicle(named + 'port_order = "farthest_first"\nmounting = { forward_m = 1.0 }')
    with pytest.raises(ConfigError, match=r"uuv\.toml:4: atd_stub\.projected_crs: got 'EPSG:4326'"):
        vehicle('projected_crs = "EPSG:4326"')
    options.write_text("[mounting]\nlayback_m = -1\n")
    with pytest.raises(ConfigError, match=r"line options\.toml: mounting\.layback_m: got -1"):
        vehicle(named)


@pytest.mark.parametrize(
    ("command", "given", "message"),
    [("detect", *each) for each in WRONG] + [(name, *WRONG[0]) for name in ("survey info", "survey plot", "run")],
)
def test_wrong_options_are_one_line_before_any_work(command, given, message, tmp_path, config, capsys):
    (tmp_path / "a.xtf").write_bytes(b"not read before the options are valid")
    file = ["atd_stub", "--config", str(config)] if command == "run" else [str(tmp_path / "a.xtf")]
    assert main([*command.split(), *file, *given]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert message in line


def test_other_services_take_no_survey_options(tmp_path, config, capsys):
    assert main(["run", "compressor", "--config", str(config), "--crs", "EPSG:32616"]) == 2
    assert "survey options for atd_stub only" in capsys.readouterr().err


def test_positions_in_metres_are_those_of_pyproj(tmp_path):
    survey = small_survey(pings=60, samples=64)
    write_xtf(survey, tmp_path / "metres.xtf", projected_crs="EPSG:32616")
    stored = read_survey(tmp_path / "metres.xtf", SurveyOptions(projected_crs="EPSG:32616"))
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32616", always_xy=True)
    to_degrees = Transformer.from_crs("EPSG:32616", "EPSG:4326", always_xy=True)
    for ping, want in zip(stored, survey, strict=True):
        lon_deg, lat_deg = to_degrees.transform(*to_utm.transform(want.lon_deg, want.lat_deg))
        assert (ping.lat_deg, ping.lon_deg) == pytest.approx((lat_deg, lon_deg), abs=1e-9)
        assert (ping.lat_deg, ping.lon_deg) == pytest.approx((want.lat_deg, want.lon_deg), abs=1e-6)


@pytest.mark.system
@pytest.mark.realdata
def test_a_recorded_wreck_in_metres_has_the_same_contacts_and_positions(data_dir, tmp_path, capsys):
    recorded = data_dir / "surveys" / "scotsman-iver2.xtf"
    write_xtf(read_survey(recorded), tmp_path / recorded.name, projected_crs="EPSG:32616")
    contacts = []
    for path, crs in ((recorded, []), (tmp_path / recorded.name, ["--crs", "EPSG:32616"])):
        assert main(["detect", "--json", str(path), *crs]) == 0
        contacts.append(json.loads(capsys.readouterr().out)["files"][0]["contacts"])
    assert len(contacts[0]) == len(contacts[1]) >= 4
    for one, other in zip(*contacts, strict=True):
        assert other["atd_confidence"] == pytest.approx(one["atd_confidence"], abs=1e-6)
        assert (other["lat_deg"], other["lon_deg"]) == pytest.approx((one["lat_deg"], one["lon_deg"]), abs=1e-6)
