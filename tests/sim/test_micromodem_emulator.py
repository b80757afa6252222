"""The emulated Micro-Modem: exact sentences, and no bytes that break it."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.modem import nmea
from sonarpost.modem.config import MicroModemConfig
from sonarpost.modem.events import (
    Event,
    ModemComplained,
    ModemRebooted,
    ModemUnresponsive,
    PacketFailed,
    PacketReceived,
    PacketSent,
    SentenceRejected,
)
from sonarpost.modem.micromodem import MicroModem
from sonarpost.modem.rates import RATES
from sonarpost.sim.acoustic_world import AcousticWorld, ModemPlace
from sonarpost.sim.micromodem import Micromodem
from sonarpost.sim.micromodem_config import ModemConfig, Report
from sonarpost.sim.serial_pace import SerialPace
from sonarpost.sim.water_config import WaterConfig
from sonarpost.sim.water_physics import Position
from sonarpost.sim.water_records import Transmission

START_UTC_S = datetime(2016, 10, 12, 9, 0, 0, tzinfo=UTC).timestamp()
RANGE_M = 150.0


class Bench:
    """Modems 150 m apart in one water, with what each told its host."""

    def __init__(self, modems: int = 2, serial_baud: float | None = None, **config: object) -> None:
        water = {name: config.pop(name) for name in list(config) if name in WaterConfig.__dataclass_fields__}
        places = {
            n: ModemPlace(ModemConfig(n, utc_at_zero_s=START_UTC_S, **config), Position(RANGE_M * (n - 1)))  # type: ignore[arg-type]
            for n in range(1, modems + 1)
        }
        self.world = AcousticWorld(WaterConfig(**water), places, serial_baud)  # type: ignore[arg-type]
        self.told = dict.fromkeys(places, b"")
        self.reports: list[Report] = []
        self.transmissions: list[Transmission] = []
        self.now = 0.0
        self.advance(1.0)
        self.clear()

    def advance(self, now: float) -> None:
        self.now = now
        for happened in self.world.advance(now):
            (self.reports if isinstance(happened, Report) else self.transmissions).append(happened)  # type: ignore[arg-type]
        for n in self.told:
            for output in self.world.take_outputs(n):
                self.told[n] += output.data
                if output.report:
                    self.reports.append(output.report)

    def say(self, modem: int, *sentences: tuple[str | int, ...]) -> None:
        for kind, *fields in sentences:
            self.world.receive(modem, nmea.format(str(kind), *fields), self.now)
            self.advance(self.now)

    def clear(self) -> None:
        self.told = dict.fromkeys(self.told, b"")

    def lines(self, modem: int) -> list[str]:
        """What the host was told since the last call, without checksums, which are checked."""
        told, self.told[modem] = self.told[modem], b""
        assert told == b"" or told.endswith(b"\r\n")
        shown = []
        for line in told.split(b"\r\n")[:-1]:
            body, _, digits = line[1:].partition(b"*")
            assert digits == b"%02X" % nmea.checksum(body), line
            shown.append(body.decode())
        return [line for line in shown if not line.startswith("CAREV")]


def cst(clock: str, rate: int, *, kind: int = 3, frames: int, bad: int = 0, mode: int = 0) -> str:
    """The statistics of a packet from 1 to 2 at 150 m; the levels follow the range and the first packet's draw."""
    psk = kind == 3
    error = 3 if bad and psk else 0
    snr = "15.4,12.41,-100,-12.41,-01" if psk else "15.4,-100,-100,-100,195"
    head = f"CACST,6,{mode},{clock},05,25158,40,0131,0141,07,00,00,00,00,{rate},001,002"
    return f"{head},{error},{kind},{frames},{bad},141,{snr},0.00,51,25000,5000"


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
    assert bench.reports[-1].untold == "cycle header missed"


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
    assert bench.reports[-1].untold == "RXA is off"


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
    places = {1: ModemPlace(ModemConfig(1, utc_at_zero_s=START_UTC_S)), 2: ModemPlace(ModemConfig(2), Position(50.0))}
    transponders = {"A": Position(300.0), "B": Position(0.0, 600.0), "C": Position(5000.0), "D": Position(30.0)}
    world = AcousticWorld(WaterConfig(), places, transponders=transponders)
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
        f"CAMSG,BAD_CRC,{f.number}" if f.fate.value == "lost" else f"CARXD,1,2,0,{f.number},{f.sent.hex().upper()}"
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
    assert [(r.untold, r.arrival.frames[0].fate.value) for r in at_2] == [("collision", "lost")] * 2


def test_a_transmitting_modem_hears_nothing():
    bench = Bench()
    for modem, other in ((1, 2), (2, 1)):
        bench.say(modem, ("CCCYC", 0, modem, other, 1, 0, 1), ("CCTXD", modem, other, 0, "AA"))
    bench.clear()
    bench.advance(9.0)
    for modem in (1, 2):
        assert [line.split(",")[0] for line in bench.lines(modem)] == ["CATXF", "CAXST"]
    assert [report.untold for report in bench.reports] == ["receiver transmitting"] * 2


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
    untold = {report.arrival.receiver: report.untold for report in bench.reports}
    assert untold == {2: None, 3: None if promiscuous else "addressed to another modem"}


def test_a_broadcast_is_shown_to_everybody():
    bench = Bench(modems=3, promiscuous=False)
    bench.say(1, ("CCCYC", 0, 1, 15, 4, 0, 1), ("CCTXD", 1, 15, 0, "AA"))
    bench.advance(9.0)
    for n in (2, 3):
        assert "CARXD,1,15,0,1,AA" in bench.lines(n)


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
    assert [report.untold for report in bench.reports] == [None, "RXD is off"]


def test_the_known_start_up_query_has_the_known_answer():
    modem = Micromodem(ModemConfig(1, utc_at_zero_s=START_UTC_S))
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
    assert bench.reports[-1].untold == "rebooting"
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


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"$CCCFQ,SRC*00\r\n", "NMEA,1,bad checksum"),
        (b"hello\r\n", "NMEA,1,bad sentence"),
        (b"$CCXYZ,1*00\r\n", "NMEA,1,bad checksum"),
        (b"$CCXYZ,1\r\n", "NMEA,2,unknown CCXYZ"),
        (b"$CCCYC,0,1,2,9,0,1\r\n", "NMEA,3,CCCYC bad rate"),
        (b"$CCCYC,0,1,2,1,0,4\r\n", "NMEA,3,CCCYC bad frames"),
        (b"$CCCYC,0,1,2,1,0,0\r\n", "NMEA,3,CCCYC bad frames"),
        (b"$CCMPC,5,2\r\n", "NMEA,3,CCMPC bad source"),
        (b"$CCCYC,0,1,128,1,0,1\r\n", "NMEA,3,CCCYC bad destination"),
        (b"$CCCYC\r\n", "NMEA,3,CCCYC bad rate"),
        (b"$CCCFG,SRC,128\r\n", "NMEA,3,CCCFG bad SRC"),
        (b"$CCCFG,SRC,x\r\n", "NMEA,3,CCCFG bad value"),
        (b"$CCCFG,,1\r\n", "NMEA,3,CCCFG bad name"),
        (b"$CCCFG,ALL,1\r\n", "NMEA,3,CCCFG bad ALL"),
        (b"$CCMSC,1,1,5\r\n", "NMEA,3,CCMSC bad minutes"),
        (b"$CCMUC,1,2,2000\r\n", "NMEA,3,CCMUC bad bits"),
        (b"$CCTXD,1,2,0,ABC\r\n", "NMEA,3,CCTXD bad data"),
    ],
)
def test_what_does_not_parse_is_answered_with_an_error(line: bytes, answer: str):
    modem = Micromodem(ModemConfig(1, utc_at_zero_s=START_UTC_S))
    modem.bytes_to_send()
    modem.receive(line, 2.0)
    assert modem.bytes_to_send() == nmea.format("CAERR", "090002", *answer.split(","))
    assert modem.packets_to_transmit() == []


def test_a_frame_that_is_too_long_is_refused_and_asked_for_no_more():
    bench = Bench()
    bench.say(1, ("CCCYC", 0, 1, 2, 1, 0, 1), ("CCTXD", 1, 2, 0, "AA" * 65))
    assert bench.lines(1)[-1] == "CAERR,090001,NMEA,3,CCTXD bad length"
    bench.say(1, ("CCTXD", 1, 2, 0, "AA" * 64))
    assert bench.lines(1) == ["CATXD,1,2,0,64", "CATXP,64"]


def test_settings_cannot_grow_without_end():
    modem = Micromodem(ModemConfig(1))
    for number in range(2000):
        modem.receive(nmea.format("CCCFG", f"name.{number}", 1), 0.0)
    assert len(modem.settings.items()) == 512


KINDS = ["CCCFG", "CCCFQ", "CCMSC", "CCCLK", "CCCLQ", "CCTMS", "CCTMQ", "CCCYC",
         "CCTXD", "CCTXA", "CCMPC", "CCMUC", "CCTDP", "CCPDT", "CCPNT", "CCALQ"]  # fmt: skip
SENTENCES = st.tuples(
    st.sampled_from(KINDS),
    st.lists(
        st.one_of(st.integers(-2, 130).map(str), st.sampled_from(["", "SRC", "ALL", "DTO", "AABB", "1e5", "٣"[:0]])),
        max_size=8,
    ),
).map(lambda s: nmea.format(s[0], *s[1]))


@given(st.lists(st.tuples(st.sampled_from([1, 2]), st.one_of(st.binary(max_size=80), SENTENCES), st.floats(0, 5))))
def test_no_bytes_break_it(steps: list[tuple[int, bytes, float]]):
    bench = Bench(frame_loss=0.2, tail_damage=0.2)
    for modem, data, pause_s in steps:
        bench.world.receive(modem, data, bench.now)
        bench.advance(bench.now + pause_s)
    bench.advance(bench.now + 400.0)
    for modem in (1, 2):
        assembler = nmea.LineAssembler()
        items = assembler.feed(bench.told[modem])
        assert all(isinstance(item, nmea.Sentence) for item in items)
        assert assembler.pending_bytes == 0
    # Whatever was sent, the modem still lives: a reboot has ended and a query has an answer.
    bench.clear()
    bench.world.receive(1, b"\r\n" + nmea.format("CCCFQ", "SRC"), bench.now)
    bench.advance(bench.now)
    assert bench.lines(1)[-1].startswith("CACFG,SRC,")


@given(st.integers(1, 7), st.integers(0, 2**32))
def test_lateness_of_the_driver_changes_nothing(steps: int, seed: int):
    def run(advances: int) -> tuple[dict[int, bytes], list[Transmission]]:
        bench = Bench(frame_loss=0.3, seed=seed)
        bench.say(1, ("CCCYC", 0, 1, 2, 5, 1, 3), *(("CCTXD", 1, 2, 1, f"{n:02X}" * 20) for n in range(3)))
        for n in range(1, advances + 1):
            bench.advance(1.0 + 24.0 * n / advances)
        return bench.told, bench.transmissions

    assert run(steps) == run(1)


def test_the_serial_line_takes_its_time():
    bench = Bench(serial_baud=19200)
    query = nmea.format("CCCFQ", "SRC")
    bench.world.receive(1, query, 1.0)
    answer = b"$CACFG,SRC,1*33\r\n"
    arrives_s = 1.0 + (len(query) + len(answer)) * 10 / 19200
    bench.advance(arrives_s - 0.0001)
    assert bench.told[1] == b""
    bench.advance(arrives_s + 0.0001)
    assert bench.told[1] == answer


def test_what_is_on_a_serial_line_comes_out_in_order_or_is_dropped():
    line: SerialPace[str] = SerialPace(100)
    line.put("a", 10, 0.0)
    line.put("b", 10, 0.0)
    line.put("c", 10, 5.0)
    assert line.next_s() == 1.0
    assert line.take(1.99) == ["a"]
    assert line.take(5.5) == ["b"]
    assert line.abandon() == ["c"]
    assert line.next_s() is None
    with pytest.raises(ValueError, match="baud"):
        SerialPace(0)


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
        ModemConfig(1, **config)  # type: ignore[arg-type]


def drive(bench: Bench, drivers: dict[int, MicroModem], until_s: float) -> dict[int, list[Event]]:
    """Run the project's own drivers on the emulated modems, without any real time."""
    events: dict[int, list[Event]] = {n: [] for n in drivers}
    while bench.now < until_s:
        for n, driver in drivers.items():
            told, bench.told[n] = bench.told[n], b""
            events[n] += driver.receive(told, bench.now) + driver.poll(bench.now)
            bench.world.receive(n, driver.bytes_to_send(), bench.now)
        bench.advance(round(bench.now + 0.05, 6))
    return events


@pytest.mark.parametrize("rate", sorted(RATES))
@pytest.mark.parametrize("ack", [False, True])
def test_the_driver_gets_along_with_the_emulator(rate: int, ack: bool):
    bench = Bench()
    drivers = {n: MicroModem(MicroModemConfig(n)) for n in (1, 2)}
    for driver in drivers.values():
        driver.start(bench.now)
    drive(bench, drivers, 10.0)
    assert all(driver.ready for driver in drivers.values())
    shape = RATES[rate]
    frames = [bytes([n + 1]) * (shape.frame_bytes - n) for n in range(shape.frames)]
    for n in range(2):
        drivers[1].send_packet(2, rate, frames, ack=ack, now=bench.now + n / 1000)
    events = drive(bench, drivers, 70.0)

    sent = [event for event in events[1] if isinstance(event, PacketSent)]
    assert [event.acknowledged for event in sent] == [tuple(range(1, shape.frames + 1)) if ack else ()] * 2
    assert all(event.statistics is not None and event.statistics.nbytes == sum(map(len, frames)) for event in sent)
    got = [event for event in events[2] if isinstance(event, PacketReceived)]
    assert [[frame.data for frame in packet.frames] for packet in got] == [frames] * 2
    assert all(packet.complete and packet.rate == rate and packet.statistics is not None for packet in got)
    unwanted = (PacketFailed, ModemComplained, SentenceRejected, ModemRebooted, ModemUnresponsive)
    assert not [event for n in events for event in events[n] if isinstance(event, unwanted)]


def test_the_driver_recovers_from_a_reboot_of_the_emulator():
    bench = Bench()
    driver = MicroModem(MicroModemConfig(1))
    driver.start(bench.now)
    drive(bench, {1: driver}, 10.0)
    bench.say(1, ("CCMSC", 1, 1, 0))
    events = drive(bench, {1: driver}, 30.0)[1]
    assert sum(isinstance(event, ModemRebooted) for event in events) == 1
    assert driver.ready
    driver.send_packet(2, 1, [b"after"], now=bench.now)
    drive(bench, {1: driver}, 45.0)
    assert "CARXD,1,2,0,1,6166746572" in bench.lines(2)


def test_the_driver_sees_lost_frames_and_collisions():
    bench = Bench(modems=3, frame_loss=0.4, seed=2)
    drivers = {n: MicroModem(MicroModemConfig(n)) for n in (1, 2, 3)}
    for driver in drivers.values():
        driver.start(bench.now)
    drive(bench, drivers, 10.0)
    frames = [bytes([n]) * 8 for n in range(1, 9)]
    drivers[1].send_packet(2, 5, frames, now=bench.now)
    events = drive(bench, drivers, 20.0)
    (packet,) = (event for event in events[2] if isinstance(event, PacketReceived))
    told = next(r for r in bench.reports if r.arrival.receiver == 2)
    good = [frame.received for frame in told.arrival.frames if frame.fate.value == "delivered"]
    assert [frame.data for frame in packet.frames] == good
    assert packet.bad_frames == 8 - len(good) > 0
    assert not packet.complete
    for n in (1, 3):
        drivers[n].send_packet(2, 1, [b"clash"], now=bench.now)
    events = drive(bench, drivers, 40.0)
    assert not [event for event in events[2] if isinstance(event, PacketReceived) and event.frames]
    assert not drivers[2].receiving
    assert all(driver.ready for driver in drivers.values())
