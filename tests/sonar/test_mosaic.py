"""Mosaic and GeoTIFF: georeference, cloud-optimised layout, gaps, coverage, memory. GDAL is the oracle."""

from __future__ import annotations

import math
import subprocess
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from builders import gdal
from builders.survey_lines import ALTITUDE_M, RANGE_M, SAMPLES, line
from builders.surveys import make_xtf
from pyproj import Transformer

from sonarpost.cli.main import main
from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position, georeference, offset_position
from sonarpost.sonar.maps import geotiff, ground_canvas, track
from sonarpost.sonar.maps.geotiff import GeoTransform, write_image, write_tiles
from sonarpost.sonar.maps.mosaic import utm_epsg, write_mosaic
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import Side


def pixel(path, position):
    """Return column and row of a position in an image, by its tags."""
    with tifffile.TiffFile(path) as file:
        tags = file.pages[0].tags
        epsg = tags["GeoKeyDirectoryTag"].value[15]
        scale, tie = tags["ModelPixelScaleTag"].value, tags["ModelTiepointTag"].value
    east, north = Transformer.from_crs(4326, epsg, always_xy=True).transform(position.lon_deg, position.lat_deg)
    return (east - tie[3]) / scale[0], (tie[4] - north) / scale[1]


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, 137.0, 290.0])
@pytest.mark.parametrize("side", list(Side))
def test_echo_is_at_its_georeferenced_position(tmp_path, heading_deg, side):
    survey = line(heading_deg, bright=(60, side, 20.0))
    write_mosaic([make_xtf(survey, tmp_path)], tmp_path / "m.tif", 0.1)
    sample = math.hypot(20.0, ALTITUDE_M) / RANGE_M * SAMPLES - 0.5
    want = georeference(survey.pings[60], side, sample, SurveyOptions())
    column, row = pixel(tmp_path / "m.tif", want.position)
    image = tifffile.imread(tmp_path / "m.tif").astype(float)
    window = image[int(row) - 15 : int(row) + 16, int(column) - 15 : int(column) + 16]
    lines, columns = np.nonzero(window > 230)
    assert len(lines) > 4
    off_px = math.hypot(lines.mean() + 0.5 - 15 - row % 1, columns.mean() + 0.5 - 15 - column % 1)
    assert off_px * 0.1 < 0.15


@gdal.needs_gdal
def test_gdal_finds_the_same_place(tmp_path):
    survey = line()
    write_mosaic([make_xtf(survey, tmp_path)], tmp_path / "m.tif", 0.1)
    info = gdal.info(tmp_path / "m.tif")
    assert 'ID["EPSG",32619]' in info["coordinateSystem"]["wkt"]
    assert info["bands"][0]["noDataValue"] == 0
    found = subprocess.run(
        ["gdallocationinfo", "-wgs84", "-xml", str(tmp_path / "m.tif"), "-68.8", "48.4"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    column, row = pixel(tmp_path / "m.tif", Position(48.4, -68.8))
    assert f'pixel="{int(column)}" line="{int(row)}"' in found


@gdal.needs_bindings
@pytest.mark.parametrize("size_px", [(1, 1), (512, 512), (513, 5), (1500, 2300)])
@pytest.mark.parametrize("is_big", [False, True])
def test_gdal_accepts_the_layout_as_cloud_optimised(tmp_path, monkeypatch, size_px, is_big):
    if is_big:
        monkeypatch.setattr(geotiff, "_CLASSIC_BYTES", 0)
    image = np.random.default_rng(0).integers(0, 256, size_px, dtype=np.uint8)
    path = tmp_path / "m.tif"
    write_image(path, image, GeoTransform(32619, (5e5, 5.3e6), (0.5, 0.0), (0.0, -0.5)))
    assert gdal.cloud_optimised_problems(path) == "([], [])"
    np.testing.assert_array_equal(tifffile.imread(path), image)
    with tifffile.TiffFile(path) as file:
        assert file.is_bigtiff is is_big


def test_overviews_are_means_of_pixels_with_data(tmp_path):
    image = np.zeros((600, 600), np.uint8)
    image[:2, :4] = [[100, 0, 10, 20], [50, 0, 30, 41]]
    write_image(tmp_path / "m.tif", image, GeoTransform(32619, (5e5, 5.3e6), (1.0, 0.0), (0.0, -1.0)))
    with tifffile.TiffFile(tmp_path / "m.tif") as file:
        assert [page.shape for page in file.pages] == [(600, 600), (300, 300)]
        reduced = file.pages[1].asarray()
    assert reduced[0, :3].tolist() == [75, 25, 0]


@gdal.needs_gdal
def test_rotated_image_has_a_transformation(tmp_path):
    angle = math.radians(30)
    column, row = (math.cos(angle), math.sin(angle)), (math.sin(angle), -math.cos(angle))
    write_image(tmp_path / "r.tif", np.ones((4, 5), np.uint8), GeoTransform(32619, (5e5, 5.3e6), column, row))
    got = gdal.info(tmp_path / "r.tif")["geoTransform"]
    assert got == pytest.approx([5e5, column[0], row[0], 5.3e6, column[1], row[1]])


@pytest.mark.parametrize("size_px", [(0, 5), (5, 0), (1 << 20, 1 << 20)])
def test_impossible_image_size_is_rejected(tmp_path, size_px):
    transform = GeoTransform(32619, (0.0, 0.0), (1.0, 0.0), (0.0, -1.0))
    with pytest.raises(ValueError, match="tiles"):
        write_tiles(tmp_path / "m.tif", size_px, lambda row, column: np.zeros((512, 512), np.uint8), transform)


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


def test_mean_echo_is_middle_grey(tmp_path):
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
    assert [(p.first_ping, p.last_ping, p.line) for p in result.coverage.polygons] == [
        (0, 39, "line"),
        (90, 119, "line"),
    ]


def test_lines_overlap_as_means(tmp_path):
    """Two lines over the same bottom give a pixel the mean of both."""
    one, other = (line(bright=(60, Side.STARBOARD, 20.0), level=level) for level in (60, 25))
    paths = []
    for number, survey in enumerate((one, other)):
        (tmp_path / str(number)).mkdir()
        paths.append(make_xtf(survey, tmp_path / str(number)))
    sample = math.hypot(20.0, ALTITUDE_M) / RANGE_M * SAMPLES - 0.5
    place = georeference(one.pings[60], Side.STARBOARD, sample, SurveyOptions()).position
    echoes = []
    for chosen in (paths[:1], paths[1:], paths):
        write_mosaic(chosen, tmp_path / "m.tif", 0.1)
        column, row = pixel(tmp_path / "m.tif", place)
        echoes.append(((int(tifffile.imread(tmp_path / "m.tif")[int(row), int(column)]) - 1) / 127) ** 2)
    assert echoes[0] > 1.5 * echoes[1]
    assert echoes[2] == pytest.approx((echoes[0] + echoes[1]) / 2, rel=0.05)


def test_pings_without_navigation_are_left_out(tmp_path):
    survey = line()
    pings = list(survey.pings)
    for row in range(30):
        pings[row] = replace(pings[row], lat_deg=None, lon_deg=None)
    path = make_xtf(replace(survey, pings=tuple(pings)), tmp_path)
    result = write_mosaic([path], tmp_path / "m.tif", 0.2)
    assert (result.coverage.pings, result.coverage.left_out) == (90, 30)
    bare = tuple(replace(ping, heading_deg=None) for ping in pings)
    path = make_xtf(replace(survey, pings=bare), tmp_path)
    with pytest.raises(SurveyFileError, match="position, heading and altitude"):
        write_mosaic([path], tmp_path / "m.tif", 0.2)


def test_area_that_is_too_large_is_rejected(tmp_path):
    paths = []
    for number, start in enumerate((Position(48.4, -68.8), Position(10.0, -68.8))):
        (tmp_path / str(number)).mkdir()
        paths.append(make_xtf(line(start=start), tmp_path / str(number)))
    with pytest.raises(SurveyFileError, match="coarser resolution"):
        write_mosaic(paths, tmp_path / "m.tif", 0.1)
    assert not (tmp_path / "m.tif").exists()


def test_memory_does_not_depend_on_the_length(tmp_path, monkeypatch):
    """Tiles are moved to a file: a line of four times the length needs no more memory, and the image is the same."""
    monkeypatch.setattr(ground_canvas, "_HELD_TILES", 4)
    monkeypatch.setattr(track, "_STRIP_PINGS", 150)
    peaks = []
    for pings in (300, 1200):
        path = make_xtf(line(pings=pings, bright=None), tmp_path)
        tracemalloc.start()
        write_mosaic([path], tmp_path / f"{pings}.tif", 0.1)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.15 * peaks[0]
    monkeypatch.setattr(ground_canvas, "_HELD_TILES", 1000)
    write_mosaic([path], tmp_path / "held.tif", 0.1)
    assert (tmp_path / "held.tif").read_bytes() == (tmp_path / "1200.tif").read_bytes()


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "epsg"), [(48.4, -68.8, 32619), (-33.0, 151.0, 32756), (0.0, 180.0, 32660), (5, -180, 32601)]
)
def test_utm_zone(lat_deg, lon_deg, epsg):
    assert utm_epsg(Position(lat_deg, lon_deg)) == epsg


def test_command_writes_mosaic_and_coverage(tmp_path, capsys):
    path = make_xtf(line(), tmp_path)
    arguments = ["survey", "mosaic", str(path), "--out", str(tmp_path / "new" / "m.tif"), "--resolution-m", "0.5"]
    assert main([*arguments, "--coverage", str(tmp_path / "c.geojson")]) == 0
    assert "EPSG:32619, 120 pings" in capsys.readouterr().out
    assert (tmp_path / "new" / "m.tif").is_file()
    assert (tmp_path / "c.geojson").is_file()
    for resolution in ("0", "nan", "0.001", "-1"):
        assert main([*arguments[:-1], resolution]) == 2
