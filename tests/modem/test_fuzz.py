"""Fuzzed and arbitrary input: the driver raises nothing, keeps its memory bounded and recovers."""

from __future__ import annotations

import pytest
from builders.fake_modem import FakeModem
from builders.modem_fuzz import Fuzz, parse_alone
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.modem.interface import PacketFailed, PacketSent
from sonarpost.modem.micromodem import MicroModem, MicroModemConfig, nmea


@pytest.mark.parametrize("seed", [1, 2])
def test_driver_survives_fuzzed_lines(seed: int) -> None:
    fuzz = Fuzz(seed)
    fuzz.run(4000)
    assert fuzz.lines == 4000
    assert fuzz.sentences_parsed > 2000, "most lines must pass the parser to test the driver"


def test_parser_raises_only_sentence_error_on_fuzzed_lines() -> None:
    fuzz = Fuzz(3)
    assert 500 < parse_alone([fuzz.line() for _ in range(2000)]) < 2000


@given(st.binary(max_size=200))
def test_any_bytes_give_sentences_or_errors(data: bytes) -> None:
    assembler = nmea.LineAssembler()
    items = assembler.feed(data) + assembler.feed(b"\r\n")
    assert assembler.pending_bytes == 0
    for item in items:
        if isinstance(item, nmea.Sentence):
            assert nmea.parse(item.encode()) == item


KINDS = ["CAREV", "CACFG", "CACLK", "CACYC", "CADRQ", "CATXD", "CATXP", "CATXF", "CAXST", "CARXP", "CARXD", "CAMSG",
         "CACST", "CAACK", "CAERR", "CAMPR"]  # fmt: skip
values = st.sampled_from(["", "0", "1", "2", "3", "-1", "127", "256", "AB", "INIT", "SRC", "BAD_CRC", "DATA_TIMEOUT"])
lines = st.builds(lambda kind, fields: nmea.format(kind, *fields), st.sampled_from(KINDS), st.lists(values, max_size=9))
inputs = st.binary(max_size=80) | lines
CONFIG = MicroModemConfig(address=3)


@given(st.lists(st.tuples(inputs, st.floats(0.0, 30.0)), max_size=40), st.booleans())
def test_driver_recovers_after_any_input(script: list[tuple[bytes, float]], sending: bool) -> None:
    modem = FakeModem(MicroModem(CONFIG))
    modem.driver.start(0.0)
    ids = []
    for data, pause_s in script:
        if sending:
            ids.append(modem.driver.send_packet(1, 4, [b"x", b"y"], ack=len(ids) % 2 == 1, now=modem.now))
        modem.send_bytes(data)
        modem.run(modem.now + pause_s)
        assert modem.driver.queued <= CONFIG.queued_packets + 1
    modem.send_bytes(b"\r\n")
    modem.run(modem.now + 400.0)
    assert sorted(event.packet_id for event in modem.events_of(PacketSent, PacketFailed)) == ids
    assert modem.driver.ready
    last = modem.driver.send_packet(1, 4, [b"last"], now=modem.now)
    modem.run(modem.now + 60.0)
    sent = [event for event in modem.events_of(PacketSent) if event.packet_id == last]
    assert [event.frames for event in sent] == [(b"last",)]
