"""Limits of the connections of a server with threads; tests/services/console/test_connections.py has the console's."""

import math
import socket
import threading
from contextlib import contextmanager

import pytest
from builders.common import eventually

from sonarpost.network.connections import REQUEST_S, ConnectionLimits, LimitedHandler, LimitedServer


class Clock:
    """Only tests advance it."""

    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


class OkHandler(LimitedHandler):
    def do_GET(self):  # noqa: N802 of the base class
        self.set_deadline(math.inf)
        self.reply(200, "OK")


@contextmanager
def server_with(limits, handler=OkHandler):
    server = LimitedServer(("127.0.0.1", 0), handler, limits)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def connect(server):
    return socket.create_connection(server.server_address, timeout=300)


def get(server):
    with connect(server) as client:
        client.sendall(b"GET / HTTP/1.1\r\n\r\n")
        return client.recv(4096).split(b"\r\n")[0]


def test_request_has_a_time_limit_in_total(clock):
    limits = ConnectionLimits(clock=clock)
    with server_with(limits) as server, connect(server) as slow:
        eventually(lambda: limits.count == 1)
        for byte in b"GET / HT":
            slow.sendall(bytes([byte]))
            clock.now_s += 1.0
        assert get(server) == b"HTTP/1.0 200 OK"
        clock.now_s += REQUEST_S - 8.0
        assert slow.recv(100) == b""
        eventually(lambda: limits.count == 0)


def test_connection_that_waits_longest_is_replaced(clock):
    limits = ConnectionLimits(max_connections=3, max_of_address=2, clock=clock)
    with server_with(limits) as server, connect(server) as first:
        eventually(lambda: limits.count == 1)
        clock.now_s += 1.0
        with connect(server) as second:
            eventually(lambda: limits.count == 2)
            for _ in range(5):
                assert get(server) == b"HTTP/1.0 200 OK"
                eventually(lambda: limits.count == 1)
            assert first.recv(100) == b""
            second.sendall(b"GET / HTTP/1.1\r\n\r\n")
            assert second.recv(4096).startswith(b"HTTP/1.0 200 OK")


def test_defect_of_a_handler_is_logged_and_ends_its_connection_only(caplog):
    class Handler(LimitedHandler):
        def do_GET(self):  # noqa: N802 of the base class
            if self.path == "/defect":
                raise RuntimeError("a defect")
            self.reply(200, "OK")

    with server_with(ConnectionLimits(), Handler) as server:
        with connect(server) as client:
            client.sendall(b"GET /defect HTTP/1.1\r\n\r\n")
            assert client.recv(4096) == b""
        assert get(server) == b"HTTP/1.0 200 OK"
    assert "unexpected exception" in caplog.text
