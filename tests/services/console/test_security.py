"""Sessions, roles, log-in limits, and hostile input."""

import json
import logging
import re
from http.cookiejar import CookieJar

import httpx2
import pytest
from builders.console import PASSWORD, ROLES_OF_USERS, Browser, contact_id, image_record, web_server
from starlette.routing import Mount
from starlette.testclient import TestClient

from sonarpost.errors import BadInputError
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.store.contacts import ContactFilter
from sonarpost.services.console.store.users import Users

ID = contact_id()
ONE = f"/api/contacts/{ID}"
READ_PATHS = [
    "/api/session",
    "/api/info",
    "/api/contacts",
    ONE,
    f"{ONE}/versions/1/image.png",
    f"{ONE}/versions/1/mask.png",
    f"{ONE}/versions/1/thumbnail.png",
    "/api/fleet",
    "/api/map",
    "/api/map/tracks",
    "/tiles/1/1/1.png",
    "/api/export/contacts.csv",
    f"/report/{ID}",
    "/events",
]
PERMISSION_OF_PATH = {
    f"{ONE}/decisions": "decide",
    f"{ONE}/undo": "decide",
    f"{ONE}/measure": "measure",
    f"{ONE}/requests": "request",
    f"{ONE}/comment": "comment",
}
HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(2)>\"'&"


@pytest.fixture
def with_contact(console):
    console.state.store_image(image_record())
    return console


def test_reading_needs_a_session(with_contact):
    browser, invented = with_contact.browser(), with_contact.browser()
    invented.client.cookies.set("sonarpost_session_8470", "x" * 43)
    for path in READ_PATHS:
        answer = browser.get(path)
        assert (answer.status_code, answer.json()["error"]["code"]) == (401, "no_session"), path
        assert invented.get(path).status_code == 401
    answer = browser.get("/")
    assert (answer.status_code, answer.headers["location"]) == (303, "/login")


def test_actions_need_a_session_its_token_and_the_page_of_this_site(with_contact):
    stranger, anna, other = with_contact.browser(), with_contact.browser("anna"), with_contact.browser("anna")
    for path in (*PERMISSION_OF_PATH, "/api/logout", "/api/password", "/api/settings"):
        assert stranger.post(path, {}).status_code == 401
        for headers in ({}, {"X-CSRF-Token": ""}, {"X-CSRF-Token": other.csrf}):
            answer = anna.client.post(path, json={}, headers=headers)
            assert (answer.status_code, answer.json()["error"]["code"]) == (403, "csrf"), path
    for origin in ("http://evil.example", "http://127.0.0.1:9999", "null"):
        answer = anna.post(f"{ONE}/decisions", {}, Origin=origin)
        assert (answer.status_code, answer.json()["error"]["code"]) == (403, "bad_origin")
    assert anna.post(f"{ONE}/decisions", {}, Origin="http://127.0.0.1:8470").status_code == 400


def test_role_permissions(with_contact):
    for user, role in ROLES_OF_USERS.items():
        browser = with_contact.browser(user)
        may = browser.get("/api/session").json()["may"]
        for path, permission in PERMISSION_OF_PATH.items():
            assert may[permission] == (role != "observer" and permission != "comment")
            # The body is invalid, so that a permitted request changes nothing.
            assert browser.post(path, {"x": 1}).status_code == (400 if may[permission] else 403)


def test_at_the_shore_site_only_experts_act(make_console):
    console = make_console(role="shore")
    may = {user: console.browser(user).get("/api/session").json()["may"] for user in ("watch", "anna", "eva")}
    assert not any(may["watch"].values())
    assert may["anna"] == {"decide": False, "measure": True, "request": False, "comment": False}
    assert may["eva"] == {"decide": False, "measure": True, "request": True, "comment": True}


def test_session_cookie_attributes(console, make_console):
    answer = console.browser().login("anna")
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    assert "Secure" not in cookie
    assert "csrf" in answer.json()
    assert "token" not in answer.text
    secure = make_console(tls=True).browser().login("anna").headers
    assert "Secure" in secure["set-cookie"]
    assert "strict-transport-security" in secure


def test_consoles_on_two_ports_of_a_host_keep_their_sessions(make_console):
    """Browsers send a cookie to all ports of its host."""
    vessel, shore = make_console(), make_console(role="shore")
    jar = CookieJar()
    with web_server(vessel) as one, web_server(shore) as other:
        clients = [httpx2.Client(base_url=server.address, cookies=jar, timeout=120) for server in (one, other)]
        browsers = [Browser(client) for client in clients]
        for browser in (*browsers, *browsers):
            assert browser.login("anna").status_code == 200
        sessions = [browser.get("/api/session") for browser in browsers]
        assert [answer.status_code for answer in sessions] == [200, 200]
        assert [answer.json()["may"]["decide"] for answer in sessions] == [True, False]
        assert browsers[0].post("/api/logout", {}).status_code == 204
        assert [browser.get("/api/session").status_code for browser in browsers] == [401, 200]
        for client in clients:
            client.close()


def test_session_ends_by_log_out_idle_time_and_maximum_time(console, tmp_path):
    browser = console.browser("anna")
    cookie = browser.client.cookies["sonarpost_session_8470"]
    assert browser.post("/api/logout", {}).status_code == 204
    browser.client.cookies.set("sonarpost_session_8470", cookie)
    assert browser.get("/api/contacts").status_code == 401
    now = [1000.0]
    users = Users(tmp_path / "users.db", session_s=100, session_max_s=250, clock=lambda: now[0])
    users.add("anna", "operator", PASSWORD)
    token = users.start_session("anna").token
    for now[0], is_use, valid in ((1090, True, True), (1185, True, True), (1240, True, True), (1251, True, False)):
        assert (users.find_session(token, is_use=is_use) is not None) == valid
    token, now[0] = users.start_session("anna").token, 2000.0
    assert users.find_session(token) is None
    token = users.start_session("anna").token
    for now[0], valid in ((2060, True), (2099, True), (2101, False)):
        # An open page alone does not extend its session.
        assert (users.find_session(token, is_use=False) is not None) == valid
    users.close()


def test_file_has_no_passwords_and_tokens(tmp_path):
    users = Users(tmp_path / "users.db")
    users.add("anna", "operator", PASSWORD)
    session = users.start_session("anna")
    users.close()
    stored = b"".join(path.read_bytes() for path in tmp_path.iterdir())
    assert b"anna" in stored
    assert PASSWORD.encode() not in stored
    assert session.token.encode() not in stored
    assert (tmp_path / "users.db").stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(
    ("name", "role", "password", "field"),
    [("../x", "observer", PASSWORD, "name"), ("x", "admin", PASSWORD, "role"), ("x", "observer", "short", "password")],
)
def test_error_names_the_invalid_field_of_a_user(tmp_path, name, role, password, field):
    users = Users(tmp_path / "users.db")
    with pytest.raises(BadInputError) as caught:
        users.add(name, role, password)
    users.close()
    assert caught.value.field == field
    assert PASSWORD not in str(caught.value)


def test_only_known_host_names_are_accepted(console, make_console):
    for host in ("evil.example", "evil.example:8470", "", "127.0.0.1.evil.example", "[::2]"):
        answer = console.browser().client.get("/login", headers={"Host": host})
        assert (answer.status_code, answer.json()["error"]["code"]) == (400, "bad_host")
    named = make_console(names=("bridge.example",))
    assert Browser(TestClient(named.app.asgi, base_url="http://bridge.example:8470")).login("anna").status_code == 200


def test_all_responses_have_security_headers(console):
    for path in ("/", "/login", "/api/contacts", "/nothing", "/static/nothing.js"):
        headers = console.browser().get(path).headers
        assert "default-src 'none'; script-src 'self'" in headers["content-security-policy"]
        assert "unsafe-inline" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"


def test_path_traversal_is_rejected(with_contact):
    anna = with_contact.browser("anna")
    for path in (
        "/static/../service.py",
        "/static/%2e%2e/service.py",
        "/static/..%2fservice.py",
        "/static//etc/passwd",
        "/static/%2fetc%2fpasswd",
        f"{ONE}/versions/..%2f..%2f1/image.png",
        "/api/contacts/..%2f..%2fetc%2fpasswd/versions/1/image.png",
        "/api/contacts/%2e%2e/versions/1/image.png",
        f"{ONE}/versions/99999999999999999999/image.png",
        f"{ONE}/versions/-1/image.png",
        "/tiles/../1/1.png",
        "/tiles/1/1/..%2f..%2fx.png",
        "/api/export/..%2fx",
        "/report/..%2f..%2fetc%2fpasswd",
    ):
        answer = anna.get(path)
        assert (answer.status_code, answer.json()["error"]["code"]) == (404, "not_found"), path


HOSTILE_VALUES = (
    "9" * 5000,
    "9" * 20,
    "9" * 10,
    "-1",
    "1e999",
    "x" * 5000,
    "%00",
    "%FF%FE",
    "%ED%A0%80",
    "%D9%A3",
    "%2e%2e",
)
HOSTILE_NUMBERS = (
    "9" * 5000,
    "9" * 20,
    "-1",
    "1e999",
    "-1e999",
    "1e-999",
    "[" * 9000,
    '"\\ud800"',
    "{}",
    "null",
    "true",
)
BODIES = {
    "/decisions": {"version": 1, "revision": 0, "sha256": "0" * 64, "verdict": "unsure", "shown_s": 1, "remark": "x"},
    "/undo": {"decision_id": "x", "version": 1, "sha256": "0" * 64},
    "/measure": {"version": 1, "kind": "length", "from": [1, 2], "to": [3, 4]},
    "/requests": {"kind": "region", "airtime_s": 1, "box": [0, 0, 1, 1], "stream_bytes": 100},
    "/comment": {"version": 1, "verdict": "unsure", "remark": "x"},
    "/split": {"contact": ID},
    "/merge": {"contact": ID},
    "/api/settings": {"settings": {"theme": "x"}},
    "/api/login": {"user": "anna", "password": "x"},
    "/api/login-link": {"token": "x"},
    "/api/password": {"old": "x", "new": "x"},
}


def routes_of(console):
    """Paths and methods of all routes; each `{}` in a path is a parameter."""
    for route in console.app.asgi._app.routes:
        path = re.sub("{.*?}", "{}", route.path)
        if isinstance(route, Mount):
            yield f"{path}/{{}}", "GET"
        else:
            yield path, "POST" if "POST" in (route.methods or ()) else "GET"


def hostile_requests(console):
    """Yield method, path, query string and body of hostile requests to all routes."""
    queries = [f"{name}={value}" for name in (*ContactFilter.model_fields, "q", "last") for value in HOSTILE_VALUES]
    for path, method in routes_of(console):
        known = path.replace("{}", ID, 1).replace("{}", "1")
        if method == "POST":
            body = next((body for ending, body in BODIES.items() if path.endswith(ending)), {"x": 1})
            for name in body:
                for value in HOSTILE_NUMBERS:
                    hostile = json.dumps({**body, name: "HOSTILE"}).replace('"HOSTILE"', value)
                    yield method, known, "", hostile.encode()
        elif path in ("/api/contacts", "/report", "/api/export/{}"):
            for query in queries:
                yield method, known.replace(ID, "contacts.csv"), query, b""
        if "{}" in path:
            for value in HOSTILE_VALUES:
                yield method, path.replace("{}", value), "", b"{}"
                yield method, path.replace("{}", ID, 1).replace("{}", value), "", b"{}"
        yield method, known, "x=" + "9" * 5000, b"{}"


@pytest.mark.system
@pytest.mark.parametrize("user", ["", "anna", "eva"])
def test_no_hostile_request_is_an_error_of_the_server(with_contact, caplog, user):
    browser = with_contact.browser(user)
    number = 0
    for method, path, query, body in hostile_requests(with_contact):
        if user and path in ("/events", "/api/logout"):
            continue  # a stream without an end; the end of the session
        answer = browser.client.request(
            method, f"{path}?{query}", content=body, headers={"X-CSRF-Token": browser.csrf}, follow_redirects=False
        )
        assert answer.status_code < 500, (method, path[:100], query[:100], body[:100])
        number += 1
    assert number > 400
    assert browser.get("/api/session").status_code == (200 if user else 401)
    assert sum(len(record.getMessage()) + len(str(record.exc_info or "")) for record in caplog.records) < 100 * number
    assert [record.getMessage() for record in caplog.records if record.exc_info] == []


def test_unexpected_exceptions_are_logged_once_an_interval(with_contact, caplog, monkeypatch):
    def fail(*_arguments):
        raise ValueError("internal detail")

    monkeypatch.setattr(with_contact.state, "list_contacts", fail)
    anna = with_contact.browser("anna")
    caplog.clear()
    for _ in range(20):
        answer = anna.get("/api/contacts")
        assert (answer.status_code, answer.json()["error"]["code"]) == (500, "defect")
    [line] = [record for record in caplog.records if record.levelno >= logging.ERROR]
    assert "in fail" in str(line.exc_text)
    assert "internal detail" in str(line.exc_text)
    assert "internal detail" not in answer.text


def test_tiles_are_served_from_their_folder(make_console, tmp_path):
    tile = tmp_path / "tiles" / "3" / "4" / "5.png"
    tile.parent.mkdir(parents=True)
    tile.write_bytes(b"a tile")
    console = make_console(tiles_dir=tmp_path / "tiles")
    watch = console.browser("watch")
    assert watch.get("/tiles/3/4/5.png").content == b"a tile"
    assert watch.get("/tiles/3/4/6.png").status_code == 404
    assert watch.get("/api/info").json()["tiles"]["max_zoom"] == 3


def test_too_large_and_invalid_bodies_are_rejected(with_contact):
    anna = with_contact.browser("anna")
    answer = anna.post(f"{ONE}/decisions", {"remark": "x" * 70_000})
    assert (answer.status_code, answer.json()["error"]["code"]) == (413, "too_large")
    assert with_contact.browser().login("x" * 70_000).status_code == 413
    for body in (b"", b"[]", b"{", b'"x"', b"\xff", b'{"revision": 1e999}', b"[" * 5000):
        answer = anna.client.post(f"{ONE}/decisions", content=body, headers={"X-CSRF-Token": anna.csrf})
        assert (answer.status_code, answer.json()["error"]["code"]) == (400, "bad_request")
    for field, value in (
        ("verdict", "maybe"),
        ("confidence", 1.5),
        ("confidence", "0.5"),
        ("remark", "x" * 2001),
        ("mlo_class", ""),
        ("revision", True),
        ("operator", "another"),
        ("layer", "enhanced"),
    ):
        answer = anna.decide(ID, **{field: value})
        assert (answer.status_code, answer.json()["error"]["field"]) == (400, field)
    assert with_contact.state.unsent_records() == []


def test_hostile_remark_is_stored_unchanged_and_escaped_in_markup(with_contact):
    anna = with_contact.browser("anna")
    assert anna.decide(ID, remark=HOSTILE, mlo_class=HOSTILE[:60]).status_code == 201
    detail = anna.get(ONE)
    assert detail.headers["content-type"] == "application/json"
    assert json.loads(detail.text)["decisions"][0]["remark"] == HOSTILE
    report = anna.get(f"/report/{ID}").text
    assert "&lt;script&gt;alert(1)" in report
    assert "<script" not in report
    assert "<img src=x" not in report
    for name in anna.get("/api/info").json()["exports"]:
        assert anna.get(f"/api/export/contacts.{name}").status_code == 200


def test_other_hosts_need_tls():
    with pytest.raises(ValueError, match="passwords are sent over this connection"):
        ConsoleConfig(host="0.0.0.0")
    assert ConsoleConfig(host="0.0.0.0", tls=True).tls
    assert ConsoleConfig(host="0.0.0.0", insecure=True).insecure
