"""The vessel's end of the link: orders repeated until confirmed, reports when they help, all over a restart."""

from __future__ import annotations

from dataclasses import replace

import msgpack
import numpy as np
import pytest

from sonarpost.errors import FrameError
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.downlink import messages as dl
from sonarpost.link.downlink.commands import MAX_PENDING, CommandState, CommandTracker, PendingCommand
from sonarpost.link.downlink.vessel_endpoint import VesselEndpoint
from sonarpost.link.events import FeedbackReceived, MessageReceived
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.receiver import LinkReceiver
from sonarpost.link.sender import LinkSender

UUV, VESSEL = 3, 1
LASTING_S = 3600.0


def order(book, record_id, kind="resend", address=UUV, now=0.0):
    token = book.free_token(kind, record_id)
    content = dl.ResendMessage(token, 0, 7)
    return PendingCommand(kind, record_id, "uuv-1", address, token, dl.pack(content), now, now + LASTING_S)


class Vehicle:
    """Takes orders as a vehicle does: each once, and confirms every copy."""

    def __init__(self, config=None):
        self.receiver = LinkReceiver()
        self.sender = LinkSender(config or SenderConfig(channels=(LossChannel(0.5),)))
        self.taken = []

    def hear(self, frame, now):
        for event in self.receiver.accept(VESSEL, frame, now):
            if isinstance(event, FeedbackReceived):
                self.sender.on_report(event.report, now, VESSEL)
            elif isinstance(event, MessageReceived):
                content = dl.unpack(event.data)
                if content not in self.taken:
                    self.taken.append(content)
                answer = dl.ConfirmationMessage(((content.token, dl.CommandOutcome.TAKEN),))
                self.sender.add_message(dl.pack(answer), now, times=1)


def restarted(link):
    """The same link in another process."""
    again = VesselEndpoint(CommandTracker(link.book.retry_s), link.receiver.config)
    again.restore(msgpack.unpackb(msgpack.packb(link.snapshot()), strict_map_key=False))
    return again


@pytest.mark.parametrize("frame_bytes", [32, 64])
def test_orders_reach_the_vehicle_once_through_half_lost_frames_and_restarts(frame_bytes):
    rng = np.random.default_rng(frame_bytes)
    link, vehicle = VesselEndpoint(CommandTracker(30.0)), Vehicle()
    for n in range(20):
        link.book.ask(order(link.book, f"c-{n}"), 0.0)
    changes = []
    now = 0.0
    while link.book.open_orders:
        now += 5.0
        assert now < LASTING_S
        packet = link.packet(3, frame_bytes, now)
        if packet is not None:
            assert packet.address == UUV
            assert {len(frame) for frame in packet.frames} == {frame_bytes}
            for frame in packet.frames:
                if rng.random() >= 0.5:
                    vehicle.hear(frame, now)
            changes += link.sent(packet, now)
        link = restarted(link)
        answer = vehicle.sender.next_frame(now)
        if answer is not None and rng.random() >= 0.5:
            changes += link.hear(UUV, answer, now).orders
    assert len(vehicle.taken) == 20
    final = {change.record_id: change.state for change in changes}
    assert set(final.values()) == {CommandState.CONFIRMED}
    assert len(final) == 20
    assert max(change.times_sent for change in changes) > 1


def test_an_order_nobody_hears_is_sent_more_and_more_rarely_and_expires():
    link = VesselEndpoint(CommandTracker(60.0))
    link.book.ask(order(link.book, "c-1"), 0.0)
    sent_at = []
    for now in np.arange(0.0, LASTING_S + 10, 5.0):
        packet = link.packet(1, 32, float(now))
        if packet is not None:
            link.sent(packet, float(now))
            sent_at.append(float(now))
    assert np.diff(sent_at).tolist()[:5] == [60.0, 120.0, 240.0, 480.0, 480.0]
    [expired] = link.book.expire(LASTING_S)
    assert (expired.state, expired.times_sent) == (CommandState.EXPIRED, len(sent_at))
    assert link.book.open_orders == ()
    late = dl.ConfirmationMessage(((expired.token, dl.CommandOutcome.TAKEN),))
    assert [o.state for o in link.book.confirm(UUV, late.outcomes)] == [CommandState.CONFIRMED]


def test_what_failed_is_due_at_once_and_what_was_sent_is_not():
    link = VesselEndpoint(CommandTracker(60.0))
    link.book.ask(order(link.book, "c-1"), 0.0)
    packet = link.packet(1, 32, 0.0)
    link.failed(packet)
    assert link.wants_to_send(0.0) == UUV
    again = link.packet(1, 32, 0.0)
    assert again.tokens == packet.tokens
    assert again.frames != packet.frames  # another number: to the vehicle's link it is another message
    link.sent(again, 0.0)
    assert link.wants_to_send(59.0) is None


def test_confirmations_count_from_the_vehicle_that_was_asked_and_once():
    book = CommandTracker(60.0)
    asked = book.ask(order(book, "c-1"), 0.0)
    outcome = (asked.token, dl.CommandOutcome.UNKNOWN_IMAGE)
    assert book.confirm(UUV + 1, [outcome]) == ()
    assert book.confirm(UUV, [(asked.token ^ 1, dl.CommandOutcome.TAKEN)]) == ()
    [refused] = book.confirm(UUV, [outcome, (asked.token, dl.CommandOutcome.TAKEN)])
    assert (refused.state, refused.reason) == (CommandState.REFUSED, "unknown image")


def test_a_record_that_comes_again_is_known_and_tokens_are_free():
    book = CommandTracker(60.0)
    first = book.ask(order(book, "c-1"), 0.0)
    assert book.known("resend", "c-1") == first
    assert book.known("refine", "c-1") is None
    assert book.free_token("resend", "c-1") == dl.token_of("c-1", "command", 1)
    with pytest.raises(FrameError, match="token"):
        book.ask(first, 0.0)


def test_the_book_is_bounded():
    book = CommandTracker(60.0)
    for n in range(MAX_PENDING):
        book.ask(order(book, f"c-{n}"), 0.0)
    with pytest.raises(FrameError, match="open"):
        book.ask(order(book, "one more"), 0.0)
    for n in range(1500):
        book.expire(1e9 + n + LASTING_S)
        book.ask(order(book, f"d-{n}", now=1e9 + n), 1e9 + n)
    assert len(book.snapshot()["orders"]) <= 1000 + MAX_PENDING


@pytest.mark.parametrize("field", ["format", "state", "address", "message", "due_at"])
def test_a_state_of_somebody_else_is_refused(field):
    book = CommandTracker(60.0)
    book.ask(order(book, "c-1"), 0.0)
    state = msgpack.unpackb(msgpack.packb(book.snapshot()))
    if field == "format":
        state["format"] = 99
    else:
        state["orders"][0][field] = None
    with pytest.raises(FrameError, match=field):
        book.restore(state)
    assert len(book.open_orders) == 1


PICTURE = bytes([0x20]) + bytes(range(200))
CONTACT = ContactSummary(height_px=40, width_px=60, lat_deg=56.4, lon_deg=-5.6, time_utc_s=1_475_568_000.0)


def test_reports_make_the_vehicle_complete_what_was_lost():
    rng = np.random.default_rng(5)
    vehicle = Vehicle(SenderConfig(frame_bytes=64, channels=(LossChannel(0.1),), feedback=True, max_defer_s=120.0))
    for number in range(1, 9):
        vehicle.sender.add_picture(number, replace(CONTACT, time_utc_s=float(number)), PICTURE, 0.0)
    link = VesselEndpoint(CommandTracker(30.0), ReceiverConfig(feedback_interval_s=60.0))
    now, reports = 0.0, 0
    while vehicle.sender.blocks or vehicle.sender.waiting:
        now += 6.0
        assert now < 3600
        for frame in vehicle.sender.next_packet(3, now):
            if rng.random() >= 0.3:
                link.hear(UUV, frame, now)
        packet = link.packet(1, 32, now)
        if packet is not None:
            reports += packet.reports
            link.sent(packet, now)
            for frame in packet.frames:
                vehicle.hear(frame, now)
    assert link.receiver.counts.complete >= 8
    assert 1 <= reports <= 20


def test_reports_into_silence_become_rare_and_end():
    vehicle = Vehicle(SenderConfig(frame_bytes=64, feedback=True))
    for number in range(1, 5):
        vehicle.sender.add_picture(number, CONTACT, PICTURE, 0.0)
    link = VesselEndpoint(CommandTracker(30.0), ReceiverConfig(feedback_interval_s=10.0))
    link.hear(UUV, vehicle.sender.next_frame(0.0), 0.0)
    at = []
    for now in range(1, 3000):
        packet = link.packet(1, 32, float(now))
        if packet is not None:
            at.append(now)
            link.sent(packet, float(now))
    assert np.diff(at).tolist() == [10, 20, 40, 80, 160, 320]
    link.hear(UUV, vehicle.sender.next_frame(3000.0), 3000.0)
    assert link.wants_to_send(3000.0 + 400) == UUV


def test_a_report_that_failed_comes_again_and_none_without_feedback():
    vehicle = Vehicle(SenderConfig(frame_bytes=64, feedback=True))
    for number in range(1, 5):
        vehicle.sender.add_picture(number, CONTACT, PICTURE, 0.0)
    frame = vehicle.sender.next_frame(0.0)
    link, mute = VesselEndpoint(CommandTracker(30.0)), VesselEndpoint(CommandTracker(30.0), feedback=False)
    for each in (link, mute):
        each.hear(UUV, frame, 0.0)
    packet = link.packet(1, 32, 61.0)
    assert packet.reports
    assert link.wants_to_send(61.0) is None
    link.failed(packet)
    assert link.packet(1, 32, 61.0).reports
    assert mute.packet(1, 32, 61.0) is None


def test_other_traffic_is_given_out_once_and_nonsense_is_refused():
    link = VesselEndpoint(CommandTracker(30.0))
    sender = LinkSender(SenderConfig(channels=(LossChannel(0.3),)))
    sender.add_message(dl.pack(dl.DataMessage(b"status"), 4096), 0.0, times=2)
    frames = [sender.next_frame(float(n)) for n in range(2)]
    heard = [link.hear(UUV, frame, 0.0) for frame in frames if frame is not None]
    assert [each.data for each in heard] in ([(b"status",)], [(b"status",), ()])
    nonsense = pack_segments([Segment(SegmentKind.MESSAGE, b"\x01\x7f")], 32)
    assert [error.field for error in link.hear(UUV, nonsense, 0.0).refused] == ["kind"]
    assert link.hear(UUV, b"not a frame", 0.0).refused[0].field == "checksum"


def test_an_order_that_fits_no_frame_is_an_error_that_says_so():
    link = VesselEndpoint(CommandTracker(30.0))
    long = replace(order(link.book, "c-1"), message=bytes(40))
    link.book.ask(long, 0.0)
    with pytest.raises(FrameError, match="room for an order"):
        link.packet(1, 32, 0.0)
    assert link.packet(1, 64, 0.0).tokens == (long.token,)
