"""The detector with surveys of speckle, simulated surveys and recordings."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import Geod

from sonarpost.detection import candidates
from sonarpost.detection.detector import MINE_LIKE, STRUCTURE, detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.snippets import cut_snippet
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.bottom_track import track_bottom
from sonarpost.sonar.geometry import Position, georeference, offset_between_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Ping, Side, Survey


@pytest.fixture(autouse=True)
def few_candidates_in_quick_tests(request, monkeypatch):
    if request.node.get_closest_marker("system") is None:
        monkeypatch.setattr(candidates, "_MAX_PER_1000_PINGS", 20)


@pytest.mark.parametrize(("side", "sign"), [(Side.PORT, -1), (Side.STARBOARD, 1)])
def test_object_is_detected_with_position_and_size(make_survey, side, sign):
    survey = make_survey({"side": side})
    (found,) = detect(survey)
    # Port is left of the heading and starboard right.
    north_m, east_m = offset_between_m(found.vehicle, found.position)
    assert east_m == pytest.approx(sign * found.ground_range_m, abs=0.01)
    assert north_m == pytest.approx(0.0, abs=0.01)
    assert found.side is side
    assert found.ping_index == pytest.approx(100, abs=2)
    assert found.ping_number == found.ping_index + 1000
    assert found.time_utc_s == survey.pings[found.ping_index].time_utc_s
    assert found.sample == pytest.approx(250, abs=5)
    assert found.slant_range_m == pytest.approx(250.5 * 20 / 512, abs=0.2)
    assert found.ground_range_m == pytest.approx(np.sqrt(found.slant_range_m**2 - 9.0))
    assert found.length_m == pytest.approx(0.8, abs=0.25)
    assert found.width_m == pytest.approx(12 * 20 / 512, abs=0.2)
    assert found.shadow_m == pytest.approx(30 * 20 / 512, abs=0.25)
    assert found.height_m == pytest.approx(found.shadow_m * 3.0 / (found.slant_range_m + found.shadow_m))
    assert found.atd_class == MINE_LIKE
    assert 1.0 <= found.confidence < 2.0
    assert (found.heading_deg, found.altitude_m, found.depth_m, found.speed_mps) == (0.0, 3.0, 12.0, 1.0)


def test_unknown_navigation_is_none_and_unknown_altitude_tracked(make_survey):
    (found,) = detect(make_survey({}, navigation=False))
    assert (found.vehicle, found.position, found.heading_deg, found.speed_mps) == (None, None, None, None)
    assert (found.length_m, found.pixel_along_m) == (None, None)
    assert found.height_m is not None  # from range alone
    # The altitude is that of the first return.
    (found,) = detect(make_survey({}, altitude=False))
    assert found.altitude_m == pytest.approx(3.0, abs=0.25)
    assert found.position is not None


def test_detections_of_both_sides_are_sorted_by_confidence(make_survey):
    boxes = ({"ping": 50, "sample": 400, "highlight": 3.0}, {"side": Side.STARBOARD, "ping": 150}, {"ping": 140})
    survey = make_survey(*boxes)
    found = detect(survey)
    places = {(Side.PORT, 50), (Side.STARBOARD, 150), (Side.PORT, 140)}
    assert {(d.side, round(d.ping_index, -1)) for d in found} == places
    assert all(a.confidence >= b.confidence for a, b in itertools.pairwise(found))
    assert detect(survey, DetectorSettings(max_contacts=2)) == found[:2]
    assert detect(survey, DetectorSettings(confidence_threshold=found[0].confidence)) == found[:1]


def test_empty_seabed_gives_few_detections(make_survey):
    assert sum(len(detect(make_survey(seed=seed))) for seed in range(2)) <= 1


def test_detections_are_independent_of_sample_scale(make_survey):
    positions = [
        [
            (d.side, d.ping_index, d.sample)
            for d in detect(make_survey({}, sides=(Side.PORT,), dtype=dtype, scale=scale))
        ]
        for dtype, scale in ((np.uint16, 1.0), (np.uint32, 50_000.0))
    ]
    assert positions[0] == positions[1] != []
    eight_bits = detect(make_survey({}, sides=(Side.PORT,), dtype=np.uint8, scale=1 / 80))
    assert [(d.side, d.ping_index // 8) for d in eight_bits] == [(Side.PORT, 100 // 8)]


def test_sides_are_symmetric(one_object):
    survey, one = one_object
    swap = {Side.PORT: Side.STARBOARD, Side.STARBOARD: Side.PORT}
    swapped = tuple(replace(p, channels=tuple(replace(c, side=swap[c.side]) for c in p.channels)) for p in survey.pings)
    (other,) = detect(replace(survey, pings=swapped))
    assert (one.ping_index, one.sample, one.confidence) == (other.ping_index, other.sample, other.confidence)
    assert one.side is swap[other.side]


def test_short_and_empty_surveys_give_no_detections(make_survey):
    survey = make_survey()
    for pings in (0, 1, 2, 7):
        assert detect(replace(survey, pings=survey.pings[:pings])) == ()
        assert detect(Survey(Path("x"), "x", "x", tuple(Ping(i, float(i), ()) for i in range(pings)))) == ()


@pytest.mark.system
@pytest.mark.parametrize("seabed", [SeabedKind.SAND, SeabedKind.MUD, SeabedKind.GRAVEL])
def test_simulated_mines_are_detected_with_few_false_alarms(seabed):
    simulated = simulate_survey(SurveySpec(seed=7, seabed=seabed, targets=8, clutter=2))
    found = detect(simulated.survey)

    def near(detection, truth):
        along_m = abs(detection.ping_index - truth.ping) * 0.1
        across_m = abs(detection.sample - truth.sample_index) * 30 / 1024
        return detection.side is truth.side and along_m < 1.5 and across_m < 1.5

    mines = [t for t in simulated.truth if t.is_mine_like]
    pairs = [(t, d) for t in mines for d in found if near(d, t)]
    assert len({id(t) for t, _ in pairs}) >= 0.9 * len(mines) > 0
    assert sum(d.atd_class == MINE_LIKE for _, d in pairs) >= 0.8 * len(mines)
    false_alarms = [d for d in found if not any(near(d, t) for t in simulated.truth)]
    assert len(false_alarms) <= 3
    for truth, detection in pairs:
        true_position = Position(truth.lat_deg, truth.lon_deg)
        assert np.hypot(*offset_between_m(true_position, detection.position)) < 2.0
    errors = [abs(d.height_m - t.height_m) / t.height_m for t, d in pairs]
    assert np.median(errors) < 0.25


@pytest.mark.system
@pytest.mark.realdata
def test_scotsman_gives_wreck_and_small_objects_to_port(data_dir):
    survey = read_survey(data_dir / "surveys" / "scotsman-iver2.xtf")
    found = detect(survey)
    assert len(found) <= 10
    # The wreck covers pings 165 to 365 and samples 150 to 600 in the image.
    (wreck,) = [d for d in found if d.atd_class == STRUCTURE and d.confidence > 1.0]
    assert wreck.side is Side.STARBOARD
    assert 165 <= wreck.ping_index <= 365
    assert 150 <= wreck.sample <= 600
    assert wreck.length_m > 15.0
    # The wreck's parts are not mine-like.
    on_wreck = [d for d in found if d.side is Side.STARBOARD and 165 <= d.ping_index <= 365 and d.sample <= 600]
    assert [d for d in on_wreck if d.atd_class != STRUCTURE] == []
    # Small objects with a shadow to port.
    for ping, sample in ((313, 945), (356, 283)):
        near = [d for d in found if abs(d.ping_index - ping) <= 4 and abs(d.sample - sample) <= 15]
        assert [d for d in near if d.side is Side.PORT and d.atd_class == MINE_LIKE], (ping, sample)
    for d in found:
        snippet = cut_snippet(survey, d)
        assert snippet.image.shape == (100, 100)
        assert snippet.image.std() > 20


@pytest.mark.system
@pytest.mark.realdata
def test_scotsman_label_matches_a_contact_and_positions_match_geodesic(data_dir):
    survey = read_survey(data_dir / "surveys" / "scotsman-iver2.xtf")
    channel, column, row = map(int, (data_dir / "surveys" / "scotsman-iver2.xtf.hits").read_text().split())
    assert (channel, column, row) == (1, 138, 281)  # XTF channel 1 is starboard
    ping = survey.pings[row]
    spacing_m = ping.channel(Side.STARBOARD).sample_spacing_m
    # As a slant range the label would be in the water column.
    assert (column + 0.5) * spacing_m < track_bottom(survey)[row]
    # As a ground range it is the near edge of the wreck.
    geod = Geod(ellps="WGS84")

    def lon_lat(at, side, ground_m):
        turn = 90.0 if side is Side.STARBOARD else -90.0
        lon, lat, _ = geod.fwd(at.lon_deg, at.lat_deg, at.heading_deg + turn, ground_m)
        return lon, lat

    label = lon_lat(ping, Side.STARBOARD, (column + 0.5) * spacing_m)
    found = detect(survey)
    distances = [
        (geod.inv(*label, d.position.lon_deg, d.position.lat_deg)[2], d) for d in found if d.side is Side.STARBOARD
    ]
    distance_m, nearest = min(distances, key=lambda pair: pair[0])
    reference = georeference(survey.pings[nearest.ping_index], nearest.side, nearest.sample, SurveyOptions())
    assert nearest.position_sigma_m == max(reference.across_sigma_m, reference.along_sigma_m)
    # Within the root mean square distance (DRMS) that the error budget predicts.
    assert distance_m < np.hypot(reference.across_sigma_m, reference.along_sigma_m)
    for d in found:
        at = survey.pings[d.ping_index]
        slant_m = (d.sample + 0.5) * at.channel(d.side).sample_spacing_m
        lon, lat = lon_lat(at, d.side, np.sqrt(slant_m**2 - at.altitude_m**2))
        assert geod.inv(lon, lat, d.position.lon_deg, d.position.lat_deg)[2] < 0.01


@pytest.mark.system
@pytest.mark.realdata
def test_8_bit_survey_without_altitude_or_speed(data_dir):
    survey = read_survey(data_dir / "surveys" / "000_1236.xtf")
    found = detect(survey, DetectorSettings(confidence_threshold=0.1))
    assert 10 <= len(found) <= 60  # a river bed with debris
    assert all(d.length_m is not None for d in found)
    on_the_bottom = [d for d in found if d.atd_class != STRUCTURE]
    assert all(d.height_m is not None and d.position is not None for d in on_the_bottom)
    # A wall beside the track echoes in the water column; nothing else is as certain.
    certain = [d for d in found if d.confidence > 1.0]
    assert [(d.atd_class, d.side) for d in certain] == [(STRUCTURE, Side.STARBOARD)]
    assert certain[0].length_m > 30.0
    assert certain[0].slant_range_m < certain[0].altitude_m
