"""Reason of a router that is not reached, for each cause that Zenoh itself reports as a time-out."""

import socket
import subprocess
import sys
import threading

import pytest
from builders.common import WAIT_S, free_port

from sonarpost.bus import connectivity, session
from sonarpost.bus.connectivity import ConnectivityResult, ConnectivityState, diagnose_no_reply
from sonarpost.bus.session import lost_reason, open_with_retry
from sonarpost.security.router_config import RouterOptions


@pytest.fixture(autouse=True)
def waits(monkeypatch):
    """Attempts that fail anyway are short; a busy server has time to refuse."""
    monkeypatch.setattr(session, "OPEN_TIMEOUT_MS", (50,))
    for name in ("TIMEOUT_S", "TLS_REFUSAL_S"):
        monkeypatch.setattr(connectivity, name, WAIT_S)


def reason_of(endpoint, tls):
    """Return the reason of the first failed attempt."""
    stop, reasons = threading.Event(), []

    def on_failure(reason):
        reasons.append(reason)
        stop.set()

    assert open_with_retry([endpoint], stop, tls, on_failure) is None
    [reason] = reasons
    return reason


@pytest.mark.parametrize(
    ("who", "words"),
    [
        ("stranger", "its certificate is not accepted here: unable to get local issuer certificate"),
        ("expired", "it does not accept our certificate (certificate expired)"),
        ("", "[platform] has no tls"),
    ],
)
def test_reason_is_the_refused_certificate(world, who, words):
    reason = reason_of(world.shore_tls, world.tls(who) if who else None)
    assert reason.startswith(f"TLS refused: {world.shore_tls}: {words}")


def test_reason_is_the_authority_that_the_router_does_not_accept(world):
    tls = world.tls("stranger").model_copy(update={"ca": world.fleet.folder / "ca.pem"})
    assert "it does not accept our certificate (unknown ca)" in reason_of(world.shore_tls, tls)


def test_reason_is_the_missing_certificate_file(world):
    tls = world.tls("vessel-2").model_copy(update={"ca": world.folder / "absent.pem"})
    assert "a certificate file of this host is missing" in reason_of(world.shore_tls, tls)


def test_reason_is_the_name_in_the_certificate(world):
    endpoint = f"tls/localhost:{free_port()}"
    wanted = RouterOptions("shore-2", listen=[endpoint], local=[], files=world.folders["nameless"])
    router = world.start("shore-2", wanted)
    assert "certificate is not valid for 'localhost'" in reason_of(endpoint, world.tls("vessel-2"))
    router.stop()


def test_reason_is_the_wrong_protocol(world, monkeypatch):
    plain, tls = world.shore_tls.replace("tls/", "tcp/"), world.tls("vessel-2")
    assert reason_of(plain, None) == f"TLS refused: {plain}: the port expects TLS: tls/..."
    no_reply = ConnectivityResult(ConnectivityState.NO_REPLY)
    assert diagnose_no_reply(no_reply, [plain], tls).state is ConnectivityState.TLS_REFUSED
    monkeypatch.setattr(connectivity, "TIMEOUT_S", 0.2)
    encrypted = world.shore_local.replace("tcp/", "tls/")
    assert "no reply to the TLS handshake; a port without TLS is tcp/..." in reason_of(encrypted, tls)


def test_reason_is_the_listener_that_is_no_router(monkeypatch):
    monkeypatch.setattr(connectivity, "TLS_REFUSAL_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as server:  # accepts connections in its backlog, and sends nothing
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        expected = f"no reply: {endpoint} accepts connections, but does not reply as a Zenoh router"
        assert reason_of(endpoint, None) == expected


def test_right_certificate_reaches_the_router(world, monkeypatch):
    monkeypatch.setattr(session, "OPEN_TIMEOUT_MS", (60_000,))
    opened = open_with_retry([world.shore_tls], threading.Event(), world.tls("observer-1"))
    assert lost_reason(opened) == ""
    opened.close()


def test_command_prints_the_reason_without_verbosity(world):
    files = {name: world.folders["stranger"] / f"{name}.pem" for name in ("ca", "certificate", "key")}
    options = [text for name, path in files.items() for text in (f"--tls-{name}", str(path))]
    command = [sys.executable, "-m", "sonarpost.cli.main", "c2", "watch", "--router", world.shore_tls, *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        process.kill()
    assert "unable to get local issuer certificate" in line
