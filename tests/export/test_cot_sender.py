"""The event sender with real sockets: streams, datagrams, TLS, and peers that close, restart or are absent."""

from __future__ import annotations

import contextlib
import socket
import ssl
import struct
import threading

import pytest
from builders.common import eventually, free_port

from sonarpost.errors import ConfigError, PortError
from sonarpost.export.cot_sender import CotSender, Endpoint, TlsFiles, parse_endpoint
from sonarpost.security.fleet import CA_CERTIFICATE, CERTIFICATE, KEY, Fleet

EVENTS = (b'<event uid="a"/>', b'<event uid="b"/>')
STREAM = b'<event uid="a"/>\n<event uid="b"/>\n'


class Server:
    """Listener of a TAK server: stores the data of each connection, and optionally sends a greeting."""

    def __init__(self, context=None, port=0, greeting=b""):
        self.received: list[bytearray] = []
        self.ended: list[bool] = []
        self.connections: list[socket.socket] = []
        self._greeting = greeting
        self._context = context
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self):
        while True:
            try:
                connection = self._listener.accept()[0]
                if self._context is not None:
                    connection = self._context.wrap_socket(connection, server_side=True)
                if self._greeting:
                    connection.sendall(self._greeting)
            except ssl.SSLError:
                continue
            except OSError:
                return
            self.received.append(bytearray())
            self.ended.append(False)
            self.connections.append(connection)
            threading.Thread(target=self._read, args=(connection, len(self.received) - 1), daemon=True).start()

    def _read(self, connection, number):
        try:
            while data := connection.recv(65536):
                self.received[number] += data
        except OSError:
            return
        self.ended[number] = True
        connection.close()

    def reset(self):
        """Reset the newest connection, as a killed process does."""
        connection = self.connections[-1]
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.shutdown(socket.SHUT_RDWR)
        connection.close()

    def close(self):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self.connections:
            connection.close()
        self._thread.join()


@pytest.fixture
def serve():
    servers: list[Server] = []

    def make(*args, **options):
        servers.append(Server(*args, **options))
        return servers[-1]

    yield make
    for server in servers:
        server.close()


def gives_up(_):
    return True


def test_endpoint_forms():
    for text, endpoint in (
        ("tcp://tak.example:8087", Endpoint("tcp", "tak.example", 8087)),
        ("ssl://tak.example:8089", Endpoint("tls", "tak.example", 8089)),
        ("udp://239.2.3.1:6969", Endpoint("udp", "239.2.3.1", 6969)),
        ("tcp://[::1]:8087", Endpoint("tcp", "::1", 8087)),
    ):
        assert parse_endpoint(text) == endpoint
        assert str(endpoint) == text.replace("ssl", "tls")
    invalid = ("", "tak:8087", "http://a:1", "tcp://a", "tcp://:8087", "tcp://a:0", "tcp://a:99999", "tcp://a:b")
    for text in (*invalid, "tcp://a:1/x"):
        with pytest.raises(ConfigError, match=r"CoT endpoint: got .* expected tcp://host:port"):
            parse_endpoint(text)


def test_batch_is_complete_after_close(serve):
    server = serve()
    many = tuple(b'<event uid="%d">%s</event>' % (n, b"x" * 5000) for n in range(100))
    with CotSender(f"tcp://127.0.0.1:{server.port}") as sender:
        sender.send(many)
    eventually(lambda: server.ended == [True])
    assert bytes(server.received[0]) == b"".join(event + b"\n" for event in many)


def test_one_connection_for_many_batches_and_server_data_is_discarded(serve):
    server = serve(greeting=b"<event uid='other'/>" * 20_000)
    with CotSender(f"tcp://127.0.0.1:{server.port}") as sender:
        for _ in range(3):
            sender.send(EVENTS)
    eventually(lambda: server.ended == [True])
    assert bytes(server.received[0]) == STREAM * 3
    assert len(server.received) == 1


@pytest.mark.parametrize("end", ["close", "reset"])
def test_closed_connection_is_detected_before_the_next_batch(serve, end):
    server = serve()
    with CotSender(f"tcp://127.0.0.1:{server.port}", timeout_s=600.0) as sender:
        sender.send(EVENTS)
        eventually(lambda: len(server.received) == 1 and bytes(server.received[0]) == STREAM)
        if end == "reset":
            server.reset()
        else:
            server.connections[0].shutdown(socket.SHUT_RDWR)
        with contextlib.suppress(ConnectionResetError):
            # The end of the connection has arrived; without it the first batch after it may be lost.
            assert sender._socket.recv(1, socket.MSG_PEEK) == b""
        sender.send(EVENTS)
    eventually(lambda: server.ended[-1])
    assert (len(server.received), bytes(server.received[1])) == (2, STREAM)


def test_batch_is_sent_when_the_server_starts_later():
    port, started = free_port(), []

    def wait(_):
        if not started:
            started.append(Server(port=port))
        return False

    with CotSender(f"tcp://127.0.0.1:{port}", wait=wait) as sender:
        sender.send(EVENTS)
    eventually(lambda: started[0].ended == [True])
    assert bytes(started[0].received[0]) == STREAM
    started[0].close()


def test_pauses_increase_until_the_time_limit():
    port, now, pauses = free_port(), [0.0], []

    def wait(timeout):
        pauses.append(timeout)
        now[0] += timeout
        return False

    sender = CotSender(f"tcp://127.0.0.1:{port}", clock=lambda: now[0], wait=wait)
    with pytest.raises(PortError, match=rf"tcp://127.0.0.1:{port}: 2 events not sent: .*[Rr]efused"):
        sender.send(EVENTS, give_up_after_s=20.0)
    assert pauses == [0.2, 0.5, 1.0, 2.0, 5.0, 5.0, 5.0]


def test_each_datagram_holds_one_event():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        with CotSender(f"udp://127.0.0.1:{receiver.getsockname()[1]}") as sender:
            sender.send(EVENTS)
        assert [receiver.recv(65536) for _ in EVENTS] == list(EVENTS)
    multicast = CotSender("udp://239.2.3.1:6969", multicast_ttl=3)
    with multicast, multicast._open_datagram_socket("239.2.3.1", 6969) as datagrams:
        assert datagrams.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 3
    with CotSender("udp://127.0.0.1:9") as sender, pytest.raises(PortError, match="65001 bytes"):
        sender.send([b"x" * 65_001])


@pytest.fixture
def issue(tmp_path):
    """Issues certificates of a new authority."""
    fleet = Fleet.init(tmp_path / "pki", "test")

    def make(name):
        folder = fleet.issue(name, "vessel", hosts=("127.0.0.1",)).folder
        return TlsFiles(folder / CA_CERTIFICATE, folder / CERTIFICATE, folder / KEY)

    return make


def server_context(files):
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(files.certificate, files.key)
    context.load_verify_locations(files.ca)
    context.verify_mode = ssl.CERT_REQUIRED
    return context


def test_mutual_tls(serve, issue):
    server = serve(server_context(issue("server")), greeting=b"<event uid='other'/>" * 1000)
    # A write that waits for data after a session ticket would never end.
    with CotSender(f"tls://127.0.0.1:{server.port}", issue("client"), timeout_s=600.0) as sender:
        for _ in range(3):
            sender.send(EVENTS)
        eventually(lambda: len(server.received) == 1 and bytes(server.received[0]) == STREAM * 3)
    eventually(lambda: server.ended == [True])
    assert len(server.received) == 1


def test_server_of_another_authority_is_rejected(serve, issue, tmp_path):
    server = serve(server_context(issue("server")))
    other = Fleet.init(tmp_path / "other", "other").issue("vessel-1", "vessel").folder
    sender = CotSender(f"tls://127.0.0.1:{server.port}", TlsFiles(other / CA_CERTIFICATE), wait=gives_up)
    with pytest.raises(PortError, match=r"(?i)certificate verify failed"):
        sender.send(EVENTS)
    assert server.received == []
    with pytest.raises(ConfigError, match=r"TLS: got .*nowhere.pem.* expected readable PEM files"):
        CotSender("tls://127.0.0.1:1", TlsFiles(tmp_path / "nowhere.pem"))
    (tmp_path / "bad.pem").write_text("no certificate")
    with pytest.raises(ConfigError, match=r"bad.pem"):
        CotSender("tls://127.0.0.1:1", TlsFiles(tmp_path / "bad.pem"))
