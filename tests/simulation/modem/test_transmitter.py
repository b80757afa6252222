"""The emulated Micro-Modem's cycles at every rate, both ways: asked for, filled, sent and told on both sides."""

from __future__ import annotations

import pytest
from builders.emulator_bench import Bench, cst

from sonarpost.modem.micromodem import RATES


def test_a_whole_cycle_at_rate_1_on_both_sides():
    bench = Bench()
    first, second = b"\x01\x02" * 32, b"\xff"
    bench.say(1, ("CCCYC", 0, 1, 2, 1, 0, 3))
    assert bench.lines(1) == ["CACYC,0,1,2,1,0,3", "CADRQ,090001,1,2,0,64,1"]
    bench.say(1, ("CCTXD", 1, 2, 0, first.hex()))
    assert bench.lines(1) == ["CATXD,1,2,0,64", "CADRQ,090001,1,2,0,64,2"]
    bench.say(1, ("CCTXD", 1, 2, 0, second.hex()))
    assert bench.lines(1) == ["CATXD,1,2,0,1", "CADRQ,090001,1,2,0,64,3"]
    bench.say(1, ("CCTXD", 1, 2, 0, ""))
    assert bench.lines(1) == ["CATXD,1,2,0,0", "CATXP,65"]

    bench.advance(1.09)
    assert bench.lines(2) == []
    bench.advance(1.1)
    assert bench.lines(2) == ["CARXP,1"]
    bench.advance(7.09)
    assert bench.lines(1) == []
    bench.advance(7.1)
    assert bench.lines(1) == [
        "CATXF,65",
        "CAXST,6,20161012,090001.000000,0,0,200,5000,25000,1,1,2,0,3,2,3,65",
    ]
    bench.advance(7.19)
    assert bench.lines(2) == []
    bench.advance(7.21)
    assert bench.lines(2) == [
        "CACYC,0,1,2,1,0,3",
        f"CARXD,1,2,0,1,{'0102' * 32}",
        "CARXD,1,2,0,2,FF",
        cst("20161012090001.100000", 1, frames=2),
    ]


def test_a_whole_cycle_at_rate_0_has_two_statistics_on_each_side():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 0, 0, 1))
    assert bench.lines(1) == ["CACYC,0,1,2,0,0,1", "CATXP,0"]
    bench.say(1, ("CCTXD", 1, 2, 0, "00"))
    assert bench.lines(1) == ["CAERR,090001,NMEA,3,CCTXD bad moment"], "the header is still on the air"
    bench.advance(2.0)
    xst = "CAXST,6,20161012,09000{}00000,0,0,200,5000,25000,0,1,2,0,1,{}"
    assert bench.lines(1) == ["CATXF,0", xst.format("1.0", "0,2,0"), "CADRQ,090001,1,2,0,32,1"]
    assert bench.lines(2) == ["CARXP,0", "CACYC,0,1,2,0,0,1", cst("20161012090001.100000", 0, kind=2, frames=0)]
    bench.say(1, ("CCTXD", 1, 2, 0, "48656C6C6F"))
    assert bench.lines(1) == ["CATXD,1,2,0,5", "CATXP,5"]
    bench.advance(6.0)
    assert bench.lines(1) == ["CATXF,5", xst.format("2.0", "1,1,5")]
    heard = bench.lines(2)
    assert heard[:2] == ["CARXP,0", "CARXD,1,2,0,1,48656C6C6F"]
    assert heard[2].split(",")[14:20] == ["0", "001", "002", "0", "1", "1"]
    assert len(heard) == 3


def test_data_at_rate_0_without_its_header_is_not_understood():
    bench = Bench(modems=3)
    bench.say(1, ("CCCYC", 0, 1, 2, 0, 0, 1))
    bench.say(3, ("CCMUC", 3, 15, "1"))  # collides with the header at 2
    bench.advance(2.0)
    bench.say(1, ("CCTXD", 1, 2, 0, "AA"))
    bench.clear()
    bench.advance(8.0)
    assert [line.split(",")[:2] for line in bench.lines(2)] == [
        ["CARXP", "0"],
        ["CAMSG", "PACKET_TIMEOUT"],
        ["CACST", "6"],
    ]
    assert bench.reports[-1].unreported_reason == "cycle header missed"


def test_a_header_that_nothing_follows_is_given_up():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 0, 0, 1))
    bench.advance(13.9)
    assert bench.lines(2)[3:] == [], "ten seconds for the cycle, two for the host's data"
    bench.advance(14.1)
    assert bench.lines(2) == ["CAMSG,PACKET_TIMEOUT,0"]


@pytest.mark.parametrize("rate", [0, 1, 5])
def test_polling_another_modem_for_data(rate: int):
    bench = Bench(modems=3)
    poll = f"CACYC,0,2,1,{rate},1,1"
    bench.say(1, ("CCCYC", 0, 2, 1, rate, 1, 1))
    bench.advance(2.2)
    assert [line.split(",")[0] for line in bench.lines(1)] == ["CACYC", "CATXP", "CATXF", "CAXST"]
    for n in (2, 3):
        told = bench.lines(n)
        assert told[:2] == ["CARXP,0", poll]
        assert told[2].startswith("CACST,6,0,")
        assert told[3:] == ([f"CADRQ,090002,2,1,1,{RATES[rate].frame_bytes},1"] if n == 2 else [])
    bench.say(2, ("CCTXD", 2, 1, 1, "CAFE"))
    bench.advance(15.0)
    assert [line.split(",")[0] for line in bench.lines(2)][:4] == ["CATXD", "CATXP", "CATXF", "CAXST"]
    for n in (1, 3):
        told = bench.lines(n)
        expected = [f"CARXP,{int(rate > 0)}"] + ([poll] if rate else []) + ["CARXD,2,1,1,1,CAFE"]
        assert told[: len(expected)] == expected
        assert told[len(expected)].startswith("CACST,6,0,")
    assert bench.transmissions[-1].packet.acked_frames == (1,)


def test_a_polled_host_without_data_and_a_poll_that_nobody_answers():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 2, 1, 1, 0, 3))
    bench.advance(2.2)
    bench.say(2, ("CCTXD", 2, 1, 0, ""))
    bench.clear()
    bench.advance(12.0)
    assert [line.split(",")[0] for line in bench.lines(1)] == ["CARXP", "CACYC", "CACST"]
    bench.say(1, ("CCCYC", 0, 9, 1, 1, 0, 1))
    bench.clear()
    bench.advance(30.0)
    assert [line for line in bench.lines(1) if line.startswith("CAMSG")] == ["CAMSG,PACKET_TIMEOUT,1"]


@pytest.mark.parametrize("rate", [1, 2, 3, 4, 5, 6])
def test_a_full_packet_at_every_rate(rate: int):
    bench = Bench()
    shape = RATES[rate]
    frames = [bytes([number]) * shape.frame_bytes for number in range(1, shape.frames + 1)]
    bench.say(1, ("CCCYC", 0, 1, 2, rate, 0, shape.frames), *(("CCTXD", 1, 2, 0, f.hex()) for f in frames))
    requests = [line for line in bench.lines(1) if line.startswith("CADRQ")]
    assert requests == [f"CADRQ,090001,1,2,0,{shape.frame_bytes},{number}" for number in range(1, shape.frames + 1)]
    bench.advance(1.0 + shape.airtime_s - 0.001)
    assert bench.lines(1) == []
    bench.advance(9.0)
    assert bench.lines(1)[0] == f"CATXF,{shape.packet_bytes}"
    heard = bench.lines(2)
    assert heard[:2] == ["CARXP,1", f"CACYC,0,1,2,{rate},0,{shape.frames}"]
    assert heard[2:-1] == [f"CARXD,1,2,0,{n},{f.hex().upper()}" for n, f in enumerate(frames, start=1)]
    assert heard[-1] == cst("20161012090001.100000", rate, frames=shape.frames)


def test_a_host_that_never_answers_is_given_up():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 1, 0, 3), ("CCTXD", 1, 2, 0, "AA"))
    bench.clear()
    bench.advance(2.99)
    assert bench.lines(1) == []
    bench.advance(3.0)
    assert bench.lines(1) == ["CAERR,090003,DATA_TIMEOUT,2"]
    bench.advance(20.0)
    assert bench.transmissions == []
    bench.say(1, ("CCTXD", 1, 2, 0, "AA"))
    assert bench.lines(1) == ["CAERR,090020,NMEA,3,CCTXD bad moment"]
    bench.say(1, ("CCCFG", "DTO", 7), ("CCCYC", 0, 1, 2, 1, 0, 1))
    bench.clear()
    bench.advance(26.9)
    assert bench.lines(1) == []
    bench.advance(27.1)
    assert bench.lines(1) == ["CAERR,090027,DATA_TIMEOUT,1"]


def test_a_cycle_without_data_is_still_ended():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 1, 0, 3), ("CCTXD", 1, 2, 0, ""))
    bench.advance(9.0)
    assert [line.split(",")[:2] for line in bench.lines(1)[-3:]] == [["CATXP", "0"], ["CATXF", "0"], ["CAXST", "6"]]
    assert [line.split(",")[0] for line in bench.lines(2)] == ["CARXP", "CACYC", "CACST"]


def test_a_second_cycle_is_refused_while_busy():
    bench = Bench()
    cycle = ("CCCYC", 0, 1, 2, 1, 0, 1)
    bench.say(1, cycle)
    bench.clear()
    bench.say(1, cycle)
    assert bench.lines(1) == ["CAERR,090001,CYCLE,4,CCCYC while busy"]
    bench.say(1, ("CCTXD", 1, 2, 0, "AA"))
    bench.clear()
    bench.say(1, cycle)
    assert bench.lines(1) == ["CAERR,090001,CYCLE,4,CCCYC while busy"]
    bench.advance(8.0)
    bench.clear()
    bench.say(1, cycle)
    assert bench.lines(1)[0] == "CACYC,0,1,2,1,0,1"


def test_data_filled_during_an_automatic_answer_waits_for_its_end():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 1, 1), ("CCTXD", 1, 2, 1, "AA"))
    bench.advance(4.0)
    bench.say(2, ("CCCYC", 0, 2, 1, 4, 0, 1))
    bench.advance(4.6)  # the acknowledgement is on the air from 4.5 to 5.4
    bench.say(2, ("CCTXD", 2, 1, 0, "BB"))
    bench.advance(20.0)
    assert [(t.transmitter, t.packet.kind.value) for t in bench.transmissions] == [(1, "data"), (2, "ack"), (2, "data")]
    assert bench.transmissions[2].started_s == pytest.approx(5.4)
    assert "CARXD,2,1,0,1,BB" in bench.lines(1)


def test_a_frame_that_is_too_long_is_refused_and_asked_for_no_more():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 1, 0, 1), ("CCTXD", 1, 2, 0, "AA" * 65))
    assert bench.lines(1)[-1] == "CAERR,090001,NMEA,3,CCTXD bad length"
    bench.say(1, ("CCTXD", 1, 2, 0, "AA" * 64))
    assert bench.lines(1) == ["CATXD,1,2,0,64", "CATXP,64"]
