"""Snippets in samples, at half the scale, and in ground range."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.detection.detector import detect
from sonarpost.detection.snippets import cut_expanded, cut_snippet, ground_projected_image, to_grey
from sonarpost.sonar.survey import ChannelPing, Side

pytestmark = pytest.mark.usefixtures("few_candidates")


@pytest.fixture(scope="module")
def found(make_survey):
    survey = make_survey({"side": Side.STARBOARD}, sides=(Side.STARBOARD,))
    return survey, detect(survey)[0]


def raw_window(survey, side, snippet):
    rows, columns = snippet.image.shape
    image = survey.waterfall(side)
    return image[
        snippet.first_ping_index : snippet.first_ping_index + rows,
        snippet.first_sample : snippet.first_sample + columns,
    ]


def test_default_snippet_is_centred_on_highlight_and_shadow(found):
    survey, detection = found
    snippet = cut_snippet(survey, detection)
    assert snippet.image.shape == snippet.image16.shape == (100, 100)
    row, column = detection.ping_index - snippet.first_ping_index, detection.sample - snippet.first_sample
    assert row == 50
    assert column == 50 - detection.shadow_samples // 2
    assert np.array_equal(snippet.image16, raw_window(survey, Side.STARBOARD, snippet))
    # Bright at the target, dark to its right, because the nadir is to the left.
    shadow_column = column + 6 + detection.shadow_samples // 2
    assert snippet.image[row - 2 : row + 3, column - 3 : column + 4].mean() > 180
    assert snippet.image[row - 2 : row + 3, shadow_column - 5 : shadow_column + 6].mean() < 60


@given(ping=st.integers(0, 199), sample=st.integers(0, 511), height=st.integers(1, 230), width=st.integers(1, 600))
def test_window_is_shifted_at_borders(found, ping, sample, height, width):
    survey, detection = found
    snippet = cut_snippet(survey, replace(detection, ping_index=ping, sample=sample), height, width)
    assert snippet.image.shape == (min(height, 200), min(width, 512))
    assert raw_window(survey, Side.STARBOARD, snippet).shape == snippet.image.shape
    assert 0 <= ping - snippet.first_ping_index < snippet.image.shape[0]
    assert 0 <= sample - snippet.first_sample < snippet.image.shape[1]


def test_missing_samples_are_black_and_do_not_change_contrast(found):
    survey, detection = found
    pings = list(survey.pings)
    cut = pings[90].channel(Side.STARBOARD)
    pings[90] = replace(pings[90], channels=())
    pings[91] = replace(pings[91], channels=(ChannelPing(Side.STARBOARD, cut.samples[:250], cut.slant_range_m),))
    complete = cut_snippet(survey, detection)
    with_gaps = cut_snippet(replace(survey, pings=tuple(pings)), detection)
    row = 90 - with_gaps.first_ping_index
    assert not with_gaps.image[row].any()
    assert not with_gaps.image[row + 1, 250 - with_gaps.first_sample :].any()
    untouched = np.r_[0:row, row + 2 : 100]
    assert np.abs(with_gaps.image[untouched].astype(int) - complete.image[untouched]).max() <= 4


def test_values_beyond_16_bits_are_divided_by_power_of_two(found, make_survey):
    _, detection = found
    survey = make_survey({"side": Side.STARBOARD}, sides=(Side.STARBOARD,), dtype=np.uint32, scale=10_000.0)
    snippet = cut_snippet(survey, detection)
    assert snippet.divisor16 > 1
    assert snippet.divisor16 & (snippet.divisor16 - 1) == 0
    assert snippet.image16.max() >= 32768
    pixel = survey.pings[snippet.first_ping_index].channel(Side.STARBOARD).samples[snippet.first_sample]
    assert snippet.image16[0, 0] == pixel // snippet.divisor16


def test_grey_levels_follow_documented_formula():
    raw = np.arange(10_000, dtype=np.uint32).reshape(100, 100) ** 2
    grey = to_grey(raw, np.ones(raw.shape, dtype=np.bool_))
    low, high = np.percentile(np.arange(10_000), (0.5, 99.5))
    expected = np.clip(np.rint(255 * (np.arange(10_000) - low) / (high - low)), 0, 255).reshape(100, 100)
    assert np.abs(grey - expected).max() <= 1
    assert (grey[0, 0], grey[-1, -1]) == (0, 255)
    # A single bright pixel does not change the contrast; a flat window is mid-grey and unknown is black.
    raw = np.random.default_rng(0).integers(100, 200, (100, 100), dtype=np.uint32)
    plain = to_grey(raw, np.ones(raw.shape, dtype=np.bool_))
    raw[50, 50] = 60_000
    assert abs(float(to_grey(raw, np.ones(raw.shape, dtype=np.bool_)).mean()) - float(plain.mean())) < 2
    flat = np.full((4, 5), 77, dtype=np.uint32)
    assert (to_grey(flat, np.ones(flat.shape, dtype=np.bool_)) == 128).all()
    assert not to_grey(flat, np.zeros(flat.shape, dtype=np.bool_)).any()


def test_detection_outside_survey_and_empty_window_are_rejected(found):
    survey, detection = found
    for change in ({"ping_index": 200}, {"ping_index": -1}, {"sample": 512}):
        for cut in (cut_snippet, cut_expanded):
            with pytest.raises(ValueError, match="expected inside 200 pings of 512 samples"):
                cut(survey, replace(detection, **change), 80, 100)
    for size in ((0, 10), (10, 0)):
        with pytest.raises(ValueError, match="expected 1 or more"):
            cut_snippet(*found, *size)


def block_means(image):
    """Return the means of blocks of 2 x 2 pixels."""
    return sum(image[row::2, column::2].astype(float) for row in (0, 1) for column in (0, 1)) / 4


def test_expanded_snippet_covers_twice_the_extent(found):
    survey, detection = found
    narrow = cut_snippet(survey, detection, 40, 60)
    expanded = cut_expanded(survey, detection, 40, 60)
    top, left = narrow.first_ping_index - 20, narrow.first_sample - 30
    values = block_means(survey.waterfall(Side.STARBOARD)[top : top + 80, left : left + 120])
    root = np.sqrt(values)
    low, high = np.percentile(root, (0.5, 99.5))
    assert expanded.shape == narrow.image.shape
    np.testing.assert_array_equal(expanded, np.clip(np.rint(255 * (root - low) / (high - low)), 0, 255))


@given(ping=st.integers(0, 199), sample=st.integers(0, 511), height=st.integers(1, 210), width=st.integers(1, 600))
def test_expanded_snippet_stays_within_recording(found, ping, sample, height, width):
    survey, detection = found
    expanded = cut_expanded(survey, replace(detection, ping_index=ping, sample=sample), height, width)
    if height >= 200 or width >= 512:
        assert expanded is None, "the recording does not extend beyond the snippet"
    else:
        assert expanded.shape == (min(height, 100), min(width, 256))


def test_missing_samples_do_not_darken_expanded_snippet(found):
    survey, detection = found
    pings = list(survey.pings)
    complete = cut_expanded(survey, detection, 40, 60)
    top = cut_snippet(survey, detection, 40, 60).first_ping_index - 20
    for row in (top + 10, top + 11, top + 20):
        pings[row] = replace(pings[row], channels=())
    with_gaps = cut_expanded(replace(survey, pings=tuple(pings)), detection, 40, 60)
    assert not with_gaps[5].any(), "both pings of the row are absent"
    # One of the two pings is present: the row has its mean.
    assert abs(float(with_gaps[10].mean()) - float(complete[10].mean())) < 15
    untouched = [row for row in range(40) if row not in (5, 10)]
    assert np.abs(with_gaps[untouched].astype(int) - complete[untouched]).max() <= 6


def test_ground_image_is_centred_at_its_scale(make_survey):
    survey = make_survey({"pings": 10, "samples": 25, "shadow_samples": 40}, sides=(Side.PORT,))
    (found,) = detect(survey)
    image = ground_projected_image(survey, found, 80, 80, 0.1)
    assert image.shape == (80, 80)
    assert image[38:42, 37:43].mean() > 180
    assert image[38:42, 50:56].mean() < 60
    # The object is 1.0 m long along-track: about ten rows of 0.1 m.
    bright = image[:, 37:43].mean(axis=1) > 150
    assert np.count_nonzero(bright) == pytest.approx(10, abs=3)


def test_ground_image_is_black_beyond_recording_and_absent_without_navigation(one_object):
    survey, found = one_object
    image = ground_projected_image(survey, replace(found, ping_index=8), 50, 50, 0.2)
    assert not image[:15].any()
    assert image[30:].any(axis=1).all()
    bare = tuple(replace(ping, lat_deg=None, lon_deg=None, speed_mps=None) for ping in survey.pings)
    unknown = replace(found, position=None, vehicle=None, heading_deg=None, pixel_along_m=None)
    assert ground_projected_image(replace(survey, pings=bare), unknown, 100, 100, 0.1) is None
