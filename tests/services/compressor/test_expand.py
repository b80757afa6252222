"""compressor: the expand command (kind "wider") sends more seabed around a contact as an image of its own."""

from __future__ import annotations

import msgpack
import numpy as np
import pytest
from builders.common import eventually
from builders.records import command_record

from sonarpost import keys
from sonarpost.detection.detector import detect
from sonarpost.detection.stream import FileOrigin
from sonarpost.link.downlink import messages as dl
from sonarpost.messages import Contact, Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.survey_detection import snippet_of
from sonarpost.services.compressor.encoding import expand
from sonarpost.services.op_modem.vessel_endpoint import message_of
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.received_commands import ReceivedCommands
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey

IN, OUT = keys.contact_detected("uuv-1"), keys.image_encoded("uuv-1")


@pytest.fixture
def expandable_snippet(snippet):
    """Make snippets with an expanded image, pixels of 0.05 m x 0.1 m."""

    def make(contact_id, seed=1, **changes):
        sizes = {"pixel_along_m": 0.05, "pixel_across_m": 0.1}
        contact = Contact(contact_id=contact_id, vehicle_id="uuv-1", **(sizes | changes))
        wide = snippet("expanded", seed=seed + 100).picture
        return Snippet(contact=contact, picture=snippet(contact_id, seed=seed).picture, source="line", wide=wide)

    return make


def test_expand_sends_more_seabed_as_an_image_of_its_own(
    start_service, send_command, atd, modem, expandable_snippet, vq
):
    service = start_service()
    sent = expandable_snippet("c1")
    atd.send(IN, "compressor", sent)
    eventually(lambda: len(modem.received) == 1)
    send_command("wider", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    first, expanded = modem.received
    assert int(expanded.image_id, 36) == int(first.image_id, 36) + 1
    assert expanded.contact == sent.contact.model_copy(update={"pixel_along_m": 0.1, "pixel_across_m": 0.2})
    assert expanded.stream == vq.encode(sent.wide.to_array())
    assert expanded.original_sha256 == sent.wide.sha256
    counters = service.health().counters
    assert (counters["images_encoded"], counters["images_expanded"]) == (2, 1)


def test_expand_of_a_detection_shows_twice_the_ground(start_service, runner, atd, modem, emb):
    survey = simulate_survey(SurveySpec(seed=1, pings=400, samples=1024, clutter=0)).survey
    config = AtdStubConfig()
    origin = FileOrigin("ab" * 32, "line-7.xtf", "line-7")
    # Away from the ends of the recording, where the expanded image would be shifted.
    detection = next(each for each in detect(survey) if 80 <= each.ping_index < 320 and 150 <= each.sample < 850)
    sent = snippet_of(survey, detection, origin, "uuv-1", config)
    start_service(codec="emb", budget_bytes=4000)
    atd.send(IN, "compressor", sent)
    eventually(lambda: len(modem.received) == 1)
    first = modem.received[0]
    # A command on the vessel, bytes on the acoustic link, a command again on the vehicle.
    downlink_bytes = dl.pack(message_of(command_record("wider", first.image_id), 7))
    outcome, received = ReceivedCommands("uuv-1", UuvModemConfig(port="unused")).accept(
        1, dl.unpack(downlink_bytes), first.image_id
    )
    assert (outcome, received.consumers) == (dl.CommandOutcome.ACCEPTED, ("compressor",))
    runner.peer("uuv-1", "vehicle_commands").send(received.key, "compressor", received.record)
    eventually(lambda: len(modem.received) == 2)
    expanded = modem.received[1]
    decoded = {image.image_id: emb.decode(image.stream).image.astype(float) for image in (first, expanded)}
    around, near = decoded[expanded.image_id], decoded[first.image_id]
    assert around.shape == near.shape == (80, 140)
    assert expanded.contact.pixel_along_m == 2 * first.contact.pixel_along_m
    assert expanded.contact.pixel_across_m == 2 * first.contact.pixel_across_m
    # The first image is the middle of the expanded one at half the size, and correlates nowhere else as well.
    small = near.reshape(40, 2, 70, 2).mean(axis=(1, 3))
    correlation = {
        (row, column): np.corrcoef(small.ravel(), around[row : row + 40, column : column + 70].ravel())[0, 1]
        for row in range(0, 41, 5)
        for column in range(0, 71, 5)
    }
    assert max(correlation, key=correlation.__getitem__) == (20, 35)
    assert correlation[20, 35] > 0.8


def test_a_repeated_expand_command_sends_the_same_image(
    start_service, runner, send_command, atd, modem, expandable_snippet
):
    service = start_service()
    atd.send(IN, "compressor", expandable_snippet("c1"), expandable_snippet("c2", seed=2))
    eventually(lambda: len(modem.received) == 2)
    send_command("wider", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 3)
    send_command("refine", modem.received[0].image_id)  # replaces the cache entry
    eventually(lambda: len(modem.received) == 4)
    runner.stop(service)
    service = start_service()
    send_command("wider", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 5)
    assert modem.received[4] == modem.received[2]
    assert "images_encoded" not in service.health().counters


def test_an_expanded_image_that_left_the_cache_is_encoded_again(
    start_service, send_command, atd, modem, expandable_snippet
):
    start_service(codec="emb", budget_bytes=120, cache_images=2)
    atd.send(IN, "compressor", expandable_snippet("c1"))
    eventually(lambda: len(modem.received) == 1)
    first = modem.received[0].image_id
    send_command("wider", first)
    eventually(lambda: len(modem.received) == 2)
    send_command("refine", first)  # now the expanded image is the oldest entry
    eventually(lambda: len(modem.received) == 3)
    atd.send(IN, "compressor", expandable_snippet("c2", seed=2))
    eventually(lambda: len(modem.received) == 4)
    send_command("wider", first)
    eventually(lambda: len(modem.received) == 5)
    assert modem.received[4].stream == modem.received[1].stream
    assert modem.received[4].image_id not in {image.image_id for image in modem.received[:4]}


def test_expand_without_an_expanded_image_is_counted(
    start_service, send_command, atd, modem, snippet, expandable_snippet
):
    service = start_service()
    atd.send(IN, "compressor", snippet("plain"), expandable_snippet("c1"))
    eventually(lambda: len(modem.received) == 2)
    plain, first = (image.image_id for image in modem.received)
    counters = lambda: service.health().counters  # noqa: E731
    send_command("wider", plain)
    eventually(lambda: counters().get("commands_without_expanded_image") == 1)
    send_command("wider", "ZZZZ")
    eventually(lambda: counters().get("commands_unknown_image") == 1)
    send_command("wider", first)
    eventually(lambda: len(modem.received) == 3)
    send_command("wider", modem.received[2].image_id)  # an expanded image cannot be expanded again
    eventually(lambda: counters().get("commands_without_expanded_image") == 2)
    send_command("resend", modem.received[2].image_id)
    eventually(lambda: len(modem.received) == 4)
    assert modem.received[3] == modem.received[2]


def test_pixel_sizes_above_the_range_of_the_record_are_unknown(expandable_snippet):
    expanded = expand(expandable_snippet("c1", pixel_along_m=60.0, pixel_across_m=None))
    assert (expanded.contact.pixel_along_m, expanded.contact.pixel_across_m) == (None, None)
    assert expanded.wide is None


def test_a_cache_entry_without_an_expanded_id_is_sent(start_service, send_command, atd, modem, snippet):
    service = start_service()
    atd.send(IN, "compressor", snippet("c1"))
    eventually(lambda: len(modem.received) == 1)
    name = f"kept/{modem.received[0].image_id}"
    image, packed, *_ = msgpack.unpackb(service.store.get_state(name))
    with service.store.transaction() as tx:
        tx.put_state(name, msgpack.packb([image, packed]))
    send_command("resend", modem.received[0].image_id)
    eventually(lambda: len(modem.received) == 2)
    assert modem.received[1] == modem.received[0]
