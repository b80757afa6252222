"""Frames that two vessels received: any split over them gives what one vessel receives from all of them."""

from collections.abc import Sequence
from itertools import product

import pytest
from builders.authentication_world import VEHICLE, vehicle_authenticator, vessel_authenticator
from builders.v1_world import add_message, contact, stream
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.link.auth.authentication import WINDOW
from sonarpost.link.auth.merging import MERGE_WINDOW, Arrival, FrameMerger, MergedWindow
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, Symbol, SymbolKind, pack_segments, pack_symbol
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import Event, FrameRejected, ImageUpdate, MessageReceived
from sonarpost.link.state import pack_part

OTHER = "vessel-2"
IMAGES = 3


def lead_and_merger() -> tuple[V1Receiver, FrameMerger]:
    """Return the receiver of a lead vessel, and its merger."""
    own = vessel_authenticator()
    merger = FrameMerger(own, {OTHER: vessel_authenticator()})
    return V1Receiver(protection=own, merger=merger), merger


def lead() -> V1Receiver:
    return lead_and_merger()[0]


def sent_frames(first_block: int, feedback: bool) -> list[bytes]:
    sender = V1Sender(
        SenderConfig(
            frame_bytes=64, channels=(LossChannel(0.3),), feedback=feedback, stream_bytes=200, frames_per_image=8.0
        ),
        first_block=first_block,
        protection=vehicle_authenticator(),
    )
    for number in range(1, IMAGES + 1):
        sender.add_image(number, contact(number), stream(number, 250), 0.0)
    add_message(sender, b"a message", 0.0, times=2)
    frames = [frame for _ in range(2 * WINDOW) if (frame := sender.next_frame(0.0)) is not None]
    assert IMAGES * 3 < len(frames) < WINDOW
    return frames


FRAMES = {(first, feedback): sent_frames(first, feedback) for first, feedback in product((0, 13, 30), (False, True))}


def content(events: Sequence[Event]) -> dict[str, tuple[bytes, bool]]:
    """Return the received beginning and completeness of each image."""
    updates = [event for event in events if isinstance(event, ImageUpdate)]
    assert all(event.contact == contact(number_of_image(event.image_id)) for event in updates)
    return {event.image_id: (event.stream, event.complete) for event in updates}


def messages(events: Sequence[Event]) -> list[bytes]:
    return [event.data for event in events if isinstance(event, MessageReceived)]


@given(data=st.data())
def test_any_split_gives_what_one_vessel_receives_from_all(data: st.DataObject) -> None:
    frames = FRAMES[data.draw(st.sampled_from(sorted(FRAMES)))]
    ways = data.draw(st.lists(st.sampled_from(["lost", "own", "other", "both"]), min_size=len(frames)))
    own = [frame for frame, way in zip(frames, ways, strict=False) if way in ("own", "both")]
    other = [frame for frame, way in zip(frames, ways, strict=False) if way in ("other", "both")]
    union = [frame for frame, way in zip(frames, ways, strict=False) if way != "lost"]
    if not union:
        return
    arrivals = [("", frame) for frame in own] + [(OTHER, frame) for frame in other]
    if data.draw(st.booleans()):
        arrivals = data.draw(st.permutations(arrivals))

    single = V1Receiver(protection=vessel_authenticator())
    expected = [event for frame in union for event in single.accept(VEHICLE, frame, 0.0)]
    receiver, merger = lead_and_merger()
    events: list[Event] = []
    for vessel, frame in arrivals:
        if vessel:
            events += receiver.accept_from(vessel, VEHICLE, frame, 0.0)
        else:
            events += receiver.accept(VEHICLE, frame, 0.0)
        assert not merger.restore(merger.parts())
    assert not [event for event in events if isinstance(event, FrameRejected)]
    assert content(events) == content(expected)
    assert messages(events) == messages(expected)
    assert receiver.counts.duplicates == len(arrivals) - len(union)
    assert receiver.counts.late == 0
    # The vehicle measures the loss from this number.
    assert receiver.feedback(VEHICLE, 0.0) == single.feedback(VEHICLE, 0.0)


def test_replay_is_rejected_by_each_way_and_a_frame_of_both_is_a_duplicate() -> None:
    frame, receiver = FRAMES[0, False][0], lead()
    assert receiver.accept(VEHICLE, frame, 0.0)
    assert receiver.accept_from(OTHER, VEHICLE, frame, 0.0) == []
    for again in (receiver.accept(VEHICLE, frame, 1.0), receiver.accept_from(OTHER, VEHICLE, frame, 1.0)):
        [event] = again
        assert isinstance(event, FrameRejected)
        assert event.reason.field == "counter"
    assert (receiver.counts.duplicates, receiver.counts.rejected) == (1, 2)


def test_frame_with_another_key_and_unknown_vessel_are_rejected() -> None:
    receiver, forger = lead(), vehicle_authenticator(name="forged")
    forged = pack_segments([Segment(SegmentKind.MESSAGE, b"\x01false")], 64, forger)
    for vessel, frame, field in ((OTHER, forged, "tag"), ("vessel-9", FRAMES[0, False][0], "vessel")):
        [event] = receiver.accept_from(vessel, VEHICLE, frame, 0.0)
        assert isinstance(event, FrameRejected)
        assert event.reason.field == field
    assert receiver.sources == ()
    [event] = V1Receiver(protection=vessel_authenticator()).accept_from(OTHER, VEHICLE, FRAMES[0, False][0], 0.0)
    assert isinstance(event, FrameRejected)


def symbols(blocks: int, each: int, name: str = "fleet") -> list[bytes]:
    """Return frames of consecutive blocks, each a message of `each` symbols, one of them more than required."""
    vehicle = vehicle_authenticator(name=name)
    return [
        pack_symbol(Symbol(SymbolKind.OBJECT, n % 32, index, each, bytes([n]) * 40), vehicle)
        for n in range(blocks)
        for index in range(each)
    ]


def test_late_symbols_of_blocks_before_the_window_are_dropped_and_do_not_move_it() -> None:
    frames = symbols(40, 3)
    receiver = lead()
    for at in range(0, len(frames), 3):  # the first symbol of each block
        receiver.accept(VEHICLE, frames[at], 0.0)
    before = receiver.feedback(VEHICLE, 0.0)
    assert before is not None
    assert before.newest == 39 % 32
    for at in range(1, len(frames), 3):
        assert receiver.accept_from(OTHER, VEHICLE, frames[at], 0.0) == []
    after = receiver.feedback(VEHICLE, 0.0)
    assert after is not None
    assert after.newest == before.newest
    assert receiver.counts.late == 40 - 16
    assert [m - 1 for m in before.missing] == list(after.missing)
    assert receiver.counts.rejected == 0


def test_counters_of_a_replaced_key_reject_no_frame() -> None:
    before, receiver = (
        lead(),
        V1Receiver(protection=(own := vessel_authenticator(name="new")), merger=FrameMerger(own, {})),
    )
    for frame in symbols(30, 4):
        before.accept(VEHICLE, frame, 0.0)
    assert not receiver.restore(before.parts())
    assert receiver.feedback(VEHICLE, 0.0) == before.feedback(VEHICLE, 0.0)
    for frame in symbols(34, 1, "new")[30:]:
        receiver.accept(VEHICLE, frame, 0.0)
    assert receiver.counts.late == 0
    found = receiver.feedback(VEHICLE, 0.0)
    assert found is not None
    assert found.newest == 33 % 32


def test_window_of_counters_is_bounded() -> None:
    window = MergedWindow("key", VEHICLE)
    assert window.arrive(MERGE_WINDOW + 10) is Arrival.NEW
    assert window.arrive(11) is Arrival.NEW
    assert window.arrive(11) is Arrival.DUPLICATE
    assert window.arrive(10) is Arrival.LATE
    assert window.arrive(2**40) is Arrival.NEW
    assert window.arrive(MERGE_WINDOW + 10) is Arrival.LATE
    assert len(window.seen) == MERGE_WINDOW // 8


def test_saved_state_of_another_key_or_length_is_not_used() -> None:
    own = vessel_authenticator()
    merger = FrameMerger(own, {OTHER: vessel_authenticator()})
    merger.arrive(VEHICLE, 5)
    changed = vessel_authenticator(name="forged")
    other = FrameMerger(changed, {OTHER: vessel_authenticator(name="forged")})
    assert not other.restore(merger.parts())
    assert other.arrive(VEHICLE, 5) is Arrival.NEW
    short = MergedWindow(own.fingerprint, VEHICLE, 5, b"\1")
    errors = merger.restore({f"window/{VEHICLE}": pack_part(short)})
    assert [error.field for error in errors.values()] == ["seen"]


@pytest.mark.parametrize("vessel", ["", OTHER])
def test_updates_of_an_image_continue_whichever_vessel_delivers(vessel: str) -> None:
    receiver, events = lead(), list[Event]()
    for n, frame in enumerate(FRAMES[0, True]):
        way = vessel if n % 2 else OTHER
        events += receiver.accept_from(way, VEHICLE, frame, 0.0) if way else receiver.accept(VEHICLE, frame, 0.0)
    versions = [event.version for event in events if isinstance(event, ImageUpdate) and event.image_id == "0001"]
    assert versions == list(range(1, len(versions) + 1))
    for image_id, (received, complete) in content(events).items():
        assert complete
        assert len(received) >= 150
        assert stream(number_of_image(image_id), 250).startswith(received)
    assert len(content(events)) == IMAGES
