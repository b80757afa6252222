"""The page that specifies the format agrees with the code."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sonarpost.codec.interface import StreamHeader
from sonarpost.link.contact_record import ContactSummary
from sonarpost.link.paper_format import ContactFrame, HalfFrame, parse_frame
from sonarpost.link.paper_sender import body_capacity_bytes, plan_packets

PAGE = (Path(__file__).parents[2] / "docs" / "wire-acoustic.md").read_text(encoding="utf-8")
RATES = {0: (1, 32), 1: (3, 64), 2: (3, 64), 3: (2, 256), 4: (2, 256), 5: (8, 256), 6: (6, 32)}


def test_the_worked_examples_parse_to_what_the_page_says() -> None:
    lines = re.findall(r"^(?:[0-9A-F]{2} ?){15,}$", PAGE, re.MULTILINE)
    top, bottom, contact, nothing = (parse_frame(bytes.fromhex(line)) for line in lines)
    header = StreamHeader(1, 0xBEEF, 113, 49, 9)
    assert top == HalfFrame("top", "00A7", 0, header, bytes(range(0xA1, 0xA6)))
    assert bottom == HalfFrame("bottom", "00A7", 5, header, bytes(range(0xA6, 0xAA)))
    assert nothing == ContactFrame("0000", ContactSummary())
    assert isinstance(contact, ContactFrame)
    record = contact.contact
    assert (record.lat_deg, record.lon_deg, record.ground_range_m) == (44.7123456, -63.6543210, 33.3)
    assert record.pixel_along_m == pytest.approx(0.25, rel=0.013)
    assert record.position_sigma_m == pytest.approx(3.1, rel=0.02)


def test_the_table_of_rates_is_right() -> None:
    rows = re.findall(r"^\| ([\d, ]+) \| (\d) \u00d7 (\d+) \| (\d+) \| (\d+) \| \d \((.*)\) \|$", PAGE, re.MULTILINE)
    seen = []
    for rates, frames, size, with_contact, without, layout in rows:
        for rate in map(int, rates.split(",")):
            seen.append(rate)
            assert RATES[rate] == (int(frames), int(size))
            assert body_capacity_bytes(*RATES[rate], with_contact=True) == int(with_contact)
            assert body_capacity_bytes(*RATES[rate], with_contact=False) == int(without)
            stream = StreamHeader(1, 0, 49, 113, 88).pack() + bytes(88)
            plan = plan_packets("00A7", stream, ContactSummary(), *RATES[rate])
            assert [re.sub(r"[^TBC]", "", "".join(chr(f[0]) for f in packet)) for packet in plan] == re.findall(
                r"`([TBC]+)`", layout
            )
    assert seen == sorted(RATES)
