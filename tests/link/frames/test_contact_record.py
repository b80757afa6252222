"""The contact record: values round trip within the step of their field, or become unknown."""

import dataclasses
import math
import struct
from typing import Any

import pytest
from builders.record_strategies import STRATEGIES
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from sonarpost.errors import FrameError
from sonarpost.link.frames.contact_record import (
    RECORD_SIZE,
    ContactSummary,
    atd_class_of,
    contact_and_size,
    contact_of,
    exact_record,
    summary_of,
)
from sonarpost.messages import Contact
from sonarpost.sonar.survey import Side


def maybe(strategy: st.SearchStrategy[float]) -> st.SearchStrategy[float | None]:
    return st.none() | strategy


SIZES = st.none() | st.tuples(st.integers(16, 512), st.integers(16, 512))
FIXES = st.none() | st.tuples(st.floats(-90, 90), st.floats(-180, 180), maybe(st.floats(0, 5500)))
CLASSES = st.sampled_from([None, "mine_like", "clutter", "structure"])
PLACES = st.none() | st.tuples(st.sampled_from(Side), maybe(st.floats(0, 3276)))


@st.composite
def probabilities(draw: st.DrawFn) -> tuple[float, float]:
    """Draw p_mine_like and p_other_object; their sum is often exactly 1."""
    mine_like = draw(st.floats(0, 1))
    return mine_like, draw(st.just(1 - mine_like) | st.floats(0, 1 - mine_like))


@st.composite
def contacts(draw: st.DrawFn) -> ContactSummary:
    """Draw a contact with values that the record can hold, in either layout."""
    p_mine_like, p_other_object = draw(st.none() | probabilities()) or (None, None)
    height_px, width_px = draw(SIZES) or (None, None)
    lat_deg, lon_deg, sigma_m = draw(FIXES) or (None, None, None)
    side, ground_range_m = draw(PLACES) or (None, None)
    return ContactSummary(
        height_px=height_px,
        width_px=width_px,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        time_utc_s=draw(maybe(st.floats(0, 4e9))),
        confidence=draw(maybe(st.floats(0, 2))),
        heading_deg=draw(maybe(st.floats(-720, 720))),
        altitude_m=draw(maybe(st.floats(0, 127))),
        depth_m=draw(maybe(st.floats(0, 6553))),
        side=side,
        ground_range_m=ground_range_m,
        pixel_along_m=draw(maybe(st.floats(0.005, 2.69))),
        pixel_across_m=draw(maybe(st.floats(0.005, 2.69))),
        position_sigma_m=sigma_m,
        atd_class=draw(CLASSES),
        p_mine_like=p_mine_like,
        p_other_object=p_other_object,
    )


def unknown_fields(contact: ContactSummary) -> set[str]:
    return {f.name for f in dataclasses.fields(contact) if getattr(contact, f.name) is None}


HALF_STEPS = {
    "height_px": 0,
    "width_px": 0,
    "lat_deg": 0.5e-7,
    "lon_deg": 0.5e-7,
    "time_utc_s": 0.5,
    "confidence": 0.5 / 127,
    "altitude_m": 0.25,
    "depth_m": 0.05,
    "ground_range_m": 0.05,
}
CLASSIFIED_HALF_STEPS = HALF_STEPS | {"lat_deg": 2e-7, "lon_deg": 2e-7, "p_mine_like": 0.025, "p_other_object": 0.025}


@given(contacts())
@example(ContactSummary(lat_deg=90.0, lon_deg=180.0, atd_class="structure"))
@example(ContactSummary(lat_deg=-90.0, lon_deg=-180.0, p_mine_like=0.83, p_other_object=0.17))
def test_values_round_trip_within_half_a_step(sent: ContactSummary) -> None:
    packed = sent.pack()
    assert len(packed) == RECORD_SIZE
    read = ContactSummary.unpack(packed)
    assert read == sent.rounded() == read.rounded()
    assert unknown_fields(read) == unknown_fields(sent)
    assert read.side is sent.side
    assert read.atd_class == sent.atd_class
    for name, half_step in (CLASSIFIED_HALF_STEPS if sent.is_classified else HALF_STEPS).items():
        if getattr(sent, name) is not None:
            assert abs(getattr(read, name) - getattr(sent, name)) <= half_step * (1 + 1e-6) + 1e-12, name
    if sent.heading_deg is not None and read.heading_deg is not None:
        turn = (read.heading_deg - sent.heading_deg + 180) % 360 - 180
        assert abs(turn) <= 180 / 255 + 1e-9
        assert 0 <= read.heading_deg < 360
    for name in ("pixel_along_m", "pixel_across_m"):
        if getattr(sent, name) is not None:
            assert abs(math.log2(getattr(read, name) / getattr(sent, name))) <= 0.5 / 28 + 1e-3
    if sent.position_sigma_m is not None and read.position_sigma_m is not None:
        assert read.position_sigma_m >= sent.position_sigma_m * (1 - 1e-9)
        assert read.position_sigma_m <= max(0.1, sent.position_sigma_m) * 2 ** (1 / 16) * (1 + 1e-9)


@given(contacts())
def test_only_the_classified_layout_begins_with_a_set_bit(sent: ContactSummary) -> None:
    """In the plain layout the first 12 bits are the height of the image, at most 512 px."""
    packed = sent.pack()
    first_12_bits = int.from_bytes(packed[:2], "big") >> 4
    assert (first_12_bits > 512) == sent.is_classified == (sent.atd_class is not None or sent.p_mine_like is not None)
    without = dataclasses.replace(sent, atd_class=None, p_mine_like=None, p_other_object=None)
    assert packed[11:] == without.pack()[11:]


def classified_head(*, sizes: int = 0, probabilities: int = 255, class_code: int = 1) -> bytes:
    """Return the first 11 bytes of the classified layout without a position, as the specification lists the bits."""
    no_fix = 1 << 58 | 1 << 29
    return (1 << 87 | class_code << 85 | probabilities << 77 | sizes << 59 | no_fix).to_bytes(11, "big")


@given(st.binary(min_size=RECORD_SIZE, max_size=RECORD_SIZE), st.integers(128, 255))
def test_any_record_that_parses_packs_to_the_same_bytes(data: bytes, first: int) -> None:
    # The last ones without a size and a position, which random bytes rarely have in range.
    head = classified_head(probabilities=data[0] % 231, class_code=first & 3)
    for candidate in (data, bytes([first]) + data[1:], head + data[11:]):
        try:
            contact = ContactSummary.unpack(candidate)
        except FrameError:
            continue
        assert contact.is_classified == (candidate[0] >= 128)
        assert contact.pack() == candidate


@given(
    st.sampled_from([b"\0\0\0", b"\x02\x00\x50", b"\x02\x00\x00", b"\x00\xf0\x50", b"\x02\x02\x01"])
    | st.binary(min_size=3, max_size=3),
    st.sampled_from([(-(2**31), -(2**31)), (1, 2), (-(2**31), 2), (900_000_001, 2), (1, -1_800_000_001)]),
    st.binary(min_size=14, max_size=14),
    st.booleans(),
)
def test_contact_and_size_are_those_of_a_summary_or_both_are_rejected(
    size: bytes, fix: tuple[int, int], tail: bytes, has_sigma: bool
) -> None:
    data = struct.pack(">3sii14s", size, *fix, tail if has_sigma else tail[:13] + b"\xff")
    try:
        summary = ContactSummary.unpack(data)
        expected = contact_of(summary, "uuv-1", "000A"), summary.height_px, summary.width_px
    except (FrameError, ValidationError):
        with pytest.raises((FrameError, ValidationError)):
            contact_and_size(data, "uuv-1", "000A")
        return
    assert contact_and_size(data, "uuv-1", "000A") == expected


def test_all_codes_of_class_and_probabilities_round_trip_or_are_rejected() -> None:
    tail = ContactSummary().pack()[11:]
    values, rejected = set(), []
    for class_code in range(4):
        for code in range(256):
            data = classified_head(probabilities=code, class_code=class_code) + tail
            try:
                contact = ContactSummary.unpack(data)
            except FrameError as error:
                rejected.append((class_code, code, error.field))
                continue
            assert contact.pack() == data
            values.add((contact.atd_class, contact.p_mine_like, contact.p_other_object))
    reserved = [(c, code, "probabilities") for c in range(4) for code in range(231, 255)]
    assert sorted(rejected) == sorted([*reserved, (0, 255, "class")])
    assert len(values) == 4 * 232 - 1
    for _, p_mine_like, p_other_object in values - {(c, None, None) for c in ("mine_like", "clutter", "structure")}:
        assert p_mine_like + p_other_object <= 1 + 1e-9


def test_all_sides_of_the_classified_layout_round_trip_or_are_rejected() -> None:
    tail = ContactSummary().pack()[11:]
    for height, width in ((h, w) for h in range(512) for w in (0, 14, 15, 79, 511)):
        data = classified_head(sizes=height << 9 | width) + tail
        fits = (height, width) == (0, 0) or (height >= 15 and width >= 15)
        try:
            contact = ContactSummary.unpack(data)
        except FrameError:
            assert not fits
            continue
        assert fits
        assert contact.pack() == data
        assert (contact.height_px, contact.width_px) == ((height + 1, width + 1) if height else (None, None))


def test_position_out_of_range_is_rejected_in_the_classified_layout() -> None:
    data = ContactSummary(lat_deg=90.0, lon_deg=180.0, atd_class="clutter").pack()
    head = int.from_bytes(data[:11], "big")
    for step, named in ((1 << 30, "lat_deg"), (1, "lon_deg")):
        with pytest.raises(FrameError) as caught:
            ContactSummary.unpack((head + step).to_bytes(11, "big") + data[11:])
        assert caught.value.field == named


def test_only_classes_of_the_layout_are_carried() -> None:
    assert [*map(atd_class_of, ("mine_like", "clutter", "structure"))] == ["mine_like", "clutter", "structure"]
    assert [atd_class_of(name) for name in (None, "", "sphere", "Structure")] == [None] * 4


@pytest.mark.parametrize("position", [20, 21, 22, 27, 28, 29])
def test_all_codes_of_one_byte_fields_round_trip(position: int) -> None:
    # Random records rarely have an image size and a position in range, so this test covers all codes.
    base = bytearray(ContactSummary(height_px=80, width_px=140, lat_deg=1, lon_deg=2).pack())
    values = []
    for code in range(256):
        base[position - 5] = code
        contact = ContactSummary.unpack(bytes(base))
        assert contact.pack() == bytes(base)
        values.append(contact)
    assert len(set(values)) == 256


@pytest.mark.parametrize("start", [18, 20])
def test_all_codes_of_two_byte_fields_round_trip(start: int) -> None:
    base = bytearray(ContactSummary().pack())
    rejected = []
    for code in {*range(0, 65536, 97), *range(512), *range(65024, 65536)}:
        base[start : start + 2] = struct.pack(">H", code)
        try:
            contact = ContactSummary.unpack(bytes(base))
        except FrameError:
            rejected.append(code)
            continue
        assert contact.pack() == bytes(base)
    assert rejected == ([] if start == 18 else [0xFFFE])


OUT_OF_RANGE = {
    "altitude_m": (127.3, -0.3, 1e308),
    "depth_m": (6553.5, -1.0),
    "ground_range_m": (3276.6, 1.7e308),
    "pixel_along_m": (2.8, 0.0049),
    "pixel_across_m": (0.0, 1.7e308, 5e-324),
    "position_sigma_m": (6100.0, 1.7e308),
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name in OUT_OF_RANGE for value in OUT_OF_RANGE[name]])
def test_value_out_of_the_field_range_is_sent_as_unknown(name: str, value: float) -> None:
    contact = dataclasses.replace(ContactSummary(lat_deg=1, lon_deg=2, side=Side.STARBOARD), **{name: value})
    read = contact.rounded()
    assert getattr(read, name) is None
    assert read.side is Side.STARBOARD


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"height_px": 80}, "height_px and width_px"),
        ({"height_px": 15, "width_px": 80}, "height_px"),
        ({"height_px": 80, "width_px": 513}, "width_px"),
        ({"lon_deg": 1.0}, "lat_deg and lon_deg"),
        ({"lat_deg": 90.1, "lon_deg": 0.0}, "lat_deg"),
        ({"lat_deg": 0.0, "lon_deg": -180.1}, "lon_deg"),
        ({"lat_deg": math.nan, "lon_deg": 0.0}, "lat_deg"),
        ({"time_utc_s": -1.0}, "time_utc_s"),
        ({"time_utc_s": 2.0**32}, "time_utc_s"),
        ({"confidence": 2.1}, "confidence"),
        ({"heading_deg": math.inf}, "heading_deg"),
        ({"altitude_m": math.nan}, "altitude_m"),
        ({"depth_m": -math.inf}, "depth_m"),
        ({"ground_range_m": 10.0}, "side"),
        ({"ground_range_m": -1.0, "side": Side.PORT}, "ground_range_m"),
        ({"side": "Starboard"}, "side"),
        ({"pixel_along_m": -0.1}, "pixel_along_m"),
        ({"position_sigma_m": 1.0}, "lat_deg"),
        ({"atd_class": "sphere"}, "atd_class"),
        ({"p_mine_like": 0.5}, "p_mine_like and p_other_object"),
        ({"p_other_object": 0.5}, "p_mine_like and p_other_object"),
        ({"p_mine_like": -0.1, "p_other_object": 0.5}, "p_mine_like"),
        ({"p_mine_like": 0.5, "p_other_object": 1.1}, "p_other_object"),
        ({"p_mine_like": math.nan, "p_other_object": 0.5}, "p_mine_like"),
        ({"p_mine_like": 0.6, "p_other_object": 0.41}, "p_mine_like + p_other_object"),
    ],
)
def test_impossible_values_are_rejected(fields: dict[str, Any], named: str) -> None:
    with pytest.raises(FrameError) as caught:
        ContactSummary(**fields)
    assert caught.value.field == named


def test_decoded_sigma_gives_the_same_code() -> None:
    assert ContactSummary(lat_deg=1, lon_deg=2, position_sigma_m=0.0).rounded().position_sigma_m == pytest.approx(0.1)
    for code in range(255):
        value = 0.1 * 2 ** (code / 16)
        for near in (value, math.nextafter(value, 0), math.nextafter(value, math.inf), value * (1 + 1e-13)):
            packed = ContactSummary(lat_deg=1, lon_deg=2, position_sigma_m=near).pack()
            assert packed[24] == code


@pytest.mark.parametrize("length", [0, RECORD_SIZE - 1, RECORD_SIZE + 1])
def test_other_length_is_rejected(length: int) -> None:
    with pytest.raises(FrameError, match="25 bytes"):
        ContactSummary.unpack(bytes(length))


@pytest.mark.parametrize(
    ("time_utc_s", "expected"), [(4294967294.0, 4294967294.0), (4294967294.5, None), (4294967295.0, None)]
)
def test_time_that_the_record_cannot_hold_is_unknown(time_utc_s: float, expected: float | None) -> None:
    summary = summary_of(Contact(contact_id="c", vehicle_id="uuv-1", time_utc_s=time_utc_s), None, None)
    assert ContactSummary.unpack(summary.pack()).time_utc_s == expected


SOME_SIDES = st.none() | st.integers(1, 600)


@given(contacts(), st.sampled_from(sorted(Contact.model_fields.keys() - {"vehicle_id"})), SOME_SIDES, st.data())
def test_exact_record_is_read_as_the_same_contact_or_is_empty(
    sent: ContactSummary, changed: str, side_px: int | None, data: st.DataObject
) -> None:
    """A contact as it was received has an exact record; one with a change has it only if the change is read as well."""
    received = sent.rounded()
    contact = contact_of(received, "uuv-1", "000A")
    assert exact_record(contact, received.height_px, received.width_px) == received.pack()
    size = data.draw(st.sampled_from([(received.height_px, received.width_px), (side_px, 80), (80, side_px)]))
    drawn: Contact = data.draw(STRATEGIES[Contact])
    try:
        contact = Contact.model_validate(contact.model_dump() | {changed: getattr(drawn, changed)})
    except ValidationError:
        contact = drawn
    packed = exact_record(contact, *size)
    try:
        read = summary_of(contact, *size).rounded()
    except FrameError:
        assert packed == b""
        return
    identifiers = {"contact_id": contact.contact_id, "vehicle_id": contact.vehicle_id}
    is_exact = contact_of(read, "uuv-1", "000A").model_copy(update=identifiers) == contact
    is_exact &= (read.height_px, read.width_px) == size
    assert packed == (read.pack() if is_exact else b"")
