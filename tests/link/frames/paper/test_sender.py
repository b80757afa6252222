"""Packet plans: golden plans, and the rules for any image at any rate."""

import json
from typing import Any

import pytest
from builders.common import GOLDEN_FOLDER
from hypothesis import example, given
from hypothesis import strategies as st

from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import FrameError, StreamError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame, HalfFrame, half_bounds, parse_frame
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import Packet, plan_packets
from sonarpost.link.receiver import ImageUpdate

GOLDEN = json.loads((GOLDEN_FOLDER / "link" / "paper_packets.json").read_text())["plans"]
RATES = {0: (1, 32), 1: (3, 64), 2: (3, 64), 3: (2, 256), 4: (2, 256), 5: (8, 256), 6: (6, 32)}
CONTACT = ContactSummary(height_px=80, width_px=140, lat_deg=44.7, lon_deg=-63.6, confidence=1.5)


# By length: no model, a small model, a codebook; each with common sides and with another height.
HEADERS = {
    header.size: header
    for height_px in (80, 81)
    for header in (
        StreamHeader(1, 0, height_px, 140),
        StreamHeader(0x20, 0xA5, height_px, 140),
        StreamHeader(0x10, 0xBEEF, height_px, 140),
    )
}


def make_stream(length: int, header_bytes: int = 4) -> bytes:
    return HEADERS[header_bytes].pack() + bytes((7 * i + 1) % 256 for i in range(length))


@pytest.mark.parametrize("case", GOLDEN, ids=[c["name"] for c in GOLDEN])
def test_golden_plans(case: dict[str, Any]) -> None:
    contact = None if case["contact"] is None else ContactSummary(**case["contact"])
    plan = plan_packets(
        case["image_id"], bytes.fromhex(case["stream"]), contact, case["frames_per_packet"], case["frame_bytes"]
    )
    assert " ".join("".join(chr(frame[0]) for frame in packet) for packet in plan) == case["layout"]
    assert [[frame.hex() for frame in packet] for packet in plan] == case["packets"]


def fewest_packets(length: int, frames_per_packet: int, payload_bytes: int) -> int:
    """Return the number of packets if halves may share packets freely."""
    step = payload_bytes
    top, bottom = half_bounds(length, "top")[1], length // 2
    frames = max(1, -(-top // step)) + -(-bottom // step)
    return -(-frames // frames_per_packet)


@given(
    st.integers(0, 700) | st.integers(0, 65535),
    st.sampled_from(sorted(RATES)),
    st.booleans(),
    st.sampled_from(sorted(HEADERS)),
)
@example(65535, 0, True, 7)
@example(306, 1, True, 4)
def test_plan_keeps_all_rules(length: int, rate: int, with_contact: bool, header_bytes: int) -> None:
    frames_per_packet, frame_bytes = RATES[rate]
    stream = make_stream(length, header_bytes)
    plan = plan_packets("0K3P", stream, CONTACT if with_contact else None, frames_per_packet, frame_bytes)

    assert all(1 <= len(packet) <= frames_per_packet for packet in plan)
    assert all(len(frame) <= frame_bytes for packet in plan for frame in packet)
    parsed = [[parse_frame(frame) for frame in packet] for packet in plan]
    halves = [f for packet in parsed for f in packet if isinstance(f, HalfFrame)]
    assert b"".join(f.payload for f in halves) == stream[header_bytes:]  # in order, each once, top before bottom
    assert all(f.header == HEADERS[header_bytes] and f.body_length == length for f in halves)
    assert [f.half for f in halves] == sorted((f.half for f in halves), reverse=True)

    mixed = any(len({f.half for f in packet if isinstance(f, HalfFrame)}) > 1 for packet in parsed)
    most = max(sum(f.half == half for f in halves) for half in ("top", "bottom"))
    if most <= frames_per_packet:
        assert not mixed
    check_contact(parsed, plan, frames_per_packet, with_contact)
    alone = [p for p in parsed if not any(isinstance(f, HalfFrame) for f in p)]
    apart = sum(-(-sum(f.half == half for f in halves) // frames_per_packet) for half in ("top", "bottom"))
    if not with_contact:
        needed = (
            apart
            if most <= frames_per_packet
            else min(apart, fewest_packets(length, frames_per_packet, frame_bytes - 9 - header_bytes))
        )
        assert len(plan) == needed
        assert mixed == (len(plan) < apart)
    else:
        assert len(plan) - len(alone) <= apart


def check_contact(
    parsed: list[list[HalfFrame | ContactFrame]], plan: tuple[Packet, ...], frames_per_packet: int, with_contact: bool
) -> None:
    records = [[f for f in packet if isinstance(f, ContactFrame)] for packet in parsed]
    if not with_contact:
        assert not any(records)
        return
    assert all(f == ContactFrame("0K3P", CONTACT.rounded()) for packet in records for f in packet)
    alone = [i for i, packet in enumerate(parsed) if len(records[i]) == len(packet)]
    if alone:
        assert alone == [0]  # a packet of its own only if no other packet has a free frame
        assert plan[0] == (ContactFrame("0K3P", CONTACT).pack(),)
        assert all(len(packet) == frames_per_packet and not records[i] for i, packet in enumerate(parsed) if i)
    else:
        assert all(len(packet) == frames_per_packet for packet in plan)  # every free frame is used
        leading = next(i for i, packet in enumerate(records) if packet)
        assert isinstance(parsed[leading][0], ContactFrame)
        check_contact_leads(parsed, frames_per_packet)


def check_contact_leads(parsed: list[list[HalfFrame | ContactFrame]], frames_per_packet: int) -> None:
    """Check that the record goes first in each half (in both if they share) with a free frame, further copies last."""
    kinds = ["".join("C" if isinstance(f, ContactFrame) else f.half[0] for f in packet) for packet in parsed]
    shared = any("t" in kind and "b" in kind for kind in kinds)
    groups = ["".join(kinds)] if shared else ["".join(k for k in kinds if half in k) for half in "tb"]
    for group in groups:
        halves = group.replace("C", "")
        free = -len(halves) % frames_per_packet
        assert group == ("C" + halves + "C" * (free - 1) if free else halves)


@given(st.integers(0, 700), st.sampled_from(sorted(RATES)), st.sampled_from(sorted(HEADERS)))
def test_all_frames_give_one_complete_image_with_contact(length: int, rate: int, header_bytes: int) -> None:
    stream = make_stream(length, header_bytes)
    receiver = PaperReceiver(60)
    plan = plan_packets("0K3P", stream, CONTACT, *RATES[rate])
    events = [e for packet in plan for frame in packet for e in receiver.accept(2, frame, 0)]
    (event,) = events  # one version: later frames add nothing
    assert isinstance(event, ImageUpdate)
    assert event.complete
    assert event.stream == stream
    assert event.contact == CONTACT.rounded()


@pytest.mark.parametrize(
    ("image_id", "contact", "frames_per_packet", "frame_bytes", "named"),
    [
        ("0k3p", None, 3, 64, "image identifier"),
        ("0K3P", None, 0, 64, "frames_per_packet"),
        ("0K3P", None, 3, 16, "frame_bytes"),
        ("0K3P", CONTACT, 3, 31, "frame_bytes"),
    ],
)
def test_impossible_plans_are_rejected(
    image_id: str, contact: ContactSummary | None, frames_per_packet: int, frame_bytes: int, named: str
) -> None:
    with pytest.raises(FrameError) as caught:
        plan_packets(image_id, make_stream(20), contact, frames_per_packet, frame_bytes)
    assert caught.value.field == named


@pytest.mark.parametrize(
    ("stream", "field"),
    [
        (b"", "header"),
        (make_stream(9)[:3], "header"),
        (make_stream(9, 7)[:6], "header"),
        (b"\x01\xff" + bytes(7), "height_px"),
        (b"\x01\xe1" + bytes(7), "size"),
        (make_stream(65536), "body"),
    ],
    ids=["empty", "cut", "size cut", "no size", "reserved", "too long"],
)
def test_invalid_stream_is_rejected(stream: bytes, field: str) -> None:
    with pytest.raises(StreamError) as caught:
        plan_packets("0K3P", stream, None, 3, 64)
    assert caught.value.field == field


def test_shorter_header_leaves_more_room_for_the_body() -> None:
    longest = {n: len(plan_packets("0K3P", make_stream(700, n), None, 3, 64)[0][0]) - 9 - n for n in HEADERS}
    assert longest == {2: 53, 3: 52, 4: 51, 5: 50, 6: 49, 7: 48}
