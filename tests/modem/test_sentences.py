import contextlib
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem import nmea
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.sentences import (
    Acknowledgement,
    Cycle,
    DataAccepted,
    DataRequest,
    ModemMessage,
    ReceivedData,
    ReceptionStarted,
    TransmitData,
    TransmitMark,
)
from sonarpost.modem.micromodem.settings import ClockSetting, ConfigurationSetting, ErrorReport, Revision, SettingQuery
from sonarpost.modem.micromodem.statistics import LinkStatistics, TransmitStatistics, format_stamp

RECORDS = [
    (b"$CCCYC,0,3,1,4,0,2", Cycle(3, 1, 4, False, 2)),
    (b"$CADRQ,181807,3,1,0,256,2", DataRequest(3, 1, False, 256, 2, "181807")),
    (b"$CCTXD,2,1,1,", TransmitData(2, 1, True, b"")),
    (b"$CCTXD,2,1,0,00FF80", TransmitData(2, 1, False, b"\x00\xff\x80")),
    (b"$CATXD,2,1,0,3", DataAccepted(2, 1, False, 3)),
    (b"$CATXP,28", TransmitMark(False, 28)),
    (b"$CATXF,28", TransmitMark(True, 28)),
    (b"$CARXP,1", ReceptionStarted(1)),
    (b"$CARXD,3,1,0,2,00FF80", ReceivedData(3, 1, False, 2, b"\x00\xff\x80")),
    (b"$CARXD,3,1,0,2,", ReceivedData(3, 1, False, 2, b"")),
    (b"$CAACK,1,3,2,1", Acknowledgement(1, 3, 2)),
    (b"$CAMSG,BAD_CRC,2", ModemMessage("BAD_CRC", ("2",))),
    (b"$CAMSG,PACKET_TIMEOUT,3", ModemMessage("PACKET_TIMEOUT", ("3",))),
    (b"$CACFG,SRC,1", ConfigurationSetting("SRC", "1")),
    (b"$CCCFQ,ALL", SettingQuery("ALL")),
    (b"$CAREV,000052,AUV,0.93.0.09", Revision("AUV", "0.93.0.09", "000052")),
    (b"$CAERR,181807,NMEA,2,no such command", ErrorReport("NMEA", 2, "no such command", "181807")),
    (b"$CAERR,181807,DATA_TIMEOUT,2", ErrorReport("DATA_TIMEOUT", 2, "", "181807")),
    (b"$CCCLK,2016,10,12,9,0,5", ClockSetting(datetime(2016, 10, 12, 9, 0, 5, tzinfo=UTC))),
]


@pytest.mark.parametrize(("line", "record"), RECORDS, ids=[line.decode() for line, _ in RECORDS])
def test_records_both_ways(line: bytes, record) -> None:
    sentence = nmea.parse(line)
    assert type(record).parse(sentence) == record
    built = {"CACFG": ("CACFG",)}.get(sentence.kind, ())
    assert record.sentence(*built) == sentence


def test_echoes_are_the_command_under_another_name() -> None:
    assert Cycle(3, 1, 4, True, 2).sentence("CACYC") == Sentence("CACYC", ("0", "3", "1", "4", "1", "2"))
    clock = ClockSetting(datetime(2016, 10, 12, 11, 0, 5, tzinfo=timezone(timedelta(hours=2))))
    assert clock.sentence("CACLK") == Sentence("CACLK", ("2016", "10", "12", "9", "0", "5"))


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
        (b"$CATXD,3,1,0,99999999", DataAccepted.parse, "nbytes"),
        (b"$CATXF,x", TransmitMark.parse, "nbytes"),
        (b"$CAACK,1,3,0,1", Acknowledgement.parse, "frame"),
        (b"$CAMSG,", ModemMessage.parse, "text"),
        (b"$CACFG,,1", ConfigurationSetting.parse, "name"),
        (b"$CAREV,000052,", Revision.parse, "role"),
        (b"$CACLK,2016,2,30,0,0,0", ClockSetting.parse, "day"),
        (b"$CACLK,2016,13,1,0,0,0", ClockSetting.parse, "month"),
        (b"$CACLK,2016,12,1,0,0,60", ClockSetting.parse, "second"),
        (b"$CACST,8,x", LinkStatistics.parse, "mode"),
        (b"$CACST,8,0,,,one", LinkStatistics.parse, "mfd_peak"),
        (b"$CACST,8,0" + b"," * 19 + b",nan", LinkStatistics.parse, "snr_in"),
        (b"$CAXST,7,20250606", TransmitStatistics.parse, "fields"),
        (b"$CAXST,7,20250606,230117,3,0,200,1e999", TransmitStatistics.parse, "bw"),
        (b"$CATXF,28", Cycle.parse, "kind"),
    ],
)
def test_wrong_fields_are_named(line: bytes, parse: Callable[[Sentence], object], field: str) -> None:
    with pytest.raises(SentenceError) as caught:
        parse(nmea.parse(line))
    assert caught.value.field == field
    assert caught.value.expected


PARSERS = {
    "CACYC": Cycle, "CADRQ": DataRequest, "CCTXD": TransmitData, "CATXD": DataAccepted, "CATXP": TransmitMark,
    "CARXP": ReceptionStarted, "CARXD": ReceivedData, "CAACK": Acknowledgement, "CAMSG": ModemMessage,
    "CACFG": ConfigurationSetting, "CCCFQ": SettingQuery,
    "CAREV": Revision, "CAERR": ErrorReport, "CACLK": ClockSetting,
    "CACST": LinkStatistics, "CAXST": TransmitStatistics,
}  # fmt: skip
awkward = st.sampled_from(
    ["", " ", "0", "1", "-1", "1_0", "0x1", "1e5", "nan", "inf", "-", ".", "AB", "9" * 30, "\u0661"]
)
any_fields = st.lists(awkward | st.integers(-200, 99999).map(str) | st.text(max_size=6), max_size=40).map(tuple)


@given(st.sampled_from(sorted(PARSERS)), any_fields)
def test_any_fields_parse_or_raise_the_sentence_error(kind: str, fields: tuple[str, ...]) -> None:
    with contextlib.suppress(SentenceError):
        assert isinstance(PARSERS[kind].parse(Sentence(kind, fields)), PARSERS[kind])


GOLDEN_CST = nmea.parse(
    b"$CACST,8,0,20250606230123.348554,06,32767,45,0102,0123,07,00,00,00,00,1,001,000,0,5,1,0,150,26.0,9.48,-100,"
    b"-6.48,-01,0.01,51,25000,5000,0,-1,-1,00*4A"
)


def test_golden_link_statistics() -> None:
    got = LinkStatistics.parse(GOLDEN_CST)
    assert (got.version, got.mode, got.good, got.clock) == (8, 0, True, "06")
    assert got.arrival_utc == datetime(2025, 6, 6, 23, 1, 23, 348554, tzinfo=UTC)
    assert (got.mfd_peak, got.mfd_power_db, got.mfd_ratio, got.spl_db, got.agn) == (32767, 45, 102, 123, 7)
    assert (got.rate, got.src, got.dest, got.psk_error, got.packet_type) == (1, 1, 0, 0, 5)
    assert (got.nframes, got.nbad, got.snr_rss_db, got.snr_in_db, got.snr_out_db) == (1, 0, 150.0, 26.0, 9.48)
    assert (got.snr_symbol_db, got.mse_db, got.dqf, got.doppler) == (-100.0, -6.48, -1, 0.01)
    assert (got.noise_db, got.carrier_hz, got.bandwidth_hz, got.more) == (
        51.0,
        25000.0,
        5000.0,
        ("0", "-1", "-1", "00"),
    )
    assert LinkStatistics.parse(got.sentence()) == got


@pytest.mark.parametrize("kept", range(2, len(GOLDEN_CST.fields) + 1))
def test_statistics_of_fewer_fields_give_what_is_there(kept: int) -> None:
    whole = LinkStatistics.parse(GOLDEN_CST)
    got = LinkStatistics.parse(Sentence("CACST", GOLDEN_CST.fields[:kept]))
    assert got.mode == whole.mode
    assert got.nframes == (whole.nframes if kept >= 19 else None)
    assert got.bandwidth_hz == (whole.bandwidth_hz if kept >= 30 else None)
    assert got.more == whole.more[: max(0, kept - 30)]


def test_statistics_with_more_fields_keep_them() -> None:
    longer = Sentence("CACST", (*GOLDEN_CST.fields, "new", "fields"))
    assert LinkStatistics.parse(longer).more == ("0", "-1", "-1", "00", "new", "fields")


def test_statistics_of_old_firmware_have_no_version() -> None:
    old = Sentence("CACST", ("0", "181807.1234", "3", *GOLDEN_CST.fields[4:]))
    got = LinkStatistics.parse(old)
    assert (got.version, got.mode, got.mfd_peak, got.bandwidth_hz) == (None, 0, 32767, 5000.0)
    assert got.arrival_utc is None
    assert LinkStatistics.parse(got.sentence()) == got


@pytest.mark.parametrize("stamp", ["00000000000000", "20251332250000.5", "", "garbage", "20250606"])
def test_a_clock_never_set_costs_only_the_time(stamp: str) -> None:
    got = LinkStatistics.parse(Sentence("CACST", ("8", "1", stamp, *GOLDEN_CST.fields[3:])))
    assert got.arrival_utc is None
    assert not got.good
    assert got.snr_out_db == 9.48


def test_short_fraction_of_a_second_is_a_decimal_fraction() -> None:
    got = LinkStatistics(mode=0, arrival_time="20250606230123.1234").arrival_utc
    assert got == datetime(2025, 6, 6, 23, 1, 23, 123400, tzinfo=UTC)
    assert format_stamp(got) == "20250606230123.123400"


def test_golden_transmit_statistics() -> None:
    sentence = nmea.parse(b"$CAXST,7,20250606,230117.336548,3,0,200,5000,25000,1,0,0,0,0,8,5,28,25000*66")
    got = TransmitStatistics.parse(sentence)
    assert (got.version, got.date, got.time, got.clock, got.mode) == (7, "20250606", "230117.336548", "3", 0)
    assert (got.probe_length, got.bandwidth_hz, got.carrier_hz, got.rate) == (200, 5000.0, 25000.0, 1)
    assert (got.frames_expected, got.frames_sent, got.packet_type, got.nbytes, got.more) == (0, 8, 5, 28, ("25000",))
    assert got.started_utc == datetime(2025, 6, 6, 23, 1, 17, 336548, tzinfo=UTC)
    assert got.sentence() == sentence


@pytest.mark.parametrize(
    ("value", "number"), [("1", 1), ("001", 1), ("-1", -1), ("1_0", None), ("2.5", None), ("", None), ("on", None)]
)
def test_values_of_settings(value: str, number: int | None) -> None:
    assert ConfigurationSetting("name", value).number == number


def test_dotted_setting_of_a_second_generation_modem() -> None:
    got = ConfigurationSetting.parse(Sentence("CACFG", ("gps.parser.enable", "a", "b")))
    assert (got.name, got.value) == ("gps.parser.enable", "a,b")
