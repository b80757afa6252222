"""decompressor: bytes written into the store for each received image."""

from __future__ import annotations

import pytest
from builders.common import eventually
from builders.vessel_frames import CONTACT
from builders.written_bytes import written_bytes

from sonarpost import keys, wire
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.received_image import received_image
from sonarpost.link.receiver import ImageUpdate
from sonarpost.messages import CodedImage, ReceivedImage
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService

VESSEL = "vessel-1"
IN, OUT = keys.acoustic_image(VESSEL), keys.image_coded(VESSEL)
IMAGES = 20
MAX_OVERHEAD_BYTES = 10_000
"""Beyond the received record and the sent one."""


def contact_only(number: int) -> ReceivedImage:
    update = ImageUpdate(3, image_of_number(number), 1, CONTACT, b"", (), False, 0, 0, 1, 0, 1.7e9, 1.7e9)
    return received_image(update, VESSEL, "uuv-1")


def test_written_bytes_of_an_image_do_not_depend_on_the_number_of_contacts(runner, platform, tmp_path):
    service = runner.start(DecompressorService(platform(VESSEL), DecompressorConfig(out_dir=tmp_path / "out")))
    op_modem = runner.peer(VESSEL, "op_modem")
    relay = runner.peer(VESSEL, "relay", {OUT: CodedImage})

    def process(numbers: range, in_one_batch: bool) -> None:
        for part in [numbers] if in_one_batch else [range(n, n + 1) for n in numbers]:
            expected = len(relay.received) + len(part)
            op_modem.send(IN, "decompressor", *map(contact_only, part))
            eventually(lambda: len(relay.received) == expected)  # noqa: B023 used in this iteration
            eventually(lambda: service.store.outbox_depth() + service.store.inbox_depth() == 0)

    def written_per_image(first: int) -> float:
        numbers = range(first, first + IMAGES)
        return written_bytes(service.store, lambda: process(numbers, in_one_batch=False)) / IMAGES

    process(range(1, 2), in_one_batch=True)
    few = written_per_image(10)
    process(range(100, 825), in_one_batch=True)
    many = written_per_image(2000)
    record_bytes = len(wire.encode(contact_only(1))) + len(wire.encode(relay.received[0]))
    assert few - record_bytes <= MAX_OVERHEAD_BYTES
    assert many == pytest.approx(few, rel=0.1)
