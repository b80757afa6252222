"""A bounded run of `fuzz`, and the parser against arbitrary bytes."""

from __future__ import annotations

import pytest
from builders.modem_fuzz import Fuzz, parse_alone
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.modem.micromodem import nmea


@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_a_modem_says_breaks_the_driver(seed: int) -> None:
    fuzz = Fuzz(seed)
    fuzz.run(4000)
    assert fuzz.lines == 4000
    assert fuzz.kinds_taken > 2000, "most lines get past the parser, or the driver is not tested"


def test_the_parser_raises_its_own_error_and_keeps_what_it_parses() -> None:
    fuzz = Fuzz(3)
    assert 500 < parse_alone([fuzz.line() for _ in range(2000)]) < 2000


@given(st.binary(max_size=200))
def test_any_bytes_are_sentences_or_errors(data: bytes) -> None:
    assembler = nmea.LineAssembler()
    items = assembler.feed(data) + assembler.feed(b"\r\n")
    assert assembler.pending_bytes == 0
    for item in items:
        if isinstance(item, nmea.Sentence):
            assert nmea.parse(item.encode()) == item
