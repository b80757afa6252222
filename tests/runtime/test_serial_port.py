import errno
import fcntl
import logging
import os
import pty
import queue
import socket
import subprocess
import sys
import termios
import threading
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
import serial
from builders.common import WAIT_S, eventually, free_port

from sonarpost.errors import ConfigError, PortError
from sonarpost.runtime import serial_device, serial_port
from sonarpost.runtime.serial_device import close_port, open_port
from sonarpost.runtime.serial_port import PortEvent, PortLost, PortOpened, SerialPort


class PortEvents:
    """The events of a port, one by one."""

    def __init__(self, port):
        self.events: queue.SimpleQueue[PortEvent] = queue.SimpleQueue()
        port.start(self.events.put)

    def next(self):
        return self.events.get(timeout=WAIT_S)

    def data(self, size):
        data = b""
        while len(data) < size:
            item = self.next()
            assert isinstance(item, bytes), item
            data += item
        return data


class PtyPort:
    """A pseudo-terminal with a symbolic link to its slave, like the udev name of an adapter."""

    def __init__(self, path):
        self.path = path
        self.master = -1

    def plug(self):
        self.master, slave = pty.openpty()
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def unplug(self):
        if self.master >= 0:
            self.path.unlink()
            os.close(self.master)
            self.master = -1


@pytest.fixture
def pty_port(tmp_path):
    pty_port = PtyPort(tmp_path / "ttyMODEM")
    pty_port.plug()
    yield pty_port
    pty_port.unplug()


@pytest.fixture
def server():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(WAIT_S)
        yield listening


@pytest.fixture(autouse=True)
def retries(monkeypatch):
    """Sets the delays after failed attempts to open; at first short ones."""

    def change(first_s, max_s):
        monkeypatch.setattr(serial_port, "FIRST_RETRY_S", first_s)
        monkeypatch.setattr(serial_port, "MAX_RETRY_S", max_s)

    change(0.02, 0.1)
    return change


def test_a_pty_transfers_bytes_in_both_directions(pty_port):
    port = SerialPort(str(pty_port.path))
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


def test_an_unplugged_pty_is_reported_and_opened_again(pty_port, caplog, monkeypatch):
    caplog.set_level(logging.INFO, "sonarpost.runtime.serial_port")
    attempts: list[str] = []
    make = serial.serial_for_url
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **options: attempts.append(url) or make(url, **options))
    port = SerialPort(str(pty_port.path))
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


@pytest.mark.parametrize("reset", [False, True], ids=["end of stream", "reset"])
def test_a_socket_is_opened_again_after_it_was_closed(server, reset):
    host, number = server.getsockname()
    port = SerialPort(f"socket://{host}:{number}")
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


def test_an_absent_server_is_retried(caplog):
    number = free_port()
    port = SerialPort(f"socket://127.0.0.1:{number}")
    events = PortEvents(port)
    try:
        eventually(lambda: port.error is not None)
        assert "refused" in (port.error or "")
        with socket.create_server(("127.0.0.1", number)):
            assert events.next() == PortOpened()
        assert sum("cannot be opened" in record.getMessage() for record in caplog.records) == 1
    finally:
        port.close()


def test_retries_slow_down_when_the_server_closes_each_connection(server, retries, monkeypatch):
    waits: list[float | None] = []

    class QuickEvent(threading.Event):
        def wait(self, timeout=None):
            waits.append(timeout)
            return super().wait(0.001)

    quick = SimpleNamespace(**(vars(threading) | {"Event": QuickEvent}))
    host, number = server.getsockname()
    retries(1000.0, 3000.0)
    port = SerialPort(f"socket://{host}:{number}")
    monkeypatch.setattr(serial_port, "threading", quick)
    port.start(lambda event: None)
    while len(waits) < 3:
        server.accept()[0].close()
    port.close()
    assert waits[:3] == [2000.0, 3000.0, 3000.0]


def test_a_blocked_write_ends_with_an_error(server, monkeypatch):
    monkeypatch.setattr(serial_port, "WRITE_TIMEOUT_S", 0.3)
    host, number = server.getsockname()
    port = SerialPort(f"socket://{host}:{number}")
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


def test_a_loop_url_works_without_a_descriptor():
    port = SerialPort("loop://")
    events = PortEvents(port)
    try:
        assert events.next() == PortOpened()
        port.write(b"loopback!")
        assert events.data(9) == b"loopback!"
    finally:
        port.close()


@pytest.mark.parametrize("state", ["open", "opening"])
def test_close_does_not_wait_for_a_retry_and_stops_events(pty_port, retries, state):
    retries(3600.0, 3600.0)
    if state == "opening":
        pty_port.unplug()
    port = SerialPort(str(pty_port.path))
    events = PortEvents(port)
    if state == "open":
        assert events.next() == PortOpened()
    port.close()
    with pytest.raises(PortError):
        port.write(b"x")
    assert events.events.empty()
    assert not any(thread.name == f"port {port.url}" for thread in threading.enumerate())
    port.close()


def test_a_closed_port_can_be_started_again(pty_port):
    port = SerialPort(str(pty_port.path))
    for _ in range(3):
        events = PortEvents(port)
        assert events.next() == PortOpened()
        with pytest.raises(PortError, match="already started"):
            port.start(events.events.put)
        os.write(pty_port.master, b"again")
        assert events.data(5) == b"again"
        port.close()


@pytest.mark.parametrize(("url", "baud"), [("gopher://x:1", 19200), ("/dev/ttyS0", -1)])
def test_an_invalid_url_or_baud_rate_is_a_configuration_error(url, baud):
    with pytest.raises(ConfigError, match="modem port: url or baud"):
        SerialPort(url, baud)


# A port that another program has

TIOCGEXCL = 0x80045440
"""Linux: whether `TIOCEXCL` is set."""
ME = f"(process {os.getpid()})"


@pytest.fixture
def first(pty_port):
    """The first program on the port: it does not read by itself."""
    port = serial.serial_for_url(str(pty_port.path), timeout=WAIT_S, do_not_open=True)
    open_port(port)
    yield port
    close_port(port)


def test_second_program_is_refused_and_the_first_keeps_its_bytes(pty_port, first):
    os.set_blocking(pty_port.master, False)
    settings = termios.tcgetattr(first.fileno())
    os.write(pty_port.master, b"received before, not read yet")
    command = ["modem", "ping", "--port", str(pty_port.path), "--baud", "4800", "--address", "1", "--destination", "2"]
    arguments = [sys.executable, "-m", "sonarpost.cli.main", *command]
    second = subprocess.run(arguments, check=False, capture_output=True, text=True, timeout=WAIT_S)
    assert second.returncode == 2
    last_line = second.stderr.splitlines()[-1]
    assert last_line.startswith(f"sonarpost: {pty_port.path}: in use by ")
    assert last_line.endswith(ME)
    os.write(pty_port.master, b", and after")
    assert first.read(40) == b"received before, not read yet, and after"
    assert termios.tcgetattr(first.fileno()) == settings
    with pytest.raises(BlockingIOError):
        os.read(pty_port.master, 1)


def test_port_in_use_is_retried_and_opened_when_it_is_free(pty_port, first, caplog):
    port = SerialPort(str(pty_port.path))
    events = PortEvents(port)
    with closing(port):
        eventually(lambda: port.error is not None)
        assert port.error.startswith("in use by ")
        assert port.error.endswith(ME)
        assert not port.is_open
        close_port(first)
        assert events.next() == PortOpened()
        assert port.error is None
    [line] = [record for record in caplog.records if "cannot be opened" in record.message]
    assert line.fields["reason"].endswith(ME)


def test_each_reason_of_a_port_that_is_not_open_is_logged_once(pty_port, first, caplog):
    link = pty_port.path.with_name("adapter")
    port = SerialPort(str(link))
    events = PortEvents(port)
    with closing(port):
        eventually(lambda: port.error is not None)
        link.symlink_to(pty_port.path)
        eventually(lambda: "in use by" in port.error)
        close_port(first)
        assert events.next() == PortOpened()
    absent, in_use = [record.fields["reason"] for record in caplog.records if "cannot be opened" in record.message]
    assert "No such file" in absent
    assert in_use.startswith("in use by ")


def test_port_that_the_system_refuses_names_the_program_that_has_it_open(pty_port, monkeypatch):
    def refuse(_):
        raise serial.SerialException(errno.EBUSY, "Device or resource busy")

    monkeypatch.setattr(serial.Serial, "open", refuse)
    port = serial.serial_for_url(str(pty_port.path), do_not_open=True)
    with pytest.raises(OSError, match=r"^in use by another program$"):
        open_port(port)
    other = os.open(pty_port.path, os.O_RDWR | os.O_NOCTTY)  # without a lock
    try:
        with pytest.raises(OSError, match=rf"^in use by .+ \(process {os.getpid()}\)$"):
            open_port(port)
        monkeypatch.setattr(Path, "read_text", lambda *_, **__: refuse(None))  # another system, or no permission
        with pytest.raises(OSError, match=r"^in use by another program$"):
            open_port(port)
    finally:
        os.close(other)


def test_device_is_closed_to_programs_without_a_lock_but_not_a_pseudo_terminal(pty_port, monkeypatch):
    port = serial.serial_for_url(str(pty_port.path), do_not_open=True)
    for majors, is_exclusive in ((serial_device._PTY_MAJORS, False), ((), True)):
        monkeypatch.setattr(serial_device, "_PTY_MAJORS", majors)
        open_port(port)
        answer = fcntl.ioctl(port.fileno(), TIOCGEXCL, bytes(4))
        close_port(port)
        assert bool(int.from_bytes(answer, sys.byteorder)) == is_exclusive


def test_unexpected_exception_counts_as_a_lost_port(pty_port, monkeypatch):
    read = serial_port._read_descriptor
    errors = [AttributeError("a defect")]

    def failing(descriptor):
        if errors:
            raise errors.pop()
        return read(descriptor)

    monkeypatch.setattr(serial_port, "_read_descriptor", failing)
    monkeypatch.setattr(serial_port, "_CLOSE_S", 0.0)
    with closing(SerialPort(str(pty_port.path))) as port:
        events = PortEvents(port)
        assert [events.next() for _ in range(3)] == [PortOpened(), PortLost("a defect"), PortOpened()]
