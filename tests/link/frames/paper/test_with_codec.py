"""The paper's chain without water: a picture through codec, packets and receiver; what is lost is black and marked."""

from __future__ import annotations

import numpy as np
import pytest

from sonarpost.codec.vq.codec import VqCodec
from sonarpost.codec.vq.tiles import TileDatabase, cut_tiles
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import Packet, plan_packets
from sonarpost.link.receiver import ImageUpdate

HEIGHT_PX, WIDTH_PX, TILE_PX = 80, 140, 10
CONTACT = ContactSummary(height_px=HEIGHT_PX, width_px=WIDTH_PX, lat_deg=44.7, lon_deg=-63.6)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    return np.random.default_rng(7).integers(1, 256, (HEIGHT_PX, WIDTH_PX), dtype=np.uint8)


@pytest.fixture(scope="module")
def codec(picture: np.ndarray) -> VqCodec:
    return VqCodec(TileDatabase.from_tiles(TILE_PX, cut_tiles(picture, TILE_PX)))


def send(packets: tuple[Packet, ...], lost: set[int]) -> ImageUpdate:
    """Hand over every packet but the lost ones, each as long after the one before as at rate 1."""
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
    ("lost", "there"),
    [((), slice(0, HEIGHT_PX)), ((1,), slice(0, HEIGHT_PX // 2)), ((0,), slice(HEIGHT_PX // 2, HEIGHT_PX))],
    ids=["nothing lost", "bottom lost", "top lost"],
)
def test_received_half_is_decoded_at_its_place(
    picture: np.ndarray, codec: VqCodec, lost: tuple[int, ...], there: slice
) -> None:
    packets = plan_packets("0001", codec.encode(picture), CONTACT, 3, 64)
    assert len(packets) == 2
    event = send(packets, set(lost))
    assert event.contact == CONTACT.rounded()  # in both packets, so it survives the loss of either
    decoded = codec.decode(event.stream, event.received_mask())
    assert np.array_equal(decoded.image[there], picture[there])
    gone = np.ones(HEIGHT_PX, dtype=bool)
    gone[there] = False
    assert not decoded.image[gone].any()
    assert decoded.missing[gone].all()
    assert not decoded.missing[there].any()
