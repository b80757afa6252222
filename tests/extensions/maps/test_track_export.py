"""`sonarpost survey export`: the track as CSV and GeoJSON."""

import csv
import dataclasses
import io
import json

import pytest
from builders.surveys import make_xtf, small_survey
from builders.xtf import write_xtf

from sonarpost.cli.main import main


def test_export_csv(tmp_path, capsys):
    survey = small_survey()
    without_fix = dataclasses.replace(survey.pings[2], lat_deg=None, lon_deg=None)
    path = make_xtf(dataclasses.replace(survey, pings=(*survey.pings[:2], without_fix, *survey.pings[3:])), tmp_path)
    assert main(["survey", "export", str(path)]) == 0
    lines = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [float(line["number"]) for line in lines] == [10, 11, 12, 13, 14]
    assert lines[2]["lat_deg"] == ""
    assert float(lines[3]["lat_deg"]) == pytest.approx(survey.pings[3].lat_deg, abs=1e-8)
    assert lines[0]["time_utc"] == "2013-09-10T21:13:08.130Z"


def test_export_geojson_divides_the_track_at_gaps_and_the_180th_meridian(tmp_path):
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
    assert [f["geometry"]["type"] for f in features] == ["MultiLineString", "Point"]
    lons = [[179.9995, 179.9999, 180.0], [-180.0, -179.9998, -179.9994]]
    assert features[0]["geometry"]["coordinates"] == [[[lon, 48.44545] for lon in part] for part in lons]
    assert [f["properties"]["first_ping"] for f in features] == [0, 4]


@pytest.mark.parametrize("kind", ["csv", "geojson"])
def test_export_without_positions_is_an_error_and_writes_no_file(kind, tmp_path, capsys):
    pings = tuple(dataclasses.replace(ping, lat_deg=None, lon_deg=None) for ping in small_survey())
    without = make_xtf(dataclasses.replace(small_survey(), pings=pings), tmp_path)
    write_xtf(small_survey(), tmp_path / "metres.xtf", "EPSG:32619")
    out = tmp_path / "absent" / "track"
    for path, crs, message in (
        (without, [], "positions: got 'none in 5 pings', expected a recording with positions"),
        (tmp_path / "metres.xtf", [], "got 'projected coordinates', expected their projection, --crs EPSG:N"),
    ):
        assert main(["survey", "export", "--format", kind, "--out", str(out), str(path), *crs]) == 2
        printed = capsys.readouterr()
        [line] = printed.err.splitlines()
        assert message in line
        assert not out.parent.exists()
        assert main(["survey", "export", "--format", kind, str(path), *crs]) == 2
        assert capsys.readouterr().out == ""
    metres = str(tmp_path / "metres.xtf")
    assert main(["survey", "export", "--format", kind, "--out", str(out), metres, "--crs", "EPSG:32619"]) == 0
    assert "48.4454" in out.read_text()


def test_export_of_a_damaged_file_leaves_none(tmp_path, capsys):
    path = make_xtf(small_survey(pings=30, samples=300), tmp_path)
    path.write_bytes(path.read_bytes()[:1024] + bytes(512))
    assert main(["survey", "export", "--out", str(tmp_path / "t.csv"), str(path)]) == 2
    assert "marker: got '0000', expected cefa" in capsys.readouterr().err
    assert not (tmp_path / "t.csv").exists()
