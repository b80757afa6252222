"""The paper's chain without a channel: image, codec, packets, receiver. Lost parts are black and marked as missing."""

from __future__ import annotations

import numpy as np
import pytest

from sonarpost.codec.vq.codec import VqCodec
from sonarpost.codec.vq.tiles import TileDatabase, cut_tiles
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import Packet, plan_packets
from sonarpost.link.receiver import ImageUpdate, received_mask

HEIGHT_PX, WIDTH_PX, TILE_PX = 80, 140, 10
CONTACT = ContactSummary(height_px=HEIGHT_PX, width_px=WIDTH_PX, lat_deg=44.7, lon_deg=-63.6)


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    return np.random.default_rng(7).integers(1, 256, (HEIGHT_PX, WIDTH_PX), dtype=np.uint8)


@pytest.fixture(scope="module")
def codec(image: np.ndarray) -> VqCodec:
    return VqCodec(TileDatabase.from_tiles(TILE_PX, cut_tiles(image, TILE_PX)))


def send(packets: tuple[Packet, ...], lost: set[int]) -> ImageUpdate:
    """Deliver all packets except the lost ones, at the interval of rate 1."""
    receiver = PaperReceiver(60)
    events = []
    for number, packet in enumerate(packets):
        if number not in lost:
            events += [e for frame in packet for e in receiver.accept(1, frame.ljust(64, b"\0"), number * 6.1)]
    events += receiver.poll(1000)
    (event,) = events
    assert isinstance(event, ImageUpdate)
    return event


@pytest.mark.parametrize(
    ("lost", "received_rows"),
    [((), slice(0, HEIGHT_PX)), ((1,), slice(0, HEIGHT_PX // 2)), ((0,), slice(HEIGHT_PX // 2, HEIGHT_PX))],
    ids=["nothing lost", "bottom lost", "top lost"],
)
def test_received_half_is_decoded_at_its_place(
    image: np.ndarray, codec: VqCodec, lost: tuple[int, ...], received_rows: slice
) -> None:
    packets = plan_packets("0001", codec.encode(image), CONTACT, 3, 64)
    assert len(packets) == 2
    event = send(packets, set(lost))
    assert event.contact == CONTACT.rounded()  # in both packets
    decoded = codec.decode(event.stream, received_mask(event.stream, event.missing))
    assert np.array_equal(decoded.image[received_rows], image[received_rows])
    lost_rows = np.ones(HEIGHT_PX, dtype=bool)
    lost_rows[received_rows] = False
    assert not decoded.image[lost_rows].any()
    assert decoded.missing[lost_rows].all()
    assert not decoded.missing[received_rows].any()
