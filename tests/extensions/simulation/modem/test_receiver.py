"""Receiving half of the emulated modem: bad frames, collisions, acknowledgements, data for other modems."""

import pytest
from builders.emulator_bench import EmulatorBench


def test_optional_sentences_precede_the_statistics():
    bench = EmulatorBench()
    bench.send(2, ("CCCFG", "TOA", 1), ("CCCFG", "DQF", 1))
    bench.send(1, ("CCCYC", 0, 1, 2, 0, 0, 1))
    bench.advance(2.0)
    bench.send(1, ("CCTXD", 1, 2, 0, "AA"))
    bench.clear_output()
    bench.advance(8.0)
    assert [line.split(",")[0] for line in bench.sentences(2)] == ["CARXP", "CARXD", "CATOA", "CADQF", "CACST"]


def test_newest_layout_of_the_statistics():
    bench = EmulatorBench(statistics_version=8)
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(9.0)
    assert bench.sentences(1)[-1] == "CAXST,7,20161012,090001.000000,0,0,200,5000,25000,4,1,2,0,1,1,3,1,25000"
    sentences = bench.sentences(2)[-1].split(",")
    assert (sentences[1], sentences[30:]) == ("8", ["5000", "0", "-1", "-1", "00"])


def test_statistics_and_revision_of_the_first_generation():
    bench = EmulatorBench(generation=1)
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 0, 1), ("CCTXD", 1, 2, 0, "AA"))
    bench.advance(14.3)
    assert b"CAREV,090014,AUV,0.93.0.09" in bench.output[1]
    assert bench.sentences(1)[-1] == "CAXST,6,20161012,090001.000000,0,0,200,5000,25000,4,1,2,0,1,1,3,1"
    fields = bench.sentences(2)[-1].split(",")
    assert (fields[1], fields[4], len(fields)) == ("6", "0", 31)
    assert fields[-2:] == ["25000", "5000"]


def test_bad_frames_are_reported_with_the_good_ones():
    bench = EmulatorBench(frame_loss=0.5, seed=4)
    frames = [bytes([n]) * 4 for n in range(8)]
    bench.send(1, ("CCCYC", 0, 1, 2, 5, 0, 8), *(("CCTXD", 1, 2, 0, f.hex()) for f in frames))
    bench.advance(9.0)
    sentences = bench.sentences(2)
    (report,) = bench.reports
    expected = [
        f"CAMSG,BAD_CRC,{f.number}" if f.outcome.value == "lost" else f"CARXD,1,2,0,{f.number},{f.sent.hex().upper()}"
        for f in report.arrival.frames
    ]
    lost = sum(line.startswith("CAMSG") for line in expected)
    assert 0 < lost < 8
    assert sentences[2:-1] == expected
    assert sentences[-1].split(",")[2] == "1"
    assert sentences[-1].split(",")[17:21] == ["3", "3", "8", str(lost)]


def test_collision_is_reported_as_packet_timeout():
    bench = EmulatorBench(modems=3)
    for modem in (1, 3):
        bench.send(modem, ("CCCYC", 0, modem, 2, 1, 0, 1), ("CCTXD", modem, 2, 0, "AA"))
    bench.advance(9.0)
    sentences = bench.sentences(2)
    assert sentences[:2] == ["CARXP,1", "CAMSG,PACKET_TIMEOUT,1"]
    assert sentences[2].startswith("CACST,6,2,20161012090001.1")
    assert sentences[2].split(",")[14:21] == ["1", "000", "000", "2", "3", "0", "0"]
    assert len(sentences) == 3
    at_2 = [r for r in bench.reports if r.arrival.receiver == 2]
    assert [(r.unreported_reason, r.arrival.frames[0].outcome.value) for r in at_2] == [("collision", "lost")] * 2


def test_transmitting_modem_receives_nothing():
    bench = EmulatorBench()
    for modem, other in ((1, 2), (2, 1)):
        bench.send(modem, ("CCCYC", 0, modem, other, 1, 0, 1), ("CCTXD", modem, other, 0, "AA"))
    bench.clear_output()
    bench.advance(9.0)
    for modem in (1, 2):
        assert [line.split(",")[0] for line in bench.sentences(modem)] == ["CATXF", "CAXST"]
    assert [report.unreported_reason for report in bench.reports] == ["receiver transmitting"] * 2


def test_good_frames_are_acknowledged():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 1, 2), ("CCTXD", 1, 2, 1, "AA"), ("CCTXD", 1, 2, 1, "BB"))
    bench.clear_output()
    bench.advance(9.0)
    sentences = [line.split(",")[0] for line in bench.sentences(2)]
    assert sentences == ["CARXP", "CACYC", "CARXD", "CARXD", "CACST", "CATXP", "CATXF"]
    sentences = bench.sentences(1)
    assert sentences[0] == "CATXF,2"
    assert sentences[2:5] == ["CARXP,0", "CAACK,2,1,1,1", "CAACK,2,1,2,1"]
    assert sentences[5].startswith("CACST,6,0,")
    ack = bench.transmissions[1]
    # 1.0 start, 3.2 air time, 0.1 travel, 0.2 turnaround
    assert ack.started_s == pytest.approx(4.5)
    assert ack.packet.acked_frames == (1, 2)


def test_no_acknowledgement_without_request_for_broadcasts_or_bad_frames():
    for cycle, loss in ((("CCCYC", 0, 1, 2, 4, 0, 1), 0.0), (("CCCYC", 0, 1, 15, 4, 1, 1), 0.0)):
        bench = EmulatorBench(frame_loss=loss)
        bench.send(1, cycle, ("CCTXD", 1, cycle[3], 0, "AA"))
        bench.advance(20.0)
        assert len(bench.transmissions) == 1
    bench = EmulatorBench(frame_loss=1.0)
    bench.send(1, ("CCCYC", 0, 1, 2, 4, 1, 1), ("CCTXD", 1, 2, 1, "AA"))
    bench.advance(20.0)
    assert len(bench.transmissions) == 1


@pytest.mark.parametrize(("dest", "promiscuous", "shown"), [(2, True, {2, 3}), (2, False, {2}), (15, False, {2, 3})])
def test_data_is_reported_by_addressed_and_promiscuous_modems(dest: int, promiscuous: bool, shown: set[int]):
    bench = EmulatorBench(modems=3, promiscuous=promiscuous)
    bench.send(1, ("CCCYC", 0, 1, dest, 4, 0, 1), ("CCTXD", 1, dest, 0, "AA"))
    bench.advance(9.0)
    assert {n for n in (2, 3) if f"CARXD,1,{dest},0,1,AA" in bench.sentences(n)} == shown
    untold = {report.arrival.receiver: report.unreported_reason for report in bench.reports}
    assert untold == {2: None, 3: None if 3 in shown else "addressed to another modem"}
