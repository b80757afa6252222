"""Surveys as waterfall images with a navigation table."""

import numpy as np
import pytest
from builders.surveys import make_waterfall
from pyproj import Transformer

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import open_survey, read_survey
from sonarpost.sonar.survey import Side


def test_16_bit_tiff(small_survey, tmp_path):
    survey = small_survey(np.uint16)
    read = read_survey(make_waterfall(survey, tmp_path, tiff=True))
    np.testing.assert_array_equal(read.waterfall(Side.PORT), survey.waterfall(Side.PORT))
    assert (read.sonar_id, read.line_name, read.warnings) == ("HDS", "line", ())


DESCRIPTION_ERRORS = [
    ('port_order = "farthest_first"\n', "", "port_order"),
    ('positions = "degrees"', 'positions = "metres"', "projected_crs"),
    ('positions = "degrees"', 'positions = "degree"', "positions"),
    ('positions = "degrees"', "", "positions"),
    ("sonar_id", "sonarid", "sonarid"),
    ("line.csv", "absent.csv", "No such file"),
    ("line.port.png", "absent.png", "No such file"),
    ("line.port.png", "./line.port.png", "port: got './line.port.png', expected"),
    ("line.port.png", "a\\u0000b", "port"),
    ("line.csv", "..", "navigation"),
    ("line.csv", 128 * "é", "navigation"),
    ("sonar_id =", "sonar_id", "TOML"),
    ('positions = "degrees"\n', 'positions = "degrees"\n[columns]\nlat = "a"\n', "columns"),
    ('positions = "degrees"\n', 'positions = "degrees"\n[columns]\nlat_deg = "y"\n', "no 'y'"),
]
TABLE_ERRORS = [
    ("25.0", "-25.0", "ping 0, slant_range_m"),
    ("25.0", "nan", "ping 0, slant_range_m"),
    ("25.0", "far", "ping 0, slant_range_m"),
    ("1378847588.13", "yesterday", "ping 0, time_utc"),
    ("1378847588.13", "nan", "ping 0, time_utc"),
    ("1378847588.13", "1e300", "ping 0, time_utc"),
    ("slant_range_m", "range", "no 'slant_range_m'"),
    ("354.5", "35\x00", "heading_deg"),
    ("354.5", '3"5', "heading_deg"),
    ("354.5", "354,5", "fields"),
    ("354.5", "9" * 70_000, "line|field"),
]


@pytest.mark.parametrize(
    ("name", "old", "new", "field"),
    [*(("line.waterfall.toml", *each) for each in DESCRIPTION_ERRORS), *(("line.csv", *each) for each in TABLE_ERRORS)],
)
def test_error_names_the_invalid_field(small_survey, tmp_path, name, old, new, field):
    path = make_waterfall(small_survey(), tmp_path)
    changed = path.with_name(name)
    changed.write_text(changed.read_text().replace(old, new))
    with pytest.raises(SurveyFileError, match=field):
        open_survey(path)


def test_table_length_must_match_images(small_survey, tmp_path):
    path = make_waterfall(small_survey(), tmp_path)
    lines = (tmp_path / "line.csv").read_text().splitlines(keepends=True)
    for changed in (lines[:-1], [*lines, lines[-1]]):
        (tmp_path / "line.csv").write_text("".join(changed))
        with pytest.raises(SurveyFileError, match=r"lines|row"):
            read_survey(path)


def test_nan_navigation_is_unknown_and_out_of_range_is_reported(small_survey, tmp_path):
    path = make_waterfall(small_survey(), tmp_path)
    table = tmp_path / "line.csv"
    lines = table.read_text().splitlines()
    lines[1] = lines[1].replace("354.5", "nan").replace("48.44545", "inf").replace("6.25", "")
    lines[2] = lines[2].replace("354.5", "400")
    table.write_text("\n".join(lines))
    survey = read_survey(path)
    first = survey.pings[0]
    assert (first.heading_deg, first.lat_deg, first.lon_deg, first.altitude_m) == (None,) * 4
    assert survey.pings[1].heading_deg is None
    assert survey.warnings == (
        "no position fix in 1 of 5 pings, the first in row 0",
        "heading_deg out of range in 1 of 5 pings, the first in row 1",
    )


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["scotsman-iver2", "000_1236"])
def test_derived_images_match_recordings(data_dir, tmp_path, name):
    for part in ("port.png", "stbd.png", "nav.csv"):
        (tmp_path / part).symlink_to(data_dir / "surveys" / "derived" / f"{name}.xtf.{part}")
    path = tmp_path / "line.waterfall.toml"
    path.write_text(
        'port = "port.png"\nstarboard = "stbd.png"\nnavigation = "nav.csv"\n'
        'port_order = "farthest_first"\npositions = "degrees"\nknots = true\nzero_is_unknown = true\n'
        '[columns]\nlat_deg = "y_or_lat"\nlon_deg = "x_or_lon"\ntime_utc = "utc"\nslant_range_m = "slant_range"\n'
        'heading_deg = "heading"\naltitude_m = "alt"\nspeed_mps = "speed"\n'
    )
    images, recording = read_survey(path), read_survey(data_dir / "surveys" / f"{name}.xtf")
    for got, want in zip(images, recording, strict=True):
        for side in Side:
            np.testing.assert_array_equal(got.channel(side).samples, want.channel(side).samples)
        assert (got.lat_deg, got.lon_deg) == (want.lat_deg, want.lon_deg)
        assert got.time_utc_s == pytest.approx(want.time_utc_s, abs=0.001)
        assert (got.speed_mps or 0) == pytest.approx(want.speed_mps or 0, abs=0.006)


def test_table_in_metres_has_positions_and_its_extent(small_survey, tmp_path):
    path = make_waterfall(small_survey(), tmp_path)
    to_utm = Transformer.from_crs(4326, 32619, always_xy=True)
    points = [to_utm.transform(p.lon_deg, p.lat_deg) for p in small_survey()]
    header, *lines = (tmp_path / "line.csv").read_text().splitlines()
    rows = [header.replace("lat_deg,lon_deg", "northing_m,easting_m")]
    for line, (easting_m, northing_m) in zip(lines, points, strict=True):
        number, time_utc, _, _, rest = line.split(",", 4)
        rows.append(f"{number},{time_utc},{northing_m!r},{easting_m!r},{rest}")
    (tmp_path / "line.csv").write_text("\n".join(rows))
    path.write_text(path.read_text().replace('positions = "degrees"', 'positions = "metres"'))
    with pytest.raises(SurveyFileError, match=r"projected_crs: got None, expected .* \(--crs\)"):
        open_survey(path)
    with open_survey(path, SurveyOptions(projected_crs="EPSG:32619")) as source:
        for ping, want, point in zip(source.pings(), small_survey(), points, strict=True):
            assert (ping.lat_deg, ping.lon_deg) == pytest.approx((want.lat_deg, want.lon_deg), abs=1e-8)
            assert ping.grid_m == point
        grid = source.info.grid
    assert (grid.first_m, grid.last_m) == (points[0], points[-1])
    eastings, northings = zip(*points, strict=True)
    assert (grid.min_m, grid.max_m) == ((min(eastings), min(northings)), (max(eastings), max(northings)))
