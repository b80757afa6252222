"""Messages to systemd, received on a socket like systemd's."""

import logging
import os
import signal
import socket
import subprocess
import sys

import pytest
from builders.common import free_port

from sonarpost.monitoring.service_manager import ServiceManager


@pytest.fixture
def manager_socket(tmp_path):
    """Return systemd's end of the socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(tmp_path / "notify"))
        bound.settimeout(120)
        yield bound


def sender(tmp_path, interval_s=5.0, **variables):
    return ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "notify"), **variables}, interval_s)


def received(bound):
    return bound.recv(4096).decode().splitlines()


def test_messages_have_the_documented_fields(manager_socket, tmp_path):
    manager = sender(tmp_path)
    manager.ready("started")
    assert received(manager_socket) == ["READY=1", "STATUS=started"]
    manager.alive("degraded: no modem\nREADY=0")
    assert received(manager_socket) == ["WATCHDOG=1", "STATUS=degraded: no modem READY=0"]
    manager.stopping()
    assert received(manager_socket) == ["STOPPING=1", "STATUS=stopping"]


@pytest.mark.parametrize(
    ("watchdog_us", "interval_s", "extended"),
    [("60000000", 5.0, []), ("60000000", 60.0, ["WATCHDOG_USEC=180000000"]), ("", 60.0, []), ("never", 60.0, [])],
)
def test_a_watchdog_time_below_the_interval_is_extended(watchdog_us, interval_s, extended, manager_socket, tmp_path):
    sender(tmp_path, interval_s, WATCHDOG_USEC=watchdog_us).ready("started")
    assert received(manager_socket)[2:] == extended


def test_an_abstract_socket_is_supported(tmp_path):
    name = f"sonarpost-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(f"\0{name}")
        sender(tmp_path, NOTIFY_SOCKET=f"@{name}").stopping()
        assert received(bound)[0] == "STOPPING=1"


def test_an_absent_manager_is_logged_once(tmp_path, caplog):
    manager = sender(tmp_path)
    with caplog.at_level(logging.WARNING):
        manager.alive("ok")
        manager.alive("ok")
        ServiceManager({}, 5.0).alive("ok")
    assert [record.message for record in caplog.records] == ["systemd not notified"]


@pytest.mark.system
def test_a_router_notifies_systemd(manager_socket, tmp_path):
    command = [sys.executable, "-m", "sonarpost.bus.router", "--listen", f"tcp/127.0.0.1:{free_port()}"]
    environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as process:
        try:
            assert received(manager_socket)[0] == "READY=1"
            assert received(manager_socket) == ["WATCHDOG=1", "STATUS=ok: 0 links"]
            process.send_signal(signal.SIGTERM)
            assert received(manager_socket)[0] == "STOPPING=1"
        finally:
            process.kill()
