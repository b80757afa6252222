"""Content of the v1 golden files; `PYTHONPATH=tests python -m builders.v1_golden` adds missing ones.

Existing files are not written again: bytes of a wire format can be added, never changed.
"""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from builders.common import GOLDEN_FOLDER
from sonarpost.link.coding import erasure_code as fec
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.coding.erasure_code import Layering, layered_symbols
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame
from sonarpost.link.frames.v1.frame import (
    Content,
    Segment,
    SegmentKind,
    Symbol,
    SymbolKind,
    checksum,
    pack_segments,
    pack_symbol,
)
from sonarpost.link.frames.v1.payload_objects import (
    Feedback,
    MessageObject,
    PieceList,
    Preview,
    RefineRequest,
    StreamPiece,
    pack_mini,
)
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import Event, FeedbackReceived, FrameRejected, ImageUpdate, MessageReceived
from sonarpost.sonar.survey import Side

FOLDER = GOLDEN_FOLDER / "acoustic-v1"
CONTACT = ContactSummary(
    height_px=113,
    width_px=49,
    lat_deg=44.7123456,
    lon_deg=-63.654321,
    time_utc_s=1476612000,
    confidence=1.7,
    heading_deg=120,
    altitude_m=12.5,
    depth_m=12.3,
    side=Side.STARBOARD,
    ground_range_m=33.3,
    pixel_along_m=0.25,
    pixel_across_m=0.1,
    position_sigma_m=3.1,
)

CLASSIFIED = {
    "everything": replace(CONTACT, atd_class="mine-like", p_mine_like=0.83, p_other_object=0.12),
    "class only": ContactSummary(atd_class="structure"),
    "clutter": replace(CONTACT, atd_class="clutter", p_mine_like=0.0, p_other_object=1.0),
    "probabilities only": ContactSummary(p_mine_like=0.0, p_other_object=0.0),
    "last codes": ContactSummary(512, 512, 90.0, 180.0, atd_class="structure", p_mine_like=1.0, p_other_object=0.0),
    "first codes": ContactSummary(16, 16, -90.0, -180.0, atd_class="mine-like", p_mine_like=0.0, p_other_object=0.05),
}
"""Records of the classified layout by name."""


def counted(length: int, first: int = 1) -> bytes:
    return bytes((first + i) % 256 for i in range(length))


def describe_content(content: Content) -> dict[str, Any]:
    if isinstance(content, Symbol):
        return {
            "kind": content.kind.name,
            "block": content.block,
            "index": content.index,
            "parameter": content.parameter,
            "data": content.data.hex(),
        }
    return {"segments": [{"kind": int(s.kind), "data": s.data.hex()} for s in content]}


def describe_event(event: Event) -> dict[str, Any]:
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


def frames() -> dict[str, Any]:
    preview = Preview(7, CONTACT, counted(30))
    contents: list[tuple[Content, int]] = [
        (Symbol(SymbolKind.OBJECT, 5, 17, 40, counted(59)), 64),
        (Symbol(SymbolKind.LAYERED, 31, 254, 0, counted(27, 200)), 32),
        (Symbol(SymbolKind.PREVIEW, 0, 0, 24, preview.pack(59)), 64),
        (Symbol(SymbolKind.OBJECT, 1, 2, 3, counted(200) + bytes(51)), 256),
        ((Segment(SegmentKind.CONTACT, Preview(7, CONTACT, b"").pack(29)),), 32),
        (
            (
                Segment(SegmentKind.MESSAGE, b"\x09go to 12"),
                Segment(SegmentKind.CONTACT, Preview(8, CONTACT, b"").pack(29)),
            ),
            64,
        ),
        ((Segment(SegmentKind.PREVIEW, Preview(9, CONTACT, counted(20)).pack(49)),), 64),
        ((Segment(SegmentKind.SYMBOL, Symbol(SymbolKind.OBJECT, 4, 3, 2, counted(27)).head() + counted(27)),), 64),
        ((Segment(SegmentKind.FEEDBACK, Feedback(3, 1000, (12, 0, 255)).pack()),), 32),
        ((Segment(SegmentKind.REQUEST, RefineRequest(7, 700).pack()),), 32),
    ]
    good = [
        {"frame": (pack_symbol(c) if isinstance(c, Symbol) else pack_segments(c, size)).hex(), **describe_content(c)}
        for c, size in contents
    ]
    first = bytes.fromhex(good[0]["frame"])
    padded = [{"frame": (first + bytes(n)).hex(), **describe_content(contents[0][0])} for n in (1, 192)]
    wrong = [bytes(64), first[:40], first[:50] + bytes(14), first[:-1] + bytes([first[-1] ^ 1])]
    for covered in (b"\x05\xff\x28data", b"\x05\x11\x00data", b"\x41\x09abc", b"\x40\x01a", b"\x80\x11\x28data"):
        wrong.append(checksum(covered).to_bytes(2, "big") + covered)
    return {"frames": good + padded, "refused": [frame.hex() for frame in wrong]}


def codes() -> dict[str, Any]:
    blocks = []
    for count, length in ((1, 3), (4, 2), (24, 3), (120, 1)):
        source = np.frombuffer(counted(count * length, 7), np.uint8).reshape(count, length)
        indices = [0, count - 1, count, (2 * count) % 255, 253, 254]
        made = fec.encode(source, indices)
        symbols = [[i, row.tobytes().hex()] for i, row in zip(indices, made, strict=True)]
        blocks.append({"k": count, "source": source.tobytes().hex(), "symbols": symbols})
    layered = []
    for layering in (Layering(4, 0, (16,)), Layering(5, 3, (4, 12)), Layering(6, 2, (3, 3, 4, 6))):
        objects = [counted(n, 30 * i) for i, n in enumerate(layering.lengths(27))]
        indices = [0, 5, 100, 254]
        made_symbols = layered_symbols(layering, objects, indices)
        layered.append(
            {
                "needs": list(layering.required_symbols),
                "bounds": list(layering.bounds(27)),
                "descriptor": layering.pack().hex(),
                "objects": [data.hex() for data in objects],
                "symbols": [
                    [i, descriptor, data.hex()] for i, (descriptor, data) in zip(indices, made_symbols, strict=True)
                ],
            }
        )
    return {"blocks": blocks, "layered": layered}


def objects() -> dict[str, Any]:
    base = PieceList((StreamPiece(65535, 9, 30, counted(140)), StreamPiece(1, 8, 30, counted(3))), final=False)
    above = PieceList((StreamPiece(65535, 9, 170, counted(2)), StreamPiece(1, 8, 33, b"")), final=True)
    apart = PieceList((StreamPiece(7, 1, 0, counted(5)), StreamPiece(9, 2, 300, counted(4))), final=True)
    return {
        "previews": [
            {"number": p.number, "prefix": p.prefix.hex(), "ended": p.ended, "link": p.link, "entry": p.pack(59).hex()}
            for p in (Preview(7, CONTACT, counted(30)), Preview(300, ContactSummary(), counted(11), ended=True))
        ],
        "record": CONTACT.pack().hex(),
        "pieces": [
            {
                "pieces": [[p.number, p.link, p.start, p.data.hex()] for p in g.pieces],
                "final": g.final,
                "object": data.hex(),
            }
            for g, data in ((base, base.pack(180)), (above, above.pack(14, base.ends)), (apart, apart.pack(40)))
        ],
        "messages": [
            {"number": 200, "data": counted(20).hex(), "object": MessageObject(200, counted(20)).pack(54).hex()}
        ],
        "minipackets": [[block, needed, pack_mini(block, needed)] for block, needed in ((0, 0), (5, 17), (31, 255))],
    }


def exchange() -> dict[str, Any]:
    """Return frames with times, and the events of a receiver."""
    steps: list[dict[str, Any]] = []
    receiver, rng = V1Receiver(), np.random.default_rng(1)
    for channels, size in (
        ((LossChannel(0.2),), 64),
        ((LossChannel(0.05), LossChannel(0.6)), 64),
        ((LossChannel(0.2),), 32),
    ):
        sender = V1Sender(SenderConfig(frame_bytes=size, channels=channels, frames_per_image=9.0), first_block=30)
        source = 3 + len(channels) + size
        for number in range(1, 7):
            length = 250 if number % 2 else 12
            record = ContactSummary(lat_deg=number / 10, lon_deg=-1.0)
            sender.add_image(number, record, counted(length, number), 0.0)
        sender.add_message(b"hello", 0.0, times=1)
        sender.add_message(counted(150), 0.0)
        while (frame := sender.next_frame(0.0)) is not None:
            if rng.random() < 0.25:
                continue
            now = float(len(steps))
            events = receiver.accept(source, frame, now)
            steps.append(
                {"at": now, "source": source, "frame": frame.hex(), "events": [describe_event(e) for e in events]}
            )
    feedback = {
        str(source): message.pack().hex()
        for source in sorted({s["source"] for s in steps})
        if (message := receiver.feedback(source, float(len(steps)))) is not None
    }
    return {"steps": steps, "reports": feedback}


def classified() -> dict[str, Any]:
    """Return records of the classified layout, alone and in entries and frames, and records to refuse."""
    preview = Preview(7, CLASSIFIED["everything"], counted(30))
    contact = Preview(8, CLASSIFIED["class only"], b"").pack(29)
    head, tail = int.from_bytes(ContactSummary(atd_class="clutter").pack()[:11], "big"), ContactSummary().pack()[11:]
    changes = {
        "reserved probabilities": (0xFF << 77, 231 << 77),
        "nothing classified": (3 << 85, 0),
        "height alone": (0x1FF << 68, 79 << 68),
        "side of 15 px": (0x3FFFF << 59, 14 << 68 | 79 << 59),
        "latitude alone": (0x1FFFFFFF << 30, 0),
    }
    return {
        "records": [
            {"name": name, "record": record.pack().hex(), "values": describe_record(record.rounded())}
            for name, record in CLASSIFIED.items()
        ],
        "refused": [
            {"name": name, "record": (head & ~mask | bits).to_bytes(11, "big").hex() + tail.hex()}
            for name, (mask, bits) in changes.items()
        ],
        "paper": ContactFrame("00A7", CLASSIFIED["everything"]).pack().hex(),
        "frames": [
            pack_symbol(Symbol(SymbolKind.PREVIEW, 0, 0, 24, preview.pack(59))).hex(),
            pack_segments((Segment(SegmentKind.CONTACT, contact),), 32).hex(),
        ],
    }


def describe_record(record: ContactSummary) -> dict[str, Any]:
    return {name: value for name, value in asdict(record).items() if value is not None}


MAKERS = {"classified": classified, "frames": frames, "codes": codes, "objects": objects, "exchange": exchange}

if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, make in MAKERS.items():
        path = FOLDER / f"{name}.json"
        if not path.exists():
            path.write_text(json.dumps(make(), indent=1) + "\n", encoding="utf-8")
