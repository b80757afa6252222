"""Typed sentences and statistics: known sentences, wrong fields, arbitrary fields."""

import contextlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import RangeMeasured, ShortMessageReceived
from sonarpost.modem.micromodem import nmea
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.requests import ping_command
from sonarpost.modem.micromodem.sentences import (
    Acknowledgement,
    ConfigurationSetting,
    Cycle,
    DataRequest,
    ErrorReport,
    LinkStatistics,
    ReceivedData,
    Revision,
    TransmitMark,
    accepted_bytes,
    message_text,
    range_measured,
    short_message,
    transmit_data,
    transmitted_type,
)
from sonarpost.modem.micromodem.supervisor import query_command, set_command

PARSED = [
    (b"$CACYC,0,3,1,4,0,2", Cycle(3, 1, 4, False, 2)),
    (b"$CADRQ,181807,3,1,0,256,2", DataRequest(3, 1, False, 256, 2)),
    (b"$CATXP,28", TransmitMark(False, 28)),
    (b"$CATXF,28", TransmitMark(True, 28)),
    (b"$CATXF", TransmitMark(True)),
    (b"$CARXD,3,1,0,2,00FF80", ReceivedData(3, 1, False, 2, b"\x00\xff\x80")),
    (b"$CARXD,3,1,0,2,", ReceivedData(3, 1, False, 2, b"")),
    (b"$CARXA,2,1,0,1,hello, sea", ReceivedData(2, 1, False, 1, b"hello, sea")),
    (b"$CAACK,1,3,2,1", Acknowledgement(1, 3, 2)),
    (b"$CAACK,1,3,2", Acknowledgement(1, 3, 2)),
    (b"$CAACK,1,3,2,0", Acknowledgement(1, 3, 2, good=False)),
    (b"$CACFG,SRC,1", ConfigurationSetting("SRC", "1")),
    (b"$CAREV,000052,AUV,0.93.0.09", Revision("AUV", "0.93.0.09")),
    (b"$CAERR,181807,NMEA,2,no such command", ErrorReport("NMEA", 2, "no such command")),
    (b"$CAERR,181807,NMEA,two,words", ErrorReport("NMEA", None, "two,words")),
    (b"$CAERR,181807,DATA_TIMEOUT,2", ErrorReport("DATA_TIMEOUT", 2)),
]


@pytest.mark.parametrize(("line", "record"), PARSED, ids=[line.decode() for line, _ in PARSED])
def test_sentence_of_the_modem_is_parsed(line: bytes, record) -> None:
    assert type(record).parse(nmea.parse(line)) == record


@pytest.mark.parametrize(
    ("sentence", "line"),
    [
        (Cycle(3, 1, 4, False, 2).sentence(), b"$CCCYC,0,3,1,4,0,2"),
        (transmit_data(2, 1, b"", ack=True), b"$CCTXD,2,1,1,"),
        (transmit_data(2, 1, b"\x00\xff\x80", ack=False), b"$CCTXD,2,1,0,00FF80"),
        (set_command("SRC", 1).sentence, b"$CCCFG,SRC,1"),
        (query_command("SRC", 1).sentence, b"$CCCFQ,SRC"),
        (ping_command(1, 2), b"$CCMPC,1,2"),
    ],
)
def test_bytes_of_each_command(sentence: Sentence, line: bytes) -> None:
    assert sentence.encode().partition(b"*")[0] == line


@pytest.mark.parametrize(
    ("line", "parse", "value"),
    [
        (b"$CATXD,2,1,0,3", accepted_bytes, 3),
        (b"$CAMSG,BAD_CRC,2", message_text, "BAD_CRC"),
        (b"$CAMPR,2,1,0.1234", range_measured, RangeMeasured(2, 1, 0.1234)),
        (b"$CAMPR,2,1", range_measured, RangeMeasured(2, 1, None)),
        (b"$CAMUA,1,2,1ABC", short_message, ShortMessageReceived(1, 2, 0x1ABC)),
        (b"$CAXST,7,20250606,230117.336548,3,0,200,5000,25000,1,0,0,0,0,8,5,28,25000*66", transmitted_type, 5),
        (b"$CAXST,7,20250606,230117.336548", transmitted_type, None),
    ],
)
def test_sentence_with_one_result(line: bytes, parse: Callable[[Sentence], object], value: object) -> None:
    assert parse(nmea.parse(line)) == value


def test_echo_has_the_fields_of_the_command() -> None:
    assert Cycle(3, 1, 4, True, 2).sentence("CACYC") == Sentence("CACYC", ("0", "3", "1", "4", "1", "2"))


@pytest.mark.parametrize(
    ("line", "parse", "field"),
    [
        (b"$CACYC,0,3,1,4,0", Cycle.parse, "fields"),
        (b"$CACYC,0,128,1,4,0,2", Cycle.parse, "src"),
        (b"$CACYC,0,3,-1,4,0,2", Cycle.parse, "dest"),
        (b"$CACYC,0,3,1,4,2,2", Cycle.parse, "ack"),
        (b"$CACYC,0,3,1,4,0,two", Cycle.parse, "nframes"),
        (b"$CADRQ,181807,3,1,0,256,0", DataRequest.parse, "frame"),
        (b"$CADRQ,181807,3,1,0,,1", DataRequest.parse, "maxbytes"),
        (b"$CARXD,3,1,0,1,ABC", ReceivedData.parse, "data"),
        (b"$CARXD,3,1,0,1,GG", ReceivedData.parse, "data"),
        (b"$CARXD,3,1,0,1,A B ", ReceivedData.parse, "data"),
        (b"$CATXD,3,1,0,99999999", accepted_bytes, "nbytes"),
        (b"$CATXD,128,1,0,1", accepted_bytes, "src"),
        (b"$CATXF,x", TransmitMark.parse, "nbytes"),
        (b"$CAACK,1,3,0,1", Acknowledgement.parse, "frame"),
        (b"$CAMSG,", message_text, "text"),
        (b"$CACFG,,1", ConfigurationSetting.parse, "name"),
        (b"$CAREV,000052,", Revision.parse, "role"),
        (b"$CACST,8,x", LinkStatistics.parse, "mode"),
        (b"$CACST,8,0,,,,,,one", LinkStatistics.parse, "spl_db"),
        (b"$CACST,8,0" + b"," * 19 + b",nan", LinkStatistics.parse, "snr_in_db"),
        (b"$CAXST,7,20250606", transmitted_type, "fields"),
        (b"$CAXST,7,20250606,230117" + b"," * 12 + b"x", transmitted_type, "packet_type"),
        (b"$CATXF,28", Cycle.parse, "kind"),
        (b"$CAMPR,1,2,soon", range_measured, "travel time"),
        (b"$CAMPR,1,2,-1", range_measured, "travel time"),
        (b"$CAMUA,1,2,2000", short_message, "bits"),
        (b"$CAMUA,1,2,", short_message, "bits"),
    ],
)
def test_error_names_the_invalid_field(line: bytes, parse: Callable[[Sentence], object], field: str) -> None:
    with pytest.raises(SentenceError) as caught:
        parse(nmea.parse(line))
    assert caught.value.field == field
    assert caught.value.expected


PARSERS: dict[str, Callable[[Sentence], object]] = {
    "CACYC": Cycle.parse, "CADRQ": DataRequest.parse, "CATXD": accepted_bytes, "CATXP": TransmitMark.parse,
    "CARXD": ReceivedData.parse, "CAACK": Acknowledgement.parse,
    "CAMSG": message_text, "CACFG": ConfigurationSetting.parse, "CAREV": Revision.parse,
    "CAERR": ErrorReport.parse, "CAMPR": range_measured, "CAMUA": short_message, "CACST": LinkStatistics.parse,
}  # fmt: skip
awkward = st.sampled_from(
    ["", " ", "0", "1", "-1", "1_0", "0x1", "1e5", "nan", "inf", "-", ".", "AB", "9" * 30, "\u0661", "1;2;AABB"]
)
any_fields = st.lists(awkward | st.integers(-200, 99999).map(str) | st.text(max_size=6), max_size=40).map(tuple)


@given(st.sampled_from(sorted(PARSERS)), any_fields)
def test_any_fields_parse_or_raise_sentence_error(kind: str, fields: tuple[str, ...]) -> None:
    with contextlib.suppress(SentenceError):
        assert PARSERS[kind](Sentence(kind, fields)) is not None


GOLDEN_CST = nmea.parse(
    b"$CACST,8,0,20250606230123.348554,06,32767,45,0102,0123,07,00,00,00,00,1,001,000,0,5,1,0,150,26.0,9.48,-100,"
    b"-6.48,-01,0.01,51,25000,5000,0,-1,-1,00*4A"
)


def test_golden_link_statistics() -> None:
    got = LinkStatistics.parse(GOLDEN_CST)
    assert (got.mode, got.good, got.spl_db, got.rate, got.src, got.dest, got.packet_type) == (0, True, 123, 1, 1, 0, 5)
    assert (got.nframes, got.nbad, got.snr_in_db, got.snr_out_db) == (1, 0, 26.0, 9.48)
    assert (got.mse_db, got.doppler) == (-6.48, 0.01)


@pytest.mark.parametrize("kept", range(2, len(GOLDEN_CST.fields) + 1))
def test_missing_statistics_fields_are_none(kept: int) -> None:
    whole = LinkStatistics.parse(GOLDEN_CST)
    got = LinkStatistics.parse(Sentence("CACST", GOLDEN_CST.fields[:kept]))
    assert got.mode == whole.mode
    assert got.nframes == (whole.nframes if kept >= 19 else None)
    assert got.doppler == (whole.doppler if kept >= 27 else None)


def test_statistics_of_old_and_newer_firmware() -> None:
    whole = LinkStatistics.parse(GOLDEN_CST)
    assert LinkStatistics.parse(Sentence("CACST", (*GOLDEN_CST.fields, "new", "fields"))) == whole
    assert LinkStatistics.parse(Sentence("CACST", ("0", "181807.1234", "3", *GOLDEN_CST.fields[4:]))) == whole


@pytest.mark.parametrize(
    ("value", "number"), [("1", 1), ("001", 1), ("-1", -1), ("1_0", None), ("2.5", None), ("", None), ("on", None)]
)
def test_integer_value_of_a_setting(value: str, number: int | None) -> None:
    assert ConfigurationSetting("name", value).number == number


def test_dotted_setting_of_a_second_generation_modem() -> None:
    got = ConfigurationSetting.parse(Sentence("CACFG", ("gps.parser.enable", "a", "b")))
    assert (got.name, got.value) == ("gps.parser.enable", "a,b")
