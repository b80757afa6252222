"""The receiver of the paper format: golden scenarios, and each rule."""

import dataclasses
import json
import math
from typing import Any

import msgpack
import pytest
from builders.common import GOLDEN_FOLDER
from builders.link_state import field_names, group, plain_of, with_fields
from builders.paper_images import body_of, header_of, received_of

from sonarpost.codec.interface import StreamHeader
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame, HalfFrame, format_image_id, half_bounds
from sonarpost.link.frames.paper.receiver import ImageCandidate, PaperReceiver, PaperReceiverCounts, PendingImage
from sonarpost.link.receiver import Event, FrameRejected, ImageUpdate, received_mask

GOLDEN = json.loads((GOLDEN_FOLDER / "link" / "paper_receiver.json").read_text())["scenarios"]
HEADER = StreamHeader(0x10, 0xBEEF, 113, 49)
BODY = bytes(range(0xA1, 0xAA))
CONTACT = ContactSummary(height_px=113, width_px=49, lat_deg=44.7, lon_deg=-63.6).rounded()


def half(name: Any, image_id: str = "00A7", header: StreamHeader = HEADER, body: bytes = BODY) -> bytes:
    start, stop = half_bounds(len(body), name)
    return HalfFrame(name, image_id, start, len(body), header, body[start:stop]).pack()


def piece(start: int, stop: int, image_id: str = "00A7") -> bytes:
    name: Any = "top" if start < 5 else "bottom"
    return HalfFrame(name, image_id, start, 9, HEADER, BODY[start:stop]).pack()


def contact(image_id: str = "00A7", record: ContactSummary = CONTACT) -> bytes:
    return ContactFrame(image_id, record).pack()


def images(events: list[Event]) -> list[ImageUpdate]:
    """Return the events, which must all be images with a stream."""
    updates = [e for e in events if isinstance(e, ImageUpdate) and e.stream]
    assert len(updates) == len(events)
    return updates


def contacts_only(events: list[Event]) -> list[ImageUpdate]:
    """Return the events, which must all be contact records without a stream."""
    updates = [e for e in events if isinstance(e, ImageUpdate) and not e.stream]
    assert len(updates) == len(events)
    return updates


def describe(event: Event) -> dict[str, Any]:
    """Return the event as in the golden files."""
    match event:
        case ImageUpdate() if event.stream:
            return {
                "event": "image",
                "source": event.source,
                "image_id": event.image_id,
                "version": event.version,
                "body": body_of(event).hex(),
                "received": [list(r) for r in received_of(event)],
                "missing_halves": list(event.missing_halves),
                "complete": event.complete,
                "has_contact": event.contact is not None,
                "frames": event.frames,
                "conflicts": event.conflicts,
            }
        case ImageUpdate():
            assert event.contact is not None
            assert (event.complete, event.missing_halves) == (False, ("top", "bottom"))
            return {
                "event": "contact",
                "source": event.source,
                "image_id": event.image_id,
                "version": event.version,
                "conflicts": event.conflicts,
            }
        case FrameRejected():
            return {"event": "rejected", "source": event.source, "field": event.reason.field}
    raise AssertionError(event)


@pytest.mark.parametrize("case", GOLDEN, ids=[c["name"] for c in GOLDEN])
def test_golden_scenarios(case: dict[str, Any]) -> None:
    receiver = PaperReceiver(case["timeout_s"])
    for step in case["steps"]:
        if "frame" in step:
            events = receiver.accept(step["source"], bytes.fromhex(step["frame"]), step["at"])
        else:
            events = receiver.poll(step["at"])
        assert [describe(e) for e in events] == step["events"], step


def test_update_has_times_stream_and_mask() -> None:
    receiver = PaperReceiver(60)
    assert receiver.accept(2, piece(0, 2), 10) == []
    assert receiver.accept(2, contact(), 11) == []
    assert receiver.accept(2, piece(5, 8), 12) == []
    assert receiver.next_deadline() == 72
    (event,) = images(receiver.poll(72))
    assert (event.first_frame_s, event.last_frame_s) == (10, 12)
    assert event.contact == CONTACT
    assert event.stream == HEADER.pack() + BODY[:2] + bytes(3) + BODY[5:8] + bytes(1)
    assert received_mask(event.stream, event.missing).tolist() == [n in (0, 1, 5, 6, 7) for n in range(9)]
    assert event.missing_halves == ()
    assert receiver.next_deadline() is None


def test_timeout_starts_at_the_last_frame_with_new_content() -> None:
    receiver = PaperReceiver(60)
    receiver.accept(2, piece(0, 2), 0)
    receiver.accept(2, piece(2, 3), 50)
    receiver.accept(2, piece(0, 3), 100)  # a duplicate
    assert receiver.next_deadline() == 110
    assert receiver.poll(109.9) == []
    (event,) = images(receiver.poll(110))
    assert received_of(event) == ((0, 3),)
    assert receiver.counts.duplicates == 1


def test_accept_reports_due_images_first() -> None:
    receiver = PaperReceiver(60)
    receiver.accept(2, half("top"), 0)
    first, second = images(receiver.accept(2, half("bottom"), 1000))
    assert (first.version, first.complete) == (1, False)
    assert (second.version, second.complete, body_of(second)) == (2, True, BODY)


def test_late_frame_does_not_report_the_open_image() -> None:
    receiver = PaperReceiver(60)
    receiver.accept(2, half("top", "00A7"), 0)
    (old,) = images(receiver.accept(2, half("top", "00A8"), 1))
    assert old.image_id == "00A7"
    (late,) = images(receiver.accept(2, half("bottom", "00A7"), 2))
    assert (late.image_id, late.version, late.complete) == ("00A7", 2, True)
    (new,) = images(receiver.accept(2, half("bottom", "00A8"), 3))
    assert (new.image_id, new.version, new.complete) == ("00A8", 1, True)


def test_image_reopened_by_a_late_frame_is_reported_with_the_next_image() -> None:
    receiver = PaperReceiver(60)
    receiver.accept(2, piece(0, 2), 0)
    assert [e.version for e in images(receiver.accept(2, half("top", "00A8"), 1))] == [1]
    assert receiver.accept(2, piece(2, 3), 2) == []
    given = images(receiver.accept(2, half("top", "00A9"), 3))
    assert [(e.image_id, e.version) for e in given] == [("00A8", 1), ("00A7", 2)]


def test_half_frame_of_another_image_does_not_report_a_contact_record() -> None:
    receiver = PaperReceiver(60)
    receiver.accept(2, contact("00A7"), 0)
    assert receiver.accept(2, half("top", "00A8"), 1) == []
    (event,) = contacts_only(receiver.poll(60))
    assert event.image_id == "00A7"


def test_different_second_contact_record_is_a_conflict() -> None:
    receiver = PaperReceiver(60)
    other = dataclasses.replace(CONTACT, lat_deg=45.0)
    receiver.accept(2, contact(), 0)
    receiver.accept(2, contact(record=other), 1)
    receiver.accept(2, contact(), 2)
    (event,) = contacts_only(receiver.poll(60))
    assert event.contact == CONTACT
    assert event.conflicts == 1
    assert receiver.counts == PaperReceiverCounts(frames=3, duplicates=2, conflicts=1, contacts_only=1)


def test_received_bytes_stay_when_a_repetition_differs() -> None:
    receiver = PaperReceiver(60)
    receiver.accept(2, piece(0, 3), 0)
    damaged = HalfFrame("top", "00A7", 1, 9, HEADER, b"\xa2\x00\xa4\xa5").pack()
    receiver.accept(2, damaged, 1)
    (event,) = images(receiver.poll(61))
    assert body_of(event) == BODY[:5] + bytes(4)
    assert (event.frames, event.conflicts) == (2, 1)


def test_contact_record_decides_between_stream_headers() -> None:
    wrong = StreamHeader(0x10, 0xBEEF, 113, 48)
    receiver = PaperReceiver(60)
    receiver.accept(2, HalfFrame("top", "00A7", 0, 9, wrong, BODY[:2]).pack(), 0)
    receiver.accept(2, HalfFrame("top", "00A7", 2, 9, wrong, BODY[2:4]).pack(), 1)
    receiver.accept(2, half("top"), 2)
    assert receiver.accept(2, contact(), 3) == []
    (event,) = images(receiver.poll(63))
    assert header_of(event) == HEADER
    assert event.frames == 1


def test_more_frames_win_over_more_bytes() -> None:
    wrong = StreamHeader(0x10, 0xBEEF, 113, 48)
    receiver = PaperReceiver(60)
    receiver.accept(2, half("top", header=wrong), 0)
    receiver.accept(2, piece(0, 1), 1)
    receiver.accept(2, piece(1, 2), 2)
    (event,) = images(receiver.poll(62))
    assert (header_of(event), received_of(event)) == (HEADER, ((0, 2),))


def test_outvoted_header_is_corrected_by_a_new_version() -> None:
    wrong = StreamHeader(0x10, 0xBEEF, 113, 48)
    receiver = PaperReceiver(60)
    receiver.accept(2, half("top", header=wrong), 0)
    assert [header_of(e) for e in images(receiver.poll(60))] == [wrong]
    assert receiver.accept(2, half("top"), 61) == []  # a draw: the first header stays, nothing to report
    assert receiver.next_deadline() is None
    (event,) = images(receiver.accept(2, half("bottom"), 62))
    assert (event.version, header_of(event), body_of(event), event.complete) == (2, HEADER, BODY, True)


@pytest.mark.parametrize("changed", ["width", "length"])
def test_fourth_stream_header_or_body_length_is_rejected(changed: str) -> None:
    receiver, found = PaperReceiver(60), []
    for n in range(4):
        header = dataclasses.replace(HEADER, width_px=49 + n) if changed == "width" else HEADER
        length = 9 + n if changed == "length" else 9
        found.append(receiver.accept(2, HalfFrame("top", "00A7", 0, length, header, b"x").pack(), 0))
    assert found[:3] == [[]] * 3
    [event] = found[3]
    assert isinstance(event, FrameRejected)
    assert (event.source, changed == "width" and event.reason.field) in ((2, "stream header"), (2, False))
    assert receiver.counts == PaperReceiverCounts(frames=4, rejected=1, conflicts=3)


@pytest.mark.parametrize("length", [0, 1])
def test_image_without_a_bottom_half_is_complete_with_its_top(length: int) -> None:
    receiver = PaperReceiver(60)
    (event,) = images(receiver.accept(2, half("top", body=BODY[:length]), 0))
    assert (event.complete, body_of(event), event.missing_halves) == (True, BODY[:length], ())


def test_frame_without_body_bytes_announces_the_image() -> None:
    receiver = PaperReceiver(60)
    receiver.accept(2, half("bottom")[:16], 0)
    (event,) = images(receiver.poll(60))
    assert (received_of(event), body_of(event), event.missing_halves) == ((), bytes(9), ("top", "bottom"))
    assert received_mask(event.stream, event.missing).tolist() == [False] * 9


def test_identifier_reused_after_memory_s_is_a_new_image() -> None:
    receiver = PaperReceiver(60, memory_s=3600)
    receiver.accept(2, half("top"), 0)
    receiver.accept(2, half("bottom"), 1)
    assert receiver.accept(2, half("top"), 3601) == []
    assert receiver.counts.duplicates == 1  # memory_s starts again here
    assert receiver.accept(2, half("top"), 7202) == []
    (event,) = images(receiver.accept(2, half("bottom"), 7203))
    assert (event.version, event.first_frame_s, event.complete) == (1, 7202, True)


def test_clock_set_back_does_not_delay_an_image() -> None:
    receiver = PaperReceiver(60)
    receiver.accept(2, half("top"), 1_000_000)
    assert receiver.poll(500) == []
    restarted = PaperReceiver(60)
    assert not restarted.restore(receiver.parts())
    for each in (receiver, restarted):
        assert each.next_deadline() == 560
        assert len(images(each.poll(560))) == 1


def test_clock_set_back_does_not_extend_the_memory() -> None:
    receiver = PaperReceiver(60, memory_s=3600)
    receiver.accept(2, half("top"), 1_000_000)
    receiver.accept(2, half("bottom"), 1_000_000)
    receiver.poll(500)
    receiver.accept(2, half("top"), 4101)
    (event,) = images(receiver.accept(2, half("bottom"), 4102))
    assert event.version == 1


def test_memory_is_bounded_and_deleted_images_are_reported() -> None:
    receiver = PaperReceiver(60, max_images=4)
    events: list[Event] = []
    for number in range(50):
        frame = HalfFrame("top", format_image_id(number), 0, 65535, HEADER, b"x").pack()
        events += receiver.accept(number, frame, number / 100)
    assert [e.source for e in images(events)] == list(range(46))  # the least recently seen first
    assert len(group(receiver.parts(), "image")) == 4
    assert receiver.counts.evicted == 46
    assert sorted(e.source for e in images(receiver.poll(100))) == [46, 47, 48, 49]


def test_images_of_the_source_with_the_most_are_deleted_first() -> None:
    receiver = PaperReceiver(60, max_images=4)
    receiver.accept(1, half("top"), 0)
    for number in range(50):
        frame = HalfFrame("top", format_image_id(number), 0, 65535, HEADER, b"x").pack()
        receiver.accept(9, frame, 1 + number / 100)
    (event,) = images(receiver.accept(1, half("bottom"), 2))
    assert (event.source, event.complete) == (1, True)


def test_reported_images_are_deleted_before_open_ones() -> None:
    receiver = PaperReceiver(60, max_images=2)
    receiver.accept(1, half("top"), 0)
    receiver.accept(2, half("top"), 1)
    assert len(images(receiver.accept(2, half("bottom"), 2))) == 1
    assert receiver.accept(3, half("top"), 3) == []
    # This deleted the image of source 2, although it was seen after that of source 1.
    (event,) = images(receiver.accept(1, half("bottom"), 4))
    assert (event.source, event.version, event.complete) == (1, 1, True)


def test_memory_of_contact_records_is_bounded() -> None:
    receiver = PaperReceiver(60, max_images=3)
    events = [e for n in range(10) for e in receiver.accept(2, contact(format_image_id(n)), n / 10)]
    assert [e.image_id for e in contacts_only(events)] == [format_image_id(n) for n in range(7)]


@pytest.mark.parametrize(
    "settings",
    [
        {"timeout_s": 0},
        {"timeout_s": math.nan},
        {"timeout_s": 60, "memory_s": 59},
        {"timeout_s": 60, "memory_s": math.nan},
        {"timeout_s": 60, "max_images": 0},
    ],
)
def test_invalid_settings_are_rejected(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="timeout_s > 0"):
        PaperReceiver(**settings)


def busy_receiver() -> PaperReceiver:
    receiver = PaperReceiver(60)
    receiver.accept(2, half("top"), 0)
    receiver.accept(2, half("bottom"), 1)
    receiver.accept(2, contact("00A8"), 2)
    receiver.accept(2, piece(6, 8, "00A9"), 3)
    receiver.accept(3, half("top", header=dataclasses.replace(HEADER, width_px=50)), 4)
    receiver.accept(3, half("top"), 4)
    return receiver


IMAGE = "image/2/00A7"


def _wrong_fields() -> list[tuple[str, dict[str, Any]]]:
    """Return wrong values for the fields of a state, as part and fields."""
    plain = plain_of(busy_receiver().parts(), IMAGE)
    candidates = plain[field_names(PendingImage).index("candidates")]
    candidate = dict(zip(field_names(ImageCandidate)[1:], candidates[0], strict=True))
    wrong_candidates: list[Any] = [
        7,
        {"header": b"\x10sh"},
        {"header": HEADER.pack() + b"\0"},
        {"header": b"\x10\xbe\xef\xe1"},
        {"body": packed_body(8, [5, bytes(5)])},
        {"body": packed_body(9, [3, b"x"], [0, b"x"])},
    ]
    values: list[tuple[str, Any]] = [
        ("image_id", "a7"),
        ("wait_from_s", math.nan),
        ("candidates", []),
        ("candidates", [candidate] * 4),
        *(("candidates", [{**candidate, **c} if isinstance(c, dict) else c]) for c in wrong_candidates),
        ("contact", bytes(24)),
        ("reported", [0, 9]),
    ]
    return [*((IMAGE, {name: value}) for name, value in values), ("counts", {"format version": 3})]


def packed_body(length: int, *pieces: object) -> bytes:
    data: bytes = msgpack.packb([length, list(pieces)])
    return data


@pytest.mark.parametrize(("name", "change"), _wrong_fields(), ids=str)
def test_a_malformed_part_is_reported_and_the_others_are_restored(name: str, change: dict[str, Any]) -> None:
    parts = busy_receiver().parts()
    receiver = PaperReceiver(60)
    errors = receiver.restore(
        with_fields(parts, name, PaperReceiverCounts if name == "counts" else PendingImage, change)
    )
    assert list(errors) == [name]
    assert str(errors[name]).startswith(f"paper receiver state: {name}: ")
    kept = {part: data for part, data in parts.items() if part != name}
    assert {part: data for part, data in receiver.parts().items() if part in kept} == kept
    assert (IMAGE in receiver.parts()) == (name != IMAGE)
