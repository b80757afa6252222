"""The contract of all registered codecs."""

from __future__ import annotations

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.codec.interface import Codec, DecodedImage, StreamHeader, model_tag
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import load
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.errors import StreamError

RESOURCES = CodecResources(load(GOLDEN_FOLDER / "vq" / "small.tiles").tiles)
NAMES = default_registry().names()
SIZES = [(16, 16), (16, 512), (512, 16), (17, 33), (49, 113), (80, 80), (140, 80), (127, 201)]


def codecs() -> list[tuple[str, Codec]]:
    registry = default_registry()
    made = [(name, registry.create(name, RESOURCES)) for name in NAMES]
    made.append(("emb-structure", registry.create("emb", CodecResources(model="structure"))))
    for packing in (IndexPacking.BYTES2, IndexPacking.BYTES3, IndexPacking.ASCII5):
        made.append((f"vq-{packing.value}", registry.create("vq", CodecResources(RESOURCES.tiles, packing))))
    return made


CODECS = dict(codecs())


def snippet(height_px: int, width_px: int, seed: int = 0) -> np.ndarray:
    """Return speckle with a highlight and a shadow."""
    rng = np.random.default_rng(seed)
    image = 60 * rng.rayleigh(1.0, (height_px, width_px))
    image[height_px // 3 : height_px // 2, width_px // 4 : width_px // 2] *= 3
    image[height_px // 3 : height_px // 2, width_px // 2 : width_px * 3 // 4] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


def check_decoded(decoded: DecodedImage, height_px: int, width_px: int) -> None:
    assert decoded.image.shape == decoded.missing.shape == (height_px, width_px)
    assert decoded.image.dtype == np.uint8
    assert decoded.missing.dtype == np.bool_
    assert not decoded.image[decoded.missing].any()


@pytest.mark.parametrize("name", CODECS)
def test_codec_agrees_with_its_registry_entry(name: str) -> None:
    codec = CODECS[name]
    assert isinstance(codec, Codec)
    spec = default_registry().spec(codec.name)
    assert codec.codec_id in spec.codec_ids
    assert len(codec.model_hash) in (0, 64)
    assert default_registry().spec_for_id(codec.codec_id) is spec


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("size", SIZES)
def test_every_size_round_trips_without_missing_pixels(name: str, size: tuple[int, int]) -> None:
    codec, image = CODECS[name], snippet(*size)
    stream = codec.encode(image)
    header = StreamHeader.unpack(stream)
    assert (header.height_px, header.width_px) == size
    assert header.codec_id == codec.codec_id
    assert header.model_tag == model_tag(codec.codec_id, codec.model_hash)
    assert header.pack() == stream[: header.size]
    decoded = codec.decode(stream)
    check_decoded(decoded, *size)
    assert not decoded.missing.any()
    reader = default_registry().create_for_stream(stream, RESOURCES)
    assert np.array_equal(reader.decode(stream).image, decoded.image)


@pytest.mark.parametrize("name", CODECS)
def test_encoding_is_deterministic_and_does_not_modify_the_image(name: str) -> None:
    image = snippet(60, 44)
    before = image.copy()
    assert CODECS[name].encode(image) == CODECS[name].encode(np.asfortranarray(image))
    assert np.array_equal(image, before)


@pytest.mark.parametrize("name", CODECS)
def test_decoded_image_resembles_the_original(name: str) -> None:
    codec = CODECS[name]
    bright, dark = snippet(80, 80), (snippet(80, 80, 1) // 8).astype(np.uint8)
    for image in (bright, dark):
        error = np.abs(codec.decode(codec.encode(image)).image.astype(int) - image).mean()
        other = np.abs(bright.astype(int) - dark).mean()
        assert error < other


@pytest.mark.parametrize("name", CODECS)
def test_16_bit_images_are_mapped_over_their_own_range(name: str) -> None:
    codec, image = CODECS[name], snippet(48, 40)
    image.flat[0], image.flat[1] = 0, 255
    wide = image.astype(np.uint16) * 100 + 1000
    assert codec.encode(wide) == codec.encode(image)
    flat = np.full((20, 20), 41_000, np.uint16)
    check_decoded(codec.decode(codec.encode(flat)), 20, 20)


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize(
    "image",
    [
        np.zeros((15, 40), np.uint8),
        np.zeros((40, 513), np.uint8),
        np.zeros((40, 40), np.float32),
        np.zeros((40, 40), np.int16),
        np.zeros((40, 40, 3), np.uint8),
        np.zeros(400, np.uint8),
    ],
    ids=str,
)
def test_unsupported_images_are_rejected(name: str, image: np.ndarray) -> None:
    with pytest.raises(StreamError):
        CODECS[name].encode(image)


@pytest.mark.parametrize("name", CODECS)
def test_every_truncation_decodes_or_is_rejected(name: str) -> None:
    codec = CODECS[name]
    stream = codec.encode(snippet(33, 47))
    for length in range(len(stream)) if len(stream) < 300 else [*range(40), *range(40, len(stream), 17)]:
        try:
            check_decoded(codec.decode(stream[:length]), 33, 47)
        except StreamError:
            assert length < StreamHeader.unpack(stream).size or codec.name != "vq"


@pytest.mark.parametrize("name", CODECS)
@given(data=st.data())
@settings(max_examples=25, deadline=None)
def test_any_corruption_decodes_or_is_rejected(name: str, data: st.DataObject) -> None:
    codec = CODECS[name]
    stream = bytearray(codec.encode(snippet(24, 21)))
    for _ in range(data.draw(st.integers(1, 6))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    length = data.draw(st.integers(0, len(stream)))
    tail = data.draw(st.binary(max_size=20))
    try:
        decoded = codec.decode(bytes(stream[:length]) + tail)
    except StreamError:
        return
    header = StreamHeader.unpack(bytes(stream[:length]) + tail)
    check_decoded(decoded, header.height_px, header.width_px)


@pytest.mark.parametrize("name", CODECS)
@given(junk=st.binary(max_size=80))
@settings(max_examples=25, deadline=None)
def test_junk_after_a_valid_header_decodes_or_is_rejected(name: str, junk: bytes) -> None:
    codec = CODECS[name]
    header = StreamHeader.unpack(codec.encode(snippet(20, 20)))
    try:
        check_decoded(codec.decode(header.pack() + junk), 20, 20)
    except StreamError:
        assert codec.name != "vq"


@pytest.mark.parametrize("name", CODECS)
@given(data=st.data())
@settings(max_examples=15, deadline=None)
def test_missing_bytes_give_missing_pixels(name: str, data: st.DataObject) -> None:
    codec = CODECS[name]
    stream = codec.encode(snippet(40, 40))
    start = StreamHeader.unpack(stream).size
    length = len(stream) - start
    received = np.array(data.draw(st.lists(st.booleans(), min_size=length, max_size=length)), dtype=np.bool_)
    body = np.frombuffer(stream[start:], np.uint8) * received
    try:
        decoded = codec.decode(stream[:start] + body.astype(np.uint8).tobytes(), received)
    except StreamError:
        assert codec.name != "vq"
        return
    check_decoded(decoded, 40, 40)
    if not received.any():
        assert decoded.missing.all()


@pytest.mark.parametrize("name", CODECS)
def test_budget_is_met_or_rejected(name: str) -> None:
    codec, image = CODECS[name], snippet(80, 80)
    natural = len(codec.encode(image))
    for budget in (0, 1, 2, 4, 5, 8, 9, 40, natural - 1, natural, natural + 100):
        try:
            stream = codec.encode(image, budget)
        except StreamError:
            assert budget < natural
            continue
        assert len(stream) <= budget
        check_decoded(codec.decode(stream), 80, 80)


@pytest.mark.parametrize("name", CODECS)
def test_stream_of_another_codec_is_rejected(name: str) -> None:
    codec = CODECS[name]
    for other in CODECS.values():
        # emb decodes the streams of all its models.
        if other.codec_id != codec.codec_id and (other.name, codec.name) != ("emb", "emb"):
            with pytest.raises(StreamError):
                codec.decode(other.encode(snippet(20, 20)))
