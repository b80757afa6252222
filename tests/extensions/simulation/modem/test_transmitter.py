"""Cycles of the emulated modem at every rate: commands, data, transmission and reports on both sides."""

import pytest
from builders.emulator_bench import EmulatorBench, cst

from sonarpost.modem.micromodem import RATES


def test_sentences_of_a_cycle_at_rate_1():
    bench = EmulatorBench()
    first, second = b"\x01\x02" * 32, b"\xff"
    bench.send(1, ("CCCYC", 0, 1, 2, 1, 0, 3))
    assert bench.sentences(1) == ["CACYC,0,1,2,1,0,3", "CADRQ,090001,1,2,0,64,1"]
    bench.send(1, ("CCTXD", 1, 2, 0, first.hex()))
    assert bench.sentences(1) == ["CATXD,1,2,0,64", "CADRQ,090001,1,2,0,64,2"]
    bench.send(1, ("CCTXD", 1, 2, 0, second.hex()))
    assert bench.sentences(1) == ["CATXD,1,2,0,1", "CADRQ,090001,1,2,0,64,3"]
    bench.send(1, ("CCTXD", 1, 2, 0, ""))
    assert bench.sentences(1) == ["CATXD,1,2,0,0", "CATXP,65"]

    bench.advance(1.09)
    assert bench.sentences(2) == []
    bench.advance(1.1)
    assert bench.sentences(2) == ["CARXP,1"]
    bench.advance(7.09)
    assert bench.sentences(1) == []
    bench.advance(7.1)
    assert bench.sentences(1) == ["CATXF,65", "CAXST,6,20161012,090001.000000,0,0,200,5000,25000,1,1,2,0,3,2,3,65"]
    bench.advance(7.19)
    assert bench.sentences(2) == []
    bench.advance(7.21)
    assert bench.sentences(2) == [
        "CACYC,0,1,2,1,0,3",
        f"CARXD,1,2,0,1,{'0102' * 32}",
        "CARXD,1,2,0,2,FF",
        cst("20161012090001.100000", 1, frames=2),
    ]


def test_sentences_of_a_cycle_at_rate_0():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 0, 0, 1))
    assert bench.sentences(1) == ["CACYC,0,1,2,0,0,1", "CATXP,0"]
    bench.send(1, ("CCTXD", 1, 2, 0, "00"))
    assert bench.sentences(1) == ["CAERR,090001,NMEA,3,CCTXD bad moment"], "the header is being transmitted"
    bench.advance(2.0)
    xst = "CAXST,6,20161012,09000{}00000,0,0,200,5000,25000,0,1,2,0,1,{}"
    assert bench.sentences(1) == ["CATXF,0", xst.format("1.0", "0,2,0"), "CADRQ,090001,1,2,0,32,1"]
    assert bench.sentences(2) == ["CARXP,0", "CACYC,0,1,2,0,0,1", cst("20161012090001.100000", 0, kind=2, frames=0)]
    bench.send(1, ("CCTXD", 1, 2, 0, "48656C6C6F"))
    assert bench.sentences(1) == ["CATXD,1,2,0,5", "CATXP,5"]
    bench.advance(6.0)
    assert bench.sentences(1) == ["CATXF,5", xst.format("2.0", "1,1,5")]
    sentences = bench.sentences(2)
    assert sentences[:2] == ["CARXP,0", "CARXD,1,2,0,1,48656C6C6F"]
    assert sentences[2].split(",")[14:20] == ["0", "001", "002", "0", "1", "1"]
    assert len(sentences) == 3


def test_rate_0_data_without_header_is_not_decoded():
    bench = EmulatorBench(modems=3)
    bench.send(1, ("CCCYC", 0, 1, 2, 0, 0, 1))
    bench.send(3, ("CCMUC", 3, 15, "1"))  # collides with the header at 2
    bench.advance(2.0)
    bench.send(1, ("CCTXD", 1, 2, 0, "AA"))
    bench.clear_output()
    bench.advance(8.0)
    assert [line.split(",")[:2] for line in bench.sentences(2)] == [
        ["CARXP", "0"],
        ["CAMSG", "PACKET_TIMEOUT"],
        ["CACST", "6"],
    ]
    assert bench.reports[-1].unreported_reason == "cycle header missed"


def test_header_without_data_times_out():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 0, 0, 1))
    bench.advance(13.9)
    assert bench.sentences(2)[3:] == [], "CTO of ten seconds and DTO of two"
    bench.advance(14.1)
    assert bench.sentences(2) == ["CAMSG,PACKET_TIMEOUT,0"]


@pytest.mark.parametrize("rate", [0, 1, 5])
def test_poll_of_another_modem(rate: int):
    bench = EmulatorBench(modems=3)
    poll = f"CACYC,0,2,1,{rate},1,1"
    bench.send(1, ("CCCYC", 0, 2, 1, rate, 1, 1))
    bench.advance(2.2)
    assert [line.split(",")[0] for line in bench.sentences(1)] == ["CACYC", "CATXP", "CATXF", "CAXST"]
    for n in (2, 3):
        sentences = bench.sentences(n)
        assert sentences[:2] == ["CARXP,0", poll]
        assert sentences[2].startswith("CACST,6,0,")
        assert sentences[3:] == ([f"CADRQ,090002,2,1,1,{RATES[rate].frame_bytes},1"] if n == 2 else [])
    bench.send(2, ("CCTXD", 2, 1, 1, "CAFE"))
    bench.advance(15.0)
    assert [line.split(",")[0] for line in bench.sentences(2)][:4] == ["CATXD", "CATXP", "CATXF", "CAXST"]
    for n in (1, 3):
        sentences = bench.sentences(n)
        expected = [f"CARXP,{int(rate > 0)}"] + ([poll] if rate else []) + ["CARXD,2,1,1,1,CAFE"]
        assert sentences[: len(expected)] == expected
        assert sentences[len(expected)].startswith("CACST,6,0,")
    assert bench.transmissions[-1].packet.acked_frames == (1,)


def test_poll_without_data_and_poll_without_answer():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 2, 1, 1, 0, 3))
    bench.advance(2.2)
    bench.send(2, ("CCTXD", 2, 1, 0, ""))
    bench.clear_output()
    bench.advance(12.0)
    assert [line.split(",")[0] for line in bench.sentences(1)] == ["CARXP", "CACYC", "CACST"]
    bench.send(1, ("CCCYC", 0, 9, 1, 1, 0, 1))
    bench.clear_output()
    bench.advance(30.0)
    assert [line for line in bench.sentences(1) if line.startswith("CAMSG")] == ["CAMSG,PACKET_TIMEOUT,1"]


def test_cycle_of_a_silent_host_times_out():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 1, 0, 3), ("CCTXD", 1, 2, 0, "AA"))
    bench.clear_output()
    bench.advance(2.99)
    assert bench.sentences(1) == []
    bench.advance(3.0)
    assert bench.sentences(1) == ["CAERR,090003,DATA_TIMEOUT,2"]
    bench.advance(20.0)
    assert bench.transmissions == []
    bench.send(1, ("CCTXD", 1, 2, 0, "AA"))
    assert bench.sentences(1) == ["CAERR,090020,NMEA,3,CCTXD bad moment"]
    bench.send(1, ("CCCFG", "DTO", 7), ("CCCYC", 0, 1, 2, 1, 0, 1))
    bench.clear_output()
    bench.advance(26.9)
    assert bench.sentences(1) == []
    bench.advance(27.1)
    assert bench.sentences(1) == ["CAERR,090027,DATA_TIMEOUT,1"]


def test_cycle_without_data_is_transmitted():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 1, 0, 3), ("CCTXD", 1, 2, 0, ""))
    bench.advance(9.0)
    assert [line.split(",")[:2] for line in bench.sentences(1)[-3:]] == [["CATXP", "0"], ["CATXF", "0"], ["CAXST", "6"]]
    assert [line.split(",")[0] for line in bench.sentences(2)] == ["CARXP", "CACYC", "CACST"]


def test_second_cycle_is_rejected_as_busy():
    bench = EmulatorBench()
    cycle = ("CCCYC", 0, 1, 2, 1, 0, 1)
    bench.send(1, cycle)
    bench.clear_output()
    bench.send(1, cycle)
    assert bench.sentences(1) == ["CAERR,090001,CYCLE,4,CCCYC while busy"]
    bench.send(1, ("CCTXD", 1, 2, 0, "AA"))
    bench.clear_output()
    bench.send(1, cycle)
    assert bench.sentences(1) == ["CAERR,090001,CYCLE,4,CCCYC while busy"]
    bench.advance(8.0)
    bench.clear_output()
    bench.send(1, cycle)
    assert bench.sentences(1)[0] == "CACYC,0,1,2,1,0,1"


def test_data_waits_for_the_end_of_an_automatic_reply():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 1, 1), ("CCTXD", 1, 2, 1, "AA"))
    bench.advance(4.0)
    bench.send(2, ("CCCYC", 0, 2, 1, 4, 0, 1))
    bench.advance(4.6)  # the acknowledgement is on the air from 4.5 to 5.4
    bench.send(2, ("CCTXD", 2, 1, 0, "BB"))
    bench.advance(20.0)
    assert [(t.transmitter, t.packet.kind.value) for t in bench.transmissions] == [(1, "data"), (2, "ack"), (2, "data")]
    assert bench.transmissions[2].started_s == pytest.approx(5.4)
    assert "CARXD,2,1,0,1,BB" in bench.sentences(1)


def test_too_long_frame_is_rejected():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 1, 0, 1), ("CCTXD", 1, 2, 0, "AA" * 65))
    assert bench.sentences(1)[-1] == "CAERR,090001,NMEA,3,CCTXD bad length"
    bench.send(1, ("CCTXD", 1, 2, 0, "AA" * 64))
    assert bench.sentences(1) == ["CATXD,1,2,0,64", "CATXP,64"]
