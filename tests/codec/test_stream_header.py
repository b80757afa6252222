"""The stream header: golden bytes, every size, every kind of tag, invalid input."""

import json

import pytest
from builders.common import GOLDEN_FOLDER
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.codec.interface import COMMON_SIDES_PX, MAX_SIDE_PX, MIN_SIDE_PX, StreamHeader, model_tag, tag_length
from sonarpost.errors import StreamError

GOLDEN = json.loads((GOLDEN_FOLDER / "codec" / "stream_headers.json").read_text())
UNCOMMON_SIDES_PX = sorted(set(range(MIN_SIDE_PX, MAX_SIDE_PX + 1)) - set(COMMON_SIDES_PX))
ONE_CODEC_ID_OF_EACH_CLASS = (0x01, 0x10, 0x20, 0x80)
SHA256 = "f893" + "a5" * 30


@st.composite
def headers(draw: st.DrawFn) -> StreamHeader:
    codec_id = draw(st.integers(0, 255))
    sides = st.sampled_from(COMMON_SIDES_PX) | st.integers(MIN_SIDE_PX, MAX_SIDE_PX)
    return StreamHeader(codec_id, draw(st.integers(0, 256 ** tag_length(codec_id) - 1)), draw(sides), draw(sides))


def test_golden_headers() -> None:
    assert list(COMMON_SIDES_PX) == GOLDEN["common_sides_px"]
    for case in GOLDEN["headers"]:
        data = bytes.fromhex(case["hex"])
        header = StreamHeader(case["codec_id"], case["model_tag"], case["height_px"], case["width_px"])
        assert header.pack() == data, case["name"]
        assert StreamHeader.unpack(data) == header
        assert header.size == len(data)


def test_golden_rejected_headers() -> None:
    for case in GOLDEN["rejected"]:
        with pytest.raises(StreamError) as caught:
            StreamHeader.unpack(bytes.fromhex(case["hex"]), "stream 7")
        assert caught.value.field == case["field"], case["name"]
        assert str(caught.value).startswith("stream 7: ")


def test_tag_is_the_start_of_the_model_hash() -> None:
    tags = {0x00: 0, 0x0F: 0, 0x10: 0xF893, 0x1F: 0xF893, 0x20: 0xF8, 0x7F: 0xF8, 0x80: 0xF893, 0xFF: 0xF893}
    for codec_id, tag in tags.items():
        assert model_tag(codec_id, SHA256) == tag
        assert model_tag(codec_id, "") == 0
        packed = StreamHeader(codec_id, tag, 80, 140).pack()
        assert packed[1:-1].hex() == SHA256[: 2 * tag_length(codec_id)]


@pytest.mark.parametrize("codec_id", ONE_CODEC_ID_OF_EACH_CLASS)
def test_every_pair_of_common_sides_has_one_size_byte(codec_id: int) -> None:
    codes = set()
    for height_px in COMMON_SIDES_PX:
        for width_px in COMMON_SIDES_PX:
            header = StreamHeader(codec_id, 0, height_px, width_px)
            packed = header.pack()
            assert len(packed) == header.size == 2 + tag_length(codec_id)
            assert StreamHeader.unpack(packed) == header
            codes.add(packed[-1])
    assert codes == set(range(225))


def test_other_sides_use_the_long_form() -> None:
    for side_px in UNCOMMON_SIDES_PX:
        for other_px in (80, 17):
            for height_px, width_px in ((side_px, other_px), (other_px, side_px)):
                header = StreamHeader(0x10, 0xBEEF, height_px, width_px)
                packed = header.pack()
                assert packed.hex() == f"10beefff{height_px:03x}{width_px:03x}"
                assert len(packed) == header.size == StreamHeader.MAX_SIZE
                assert StreamHeader.unpack(packed) == header


@given(headers(), st.binary(max_size=20))
def test_headers_round_trip_before_any_body(header: StreamHeader, body: bytes) -> None:
    packed = header.pack()
    assert len(packed) == header.size
    assert 2 <= header.size <= StreamHeader.MAX_SIZE
    assert StreamHeader.unpack(packed + body) == header


@given(headers())
def test_truncated_header_is_rejected(header: StreamHeader) -> None:
    packed = header.pack()
    for length in range(len(packed)):
        with pytest.raises(StreamError) as caught:
            StreamHeader.unpack(packed[:length])
        assert caught.value.field == "header"
    with pytest.raises(StreamError, match=f"at least {header.size} bytes"):
        StreamHeader.unpack(packed[:-1])


@pytest.mark.parametrize("codec_id", ONE_CODEC_ID_OF_EACH_CLASS)
def test_reserved_size_codes_are_rejected(codec_id: int) -> None:
    for code in range(225, 255):
        with pytest.raises(StreamError) as caught:
            StreamHeader.unpack(bytes([codec_id]) + bytes(tag_length(codec_id)) + bytes([code]) + bytes(8))
        assert (caught.value.field, caught.value.value) == ("size", code)


def test_common_sides_in_the_long_form_and_sides_out_of_range_are_rejected() -> None:
    for height_px in COMMON_SIDES_PX:
        for width_px in COMMON_SIDES_PX:
            with pytest.raises(StreamError, match="one-byte form"):
                StreamHeader.unpack(bytes.fromhex(f"10beefff{height_px:03x}{width_px:03x}"))
    for side_px in (0, 1, 15, 513, 1024, 4095):
        for text, field in ((f"01ff{side_px:03x}011", "height_px"), (f"01ff011{side_px:03x}", "width_px")):
            with pytest.raises(StreamError) as caught:
                StreamHeader.unpack(bytes.fromhex(text))
            assert (caught.value.field, caught.value.value) == (field, side_px)


@given(st.binary(max_size=12))
def test_any_bytes_unpack_to_a_header_that_packs_to_them_or_are_rejected(data: bytes) -> None:
    try:
        header = StreamHeader.unpack(data)
    except StreamError:
        return
    assert data.startswith(header.pack())  # unique headers: receivers compare them to assign frames to images
