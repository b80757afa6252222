"""The page that specifies the format agrees with the code."""

from __future__ import annotations

import re
import zlib

from builders.common import REPOSITORY

from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.coding.redundancy_plan import PREVIEWS_UNSEEN
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.frames.v1.feedback import WINDOW, Feedback
from sonarpost.link.frames.v1.frame import (
    BLOCKS,
    HEADER_BYTES,
    PADDED_LENGTHS,
    Segment,
    SegmentKind,
    Symbol,
    checksum,
    parse_frame,
)
from sonarpost.link.frames.v1.preview import Preview, entry_shape
from sonarpost.link.sender_messages import MAX_MESSAGE_BYTES

PAGE = (REPOSITORY / "docs" / "specifications" / "acoustic-v1.md").read_text(encoding="utf-8")


def test_the_examples_parse_to_what_the_page_says() -> None:
    lines = [bytes.fromhex(line) for line in re.findall(r"^(?:[0-9A-F]{2} ?){30,}$", PAGE, re.MULTILINE)]
    (contact,), (message, other), preview, (report,) = (parse_frame(line) for line in lines)
    assert isinstance(contact, Segment)
    assert Preview.unpack(contact.data).number == 7
    assert message == Segment(SegmentKind.MESSAGE, b"\x09go to 12")
    assert isinstance(other, Segment)
    assert Preview.unpack(other.data).number == 8
    assert isinstance(preview, Symbol)
    assert (preview.kind.name, preview.index, preview.parameter) == ("PREVIEW", 0, 24)
    assert Preview.unpack(preview.data).prefix == bytes(range(1, 31))
    assert Preview.unpack(preview.data).contact.lat_deg == 44.7123456
    assert isinstance(report, Segment)
    assert Feedback.unpack(report.data) == Feedback(3, 1000, (12, 0, 255))


def test_the_checksums_are_those_named() -> None:
    assert f"`123456789` it is 0x{checksum(b'123456789'):04X}" in PAGE
    assert f"`123456789` it is 0x{zlib.crc32(b'123456789'):08X}" in PAGE


def test_the_numbers_of_the_page_are_those_of_the_code() -> None:
    (said,) = re.findall(r"first ([\d, and]+) bytes, in this order", PAGE)
    assert tuple(map(int, re.findall(r"\d+", said))) == PADDED_LENGTHS
    assert f"has {HEADER_BYTES} bytes of header" in PAGE
    assert f"numbered 0\u2013{BLOCKS - 1}" in PAGE
    assert f"At most {WINDOW} successive numbers" in " ".join(PAGE.split())
    assert f"up to {MAX_MESSAGE_BYTES} bytes" in PAGE
    assert f"a frame of at most {2 + 2 + 3 + WINDOW} bytes" in PAGE
    assert f"at most {100 * PREVIEWS_UNSEEN:g} % of contacts" in PAGE
    sender, receiver = SenderConfig(channels=(LossChannel(0.3),)), ReceiverConfig()
    assert f"with 6 frames a picture {sender.group_size}," in PAGE
    assert f"at most {sender.block_symbols} source symbols" in PAGE
    assert f"up to {100 * sender.uncertainty:g} % wrong" in PAGE
    assert f"after {receiver.feedback_interval_frames} frames or a minute" in PAGE
    assert (receiver.feedback_interval_s, receiver.block_memory_s) == (60.0, 3600.0)
    for kind in SegmentKind:
        if kind != SegmentKind.END:
            assert f"| {int(kind)} {kind.name.lower()} |" in PAGE


def test_the_table_of_entries_is_the_rule_of_the_code() -> None:
    for s in range(22, 252):
        shape, entries = entry_shape(s), max(1, s // 56)
        expected = (1, 2, 2 * s) if s <= 43 else (entries, 1, s // entries)
        assert (shape.entries, shape.symbols, shape.entry_bytes) == expected
