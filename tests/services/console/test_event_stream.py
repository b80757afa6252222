"""The event stream over a real connection, and its buffer."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from http.client import HTTPResponse
from typing import Any

import pytest
from builders.common import eventually
from builders.console import PASSWORD, image_record

from sonarpost.services.console.events import EventHub, RateLimiter
from sonarpost.services.console.web.server import WebServer


class EventReader:
    """Reads the event stream as an open page does."""

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
            pass  # closed by the test
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
    console.app.stop()
    server.stop()


@pytest.fixture
def headers(served):
    body = json.dumps({"user": "anna", "password": PASSWORD}).encode()
    with urllib.request.urlopen(served.address + "api/login", body, timeout=20) as answer:
        cookie = answer.headers["set-cookie"].partition(";")[0]
        return {"Cookie": cookie, "X-CSRF-Token": json.load(answer)["csrf"]}


@pytest.fixture
def open_stream(served, headers):
    readers: list[EventReader] = []

    def make(query: str = "", **more: str) -> EventReader:
        request = urllib.request.Request(served.address + "events" + query, None, {**headers, **more})
        readers.append(EventReader(urllib.request.urlopen(request, timeout=60)))
        return readers[-1]

    yield make
    for reader in readers:
        reader.close()


def test_page_receives_events_of_an_interruption(console, open_stream):
    first = open_stream()
    console.state.store_image(image_record("0001"))
    eventually(lambda: "contact" in first.names(), what="event")
    [(_, identifier, data)] = [event for event in first.events if event[0] == "contact"]
    assert data["contact"]["image_id"] == "0001"
    assert (data["new"], data["total"], data["unreviewed"]) == (True, 1, 1)
    first.close()
    console.state.store_image(image_record("0002"))
    console.state.store_image(image_record("0003"))
    for again in (open_stream(**{"Last-Event-ID": identifier}), open_stream(f"?last={identifier}")):
        eventually(lambda page=again: page.names().count("contact") == 2, what="missed events")
        assert [e[2]["contact"]["image_id"] for e in again.events if e[0] == "contact"] == ["0002", "0003"]
        assert "reset" not in again.names()


def test_page_of_another_run_is_reset(open_stream):
    page = open_stream(**{"Last-Event-ID": "0000000-5"})
    eventually(lambda: page.names()[:2] == ["hello", "reset"], what="reset")


def test_idle_stream_sends_the_time(open_stream):
    page = open_stream()
    eventually(lambda: page.names().count("clock") >= 2, what="clock")


def test_stream_ends_with_its_session(console, served, headers, open_stream):
    page = open_stream()
    eventually(lambda: page.names() != [], what="stream")
    request = urllib.request.Request(served.address + "api/logout", b"{}", headers)
    with urllib.request.urlopen(request, timeout=20) as answer:
        assert answer.status == 204
    eventually(lambda: page.ended, what="end")
    assert page.names()[-1] == "session"
    eventually(lambda: console.state.events.subscriber_count == 0, what="no subscriber")


def test_number_of_streams_of_a_session_is_limited(open_stream):
    pages = [open_stream() for _ in range(4)]
    eventually(lambda: all(page.names() for page in pages), what="four streams")
    with pytest.raises(urllib.error.HTTPError) as caught:
        open_stream()
    assert caught.value.code == 429
    caught.value.close()
    pages[0].close()

    def is_accepted() -> bool:
        try:
            open_stream()
        except urllib.error.HTTPError as error:
            error.close()
            return False
        return True

    eventually(is_accepted, what="another stream")


def test_unhandled_exception_is_logged_and_answered(console, monkeypatch, caplog):
    def fail(_query: object) -> None:
        raise RuntimeError("internal detail")

    monkeypatch.setattr(console.state, "list_contacts", fail)
    answer = console.browser("watch").get("/api/contacts")
    assert (answer.status_code, answer.json()["error"]["code"]) == (500, "defect")
    assert "internal detail" in caplog.text
    assert "internal detail" not in answer.text


def test_event_buffer():
    hub = EventHub(buffered=3)
    notified = []
    subscriber = hub.subscribe(lambda: notified.append(1))
    for number in range(5):
        hub.publish("contact", {"n": number})
    hub.unsubscribe(subscriber)
    hub.publish("contact", {"n": 5})
    assert len(notified) == 5
    assert [json.loads(e.data)["n"] for e in hub.events_after(4) or ()] == [4, 5]
    assert hub.events_after(6) == ()
    assert hub.events_after(2) is None
    assert hub.events_after(7) is None
    assert hub.parse_event_id(hub.event_id(4)) == 4
    for other in ("", "4", f"{EventHub().run}-4", f"{hub.run}-x", f"{hub.run}-{'9' * 30}"):
        assert hub.parse_event_id(other) is None
    with pytest.raises(ValueError, match="Out of range"):
        hub.publish("contact", {"n": float("nan")})


def test_rate_limiter_is_separate_for_each_name():
    limiter = RateLimiter(1.0)
    times = [("a", 0.0), ("a", 0.5), ("b", 0.5), ("a", 1.0), ("a", 1.9), ("a", 2.0)]
    assert [limiter.allows(*at) for at in times] == [True, False, True, True, False, True]
