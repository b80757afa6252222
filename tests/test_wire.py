"""Encoding of records: golden vectors, arbitrary bytes, error messages."""

import math

import msgpack
import pytest
from builders.record_samples import RECORD_TYPES, SAMPLES, vectors
from builders.record_strategies import any_record
from builders.record_vectors import BATCH, batch_samples, delivery_samples, plain
from hypothesis import example, given
from hypothesis import strategies as st

from sonarpost import wire
from sonarpost.delivery.protocol import AckReply, attachment, pack_replies, parse_query, unpack_replies
from sonarpost.delivery.records import OutboxItem, ReceivedChunk
from sonarpost.errors import PayloadError
from sonarpost.messages import Contact, Pixels

KEY = "sonarpost/v1/uuv-1/somewhere"

# Golden vectors


def with_fields_of(vector, present):
    """Return a value without the fields that its records have gained since the vector was made."""
    if not isinstance(vector, dict) or not isinstance(present, dict):
        return present
    return {name: with_fields_of(vector[name], value) for name, value in present.items() if name in vector}


@pytest.mark.parametrize("record_type", RECORD_TYPES, ids=lambda t: t.TYPE)
def test_golden_bytes_decode_and_are_encoded_again(record_type):
    fields = {"type", "v", *record_type.model_fields}
    found = vectors(record_type.TYPE)
    assert any(set(vector["fields"]) == fields for vector in found.values())
    encoded = 0
    for name, vector in found.items():
        payload = bytes.fromhex(vector["hex"])
        # Any msgpack library decodes the bytes to the fields of the vector.
        assert plain(msgpack.unpackb(payload)) == vector["fields"]
        record = wire.decode(record_type, payload, KEY)
        dumped = plain({"type": record_type.TYPE, "v": record_type.VERSION, **record.model_dump()})
        for field, value in vector["fields"].items():
            assert with_fields_of(value, dumped[field]) == value, (name, field)
        present = plain(record.model_dump(exclude_defaults=record.SPARSE))
        if with_fields_of(vector["fields"], present) == present:
            assert wire.encode(record).hex() == vector["hex"], name
            encoded += 1
    assert encoded


def test_golden_delivery_messages_parse_and_encode_unchanged():
    made = delivery_samples()
    for name, vector in vectors("delivery-reply").items():
        payload, fields = bytes.fromhex(vector["hex"]), vector["fields"]
        reply = AckReply.unpack(payload, KEY)
        assert (reply.status, reply.next_offset, reply.reason) == (fields["status"], fields["next"], fields["reason"])
        assert reply.max_batch == fields.get("takes", 0)
        assert made["delivery-reply"][name] == payload == reply.pack(reply.max_batch)
    for name, vector in vectors("delivery-attachment").items():
        payload, fields = bytes.fromhex(vector["hex"]), vector["fields"]
        size = min(32768, fields["size"] - fields["offset"])
        chunk = parse_query(payload, bytes(size), KEY)
        assert isinstance(chunk, ReceivedChunk)
        assert plain({"origin": chunk.origin, "sha256": chunk.sha256}) == {
            "origin": fields["origin"],
            "sha256": fields["sha256"],
        }
        assert (chunk.seq, chunk.size, chunk.offset) == (fields["seq"], fields["size"], fields["offset"])
        assert made["delivery-attachment"][name] == payload
        item = OutboxItem(fields["consumer"], chunk.seq, "k", "", 4, bytes(chunk.size), chunk.sha256)
        assert chunk.done_up_to == fields.get("done_up_to", 0)
        assert attachment(chunk.origin, item, chunk.offset, chunk.done_up_to) == payload


def test_golden_batch_messages_parse_and_encode_unchanged():
    made = batch_samples()
    sizes = [size for _, size in BATCH]
    data = b"".join(bytes([number]) * size for number, size in enumerate(sizes))
    for name, vector in vectors("delivery-batch-attachment").items():
        payload, fields = bytes.fromhex(vector["hex"]), vector["fields"]
        chunks = parse_query(payload, data, KEY)
        assert isinstance(chunks, tuple)
        assert [[c.seq, c.size] for c in chunks] == fields["records"]
        assert [c.data for c in chunks] == [bytes([number]) * size for number, size in enumerate(sizes)]
        assert {c.done_up_to for c in chunks} == {fields.get("done_up_to", 0)}
        assert {c.origin.hex() for c in chunks} == {fields["origin"]["$hex"]}
        assert made["delivery-batch-attachment"][name] == payload
    for name, vector in vectors("delivery-batch-reply").items():
        payload, fields = bytes.fromhex(vector["hex"]), vector["fields"]
        replies = unpack_replies(payload, 3, KEY)
        assert isinstance(replies, tuple)
        assert [[reply.status, reply.reason] for reply in replies] == (fields["replies"] or 3 * [["stored", ""]])
        assert made["delivery-batch-reply"][name] == payload == pack_replies(replies)


# Round trips


@given(any_record)
@example(SAMPLES["part-whole"])
def test_record_round_trip_as_a_map_with_type_and_version_first(record):
    payload = wire.encode(record)
    back = wire.decode(type(record), payload, KEY)
    assert back == record
    assert wire.encode(back) == payload
    fields = msgpack.unpackb(payload)
    names = record.model_dump(exclude_defaults=True) if record.SPARSE else type(record).model_fields
    assert list(fields) == ["type", "v", *names]
    assert (fields["type"], fields["v"]) == (record.TYPE, record.VERSION)
    assert wire.encoding_of(type(record)) == f"application/msgpack;schema=sonarpost.{record.TYPE}.v{record.VERSION}"


# External data is a record or a PayloadError

TEXT, BINARY = st.text(max_size=8), st.binary(max_size=8)
msgpack_values = st.recursive(
    st.sampled_from([None, False, True])
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | TEXT
    | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=12,
)
record_types = st.sampled_from(RECORD_TYPES)


def record_or_payload_error(record_type, payload):
    try:
        record = wire.decode(record_type, payload, KEY)
    except PayloadError as error:
        assert error.where == KEY  # noqa: PT017  # both results are valid
        assert error.field  # noqa: PT017
        assert KEY in str(error)  # noqa: PT017
        assert ", expected " in str(error)  # noqa: PT017
        return
    assert type(record) is record_type


@given(record_types, st.binary(max_size=200) | msgpack_values.map(msgpack.packb))
def test_arbitrary_payload_is_a_record_or_a_payload_error(record_type, payload):
    record_or_payload_error(record_type, payload)


@given(st.data())
def test_arbitrary_field_value_is_a_record_or_a_payload_error(data):
    sample = data.draw(st.sampled_from(list(SAMPLES.values())))
    fields = msgpack.unpackb(wire.encode(sample))
    for _ in range(4):
        changed = fields | {data.draw(st.sampled_from(sorted(fields))): data.draw(msgpack_values)}
        record_or_payload_error(type(sample), msgpack.packb(changed))


@given(st.data())
def test_damaged_bytes_are_a_record_or_a_payload_error(data):
    sample = data.draw(st.sampled_from(list(SAMPLES.values())))
    payload = bytearray(wire.encode(sample))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    record_or_payload_error(type(sample), bytes(payload[: data.draw(st.integers(0, len(payload)))]))


NO_MAPS = "c1 8000 810102 81c4016102 90 c0 81a1ff01 dfffffffff ddffffffff c6ffffffff d6ffffffffff c703ff000000 819001"


@pytest.mark.parametrize(
    "text", ["", "818001", *NO_MAPS.split(), "91" * 100_000, "81a161" * 50_000], ids=lambda text: text[:16]
)
def test_payload_must_be_a_map_with_text_keys(text):
    with pytest.raises(PayloadError, match="a msgpack map") as caught:
        wire.unpack_map(bytes.fromhex(text), KEY)
    assert (caught.value.where, caught.value.field) == (KEY, "payload")
    assert len(str(caught.value)) < 400


def test_oversized_payload_is_rejected_unread(monkeypatch):
    monkeypatch.setattr(wire, "MAX_PAYLOAD_BYTES", 100)
    assert wire.unpack_map(msgpack.packb({"a": b"x" * 95}), KEY) == {"a": b"x" * 95}
    with pytest.raises(PayloadError, match="got '101 bytes', expected at most 100 bytes"):
        wire.unpack_map(msgpack.packb({"a": b"x" * 96}), KEY)


def test_largest_image_is_below_the_limit():
    raster = Pixels(height_px=4096, width_px=4096, bits=16, data=bytes(4096 * 4096 * 2))
    assert wire.decode(Pixels, wire.encode(raster), KEY) == raster


# Error messages


def of(sample, **change):
    return bytes(msgpack.packb(msgpack.unpackb(wire.encode(SAMPLES[sample])) | change))


@pytest.mark.parametrize(
    ("sample", "change", "message"),
    [
        ("contact-unclassified", {"type": "snippet"}, "type: got 'snippet', expected 'contact'"),
        ("contact-unclassified", {"v": 2}, "v: got 2, expected 1"),
        ("queue-state-counting", {"v": 1}, "v: got 1, expected 2"),
        ("contact-unclassified", {"v": 1.0}, "v: got 1.0, expected 1"),
        ("contact-unclassified", {"v": True}, "v: got True, expected 1"),
        ("contact-unclassified", {"lat_deg": "41"}, "lat_deg: got '41', expected a valid number"),
        ("contact-unclassified", {"lat_deg": 91}, "lat_deg: got 91, expected less than or equal to 90"),
        ("contact-unclassified", {"lat_deg": math.nan}, "lat_deg: got nan, expected a finite number"),
        ("contact-unclassified", {"channel": "up"}, "channel: got 'up', expected 'port' or 'starboard'"),
        ("contact-unclassified", {"ping_number": 1.0}, "ping_number: got 1.0, expected a valid integer"),
        ("raster-8-bits", {"data": b"1"}, "data: got b'1', expected 6 bytes for 3 × 2 px of 8 bits, not 1"),
        ("health", {"gauges": {"a": math.inf}}, "gauges.a: got inf, expected a finite number"),
        (
            "reconstructed-image-classified",
            {"missing_mask": b"12"},
            "missing_mask: got b'12', expected 0 or 1 bytes, not 2",
        ),
        ("snippet-classified", {"contact": {"contact_id": "c"}}, "contact.vehicle_id: got 'nothing', expected a value"),
    ],
)
def test_error_names_key_field_value_and_expectation(sample, change, message):
    with pytest.raises(PayloadError) as caught:
        wire.decode(type(SAMPLES[sample]), of(sample, **change), KEY)
    assert caught.value.field == message.partition(":")[0]
    assert str(caught.value) == f"{KEY}: {message}"


@pytest.mark.parametrize("name", ["type", "v"])
def test_type_and_version_are_required(name):
    fields = msgpack.unpackb(wire.encode(SAMPLES["contact-unclassified"]))
    del fields[name]
    with pytest.raises(PayloadError) as caught:
        wire.decode(Contact, msgpack.packb(fields), KEY)
    assert caught.value.field == name


# Other languages and newer versions


@given(st.sampled_from(list(SAMPLES.values())), msgpack_values)
def test_unknown_fields_are_ignored(sample, value):
    fields = msgpack.unpackb(wire.encode(sample)) | {"invented_later": value}
    assert wire.decode(type(sample), msgpack.packb(fields), KEY) == sample


def test_unknown_nested_fields_are_ignored():
    sample = SAMPLES["snippet-classified"]
    fields = msgpack.unpackb(wire.encode(sample))
    fields["contact"]["invented_later"] = fields["pixels"]["and_this"] = [1]
    assert wire.decode(type(sample), msgpack.packb(fields), KEY) == sample


def test_optional_fields_can_be_absent_and_order_is_free():
    small = {"vehicle_id": "uuv-1", "v": 1, "contact_id": "c1", "type": "contact"}
    assert wire.decode(Contact, msgpack.packb(small), KEY) == SAMPLES["contact-unclassified"]


def test_integers_and_single_precision_are_valid_for_floats():
    whole = wire.decode(Contact, of("contact-unclassified", lat_deg=41, heading_deg=0), KEY)
    assert (whole.lat_deg, whole.heading_deg) == (41.0, 0.0)
    assert isinstance(whole.lat_deg, float)
    short = msgpack.packb(msgpack.unpackb(of("contact-unclassified", lat_deg=0.5)), use_single_float=True)
    assert b"\xca" in short
    assert wire.decode(Contact, short, KEY).lat_deg == 0.5
