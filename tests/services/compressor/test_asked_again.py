"""compressor asked again for a picture: the same stream, or a longer one that begins with all that was given."""

from __future__ import annotations

from itertools import pairwise

import pytest
from builders.common import eventually
from builders.records import command_record

from sonarpost import keys

IN, OUT = keys.contact_detected("uuv-1"), keys.image_encoded("uuv-1")


def test_a_picture_that_is_asked_for_again_is_given_again_until_it_is_forgotten(begin, crew, atd, modem, snippet):
    service = begin(cache_images=2)
    uuv_modem = crew.neighbour("uuv-1", "orders")
    atd.owe(IN, "compressor", *[snippet(f"c{n}") for n in range(3)])
    eventually(lambda: len(modem.got) == 3)
    first, _, third = modem.got
    uuv_modem.owe(keys.command("uuv-1", "resend"), "compressor", command_record("resend", third.image_id))
    uuv_modem.owe(keys.command("uuv-1", "resend"), "compressor", command_record("resend", first.image_id))
    eventually(lambda: service.health().counters.get("commands_unknown_image") == 1)
    eventually(lambda: len(modem.got) == 4)
    assert modem.got[3] == third


def refine(uuv_modem, modem, times):
    """Ask for the first picture to be refined so many times; return its streams."""
    eventually(lambda: len(modem.got) == 1)
    for n in range(times):
        again = command_record("refine", modem.got[0].image_id).model_copy(update={"command_id": f"again-{n}"})
        uuv_modem.owe(keys.command("uuv-1", "refine"), "compressor", again)
        eventually(lambda wanted=n + 2: len(modem.got) == wanted)
    assert {image.image_id for image in modem.got} == {modem.got[0].image_id}
    return [image.stream for image in modem.got]


@pytest.mark.parametrize("budget_bytes", [100, 101, 256])
def test_refining_gives_twice_the_stream_with_all_that_was_given(budget_bytes, begin, crew, atd, modem, snippet, emb):
    service = begin(codec="emb", budget_bytes=budget_bytes)
    picture = snippet("c1", 64, 64)
    atd.owe(IN, "compressor", picture)
    streams = refine(crew.neighbour("uuv-1", "orders"), modem, times=3)
    assert len(streams[0]) == budget_bytes
    for shorter, longer in pairwise(streams):
        assert longer.startswith(shorter)
        assert len(longer) >= 1.9 * len(shorter)
    eventually(lambda: service.health().counters.get("images_refined") == 3)
    truth = picture.picture.to_array().astype(float)
    errors = [float(((emb.decode(stream).image - truth) ** 2).mean()) for stream in streams]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.8 * errors[0]


def test_a_stream_goes_on_beyond_its_budget_for_the_vessel_to_ask_for(begin, crew, atd, modem, snippet):
    begin(codec="emb", budget_bytes=200, refine_bytes=900)
    atd.owe(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.got) == 1)
    begun = modem.got[0].stream
    assert 850 < len(begun) <= 900


def test_resending_gives_the_same_stream(begin, crew, atd, modem, snippet):
    begin(codec="emb", budget_bytes=120)
    atd.owe(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.got) == 1)
    orders = crew.neighbour("uuv-1", "orders")
    orders.owe(keys.command("uuv-1", "resend"), "compressor", command_record("resend", modem.got[0].image_id))
    eventually(lambda: len(modem.got) == 2)
    assert modem.got[1] == modem.got[0]


def test_where_no_longer_stream_continues_the_first_the_same_is_given_again(begin, crew, atd, modem, snippet):
    service = begin()
    uuv_modem = crew.neighbour("uuv-1", "orders")
    atd.owe(IN, "compressor", snippet("c1"))
    eventually(lambda: len(modem.got) == 1)
    uuv_modem.owe(keys.command("uuv-1", "refine"), "compressor", command_record("refine", modem.got[0].image_id))
    eventually(lambda: len(modem.got) == 2)
    assert modem.got[1] == modem.got[0]
    assert "images_refined" not in service.health().counters


def test_a_picture_of_before_the_codec_was_changed_is_given_as_it_was(begin, crew, atd, modem, snippet):
    first = begin(codec="emb", budget_bytes=120)
    atd.owe(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.got) == 1)
    eventually(lambda: first.store.outbox_depth() == 0)
    crew.stop(first)
    begin(codec="vq")
    [_, again] = refine(crew.neighbour("uuv-1", "orders"), modem, times=1)
    assert again.startswith(modem.got[0].stream)
    assert modem.got[1].codec == "emb"
