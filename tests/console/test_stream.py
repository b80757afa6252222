"""The stream of events over a real connection: what is missed comes again, what is too old is loaded anew."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from http.client import HTTPResponse
from typing import Any

import pytest
from builders.common import eventually
from builders.console import PASSWORD, picture_record

from sonarpost.services.console.web.server import WebServer


class Follower:
    """A page that is open."""

    def __init__(self, stream: HTTPResponse) -> None:
        self._stream = stream
        self.events: list[tuple[str, str, Any]] = []
        self.ended = False
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        identifier = name = ""
        try:
            for raw in self._stream:
                field, _, value = raw.decode().rstrip("\n").partition(": ")
                if field == "id":
                    identifier = value
                elif field == "event":
                    name = value
                elif field == "data":
                    self.events.append((name, identifier, json.loads(value)))
        except (OSError, ValueError, AttributeError):
            pass  # the test has closed it
        self.ended = True

    def names(self) -> list[str]:
        return [name for name, _, _ in self.events]

    def close(self) -> None:
        self._stream.close()


@pytest.fixture
def served(console, monkeypatch):
    monkeypatch.setattr("sonarpost.services.console.web.event_stream.KEEP_ALIVE_S", 0.1)
    server = WebServer(console.app.asgi, "127.0.0.1", 0)
    server.start()
    yield server
    console.app.end()
    server.stop()


@pytest.fixture
def headers(served):
    body = json.dumps({"user": "anna", "password": PASSWORD}).encode()
    with urllib.request.urlopen(served.address + "api/login", body, timeout=20) as answer:
        cookie = answer.headers["set-cookie"].partition(";")[0]
        return {"Cookie": cookie, "X-CSRF-Token": json.load(answer)["csrf"]}


@pytest.fixture
def follow(served, headers):
    followers: list[Follower] = []

    def make(query: str = "", **more: str) -> Follower:
        request = urllib.request.Request(served.address + "events" + query, None, {**headers, **more})
        followers.append(Follower(urllib.request.urlopen(request, timeout=60)))
        return followers[-1]

    yield make
    for follower in followers:
        follower.close()


def test_a_page_that_was_cut_off_gets_what_it_missed(console, follow):
    first = follow()
    console.board.take_image(picture_record("0001"))
    eventually(lambda: "contact" in first.names(), what="event")
    [(_, identifier, data)] = [event for event in first.events if event[0] == "contact"]
    assert data["contact"]["image_id"] == "0001"
    assert (data["new"], data["total"], data["unreviewed"]) == (True, 1, 1)
    first.close()
    console.board.take_image(picture_record("0002"))
    console.board.take_image(picture_record("0003"))
    for again in (follow(**{"Last-Event-ID": identifier}), follow(f"?last={identifier}")):
        eventually(lambda page=again: page.names().count("contact") == 2, what="missed events")
        assert [e[2]["contact"]["image_id"] for e in again.events if e[0] == "contact"] == ["0002", "0003"]
        assert "reset" not in again.names()


def test_a_page_of_another_run_loads_anew(follow):
    page = follow(**{"Last-Event-ID": "0000000-5"})
    eventually(lambda: page.names()[:2] == ["hello", "reset"], what="reset")


def test_a_quiet_stream_tells_the_time(follow):
    page = follow()
    eventually(lambda: page.names().count("clock") >= 2, what="clock")


def test_a_stream_ends_with_its_session(console, served, headers, follow):
    page = follow()
    eventually(lambda: page.names() != [], what="stream")
    request = urllib.request.Request(served.address + "api/logout", b"{}", headers)
    with urllib.request.urlopen(request, timeout=20) as answer:
        assert answer.status == 204
    eventually(lambda: page.ended, what="end")
    assert page.names()[-1] == "session"
    eventually(lambda: console.board.hub.listeners == 0, what="listener gone")


def test_a_session_has_so_many_streams_and_no_more(follow):
    pages = [follow() for _ in range(4)]
    eventually(lambda: all(page.names() for page in pages), what="four streams")
    with pytest.raises(urllib.error.HTTPError) as caught:
        follow()
    assert caught.value.code == 429
    caught.value.close()
    pages[0].close()

    def there_is_room() -> bool:
        try:
            follow()
        except urllib.error.HTTPError as error:
            error.close()
            return False
        return True

    eventually(there_is_room, what="room for another")


def test_a_defect_is_logged_and_answered(console, monkeypatch, caplog):
    def broken(_wanted: object) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(console.board, "contacts", broken)
    answer = console.browser("watch").get("/api/contacts")
    assert (answer.status_code, answer.json()["error"]["code"]) == (500, "defect")
    assert "a defect" in caplog.text
    assert "a defect" not in answer.text
