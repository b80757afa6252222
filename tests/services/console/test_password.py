"""Password change by users: errors, end of other sessions, and no password in files or logs."""

import logging
import re

import pytest
from builders.console import PASSWORD, ROLES_OF_USERS

from sonarpost.services.console.store.users import MAX_PASSWORD, MIN_PASSWORD

NEW = "another fine one"


def test_new_password_ends_only_other_sessions_of_the_user(console):
    here, there, another = console.browser("anna"), console.browser("anna"), console.browser("bo")
    assert here.post("/api/password", {"old": PASSWORD, "new": NEW}).status_code == 204
    assert here.get("/api/session").status_code == 200
    assert there.get("/api/session").status_code == 401
    assert another.get("/api/session").status_code == 200
    assert console.browser().login("anna").status_code == 401
    assert console.browser().login("anna", NEW).status_code == 200


@pytest.mark.parametrize("user", ROLES_OF_USERS)
def test_users_of_every_role_may_change_their_password(console, user):
    browser = console.browser(user)
    assert browser.post("/api/password", {"old": PASSWORD, "new": NEW}).status_code == 204


@pytest.mark.parametrize(
    ("old", "new", "status", "field"),
    [
        ("not it at all", NEW, 403, "old"),
        ("", NEW, 403, "old"),
        (PASSWORD, "x" * (MIN_PASSWORD - 1), 400, "new"),
        (PASSWORD, "x" * (MAX_PASSWORD + 1), 400, "new"),
        (PASSWORD, None, 400, "new"),
    ],
)
def test_error_names_the_invalid_field_and_changes_nothing(console, old, new, status, field):
    here, there = console.browser("anna"), console.browser("anna")
    answer = here.post("/api/password", {"old": old, "new": new})
    assert (answer.status_code, answer.json()["error"]["field"]) == (status, field)
    assert there.get("/api/session").status_code == 200
    assert console.browser().login("anna").status_code == 200


def test_wrong_present_passwords_are_limited(console):
    here = console.browser("anna")
    for _ in range(5):
        assert here.post("/api/password", {"old": "not it at all", "new": NEW}).status_code == 403
    limited = here.post("/api/password", {"old": PASSWORD, "new": NEW})
    assert (limited.status_code, limited.json()["error"]["code"]) == (429, "too_many")
    assert console.users.verify_password("anna", PASSWORD)


def test_no_password_in_logs_audit_and_files(console, caplog):
    guess = "a wrong password"
    caplog.set_level(logging.DEBUG)
    here = console.browser("anna")
    answers = [
        here.post("/api/password", body)
        for body in ({"old": guess, "new": NEW}, {"old": PASSWORD, "new": "tooshort"}, {"old": PASSWORD, "new": NEW})
    ]
    assert [answer.status_code for answer in answers] == [403, 400, 204]
    assert {"Password change refused", "Password changed"} <= {record.getMessage() for record in caplog.records}
    logged = " ".join(str(vars(record)) for record in caplog.records)
    stored = b"".join(path.read_bytes() for path in console.users.path.parent.iterdir() if path.is_file())
    with console.state.database.read() as db:
        audit = str([tuple(row) for row in db.execute("SELECT * FROM audit")])
    for secret in (PASSWORD, NEW, guess, "tooshort"):
        assert secret not in logged + audit + "".join(answer.text for answer in answers)
        assert secret.encode() not in stored


def test_log_in_page_has_no_foreign_links_and_no_inline_script(console):
    page = console.browser().get("/login").text
    links = re.findall(r"(?:src|href|action)=\"([^\"]*)\"", page)
    assert "/static/js/login.js" in links
    assert all(re.fullmatch(r"/(?!/).*", link) for link in links)
    assert not re.search(r"<style|style=|<script(?![^>]* src=)|\son[a-z]+=", page)
    # Without JavaScript, a form with GET would put the passwords into the URL.
    assert re.search(r'<form [^>]*method="post"', page)


def test_info_contains_the_password_length(console):
    assert console.browser("anna").get("/api/info").json()["password_characters"] == [MIN_PASSWORD, MAX_PASSWORD]
