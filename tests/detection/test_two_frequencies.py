"""Detection in dual-frequency surveys gives the results of the first frequency alone."""

from dataclasses import replace

import numpy as np
import pytest
from builders.two_frequencies import read_both, with_second_frequency

from research.detection.codec_effect import confidence_with
from sonarpost.cli.detection.command import annotated_waterfall
from sonarpost.detection.detector import detect
from sonarpost.detection.normalisation import normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.snippets import cut_expanded, cut_snippet, ground_projected_image
from sonarpost.detection.stream import FileOrigin, StreamDetector
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.ground_range import MAX_COLUMNS
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import InMemorySource
from sonarpost.sonar.survey import Side

pytestmark = pytest.mark.usefixtures("few_candidates")
SAMPLES, RANGE_M = 512, 30.0
SECOND = pytest.mark.parametrize(
    ("samples", "range_m"),
    [
        pytest.param(SAMPLES, 10.0, id="shorter"),
        pytest.param(SAMPLES, 90.0, id="longer"),
        pytest.param(4 * SAMPLES, RANGE_M, id="finer"),
        pytest.param(SAMPLES // 4, RANGE_M, id="coarser"),
    ],
)


@pytest.mark.parametrize(("samples", "range_m"), [(4 * SAMPLES, 10.0), (SAMPLES // 4, 90.0)])
def test_detections_equal_those_of_first_frequency(samples, range_m, tmp_path):
    sand = {"clutter": 0, "seabed": SeabedKind.SAND}
    simulated = simulate_survey(SurveySpec(seed=3, pings=400, samples=SAMPLES, range_m=RANGE_M, targets=4, **sand))
    alone, both = read_both(simulated.survey, tmp_path, samples, range_m)
    found = detect(both)
    assert len(found) == len(simulated.truth) == 4
    for target in simulated.truth:
        # The highlight is the near face, which is nearer than the middle of the object.
        slant_m = (target.sample_index + 0.5) * RANGE_M / SAMPLES
        (one,) = [d for d in found if d.side is target.side and abs(d.slant_range_m - slant_m) < 0.4]
        assert one.ping_index == pytest.approx(target.ping, abs=10)
        assert one.ground_range_m == pytest.approx(target.ground_range_m, abs=0.7)
        assert one.length_m == pytest.approx(target.length_m, abs=0.5)
        assert one.width_m == pytest.approx(target.width_m, abs=0.6)
        assert one.height_m == pytest.approx(target.height_m, abs=0.15)
    assert found == detect(alone)


@SECOND
def test_cells_snippets_waterfall_and_codec_effect_are_those_of_first_frequency(samples, range_m, one_object, tmp_path):
    survey, found = one_object
    alone, both = read_both(survey, tmp_path, samples, range_m)
    one, other = (normalise_side(each, Side.PORT, DetectorSettings()) for each in (alone, both))
    assert (other.cell_across_m, other.samples_per_cell) == (one.cell_across_m, one.samples_per_cell)
    np.testing.assert_array_equal(other.level, one.level)
    for sample in (250, 505):  # at the outer edge of the recording the window is shifted
        at = replace(found, sample=sample)
        for width in (140, 1000):
            one, other = (cut_snippet(each, at, 80, width) for each in (alone, both))
            assert other.first_sample == one.first_sample
            np.testing.assert_array_equal(other.image16, one.image16)
        np.testing.assert_array_equal(cut_expanded(both, at, 80, 140), cut_expanded(alone, at, 80, 140))
        one, other = (ground_projected_image(each, at, 80, 140, 0.1) for each in (alone, both))
        np.testing.assert_array_equal(other, one)
    images = [annotated_waterfall(InMemorySource(each, SurveyOptions()), (found,)) for each in (alone, both)]
    np.testing.assert_array_equal(*map(np.asarray, images))
    image = cut_snippet(alone, found, 80, 140)
    confidences = [confidence_with(each, found, image, image.image) for each in (alone, both)]
    assert confidences[0] == confidences[1] > 1.0


@SECOND
def test_line_of_several_files_without_altitude_and_navigation(samples, range_m, make_survey, tmp_path):
    found = []
    survey = make_survey({}, sides=(Side.PORT,), navigation=False, altitude=False)
    for each in read_both(survey, tmp_path, samples, range_m):
        results, held = results_of(files_of(each, 98))
        found.append([contact.content for result in results for contact in (*result.released, *result.contacts)])
        found[-1] += [contact.content for contact in held]
    assert found[0] == found[1]
    ((_, detection),) = found[0]
    assert detection.slant_range_m == pytest.approx(250.5 * 20 / 512, abs=0.2)
    assert detection.width_m == pytest.approx(12 * 20 / 512, abs=0.2)
    assert detection.altitude_m == pytest.approx(3.0, abs=0.25)


def test_long_range_of_second_frequency_allows_small_pixels(one_object, tmp_path):
    survey, found = one_object
    alone, both = read_both(survey, tmp_path, 512, 8000.0)
    pixel_m = 8000.0 / MAX_COLUMNS / 2
    image = ground_projected_image(alone, found, 8, 14, pixel_m)
    assert image is not None
    np.testing.assert_array_equal(ground_projected_image(both, found, 8, 14, pixel_m), image)
    with pytest.raises(ValueError, match="512 samples"):
        cut_snippet(with_second_frequency(survey, 1024, 20.0), replace(found, sample=600))


def files_of(survey, boundary):
    return [replace(survey, pings=survey.pings[:boundary]), replace(survey, pings=survey.pings[boundary:])]


def results_of(files):
    """Return the results of consecutive files and the contacts held at the end; contacts are their detections."""
    detector = StreamDetector(lambda _survey, detection, origin: (origin.row, detection))
    sources = [InMemorySource(file, SurveyOptions()) for file in files]
    return [detector.add_file(source, FileOrigin.of(source, "0")) for source in sources], detector.finish()


def test_channels_in_another_order_are_a_continuation(make_survey):
    survey = with_second_frequency(make_survey({}, sides=(Side.PORT,)), 512, 10.0)
    first, second = files_of(survey, 98)
    assert results_of([first, second])[0][1].joined
    # The order of the channels in a ping does not matter: the frequency chooses.
    exchanged = tuple(replace(p, channels=p.channels[::-1]) for p in second.pings)
    assert results_of([first, replace(second, pings=exchanged)])[0][1].joined
