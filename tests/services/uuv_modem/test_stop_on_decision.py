"""A verdict stops the rest of an image: the vehicle's and the vessel's endpoints with a channel between them."""

from collections import Counter

import pytest
from builders.records import command_record, decision_record, encoded_image

from sonarpost.link.downlink.commands import CommandState
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.vessel_endpoint import VesselLink
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.vehicle_endpoint import VehicleEndpoint

PACKET_S = 6.1
STREAM_BYTES = 600


class Link:
    """Both ends of a channel without loss, and a clock. The vessel sends after each packet of the vehicle."""

    def __init__(self, **config):
        self.config = UuvModemConfig(port="unused", group_delay_s=0.0, stream_bytes=STREAM_BYTES, **config)
        self.vehicle = VehicleEndpoint("uuv-1", self.config)
        self.vessel = VesselLink("vessel-1", OpModemConfig(port="unused", vehicles={"3": "uuv-1"}))
        self.now = 1e9
        self.received: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()

    def add(self, *numbers):
        self.vehicle.queue.sender.expect_feedback(expected=True)
        for number in numbers:
            self.vehicle.add(encoded_image(number, STREAM_BYTES), self.now)

    def decide(self, number, verdict, issued_s=None):
        decided_s = self.now if issued_s is None else issued_s
        decision_id = f"d-{self.now}-{number}-{verdict}"
        decision = decision_record(decision_id, image_id=f"{number:04}", verdict=verdict, decided_utc_s=decided_s)
        assert self.vessel.add(decision, self.now) is not None
        return decision.decision_id

    def run(self, packets):
        """Exchange packets, at most so many of the vehicle; return how many it sent."""
        sent = 0
        for _ in range(packets):
            self.now += PACKET_S
            packet = self.vehicle.next_packet(self.now)
            if packet is not None:
                self.vehicle.packet_sent(packet.frames, PACKET_S)
                sent += 1
            for frame in packet.frames if packet else ():
                for image in self.vessel.endpoint.accept(3, frame, self.now).images:
                    self.received[image.image_id] = len(image.stream)
            answer = self.vessel.endpoint.next_packet(3, 32, self.now)
            if answer is not None:
                self.vessel.endpoint.sent(answer, self.now)
                for frame in answer.frames:
                    self.vehicle.receive(1, frame, self.now)
            self.counts.update(self.vehicle.take_effects().counts)
        return sent

    def run_until_previewed(self, images):
        for _ in range(50):
            self.run(1)
            if len(self.received) == images:
                return
        pytest.fail("no previews")

    def state_of(self, record_id):
        command = self.vessel.commands.find("decision", record_id)
        assert command is not None
        return command.state


def test_final_verdicts_stop_their_images_and_are_confirmed():
    link = Link()
    link.add(1, 2, 3)
    link.run_until_previewed(3)
    decisions = [link.decide(1, "not_mine_like"), link.decide(2, "mine_like"), link.decide(3, "unsure")]
    link.run(60)
    assert [link.state_of(each) for each in decisions] == [CommandState.CONFIRMED] * 3
    assert link.counts["images_stopped"] == 2
    assert link.received["0001"] < 200
    assert link.received["0002"] < 200
    assert link.received["0003"] == STREAM_BYTES
    assert link.vessel.endpoint.incomplete_images == 0
    assert link.vessel.endpoint.feedback_open == 0
    assert link.vehicle.queue_state(link.now).images == ()


def test_vessel_does_not_wait_for_a_stopped_image_of_a_group_of_its_own():
    link = Link()
    link.add(1)
    link.run_until_previewed(1)
    link.decide(1, "not_mine_like")
    link.run(60)
    assert link.received["0001"] < 200
    assert link.vessel.endpoint.incomplete_images == 0
    assert link.vessel.endpoint.feedback_open == 0
    assert link.run(100) == 0
    # A withdrawn verdict queues the rest again.
    link.decide(1, "unsure")
    link.run(60)
    assert link.counts["images_resumed"] == 1
    assert link.received["0001"] == STREAM_BYTES
    assert link.vessel.endpoint.incomplete_images == 0


def test_late_copy_of_a_withdrawn_verdict_stops_nothing():
    link = Link()
    link.add(1, 2)
    link.run_until_previewed(2)
    link.decide(1, "unsure")
    link.run(2)
    link.decide(1, "not_mine_like", issued_s=link.now - 600.0)
    link.run(60)
    assert link.counts["images_stopped"] == 0
    assert link.received["0001"] == STREAM_BYTES


def test_prioritised_image_is_completed_first():
    link = Link()
    link.add(1, 2, 3, 4)
    link.run_until_previewed(4)
    command = command_record("prioritise", "0003", command_id="c-1", issued_utc_s=link.now, place="first")
    assert link.vessel.add(command, link.now) is not None
    while link.received["0003"] < STREAM_BYTES:
        assert link.run(1) == 1
    assert max(link.received[name] for name in ("0001", "0002", "0004")) < STREAM_BYTES
    link.run(60)
    assert set(link.received.values()) == {STREAM_BYTES}
    found = link.vessel.commands.find("prioritise", "c-1")
    assert found is not None
    assert found.state is CommandState.CONFIRMED


def test_option_switches_the_stop_off():
    link = Link(stop_on_decision=False)
    link.add(1)
    link.run_until_previewed(1)
    decision = link.decide(1, "not_mine_like")
    link.run(60)
    assert link.state_of(decision) is CommandState.REFUSED
    assert link.received["0001"] == STREAM_BYTES


def test_stop_survives_a_restart():
    link = Link()
    link.add(1, 2)
    link.run_until_previewed(2)
    link.decide(1, "not_mine_like")
    link.run(3)
    parts = link.vehicle.parts()
    link.vehicle = VehicleEndpoint("uuv-1", link.config)
    assert not link.vehicle.restore(parts)
    parts = link.vessel.parts()
    link.vessel = VesselLink("vessel-1", OpModemConfig(port="unused", vehicles={"3": "uuv-1"}))
    assert not link.vessel.restore(parts)
    link.run(60)
    assert link.received["0001"] < 200
    assert link.received["0002"] == STREAM_BYTES
    assert link.vessel.endpoint.incomplete_images == 0
