"""The v1 receiver with any frames in any order: correct images, no exceptions, restarts without effect."""

import msgpack
import pytest
from builders import v1_fuzz
from builders.link_state import comparable, plain_of, replace_a_value, with_fields
from builders.v1_world import VEHICLE, add_message, contact, stream
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.link.coding.block_decoder import BlockDecoder, SymbolChunk
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.v1.receiver import AssembledImage, PeerState, V1Receiver, V1ReceiverCounts
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import ImageUpdate, MessageReceived


@st.composite
def deliveries(draw: st.DrawFn) -> list[tuple[float, bytes]]:
    """Draw frames of a sender with images and messages: lost, reordered, repeated, padded or cut."""
    channels = draw(st.sampled_from([(LossChannel(0.0),), (LossChannel(0.3),), (LossChannel(0.05), LossChannel(0.6))]))
    sender = V1Sender(
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
        sender.add_image(number, contact(number), stream(number, draw(st.sampled_from([5, 40, 250]))), 0.0)
    if draw(st.booleans()):
        add_message(sender, b"a message", 0.0, times=1)
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


@given(deliveries())
def test_updates_hold_only_sent_bytes_and_grow(delivery: list[tuple[float, bytes]]) -> None:
    receiver, known = V1Receiver(), dict[int, ImageUpdate]()
    for now, frame in delivery:
        for event in receiver.accept(VEHICLE, frame, now):
            if isinstance(event, MessageReceived):
                assert event.data == b"a message"
            elif isinstance(event, ImageUpdate):
                number = number_of_image(event.image_id)
                sent = [stream(number, length) for length in (5, 40, 250)]
                assert event.contact == contact(number)
                assert any(s.startswith(event.stream) for s in sent)
                before = known.get(number)
                assert event.version == (1 if before is None else before.version + 1)
                if before is not None:
                    assert event.stream.startswith(before.stream)
                    assert (len(event.stream), event.complete) != (len(before.stream), before.complete)
                known[number] = event
    assert receiver.counts.frames == len(delivery)


@given(deliveries())
def test_a_restart_at_any_frame_changes_nothing(delivery: list[tuple[float, bytes]]) -> None:
    config = ReceiverConfig(max_contacts=4, block_memory_s=120.0)
    steady, restarted = V1Receiver(config), V1Receiver(config)
    for place, (now, frame) in enumerate(delivery):
        if place % 4 == 0:
            parts = restarted.parts()
            restarted = V1Receiver(config)
            assert not restarted.restore(parts)
        assert comparable(restarted.accept(VEHICLE, frame, now)) == comparable(steady.accept(VEHICLE, frame, now))
        assert restarted.feedback_is_due(VEHICLE, now) == steady.feedback_is_due(VEHICLE, now)
        assert restarted.feedback(VEHICLE, now) == steady.feedback(VEHICLE, now)
    assert restarted.parts() == steady.parts()
    assert restarted.counts == steady.counts


def test_hostile_frames_give_no_wrong_image_or_message() -> None:
    counts = v1_fuzz.run(1_500, seed=1)
    assert counts["wrong"] == 0
    assert counts["shown"] > 120


def busy_receiver() -> tuple[V1Sender, V1Receiver]:
    """Return a receiver with images, a layered block and messages, and its sender."""
    sender, receiver = V1Sender(SenderConfig(channels=(LossChannel(0.05), LossChannel(0.6)))), V1Receiver()
    for number in (1, 2, 3):
        sender.add_image(number, contact(number), stream(number, 300), 0.0)
    add_message(sender, b"a message", 0.0)
    for _ in range(12):
        receiver.accept(VEHICLE, sender.next_frame(0.0) or b"", 0.0)
    return sender, receiver


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("counts", {"format version": 1}),
        ("counts", {"frames": -1}),
        ("counts", {"frames": True}),
        ("peer/3", {"newest_block": 32}),
        ("peer/3", {"recent_messages": [[1, 2]]}),
        ("image/3/1", {"contact": bytes(24)}),
        ("image/3/1", {"stream": b""}),
        ("image/3/1", {"reported": [1]}),
        ("block/3/1", {"kind": 2}),
        ("block/3/1", {"count": 3}),
        ("block/3/1", {"layering": bytes(3)}),
        ("block-symbols/3/1/00", {"symbols": [[255, bytes(59), 0]]}),
        ("block-symbols/3/1/00", {"symbols": [[0, bytes(58), 0]]}),
    ],
    ids=str,
)
def test_a_malformed_part_is_reported_and_the_others_are_restored(name: str, change: dict[str, object]) -> None:
    _, receiver = busy_receiver()
    parts = receiver.parts()
    assert name in parts
    restored = V1Receiver()
    kinds = {"counts": V1ReceiverCounts, "peer": PeerState, "image": AssembledImage, "block": BlockDecoder}
    errors = restored.restore(with_fields(parts, name, kinds.get(name.partition("/")[0], SymbolChunk), change))
    assert list(errors) == [name]
    assert str(errors[name]).startswith(f"v1 receiver state: {name}: ")
    skipped = ("block/", "block-symbols/") if name.startswith("block") else ("block", name) if "peer" in name else ()
    expected = {part: data for part, data in parts.items() if part != name and not part.startswith(skipped)}
    assert {part: data for part, data in restored.parts().items() if part in expected} == expected


@given(st.data())
def test_a_replaced_value_in_a_state_is_reported_or_accepted_and_raises_nothing(data: st.DataObject) -> None:
    sender, receiver = busy_receiver()
    parts = receiver.parts()
    name = data.draw(st.sampled_from(sorted(parts)))
    plain = plain_of(parts, name)
    replace_a_value(plain, data)
    fresh = V1Receiver()
    errors = fresh.restore({**parts, name: msgpack.packb(plain)})
    assert all(part == name or ("block" in name and part.startswith("block-symbols/")) for part in errors)
    for _ in range(30):
        fresh.accept(VEHICLE, sender.next_frame(1.0) or b"", 1.0)
    fresh.feedback(VEHICLE, 1.0)
