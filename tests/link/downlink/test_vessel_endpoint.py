"""The vessel's end of the link: commands until they are confirmed, feedback when it is useful, restarts."""

from dataclasses import replace

import numpy as np
import pytest
from builders.link_state import with_fields
from builders.v1_world import add_message, next_frames

from sonarpost.errors import FrameError
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.downlink import commands
from sonarpost.link.downlink import messages as dl
from sonarpost.link.downlink.commands import MAX_PENDING, CommandState, CommandTracker, PendingCommand
from sonarpost.link.downlink.vessel_endpoint import VesselEndpoint
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import FeedbackReceived, MessageReceived

UUV, VESSEL = 3, 1
LASTING_S = 3600.0


def command(tracker, record_id, kind="resend", address=UUV, now=0.0):
    token = tracker.free_token(kind, record_id)
    content = dl.ResendMessage(token, 0, 7)
    return PendingCommand(kind, record_id, "uuv-1", address, token, dl.pack(content), now, now + LASTING_S)


class Vehicle:
    """Executes each command once and confirms every copy, as a vehicle does."""

    def __init__(self, config=None):
        self.receiver = V1Receiver()
        self.sender = V1Sender(config or SenderConfig(channels=(LossChannel(0.5),)))
        self.accepted = []

    def receive(self, frame, now):
        for event in self.receiver.accept(VESSEL, frame, now):
            if isinstance(event, FeedbackReceived):
                self.sender.on_feedback(event.feedback, now, VESSEL)
            elif isinstance(event, MessageReceived):
                content = dl.unpack(event.data)
                if content not in self.accepted:
                    self.accepted.append(content)
                answer = dl.ConfirmationMessage(((content.token, dl.CommandOutcome.ACCEPTED),))
                add_message(self.sender, dl.pack(answer), now, times=1)


def restarted(link):
    """Return the endpoint restored in another process."""
    again = VesselEndpoint(CommandTracker(link.commands.retry_s), link.v1.config)
    assert not again.restore(link.parts())
    return again


@pytest.mark.parametrize("frame_bytes", [32, 64])
def test_commands_arrive_once_at_50_percent_loss_and_restarts(frame_bytes):
    rng = np.random.default_rng(frame_bytes)
    link, vehicle = VesselEndpoint(CommandTracker(30.0)), Vehicle()
    for n in range(20):
        link.commands.add(command(link.commands, f"c-{n}"), 0.0)
    changes = []
    now = 0.0
    while link.commands.open_commands:
        now += 5.0
        assert now < LASTING_S
        packet = link.next_packet(3, frame_bytes, now)
        if packet is not None:
            assert packet.address == UUV
            assert {len(frame) for frame in packet.frames} == {frame_bytes}
            for frame in packet.frames:
                if rng.random() >= 0.5:
                    vehicle.receive(frame, now)
            changes += link.sent(packet, now)
        link = restarted(link)
        answer = vehicle.sender.next_frame(now)
        if answer is not None and rng.random() >= 0.5:
            changes += link.accept(UUV, answer, now).commands
    assert len(vehicle.accepted) == 20
    final = {change.record_id: change.state for change in changes}
    assert set(final.values()) == {CommandState.CONFIRMED}
    assert len(final) == 20
    assert max(change.times_sent for change in changes) > 1


def test_unanswered_command_is_retried_less_often_and_expires():
    link = VesselEndpoint(CommandTracker(60.0))
    link.commands.add(command(link.commands, "c-1"), 0.0)
    sent_at = []
    for now in np.arange(0.0, LASTING_S + 10, 5.0):
        packet = link.next_packet(1, 32, float(now))
        if packet is not None:
            link.sent(packet, float(now))
            sent_at.append(float(now))
    assert np.diff(sent_at).tolist()[:7] == [60.0, 60.0, 60.0, 120.0, 240.0, 480.0, 480.0]
    [expired] = link.commands.expire(LASTING_S)
    assert (expired.state, expired.times_sent) == (CommandState.EXPIRED, len(sent_at))
    assert link.commands.open_commands == ()
    late = dl.ConfirmationMessage(((expired.token, dl.CommandOutcome.ACCEPTED),))
    assert [o.state for o in link.commands.confirm(UUV, late.outcomes)] == [CommandState.CONFIRMED]


def test_failed_packet_is_due_at_once():
    link = VesselEndpoint(CommandTracker(60.0))
    link.commands.add(command(link.commands, "c-1"), 0.0)
    packet = link.next_packet(1, 32, 0.0)
    link.failed(packet)
    assert link.due_address(0.0) == UUV
    again = link.next_packet(1, 32, 0.0)
    assert again.tokens == packet.tokens
    assert again.frames != packet.frames  # a new message number, so that the vehicle's link does not drop it
    link.sent(again, 0.0)
    assert link.due_address(59.0) is None


def test_only_the_addressed_vehicle_confirms_a_command_once():
    tracker = CommandTracker(60.0)
    added = tracker.add(command(tracker, "c-1"), 0.0)
    outcome = (added.token, dl.CommandOutcome.UNKNOWN_IMAGE)
    assert tracker.confirm(UUV + 1, [outcome]) == ()
    assert tracker.confirm(UUV, [(added.token ^ 1, dl.CommandOutcome.ACCEPTED)]) == ()
    [rejected] = tracker.confirm(UUV, [outcome, (added.token, dl.CommandOutcome.ACCEPTED)])
    assert (rejected.state, rejected.reason) == (CommandState.REFUSED, "unknown image")


def test_repeated_record_is_found_and_tokens_are_unique():
    tracker = CommandTracker(60.0)
    first = tracker.add(command(tracker, "c-1"), 0.0)
    assert tracker.find("resend", "c-1") == first
    assert tracker.find("refine", "c-1") is None
    assert tracker.free_token("resend", "c-1") == dl.token_of("c-1", "command", 1)
    with pytest.raises(FrameError, match="token"):
        tracker.add(first, 0.0)


def test_tracker_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(commands, "_MAX_CLOSED", 20)
    tracker = CommandTracker(60.0)
    for n in range(MAX_PENDING):
        tracker.add(command(tracker, f"c-{n}"), 0.0)
    with pytest.raises(FrameError, match="open"):
        tracker.add(command(tracker, "one more"), 0.0)
    for n in range(30):
        tracker.expire(1e9 + n + LASTING_S)
        tracker.add(command(tracker, f"d-{n}", now=1e9 + n), 1e9 + n)
    assert len(tracker.parts()) == 20 + 1, "the last closed ones and the open one"


def test_vehicles_have_shares_of_open_commands_and_take_turns():
    tracker = CommandTracker(60.0)
    for n in range(MAX_PENDING):
        tracker.add(command(tracker, f"c-{n}"), 0.0)
    other = replace(command(tracker, "other"), address=9)
    assert not tracker.is_full(9)
    tracker.add(other, 1.0)
    endpoint = VesselEndpoint(tracker)
    packets = [endpoint.next_packet(1, 64, 2.0) for _ in range(4)]
    assert [packet.address for packet in packets] == [3, 9, 3, 9]
    assert packets[1].tokens == (other.token,)


@pytest.mark.parametrize("field", ["format version", "state", "address", "message", "due_s"])
def test_a_malformed_command_is_reported_and_the_others_restored(field):
    tracker = CommandTracker(60.0)
    first, second = (tracker.add(command(tracker, f"c-{n}"), 0.0) for n in (1, 2))
    again = CommandTracker(60.0)
    name = f"command/{first.token}"
    errors = again.restore(with_fields(tracker.parts(), name, PendingCommand, {field: None}))
    assert [(part, error.field) for part, error in errors.items()] == [(name, field)]
    assert again.open_commands == (second,)


def test_the_endpoint_reports_malformed_parts_by_name():
    link = VesselEndpoint(CommandTracker(30.0))
    added = link.commands.add(command(link.commands, "c-1"), 0.0)
    link.accept(UUV, Vehicle().sender.next_frame(0.0) or b"", 0.0)
    for name in ("endpoint", "v1/counts", "paper/counts", f"commands/command/{added.token}"):
        again = VesselEndpoint(CommandTracker(30.0))
        assert set(again.restore(with_fields(link.parts(), name, PendingCommand, {"format version": 1}))) == {name}
        assert len(again.commands.open_commands) == (not name.startswith("commands/"))


STREAM = bytes([0x20]) + bytes(range(200))
CONTACT = ContactSummary(height_px=40, width_px=60, lat_deg=56.4, lon_deg=-5.6, time_utc_s=1_475_568_000.0)


def test_feedback_completes_lost_images():
    rng = np.random.default_rng(5)
    vehicle = Vehicle(SenderConfig(frame_bytes=64, channels=(LossChannel(0.1),), feedback=True, max_defer_s=120.0))
    for number in range(1, 9):
        vehicle.sender.add_image(number, replace(CONTACT, time_utc_s=float(number)), STREAM, 0.0)
    link = VesselEndpoint(CommandTracker(30.0), ReceiverConfig(feedback_interval_s=60.0))
    now, feedback_sent = 0.0, 0
    while vehicle.sender.window.blocks or vehicle.sender.waiting:
        now += 6.0
        assert now < 3600
        for frame in next_frames(vehicle.sender, 3, now):
            if rng.random() >= 0.3:
                link.accept(UUV, frame, now)
        packet = link.next_packet(1, 32, now)
        if packet is not None:
            feedback_sent += packet.has_feedback
            link.sent(packet, now)
            for frame in packet.frames:
                vehicle.receive(frame, now)
    assert link.v1.counts.complete >= 8
    assert 1 <= feedback_sent <= 20


def test_unanswered_feedback_becomes_rare_and_ends():
    vehicle = Vehicle(SenderConfig(frame_bytes=64, feedback=True))
    for number in range(1, 5):
        vehicle.sender.add_image(number, CONTACT, STREAM, 0.0)
    link = VesselEndpoint(CommandTracker(30.0), ReceiverConfig(feedback_interval_s=10.0))
    link.accept(UUV, vehicle.sender.next_frame(0.0), 0.0)
    at = []
    for now in range(1, 3000):
        packet = link.next_packet(1, 32, float(now))
        if packet is not None:
            at.append(now)
            link.sent(packet, float(now))
    assert np.diff(at).tolist() == [10, 10, 10, 20, 40, 80] + 18 * [100]
    link.accept(UUV, vehicle.sender.next_frame(3000.0), 3000.0)
    assert link.due_address(3000.0 + 400) == UUV


def test_failed_feedback_is_repeated():
    vehicle = Vehicle(SenderConfig(frame_bytes=64, feedback=True))
    for number in range(1, 5):
        vehicle.sender.add_image(number, CONTACT, STREAM, 0.0)
    frame = vehicle.sender.next_frame(0.0)
    link, mute = VesselEndpoint(CommandTracker(30.0)), VesselEndpoint(CommandTracker(30.0), feedback=False)
    for each in (link, mute):
        each.accept(UUV, frame, 0.0)
    packet = link.next_packet(1, 32, 61.0)
    assert packet.has_feedback
    assert link.due_address(61.0) is None
    link.failed(packet)
    assert link.next_packet(1, 32, 61.0).has_feedback
    assert mute.next_packet(1, 32, 61.0) is None


def lost_image_frames():
    """Return a frame of an incomplete block and the other frames of the same image."""
    vehicle = Vehicle(SenderConfig(frame_bytes=64, channels=(LossChannel(0.3),), frames_per_image=6))
    vehicle.sender.add_image(7, ContactSummary(height_px=40, width_px=60), bytes([0x20]) + bytes(range(200)), 0.0)
    frames = []
    while (frame := vehicle.sender.next_frame(0.0)) is not None:
        frames.append(frame)
    return frames


def test_open_feedback_is_counted_until_it_is_no_longer_useful():
    first, *others = lost_image_frames()
    link = VesselEndpoint(CommandTracker(30.0), ReceiverConfig(feedback_interval_s=10.0))
    mute = VesselEndpoint(CommandTracker(30.0), feedback=False)
    assert (link.feedback_open, link.incomplete_images) == (0, 0)
    for endpoint in (link, mute):
        endpoint.accept(UUV, first, 0.0)
    assert (link.feedback_open, mute.feedback_open) == (1, 0)
    assert link.incomplete_images == mute.incomplete_images
    now = 0.0
    while link.feedback_open:
        now += 10.0
        assert now < 10_000.0
        packet = link.next_packet(1, 32, now)
        if packet is not None:
            link.sent(packet, now)
    assert link.next_packet(1, 32, now + 3600.0) is None
    for frame in others:
        link.accept(UUV, frame, now)
    assert link.incomplete_images == 0


def test_overheard_vehicle_gets_no_feedback_and_its_messages_are_ignored():
    first, second, *_ = lost_image_frames()
    link = VesselEndpoint(CommandTracker(30.0), ReceiverConfig(feedback_interval_s=10.0))
    assert len(link.accept(UUV, first, 0.0, overheard=True).images) == 1
    assert len(link.accept(UUV + 1, first, 0.0).images) == 1
    message = pack_segments([Segment(SegmentKind.MESSAGE, b"\x01" + dl.pack(dl.DataMessage(b"text")))], 32)
    assert link.accept(UUV, message, 0.0, overheard=True).messages == ()
    for endpoint in (link, restarted(link)):
        assert endpoint.feedback_open == 1
        assert endpoint.next_packet(1, 32, 3600.0).address == UUV + 1
    link.accept(UUV, second, 1.0)
    assert link.accept(UUV, b"rejected", 2.0, overheard=True).rejected
    assert link.due_address(3600.0) == UUV


def test_messages_are_returned_once_and_invalid_ones_rejected():
    link = VesselEndpoint(CommandTracker(30.0))
    sender = V1Sender(SenderConfig(channels=(LossChannel(0.3),)))
    add_message(sender, dl.pack(dl.DataMessage(b"status"), 4096), 0.0, times=2)
    frames = [sender.next_frame(float(n)) for n in range(2)]
    received = [link.accept(UUV, frame, 0.0) for frame in frames if frame is not None]
    assert [each.messages for each in received] in ([(b"status",)], [(b"status",), ()])
    nonsense = pack_segments([Segment(SegmentKind.MESSAGE, b"\x01\x7f")], 32)
    assert [error.field for error in link.accept(UUV, nonsense, 0.0).rejected] == ["kind"]
    assert link.accept(UUV, b"not a frame", 0.0).rejected[0].field == "checksum"


def test_command_longer_than_a_frame_is_an_error():
    link = VesselEndpoint(CommandTracker(30.0))
    long = replace(command(link.commands, "c-1"), message=bytes(40))
    link.commands.add(long, 0.0)
    with pytest.raises(FrameError, match="room for a command"):
        link.next_packet(1, 32, 0.0)
    assert link.next_packet(1, 64, 0.0).tokens == (long.token,)
