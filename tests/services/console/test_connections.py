"""Limits of connections, with a real server: half-open, idle and slow clients do not keep others out."""

from __future__ import annotations

import asyncio
import gc
import math
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from ipaddress import ip_network
from typing import Any

import httpx2
import pytest
from builders.common import eventually
from builders.console import PASSWORD, Browser, Console, EventReader
from starlette.responses import PlainTextResponse, Response
from starlette.testclient import TestClient

from sonarpost.config import TlsConfig
from sonarpost.security.fleet import CA_CERTIFICATE, CERTIFICATE, KEY, Fleet
from sonarpost.services.console.web.connections import (
    CHUNK_BYTES,
    ConnectionDeadlines,
    ConnectionLimits,
    TrustedProxies,
    address_group,
)
from sonarpost.services.console.web.server import WebServer

HALF_A_REQUEST = b"GET /login HTTP/1.1\r\nHost: 127.0.0.1\r\n"
SHORT_S = 1.0
LOCAL_PROXY = TrustedProxies([ip_network("127.0.0.1")])


@pytest.fixture
def serve(console: Console) -> Iterator[Callable[..., WebServer]]:
    servers: list[WebServer] = []

    def make(app: Any = None, tls: TlsConfig | None = None, **limits: Any) -> WebServer:
        server = WebServer(app or console.app.asgi, "127.0.0.1", 0, tls, ConnectionLimits(**limits))
        servers.append(server)
        server.start()
        return server

    yield make
    console.app.stop()
    for server in servers:
        server.stop()


@pytest.fixture
def connect() -> Iterator[Callable[..., socket.socket]]:
    opened: list[socket.socket] = []

    def make(server: WebServer, sent: bytes = b"", source: str = "127.0.0.1") -> socket.socket:
        client = socket.create_connection(("127.0.0.1", server.port), 20, (source, 0))
        opened.append(client)
        client.sendall(sent)
        return client

    yield make
    for client in opened:
        client.close()


@pytest.fixture
def browser_at() -> Iterator[Callable[[WebServer, str], Browser]]:
    clients: list[httpx2.Client] = []

    def make(server: WebServer, source: str) -> Browser:
        transport = httpx2.HTTPTransport(local_address=source)
        clients.append(httpx2.Client(base_url=server.address, transport=transport, timeout=20))
        return Browser(clients[-1])

    yield make
    for client in clients:
        client.close()


def is_closed(client: socket.socket) -> bool:
    """Read what the server has sent; return whether it has closed the connection."""
    client.setblocking(False)
    try:
        while client.recv(65536):
            pass
    except BlockingIOError:
        return False
    except ConnectionResetError:
        pass
    return True


@pytest.mark.parametrize("sent", [HALF_A_REQUEST, b""], ids=["half-requests", "idle"])
def test_unfinished_requests_keep_no_one_out_and_are_closed(serve, connect, browser_at, sent):
    server = serve(request_s=3.0)
    anna = browser_at(server, "127.0.0.2")
    assert anna.login("anna").status_code == 200
    held = [connect(server, sent) for _ in range(230)]
    assert anna.get("/api/contacts").status_code == 200
    assert browser_at(server, "127.0.0.1").login("bo").status_code == 200
    assert server.limits.count <= 100 + 2
    eventually(lambda: all(is_closed(client) for client in held), what="end of the connections")
    assert browser_at(server, "127.0.0.1").login("bo").status_code == 200


@pytest.mark.parametrize(
    "sent", [HALF_A_REQUEST, b"POST /api/login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99\r\n\r\n"]
)
def test_single_bytes_do_not_extend_the_time_for_a_request(serve, connect, sent):
    client = connect(serve(request_s=SHORT_S), sent)

    def is_ended() -> bool:
        try:
            client.sendall(b"x")
        except OSError:
            return True
        return is_closed(client)

    eventually(is_ended, what="end of the connection")


def test_connection_is_closed_between_requests(serve, connect):
    client = connect(serve(request_s=SHORT_S), HALF_A_REQUEST + b"\r\n")
    assert client.recv(15) == b"HTTP/1.1 200 OK"
    eventually(lambda: is_closed(client), what="end of the connection")


def test_unfinished_tls_handshake_is_closed(serve, connect, make_console, tmp_path):
    folder = Fleet.init(tmp_path / "pki", "test").issue("vessel-1", "vessel", hosts=("127.0.0.1",)).folder
    tls = TlsConfig(ca=folder / CA_CERTIFICATE, certificate=folder / CERTIFICATE, key=folder / KEY)
    server = serve(make_console(tls=True).app.asgi, tls, request_s=SHORT_S, max_of_address=2)
    clients = [connect(server) for _ in range(5)]
    context = ssl.create_default_context(cafile=str(tls.ca))
    with httpx2.Client(base_url=server.address, verify=context, timeout=120) as client:
        assert client.post("api/login", json={"user": "anna", "password": PASSWORD}).status_code == 200
    eventually(lambda: all(is_closed(one) for one in clients), what="end of the connections")


def test_event_stream_stays_open_between_events(serve, console):
    server = serve(request_s=0.2, read_s=0.5)
    page = EventReader(server.address, console.users.start_session("anna").token)
    eventually(lambda: "hello" in page.names(), what="stream")
    time.sleep(2.5)  # two checks of the deadlines
    assert not page.ended
    console.state.events.publish("fleet", {})
    eventually(lambda: "fleet" in page.names(), what="event")
    page.close()


LARGE = bytes(40 * CHUNK_BYTES) + b"end"


async def large(scope: Any, receive: Any, send: Any) -> None:
    await Response(LARGE)(scope, receive, send)


def test_client_that_does_not_read_is_closed(serve, connect):
    server = serve(large, request_s=60.0, read_s=SHORT_S)
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.connect(("127.0.0.1", server.port))
    client.sendall(HALF_A_REQUEST + b"\r\n")
    eventually(lambda: server.limits.count == 1, what="connection")
    eventually(lambda: server.limits.count == 0, what="end of the connection")
    client.close()


def test_server_that_ends_closes_a_client_that_does_not_read(serve):
    async def endless(scope: Any, receive: Any, send: Any) -> None:
        await Response(bytes(64 << 20))(scope, receive, send)

    server = serve(endless, request_s=600.0, read_s=600.0)
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.connect(("127.0.0.1", server.port))
    client.sendall(HALF_A_REQUEST + b"\r\n")
    assert client.recv(1) == b"H"
    server.stop()
    # A transport that is not closed gives a ResourceWarning, which is an error in these tests.
    gc.collect()
    client.close()


def test_client_that_reads_slowly_receives_everything(serve, connect):
    client = connect(serve(large, request_s=SHORT_S, read_s=20.0), HALF_A_REQUEST + b"Connection: close\r\n\r\n")
    received = bytearray()
    while chunk := client.recv(CHUNK_BYTES):
        received += chunk
        time.sleep(0.05)
    assert received.endswith(LARGE)


def test_connections_of_a_proxy_have_only_the_total_limit(serve, connect):
    server = serve(proxies=LOCAL_PROXY, max_of_address=2, max_connections=6, request_s=20.0)
    clients = [connect(server) for _ in range(6)]
    eventually(lambda: server.limits.count == 6, what="connections")
    assert not any(is_closed(client) for client in clients)
    connect(server)
    eventually(lambda: is_closed(clients[0]), what="end of the oldest connection")
    assert not any(is_closed(client) for client in clients[1:])


def test_new_connection_is_refused_while_all_others_are_in_use(connect, serve, console):
    server = serve(max_of_address=2)
    pages = [EventReader(server.address, console.users.start_session(name).token) for name in ("anna", "bo")]
    eventually(lambda: all("hello" in page.names() for page in pages), what="streams")
    refused = connect(server)
    eventually(lambda: is_closed(refused), what="refusal")
    assert connect(server, HALF_A_REQUEST + b"\r\n", "127.0.0.2").recv(15) == b"HTTP/1.1 200 OK"
    assert not any(page.ended for page in pages)
    for page in pages:
        page.close()


def test_request_of_a_closed_connection_is_not_handled():
    handled = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        handled.append(scope["client"])
        await PlainTextResponse("")(scope, receive, send)

    client = TestClient(ConnectionDeadlines(app, ConnectionLimits()))
    assert client.get("/").status_code == 503
    assert handled == []


def test_deadlines_with_a_clock():
    now = [0.0]
    limits = ConnectionLimits(max_connections=3, max_of_address=2, request_s=10, clock=lambda: now[0])
    pairs = [socket.socketpair() for _ in range(4)]
    peers = [("a", 1), ("a", 2), ("b", 1), ("c", 1)]
    for peer, (ours, _) in zip(peers[:3], pairs, strict=False):
        assert limits.add(peer, ours)
    limits.set_deadline(("a", 1), math.inf)
    assert limits.add(peers[3], pairs[3][0])
    assert ("a", 2) not in limits  # it waited longest of those that wait
    now[0] = 11
    asyncio.run(limits.close_overdue())
    assert [peer in limits for peer in peers] == [True, False, False, False]
    limits.remove(("a", 1), pairs[1][0])
    assert ("a", 1) in limits
    limits.remove(("a", 1), pairs[0][0])
    assert limits.count == 0
    for pair in pairs:
        for one in pair:
            one.close()


@pytest.mark.parametrize(
    ("host", "group"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("::ffff:192.0.2.7", "192.0.2.7"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2::9", "2001:db8:1:2::/64"),
        ("testclient", "testclient"),
    ],
)
def test_address_group(host, group):
    assert address_group(host) == group


@pytest.mark.parametrize(
    ("host", "forwarded", "address"),
    [
        ("10.0.0.1", "", "10.0.0.1"),
        ("10.0.0.1", "192.0.2.7", "192.0.2.7"),
        ("10.0.0.1", "forged, 192.0.2.7", "192.0.2.7"),
        ("10.0.0.1", "192.0.2.7, 10.0.0.2", "192.0.2.7"),
        ("10.0.0.1", "10.0.0.2", "10.0.0.2"),
        ("10.0.0.1", "192.0.2.7, ", "10.0.0.1"),
        ("192.0.2.1", "192.0.2.7", "192.0.2.1"),
        ("10.0.0.1", "x" * 200, "x" * 100),
    ],
)
def test_only_a_trusted_proxy_names_the_client(host, forwarded, address):
    proxies = TrustedProxies([ip_network("10.0.0.0/24")])
    assert proxies.client_address(host, forwarded) == address


def test_wrong_passwords_are_counted_by_the_address_that_the_proxy_names(make_console, serve, browser_at):
    console = make_console(trusted_proxies=("127.0.0.1",))
    server = serve(console.app.asgi, proxies=LOCAL_PROXY)
    for source, codes in (("127.0.0.1", {401}), ("127.0.0.2", {401, 429})):
        browser = browser_at(server, source)
        found = set()
        for number in range(6):
            browser.client.headers["X-Forwarded-For"] = f"192.0.2.{number}"
            found.add(browser.login("anna", "wrong password").status_code)
        assert found == codes
