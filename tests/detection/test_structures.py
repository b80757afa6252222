"""Large structures: by their shadow, and by their echo in the water column."""

from dataclasses import replace

import numpy as np
import pytest

from sonarpost.detection.detector import STRUCTURE, detect
from sonarpost.detection.normalisation import normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.structures import find_structures, find_water_structures, is_part_of_structure
from sonarpost.extensions.simulation.seabed.objects import ObjectKind
from sonarpost.extensions.simulation.seabed.spec import SurveySpec
from sonarpost.extensions.simulation.seabed.survey import simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.survey import ChannelPing, Side

pytestmark = pytest.mark.usefixtures("few_candidates")

SETTINGS = DetectorSettings()


def test_long_shadow_behind_bright_edge_is_one_structure(make_survey):
    rows = [
        {"ping": ping, "pings": 10, "sample": 200, "samples": 14, "shadow_samples": 180} for ping in range(60, 150, 10)
    ]
    grid = normalise_side(make_survey(*rows), Side.PORT, SETTINGS)
    found = find_structures(grid)
    assert len(found) == 1
    structure = found[0].measurement
    assert found[0].confidence > 1.0
    assert structure.rows == (pytest.approx(55, abs=6), pytest.approx(145, abs=6))
    assert 2 * structure.cells[1] == pytest.approx(207, abs=10)
    assert is_part_of_structure(replace(structure, row=100), structure, grid)
    assert not is_part_of_structure(replace(structure, row=5), structure, grid)
    assert find_structures(normalise_side(make_survey({}), Side.PORT, SETTINGS)) == []


@pytest.mark.system
def test_simulated_wreck_is_one_contact_of_class_structure():
    spec = SurveySpec(seed=3, pings=900, seabed=SeabedKind.SAND, targets=0, clutter=(ObjectKind.WRECK,))
    simulated = simulate_survey(spec)
    (wreck,) = simulated.truth
    found = [d for d in detect(simulated.survey) if d.atd_class == STRUCTURE]
    assert found
    best = found[0]
    assert best.side is wreck.side
    assert abs(best.ping_index - wreck.ping) * spec.ping_spacing_m < wreck.length_m
    assert best.confidence > 1.0
    assert best.length_m > 5.0
    assert best.p_mine_like is None


def with_water_echo(survey, rows, samples, value, step=3):
    """Return the survey with echoes in the water column; a step above 1 leaves gaps between them."""
    pings = []
    for row, ping in enumerate(survey.pings):
        channels = []
        for channel in ping.channels:
            values = channel.samples.copy()
            if channel.side is Side.PORT and rows[0] <= row < rows[1] and row % step == 0:
                values[samples[0] : samples[1]] = value
            channels.append(ChannelPing(channel.side, values, channel.slant_range_m, channel.frequency_hz))
        pings.append(replace(ping, channels=tuple(channels)))
    return replace(survey, pings=tuple(pings))


@pytest.fixture(scope="module")
def deep_survey():
    return simulate_survey(SurveySpec(seed=5, pings=400, altitude_m=10.0, seabed=SeabedKind.SAND, targets=0, clutter=0))


def test_echo_in_the_water_column_is_a_structure(deep_survey):
    changed = with_water_echo(deep_survey.survey, (100, 250), (120, 240), 200)
    grid = normalise_side(changed, Side.PORT, SETTINGS)
    (structure,) = find_water_structures(grid)
    assert structure.measurement.rows == (pytest.approx(100, abs=8), pytest.approx(250, abs=8))
    assert structure.area_m2 == pytest.approx(150 * 0.1 * 120 * 30 / 1024, rel=0.3)
    assert structure.confidence > 1.0
    (contact,) = [d for d in detect(changed) if d.atd_class == STRUCTURE]
    assert contact.length_m == pytest.approx(15.0, rel=0.1)
    assert contact.slant_range_m < contact.altitude_m


def test_surface_line_and_short_noise_are_no_structure(deep_survey):
    # A line at one range, as of the surface, and eight pings of noise.
    for rows, samples, step in (((0, 400), (150, 170), 1), ((100, 108), (120, 240), 3)):
        grid = normalise_side(with_water_echo(deep_survey.survey, rows, samples, 200, step), Side.PORT, SETTINGS)
        assert [s for s in find_water_structures(grid) if s.confidence >= SETTINGS.confidence_threshold] == []
    assert find_water_structures(normalise_side(deep_survey.survey, Side.PORT, SETTINGS)) == []
    assert find_water_structures(replace(grid, water_echo=None)) == []
    assert np.isfinite(grid.water_echo).all()
