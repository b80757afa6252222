"""Despeckling: the estimate, its strength in the stream, and the same result on all machines."""

import hashlib

import numpy as np
import pytest

from research.common.quality import psnr_db
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.despeckle import ACTIVATION_LIMIT, INPUT_LIMIT, check_strength, despeckled, network
from sonarpost.errors import ConfigError


def scene(height_px: int = 80, width_px: int = 140) -> np.ndarray:
    """Return a slope with a highlight and its shadow, without speckle, float64."""
    image = np.broadcast_to(70 + 40 * np.linspace(0, 1, width_px), (height_px, width_px)).copy()
    image[height_px // 3 : height_px // 2, width_px // 4 : width_px // 3] = 230
    image[height_px // 3 : height_px // 2, width_px // 3 : width_px // 2] = 12
    return image


def grey(image: np.ndarray) -> np.ndarray:
    """Return the image rounded to uint8."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def speckled(image: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return the scene with multiplicative noise of two looks in intensity, uint8."""
    noise = np.sqrt(np.random.default_rng(seed).gamma(2, 1 / 2, image.shape))
    return grey(image * noise)


@pytest.fixture(scope="module")
def noisy() -> np.ndarray:
    return speckled(scene())


@pytest.fixture(scope="module")
def estimate(noisy: np.ndarray) -> np.ndarray:
    return despeckled(noisy)


def test_the_estimate_is_nearer_to_the_scene_and_the_same_on_every_machine(noisy, estimate) -> None:
    assert psnr_db(grey(scene()), estimate) > psnr_db(grey(scene()), noisy) + 6
    assert estimate[30:36, 37:44].mean() > 180  # the highlight
    assert estimate[30:36, 50:66].mean() < 40  # the shadow
    digest = hashlib.sha256(estimate.tobytes()).hexdigest()
    assert digest == "942339c03a955cd07d0d43b0fcba33f2b67c28d9037aae6e105e36687aa0913c"


def test_strength_0_returns_the_image_and_a_half_lies_between(noisy, estimate) -> None:
    assert despeckled(noisy, 0.0) is noisy
    whole, half = estimate.astype(int), despeckled(noisy, 0.5).astype(int)
    inside = (whole > 0) & (whole < 255)
    assert np.abs(half - (noisy.astype(int) + whole) / 2)[inside].max() <= 1


def test_constant_images_stay_almost_constant() -> None:
    for grey in (0, 128, 255):
        estimate = despeckled(np.full((40, 48), grey, np.uint8)).astype(int)
        assert np.abs(estimate - grey).max() <= 12


def test_sums_of_products_cannot_overflow() -> None:
    for number, layer in enumerate(network()):
        largest = np.abs(layer.weights.astype(np.int64)).sum((0, 1, 2)).max()
        assert largest * (ACTIVATION_LIMIT if number else INPUT_LIMIT) < 2**31


def test_strengths_are_rounded_to_sixteenths_and_others_rejected() -> None:
    for strength, rounded in ((0, 0), (1e-9, 1 / 16), (0.3, 5 / 16), (0.5, 0.5), (1, 1)):
        assert check_strength(strength) == EmbCodec(strength=strength).strength == rounded
    for strength in (-0.1, 1.01, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match=r"codec emb: strength: got .*, expected 0\.\.1"):
            EmbCodec(strength=strength)


@pytest.mark.parametrize(
    ("model", "strength"), [("standard", 0.0), ("standard", 0.25), ("structure", 0.25), ("structure", 1.0)]
)
def test_the_stream_carries_the_strength(model: str, strength: float) -> None:
    codec = EmbCodec(model, strength)
    stream = codec.encode(speckled(scene(32, 48)), 64)
    for reader in (EmbCodec(), EmbCodec("structure", 1.0)):
        assert reader.decode(stream).despeckle_strength == strength
    assert codec.decode(stream[:3]).despeckle_strength is None


def test_a_longer_stream_continues_with_the_strength_of_the_stream() -> None:
    noisy = speckled(scene(48, 64))
    stream = EmbCodec(strength=1.0).encode(noisy, 64)
    longer = EmbCodec(strength=0.0).extend(stream, noisy, 200)
    assert len(longer) > 150
    assert longer.startswith(stream[:-1])
    decoded = EmbCodec().decode(longer)
    assert decoded.despeckle_strength == 1.0
    assert psnr_db(despeckled(noisy), decoded.image) > psnr_db(noisy, decoded.image) + 3
