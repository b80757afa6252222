"""Dual-frequency surveys: images use the first channel of each side."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from builders.two_frequencies import files_of, read_both

from sonarpost.cli.main import main
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.bottom_track import track_bottom
from sonarpost.sonar.ground_range import ground_range_image
from sonarpost.sonar.survey import Side

SECOND = pytest.mark.parametrize(("samples", "range_m"), [(256, 10.0), (256, 90.0), (1024, 30.0), (64, 30.0)])
NOTE = "several channels a side in 120 of 120 pings: images and contacts are of the first, 400 kHz, slant range 30 m"


@pytest.fixture(scope="module")
def survey():
    return simulate_survey(SurveySpec(seed=3, pings=120, samples=256, range_m=30.0, targets=1, clutter=0)).survey


@SECOND
def test_images_and_bottom_track_are_of_the_first_channel(samples, range_m, survey, tmp_path):
    alone, both = read_both(survey, tmp_path, samples, range_m)
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
def test_commands_use_the_first_channel_and_info_names_it(samples, range_m, survey, tmp_path, capsys):
    alone, both = files_of(survey, tmp_path, samples, range_m)

    def printed(path, *arguments):
        assert main(["survey", *arguments, str(path)]) == 0
        return capsys.readouterr().out

    for flags in ([], ["--ground", "--even"]):
        for path in (alone, both):
            printed(path, "plot", *flags, "--out", str(path.parent))
        images = [(path.parent / "line-waterfall.png").read_bytes() for path in (alone, both)]
        assert images[0] == images[1]
    assert printed(alone, "export") == printed(both, "export")
    assert printed(both, "export").splitlines()[1].endswith(",30")
    info = json.loads(printed(both, "info", "--json"))
    assert info["samples"] == sorted({256, samples})
    assert info["frequency_hz"] == [400e3, 900e3]
    assert info["slant_range_m"] == [min(30.0, range_m), max(30.0, range_m)]
    assert info["warnings"][-1] == NOTE
    assert f"  note: {NOTE}\n" in printed(both, "info")
    assert "several channels" not in printed(alone, "info")
