"""The emulated Micro-Modem besides binary frames: text, flexible data, pings, mini-packets, transponders."""

from __future__ import annotations

import pytest
from builders.emulator_bench import START_UTC_S, Bench

from sonarpost.modem.micromodem import nmea
from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.parameters import ChannelParameters
from sonarpost.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.simulation.modem.settings import EmulatedModemConfig


def test_text_travels_as_text():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 1, 0, 2), ("CCTXA", 1, 2, 0, "hello", " sea"), ("CCTXD", 1, 2, 0, "00FF"))
    assert "CATXA,1,2,0,10" in bench.lines(1)
    bench.advance(9.0)
    assert bench.lines(2)[2:4] == ["CARXA,1,2,0,1,hello, sea", "CARXD,1,2,0,2,00FF"]
    bench.say(2, ("CCCFG", "RXA", 0))
    bench.say(1, ("CCCYC", 0, 1, 2, 1, 0, 1), ("CCTXA", 1, 2, 0, "unheard"))
    bench.clear()
    bench.advance(20.0)
    assert not [line for line in bench.lines(2) if line.startswith("CARX") and "P" not in line[:6]]
    assert bench.reports[-1].unreported_reason == "RXA is off"


@pytest.mark.parametrize(("size", "groups"), [(22, [22]), (90, [90]), (150, [90, 60]), (282, [90, 64, 64, 64])])
def test_flexible_data(size: int, groups: list[int]):
    bench = Bench()
    data = bytes(range(256))[:size] + bytes(max(0, size - 256))
    bench.say(2, ("CCTDP", 1, 1, 0, 0, data.hex()))
    assert bench.lines(2) == [f"CATDP,0,1,1,1,0,0,{size}", f"CATXP,{size}"]
    bench.advance(15.0)
    told = bench.lines(1)
    assert told[0] == "CARXP,1"
    fields = told[1].split(",")
    assert fields[:6] == ["CARDP", "2", "1", "1", "0", "0"]
    parts = (fields[6] + (";" + fields[7] if fields[7] else "")).split(";")
    assert [(int(crc), int(count)) for crc, count in zip(parts[::3], parts[1::3], strict=True)] == [
        (1, n) for n in groups
    ]
    assert bytes.fromhex("".join(parts[2::3])) == data
    assert told[2].split(",")[18] == "5"
    assert [line.split(",")[0] for line in bench.lines(2)] == ["CATXF", "CAXST"]


def test_flexible_data_is_refused_where_there_is_none():
    bench = Bench(generation=1)
    bench.say(1, ("CCTDP", 2, 1, 0, 0, "AA"), ("CCTMQ", 0))
    assert bench.lines(1) == ["CAERR,090001,NMEA,2,unknown CCTDP", "CAERR,090001,NMEA,2,unknown CCTMQ"]
    bench = Bench()
    for bad in ((2, 2, 0, 0, "AA"), (2, 1, 0, 0, ""), (2, 1, 0, 0, "AA" * 283)):
        bench.say(1, ("CCTDP", *bad))
    assert [line.split(",")[4] for line in bench.lines(1)] == ["CCTDP bad rate", "CCTDP bad length", "CCTDP bad length"]


def test_lost_flexible_data_is_told_as_bad():
    bench = Bench(frame_loss=1.0)
    bench.say(1, ("CCTDP", 2, 1, 0, 0, "AABB"))
    bench.advance(15.0)
    told = bench.lines(2)
    assert told[1] == "CARDP,1,2,1,0,0,0;2;0000,"
    assert told[2].split(",")[2] == "1"


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
    world = ChannelSimulator(ChannelParameters(), places, transponders=transponders)
    world.advance(1.0)
    for number in places:
        world.take_outputs(number)
    beacons = ("1", "1", "1", "0") if kind == "PDT" else ("25000", "26000", "27000", "0")
    command = ("CCPDT", 1, 2, 0, 0, 1383, *beacons) if kind == "PDT" else ("CCPNT", 26000, 5, 5, 1383, *beacons, 1)
    for _ in range(2):
        world.receive(1, nmea.format(str(command[0]), *command[1:]), 1.0)
    world.advance(2.38)
    told = b"".join(output.data for output in world.take_outputs(1))
    assert told == nmea.format(f"SN{kind}", *command[1:]) + nmea.format(
        "CAERR", "090001", "CYCLE", 4, f"CC{kind} while busy"
    )
    world.advance(2.3831)
    told = b"".join(output.data for output in world.take_outputs(1))
    assert told == nmea.format("SNTTA", "0.2000", "0.4000", "", "", "090001.0000"), "C is too far, D was not asked"
    assert world.take_outputs(2) == [], "a ping is no packet"


def test_a_ping_measures_the_travel_time_and_a_mini_packet_carries_13_bits():
    bench = Bench()
    bench.say(1, ("CCMPC", 1, 2))
    bench.advance(5.0)
    assert [line for line in bench.lines(2) if not line.startswith("CACST")] == [
        "CARXP,0",
        "CAMPA,1,2",
        "CATXP,0",
        "CATXF,0",
    ]
    told = bench.lines(1)
    sent = ["CATXP,0", "CATXF,0", "CARXP,0"]
    assert [line for line in told if not line.startswith("CACST")] == ["CAMPC,1,2", *sent, "CAMPR,2,1,0.1000"]
    bench.say(1, ("CCMUC", 1, 2, "1a2b"))
    bench.advance(9.0)
    assert "CAMUA,1,2,1A2B" in bench.lines(2)
    assert [line for line in bench.lines(1) if not line.startswith("CACST")] == [
        "CAMUC,1,2,1A2B",
        *sent,
        "CAMUR,2,1",
    ]
