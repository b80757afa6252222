"""Messages of the delivery protocol: one chunk or several records in a query, replies."""

import hashlib
from contextlib import suppress

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.delivery.protocol import (
    CHUNK_BYTES,
    MAX_BATCH_RECORDS,
    AckReply,
    attachment,
    batch_attachment,
    pack_replies,
    parse_query,
    unpack_replies,
)
from sonarpost.delivery.records import OutboxItem, ReceivedChunk
from sonarpost.errors import PayloadError

WHERE = "k/delivery/consumer"
ORIGIN = b"o" * 16
SHA = bytes(32)


def item(seq, payload):
    return OutboxItem("consumer", seq, "k", "", 4, payload, hashlib.sha256(payload).digest())


@given(st.dictionaries(st.integers(1, 2**63 - 1), st.binary(max_size=200), min_size=1, max_size=MAX_BATCH_RECORDS))
def test_packed_batch_parses_unchanged(records):
    items = [item(seq, payload) for seq, payload in records.items()]
    done_up_to = min(records) - 1
    chunks = parse_query(batch_attachment(ORIGIN, items, done_up_to), b"".join(records.values()), WHERE)
    assert chunks == tuple(
        ReceivedChunk(ORIGIN, i.seq, len(i.payload), i.sha256, 0, i.payload, done_up_to) for i in items
    )


def test_packed_chunk_parses_unchanged():
    sent = item(5, b"data")
    found = parse_query(attachment(ORIGIN, sent, 1, done_up_to=4), b"ata", WHERE)
    assert found == ReceivedChunk(ORIGIN, 5, 4, sent.sha256, 1, b"ata", 4)


SINGLE = msgpack.unpackb(attachment(ORIGIN, item(5, b"data")))
BATCH = msgpack.unpackb(batch_attachment(ORIGIN, [item(4, b"a"), item(9, b"b")]))
DIGESTS = BATCH["sha256"]


@pytest.mark.parametrize(
    ("fields", "change", "data", "field"),
    [
        (SINGLE, {"origin": b"short"}, b"data", "origin"),
        (SINGLE, {"seq": 0}, b"data", "seq"),
        (SINGLE, {"size": 1 << 40}, b"data", "size"),
        (SINGLE, {"sha256": "text"}, b"data", "sha256"),
        (SINGLE, {"offset": 10}, b"data", "payload"),
        (SINGLE, {"done_up_to": 5}, b"data", "done_up_to"),
        (SINGLE, {"v": 3}, b"data", "records"),
        (SINGLE, {"v": 2}, b"data", "v"),
        (BATCH, {"v": 2}, b"ab", "v"),
        (BATCH, {"sha256": b"short"}, b"ab", "sha256"),
        (BATCH, {"sha256": SHA}, b"ab", "sha256"),
        (BATCH, {}, b"ba", "sha256"),
        (BATCH, {"v": True}, b"ab", "v"),
        (BATCH, {"origin": b"short"}, b"ab", "origin"),
        (BATCH, {"done_up_to": -1}, b"ab", "done_up_to"),
        (BATCH, {"done_up_to": 4}, b"ab", "done_up_to"),
        (BATCH, {"records": []}, b"", "records"),
        (BATCH, {"records": [[n, 0] for n in range(1, MAX_BATCH_RECORDS + 2)]}, b"", "records"),
        (BATCH, {"records": [[4, 1], [4, 1]], "sha256": DIGESTS}, b"ab", "records"),
        (BATCH, {"records": [[4, 1], 5]}, b"ab", "records.1"),
        (BATCH, {"records": [[4, 1], [5]]}, b"ab", "records.1.1"),
        (BATCH, {"records": [[0, 2]]}, b"ab", "records.0.0"),
        (BATCH, {"records": [[1 << 63, 2]]}, b"ab", "records.0.0"),
        (BATCH, {"records": [[4, CHUNK_BYTES + 1]]}, b"ab", "records.0.1"),
        (BATCH, {}, b"a", "payload"),
        (BATCH, {}, b"abc", "payload"),
        (BATCH, {}, bytes(CHUNK_BYTES + 1), "payload"),
    ],
)
def test_query_error_names_the_field(fields, change, data, field):
    with pytest.raises(PayloadError, match="expected") as caught:
        parse_query(msgpack.packb(fields | change), data, WHERE)
    assert caught.value.field == field


def test_a_short_reply_means_that_all_are_stored():
    packed = pack_replies([AckReply("stored")] * 5)
    assert len(packed) < 15
    assert unpack_replies(packed, 5, WHERE) == (AckReply("stored"),) * 5


@given(st.binary(max_size=80), st.binary(max_size=8))
def test_arbitrary_bytes_parse_or_raise_payload_error(attached, data):
    for parse in (lambda: parse_query(attached, data, WHERE), lambda: unpack_replies(attached, 2, WHERE)):
        with suppress(PayloadError):
            parse()


@pytest.mark.parametrize(
    ("replies", "field"),
    [
        ([["stored", ""]], "replies"),
        (None, "replies"),
        ([["stored", ""], ["more", ""]], "replies.1.0"),
        ([["stored", ""], ["stored"]], "replies.1.1"),
        ([["stored", 1], ["stored", ""]], "replies.0.1"),
        (["stored", ["stored", ""]], "replies.0"),
    ],
)
def test_reply_error_names_the_field(replies, field):
    with pytest.raises(PayloadError, match="expected") as caught:
        unpack_replies(msgpack.packb({"v": 3, "replies": replies}), 2, WHERE)
    assert caught.value.field == field
    single = msgpack.unpackb(AckReply("stored").pack())
    with pytest.raises(PayloadError, match="takes"):
        AckReply.unpack(msgpack.packb(single | {"takes": "many"}), WHERE)
