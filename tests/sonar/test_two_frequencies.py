"""Dual-frequency surveys: images are of the highest frequency, or of the one that is chosen."""

import json
from dataclasses import replace

import numpy as np
import pytest
from builders.two_frequencies import FIRST_HZ, SECOND_HZ, files_of, read_both

from sonarpost.cli.main import main
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.bottom_track import track_bottom
from sonarpost.sonar.ground_range import ground_range_image
from sonarpost.sonar.survey import Side

SECOND = pytest.mark.parametrize(("samples", "range_m"), [(256, 10.0), (256, 90.0), (1024, 30.0), (64, 30.0)])
NOTE = (
    "2 channel sets: 900 kHz in 120 pings; 400 kHz in 120 pings; "
    "images and contacts are of 900 kHz (option frequency_hz)"
)


@pytest.fixture(scope="module")
def survey():
    return simulate_survey(SurveySpec(seed=3, pings=120, samples=256, range_m=30.0, targets=1, clutter=0)).survey


@SECOND
def test_images_and_bottom_track_are_of_the_highest_frequency(samples, range_m, survey, tmp_path):
    alone, both = read_both(survey, tmp_path, samples, range_m)
    for one, other in zip(alone, both, strict=True):
        # What is detected and drawn follows from the pings.
        assert replace(other, channels=()) == replace(one, channels=())
        described = ([replace(c, samples=None, index=0) for c in ping.channels] for ping in (one, other))
        assert next(described) == next(described)
    for side in Side:
        assert both.waterfall(side).shape == (120, 256)
        np.testing.assert_array_equal(both.waterfall(side), alone.waterfall(side))
        assert (both.sample_count(side), both.max_slant_range_m(side)) == (256, 30.0)
    np.testing.assert_array_equal(track_bottom(both), track_bottom(alone))
    one, other = (ground_range_image(s, Side.PORT, np.full(120, 5.0), 0.25) for s in (alone, both))
    assert other.shape == (120, 120)
    np.testing.assert_array_equal(other, one)
    port = replace(survey, pings=tuple(replace(p, channels=p.channels[:1]) for p in survey.pings))
    assert (port.sample_count(Side.STARBOARD), port.max_slant_range_m(Side.STARBOARD)) == (0, 0.0)
    assert port.waterfall(Side.STARBOARD).shape == (120, 0)


@pytest.mark.parametrize(("samples", "range_m"), [(256, 10.0), (1024, 30.0)])
def test_commands_use_the_highest_frequency_and_info_names_both(samples, range_m, survey, tmp_path, capsys):
    alone, both = files_of(survey, tmp_path, samples, range_m)

    def printed(path, *arguments):
        assert main(["survey", *arguments, str(path)]) == 0
        return capsys.readouterr().out

    for flags in ([], ["--ground", "--even"]):
        for path in (alone, both):
            printed(path, "plot", *flags, "--out", str(path.parent))
        images = [(path.parent / "line-waterfall.png").read_bytes() for path in (alone, both)]
        assert images[0] == images[1]
    for arguments, samples_of, frequency_hz, used_m in (
        ([], 256, FIRST_HZ, 30.0),
        (["--frequency", "400"], samples, SECOND_HZ, range_m),
    ):
        info = json.loads(printed(both, "info", "--json", *arguments))
        assert (info["samples"], info["frequency_hz"]) == ([samples_of], [frequency_hz])
        assert info["slant_range_m"] == [used_m, used_m]
        assert [each["frequency_hz"] for each in info["channel_sets"]] == [FIRST_HZ, SECOND_HZ]
    assert f"  note: {NOTE}\n" in printed(both, "info")
    assert "channel sets" not in printed(alone, "info")
