"""compressor: despeckling, and the command `original`, which sends the image without it as an image of its own."""

from __future__ import annotations

import logging

import msgpack
import pytest
from builders.common import eventually
from builders.records import command_record

from sonarpost import keys
from sonarpost.codec import emb
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.link.downlink import messages as dl
from sonarpost.messages import Contact, Snippet
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.encoding import encode, transmit_part
from sonarpost.services.op_modem.vessel_endpoint import message_of
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.received_commands import ReceivedCommands

IN = keys.contact_detected("uuv-1")
BUDGET_BYTES = 150


@pytest.fixture
def start_emb(start_service):
    return lambda **options: start_service(**{"codec": "emb", "budget_bytes": BUDGET_BYTES, **options})


def strength_of(image):
    return EmbCodec().decode(image.stream).despeckle_strength


def expected_stream(snippet, strength):
    codec = EmbCodec(strength=strength)
    return transmit_part(codec, encode(codec, snippet.picture.to_array(), BUDGET_BYTES, 0))


@pytest.mark.parametrize("strength", [0.0, 0.25, 1.0])
def test_strength_is_passed_to_the_codec_and_logged(strength, start_emb, atd, modem, snippet, caplog):
    caplog.set_level(logging.INFO)
    start_emb(despeckle_strength=strength)
    sent = snippet("c1", 64, 64)
    atd.send(IN, "compressor", sent)
    eventually(lambda: len(modem.received) == 1)
    assert strength_of(modem.received[0]) == strength
    assert modem.received[0].stream == expected_stream(sent, strength)
    [line] = [record for record in caplog.records if record.message == "Image encoded"]
    assert line.fields["despeckle_strength"] == strength


def test_default_strength_is_that_of_the_codec(start_emb, atd, modem, snippet):
    assert CompressorConfig().despeckle_strength == emb.DEFAULT_STRENGTH
    start_emb()
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    assert strength_of(modem.received[0]) == emb.DEFAULT_STRENGTH


def test_original_sends_the_contact_without_despeckling(start_emb, send_command, atd, modem, snippet):
    service = start_emb()
    sent = snippet("c1", 64, 64)
    atd.send(IN, "compressor", sent)
    eventually(lambda: len(modem.received) == 1)
    send_command("original", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    first, original = modem.received
    assert int(original.image_id, 36) == int(first.image_id, 36) + 1
    assert (original.contact, original.original_sha256) == (first.contact, first.original_sha256)
    assert (strength_of(first), strength_of(original)) == (1.0, 0.0)
    assert original.stream == expected_stream(sent, 0.0)
    counters = service.health().counters
    assert (counters["images_encoded"], counters["images_original"]) == (2, 1)


def test_original_command_arrives_through_the_acoustic_link(start_emb, runner, atd, modem, snippet):
    start_emb()
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    first = modem.received[0]
    downlink_bytes = dl.pack(message_of(command_record("original", first.image_id), 7))
    commands = ReceivedCommands("uuv-1", UuvModemConfig(port="socket://x", address=3))
    _, received = commands.accept(1, dl.unpack(downlink_bytes), first.image_id)
    assert received.consumers == ("compressor",)
    runner.peer("uuv-1", "vehicle_commands").send(received.key, "compressor", received.record)
    eventually(lambda: len(modem.received) == 2)
    assert strength_of(modem.received[1]) == 0.0


def test_a_repeated_original_command_sends_the_same_image(start_emb, runner, send_command, atd, modem, snippet):
    service = start_emb()
    atd.send(IN, "compressor", snippet("c1", 64, 64), snippet("c2", 64, 64, seed=2))
    eventually(lambda: len(modem.received) == 2)
    send_command("original", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 3)
    # The answer is the same after a restart with another strength.
    eventually(lambda: service.store.outbox_depth() == 0)
    runner.stop(service)
    service = start_emb(despeckle_strength=0.5)
    send_command("original", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 4)
    assert modem.received[3] == modem.received[2]
    assert "images_original" not in service.health().counters


def test_an_original_image_that_left_the_cache_is_encoded_again(start_emb, send_command, atd, modem, snippet):
    start_emb(cache_images=2)
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    first = modem.received[0].image_id
    send_command("original", first)
    eventually(lambda: len(modem.received) == 2)
    send_command("refine", first)  # now the original image is the oldest entry
    eventually(lambda: len(modem.received) == 3)
    atd.send(IN, "compressor", snippet("c2", 64, 64, seed=2))
    eventually(lambda: len(modem.received) == 4)
    send_command("original", first)
    eventually(lambda: len(modem.received) == 5)
    assert modem.received[4].stream == modem.received[1].stream
    assert modem.received[4].image_id != modem.received[1].image_id


@pytest.mark.parametrize("options", [{"despeckle_strength": 0.0}, {"codec": "vq", "budget_bytes": 0}])
def test_original_for_an_image_without_despeckling_is_counted(options, start_emb, send_command, atd, modem, snippet):
    service = start_emb(**options)
    atd.send(IN, "compressor", snippet("c1"))
    eventually(lambda: len(modem.received) == 1)
    send_command("original", modem.received[0].image_id)
    eventually(lambda: service.health().counters.get("commands_without_despeckling") == 1)
    send_command("resend", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    assert modem.received[1] == modem.received[0]
    assert service.health().counters["images_encoded"] == 1


def test_original_of_an_original_image_and_of_an_unknown_image_are_counted(
    start_emb, send_command, atd, modem, snippet
):
    service = start_emb()
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    send_command("original", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    send_command("original", modem.received[1].image_id)
    eventually(lambda: service.health().counters.get("commands_without_despeckling") == 1)
    send_command("original", "ZZZZ")
    eventually(lambda: service.health().counters.get("commands_unknown_image") == 1)
    assert len(modem.received) == 2


def test_an_expanded_image_is_despeckled_and_its_original_can_be_requested(
    start_emb, send_command, atd, modem, snippet
):
    start_emb()
    wide = snippet("wide", 64, 64, seed=9).picture
    contact = Contact(contact_id="c1", vehicle_id="uuv-1", pixel_along_m=0.05, pixel_across_m=0.1)
    atd.send(IN, "compressor", Snippet(contact=contact, picture=snippet("c1", 64, 64).picture, wide=wide))
    eventually(lambda: len(modem.received) == 1)
    send_command("wider", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    send_command("original", modem.received[1].image_id)
    eventually(lambda: len(modem.received) == 3)
    expanded, original = modem.received[1:]
    assert original.original_sha256 == expanded.original_sha256 == wide.sha256
    assert original.contact == expanded.contact
    assert (strength_of(expanded), strength_of(original)) == (1.0, 0.0)


@pytest.mark.parametrize("model", ["standard", "structure"])
@pytest.mark.parametrize(("before", "after"), [(1.0, 0.0), (0.0, 1.0), (1.0, 0.25)])
def test_images_of_another_strength_are_resent_and_refined(
    before, after, model, start_emb, runner, send_command, atd, modem, snippet
):
    service = start_emb(despeckle_strength=before, model=model)
    sent = snippet("c1", 64, 64)
    atd.send(IN, "compressor", sent)
    eventually(lambda: len(modem.received) == 1)
    eventually(lambda: service.store.outbox_depth() == 0)
    runner.stop(service)
    service = start_emb(despeckle_strength=after, model=model)
    first = modem.received[0]
    send_command("resend", first.image_id)
    eventually(lambda: len(modem.received) == 2)
    assert modem.received[1] == first
    send_command("refine", first.image_id)
    eventually(lambda: len(modem.received) == 3)
    longer = modem.received[2]
    assert longer.stream.startswith(first.stream)
    assert len(longer.stream) >= 1.9 * len(first.stream)
    assert strength_of(longer) == before
    assert (longer.codec, longer.model) == (first.codec, first.model)
    assert service.health().counters["images_refined"] == 1


def test_original_image_is_refined(start_emb, send_command, atd, modem, snippet):
    service = start_emb()
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    send_command("original", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    original = modem.received[1]
    send_command("refine", original.image_id)
    eventually(lambda: len(modem.received) == 3)
    longer = modem.received[2]
    assert longer.image_id == original.image_id
    assert longer.stream.startswith(original.stream)
    assert len(longer.stream) >= 1.9 * len(original.stream)
    assert strength_of(longer) == 0.0
    assert service.health().counters["images_refined"] == 1


def test_a_cache_entry_without_an_original_id_is_read(start_emb, send_command, atd, modem, snippet):
    service = start_emb()
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    name = f"kept/{modem.received[0].image_id}"
    *others, _ = msgpack.unpackb(service.store.get_state(name))
    assert len(others) == 3
    with service.store.transaction() as tx:
        tx.put_state(name, msgpack.packb(others))
    send_command("original", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    assert strength_of(modem.received[1]) == 0.0
