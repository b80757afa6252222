import dataclasses
import json
import math

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from sonarpost.cli.main import parser
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed import survey as simulator
from sonarpost.extensions.simulation.seabed.objects import MINE_LIKE_KINDS
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.geometry import Position, georeference, offset_between_m, ping_spacing_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Side

SMALL = SurveySpec(seed=5, pings=180, samples=512, seabed=SeabedKind.SAND, targets=2, clutter=2)


@pytest.fixture(scope="module")
def small():
    return simulate_survey(SMALL)


def test_survey_matches_its_specification(small):
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


def test_survey_depends_only_on_the_seed():
    spec = dataclasses.replace(SMALL, pings=60, samples=128)
    one, again, other = (simulate_survey(dataclasses.replace(spec, seed=seed)) for seed in (5, 5, 6))
    assert again.truth == one.truth
    for side in Side:
        np.testing.assert_array_equal(again.survey.waterfall(side), one.survey.waterfall(side))
    assert not np.array_equal(other.survey.waterfall(Side.PORT), one.survey.waterfall(Side.PORT))


def test_survey_without_speckle_has_the_same_other_draws(monkeypatch):
    spec = SurveySpec(seed=5, pings=40, targets=1, clutter=0, seabed=SeabedKind.SAND, bits=16)
    noisy, clean = simulate_survey(spec), simulate_survey(spec, speckle=False)
    drawn = simulator._speckle

    def ones(shape, rng, sigma):
        return np.ones_like(drawn(shape, rng, sigma))

    monkeypatch.setattr(simulator, "_speckle", ones)
    expected = simulate_survey(spec)
    assert noisy.truth == clean.truth
    for side in noisy.survey.sides():
        one, other = noisy.survey.waterfall(side), clean.survey.waterfall(side)
        assert np.array_equal(other, expected.survey.waterfall(side))
        assert not np.array_equal(one, other)
        middle = slice(400, 800)
        assert (one[:, middle] ** 2).mean() == pytest.approx((other[:, middle] ** 2).mean(), rel=0.1)


def test_objects_do_not_change_the_seabed(small):
    empty = simulate_survey(dataclasses.replace(SMALL, targets=0, clutter=0))
    assert empty.truth == ()
    same = empty.survey.waterfall(Side.PORT) == small.survey.waterfall(Side.PORT)
    assert 0.75 < same.mean() < 1


def test_truth_matches_geographic_and_image_positions():
    spec = SurveySpec(seed=9, pings=400, seabed=SeabedKind.MUD, targets=tuple(MINE_LIKE_KINDS) * 2, clutter=0)
    simulated = simulate_survey(spec)
    for item in simulated.truth:
        ping = simulated.survey.pings[item.ping]
        found = georeference(ping, item.side, item.sample_index, SurveyOptions())
        north, east = offset_between_m(Position(item.lat_deg, item.lon_deg), found.position)
        # The truth uses half the height of the object; geo-referencing assumes a flat bottom.
        assert math.hypot(north, east) < 1.0
        image = simulated.survey.waterfall(item.side)
        rows = slice(max(item.ping - 4, 0), item.ping + 5)
        here = image[rows, item.sample_index - 25 : item.sample_index + 15]
        usual = np.median(image[:, item.sample_index - 25 : item.sample_index + 15])
        assert here.max() > 3 * usual
        reach_m = item.length_m / 2 + item.height_m * item.ground_range_m / (5.0 - item.height_m)
        behind = slice(item.sample_index, item.sample_index + round(reach_m * 1024 / 30))
        shadow = uniform_filter(image[max(item.ping - 1, 0) : item.ping + 2, behind], 3)
        assert shadow.min() < 0.35 * usual


def test_sixteen_bit_samples_use_the_range_of_recorders():
    spec = dataclasses.replace(SMALL, bits=16, pings=1, targets=0, clutter=0)
    (ping,) = simulate_survey(spec).survey.pings
    image = ping.channels[0].samples
    assert image.dtype == np.uint16
    assert 255 < image.max() <= 32767


def test_track_without_motion_is_straight():
    survey = simulate_survey(dataclasses.replace(SMALL, motion=0.0, seabed=SeabedKind.MUD, pings=40, targets=0)).survey
    assert {p.heading_deg for p in survey} == {40.0}
    assert {p.roll_deg for p in survey} == {0.0}


def test_objects_avoid_nadir_and_each_other_and_targets_are_large_enough_to_recognise():
    simulated = simulate_survey(dataclasses.replace(SMALL, pings=600, samples=128, targets=9, clutter=9))
    assert all(5.0 < item.ground_range_m < 25.0 for item in simulated.truth)
    assert [item.ping for item in simulated.truth] == sorted(item.ping for item in simulated.truth)
    assert len({(t.side, t.ping, t.sample_index) for t in simulated.truth}) == 18
    spacing_m, sample_m = 0.1, 30 / 1024
    for item in simulated.truth:
        if item.is_mine_like:
            shadow_m = item.height_m * item.ground_range_m / (5.0 - item.height_m)
            assert (item.width_m + shadow_m) / sample_m >= 15
            assert 5 <= item.length_m / spacing_m <= 40


def test_too_many_objects_are_rejected():
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
        ("targets", -1),
        ("seed", -1),
        ("water_depth_m", 2.0),
        ("burial", 0.9),
        ("scour", float("nan")),
    ],
)
def test_specification_error_names_the_field(field, value):
    with pytest.raises(ConfigError, match=field):
        SurveySpec(**{field: value})


def run(*words: str) -> int:
    args = parser("simulate").parse_args(["simulate", *words])
    return args.run(args)


def test_command_writes_survey_and_truth(small, tmp_path, capsys):
    out, truth = tmp_path / "line.xtf", tmp_path / "truth.json"
    words = [str(out), "--seed", "5", "--pings", "180", "--samples", "512", "--seabed", "sand"]
    words += ["--targets", "2", "--clutter", "2"]
    assert run(*words, "--truth", str(truth)) == 0
    assert "180 pings, 2 mine-like objects, 2 others" in capsys.readouterr().out
    read = read_survey(out)
    assert read.warnings == ()
    assert read.sonar_id == small.survey.sonar_id
    for side in Side:
        np.testing.assert_array_equal(read.waterfall(side), small.survey.waterfall(side))
    document = json.loads(truth.read_text())
    assert document["survey"] == "line.xtf"
    for got, want in zip(document["objects"], small.truth, strict=True):
        assert got == {**dataclasses.asdict(want), "kind": want.kind.value, "side": want.side.value}
    first = out.read_bytes()
    assert run(*words, "--force") == 0
    assert out.read_bytes() == first


def test_command_replaces_files_only_with_force(tmp_path):
    words = ["--pings", "2", "--samples", "64", "--targets", "0", "--clutter", "0"]
    out, truth = tmp_path / "new" / "a.xtf", tmp_path / "truth.json"
    truth.write_text("older")
    with pytest.raises(ConfigError, match=r"truth\.json: got 'an existing file', expected .* --force"):
        run(str(out), *words, "--truth", str(truth))
    assert (out.exists(), truth.read_text()) == (False, "older")
    assert run(str(out), *words) == 0
    first = out.read_bytes()
    with pytest.raises(ConfigError, match=r"a\.xtf: got 'an existing file', expected .* --force"):
        run(str(out), *words, "--seed", "2")
    assert out.read_bytes() == first
    assert run(str(out), *words, "--seed", "2", "--truth", str(truth), "--force") == 0
    assert out.read_bytes() != first
    assert json.loads(truth.read_text())["survey"] == "a.xtf"


def test_command_writes_positions_in_metres(tmp_path):
    words = ["--pings", "5", "--samples", "64", "--targets", "0", "--clutter", "0"]
    assert (
        run(str(tmp_path / "degrees.xtf"), *words) == run(str(tmp_path / "m.xtf"), *words, "--crs", "EPSG:32620") == 0
    )
    assert all(ping.lat_deg is None for ping in read_survey(tmp_path / "m.xtf"))
    read = read_survey(tmp_path / "m.xtf", SurveyOptions(projected_crs="EPSG:32620"))
    for got, want in zip(read, read_survey(tmp_path / "degrees.xtf"), strict=True):
        assert (got.lat_deg, got.lon_deg) == pytest.approx((want.lat_deg, want.lon_deg), abs=1e-8)
    with pytest.raises(ConfigError, match="--crs"):
        run(str(tmp_path / "b.xtf"), *words, "--crs", "EPSG:4326")


def test_command_rejects_invalid_options(tmp_path):
    with pytest.raises(ConfigError, match="pings"):
        run(str(tmp_path / "a.xtf"), "--pings", "0")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"output folder: got .*file"):
        run(str(tmp_path / "file" / "a.xtf"), "--pings", "2", "--samples", "64", "--targets", "0", "--clutter", "0")
    with pytest.raises(SystemExit):
        run(str(tmp_path / "a.xtf"), "--seabed", "cheese")
