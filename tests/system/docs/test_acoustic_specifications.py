"""The examples of docs/specifications/acoustic-paper.md and acoustic-v1.md: bytes and packet plans."""

import re
import zlib

import pytest
from builders.common import REPOSITORY

from sonarpost.codec.interface import StreamHeader, tag_length
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import HALF_PREFIX_SIZE, ContactFrame, HalfFrame
from sonarpost.link.frames.paper.frame import parse_frame as parse_paper_frame
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, Symbol, checksum, parse_frame
from sonarpost.link.frames.v1.payload_objects import Feedback, Preview, entry_shape

SPECIFICATIONS = REPOSITORY / "docs" / "specifications"
PAPER = (SPECIFICATIONS / "acoustic-paper.md").read_text(encoding="utf-8")
V1 = (SPECIFICATIONS / "acoustic-v1.md").read_text(encoding="utf-8")
RATES = {0: (1, 32), 1: (3, 64), 2: (3, 64), 3: (2, 256), 4: (2, 256), 5: (8, 256), 6: (6, 32)}


def test_paper_example_frames_parse_to_the_stated_fields():
    lines = re.findall(r"^(?:[0-9A-F]{2} ?){15,}$", PAPER, re.MULTILINE)
    top, bottom, common_top, common_bottom, contact, nothing, classified = (
        parse_paper_frame(bytes.fromhex(line)) for line in lines
    )
    header, common = StreamHeader(0x10, 0xBEEF, 113, 49), StreamHeader(0x10, 0xBEEF, 140, 80)
    assert top == HalfFrame("top", "00A7", 0, 9, header, bytes(range(0xA1, 0xA6)))
    assert bottom == HalfFrame("bottom", "00A7", 5, 9, header, bytes(range(0xA6, 0xAA)))
    assert common_top == HalfFrame("top", "00A8", 0, 9, common, bytes(range(0xA1, 0xA6)))
    assert common_bottom == HalfFrame("bottom", "00A8", 5, 9, common, bytes(range(0xA6, 0xAA)))
    assert nothing == ContactFrame("0000", ContactSummary())
    assert isinstance(contact, ContactFrame)
    assert isinstance(classified, ContactFrame)
    found = classified.contact
    assert (found.atd_class, found.p_mine_like, found.p_other_object) == ("mine_like", 0.85, 0.1)
    assert (found.lat_deg, found.lon_deg, found.height_px, found.width_px) == (44.7123456, -63.6543208, 113, 49)
    record = contact.contact
    assert (record.lat_deg, record.lon_deg, record.ground_range_m) == (44.7123456, -63.6543210, 33.3)
    assert record.pixel_along_m == pytest.approx(0.25, rel=0.013)
    assert record.position_sigma_m == pytest.approx(3.1, rel=0.02)


def test_paper_example_stream_headers_equal_the_packed_bytes():
    rows = re.findall(
        r"^\| 0x(\w\w) \| (?:none|0x(\w+)) \| (\d+) \u00d7 (\d+) px \| `([0-9A-F ]+)` \|$", PAPER, re.MULTILINE
    )
    for codec_id, tag, height_px, width_px, text in rows:
        header = StreamHeader(int(codec_id, 16), int(tag or "0", 16), int(height_px), int(width_px))
        assert header.pack().hex(" ").upper() == text
        assert len(tag) == 2 * tag_length(header.codec_id)
    assert sorted(len(bytes.fromhex(row[-1])) for row in rows) == [2, 3, 4, 5, 6, 7]


def test_paper_rate_table_equals_capacities_and_packet_plans():
    rows = re.findall(r"^\| ([\d, ]+) \| (\d) \u00d7 (\d+) \| (\d+) \| (\d+) \| \d \((.*)\) \|$", PAPER, re.MULTILINE)
    seen = []
    for rates, frames, size, with_contact, without, layout in rows:
        for rate in map(int, rates.split(",")):
            seen.append(rate)
            assert RATES[rate] == (int(frames), int(size))
            body_bytes = int(size) - HALF_PREFIX_SIZE - 4
            assert int(without) == 2 * int(frames) * body_bytes
            assert int(with_contact) == 2 * max(1, int(frames) - 1) * body_bytes
            stream = StreamHeader(0x10, 0xBEEF, 140, 80).pack() + bytes(88)
            plan = plan_packets("00A7", stream, ContactSummary(), *RATES[rate])
            assert [re.sub(r"[^TBC]", "", "".join(chr(f[0]) for f in packet)) for packet in plan] == re.findall(
                r"`([TBC]+)`", layout
            )
    assert seen == sorted(RATES)


def test_v1_example_frames_parse_to_the_stated_fields():
    lines = [bytes.fromhex(line) for line in re.findall(r"^(?:[0-9A-F]{2} ?){30,}$", V1, re.MULTILINE)]
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


def test_v1_checksums_have_the_stated_check_values():
    assert f"`123456789` it is 0x{checksum(b'123456789'):04X}" in V1
    assert f"`123456789` it is 0x{zlib.crc32(b'123456789'):08X}" in V1


def test_v1_preview_entries_follow_the_table():
    for s in range(22, 252):
        shape, entries = entry_shape(s), max(1, s // 56)
        expected = (1, 2, 2 * s) if s <= 43 else (entries, 1, s // entries)
        assert (shape.entries, shape.symbols, shape.entry_bytes) == expected
