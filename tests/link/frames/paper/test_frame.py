"""Frames of the paper format: golden bytes, round trips, hostile input."""

import dataclasses
import json
from typing import Any

import pytest
from builders.common import GOLDEN_FOLDER
from hypothesis import assume, given
from hypothesis import strategies as st

from sonarpost.codec.interface import COMMON_SIDES_PX, StreamHeader, tag_length
from sonarpost.errors import FrameError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import (
    CONTACT_FRAME_SIZE,
    HALF_PREFIX_SIZE,
    MAX_HALF_HEADER_SIZE,
    ContactFrame,
    HalfFrame,
    format_image_id,
    half_bounds,
    is_image_id,
    parse_frame,
)
from sonarpost.link.frames.v1.frame import checksum

GOLDEN = json.loads((GOLDEN_FOLDER / "link" / "paper_frames.json").read_text())
HEADER = StreamHeader(0x10, 0xBEEF, 113, 49)


def by_name(cases: list[dict[str, Any]]) -> Any:
    return pytest.mark.parametrize("case", cases, ids=[c["name"] for c in cases])


@by_name([c for c in GOLDEN["frames"] if c["kind"] == "half"])
def test_golden_half_frames(case: dict[str, Any]) -> None:
    data = bytes.fromhex(case["hex"])
    frame = parse_frame(data)
    assert frame == HalfFrame(
        case["half"],
        case["image_id"],
        case["offset"],
        case["body_length"],
        StreamHeader(**case["header"]),
        bytes.fromhex(case["payload"]),
    )
    assert frame.pack() == data[: len(data) - case["padding_bytes"]]


@by_name([c for c in GOLDEN["frames"] if c["kind"] == "contact"])
def test_golden_contact_frames(case: dict[str, Any]) -> None:
    data = bytes.fromhex(case["hex"])
    frame = parse_frame(data)
    assert isinstance(frame, ContactFrame)
    assert frame.image_id == case["image_id"]
    read = dataclasses.asdict(frame.contact)
    unknown_here = {"atd_class", "p_mine_like", "p_other_object"}  # the plain layout does not carry them
    assert read.keys() - unknown_here == case["contact"].keys()
    assert all(read[name] is None for name in unknown_here)
    for name, expected in case["contact"].items():
        same = expected if expected is None or isinstance(expected, str) else pytest.approx(expected, rel=1e-12)
        assert read[name] == same, name
    assert frame.pack() == data[: len(data) - case["padding_bytes"]]


@by_name(GOLDEN["rejected"])
def test_golden_rejected_frames(case: dict[str, Any]) -> None:
    with pytest.raises(FrameError) as caught:
        parse_frame(bytes.fromhex(case["hex"]), "frame 7")
    assert caught.value.field == case["field"]
    assert str(caught.value).startswith("frame 7: ")


def test_checksum_has_the_published_check_value() -> None:
    assert checksum(b"123456789") == 0x29B1


@given(
    st.sampled_from([b"T", b"B", b"C"]),
    st.binary(max_size=60),
    st.integers(0, 2**16 - 1),
    st.sampled_from([StreamHeader(1, 0, 80, 140), HEADER]),
)
def test_plausible_bytes_parse_or_raise_frame_error(
    kind: bytes, rest: bytes, length: int, header: StreamHeader
) -> None:
    known = length.to_bytes(2, "big") + header.pack()
    for data in (kind + b"00A7" + rest, kind + b"00A7" + rest[:2] + known + rest[2:]):
        try:
            frame = parse_frame(data)
        except FrameError:
            continue
        assert data.startswith(frame.pack())


@st.composite
def half_frames(draw: st.DrawFn) -> HalfFrame:
    codec_id = draw(st.integers(0, 255))
    sides = st.sampled_from(COMMON_SIDES_PX) | st.integers(16, 512)
    header = StreamHeader(codec_id, draw(st.integers(0, 256 ** tag_length(codec_id) - 1)), draw(sides), draw(sides))
    body_length = draw(st.integers(0, 300) | st.integers(0, 65535))
    half = draw(st.sampled_from(["top", "bottom"]))
    start, stop = half_bounds(body_length, half)
    offset = draw(st.integers(start, max(start, stop - 1)))
    payload = draw(st.binary(max_size=min(stop - offset, 241)))
    return HalfFrame(half, format_image_id(draw(st.integers(0, 36**4 - 1))), offset, body_length, header, payload)


@given(half_frames(), st.binary(max_size=40))
def test_half_frame_round_trip_without_padding(frame: HalfFrame, tail: bytes) -> None:
    packed = frame.pack()
    assert len(packed) == HALF_PREFIX_SIZE + frame.header.size + len(frame.payload)
    assert len(packed) <= MAX_HALF_HEADER_SIZE + len(frame.payload)
    assert parse_frame(packed) == frame
    reaches_the_end = frame.stop == half_bounds(frame.body_length, frame.half)[1]
    if reaches_the_end:
        assert parse_frame(packed + tail) == frame


@given(half_frames())
def test_half_frame_cut_in_its_header_is_rejected_and_later_keeps_its_bytes(frame: HalfFrame) -> None:
    packed, head = frame.pack(), HALF_PREFIX_SIZE + frame.header.size
    for length in range(head):
        with pytest.raises(FrameError) as caught:
            parse_frame(packed[:length])
        expected = "type" if length == 0 else "length" if length < HALF_PREFIX_SIZE else "header"
        assert caught.value.field == expected
    for length in range(head, len(packed)):
        assert parse_frame(packed[:length]) == dataclasses.replace(frame, payload=frame.payload[: length - head])


@given(st.integers(0, 8 * CONTACT_FRAME_SIZE - 1), st.integers(1, 16), st.integers(1, 2**16 - 1))
def test_contact_frame_detects_bursts_of_up_to_16_wrong_bits(first_bit: int, length: int, pattern: int) -> None:
    frame = ContactFrame("00A7", ContactSummary(height_px=80, width_px=140, lat_deg=44.7, lon_deg=-63.6)).pack()
    burst = (pattern & ((1 << length) - 1)) << first_bit
    assume(burst)
    assume(burst < 1 << (8 * CONTACT_FRAME_SIZE))
    damaged = (int.from_bytes(frame, "big") ^ burst).to_bytes(CONTACT_FRAME_SIZE, "big")
    if damaged[:1] in b"TB":
        return  # parsed as a half frame, which has no checksum
    with pytest.raises(FrameError):
        parse_frame(damaged)


def test_image_identifiers_count_in_base_36_and_wrap_around() -> None:
    assert [format_image_id(n) for n in (0, 35, 36, 36**4 - 1, 36**4)] == ["0000", "000Z", "0010", "ZZZZ", "0000"]
    assert all(int(format_image_id(n), 36) == n for n in range(0, 36**4, 9973))
    assert not any(
        is_image_id(text) for text in ("", "000", "00000", "00a7", "00 7", "00A7\n", "\u0660\u0661\u0662\u0663")
    )


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"offset": -1}, "offset"),
        ({"offset": 5}, "offset"),
        ({"payload": bytes(6)}, "payload"),
        ({"image_id": "A7"}, "image identifier"),
        ({"header": StreamHeader(256, 0, 80, 80)}, "stream header codec_id"),
        ({"header": StreamHeader(-1, 0, 80, 80)}, "stream header codec_id"),
        ({"header": StreamHeader(0x10, 65536, 80, 80)}, "stream header model_tag"),
        ({"header": StreamHeader(0x10, -1, 80, 80)}, "stream header model_tag"),
        ({"header": StreamHeader(0x20, 256, 80, 80)}, "stream header model_tag"),
        ({"header": StreamHeader(1, 1, 80, 80)}, "stream header model_tag"),
        ({"header": StreamHeader(1, 0, 513, 80)}, "stream header height_px"),
        ({"header": StreamHeader(1, 0, 80, 15)}, "stream header width_px"),
        ({"body_length": 65536}, "body_length"),
        ({"body_length": -1}, "body_length"),
    ],
)
def test_invalid_half_frame_is_rejected(change: dict[str, Any], named: str) -> None:
    frame = HalfFrame("top", "00A7", 0, 9, HEADER, bytes(5))
    with pytest.raises(FrameError) as caught:
        dataclasses.replace(frame, **change)
    assert caught.value.field == named


def test_contact_frame_fills_a_rate_0_frame() -> None:
    assert (CONTACT_FRAME_SIZE, MAX_HALF_HEADER_SIZE) == (32, 16)
    assert len(ContactFrame("00A7", ContactSummary()).pack()) == 32
    with pytest.raises(FrameError, match="four characters"):
        ContactFrame("00a7", ContactSummary())
