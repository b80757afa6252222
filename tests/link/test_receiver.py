"""Contract of every `FrameReceiver`: the same events in every wire format."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from builders.v1_world import contact
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.codec.interface import StreamHeader
from sonarpost.link.coding.byte_ranges import count_positions
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import (
    CombinedReceiver,
    Event,
    FrameReceiver,
    FrameRejected,
    ImageUpdate,
    has_header,
    received_mask,
)

VEHICLE = 3
HEADER = StreamHeader(0x10, 0xBEEF, 80, 80)


def image_stream(length: int = 200) -> bytes:
    return HEADER.pack() + np.random.default_rng(length).integers(1, 256, length, dtype=np.uint8).tobytes()


def v1_frames(image_id: str, stream: bytes) -> list[bytes]:
    sender = V1Sender(SenderConfig(channels=(LossChannel(0.0),), frames_per_image=20.0))
    number = number_of_image(image_id)
    sender.add_image(number, contact(number), stream, 0.0)
    frames = []
    while (frame := sender.next_frame(0.0)) is not None:
        frames.append(frame)
    return frames


def paper_frames(image_id: str, stream: bytes) -> list[bytes]:
    packets = plan_packets(image_id, stream, contact(number_of_image(image_id)), 3, 64)
    return [frame for packet in packets for frame in packet]


@dataclass(frozen=True)
class Format:
    """A receiver and the frames of a sender for it."""

    name: str
    receiver: Callable[[], Any]
    frames: Callable[[str, bytes], list[bytes]]

    def __str__(self) -> str:
        return self.name


def combined() -> CombinedReceiver:
    return CombinedReceiver(V1Receiver(), PaperReceiver(60.0))


FORMATS = [
    Format("v1", V1Receiver, v1_frames),
    Format("paper", lambda: PaperReceiver(60.0), paper_frames),
    Format("v1 of both", combined, v1_frames),
    Format("paper of both", combined, paper_frames),
]
SINGLE = FORMATS[:2]
each_format = pytest.mark.parametrize("wire", FORMATS, ids=str)


def updates(events: list[Event]) -> list[ImageUpdate]:
    assert all(isinstance(event, ImageUpdate) for event in events)
    return [event for event in events if isinstance(event, ImageUpdate)]


def receive(receiver: FrameReceiver, frames: list[bytes], first_s: float = 10.0) -> list[Event]:
    found: list[Event] = []
    for place, frame in enumerate(frames):
        found += receiver.accept(VEHICLE, frame, first_s + place)
    return found + receiver.poll(first_s + len(frames) + 1000.0)


@each_format
def test_all_frames_give_a_complete_image(wire: Format) -> None:
    stream = image_stream()
    frames = wire.frames("00A7", stream)
    last = updates(receive(wire.receiver(), frames))[-1]
    assert (last.source, last.image_id, last.complete) == (VEHICLE, "00A7", True)
    assert (last.stream, last.missing, last.missing_halves) == (stream, (), ())
    assert last.contact == contact(number_of_image("00A7"))
    assert received_mask(last.stream, last.missing).tolist() == [True] * 200
    assert last.received_bytes == last.total_bytes
    assert last.first_frame_s == 10.0
    assert 10.0 <= last.last_frame_s < 10.0 + len(frames)


@each_format
def test_versions_count_up_and_hold_more_bytes(wire: Format) -> None:
    frames = wire.frames("00A7", image_stream())
    receiver = wire.receiver()
    found = updates(receive(receiver, frames[:3]))
    found += updates(receive(receiver, frames[3:], first_s=5000.0))
    assert [update.version for update in found] == list(range(1, len(found) + 1))
    assert len(found) > 1
    received = [len(u.stream) - count_positions(u.missing) for u in found]
    assert received == sorted(received)


@each_format
@pytest.mark.parametrize("lost", [{0}, {1}, {4}, {0, 1, 2}])
def test_missing_ranges_hold_zeros_and_the_rest_is_right(wire: Format, lost: set[int]) -> None:
    stream = image_stream()
    frames = [frame for place, frame in enumerate(wire.frames("00A7", stream)) if place not in lost]
    for update in updates(receive(wire.receiver(), frames[: len(frames) // 2 + 1])):
        missing = {i for a, b in update.missing for i in range(a, b)}
        assert (
            update.stream == bytes(0 if i in missing else byte for i, byte in enumerate(stream))[: len(update.stream)]
        )
        assert not (update.complete and missing)
        if has_header(update.stream):
            mask = received_mask(update.stream, update.missing)
            assert mask.tolist() == [i not in missing for i in range(HEADER.size, len(update.stream))]
        else:
            assert (update.stream, update.missing_halves) == (b"", ("top", "bottom"))


@each_format
def test_a_contact_alone_is_reported_without_a_stream(wire: Format) -> None:
    if "paper" in wire.name:
        frame = paper_frames("00A7", image_stream())[0]
    else:
        sender = V1Sender(SenderConfig(frame_bytes=32, announce=True, group_delay_s=1e4))
        sender.add_image(number_of_image("00A7"), contact(number_of_image("00A7")), image_stream(), 0.0)
        frame = sender.next_frame(0.0) or b""
    (update,) = updates(receive(wire.receiver(), [frame]))
    assert (update.image_id, update.stream, update.complete) == ("00A7", b"", False)
    assert update.contact == contact(number_of_image("00A7"))
    assert update.missing_halves == ("top", "bottom")
    assert (update.received_bytes, update.total_bytes) == (0, 0)


@each_format
def test_sources_are_independent(wire: Format) -> None:
    receiver = wire.receiver()
    streams = {source: image_stream(100 + source) for source in (3, 4, 5)}
    frames = {source: wire.frames("00A7", stream) for source, stream in streams.items()}
    latest: dict[int, ImageUpdate] = {}
    for place in range(max(map(len, frames.values()))):
        for source, listed in frames.items():
            if place < len(listed):
                latest |= {u.source: u for u in updates(receiver.accept(source, listed[place], float(place)))}
    assert {source: update.stream for source, update in latest.items()} == streams


@each_format
@given(frame=st.binary(max_size=80), source=st.integers(-1, 300), now=st.floats(-1e6, 1e9))
def test_any_bytes_are_rejected_without_an_exception(wire: Format, frame: bytes, source: int, now: float) -> None:
    for event in wire.receiver().accept(source, frame, now):
        if isinstance(event, FrameRejected):
            assert (event.source, event.received_s) == (source, now)
            assert str(event.reason).startswith(f"acoustic frame from modem {source}: ")


@pytest.mark.parametrize("wire", SINGLE, ids=str)
def test_a_frame_changes_few_small_parts(wire: Format) -> None:
    receiver = wire.receiver()
    for number in range(1, 31):
        receive(receiver, wire.frames(f"{number:04d}", image_stream(60))[:1], first_s=0.0)
    before = receiver.parts()
    receiver.accept(VEHICLE, wire.frames("00A7", image_stream())[0], 5.0)
    after = receiver.parts()
    changed = {name: data for name, data in after.items() if before.get(name) != data}
    assert not before.keys() - after.keys()
    assert len(changed) <= 5
    assert sum(map(len, changed.values())) < 1000


def test_a_receiver_without_a_format_reports_its_frames_as_rejected_or_not_at_all() -> None:
    v1, paper = v1_frames("00A7", image_stream())[0], paper_frames("00A7", image_stream())[1]
    only_v1, only_paper = CombinedReceiver(V1Receiver(), None), CombinedReceiver(None, PaperReceiver(60.0))
    none = CombinedReceiver(None, None)
    assert [type(e) for e in only_v1.accept(VEHICLE, paper, 0.0)] == [FrameRejected]
    assert [type(e) for e in only_paper.accept(VEHICLE, v1, 0.0)] == [FrameRejected]
    assert none.accept(VEHICLE, v1, 0.0) == none.accept(VEHICLE, paper, 0.0) == none.poll(0.0) == []
    assert only_paper.accept(VEHICLE, paper, 1.0) == []
    assert (only_v1.next_deadline(), only_paper.next_deadline()) == (None, 61.0)


def test_both_formats_at_once() -> None:
    receiver, stream = combined(), image_stream()
    found: list[Event] = []
    for place, pair in enumerate(zip(v1_frames("00A7", stream), paper_frames("00A8", stream), strict=False)):
        for frame in pair:
            found += receiver.accept(VEHICLE, frame, float(place))
    assert {update.image_id for update in updates(found)} == {"00A7", "00A8"}
    assert [type(e) for e in receiver.accept(VEHICLE, b"T neither of them", 50.0)] == [FrameRejected]
    assert receiver.v1.counts.rejected > 0
    assert receiver.paper.counts.rejected == 0
