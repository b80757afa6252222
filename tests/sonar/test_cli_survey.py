"""`sonarpost survey` with surveys of known content."""

from __future__ import annotations

import csv
import dataclasses
import io
import json

import numpy as np
import pytest
from builders.surveys import MAKERS, make_xtf
from PIL import Image

from sonarpost.cli.main import main
from sonarpost.cli.survey.plot import SIDE_PX, angle_normalised, nice_step, reduce_survey, thinned_track
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.geometry import Position, offset_position
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import InMemorySource
from sonarpost.sonar.survey import ChannelPing, Side


@pytest.mark.parametrize("kind", sorted(MAKERS))
def test_info_reads_every_format(kind, small_survey, tmp_path, capsys):
    path = MAKERS[kind](small_survey(), tmp_path)
    assert main(["survey", "info", "--json", str(path)]) == 0
    info = json.loads(capsys.readouterr().out)
    assert (info["pings"], info["fixes"], info["samples"]) == (5, 5, [40])
    assert info["sides"] == ["port", "starboard"]
    assert info["time_utc"][0].startswith("2013-09-10T21:13:08.1")
    assert info["duration_s"] == pytest.approx(1.48, abs=0.02)
    assert main(["survey", "info", str(path)]) == 0
    assert "pings                5" in capsys.readouterr().out


def test_info_shows_track_length_and_warnings(small_survey, tmp_path, capsys):
    survey = small_survey(pings=101)
    origin = Position(48.0, -68.0)
    positions = [offset_position(origin, 30.0, row * 2.0) for row in range(101)]
    pings = [
        dataclasses.replace(ping, lat_deg=at.lat_deg, lon_deg=at.lon_deg)
        for ping, at in zip(survey, positions, strict=True)
    ]
    pings[50] = dataclasses.replace(pings[50], lat_deg=None, lon_deg=None)
    path = make_xtf(dataclasses.replace(survey, pings=tuple(pings)), tmp_path)
    assert main(["survey", "info", str(path)]) == 0
    output = capsys.readouterr().out
    assert "track_m              198" in output  # positions are summed in steps of at least 5 m: 6 m here
    assert "note: no position fix in 1 of 101 pings, the first in row 50" in output


def test_export_csv(small_survey, tmp_path, capsys):
    survey = small_survey()
    without_fix = dataclasses.replace(survey.pings[2], lat_deg=None, lon_deg=None)
    path = make_xtf(dataclasses.replace(survey, pings=(*survey.pings[:2], without_fix, *survey.pings[3:])), tmp_path)
    assert main(["survey", "export", str(path)]) == 0
    lines = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [float(line["number"]) for line in lines] == [10, 11, 12, 13, 14]
    assert lines[2]["lat_deg"] == ""
    assert float(lines[3]["lat_deg"]) == pytest.approx(survey.pings[3].lat_deg, abs=1e-8)
    assert lines[0]["time_utc"] == "2013-09-10T21:13:08.130Z"


def test_export_geojson_splits_track_at_gaps_and_antimeridian(small_survey, tmp_path):
    start = small_survey().pings[0]
    fixes = [(0, 179.9995), (1, 179.9999), (2, -179.9998), (3, -179.9994), (200, -179.9990)]
    pings = tuple(
        dataclasses.replace(start, number=n, time_utc_s=start.time_utc_s + s, lon_deg=lon)
        for n, (s, lon) in enumerate(fixes)
    )
    path = make_xtf(dataclasses.replace(small_survey(), pings=pings), tmp_path)
    out = tmp_path / "track.geojson"
    assert main(["survey", "export", "--format", "geojson", "--out", str(out), str(path)]) == 0
    features = json.loads(out.read_text())["features"]
    assert [f["geometry"]["type"] for f in features] == ["LineString", "LineString", "Point"]
    assert features[0]["geometry"]["coordinates"] == [[179.9995, 48.44545], [179.9999, 48.44545]]
    assert features[1]["properties"]["first_ping"] == 2


def test_track_without_fixes_is_empty_collection(small_survey, tmp_path, capsys):
    pings = tuple(dataclasses.replace(p, lat_deg=None, lon_deg=None) for p in small_survey())
    path = make_xtf(dataclasses.replace(small_survey(), pings=pings), tmp_path)
    assert main(["survey", "export", "--format", "geojson", str(path)]) == 0
    assert json.loads(capsys.readouterr().out) == {"type": "FeatureCollection", "features": []}
    assert main(["survey", "plot", "--out", str(tmp_path), str(path)]) == 0


def test_failed_export_leaves_no_file(small_survey, tmp_path, capsys):
    path = make_xtf(small_survey(), tmp_path)
    path.write_bytes(path.read_bytes()[:-7])
    assert main(["survey", "export", "--out", str(tmp_path / "t.csv"), str(path)]) == 2
    assert "truncated" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["line.xtf"]


def test_plot_writes_waterfall_and_track(small_survey, tmp_path, capsys):
    path = make_xtf(small_survey(pings=80, samples=300), tmp_path)
    assert main(["survey", "plot", "--ground", "--even", "--rows", "50", "--out", str(tmp_path), str(path)]) == 0
    sizes = []
    for line in capsys.readouterr().out.split():
        with Image.open(line) as image:
            sizes.append(image.size)
    waterfall, track = sizes
    assert waterfall[1] < 120  # 80 pings in 40 rows, plus the scales
    assert track == (800, 800)


@pytest.mark.parametrize("arguments", [["--rows", "0"], ["--rows", "999999"], ["--even"], ["--options", "absent.toml"]])
def test_invalid_arguments_print_one_line(small_survey, tmp_path, capsys, arguments):
    path = make_xtf(small_survey(), tmp_path)
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
    reduced = reduce_survey(
        InMemorySource(dataclasses.replace(survey, pings=tuple(pings)), SurveyOptions()), over_ground=False, max_rows=20
    )
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


@pytest.mark.parametrize(("target", "step"), [(7.3, 5), (2, 2), (1.9, 1), (0.06, 0.05), (10, 10), (499, 200)])
def test_scale_steps_are_round_numbers(target, step):
    assert nice_step(target) == pytest.approx(step)
