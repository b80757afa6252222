"""Limits of connections, with a real server: half-open, idle and slow clients do not keep others out."""

import asyncio
import gc
import math
import socket
import ssl
from ipaddress import ip_network

import httpx2
import pytest
from builders.common import eventually
from builders.console import PASSWORD, Browser, EventReader, server_certificate
from starlette.responses import PlainTextResponse, Response
from starlette.testclient import TestClient

from sonarpost.network.connections import ConnectionLimits, TrustedProxies, address_group
from sonarpost.services.console.web.server import CHUNK_BYTES, ConnectionDeadlines, WebServer

HALF_A_REQUEST = b"GET /login HTTP/1.1\r\nHost: 127.0.0.1\r\n"
HALF_A_BODY = b"POST /api/login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999\r\n\r\n"
LOCAL_PROXY = TrustedProxies([ip_network("127.0.0.1")])
LARGE = bytes(40 * CHUNK_BYTES) + b"end"


class Clock:
    """The clock of the deadlines: only tests advance it."""

    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def serve(console, clock):
    servers = []

    def make(app=None, tls=None, **limits):
        limits = ConnectionLimits(clock=clock, **limits)
        servers.append(WebServer(app or console.app.asgi, "127.0.0.1", 0, tls, limits))
        servers[-1].start()
        return servers[-1]

    yield make
    console.app.stop()
    for server in servers:
        server.stop()


@pytest.fixture
def connect():
    opened = []

    def make(server, sent=b"", source="127.0.0.1", *, buffer_bytes=None):
        client = socket.socket()
        opened.append(client)
        if buffer_bytes is not None:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
        client.settimeout(120)
        client.bind((source, 0))
        client.connect(("127.0.0.1", server.port))
        client.sendall(sent)
        return client

    yield make
    for client in opened:
        client.close()


@pytest.fixture
def browser_at():
    clients = []

    def make(server, source):
        transport = httpx2.HTTPTransport(local_address=source)
        clients.append(httpx2.Client(base_url=server.address, transport=transport, timeout=120))
        return Browser(clients[-1])

    yield make
    for client in clients:
        client.close()


def is_closed(client):
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


def wait_for_end(clock, *clients, sent=b""):
    """Let time pass, in which the clients send single bytes, until the server has closed all connections."""

    def are_ended():
        clock.now_s += 1.0
        for client in clients:
            try:
                client.sendall(sent)
            except OSError:
                continue
        return all(is_closed(client) for client in clients)

    eventually(are_ended, what="end of the connections")


@pytest.mark.parametrize("sent", [HALF_A_REQUEST, b""], ids=["half-requests", "idle"])
def test_unfinished_requests_keep_no_one_out_and_are_closed(serve, connect, browser_at, clock, sent):
    server = serve(request_s=3.0)
    anna = browser_at(server, "127.0.0.2")
    assert anna.login("anna").status_code == 200
    held = [connect(server, sent) for _ in range(130)]
    assert anna.get("/api/contacts").status_code == 200
    assert browser_at(server, "127.0.0.1").login("bo").status_code == 200
    assert server.limits.count <= 100 + 2
    wait_for_end(clock, *held)
    assert browser_at(server, "127.0.0.1").login("bo").status_code == 200


def test_single_bytes_do_not_extend_the_time_for_a_request_and_answers_do(serve, connect, clock):
    server = serve(request_s=10.0)
    answered = connect(server, HALF_A_REQUEST + b"\r\n")
    assert answered.recv(15) == b"HTTP/1.1 200 OK"
    wait_for_end(clock, connect(server, HALF_A_REQUEST), connect(server, HALF_A_BODY), sent=b"x")
    wait_for_end(clock, answered)


def test_unfinished_tls_handshake_is_closed(serve, connect, make_console, clock, tmp_path):
    tls = server_certificate(tmp_path)
    server = serve(make_console(tls=True).app.asgi, tls, max_of_address=2)
    clients = [connect(server) for _ in range(5)]
    context = ssl.create_default_context(cafile=str(tls.ca))
    with httpx2.Client(base_url=server.address, verify=context, timeout=120) as client:
        assert client.post("api/login", json={"user": "anna", "password": PASSWORD}).status_code == 200
    wait_for_end(clock, *clients)


def test_event_stream_stays_open_between_events(serve, connect, console, clock):
    server = serve()
    page = EventReader(server.address, console.users.start_session("anna").token)
    eventually(lambda: "hello" in page.names(), what="stream")
    # The deadlines of other connections pass.
    for _ in range(2):
        wait_for_end(clock, connect(server))
    assert not page.ended
    console.state.events.publish("fleet", {})
    eventually(lambda: "fleet" in page.names(), what="event")


async def large(scope, receive, send):
    await Response(LARGE)(scope, receive, send)


def test_client_that_does_not_read_is_closed_and_one_that_reads_receives_everything(serve, connect, clock):
    server = serve(large, request_s=1e9, read_s=30.0)
    reading = connect(server, HALF_A_REQUEST + b"Connection: close\r\n\r\n")
    received = bytearray()
    while chunk := reading.recv(CHUNK_BYTES):
        received += chunk
    assert received.endswith(LARGE)
    eventually(lambda: server.limits.count == 0, what="end of the connection")
    connect(server, HALF_A_REQUEST + b"\r\n", buffer_bytes=4096)
    eventually(lambda: server.limits.count == 1, what="connection")

    def is_ended():
        clock.now_s += 1.0
        return server.limits.count == 0

    eventually(is_ended, what="end of the connection")


@pytest.mark.parametrize(("chunk_s", "received"), [(29.0, True), (31.0, False)])
def test_time_to_read_a_response_is_that_of_each_chunk(clock, chunk_s, received):
    limits = ConnectionLimits(request_s=10.0, read_s=30.0, clock=clock)
    ours, theirs = socket.socketpair()
    limits.add(("a", 1), ours)
    left = []

    async def send(message):
        clock.now_s += chunk_s
        limits.close_overdue()
        left.append(("a", 1) in limits)

    async def receive():
        return {"type": "http.request"}

    scope = {"type": "http", "method": "GET", "client": ("a", 1)}
    asyncio.run(ConnectionDeadlines(large, limits)(scope, receive, send))
    assert len(left) > 40
    assert set(left) == {received}
    for one in (ours, theirs):
        one.close()


def test_server_that_ends_closes_a_client_that_does_not_read(serve, connect):
    async def endless(scope, receive, send):
        await Response(bytes(64 << 20))(scope, receive, send)

    server = serve(endless)
    client = connect(server, HALF_A_REQUEST + b"\r\n", buffer_bytes=4096)
    assert client.recv(1) == b"H"
    server.stop()
    # A transport that is not closed gives a ResourceWarning, which is an error in these tests.
    gc.collect()


def test_connections_of_a_proxy_have_only_the_total_limit(serve, connect):
    server = serve(proxies=LOCAL_PROXY, max_of_address=2, max_connections=6)
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


def test_request_of_a_closed_connection_is_not_handled():
    handled = []

    async def app(scope, receive, send):
        handled.append(scope["client"])
        await PlainTextResponse("")(scope, receive, send)

    client = TestClient(ConnectionDeadlines(app, ConnectionLimits()))
    assert client.get("/").status_code == 503
    assert handled == []


def test_deadlines_with_a_clock(clock):
    limits = ConnectionLimits(max_connections=3, max_of_address=2, request_s=10, clock=clock)
    pairs = [socket.socketpair() for _ in range(4)]
    peers = [("a", 1), ("a", 2), ("b", 1), ("c", 1)]
    for peer, (ours, _) in zip(peers[:3], pairs, strict=False):
        assert limits.add(peer, ours)
    limits.set_deadline(("a", 1), math.inf)
    assert limits.add(peers[3], pairs[3][0])
    assert ("a", 2) not in limits  # it waited longest of those that wait
    clock.now_s = 11
    limits.close_overdue()
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
