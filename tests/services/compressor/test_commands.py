"""compressor: resend sends the same stream, refine a longer one that begins with the stream sent before."""

from __future__ import annotations

from itertools import pairwise

import msgpack
import pytest
from builders.common import eventually
from builders.records import command_record

from sonarpost import keys, wire
from sonarpost.messages import EncodedImage

IN, OUT = keys.contact_detected("uuv-1"), keys.image_encoded("uuv-1")


def test_an_image_is_sent_again_while_it_is_in_the_cache(start_service, runner, atd, modem, snippet):
    service = start_service(cache_images=2)
    uuv_modem = runner.peer("uuv-1", "vehicle_commands")
    atd.send(IN, "compressor", *[snippet(f"c{n}") for n in range(3)])
    eventually(lambda: len(modem.received) == 3)
    first, _, third = modem.received
    uuv_modem.send(keys.command("uuv-1", "resend"), "compressor", command_record("resend", third.image_id))
    uuv_modem.send(keys.command("uuv-1", "resend"), "compressor", command_record("resend", first.image_id))
    eventually(lambda: service.health().counters.get("commands_unknown_image") == 1)
    eventually(lambda: len(modem.received) == 4)
    assert modem.received[3] == third


def refine(uuv_modem, modem, times):
    """Refine the first image several times; return its streams."""
    eventually(lambda: len(modem.received) == 1)
    for n in range(times):
        command = command_record("refine", modem.received[0].image_id).model_copy(update={"command_id": f"again-{n}"})
        uuv_modem.send(keys.command("uuv-1", "refine"), "compressor", command)
        eventually(lambda count=n + 2: len(modem.received) == count)
    assert {image.image_id for image in modem.received} == {modem.received[0].image_id}
    return [image.stream for image in modem.received]


@pytest.mark.parametrize("budget_bytes", [100, 101, 256])
def test_refine_doubles_the_stream_and_continues_it(budget_bytes, start_service, runner, atd, modem, snippet, emb):
    # A despeckled image has too little detail for the longest of these streams.
    service = start_service(codec="emb", budget_bytes=budget_bytes, despeckle_strength=0.0)
    sent = snippet("c1", 64, 64)
    atd.send(IN, "compressor", sent)
    streams = refine(runner.peer("uuv-1", "vehicle_commands"), modem, times=3)
    assert len(streams[0]) == budget_bytes
    for shorter, longer in pairwise(streams):
        assert longer.startswith(shorter)
        assert len(longer) >= 1.9 * len(shorter)
    eventually(lambda: service.health().counters.get("images_refined") == 3)
    original = sent.picture.to_array().astype(float)
    errors = [float(((emb.decode(stream).image - original) ** 2).mean()) for stream in streams]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.8 * errors[0]


def test_refine_bytes_continues_a_stream_beyond_its_budget(start_service, runner, atd, modem, snippet):
    start_service(codec="emb", budget_bytes=200, refine_bytes=900)
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    stream = modem.received[0].stream
    assert 850 < len(stream) <= 900


def test_resend_sends_the_same_stream(start_service, runner, atd, modem, snippet):
    start_service(codec="emb", budget_bytes=120)
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    uuv_modem = runner.peer("uuv-1", "vehicle_commands")
    uuv_modem.send(keys.command("uuv-1", "resend"), "compressor", command_record("resend", modem.received[0].image_id))
    eventually(lambda: len(modem.received) == 2)
    assert modem.received[1] == modem.received[0]


def test_refine_sends_the_same_stream_when_the_codec_cannot_extend_it(start_service, runner, atd, modem, snippet):
    service = start_service()
    uuv_modem = runner.peer("uuv-1", "vehicle_commands")
    atd.send(IN, "compressor", snippet("c1"))
    eventually(lambda: len(modem.received) == 1)
    uuv_modem.send(keys.command("uuv-1", "refine"), "compressor", command_record("refine", modem.received[0].image_id))
    eventually(lambda: len(modem.received) == 2)
    assert modem.received[1] == modem.received[0]
    assert "images_refined" not in service.health().counters


def test_an_image_of_another_codec_is_sent_unchanged(start_service, runner, atd, modem, snippet):
    first = start_service(codec="emb", budget_bytes=120)
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    eventually(lambda: first.store.outbox_depth() == 0)
    runner.stop(first)
    start_service(codec="vq")
    [_, repeated] = refine(runner.peer("uuv-1", "vehicle_commands"), modem, times=1)
    assert repeated.startswith(modem.received[0].stream)
    assert modem.received[1].codec == "emb"


def test_cached_image_of_a_retired_codec_name_is_refined(start_service, runner, atd, modem, snippet):
    service = start_service(codec="emb", model="structure", budget_bytes=120, despeckle_strength=0.0)
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    sent = modem.received[0]
    assert (sent.codec, sent.stream[0]) == ("emb", 0x21)
    name = f"kept/{sent.image_id}"
    image, *others = msgpack.unpackb(service.store.get_state(name))
    old = wire.decode(EncodedImage, image, name).model_copy(update={"codec": "emb-structure"})
    with service.store.transaction() as tx:
        tx.put_state(name, msgpack.packb([wire.encode(old), *others]))
    [first, longer] = refine(runner.peer("uuv-1", "vehicle_commands"), modem, times=1)
    assert longer.startswith(first)
    assert len(longer) >= 1.9 * len(first)
    assert modem.received[1].codec == "emb"
