"""Covered seabed: place and area of the outline, gaps, turns, files."""

import json
import math
import sqlite3
import struct
import subprocess
import tracemalloc
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from builders import gdal
from builders.survey_lines import ALTITUDE_M, RANGE_M, course, line, with_turn
from builders.surveys import make_xtf
from builders.xtf import write_xtf
from pyproj import Geod

from sonarpost.cli.main import main
from sonarpost.errors import SurveyFileError
from sonarpost.extensions.maps import track
from sonarpost.extensions.maps.coverage import survey_coverage, write_coverage_geojson, write_coverage_geopackage
from sonarpost.sonar.geometry import Position, offset_position

REACH_M = math.sqrt(RANGE_M**2 - ALTITUDE_M**2)
GEOD = Geod(ellps="WGS84")


def layer(path, *arguments):
    """Return the features of a file as GeoJSON, by ogr2ogr."""
    command = ["ogr2ogr", "-f", "GeoJSON", "/vsistdout/", path, *arguments]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)["features"]


def invalid_polygons(path):
    """Return the number of features and of those that GEOS finds invalid."""
    program = (
        "from osgeo import ogr; import sys; ogr.UseExceptions(); source = ogr.Open(sys.argv[1]);"
        "valid = [f.GetGeometryRef().IsValid() for f in source.GetLayer(0)]; print(len(valid), valid.count(False))"
    )
    ran = subprocess.run([gdal.SYSTEM_PYTHON, "-c", program, path], check=True, capture_output=True, text=True)
    count, invalid = map(int, ran.stdout.split())
    return count, invalid


@pytest.mark.parametrize("heading_deg", [0.0, 200.0])
def test_corners_are_the_ends_of_the_swath(tmp_path, heading_deg):
    survey = line(heading_deg, bright=None)
    (polygon,) = survey_coverage([make_xtf(survey, tmp_path)]).polygons
    assert (polygon.line, polygon.first_ping, polygon.last_ping) == ("line", 0, 119)
    assert polygon.end_utc_s - polygon.start_utc_s == pytest.approx(119 * 0.2)
    assert polygon.area_m2 == pytest.approx(119 * 0.25 * 2 * REACH_M, rel=2e-3)
    assert polygon.ring[0] == polygon.ring[-1]
    area_m2, _ = GEOD.polygon_area_perimeter(*zip(*((p.lon_deg, p.lat_deg) for p in polygon.ring), strict=True))
    assert area_m2 == pytest.approx(polygon.area_m2, rel=2e-3)  # positive: counter-clockwise
    for row in (0, 119):
        for bearing_deg in (heading_deg + 90, heading_deg - 90):
            ping = survey.pings[row]
            lon_deg, lat_deg, _ = GEOD.fwd(ping.lon_deg, ping.lat_deg, bearing_deg, REACH_M)
            assert min(GEOD.inv(lon_deg, lat_deg, p.lon_deg, p.lat_deg)[2] for p in polygon.ring) < 0.05


def test_gap_ends_a_polygon_and_a_ping_without_position_does_not(tmp_path):
    survey = line(bright=None)
    pings = list(survey.pings)
    pings[20] = replace(pings[20], lat_deg=None, lon_deg=None)
    path = make_xtf(replace(survey, pings=(*pings[:40], *pings[90:])), tmp_path)
    coverage = survey_coverage([path])
    assert [(p.first_ping, p.last_ping) for p in coverage.polygons] == [(0, 39), (90, 119)]
    assert (coverage.pings, coverage.left_out) == (69, 1)
    bare = tuple(replace(ping, lat_deg=None, lon_deg=None) for ping in pings)
    with pytest.raises(SurveyFileError, match="position, heading and altitude"):
        survey_coverage([make_xtf(replace(survey, pings=bare), tmp_path)])


def polygons_of_turn(folder, radius_m):
    return survey_coverage([make_xtf(with_turn(radius_m), folder)]).polygons


def polygons_with_errors_of_the_heading(folder):
    """Errors of up to 6 degrees at a reach of 29 m: neighbouring pings cross each other."""
    survey = line(heading_deg=30.0, pings=240, bright=None)
    pings = tuple(
        replace(ping, heading_deg=30.0 + 6 * math.sin(row / 5)) if 40 <= row < 200 else ping
        for row, ping in enumerate(survey.pings)
    )
    return survey_coverage([make_xtf(replace(survey, pings=pings), folder)]).polygons


def polygons_across_the_180th_meridian(folder, lat_deg, heading_deg):
    """A line across the meridian, a turn, a line back across it, and a recording on one side."""
    start = offset_position(Position(lat_deg, 180.0), heading_deg + 175, 30.0)
    headings = [heading_deg] * 120, np.linspace(heading_deg, heading_deg + 180, 240), [heading_deg + 180] * 120
    survey = course(np.concatenate(headings).tolist(), start=start)
    write_xtf(line(start=offset_position(start, heading_deg + 180, 500.0), bright=None), folder / "beside.xtf")
    return survey_coverage([make_xtf(survey, folder), folder / "beside.xtf"]).polygons


@gdal.needs_bindings
def test_polygons_of_turns_overlaps_and_errors_are_valid(tmp_path):
    turns = [polygons_of_turn(tmp_path, radius_m) for radius_m in (5.0, 25.0, 60.0)]
    across = polygons_across_the_180th_meridian(tmp_path, -16.9, 80.0)
    for polygons in (*turns, polygons_with_errors_of_the_heading(tmp_path), across):
        write_coverage_geopackage(tmp_path / "c.gpkg", polygons)
        assert invalid_polygons(tmp_path / "c.gpkg") == (len(polygons), 0)


def test_lines_are_covered_at_a_turn_and_with_errors_of_the_heading(tmp_path):
    polygons = polygons_of_turn(tmp_path, 5.0)
    assert all(polygon.area_m2 > 0 for polygon in polygons)
    # Each line is covered but for the 10 m at a turn.
    assert sum(polygon.area_m2 for polygon in polygons) > 2 * (119 * 0.5 - 10) * 2 * REACH_M
    (polygon,) = polygons_with_errors_of_the_heading(tmp_path)
    assert (polygon.first_ping, polygon.last_ping) == (0, 239)
    assert polygon.area_m2 == pytest.approx(239 * 0.25 * 2 * REACH_M, rel=0.05)


def test_strips_do_not_change_the_outline(tmp_path, monkeypatch):
    whole = survey_coverage([make_xtf(line(pings=200, bright=None), tmp_path)])
    monkeypatch.setattr(track, "_STRIP_PINGS", 100)
    assert survey_coverage([tmp_path / "line.xtf"]) == whole


@pytest.mark.system
def test_memory_does_not_depend_on_the_length(tmp_path, monkeypatch):
    monkeypatch.setattr(track, "_STRIP_PINGS", 150)
    peaks = []
    for pings in (600, 1800):
        path = make_xtf(line(pings=pings, bright=None), tmp_path)
        tracemalloc.start()
        survey_coverage([path])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.15 * peaks[0]


def write_both(folder, polygons):
    write_coverage_geojson(folder / "c.geojson", polygons)
    write_coverage_geopackage(folder / "c.gpkg", polygons)


def test_both_files_hold_the_polygons(tmp_path):
    survey = line(bright=None)
    path = make_xtf(replace(survey, pings=(*survey.pings[:40], *survey.pings[90:])), tmp_path)
    polygons = survey_coverage([path]).polygons
    write_both(tmp_path, polygons)
    features = json.loads((tmp_path / "c.geojson").read_text())["features"]
    with closing(sqlite3.connect(tmp_path / "c.gpkg")) as db:
        cursor = db.execute("SELECT * FROM coverage ORDER BY fid")
        rows = [dict(zip([column[0] for column in cursor.description], row, strict=True)) for row in cursor]
    assert len(features) == len(rows) == len(polygons) == 2
    for feature, row, polygon in zip(features, rows, polygons, strict=True):
        assert {name: row[name] for name in feature["properties"]} == feature["properties"]
        (ring,) = feature["geometry"]["coordinates"]
        points = np.frombuffer(row["geom"][-16 * len(ring) :], "<f8").reshape(-1, 2)
        np.testing.assert_allclose(ring, points, atol=2e-8)
        np.testing.assert_allclose(points, [(p.lon_deg, p.lat_deg) for p in polygon.ring], atol=1e-9)


def rings_of(geometry):
    """Return the rings of a GeoPackage geometry of polygons, and its envelope: west, east, south, north."""
    envelope = struct.unpack_from("<4d", geometry, 8)
    kind, count = struct.unpack_from("<xII", geometry, 40)
    assert kind == 6, "MULTIPOLYGON"
    offset, rings = 49, []
    for _ in range(count):
        header = struct.unpack_from("<BIII", geometry, offset)
        assert header[:3] == (1, 3, 1)
        rings.append(np.frombuffer(geometry, "<f8", 2 * header[3], offset + 13).reshape(-1, 2).tolist())
        offset += 13 + 16 * header[3]
    assert offset == len(geometry)
    return rings, envelope


@pytest.mark.parametrize("lat_deg", [-16.9, 0.001, 65.0])
@pytest.mark.parametrize("heading_deg", [90.0, 255.0])
def test_polygons_across_the_180th_meridian_are_divided(tmp_path, lat_deg, heading_deg):
    polygons = polygons_across_the_180th_meridian(tmp_path, lat_deg, heading_deg)
    write_both(tmp_path, polygons)
    with closing(sqlite3.connect(tmp_path / "c.gpkg")) as db:
        stored = [rings_of(row[0]) for row in db.execute("SELECT geom FROM coverage ORDER BY fid")]
        assert db.execute("SELECT geometry_type_name FROM gpkg_geometry_columns").fetchall() == [("MULTIPOLYGON",)]
        box = db.execute("SELECT min_x, max_x FROM gpkg_contents").fetchone()
    assert box == (-180.0, 180.0), "the extent of a layer is that of the plane"
    features = json.loads((tmp_path / "c.geojson").read_text())["features"]
    kinds = {"Polygon": lambda part: [part], "MultiPolygon": lambda parts: parts}
    written = [kinds[f["geometry"]["type"]](f["geometry"]["coordinates"]) for f in features]
    assert [len(parts) > 1 for parts in written] == [polygon.line != "beside" for polygon in polygons]
    for polygon, parts, (rings, envelope) in zip(polygons, written, stored, strict=True):
        assert [len(ring) for ring in rings] == [len(ring) for (ring,) in parts]
        for (ring,), same in zip(parts, rings, strict=True):
            np.testing.assert_allclose(ring, same, atol=2e-8)
            assert ring[0] == ring[-1]
            assert len({lon > 0 for lon, _ in ring}) == 1
        lons, lats = zip(*(corner for ring in rings for corner in ring), strict=True)
        assert envelope == (min(lons), max(lons), min(lats), max(lats))
        areas_m2 = [GEOD.polygon_area_perimeter(*zip(*ring, strict=True))[0] for ring in rings]
        assert min(areas_m2) > 0  # counter-clockwise
        assert sum(areas_m2) == pytest.approx(polygon.area_m2, rel=2e-3)


@gdal.needs_ogr
def test_ogr_reads_the_same_polygons_from_both_files(tmp_path):
    survey = line(bright=None)
    path = make_xtf(replace(survey, pings=(*survey.pings[:40], *survey.pings[90:])), tmp_path)
    write_both(tmp_path, survey_coverage([path]).polygons)
    described = subprocess.run(["ogrinfo", "-so", tmp_path / "c.gpkg", "coverage"], check=True, capture_output=True)
    assert "Geometry: Polygon" in described.stdout.decode()
    features = json.loads((tmp_path / "c.geojson").read_text())["features"]
    read = layer(tmp_path / "c.gpkg", "-lco", "COORDINATE_PRECISION=8")
    assert [f["properties"] for f in read] == [f["properties"] for f in features]
    for got, want in zip(read, features, strict=True):
        (got_ring,), (want_ring,) = got["geometry"]["coordinates"], want["geometry"]["coordinates"]
        assert len(got_ring) == len(want_ring)
        for point, other in zip(got_ring, want_ring, strict=True):
            assert point == pytest.approx(other, abs=2e-8)


def test_commands_write_the_format_of_the_suffix(tmp_path, capsys):
    path = str(make_xtf(line(), tmp_path))
    for name in ("new/c.gpkg", "c.geojson"):
        assert main(["survey", "coverage", path, "--out", str(tmp_path / name)]) == 0
        assert f"{name}: polygons 1, area 17" in capsys.readouterr().out
    assert (tmp_path / "new" / "c.gpkg").read_bytes().startswith(b"SQLite format 3")
    assert json.loads((tmp_path / "c.geojson").read_text())["type"] == "FeatureCollection"
    mosaic = ["survey", "mosaic", path, "--out", str(tmp_path / "m.tif"), "--resolution-m", "1", "--coverage"]
    assert main([*mosaic, str(tmp_path / "m.gpkg")]) == 0
    assert (tmp_path / "m.gpkg").read_bytes()[68:72] == b"GPKG"
    for command in (["survey", "coverage", path, "--out"], mosaic):
        assert main([*command, str(tmp_path / "c.shp")]) == 2
        assert "*.gpkg or *.geojson" in capsys.readouterr().err
