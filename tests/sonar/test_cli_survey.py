"""`sonarpost survey` with surveys of known content."""

import dataclasses
import json

import numpy as np
import pytest
from builders.surveys import make_xtf
from builders.xtf import write_xtf
from PIL import Image
from pyproj import Transformer

from sonarpost.cli.main import main
from sonarpost.cli.survey.plot import SIDE_PX, angle_normalised, reduce_survey, thinned_track
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.geometry import Position, offset_position
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import InMemorySource
from sonarpost.sonar.survey import ChannelPing, Side


def with_values(survey, **values):
    return dataclasses.replace(survey, pings=tuple(dataclasses.replace(p, **values) for p in survey))


def test_info_states_content_track_length_and_warnings(small_survey, tmp_path, capsys):
    survey = small_survey(pings=101)
    positions = [offset_position(Position(48.0, -68.0), 30.0, row * 2.0) for row in range(101)]
    fixes = [{"lat_deg": at.lat_deg, "lon_deg": at.lon_deg} for at in positions]
    pings = [dataclasses.replace(ping, **fix) for ping, fix in zip(survey, fixes, strict=True)]
    pings[50] = dataclasses.replace(pings[50], lat_deg=None, lon_deg=None)
    info, text = info_of(make_xtf(dataclasses.replace(survey, pings=tuple(pings)), tmp_path), capsys)
    assert (info["pings"], info["fixes"], info["samples"], info["sides"]) == (101, 100, [40], ["port", "starboard"])
    assert info["time_utc"][0].startswith("2013-09-10T21:13:08.1")
    assert info["duration_s"] == pytest.approx(37.0, abs=0.02)
    assert "pings                101" in text
    assert "track_m              198" in text  # positions are summed in steps of at least 5 m: 6 m here
    assert "note: no position fix in 1 of 101 pings, the first in row 50" in text


def info_of(path, capsys, *options):
    assert main(["survey", "info", "--json", str(path), *options]) == 0
    info = json.loads(capsys.readouterr().out)
    assert main(["survey", "info", str(path), *options]) == 0
    text = capsys.readouterr().out
    assert all(f"  hint: {hint}" in text for hint in info["hints"])
    return info, text


def test_info_shows_coordinates_in_metres_and_how_to_name_the_projection(small_survey, tmp_path, capsys):
    survey = small_survey(pings=30)
    write_xtf(survey, tmp_path / "m.xtf", "EPSG:32619")
    to_utm = Transformer.from_crs(4326, 32619, always_xy=True)
    points = [to_utm.transform(p.lon_deg, p.lat_deg) for p in survey]
    info, text = info_of(tmp_path / "m.xtf", capsys)
    eastings, northings = zip(*points, strict=True)
    for axis, values in (("easting", eastings), ("northing", northings)):
        assert info[f"{axis}_m"] == pytest.approx([min(values), max(values)], abs=0.001)
        assert [info[end][axis] for end in ("first_m", "last_m")] == pytest.approx([values[0], values[-1]], abs=0.001)
    assert f"  first_m              easting {points[0][0]:.1f}, northing {points[0][1]:.1f}" in text
    [projection, missing] = info["hints"]
    assert missing == "no positions: contacts have no position"
    assert "name their projection with --crs EPSG:N" in projection
    assert "EPSG:326ZZ at latitude 48.4 N or EPSG:327ZZ at latitude 41.9 S" in projection
    info, _ = info_of(tmp_path / "m.xtf", capsys, "--crs", "EPSG:32619")
    assert info["hints"] == []
    assert info["lat_deg"] == pytest.approx([48.44545, 48.44545 + 29e-6], abs=1e-7)
    assert info["easting_m"] == pytest.approx([min(eastings), max(eastings)], abs=0.001)


def test_info_says_when_a_projection_does_not_fit(small_survey, tmp_path, capsys):
    write_xtf(with_values(small_survey(), lat_deg=85.0, lon_deg=179.0), tmp_path / "m.xtf", "EPSG:3395")
    assert "they are not UTM coordinates" in info_of(tmp_path / "m.xtf", capsys)[0]["hints"][0]
    info, _ = info_of(tmp_path / "m.xtf", capsys, "--crs", "EPSG:32619")
    assert "EPSG:32619 has no position for these eastings and northings" in info["hints"][0]


def test_info_says_what_is_missing(small_survey, tmp_path, capsys):
    def of(**values):
        return info_of(make_xtf(with_values(small_survey(), **values), tmp_path), capsys)[0]

    assert of()["hints"] == []
    assert of(altitude_m=None, heading_deg=None)["hints"] == [
        "heading_deg in none of 5 pings: contacts without a heading have no position",
        "altitude_m in none of 5 pings: it is taken from the first bottom return",
    ]
    assert of(lat_deg=48.0, lon_deg=-68.0)["hints"] == ["the position is the same in every ping"]
    info = of(lat_deg=None, lon_deg=None)
    assert info["hints"] == ["no positions: contacts have no position"]
    assert (info["easting_m"], info["first_m"]) == (None, None)


def test_info_says_that_degrees_are_marked_as_metres(small_survey, tmp_path, capsys):
    path = make_xtf(small_survey(), tmp_path)
    raw = bytearray(path.read_bytes())
    raw[164:166] = bytes(2)
    path.write_bytes(raw)
    assert "look like degrees, but NavUnits" in info_of(path, capsys)[0]["hints"][0]
    raw[164] = 3
    path.write_bytes(raw)
    assert info_of(path, capsys)[0]["hints"] == []


def test_file_cut_by_a_power_failure_is_read_and_a_damaged_one_is_an_error(small_survey, tmp_path, capsys):
    path = make_xtf(small_survey(pings=30, samples=300), tmp_path)
    complete = path.read_bytes()
    path.write_bytes(complete[:-658])
    for command in (["info", "--json"], ["plot", "--out", str(tmp_path)]):
        assert main(["survey", *command, str(path)]) == 0
        printed = capsys.readouterr()
        if "info" in command:
            assert json.loads(printed.out)["pings"] == 29
        assert "the file ends inside its last packet" in printed.out + printed.err
    path.write_bytes(complete[:1024] + bytes(512))
    assert main(["survey", "info", str(path)]) == 2
    assert "marker: got '0000', expected cefa" in capsys.readouterr().err


def test_plot_writes_waterfall_and_track_and_refuses_invalid_arguments(small_survey, tmp_path, capsys):
    path = make_xtf(small_survey(pings=80, samples=300), tmp_path)
    assert main(["survey", "plot", "--ground", "--even", "--rows", "50", "--out", str(tmp_path), str(path)]) == 0
    sizes = []
    for line in capsys.readouterr().out.split():
        with Image.open(line) as image:
            sizes.append(image.size)
    waterfall, track = sizes
    assert waterfall[1] < 120  # 80 pings in 40 rows, plus the scales
    assert track == (800, 800)
    for arguments in (["--rows", "0"], ["--rows", "999999"], ["--even"], ["--options", "absent.toml"]):
        assert main(["survey", "plot", *arguments, str(path)]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_waterfall_shows_echo_at_its_range_and_row(small_survey):
    survey = small_survey(pings=40, samples=500)
    pings = []
    for row, ping in enumerate(survey):
        channels = []
        for side in Side:
            samples = np.full(500, 10, np.uint8)
            if 20 <= row < 22:
                samples[300 if side is Side.PORT else 100] = 250
            channels.append(ChannelPing(side, samples, 25.0))
        pings.append(dataclasses.replace(ping, channels=tuple(channels)))
    source = InMemorySource(dataclasses.replace(survey, pings=tuple(pings)), SurveyOptions())
    reduced = reduce_survey(source, over_ground=False, max_rows=20)
    assert reduced.echo.shape == (20, 2 * SIDE_PX)
    bright = np.argwhere(reduced.echo > 100)
    assert bright.tolist() == [[10, SIDE_PX - 301], [10, SIDE_PX + 100]]
    assert reduced.numbers[10] == survey.pings[20].number
    assert reduced.altitude_m == pytest.approx(np.full(20, 6.25))


def test_ground_range_plot_removes_water_column_and_even_normalises():
    survey = simulate_survey(SurveySpec(seed=1, pings=150, samples=400, targets=0, clutter=0)).survey
    source = InMemorySource(survey, SurveyOptions())
    slant, ground = (reduce_survey(source, over_ground=over, max_rows=75) for over in (False, True))
    middle = slice(SIDE_PX + 5, SIDE_PX + 40)
    assert np.nanmean(slant.echo[:, middle]) < 0.5 * np.nanmean(ground.echo[:, middle])
    even = angle_normalised(ground).echo
    halves = np.nanmean(even[:, SIDE_PX + 60 : SIDE_PX + 200]), np.nanmean(even[:, SIDE_PX + 200 : SIDE_PX + 400])
    assert halves == pytest.approx((1, 1), abs=0.15)


def test_track_is_thinned_evenly_and_keeps_end_points(small_survey):
    ping = small_survey().pings[0]
    track = thinned_track(dataclasses.replace(ping, lat_deg=10 + n * 1e-5) for n in range(30_000))
    assert len(track) <= 4096
    assert (track[0].lat_deg, track[-1].lat_deg) == (10, 10 + 29_999 * 1e-5)
    steps = np.diff([position.lat_deg for position in track])[:-1]
    assert steps.max() == pytest.approx(steps.min())
