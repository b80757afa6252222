"""Detection in an image of known scale."""

import numpy as np
import pytest

from sonarpost.detection.images import ScaledImage, detect_in_image, normalise_window, seabed_window
from sonarpost.sonar.survey import Side

pytestmark = pytest.mark.usefixtures("few_candidates")


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
    for seed in range(1):
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


def images():
    """Return images with scores from low to high: objects of different contrast on different seabeds."""
    return [with_object(seabed(seed, (150, 170)) ** power, 70, 60) for seed, power in ((1, 1.0), (2, 0.9), (3, 1.1))]


@pytest.fixture(scope="module", params=range(3))
def scored(request):
    """An image and its detection."""
    image = images()[request.param]
    return image, detect_in_image(ScaledImage(image, 0.05, 0.05))


@pytest.mark.parametrize(
    ("value", "widths"), [(0, ((0, 40), (0, 0))), (90, ((13, 0), (7, 0))), (255, ((5, 5), (0, 64)))]
)
def test_padding_changes_place_but_not_score(scored, value, widths):
    image, one = scored
    other = detect_in_image(ScaledImage(np.pad(image, widths, constant_values=value), 0.05, 0.05))
    assert other.confidence == pytest.approx(one.confidence)
    assert (other.row, other.column) == (one.row + widths[0][0], one.column + widths[1][0])


def test_padding_with_traces_of_jpeg_is_cut_off():
    image = with_object(seabed())
    padded = np.pad(image, ((20, 0), (0, 30)))
    padded[:20] = np.random.default_rng(5).integers(0, 2, padded[:20].shape)
    window = seabed_window(ScaledImage(padded, 0.05, 0.05))
    assert (window.values.shape, window.top, window.left) == ((256, 256), 20, 0)


def test_score_depends_neither_on_gain_direction_nor_bit_depth(scored):
    image, one = scored
    assert confidence((image * 0.5).astype(np.uint8)) == pytest.approx(one.confidence, abs=0.1)
    assert confidence(image // 3) == pytest.approx(one.confidence, abs=0.1)
    assert confidence(image[:, ::-1]) == pytest.approx(one.confidence)
    for factor in (16, 257):
        deep = image.astype(np.uint16) * np.uint16(factor)
        assert confidence(deep) == pytest.approx(one.confidence, rel=1e-4)
    glint = image.astype(np.uint16) * np.uint16(16)
    glint[140, 160] = 65535
    assert confidence(glint) == pytest.approx(one.confidence, abs=0.02)


@pytest.mark.parametrize(
    ("shape", "pixel_m"), [((32, 32), 0.005), ((32, 32), 1.0), ((32, 200), 0.05), ((200, 32), 0.1), ((33, 47), 0.5)]
)
def test_image_of_any_size_has_a_level_grid(shape, pixel_m):
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


def test_flat_or_tiny_image_has_no_detection_and_an_invalid_one_is_rejected():
    for value, side_px in ((0, 256), (7, 256), (255, 256), (0, 8), (255, 8)):
        assert detect_in_image(ScaledImage(np.full((side_px, side_px), value, np.uint8), 0.05, 0.05)) is None
    for arguments in ((np.zeros((4, 4, 3), np.uint8), 1.0, 1.0), (np.zeros((4, 4), np.uint8), 0.0, 1.0)):
        with pytest.raises(ValueError, match="expected"):
            ScaledImage(*arguments)
