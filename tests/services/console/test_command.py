"""`sonarpost console`: users, the view of a folder, and the web server with TLS."""

import io
import json
import signal
import socket
import ssl
import subprocess
import sys
import urllib.request
from contextlib import suppress
from pathlib import Path

import httpx2
import pytest
from builders.common import eventually
from builders.console import PASSWORD, Browser, image_record, server_certificate, web_server
from builders.records import decision_record

from sonarpost.cli.main import main
from sonarpost.config import TlsConfig
from sonarpost.errors import ConfigError
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config
from sonarpost.services.console.store.users import FILE_NAME, Users
from sonarpost.services.console.web.server import WebServer


def user(state: Path, *words: str) -> int:
    return main(["console", "user", *words, "--state-dir", str(state)])


def test_add_change_and_remove_users(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{PASSWORD}\n"))
    assert user(tmp_path, "add", "anna", "--role", "operator", "--password-stdin") == 0
    assert user(tmp_path, "ls") == 0
    assert "anna" in capsys.readouterr().out
    users = Users(tmp_path / FILE_NAME)
    assert users.verify_password("anna", PASSWORD)
    assert not users.verify_password("anna", PASSWORD + "x")
    monkeypatch.setattr("sys.stdin", io.StringIO("another password\n"))
    assert user(tmp_path, "passwd", "anna", "--password-stdin") == 0
    assert users.verify_password("anna", "another password")
    assert user(tmp_path, "rm", "anna") == 0
    assert users.find("anna") is None
    users.close()
    assert user(tmp_path, "rm", "anna") == 2
    assert "user anna removed" in capsys.readouterr().out


def test_without_a_terminal_the_error_names_the_option(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{PASSWORD}\n"))
    assert user(tmp_path, "add", "anna") == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line == "sonarpost: console: password: got 'no terminal to ask', expected --password-stdin"


def test_password_prompt_is_repeated(tmp_path, capsys, monkeypatch):
    answers = iter([PASSWORD, "another", PASSWORD, PASSWORD, "short", "short"])
    monkeypatch.setattr("getpass.getpass", lambda _prompt: next(answers))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    config = tmp_path / "vessel.toml"
    config.write_text(f'[platform]\nid = "vessel-1"\nstate_dir = "{tmp_path}/state"\n')
    assert main(["console", "user", "add", "anna", "--config", str(config)]) == 2
    assert main(["console", "user", "add", "anna", "--config", str(config)]) == 0
    assert (tmp_path / "state" / FILE_NAME).is_file()
    assert main(["console", "user", "passwd", "anna", "--config", str(config)]) == 2
    assert "10 to 200 characters" in capsys.readouterr().err


def test_missing_action_and_missing_folder_are_errors(capsys):
    assert main(["console"]) == 2
    assert main(["console", "--view", "/nowhere"]) == 2
    assert "--view: got '/nowhere', expected a folder of c2" in capsys.readouterr().err


def test_folder_of_c2_is_shown_to_an_observer_on_any_free_port(tmp_path):
    archive = Archive(C2Config(out_dir=tmp_path / "out"))
    archive.store_image(image_record("AAAA"), 5.0)
    archive.store_decision(decision_record("d1"))
    archive.flush()
    archive.close()
    words = ["console", "--view", str(tmp_path / "out"), "--password", PASSWORD]
    command = [sys.executable, "-m", "sonarpost.cli.main", *words]
    # 8470 may be in use: the page is at another port then.
    with suppress(OSError), socket.create_server(("127.0.0.1", 8470)):
        show_folder(command)
    show_folder(command)


def show_folder(command):
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            url, _, user = process.stdout.readline().split()[:3]
            assert f"{url}login#" in process.stdout.readline()
            assert "1 contacts in" in process.stdout.readline()
            with httpx2.Client(base_url=url, timeout=120) as client:
                browser = Browser(client)
                assert browser.login(user, PASSWORD).json()["role"] == "observer"
                [contact] = client.get("/api/contacts").json()["items"]
                assert contact["review"] == "mine_like"
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(timeout=120) == 0


@pytest.fixture
def certificate(tmp_path):
    return server_certificate(tmp_path)


def test_https_with_the_certificate_of_the_fleet(make_console, certificate):
    console = make_console(tls=True)
    body = json.dumps({"user": "anna", "password": PASSWORD}).encode()
    trusted = ssl.create_default_context(cafile=str(certificate.ca))
    with web_server(console, certificate) as server:
        assert server.address.startswith("https://")
        with urllib.request.urlopen(server.address + "api/login", body, timeout=120, context=trusted) as answer:
            assert "Secure" in answer.headers["set-cookie"]
            assert json.load(answer)["user"] == "anna"
    eventually(lambda: not server.running, what="end of the server")


def test_invalid_certificate_is_an_error(make_console, certificate, tmp_path):
    (tmp_path / "none.pem").write_text("none")
    wrong = TlsConfig(ca=certificate.ca, certificate=tmp_path / "none.pem", key=certificate.key)
    with pytest.raises(ConfigError, match="certificate"):
        WebServer(make_console(tls=True).app.asgi, "127.0.0.1", 0, wrong)
