"""Payloads of the v1 format: previews, pieces, messages, layers and feedback."""

import zlib
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import FrameError
from sonarpost.link.coding.delivery_ledger import LossMeter
from sonarpost.link.coding.erasure_code import Layering, layered_symbols, recover_layer, recover_layering
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.payload_objects import (
    Feedback,
    MessageObject,
    PieceList,
    Preview,
    RefineRequest,
    StreamPiece,
    contact_link,
    entry_shape,
    number_after,
    unpack_mini,
    unpack_object,
)

CONTACT = ContactSummary(lat_deg=44.7, lon_deg=-63.6, confidence=1.0).rounded()


@given(st.integers(1, 65535), st.binary(max_size=60), st.integers(29, 100))
def test_preview_round_trip(number: int, stream: bytes, entry_bytes: int) -> None:
    room = entry_bytes - 29
    preview = Preview(number, CONTACT, stream[:room], ended=len(stream) < room)
    entry = preview.pack(entry_bytes)
    assert len(entry) == entry_bytes
    assert Preview.unpack(entry) == preview


def test_preview_with_a_wrong_byte_is_rejected() -> None:
    entry = Preview(7, CONTACT, bytes(range(30))).pack(59)
    for place in range(59):
        with pytest.raises(FrameError):
            Preview.unpack(entry[:place] + bytes([entry[place] ^ 1]) + entry[place + 1 :])


def test_preview_must_fill_its_entry_or_end() -> None:
    with pytest.raises(FrameError):
        Preview(7, CONTACT, b"short").pack(59)
    with pytest.raises(FrameError):
        Preview(0, CONTACT, b"").pack(29)


@pytest.mark.parametrize(
    ("symbol_bytes", "entries", "symbols", "entry_bytes"),
    [(27, 1, 2, 54), (43, 1, 2, 86), (44, 1, 1, 44), (59, 1, 1, 59), (112, 2, 1, 56), (251, 4, 1, 62)],
)
def test_entry_layout_by_symbol_length(symbol_bytes: int, entries: int, symbols: int, entry_bytes: int) -> None:
    shape = entry_shape(symbol_bytes)
    assert (shape.entries, shape.symbols, shape.entry_bytes) == (entries, symbols, entry_bytes)
    assert shape.source_symbols(5) == -(-5 * symbols // entries)
    assert shape.prefix_bytes >= 15


pieces = st.lists(
    st.builds(StreamPiece, st.integers(1, 65535), st.integers(0, 255), st.integers(0, 60000), st.binary(max_size=200)),
    min_size=1,
    max_size=8,
)


@given(pieces, st.booleans(), st.integers(0, 50), st.data())
def test_pieces_and_the_layer_above_round_trip(
    listed: list[StreamPiece], final: bool, spare: int, data: st.DataObject
) -> None:
    group = PieceList(tuple(listed), final)
    length = group.overhead_bytes() + sum(len(p.data) for p in listed) + spare
    packed = group.pack(length)
    assert len(packed) == length
    assert unpack_object(packed) == group
    above = PieceList(
        tuple(StreamPiece(p.number, p.link, p.stop, data.draw(st.binary(max_size=9))) for p in listed), True
    )
    length = above.overhead_bytes(group.ends) + sum(len(p.data) for p in above.pieces)
    assert unpack_object(above.pack(length, group.ends), group.ends) == above
    with pytest.raises(FrameError):
        unpack_object(above.pack(length, group.ends))  # without the layer below
    with pytest.raises(FrameError, match="at most"):
        group.pack(group.overhead_bytes() + sum(len(p.data) for p in listed) - 1)


def test_consecutive_contacts_with_one_start_cost_three_bytes_each() -> None:
    listed, number = [], 65534
    for _ in range(4):
        listed.append(StreamPiece(number, 9, 30, bytes(200)))
        number = number_after(number)
    assert [p.number for p in listed] == [65534, 65535, 1, 2]
    group = PieceList(tuple(listed), final=True)
    assert group.overhead_bytes() == 5 + 4 * 3 + 4
    assert unpack_object(group.pack(group.overhead_bytes() + 800)) == group


def test_object_with_a_wrong_byte_is_rejected() -> None:
    packed = MessageObject(3, b"status: fine").pack(30)
    assert unpack_object(packed) == MessageObject(3, b"status: fine")
    for place in range(30):
        with pytest.raises(FrameError, match="check"):
            unpack_object(packed[:place] + bytes([packed[place] ^ 64]) + packed[place + 1 :])


@pytest.mark.parametrize(
    "body", [b"\x30", b"\x20\x01\x00\x09abc", b"\x10\x00\x00\x01", b"\x18\x01\x00\x05\x09\xff\xff\xff\x7f"]
)
def test_invalid_objects_are_rejected(body: bytes) -> None:
    with pytest.raises(FrameError):
        unpack_object(body + zlib.crc32(body).to_bytes(4, "big"))


def test_the_link_depends_on_number_and_record() -> None:
    links = {contact_link(n, ContactSummary(confidence=c).pack()) for n in range(1, 20) for c in (0.0, 1.0)}
    assert len(links) > 30


@st.composite
def layerings(draw: st.DrawFn) -> Layering:
    layers = draw(st.integers(1, 4))
    cuts = sorted(draw(st.lists(st.integers(1, 15), min_size=layers - 1, max_size=layers - 1, unique=True)))
    edges = [0, *cuts, 16]
    step = draw(st.integers(1, 20)) if layers > 1 else 0
    return Layering(draw(st.integers(4, 60)), step, tuple(b - a for a, b in pairwise(edges)))


@given(layerings(), st.integers(16, 80), st.randoms(use_true_random=False))
def test_each_layer_is_recovered_from_its_required_symbols(
    layering: Layering, symbol_bytes: int, random: np.random.Generator
) -> None:
    assert Layering.unpack(layering.pack()) == layering
    rng = np.random.default_rng(random.getrandbits(32))
    objects = [rng.integers(0, 256, n, dtype=np.uint8).tobytes() for n in layering.lengths(symbol_bytes)]
    order = [int(i) for i in rng.permutation(255)]
    made = dict(zip(order, layered_symbols(layering, objects, order), strict=True))
    assert recover_layering({i: made[i][0] for i in order[:4]}) == layering
    for layer, need in enumerate(layering.required_symbols):
        symbols = {i: made[i][1] for i in order[-need:]}
        assert {len(s) for s in symbols.values()} == {symbol_bytes}
        assert recover_layer(layering, layer, symbols) == objects[layer]


@pytest.mark.parametrize(
    ("first", "step", "shares"),
    [(3, 0, (16,)), (4, 1, (16,)), (4, 0, (8, 8)), (4, 1, (8, 9)), (200, 60, (8, 8)), (4, 1, (4, 4, 4, 2, 2))],
)
def test_invalid_layers_are_rejected(first: int, step: int, shares: tuple[int, ...]) -> None:
    with pytest.raises(FrameError, match="layered block"):
        Layering(first, step, shares)


def test_most_random_descriptors_are_rejected() -> None:
    rng, taken = np.random.default_rng(0), 0
    for _ in range(4000):
        try:
            Layering.unpack(rng.integers(0, 256, 4, dtype=np.uint8).tobytes())
            taken += 1
        except FrameError:
            pass
    assert taken < 4000 / 16


@given(st.integers(0, 31), st.integers(0, 65535), st.lists(st.integers(0, 255), max_size=16))
def test_feedback_round_trip_fits_the_smallest_frame(newest: int, frames: int, needs: list[int]) -> None:
    feedback = Feedback(newest, frames, tuple(needs))
    assert Feedback.unpack(feedback.pack()) == feedback
    assert 2 + 2 + len(feedback.pack()) <= 32
    for back, need in enumerate(needs):
        assert feedback.missing_of((newest - back) % 32) == need
    assert feedback.missing_of((newest + 1) % 32) is None


@pytest.mark.parametrize("data", [b"", b"\x00\x01", b"\x20\x00\x00", bytes(20)])
def test_invalid_feedback_is_rejected(data: bytes) -> None:
    with pytest.raises(FrameError):
        Feedback.unpack(data)


@given(st.integers(0, 31), st.integers(0, 255))
def test_mini_packet_has_one_block(block: int, needed: int) -> None:
    bits = block << 8 | needed
    assert unpack_mini(bits) == Feedback(block, None, (needed,))
    with pytest.raises(FrameError):
        unpack_mini(1 << 13 | bits)


def test_refine_request_round_trip() -> None:
    assert RefineRequest.unpack(RefineRequest(9, 700).pack()) == RefineRequest(9, 700)
    for data in (b"", b"\0\0\0\5", bytes(5)):
        with pytest.raises(FrameError):
            RefineRequest.unpack(data)


def test_loss_is_measured_between_feedback_messages() -> None:
    meter = LossMeter()
    meter.update(65500, 100)
    assert meter.loss is None
    meter.update(65501, 110)  # an interval that is too short
    assert meter.loss is None
    meter.update((65500 + 70) % 65536, 200)
    assert meter.loss == pytest.approx(0.3)
    meter.update((65500 + 70) % 65536, 300)
    assert meter.loss == pytest.approx(0.75 * 0.3 + 0.25)
