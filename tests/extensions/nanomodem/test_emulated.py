"""The emulated nanomodem: its commands and its packets in the channel."""

import pytest

from sonarpost.extensions.nanomodem.rates import airtime_s
from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.parameters import build_parameters
from sonarpost.extensions.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.extensions.simulation.modem.packet_modem import PacketModemSettings

RANGE_M = 150.0
STEPS = round(RANGE_M / 1500.0 / 31.25e-6)


class Bench:
    """Modems 1, 2, … with 150 m between neighbours."""

    def __init__(self, modems: int = 2, **parameters: float) -> None:
        places = {
            n: PlacedModem(PacketModemSettings("nano", n), LocalPosition(RANGE_M * (n - 1)))
            for n in range(1, modems + 1)
        }
        self.simulator = ChannelSimulator(build_parameters(dict(parameters), "test"), places)
        self.now = 0.0

    def say(self, modem: int, data: bytes) -> None:
        self.simulator.receive(modem, data, self.now)

    def output(self, modem: int, after_s: float = 0.0) -> bytes:
        self.now += after_s
        self.simulator.advance(self.now)
        return b"".join(output.data for output in self.simulator.take_outputs(modem))


def test_status_and_address() -> None:
    bench = Bench()
    bench.say(1, b"$?")
    assert bench.output(1) == b"#A001V21845\r\n"
    bench.say(1, b"$A0")
    assert bench.output(1) == b""
    bench.say(1, b"17$?")
    assert bench.output(1) == b"#A017\r\n#A017V21845\r\n"


def test_broadcast_arrives_everywhere_after_its_air_time() -> None:
    bench = Bench(3)
    bench.say(1, b"$B08a\r\n$B02x$?")
    assert bench.output(1) == b"$B08\r\n#A001V21845\r\n"
    assert bench.output(2, airtime_s(8) + 0.05) == b"", "on the way"
    assert bench.output(2, 0.1) == b"#B00108a\r\n$B02x\r\n"
    assert bench.output(3, 0.2) == b"#B00108a\r\n$B02x\r\n"


def test_unicast_with_and_without_acknowledgement() -> None:
    bench = Bench(3)
    bench.say(1, b"$U00205hello")
    assert bench.output(1, 2.0) == b"$U00205\r\n"
    assert bench.output(2) == b"#U05hello\r\n"
    assert bench.output(3) == b""
    bench.say(1, b"$M00205again")
    assert bench.output(1, 2.0) == b"$M00205\r\n#R002T%05d\r\n" % STEPS
    assert bench.output(2) == b"#U05again\r\n"


def test_ping_measures_the_range() -> None:
    bench = Bench()
    bench.say(1, b"$P002")
    assert bench.output(1, 1.0) == b"$P002\r\n#R002T%05d\r\n" % STEPS


@pytest.mark.parametrize("command", [b"$P009", b"$M00902xy"])
def test_timeout_without_an_answer(command: bytes) -> None:
    bench = Bench()
    bench.say(1, command)
    assert bench.output(1, 3.0) == command[:7].removesuffix(b"x") + b"\r\n"
    assert bench.output(1, 3.0) == b"#TO\r\n"
    bench.say(1, command)
    bench.output(1, 2.0)
    bench.say(1, b"$?")
    assert bench.output(1, 10.0) == b"#A001V21845\r\n", "a command ends the wait"


def test_lost_packet_and_lost_answer() -> None:
    bench = Bench(frame_loss=1.0)
    bench.say(1, b"$B02xy")
    bench.say(2, b"$P001")
    assert bench.output(1, 10.0) == b"$B02\r\n"
    assert bench.output(2) == b"$P001\r\n#TO\r\n"


@pytest.mark.parametrize(
    "command",
    [b"$B01a", b"$B65" + bytes(65), b"$B00", b"$U00102xy", b"$M00102xy", b"$P001", b"$P256", b"$A256", b"$Zxxxxx"],
)
def test_refused_command(command: bytes) -> None:
    bench = Bench()
    bench.say(1, b"noise" + command + b"$?")
    assert bench.output(1, 5.0) == b"E\r\n#A001V21845\r\n"
