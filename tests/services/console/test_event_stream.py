"""The event stream over a real connection, and its buffer."""

import json
import urllib.error
import urllib.request

import pytest
from builders.common import eventually
from builders.console import EventReader, image_record, web_server

from sonarpost.services.console.events import EventHub
from sonarpost.services.console.web.event_stream import MAX_STREAMS_OF_USER


@pytest.fixture
def served(console, monkeypatch):
    monkeypatch.setattr("sonarpost.services.console.web.event_stream.KEEP_ALIVE_S", 0.1)
    with web_server(console) as server:
        yield server


@pytest.fixture
def token(console):
    return console.users.start_session("anna").token


@pytest.fixture
def open_stream(served, token):
    readers = []

    def make(query="", **headers):
        readers.append(EventReader(served.address, token, query, **headers))
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
    assert (data["new"], data["total"], data["to_do"]) == (True, 1, 1)
    first.close()
    # At other positions: a look at the same object would change the first contact too.
    console.state.store_image(image_record("0002", position=(56.1, -5.0)))
    console.state.store_image(image_record("0003", position=(56.2, -5.0)))
    for again in (open_stream(**{"Last-Event-ID": identifier}), open_stream(f"?last={identifier}")):
        eventually(lambda page=again: page.names().count("contact") == 2, what="missed events")
        assert [e[2]["contact"]["image_id"] for e in again.events if e[0] == "contact"] == ["0002", "0003"]
        assert "reset" not in again.names()


def test_page_of_another_run_is_reset_and_then_receives_the_time(open_stream):
    page = open_stream(**{"Last-Event-ID": "0000000-5"})
    eventually(lambda: page.names()[:2] == ["hello", "reset"], what="reset")
    eventually(lambda: page.names().count("clock") >= 2, what="clock")


def test_stream_ends_with_its_session(console, token, open_stream):
    page = open_stream()
    eventually(lambda: page.names() != [], what="stream")
    console.users.end_session(token)
    eventually(lambda: page.ended, what="end")
    assert page.names()[-1] == "session"
    eventually(lambda: console.state.events.subscriber_count == 0, what="no subscriber")


def refusal(served, console, user):
    """Status, waiting time and error of a stream that is refused."""
    with pytest.raises(urllib.error.HTTPError) as caught:
        EventReader(served.address, console.users.start_session(user).token)
    with caught.value as answer:
        return answer.code, int(answer.headers["retry-after"]), json.load(answer)["error"]


def test_number_of_streams_of_a_user_is_limited_over_all_sessions_and_in_total(
    console, served, open_stream, monkeypatch
):
    pages = [open_stream() for _ in range(MAX_STREAMS_OF_USER)]
    eventually(lambda: all(page.names() for page in pages), what="streams")
    code, retry_after_s, error = refusal(served, console, "anna")
    assert (code, retry_after_s > 0) == (429, True)
    assert "close one" in error["message"]
    monkeypatch.setattr("sonarpost.services.console.web.event_stream.MAX_STREAMS", MAX_STREAMS_OF_USER)
    code, retry_after_s, error = refusal(served, console, "bo")
    assert (code, retry_after_s > 0, error["code"]) == (503, True, "busy")
    pages[0].close()

    def is_accepted():
        try:
            open_stream()
        except urllib.error.HTTPError as error:
            error.close()
            return False
        return True

    eventually(is_accepted, what="another stream")


def test_large_events_do_not_fill_the_memory():
    hub = EventHub()
    for number in range(40):
        hub.publish("fleet", {"n": number, "detail": "x" * 1_000_000})
    assert len(hub.events_after(39) or ()) == 1
    assert len(hub.events_after(26) or ()) == 14
    assert hub.events_after(20) is None


def test_event_buffer(monkeypatch):
    monkeypatch.setattr("sonarpost.services.console.events.BUFFERED_EVENTS", 3)
    hub = EventHub()
    notified = []
    notify = lambda: notified.append(1)  # noqa: E731
    hub.subscribe(notify)
    for number in range(5):
        hub.publish("contact", {"n": number})
    hub.unsubscribe(notify)
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
