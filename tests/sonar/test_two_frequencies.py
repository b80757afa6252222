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


@pytest.fixture(scope="module")
def survey():
    return simulate_survey(SurveySpec(seed=3, pings=120, samples=256, range_m=30.0, targets=1, clutter=0)).survey


@SECOND
def test_waterfall_has_width_of_first_channel(samples, range_m, survey, tmp_path):
    alone, both = read_both(survey, tmp_path, samples, range_m)
    for side in Side:
        assert both.waterfall(side).shape == (120, 256)
        np.testing.assert_array_equal(both.waterfall(side), alone.waterfall(side))
        assert (both.sample_count(side), both.max_slant_range_m(side)) == (256, 30.0)


@SECOND
def test_ground_range_ends_with_first_channel(samples, range_m, survey, tmp_path):
    altitude_m = np.full(120, 5.0)
    alone, both = (
        ground_range_image(s, Side.PORT, altitude_m, 0.25) for s in read_both(survey, tmp_path, samples, range_m)
    )
    assert both.shape == (120, 120)
    np.testing.assert_array_equal(both, alone)


@SECOND
def test_bottom_tracking_uses_first_channel(samples, range_m, survey, tmp_path):
    alone, both = read_both(survey, tmp_path, samples, range_m)
    np.testing.assert_array_equal(track_bottom(both), track_bottom(alone))


@SECOND
@pytest.mark.parametrize("flags", [[], ["--ground"], ["--ground", "--even"]])
def test_plots_use_first_channel(flags, samples, range_m, survey, tmp_path):
    images = []
    for path in files_of(survey, tmp_path, samples, range_m):
        assert main(["survey", "plot", *flags, "--out", str(path.parent), str(path)]) == 0
        images.append((path.parent / "line-waterfall.png").read_bytes())
    assert images[0] == images[1]


@SECOND
def test_exported_range_is_that_of_first_channel(samples, range_m, survey, tmp_path, capsys):
    tables = []
    for path in files_of(survey, tmp_path, samples, range_m):
        assert main(["survey", "export", str(path)]) == 0
        tables.append(capsys.readouterr().out)
    assert tables[0] == tables[1]
    assert tables[1].splitlines()[1].endswith(",30")


@SECOND
def test_info_lists_all_channels_and_names_the_one_in_use(samples, range_m, survey, tmp_path, capsys):
    alone, both = files_of(survey, tmp_path, samples, range_m)
    note = (
        "several channels a side in 120 of 120 pings: images and contacts are of the first, 400 kHz, slant range 30 m"
    )
    assert main(["survey", "info", "--json", str(both)]) == 0
    info = json.loads(capsys.readouterr().out)
    assert info["samples"] == sorted({256, samples})
    assert info["frequency_hz"] == [400e3, 900e3]
    assert info["slant_range_m"] == [min(30.0, range_m), max(30.0, range_m)]
    assert info["warnings"][-1] == note
    assert main(["survey", "info", str(both)]) == 0
    assert f"  note: {note}\n" in capsys.readouterr().out
    assert main(["survey", "info", str(alone)]) == 0
    assert "several channels" not in capsys.readouterr().out


def test_absent_side_has_zero_range(survey):
    port = replace(survey, pings=tuple(replace(p, channels=p.channels[:1]) for p in survey.pings))
    assert (port.sample_count(Side.STARBOARD), port.max_slant_range_m(Side.STARBOARD)) == (0, 0.0)
    assert port.waterfall(Side.STARBOARD).shape == (120, 0)
