"""`emb-structure`: what scales its coefficients, what it is chosen by, and what comes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from research.common.quality import ms_ssim
from sonarpost.codec.emb import perceptual_weights as aim
from sonarpost.codec.emb import transform
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.coder import PLAIN_SCALE, State
from sonarpost.codec.emb.layout import HEIGHT, LEVEL, LL, OFFSET, ORIENT, STRIDE, WIDTH, layout
from sonarpost.codec.emb.model import all_structure
from sonarpost.codec.emb.side_info import Box
from sonarpost.codec.emb.similarity import structural_similarity
from sonarpost.codec.quality import psnr_db
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.errors import StreamError

PLAIN, STRUCTURE = EmbCodec(), EmbCodec(all_structure()[0])
AIM = all_structure()[0].aim
assert AIM is not None
SIZES = [(16, 16), (49, 113), (80, 80), (200, 161)]


def seabed(height_px: int = 80, width_px: int = 80, seed: int = 0) -> np.ndarray:
    """Rippled and blotched ground with speckle, a highlight and a shadow."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height_px, :width_px]
    ground = 70 + 18 * np.sin(x / 5 + y / 9 + seed) + 90 * ndimage.gaussian_filter(rng.normal(size=y.shape), 4)
    ground[height_px // 3 : height_px // 2, width_px // 4 : width_px // 3] += 90
    ground[height_px // 3 : height_px // 2, width_px // 3 : width_px // 2] *= 0.2
    return np.clip(ground * rng.rayleigh(0.8, y.shape) ** 0.5, 0, 255).astype(np.uint8)


def lows_of(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    lay = layout(*picture.shape)
    flat = transform.to_flat(transform.forward(picture.astype(np.int64) * transform.UNIT, lay), lay)
    return flat, transform.inverse(transform.from_flat(flat, lay), lay, 1)[1]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("level", [2, 3])
def test_the_variance_is_that_of_the_low_pass_picture(size: tuple[int, int], level: int) -> None:
    lay = layout(*size)
    _, lows = lows_of(seabed(*size))
    at, (height, width) = int(lay.low_offsets[1]), (int(n) for n in lay.sides[1])
    grey = (lows[at : at + (height + 2) * (width + 2)].reshape(height + 2, width + 2)[1:-1, 1:-1] >> 4) / 8
    radius, rounds = ((1, 2), (2, 2))[level - 2]
    mean, square = grey, grey**2
    for _ in range(rounds):
        mean, square = (ndimage.uniform_filter(a, 2 * radius + 1, mode="nearest") for a in (mean, square))
    found = aim._variance(lows, lay, 1, level)
    assert np.abs(found - (square - mean**2)).max() <= 1
    assert found.min() >= 0


def test_busy_ground_is_scaled_down_and_still_ground_up() -> None:
    rng = np.random.default_rng(4)
    picture = np.full((80, 80), 100.0)
    picture[:, 40:] += 50 * ndimage.gaussian_filter(rng.normal(size=(80, 40)), 2) / 0.14
    flat, _ = lows_of(np.clip(picture, 0, 255))
    lay = layout(80, 80)
    scales = aim.expected(AIM, flat, lay)
    for band in lay.bands.tolist():
        at = band[OFFSET] + np.arange(band[HEIGHT])[:, None] * band[STRIDE] + np.arange(band[WIDTH])
        first = AIM.levels[0 if band[ORIENT] == LL else band[LEVEL]]
        if band[ORIENT] == LL or band[LEVEL] not in aim.FOLLOWING:
            assert (scales[at] == first).all()
        else:
            half = band[WIDTH] // 2
            assert scales[at][:, : half - 2].min() > first > scales[at][:, half + 2 :].mean()


def test_what_is_known_is_scaled_with_its_coefficient() -> None:
    lay = layout(80, 80)
    flat, lows = lows_of(seabed())
    state = State(lay)
    scaled = aim.begin(AIM, state, flat)
    row = next(i for i, band in enumerate(lay.bands.tolist()) if band[LEVEL] == 2 and band[ORIENT] != LL)
    band = lay.bands[row]
    cell = int(band[OFFSET] + 3 * band[STRIDE] + 4)
    state.values[cell], state.widths[cell] = 40_000, 20_000
    before = int(state.scale[cell])
    aim.follow(AIM, state, row, lows, 1, flat, scaled)
    after = int(state.scale[cell])
    assert after != before
    assert state.values[cell] == round(40_000 * after / before)
    assert state.widths[cell] == round(20_000 * after / before)
    assert not state.values[:cell].any()
    expected = np.abs(flat.astype(np.int64)) * state.scale // PLAIN_SCALE * np.sign(flat)
    assert np.array_equal(scaled, expected)


def test_likeness_orders_pictures_as_ms_ssim_does() -> None:
    picture = seabed().astype(np.int64)
    rng = np.random.default_rng(8)
    shown = [ndimage.gaussian_filter(picture.astype(float), sigma) for sigma in (0.7, 1.5, 3.0, 6.0)]
    shown += [picture + rng.normal(0, strength, picture.shape) for strength in (5, 20, 60)]
    shown = [np.clip(np.rint(s), 0, 255).astype(np.int64) for s in shown]
    ours = [structural_similarity(picture, s) for s in shown]
    theirs = [ms_ssim(picture.astype(np.uint8), s.astype(np.uint8)) for s in shown]
    assert np.array_equal(np.argsort(ours), np.argsort(theirs))
    assert structural_similarity(picture, picture) == pytest.approx(2.0**28, rel=0.001)


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(16, 40), st.integers(16, 40), st.booleans())
def test_likeness_does_not_overflow(seed: int, height_px: int, width_px: int, is_inverse: bool) -> None:
    rng = np.random.default_rng(seed)
    cell = int(rng.integers(1, 9))
    picture = 255 * rng.integers(0, 2, (height_px // cell + 1, width_px // cell + 1)).astype(np.int64)
    picture = picture.repeat(cell, 0).repeat(cell, 1)[:height_px, :width_px]
    other = 255 - picture if is_inverse else picture
    found = structural_similarity(picture, other)
    assert found <= 2**28
    if not is_inverse:
        assert found >= 2**28 * 0.999


@pytest.mark.parametrize("budget", [64, 128])
def test_more_structure_for_more_error(budget: int) -> None:
    """The trade that it is made for: more likeness than `emb`, whose squared error is the less."""
    pictures = [seabed(seed=seed) for seed in range(6)]
    plain, made = ([c.decode(c.encode(p, budget)).image for p in pictures] for c in (PLAIN, STRUCTURE))
    like = [np.mean([ms_ssim(p, d) for p, d in zip(pictures, ds, strict=True)]) for ds in (plain, made)]
    near = [np.mean([psnr_db(p, d) for p, d in zip(pictures, ds, strict=True)]) for ds in (plain, made)]
    assert like[1] > like[0] + 0.01
    assert near[0] - 1.0 < near[1] < near[0]


def test_every_prefix_decodes_and_the_estimate_falls() -> None:
    picture = seabed()
    made = STRUCTURE.encode_with_estimate(picture, 200)
    errors = []
    for n in range(6, 201, 2):
        shown = STRUCTURE.decode(made.stream[:n]).image.astype(float)
        errors.append(((shown - picture) ** 2).mean())
        assert made.mean_square_error[n] > 0
    assert errors[-1] < 0.75 * errors[4]
    # The estimate is of the coefficients; the enhancer, which aims at likeness, changes the picture by some per cent.
    assert made.mean_square_error[200] == pytest.approx(errors[-1], rel=0.15)


@pytest.mark.parametrize("first", [22, 64, 128])
def test_streams_go_on(first: int) -> None:
    went = 0
    for seed in range(6):
        picture = seabed(seed=seed)
        stream = STRUCTURE.encode(picture, first)
        longer = STRUCTURE.extend(stream, picture, 2 * first)
        assert longer[: len(stream) - 1] == stream[:-1]
        if len(longer) > len(stream):
            went += 1
            nearer = [((STRUCTURE.decode(s).image.astype(float) - picture) ** 2).mean() for s in (longer, stream)]
            assert nearer[0] < nearer[1]
    assert went == 6


def test_a_box_is_seen_more_sharply_and_grain_is_a_layer() -> None:
    picture = seabed()
    box = Box(4, 3, 8, 8)
    rows, columns = slice(20, 45), slice(15, 45)
    errors = []
    for chosen in (None, box):
        shown = STRUCTURE.decode(STRUCTURE.encode_with_estimate(picture, 128, box=chosen).stream).image.astype(float)
        errors.append(((shown - picture)[rows, columns] ** 2).mean())
    assert errors[1] < errors[0]
    stream = replace(STRUCTURE, grain=True).encode(picture, 128)
    assert STRUCTURE.decode_grain(stream).any()


def test_each_decodes_its_own() -> None:
    registry, picture = default_registry(), seabed()
    for name, codec_id in (("emb", 0x20), ("emb-structure", 0x21)):
        codec = registry.create(name, CodecResources())
        assert (codec.name, codec.codec_id) == (name, codec_id)
        stream = codec.encode(picture, 64)
        assert stream[0] == codec_id
        reader = registry.create_for_stream(stream, CodecResources())
        assert reader.name == name
        assert np.array_equal(reader.decode(stream).image, codec.decode(stream).image)
    with pytest.raises(StreamError, match=r"codec_id: 0x21, expected 0x20 \(emb\)|0x21"):
        PLAIN.decode(STRUCTURE.encode(picture, 64))
    stream = STRUCTURE.encode(picture, 64)
    with pytest.raises(StreamError, match="model_tag"):
        STRUCTURE.decode(stream[:1] + bytes([stream[1] ^ 1]) + stream[2:])
