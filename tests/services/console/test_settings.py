"""Settings of users: stored for each user, limited in names and size."""

import pytest

from sonarpost.services.console.web.session_routes import MAX_VALUE, SETTINGS


def test_settings_follow_the_user_and_no_other(console):
    here, there, another = console.browser("anna"), console.browser("anna"), console.browser("bo")
    assert here.get("/api/settings").json() == {"names": list(SETTINGS), "settings": {}}
    assert here.post("/api/settings", {"settings": {"theme": "night", "language": "de"}}).status_code == 204
    assert here.post("/api/settings", {"settings": {"theme": "day"}}).status_code == 204
    assert there.get("/api/settings").json()["settings"] == {"theme": "day", "language": "de"}
    assert another.get("/api/settings").json()["settings"] == {}
    console.users.remove("anna")
    assert console.users.settings("anna") == {}


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "settings"),
        ({"settings": {"colour": "red"}}, "settings.colour"),
        ({"settings": {"theme": 1}}, "settings.theme"),
        ({"settings": {"keys": "x" * (MAX_VALUE + 1)}}, "settings.keys"),
        ({"settings": {str(number): "" for number in range(len(SETTINGS) + 1)}}, "settings"),
        ({"settings": {}, "user": "bo"}, "user"),
    ],
)
def test_invalid_settings_are_refused(console, body, field):
    anna = console.browser("anna")
    answer = anna.post("/api/settings", body)
    assert (answer.status_code, answer.json()["error"]["field"]) == (400, field)
    assert anna.get("/api/settings").json()["settings"] == {}


def test_largest_settings_are_accepted_and_none_without_a_session(console):
    largest = dict.fromkeys(SETTINGS, "x" * MAX_VALUE)
    anna = console.browser("anna")
    assert anna.post("/api/settings", {"settings": largest}).status_code == 204
    assert anna.get("/api/settings").json()["settings"] == largest
    assert console.browser().get("/api/settings").status_code == 401
