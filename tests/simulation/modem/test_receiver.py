"""What of a packet the emulated Micro-Modem tells: bad frames, collisions, acknowledgements, data for others."""

from __future__ import annotations

import pytest
from builders.emulator_bench import Bench


def test_extra_lines_come_before_the_statistics_where_a_host_wants_them():
    bench = Bench()
    bench.say(2, ("CCCFG", "TOA", 1), ("CCCFG", "DQF", 1))
    bench.say(1, ("CCCYC", 0, 1, 2, 0, 0, 1))
    bench.advance(2.0)
    bench.say(1, ("CCTXD", 1, 2, 0, "AA"))
    bench.clear()
    bench.advance(8.0)
    assert [line.split(",")[0] for line in bench.lines(2)] == ["CARXP", "CARXD", "CATOA", "CADQF", "CACST"]


def test_the_newest_layout_of_statistics():
    bench = Bench(statistics_version=8)
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(9.0)
    assert bench.lines(1)[-1] == "CAXST,7,20161012,090001.000000,0,0,200,5000,25000,4,1,2,0,1,1,3,1,25000"
    told = bench.lines(2)[-1].split(",")
    assert (told[1], told[30:]) == ("8", ["5000", "0", "-1", "-1", "00"])


def test_the_first_generation_has_a_longer_version_and_a_shorter_clock_status():
    bench = Bench(generation=1)
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(14.3)
    assert b"CAREV,090014,AUV,0.93.0.09" in bench.told[1]
    assert bench.lines(1)[-1] == "CAXST,6,20161012,090001.000000,0,0,200,5000,25000,4,1,2,0,1,1,3,1"
    fields = bench.lines(2)[-1].split(",")
    assert (fields[1], fields[4], len(fields)) == ("6", "0", 31)
    assert fields[-2:] == ["25000", "5000"]


def test_bad_frames_are_told_as_bad_and_the_rest_is_told():
    bench = Bench(frame_loss=0.5, seed=4)
    frames = [bytes([n]) * 4 for n in range(8)]
    bench.say(1, ("CCCYC", 0, 1, 2, 5, 0, 8), *(("CCTXD", 1, 2, 0, f.hex()) for f in frames))
    bench.advance(9.0)
    heard = bench.lines(2)
    (report,) = bench.reports
    expected = [
        f"CAMSG,BAD_CRC,{f.number}" if f.outcome.value == "lost" else f"CARXD,1,2,0,{f.number},{f.sent.hex().upper()}"
        for f in report.arrival.frames
    ]
    lost = sum(line.startswith("CAMSG") for line in expected)
    assert 0 < lost < 8
    assert heard[2:-1] == expected
    assert heard[-1].split(",")[2] == "1"
    assert heard[-1].split(",")[17:21] == ["3", "3", "8", str(lost)]


def test_a_collision_ends_in_a_packet_timeout():
    bench = Bench(modems=3)
    for modem in (1, 3):
        bench.say(modem, ("CCCYC", 0, modem, 2, 1, 0, 1), ("CCTXD", modem, 2, 0, "AA"))
    bench.advance(9.0)
    heard = bench.lines(2)
    assert heard[:2] == ["CARXP,1", "CAMSG,PACKET_TIMEOUT,1"]
    assert heard[2].startswith("CACST,6,2,20161012090001.1")
    assert heard[2].split(",")[14:21] == ["1", "000", "000", "2", "3", "0", "0"]
    assert len(heard) == 3
    at_2 = [r for r in bench.reports if r.arrival.receiver == 2]
    assert [(r.unreported_reason, r.arrival.frames[0].outcome.value) for r in at_2] == [("collision", "lost")] * 2


def test_a_transmitting_modem_hears_nothing():
    bench = Bench()
    for modem, other in ((1, 2), (2, 1)):
        bench.say(modem, ("CCCYC", 0, modem, other, 1, 0, 1), ("CCTXD", modem, other, 0, "AA"))
    bench.clear()
    bench.advance(9.0)
    for modem in (1, 2):
        assert [line.split(",")[0] for line in bench.lines(modem)] == ["CATXF", "CAXST"]
    assert [report.unreported_reason for report in bench.reports] == ["receiver transmitting"] * 2


def test_an_acknowledgement_comes_back_for_the_good_frames():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 1, 2), ("CCTXD", 1, 2, 1, "AA"), ("CCTXD", 1, 2, 1, "BB"))
    bench.clear()
    bench.advance(9.0)
    heard = [line.split(",")[0] for line in bench.lines(2)]
    assert heard == ["CARXP", "CACYC", "CARXD", "CARXD", "CACST", "CATXP", "CATXF"]
    told = bench.lines(1)
    assert told[0] == "CATXF,2"
    assert told[2:5] == ["CARXP,0", "CAACK,2,1,1,1", "CAACK,2,1,2,1"]
    assert told[5].startswith("CACST,6,0,")
    ack = bench.transmissions[1]
    # 1.0 start, 3.2 air time, 0.1 travel, 0.2 turnaround
    assert ack.started_s == pytest.approx(4.5)
    assert ack.packet.acked_frames == (1, 2)


def test_nothing_is_acknowledged_without_request_to_others_or_when_all_is_bad():
    for cycle, loss in ((("CCCYC", 0, 1, 2, 4, 0, 1), 0.0), (("CCCYC", 0, 1, 15, 4, 1, 1), 0.0)):
        bench = Bench(frame_loss=loss)
        bench.say(1, cycle, ("CCTXD", 1, cycle[3], 0, "AA"))
        bench.advance(20.0)
        assert len(bench.transmissions) == 1
    bench = Bench(frame_loss=1.0)
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 1, 1), ("CCTXD", 1, 2, 1, "AA"))
    bench.advance(20.0)
    assert len(bench.transmissions) == 1


@pytest.mark.parametrize(("promiscuous", "shown"), [(True, {2, 3}), (False, {2})])
def test_data_for_another_modem(promiscuous: bool, shown: set[int]):
    bench = Bench(modems=3, promiscuous=promiscuous)
    bench.say(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(9.0)
    assert {n for n in (2, 3) if any(line.startswith("CARXD") for line in bench.lines(n))} == shown
    untold = {report.arrival.receiver: report.unreported_reason for report in bench.reports}
    assert untold == {2: None, 3: None if promiscuous else "addressed to another modem"}


def test_a_broadcast_is_shown_to_everybody():
    bench = Bench(modems=3, promiscuous=False)
    bench.say(1, ("CCCYC", 0, 1, 15, 4, 0, 1), ("CCTXD", 1, 15, 0, "AA"))
    bench.advance(9.0)
    for n in (2, 3):
        assert "CARXD,1,15,0,1,AA" in bench.lines(n)
