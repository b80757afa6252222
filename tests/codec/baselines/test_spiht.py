"""SPIHT: the transform, the trees, the embedded stream, the paper's maxloop, damage, speed and quality."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import picture, sdvd_crops
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.codec.baselines import spiht
from sonarpost.codec.baselines.spiht import NATURAL_MAXLOOP, SpihtCodec
from sonarpost.codec.baselines.spiht_passes import MAX_PLANES, UNIT, DecoderTests, EncoderTests, run_passes
from sonarpost.codec.baselines.spiht_wavelet import FRACTION_BITS, forest_of, inverse, transform
from sonarpost.codec.interface import StreamHeader
from sonarpost.codec.quality import psnr_db
from sonarpost.errors import ConfigError, StreamError

GOLDEN = GOLDEN_FOLDER / "spiht"
SIZES = st.tuples(st.integers(16, 70), st.integers(16, 70))


@pytest.mark.parametrize("name", ["80x80-64", "49x113-343", "17x31-40", "17x31-None", "16x200-22"])
def test_golden_streams_are_written_and_read_for_ever(name: str) -> None:
    size, budget = name.split("-")
    height_px, width_px = map(int, size.split("x"))
    golden = bytes.fromhex((GOLDEN / f"{name}.hex").read_text())
    codec = SpihtCodec()
    stream = codec.encode(picture(height_px, width_px), None if budget == "None" else int(budget))
    assert stream.hex() == golden.hex()
    decoded = codec.decode(golden)
    assert decoded.image.tobytes().hex() == (GOLDEN / f"{name}-picture.hex").read_text().strip()
    assert not decoded.missing.any()


@given(size=SIZES, seed=st.integers(0, 999), mean=st.integers(100, 150))
@settings(max_examples=40, deadline=None)
def test_the_transform_of_any_size_is_undone_and_nearly_keeps_energy(
    size: tuple[int, int], seed: int, mean: int
) -> None:
    image = np.random.default_rng(seed).integers(0, 256, size, dtype=np.uint8)
    forest = forest_of(*size)
    flat = transform(image, mean, forest)
    assert flat.shape == (image.size,)
    assert np.array_equal(inverse(flat, mean, forest), image)
    energy = ((image.astype(float) - mean) ** 2).sum()
    assert 0.7 < ((flat / 2**FRACTION_BITS) ** 2).sum() / energy < 1.5


def test_a_smooth_slope_lies_in_the_coarse_coefficients() -> None:
    rows, columns = np.mgrid[:64, :64]
    forest = forest_of(64, 64)
    flat = np.abs(transform((rows + 2 * columns + 20).astype(np.uint8), 100, forest))
    fine = sum(h * w for _, h, w in forest.bands[-6:])  # the two finest levels, 94 % of all coefficients
    assert flat[-fine:].max() < flat.max() / 100


@given(size=SIZES)
@settings(max_examples=30, deadline=None)
def test_every_coefficient_hangs_in_one_tree(size: tuple[int, int]) -> None:
    forest = forest_of(*size)
    assert forest.size == size[0] * size[1]
    seen = [child for children in forest.children for child in children]
    assert sorted(seen) == list(range(forest.roots, forest.size))
    for node, children in enumerate(forest.children):
        assert all(forest.parents[child] == node and child > node for child in children)
        assert len(children) <= 9
    assert (forest.parents[: forest.roots] == -1).all()


def test_children_lie_where_their_parent_does() -> None:
    forest = forest_of(80, 80)
    band = {}
    for number, (start, h, w) in enumerate(forest.bands):
        for i in range(h * w):
            band[start + i] = (number, i // w / h, i % w / w)
    for node in range(forest.roots, forest.size):
        for child in forest.children[node]:
            assert band[child][0] == band[node][0] + 3  # the same orientation, one level finer
            assert abs(band[child][1] - band[node][1]) <= 0.5
            assert abs(band[child][2] - band[node][2]) <= 0.5


@given(size=SIZES, seed=st.integers(0, 999), phase=st.integers(0, 3), loops=st.integers(1, 14))
@settings(max_examples=30, deadline=None)
def test_after_a_plane_no_coefficient_is_further_off_than_its_step(
    size: tuple[int, int], seed: int, phase: int, loops: int
) -> None:
    image = (np.random.default_rng(seed).rayleigh(40, size)).clip(0, 255).astype(np.uint8)
    forest = forest_of(*size)
    flat = transform(image, 100, forest)
    picture_ = EncoderTests(flat, phase, forest, None)
    planes = range(picture_.planes - 1, max(picture_.planes - 1 - loops, -1), -1)
    run_passes(forest, planes, picture_.tests())
    stream = DecoderTests(bytes(picture_.bits), forest)
    run_passes(forest, planes, stream.tests())
    step = (4 + phase) * UNIT << planes[-1]
    rebuilt = stream.coefficients(phase)
    assert (np.abs(rebuilt - flat) <= step).all()
    assert ((rebuilt == 0) == (np.abs(flat) < step)).all()
    assert (np.sign(rebuilt[rebuilt != 0]) == np.sign(flat[rebuilt != 0])).all()


def test_the_stream_is_embedded_to_the_byte() -> None:
    image = picture(80, 80)
    forest = forest_of(80, 80)
    flat = transform(image, 100, forest)
    whole = spiht._write_body(flat, 12, 1, forest, MAX_PLANES, None)
    for length in (2, 3, 10, 57, 200, 1000):
        assert spiht._write_body(flat, 12, 1, forest, MAX_PLANES, length) == whole[:length]


def test_more_of_the_stream_is_a_better_picture() -> None:
    codec, image = SpihtCodec(), picture(80, 80)
    stream = codec.encode(image, 3000)
    quality = [psnr_db(image, codec.decode(stream[:length]).image) for length in (4, 12, 30, 80, 200, 600, 1500, 3000)]
    assert quality == sorted(quality)
    assert quality[-1] > 35
    assert quality[-1] - quality[0] > 15


def test_every_byte_of_the_budget_is_used_until_the_picture_is_exact_to_a_grey_level() -> None:
    codec, image = SpihtCodec(), picture(40, 56)
    assert [len(codec.encode(image, budget)) for budget in range(7, 90)] == list(range(7, 90))
    exact = codec.encode(image, 100_000)
    assert len(exact) < 3000
    assert np.abs(codec.decode(exact).image.astype(int) - image).max() <= 1


def test_the_phase_with_the_smallest_error_is_taken() -> None:
    image, forest = picture(80, 80), forest_of(80, 80)
    codec = SpihtCodec()
    stream = codec.encode(image, 66)
    flat = transform(image, 8 * (stream[2] >> 3) + 4, forest)
    bodies = [spiht._write_body(flat, stream[2] >> 3, phase, forest, MAX_PLANES, 64) for phase in range(4)]
    errors = [-psnr_db(image, spiht._read_body(body, forest)) for body in bodies]
    assert stream[2:] == bodies[int(np.argmin(errors))]
    assert max(errors) > min(errors)


def test_maxloop_is_the_number_of_passes() -> None:
    image = picture(49, 113)
    lengths = {loops: len(SpihtCodec(loops).encode(image)) for loops in range(1, 12)}
    assert list(lengths.values()) == sorted(lengths.values())
    # The paper's Fig. 2 at this size: 343 B with 6 passes, 1110 B with 7. Ours depend on the texture alike.
    assert 1.5 < lengths[7] / lengths[6] < 6
    assert lengths[NATURAL_MAXLOOP] == len(SpihtCodec().encode(image))
    assert len(SpihtCodec(3).encode(image, 5000)) <= lengths[3] + 200  # binds with a budget too
    assert len(SpihtCodec(11).encode(image, 300)) == 300


@pytest.mark.parametrize("maxloop", [0, -1, MAX_PLANES + 1])
def test_a_maxloop_out_of_bounds_is_refused(maxloop: int) -> None:
    with pytest.raises(ConfigError, match="maxloop"):
        SpihtCodec(maxloop)


@pytest.mark.parametrize("grey", [0, 1, 100, 103, 255])
def test_a_flat_picture_takes_a_few_bytes(grey: int) -> None:
    codec = SpihtCodec()
    stream = codec.encode(np.full((80, 80), grey, np.uint8), 64)
    assert np.abs(codec.decode(stream).image.astype(int) - grey).max() <= 1


def test_the_largest_coefficients_there_can_be_are_counted() -> None:
    rows, columns = np.indices((512, 512))
    for image in (rows < 256, columns < 256, (rows < 256) ^ (columns < 256)):
        black_and_white = (image * 255).astype(np.uint8)
        decoded = SpihtCodec().decode(SpihtCodec().encode(black_and_white, 1000))
        assert psnr_db(black_and_white, decoded.image) > 25


def test_a_gap_ends_what_is_used() -> None:
    codec = SpihtCodec()
    stream = codec.encode(picture(80, 80), 200)
    received = np.ones(198, np.bool_)
    received[50] = False
    body = bytearray(stream[2:])
    body[50] = 0
    decoded = codec.decode(stream[:2] + bytes(body), received)
    assert np.array_equal(decoded.image, codec.decode(stream[:52]).image)
    assert not decoded.missing.any()
    assert decoded.notes == ("body byte 50 of 198 did not arrive; what follows it is not used",)


@pytest.mark.parametrize("length", [2, 3])
def test_less_than_the_leading_bits_is_nothing(length: int) -> None:
    codec = SpihtCodec()
    decoded = codec.decode(codec.encode(picture(80, 80), 64)[:length])
    assert decoded.missing.all()
    assert not decoded.image.any()
    assert "at least 2" in decoded.notes[0]


def test_a_budget_below_the_leading_bits_is_refused() -> None:
    for size in ((80, 80), (81, 80)):
        least = StreamHeader(0x04, 0, *size).size + 2
        assert len(SpihtCodec().encode(picture(*size), least)) == least
        with pytest.raises(StreamError, match=f"at least {least} B"):
            SpihtCodec().encode(picture(*size), least - 1)


@pytest.mark.parametrize("top", range(MAX_PLANES, 32))
def test_a_plane_that_cannot_be_is_refused(top: int) -> None:
    header = StreamHeader(0x04, 0, 80, 80).pack()
    with pytest.raises(StreamError, match="highest plane"):
        SpihtCodec().decode(header + bytes([top >> 4, (top & 15) << 4, 0, 0]))


@given(body=st.binary(min_size=2, max_size=400), size=SIZES)
@settings(max_examples=60, deadline=None)
def test_any_body_is_a_picture_or_refused(body: bytes, size: tuple[int, int]) -> None:
    try:
        decoded = SpihtCodec().decode(StreamHeader(0x04, 0, *size).pack() + body)
    except StreamError:
        assert (body[0] & 1) << 4 | body[1] >> 4 >= MAX_PLANES
        return
    assert decoded.image.shape == size
    assert not decoded.missing.any()


def test_a_snippet_is_encoded_within_200_ms() -> None:
    codec, image = SpihtCodec(), picture(140, 80)
    for budget in (None, 512):
        codec.encode(image, budget)
        seconds = []
        for _ in range(5):
            start = time.perf_counter()
            codec.encode(image, budget)
            seconds.append(time.perf_counter() - start)
        # About 10 ms; the best of five, since other work may share the processor.
        assert min(seconds) < 0.2


@pytest.mark.realdata
@pytest.mark.parametrize(("budget", "least_db"), [(22, 20.27), (64, 21.23), (256, 23.10)])
def test_real_snippets_keep_their_quality(data_dir: Path, budget: int, least_db: float) -> None:
    crops = sdvd_crops(data_dir)
    assert len(crops) == 69
    quality = [psnr_db(crop, SpihtCodec().decode(SpihtCodec().encode(crop, budget)).image) for crop in crops]
    # What was measured, less 0.05 dB for another build of the libraries.
    assert np.mean(quality) > least_db
