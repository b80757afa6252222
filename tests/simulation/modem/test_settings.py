"""The emulated Micro-Modem's settings, clock, revision and reboots."""

from __future__ import annotations

import pytest
from builders.emulator_bench import START_UTC_S, Bench

from sonarpost.modem.micromodem import nmea
from sonarpost.simulation.modem.emulator import EmulatedMicroModem
from sonarpost.simulation.modem.settings import EmulatedModemConfig


def test_the_clock_shows_the_second_to_come_and_runs_from_the_pulse():
    bench = Bench()
    bench.advance(5.07)
    bench.say(1, ("CCTMS", "2016-10-12T09:00:06Z", 0), ("CCTMQ", 0))
    assert bench.lines(1) == [
        "CATMG,2016-10-12T09:00:06Z,USER_CMD,RTC",
        "CATMS,0,2016-10-12T09:00:06Z",
        "CATMQ,2016-10-12T09:00:06Z,USER_CMD,RTC",
    ]
    for now, second in ((6.99, "06"), (7.01, "07")):
        bench.advance(now)
        bench.say(1, ("CCTMQ", 0))
        assert bench.lines(1) == [f"CATMQ,2016-10-12T09:00:{second}Z,USER_CMD,RTC"]
    bench.say(1, ("CCCLK", 2016, 10, 12, 9, 0, 60), ("CCTMQ", 0))
    assert bench.lines(1) == ["CACLK,2016,10,12,9,0,60", "CATMQ,2016-10-12T09:01:00Z,USER_CMD,RTC"]
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.clear()
    bench.advance(20.0)
    assert bench.lines(1)[1].split(",")[4] == "1"


def test_settings_are_stored_given_back_and_reset():
    bench = Bench()
    bench.say(1, ("CCCFG", "SRC", 9), ("CCCFG", "cst", 0), ("CCCFG", "hdr.x_1", -5), ("CCCFQ", "SRC"))
    assert bench.lines(1) == ["CACFG,SRC,9", "CACFG,cst,0", "CACFG,hdr.x_1,-5", "CACFG,SRC,9"]
    assert bench.world.modem(1).address == 9
    bench.say(1, ("CCCFQ", "CST"), ("CCCFQ", "hdr.x_1"), ("CCCFQ", "NONE"))
    assert bench.lines(1) == ["CACFG,CST,0", "CACFG,hdr.x_1,-5", "CAERR,090001,NMEA,3,CCCFQ bad name"]
    for everything in ("ALL", "TOP"):
        bench.say(1, ("CCCFQ", everything))
        dump = bench.lines(1)
        assert len(dump) > 50
        assert dump == sorted(dump)
        assert {"CACFG,SRC,9", "CACFG,hdr.x_1,-5"} <= set(dump)
    bench.say(1, ("CCCFG", "ALL", 0), ("CCCFQ", "SRC"), ("CCCFQ", "CST"))
    assert bench.lines(1) == ["CACFG,ALL,0", "CACFG,SRC,1", "CACFG,CST,1"]


def test_settings_switch_sentences_off():
    bench = Bench()
    bench.say(1, *(("CCCFG", name, 0) for name in ("TXP", "TXF", "XST", "REV")))
    bench.say(2, *(("CCCFG", name, 0) for name in ("RXP", "CST")))
    bench.clear()
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(30.0)
    assert b"CAREV" not in bench.told[1]
    assert [line.split(",")[0] for line in bench.lines(1)] == ["CACYC", "CADRQ", "CATXD"]
    assert bench.lines(2) == ["CACYC,0,1,2,4,0,1", "CARXD,1,2,0,1,AA"]
    bench.say(2, ("CCCFG", "RXD", 0))
    bench.clear()
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(40.0)
    assert bench.lines(2) == ["CACYC,0,1,2,4,0,1"]
    assert [report.unreported_reason for report in bench.reports] == [None, "RXD is off"]


def test_the_known_start_up_query_has_the_known_answer():
    modem = EmulatedMicroModem(EmulatedModemConfig(1, utc_at_zero_s=START_UTC_S))
    assert modem.bytes_to_send() == b"$CAREV,090000,INIT,2.0.27087*44\r\n"
    modem.receive(b"$CCCFQ,SRC*3A\r\n", 0.5)
    assert modem.bytes_to_send() == b"$CACFG,SRC,1*33\r\n"
    modem.receive(b"$CCCFG,CST,1*37\r\n", 0.5)
    assert modem.bytes_to_send() == nmea.format("CACFG", "CST", 1)


def test_the_clock_is_set_echoed_and_used():
    bench = Bench()
    bench.say(1, ("CCCLK", 2025, 6, 6, 23, 1, 23))
    assert bench.lines(1) == ["CATMG,2025-06-06T23:01:23Z,USER_CMD,RTC", "CACLK,2025,6,6,23,1,23"]
    bench.advance(3.5)
    bench.say(1, ("CCCLQ", 0), ("CCTMQ", 0))
    assert bench.lines(1) == ["CACLK,2025,6,6,23,1,25", "CATMQ,2025-06-06T23:01:25Z,USER_CMD,RTC"]
    bench.say(1, ("CCTMS", "2019-12-02T03:02:59Z", 0), ("CCCYC", 0, 1, 2, 4, 0, 1))
    assert bench.lines(1) == ["CATMS,0,2019-12-02T03:02:59Z", "CACYC,0,1,2,4,0,1", "CADRQ,030259,1,2,0,256,1"]
    for bad in (("CCCLK", 2025, 2, 30, 0, 0, 0), ("CCCLK", 0, 1, 1, 0, 0, 0), ("CCTMS", "yesterday", 0)):
        bench.say(1, bad)
    bench.say(1, ("CCCLK", 2200, 1, 1, 0, 0, 0), ("CCTMS", "2019-12-02T03:02:59Z", 1))
    errors = [line for line in bench.lines(1) if line.startswith("CAERR")]
    assert [line.split(",")[4] for line in errors] == [
        "CCCLK bad date",
        "CCCLK bad date",
        "CCTMS bad time",
        "CCCLK bad year",
        "CCTMS bad mode",
    ]


def test_a_reboot_is_deaf_and_ends_with_init():
    bench = Bench()
    bench.say(2, ("CCCFG", "SRC", 7), ("CCMSC", 7, 7, 0), ("CCCFQ", "SRC"))
    bench.clear()
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(1.99)
    assert bench.told[2] == b""
    bench.advance(2.0)
    assert bench.told[2] == nmea.format("CAREV", "090002", "INIT", "2.0.27087")
    bench.say(2, ("CCCFQ", "SRC"))
    assert bench.lines(2) == ["CACFG,SRC,7"]


def test_what_began_before_a_reboot_is_not_heard_after_it():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 1, 1), ("CCTXD", 1, 2, 1, "AA"))
    bench.advance(2.0)
    bench.say(2, ("CCMSC", 2, 2, 0))
    bench.clear()
    bench.advance(20.0)
    assert bench.lines(2) == []
    assert bench.reports[-1].unreported_reason == "rebooting"
    assert len(bench.transmissions) == 1, "what was not heard is not acknowledged"


def test_a_reboot_in_the_middle_of_a_packet_lets_the_packet_end():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 1, 0, 1), ("CCTXD", 1, 2, 0, "AA"), ("CCMSC", 1, 1, 0))
    bench.clear()
    bench.advance(7.2)
    assert bench.lines(1) == []
    bench.say(1, ("CCCYC", 0, 1, 2, 1, 0, 1), ("CCTXD", 1, 2, 0, "BB"))
    bench.advance(20.0)
    assert [line for line in bench.lines(2) if line.startswith("CARXD")] == ["CARXD,1,2,0,1,AA", "CARXD,1,2,0,1,BB"]


def test_the_revision_comes_every_ten_seconds():
    bench = Bench()
    bench.advance(35.0)
    assert bench.told[1] == b"".join(
        nmea.format("CAREV", f"0900{second}", "AUV", "2.0.27087") for second in (10, 20, 30)
    )


def test_settings_cannot_grow_without_end():
    modem = EmulatedMicroModem(EmulatedModemConfig(1))
    for number in range(2000):
        modem.receive(nmea.format("CCCFG", f"name.{number}", 1), 0.0)
    assert len(modem.settings.items()) == 512


@pytest.mark.parametrize(
    "config",
    [
        {"generation": 3},
        {"airtimes_s": {1: 0.0}},
        {"airtimes_s": {9: 1.0}},
        {"reboot_s": -1.0},
        {"mini_airtime_s": 0.0},
    ],
)
def test_a_modem_that_cannot_be_built_is_refused(config: dict[str, object]):
    with pytest.raises(ValueError, match=next(iter(config))):
        EmulatedModemConfig(1, **config)  # type: ignore[arg-type]
