"""Detection in an image of known scale."""

from __future__ import annotations

import numpy as np
import pytest

from sonarpost.detection.images import ScaledImage, detect_in_image, normalise_window, seabed_window
from sonarpost.sonar.survey import Side


def seabed(seed=0, shape=(256, 256)):
    return np.random.default_rng(seed).rayleigh(60, shape)


def with_object(image, row=120, column=120):
    out = image.copy()
    out[row - 8 : row + 8, column - 8 : column + 8] *= 4.0
    out[row - 8 : row + 8, column + 8 : column + 48] *= 0.05
    return np.clip(out, 0, 255).astype(np.uint8)


def to_uint8(image):
    return np.clip(image, 0, 255).astype(np.uint8)


def test_object_in_image_has_higher_confidence_than_seabed():
    found = detect_in_image(ScaledImage(with_object(seabed()), 0.05, 0.05))
    assert found.confidence > 1.5
    assert (found.row, found.column) == (pytest.approx(120, abs=8), pytest.approx(120, abs=8))
    assert found.side is Side.STARBOARD
    for seed in range(3):
        bare = detect_in_image(ScaledImage(to_uint8(seabed(seed + 10)), 0.05, 0.05))
        assert bare is None or bare.confidence < 0.5 * found.confidence


def test_mirrored_image_gives_mirrored_detection():
    image = with_object(seabed())
    one = detect_in_image(ScaledImage(image, 0.05, 0.05))
    other = detect_in_image(ScaledImage(np.ascontiguousarray(image[:, ::-1]), 0.05, 0.05))
    assert other.side is Side.PORT
    assert other.confidence == pytest.approx(one.confidence)
    assert other.column == 255 - one.column
    assert detect_in_image(ScaledImage(image, 0.05, 0.05), side=Side.PORT).confidence < one.confidence


def confidence(image, pixel_m=0.05):
    found = detect_in_image(ScaledImage(np.ascontiguousarray(image), pixel_m, pixel_m))
    assert found.p_mine_like == pytest.approx(found.confidence / 2)
    return found.confidence


def pictures():
    """Return pictures with scores from low to high: objects of different contrast on different seabeds."""
    return [with_object(seabed(seed, (150, 170)) ** power, 70, 60) for seed, power in ((1, 1.0), (2, 0.9), (3, 1.1))]


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("value", [0, 90, 255])
@pytest.mark.parametrize("widths", [((0, 40), (0, 0)), ((13, 0), (7, 0)), ((5, 5), (0, 64))])
def test_padding_changes_place_but_not_score(number, value, widths):
    image = pictures()[number]
    one = detect_in_image(ScaledImage(image, 0.05, 0.05))
    other = detect_in_image(ScaledImage(np.pad(image, widths, constant_values=value), 0.05, 0.05))
    assert other.confidence == pytest.approx(one.confidence)
    assert (other.row, other.column) == (one.row + widths[0][0], one.column + widths[1][0])


def test_padding_with_traces_of_jpeg_is_cut_off():
    image = with_object(seabed())
    padded = np.pad(image, ((20, 0), (0, 30)))
    padded[:20] = np.random.default_rng(5).integers(0, 2, padded[:20].shape)
    window = seabed_window(ScaledImage(padded, 0.05, 0.05))
    assert (window.values.shape, window.top, window.left) == ((256, 256), 20, 0)


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("changed", [lambda i: (i * 0.5).astype(np.uint8), lambda i: i // 3])
def test_score_does_not_depend_on_gain(number, changed):
    image = pictures()[number]
    assert confidence(changed(image)) == pytest.approx(confidence(image), abs=0.1)


@pytest.mark.parametrize("number", range(3))
def test_score_does_not_depend_on_direction(number):
    image = pictures()[number]
    assert confidence(image[:, ::-1]) == pytest.approx(confidence(image))


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("factor", [1, 16, 257])
def test_score_does_not_depend_on_bit_depth(number, factor):
    image = pictures()[number]
    deep = image.astype(np.uint16) * np.uint16(factor)
    assert confidence(deep) == pytest.approx(confidence(image), rel=1e-4)


def test_glint_does_not_change_the_score():
    image = pictures()[0].astype(np.uint16) * np.uint16(16)
    glint = image.copy()
    glint[140, 160] = 65535
    assert confidence(glint) == pytest.approx(confidence(image), abs=0.02)


@pytest.mark.parametrize("pixel_m", [0.005, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("shape", [(32, 32), (32, 300), (300, 32), (33, 47)])
def test_picture_of_any_size_has_a_level_grid(shape, pixel_m):
    image = ScaledImage(to_uint8(seabed(4, shape)), pixel_m, pixel_m)
    for side in Side:
        assert min(normalise_window(seabed_window(image), side).level.shape) >= 16
    detect_in_image(image)


def test_water_is_unknown():
    image = with_object(seabed())
    image[:, 200:] //= 20
    grid = normalise_window(seabed_window(ScaledImage(image, 0.06, 0.06)), Side.STARBOARD)
    assert np.isnan(grid.level[20:230, 225:240]).all()
    assert np.isfinite(grid.level[20:230, 10:150]).all()


@pytest.mark.parametrize("value", [0, 7, 255])
def test_flat_or_tiny_image_has_no_detection(value):
    assert detect_in_image(ScaledImage(np.full((256, 256), value, np.uint8), 0.05, 0.05)) is None
    assert detect_in_image(ScaledImage(np.full((8, 8), value, np.uint8), 0.05, 0.05)) is None


@pytest.mark.parametrize(
    "arguments", [(np.zeros((4, 4, 3), np.uint8), 1.0, 1.0), (np.zeros((4, 4), np.uint8), 0.0, 1.0)]
)
def test_invalid_image_is_rejected(arguments):
    with pytest.raises(ValueError, match="expected"):
        ScaledImage(*arguments)
