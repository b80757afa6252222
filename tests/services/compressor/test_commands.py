"""compressor: the commands resend, refine and region."""

from itertools import pairwise

import msgpack
import numpy as np
import pytest
from builders.common import eventually


def test_the_same_image_is_sent_again_while_it_is_in_the_cache(
    start_service, encoded, send_command, answer, snippet, caplog
):
    service = start_service(cache_images=2)
    first, _, third = encoded(*(snippet(f"c{n}") for n in range(3)))
    send_command("resend", first.image_id)
    send_command("region", "0ZZZ", box=(0, 0, 32, 32), stream_bytes=96)
    eventually(lambda: service.health().counters.get("commands_unknown_image") == 2)
    missing = [vars(record)["fields"] for record in caplog.records if "not in cache" in record.message]
    assert [(each["image_id"], each["kind"]) for each in missing] == [(first.image_id, "resend"), ("0ZZZ", "region")]
    assert answer("resend", third.image_id) == third


@pytest.mark.parametrize("budget_bytes", [101, 256])
def test_refine_doubles_the_stream_and_continues_it(budget_bytes, start_service, encoded, answer, snippet, emb):
    # A despeckled image has too little detail for the longest of these streams.
    service = start_service(codec="emb", budget_bytes=budget_bytes, despeckle_strength=0.0)
    sent = snippet("c1", 64, 64)
    [first] = encoded(sent)
    images = [first, *(answer("refine", first.image_id) for _ in range(3))]
    assert {image.image_id for image in images} == {first.image_id}
    assert len(first.stream) == budget_bytes
    for shorter, longer in pairwise(images):
        assert longer.stream.startswith(shorter.stream)
        assert len(longer.stream) >= 1.9 * len(shorter.stream)
    eventually(lambda: service.health().counters.get("images_refined") == 3)
    original = sent.pixels.to_array().astype(float)
    errors = [float(((emb.decode(image.stream).image - original) ** 2).mean()) for image in images]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.8 * errors[0]


def test_refine_bytes_continues_a_stream_beyond_its_budget(start_service, encoded, snippet):
    start_service(codec="emb", budget_bytes=200, refine_bytes=900)
    [image] = encoded(snippet("c1", 64, 64))
    assert 850 < len(image.stream) <= 900


def test_refine_sends_the_same_stream_when_the_codec_cannot_extend_it(start_service, encoded, answer, snippet):
    service = start_service()
    [image] = encoded(snippet("c1"))
    assert answer("refine", image.image_id) == image
    assert "images_refined" not in service.health().counters


def test_an_image_of_another_codec_is_sent_unchanged(start_service, restart, encoded, answer, snippet):
    service = start_service(codec="emb", budget_bytes=120)
    [image] = encoded(snippet("c1", 64, 64))
    restart(service, codec="vq")
    repeated = answer("refine", image.image_id)
    assert repeated.codec == "emb"
    assert repeated.stream.startswith(image.stream)


def test_region_is_an_image_of_its_own_with_all_bytes(start_service, encoded, answer, snippet, emb):
    service = start_service(codec="emb")
    sent = snippet("c1")
    [first] = encoded(sent)
    region = answer("region", first.image_id, box=(8, 16, 24, 32), stream_bytes=96)
    pixels = sent.pixels.to_array()
    height, width = pixels.shape
    inside = pixels[height // 4 : height * 3 // 4, width // 2 :]
    assert (region.height_px, region.width_px) == inside.shape
    assert region.contact == first.contact
    assert 60 <= len(region.stream) <= 96
    shown = emb.decode(region.stream).image
    assert shown.shape == inside.shape
    assert np.abs(shown.astype(int) - inside.astype(int)).mean() < 40
    assert service.health().counters["images_region"] == 1


@pytest.mark.parametrize("damaged", [b"", b"\xc1", msgpack.packb([b"image", b"snippet"])])
def test_state_that_cannot_be_read_does_not_stop_the_service(damaged, start_service, encoded, answer, snippet):
    service = start_service()
    [first, second] = encoded(snippet("c1"), snippet("c2"))
    with service.store.transaction() as tx:
        tx.put_state(f"kept/{first.image_id}", damaged)
        tx.put_state("kept", damaged)
        tx.put_state("next_image", damaged)
    assert answer("resend", second.image_id) == second
    encoded(snippet("c3"))
    assert service.health().counters["states_discarded"] >= 2
    assert not service.failed
