"""The codec emb: prefixes, damage, models, transform."""

import hashlib
from importlib.resources import files

import numpy as np
import pytest
from builders.images import contact
from hypothesis import given
from hypothesis import strategies as st

from research.common.emb_estimate import decode_before_enhancer, encode_with_estimate
from research.common.quality import psnr_db
from sonarpost.codec.emb import MODEL_FILES, transform
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.decode import read_body
from sonarpost.codec.emb.model import parse, shipped_model
from sonarpost.codec.emb.transform import layout_of
from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import StreamError

CODEC = EmbCodec()


def test_longer_prefixes_are_not_much_worse() -> None:
    image = contact(40, 48)
    stream = CODEC.encode(image, 160)
    quality = []
    for length in range(StreamHeader.unpack(stream).size, len(stream) + 1, 2):
        decoded = CODEC.decode(stream[:length])
        if not decoded.missing.any():
            quality.append(psnr_db(image, decoded.image))
    assert len(quality) > 75
    assert quality[-1] > quality[0] + 3
    assert np.all(np.maximum.accumulate(quality) - quality < 0.35)


def test_budget_is_used_completely_and_quality_increases() -> None:
    image = contact()
    quality = []
    for budget in (6, 7, 22, 23, 64, 200, 704):
        stream = CODEC.encode(image, budget)
        assert len(stream) == budget
        if budget not in (7, 23):
            quality.append(psnr_db(image, CODEC.decode(stream).image))
    assert quality == sorted(quality)
    image = contact(32, 32)
    stream = CODEC.encode(image, 4000)
    assert len(stream) < 2000  # a long budget is not filled
    assert psnr_db(image, CODEC.decode(stream).image) > 34


def test_decisions_of_a_prefix_hold_for_every_continuation() -> None:
    stream = CODEC.encode(contact(32, 32), 120)
    for length in range(8, 60, 10):
        states = [_coefficients(stream[:length] + tail) for tail in (b"", bytes(40), b"\xff" * 40, stream[length:])]
        short = states[0]
        significant = short[0] > 0
        for lower, signs in states[1:]:
            assert np.all(lower[significant] >= short[0][significant])
            assert np.array_equal(signs[significant], short[1][significant])


def _coefficients(stream: bytes) -> tuple[np.ndarray, np.ndarray]:
    header = StreamHeader.unpack(stream)
    state, _ = read_body(stream[header.size :], layout_of(header.height_px, header.width_px), CODEC.network)
    return state.lower, state.signs


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_flat_images_need_few_bytes(grey: int) -> None:
    stream = CODEC.encode(np.full((48, 48), grey, np.uint8), 64)
    assert len(stream) < 40
    assert np.abs(CODEC.decode(stream).image.astype(int) - grey).max() <= 2


@pytest.mark.parametrize("size", [(80, 80), pytest.param((512, 512), marks=pytest.mark.system), (300, 40)])
def test_half_black_half_white_image(size: tuple[int, int]) -> None:
    """The largest possible coefficients need planes above the usual first one."""
    image = np.zeros(size, np.uint8)
    image[:, size[1] // 2 :] = 255
    assert psnr_db(image, CODEC.decode(CODEC.encode(image, 256)).image) > 26


@given(
    height_px=st.integers(16, 40),
    width_px=st.integers(16, 40),
    seed=st.integers(0, 1000),
    contrast=st.sampled_from([0, 1, 20, 255]),
    budget=st.integers(10, 90),
)
def test_error_of_any_image_is_bounded(height_px: int, width_px: int, seed: int, contrast: int, budget: int) -> None:
    rng = np.random.default_rng(seed)
    image = (rng.integers(0, contrast + 1, (height_px, width_px)) + rng.integers(0, 256 - contrast)).astype(np.uint8)
    stream = CODEC.encode(image, budget)
    assert len(stream) <= budget
    decoded = CODEC.decode(stream)
    assert not decoded.missing.any()
    error = decoded.image.astype(float) - image
    assert (error**2).mean() < 1.25 * image.astype(float).var() + 9


def test_error_estimate_of_each_prefix_is_accurate() -> None:
    image = contact()
    result = encode_with_estimate(CODEC, image, 200)
    assert result.mean_square_error.shape == (201,)
    assert np.isinf(result.mean_square_error[:4]).all()
    for length in (12, 30, 64, 120, 200):
        decoded = decode_before_enhancer(CODEC, result.stream[:length])
        error = decoded.plane / 64 + decoded.mean - image
        assert (error**2).mean() == pytest.approx(result.mean_square_error[length], rel=0.1)
    known = result.mean_square_error[6:]
    assert np.all(np.diff(known) < 0.01 * known[:-1])


def test_unknown_models_and_small_budgets_are_rejected_and_no_bytes_give_no_pixels() -> None:
    stream = bytearray(CODEC.encode(contact(), 40))
    with pytest.raises(StreamError, match="codec_id"):
        CODEC.decode(bytes([0x2F]) + bytes(stream[1:]))
    with pytest.raises(StreamError, match="does not have"):
        CODEC.decode(bytes([stream[0], stream[1] ^ 1]) + bytes(stream[2:]))
    for budget in (-1, 0, 3, 5):
        with pytest.raises(StreamError, match="budget_bytes"):
            CODEC.encode(contact(), budget)
    nothing = CODEC.decode(CODEC.encode(contact(), 100), np.zeros(97, np.bool_))
    assert nothing.missing.all()
    assert not nothing.image.any()


def test_invalid_model_files_are_rejected() -> None:
    for name, file in MODEL_FILES.items():
        raw = files("sonarpost.codec.emb").joinpath("data", file).read_bytes()
        assert parse(raw).identity == hashlib.sha256(raw).hexdigest() == shipped_model(name).identity
        with pytest.raises(StreamError, match="magic"):
            parse(b"x" + raw)
        with pytest.raises(StreamError, match="length"):
            parse(raw[:-1])
    assert CODEC.model_hash == shipped_model().identity


def test_accumulators_do_not_overflow() -> None:
    for model in map(shipped_model, MODEL_FILES):
        first = 290 * np.abs(model.w1.astype(np.int64)).sum(1) + np.abs(model.b1)
        second = 4095 * np.abs(model.w2.astype(np.int64)).sum(1) + np.abs(model.b2)
        sign = 96 * np.abs(model.sign_w1.astype(np.int64)).sum(1) + np.abs(model.sign_b1)
        assert max(first.max(), second.max(), sign.max()) < 2**31


@pytest.mark.parametrize("size", [(16, 16), (17, 33), (80, 80), (16, 512), (301, 127)])
def test_transform_is_invertible(size: tuple[int, int]) -> None:
    layout = layout_of(*size)
    plane = np.random.default_rng(1).integers(-8000, 8000, size)
    flat = transform.to_flat(transform.forward(plane, layout), layout)
    back, _ = transform.inverse(transform.from_flat(flat, layout), layout)
    assert np.abs(back - plane).max() <= 16  # 1/4 grey level


def test_cosine_matrix_matches_its_definition() -> None:
    for n in range(1, 11):
        k, i = np.mgrid[:n, :n]
        exact = np.cos(np.pi * (2 * i + 1) * k / (2 * n)) * np.sqrt(np.where(k == 0, 1, 2) / n)
        assert np.array_equal(transform.cosine_matrix(n), np.rint(exact * 2**14))
