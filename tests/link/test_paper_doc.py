"""The page that specifies the format agrees with the code."""

from __future__ import annotations

import re

import pytest
from builders.common import REPOSITORY

from sonarpost.codec.interface import COMMON_SIDES_PX, StreamHeader, tag_length
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import HALF_PREFIX_SIZE, ContactFrame, HalfFrame, parse_frame
from sonarpost.link.frames.paper.sender import body_capacity_bytes, plan_packets

PAGE = (REPOSITORY / "docs" / "specifications" / "acoustic-paper.md").read_text(encoding="utf-8")
RATES = {0: (1, 32), 1: (3, 64), 2: (3, 64), 3: (2, 256), 4: (2, 256), 5: (8, 256), 6: (6, 32)}


def test_the_worked_examples_parse_to_what_the_page_says() -> None:
    lines = re.findall(r"^(?:[0-9A-F]{2} ?){15,}$", PAGE, re.MULTILINE)
    top, bottom, common_top, common_bottom, contact, nothing = (parse_frame(bytes.fromhex(line)) for line in lines)
    header, common = StreamHeader(0x10, 0xBEEF, 113, 49), StreamHeader(0x10, 0xBEEF, 140, 80)
    assert top == HalfFrame("top", "00A7", 0, 9, header, bytes(range(0xA1, 0xA6)))
    assert bottom == HalfFrame("bottom", "00A7", 5, 9, header, bytes(range(0xA6, 0xAA)))
    assert common_top == HalfFrame("top", "00A8", 0, 9, common, bytes(range(0xA1, 0xA6)))
    assert common_bottom == HalfFrame("bottom", "00A8", 5, 9, common, bytes(range(0xA6, 0xAA)))
    assert nothing == ContactFrame("0000", ContactSummary())
    assert isinstance(contact, ContactFrame)
    record = contact.contact
    assert (record.lat_deg, record.lon_deg, record.ground_range_m) == (44.7123456, -63.6543210, 33.3)
    assert record.pixel_along_m == pytest.approx(0.25, rel=0.013)
    assert record.position_sigma_m == pytest.approx(3.1, rel=0.02)


def test_the_table_of_stream_headers_is_right() -> None:
    rows = re.findall(
        r"^\| 0x(\w\w) \| (?:none|0x(\w+)) \| (\d+) \u00d7 (\d+) px \| `([0-9A-F ]+)` \|$", PAGE, re.MULTILINE
    )
    for codec_id, tag, height_px, width_px, text in rows:
        header = StreamHeader(int(codec_id, 16), int(tag or "0", 16), int(height_px), int(width_px))
        assert header.pack().hex(" ").upper() == text
        assert len(tag) == 2 * tag_length(header.codec_id)
    assert sorted(len(bytes.fromhex(row[-1])) for row in rows) == [2, 3, 4, 5, 6, 7]


def test_the_common_sides_and_the_classes_of_codec_ids_are_those_of_the_code() -> None:
    (sides,) = re.findall(r"common sides, numbered from 0: ([\d, ]+) px", PAGE)
    assert tuple(map(int, sides.split(","))) == COMMON_SIDES_PX
    (row,) = re.findall(r"^\| 0, 1 or 2 \| model tag \| (.*) \|$", PAGE, re.MULTILINE)
    none, one, two = re.findall(r"(?:none|one|two) for ([^(]*) \(", row)
    for text, length in ((none, 0), (one, 1), (two, 2)):
        for low, high in re.findall(r"0x(\w\w)\u20130x(\w\w)", text):
            assert {tag_length(codec_id) for codec_id in range(int(low, 16), int(high, 16) + 1)} == {length}
    spans = re.findall(r"0x(\w\w)\u20130x(\w\w)", row)
    assert sum(int(high, 16) - int(low, 16) + 1 for low, high in spans) == 256


def test_the_share_of_the_header_is_right() -> None:
    said = r"(\d+) bytes of every frame[^(]*\((\d+) % at 32 bytes, (\d+) % at 64, (\d+) % at 256"
    (numbers,) = re.findall(said, PAGE)
    header, *shares = map(int, numbers)
    assert header == HALF_PREFIX_SIZE + 4
    assert shares == [round(100 * header / size) for size in (32, 64, 256)]


def test_the_table_of_rates_is_right() -> None:
    rows = re.findall(r"^\| ([\d, ]+) \| (\d) \u00d7 (\d+) \| (\d+) \| (\d+) \| \d \((.*)\) \|$", PAGE, re.MULTILINE)
    seen = []
    for rates, frames, size, with_contact, without, layout in rows:
        for rate in map(int, rates.split(",")):
            seen.append(rate)
            assert RATES[rate] == (int(frames), int(size))
            assert body_capacity_bytes(*RATES[rate], with_contact=True, header_bytes=4) == int(with_contact)
            assert body_capacity_bytes(*RATES[rate], with_contact=False, header_bytes=4) == int(without)
            stream = StreamHeader(0x10, 0xBEEF, 140, 80).pack() + bytes(88)
            plan = plan_packets("00A7", stream, ContactSummary(), *RATES[rate])
            assert [re.sub(r"[^TBC]", "", "".join(chr(f[0]) for f in packet)) for packet in plan] == re.findall(
                r"`([TBC]+)`", layout
            )
    assert seen == sorted(RATES)
