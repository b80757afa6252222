"""The event sender with real sockets: what it reports equals what the server has received, for every kind of server."""

import socket
import ssl
import threading

import pytest
from builders.common import WAIT_S, eventually, free_port
from builders.tls_authority import Authority
from extensions.tak.tak_server import TakServer

from sonarpost.errors import ConfigError, PortError
from sonarpost.extensions.tak import cot_stream
from sonarpost.extensions.tak.cot_sender import DATAGRAMS, MAX_BATCH, CotSender, TakEndpoint, parse_endpoint
from sonarpost.extensions.tak.cot_stream import ACKNOWLEDGED, READ
from sonarpost.security.client_tls import TlsFiles

EVENTS = (b'<event uid="a"/>', b'<event uid="b"/>')
STREAM = b'<event uid="a"/>\n<event uid="b"/>\n'
OTHER = b"<event uid='other'/>"
PASSPHRASE = b"atakatak"
TLS_VERSIONS = (ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3)


@pytest.fixture
def serve():
    servers: list[TakServer] = []

    def make(*args, **options):
        servers.append(TakServer(*args, **options))
        return servers[-1]

    yield make
    for server in servers:
        server.close()


@pytest.fixture
def authority(tmp_path):
    return Authority(tmp_path)


def sender_to(server, scheme="tcp", tls=TlsFiles(), **options):  # noqa: B008 it is frozen
    return CotSender(f"{scheme}://127.0.0.1:{server.port}", tls, **{"settle_s": 0.0, "timeout_s": 600.0, **options})


def refused(sender, events=EVENTS):
    """Return the text of the failure of one attempt."""
    with pytest.raises(PortError) as caught:
        sender.send(events, give_up_after_s=0.0)
    return str(caught.value)


def test_endpoint_forms():
    for text, endpoint in (
        ("tcp://tak.example:8087", TakEndpoint("tcp", "tak.example", 8087)),
        ("ssl://tak.example:8089", TakEndpoint("tls", "tak.example", 8089)),
        ("udp://239.2.3.1:6969", TakEndpoint("udp", "239.2.3.1", 6969)),
        ("tcp://[::1]:8087", TakEndpoint("tcp", "::1", 8087)),
    ):
        assert parse_endpoint(text) == endpoint
        assert str(endpoint) == text.replace("ssl", "tls")
    invalid = ("", "tak:8087", "http://a:1", "tcp://a", "tcp://:8087", "tcp://a:0", "tcp://a:99999", "tcp://a:b")
    for text in (*invalid, "tcp://a:1/x"):
        with pytest.raises(ConfigError, match=r"CoT endpoint: got .* expected tcp://host:port"):
            parse_endpoint(text)


# Servers that receive the events


@pytest.mark.parametrize("version", [None, *TLS_VERSIONS])
@pytest.mark.parametrize("greeting", [b"", OTHER, OTHER * 20_000])
def test_good_client_is_read_to_its_end(serve, authority, version, greeting):
    context = None if version is None else authority.server_context(version=version)
    server = serve(context, greeting=greeting)
    sender = sender_to(server, "tcp" if version is None else "tls", authority.issue("client"))
    many = tuple(b'<event uid="%d">%s</event>' % (n, b"x" * 5000) for n in range(100))
    assert sender.send(many) == sender.send(EVENTS) == READ
    assert bytes(server.received[0]) == b"".join(event + b"\n" for event in many)
    assert bytes(server.received[1]) == STREAM
    assert sender.delivered == server.events() == 102
    assert sender.send([]) == READ  # a check of the connection
    assert sender.delivered == 102


@pytest.mark.parametrize("version", [None, *TLS_VERSIONS])
def test_server_that_keeps_the_connection_open(serve, authority, version):
    context = None if version is None else authority.server_context(version=version)
    server = serve(context, keeps_open=True)
    now_s = 0.0

    def clock():
        nonlocal now_s
        now_s += server.ended == [True]  # time passes when the server has received all
        return now_s

    sender = sender_to(
        server, "tcp" if version is None else "tls", authority.issue("client"), clock=clock, timeout_s=5.0
    )
    assert sender.send(EVENTS) == ACKNOWLEDGED
    assert sender.delivered == server.events() == 2


def test_batch_is_sent_when_the_server_starts_later():
    port, started = free_port(), []

    def wait(_):
        if not started:
            started.append(TakServer(port=port))

    sender = CotSender(f"tcp://127.0.0.1:{port}", TlsFiles(), wait=wait, settle_s=0.0)
    sender.send(EVENTS)
    assert sender.delivered == started[0].events() == 2
    started[0].close()


def test_pauses_increase_until_the_time_limit():
    port, now, pauses = free_port(), [0.0], []

    def wait(timeout):
        pauses.append(timeout)
        now[0] += timeout

    sender = CotSender(f"tcp://127.0.0.1:{port}", TlsFiles(), clock=lambda: now[0], wait=wait)
    with pytest.raises(PortError, match=rf"tcp://127.0.0.1:{port}: 0 of 2 events delivered: Connection refused$"):
        sender.send(EVENTS, give_up_after_s=20.0)
    assert pauses == [0.2, 0.5, 1.0, 2.0, 5.0, 5.0, 5.0]


# Servers that refuse the client


@pytest.mark.parametrize("version", TLS_VERSIONS)
@pytest.mark.parametrize("client", ["another authority", "no certificate", "expired", "revoked"])
@pytest.mark.parametrize("count", [1, 400])
def test_refused_client_delivers_nothing_and_is_told_why(serve, authority, tmp_path, version, client, count):
    good = authority.issue("client")
    files, reason = {
        "another authority": (Authority(tmp_path, "other").issue("client"), "unknown CA"),
        "no certificate": (TlsFiles(), "certificate required|handshake failure"),
        "expired": (authority.issue("late", expired=True), "certificate expired"),
        "revoked": (good, "certificate revoked"),
    }[client]
    server = serve(authority.server_context(version=version, revoked=[good] if client == "revoked" else ()))
    files = TlsFiles(good.ca, files.certificate, files.key)
    # Small batches are written before the refusal; large ones fail in the write.
    sender = sender_to(server, "tls", files, wait=lambda _: pytest.fail("a refusal is not tried again"))
    with pytest.raises(PortError, match=rf"0 of {count} events delivered: refused by the server: ({reason})$"):
        sender.send([b"x" * 10_000] * count)
    assert sender.delivered == server.events() == 0


def test_server_that_does_not_show_acceptance_does_not_count(serve, authority):
    """Without tickets, data and close_notify, nothing shows that a server of TLS 1.3 accepts the client."""
    server = serve(authority.server_context(tickets=0))
    sender = sender_to(server, "tls", authority.issue("client"))
    assert "0 of 2 events delivered: the server has neither accepted nor refused the client within 600 s" in refused(
        sender
    )
    assert sender.delivered == 0


def test_server_of_another_authority_or_with_an_expired_certificate_is_refused(serve, authority, tmp_path):
    server = serve(authority.server_context())
    other = Authority(tmp_path, "other").issue("client")
    assert "certificate verify failed, that of the server: self-signed certificate in certificate chain" in refused(
        sender_to(server, "tls", other)
    )
    late = authority.issue("late", expired=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(late.certificate, late.key)
    expired = serve(context)
    assert "certificate has expired" in refused(sender_to(expired, "tls", late))
    assert server.received == expired.received == []


# Servers of another protocol


def test_tcp_to_a_tls_port(serve, authority):
    server = serve(authority.server_context())
    text = refused(sender_to(server))
    assert "0 of 2 events delivered" in text
    assert "a port with TLS needs tls://" in text
    assert server.received == []
    # Some servers answer with an alert.
    alert = serve(greeting=b"\x15\x03\x01\x00\x02\x02\x46", keeps_open=True)
    assert "refused by the server with a TLS alert: the port needs tls://" in refused(sender_to(alert))


@pytest.mark.parametrize("server_options", [{"greeting": OTHER}, {"closes_after": 1}, {"reset_in": 0}, {}])
def test_tls_to_a_plain_port(serve, authority, server_options):
    server = serve(**server_options)
    timeout_s = 600.0 if server_options else 0.01  # the last one does not answer
    text = refused(sender_to(server, "tls", authority.issue("client"), timeout_s=timeout_s))
    assert "0 of 2 events delivered: " in text
    assert "a port without TLS needs tcp://" in text
    assert all(b"event" not in data for data in server.received)


@pytest.mark.parametrize("has_tls", [False, True])
def test_port_of_http(serve, authority, has_tls):
    server = serve(authority.server_context() if has_tls else None, greeting=b"HTTP/1.1 400 Bad Request\r\n\r\n")
    sender = sender_to(server, "tls" if has_tls else "tcp", authority.issue("client"))
    assert "0 of 2 events delivered: refused by the server with an HTTP reply" in refused(sender)


# Servers that stop


@pytest.mark.parametrize("version", [None, *TLS_VERSIONS])
@pytest.mark.parametrize("reset_after", [1, 100_000])
def test_server_killed_in_mid_stream(serve, authority, version, reset_after):
    context = None if version is None else authority.server_context(version=version)
    server = serve(context, reset_in=1, reset_after=reset_after)
    sender = sender_to(server, "tcp" if version is None else "tls", authority.issue("client"))
    text = refused(sender, [b"<event>%s</event>" % (b"x" * 2000)] * (MAX_BATCH + 100))
    assert f"{MAX_BATCH} of {MAX_BATCH + 100} events delivered" in text
    assert "closed by the server, which has stopped or refused the client" in text
    assert sender.delivered == server.events() == MAX_BATCH
    if version is None:
        assert "some events can have arrived" in text


def test_interrupted_batch_is_sent_again(serve):
    server = serve(reset_in=0)
    sender = sender_to(server, wait=lambda _: None)
    assert sender.send(EVENTS) == READ
    assert sender.delivered == server.events() == 2


@pytest.mark.parametrize("version", [None, *TLS_VERSIONS])
def test_server_that_closes_first_has_not_accepted_the_events(serve, authority, version):
    """A TAK server that authenticates after the handshake closes the connection of a client that it does not know."""
    context = None if version is None else authority.server_context(version=version)
    server = serve(context, closes_after=len(STREAM))
    sender = sender_to(server, "tcp" if version is None else "tls", authority.issue("client"), settle_s=600.0)
    text = refused(sender)
    assert "0 of 2 events delivered" in text
    assert "which has stopped or refused the client" in text
    assert sender.delivered == server.events() == 0


def test_server_that_reads_nothing(serve):
    with socket.create_server(("127.0.0.1", 0)) as listener:  # it accepts no connection
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sender = CotSender(f"tcp://127.0.0.1:{listener.getsockname()[1]}", TlsFiles(), timeout_s=0.01, settle_s=0.0)
        text = refused(sender, [b"x" * 60_000] * MAX_BATCH)
    assert "not acknowledged by the server's TCP within 0.01 s" in text
    assert sender.delivered == 0


# Datagrams


def test_server_that_reads_a_few_bytes_a_while(monkeypatch):
    """Each read is progress, so that a limit of each wait alone would not end the connection."""
    monkeypatch.setattr(cot_stream, "EXCHANGE_S", 0.5)
    ended = threading.Event()

    def read():
        connection, _ = listener.accept()
        with connection:
            while not ended.wait(0.01) and connection.recv(512):
                pass

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        thread = threading.Thread(target=read)
        thread.start()
        sender = CotSender(f"tcp://127.0.0.1:{listener.getsockname()[1]}", TlsFiles(), timeout_s=WAIT_S, settle_s=0.0)
        with pytest.raises(PortError, match="0 of 1 events delivered"):
            sender.send([bytes(20_000_000)], give_up_after_s=0.0)
        ended.set()
        thread.join(WAIT_S)


def test_each_datagram_holds_one_event():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        sender = CotSender(f"udp://127.0.0.1:{receiver.getsockname()[1]}", TlsFiles())
        assert sender.send(EVENTS) == DATAGRAMS
        assert [receiver.recv(65536) for _ in EVENTS] == list(EVENTS)
    assert sender.delivered == 2
    assert "Connection refused" in refused(sender, EVENTS[:1])
    with pytest.raises(PortError, match="65001 bytes"):
        CotSender("udp://127.0.0.1:9", TlsFiles()).send([b"x" * 65_001])


# Files of TLS


def test_encrypted_key_and_pkcs12(serve, authority, tmp_path):
    server = serve(authority.server_context())
    files = authority.issue("client")
    client, truststore, key = authority.encrypted(files, PASSPHRASE)
    passphrase = tmp_path / "passphrase"
    passphrase.write_bytes(PASSPHRASE + b"\nmore")
    passphrase.chmod(0o600)
    for tls in (
        TlsFiles(files.ca, files.certificate, key, passphrase),
        TlsFiles(files.ca, client, None, passphrase),
        TlsFiles(truststore, client, None, passphrase),
    ):
        sender_to(server, "tls", tls).send(EVENTS)
    eventually(lambda: server.events() == 6)


def test_expected_name_of_the_server(serve, authority):
    server = serve(authority.server_context(hosts=("takserver",)))
    files = authority.issue("client")
    assert "IP address mismatch" in refused(sender_to(server, "tls", files))
    named = TlsFiles(files.ca, files.certificate, files.key, server_name="takserver")
    assert sender_to(server, "tls", named).send(EVENTS) == READ
    other = TlsFiles(files.ca, files.certificate, files.key, server_name="elsewhere")
    assert "Hostname mismatch" in refused(sender_to(server, "tls", other))
