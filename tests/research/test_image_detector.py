"""Detection in an image of known scale."""

from __future__ import annotations

import numpy as np
import pytest

from research.detection.image_detector import ScaledImage, detect_in_image, normalise_image
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


def test_padding_is_unknown():
    image = with_object(seabed())
    padded = image.copy()
    padded[200:] = 0
    assert detect_in_image(ScaledImage(padded, 0.05, 0.05)).confidence > 1.5
    grid = normalise_image(ScaledImage(padded, 0.06, 0.06), Side.STARBOARD)
    assert np.isnan(grid.level[201:]).all()
    assert np.isfinite(grid.level[20:190, 10:240]).all()


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
