"""Subscriber of accepted records against a c2 whose replies the test determines."""

import queue
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import pytest
import zenoh
from builders.common import WAIT_S, eventually
from builders.shore import CONTACTS

from sonarpost import keys
from sonarpost.bus import catch_up
from sonarpost.bus.catch_up import AcceptedRecord, CatchUpSubscriber
from sonarpost.bus.session import client_config
from sonarpost.errors import QueryRefusedError

OLD, NEW = "0000000a", "0000000b"
KEY = keys.shore_image("vessel-1")


def record(seq: int, archive: str = OLD, **fields: Any) -> bytes:
    return msgpack.packb({"accepted": {"archive": archive, "seq": seq, "utc_s": 1.0}, **fields})


def page(records: int, end: int, archive: str = OLD, *, more: bool = False) -> bytes:
    return msgpack.packb({"type": "page", "records": records, "more": more, "next": f"{archive}.{end}"})


class C2:
    """Answers queries with `answer`, which returns payloads, or an error as text; None leaves a query open."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.queries: queue.Queue[dict[str, str]] = queue.Queue()
        self.answer: Callable[[dict[str, str]], list[bytes] | bytes | None] = lambda _: [page(0, 0)]
        self._open: list[zenoh.Query] = []
        session.declare_queryable(CONTACTS, self._on_query, complete=True)

    def _on_query(self, query: zenoh.Query) -> None:
        parameters = dict(pair.split("=", 1) for pair in str(query.parameters).split(";"))
        self.queries.put(parameters)
        replies = self.answer(parameters)
        if replies is None:
            self._open.append(query)
            return
        if isinstance(replies, bytes):
            query.reply_err(replies, encoding=zenoh.Encoding.TEXT_PLAIN)
        else:
            for payload in replies:
                query.reply(KEY, payload)
        query.drop()

    def publish(self, payload: bytes) -> None:
        self.session.put(KEY, payload, congestion_control=zenoh.CongestionControl.BLOCK)


@pytest.fixture
def c2(client: zenoh.Session, monkeypatch: pytest.MonkeyPatch) -> C2:
    monkeypatch.setattr(catch_up, "RETRY_S", 0.01)
    return C2(client)


@pytest.fixture
def subscribe(router: str) -> Iterator[Callable[..., CatchUpSubscriber]]:
    with zenoh.open(client_config([router])) as session:
        yield lambda *arguments, **options: CatchUpSubscriber(session, CONTACTS, *arguments, **options)


def caught_up(subscriber: CatchUpSubscriber, cursor: str) -> list[int]:
    """Return the numbers of the records up to a cursor."""
    found: list[int] = []

    def is_caught_up() -> bool:
        record = subscriber.poll(0.0)
        found.extend([] if record is None else [record.seq])
        return record is None and subscriber.is_caught_up and subscriber.cursor == cursor

    eventually(is_caught_up)
    return found


def next_record(subscriber: CatchUpSubscriber) -> AcceptedRecord:
    while (found := subscriber.poll(WAIT_S)) is None:
        pass
    return found


def limits(c2: C2, subscriber: CatchUpSubscriber, count: int) -> list[int]:
    """Return the limits of the next `count` queries."""
    found: list[int] = []
    while len(found) < count:
        subscriber.poll(0.01)
        while not c2.queries.empty():
            found.append(int(c2.queries.get()["limit"]))
    return found[:count]


def test_limit_is_reduced_by_lost_replies_only_and_recovers(c2, subscribe):
    c2.answer = lambda _: []
    subscriber = subscribe(refresh_s=0.0)
    assert limits(c2, subscriber, 4) == [256] * 4
    answers = iter([[record(1), record(2), page(9, 9)], [page(3, 3)]])
    c2.answer = lambda _: next(answers, [page(0, 0)])
    found = limits(c2, subscriber, 14)
    reduced = found.index(1)
    assert found[reduced:][:6] == [1, 1, 2, 4, 8, 16]
    assert limits(c2, subscriber, 6)[-1] == 256


def test_publications_are_delivered_while_a_query_waits(c2, subscribe, monkeypatch):
    monkeypatch.setattr(catch_up, "QUERY_TIMEOUT_S", 100 * WAIT_S)
    c2.answer = lambda _: None
    subscriber = subscribe(refresh_s=0.0)
    assert subscriber.poll(0.0) is None
    c2.queries.get(timeout=WAIT_S)
    for seq in (7, 8):
        c2.publish(record(seq))
    assert [next_record(subscriber).seq for _ in range(2)] == [7, 8]
    assert not subscriber.is_caught_up
    assert c2.queries.empty()


def test_invalid_utf8_in_an_error_reply_is_replaced(c2, subscribe):
    c2.answer = lambda _: b"key: \xff"
    with pytest.raises(QueryRefusedError, match="key: \ufffd"):
        next_record(subscribe())


def test_forged_publication_does_not_suppress_the_record_with_its_number(c2, subscribe):
    subscriber = subscribe(refresh_s=0.0)
    caught_up(subscriber, f"{OLD}.0")
    sent = [record(1, forged=True), record(1), record(1)]
    for payload in (*sent, record(2)):
        c2.publish(payload)
    assert [next_record(subscriber).payload for _ in range(3)] == [*sent[:2], record(2)]
    c2.answer = lambda _: [record(1), record(2), page(2, 2)]
    assert caught_up(subscriber, f"{OLD}.2") == []


def test_only_new_records_are_delivered_after_the_archive_was_replaced(c2, subscribe):
    c2.answer = lambda parameters: [page(0, 5)] if "_time" in parameters else [record(6), page(1, 6)]
    subscriber = subscribe(only_new=True, refresh_s=0.0)
    assert next_record(subscriber).seq == 6

    def replaced(parameters):
        if OLD in parameters.get("after", ""):
            return b"key: after: got another archive"
        old_records = [] if "_time" in parameters or "after" in parameters else [record(1, NEW)]
        return [*old_records, page(len(old_records), 2, NEW)]

    c2.publish(record(2, NEW))
    assert next_record(subscriber).archive == NEW
    c2.answer = replaced
    assert caught_up(subscriber, f"{NEW}.2") == []


def test_cursor_does_not_move_back(c2, subscribe):
    c2.answer = lambda _: [record(3), page(1, 4)]
    subscriber = subscribe(f"{OLD}.9")
    eventually(lambda: subscriber.poll(0.0) is None and subscriber.is_caught_up)
    assert subscriber.cursor == f"{OLD}.9"


def test_large_payloads_are_ignored(c2, subscribe, monkeypatch):
    subscriber = subscribe(refresh_s=0.0)
    caught_up(subscriber, f"{OLD}.0")
    monkeypatch.setattr(catch_up, "MAX_RECORD_BYTES", 1000, raising=False)
    c2.publish(record(1, data=bytes(1000)))
    c2.publish(record(2))
    assert next_record(subscriber).seq == 2
