"""The vector-quantisation codec: packings, reserved index, damage, golden streams."""

import dataclasses

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from hypothesis import given
from hypothesis import strategies as st

from research.codebook.basis import database_of
from sonarpost.codec.interface import StreamHeader
from sonarpost.codec.vq.codebook import load
from sonarpost.codec.vq.codec import IndexPacking, VqCodec, codebook_tag, pack_indices, unpack_indices
from sonarpost.codec.vq.tiles import TileDatabase, cut_tiles
from sonarpost.errors import ConfigError, StreamError

GOLDEN = GOLDEN_FOLDER / "vq"
PACKINGS = list(IndexPacking)
EACH_PACKING = pytest.mark.parametrize("packing", PACKINGS)


@pytest.fixture(scope="module")
def tiles() -> TileDatabase:
    return load(GOLDEN / "small.tiles").tiles


def snippet(height_px: int, width_px: int) -> np.ndarray:
    """Return a slope with a bright box and its shadow, by integer arithmetic."""
    rows, columns = np.mgrid[:height_px, :width_px]
    image = 40 + (rows * 3 + columns * 5) % 97
    image[height_px // 3 : height_px // 2, width_px // 4 : width_px // 2] = 240
    image[height_px // 3 : height_px // 2, width_px // 2 : width_px * 3 // 4] = 3
    return image.astype(np.uint8)


def split(stream: bytes) -> tuple[bytes, bytes]:
    """Return header and body."""
    size = StreamHeader.unpack(stream).size
    return stream[:size], stream[size:]


@EACH_PACKING
def test_golden_streams_are_reproduced_and_decoded(tiles: TileDatabase, packing: IndexPacking) -> None:
    codec = VqCodec(tiles, packing)
    for height_px, width_px in ((80, 80), (49, 113), (17, 31)):
        name = f"{height_px}x{width_px}"
        golden = bytes.fromhex((GOLDEN / f"{name}-{packing.value}.hex").read_text())
        assert codec.encode(snippet(height_px, width_px)).hex() == golden.hex()
        header, _ = split(golden)
        assert len(header) == (4 if name == "80x80" else 7)
        assert header[:3] == bytes([packing.codec_id]) + bytes.fromhex(tiles.identity[:4])
        decoded = codec.decode(golden)
        assert decoded.image.tobytes() == bytes.fromhex((GOLDEN / f"{name}-image.hex").read_text())
        assert decoded.image.shape == (height_px, width_px)
        assert not decoded.missing.any()
        assert decoded.notes == ()


def test_stream_sizes_are_those_of_the_paper() -> None:
    tiles = database_of(10, np.arange(0, 200, 2, dtype=np.uint8)[:, None].repeat(100, axis=1))
    image = snippet(140, 80)
    assert [len(VqCodec(tiles, packing).encode(image)) - 4 for packing in PACKINGS] == [196, 224, 336, 560]


@EACH_PACKING
@given(data=st.data())
def test_packing_round_trips(packing: IndexPacking, data: st.DataObject) -> None:
    values = data.draw(st.lists(st.integers(0, packing.max_index), min_size=1, max_size=40))
    body = pack_indices(np.array(values, dtype=np.int64), packing)
    assert len(body) == packing.body_length(len(values))
    assert unpack_indices(body, len(values), packing).tolist() == values


def test_packed_bytes_of_an_example_and_codec_ids() -> None:
    values = np.array([1, 0x2ABC, 0], dtype=np.int64)
    assert pack_indices(values, IndexPacking.BITS14).hex() == "0006abc00000"  # 14 + 14 + 14 bits, then 6 zero bits
    assert pack_indices(values, IndexPacking.BYTES2).hex() == "00012abc0000"
    assert pack_indices(values, IndexPacking.BYTES3).hex() == "000001002abc000000"
    assert pack_indices(values, IndexPacking.ASCII5) == b"000011094000000"
    ids = [packing.codec_id for packing in PACKINGS]
    assert ids == [0x10, 0x11, 0x12, 0x13]
    assert [IndexPacking.from_codec_id(number) for number in ids] == PACKINGS
    assert IndexPacking.from_codec_id(0x14) is None


@EACH_PACKING
def test_wire_index_is_the_tile_number_plus_one(tiles: TileDatabase, packing: IndexPacking) -> None:
    image = tiles.tiles[0].reshape(tiles.tile_px, tiles.tile_px).repeat(4, axis=0).repeat(4, axis=1)
    codec = VqCodec(tiles, packing)
    flat = np.tile(tiles.tiles[0].reshape(tiles.tile_px, -1), (4, 4))
    stream = codec.encode(flat)
    assert set(unpack_indices(split(stream)[1], 16, packing).tolist()) == {1}
    assert np.array_equal(codec.decode(stream).image, flat)
    assert codec.encode(image) != stream


@EACH_PACKING
def test_zero_padding_is_black_and_missing(tiles: TileDatabase, packing: IndexPacking) -> None:
    codec = VqCodec(tiles, packing)
    stream = codec.encode(snippet(80, 40))
    header, body = split(stream)
    half = len(body) // 2
    decoded = codec.decode(header + body[:half] + bytes(len(body) - half))
    complete = codec.decode(stream)
    # Indices are in raster order: the first half of the body is the top half of the image.
    assert np.array_equal(decoded.image[:40], complete.image[:40])
    assert not decoded.missing[:40].any()
    assert decoded.missing[40:].all()
    assert not decoded.image[40:].any()
    assert "reserved index 0" in decoded.notes[0]


@EACH_PACKING
def test_index_above_the_last_tile_is_black_and_missing(tiles: TileDatabase, packing: IndexPacking) -> None:
    codec = VqCodec(tiles, packing)
    stream = codec.encode(snippet(20, 30))
    header, body = split(stream)
    indices = unpack_indices(body, 6, packing)
    indices[4] = len(tiles) + 1
    decoded = codec.decode(header + pack_indices(indices, packing))
    assert decoded.missing[10:, 10:20].all()
    assert decoded.missing.sum() == 100
    assert not decoded.image[decoded.missing].any()
    assert "outside the codebook" in decoded.notes[0]
    indices[4] = len(tiles)
    assert not codec.decode(header + pack_indices(indices, packing)).missing.any()


def test_invalid_ascii_is_black_and_missing(tiles: TileDatabase) -> None:
    codec = VqCodec(tiles, IndexPacking.ASCII5)
    header, body = split(codec.encode(snippet(16, 16)))
    for text in (b"12x45", b"    1", b"-0001", b"+0001", b"\xff" * 5, b"\x000001", b"1_000"):
        decoded = codec.decode(header + text + body[5:])
        assert decoded.missing[:10, :10].all()
        assert decoded.missing.sum() == 100
        assert "damaged" in decoded.notes[0]


@EACH_PACKING
def test_tile_with_a_missing_index_byte_is_missing(tiles: TileDatabase, packing: IndexPacking) -> None:
    codec = VqCodec(tiles, packing)
    stream = codec.encode(snippet(16, 60))
    header, sent = split(stream)
    count, length = 12, len(sent)
    complete = codec.decode(stream)
    for lost_byte in range(length):
        received = np.ones(length, dtype=np.bool_)
        received[lost_byte] = False
        body = bytearray(sent)
        body[lost_byte] = 0
        decoded = codec.decode(header + bytes(body), received)
        affected = [i for i in range(count) if i * packing.bits // 8 <= lost_byte <= ((i + 1) * packing.bits - 1) // 8]
        is_missing = [int(cut_tiles(decoded.missing.astype(np.uint8), 10)[i].max()) for i in range(count)]
        assert [i for i in range(count) if is_missing[i]] == affected
        assert not decoded.image[decoded.missing].any()
        assert np.array_equal(decoded.image[~decoded.missing], complete.image[~decoded.missing])


def test_short_and_long_bodies_give_notes(tiles: TileDatabase) -> None:
    codec = VqCodec(tiles, IndexPacking.BYTES2)
    stream = codec.encode(snippet(20, 20))
    short = codec.decode(stream[:-3])
    assert short.missing.sum() == 200
    assert "body ends after 5 of 8 B" in short.notes
    assert "2 of 4 tiles did not arrive" in short.notes
    longer = codec.decode(stream + b"\0\0\0")
    assert not longer.missing.any()
    assert longer.notes == ("3 B after the body ignored",)


def test_error_for_another_codebook_names_both_tags(tiles: TileDatabase) -> None:
    other = database_of(tiles.tile_px, tiles.tiles[::-1])
    stream = VqCodec(other).encode(snippet(20, 20))
    with pytest.raises(StreamError, match="another identity") as caught:
        VqCodec(tiles).decode(stream)
    assert f"{codebook_tag(other):#06x}" in str(caught.value)
    assert f"{codebook_tag(tiles):#06x}" in str(caught.value)


def test_header_of_another_codec_or_codebook_is_rejected(tiles: TileDatabase) -> None:
    codec = VqCodec(tiles)
    header = StreamHeader.unpack(codec.encode(snippet(20, 20)))
    for change, field in (
        ({"codec_id": 0x11}, "codec_id"),
        ({"model_tag": 0}, "model_tag"),
        ({"codec_id": 0x01, "model_tag": 0}, "codec_id"),
        ({"height_px": 15}, "height_px"),
        ({"width_px": 513}, "width_px"),
    ):
        with pytest.raises(StreamError) as caught:
            codec.decode(dataclasses.replace(header, **change).pack() + bytes(16))
        assert caught.value.field == field


def test_identity_and_tag(tiles: TileDatabase) -> None:
    assert (VqCodec(tiles).codec_id, VqCodec(tiles).model_hash) == (0x10, tiles.identity)
    assert f"{codebook_tag(tiles):04x}" == tiles.identity[:4]
    needed = len(VqCodec(tiles).encode(snippet(40, 40)))
    with pytest.raises(StreamError, match=f"at least {needed} B"):
        VqCodec(tiles).encode(snippet(40, 40), needed - 1)


def test_limits_of_tiles_and_body() -> None:
    codec = VqCodec(database_of(4, np.eye(16, dtype=np.uint8)), IndexPacking.ASCII5)
    with pytest.raises(StreamError, match="81924"):
        codec.encode(snippet(512, 512))
    many = np.zeros((0x4000, 16), dtype=np.uint8)
    database = database_of(4, many)
    with pytest.raises(ConfigError, match="wider packing"):
        VqCodec(database, IndexPacking.BITS14)
    assert VqCodec(database, IndexPacking.BYTES2).codec_id == 0x11
    assert VqCodec(database_of(4, many[1:])).codec_id == 0x10
