"""Log-in links: valid once and for ten minutes, limited, stored as a hash, and in no log."""

import logging
import re

import pytest
from builders.console import PASSWORD

from sonarpost.cli.main import main
from sonarpost.errors import BadInputError
from sonarpost.services.console.store.users import FILE_NAME, LINK_S, MAX_LINKS_OF_USER, Users
from sonarpost.services.console.web.session_routes import RATE_OF_ADDRESS


def use(browser, token):
    return browser.post("/api/login-link", {"token": token})


def test_link_logs_in_once(console):
    token = console.users.make_login_link("anna")
    browser = console.browser()
    answer = use(browser, token)
    assert (answer.status_code, answer.json()["user"], answer.json()["role"]) == (200, "anna", "operator")
    assert "HttpOnly" in answer.headers["set-cookie"]
    assert browser.get("/api/session").status_code == 200
    again = use(console.browser(), token)
    assert (again.status_code, again.json()["error"]["code"]) == (401, "link_used")


def test_expired_and_unknown_links_are_refused(tmp_path):
    now = 1000.0
    users = Users(tmp_path / FILE_NAME, clock=lambda: now)
    users.add("anna", "operator", PASSWORD)
    tokens = [users.make_login_link("anna") for _ in range(3)]
    now += LINK_S
    assert users.use_login_link(tokens[0]) == ("valid", "anna")
    now += 1.0
    assert users.use_login_link(tokens[1]) == ("expired", "anna")
    now = 999.0  # the clock was set back
    assert users.use_login_link(tokens[2]) == ("expired", "anna")
    assert users.use_login_link("x") == ("unknown", "")
    users.close()


def test_expired_link_is_named_in_the_response(console, monkeypatch):
    token = console.users.make_login_link("anna")
    monkeypatch.setattr("sonarpost.services.console.store.users.LINK_S", -1.0)
    answer = use(console.browser(), token)
    assert (answer.status_code, answer.json()["error"]["code"]) == (401, "link_expired")


def test_new_password_removal_and_later_links_end_a_link(console):
    tokens = [console.users.make_login_link("anna") for _ in range(MAX_LINKS_OF_USER + 1)]
    assert use(console.browser(), tokens[0]).json()["error"]["code"] == "link_unknown"
    console.users.set_password("anna", "another fine one")
    assert use(console.browser(), tokens[1]).json()["error"]["code"] == "link_unknown"
    token = console.users.make_login_link("bo")
    console.users.remove("bo")
    assert use(console.browser(), token).status_code == 401
    with pytest.raises(BadInputError, match="got 'bo'"):
        console.users.make_login_link("bo")


def test_wrong_tokens_are_limited_for_an_address(console):
    browser = console.browser()
    answers = [use(browser, f"wrong {number}").status_code for number in range(RATE_OF_ADDRESS.burst + 1)]
    assert answers == [401] * RATE_OF_ADDRESS.burst + [429]
    assert use(browser, console.users.make_login_link("anna")).status_code == 429
    # Passwords have limits of their own.
    assert browser.login("anna").status_code == 200


@pytest.mark.parametrize(
    "body", [{}, {"token": 5}, {"token": ""}, {"token": "x" * 101}, {"token": "x", "user": "anna"}]
)
def test_invalid_bodies_are_refused(console, body):
    assert console.browser().post("/api/login-link", body).status_code == 400


def test_token_is_in_no_log_and_no_file(console, caplog):
    caplog.set_level(logging.DEBUG)
    token = console.users.make_login_link("anna")
    assert use(console.browser(), token).status_code == 200
    assert use(console.browser(), token).status_code == 401
    assert {"Log-in link refused", "User logged in"} <= {record.getMessage() for record in caplog.records}
    stored = b"".join(path.read_bytes() for path in console.users.path.parent.iterdir() if path.is_file())
    assert token not in " ".join(str(vars(record)) for record in caplog.records)
    assert token.encode() not in stored


def test_command_prints_a_link(tmp_path, capsys):
    users = Users(tmp_path / "state" / FILE_NAME)
    users.add("anna", "operator", PASSWORD)
    config = tmp_path / "vessel.toml"
    config.write_text(f'[platform]\nid = "vessel-1"\nstate_dir = "{tmp_path}/state"\n[console]\nport = 8123\n')
    assert main(["console", "user", "link", "anna", "--config", str(config)]) == 0
    found = re.fullmatch(r"http://127\.0\.0\.1:8123/login#([\w-]{43})\n", capsys.readouterr().out)
    assert found is not None
    assert users.use_login_link(found[1]) == ("valid", "anna")
    users.close()
    assert main(["console", "user", "link", "nobody", "--config", str(config)]) == 2
