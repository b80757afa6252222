"""One HTTP request to a server that replies slowly, without end, or not at all."""

import socket
import ssl
import threading
from contextlib import contextmanager, suppress

import pytest
from builders.common import WAIT_S, eventually

from sonarpost.network import http_client
from sonarpost.network.http_client import post


@contextmanager
def server_that(sends):
    """Accept connections; each receives the pieces of `sends`, and is then kept open until the end of the test."""
    ended = threading.Event()
    accepted = []

    def serve():
        with suppress(OSError):
            while True:
                accepted.append(listener.accept()[0])
                threading.Thread(target=reply, args=(accepted[-1],), daemon=True).start()

    def reply(connection):
        with suppress(OSError):
            for piece in sends(ended):
                connection.sendall(piece)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield f"127.0.0.1:{listener.getsockname()[1]}", accepted
        finally:
            ended.set()
            listener.shutdown(socket.SHUT_RDWR)
            thread.join(WAIT_S)
            for connection in accepted:
                connection.close()


def pieces(*data):
    return lambda _ended: data


def endless(head, piece, interval_s=0.0):
    def sends(ended):
        yield head
        while not ended.wait(interval_s):
            yield piece

    return sends


HEAD = b"HTTP/1.1 200 OK\r\n"


def test_reply_with_and_without_its_body():
    reply = HEAD + b"Content-Length: 5\r\n\r\nhello"
    with server_that(pieces(reply)) as (address, _):
        assert post(f"http://{address}/a?b=1", b"x", {}) == http_client.Reply(200, "OK", b"")
        assert post(f"http://{address}/", b"x", {}, reads_body=True).body == b"hello"
    # The status is known although the body never ends.
    with server_that(endless(HEAD + b"\r\n", b"x", 0.01)) as (address, _):
        assert post(f"http://{address}/", b"x", {}).status == 200


@pytest.mark.parametrize(
    ("sends", "reads_body"),
    [
        (endless(b"", b"HTTP/1.1 100 Continue\r\n\r\n"), False),
        (endless(HEAD + b"\r\n", b"x" * 1000), True),
        (endless(HEAD + b"Transfer-Encoding: chunked\r\n\r\n", b"1\r\nx\r\n"), True),
        (endless(HEAD, b"A: b\r\n"), False),
        (endless(HEAD + b"A: ", b"x" * 1000), False),
        (pieces(b"SSH-2.0-OpenSSH_9.2\r\n"), False),
    ],
    ids=["interim replies", "body", "chunks", "headers", "header", "other protocol"],
)
def test_reply_without_end_is_an_error_before_the_deadline(sends, reads_body):
    with server_that(sends) as (address, _), pytest.raises(ConnectionError, match="reply"):
        post(f"http://{address}/", b"x", {}, reads_body=reads_body, timeout_s=WAIT_S)


@pytest.mark.parametrize(
    ("scheme", "sends", "reads_body"),
    [
        ("http", pieces(), False),
        ("http", endless(HEAD + b"A: ", b"x", 0.02), False),
        ("http", endless(b"", b"HTTP/1.1 100 Continue\r\n\r\n", 0.02), False),
        ("http", endless(HEAD + b"\r\n", b"x", 0.02), True),
        ("https", pieces(), False),
        ("https", endless(b"\x16\x03\x03\x40\x00\x02", b"\x00", 0.02), False),
    ],
    ids=["silent", "head", "interim replies", "body", "silent TLS", "TLS handshake"],
)
def test_deadline_is_for_the_whole_exchange(scheme, sends, reads_body):
    # Each read of a byte a while has its own time limit in `http.client`, so that it would never end.
    with server_that(sends) as (address, accepted):
        with pytest.raises(TimeoutError, match=r"within 0\.5 s"):
            post(f"{scheme}://{address}/", b"x", {}, reads_body=reads_body, timeout_s=0.5)
        eventually(lambda: accepted, what="connection")
        accepted[0].settimeout(WAIT_S)
        with suppress(ConnectionResetError):
            while accepted[0].recv(4096):
                pass  # the request; then the client has closed the connection


def test_event_ends_an_exchange():
    stop = threading.Event()
    asked = threading.Event()

    def sends(_ended):
        asked.set()
        return ()

    with server_that(sends) as (address, _):
        threading.Thread(target=lambda: asked.wait(WAIT_S) and stop.set(), daemon=True).start()
        with pytest.raises(TimeoutError, match="ended by a signal"):
            post(f"https://{address}/", b"x", {}, timeout_s=WAIT_S, stop=stop)


def test_resolution_of_a_name_that_does_not_end_is_given_up(monkeypatch):
    resolved = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: resolved.wait(WAIT_S) and [])
    with pytest.raises(TimeoutError, match="no complete reply"):
        post("http://shore.example/", b"x", {}, timeout_s=0.2)
    resolved.set()


def test_errors_of_the_connection_are_os_errors():
    with pytest.raises(ConnectionRefusedError):
        post("http://127.0.0.1:1/", b"x", {})
    with pytest.raises(ConnectionError, match="control characters"):
        post("http://127.0.0.1:1/a b", b"x", {})
    with server_that(pieces(b"HTTP/1.1 200 OK\r\n\r\n")) as (address, _), pytest.raises(ssl.SSLError):
        post(f"https://{address}/", b"x", {})
