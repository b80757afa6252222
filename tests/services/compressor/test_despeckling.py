"""compressor: despeckling, and the command `original`, which sends the image without it as an image of its own."""

import pytest
from builders.common import eventually

from sonarpost.codec import emb
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.messages import Contact, Snippet
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.encoding import encode, transmit_part

BUDGET_BYTES = 150
EMB = {"codec": "emb", "budget_bytes": BUDGET_BYTES}


def strength_of(image):
    return EmbCodec().decode(image.stream).despeckle_strength


def expected_stream(snippet, strength):
    codec = EmbCodec(strength=strength)
    return transmit_part(codec, encode(codec, snippet.pixels.to_array(), BUDGET_BYTES, 0))


@pytest.mark.parametrize("strength", [0.0, 0.25, None])
def test_strength_is_passed_to_the_codec_and_logged(strength, start_service, encoded, snippet, caplog):
    caplog.set_level("INFO")
    assert CompressorConfig().codec == "emb"
    assert CompressorConfig().despeckle_strength == emb.DEFAULT_STRENGTH == 1.0
    start_service(**EMB, **({} if strength is None else {"despeckle_strength": strength}))
    strength = emb.DEFAULT_STRENGTH if strength is None else strength
    sent = snippet("c1", 64, 64)
    [image] = encoded(sent)
    assert strength_of(image) == strength
    assert image.stream == expected_stream(sent, strength)
    [line] = [record for record in caplog.records if record.message == "Image encoded"]
    assert line.fields["despeckle_strength"] == strength


def test_original_sends_the_contact_without_despeckling_and_is_refined(start_service, encoded, answer, snippet):
    service = start_service(**EMB)
    sent = snippet("c1", 64, 64)
    [first] = encoded(sent)
    original = answer("original", first.image_id)
    assert int(original.image_id, 36) == int(first.image_id, 36) + 1
    assert (original.contact, original.original_sha256) == (first.contact, first.original_sha256)
    assert (strength_of(first), strength_of(original)) == (1.0, 0.0)
    assert original.stream == expected_stream(sent, 0.0)
    longer = answer("refine", original.image_id)
    assert longer.image_id == original.image_id
    assert longer.stream.startswith(original.stream)
    assert len(longer.stream) >= 1.9 * len(original.stream)
    assert strength_of(longer) == 0.0
    counters = service.health().counters
    assert (counters["images_encoded"], counters["images_original"], counters["images_refined"]) == (2, 1, 1)


def test_original_command_arrives_through_the_acoustic_link(start_service, encoded, command_over_the_link, snippet):
    start_service(**EMB)
    [first] = encoded(snippet("c1", 64, 64))
    assert strength_of(command_over_the_link("original", first.image_id)) == 0.0


def test_a_repeated_original_command_sends_the_same_image(start_service, restart, encoded, answer, snippet):
    service = start_service(**EMB)
    first, _ = encoded(snippet("c1", 64, 64), snippet("c2", 64, 64, seed=2))
    original = answer("original", first.image_id)
    # The answer is the same after a restart with another strength.
    service = restart(service, **EMB, despeckle_strength=0.5)
    assert answer("original", first.image_id) == original
    assert "images_original" not in service.health().counters


def test_an_original_image_that_left_the_cache_is_encoded_again(start_service, encoded, answer, snippet):
    start_service(**EMB, cache_images=2)
    [first] = encoded(snippet("c1", 64, 64))
    original = answer("original", first.image_id)
    answer("refine", first.image_id)  # now the original image is the oldest entry
    encoded(snippet("c2", 64, 64, seed=2))
    again = answer("original", first.image_id)
    assert again.stream == original.stream
    assert again.image_id != original.image_id


@pytest.mark.parametrize("options", [{"despeckle_strength": 0.0}, {"codec": "vq", "budget_bytes": 0}])
def test_original_for_an_image_without_despeckling_is_counted(
    options, start_service, encoded, send_command, answer, snippet
):
    service = start_service(**(EMB | options))
    [image] = encoded(snippet("c1"))
    send_command("original", image.image_id)
    eventually(lambda: service.health().counters.get("commands_without_despeckling") == 1)
    assert answer("resend", image.image_id) == image
    assert service.health().counters["images_encoded"] == 1


def test_original_of_an_original_image_and_of_an_unknown_image_are_counted(
    start_service, encoded, send_command, answer, modem, snippet
):
    service = start_service(**EMB)
    [first] = encoded(snippet("c1", 64, 64))
    send_command("original", answer("original", first.image_id).image_id)
    eventually(lambda: service.health().counters.get("commands_without_despeckling") == 1)
    send_command("original", "ZZZZ")
    eventually(lambda: service.health().counters.get("commands_unknown_image") == 1)
    assert len(modem.received) == 2


def test_an_expanded_image_is_despeckled_and_its_original_can_be_requested(start_service, encoded, answer, snippet):
    start_service(**EMB)
    wide = snippet("wide", 64, 64, seed=9).pixels
    contact = Contact(contact_id="c1", vehicle_id="uuv-1", pixel_along_m=0.05, pixel_across_m=0.1)
    [first] = encoded(Snippet(contact=contact, pixels=snippet("c1", 64, 64).pixels, wide=wide))
    expanded = answer("expand", first.image_id)
    original = answer("original", expanded.image_id)
    assert original.original_sha256 == expanded.original_sha256 == wide.sha256
    assert original.contact == expanded.contact
    assert (strength_of(expanded), strength_of(original)) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("before", "after", "model"), [(1.0, 0.0, "standard"), (0.0, 1.0, "structure"), (1.0, 0.25, "structure")]
)
def test_images_of_another_strength_are_resent_and_refined(
    before, after, model, start_service, restart, encoded, answer, snippet
):
    service = start_service(**EMB, despeckle_strength=before, model=model)
    [first] = encoded(snippet("c1", 64, 64))
    service = restart(service, **EMB, despeckle_strength=after, model=model)
    assert answer("resend", first.image_id) == first
    longer = answer("refine", first.image_id)
    assert longer.stream.startswith(first.stream)
    assert len(longer.stream) >= 1.9 * len(first.stream)
    assert strength_of(longer) == before
    assert (longer.codec, longer.model) == (first.codec, first.model)
    assert service.health().counters["images_refined"] == 1
