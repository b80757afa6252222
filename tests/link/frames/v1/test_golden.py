"""Golden files of the v1 format: the bytes give the fields, and the fields the same bytes; events of an exchange.

Bytes of a wire format can be added to the files, never changed.
"""

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER

from sonarpost.errors import FrameError
from sonarpost.link.coding import erasure_code as fec
from sonarpost.link.coding.erasure_code import Layering, layered_symbols, recover_layer, recover_layering
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame
from sonarpost.link.frames.paper.frame import parse_frame as parse_paper_frame
from sonarpost.link.frames.v1.frame import Content, Segment, Symbol, SymbolKind, pack_segments, pack_symbol, parse_frame
from sonarpost.link.frames.v1.payload_objects import (
    Feedback,
    MessageObject,
    PieceList,
    Preview,
    unpack_mini,
    unpack_object,
)
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.receiver import Event, FeedbackReceived, FrameRejected, ImageUpdate, MessageReceived


def golden(name: str) -> Any:
    return json.loads((GOLDEN_FOLDER / "acoustic-v1" / f"{name}.json").read_text(encoding="utf-8"))


def content_of(entry: dict[str, Any]) -> Content:
    if "segments" in entry:
        return tuple(Segment(segment["kind"], bytes.fromhex(segment["data"])) for segment in entry["segments"])
    kind, data = SymbolKind[entry["kind"]], bytes.fromhex(entry["data"])
    return Symbol(kind, entry["block"], entry["index"], entry["parameter"], data)


def test_golden_frames() -> None:
    read = golden("frames")
    for entry in read["frames"]:
        frame, content = bytes.fromhex(entry["frame"]), content_of(entry)
        assert parse_frame(frame) == content
        packed = pack_symbol(content) if isinstance(content, Symbol) else pack_segments(content, len(frame))
        assert frame == packed.ljust(len(frame), b"\0")
    for frame in read["refused"]:
        with pytest.raises(FrameError):
            parse_frame(bytes.fromhex(frame))


def test_golden_codes() -> None:
    read = golden("codes")
    for block in read["blocks"]:
        source = np.frombuffer(bytes.fromhex(block["source"]), np.uint8).reshape(block["k"], -1)
        for index, symbol in block["symbols"]:
            assert fec.encode(source, [index])[0].tobytes().hex() == symbol
    for entry in read["layered"]:
        layering = Layering.unpack(bytes.fromhex(entry["descriptor"]))
        assert layering.pack().hex() == entry["descriptor"]
        assert [*layering.required_symbols] == entry["needs"]
        assert [*layering.bounds(27)] == entry["bounds"]
        objects = [bytes.fromhex(data) for data in entry["objects"]]
        made = layered_symbols(layering, objects, [index for index, *_ in entry["symbols"]])
        assert [[value, data.hex()] for value, data in made] == [symbol[1:] for symbol in entry["symbols"]]
        assert recover_layering({index: value for index, value, _ in entry["symbols"]}) == layering
    symbols = {index: bytes.fromhex(data) for index, _, data in read["layered"][0]["symbols"]}
    assert recover_layer(Layering(4, 0, (16,)), 0, symbols).hex() == read["layered"][0]["objects"][0]


def test_golden_objects() -> None:
    read = golden("objects")
    for entry, record in zip(read["previews"], (read["record"], ContactSummary().pack().hex()), strict=True):
        preview = Preview.unpack(bytes.fromhex(entry["entry"]))
        fields = {"number": preview.number, "prefix": preview.prefix.hex(), "ended": preview.ended}
        assert fields | {"link": preview.link, "entry": preview.pack(59).hex()} == entry
        assert preview.contact.pack().hex() == record
    below: PieceList | None = None
    for entry, follows in zip(read["pieces"], (False, True, False), strict=True):
        ends, packed = below.ends if below and follows else None, bytes.fromhex(entry["object"])
        pieces = unpack_object(packed, ends)
        assert isinstance(pieces, PieceList)
        assert [[p.number, p.link, p.start, p.data.hex()] for p in pieces.pieces] == entry["pieces"]
        assert pieces.final == entry["final"]
        assert pieces.pack(len(packed), ends) == packed
        below = pieces
    (entry,) = read["messages"]
    message, packed = MessageObject(entry["number"], bytes.fromhex(entry["data"])), bytes.fromhex(entry["object"])
    assert unpack_object(packed) == message
    assert message.pack(len(packed)) == packed
    for block, needed, bits in read["minipackets"]:
        assert unpack_mini(bits) == Feedback(block, None, (needed,))


def test_golden_classified_records() -> None:
    read = golden("classified")
    records = {}
    for entry in read["records"]:
        record = ContactSummary.unpack(bytes.fromhex(entry["record"]))
        assert {name: value for name, value in asdict(record).items() if value is not None} == entry["values"]
        assert record.pack().hex() == ContactSummary(**entry["values"]).pack().hex() == entry["record"]
        records[entry["name"]] = record
    for entry in read["refused"]:
        with pytest.raises(FrameError):
            ContactSummary.unpack(bytes.fromhex(entry["record"]))
    contact = ContactFrame("00A7", records["everything"])
    assert parse_paper_frame(bytes.fromhex(read["paper"])) == contact
    assert contact.pack().hex() == read["paper"]
    receiver = V1Receiver()
    events = [event for frame in read["frames"] for event in receiver.accept(3, bytes.fromhex(frame), 0.0)]
    updates = [event for event in events if isinstance(event, ImageUpdate)]
    assert [update.contact for update in updates] == [records["everything"], records["class only"]]


def describe(event: Event) -> dict[str, Any]:
    match event:
        case ImageUpdate():
            return {
                "contact": number_of_image(event.image_id),
                "version": event.version,
                "record": event.contact.pack().hex() if event.contact else "",
                "stream": event.stream.hex(),
                "complete": event.complete,
            }
        case MessageReceived():
            return {"message": event.number, "data": event.data.hex()}
        case FeedbackReceived(feedback=feedback):
            return {"report": type(feedback).__name__, "data": feedback.pack().hex()}
        case FrameRejected():
            return {"refused": event.reason.field}


def test_golden_exchange_gives_the_same_events() -> None:
    read, receiver = golden("exchange"), V1Receiver()
    for step in read["steps"]:
        events = receiver.accept(step["source"], bytes.fromhex(step["frame"]), step["at"])
        assert [describe(e) for e in events] == step["events"], step["at"]
    for source, feedback in read["reports"].items():
        found = receiver.feedback(int(source), float(len(read["steps"])))
        assert found is not None
        assert found.pack().hex() == feedback
