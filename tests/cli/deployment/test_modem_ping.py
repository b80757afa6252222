"""`sonarpost modem ping` with emulated modems."""

import fcntl
import os
import pty
import re
import socket
from collections.abc import Callable
from functools import partial

import pytest

from sonarpost.cli.deployment import modem_ping
from sonarpost.cli.main import main
from sonarpost.extensions.simulation.channel.config import EmulatorConfig
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.modem.micromodem import driver
from sonarpost.modem.micromodem.config import MicroModemConfig

Emulate = Callable[..., list[str]]


@pytest.fixture
def emulate():
    """Start emulated modems with addresses 1, 2, … 300 m apart; return their URLs."""
    started: list[ChannelEmulator] = []

    def start(count=2, **settings):
        modems = [{"address": number + 1, "east_m": 300.0 * number} for number in range(count)]
        values = {"modem": modems, "tcp_ports": (0,) * count, "time_scale": 20.0, **settings}
        emulator = ChannelEmulator(EmulatorConfig.model_validate(values))
        emulator.start()
        started.append(emulator)
        return [device.device for device in emulator.devices()]

    yield start
    for emulator in started:
        emulator.stop()


def ping(port, *options, destination=2):
    return main(["modem", "ping", "--port", port, "--address", "1", "--destination", str(destination), *options])


def test_the_travel_time_to_the_other_modem_is_printed(emulate, capsys):
    assert ping(emulate()[0], "--count", "2") == 0
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"modem ready: address 1, firmware (unknown|[\d.]+)", lines[0])
    assert lines[1:3] == [
        "ping 1: one way 0.2000 s, 300.0 m at 1500 m/s",
        "ping 2: one way 0.2000 s, 300.0 m at 1500 m/s",
    ]
    assert lines[3] == "2 of 2 pings answered"


def test_a_modem_that_does_not_answer_is_status_1(emulate, capsys, monkeypatch):
    monkeypatch.setattr(driver, "MicroModemConfig", partial(MicroModemConfig, poll_wait_s=0.1, ack_wait_s=0.1))
    assert ping(emulate()[0], "--count", "1", destination=9) == 1
    assert capsys.readouterr().out.splitlines()[1:] == [
        "ping 1: not answered (no answer from the far modem)",
        "0 of 1 pings answered",
    ]


def test_a_silent_serial_line_is_status_2(capsys):
    with socket.create_server(("127.0.0.1", 0)) as server:  # accepts connections in its backlog, and sends nothing
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        assert ping(url, "--wait", "0.2") == 2
    assert capsys.readouterr().err == f"sonarpost: {url}: the modem does not reply\n"


def test_an_absent_port_is_status_2(capsys):
    assert ping("/dev/absent", "--wait", "0.1") == 2
    assert "sonarpost: /dev/absent: " in capsys.readouterr().err


def test_a_port_in_use_is_status_2_at_once(capsys):
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    fcntl.flock(slave, fcntl.LOCK_EX)
    try:
        assert ping(path, "--wait", "1e9") == 2
    finally:
        os.close(slave)
        os.close(master)
    err = capsys.readouterr().err
    assert err.startswith(f"sonarpost: {path}: in use by ")
    assert err.endswith(f" (process {os.getpid()})\n")


def test_an_invalid_destination_is_refused(capsys):
    for destination in (1, 128, -1):
        assert ping("loop://", destination=destination) == 2
        assert f"--destination: got {destination}, expected 0..127, another one" in capsys.readouterr().err


def test_a_ping_without_any_event_ends(monkeypatch, emulate, capsys):
    monkeypatch.setattr(modem_ping, "PING_TIMEOUT_S", 0.0)
    assert ping(emulate()[0], "--count", "1") == 1
    assert "ping 1: not answered (no end of the request)" in capsys.readouterr().out
