"""Settings, clock, revision and reboots of the emulated modem."""

from builders.emulator_bench import START_UTC_S, EmulatorBench

from sonarpost.extensions.simulation.modem.emulator import EmulatedMicroModem
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.micromodem import nmea


def test_second_z_of_the_clock_command_is_accepted():
    bench = EmulatorBench()
    bench.send(1, ("CCTMS", "2024-02-29T23:59:50ZZ", 0))
    assert bench.sentences(1)[-1] == "CATMS,0,2024-02-29T23:59:50Z"
    bench.send(1, ("CCTMS", "2024-02-29T23:59:50ZZZ", 0))
    assert bench.sentences(1)[-1].endswith("CCTMS bad time")


def test_clock_holds_the_set_second_until_the_pulse():
    bench = EmulatorBench()
    bench.advance(5.07)
    bench.send(1, ("CCTMS", "2016-10-12T09:00:06Z", 0), ("CCTMQ", 0))
    assert bench.sentences(1) == [
        "CATMG,2016-10-12T09:00:06Z,USER_CMD,RTC",
        "CATMS,0,2016-10-12T09:00:06Z",
        "CATMQ,2016-10-12T09:00:06Z,USER_CMD,RTC",
    ]
    for now, second in ((6.99, "06"), (7.01, "07")):
        bench.advance(now)
        bench.send(1, ("CCTMQ", 0))
        assert bench.sentences(1) == [f"CATMQ,2016-10-12T09:00:{second}Z,USER_CMD,RTC"]
    bench.send(1, ("CCCLK", 2016, 10, 12, 9, 0, 60), ("CCTMQ", 0))
    assert bench.sentences(1) == ["CACLK,2016,10,12,9,0,60", "CATMQ,2016-10-12T09:01:00Z,USER_CMD,RTC"]
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.clear_output()
    bench.advance(20.0)
    assert bench.sentences(1)[1].split(",")[4] == "1"


def test_settings_are_stored_queried_and_reset():
    bench = EmulatorBench()
    bench.send(1, ("CCCFG", "SRC", 9), ("CCCFG", "cst", 0), ("CCCFG", "hdr.x_1", -5), ("CCCFQ", "SRC"))
    assert bench.sentences(1) == ["CACFG,SRC,9", "CACFG,cst,0", "CACFG,hdr.x_1,-5", "CACFG,SRC,9"]
    assert bench.simulator.modem(1).address == 9
    bench.send(1, ("CCCFQ", "CST"), ("CCCFQ", "hdr.x_1"), ("CCCFQ", "NONE"))
    assert bench.sentences(1) == ["CACFG,CST,0", "CACFG,hdr.x_1,-5", "CAERR,090001,NMEA,3,CCCFQ bad name"]
    for everything in ("ALL", "TOP"):
        bench.send(1, ("CCCFQ", everything))
        dump = bench.sentences(1)
        assert len(dump) > 50
        assert dump == sorted(dump)
        assert {"CACFG,SRC,9", "CACFG,hdr.x_1,-5"} <= set(dump)
    bench.send(1, ("CCCFG", "ALL", 0), ("CCCFQ", "SRC"), ("CCCFQ", "CST"))
    assert bench.sentences(1) == ["CACFG,ALL,0", "CACFG,SRC,1", "CACFG,CST,1"]


def test_settings_disable_sentences():
    bench = EmulatorBench()
    bench.send(1, *(("CCCFG", name, 0) for name in ("TXP", "TXF", "XST", "REV")))
    bench.send(2, *(("CCCFG", name, 0) for name in ("RXP", "CST")))
    bench.clear_output()
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(30.0)
    assert b"CAREV" not in bench.output[1]
    assert [line.split(",")[0] for line in bench.sentences(1)] == ["CACYC", "CADRQ", "CATXD"]
    assert bench.sentences(2) == ["CACYC,0,1,2,4,0,1", "CARXD,1,2,0,1,AA"]
    bench.send(2, ("CCCFG", "RXD", 0))
    bench.clear_output()
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(40.0)
    assert bench.sentences(2) == ["CACYC,0,1,2,4,0,1"]
    assert [report.unreported_reason for report in bench.reports] == [None, "RXD is off"]


def test_start_up_query_has_the_recorded_answer():
    modem = EmulatedMicroModem(EmulatedModemConfig(1, utc_at_zero_s=START_UTC_S))
    assert modem.bytes_to_send() == b"$CAREV,090000,INIT,2.0.27087*44\r\n"
    modem.receive(b"$CCCFQ,SRC*3A\r\n", 0.5)
    assert modem.bytes_to_send() == b"$CACFG,SRC,1*33\r\n"
    modem.receive(b"$CCCFG,CST,1*37\r\n", 0.5)
    assert modem.bytes_to_send() == nmea.format("CACFG", "CST", 1)


def test_clock_is_set_echoed_and_used():
    bench = EmulatorBench()
    bench.send(1, ("CCCLK", 2025, 6, 6, 23, 1, 23))
    assert bench.sentences(1) == ["CATMG,2025-06-06T23:01:23Z,USER_CMD,RTC", "CACLK,2025,6,6,23,1,23"]
    bench.advance(3.5)
    bench.send(1, ("CCCLQ", 0), ("CCTMQ", 0))
    assert bench.sentences(1) == ["CACLK,2025,6,6,23,1,25", "CATMQ,2025-06-06T23:01:25Z,USER_CMD,RTC"]
    bench.send(1, ("CCTMS", "2019-12-02T03:02:59Z", 0), ("CCCYC", 0, 1, 2, 4, 0, 1))
    assert bench.sentences(1) == ["CATMS,0,2019-12-02T03:02:59Z", "CACYC,0,1,2,4,0,1", "CADRQ,030259,1,2,0,256,1"]
    for bad in (("CCCLK", 2025, 2, 30, 0, 0, 0), ("CCCLK", 0, 1, 1, 0, 0, 0), ("CCTMS", "yesterday", 0)):
        bench.send(1, bad)
    bench.send(1, ("CCCLK", 2200, 1, 1, 0, 0, 0), ("CCTMS", "2019-12-02T03:02:59Z", 1))
    errors = [line for line in bench.sentences(1) if line.startswith("CAERR")]
    assert [line.split(",")[4] for line in errors] == [
        "CCCLK bad date",
        "CCCLK bad date",
        "CCTMS bad time",
        "CCCLK bad year",
        "CCTMS bad mode",
    ]


def test_rebooting_modem_receives_nothing_and_reports_init():
    bench = EmulatorBench()
    bench.send(2, ("CCCFG", "SRC", 7), ("CCMSC", 7, 7, 0), ("CCCFQ", "SRC"))
    bench.clear_output()
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(1.99)
    assert bench.output[2] == b""
    bench.advance(2.0)
    assert bench.output[2] == nmea.format("CAREV", "090002", "INIT", "2.0.27087")
    bench.send(2, ("CCCFQ", "SRC"))
    assert bench.sentences(2) == ["CACFG,SRC,7"]


def test_packet_interrupted_by_a_reboot_is_not_received():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 1, 1), ("CCTXD", 1, 2, 1, "AA"))
    bench.advance(2.0)
    bench.send(2, ("CCMSC", 2, 2, 0))
    bench.clear_output()
    bench.advance(20.0)
    assert bench.sentences(2) == []
    assert bench.reports[-1].unreported_reason == "rebooting"
    assert len(bench.transmissions) == 1, "a packet that is not received is not acknowledged"


def test_reboot_completes_the_transmission_in_progress():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 1, 0, 1), ("CCTXD", 1, 2, 0, "AA"), ("CCMSC", 1, 1, 0))
    bench.clear_output()
    bench.advance(7.2)
    assert bench.sentences(1) == []
    bench.send(1, ("CCCYC", 0, 1, 2, 1, 0, 1), ("CCTXD", 1, 2, 0, "BB"))
    bench.advance(20.0)
    assert [line for line in bench.sentences(2) if line.startswith("CARXD")] == ["CARXD,1,2,0,1,AA", "CARXD,1,2,0,1,BB"]


def test_revision_is_sent_every_ten_seconds():
    bench = EmulatorBench()
    bench.advance(35.0)
    assert bench.output[1] == b"".join(
        nmea.format("CAREV", f"0900{second}", "AUV", "2.0.27087") for second in (10, 20, 30)
    )


def test_number_of_settings_is_bounded():
    modem = EmulatedMicroModem(EmulatedModemConfig(1))
    for number in range(2000):
        modem.receive(nmea.format("CCCFG", f"name.{number}", 1), 0.0)
    assert len(modem.settings.items()) == 512
