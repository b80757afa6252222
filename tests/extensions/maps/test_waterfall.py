"""Georeferenced waterfall: position of echoes and objects, orientation, lines, memory."""

import math
import tracemalloc
from dataclasses import replace

import pytest
import tifffile
from builders import gdal
from builders.survey_lines import brightest_px, course, echo_position, line, pixel, with_turn
from builders.surveys import make_xtf

from sonarpost.cli.main import main
from sonarpost.errors import SurveyFileError
from sonarpost.extensions.maps import ground_canvas, track
from sonarpost.extensions.maps.ground_images import write_waterfalls
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.survey import Side


@pytest.mark.parametrize(("heading_deg", "side"), [(0.0, Side.PORT), (30.0, Side.STARBOARD), (290.0, Side.PORT)])
def test_echo_is_at_its_georeferenced_position(tmp_path, heading_deg, side):
    survey = line(heading_deg, bright=(60, side, 20.0))
    (waterfall,) = write_waterfalls(make_xtf(survey, tmp_path), tmp_path, 0.1)
    assert waterfall.path == tmp_path / "line-waterfall-1.tif"
    assert (waterfall.first_ping, waterfall.last_ping) == (0, 119)
    places = [echo_position(survey, 60, side, 20.0), *(survey.pings[row] for row in (0, 60, 119))]
    (column, row), first, middle, last = (pixel(waterfall.path, place) for place in places)
    found = brightest_px(tifffile.imread(waterfall.path), column, row)
    assert math.dist(found, (column, row)) * 0.1 < 0.15
    # The line goes straight up; port is on the left.
    assert first[0] == pytest.approx(last[0], abs=0.5)
    assert first[1] - last[1] == pytest.approx(119 * 0.25 / 0.1, rel=2e-3)
    assert (column < middle[0]) is (side is Side.PORT)


@gdal.needs_gdal
def test_gdal_places_simulated_objects_within_1_m(tmp_path):
    """The track of the simulator is not straight; highlights are at the near edge of their object."""
    simulated = simulate_survey(SurveySpec(seed=1, pings=400, targets=4, clutter=0), speckle=False)
    (waterfall,) = write_waterfalls(make_xtf(simulated.survey, tmp_path), tmp_path, 0.1)
    image = tifffile.imread(waterfall.path)
    places = gdal.pixels(waterfall.path, [(item.lat_deg, item.lon_deg) for item in simulated.truth])
    assert len(places) == 4
    for column, row in places:
        assert math.dist(brightest_px(image, column, row), (column, row)) * 0.1 < 1.0


@gdal.needs_bindings
def test_gdal_accepts_the_layout(tmp_path):
    survey = line(pings=300, bright=None)
    (waterfall,) = write_waterfalls(make_xtf(survey, tmp_path), tmp_path, 0.1)
    assert max(waterfall.size_px) > 512
    assert gdal.cloud_optimised_problems(waterfall.path) == "([], [])"
    described = gdal.info(waterfall.path)
    assert 'ID["EPSG",32619]' in described["coordinateSystem"]["wkt"]
    # A rotation without reflection.
    _, cx, rx, _, cy, ry = described["geoTransform"]
    assert (cx, rx) == pytest.approx((-ry, cy))
    assert math.hypot(cx, cy) == pytest.approx(0.1)


def test_lines_are_separate_and_the_turn_is_left_out(tmp_path):
    path = make_xtf(with_turn(radius_m=5.0), tmp_path)
    first, second = write_waterfalls(path, tmp_path, 0.2)
    assert [w.path.name for w in (first, second)] == ["line-waterfall-1.tif", "line-waterfall-2.tif"]
    assert first.first_ping == 0
    assert 119 <= first.last_ping <= 135
    assert 135 <= second.first_ping <= 151
    assert second.last_ping == 270
    for waterfall in (first, second):
        image = tifffile.imread(waterfall.path)
        assert image.shape == waterfall.size_px
        # Both sides of the swath but the nadir, over most of the length.
        assert (image[: image.shape[0] * 3 // 4] > 0).any(axis=1).mean() > 0.9


def test_gap_divides_a_line_and_a_single_wrong_heading_does_not(tmp_path):
    survey = course([0.0] * 300)
    pings = list(survey.pings)
    pings[60] = replace(pings[60], heading_deg=90.0)
    path = make_xtf(replace(survey, pings=(*pings[:120], *pings[170:])), tmp_path)
    waterfalls = write_waterfalls(path, tmp_path, 0.5)
    assert [(w.first_ping, w.last_ping) for w in waterfalls] == [(0, 119), (170, 299)]


def test_no_row_is_empty_where_strips_join(tmp_path, monkeypatch):
    monkeypatch.setattr(track, "_STRIP_PINGS", 100)
    (waterfall,) = write_waterfalls(make_xtf(line(pings=200, bright=None), tmp_path), tmp_path, 0.2)
    assert waterfall.last_ping == 199
    image = tifffile.imread(waterfall.path)
    assert (image > 0).any(axis=1).sum() * 0.2 == pytest.approx(199 * 0.25, abs=0.5)


@pytest.mark.system
def test_memory_does_not_depend_on_the_length(tmp_path, monkeypatch):
    monkeypatch.setattr(ground_canvas, "_HELD_TILES", 4)
    monkeypatch.setattr(track, "_STRIP_PINGS", 150)
    peaks = []
    for pings in (300, 900):
        path = make_xtf(line(pings=pings, bright=None), tmp_path)
        tracemalloc.start()
        write_waterfalls(path, tmp_path, 0.1)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.15 * peaks[0]


def test_recording_without_line_is_rejected(tmp_path):
    survey = line(pings=30)
    bare = replace(survey, pings=tuple(replace(ping, lat_deg=None, lon_deg=None) for ping in survey.pings))
    for changed, message in ((survey, "straight line of at least 20 m"), (bare, "position, heading and altitude")):
        with pytest.raises(SurveyFileError, match=message):
            write_waterfalls(make_xtf(changed, tmp_path), tmp_path, 0.1)


def test_command_prints_the_files(tmp_path, capsys):
    path = make_xtf(line(), tmp_path)
    arguments = ["survey", "waterfall", str(path), "--out", str(tmp_path / "new"), "--resolution-m", "0.5"]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{tmp_path / 'new' / 'line-waterfall-1.tif'}: ")
    assert out.endswith("px of 0.5 m, EPSG:32619, pings 0 to 119\n")
    for resolution in ("0", "nan", "0.001"):
        assert main([*arguments[:-1], resolution]) == 2
