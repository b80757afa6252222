"""compressor: the region command sends a part of the image, with all bytes in it, as an image of its own."""

from __future__ import annotations

import numpy as np
import pytest
from builders.common import eventually
from builders.records import command_record

from sonarpost import keys

IN = keys.contact_detected("uuv-1")


@pytest.fixture
def send_region(runner):
    uuv_modem = runner.peer("uuv-1", "vehicle_commands")

    def send(image_id, box, stream_bytes):
        record = command_record("region", image_id, box=box, stream_bytes=stream_bytes)
        uuv_modem.send(keys.command("uuv-1", "region"), "compressor", record)

    return send


def test_region_is_an_image_of_its_own_with_all_bytes(start_service, send_region, atd, modem, snippet, emb):
    service = start_service(codec="emb")
    sent = snippet("c1")
    atd.send(IN, "compressor", sent)
    eventually(lambda: len(modem.received) == 1)
    send_region(modem.received[0].image_id, (8, 16, 24, 32), 96)
    eventually(lambda: len(modem.received) == 2)
    first, region = modem.received
    pixels = sent.picture.to_array()
    height, width = pixels.shape
    inside = pixels[height // 4 : height * 3 // 4, width // 2 :]
    assert (region.height_px, region.width_px) == inside.shape
    assert region.contact == first.contact
    assert 60 <= len(region.stream) <= 96
    shown = emb.decode(region.stream).image
    assert shown.shape == inside.shape
    assert np.abs(shown.astype(int) - inside.astype(int)).mean() < 40
    assert service.health().counters["images_region"] == 1


def test_region_of_an_unknown_image_is_counted(start_service, send_region, modem):
    service = start_service()
    send_region("0ZZZ", (0, 0, 32, 32), 96)
    eventually(lambda: service.health().counters.get("commands_unknown_image", 0) == 1)
    assert not modem.received
