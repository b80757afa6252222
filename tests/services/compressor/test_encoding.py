"""compressor: one stream a snippet, unique identifiers, bad snippets quarantined."""

import msgpack
import numpy as np
import pytest
from builders.common import eventually

from sonarpost import keys, wire
from sonarpost.codec.interface import StreamHeader, to_uint8
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.errors import CodebookError, ConfigError
from sonarpost.link.frames.paper.frame import format_image_id, is_image_id
from sonarpost.messages import Contact
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.service import IMAGE_IDS, CompressorService

IN, OUT = keys.contact_detected("uuv-1"), keys.image_encoded("uuv-1")


def test_a_snippet_is_encoded_with_its_contact(start_service, atd, modem, snippet, vq, check_monitoring, watch):
    published = watch(OUT)
    service = start_service()
    contact = Contact(
        contact_id="full", vehicle_id="uuv-1", lat_deg=56.1, lon_deg=-5.2, atd_confidence=1.5, ping_number=7
    )
    sent = snippet("c1").model_copy(update={"contact": contact})
    atd.send(IN, "compressor", sent)
    eventually(lambda: len(modem.received) == 1)
    image = modem.received[0]
    assert image.contact == sent.contact
    assert (image.vehicle_id, image.codec, image.model) == ("uuv-1", "vq", vq.model_hash)
    assert (image.height_px, image.width_px, image.original_sha256) == (40, 60, sent.pixels.sha256)
    assert image.stream == vq.encode(sent.pixels.to_array())
    assert is_image_id(image.image_id)
    eventually(lambda: atd.store.outbox_depth() == 0)
    # The header, and 14 bits for each tile of 10 x 10 px.
    size = StreamHeader.unpack(image.stream).size + 4 * 6 * 14 // 8
    eventually(lambda: service.health().counters == {"records_handled": 1, "images_encoded": 1, "bytes_encoded": size})
    eventually(lambda: len(published) == 1, what="the copy for watchers")
    assert msgpack.unpackb(published[0].payload.to_bytes())["image_id"] == image.image_id
    check_monitoring(service)


def test_16_bit_images_are_mapped_over_their_own_range(start_service, encoded, snippet, vq):
    start_service()
    deep = snippet("deep", dtype=np.uint16)
    assert deep.pixels.bits == 16
    [image] = encoded(deep)
    assert image.stream == vq.encode(to_uint8(deep.pixels.to_array()))
    assert image.original_sha256 == deep.pixels.sha256


def test_a_snippet_of_invalid_size_is_quarantined(start_service, atd, modem, snippet, refused):
    service = start_service()
    bad = {(15, 60): "height_px: got 15", (60, 15): "width_px: got 15", (513, 40): "height_px: got 513"}
    atd.send(IN, "compressor", *(snippet("bad", *size) for size in bad), snippet("good"))
    eventually(lambda: [i.contact.contact_id for i in modem.received] == ["good"])
    for (key, reason), expected in zip(refused(service), bad.values(), strict=True):
        assert key == IN
        assert expected in reason
        assert "expected 16..512" in reason
    health = service.health()
    assert (health.state, health.counters["records_refused"], health.gauges["refused"]) == ("ok", 3, 3.0)


def test_a_budget_that_cannot_be_met_is_reported(start_service, atd, modem, snippet, refused):
    service = start_service(budget_bytes=9)
    atd.send(IN, "compressor", snippet("large"))
    eventually(lambda: len(refused(service)) == 1)
    assert "budget" in refused(service)[0][1]
    assert not service.failed
    assert modem.received == []


def test_malformed_snippets_are_refused_and_the_next_one_is_encoded(start_service, atd, modem, snippet, refused):
    service = start_service()
    fields = msgpack.unpackb(wire.encode(snippet("spoilt")))
    bad = [
        b"",
        b"\xc1",
        msgpack.packb(list(fields)),
        msgpack.packb(fields | {"v": 2}),
        msgpack.packb(fields | {"type": "decision"}),
        msgpack.packb(fields | {"pixels": fields["pixels"] | {"data": b"short"}}),
    ]
    for payload in bad:
        atd.send_bytes(IN, "compressor", payload)
    atd.send(IN, "compressor", snippet("good"))
    eventually(lambda: [i.contact.contact_id for i in modem.received] == ["good"])
    # The producer quarantines them too, with the same reasons.
    eventually(lambda: refused(atd) == refused(service))
    assert len(refused(service)) == service.health().counters["records_refused"] == len(bad)
    for key, reason in refused(service):
        assert key == IN
        assert IN in reason
        assert "expected" in reason


def test_identifiers_continue_after_restarts(start_service, runner, atd, modem, snippet):
    for turn in range(3):
        service = start_service()
        atd.send(IN, "compressor", *(snippet(f"{turn}-{n}") for n in range(4)))
        eventually(lambda turn=turn: len(modem.received) == 4 * (turn + 1))
        runner.stop(service)
    first = int(modem.received[0].image_id, 36)
    assert [i.image_id for i in modem.received] == [format_image_id(first + n) for n in range(12)]
    # A query that is lost at the restart of its consumer is sent again after later ones.
    for turn in range(3):
        names = {image.contact.contact_id for image in modem.received[4 * turn : 4 * turn + 4]}
        assert names == {f"{turn}-{n}" for n in range(4)}


def test_identifiers_wrap_around(start_service, encoded, snippet):
    service = start_service()
    with service.store.transaction() as tx:
        tx.put_state("next_image", str(IMAGE_IDS).encode())
    assert [image.image_id for image in encoded(snippet("a"), snippet("b"))] == ["1EKF", "0001"]


def test_a_new_store_begins_with_another_identifier(start_service, runner, encoded, snippet):
    starts = set()
    for _ in range(3):
        service = start_service()
        [image] = encoded(snippet("c"))
        starts.add(image.image_id)
        eventually(lambda service=service: service.store.outbox_depth() == 0)
        runner.stop(service)
        service.store.path.unlink()
    assert len(starts) == 3


def test_the_configured_packing_is_used(start_service, encoded, snippet):
    start_service(packing=IndexPacking.BYTES2)
    [image] = encoded(snippet("c"))
    assert image.stream[0] == IndexPacking.BYTES2.codec_id


@pytest.mark.parametrize(
    ("options", "error", "expected"),
    [
        ({"codebook": "/nowhere/own.tiles"}, CodebookError, "/nowhere/own.tiles"),
        ({"codebook": "nominal-11"}, CodebookError, "nominal-11"),
        ({"codec": "jpeg-of-the-future"}, ConfigError, "one of"),
        ({"codec": "emb", "model": "texture"}, ConfigError, "standard or structure"),
    ],
)
def test_a_configuration_error_is_raised_before_the_store_is_opened(options, error, expected, platform):
    with pytest.raises(error, match=expected):
        CompressorService(platform("uuv-1"), CompressorConfig(**options))
    assert not (platform("uuv-1").state_dir / "compressor.db").exists()


def test_the_sender_keeps_the_snippet_while_the_disk_is_full(start_service, atd, modem, snippet, full_disk):
    service = start_service()
    with full_disk(service):
        atd.send(IN, "compressor", snippet("late", 200, 200))
        eventually(lambda: service.health().state == "degraded")
        assert atd.store.outbox_depth() == 1
    eventually(lambda: len(modem.received) == 1)
    eventually(lambda: service.health().state == "ok")
