"""The transmit queue on simulated time: order, fairness, airtime shares, lifetimes, restarts."""

import numpy as np
import pytest
from builders.link_state import group, with_fields
from builders.v1_world import queue_config, take_packet
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import ConfigError
from sonarpost.link.downlink.messages import image_of_number, number_of_image
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.queue.messages import MessageIdentifier, MessageQueue, QueuedMessage
from sonarpost.link.queue.transmit_queue import TransmitQueue, TransmitState
from sonarpost.link.receiver import ImageUpdate, MessageReceived
from sonarpost.link.sender import ImageToSend, OutgoingPacket
from sonarpost.link.state import SavedParts
from sonarpost.modem.micromodem import RATES

CONTACT = ContactSummary(height_px=80, width_px=80, lat_deg=56.4, lon_deg=-5.6, confidence=1.5)


def stream(number: int, length: int = 300) -> bytes:
    return np.random.default_rng(number).bytes(length)


def image(number: int, data: bytes | None = None) -> ImageToSend:
    return ImageToSend(image_of_number(number), f"c{number}", CONTACT, stream(number) if data is None else data)


def filled(queue: TransmitQueue, images: int, now: float = 0.0) -> TransmitQueue:
    for number in range(1, images + 1):
        assert queue.add_image(image(number), now)
    return queue


def run(queue: TransmitQueue, seconds: float, *, now: float = 0.0, lost=lambda: False, receiver=None, feedback=False):
    """Send for `seconds`; return the events and the time."""
    receiver = receiver or V1Receiver()
    found, end = [], now + seconds
    while now < end:
        frames = take_packet(queue, now)
        now += RATES[queue.rate].airtime_s
        for frame in frames:
            if not lost():
                found += receiver.accept(3, frame, now)
        if feedback and receiver.feedback_is_due(3, now) and (message := receiver.feedback(3, now)) and not lost():
            queue.on_feedback(message, now, 1)
    return found, now


def losses(share: float, seed: int = 1):
    rng = np.random.default_rng(seed)
    return lambda: bool(rng.random() < share)


def messages(events) -> list[bytes]:
    return [e.data for e in events if isinstance(e, MessageReceived)]


def test_all_contacts_precede_detail():
    queue = filled(TransmitQueue(queue_config(expected_loss=0.0)), 120)
    receiver, now, first = V1Receiver(), 0.0, None
    seen: set[str] = set()
    while len(seen) < 120:
        for frame in take_packet(queue, now):
            for event in receiver.accept(3, frame, now):
                assert isinstance(event, ImageUpdate)
                if len(event.stream) > 40 and first is None:
                    first = (event.image_id, len(seen))
                seen.add(event.image_id)
        now += 6.1
        assert now < 6.1 * 60, "no more than a frame a contact"
    assert first is None, f"detail of {first} before all contacts were seen"


def test_free_frames_of_a_packet_carry_copies_and_symbols():
    queue = TransmitQueue(queue_config(expected_loss=0.3))
    queue.add_message("m1", "uuv_modem", b"confirmed", 0.0, once=True)
    receivers = [V1Receiver(), V1Receiver()]
    frames = take_packet(queue, 0.0)
    events = [receiver.accept(3, frame, 0.0) for receiver, frame in zip(receivers, frames, strict=True)]
    assert [messages(each) for each in events] == [[b"confirmed"]] * 2
    assert take_packet(queue, 10.0) == ()
    queue = TransmitQueue(queue_config(expected_loss=0.0))
    queue.add_image(image(1, stream(1, 200)), 0.0)
    queue.sender.expect_feedback(expected=True)
    packets = list(iter(lambda: take_packet(queue, 0.0), ()))
    assert {len(frames) for frames in packets} == {3}
    assert sum(block.sent for block in queue.sender.window.blocks) > sum(
        b.source_symbols for b in queue.sender.window.blocks
    )


@pytest.mark.parametrize("kind", ["image of its own", "longer stream", "refine"])
def test_answer_to_a_request_goes_before_the_detail_of_others(kind):
    queue = filled(TransmitQueue(queue_config(expected_loss=0.0, stream_bytes=100, group_delay_s=60.0)), 1, -60.0)
    queue.sender.expect_feedback(expected=True)
    receiver = V1Receiver()
    _, now = run(queue, 60.0, now=0.0, receiver=receiver, feedback=True)
    for number in range(2, 26):
        queue.add_image(image(number), now - 60.0)
    _, now = run(queue, 60.0, now=now, receiver=receiver, feedback=True)
    if kind == "refine":
        assert queue.refine(1, 200, now)
    else:
        own = ImageToSend("00ZZ", "c1", CONTACT, stream(99, 90))
        assert queue.add_image(own if kind == "image of its own" else image(1, stream(1, 400)), now)
    wanted, least = ("00ZZ", 90) if kind == "image of its own" else (image_of_number(1), 200)
    events, _ = run(queue, 40.0, now=now, receiver=receiver, feedback=True)
    assert any(e.image_id == wanted and e.received_bytes >= least for e in events if isinstance(e, ImageUpdate))


def test_urgent_message_waits_for_one_packet_at_most():
    queue = filled(TransmitQueue(queue_config(expected_loss=0.0)), 20)
    for n in range(200):
        queue.add_message(f"m{n}", "status", b"%4d" % n * 10, 0.0, priority=5)
    run(queue, 30.0)
    queue.add_message("alarm", "safety", b"leak", 30.0, priority=1)
    receiver = V1Receiver()
    first = [e for frame in take_packet(queue, 30.0) for e in receiver.accept(3, frame, 30.0)]
    assert b"leak" in messages(first)


def test_programs_of_one_priority_share_the_airtime():
    queue = TransmitQueue(queue_config(expected_loss=0.0))
    for n in range(600):
        queue.add_message(f"m{n}", "chatty", b"C" * 50, 0.0, priority=4, lifetime_s=1e5)
    for n in range(40):
        queue.add_message(f"m{n}", "quiet", b"Q" * 20 + b"%2d" % n, 0.0, priority=4, lifetime_s=1e5)
    events, _ = run(queue, 300.0)
    sent = messages(events)
    last_quiet = max(i for i, data in enumerate(sent) if data[:1] == b"Q")
    assert sum(data[:1] == b"Q" for data in sent) == 40
    before = sum(len(d) for d in sent[: last_quiet + 1] if d[:1] == b"C")
    assert before <= 40 * 22 + 8 * 64, "half of the bytes, and what was loaded already"


def test_images_keep_their_share_among_many_messages():
    queue = filled(TransmitQueue(queue_config(expected_loss=0.0, image_airtime_share=0.25)), 4)
    for n in range(1500):
        queue.add_message(f"m{n}", "flood", b"F" * 55, 0.0, priority=1, lifetime_s=1e5)
    receiver, now, image_frames, frames = V1Receiver(), 0.0, 0, 0
    while queue.open_numbers():
        for frame in take_packet(queue, now):
            image_frames += not messages(receiver.accept(3, frame, now))
            frames += 1
        now += 6.1
        assert frames < 400
    assert 0.15 < image_frames / frames < 0.3


def test_filler_message_is_sent_after_aging():
    def frames_until_it_goes(priority: int) -> float:
        queue = TransmitQueue(queue_config(expected_loss=0.0, aging_s=600.0))
        queue.add_message("log", "logger", b"L" * 55, 0.0, priority=priority, lifetime_s=1e6)
        now, n = 0.0, 0
        receiver = V1Receiver()
        while True:
            n += 1
            if n % 2:  # never idle, and no room left
                queue.add_image(image(n), now)
            for frame in take_packet(queue, now):
                if messages(receiver.accept(3, frame, now)):
                    return now
            now += 6.1

    assert frames_until_it_goes(5) < 10
    assert 1100 < frames_until_it_goes(7) < 1400


def test_expired_message_is_counted_and_not_sent():
    queue = TransmitQueue(queue_config())
    queue.add_message("old", "s", b"old", 0.0, lifetime_s=10.0)
    assert not queue.add_message("older", "s", b"older", 0.0, lifetime_s=-1.0)
    queue.add_message("new", "s", b"new", 0.0, lifetime_s=100.0)
    events, _ = run(queue, 60.0, now=20.0)
    assert messages(events) == [b"new"]
    assert queue.messages.expired == 2
    assert queue.is_idle


def test_message_identifier_is_unique_per_program():
    queue = TransmitQueue(queue_config(expected_loss=0.0))
    assert queue.add_message("1", "a", b"one", 0.0)
    assert not queue.add_message("1", "a", b"one", 0.0)
    assert queue.add_message("1", "b", b"two", 0.0)
    events, _ = run(queue, 30.0)
    assert sorted(messages(events)) == [b"one", b"two"]


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.5])
def test_feedback_delivers_everything_at_any_loss(share):
    queue = filled(TransmitQueue(queue_config(expected_loss=0.3)), 12)
    for n in range(60):
        queue.add_message(f"m{n}", "s", b"%3d" % n * 5, 0.0, priority=4, lifetime_s=1e5)
    receiver = V1Receiver()
    run(queue, 6000.0, lost=losses(share), receiver=receiver, feedback=True)
    assert set(group(receiver.parts(), "image")) == {f"image/3/{number}" for number in range(1, 13)}
    assert not queue.open_numbers()
    if share >= 0.1:
        assert abs(queue.measured_loss - share) < 0.12
        assert abs(queue.planned_loss - share) < 0.15


def test_queue_continues_when_feedback_stops():
    queue = filled(TransmitQueue(queue_config(rates=(0, 1), first_rate=1, feedback_memory_s=300.0)), 30)
    receiver = V1Receiver()
    _, now = run(queue, 300.0, receiver=receiver, feedback=True)
    assert queue.sender.config.feedback
    for number in range(31, 61):
        queue.add_image(image(number), now)
    _, now = run(queue, 12_000.0, now=now, receiver=receiver)
    assert not queue.sender.config.feedback
    assert queue.rate == 0
    assert not queue.open_numbers()


def test_rate_follows_the_loss():
    queue = filled(TransmitQueue(queue_config(rates=(1, 5), first_rate=5, stream_bytes=4000)), 0)
    receiver, now = V1Receiver(), 0.0
    rates = []
    lost = {1: losses(0.05), 5: losses(0.97)}
    for n in range(1, 200):
        if len(queue.open_numbers()) < 3:
            queue.add_image(image(n, stream(n, 2000)), now)
        for frame in take_packet(queue, now):
            if not lost[queue.rate]():
                receiver.accept(3, frame, now)
        now += RATES[queue.rate].airtime_s
        rates.append(queue.rate)
        if n % 6 == 0 and (message := receiver.feedback(3, now)):
            queue.on_feedback(message, now, 1)
    assert rates[0] == 5
    assert rates.count(1) > 150


def test_expected_times_match_the_transmission():
    queue = filled(TransmitQueue(queue_config(expected_loss=0.2)), 10)
    queue.next_packet(0.0)
    expected = {e.image_id: e for e in queue.expected(0.0)}
    assert set(expected) == {image_of_number(n) for n in range(1, 11)}
    assert all(e.preview_s is not None and e.preview_s <= e.done_s and e.bytes_left > 0 for e in expected.values())
    now = 0.0
    done = {}
    while queue.open_numbers():
        packet = queue.next_packet(now)
        now += RATES[1].airtime_s
        queue.sent(packet.frames if packet else (), RATES[1].airtime_s)
        for number in range(1, 11):
            if number not in queue.open_numbers():
                done.setdefault(image_of_number(number), now)
    for image_id, at in done.items():
        assert abs(expected[image_id].done_s - at) <= max(15.0, 0.35 * at)
    assert queue.expected(now) == []


def copy_of(queue: TransmitQueue, protection=None) -> TransmitQueue:
    again = TransmitQueue(queue.config, protection=protection)
    assert not again.restore(queue.parts())
    return again


@given(st.data())
def test_restored_queue_sends_the_same(data):
    queue = filled(TransmitQueue(queue_config(rates=(0, 1), first_rate=1)), data.draw(st.integers(0, 12)))
    for n in range(data.draw(st.integers(0, 8))):
        priority = data.draw(st.integers(1, 7))
        queue.add_message(f"m{n}", "ab"[n % 2], bytes([n + 1]) * (n + 1), 0.0, priority=priority)
    receiver = V1Receiver()
    _, now = run(queue, data.draw(st.floats(0, 200)), receiver=receiver, feedback=data.draw(st.booleans()))
    again = copy_of(queue)
    assert again.parts() == queue.parts()
    for _ in range(10):
        now += 6.1
        assert take_packet(again, now) == take_packet(queue, now)
        assert again.expected(now) == queue.expected(now)


def test_a_packet_changes_few_small_parts():
    queue = filled(TransmitQueue(queue_config()), 30)
    for n in range(100):
        queue.add_message(f"m{n}", "s", b"%3d" % n * 10, 0.0, lifetime_s=1e5)
    take_packet(queue, 0.0)
    saved = SavedParts(queue.parts())
    for now in range(7, 140, 7):
        queue.next_packet(float(now))
        changes = saved.changes(queue.parts())
        assert {"queue", "sender", "packet"} <= changes.keys()
        assert sum(len(name) + len(data or b"") for name, data in changes.items()) < 4_000
        saved.commit(queue.parts())
        queue.sent(queue.in_flight.frames, 6.1)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("queue", {"format version": 1}),
        ("queue", {"rate": 256}),
        ("queue", {"losses": {1: [1.5, 0.0]}}),
        ("queue", {"planned_loss": "no"}),
        ("packet", {"rate": 256}),
        ("messages", {"served": {"s": -1}}),
        ("message/0", {"priority": 0}),
        ("message-id/0", {"name": None}),
    ],
    ids=str,
)
def test_a_malformed_part_is_reported_and_the_rest_restored(name, change):
    queue = filled(TransmitQueue(queue_config()), 3)
    queue.next_packet(0.0)
    for n in range(2):
        queue.add_message(f"m{n}", "s", b"data", 0.0)
    again = TransmitQueue(queue_config())
    kinds = {
        "queue": TransmitState,
        "packet": OutgoingPacket,
        "messages": MessageQueue,
        "message": QueuedMessage,
        "message-id": MessageIdentifier,
    }
    errors = again.restore(with_fields(queue.parts(), name, kinds[name.partition("/")[0]], change))
    assert set(errors) == {name}
    assert f"queue state: {name}: " in str(errors[name])
    kept = {part: data for part, data in queue.parts().items() if part not in (name, "queue", "packet", "messages")}
    assert {part: data for part, data in again.parts().items() if part in kept} == kept


def test_rate_that_is_not_configured_any_more_is_replaced():
    queue = filled(TransmitQueue(queue_config(rates=(5,), first_rate=5)), 5)
    take_packet(queue, 0.0)
    again = TransmitQueue(queue_config(rates=(1,), first_rate=1))
    assert not again.restore(queue.parts())
    assert again.rate == 1
    assert again.in_flight is None
    receiver = V1Receiver()
    events, _ = run(again, 600.0, receiver=receiver)
    assert {number_of_image(e.image_id) for e in events if isinstance(e, ImageUpdate)} == {1, 2, 3, 4, 5}


@pytest.mark.parametrize(
    "wrong",
    [
        {"expected_loss": 1.0},
        {"image_airtime_share": -0.1},
        {"aging_s": 0.0},
        {"feedback": "perhaps"},
        {"max_messages": 0},
    ],
)
def test_error_names_the_invalid_value(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        queue_config(**wrong)
    with pytest.raises(ConfigError, match="rate"):
        TransmitQueue(queue_config(rates=(1,), first_rate=4))


def test_longer_stream_of_a_sent_image_sends_only_the_new_part():
    queue = TransmitQueue(queue_config(expected_loss=0.0))
    complete = stream(1, 1200)
    receiver = V1Receiver()
    queue.add_image(image(1, complete[:300]), 0.0)
    _, now = run(queue, 200.0, receiver=receiver)
    assert not queue.open_numbers()
    assert not queue.refine(1, 1000, now), "there is no more"
    before = queue.sender.state.frames_sent
    assert queue.add_image(image(1, complete), now)
    events, now = run(queue, 600.0, now=now, receiver=receiver)
    assert max(len(e.stream) for e in events if isinstance(e, ImageUpdate)) == 1200
    assert queue.sender.state.frames_sent - before < 900 / 50 + 8


def test_repeated_image_is_sent_again_unless_it_waits():
    queue = TransmitQueue(queue_config(expected_loss=0.0))
    assert queue.add_image(image(1), 0.0)
    assert not queue.add_image(image(1), 0.0)
    _, now = run(queue, 200.0)
    assert queue.add_image(image(1), now)
    events, _ = run(queue, 200.0, now=now)
    assert [e for e in events if isinstance(e, ImageUpdate)]


def test_longer_stream_with_another_beginning_is_not_sent():
    queue = TransmitQueue(queue_config(expected_loss=0.0))
    queue.add_image(image(1, stream(1, 300)), 0.0)
    _, now = run(queue, 200.0)
    assert not queue.add_image(image(1, stream(2, 600)), now)
    assert not queue.open_numbers()
