"""Messages to systemd, received on a socket like systemd's."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from builders.common import free_port

from sonarpost.monitoring.service_manager import ServiceManager


@pytest.fixture
def manager_socket(tmp_path: Path) -> Iterator[socket.socket]:
    """Return systemd's end of the socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(tmp_path / "notify"))
        bound.settimeout(30)
        yield bound


def sender(tmp_path: Path, interval_s: float = 5.0, **variables: str) -> ServiceManager:
    return ServiceManager.from_environment({"NOTIFY_SOCKET": str(tmp_path / "notify"), **variables}, interval_s)


def received(bound: socket.socket) -> list[str]:
    return bound.recv(4096).decode().splitlines()


def test_messages_have_the_documented_fields(manager_socket: socket.socket, tmp_path: Path) -> None:
    manager = sender(tmp_path)
    manager.starting("waiting for the router tcp/a:1")
    assert received(manager_socket) == ["STATUS=waiting for the router tcp/a:1"]
    manager.ready("started")
    assert received(manager_socket) == ["READY=1", "STATUS=started"]
    manager.alive("degraded: no modem\nREADY=0")
    assert received(manager_socket) == ["WATCHDOG=1", "STATUS=degraded: no modem READY=0"]
    manager.stopping()
    assert received(manager_socket) == ["STOPPING=1", "STATUS=stopping"]


@pytest.mark.parametrize(
    ("watchdog_us", "interval_s", "extended"),
    [
        ("60000000", 5.0, []),
        ("60000000", 60.0, ["WATCHDOG_USEC=180000000"]),
        ("", 60.0, []),
        ("never", 60.0, []),
    ],
)
def test_a_watchdog_time_below_the_interval_is_extended(
    watchdog_us: str, interval_s: float, extended: list[str], manager_socket: socket.socket, tmp_path: Path
) -> None:
    sender(tmp_path, interval_s, WATCHDOG_USEC=watchdog_us).ready("started")
    assert received(manager_socket)[2:] == extended


def test_an_abstract_socket_is_supported(tmp_path: Path) -> None:
    name = f"sonarpost-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(f"\0{name}")
        sender(tmp_path, NOTIFY_SOCKET=f"@{name}").stopping()
        assert received(bound)[0] == "STOPPING=1"


def test_an_absent_manager_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    manager = sender(tmp_path)
    with caplog.at_level(logging.WARNING):
        manager.alive("ok")
        manager.alive("ok")
        ServiceManager.from_environment({}, 5.0).alive("ok")
    assert [record.message for record in caplog.records] == ["systemd not notified"]


def test_a_router_notifies_systemd(manager_socket: socket.socket, tmp_path: Path) -> None:
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
