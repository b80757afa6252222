"""Text, flexible data, pings, mini-packets and transponders of the emulated modem."""

import pytest
from builders.emulator_bench import START_UTC_S, EmulatorBench

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters
from sonarpost.extensions.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.micromodem import nmea


def test_text_is_received_as_text():
    bench = EmulatorBench()
    bench.send(1, ("CCCYC", 0, 1, 2, 1, 0, 2), ("CCTXA", 1, 2, 0, "hello", " sea"), ("CCTXD", 1, 2, 0, "00FF"))
    assert "CATXA,1,2,0,10" in bench.sentences(1)
    bench.advance(9.0)
    assert bench.sentences(2)[2:4] == ["CARXA,1,2,0,1,hello, sea", "CARXD,1,2,0,2,00FF"]
    bench.send(2, ("CCCFG", "RXA", 0))
    bench.send(1, ("CCCYC", 0, 1, 2, 1, 0, 1), ("CCTXA", 1, 2, 0, "unheard"))
    bench.clear_output()
    bench.advance(20.0)
    assert not [line for line in bench.sentences(2) if line.startswith("CARX") and "P" not in line[:6]]
    assert bench.reports[-1].unreported_reason == "RXA is off"


@pytest.mark.parametrize(("size", "groups"), [(22, [22]), (90, [90]), (150, [90, 60]), (282, [90, 64, 64, 64])])
def test_flexible_data(size: int, groups: list[int]):
    bench = EmulatorBench()
    data = bytes(range(256))[:size] + bytes(max(0, size - 256))
    bench.send(2, ("CCTDP", 1, 1, 0, 0, data.hex()))
    assert bench.sentences(2) == [f"CATDP,0,1,1,1,0,0,{size}", f"CATXP,{size}"]
    bench.advance(15.0)
    sentences = bench.sentences(1)
    assert sentences[0] == "CARXP,1"
    fields = sentences[1].split(",")
    assert fields[:6] == ["CARDP", "2", "1", "1", "0", "0"]
    parts = (fields[6] + (";" + fields[7] if fields[7] else "")).split(";")
    assert [(int(crc), int(count)) for crc, count in zip(parts[::3], parts[1::3], strict=True)] == [
        (1, n) for n in groups
    ]
    assert bytes.fromhex("".join(parts[2::3])) == data
    assert sentences[2].split(",")[18] == "5"
    assert [line.split(",")[0] for line in bench.sentences(2)] == ["CATXF", "CAXST"]


def test_flexible_data_is_rejected_by_the_first_generation_and_for_invalid_fields():
    bench = EmulatorBench(generation=1)
    bench.send(1, ("CCTDP", 2, 1, 0, 0, "AA"), ("CCTMQ", 0))
    assert bench.sentences(1) == ["CAERR,090001,NMEA,2,unknown CCTDP", "CAERR,090001,NMEA,2,unknown CCTMQ"]
    bench = EmulatorBench()
    for bad in ((2, 2, 0, 0, "AA"), (2, 1, 0, 0, ""), (2, 1, 0, 0, "AA" * 283)):
        bench.send(1, ("CCTDP", *bad))
    assert [line.split(",")[4] for line in bench.sentences(1)] == [
        "CCTDP bad rate",
        "CCTDP bad length",
        "CCTDP bad length",
    ]


def test_lost_flexible_data_is_reported_as_bad():
    bench = EmulatorBench(frame_loss=1.0)
    bench.send(1, ("CCTDP", 2, 1, 0, 0, "AABB"))
    bench.advance(15.0)
    sentences = bench.sentences(2)
    assert sentences[1] == "CARDP,1,2,1,0,0,0;2;0000,"
    assert sentences[2].split(",")[2] == "1"


@pytest.mark.parametrize("kind", ["PDT", "PNT"])
def test_ranging_to_transponders(kind: str):
    places = {
        1: PlacedModem(EmulatedModemConfig(1, utc_at_zero_s=START_UTC_S)),
        2: PlacedModem(EmulatedModemConfig(2), LocalPosition(50.0)),
    }
    transponders = {
        "A": LocalPosition(300.0),
        "B": LocalPosition(0.0, 600.0),
        "C": LocalPosition(5000.0),
        "D": LocalPosition(30.0),
    }
    simulator = ChannelSimulator(ChannelParameters(), places, transponders=transponders)
    simulator.advance(1.0)
    for number in places:
        simulator.take_outputs(number)
    beacons = ("1", "1", "1", "0") if kind == "PDT" else ("25000", "26000", "27000", "0")
    command = ("CCPDT", 1, 2, 0, 0, 1383, *beacons) if kind == "PDT" else ("CCPNT", 26000, 5, 5, 1383, *beacons, 1)
    for _ in range(2):
        simulator.receive(1, nmea.format(str(command[0]), *command[1:]), 1.0)
    simulator.advance(2.38)
    sentences = b"".join(output.data for output in simulator.take_outputs(1))
    assert sentences == nmea.format(f"SN{kind}", *command[1:]) + nmea.format(
        "CAERR", "090001", "CYCLE", 4, f"CC{kind} while busy"
    )
    simulator.advance(2.3831)
    sentences = b"".join(output.data for output in simulator.take_outputs(1))
    assert sentences == nmea.format("SNTTA", "0.2000", "0.4000", "", "", "090001.0000"), (
        "C is too far, D was not interrogated"
    )
    assert simulator.take_outputs(2) == [], "a ranging ping is not reported"


def test_ping_and_mini_packet_with_replies():
    bench = EmulatorBench()
    bench.send(1, ("CCMPC", 1, 2))
    bench.advance(5.0)
    assert [line for line in bench.sentences(2) if not line.startswith("CACST")] == [
        "CARXP,0",
        "CAMPA,1,2",
        "CATXP,0",
        "CATXF,0",
    ]
    sentences = bench.sentences(1)
    sent = ["CATXP,0", "CATXF,0", "CARXP,0"]
    assert [line for line in sentences if not line.startswith("CACST")] == ["CAMPC,1,2", *sent, "CAMPR,2,1,0.1000"]
    bench.send(1, ("CCMUC", 1, 2, "1a2b"))
    bench.advance(9.0)
    assert "CAMUA,1,2,1A2B" in bench.sentences(2)
    assert bench.sentences(1) == ["CAMUC,1,2,1A2B", *sent, "CAMUR,2,1"], "no CACST"
