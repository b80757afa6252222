"""State of sonarpost 0.1: golden examples restore to the same content, malformed ones raise FrameError only.

The examples in tests/golden/link-state-0.1 were saved by version 0.1, with what that version did next.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import msgpack
import pytest
from builders.common import GOLDEN_FOLDER
from builders.link_state import replace_a_value
from builders.paper_images import received_of
from builders.v1_world import queue_config, take_packet
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import FrameError
from sonarpost.link import migration
from sonarpost.link.auth.authentication import AuthenticationCounts, FrameAuthenticator
from sonarpost.link.auth.key import Direction, parse_key
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.downlink import commands
from sonarpost.link.downlink.commands import CommandTracker
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.downlink.vessel_endpoint import VesselEndpoint
from sonarpost.link.frames.paper.receiver import PaperReceiver, PaperReceiverCounts
from sonarpost.link.frames.v1.payload_objects import Feedback
from sonarpost.link.frames.v1.receiver import V1Receiver, V1ReceiverCounts
from sonarpost.link.queue.transmit_queue import TransmitQueue
from sonarpost.link.receiver import Event, FeedbackReceived, FrameRejected, ImageUpdate, MessageReceived

QUEUES = ["queue_broadcast", "queue_feedback"]


def golden(name: str) -> Any:
    return json.loads((GOLDEN_FOLDER / "link-state-0.1" / f"{name}.json").read_text(encoding="utf-8"))


def check(events: list[Event], expected: list[dict[str, Any]]) -> None:
    """Check the named fields of events; there is a stream where one is named."""
    assert len(events) == len(expected)
    for event, fields in zip(events, expected, strict=True):
        match event:
            case ImageUpdate():
                assert bool(event.stream) == ("stream" in fields)
                found = asdict(event) | {
                    "image": number_of_image(event.image_id),
                    "contact": event.contact and event.contact.pack().hex(),
                    "stream": event.stream.hex(),
                    "received": [list(r) for r in received_of(event)] if "received" in fields else None,
                    "missing_halves": list(event.missing_halves),
                    "first": event.first_frame_s,
                    "last": event.last_frame_s,
                }
            case MessageReceived():
                found = {"message": event.number, "data": event.data.hex()}
            case FeedbackReceived():
                found = {"feedback": event.feedback.pack().hex()}
            case FrameRejected():
                found = {"rejected": event.reason.field}
        assert {name: found.get(name) for name in fields} == fields


def test_v1_receiver() -> None:
    case = golden("v1_receiver")
    receiver = V1Receiver(ReceiverConfig(max_contacts=20))
    assert receiver.restore(migration.v1_receiver_parts(bytes.fromhex(case["state"]))) == {}
    for step in case["steps"]:
        events = receiver.accept(step["source"], bytes.fromhex(step["frame"]), step["at"])
        check(events, step["events"])
    now = case["steps"][-1]["at"]
    for address, expected in case["feedback"].items():
        source = int(address)
        assert receiver.feedback_is_due(source, now) == expected["due"]
        assert receiver.mini_feedback(source) == expected["mini"]
        feedback = receiver.feedback(source, now)
        assert feedback is not None
        assert feedback.pack().hex() == expected["feedback"]
    assert receiver.counts == V1ReceiverCounts(*case["counts"])


def test_paper_receiver() -> None:
    case = golden("paper_receiver")
    receiver = PaperReceiver(60.0, max_images=5)
    assert receiver.restore(migration.paper_receiver_parts(bytes.fromhex(case["state"]))) == {}
    assert receiver.next_deadline() == case["next_deadline"]
    for step in case["steps"]:
        if "frame" in step:
            events = receiver.accept(step["source"], bytes.fromhex(step["frame"]), step["at"])
        else:
            events = receiver.poll(step["at"])
        check(events, step["events"])
    assert receiver.counts == PaperReceiverCounts(*case["counts"])


def restored_queue(case: Any, parts: dict[str, bytes]) -> TransmitQueue:
    settings = case["config"]
    queue = TransmitQueue(
        queue_config(tuple(settings["rates"]), settings["first_rate"], settings["expected_loss"]), first_block=5
    )
    converted, errors = migration.queue_parts(parts)
    assert errors == {}
    assert queue.restore(converted) == {}
    return queue


def old_parts(case: Any) -> dict[str, bytes]:
    return {name: bytes.fromhex(data) for name, data in case["parts"].items()}


@pytest.mark.parametrize("name", QUEUES)
def test_transmit_queue(name: str) -> None:
    case = golden(name)
    queue = restored_queue(case, old_parts(case))
    assert queue.messages_waiting == case["messages_waiting"]
    found = [
        [e.image_id, e.contact_id, e.bytes_left, e.preview_s, e.done_s] for e in queue.expected(case["expected_at"])
    ]
    assert found == [[*texts, b, pytest.approx(p), pytest.approx(d)] for *texts, b, p, d in case["expected"]]
    packet = queue.next_packet(case["steps"][0]["at"])
    assert packet is not None
    assert (packet.rate, [f.hex() for f in packet.frames]) == (case["packet"]["rate"], case["packet"]["frames"])
    queue.sent(packet.frames, 6.1)
    # Version 0.1 left frames of a packet empty: further copies fill them now, so that frames go earlier.
    sent, expected = set(), set()
    for step in case["steps"]:
        sent |= {frame.hex() for frame in take_packet(queue, step["at"])}
        expected |= set(step["frames"])
        assert queue.rate == step["rate"]
        if "feedback" in step:
            queue.on_feedback(Feedback.unpack(bytes.fromhex(step["feedback"])), step["at"], 1)
    assert expected
    assert expected <= sent
    assert queue.add_message("m11", "b", b"x", 0.0) is not case["known"]


def test_a_queue_saved_before_there_were_repairs() -> None:
    """Programs before version 0.1 saved no retired blocks, no delivered ranges and no spans."""
    case = golden("queue_broadcast")
    parts = old_parts(case)
    core = msgpack.unpackb(parts["core"], strict_map_key=False)
    del core["past"], core["planned_loss"]
    core["sent"] = [entry[:2] for entry in core["sent"]]
    core["sender"]["messages"] = [entry[:7] for entry in core["sender"]["messages"]]
    parts["core"] = msgpack.packb(core)
    for name in [n for n in parts if n.startswith("block/")]:
        block = msgpack.unpackb(parts[name], strict_map_key=False)
        del block["spans"]
        parts[name] = msgpack.packb(block)
    queue = restored_queue(case, parts)
    receiver, now, images = V1Receiver(), case["expected_at"], set[str]()
    for _ in range(1500):
        now += 6.1
        for frame in take_packet(queue, now):
            images |= {e.image_id for e in receiver.accept(3, frame, now) if isinstance(e, ImageUpdate) and e.complete}
        if receiver.feedback_is_due(3, now) and (feedback := receiver.feedback(3, now)):
            queue.on_feedback(feedback, now, 1)
    assert images == {image.image_id for image in queue.sender.kept.values()}
    assert len(images) == 13


@pytest.mark.parametrize("core", [None, b"\xc1 no msgpack", msgpack.packb({"format": 99})])
def test_without_the_core_all_images_and_messages_are_sent_again(core: bytes | None) -> None:
    case = golden("queue_broadcast")
    parts = {name: data for name, data in old_parts(case).items() if name != "core"}
    parts |= {} if core is None else {"core": core}
    parts["picture/2"] = msgpack.packb({"number": 2})
    converted, errors = migration.queue_parts(parts)
    assert set(errors) == {"picture/2"} | ({"core"} if core else set())
    queue = TransmitQueue(queue_config(expected_loss=0.0))
    assert queue.restore(converted) == {}
    assert queue.messages_waiting == case["messages_waiting"]
    assert {(i.image_id, i.contact_id) for i in queue.sender.waiting} == {
        (e.image_id, e.contact_id) for e in queue.expected(0.0)
    }
    assert sorted(i.number for i in queue.sender.waiting) == [1, *range(3, 13), 50]


def test_authentication() -> None:
    case = golden("authentication")
    key = parse_key(case["key"], "golden")
    vessel = FrameAuthenticator(key, 1, Direction.TO_VEHICLE)
    parts = migration.authentication_parts(bytes.fromhex(case["state"]))
    assert vessel.restore(parts) == {}
    for step in case["steps"]:
        frame = bytes.fromhex(step["frame"])
        if "plain" in step:
            assert vessel.verify(step["source"], frame).hex() == step["plain"]
        else:
            with pytest.raises(FrameError) as caught:
                vessel.verify(step["source"], frame)
            assert caught.value.field == step["rejected"]
    assert vessel.counts == AuthenticationCounts(*case["counts"])
    again = FrameAuthenticator(key, 1, Direction.TO_VEHICLE)
    again.restore(parts)
    assert again.requested_limit == case["limit"]
    again.grant(case["limit"])
    assert again.protect(b"\x80next").hex() == case["protected"]


def test_vessel_endpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "_QUICK_RETRIES", 0)  # as version 0.1 waited
    case = golden("endpoint")
    endpoint = VesselEndpoint(CommandTracker(60.0))
    assert endpoint.restore(migration.endpoint_parts(bytes.fromhex(case["state"]))) == {}
    for step in case["steps"]:
        packet = endpoint.next_packet(2, 32, step["at"])
        assert (packet and packet.address) == step["address"]
        assert [f.hex() for f in packet.frames] if packet else step["frames"] == []
        if packet is not None:
            assert list(packet.tokens) == step["tokens"]
            endpoint.sent(packet, step["at"])
    found = [endpoint.commands.find(kind, record_id) for kind, record_id, *_ in case["commands"]]
    assert [[c.kind, c.record_id, str(c.state), c.times_sent, c.due_s] for c in found if c] == case["commands"]
    assert [c.record_id for c in endpoint.commands.expire(1e9)] == case["expired"]


CONVERSIONS: dict[str, Callable[[bytes], object]] = {
    "v1_receiver": migration.v1_receiver_parts,
    "paper_receiver": migration.paper_receiver_parts,
    "authentication": migration.authentication_parts,
    "endpoint": migration.endpoint_parts,
}


@given(st.data(), st.sampled_from(sorted(CONVERSIONS)))
def test_a_malformed_state_raises_a_frame_error_or_converts(data: st.DataObject, name: str) -> None:
    state = msgpack.unpackb(bytes.fromhex(golden(name)["state"]), strict_map_key=False)
    replace_a_value(state, data)
    with suppress(FrameError):
        CONVERSIONS[name](msgpack.packb(state))
