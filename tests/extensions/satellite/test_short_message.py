"""Format of short messages: golden bytes, round trip, hostile input."""

import json
import math

import msgpack
import pytest
from builders.common import REPOSITORY
from extensions.satellite.records import decision, golden, received, with_crc
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import BadInputError
from sonarpost.extensions.satellite.receiver import ShortMessageReceiver
from sonarpost.extensions.satellite.short_message import (
    FRAGMENT_BYTES,
    MAX_ACKNOWLEDGEMENT_BYTES,
    MAX_ITEM_BYTES,
    MAX_MESSAGE_BYTES,
    Item,
    ItemType,
    ShortAcknowledgement,
    ShortMessage,
    ShortMessageError,
    contact_head_bytes,
    decision_fragments,
    fragment,
    pack_contact,
    pack_decision,
    unpack_contact,
    unpack_decision,
)

GOLDEN = json.loads((REPOSITORY / "tests/golden/short-message/v1.json").read_text())


def test_golden_messages_are_written_and_read_for_ever():
    assert golden() == GOLDEN
    receiver = ShortMessageReceiver("vessel-1")
    records = receiver.receive(bytes.fromhex(GOLDEN["contact with preview"]), 0.0)
    assert records == [received()]
    records = receiver.receive(bytes.fromhex(GOLDEN["decision and image without contact record"]), 0.0)
    assert records == [decision(), received(2, 0, contact=False)]
    parts = [bytes.fromhex(text) for name, text in GOLDEN.items() if name.startswith("fragment")]
    found = [ShortMessageReceiver.receive(receiver, part, 0.0) for part in reversed(parts)]
    assert found == [[]] * (len(parts) - 1) + [[decision("d2", remark="r" * 600)]]
    ack = ShortAcknowledgement.unpack(bytes.fromhex(GOLDEN["acknowledgement"]))
    assert ack == ShortAcknowledgement(0x01020304, 17, frozenset({18, 25, 40}))


@given(st.integers(0, 500), st.booleans(), st.integers(1, 9999), st.integers(1, 2**32 - 1))
def test_contact_with_a_preview_that_fits_is_the_same_record(stream_bytes, contact, number, version):
    image = received(number, stream_bytes, contact=contact, version=version)
    content = pack_contact(image)
    assert len(content) <= MAX_ITEM_BYTES
    again = unpack_contact(content, "vessel-1")
    preview = content[contact_head_bytes(content) :]
    if len(preview) == stream_bytes:
        assert again == image
    else:
        assert again.stream == preview + bytes(stream_bytes - len(preview))
        assert again.missing == ((len(preview), stream_bytes),)
        assert not again.complete
        assert again.bytes_received == len(preview) < again.bytes_total == stream_bytes
    assert (again.contact, again.version, again.first_frame_utc_s) == (image.contact, version, image.first_frame_utc_s)


def test_preview_ends_before_the_first_missing_byte():
    image = received(1, 200).model_copy(update={"missing": ((50, 80),), "complete": False, "bytes_received": 170})
    assert unpack_contact(pack_contact(image), "vessel-1").missing == ((50, 200),)
    headless = image.model_copy(update={"missing": ((0, 80),)})
    again = unpack_contact(pack_contact(headless), "vessel-1")
    assert (again.stream, again.contact) == (b"", image.contact)


def test_short_message_has_all_fields_of_a_decision():
    values = decision("d9").model_dump(exclude={"vessel_id"})
    packed = msgpack.unpackb(pack_decision(decision("d9")), use_list=False)
    assert packed == tuple(values.values())


@given(
    st.text(max_size=2000).filter(lambda text: not any("\ud800" <= c <= "\udfff" for c in text)),
    st.none() | st.floats(0, 1),
    st.lists(st.from_regex(r"[!-~]{1,64}", fullmatch=True), max_size=16),
)
def test_decision_is_the_same_record(remark, confidence, overrules):
    record = decision("d9", remark=remark, confidence=confidence, overrules=tuple(overrules))
    assert unpack_decision(pack_decision(record), "vessel-1") == record
    items = decision_fragments(pack_decision(record), 3)
    if len(items) > 1:
        content = b"".join(fragment(item.content)[3] for item in items)
        assert content == pack_decision(record)
    for n, item in enumerate(items):
        assert len(ShortMessage(1, n, 0, (item,)).pack()) <= MAX_MESSAGE_BYTES


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 300), st.sets(st.integers(0, 255)))
def test_acknowledgement_is_the_same(epoch, base, offsets):
    ack = ShortAcknowledgement(epoch, base, frozenset(base + n for n in offsets))
    packed = ack.pack()
    assert len(packed) <= MAX_ACKNOWLEDGEMENT_BYTES
    assert ShortAcknowledgement.unpack(packed) == ack


@given(st.binary(max_size=400))
def test_hostile_bytes_raise_the_documented_error_only(data):
    for body in (data, with_crc(data), with_crc(b"\xb1" + data[:330]), with_crc(b"\xb2" + data)):
        for parse in (
            lambda body: ShortMessageReceiver("vessel-1").receive(body, 0.0),
            ShortAcknowledgement.unpack,
            lambda body: unpack_contact(body, "vessel-1"),
            lambda body: unpack_decision(body, "vessel-1"),
            fragment,
        ):
            try:
                parse(body)
            except BadInputError:
                continue


@given(st.data())
def test_damaged_contact_raises_the_documented_error_only(data):
    content = bytearray(pack_contact(received()))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    message = ShortMessage(1, 0, 0, (Item(ItemType.CONTACT, bytes(content[: data.draw(st.integers(0, 340))])),))
    try:
        [record] = ShortMessageReceiver("vessel-1").receive(message.pack(), 0.0)
    except BadInputError:
        return
    assert math.isfinite(record.first_frame_utc_s)


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        (b"", "length: got 0"),
        (bytes(341), "length: got 341"),
        (bytes(20), "CRC"),
        (with_crc(bytes(10)), "type: got 0"),
        (with_crc(b"\xb1" + bytes(8) + b"\x05"), "oldest: got -5"),
        (with_crc(b"\xb1" + bytes(9) + b"\x01"), "item: got 1"),
        (with_crc(b"\xb1" + bytes(9) + b"\x09\0\0"), "item type: got 9"),
        (with_crc(b"\xb1" + bytes(9) + b"\x01\0\x05"), "item length: got 5"),
        (with_crc(b"\xb1" + bytes(9) + b"\x03\0\x07" + bytes(4) + b"\2\2x"), "fragment index: got 2"),
    ],
)
def test_error_names_the_invalid_field(message, problem):
    with pytest.raises(ShortMessageError, match=problem):
        ShortMessageReceiver("vessel-1").receive(message, 0.0)


def test_too_long_a_decision_is_refused():
    assert len(decision_fragments(bytes(255 * FRAGMENT_BYTES), 0)) == 255
    with pytest.raises(ShortMessageError, match="decision"):
        decision_fragments(bytes(255 * FRAGMENT_BYTES + 1), 0)
    with pytest.raises(ShortMessageError, match="values that fit"):
        pack_contact(received(version=2**32))
