"""Start-up and driver test of Goby3, step by step, on the emulator; see `goby_host`."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

import pytest
from builders.goby_host import FRAME_BYTES, Delivery, GobyHost

from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.parameters import ChannelParameters
from sonarpost.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.simulation.modem.settings import EmulatedModemConfig

RANGE_M = 150.0
SETTINGS = ("AGC,0", "AGN,0")


class Pair:
    """Two hosts on two modems, as in the test program of Goby."""

    def __init__(self, mm: int, start_utc: datetime = datetime(2024, 2, 29, 23, 59, 51, 430_000, tzinfo=UTC)) -> None:
        start_utc_s = start_utc.timestamp()
        places = {
            n: PlacedModem(EmulatedModemConfig(n, mm, utc_at_zero_s=start_utc_s), LocalPosition(RANGE_M * (n - 1)))
            for n in (1, 2)
        }
        transponders = {"A": LocalPosition(300.0), "B": LocalPosition(450.0)}
        self.simulator = ChannelSimulator(ChannelParameters(), places, transponders=transponders)
        settings = SETTINGS + (("psk.packet.mod_hdr_version,0",) if mm == 2 else ())
        self.hosts = {n: GobyHost(n, mm, start_utc_s, settings) for n in (1, 2)}
        self.now = 0.0

    def run(self, limit_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Run for a time, or until a condition holds."""
        end_s = self.now + limit_s
        while self.now < end_s:
            self.now = round(self.now + 0.1, 6)
            self.simulator.advance(self.now)
            for n, host in self.hosts.items():
                host.work(self.now, b"".join(output.data for output in self.simulator.take_outputs(n)))
                data, host.to_modem = host.to_modem, b""
                self.simulator.receive(n, data, self.now)
            if until():
                return True
        return False

    def delivered(self, n: int) -> list[Delivery]:
        got, self.hosts[n].delivered = self.hosts[n].delivered, []
        return got


@pytest.fixture(params=[1, 2])
def tester(request: pytest.FixtureRequest) -> Pair:
    mm: int = request.param
    tester = Pair(mm)
    hosts = tester.hosts.values()
    assert tester.run(30.0, lambda: all(host.started for host in hosts)), "both drivers start"
    tester.run(3.0)
    for host in hosts:
        assert host.given_up == []
        assert host.resent == 0
    return tester


def test_start_up_configures_modem_and_clock(tester: Pair):
    tester.run(60.0)
    for n, host in tester.hosts.items():
        assert {"SRC": str(n), "CST": "1", "REV": "1", "RXP": "1", "AGC": "0"}.items() <= host.nvram.items()
        assert host.clock_set
        assert host.clock_settings == 1
        assert not host.dead
        assert (host.given_up, host.resent) == ([], 0)
        assert host.major in {0, 2}
        assert not [line for line in host.raw if line.startswith("$CAERR")]


@pytest.mark.parametrize("second", [58, 59])
def test_clock_set_at_the_end_of_a_minute(second: int):
    for tenths in range(0, 10, 3):
        tester = Pair(1, datetime(2024, 12, 31, 23, 59, second - 6, tenths * 100_000, tzinfo=UTC))
        assert tester.run(30.0, lambda t=tester: all(host.started for host in t.hosts.values()))
        assert all(host.given_up == [] for host in tester.hosts.values())


def test_configuration_dump_ends_by_silence(tester: Pair):
    tester.run(15.0)
    host = tester.hosts[1]
    host.nvram.clear()
    host.query_everything()
    assert tester.run(10.0, lambda: not host._out)
    assert len(host.nvram) > 50
    assert host.resent == 0


def test_ping(tester: Pair):
    tester.hosts[1].ping(2)
    tester.run(10.0)
    assert tester.delivered(2) == [Delivery("ping", 1, 2, modes=[0])]
    assert tester.delivered(1) == [Delivery("ping", 2, 1, travel_times_s=[0.1], modes=[0])]


def test_remus_and_narrow_band_ranging(tester: Pair):
    for kind, ask in (
        ("remus", lambda: tester.hosts[1].range_remus(1000.0)),
        ("narrow", lambda: tester.hosts[1].range_narrow(1000.0, 20)),
    ):
        ask()
        assert tester.run(10.0, lambda: bool(tester.hosts[1].delivered)), kind
        (got,) = tester.delivered(1)
        times_s = [0.2, 0.3, None, None] if kind == "remus" else [0.2, None, None, None]
        assert (got.kind, got.src, got.dest, got.travel_times_s) == (kind, 1, None, times_s)
        h, m, s = int(got.modem_time[:2]), int(got.modem_time[2:4]), float(got.modem_time[4:])
        now = tester.hosts[1].true_at_zero.timestamp() + tester.now
        assert abs((h * 3600 + m * 60 + s) - now % 86400) < 2.0
    assert tester.hosts[1].given_up == []


def test_mini_packet(tester: Pair):
    tester.hosts[2].mini(1, bytes.fromhex("0123"))
    tester.run(10.0)
    assert tester.delivered(1) == [Delivery("mini", 2, 1, frames=[b"\x01\x23"], modes=[0])]
    assert tester.delivered(2) == [], "Goby delivers an empty message for every CACST"
    kinds = [line[1:6] for line in tester.hosts[2].raw]
    first = kinds.index("CAMUC")
    assert [kind for kind in kinds[first:] if kind != "CAREV"] == ["CAMUC", "CATXP", "CATXF", "CARXP", "CAMUR"]
    kinds = [line[1:6] for line in tester.hosts[1].raw]
    first = kinds.index("CARXP")
    assert [k for k in kinds[first:] if k != "CAREV"] == ["CARXP", "CAMUA", "CACST", "CATXP", "CATXF"]


@pytest.mark.parametrize(("rate", "frames"), [(0, 1), (2, 3), (5, 8)])
@pytest.mark.parametrize("again", [1, 3])
def test_data_with_acknowledgement(tester: Pair, rate: int, frames: int, again: int):
    data = [bytes((n * 64 + i) % 256 for i in range(FRAME_BYTES[rate])) for n in range(frames)]
    for _ in range(again):
        tester.hosts[1].send(2, rate, data, ack=True)
        tester.run(15.0)
        modes = [0] * (1 + (rate == 0))
        assert tester.delivered(2) == [Delivery("data", 1, 2, frames=data, modes=modes)]
        assert tester.delivered(1) == [Delivery("ack", 2, 1, acked=list(range(frames)), modes=[0])]
        assert tester.hosts[1].results == 1
        tester.hosts[1].results = 0
    assert tester.hosts[1].given_up == tester.hosts[2].given_up == []
    assert tester.hosts[1].resent == 0


@pytest.mark.parametrize("rate", [0, 2])
def test_polling(tester: Pair, rate: int):
    tester.hosts[2].uplink = [b"polled".ljust(FRAME_BYTES[rate], b".")]
    tester.hosts[1].poll_for(2, rate)
    tester.run(25.0)
    (got,) = [d for d in tester.delivered(1) if d.kind == "data"]
    assert (got.src, got.dest, got.frames) == (2, 1, tester.hosts[2].uplink)
    (acked,) = [d for d in tester.delivered(2) if d.kind == "ack"]
    assert acked.acked == [0]
    assert tester.hosts[1].given_up == tester.hosts[2].given_up == []


def test_flexible_data():
    tester = Pair(2)
    assert tester.run(30.0, lambda: all(host.started for host in tester.hosts.values()))
    for host in tester.hosts.values():
        host.configure("psk.packet.mod_hdr_version,1")
    data = bytes.fromhex("00112233445566778899001122334455667788990011")
    tester.hosts[2].flexible(1, 1, data)
    tester.run(10.0)
    assert tester.delivered(1) == [Delivery("flexible", 2, 1, 1, frames=[data], modes=[0])]
    assert tester.hosts[2].nvram["psk.packet.mod_hdr_version"] == "1"
    assert tester.hosts[2].given_up == []
