"""compressor asked again for a picture: the same stream, or a longer one that begins with all that was given."""

from __future__ import annotations

from itertools import pairwise

import pytest
from builders.common import eventually
from builders.records import command_record

from sonarpost import keys

IN, OUT = keys.contact_detected("uuv-1"), keys.image_encoded("uuv-1")


def test_a_picture_that_is_asked_for_again_is_given_again_until_it_is_forgotten(begin, runner, atd, modem, snippet):
    service = begin(cache_images=2)
    uuv_modem = runner.peer("uuv-1", "orders")
    atd.send(IN, "compressor", *[snippet(f"c{n}") for n in range(3)])
    eventually(lambda: len(modem.received) == 3)
    first, _, third = modem.received
    uuv_modem.send(keys.command("uuv-1", "resend"), "compressor", command_record("resend", third.image_id))
    uuv_modem.send(keys.command("uuv-1", "resend"), "compressor", command_record("resend", first.image_id))
    eventually(lambda: service.health().counters.get("commands_unknown_image") == 1)
    eventually(lambda: len(modem.received) == 4)
    assert modem.received[3] == third


def refine(uuv_modem, modem, times):
    """Ask for the first picture to be refined so many times; return its streams."""
    eventually(lambda: len(modem.received) == 1)
    for n in range(times):
        again = command_record("refine", modem.received[0].image_id).model_copy(update={"command_id": f"again-{n}"})
        uuv_modem.send(keys.command("uuv-1", "refine"), "compressor", again)
        eventually(lambda wanted=n + 2: len(modem.received) == wanted)
    assert {image.image_id for image in modem.received} == {modem.received[0].image_id}
    return [image.stream for image in modem.received]


@pytest.mark.parametrize("budget_bytes", [100, 101, 256])
def test_refining_gives_twice_the_stream_with_all_that_was_given(budget_bytes, begin, runner, atd, modem, snippet, emb):
    service = begin(codec="emb", budget_bytes=budget_bytes)
    picture = snippet("c1", 64, 64)
    atd.send(IN, "compressor", picture)
    streams = refine(runner.peer("uuv-1", "orders"), modem, times=3)
    assert len(streams[0]) == budget_bytes
    for shorter, longer in pairwise(streams):
        assert longer.startswith(shorter)
        assert len(longer) >= 1.9 * len(shorter)
    eventually(lambda: service.health().counters.get("images_refined") == 3)
    truth = picture.picture.to_array().astype(float)
    errors = [float(((emb.decode(stream).image - truth) ** 2).mean()) for stream in streams]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.8 * errors[0]


def test_a_stream_goes_on_beyond_its_budget_for_the_vessel_to_ask_for(begin, runner, atd, modem, snippet):
    begin(codec="emb", budget_bytes=200, refine_bytes=900)
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    begun = modem.received[0].stream
    assert 850 < len(begun) <= 900


def test_resending_gives_the_same_stream(begin, runner, atd, modem, snippet):
    begin(codec="emb", budget_bytes=120)
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    orders = runner.peer("uuv-1", "orders")
    orders.send(keys.command("uuv-1", "resend"), "compressor", command_record("resend", modem.received[0].image_id))
    eventually(lambda: len(modem.received) == 2)
    assert modem.received[1] == modem.received[0]


def test_where_no_longer_stream_continues_the_first_the_same_is_given_again(begin, runner, atd, modem, snippet):
    service = begin()
    uuv_modem = runner.peer("uuv-1", "orders")
    atd.send(IN, "compressor", snippet("c1"))
    eventually(lambda: len(modem.received) == 1)
    uuv_modem.send(keys.command("uuv-1", "refine"), "compressor", command_record("refine", modem.received[0].image_id))
    eventually(lambda: len(modem.received) == 2)
    assert modem.received[1] == modem.received[0]
    assert "images_refined" not in service.health().counters


def test_a_picture_of_before_the_codec_was_changed_is_given_as_it_was(begin, runner, atd, modem, snippet):
    first = begin(codec="emb", budget_bytes=120)
    atd.send(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.received) == 1)
    eventually(lambda: first.store.outbox_depth() == 0)
    runner.stop(first)
    begin(codec="vq")
    [_, again] = refine(runner.peer("uuv-1", "orders"), modem, times=1)
    assert again.startswith(modem.received[0].stream)
    assert modem.received[1].codec == "emb"
