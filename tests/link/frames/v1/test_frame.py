"""Frames of the v1 format: packing, padding, damage, tags."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import FrameError
from sonarpost.link.frames.v1.frame import (
    PADDED_LENGTHS,
    Segment,
    SegmentKind,
    Symbol,
    SymbolKind,
    checksum,
    pack_segments,
    pack_symbol,
    parse_frame,
    segments_room,
)


@st.composite
def symbols(draw: st.DrawFn) -> Symbol:
    kind = draw(st.sampled_from(SymbolKind))
    parameter = draw(st.integers(0 if kind == SymbolKind.LAYERED else 1, 255))
    length = draw(st.sampled_from([27, 59, 123, 251, draw(st.integers(1, 251))]))
    data = draw(st.binary(min_size=length, max_size=length))
    return Symbol(kind, draw(st.integers(0, 31)), draw(st.integers(0, 254)), parameter, data)


@given(symbols())
def test_symbol_round_trip(symbol: Symbol) -> None:
    frame = pack_symbol(symbol)
    assert len(frame) == len(symbol.data) + 5
    assert parse_frame(frame) == symbol


@given(symbols(), st.sampled_from([n for n in PADDED_LENGTHS if n >= 32]), st.integers(0, 300))
def test_padding_is_detected_after_any_symbol(symbol: Symbol, length: int, padding: int) -> None:
    data = symbol.data.ljust(length - 5, b"\0")[: length - 5]
    symbol_sent = Symbol(symbol.kind, symbol.block, symbol.index, symbol.parameter, data)
    assert parse_frame(pack_symbol(symbol_sent) + bytes(padding)) == symbol_sent


def test_segments_share_a_frame_and_32_bytes_hold_a_contact() -> None:
    contact = Segment(SegmentKind.CONTACT, bytes(range(29)))
    assert contact.size == segments_room(32) == 30
    frame = pack_segments([contact], 32)
    assert len(frame) == 32
    assert parse_frame(frame) == (contact,)
    message, symbol = Segment(SegmentKind.MESSAGE, b"\x07hello"), Segment(SegmentKind.SYMBOL, b"\x01\x02\x03abc")
    listed = (message, contact, symbol, Segment(20, b""))
    assert sum(s.size for s in listed) <= segments_room(64)
    assert parse_frame(pack_segments(listed, 64) + bytes(100)) == listed


@given(
    st.lists(
        st.builds(Segment, st.sampled_from([1, 3, 4, 5, 6, 17, 31]), st.binary(max_size=30)), min_size=1, max_size=6
    )
)
def test_segments_round_trip(listed: list[Segment]) -> None:
    assert parse_frame(pack_segments(listed, 256)) == tuple(listed)


@given(symbols(), st.data())
def test_burst_of_up_to_16_wrong_bits_is_detected(symbol: Symbol, data: st.DataObject) -> None:
    frame = bytearray(pack_symbol(symbol))
    start, length = data.draw(st.integers(0, 8 * len(frame) - 16)), data.draw(st.integers(1, 16))
    pattern = data.draw(st.integers(0, 2 ** (length - 1) - 1)) << 1 | 1
    value = int.from_bytes(frame, "big") ^ pattern << start
    damaged = value.to_bytes(len(frame), "big")
    if damaged.endswith(b"\0"):
        return  # the parser then tries shorter lengths, which the guarantee excludes
    with pytest.raises(FrameError, match="checksum"):
        parse_frame(damaged)


@pytest.mark.parametrize("frame", [b"", bytes(1), bytes(4), bytes(5), bytes(64), b"\xff" * 64, b"T0000" + bytes(59)])
def test_other_bytes_are_rejected(frame: bytes) -> None:
    with pytest.raises(FrameError, match="checksum" if len(frame) == 64 else None):
        parse_frame(frame)


@pytest.mark.parametrize(
    ("listed", "frame_bytes"),
    [
        ([], 64),
        ([Segment(SegmentKind.CONTACT, b"short")], 64),
        ([Segment(0, b"")], 64),
        ([Segment(32, b"")], 64),
        ([Segment(1, bytes(60))], 32),
    ],
)
def test_invalid_segments_are_rejected(listed: list[Segment], frame_bytes: int) -> None:
    with pytest.raises(FrameError):
        pack_segments(listed, frame_bytes)


@pytest.mark.parametrize(
    "covered",
    [
        b"\x00\xff\x05data",  # index 255
        b"\x00\x00\x00data",  # k = 0
        b"\x41\x09abc",  # a message longer than the frame
        b"\x42abcde",  # a contact that is cut
        b"\x40aaaa",  # no segment
        b"\x41\x01a\x40aa",  # a kind above 31
    ],
)
def test_invalid_fields_are_rejected(covered: bytes) -> None:
    with pytest.raises(FrameError, match="acoustic frame"):
        parse_frame(checksum(covered).to_bytes(2, "big") + covered)
