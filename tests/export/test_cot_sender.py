"""The sender against real sockets: streams, datagrams, TLS, ends that close, restart, or are not there."""

from __future__ import annotations

import datetime as dt
import ipaddress
import socket
import ssl
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from builders.common import eventually, free_port
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from sonarpost.errors import ConfigError, PortError
from sonarpost.export.cot_sender import CotSender, Endpoint, TlsFiles, parse_endpoint

EVENTS = (b'<event uid="a"/>', b'<event uid="b"/>')
STREAM = b'<event uid="a"/>\n<event uid="b"/>\n'


class Server:
    """A TAK server's listener: keeps what each connection said, and talks back when told to."""

    def __init__(self, context: ssl.SSLContext | None = None, port: int = 0, greeting: bytes = b"") -> None:
        self.heard: list[bytearray] = []
        self.ended: list[bool] = []
        self.connections: list[socket.socket] = []
        self._greeting = greeting
        self._context = context
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        while True:
            try:
                connection = self._listener.accept()[0]
                connection.settimeout(10)
                if self._context is not None:
                    connection = self._context.wrap_socket(connection, server_side=True)
                if self._greeting:
                    connection.sendall(self._greeting)
            except ssl.SSLError:
                continue
            except OSError:
                return
            self.heard.append(bytearray())
            self.ended.append(False)
            self.connections.append(connection)
            threading.Thread(target=self._read, args=(connection, len(self.heard) - 1), daemon=True).start()

    def _read(self, connection: socket.socket, number: int) -> None:
        try:
            while data := connection.recv(65536):
                self.heard[number] += data
        except OSError:
            return
        self.ended[number] = True
        connection.close()

    def reset(self) -> None:
        """Break the newest connection off, as a process that is killed does."""
        broken = self.connections[-1]
        broken.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        broken.shutdown(socket.SHUT_RDWR)
        broken.close()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self.connections:
            connection.close()
        self._thread.join(5)


@pytest.fixture
def serve() -> Iterator[Callable[..., Server]]:
    servers: list[Server] = []

    def make(*args: object, **options: object) -> Server:
        servers.append(Server(*args, **options))  # type: ignore[arg-type]
        return servers[-1]

    yield make
    for server in servers:
        server.close()


def gives_up(_: float) -> bool:
    return True


@pytest.mark.parametrize(
    ("text", "endpoint"),
    [
        ("tcp://tak.example:8087", Endpoint("tcp", "tak.example", 8087)),
        ("ssl://tak.example:8089", Endpoint("tls", "tak.example", 8089)),
        ("udp://239.2.3.1:6969", Endpoint("udp", "239.2.3.1", 6969)),
        ("tcp://[::1]:8087", Endpoint("tcp", "::1", 8087)),
    ],
)
def test_endpoints(text: str, endpoint: Endpoint) -> None:
    assert parse_endpoint(text) == endpoint
    assert str(endpoint) == text.replace("ssl", "tls")


@pytest.mark.parametrize(
    "text",
    ["", "tak:8087", "http://a:1", "tcp://a", "tcp://:8087", "tcp://a:0", "tcp://a:99999", "tcp://a:b", "tcp://a:1/x"],
)
def test_what_is_no_endpoint(text: str) -> None:
    with pytest.raises(ConfigError, match=r"CoT endpoint: got .* expected tcp://host:port"):
        parse_endpoint(text)


def test_a_batch_arrives_whole_when_the_sender_closes(serve: Callable[..., Server]) -> None:
    server = serve()
    many = tuple(b'<event uid="%d">%s</event>' % (n, b"x" * 5000) for n in range(400))
    with CotSender(f"tcp://127.0.0.1:{server.port}") as sender:
        sender.send(many)
    eventually(lambda: server.ended == [True])
    assert bytes(server.heard[0]) == b"".join(event + b"\n" for event in many)


def test_one_connection_serves_many_batches_and_what_the_server_says_is_read_away(
    serve: Callable[..., Server],
) -> None:
    server = serve(greeting=b"<event uid='somebody'/>" * 20_000)
    with CotSender(f"tcp://127.0.0.1:{server.port}") as sender:
        for _ in range(3):
            sender.send(EVENTS)
    eventually(lambda: server.ended == [True])
    assert bytes(server.heard[0]) == STREAM * 3
    assert sender.connections == 1


@pytest.mark.parametrize("end", ["close", "reset"])
def test_an_end_that_went_away_is_noticed_before_the_next_batch(serve: Callable[..., Server], end: str) -> None:
    server = serve()
    with CotSender(f"tcp://127.0.0.1:{server.port}") as sender:
        sender.send(EVENTS)
        eventually(lambda: len(server.heard) == 1 and bytes(server.heard[0]) == STREAM)
        if end == "reset":
            server.reset()
        else:
            server.connections[0].shutdown(socket.SHUT_RDWR)
        assert sender._socket is not None
        sender._socket.settimeout(5)
        try:
            eventually(lambda: sender._socket is not None and sender._socket.recv(1, socket.MSG_PEEK) == b"")
        except ConnectionResetError:
            assert end == "reset"
        sender.send(EVENTS)
    eventually(lambda: server.ended[-1])
    assert (len(server.heard), bytes(server.heard[1])) == (2, STREAM)


def test_a_server_that_comes_later_gets_the_batch() -> None:
    port = free_port()
    started: list[Server] = []

    def wait(_: float) -> bool:
        if not started:
            started.append(Server(port=port))
        return False

    with CotSender(f"tcp://127.0.0.1:{port}", wait=wait) as sender:
        sender.send(EVENTS)
    eventually(lambda: started[0].ended == [True])
    assert bytes(started[0].heard[0]) == STREAM
    started[0].close()


def test_pauses_grow_and_trying_ends_in_time() -> None:
    port, now, pauses = free_port(), [0.0], []

    def wait(timeout: float) -> bool:
        pauses.append(timeout)
        now[0] += timeout
        return False

    sender = CotSender(f"tcp://127.0.0.1:{port}", clock=lambda: now[0], wait=wait)
    with pytest.raises(PortError, match=rf"tcp://127.0.0.1:{port}: 2 events not sent: .*[Rr]efused"):
        sender.send(EVENTS, give_up_after_s=20.0)
    assert pauses == [0.2, 0.5, 1.0, 2.0, 5.0, 5.0, 5.0]


def test_a_wait_that_was_ended_ends_the_trying() -> None:
    sender = CotSender(f"tcp://127.0.0.1:{free_port()}", wait=gives_up)
    with pytest.raises(PortError):
        sender.send(EVENTS)
    sender.close()


def test_datagrams_hold_one_event_each() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10)
        with CotSender(f"udp://127.0.0.1:{receiver.getsockname()[1]}") as sender:
            sender.send(EVENTS)
        assert [receiver.recv(65536) for _ in EVENTS] == list(EVENTS)


def test_multicast_stays_near_unless_told_otherwise() -> None:
    with CotSender("udp://239.2.3.1:6969", multicast_ttl=3) as sender:
        datagrams = sender._datagrams("239.2.3.1", 6969)
        assert datagrams.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 3
        datagrams.close()


def test_an_event_that_no_datagram_holds_is_an_error() -> None:
    with CotSender("udp://127.0.0.1:9") as sender, pytest.raises(PortError, match="65001 bytes"):
        sender.send([b"x" * 65_001])


class Authority:
    """A certificate authority of the test's own."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        self.ca, _ = self._write("ca", self._key, self._key, "authority", ca=True)

    def issue(self, name: str) -> tuple[Path, Path]:
        return self._write(name, ec.generate_private_key(ec.SECP256R1()), self._key, name, ca=False)

    def _write(
        self, file: str, key: ec.EllipticCurvePrivateKey, signer: ec.EllipticCurvePrivateKey, name: str, *, ca: bool
    ) -> tuple[Path, Path]:
        now = dt.datetime.now(dt.UTC)
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        issuer = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "authority")])
        builder = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(issuer)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - dt.timedelta(hours=1))
            .not_valid_after(now + dt.timedelta(hours=1))
            .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
        )
        if ca:
            usage = x509.KeyUsage(
                digital_signature=True,
                key_cert_sign=True,
                crl_sign=True,
                content_commitment=False,
                key_encipherment=False,
                data_encipherment=False,
                key_agreement=False,
                encipher_only=False,
                decipher_only=False,
            )
            builder = builder.add_extension(usage, critical=True)
        else:
            address = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))
            builder = builder.add_extension(x509.SubjectAlternativeName([address]), critical=False)
        certificate = builder.sign(signer, hashes.SHA256())
        paths = self._folder / f"{file}.pem", self._folder / f"{file}.key"
        paths[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        paths[1].write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
        return paths


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path)


def server_context(authority: Authority) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*authority.issue("server"))
    context.load_verify_locations(authority.ca)
    context.verify_mode = ssl.CERT_REQUIRED
    return context


def test_tls_with_certificates_on_both_sides(serve: Callable[..., Server], authority: Authority) -> None:
    server = serve(server_context(authority), greeting=b"<event uid='somebody'/>" * 1000)
    files = TlsFiles(authority.ca, *authority.issue("client"))
    # A write that waits for a session ticket to become data would meet this time-out.
    with CotSender(f"tls://127.0.0.1:{server.port}", files, timeout_s=3.0) as sender:
        for _ in range(3):
            sender.send(EVENTS)
        eventually(lambda: len(server.heard) == 1 and bytes(server.heard[0]) == STREAM * 3)
    eventually(lambda: server.ended == [True])
    assert sender.connections == 1


def test_a_server_of_another_authority_is_refused(
    serve: Callable[..., Server], authority: Authority, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    server = serve(server_context(Authority(tmp_path / "other")))
    sender = CotSender(f"tls://127.0.0.1:{server.port}", TlsFiles(authority.ca), wait=gives_up)
    with pytest.raises(PortError, match=r"(?i)certificate verify failed"):
        sender.send(EVENTS)
    assert server.heard == []


def test_tls_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"TLS: got .*nowhere.pem.* expected readable PEM files"):
        CotSender("tls://127.0.0.1:1", TlsFiles(tmp_path / "nowhere.pem"))
    (tmp_path / "bad.pem").write_text("no certificate")
    with pytest.raises(ConfigError, match=r"bad.pem"):
        CotSender("tls://127.0.0.1:1", TlsFiles(tmp_path / "bad.pem"))
