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
from sonarpost.runtime.serial_port import PortEvent, PortLost, PortOpened, SerialLink


class Heard:
    """What a link has told, taken one by one."""

    def __init__(self, link: SerialLink) -> None:
        self.events: queue.SimpleQueue[PortEvent] = queue.SimpleQueue()
        link.start(self.events.put)

    def next(self, timeout_s: float = 5.0) -> PortEvent:
        return self.events.get(timeout=timeout_s)

    def data(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            item = self.next()
            assert isinstance(item, bytes), item
            data += item
        return data


class Pty:
    """A pseudo-terminal whose slave is reached through a symbolic link, as an adapter is by its udev name."""

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
def cable(tmp_path: Path) -> Iterator[Pty]:
    cable = Pty(tmp_path / "ttyMODEM")
    cable.plug()
    yield cable
    cable.unplug()


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(5.0)
        yield listening


def eventually(condition: Callable[[], bool], timeout_s: float = 5.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "did not come true in time"
        time.sleep(0.005)


def links(url: str, **options: float) -> SerialLink:
    return SerialLink(url, first_retry_s=0.02, longest_retry_s=0.1, **options)


def test_pty_carries_bytes_both_ways(cable: Pty) -> None:
    link = links(str(cable.path))
    heard = Heard(link)
    try:
        assert heard.next() == PortOpened()
        assert link.is_open
        assert link.problem is None
        every_byte = bytes(range(256))
        os.write(cable.master, every_byte)
        assert heard.data(256) == every_byte
        link.write(every_byte)
        got = b""
        while len(got) < 256:
            got += os.read(cable.master, 4096)
        assert got == every_byte
    finally:
        link.close()
    assert not link.is_open


def test_unplugged_pty_is_noticed_and_opened_again(
    cable: Pty, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO, "sonarpost.runtime.serial_port")
    attempts: list[str] = []
    make = serial.serial_for_url
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **options: attempts.append(url) or make(url, **options))
    link = links(str(cable.path))
    heard = Heard(link)
    try:
        for round_number in range(3):
            assert heard.next() == PortOpened()
            os.write(cable.master, b"round %d" % round_number)
            assert heard.data(7) == b"round %d" % round_number
            cable.unplug()
            lost = heard.next()
            assert isinstance(lost, PortLost)
            assert lost.reason
            assert not link.is_open
            with pytest.raises(PortError, match="ttyMODEM"):
                link.write(b"x")
            attempts.clear()
            eventually(lambda: len(attempts) >= 3)
            assert link.problem is not None
            assert "No such file" in link.problem
            cable.plug()
        assert heard.next() == PortOpened()
    finally:
        link.close()
    texts = [record.getMessage() for record in caplog.records]
    assert sum("cannot be opened" in text for text in texts) == 3, "once a change of state, not once an attempt"
    assert sum("port lost" in text for text in texts) == 3
    assert sum("port open" in text for text in texts) == 4
    assert all(str(cable.path) in text for text in texts)


def test_port_that_appears_later(cable: Pty) -> None:
    cable.unplug()
    link = links(str(cable.path))
    heard = Heard(link)
    try:
        with pytest.raises(queue.Empty):
            heard.next(timeout_s=0.2)
        with pytest.raises(PortError, match="not open"):
            link.write(b"x")
        cable.plug()
        assert heard.next() == PortOpened()
    finally:
        link.close()


@pytest.mark.parametrize("reset", [False, True], ids=["end of stream", "reset"])
def test_socket_that_goes_and_returns(server: socket.socket, reset: bool) -> None:
    host, port = server.getsockname()
    link = links(f"socket://{host}:{port}")
    heard = Heard(link)
    try:
        for _ in range(2):
            connection, _address = server.accept()
            assert heard.next() == PortOpened()
            connection.sendall(b"$CAREV,181807,AUV,2.0.27087*12\r\n")
            assert heard.data(32) == b"$CAREV,181807,AUV,2.0.27087*12\r\n"
            link.write(b"hello")
            assert connection.recv(100) == b"hello"
            if reset:
                linger_zero = b"\x01\x00\x00\x00\x00\x00\x00\x00"
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger_zero)
            connection.close()
            assert isinstance(heard.next(), PortLost)
    finally:
        link.close()


def test_server_that_is_not_there(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    link = links(f"socket://127.0.0.1:{port}")
    heard = Heard(link)
    try:
        with pytest.raises(queue.Empty):
            heard.next(timeout_s=0.4)
        assert "refused" in (link.problem or "")
        assert sum("cannot be opened" in record.getMessage() for record in caplog.records) == 1
        with socket.create_server(("127.0.0.1", port)):
            assert heard.next() == PortOpened()
    finally:
        link.close()


def test_server_that_drops_everybody_is_not_hammered(server: socket.socket) -> None:
    host, port = server.getsockname()
    link = SerialLink(f"socket://{host}:{port}", first_retry_s=0.05, longest_retry_s=0.2)
    heard = Heard(link)
    server.settimeout(0.05)
    accepted, end_s = 0, time.monotonic() + 1.0
    while time.monotonic() < end_s:
        try:
            server.accept()[0].close()
            accepted += 1
        except TimeoutError:
            pass
    link.close()
    assert 2 <= accepted <= 8
    assert heard.next() == PortOpened()


def test_write_to_a_port_that_takes_nothing_ends(server: socket.socket) -> None:
    host, port = server.getsockname()
    link = links(f"socket://{host}:{port}", write_timeout_s=0.3)
    heard = Heard(link)
    try:
        assert heard.next() == PortOpened()
        connection, _ = server.accept()
        with pytest.raises(PortError, match="cannot be written"):
            link.write(bytes(64 * 1024 * 1024))
        assert isinstance(heard.next(), PortLost)
        connection.close()
    finally:
        link.close()


def test_loop_url_has_no_descriptor_and_works() -> None:
    link = links("loop://")
    heard = Heard(link)
    try:
        assert heard.next() == PortOpened()
        link.write(b"to myself")
        assert heard.data(9) == b"to myself"
    finally:
        link.close()


@pytest.mark.parametrize("state", ["open", "opening"])
def test_close_is_quick_and_final(cable: Pty, state: str) -> None:
    if state == "opening":
        cable.unplug()
    link = SerialLink(str(cable.path), first_retry_s=5.0)
    heard = Heard(link)
    if state == "open":
        assert heard.next() == PortOpened()
    begun_s = time.monotonic()
    link.close()
    assert time.monotonic() - begun_s < 1.0
    with pytest.raises(PortError):
        link.write(b"x")
    with pytest.raises(queue.Empty):
        heard.next(timeout_s=0.3)
    link.close()


def test_started_again_after_close(cable: Pty) -> None:
    link = links(str(cable.path))
    for _ in range(3):
        heard = Heard(link)
        assert heard.next() == PortOpened()
        with pytest.raises(PortError, match="already started"):
            link.start(heard.events.put)
        os.write(cable.master, b"again")
        assert heard.data(5) == b"again"
        link.close()


@pytest.mark.parametrize(("url", "baud"), [("gopher://x:1", 19200), ("/dev/ttyS0", -1)])
def test_what_no_retry_can_heal_is_a_configuration_error(url: str, baud: int) -> None:
    with pytest.raises(ConfigError, match="modem port: url or baud"):
        SerialLink(url, baud)
