"""Region of interest, areas without data, grain, and the golden streams of the embedded codec."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.coder import Coder
from sonarpost.codec.emb.layout import layout
from sonarpost.codec.emb.model import Model, all_structure, shipped
from sonarpost.codec.emb.region import INSIDE, OUTSIDE, fill_unknown, weights
from sonarpost.codec.emb.side_info import Box, SideInfo, read_side, write_side
from sonarpost.codec.emb.speckle_synthesis import measure_speckle, synthesise_speckle
from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import StreamError

GOLDEN = GOLDEN_FOLDER / "emb"
PLAIN, FITTED, SECOND, STRUCTURE = (
    GOLDEN / name for name in ("streams.json", "streams_fitted.json", "streams_second.json", "streams_structure.json")
)
"""Of the encoder that told the plain coefficients, of that which fits them to the picture, and of the second model."""
CODEC = EmbCodec()


def speckled(height_px: int = 80, width_px: int = 80, seed: int = 3) -> np.ndarray:
    """Whole-number chance, the same on every machine: gravel, a highlight and a shadow."""
    rng = np.random.default_rng(seed)
    image = rng.integers(40, 110, (height_px, width_px)) + rng.integers(0, 60, (height_px, width_px))
    image[height_px // 3 : height_px // 2, width_px // 4 : width_px // 2] += 80
    image[height_px // 3 : height_px // 2, width_px // 2 : width_px * 3 // 4] //= 8
    return np.clip(image, 0, 255).astype(np.uint8)


def inside(box: Box, size: int = 80) -> tuple[slice, slice]:
    edge = size // 16
    return slice(box.top * edge, (box.bottom + 1) * edge), slice(box.left * edge, (box.right + 1) * edge)


@given(
    mean_index=st.integers(0, 63),
    step=st.integers(0, 7),
    corners=st.none() | st.tuples(*[st.integers(0, 15)] * 4),
    grain=st.none() | st.tuples(*[st.integers(0, 15)] * 8),
    extra=st.integers(0, 6),
)
def test_side_information_comes_back_and_its_prefixes_say_less(
    mean_index: int,
    step: int,
    corners: tuple[int, int, int, int] | None,
    grain: tuple[int, ...] | None,
    extra: int,
) -> None:
    box = None
    if corners:
        (top, bottom), (left, right) = sorted(corners[:2]), sorted(corners[2:])
        box = Box(top, left, bottom, right)
    side = SideInfo(mean_index, step, box, grain, extra)
    coder = Coder.writer(40)
    write_side(coder, shipped(), side)
    body = coder.finish()
    assert len(body) <= 3 + 2 * (box is not None) + 4 * (grain is not None) + 3 + 5
    assert read_side(Coder.reader(body), shipped()) == side
    for length in range(len(body)):
        part = read_side(Coder.reader(body[:length]), shipped())
        assert part.mean_index in (-1, mean_index)
        assert part == side or part.step == -1


def test_a_region_of_interest_gets_more_of_the_bits() -> None:
    image = speckled()
    box = Box.around(22, 15, 45, 64, 80, 80)
    rows, columns = inside(box)
    errors = []
    for chosen in (None, box):
        decoded = CODEC.decode(CODEC.encode_with_estimate(image, 128, box=chosen).stream).image.astype(float)
        square = (decoded - image) ** 2
        errors.append((square[rows, columns].mean(), square.mean()))
    assert errors[1][0] < 0.97 * errors[0][0]
    assert errors[1][1] < 1.15 * errors[0][1]


def test_weights_stand_over_the_box() -> None:
    lay = layout(80, 80)
    weight = weights(lay, Box(4, 4, 7, 7))
    assert set(np.unique(weight[lay.position])) == {OUTSIDE, INSIDE}
    finest = weight[lay.position][:40, 40:]
    assert (finest[10:20, 10:20] == INSIDE).all()
    assert (finest == INSIDE).sum() == 100
    assert (weights(lay, None) == OUTSIDE).all()


@pytest.mark.parametrize("corners", [(-1, 0, 3, 3), (0, 16, 3, 16), (5, 0, 4, 3), (0, 5, 3, 4)])
def test_boxes_outside_the_picture_are_refused(corners: tuple[int, int, int, int]) -> None:
    with pytest.raises(StreamError, match="region of interest"):
        Box(*corners)


def test_areas_without_data_cost_little_and_do_not_hurt_the_rest() -> None:
    image = speckled()
    known = np.ones(image.shape, np.bool_)
    known[:, 60:] = False
    known[10:14, :8] = False
    holed = np.where(known, image, 0).astype(np.uint8)
    error = []
    for mask in (None, known):
        decoded = CODEC.decode(CODEC.encode_with_estimate(holed, 100, known=mask).stream).image.astype(float)
        error.append(((decoded - image)[known] ** 2).mean())
    assert error[1] < 0.97 * error[0]


def test_filling_keeps_what_is_known_and_stays_within_it() -> None:
    image = speckled(33, 47)
    rng = np.random.default_rng(0)
    known = rng.random(image.shape) < 0.3
    filled = fill_unknown(image, known)
    assert np.array_equal(filled[known], image[known])
    assert filled.min() >= image[known].min()
    assert filled.max() <= image[known].max()
    assert (fill_unknown(image, np.zeros_like(known)) == 128).all()
    assert fill_unknown(image, np.ones_like(known)) is image
    with pytest.raises(StreamError, match=r"known\.shape"):
        fill_unknown(image, known[1:])


def test_grain_is_a_layer_of_its_own() -> None:
    image = speckled()
    grainy = EmbCodec(grain=True)
    stream = grainy.encode(image, 68)
    plain = grainy.decode(stream).image
    layer = CODEC.decode_grain(stream)
    assert layer.shape == image.shape
    assert layer.dtype == np.int16
    assert np.array_equal(layer, grainy.decode_grain(stream))
    view = CODEC.decode_with_grain(stream)
    assert np.array_equal(grainy.decode(stream).image, plain)
    assert np.array_equal(view, np.clip(plain.astype(int) + (layer >> 1), 0, 255))
    assert abs(float(layer.mean())) < 6
    with pytest.raises(StreamError, match="grain"):
        CODEC.decode_grain(CODEC.encode(image, 68))


def test_grain_restores_the_strength_of_the_texture() -> None:
    image = speckled()
    lay = layout(80, 80)
    levels = measure_speckle(image, lay)
    assert len(levels) == 8
    decoded = CODEC.decode(CODEC.encode(image, 64)).image
    full = np.clip(decoded + synthesise_speckle(decoded, lay, levels), 0, 255).astype(np.uint8)
    assert abs(full[60:].std() / image[60:].std() - 1) < 0.3
    assert decoded[60:].std() < 0.6 * image[60:].std()
    # Two levels are a factor of two in strength.
    softer = (image.astype(int) // 2 + int(image.mean()) // 2).astype(np.uint8)
    difference = np.array(levels[:4]) - measure_speckle(softer, lay)[:4]
    assert np.all((difference >= 1) & (difference <= 3))


def test_a_flat_picture_has_no_grain() -> None:
    lay = layout(64, 64)
    flat = np.full((64, 64), 90, np.uint8)
    assert measure_speckle(flat, lay) == (0,) * 8
    assert not synthesise_speckle(flat, lay, (0,) * 8).any()


@given(seed=st.integers(0, 2**16), length=st.integers(3, 80))
@settings(max_examples=30, deadline=None)
def test_any_bytes_after_a_header_decode(seed: int, length: int) -> None:
    stream = CODEC.encode(speckled(32, 48), 40)
    head = stream[: StreamHeader.unpack(stream).size]
    body = np.random.default_rng(seed).integers(0, 256, length, np.uint8).tobytes()
    decoded = CODEC.decode(head + body)
    assert decoded.image.shape == (32, 48)


@pytest.mark.parametrize("byte", [0, 255])
def test_extreme_bodies_decode(byte: int) -> None:
    head = CODEC.encode(speckled(32, 48), 40)[:4]
    head = head[: StreamHeader.unpack(head).size]
    for length in (1, 4, 5, 50, 400):
        assert CODEC.decode(head + bytes([byte]) * length).image.shape == (32, 48)


def golden_cases(model: Model | None = None) -> dict[str, tuple[np.ndarray, int, EmbCodec]]:
    plain, grainy = (EmbCodec(model or shipped(), grain=grain) for grain in (False, True))
    return {
        "80x80 at 64 B": (speckled(), 64, plain),
        "140x80 at 256 B": (speckled(140, 80), 256, plain),
        "17x33 at 40 B": (speckled(17, 33), 40, plain),
        "201x300 at 200 B": (speckled(201, 300), 200, plain),
        "80x80 with grain at 68 B": (speckled(), 68, grainy),
    }


def hashes(stream: bytes, codec: EmbCodec) -> dict[str, str]:
    """Of the pictures of the whole stream and of half of it."""
    parts = {"half": stream[: len(stream) // 2], "whole": stream}
    out = {name: hashlib.sha256(codec.decode(part).image.tobytes()).hexdigest() for name, part in parts.items()}
    if codec.grain:
        out["grain"] = hashlib.sha256(codec.decode_grain(stream).astype("<i2").tobytes()).hexdigest()
    return out


def model_of_file(file: Path) -> Model:
    return all_structure()[0] if file == STRUCTURE else shipped()


@pytest.mark.parametrize("file", [PLAIN, FITTED, SECOND, STRUCTURE], ids=lambda path: path.stem)
@pytest.mark.parametrize("name", golden_cases())
def test_golden_streams_of_every_encoder_and_model_decode(name: str, file: Path) -> None:
    """The same pixels on every machine, and in every release that knows the codec's id and this model."""
    golden = json.loads(file.read_text())[name]
    stream = bytes.fromhex(golden.pop("stream"))
    assert hashes(stream, golden_cases(model_of_file(file))[name][2]) == golden


@pytest.mark.parametrize("file", [SECOND, STRUCTURE], ids=lambda path: path.stem)
@pytest.mark.parametrize("name", golden_cases())
def test_golden_streams_are_written_again(name: str, file: Path) -> None:
    """The same bytes on every machine."""
    image, budget, codec = golden_cases(model_of_file(file))[name]
    assert codec.encode(image, budget).hex() == json.loads(file.read_text())[name]["stream"]
