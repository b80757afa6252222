"""Whatever arrives, in whatever order: nothing wrong is shown, nothing raises, a restart changes nothing."""

from __future__ import annotations

from typing import Any

import msgpack
import pytest
from builders import v1_fuzz
from builders.v1_world import VEHICLE, contact, stream
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.errors import FrameError
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.events import ContactUpdate, Event, FrameRefused, MessageReceived
from sonarpost.link.receiver import LinkReceiver
from sonarpost.link.sender import LinkSender


@st.composite
def deliveries(draw: st.DrawFn) -> list[tuple[float, bytes]]:
    """Frames of a sender with pictures and messages, some of them, in any order, some twice, some padded or cut."""
    channels = draw(st.sampled_from([(LossChannel(0.0),), (LossChannel(0.3),), (LossChannel(0.05), LossChannel(0.6))]))
    sender = LinkSender(
        SenderConfig(
            frame_bytes=draw(st.sampled_from([32, 64, 256])),
            channels=channels,
            feedback=draw(st.booleans()),
            stream_bytes=200,
            frames_per_image=8.0,
        ),
        first_block=draw(st.integers(0, 31)),
    )
    for number in range(1, draw(st.integers(1, 9)) + 1):
        sender.add_picture(number, contact(number), stream(number, draw(st.sampled_from([5, 40, 250]))), 0.0)
    if draw(st.booleans()):
        sender.add_message(b"a message", 0.0, times=1)
    frames: list[bytes] = []
    while (frame := sender.next_frame(0.0)) is not None:
        frames.append(frame)
    kept = [f for f in frames if draw(st.integers(0, 9)) < 7]
    order = draw(st.permutations(kept)) if draw(st.booleans()) else kept
    again = draw(st.lists(st.sampled_from(frames), max_size=8))
    found, now = [], 0.0
    for frame in [*order, *again]:
        now += draw(st.sampled_from([0.0, 1.0, 60.0]))
        how = draw(st.integers(0, 19))
        found.append((now, frame + bytes(10) if how == 0 else frame[:20] if how == 1 else frame))
    return found


def comparable(events: list[Event]) -> list[Any]:
    """Errors have no equality of their own."""
    return [(e.source, e.at, str(e.reason)) if isinstance(e, FrameRefused) else e for e in events]


@settings(max_examples=40, deadline=None)
@given(deliveries())
def test_what_is_shown_was_sent_and_grows(delivery: list[tuple[float, bytes]]) -> None:
    receiver, known = LinkReceiver(), dict[int, ContactUpdate]()
    for now, frame in delivery:
        for event in receiver.accept(VEHICLE, frame, now):
            if isinstance(event, MessageReceived):
                assert event.data == b"a message"
            elif isinstance(event, ContactUpdate):
                sent = [stream(event.number, length) for length in (5, 40, 250)]
                assert event.contact == contact(event.number)
                assert any(s.startswith(event.stream) for s in sent)
                before = known.get(event.number)
                assert event.version == (1 if before is None else before.version + 1)
                if before is not None:
                    assert event.stream.startswith(before.stream)
                    assert (len(event.stream), event.complete) != (len(before.stream), before.complete)
                known[event.number] = event
    assert receiver.counts.frames == len(delivery)


@settings(max_examples=25, deadline=None)
@given(deliveries())
def test_a_restart_at_every_frame_changes_nothing(delivery: list[tuple[float, bytes]]) -> None:
    config = ReceiverConfig(max_contacts=4, block_memory_s=120.0)
    steady, restarted = LinkReceiver(config), LinkReceiver(config)
    for now, frame in delivery:
        state = msgpack.unpackb(msgpack.packb(restarted.snapshot()))
        restarted = LinkReceiver(config)
        restarted.restore(state)
        assert comparable(restarted.accept(VEHICLE, frame, now)) == comparable(steady.accept(VEHICLE, frame, now))
        assert restarted.report_is_due(VEHICLE, now) == steady.report_is_due(VEHICLE, now)
        assert restarted.report(VEHICLE, now) == steady.report(VEHICLE, now)
    assert restarted.snapshot() == steady.snapshot()
    assert restarted.counts == steady.counts


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=120), max_size=30).map(lambda parts: b"".join(bytes([len(p)]) + p for p in parts)))
def test_any_bytes_with_right_checksums_raise_nothing(data: bytes) -> None:
    v1_fuzz.one_input(data)


def test_a_bounded_run_of_hostile_frames_shows_nothing_wrong() -> None:
    counts = v1_fuzz.run(5_000, seed=1)
    assert counts["wrong"] == 0
    assert counts["shown"] > 400


STATE_CHANGES: list[dict[str, object]] = [
    {"format": 9},
    {"sources": 5},
    {"sources": [{}]},
    {"counts": {"frames": 1}},
    {"counts": {}},
]


@pytest.mark.parametrize("change", STATE_CHANGES)
def test_a_state_that_no_receiver_made_is_refused(change: dict[str, object]) -> None:
    receiver = LinkReceiver()
    before = receiver.snapshot()
    with pytest.raises(FrameError, match="receiver state"):
        receiver.restore({**before, **change})
    assert receiver.snapshot() == before


@settings(max_examples=70, deadline=None)
@given(st.data())
def test_any_part_of_a_state_replaced_is_refused_or_taken_never_another_error(data: st.DataObject) -> None:
    sender, receiver = LinkSender(SenderConfig(channels=(LossChannel(0.05), LossChannel(0.6)))), LinkReceiver()
    for number in (1, 2, 3):
        sender.add_picture(number, contact(number), stream(number, 300), 0.0)
    for _ in range(9):
        receiver.accept(VEHICLE, sender.next_frame(0.0) or b"", 0.0)
    state: Any = msgpack.unpackb(msgpack.packb(receiver.snapshot()))
    place: Any = state
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = data.draw(st.sampled_from(keys))
        if isinstance(place[key], dict | list) and place[key] and data.draw(st.booleans()):
            place = place[key]
            continue
        place[key] = data.draw(st.sampled_from([None, -1, 3, 2.5, float("nan"), b"", b"xx", "x", [], {}, True, 10**30]))
        break
    fresh = LinkReceiver()
    try:
        fresh.restore(state)
    except FrameError:
        return
    for _ in range(30):
        fresh.accept(VEHICLE, sender.next_frame(1.0) or b"", 1.0)
    fresh.report(VEHICLE, 1.0)
