import logging
import os
import pty
import queue
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial

from sonarpost.errors import ConfigError, PortError
from sonarpost.runtime.serial_port import PortEvent, PortLost, PortOpened, SerialPort


class PortEvents:
    """The events of a port, one by one."""

    def __init__(self, port: SerialPort) -> None:
        self.events: queue.SimpleQueue[PortEvent] = queue.SimpleQueue()
        port.start(self.events.put)

    def next(self, timeout_s: float = 5.0) -> PortEvent:
        return self.events.get(timeout=timeout_s)

    def data(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            item = self.next()
            assert isinstance(item, bytes), item
            data += item
        return data


class PtyPort:
    """A pseudo-terminal with a symbolic link to its slave, like the udev name of an adapter."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.master = -1

    def plug(self) -> None:
        self.master, slave = pty.openpty()
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def unplug(self) -> None:
        if self.master >= 0:
            self.path.unlink()
            os.close(self.master)
            self.master = -1


@pytest.fixture
def pty_port(tmp_path: Path) -> Iterator[PtyPort]:
    pty_port = PtyPort(tmp_path / "ttyMODEM")
    pty_port.plug()
    yield pty_port
    pty_port.unplug()


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(5.0)
        yield listening


def eventually(condition: Callable[[], bool], timeout_s: float = 120.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "condition not met in time"
        time.sleep(0.005)


def make_port(url: str, **options: float) -> SerialPort:
    return SerialPort(url, first_retry_s=0.02, max_retry_s=0.1, **options)


def test_a_pty_transfers_bytes_in_both_directions(pty_port: PtyPort) -> None:
    port = make_port(str(pty_port.path))
    events = PortEvents(port)
    try:
        assert events.next() == PortOpened()
        assert port.is_open
        assert port.error is None
        every_byte = bytes(range(256))
        os.write(pty_port.master, every_byte)
        assert events.data(256) == every_byte
        port.write(every_byte)
        received = b""
        while len(received) < 256:
            received += os.read(pty_port.master, 4096)
        assert received == every_byte
    finally:
        port.close()
    assert not port.is_open


def test_an_unplugged_pty_is_reported_and_opened_again(
    pty_port: PtyPort, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO, "sonarpost.runtime.serial_port")
    attempts: list[str] = []
    make = serial.serial_for_url
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **options: attempts.append(url) or make(url, **options))
    port = make_port(str(pty_port.path))
    events = PortEvents(port)
    try:
        for round_number in range(3):
            assert events.next() == PortOpened()
            os.write(pty_port.master, b"round %d" % round_number)
            assert events.data(7) == b"round %d" % round_number
            pty_port.unplug()
            lost = events.next()
            assert isinstance(lost, PortLost)
            assert lost.reason
            assert not port.is_open
            with pytest.raises(PortError, match="ttyMODEM"):
                port.write(b"x")
            attempts.clear()
            eventually(lambda: len(attempts) >= 3)
            assert port.error is not None
            assert "No such file" in port.error
            pty_port.plug()
        assert events.next() == PortOpened()
    finally:
        port.close()
    texts = [record.getMessage() for record in caplog.records]
    assert sum("Port cannot be opened" in text for text in texts) == 3, (
        "logged once a change of state, not once an attempt"
    )
    assert sum("Port lost" in text for text in texts) == 3
    assert sum("Port open" in text for text in texts) == 4
    assert all(record.fields["port"] == str(pty_port.path) for record in caplog.records)


def test_a_port_that_appears_later_is_opened(pty_port: PtyPort) -> None:
    pty_port.unplug()
    port = make_port(str(pty_port.path))
    events = PortEvents(port)
    try:
        with pytest.raises(queue.Empty):
            events.next(timeout_s=0.2)
        with pytest.raises(PortError, match="not open"):
            port.write(b"x")
        pty_port.plug()
        assert events.next() == PortOpened()
    finally:
        port.close()


@pytest.mark.parametrize("reset", [False, True], ids=["end of stream", "reset"])
def test_a_socket_is_opened_again_after_it_was_closed(server: socket.socket, reset: bool) -> None:
    host, number = server.getsockname()
    port = make_port(f"socket://{host}:{number}")
    events = PortEvents(port)
    try:
        for _ in range(2):
            connection, _address = server.accept()
            assert events.next() == PortOpened()
            connection.sendall(b"$CAREV,181807,AUV,2.0.27087*12\r\n")
            assert events.data(32) == b"$CAREV,181807,AUV,2.0.27087*12\r\n"
            port.write(b"hello")
            assert connection.recv(100) == b"hello"
            if reset:
                linger_zero = b"\x01\x00\x00\x00\x00\x00\x00\x00"
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger_zero)
            connection.close()
            assert isinstance(events.next(), PortLost)
    finally:
        port.close()


def test_an_absent_server_is_retried(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        number = listening.getsockname()[1]
    port = make_port(f"socket://127.0.0.1:{number}")
    events = PortEvents(port)
    try:
        with pytest.raises(queue.Empty):
            events.next(timeout_s=0.4)
        assert "refused" in (port.error or "")
        assert sum("cannot be opened" in record.getMessage() for record in caplog.records) == 1
        with socket.create_server(("127.0.0.1", number)):
            assert events.next() == PortOpened()
    finally:
        port.close()


def test_retries_slow_down_when_the_server_closes_each_connection(server: socket.socket) -> None:
    host, number = server.getsockname()
    port = SerialPort(f"socket://{host}:{number}", first_retry_s=0.05, max_retry_s=0.2)
    events = PortEvents(port)
    server.settimeout(0.05)
    accepted, end_s = 0, time.monotonic() + 1.0
    while time.monotonic() < end_s:
        try:
            server.accept()[0].close()
            accepted += 1
        except TimeoutError:
            pass
    port.close()
    assert 2 <= accepted <= 8
    assert events.next() == PortOpened()


def test_a_blocked_write_ends_with_an_error(server: socket.socket) -> None:
    host, number = server.getsockname()
    port = make_port(f"socket://{host}:{number}", write_timeout_s=0.3)
    events = PortEvents(port)
    try:
        assert events.next() == PortOpened()
        connection, _ = server.accept()
        with pytest.raises(PortError, match="cannot be written"):
            port.write(bytes(64 * 1024 * 1024))
        assert isinstance(events.next(), PortLost)
        connection.close()
    finally:
        port.close()


def test_a_loop_url_works_without_a_descriptor() -> None:
    port = make_port("loop://")
    events = PortEvents(port)
    try:
        assert events.next() == PortOpened()
        port.write(b"loopback!")
        assert events.data(9) == b"loopback!"
    finally:
        port.close()


@pytest.mark.parametrize("state", ["open", "opening"])
def test_close_returns_at_once_and_stops_events(pty_port: PtyPort, state: str) -> None:
    if state == "opening":
        pty_port.unplug()
    port = SerialPort(str(pty_port.path), first_retry_s=5.0)
    events = PortEvents(port)
    if state == "open":
        assert events.next() == PortOpened()
    start_s = time.monotonic()
    port.close()
    assert time.monotonic() - start_s < 1.0
    with pytest.raises(PortError):
        port.write(b"x")
    with pytest.raises(queue.Empty):
        events.next(timeout_s=0.3)
    port.close()


def test_a_closed_port_can_be_started_again(pty_port: PtyPort) -> None:
    port = make_port(str(pty_port.path))
    for _ in range(3):
        events = PortEvents(port)
        assert events.next() == PortOpened()
        with pytest.raises(PortError, match="already started"):
            port.start(events.events.put)
        os.write(pty_port.master, b"again")
        assert events.data(5) == b"again"
        port.close()


@pytest.mark.parametrize(("url", "baud"), [("gopher://x:1", 19200), ("/dev/ttyS0", -1)])
def test_an_invalid_url_or_baud_rate_is_a_configuration_error(url: str, baud: int) -> None:
    with pytest.raises(ConfigError, match="modem port: url or baud"):
        SerialPort(url, baud)
