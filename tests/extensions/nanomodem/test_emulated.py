"""The emulated nanomodem: its commands and its packets in the channel."""

import pytest
from builders.host_sessions import Hosts

from sonarpost.extensions.nanomodem.rates import airtime_s

STEPS = round(0.1 / 31.25e-6)


def test_status_and_address() -> None:
    hosts = Hosts("nano")
    hosts.say(1, b"$?")
    assert hosts.hear(1) == b"#A001V21845\r\n"
    hosts.say(1, b"$A0")
    assert hosts.hear(1) == b""
    hosts.say(1, b"17$?")
    assert hosts.hear(1) == b"#A017\r\n#A017V21845\r\n"


def test_broadcast_arrives_everywhere_after_its_air_time() -> None:
    hosts = Hosts("nano", 3)
    hosts.say(1, b"$B08a\r\n$B02x$?")
    assert hosts.hear(1) == b"$B08\r\n#A001V21845\r\n"
    assert hosts.hear(2, airtime_s(8) + 0.05) == b"", "on the way"
    assert hosts.hear(2, 0.1) == b"#B00108a\r\n$B02x\r\n"
    assert hosts.hear(3, 0.2) == b"#B00108a\r\n$B02x\r\n"


def test_unicast_with_and_without_acknowledgement() -> None:
    hosts = Hosts("nano", 3)
    hosts.say(1, b"$U00205hello")
    assert hosts.hear(1, 2.0) == b"$U00205\r\n"
    assert hosts.hear(2) == b"#U05hello\r\n"
    assert hosts.hear(3) == b""
    hosts.say(1, b"$M00205again")
    assert hosts.hear(1, 2.0) == b"$M00205\r\n#R002T%05d\r\n" % STEPS
    assert hosts.hear(2) == b"#U05again\r\n"


def test_ping_measures_the_range() -> None:
    hosts = Hosts("nano")
    hosts.say(1, b"$P002")
    assert hosts.hear(1, 1.0) == b"$P002\r\n#R002T%05d\r\n" % STEPS


@pytest.mark.parametrize("command", [b"$P009", b"$M00902xy"])
def test_timeout_without_an_answer(command: bytes) -> None:
    hosts = Hosts("nano")
    hosts.say(1, command)
    assert hosts.hear(1, 3.0) == command[:7].removesuffix(b"x") + b"\r\n"
    assert hosts.hear(1, 3.0) == b"#TO\r\n"
    hosts.say(1, command)
    hosts.hear(1, 2.0)
    hosts.say(1, b"$?")
    assert hosts.hear(1, 10.0) == b"#A001V21845\r\n", "a command ends the wait"


def test_lost_packet_and_lost_answer() -> None:
    hosts = Hosts("nano", frame_loss=1.0)
    hosts.say(1, b"$B02xy")
    hosts.say(2, b"$P001")
    assert hosts.hear(1, 10.0) == b"$B02\r\n"
    assert hosts.hear(2) == b"$P001\r\n#TO\r\n"


@pytest.mark.parametrize(
    "command",
    [b"$B01a", b"$B65" + bytes(65), b"$B00", b"$U00102xy", b"$M00102xy", b"$P001", b"$P256", b"$A256", b"$Zxxxxx"],
)
def test_refused_command(command: bytes) -> None:
    hosts = Hosts("nano")
    hosts.say(1, b"noise" + command + b"$?")
    assert hosts.hear(1, 5.0) == b"E\r\n#A001V21845\r\n"
