"""Golden files of the v1 format: packed bytes, parsed fields, events."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from builders import v1_golden

from sonarpost.errors import FrameError
from sonarpost.link.coding import erasure_code as fec
from sonarpost.link.coding.erasure_code import Layering, recover_layer, recover_layering
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame
from sonarpost.link.frames.paper.frame import parse_frame as parse_paper_frame
from sonarpost.link.frames.v1.frame import parse_frame
from sonarpost.link.frames.v1.payload_objects import MessageObject, PieceList, Preview, unpack_object
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.receiver import ImageUpdate


def golden(name: str) -> Any:
    return json.loads((v1_golden.FOLDER / f"{name}.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["classified", "frames", "codes", "objects"])
def test_packed_bytes_equal_the_golden_files(name: str) -> None:
    assert json.loads(json.dumps(v1_golden.MAKERS[name]())) == golden(name)


def test_golden_frames_parse() -> None:
    read = golden("frames")
    for entry in read["frames"]:
        expected = {key: value for key, value in entry.items() if key != "frame"}
        assert v1_golden.describe_content(parse_frame(bytes.fromhex(entry["frame"]))) == expected
    for frame in read["refused"]:
        with pytest.raises(FrameError):
            parse_frame(bytes.fromhex(frame))


def test_golden_codes_recover() -> None:
    read = golden("codes")
    for block in read["blocks"]:
        source = np.frombuffer(bytes.fromhex(block["source"]), np.uint8).reshape(block["k"], -1)
        for index, symbol in block["symbols"]:
            assert fec.encode(source, [index])[0].tobytes().hex() == symbol
    layering = Layering.unpack(bytes.fromhex(read["layered"][0]["descriptor"]))
    symbols = read["layered"][0]["symbols"]
    assert recover_layering({i: value for i, value, _ in symbols}) == layering
    found = recover_layer(layering, 0, {i: bytes.fromhex(data) for i, _, data in symbols})
    assert found.hex() == read["layered"][0]["objects"][0]


def test_golden_objects_parse() -> None:
    read = golden("objects")
    for entry in read["previews"]:
        preview = Preview.unpack(bytes.fromhex(entry["entry"]))
        assert (preview.number, preview.prefix.hex(), preview.ended) == (
            entry["number"],
            entry["prefix"],
            entry["ended"],
        )
        assert preview.link == entry["link"]
    below: PieceList | None = None
    for entry, follows in zip(read["pieces"], (False, True, False), strict=True):
        pieces = unpack_object(bytes.fromhex(entry["object"]), below.ends if below and follows else None)
        assert isinstance(pieces, PieceList)
        assert [[p.number, p.link, p.start, p.data.hex()] for p in pieces.pieces] == entry["pieces"]
        assert pieces.final == entry["final"]
        below = pieces
    (entry,) = read["messages"]
    assert unpack_object(bytes.fromhex(entry["object"])) == MessageObject(entry["number"], bytes.fromhex(entry["data"]))


def test_golden_classified_records_parse() -> None:
    read = golden("classified")
    records = {}
    for entry in read["records"]:
        record = ContactSummary.unpack(bytes.fromhex(entry["record"]))
        assert v1_golden.describe_record(record) == entry["values"], entry["name"]
        assert record.pack().hex() == entry["record"]
        records[entry["name"]] = record
    for entry in read["refused"]:
        with pytest.raises(FrameError):
            ContactSummary.unpack(bytes.fromhex(entry["record"]))
    assert parse_paper_frame(bytes.fromhex(read["paper"])) == ContactFrame("00A7", records["everything"])
    receiver = V1Receiver()
    events = [event for frame in read["frames"] for event in receiver.accept(3, bytes.fromhex(frame), 0.0)]
    updates = [event for event in events if isinstance(event, ImageUpdate)]
    assert [update.contact for update in updates] == [records["everything"], records["class only"]]


def test_golden_exchange_gives_the_same_events() -> None:
    read, receiver = golden("exchange"), V1Receiver()
    for step in read["steps"]:
        events = receiver.accept(step["source"], bytes.fromhex(step["frame"]), step["at"])
        assert [v1_golden.describe_event(e) for e in events] == step["events"], step["at"]
    for source, feedback in read["reports"].items():
        found = receiver.feedback(int(source), float(len(read["steps"])))
        assert found is not None
        assert found.pack().hex() == feedback
