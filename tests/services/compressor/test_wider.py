"""compressor asked for more of the seabed around a contact: a picture of its own, kept and given again."""

from __future__ import annotations

import msgpack
import numpy as np
import pytest
from builders.common import eventually
from builders.records import command_record

from sonarpost import keys
from sonarpost.detection.detector import detect
from sonarpost.link.downlink import messages as dl
from sonarpost.messages import Contact, Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.file_boundary import Origin
from sonarpost.services.atd_stub.survey_detection import snippet_of
from sonarpost.services.compressor.wide import wider
from sonarpost.services.op_modem.station import order_of
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.orders import ReceivedCommands
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey

IN, OUT = keys.contact_detected("uuv-1"), keys.image_encoded("uuv-1")


@pytest.fixture
def with_wide(snippet):
    """Snippets of which the seabed around is known, pixels of 0.05 m x 0.1 m."""

    def make(contact_id, seed=1, **changes):
        sizes = {"pixel_along_m": 0.05, "pixel_across_m": 0.1}
        contact = Contact(contact_id=contact_id, vehicle_id="uuv-1", **(sizes | changes))
        wide = snippet("around", seed=seed + 100).picture
        return Snippet(contact=contact, picture=snippet(contact_id, seed=seed).picture, source="line", wide=wide)

    return make


@pytest.fixture
def ask(runner):
    """Asks for a picture as uuv_modem does; each time by an order of its own."""
    orders = runner.peer("uuv-1", "orders")
    asked = []

    def give(kind, image_id):
        asked.append(kind)
        record = command_record(kind, image_id).model_copy(update={"command_id": f"c-{len(asked)}"})
        orders.send(keys.command("uuv-1", kind), "compressor", record)

    return give


def test_wider_gives_more_seabed_as_a_picture_of_its_own(begin, ask, atd, modem, with_wide, vq):
    service = begin()
    sent = with_wide("c1")
    atd.send(IN, "compressor", sent)
    eventually(lambda: len(modem.received) == 1)
    ask("wider", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    first, wide = modem.received
    assert int(wide.image_id, 36) == int(first.image_id, 36) + 1
    assert wide.contact == sent.contact.model_copy(update={"pixel_along_m": 0.1, "pixel_across_m": 0.2})
    assert wide.stream == vq.encode(sent.wide.to_array())
    assert wide.original_sha256 == sent.wide.sha256
    counters = service.health().counters
    assert (counters["images_encoded"], counters["images_widened"]) == (2, 1)


def test_wider_of_a_real_detection_shows_twice_the_ground_from_the_vessels_order_on(begin, runner, atd, modem, emb):
    survey = simulate_survey(SurveySpec(seed=1, pings=400, samples=1024, clutter=0)).survey
    config = AtdStubConfig()
    origin = Origin("ab" * 32, "line-7.xtf", "line-7")
    # Away from the recording's ends, where the wide picture would be shifted.
    found = next(each for each in detect(survey) if 80 <= each.ping_index < 320 and 150 <= each.sample < 850)
    sent = snippet_of(survey, found, origin, "uuv-1", config)
    begin(codec="emb", budget_bytes=4000)
    atd.send(IN, "compressor", sent)
    eventually(lambda: len(modem.received) == 1)
    first = modem.received[0]
    # On the vessel a command, in the water bytes, on the vehicle a command again.
    in_the_water = dl.pack(order_of(command_record("wider", first.image_id), 7))
    outcome, handed = ReceivedCommands("uuv-1", UuvModemConfig(port="unused")).take(
        1, dl.unpack(in_the_water), first.image_id
    )
    assert (outcome, handed.consumers) == (dl.CommandOutcome.TAKEN, ("compressor",))
    runner.peer("uuv-1", "orders").send(handed.key, "compressor", handed.record)
    eventually(lambda: len(modem.received) == 2)
    wide = modem.received[1]
    seen = {image.image_id: emb.decode(image.stream).image.astype(float) for image in (first, wide)}
    around, near = seen[wide.image_id], seen[first.image_id]
    assert around.shape == near.shape == (80, 140)
    assert wide.contact.pixel_along_m == 2 * first.contact.pixel_along_m
    assert wide.contact.pixel_across_m == 2 * first.contact.pixel_across_m
    # What the first picture shows is the middle of the wide one, at half the size; nowhere else is it like it.
    small = near.reshape(40, 2, 70, 2).mean(axis=(1, 3))
    likeness = {
        (row, column): np.corrcoef(small.ravel(), around[row : row + 40, column : column + 70].ravel())[0, 1]
        for row in range(0, 41, 5)
        for column in range(0, 71, 5)
    }
    assert max(likeness, key=likeness.__getitem__) == (20, 35)
    assert likeness[20, 35] > 0.8


def test_wider_asked_again_gives_the_same_picture_again(begin, runner, ask, atd, modem, with_wide):
    service = begin()
    atd.send(IN, "compressor", with_wide("c1"), with_wide("c2", seed=2))
    eventually(lambda: len(modem.received) == 2)
    ask("wider", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 3)
    ask("refine", modem.received[0].image_id)  # what is kept of it is written anew, and still knows its wide one
    eventually(lambda: len(modem.received) == 4)
    runner.stop(service)
    service = begin()
    ask("wider", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 5)
    assert modem.received[4] == modem.received[2]
    assert "images_encoded" not in service.health().counters


def test_a_wider_picture_that_is_forgotten_is_made_again(begin, ask, atd, modem, with_wide):
    begin(codec="emb", budget_bytes=120, cache_images=2)
    atd.send(IN, "compressor", with_wide("c1"))
    eventually(lambda: len(modem.received) == 1)
    first = modem.received[0].image_id
    ask("wider", first)
    eventually(lambda: len(modem.received) == 2)
    ask("refine", first)  # now the wide one has been kept longest
    eventually(lambda: len(modem.received) == 3)
    atd.send(IN, "compressor", with_wide("c2", seed=2))
    eventually(lambda: len(modem.received) == 4)
    ask("wider", first)
    eventually(lambda: len(modem.received) == 5)
    assert modem.received[4].stream == modem.received[1].stream
    assert modem.received[4].image_id not in {image.image_id for image in modem.received[:4]}


def test_wider_where_there_is_nothing_wider_is_said(begin, ask, atd, modem, snippet, with_wide):
    service = begin()
    atd.send(IN, "compressor", snippet("plain"), with_wide("c1"))
    eventually(lambda: len(modem.received) == 2)
    plain, first = (image.image_id for image in modem.received)
    counters = lambda: service.health().counters  # noqa: E731
    ask("wider", plain)
    eventually(lambda: counters().get("commands_nothing_wider") == 1)
    ask("wider", "ZZZZ")
    eventually(lambda: counters().get("commands_unknown_image") == 1)
    ask("wider", first)
    eventually(lambda: len(modem.received) == 3)
    ask("wider", modem.received[2].image_id)  # around the wider one nothing more is kept
    eventually(lambda: counters().get("commands_nothing_wider") == 2)
    ask("resend", modem.received[2].image_id)
    eventually(lambda: len(modem.received) == 4)
    assert modem.received[3] == modem.received[2]


def test_pixels_too_large_for_a_record_are_not_known(with_wide):
    wide = wider(with_wide("c1", pixel_along_m=60.0, pixel_across_m=None))
    assert (wide.contact.pixel_along_m, wide.contact.pixel_across_m) == (None, None)
    assert wide.wide is None


def test_what_a_version_without_wider_pictures_has_kept_is_still_given(begin, ask, atd, modem, snippet):
    service = begin()
    atd.send(IN, "compressor", snippet("c1"))
    eventually(lambda: len(modem.received) == 1)
    name = f"kept/{modem.received[0].image_id}"
    image, packed, _ = msgpack.unpackb(service.store.get_state(name))
    with service.store.transaction() as tx:
        tx.put_state(name, msgpack.packb([image, packed]))
    ask("resend", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    assert modem.received[1] == modem.received[0]
