"""The contract of all registered codecs."""

from functools import cache

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import snippet
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.codec.interface import Codec, DecodedImage, StreamHeader, model_tag
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import load
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.errors import StreamError

RESOURCES = CodecResources(load(GOLDEN_FOLDER / "vq" / "small.tiles").tiles)


def codecs() -> dict[str, Codec]:
    registry = default_registry()
    made = {name: registry.create(name, RESOURCES) for name in registry.names()}
    made["emb-structure"] = registry.create("emb", CodecResources(model="structure"))
    for packing in (IndexPacking.BYTES2, IndexPacking.BYTES3, IndexPacking.ASCII5):
        made[f"vq-{packing.value}"] = registry.create("vq", CodecResources(RESOURCES.tiles, packing))
    return made


CODECS = codecs()
EACH = pytest.mark.parametrize("name", CODECS)


@cache
def stream_of(name: str, height_px: int, width_px: int) -> bytes:
    return CODECS[name].encode(snippet(height_px, width_px))


def check_decoded(decoded: DecodedImage, height_px: int, width_px: int) -> None:
    assert decoded.image.shape == decoded.missing.shape == (height_px, width_px)
    assert decoded.image.dtype == np.uint8
    assert decoded.missing.dtype == np.bool_
    assert not decoded.image[decoded.missing].any()


@EACH
def test_every_size_round_trips_and_the_registry_finds_the_codec(name: str) -> None:
    codec = CODECS[name]
    assert isinstance(codec, Codec)
    spec = default_registry().spec(codec.name)
    assert codec.codec_id in spec.codec_ids
    assert len(codec.model_hash) in (0, 64)
    assert default_registry().spec_for_id(codec.codec_id) is spec
    for size in ((16, 16), (16, 300), (300, 16), (17, 33), (49, 113)):
        stream = stream_of(name, *size)
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


@EACH
def test_encoding_is_deterministic_and_does_not_modify_the_image(name: str) -> None:
    image = snippet(49, 33)
    before = image.copy()
    assert CODECS[name].encode(image) == CODECS[name].encode(np.asfortranarray(image))
    assert np.array_equal(image, before)


@EACH
def test_decoded_image_resembles_the_original(name: str) -> None:
    codec = CODECS[name]
    bright, dark = snippet(48, 48), (snippet(48, 48) // 8).astype(np.uint8)
    for image in (bright, dark):
        error = np.abs(codec.decode(codec.encode(image)).image.astype(int) - image).mean()
        assert error < np.abs(bright.astype(int) - dark).mean()


@EACH
def test_16_bit_images_are_mapped_over_their_own_range(name: str) -> None:
    codec, image = CODECS[name], snippet(40, 32)
    image.flat[0], image.flat[1] = 0, 255
    assert codec.encode(image.astype(np.uint16) * 100 + 1000) == codec.encode(image)
    check_decoded(codec.decode(codec.encode(np.full((20, 20), 41_000, np.uint16))), 20, 20)


@EACH
def test_unsupported_images_are_rejected(name: str) -> None:
    shapes = ((15, 40), (40, 513), (40, 40, 3), (400,))
    images = [np.zeros(shape, np.uint8) for shape in shapes]
    for image in (*images, np.zeros((40, 40), np.float32), np.zeros((40, 40), np.int16)):
        with pytest.raises(StreamError):
            CODECS[name].encode(image)


@EACH
def test_every_truncation_decodes_or_is_rejected(name: str) -> None:
    codec, stream = CODECS[name], stream_of(name, 33, 47)
    for length in range(len(stream)) if len(stream) < 100 else [*range(40), *range(40, len(stream), 29)]:
        try:
            check_decoded(codec.decode(stream[:length]), 33, 47)
        except StreamError:
            assert length < StreamHeader.unpack(stream).size or codec.name != "vq"


@EACH
@given(data=st.data())
def test_any_corruption_decodes_or_is_rejected(name: str, data: st.DataObject) -> None:
    stream = bytearray(stream_of(name, 20, 20))
    for _ in range(data.draw(st.integers(1, 6))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    length = data.draw(st.integers(0, len(stream)))
    damaged = bytes(stream[:length]) + data.draw(st.binary(max_size=20))
    try:
        decoded = CODECS[name].decode(damaged)
    except StreamError:
        return
    header = StreamHeader.unpack(damaged)
    check_decoded(decoded, header.height_px, header.width_px)


@EACH
@given(junk=st.binary(max_size=200))
def test_junk_after_a_valid_header_decodes_or_is_rejected(name: str, junk: bytes) -> None:
    header = StreamHeader.unpack(stream_of(name, 20, 20))
    try:
        check_decoded(CODECS[name].decode(header.pack() + junk), 20, 20)
    except StreamError:
        assert CODECS[name].name != "vq"


@EACH
@given(seed=st.integers(0, 2**32), share=st.sampled_from([0.0, 0.1, 0.5, 0.95]))
def test_missing_bytes_give_missing_pixels(name: str, seed: int, share: float) -> None:
    codec, stream = CODECS[name], stream_of(name, 20, 20)
    start = StreamHeader.unpack(stream).size
    received = np.random.default_rng(seed).random(len(stream) - start) < share
    body = np.frombuffer(stream[start:], np.uint8) * received
    try:
        decoded = codec.decode(stream[:start] + body.astype(np.uint8).tobytes(), received)
    except StreamError:
        assert codec.name != "vq"
        return
    check_decoded(decoded, 20, 20)
    if not received.any():
        assert decoded.missing.all()


@EACH
def test_budget_is_met_or_rejected(name: str) -> None:
    codec, image = CODECS[name], snippet(40, 40)
    natural = len(stream_of(name, 40, 40))
    for budget in (0, 1, 2, 4, 5, 9, 40, natural - 1, natural, natural + 100):
        try:
            stream = codec.encode(image, budget)
        except StreamError:
            assert budget < natural
            continue
        assert len(stream) <= budget
        check_decoded(codec.decode(stream), 40, 40)


@EACH
def test_stream_of_another_codec_is_rejected(name: str) -> None:
    codec = CODECS[name]
    for other_name, other in CODECS.items():
        # emb decodes the streams of all its models.
        if other.codec_id != codec.codec_id and (other.name, codec.name) != ("emb", "emb"):
            with pytest.raises(StreamError):
                codec.decode(stream_of(other_name, 20, 20))


def test_bytes_after_a_lost_byte_are_not_used() -> None:
    codec, stream = CODECS["emb"], stream_of("emb", 40, 40)
    size = StreamHeader.unpack(stream).size
    received = np.ones(len(stream) - size, np.bool_)
    received[40] = False
    decoded = codec.decode(stream[: size + 40] + b"\0" + stream[size + 41 :], received)
    cut = codec.decode(stream[: size + 40])
    assert np.array_equal(decoded.image, cut.image)
    assert np.array_equal(decoded.missing, cut.missing)
    assert f"body byte 40 of {len(received)} did not arrive" in decoded.notes[0]
    for wrong in (received[1:], received[:, None], received.astype(np.uint8)):
        with pytest.raises(StreamError, match="received"):
            codec.decode(stream, wrong)
