"""op_modem: bytes written into the store for each received frame."""

from __future__ import annotations

from functools import partial

import pytest
from builders.common import eventually
from builders.vessel_frames import packet, preview_frame, received
from builders.written_bytes import written_bytes

from sonarpost import keys
from sonarpost.messages import ReceivedImage
from sonarpost.modem.interface import FrameDecoded
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService

VESSEL = "vessel-1"
PACKETS = 20
MAX_BYTES = 8192


@pytest.mark.parametrize(("frames_in_packet", "delivered"), [(3, True), (1, False)])
def test_written_bytes_of_a_frame_do_not_depend_on_the_number_of_contacts(
    runner, platform, modem_pair, frames_in_packet, delivered
):
    """Every frame of 60 bytes starts a new image, which is delivered to the decompressor if there is one."""
    consumers = ("decompressor",) if delivered else ()
    config = OpModemConfig(port=modem_pair.port(modem_pair.VESSEL), image_consumers=consumers)
    service = runner.start(OpModemService(platform(VESSEL), config))
    if delivered:
        runner.peer(VESSEL, "decompressor", {keys.acoustic_image(VESSEL): ReceivedImage})

    def receive(number: int) -> None:
        frames = [received(preview_frame(number + n, 12, 64), n + 1) for n in range(frames_in_packet)]
        for frame in frames:
            service.on_modem_event(FrameDecoded(frame))
        service.on_modem_event(packet(*frames))
        eventually(lambda: service.store.outbox_depth() == 0)

    def written_per_frame(first: int) -> float:
        numbers = range(first, first + frames_in_packet * PACKETS, frames_in_packet)
        total = sum(written_bytes(service.store, partial(receive, number)) for number in numbers)
        return total / (frames_in_packet * PACKETS)

    receive(1)
    few = written_per_frame(1000)
    for number in range(2, 726):
        service.on_modem_event(packet(preview_frame(number, 12, 64), src=3 + number % 2))
    eventually(lambda: service.store.outbox_depth() == 0)
    many = written_per_frame(2000)
    assert service.link_gauges()["images_incomplete"] > 725
    assert few <= MAX_BYTES
    assert many <= MAX_BYTES
    assert many <= 1.5 * few
