"""The structure model of emb: perceptual weights, similarity, and the quality of its images."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from research.common.emb_estimate import encode_with_estimate
from research.common.quality import ms_ssim, psnr_db
from sonarpost.codec.emb import perceptual_weights, transform
from sonarpost.codec.emb.codec import EmbCodec, structural_similarity
from sonarpost.codec.emb.coder import UNIT_SCALE, CoefficientState
from sonarpost.codec.emb.model import shipped_model
from sonarpost.codec.emb.side_info import RegionOfInterest
from sonarpost.codec.emb.transform import HEIGHT, LEVEL, LL, OFFSET, ORIENT, STRIDE, WIDTH, layout_of
from sonarpost.codec.registry import CodecResources, default_registry

STANDARD, STRUCTURE = EmbCodec(), EmbCodec("structure")
WEIGHTS = shipped_model("structure").perceptual
assert WEIGHTS is not None


def seabed(height_px: int = 80, width_px: int = 80, seed: int = 0) -> np.ndarray:
    """Return rippled seabed with speckle, a highlight and a shadow."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height_px, :width_px]
    ground = 70 + 18 * np.sin(x / 5 + y / 9 + seed) + 90 * ndimage.gaussian_filter(rng.normal(size=y.shape), 4)
    ground[height_px // 3 : height_px // 2, width_px // 4 : width_px // 3] += 90
    ground[height_px // 3 : height_px // 2, width_px // 3 : width_px // 2] *= 0.2
    return np.clip(ground * rng.rayleigh(0.8, y.shape) ** 0.5, 0, 255).astype(np.uint8)


def lows_of(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    layout = layout_of(*image.shape)
    flat = transform.to_flat(transform.forward(image.astype(np.int64) * transform.UNIT, layout), layout)
    return flat, transform.inverse(transform.from_flat(flat, layout), layout, 1)[1]


@pytest.mark.parametrize(("size", "level"), [((16, 16), 2), ((49, 113), 2), ((49, 113), 3), ((200, 161), 3)])
def test_local_variance_is_that_of_the_low_pass_image(size: tuple[int, int], level: int) -> None:
    layout = layout_of(*size)
    _, lows = lows_of(seabed(*size))
    at, (height, width) = int(layout.low_offsets[1]), (int(n) for n in layout.sides[1])
    grey = (lows[at : at + (height + 2) * (width + 2)].reshape(height + 2, width + 2)[1:-1, 1:-1] >> 4) / 8
    radius, rounds = ((1, 2), (2, 2))[level - 2]
    mean, square = grey, grey**2
    for _ in range(rounds):
        mean, square = (ndimage.uniform_filter(a, 2 * radius + 1, mode="nearest") for a in (mean, square))
    variance = perceptual_weights.local_variance(lows, layout, 1, level)
    assert np.abs(variance - (square - mean**2)).max() <= 1
    assert variance.min() >= 0


def test_scales_fall_with_the_contrast() -> None:
    rng = np.random.default_rng(4)
    image = np.full((80, 80), 100.0)
    image[:, 40:] += 50 * ndimage.gaussian_filter(rng.normal(size=(80, 40)), 2) / 0.14
    flat, _ = lows_of(np.clip(image, 0, 255))
    layout = layout_of(80, 80)
    scales = perceptual_weights.expected_scales(WEIGHTS, flat, layout)
    for band in layout.bands.tolist():
        at = band[OFFSET] + np.arange(band[HEIGHT])[:, None] * band[STRIDE] + np.arange(band[WIDTH])
        first = WEIGHTS.levels[0 if band[ORIENT] == LL else band[LEVEL]]
        if band[ORIENT] == LL or band[LEVEL] not in perceptual_weights.ADAPTIVE_LEVELS:
            assert (scales[at] == first).all()
        else:
            half = band[WIDTH] // 2
            assert scales[at][:, : half - 2].min() > first > scales[at][:, half + 2 :].mean()


def test_intervals_are_rescaled_with_their_coefficients() -> None:
    layout = layout_of(80, 80)
    flat, lows = lows_of(seabed())
    state = CoefficientState(layout)
    scaled = perceptual_weights.apply_initial_scales(WEIGHTS, state, flat)
    row = next(i for i, band in enumerate(layout.bands.tolist()) if band[LEVEL] == 2 and band[ORIENT] != LL)
    band = layout.bands[row]
    cell = int(band[OFFSET] + 3 * band[STRIDE] + 4)
    state.lower[cell], state.widths[cell] = 40_000, 20_000
    before = int(state.scale[cell])
    perceptual_weights.adapt_scales(WEIGHTS, state, row, lows, 1, flat, scaled)
    after = int(state.scale[cell])
    assert after != before
    assert state.lower[cell] == round(40_000 * after / before)
    assert state.widths[cell] == round(20_000 * after / before)
    assert not state.lower[:cell].any()
    expected = np.abs(flat.astype(np.int64)) * state.scale // UNIT_SCALE * np.sign(flat)
    assert np.array_equal(scaled, expected)


def test_similarity_ranks_images_like_ms_ssim() -> None:
    image = seabed().astype(np.int64)
    rng = np.random.default_rng(8)
    distorted = [ndimage.gaussian_filter(image.astype(float), sigma) for sigma in (0.7, 1.5, 3.0, 6.0)]
    distorted += [image + rng.normal(0, strength, image.shape) for strength in (5, 20, 60)]
    distorted = [np.clip(np.rint(s), 0, 255).astype(np.int64) for s in distorted]
    similarities = [structural_similarity(image, s) for s in distorted]
    reference = [ms_ssim(image.astype(np.uint8), s.astype(np.uint8)) for s in distorted]
    assert np.array_equal(np.argsort(similarities), np.argsort(reference))
    assert structural_similarity(image, image) == pytest.approx(2.0**28, rel=0.001)


@given(st.integers(0, 2**31), st.integers(16, 40), st.integers(16, 40), st.booleans())
def test_similarity_does_not_overflow(seed: int, height_px: int, width_px: int, is_inverse: bool) -> None:
    rng = np.random.default_rng(seed)
    cell = int(rng.integers(1, 9))
    image = 255 * rng.integers(0, 2, (height_px // cell + 1, width_px // cell + 1)).astype(np.int64)
    image = image.repeat(cell, 0).repeat(cell, 1)[:height_px, :width_px]
    other = 255 - image if is_inverse else image
    similarity = structural_similarity(image, other)
    assert similarity <= 2**28
    if not is_inverse:
        assert similarity >= 2**28 * 0.999


def test_structure_model_trades_squared_error_for_ms_ssim() -> None:
    images = [seabed(seed=seed) for seed in range(4)]
    standard, structure = ([c.decode(c.encode(p, 64)).image for p in images] for c in (STANDARD, STRUCTURE))
    similarity = [np.mean([ms_ssim(p, d) for p, d in zip(images, ds, strict=True)]) for ds in (standard, structure)]
    psnr = [np.mean([psnr_db(p, d) for p, d in zip(images, ds, strict=True)]) for ds in (standard, structure)]
    assert similarity[1] > similarity[0] + 0.01
    assert psnr[0] - 1.0 < psnr[1] < psnr[0]


def test_error_of_prefixes_falls_as_estimated() -> None:
    image = seabed()
    encoded = encode_with_estimate(STRUCTURE, image, 200)
    errors = []
    for n in (*range(6, 20, 2), *range(20, 201, 20)):
        decoded = STRUCTURE.decode(encoded.stream[:n]).image.astype(float)
        errors.append(((decoded - image) ** 2).mean())
        assert encoded.mean_square_error[n] > 0
    assert errors[-1] < 0.75 * errors[4]
    # The estimate is for the coefficients; the enhancer changes the image by some per cent.
    assert encoded.mean_square_error[200] == pytest.approx(errors[-1], rel=0.15)


@pytest.mark.parametrize("first", [22, 128])
def test_structure_streams_are_extended(first: int) -> None:
    for seed in range(2):
        image = seabed(seed=seed)
        stream = STRUCTURE.encode(image, first)
        longer = STRUCTURE.extend(stream, image, 2 * first)
        assert longer[: len(stream) - 1] == stream[:-1]
        assert len(longer) > len(stream)
        errors = [((STRUCTURE.decode(s).image.astype(float) - image) ** 2).mean() for s in (longer, stream)]
        assert errors[0] < errors[1]


def test_structure_model_supports_a_region_of_interest() -> None:
    image = seabed()
    region = RegionOfInterest(4, 3, 8, 8)
    rows, columns = slice(20, 45), slice(15, 45)
    errors = []
    for chosen in (None, region):
        decoded = STRUCTURE.decode(encode_with_estimate(STRUCTURE, image, 128, region=chosen).stream).image.astype(
            float
        )
        errors.append(((decoded - image)[rows, columns] ** 2).mean())
    assert errors[1] < errors[0]


def test_each_model_has_its_codec_ids() -> None:
    registry, image = default_registry(), seabed()
    each = (("standard", 0.0, 0x20), ("structure", 0.0, 0x21), ("standard", 0.5, 0x22), ("structure", 1.0, 0x23))
    for model, strength, codec_id in each:
        codec = registry.create("emb", CodecResources(model=model, strength=strength))
        assert (codec.name, codec.codec_id) == ("emb", codec_id)
        assert codec.model_hash == shipped_model(model, despeckled=strength > 0).identity
        stream = codec.encode(image, 64)
        assert stream[0] == codec_id
        reader = registry.create_for_stream(stream)
        assert (reader.name, reader.codec_id, reader.model_hash) == ("emb", codec_id, codec.model_hash)
        assert reader.decode(stream).despeckle_strength == strength
        assert np.array_equal(reader.decode(stream).image, codec.decode(stream).image)
