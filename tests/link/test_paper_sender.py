"""Packet plans: golden plans, and the rules held to for any picture at any rate."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import FrameError, StreamError
from sonarpost.link.contact_record import ContactSummary
from sonarpost.link.paper_format import ContactFrame, HalfFrame, half_bounds, parse_frame
from sonarpost.link.paper_sender import Packet, body_capacity_bytes, plan_packets

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "link" / "paper_packets.json").read_text())["plans"]
RATES = {0: (1, 32), 1: (3, 64), 2: (3, 64), 3: (2, 256), 4: (2, 256), 5: (8, 256), 6: (6, 32)}
CONTACT = ContactSummary(height_px=80, width_px=140, lat_deg=44.7, lon_deg=-63.6, confidence=1.5)


def make_stream(length: int) -> bytes:
    return StreamHeader(1, 0xBEEF, 80, 140, length).pack() + bytes((7 * i + 1) % 256 for i in range(length))


@pytest.mark.parametrize("case", GOLDEN, ids=[c["name"] for c in GOLDEN])
def test_golden_plans(case: dict[str, Any]) -> None:
    contact = None if case["contact"] is None else ContactSummary(**case["contact"])
    plan = plan_packets(
        case["image_id"], bytes.fromhex(case["stream"]), contact, case["frames_per_packet"], case["frame_bytes"]
    )
    assert " ".join("".join(chr(frame[0]) for frame in packet) for packet in plan) == case["layout"]
    assert [[frame.hex() for frame in packet] for packet in plan] == case["packets"]


def fewest_packets(length: int, frames_per_packet: int, frame_bytes: int) -> int:
    """Packets needed when nothing but the count matters and halves may share."""
    step = frame_bytes - 15
    top, bottom = half_bounds(length, "top")[1], length // 2
    frames = max(1, -(-top // step)) + -(-bottom // step)
    return -(-frames // frames_per_packet)


@given(st.integers(0, 700) | st.integers(0, 65535), st.sampled_from(sorted(RATES)), st.booleans())
@example(65535, 0, True)
@example(294, 1, True)
def test_a_plan_keeps_every_rule(length: int, rate: int, with_contact: bool) -> None:
    frames_per_packet, frame_bytes = RATES[rate]
    stream = make_stream(length)
    plan = plan_packets("0K3P", stream, CONTACT if with_contact else None, frames_per_packet, frame_bytes)

    assert all(1 <= len(packet) <= frames_per_packet for packet in plan)
    assert all(len(frame) <= frame_bytes for packet in plan for frame in packet)
    parsed = [[parse_frame(frame) for frame in packet] for packet in plan]
    halves = [f for packet in parsed for f in packet if isinstance(f, HalfFrame)]
    assert b"".join(f.payload for f in halves) == stream[StreamHeader.SIZE :]  # in order, once, top before bottom
    assert all(f.header.pack() == stream[: StreamHeader.SIZE] for f in halves)
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
            apart if most <= frames_per_packet else min(apart, fewest_packets(length, frames_per_packet, frame_bytes))
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
        assert alone == [0]  # a packet of its own only where no other has a free frame
        assert plan[0] == (ContactFrame("0K3P", CONTACT).pack(),)
        assert all(len(packet) == frames_per_packet and not records[i] for i, packet in enumerate(parsed) if i)
    else:
        assert all(len(packet) == frames_per_packet for packet in plan)  # every frame left free is used
        leading = next(i for i, packet in enumerate(records) if packet)
        assert isinstance(parsed[leading][0], ContactFrame)


@pytest.mark.parametrize("with_contact", [True, False])
@pytest.mark.parametrize("rate", sorted(RATES))
def test_capacity_is_the_longest_body_with_one_packet_a_half(rate: int, with_contact: bool) -> None:
    frames_per_packet, frame_bytes = RATES[rate]
    contact = CONTACT if with_contact else None
    capacity = body_capacity_bytes(frames_per_packet, frame_bytes, with_contact=with_contact)
    own_packet = 1 if with_contact and frames_per_packet == 1 else 0
    plan = plan_packets("0K3P", make_stream(capacity), contact, frames_per_packet, frame_bytes)
    assert len(plan) == 2 + own_packet
    if with_contact and not own_packet:
        assert all(any(frame[:1] == b"C" for frame in packet) for packet in plan)
    beyond = plan_packets("0K3P", make_stream(capacity + 1), contact, frames_per_packet, frame_bytes)
    assert len(beyond) > len(plan) or sum(frame[:1] == b"C" for frame in beyond[0]) == 0


def test_capacity_never_exceeds_what_the_stream_header_can_say() -> None:
    assert body_capacity_bytes(8, 2**16, with_contact=False) == 65535


@pytest.mark.parametrize(
    ("image_id", "contact", "frames_per_packet", "frame_bytes", "named"),
    [
        ("0k3p", None, 3, 64, "image identifier"),
        ("0K3P", None, 0, 64, "frames_per_packet"),
        ("0K3P", None, 3, 15, "frame_bytes"),
        ("0K3P", CONTACT, 3, 31, "frame_bytes"),
    ],
)
def test_impossible_plans_are_refused(
    image_id: str, contact: ContactSummary | None, frames_per_packet: int, frame_bytes: int, named: str
) -> None:
    with pytest.raises(FrameError) as caught:
        plan_packets(image_id, make_stream(20), contact, frames_per_packet, frame_bytes)
    assert caught.value.field == named


@pytest.mark.parametrize("stream", [b"", make_stream(9)[:-1], make_stream(9) + b"x", b"\x01" + bytes(7)])
def test_a_stream_that_is_not_whole_is_refused(stream: bytes) -> None:
    with pytest.raises(StreamError):
        plan_packets("0K3P", stream, None, 3, 64)


def test_one_body_byte_a_frame_is_enough_to_send() -> None:
    plan = plan_packets("0K3P", make_stream(3), None, 1, 16)
    assert [len(packet[0]) for packet in plan] == [16, 16, 16]
