"""The confidence of a contact does not depend on whether positions are known."""

from dataclasses import replace

import pytest
from builders.xtf import write_xtf

from sonarpost.detection.detector import detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.geometry import along_track_m, ping_spacing_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import read_survey

pytestmark = pytest.mark.usefixtures("few_candidates")

CRS = "EPSG:32630"
SETTINGS = DetectorSettings(confidence_threshold=0.1)


@pytest.fixture(scope="module")
def survey():
    spec = SurveySpec(seed=3, pings=300, samples=256, targets=4, clutter=4, seabed=SeabedKind.MIXED)
    return simulate_survey(spec).survey


def without_speed(survey):
    return replace(survey, pings=tuple(replace(ping, speed_mps=None) for ping in survey.pings))


def without_fixes(survey):
    return replace(survey, pings=tuple(replace(ping, lat_deg=None, lon_deg=None) for ping in survey.pings))


def contacts_of(survey):
    """Return the contacts without what is derived from positions."""
    found = [replace(d, position=None, vehicle=None, position_sigma_m=None) for d in detect(survey, SETTINGS)]
    assert len(found) > 2
    return found


@pytest.mark.parametrize("change", [lambda survey: survey, without_speed])
def test_a_projection_changes_no_confidence(change, survey, tmp_path):
    path = tmp_path / "metres.xtf"
    write_xtf(change(survey), path, CRS)
    alone, projected = read_survey(path), read_survey(path, SurveyOptions(projected_crs=CRS))
    assert [ping.lat_deg is None for ping in (alone.pings[0], projected.pings[0])] == [True, False]
    assert alone.pings[0].grid_m == projected.pings[0].grid_m is not None
    found = contacts_of(projected)
    assert contacts_of(alone) == found
    if projected.pings[0].speed_mps is not None:
        assert contacts_of(without_fixes(survey)) == contacts_of(survey), "the file has speeds"


@pytest.mark.system
@pytest.mark.realdata
def test_missing_positions_of_a_recording_change_no_confidence(data_dir):
    recording = read_survey(data_dir / "surveys" / "scotsman-iver2.xtf")
    assert contacts_of(without_fixes(recording)) == contacts_of(recording)


def test_coordinates_in_metres_give_the_distance_between_pings(survey, tmp_path):
    path = tmp_path / "metres.xtf"
    write_xtf(without_speed(survey), path, CRS)
    by_fixes = ping_spacing_m(without_speed(survey))
    # The scale of UTM differs by at most 0.04 % at its central meridian, and by 0.1 % at its border.
    assert ping_spacing_m(read_survey(path)) == pytest.approx(by_fixes, rel=1.5e-3)


@pytest.mark.parametrize("factor", [1.0, 1.4, 1.94, 0.51, 0.0])
def test_a_speed_that_contradicts_the_positions_is_not_used(factor, survey):
    scaled = tuple(replace(ping, speed_mps=ping.speed_mps * factor) for ping in survey.pings)
    by_speed = factor in (1.0, 1.4)
    expected = ping_spacing_m(without_fixes(survey)) * factor if by_speed else ping_spacing_m(without_speed(survey))
    assert ping_spacing_m(replace(survey, pings=scaled)) == pytest.approx(expected)


def test_few_speeds_are_not_preferred_to_fixes(survey):
    few = [replace(p, speed_mps=1.4 * p.speed_mps if row % 3 == 0 else None) for row, p in enumerate(survey.pings)]
    few = tuple(few)
    assert ping_spacing_m(replace(survey, pings=few)) == ping_spacing_m(without_speed(survey))
    assert along_track_m(without_fixes(replace(survey, pings=few))) is not None


def test_a_jump_of_coordinates_in_metres_is_left_out(survey, tmp_path):
    pings = list(without_speed(survey).pings)
    pings[200] = replace(pings[200], lat_deg=pings[200].lat_deg + 0.2)
    path = tmp_path / "jump.xtf"
    write_xtf(replace(survey, pings=tuple(pings)), path, CRS)
    for options in (SurveyOptions(), SurveyOptions(projected_crs=CRS)):
        read = read_survey(path, options)
        assert read.pings[200].grid_m is None
        assert read.pings[200].lat_deg is None
        assert ping_spacing_m(read) == pytest.approx(ping_spacing_m(without_speed(survey)), rel=1.5e-3)
