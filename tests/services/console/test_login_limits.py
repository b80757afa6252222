"""Log-in: limits of wrong passwords, known browsers, number of sessions, and password hashes."""

import hashlib
import ssl
import threading
from concurrent.futures import ThreadPoolExecutor

import httpx2
import pytest
from builders.common import eventually
from builders.console import PASSWORD, Browser, web_server

from sonarpost.network.connections import ConnectionLimits
from sonarpost.services.console.store.users import (
    FILE_NAME,
    MAX_DEVICES_OF_USER,
    MAX_SESSIONS_OF_USER,
    SCRYPT_COST,
    SCRYPT_PARALLEL,
    Users,
)
from sonarpost.services.console.web.access import ApiError
from sonarpost.services.console.web.session_routes import (
    DEVICE_COOKIE,
    MAX_CHECKS,
    RATE_OF_ADDRESS,
    RATE_OF_SOURCE,
    LoginLimiter,
)

NO_TLS = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
"""Saves the time for loading certificates in each client."""


@pytest.fixture
def browser_at(console):
    """Browsers at addresses of a server that permits many connections of one address."""
    clients = []
    with web_server(console, limits=ConnectionLimits(max_of_address=300)) as server:

        def make(source):
            transport = httpx2.HTTPTransport(local_address=source, verify=NO_TLS)
            clients.append(httpx2.Client(base_url=server.address, transport=transport, timeout=120))
            return Browser(clients[-1])

        yield make
        for client in clients:
            client.close()


class Held:
    """Replaces the check of passwords: it waits until `leave` is set."""

    def __init__(self, console, monkeypatch):
        self.leave, self.entered = threading.Event(), threading.Semaphore(0)
        self.tried, verify = [], console.users.verify_password

        def wait(name, password):
            self.tried.append(name)
            self.entered.release()
            assert self.leave.wait(120)
            return verify(name, password)

        monkeypatch.setattr(console.users, "verify_password", wait)


def test_parallel_wrong_passwords_do_not_pass_the_limit_and_lock_no_one_out(console, browser_at, monkeypatch):
    known = browser_at("127.0.0.1")
    assert known.login("anna").status_code == 200
    held = Held(console, monkeypatch)
    attackers = [browser_at("127.0.0.1") for _ in range(40)]
    with ThreadPoolExecutor(40) as pool:
        answers = [pool.submit(one.login, "anna", "wrong password") for one in attackers]
        # All others are refused while the first ones are checked.
        eventually(lambda: sum(one.done() for one in answers) == 40 - RATE_OF_SOURCE.burst, what="refused attempts")
        held.leave.set()
    codes = [one.result().status_code for one in answers]
    assert (codes.count(401), codes.count(429)) == (RATE_OF_SOURCE.burst, 40 - RATE_OF_SOURCE.burst)
    assert held.tried == ["anna"] * RATE_OF_SOURCE.burst
    # The right password works from another address, for another user, and in a browser that has logged in before.
    assert browser_at("127.0.0.2").login("anna").status_code == 200
    assert browser_at("127.0.0.1").login("bo").status_code == 200
    assert known.login("anna").status_code == 200
    limited = attackers[0].login("anna")
    assert (limited.status_code, limited.json()["error"]["code"]) == (429, "too_many")
    assert 0 < int(limited.headers["retry-after"]) <= RATE_OF_SOURCE.interval_s + 1
    assert f"again in {limited.headers['retry-after']} s" in limited.json()["error"]["message"]


def test_waiting_checks_are_limited(console, browser_at, monkeypatch):
    held = Held(console, monkeypatch)
    browsers = [browser_at(f"127.0.0.{10 + n}") for n in range(MAX_CHECKS + 1)]
    with ThreadPoolExecutor(MAX_CHECKS) as pool:
        waiting = [pool.submit(one.login, "anna", "wrong password") for one in browsers[:-1]]
        for _ in range(MAX_CHECKS):
            assert held.entered.acquire(timeout=120)
        busy = browsers[-1].login("anna")
        held.leave.set()
        assert [one.result().status_code for one in waiting] == [401] * MAX_CHECKS
    assert (busy.status_code, busy.json()["error"]["code"]) == (503, "busy")
    assert int(busy.headers["retry-after"]) > 0


def attempt(limiter: LoginLimiter, user: str, address: str, device: str | None = None, *, right: bool = False) -> int:
    """Return the time to wait before a log-in; 0 if its password is checked."""
    try:
        with limiter.attempt(limiter.buckets_of_login(user, address, device), known=device is not None) as refund:
            if right:
                refund()
    except ApiError as error:
        return int(error.headers["Retry-After"])
    return 0


def test_attempts_are_refilled_with_time():
    now = [1000.0]
    limiter = LoginLimiter(lambda: now[0])
    assert [attempt(limiter, "a", "x") for _ in range(6)] == [0, 0, 0, 0, 0, 61]
    now[0] += 59
    assert attempt(limiter, "a", "x") == 2
    now[0] += 1
    assert [attempt(limiter, "a", "x") for _ in range(2)] == [0, 61]
    now[0] += 10_000
    # Right passwords are not charged.
    assert not any(attempt(limiter, "b", "x", right=True) for _ in range(200))
    assert attempt(limiter, "b", "x") == 0
    # Full buckets are deleted.
    assert len(limiter._full_at_s) == 3


def test_wrong_passwords_for_many_names_delay_only_unknown_browsers_at_the_address():
    limiter = LoginLimiter(lambda: 0.0)
    delays = [attempt(limiter, f"name {n}", "x") for n in range(RATE_OF_ADDRESS.burst + 1)]
    assert delays == [0] * RATE_OF_ADDRESS.burst + [16]
    assert attempt(limiter, "a", "x") == 16
    assert attempt(limiter, "a", "y") == 0
    assert attempt(limiter, "a", "x", "token of a known browser") == 0


def test_wrong_passwords_from_many_addresses_delay_unknown_browsers_of_the_user():
    limiter = LoginLimiter(lambda: 0.0)
    delays = [attempt(limiter, "a", f"address {n}") for n in range(101)]
    assert delays == [0] * 100 + [11]
    assert attempt(limiter, "b", "address 101") == 0
    assert attempt(limiter, "a", "address 101", "token of a known browser") == 0


def test_known_browser_has_its_own_limit_for_its_user_only(console):
    anna = console.browser("anna")
    token = anna.client.cookies[f"{DEVICE_COOKIE}_8470"]
    assert console.users.is_known_device("anna", token)
    assert not console.users.is_known_device("bo", token)
    assert not console.users.is_known_device("anna", "")
    assert [anna.login("anna", "wrong password").status_code for _ in range(6)] == [401] * 5 + [429]
    assert console.browser().login("anna").status_code == 200
    # A second user of the browser keeps the token; a token that the server did not issue is replaced.
    assert anna.login("bo").status_code == 200
    assert anna.client.cookies[f"{DEVICE_COOKIE}_8470"] == token
    assert console.users.is_known_device("bo", token)
    invented = console.users.add_device("anna", "x" * 43)
    assert invented != "x" * 43
    assert not console.users.is_known_device("anna", "x" * 43)


def test_known_browsers_expire_and_are_limited(tmp_path):
    now = [1000.0]
    users = Users(tmp_path / FILE_NAME, clock=lambda: now[0])
    users.add("anna", "operator", PASSWORD)
    tokens = []
    for _ in range(MAX_DEVICES_OF_USER + 1):
        now[0] += 1
        tokens.append(users.add_device("anna", ""))
    assert [users.is_known_device("anna", token) for token in tokens] == [False] + [True] * MAX_DEVICES_OF_USER
    assert tokens[-1].encode() not in b"".join(path.read_bytes() for path in tmp_path.iterdir())
    now[0] += 91 * 86400
    assert not users.is_known_device("anna", tokens[-1])
    users.add_device("anna", "")
    users.remove("anna")
    with users.read() as db:
        assert db.execute("SELECT COUNT(*) FROM device").fetchone()[0] == 0
    users.close()


def test_another_session_of_too_many_ends_the_oldest(console):
    first = console.browser("anna")
    bo = console.browser("bo")
    for _ in range(MAX_SESSIONS_OF_USER - 1):
        last = console.browser("anna")
    assert first.get("/api/session").status_code == 200
    last = console.browser("anna")
    assert first.get("/api/session").status_code == 401
    assert last.get("/api/session").status_code == 200
    assert bo.get("/api/session").status_code == 200


def test_scrypt_parameters_are_among_the_minimum_ones_of_owasp():
    # Imported before the fixture that reduces the cost.
    assert (SCRYPT_COST, SCRYPT_PARALLEL) in {(2**17, 1), (2**16, 2), (2**15, 3), (2**14, 5), (2**13, 10)}


def test_hash_with_other_parameters_is_replaced_at_the_next_log_in(tmp_path):
    old = hashlib.scrypt(PASSWORD.encode(), salt=bytes(16), n=2**12, r=8, p=1, dklen=32)
    path = tmp_path / FILE_NAME
    users = Users(path)
    with users.transaction() as db:
        db.execute("INSERT INTO user VALUES ('anna', 'operator', ?, ?, 4096, 1, 7.0)", (bytes(16), old))
    token = users.start_session("anna").token
    assert not users.verify_password("anna", "wrong password")
    assert users.verify_password("anna", PASSWORD)
    with users.read() as connection:
        row = connection.execute("SELECT * FROM user").fetchone()
    assert (row["cost"], row["parallel"], row["changed_utc_s"]) == (2**4, 3, 7.0)
    assert bytes(row["hash"]) not in (old, b"")
    users.close()
    again = Users(path)
    assert again.verify_password("anna", PASSWORD)
    assert not again.verify_password("anna", "wrong password")
    assert again.find_session(token) is not None
    again.close()
