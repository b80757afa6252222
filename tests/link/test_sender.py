"""Contract of every `ImageSender`: the same behaviour in every wire format."""

from collections.abc import Callable
from typing import Any

import pytest
from builders.v1_world import contact, queue_config, take_packet

from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import PaperSender, plan_packets
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.queue.transmit_queue import TransmitQueue
from sonarpost.link.receiver import CombinedReceiver, ImageUpdate
from sonarpost.link.sender import ImageSender, ImageToSend
from sonarpost.link.state import SavedParts
from sonarpost.modem.micromodem import RATES

NewSender = Callable[[], Any]
SENDERS = {
    "v1": lambda: TransmitQueue(queue_config(expected_loss=0.0, frames_per_image=20.0)),
    "paper": lambda: PaperSender(RATES[1]),
}
each_sender = pytest.mark.parametrize("new", SENDERS.values(), ids=SENDERS.keys())


def image(number: int, length: int = 200) -> ImageToSend:
    body = bytes((7 * i + number) % 255 + 1 for i in range(length))
    stream = StreamHeader(0x10, 0xBEEF, 80, 80).pack() + body
    image_id = f"{number:04d}"
    return ImageToSend(image_id, f"c{number}", contact(number_of_image(image_id)), stream)


def delivered(sender: ImageSender, packets: int = 500) -> dict[str, ImageUpdate]:
    """Send everything without loss; return the last update of each image."""
    receiver, found, now = CombinedReceiver(V1Receiver(), PaperReceiver(60.0)), dict[str, ImageUpdate](), 0.0
    for _ in range(packets):
        frames = take_packet(sender, now)
        if not frames:
            break
        assert len(frames) <= RATES[sender.rate].frames
        for frame in frames:
            assert len(frame) <= RATES[sender.rate].frame_bytes
            found |= {e.image_id: e for e in receiver.accept(3, frame, now) if isinstance(e, ImageUpdate)}
        now += 6.1
    return found


@each_sender
def test_all_images_arrive_complete(new: NewSender) -> None:
    sender, images = new(), [image(number) for number in range(1, 8)]
    assert sender.is_idle
    assert all(sender.add_image(each, 0.0) for each in images)
    assert not sender.is_idle
    found = delivered(sender)
    assert {name: (u.complete, u.stream) for name, u in found.items()} == {i.image_id: (True, i.stream) for i in images}
    assert sender.is_idle or sender.next_packet(1e4) is None


@each_sender
def test_a_packet_is_the_same_until_it_is_sent(new: NewSender) -> None:
    sender = new()
    assert sender.next_packet(0.0) is None
    sender.add_image(image(1), 0.0)
    packet = sender.next_packet(0.0)
    assert sender.next_packet(50.0) == sender.in_flight == packet
    assert sender.sent(packet.frames[:1], 6.0) == ()
    assert sender.next_packet(50.0).frames == packet.frames[1:]
    sender.sent(packet.frames[1:], 6.0)
    assert sender.in_flight is None
    assert sender.next_packet(60.0) != packet


@each_sender
def test_sent_returns_every_image_once(new: NewSender) -> None:
    sender = new()
    for number in (1, 2, 3):
        sender.add_image(image(number), 0.0)
    ended: list[str] = []
    while (packet := sender.next_packet(0.0)) is not None:
        ended += [sent.image_id for sent in sender.sent(packet.frames, 6.0)]
    assert sorted(ended) == ["0001", "0002", "0003"]
    assert sender.sent((), 6.0) == ()


@each_sender
def test_a_restart_at_any_moment_repeats_at_most_one_packet(new: NewSender) -> None:
    steady, restarted, now = new(), new(), 0.0
    for number in range(1, 6):
        steady.add_image(image(number), 0.0)
        restarted.add_image(image(number), 0.0)
    while (expected := steady.next_packet(now)) is not None:
        assert restarted.next_packet(now) == expected
        assert restarted.images_waiting == steady.images_waiting == steady.gauges()["images_waiting"]
        for _ in range(2):  # before the packet is sent, and before the state says that it was
            parts = restarted.parts()
            restarted = new()
            assert restarted.restore(parts) == {}
            assert restarted.in_flight == restarted.next_packet(now) == expected
        assert restarted.expected(now) == steady.expected(now)
        steady.sent(expected.frames, 6.0)
        restarted.sent(expected.frames, 6.0)
        now += 6.1
    assert restarted.next_packet(now) is None
    assert restarted.parts() == steady.parts()


@each_sender
def test_a_packet_changes_few_small_parts(new: NewSender) -> None:
    sender = new()
    for number in range(1, 40):
        sender.add_image(image(number), 0.0)
    sender.next_packet(0.0)
    saved = SavedParts(sender.parts())
    for now in range(1, 20):
        sender.sent(sender.in_flight.frames, 6.0)
        sender.next_packet(float(now))
        changes = saved.changes(sender.parts())
        assert sum(len(data or b"") for data in changes.values()) < 8000
        assert len(changes) < 12
        saved.commit(sender.parts())


@each_sender
def test_expected_times_follow_the_order_and_the_interval(new: NewSender) -> None:
    sender = new()
    for number in range(1, 6):
        sender.add_image(image(number), 0.0)
    sender.next_packet(0.0)
    found = {e.image_id: e for e in sender.expected(100.0)}
    assert {name: e.contact_id for name, e in found.items()} == {f"000{n}": f"c{n}" for n in range(1, 6)}
    for each in found.values():
        assert 100.0 < each.done_s < 100.0 + 2000
        assert each.preview_s is None or 100.0 <= each.preview_s <= each.done_s
        assert each.bytes_left > 0
    assert [e.done_s for e in sender.expected(100.0)] == sorted(e.done_s for e in found.values())
    delivered(sender)
    assert sender.expected(0.0) == []


@each_sender
def test_an_unreadable_image_is_reported_and_the_others_are_sent(new: NewSender) -> None:
    sender = new()
    for number in (1, 2, 3):
        sender.add_image(image(number), 0.0)
    parts = sender.parts()
    damaged = sorted(name for name in parts if name.startswith("image/"))[1]
    restored = new()
    errors = restored.restore({**parts, damaged: b"\xc1"})
    assert list(errors) == [damaged]
    assert isinstance(errors[damaged], FrameError)
    assert set(delivered(restored)) == {"0001", "0003"}


@each_sender
@pytest.mark.parametrize("wrong", [{"image_id": "no"}, {"stream": b""}, {"stream": b"\x10" + bytes(70_000)}], ids=str)
def test_invalid_image_is_rejected(new: NewSender, wrong: dict[str, Any]) -> None:
    fields = {name: getattr(image(1), name) for name in ("image_id", "contact_id", "contact", "stream")}
    sender = new()
    with pytest.raises(BadInputError):
        sender.add_image(ImageToSend(**{**fields, **wrong}), 0.0)
    assert sender.is_idle


def test_paper_packets_are_those_of_the_plan_in_the_order_of_arrival() -> None:
    sender, images = PaperSender(RATES[1]), [image(n, 40 + 90 * n) for n in (3, 1, 2)]
    for each in images:
        sender.add_image(each, 0.0)
    planned = [p for i in images for p in plan_packets(i.image_id, i.stream, i.contact, 3, 64)]
    found = []
    while (frames := take_packet(sender, 0.0)) != ():
        found.append(frames)
    assert found == planned


def test_an_image_of_the_paper_format_that_arrives_twice_is_sent_twice() -> None:
    sender = PaperSender(RATES[1])
    for _ in range(2):
        assert sender.add_image(image(1), 0.0)
    ended: list[str] = []
    while (packet := sender.next_packet(0.0)) is not None:
        ended += [sent.image_id for sent in sender.sent(packet.frames, 6.0)]
    assert ended == ["0001", "0001"]


def test_an_image_planned_for_another_rate_is_sent_from_its_beginning() -> None:
    sender = PaperSender(RATES[1])
    sender.add_image(image(1, 400), 0.0)
    take_packet(sender, 0.0)
    same, other = PaperSender(RATES[1]), PaperSender(RATES[5])
    assert same.restore(sender.parts()) == other.restore(sender.parts()) == {}
    plans = {rate: plan_packets("0001", image(1, 400).stream, image(1).contact, *rate) for rate in ((3, 64), (8, 256))}
    assert same.next_packet(0.0).frames == plans[3, 64][1]
    assert other.next_packet(0.0).frames == plans[8, 256][0]


def test_the_paper_format_has_no_messages_and_no_feedback() -> None:
    sender = PaperSender(RATES[1])
    assert not sender.accepts_messages
    with pytest.raises(FrameError, match="carries images only"):
        sender.add_message("m", "program", b"data", 0.0)
    assert sender.refine(1, 0, 0.0) is False
    assert sender.image_id_of(1) is None
