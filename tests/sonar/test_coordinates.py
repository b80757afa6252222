"""Positions as recorders store them: projected in feet, longitudes from 0 to 360, and across the 180th meridian."""

import json
import math
import struct
from dataclasses import replace

import pytest
from builders import surveys
from builders.xtf import write_xtf
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer

from sonarpost.cli.main import main
from sonarpost.sonar.geometry import Position, along_track_m, offset_position
from sonarpost.sonar.navigation import position_in_degrees
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.projection import Projection
from sonarpost.sonar.readers import open_survey, read_survey
from sonarpost.sonar.readers.xtf import decode_text

US_FOOT_M = 1200 / 3937


def at(survey, start, spacing_m=1.0, heading_deg=90.0):
    """Return a survey without speeds along a straight track."""
    places = [offset_position(start, heading_deg, row * spacing_m) for row in range(len(survey.pings))]
    changes = [{"lat_deg": place.lat_deg, "lon_deg": place.lon_deg, "speed_mps": None} for place in places]
    return replace(survey, pings=tuple(replace(p, **c) for p, c in zip(survey, changes, strict=True)))


def info_of(path, capsys, *options):
    assert main(["survey", "info", "--json", str(path), *options]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("crs", "unit_m", "start"),
    [
        ("EPSG:2263", US_FOOT_M, Position(40.6, -74.0)),
        ("EPSG:2222", 0.3048, Position(33.4, -111.0)),
        ("EPSG:2263+5703", US_FOOT_M, Position(40.6, -74.0)),  # with a height in metres
        ("+proj=utm +zone=19 +south +units=us-ft", US_FOOT_M, Position(-33.0, -69.0)),
        ("EPSG:32618", 1.0, Position(40.6, -74.0)),
    ],
)
def test_projected_positions_have_the_unit_of_their_system(small_survey, tmp_path, capsys, crs, unit_m, start):
    survey = at(small_survey(pings=60), start)
    write_xtf(survey, tmp_path / "line.xtf", crs)
    forward = Transformer.from_crs(4326, crs, always_xy=True)
    stored = [forward.transform(ping.lon_deg, ping.lat_deg) for ping in survey]
    first = struct.unpack_from("<dd", (tmp_path / "line.xtf").read_bytes(), 1024 + 160)
    assert first == pytest.approx(stored[0][::-1], abs=1e-6), "the file has the unit of the system"
    read = read_survey(tmp_path / "line.xtf", SurveyOptions(projected_crs=crs))
    for ping, want, values in zip(read, survey, stored, strict=True):
        assert (ping.lat_deg, ping.lon_deg) == pytest.approx((want.lat_deg, want.lon_deg), abs=1e-8)
        assert ping.grid_m == pytest.approx([value * unit_m for value in values])
    assert along_track_m(read)[-1] == pytest.approx(59.0, rel=2e-3)
    info = info_of(tmp_path / "line.xtf", capsys, "--crs", crs)
    assert info["easting_m"] == pytest.approx([x * unit_m for x, _ in (stored[0], stored[-1])])
    assert (info["track_m"], info["hints"]) == (pytest.approx(59.0, abs=5.0), [])


def test_a_file_that_states_metres_is_converted_to_a_system_in_feet(tmp_path):
    """Coordinates of JSF are in millimetres, decimetres or centimetres for every system."""
    easting, northing = Transformer.from_crs(4326, 2263, always_xy=True).transform(-74.0, 40.6)
    x, y = (round(value * US_FOOT_M * 1000) for value in (easting, northing))
    message = surveys.jsf_message(1, 20, 0, small_samples(), x=x, y=y, unit=1)
    (tmp_path / "line.jsf").write_bytes(message)
    (ping,) = read_survey(tmp_path / "line.jsf", SurveyOptions(projected_crs="EPSG:2263")).pings
    assert (ping.lat_deg, ping.lon_deg) == pytest.approx((40.6, -74.0), abs=1e-7)
    assert ping.grid_m == pytest.approx((x / 1000, y / 1000))


def small_samples():
    return next(iter(surveys.small_survey())).channels[0].samples


@given(st.floats(-80, 80), st.floats(-180, 180), st.sampled_from(["EPSG:3395", "+proj=merc +units=ft", "EPSG:3857"]))
def test_a_projection_and_its_inverse_agree_in_metres(lat_deg, lon_deg, crs):
    easting_m, northing_m = Projection(crs).coordinates(Position(lat_deg, lon_deg))
    assert easting_m == pytest.approx(math.radians(lon_deg) * 6_378_137, abs=1e-3)
    position = Projection(crs).position(easting_m, northing_m)
    if position is None:
        assert (easting_m, northing_m) == pytest.approx((0.0, 0.0))
    else:
        assert position.lat_deg == pytest.approx(lat_deg, abs=1e-7)
        assert math.remainder(position.lon_deg - lon_deg, 360) == pytest.approx(0.0, abs=1e-7)


@given(st.floats(-90, 90), st.floats(-180, 180, exclude_min=True).filter(lambda lon: lon == 0 or abs(lon) > 1e-9))
def test_longitudes_from_0_to_360_are_the_same_places(lat_deg, lon_deg):
    position = position_in_degrees(lat_deg, lon_deg)
    assert position == (None if (lat_deg, lon_deg) == (0.0, 0.0) else Position(lat_deg, lon_deg))
    if lon_deg < 0:
        shifted = position_in_degrees(lat_deg, lon_deg + 360)
        assert (shifted.lat_deg, shifted.lon_deg) == (lat_deg, pytest.approx(lon_deg, abs=1e-12))
        assert -180 <= shifted.lon_deg <= 180


@pytest.mark.parametrize("lon_deg", [-180.001, 360.001, math.inf, math.nan, 1e30])
def test_a_longitude_out_of_range_is_no_position(lon_deg):
    assert position_in_degrees(10.0, lon_deg) is None
    assert position_in_degrees(90.001, 10.0) is None


@pytest.mark.parametrize("kind", sorted(surveys.MAKERS.keys() - {"svlog"}))  # degrees of a GNSS receiver
def test_recordings_with_longitudes_from_0_to_360(small_survey, tmp_path, kind):
    survey = at(small_survey(), Position(-16.9, -179.9))
    pings = tuple(replace(ping, lon_deg=ping.lon_deg + 360, speed_mps=1.0) for ping in survey)
    with open_survey(surveys.MAKERS[kind](replace(survey, pings=pings), tmp_path)) as source:
        lons = [ping.lon_deg for ping in source.pings()]
        assert not any("no position" in warning for warning in source.info.warnings)
    assert lons == pytest.approx([ping.lon_deg for ping in survey], abs=1e-5)  # whole metres


@pytest.mark.parametrize(
    ("lons", "expected"),
    [
        ([179.9998, 179.9999, -179.9999, -179.9997], [179.9998, -179.9997]),
        ([-179.9999, 179.9999, -179.9998], [179.9999, -179.9998]),  # crosses twice
        ([180.0, -179.9999], [180.0, -179.9999]),
        ([179.9999, 180.0, 179.9998], [179.9998, 180.0]),
        ([-0.0002, 0.0001], [-0.0002, 0.0001]),
        ([0.0001, 0.0003], [0.0001, 0.0003]),
        ([-68.0001, -68.0003], [-68.0003, -68.0001]),
    ],
)
def test_info_has_the_shortest_range_of_longitudes(small_survey, tmp_path, capsys, lons, expected):
    survey = small_survey(pings=len(lons))
    pings = tuple(replace(ping, lat_deg=-17.0, lon_deg=lon) for ping, lon in zip(survey, lons, strict=True))
    path = surveys.make_xtf(replace(survey, pings=pings), tmp_path)
    assert info_of(path, capsys)["lon_deg"] == expected
    assert main(["survey", "info", str(path)]) == 0
    assert f"lon_deg              {expected[0]:.7g} to {expected[1]:.7g}\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("raw", "text"),
    [
        ("Sönär".encode(), "Sönär"),
        ("Sönär".encode("latin-1"), "Sönär"),
        ("声納 №3".encode(), "声納 №3"),
        (b"4125 \xb5s\0\0", "4125 µs"),
        (b"HDS", "HDS"),
        (b"a\x07b", "ab"),
    ],
)
def test_names_are_utf_8_where_the_bytes_are(raw, text):
    assert decode_text(raw.ljust(16, b"\0")) == text
