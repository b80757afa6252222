from __future__ import annotations

import argparse
import dataclasses
import json
import math

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from sonarpost.cli.simulate import add_parser
from sonarpost.errors import ConfigError
from sonarpost.simulation.seabed.echo import SonarSettings, Track, echo_intensity, received_amplitude
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.simulation.seabed.targets import MINE_LIKE_KINDS, ObjectKind, SeabedObject, place_object
from sonarpost.simulation.seabed.terrain import Seabed, SeabedKind
from sonarpost.sonar.geometry import Position, georeference, offset_between_m, ping_spacing_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.xtf import read_xtf
from sonarpost.sonar.survey import Side

SMALL = SurveySpec(seed=5, pings=180, samples=512, seabed=SeabedKind.SAND, targets=2, clutter=2)
SETTINGS = SonarSettings(samples=1024, range_m=30.0, ping_spacing_m=0.1)
ALTITUDE_M = 5.0


def flat_bed() -> Seabed:
    shape = (521, 1301)
    return Seabed(np.zeros(shape, np.float32), np.full(shape, 0.3, np.float32), 0.05, -3.0, -32.5)


def straight_track(pings: int = 200) -> Track:
    still = np.zeros(pings)
    return Track(np.arange(pings) * 0.1, still, np.full(pings, ALTITUDE_M), still, still)


def sample_of(ground_m: float, height_m: float = 0.0) -> float:
    return math.hypot(ground_m, ALTITUDE_M - height_m) / SETTINGS.sample_m


def test_the_water_column_is_dark_and_ends_at_the_altitude():
    image = echo_intensity(flat_bed(), straight_track(), SETTINGS, 1)
    first = ALTITUDE_M / SETTINGS.sample_m
    assert image[:, : int(first) - 3].max() == 0
    assert image[:, int(first) : int(first) + 4].min() > 0.02
    # Flat sand is 1 at half range, by definition of the scale, and much the same along the track.
    assert image[:, 500:524].mean() == pytest.approx(1.0, abs=0.25)
    assert image.std(axis=0).max() < 1e-3


@pytest.mark.parametrize(("sign", "across_m"), [(1, 12.0), (-1, -12.0), (1, 20.0)])
def test_a_shadow_is_as_long_as_geometry_says(sign, across_m):
    bed = flat_bed()
    cone = SeabedObject(ObjectKind.TRUNCATED_CONE, 10.0, across_m, 1.0, 1.0, 0.45)
    place_object(bed, cone)
    image = echo_intensity(bed, straight_track(), SETTINGS, sign)
    row = image[100]
    usual = np.median(np.delete(image, slice(90, 111), axis=0), axis=0)
    # The far rim of its flat top, 0.275 m from the middle, casts the shadow's end.
    top_m = abs(across_m) + 0.275
    end = sample_of(top_m * ALTITUDE_M / (ALTITUDE_M - 0.45))
    # In slant range the dark begins right behind that rim: what lies at its foot is nearer in range than it.
    begin = sample_of(top_m, 0.45)
    dark = np.flatnonzero(row[300:] < 0.25 * usual[300:]) + 300
    assert dark.min() == pytest.approx(begin, abs=6)
    assert dark.max() == pytest.approx(end, abs=6)
    assert np.ptp(dark) + 1 == dark.size
    # The highlight is at its near face, brighter than the sand, before the shadow.
    bright = np.flatnonzero(row > 3 * np.maximum(usual, 0.1))
    assert bright.size >= 4
    assert sample_of(abs(across_m) - 0.6) - 8 < bright.min() < bright.max() < dark.min() + 6
    # The other side sees nothing of it.
    other = echo_intensity(bed, straight_track(), SETTINGS, -sign)
    np.testing.assert_allclose(other, other[:1].repeat(200, axis=0), rtol=1e-3)


def test_a_taller_object_throws_a_longer_shadow():
    lengths = []
    for height in (0.2, 0.5, 1.0):
        bed = flat_bed()
        place_object(bed, SeabedObject(ObjectKind.TRUNCATED_CONE, 10.0, 15.0, 1.0, 1.0, height))
        image = echo_intensity(bed, straight_track(), SETTINGS, 1)
        lengths.append(int((image[100, 400:] < 0.25 * image[20, 400:]).sum()))
    assert lengths[0] * 1.8 < lengths[1] < lengths[2] / 1.6


def test_the_beam_widens_with_range():
    def rows_lit(across_m: float) -> int:
        bed = flat_bed()
        bed.backscatter[:] = 0.0
        column = round((across_m + 32.5) / 0.05)
        bed.backscatter[259:262, column - 3 : column + 4] = 1.0
        image = echo_intensity(bed, straight_track(), dataclasses.replace(SETTINGS, ping_spacing_m=0.02), 1)
        profile = image[:, round(sample_of(across_m))]
        return int((profile > profile.max() / 2).sum())

    # The track is then 0.1 m a ping still, but the blur is reckoned for finer pings.
    assert rows_lit(28.0) > rows_lit(8.0) + 2


def test_speckle_is_that_of_real_recordings():
    rng = np.random.default_rng(0)
    flat = np.full((300, 1024), 1.0, np.float32)
    amplitude = received_amplitude(flat, np.full(300, ALTITUDE_M), SETTINGS, rng)[:, 300:700]
    rows = amplitude / amplitude.mean(axis=1, keepdims=True)
    assert 0.3 < rows.std() < 0.45
    off = rows - rows.mean()
    near = (off[:, 1:] * off[:, :-1]).mean() / (off**2).mean()
    far = (off[:, 6:] * off[:, :-6]).mean() / (off**2).mean()
    assert 0.2 < near < 0.6
    assert abs(far) < 0.05


@pytest.fixture(scope="module")
def small():
    return simulate_survey(SMALL)


def test_the_survey_has_what_was_asked_for(small):
    survey = small.survey
    assert len(survey.pings) == 180
    assert survey.sides() == (Side.PORT, Side.STARBOARD)
    for ping in survey:
        assert all(c.samples.shape == (512,) and c.samples.dtype == np.uint8 for c in ping.channels)
        assert all(c.slant_range_m == 30.0 for c in ping.channels)
        assert 3.0 < ping.altitude_m < 7.0
        assert ping.depth_m + ping.altitude_m == pytest.approx(20.0, abs=1.5)
    assert ping_spacing_m(survey) == pytest.approx(0.1, rel=0.02)
    assert survey.pings[10].time_utc_s - survey.pings[0].time_utc_s == pytest.approx(10 / 15)
    assert [t.is_mine_like for t in small.truth].count(True) == 2
    assert len(small.truth) == 4


def test_the_same_seed_gives_the_same_survey_and_another_does_not(small):
    again = simulate_survey(SMALL)
    assert again.truth == small.truth
    for side in Side:
        np.testing.assert_array_equal(again.survey.waterfall(side), small.survey.waterfall(side))
    other = simulate_survey(dataclasses.replace(SMALL, seed=6))
    assert not np.array_equal(other.survey.waterfall(Side.PORT), small.survey.waterfall(Side.PORT))


def test_the_same_bottom_with_and_without_objects():
    empty = simulate_survey(dataclasses.replace(SMALL, targets=0, clutter=0))
    assert empty.truth == ()
    full = simulate_survey(SMALL)
    same = empty.survey.waterfall(Side.PORT) == full.survey.waterfall(Side.PORT)
    assert 0.75 < same.mean() < 1


def test_the_truth_is_where_the_chart_and_the_picture_have_it():
    spec = SurveySpec(seed=9, pings=400, seabed=SeabedKind.MUD, targets=tuple(MINE_LIKE_KINDS) * 2, clutter=0)
    simulated = simulate_survey(spec)
    for thing in simulated.truth:
        ping = simulated.survey.pings[thing.ping]
        found = georeference(ping, thing.side, thing.sample_index, SurveyOptions())
        north, east = offset_between_m(Position(thing.lat_deg, thing.lon_deg), found.position)
        # The middle of an object at half its height, against the flat bottom that geo-referencing assumes.
        assert math.hypot(north, east) < 1.0
        image = simulated.survey.waterfall(thing.side)
        rows = slice(max(thing.ping - 4, 0), thing.ping + 5)
        here = image[rows, thing.sample_index - 25 : thing.sample_index + 15]
        usual = np.median(image[:, thing.sample_index - 25 : thing.sample_index + 15])
        assert here.max() > 3 * usual
        reach_m = thing.length_m / 2 + thing.height_m * thing.ground_range_m / (5.0 - thing.height_m)
        behind = slice(thing.sample_index, thing.sample_index + round(reach_m * 1024 / 30))
        shadow = uniform_filter(image[max(thing.ping - 1, 0) : thing.ping + 2, behind], 3)
        assert shadow.min() < 0.35 * usual


def test_targets_are_of_a_size_to_recognise():
    simulated = simulate_survey(SurveySpec(seed=3, pings=500, seabed=SeabedKind.SAND, targets=8, clutter=0))
    spacing_m, sample_m = 0.1, 30 / 1024
    for thing in simulated.truth:
        shadow_m = thing.height_m * thing.ground_range_m / (5.0 - thing.height_m)
        assert (thing.width_m + shadow_m) / sample_m >= 15
        assert 5 <= thing.length_m / spacing_m <= 40


def test_sixteen_bits_use_the_range_of_recorders():
    image = simulate_survey(dataclasses.replace(SMALL, bits=16)).survey.pings[100].channels[0].samples
    assert image.dtype == np.uint16
    assert 255 < image.max() <= 32767


def test_on_rails_without_wobble():
    survey = simulate_survey(dataclasses.replace(SMALL, motion=0.0, seabed=SeabedKind.MUD)).survey
    assert {p.heading_deg for p in survey} == {40.0}
    assert {p.roll_deg for p in survey} == {0.0}


def test_nadir_range_and_object_numbers_are_respected():
    simulated = simulate_survey(dataclasses.replace(SMALL, pings=600, targets=9, clutter=9))
    assert all(5.0 < thing.ground_range_m < 25.0 for thing in simulated.truth)
    assert [thing.ping for thing in simulated.truth] == sorted(thing.ping for thing in simulated.truth)
    assert len({(t.side, t.ping, t.sample_index) for t in simulated.truth}) == 18


def test_more_objects_than_find_room():
    with pytest.raises(ConfigError, match="targets and clutter"):
        simulate_survey(dataclasses.replace(SMALL, pings=60, targets=400))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("pings", 0),
        ("samples", 1),
        ("range_m", float("nan")),
        ("altitude_m", 16.0),
        ("ping_rate_hz", 30.0),
        ("speed_mps", 0.0),
        ("bits", 12),
        ("targets", -1),
        ("seed", -1),
        ("water_depth_m", 2.0),
        ("start_lat_deg", 89.0),
    ],
)
def test_a_specification_out_of_range_is_named(field, value):
    with pytest.raises(ConfigError, match=field):
        SurveySpec(**{field: value})


def test_a_single_ping():
    survey = simulate_survey(SurveySpec(pings=1, targets=0, clutter=0, samples=128)).survey
    assert len(survey.pings) == 1


def run(*words: str) -> int:
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    args = parser.parse_args(["simulate", *words])
    return args.run(args)


def test_the_command_writes_survey_and_truth(tmp_path, capsys):
    out, truth = tmp_path / "line.xtf", tmp_path / "truth.json"
    words = [str(out), "--seed", "5", "--pings", "180", "--samples", "512", "--seabed", "sand"]
    words += ["--targets", "2", "--clutter", "2"]
    assert run(*words, "--truth", str(truth)) == 0
    assert "180 pings, 2 mine-like objects, 2 others" in capsys.readouterr().out
    read, made = read_xtf(out), simulate_survey(SMALL)
    assert read.warnings == ()
    assert read.sonar_id == made.survey.sonar_id
    for side in Side:
        np.testing.assert_array_equal(read.waterfall(side), made.survey.waterfall(side))
    document = json.loads(truth.read_text())
    assert document["survey"] == "line.xtf"
    for got, want in zip(document["objects"], made.truth, strict=True):
        assert got == {**dataclasses.asdict(want), "kind": want.kind.value, "side": want.side.value}
    first = out.read_bytes()
    assert run(*words) == 0
    assert out.read_bytes() == first


def test_the_command_refuses_what_cannot_be(tmp_path):
    with pytest.raises(ConfigError, match="pings"):
        run(str(tmp_path / "a.xtf"), "--pings", "0")
    with pytest.raises(FileNotFoundError):
        run(str(tmp_path / "absent" / "a.xtf"), "--pings", "2", "--samples", "64", "--targets", "0", "--clutter", "0")
    with pytest.raises(SystemExit):
        run(str(tmp_path / "a.xtf"), "--seabed", "cheese")
