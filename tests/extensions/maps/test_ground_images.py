"""Georeferenced images of recordings: positions of echoes and objects, orientation, lines, gaps, memory."""

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from builders import gdal
from builders.survey_lines import ALTITUDE_M, RANGE_M, brightest_px, course, echo_position, line, pixel, with_turn
from builders.surveys import make_xtf

from sonarpost.cli.main import main
from sonarpost.errors import SurveyFileError
from sonarpost.extensions.maps import ground_canvas, track
from sonarpost.extensions.maps.ground_images import write_mosaic, write_waterfalls
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.geometry import Position, offset_position
from sonarpost.sonar.survey import Side

# Mosaic


@pytest.mark.parametrize(("heading_deg", "side"), [(0.0, Side.PORT), (137.0, Side.STARBOARD), (290.0, Side.PORT)])
def test_echo_is_at_its_position_in_a_mosaic(tmp_path, heading_deg, side):
    survey = line(heading_deg, bright=(60, side, 20.0))
    write_mosaic([make_xtf(survey, tmp_path)], tmp_path / "m.tif", 0.1)
    column, row = pixel(tmp_path / "m.tif", echo_position(survey, 60, side, 20.0))
    found = brightest_px(tifffile.imread(tmp_path / "m.tif"), column, row)
    assert math.dist(found, (column, row)) * 0.1 < 0.15


@gdal.needs_gdal
def test_gdal_finds_the_same_place(tmp_path):
    survey = line()
    write_mosaic([make_xtf(survey, tmp_path)], tmp_path / "m.tif", 0.1)
    info = gdal.info(tmp_path / "m.tif")
    assert 'ID["EPSG",32619]' in info["coordinateSystem"]["wkt"]
    assert info["bands"][0]["noDataValue"] == 0
    ((column, row),) = gdal.pixels(tmp_path / "m.tif", [(48.4, -68.8)])
    assert pixel(tmp_path / "m.tif", Position(48.4, -68.8)) == pytest.approx((column, row), abs=0.01)


def test_swath_is_filled_and_nadir_is_not(tmp_path):
    """Across a straight line every pixel of the swath has data, except around the nadir."""
    survey = line(heading_deg=0.0, bright=None, spacing_m=1.0, pings=40)
    write_mosaic([make_xtf(survey, tmp_path)], tmp_path / "m.tif", 0.1)
    column, row = pixel(tmp_path / "m.tif", Position(survey.pings[20].lat_deg, survey.pings[20].lon_deg))
    known = tifffile.imread(tmp_path / "m.tif")[int(row)] > 0
    nadir_px = ALTITUDE_M * math.tan(math.radians(ground_canvas.NADIR_DEG)) / 0.1
    far_px = math.sqrt(RANGE_M**2 - ALTITUDE_M**2) / 0.1
    off = np.abs(np.arange(len(known)) + 0.5 - column)
    assert not known[off < nadir_px - 2].any()
    assert known[(off > nadir_px + 2) & (off < far_px - 3)].all()
    assert not known[off > far_px + 2].any()
    # The mean echo is middle grey.
    write_mosaic([make_xtf(line(bright=None), tmp_path)], tmp_path / "m.tif", 0.5)
    image = tifffile.imread(tmp_path / "m.tif")
    assert np.median(image[image > 0]) == pytest.approx(128, abs=8)


def test_gap_in_the_line_is_not_filled(tmp_path):
    survey = line(heading_deg=90.0, bright=None)
    pings = (*survey.pings[:40], *survey.pings[90:])  # 12.5 m without pings
    path = make_xtf(replace(survey, pings=pings), tmp_path)
    result = write_mosaic([path], tmp_path / "m.tif", 0.1)
    middle = survey.pings[65]
    place = offset_position(Position(middle.lat_deg, middle.lon_deg), 0.0, 15.0)
    column, row = pixel(tmp_path / "m.tif", place)
    assert tifffile.imread(tmp_path / "m.tif")[int(row), int(column)] == 0
    found = [(p.first_ping, p.last_ping, p.line) for p in result.coverage.polygons]
    assert found == [(0, 39, "line"), (90, 119, "line")]


def test_lines_overlap_as_means(tmp_path):
    """Two lines over the same bottom give a pixel the mean of both."""
    one, other = (line(bright=(60, Side.STARBOARD, 20.0), level=level) for level in (60, 25))
    paths = []
    for number, survey in enumerate((one, other)):
        (tmp_path / str(number)).mkdir()
        paths.append(make_xtf(survey, tmp_path / str(number)))
    place = echo_position(one, 60, Side.STARBOARD, 20.0)
    echoes = []
    for chosen in (paths[:1], paths[1:], paths):
        write_mosaic(chosen, tmp_path / "m.tif", 0.1)
        column, row = pixel(tmp_path / "m.tif", place)
        echoes.append(((int(tifffile.imread(tmp_path / "m.tif")[int(row), int(column)]) - 1) / 127) ** 2)
    assert echoes[0] > 1.5 * echoes[1]
    assert echoes[2] == pytest.approx((echoes[0] + echoes[1]) / 2, rel=0.05)


def test_pings_without_navigation_are_left_out(tmp_path):
    survey = line()
    start = tuple(replace(ping, lat_deg=None, lon_deg=None) for ping in survey.pings[:30])
    path = make_xtf(replace(survey, pings=(*start, *survey.pings[30:])), tmp_path)
    result = write_mosaic([path], tmp_path / "m.tif", 0.2)
    assert (result.coverage.pings, result.coverage.left_out) == (90, 30)
    path = make_xtf(replace(survey, pings=start), tmp_path)
    with pytest.raises(SurveyFileError, match="position, heading and altitude"):
        write_mosaic([path], tmp_path / "m.tif", 0.2)


def test_too_large_an_area_is_rejected(tmp_path):
    paths = []
    for number, start in enumerate((Position(48.4, -68.8), Position(10.0, -68.8))):
        (tmp_path / str(number)).mkdir()
        paths.append(make_xtf(line(start=start), tmp_path / str(number)))
    with pytest.raises(SurveyFileError, match="coarser resolution"):
        write_mosaic(paths, tmp_path / "m.tif", 0.1)
    assert not (tmp_path / "m.tif").exists()


def test_tiles_in_a_file_give_the_same_image(tmp_path, monkeypatch):
    path = make_xtf(line(pings=200, bright=None), tmp_path)
    images = []
    for held in (1000, 1):
        monkeypatch.setattr(ground_canvas, "_HELD_TILES", held)
        write_mosaic([path], tmp_path / "m.tif", 0.1)
        images.append((tmp_path / "m.tif").read_bytes())
    assert images[0] == images[1]


def test_command_writes_mosaic_and_coverage(tmp_path, capsys):
    path = make_xtf(line(), tmp_path)
    arguments = ["survey", "mosaic", str(path), "--out", str(tmp_path / "new" / "m.tif"), "--resolution-m", "0.5"]
    assert main([*arguments, "--coverage", str(tmp_path / "c.geojson")]) == 0
    assert "EPSG:32619, 120 pings" in capsys.readouterr().out
    assert (tmp_path / "new" / "m.tif").is_file()
    assert (tmp_path / "c.geojson").is_file()
    for resolution in ("0", "nan", "0.001", "-1"):
        assert main([*arguments[:-1], resolution]) == 2


# Waterfalls of lines


@pytest.mark.parametrize(("heading_deg", "side"), [(0.0, Side.PORT), (30.0, Side.STARBOARD), (290.0, Side.PORT)])
def test_echo_is_at_its_position_in_a_waterfall(tmp_path, heading_deg, side):
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


@pytest.mark.system
@pytest.mark.parametrize(
    "write",
    [lambda path: write_mosaic([path], path.with_name("m.tif"), 0.1), lambda p: write_waterfalls(p, p.parent, 0.1)],
)
def test_memory_does_not_depend_on_the_length(write, tmp_path, monkeypatch):
    """Tiles are moved to a file: a line of three times the length needs no more memory."""
    monkeypatch.setattr(ground_canvas, "_HELD_TILES", 4)
    monkeypatch.setattr(track, "_STRIP_PINGS", 150)
    peaks = []
    for pings in (300, 900):
        path = make_xtf(line(pings=pings, bright=None), tmp_path)
        tracemalloc.start()
        write(path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.15 * peaks[0]
