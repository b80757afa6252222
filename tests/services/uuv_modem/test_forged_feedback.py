"""Forged feedback: two false messages of 23 bytes end a queue without authentication, and change nothing with it."""

import pytest
from builders.authentication_world import key
from builders.records import encoded_image
from builders.v1_world import feedback_frame

from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.frames.v1.payload_objects import Feedback
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.vehicle_endpoint import VehicleEndpoint

VESSEL = 1
IMAGES = 24
PACKET_S = 6.1


class Vehicle:
    """A vehicle's endpoint with 24 images to send, and a clock."""

    def __init__(self, *, authenticated):
        config = UuvModemConfig(port="unused", group_delay_s=0.0)
        authenticator = None
        if authenticated:
            authenticator = FrameAuthenticator(key("fleet"), config.address, Direction.FROM_VEHICLE)
            authenticator.grant(10_000)
        self.endpoint = VehicleEndpoint("uuv-1", config, authenticator)
        self.now = 1e9
        self.frames = 0
        for number in range(1, IMAGES + 1):
            self.endpoint.add(encoded_image(number), self.now)

    def send(self, packets):
        """Send packets until there is nothing to send, at most so many."""
        for _ in range(packets):
            packet = self.endpoint.next_packet(self.now)
            if packet is None:
                return
            self.endpoint.packet_sent(packet.frames, PACKET_S)
            self.frames += len(packet.frames)
            self.now += PACKET_S

    def receive_forged_feedback(self, protection):
        """Receive two messages which say that nothing of any block is missing."""
        for newest in (15, 31):
            frame = feedback_frame(Feedback(newest, self.frames // 2, (0,) * 16), protection)
            self.endpoint.receive(VESSEL, frame, self.now)

    @property
    def rejected(self):
        counts = self.endpoint.take_effects().counts
        return counts["frames_rejected"] + counts["frames_forged"]


def test_forged_feedback_ends_an_unauthenticated_queue():
    vehicle = Vehicle(authenticated=False)
    vehicle.send(10)
    vehicle.receive_forged_feedback(None)
    vehicle.send(600)
    assert vehicle.frames < IMAGES * 300 // 64  # fewer than the bytes of the images


@pytest.mark.parametrize("with_a_tag", [False, True])
def test_forged_feedback_does_not_end_an_authenticated_queue(with_a_tag):
    vehicle = Vehicle(authenticated=True)
    vehicle.send(10)
    before = vehicle.endpoint.queue.images_waiting
    foreign = FrameAuthenticator(key("another fleet"), VESSEL, Direction.TO_VEHICLE)
    foreign.grant(100)
    vehicle.receive_forged_feedback(foreign if with_a_tag else None)
    vehicle.endpoint.receive_mini(VESSEL, 0, vehicle.now)  # has no tag
    assert vehicle.rejected == 3
    assert vehicle.endpoint.queue.images_waiting == before
    assert not vehicle.endpoint.queue.is_idle
    vehicle.send(600)
    assert vehicle.frames > IMAGES * 300 // 64
