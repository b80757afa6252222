"""The v1 sender and receiver over a simulated channel."""

from itertools import pairwise

import numpy as np
import pytest
from builders.link_state import group, with_fields
from builders.v1_world import VEHICLE, World, add_message, contact, stream

from sonarpost.errors import ConfigError, FrameError, StreamError
from sonarpost.link.coding.blocks import OutgoingImage, SendBlock
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.downlink.messages import image_of_number, number_of_image
from sonarpost.link.frames.v1.frame import (
    Segment,
    SegmentKind,
    Symbol,
    SymbolKind,
    pack_segments,
    pack_symbol,
    parse_frame,
)
from sonarpost.link.frames.v1.payload_objects import RefineRequest, unpack_mini
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import SenderState, V1Sender, WaitingImages
from sonarpost.link.receiver import FrameRejected, ImageUpdate


@pytest.mark.parametrize("frame_bytes", [32, 64, 256, 100])
def test_broadcast_without_loss_delivers_all_contacts_with_the_planned_frames(frame_bytes: int) -> None:
    world = World.make(0.0, frame_bytes=frame_bytes, frames_per_image=6.0)
    world.add(30, 700)
    world.run()
    assert set(world.latest) == set(range(1, 31))
    assert all(e.complete and len(e.stream) > frame_bytes for e in world.latest.values())
    assert world.frames == 6 * 30


@pytest.mark.parametrize(("frame_bytes", "count"), [(32, 30), (64, 2), (64, 30), (256, 7), (256, 30), (100, 1)])
def test_broadcast_at_30_percent_loss_delivers_contacts_and_most_images(frame_bytes: int, count: int) -> None:
    world = World.make(0.3, seed=count, frame_bytes=frame_bytes, frames_per_image=8.0)
    world.add(count, 900)
    world.run()
    assert len(world.latest) >= 0.96 * count - 0.5
    if count == 30:
        assert sum(e.complete for e in world.latest.values()) >= 24


def test_receivers_with_different_loss_get_different_layers() -> None:
    channels = (LossChannel(0.05), LossChannel(0.6))
    config = SenderConfig(channels=channels, frames_per_image=9.0)
    sender, receivers = V1Sender(config), [V1Receiver(), V1Receiver()]
    for number in range(1, 25):
        sender.add_image(number, contact(number), stream(number, 900), 0.0)
    rng, kinds, got = np.random.default_rng(2), set(), [dict[int, int](), dict[int, int]()]
    while (frame := sender.next_frame(0.0)) is not None:
        parsed = parse_frame(frame)
        assert isinstance(parsed, Symbol)
        kinds.add(parsed.kind)
        for receiver, channel, lengths in zip(receivers, channels, got, strict=True):
            for event in receiver.accept(VEHICLE, frame, 0.0) if rng.random() >= channel.loss else []:
                assert isinstance(event, ImageUpdate)
                lengths[number_of_image(event.image_id)] = len(event.stream)
    assert kinds == {SymbolKind.PREVIEW, SymbolKind.LAYERED}
    assert len(got[0]) == 24
    assert len(got[1]) >= 22
    assert sum(got[0].values()) > 1.5 * sum(got[1].values()) > 1.5 * 24 * 30


def test_one_frame_gives_a_contact_and_a_coarse_image() -> None:
    sender, receiver = V1Sender(SenderConfig()), V1Receiver()
    for number in range(1, 11):
        sender.add_image(number, contact(number), stream(number, 500), 0.0)
    for number in range(1, 11):
        frame = sender.next_frame(0.0)
        assert frame is not None
        (event,) = V1Receiver().accept(VEHICLE, frame, 0.0)
        assert isinstance(event, ImageUpdate)
        assert (event.image_id, event.stream) == (image_of_number(number), stream(number, 500)[:30])
        assert receiver.accept(VEHICLE, frame, 0.0)


@pytest.mark.parametrize("loss", [0.1, 0.5])
def test_feedback_completes_all_images_close_to_the_erasure_bound(loss: float) -> None:
    ratios, channels = [], (LossChannel(loss),)
    for seed in range(2):
        world = World.make(loss, seed, channels=channels, feedback=True, stream_bytes=420, max_defer_s=600.0)
        world.add(120, 500)
        world.run()
        assert len(world.latest) == 120
        assert all(e.complete and len(e.stream) >= 420 for e in world.latest.values())
        payload = sum(25 + len(e.stream) for e in world.latest.values())
        ratios.append((world.frames + world.feedback_frames) / (payload / (64 * (1 - loss))))
    assert sum(ratios) / len(ratios) <= 1.15


@pytest.mark.parametrize("frame_bytes", [32, 256])
def test_feedback_completes_all_images_at_other_frame_lengths_and_with_bursts(frame_bytes: int) -> None:
    world = World.make(
        0.5, 9, channels=(LossChannel(0.5, 4.0),), feedback=True, stream_bytes=300, frame_bytes=frame_bytes
    )
    world.add(40, 300)
    world.run()
    assert all(world.latest[n].complete and world.latest[n].stream == world.sent[n] for n in range(1, 41))
    assert world.sender.state.tracker.loss == pytest.approx(0.5, abs=0.25)


def test_messages_arrive_once() -> None:
    world = World.make(0.4, 5, channels=(LossChannel(0.4),))
    world.add(4, 300)
    small = [b"status %d" % n for n in range(8)]
    for data in small:
        add_message(world.sender, data, 0.0)
    long = stream(99, 900)
    add_message(world.sender, long, 0.0)
    world.run()
    assert sorted(world.messages) == sorted([*small, long])


def test_messages_and_contacts_share_a_frame() -> None:
    sender = V1Sender(SenderConfig(frame_bytes=128, group_delay_s=100.0))
    sender.add_image(1, contact(1), stream(1, 300), 0.0)
    for data in (b"one", b"two"):
        add_message(sender, data, 0.0, times=1)
    frame = sender.next_frame(0.0)
    assert frame is not None
    listed = parse_frame(frame)
    assert isinstance(listed, tuple)
    assert [s.kind for s in listed] == [SegmentKind.MESSAGE, SegmentKind.MESSAGE, SegmentKind.PREVIEW]
    (event,) = [e for e in V1Receiver().accept(VEHICLE, frame, 0.0) if isinstance(e, ImageUpdate)]
    assert stream(1, 300).startswith(event.stream)
    assert len(event.stream) > 60


def test_message_priorities_and_lifetimes() -> None:
    sender = V1Sender(SenderConfig())
    sender.add_image(1, contact(1), stream(1, 300), 0.0)
    add_message(sender, b"late", 0.0, priority=-1, times=1)
    add_message(sender, b"expired", 0.0, lifetime_s=1.0)
    add_message(sender, b"stop!", 0.0, priority=9, times=1)
    frames = []
    while (frame := sender.next_frame(5.0)) is not None:
        frames.append(parse_frame(frame))
    segments = [s for f in frames if isinstance(f, tuple) for s in f if s.kind == SegmentKind.MESSAGE]
    assert [s.data[1:] for s in segments] == [b"stop!", b"late"]
    assert isinstance(frames[0], tuple)


def test_copies_of_a_message_keep_a_distance() -> None:
    sender = V1Sender(SenderConfig(channels=(LossChannel(0.3, 3.0),)))
    for number in range(1, 11):
        sender.add_image(number, contact(number), stream(number, 600), 0.0)
    add_message(sender, b"go", 0.0)
    places = [n for n in range(60) if (f := sender.next_frame(0.0)) and isinstance(parse_frame(f), tuple)]
    assert len(places) == 4
    assert min(b - a for a, b in pairwise(places)) > 12


def test_refine_request_sends_more_detail() -> None:
    world = World.make(0.0, feedback=True, stream_bytes=100, channels=(LossChannel(0.0),))
    world.add(3, 900)
    world.run()
    assert all(100 <= len(e.stream) < 200 and e.complete for e in world.latest.values())
    world.sender.on_feedback(RefineRequest(2, 700), world.now)
    world.run()
    assert len(world.latest[2].stream) >= 700
    assert world.latest[2].complete
    assert not world.sender.refine(RefineRequest(2, 100), world.now)
    with pytest.raises(FrameError, match="contact number"):
        world.sender.refine(RefineRequest(77, 100), world.now)


def test_mini_packet_requests_symbols() -> None:
    sender, receiver = V1Sender(SenderConfig(feedback=True, channels=(LossChannel(0.0),))), V1Receiver()
    sender.add_image(1, contact(1), stream(1, 400), 0.0)
    frames = []
    while (frame := sender.next_frame(1.0)) is not None:
        frames.append(frame)
    for frame in frames[:-2]:
        receiver.accept(VEHICLE, frame, 1.0)
    assert receiver.is_incomplete(VEHICLE)
    sender.on_feedback(unpack_mini(1 << 8 | 2), 2.0)
    assert sender.state.tracker.loss is None
    events = [e for _ in range(2) if (f := sender.next_frame(2.0)) for e in receiver.accept(VEHICLE, f, 2.0)]
    assert isinstance(events[-1], ImageUpdate)
    assert events[-1].complete
    assert not receiver.is_incomplete(VEHICLE)


def test_another_frame_length_restarts_only_blocks_that_do_not_fit() -> None:
    for before, after in ((64, 256), (256, 64), (64, 32)):
        world = World.make(0.0, frame_bytes=before, feedback=True, stream_bytes=300, channels=(LossChannel(0.0),))
        world.add(12, 300)
        world.run(most_frames=20)
        world.sender.resize(after)
        world.run()
        assert all(world.latest[n].stream == world.sent[n] for n in range(1, 13)), (before, after)


def test_block_and_contact_numbers_wrap_around() -> None:
    world = World.make(0.2, 3, channels=(LossChannel(0.2),), group_images=2, frames_per_image=9.0)
    number = 65520
    for _ in range(24):
        world.add(2, 200, first=number)
        number = 1 if number >= 65534 else number + 2
        world.run()
        world.now += 60.0
    assert len(world.sent) == 48
    assert len(world.latest) >= 46


def test_restarted_contact_numbers_do_not_mix_images() -> None:
    receiver = V1Receiver()
    first, second = (V1Sender(SenderConfig(channels=(LossChannel(0.0),))) for _ in range(2))
    for number in range(1, 6):
        first.add_image(number, contact(number), stream(number, 400), 0.0)
        second.add_image(number, contact(number + 100), stream(number + 100, 400), 0.0)
    for _ in range(9):  # previews, and too little detail
        frame = first.next_frame(0.0)
        assert frame is not None
        receiver.accept(VEHICLE, frame, 0.0)
    latest: dict[int, ImageUpdate] = {}
    while (frame := second.next_frame(1.0)) is not None:
        for event in receiver.accept(VEHICLE, frame, 1.0):
            if isinstance(event, ImageUpdate):
                number = number_of_image(event.image_id) + 100
                assert event.contact == contact(number)
                assert stream(number, 400).startswith(event.stream)
                latest[number] = event
    assert len(latest) == 5
    assert all(e.complete for e in latest.values())


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("sender", {"format version": 1}),
        ("sender", {"next_block": 32}),
        ("sender", {"tracker": [{}, {1: [7.0, None]}]}),
        ("sender", {"messages": [[], 256]}),
        ("waiting", {"numbers": 3}),
        ("waiting", {"numbers": [0]}),
        ("image/1", {"number": 0}),
        ("image/1", {"curve": b""}),
        ("image/1", {"contact": b"short"}),
        ("image-progress/1", {"delivered": [[9, 3]]}),
        ("block/0", {"objects": []}),
        ("block/0", {"kind": 2}),
        ("block-progress/0", {"missing": {1: 256}}),
    ],
    ids=str,
)
def test_sender_reports_a_malformed_part_and_sends_the_rest_again(name: str, change: dict[str, object]) -> None:
    sender = V1Sender(SenderConfig(group_images=1, depth=1))
    for number in (1, 2):
        sender.add_image(number, contact(number), stream(number, 50), 0.0)
    assert sender.next_frame(0.0)
    restored = V1Sender(sender.config)
    kinds = {"sender": SenderState, "waiting": WaitingImages, "image": OutgoingImage, "block": SendBlock}
    kind = kinds[name.partition("/")[0].removesuffix("-progress")]
    errors = restored.restore(with_fields(sender.parts(), name, kind, change))
    assert name in errors
    assert f"sender state: {name}: " in str(errors[name])
    left = {2} if name == "image/1" else {1, 2}
    assert set(restored.kept) == left
    world = World(restored, V1Receiver(), lambda: True, sent={n: stream(n, 50) for n in left})
    world.run()
    assert set(world.latest) == left


def test_invalid_images_messages_and_configurations_are_rejected() -> None:
    sender = V1Sender(SenderConfig())
    sender.add_image(1, contact(1), b"x", 0.0)
    with pytest.raises(FrameError, match="contact number"):
        sender.add_image(1, contact(1), b"x", 0.0)
    with pytest.raises(FrameError, match="contact number"):
        sender.add_image(0, contact(1), b"x", 0.0)
    with pytest.raises(StreamError):
        sender.add_image(2, contact(1), b"", 0.0)
    for data in (b"", bytes(4097)):
        with pytest.raises(FrameError, match="message"):
            add_message(sender, data, 0.0)
    for wrong in ({"frame_bytes": 31}, {"channels": ()}, {"depth": 9}, {"max_defer_s": float("nan")}):
        with pytest.raises(ConfigError):
            SenderConfig(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError):
        ReceiverConfig(max_sources=0)


def test_memory_is_bounded() -> None:
    receiver = V1Receiver(ReceiverConfig(max_sources=2, max_contacts=5))
    for address in range(6):
        sender = V1Sender(SenderConfig(channels=(LossChannel(0.0),)))
        for number in range(1, 30):
            sender.add_image(number, contact(number), stream(number, 90), 0.0)
        while (frame := sender.next_frame(0.0)) is not None:
            receiver.accept(address, frame, 0.0)
    parts = receiver.parts()
    assert len(receiver.sources) == len(group(parts, "peer")) == 2
    assert all(len(group(parts, f"image/{source}")) <= 5 for source in receiver.sources)
    assert all(len(group(parts, f"block/{source}")) <= 16 for source in receiver.sources)
    assert receiver.counts.evicted_sources == 4


def test_full_table_keeps_an_image_whose_detail_precedes_its_preview() -> None:
    sender = V1Sender(SenderConfig(channels=(LossChannel(0.0),), feedback=True))
    receiver = V1Receiver(ReceiverConfig(max_contacts=8))
    complete: set[str] = set()

    def frames_of(numbers: range, now: float) -> list[bytes]:
        for number in numbers:
            sender.add_image(number, contact(number), stream(number, 200), now)
        frames = []
        while (frame := sender.next_frame(now + 60.0)) is not None and len(frames) < 100:
            frames.append(frame)
        return frames

    def deliver(frames: list[bytes], now: float) -> None:
        for frame in frames:
            for event in receiver.accept(VEHICLE, frame, now):
                if isinstance(event, ImageUpdate) and event.complete:
                    complete.add(event.image_id)
        feedback = receiver.feedback(VEHICLE, now)
        assert feedback is not None
        sender.on_feedback(feedback, now)

    deliver(frames_of(range(1, 9), 0.0), 0.0)
    assert len(complete) == 8
    # The preview of 9 was lost and is sent again after the one of 10.
    ninth, tenth = frames_of(range(9, 10), 100.0), frames_of(range(10, 11), 200.0)
    deliver([*ninth[1:], *tenth, ninth[0]], 300.0)
    assert len(complete) == 10
    assert receiver.incomplete_images == 0


def test_clock_set_back_by_a_day_delays_neither_a_group_nor_a_reminder() -> None:
    config = SenderConfig(channels=(LossChannel(0.0),), feedback=True, group_delay_s=20.0)
    sender, day_s = V1Sender(config), 86400.0
    sender.add_image(1, contact(1), stream(1, 200), day_s)
    assert sender.next_frame(0.0) is None, "the group waits for others"
    assert sender.next_frame(config.group_delay_s) is not None
    while sender.next_frame(config.group_delay_s) is not None:
        pass
    # The receiver does not answer.
    assert sender.next_frame(day_s + config.max_defer_s) is not None, "a reminder by the old clock"
    while sender.next_frame(0.0) is not None:
        pass
    assert sender.next_frame(config.max_defer_s) is not None, "a reminder"


def test_old_blocks_and_contacts_are_deleted() -> None:
    config = ReceiverConfig(block_memory_s=10.0, contact_memory_s=100.0)
    sender, receiver = V1Sender(SenderConfig()), V1Receiver(config)
    sender.add_image(1, contact(1), stream(1, 300), 0.0)
    frame = sender.next_frame(0.0)
    assert frame is not None
    assert len(receiver.accept(VEHICLE, frame, 0.0)) == 1
    assert receiver.accept(VEHICLE, frame, 50.0) == []  # a duplicate, although the block was deleted
    (event,) = receiver.accept(VEHICLE, frame, 200.0)
    assert isinstance(event, ImageUpdate)
    assert event.version == 1


def test_unknown_segment_is_reported_and_the_others_are_used() -> None:
    frame = pack_segments([Segment(25, b"new"), Segment(SegmentKind.MESSAGE, b"\x01hello")], 64)
    rejected, message = V1Receiver().accept(VEHICLE, frame, 0.0)
    assert isinstance(rejected, FrameRejected)
    assert "segment kind" in str(rejected.reason)
    assert getattr(message, "data", None) == b"hello"


def test_one_damaged_frame_does_not_replace_a_block() -> None:
    sender, receiver = V1Sender(SenderConfig(channels=(LossChannel(0.0),), frames_per_image=20.0)), V1Receiver()
    sender.add_image(1, contact(1), stream(1, 900), 0.0)
    frames = []
    while (frame := sender.next_frame(0.0)) is not None:
        frames.append(frame)
    for frame in frames[:3]:
        receiver.accept(VEHICLE, frame, 0.0)
    other = parse_frame(frames[3])
    assert isinstance(other, Symbol)
    false = Symbol(other.kind, other.block, parse_frame(frames[1]).index, other.parameter, bytes(59))  # type: ignore[union-attr]
    receiver.accept(VEHICLE, pack_symbol(false), 0.0)
    events = [e for frame in frames[3:] for e in receiver.accept(VEHICLE, frame, 0.0)]
    assert isinstance(events[-1], ImageUpdate)
    assert events[-1].complete
    assert stream(1, 900).startswith(events[-1].stream)


def test_block_continues_until_all_receivers_have_it() -> None:
    sender = V1Sender(SenderConfig(feedback=True, channels=(LossChannel(0.4),), stream_bytes=300))
    receivers = {address: V1Receiver() for address in (1, 2, 9)}
    latest: dict[tuple[int, int], ImageUpdate] = {}
    for number in range(1, 21):
        sender.add_image(number, contact(number), stream(number, 300), 0.0)
    rng, now = np.random.default_rng(4), 0.0
    while not sender.is_idle and now < 20_000:
        now += 1.0
        frame = sender.next_frame(now)
        for address, receiver in receivers.items():
            for event in receiver.accept(VEHICLE, frame, now) if frame and rng.random() >= 0.4 else []:
                assert isinstance(event, ImageUpdate)
                latest[address, number_of_image(event.image_id)] = event
            feedback = receiver.feedback(VEHICLE, now) if receiver.feedback_is_due(VEHICLE, now) else None
            if feedback is not None and rng.random() >= 0.4:
                sender.on_feedback(feedback, now, receiver=address)
    assert len(latest) == 60
    assert all(e.complete and e.stream == stream(number_of_image(e.image_id), 300) for e in latest.values())
    assert sender.state.tracker.loss == pytest.approx(0.4, abs=0.2)
