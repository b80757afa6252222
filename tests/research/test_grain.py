"""Grain: texture levels in a stream, and the synthetic speckle of a decoded image."""

import numpy as np
import pytest
from builders.images import contact

from research.recognition.grain import GrainCodec, measure_speckle, synthesise_speckle
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.decode import read_body
from sonarpost.codec.emb.transform import layout_of
from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import StreamError

CODEC = GrainCodec()


def gravel(height_px: int = 80, width_px: int = 80, seed: int = 3) -> np.ndarray:
    """Return gravel with a highlight and a shadow."""
    rng = np.random.default_rng(seed)
    image = rng.integers(40, 110, (height_px, width_px)) + rng.integers(0, 60, (height_px, width_px))
    image[height_px // 3 : height_px // 2, width_px // 4 : width_px // 2] += 80
    image[height_px // 3 : height_px // 2, width_px // 2 : width_px * 3 // 4] //= 8
    return np.clip(image, 0, 255).astype(np.uint8)


def test_speckle_is_a_separate_layer() -> None:
    image = gravel()
    with_texture = GrainCodec()
    stream = with_texture.encode(image, 68)
    decoded = with_texture.decode(stream).image
    layer = CODEC.speckle_layer(stream)
    assert layer.shape == image.shape
    assert layer.dtype == np.int16
    assert np.array_equal(layer, with_texture.speckle_layer(stream))
    assert np.array_equal(with_texture.decode(stream).image, decoded)
    assert abs(float(layer.mean())) < 6
    with pytest.raises(StreamError, match="texture"):
        CODEC.speckle_layer(EmbCodec().encode(image, 68))


def test_speckle_restores_the_strength_of_the_texture() -> None:
    image = gravel()
    layout = layout_of(80, 80)
    levels = measure_speckle(image, layout)
    assert len(levels) == 8
    decoded = CODEC.decode(CODEC.encode(image, 64)).image
    textured = np.clip(decoded + synthesise_speckle(decoded, layout, levels), 0, 255).astype(np.uint8)
    assert abs(textured[60:].std() / image[60:].std() - 1) < 0.3
    assert decoded[60:].std() < 0.6 * image[60:].std()
    # Two levels are a factor of 2 in strength.
    softer = (image.astype(int) // 2 + int(image.mean()) // 2).astype(np.uint8)
    difference = np.array(levels[:4]) - measure_speckle(softer, layout)[:4]
    assert np.all((difference >= 1) & (difference <= 3))


def test_flat_image_has_no_speckle() -> None:
    layout = layout_of(64, 64)
    flat = np.full((64, 64), 90, np.uint8)
    assert measure_speckle(flat, layout) == (0,) * 8
    assert not synthesise_speckle(flat, layout, (0,) * 8).any()


def test_texture_is_measured_on_the_image_before_despeckling() -> None:
    noisy = contact(48, 64)
    codec = GrainCodec(strength=1.0)
    stream = codec.encode(noisy, 100)
    header = StreamHeader.unpack(stream)
    _, side = read_body(stream[header.size :], layout_of(48, 64), codec.network)
    assert side.texture == measure_speckle(noisy, layout_of(48, 64))


def test_the_structure_model_has_grain() -> None:
    codec = GrainCodec("structure")
    assert codec.speckle_layer(codec.encode(gravel(), 128)).any()
