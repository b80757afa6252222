"""The link emulator: no data is early, senders wait for the buffer, and faults do what they say."""

import contextlib
import gc
import socket
import threading
import time

import pytest

from research.common.link_emulator import LinkEmulator, SerialLine

pytestmark = pytest.mark.quick

RATE = 20_000
DELAY_S = 0.05
LARGE_BYTES = 3_000_000
"""More than kernels hold of a connection through the link; less than the 4 MB of one over the loopback interface."""


class Ends:
    """A server behind a link, and connections to it."""

    def __init__(self):
        self.server = socket.create_server(("127.0.0.1", 0))
        self.opened = [self.server]
        self.link = None

    def link_with(self, **options):
        self.link = LinkEmulator(self.server.getsockname()[1], **options)
        return self.link

    def connect(self):
        """Return both ends of a connection."""
        near = socket.create_connection(("127.0.0.1", self.link.port), timeout=10)
        far, _ = self.server.accept()
        far.settimeout(10)
        self.opened += [near, far]
        return near, far

    def close(self):
        if self.link is not None:
            self.link.close()
        for one in self.opened:
            one.close()


@pytest.fixture
def ends():
    made = Ends()
    made.server.settimeout(10)
    yield made
    made.close()


def received(end, size):
    """Return exactly `size` bytes, or fewer before the end of the data."""
    data = b""
    while len(data) < size and (more := end.recv(size - len(data))):
        data += more
    return data


def connect_and_receive(link):
    with socket.create_connection(("127.0.0.1", link.port), timeout=10) as near:
        near.recv(1)


def fill(end):
    """Return how many bytes the end accepts before it blocks."""
    end.settimeout(0.5)
    sent = 0
    with contextlib.suppress(TimeoutError):
        while sent < LARGE_BYTES:
            sent += end.send(bytes(1000))
    return sent


def test_packets_occupy_the_line_one_after_the_other():
    line = SerialLine(100.0, delay_s=2.0, jitter_s=0.0, seed=0)
    assert [line.arrival_s(50, 10.0), line.arrival_s(100, 10.0)] == [12.5, 13.5]
    assert line.arrival_s(100, 20.0) == 23.0
    line.clear()
    assert line.arrival_s(100, 20.0) == 23.0


@pytest.mark.parametrize("upwards", [True, False])
def test_data_arrives_unchanged_and_not_before_its_time(ends, upwards):
    link = ends.link_with(rate_bytes_per_s=RATE, delay_s=DELAY_S)
    near, far = ends.connect()
    source, target = (near, far) if upwards else (far, near)
    data = bytes(range(256)) * 40
    started_s = time.monotonic()
    sender = threading.Thread(target=source.sendall, args=(data,))
    sender.start()
    assert received(target, len(data)) == data
    assert time.monotonic() - started_s >= len(data) / RATE + DELAY_S
    sender.join()
    assert link.passed_bytes == {"up": len(data) * upwards, "down": len(data) * (not upwards)}


def test_the_buffer_limits_what_a_sender_can_send(ends):
    link = ends.link_with(buffer_bytes=1000)
    link.stall()
    assert fill(ends.connect()[0]) < LARGE_BYTES
    link.close()
    ends.link_with(rate_bytes_per_s=1, buffer_bytes=LARGE_BYTES)
    ends.connect()[0].sendall(bytes(LARGE_BYTES))


def test_cut_loses_data_in_transit_and_refuses_until_mended(ends):
    faults = []
    link = ends.link_with(rate_bytes_per_s=10, on_fault=faults.append)
    near, far = ends.connect()
    near.sendall(bytes(10_000))
    link.cut()
    with pytest.raises(ConnectionResetError):
        far.recv(1)
    with pytest.raises(ConnectionResetError):
        near.recv(1)
    attempts = link.attempts
    with pytest.raises(ConnectionResetError):
        connect_and_receive(link)
    assert link.attempts == attempts + 1
    link.mend()
    near, far = ends.connect()
    near.sendall(b"1")  # 1000 s of data are not on the line any more
    assert received(far, 1) == b"1"
    assert faults == ["cut", "restored"]


@pytest.mark.parametrize("directions", [(), ("up",)])
def test_stalled_data_arrives_after_mend(ends, directions):
    faults = []
    link = ends.link_with(on_fault=faults.append)
    near, far = ends.connect()
    link.stall(*directions)
    near.sendall(b"late")
    far.sendall(b"back")
    if directions:
        assert received(near, 4) == b"back"
    else:
        near.settimeout(0.1)
        with pytest.raises(TimeoutError):
            near.recv(1)
    assert link.passed_bytes["up"] == 0
    link.mend()
    assert received(far, 4) == b"late"
    assert faults == [f"stall {' '.join(directions)}".strip(), "restored"]


def test_a_target_that_refuses_resets_the_connection(ends):
    link = ends.link_with()
    ends.server.close()
    with pytest.raises(ConnectionResetError):
        connect_and_receive(link)
    assert link.attempts == 1


def test_close_while_clients_connect_leaves_no_socket_open(ends):
    """An open socket that is collected is an error in tests."""
    stopped = threading.Event()

    def dial(port):
        while not stopped.is_set():
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=10):
                pass

    for _ in range(10):
        link = ends.link_with()
        dialling = threading.Thread(target=dial, args=(link.port,))
        stopped.clear()
        dialling.start()
        ends.server.accept()[0].close()
        link.close()
        stopped.set()
        dialling.join()
    gc.collect()
