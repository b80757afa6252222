"""Terminal, webhook and gateway against the emulated message service; hostile requests and replies."""

import contextlib
import itertools
import os
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from types import SimpleNamespace
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import Request, urlopen

import pytest
import serial
from builders.common import eventually
from extensions.satellite.gateway import MessageGatewayEmulator
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import DeliveryError, PortError
from sonarpost.extensions.satellite import iridium
from sonarpost.extensions.satellite.iridium import ExchangeResult, IridiumTerminal, TerminalError
from sonarpost.extensions.satellite.rockblock import (
    MAX_BODY_BYTES,
    RockBlockAccount,
    Webhook,
    WebhookError,
    parse_webhook,
)
from sonarpost.runtime.serial_device import close_port, open_port

IMEI = "300234010753370"
TOKEN = "t0ken"


@pytest.fixture
def messages():
    return []


@pytest.fixture
def webhook(messages):
    with closing(Webhook("127.0.0.1", 0, TOKEN, messages.append)) as webhook:
        yield webhook


@pytest.fixture
def gateway(webhook):
    with closing(MessageGatewayEmulator(f"http://127.0.0.1:{webhook.port}/{TOKEN}", [IMEI])) as gateway:
        yield gateway


@pytest.fixture
def terminal(gateway):
    with closing(IridiumTerminal(gateway.terminal_url(IMEI))) as terminal:
        yield terminal


@pytest.fixture
def account(gateway):
    return RockBlockAccount(gateway.mt_url, "user", "password")


def test_messages_travel_in_both_directions(gateway, terminal, account, messages):
    every_byte = bytes(range(256))
    assert terminal.exchange(every_byte) == ExchangeResult(sent=True)
    assert terminal.exchange(b"x" * 340).sent
    eventually(lambda: len(messages) == 2)
    assert [(m.imei, m.momsn, m.data) for m in messages] == [(IMEI, 1, every_byte), (IMEI, 2, b"x" * 340)]
    account.send(IMEI, every_byte)
    account.send(IMEI, b"second")
    assert terminal.exchange(None) == ExchangeResult(sent=False, received=every_byte, waiting=1)
    assert terminal.exchange(b"third") == ExchangeResult(sent=True, received=b"second", waiting=0)
    assert gateway.messages == 3


def test_gateway_refuses_wrong_credentials_and_unknown_terminals(account, gateway):
    with pytest.raises(DeliveryError, match="Invalid login"):
        RockBlockAccount(gateway.mt_url, "user", "wrong").send(IMEI, b"x")
    with pytest.raises(DeliveryError, match="No RockBLOCK"):
        account.send("300234010753371", b"x")
    with pytest.raises(DeliveryError, match="271 bytes"):
        account.send(IMEI, bytes(271))
    with pytest.raises(DeliveryError, match="gateway"):
        RockBlockAccount("http://127.0.0.1:1/MT", "", "").send(IMEI, b"x")


def post(webhook, path, body, headers=None):
    try:
        with urlopen(Request(f"http://127.0.0.1:{webhook.port}{path}", body, headers or {}), timeout=120) as reply:
            return reply.status
    except HTTPError as error:
        error.close()
        return error.code


def form(**changes):
    return urlencode({"imei": IMEI, "momsn": "1", "data": "00ff"} | changes).encode()


def test_webhook_refuses_what_is_not_a_message(webhook, messages):
    assert post(webhook, f"/{TOKEN}", form()) == 200
    for path in ("/", "/t0ke", "/t0kenx", "/%74oken", f"/{TOKEN}/x"):
        assert post(webhook, path, form()) == 404
    assert post(webhook, f"/{TOKEN}", form(data="0" * MAX_BODY_BYTES)) == 413
    for wrong in (form(imei="1"), form(momsn="70000"), form(momsn="-1"), form(data="0"), form(data="zz"), b"\xff"):
        assert post(webhook, f"/{TOKEN}", wrong) == 400
    assert post(webhook, f"/{TOKEN}", form(data="00" * 341)) == 400
    assert post(webhook, f"/{TOKEN}", b"&".join([b"a=1"] * 30)) == 400
    with socket.create_connection(("127.0.0.1", webhook.port)) as client:
        client.sendall(f"POST /{TOKEN} HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n".encode())
        assert b" 413 " in client.recv(4096)
    with socket.create_connection(("127.0.0.1", webhook.port)) as client:
        client.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert b" 501 " in client.recv(4096)
    assert len(messages) == 1


def test_webhook_reports_that_a_message_has_to_be_repeated(messages):
    errors = [DeliveryError("disk full"), WebhookError("webhook", "imei", IMEI, "a known terminal")]

    def receive(message):
        if errors:
            raise errors.pop(0)
        messages.append(message)

    with closing(Webhook("127.0.0.1", 0, TOKEN, receive)) as webhook:
        assert [post(webhook, f"/{TOKEN}", form()) for _ in range(3)] == [503, 400, 200]


SLOW = b"POST /wrong HTTP/1.1\r\nX: "


@pytest.mark.system
def test_slow_clients_without_the_token_do_not_keep_the_gateway_out(webhook, messages):
    with ExitStack() as slow:
        clients = [slow.enter_context(socket.create_connection(("127.0.0.1", webhook.port))) for _ in range(200)]
        for n, client in enumerate(clients):
            with contextlib.suppress(OSError):  # the first ones are closed for later ones
                client.sendall(SLOW)
            if n % 10 == 0:
                assert post(webhook, f"/{TOKEN}", form()) == 200
    assert len(messages) == 20


def test_webhook_refuses_with_a_status_while_all_connections_of_an_address_are_handled(messages):
    entered, release = threading.Semaphore(0), threading.Event()

    def receive(message):
        entered.release()
        assert release.wait(300)
        messages.append(message)

    with closing(Webhook("127.0.0.1", 0, TOKEN, receive)) as webhook, ThreadPoolExecutor(16) as pool:
        statuses = [pool.submit(post, webhook, f"/{TOKEN}", form()) for _ in range(16)]
        for _ in range(16):
            assert entered.acquire(timeout=300)
        assert [post(webhook, f"/{TOKEN}", form()) for _ in range(20)] == [503] * 20
        release.set()
        assert [status.result() for status in statuses] == [200] * 16
        assert post(webhook, f"/{TOKEN}", form()) == 200
    assert len(messages) == 17


def test_webhook_refuses_an_incomplete_body_and_an_endless_head(webhook, messages):
    with socket.create_connection(("127.0.0.1", webhook.port)) as client:
        client.sendall(f"POST /{TOKEN} HTTP/1.1\r\nContent-Length: 100\r\n\r\n".encode() + form())
        client.shutdown(socket.SHUT_WR)
        assert b" 400 " in client.recv(4096)
    with socket.create_connection(("127.0.0.1", webhook.port)) as client:
        sent = 0
        with contextlib.suppress(OSError):
            client.sendall(f"POST /{TOKEN} HTTP/1.1\r\n".encode())
            while sent < 50_000_000:
                sent += client.send(b"X: " + bytes(1000).replace(b"\0", b"x") + b"\r\n")
        assert sent < 50_000_000
    assert post(webhook, f"/{TOKEN}", form()) == 200
    assert len(messages) == 1


def test_unexpected_exception_is_reported_and_the_gateway_repeats(messages, caplog):
    def receive(message):
        raise RuntimeError("a defect")

    with closing(Webhook("127.0.0.1", 0, TOKEN, receive)) as webhook:
        assert [post(webhook, f"/{TOKEN}", form()) for _ in range(20)] == [500] * 20
    assert "unexpected exception" in caplog.text


@given(st.binary(max_size=300) | st.text(max_size=100).map(lambda t: form(data=t)))
def test_hostile_forms_raise_the_documented_error_only(body):
    try:
        parse_webhook(body)
    except WebhookError:
        return


class ScriptedPort:
    """A port with the given bytes, and a simulated clock that jumps to the end of a wait when none are left."""

    def __init__(self, data):
        self._bytes = iter(data)
        self.now_s = 0.0

    def write(self, data):
        pass

    def read(self, size):
        found = bytes(itertools.islice(self._bytes, size))
        self.now_s += 0.0 if found else iridium.SESSION_S
        return found

    def exchange(self):
        """Exchange a message with a terminal on this port."""
        terminal = IridiumTerminal("/dev/ttyTEST")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(iridium, "time", SimpleNamespace(monotonic=lambda: self.now_s))
            patch.setattr(terminal, "_open", lambda: self)
            return terminal.exchange(b"x")


REPLIES = [b"\r\nOK\r\n", b"\r\n0\r\n", b"READY\r\n", b"+SBDIX: 0, 1, 1, 1, 4, 0\r\n"]


@given(st.lists(st.binary(max_size=30) | st.sampled_from(REPLIES), max_size=60))
def test_hostile_replies_of_a_terminal_raise_the_documented_error_only(replies):
    with contextlib.suppress(TerminalError):
        ScriptedPort(b"".join(replies)).exchange()


@pytest.mark.parametrize(
    ("status", "problem"),
    [
        (b"+SBDIX: 0, 1, 1, 1, 400, 0\r\n", "MT length: got 400"),
        (b"+SBDIX: 0, 1\r\n", "six numbers"),
        (b"+SBDIX: a, b, c, d, e, f\r\n", "six numbers"),
        (b"ERROR\r\n", "six numbers"),
        (b"", "a line within"),
    ],
)
def test_wrong_status_is_named(status, problem):
    with pytest.raises(TerminalError, match=problem):
        ScriptedPort(b"OK\r\nREADY\r\n0\r\nOK\r\nSBDRING\r\n" + status).exchange()


def test_terminal_that_refuses_or_is_absent():
    with pytest.raises(PortError):
        IridiumTerminal("socket://127.0.0.1:1").exchange(b"x")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            connection, _ = server.accept()
            connection.recv(100)
            connection.sendall(b"ERROR\r\n")
            connection.close()

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(TerminalError, match="ERROR"):
            IridiumTerminal(f"socket://127.0.0.1:{server.getsockname()[1]}").exchange(b"x")
        thread.join()


class EndlessPort:
    """A port from which lines without a meaning come for ever, one byte a second of a simulated clock."""

    def __init__(self, clock):
        self._bytes = itertools.cycle(b"\r\n" * 15 + b"SBDRING\r\n")
        self._clock = clock
        self.is_open = True

    def write(self, data):
        pass

    def read(self, size):
        self._clock[0] += 1.0
        return bytes([next(self._bytes)])

    def close(self):
        self.is_open = False


def test_exchange_with_a_terminal_has_a_time_limit_in_total(monkeypatch):
    clock = [0.0]
    port = EndlessPort(clock)
    terminal = IridiumTerminal("/dev/ttyTEST")
    monkeypatch.setattr(iridium, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(terminal, "_open", lambda: port)
    with pytest.raises(TerminalError):
        terminal.exchange(b"x")
    assert clock[0] <= iridium.EXCHANGE_S + 2


def test_terminal_does_not_take_a_port_in_use():
    ends = os.openpty()
    port = serial.serial_for_url(os.ttyname(ends[1]), do_not_open=True)
    open_port(port)
    try:
        with closing(IridiumTerminal(port.port)) as terminal, pytest.raises(PortError, match="in use by "):
            terminal.exchange(b"x")
    finally:
        close_port(port)
        for end in ends:
            os.close(end)
