"""`c2 cot` with servers of every kind: what is reported and received, and the exit status."""

import signal
import ssl
import subprocess
import sys
from pathlib import Path

import pytest
from builders.common import eventually, free_port
from builders.exports import Clock, image, store
from builders.tls_authority import Authority
from extensions.tak.tak_server import TakServer

from sonarpost import keys, wire
from sonarpost.cli.c2.watch import ContactChange
from sonarpost.cli.main import main
from sonarpost.export.live import LiveContacts
from sonarpost.extensions.tak import command
from sonarpost.extensions.tak.command import RETRY_S, CotService
from sonarpost.extensions.tak.cot_sender import CotSender
from sonarpost.messages import Health
from sonarpost.security.client_tls import TlsFiles

PASSPHRASE = b"atakatak"


@pytest.fixture
def authority(tmp_path):
    return Authority(tmp_path)


@pytest.fixture
def archive(tmp_path):
    return str(store(tmp_path / "out", image("0001"), image("0002"), image("0003", {"lat_deg": None})))


def options_of(files):
    given = {"--cot-ca": files.ca, "--cot-certificate": files.certificate, "--cot-key": files.key}
    return [part for name, path in given.items() if path is not None for part in (name, str(path))]


def test_once_reports_what_the_server_has_received(authority, archive, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command, "GIVE_UP_S", 0.0)
    good = authority.issue("client")
    other = Authority(tmp_path, "other").issue("client")
    late = authority.issue("late", expired=True)
    plain, alert = "a port without TLS needs tcp://", "refused by the server: "
    for context, scheme, files, text in (
        (authority.server_context("a", version=ssl.TLSVersion.TLSv1_3), "tls", good, None),
        (authority.server_context("b", version=ssl.TLSVersion.TLSv1_2), "tls", good, None),
        (None, "tcp", good, None),
        (authority.server_context("c"), "tls", TlsFiles(good.ca, other.certificate, other.key), f"{alert}unknown CA"),
        (authority.server_context("d"), "tls", TlsFiles(good.ca), f"{alert}certificate required"),
        (authority.server_context("e"), "tls", TlsFiles(good.ca, late.certificate, late.key), "certificate expired"),
        (authority.server_context("f"), "tcp", good, "a port with TLS needs tls://"),
        (None, "tls", good, plain),
    ):
        server = TakServer(context, greeting=b"<event/>")
        url = f"{scheme}://127.0.0.1:{server.port}"
        status = main(["c2", "cot", url, "--once", "--archive", archive, *options_of(files)])
        out, err = capsys.readouterr()
        if text is None:
            assert (status, server.events()) == (0, 2)
            assert "2 events, 1 contacts without a position omitted; delivered: the server has read them" in out
        else:
            assert (status, server.events(), out) == (2, 0, "")
            assert "0 of 2 events delivered" in err
            assert text in err
        server.close()


def test_once_with_pkcs12_and_another_server_name(authority, archive, tmp_path, capsys):
    client, truststore, _ = authority.encrypted(authority.issue("client"), PASSPHRASE)
    passphrase = tmp_path / "passphrase"
    passphrase.write_bytes(PASSPHRASE)
    passphrase.chmod(0o600)
    server = TakServer(authority.server_context(hosts=("takserver",)))
    arguments = ["c2", "cot", f"tls://127.0.0.1:{server.port}", "--once", "--archive", archive]
    arguments += ["--cot-ca", str(truststore), "--cot-certificate", str(client), "--cot-server-name", "takserver"]
    assert main(arguments) == 2
    assert "an encrypted or damaged file" in capsys.readouterr().err
    assert main([*arguments, "--cot-passphrase-file", str(passphrase)]) == 0
    assert server.events() == 2
    server.close()


def test_once_needs_an_archive_and_reports_rejected_files(archive, capsys):
    server = TakServer()
    url = f"tcp://127.0.0.1:{server.port}"
    assert main(["c2", "cot", url, "--once"]) == 2
    assert "expected --archive DIR" in capsys.readouterr().err
    assert main(["c2", "cot", url, "--once", "--archive", archive, "--vessel", "vessel-2"]) == 0
    assert "0 events, 0 contacts" in capsys.readouterr().out
    (Path(archive) / "vessel-1" / "broken.json").write_text("{")
    assert main(["c2", "cot", url, "--once", "--archive", archive, "--vessel", "vessel-1"]) == 1
    assert "rejected: " in capsys.readouterr().err
    assert server.events() == 2
    server.close()


def test_live_service_counts_what_the_server_has_received(authority, tmp_path):
    port, clock = free_port(), Clock()
    server = TakServer(Authority(tmp_path, "other").server_context(), port=port)
    files = authority.issue("client")
    trusting = TlsFiles(tmp_path / "other" / "ca.pem", files.certificate, files.key)
    service = CotService(CotSender(f"tls://127.0.0.1:{port}", trusting, settle_s=0.0), None, clock=clock, utc=clock)

    def health():
        found = service.health("shore-1")
        return found.state, found.counters["events_delivered"], found.detail

    assert health() == ("ok", 0, "")
    assert service.send_due() == 0  # it has no event, and tries the connection
    state, delivered, detail = health()
    assert (state, delivered) == ("degraded", 0)
    assert detail.startswith("0 delivered since 1970-01-01T00:01:40.000Z, 0 before; retrying: tls://127.0.0.1:")
    assert detail.endswith("refused by the server: unknown CA")
    live = LiveContacts()
    for name in ("0001", "0002"):
        service.add(ContactChange(live.add(image(name)), None))
    attempts = 0
    for pause_s in (*RETRY_S, RETRY_S[-1]):
        assert service.send_due() == 0  # waits
        clock.now_s += pause_s
        assert service.send_due() == 0
        attempts += "0 of 2 events delivered" in health()[2]
        assert health()[:2] == ("degraded", 0)
    assert attempts == len(RETRY_S) + 1
    assert server.received == []
    server.close()
    server = TakServer(port=port)
    service = CotService(CotSender(f"tcp://127.0.0.1:{port}", TlsFiles(), settle_s=0.0), None, clock=clock, utc=clock)
    assert service.send_due() == 0
    service.add(ContactChange(live.add(image("0003")), None))
    assert service.send_due() == 1
    assert health() == ("ok", 1, "")
    server.close()
    clock.now_s += 5
    assert service.send_due() == 0
    assert health()[:2] == ("degraded", 1)
    assert "0 delivered since 1970-01-01T00:04:25.000Z, 1 before; retrying: " in health()[2]
    server = TakServer(port=port)
    clock.now_s += RETRY_S[0]
    assert service.send_due() == 1
    assert health() == ("ok", 2, "")
    assert server.events() == 1
    server.close()


def test_command_publishes_that_nothing_is_delivered(router, client, authority, tmp_path):
    records = []

    def receive(sample):
        key = str(sample.key_expr)
        records.append(wire.decode(Health, sample.payload.to_bytes(), key))

    client.declare_subscriber(keys.health("shore", "cot"), receive)
    server = TakServer(authority.server_context())
    files = TlsFiles(authority.issue("client").ca)
    arguments = ["c2", "cot", f"tls://127.0.0.1:{server.port}", "--router", router]
    process = subprocess.Popen([sys.executable, "-m", "sonarpost.cli.main", *arguments, *options_of(files)])
    try:
        eventually(lambda: bool(records))
        assert records[0].state == "degraded"
        assert "0 delivered since " in records[0].detail
        assert records[0].detail.endswith("refused by the server: certificate required")
        process.send_signal(signal.SIGINT)
        assert process.wait() == 0
        eventually(lambda: records[-1].state == "stopping")
    finally:
        process.kill()
        process.wait()
        server.close()
