from __future__ import annotations

import numpy as np
import pytest

from sonarpost.detection.detector import detect
from sonarpost.detection.image_detector import ScaledImage, detect_in_image, normalise_image
from sonarpost.detection.snippets import cut_ground_snippet
from sonarpost.sonar.survey import Side


def seabed(seed=0, shape=(256, 256)):
    return np.random.default_rng(seed).rayleigh(60, shape)


def with_object(picture, row=120, column=120):
    out = picture.copy()
    out[row - 8 : row + 8, column - 8 : column + 8] *= 4.0
    out[row - 8 : row + 8, column + 8 : column + 48] *= 0.05
    return np.clip(out, 0, 255).astype(np.uint8)


def plain(picture):
    return np.clip(picture, 0, 255).astype(np.uint8)


def test_an_object_in_a_piece_is_found_with_more_confidence_than_bare_seabed():
    found = detect_in_image(ScaledImage(with_object(seabed()), 0.05, 0.05))
    assert found.confidence > 1.5
    assert (found.row, found.column) == (pytest.approx(120, abs=8), pytest.approx(120, abs=8))
    assert found.side is Side.STARBOARD
    for seed in range(3):
        bare = detect_in_image(ScaledImage(plain(seabed(seed + 10)), 0.05, 0.05))
        assert bare is None or bare.confidence < 0.5 * found.confidence


def test_a_mirrored_piece_gives_the_mirrored_place():
    piece = with_object(seabed())
    one = detect_in_image(ScaledImage(piece, 0.05, 0.05))
    other = detect_in_image(ScaledImage(np.ascontiguousarray(piece[:, ::-1]), 0.05, 0.05))
    assert other.side is Side.PORT
    assert other.confidence == pytest.approx(one.confidence)
    assert other.column == 255 - one.column
    assert detect_in_image(ScaledImage(piece, 0.05, 0.05), side=Side.PORT).confidence < one.confidence


def test_padding_is_unknown_and_changes_little():
    picture = with_object(seabed())
    padded = picture.copy()
    padded[200:] = 0
    assert detect_in_image(ScaledImage(padded, 0.05, 0.05)).confidence > 1.5
    grid = normalise_image(ScaledImage(padded, 0.06, 0.06), Side.STARBOARD)
    assert np.isnan(grid.level[201:]).all()
    assert np.isfinite(grid.level[20:190, 10:240]).all()


@pytest.mark.parametrize("value", [0, 7, 255])
def test_a_piece_of_one_value_or_hardly_any_pixels_says_nothing(value):
    assert detect_in_image(ScaledImage(np.full((256, 256), value, np.uint8), 0.05, 0.05)) is None
    assert detect_in_image(ScaledImage(np.full((8, 8), value, np.uint8), 0.05, 0.05)) is None


@pytest.mark.parametrize(
    "arguments", [(np.zeros((4, 4, 3), np.uint8), 1.0, 1.0), (np.zeros((4, 4), np.uint8), 0.0, 1.0)]
)
def test_what_is_no_piece_is_refused(arguments):
    with pytest.raises(ValueError, match="expected"):
        ScaledImage(*arguments)


def test_the_ground_snippet_holds_the_contact_in_its_middle_at_its_scale(make_survey):
    survey = make_survey({"pings": 10, "samples": 25, "shadow_samples": 40})
    (found,) = detect(survey)
    cut = cut_ground_snippet(survey, found, size_m=8.0, pixel_m=0.1)
    assert cut.image.shape == cut.known.shape == (80, 80)
    assert cut.pixel_m == 0.1
    assert cut.known.all()
    assert cut.image[38:42, 37:43].mean() > 180
    assert cut.image[38:42, 50:56].mean() < 60
    # The object is 1.0 m long along-track: its rows are about ten pixels of 0.1 m.
    bright = cut.image[:, 37:43].mean(axis=1) > 150
    assert np.count_nonzero(bright) == pytest.approx(10, abs=3)


def test_a_ground_snippet_beyond_the_recording_is_unknown_there(make_survey):
    survey = make_survey({"ping": 8})
    (found,) = detect(survey)
    cut = cut_ground_snippet(survey, found, size_m=10.0, pixel_m=0.2)
    assert not cut.known[:15].any()
    assert (cut.image[~cut.known] == 0).all()
    assert cut.known[30:].all()


def test_without_altitude_or_travel_there_is_no_ground_snippet(make_survey):
    survey = make_survey({}, navigation=False)
    (found,) = detect(survey)
    assert cut_ground_snippet(survey, found) is None
    for size_m, pixel_m in ((0.0, 0.1), (10.0, 0.0), (1.0, 2.0), (1000.0, 0.01)):
        with pytest.raises(ValueError, match="size_m, pixel_m"):
            cut_ground_snippet(survey, found, size_m, pixel_m)
