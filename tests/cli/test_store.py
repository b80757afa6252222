"""`sonarpost store`: check and salvage, on damaged stores."""

import os
import re
import sqlite3
import time
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from builders.store_steps import queued_items, send

from sonarpost.cli.main import main
from sonarpost.delivery.store import Store
from sonarpost.errors import DeliveryError

PAGE = 4096
RECORDS = 300


def payload(number):
    """Return 1 kB that no other record has."""
    return (b"%06d" % number) * 170


@pytest.fixture
def relay(tmp_path):
    """Make a closed store with records in all tables; one record has overflow pages."""
    path = tmp_path / "relay.db"
    store = Store(path)
    for first in range(0, RECORDS, 50):
        send(store, *(payload(number) for number in range(first, first + 50)), consumer="c2")
    send(store, b"large" * 10_000, consumer="c2@north")
    with store.transaction() as tx:
        for number in range(40):
            tx.accept("k/in", payload(number))
        tx.put_state("name", b"value")
        tx.quarantine("in", "k/bad", b"junk", "refused by a test")
    store.close()
    return path


def pages_with(content, data):
    """Return the pages with `content`, numbered from 0."""
    return [n for n in range(len(data) // PAGE) if content in data[n * PAGE : (n + 1) * PAGE]]


def overwrite_page(path, page, data=b"\xa5" * PAGE):
    with path.open("r+b") as file:
        file.seek(page * PAGE)
        file.write(data)


def run(*arguments):
    return main(["store", *map(str, arguments)])


def test_sound_store(relay, capsys):
    before = relay.read_bytes()
    assert run("check", relay) == 0
    text = capsys.readouterr().out
    assert re.search(r"^integrity +ok$", text, re.MULTILINE)
    assert re.search(r"^side-car +as the store$", text, re.MULTILINE)
    assert re.search(rf"^c2 +{RECORDS} +{RECORDS * 1020} +20\S+ \S+ +\d+ s +{RECORDS}$", text, re.MULTILINE)
    assert re.search(r"^c2@north +1 +50000 ", text, re.MULTILINE)
    assert re.search(r"^\(inbox\) +40 +40800 .* 40$", text, re.MULTILINE)
    assert re.search(r"^\(quarantine\) +1 +4 ", text, re.MULTILINE)
    assert relay.read_bytes() == before


def test_write_ahead_log_of_a_killed_service_is_read_and_stays(relay, tmp_path, capsys):
    with closing(Store(relay)) as store:
        send(store, b"in the log", consumer="c2")
        running = {path.name: path.read_bytes() for path in tmp_path.glob("relay.db*")}
    for name, content in running.items():  # as if the service had been killed
        (tmp_path / name).write_bytes(content)
    log = relay.with_name("relay.db-wal")
    before = (relay.read_bytes(), log.read_bytes())
    assert run("check", relay) == 0
    assert re.search(rf"^c2 +{RECORDS + 1} ", capsys.readouterr().out, re.MULTILINE)
    assert run("salvage", relay, "--out", relay.with_name("new.db")) == 0
    assert (relay.read_bytes(), log.read_bytes()) == before
    with closing(Store(relay.with_name("new.db"))) as new:
        assert queued_items(new, "c2", 999)[-1].payload == b"in the log"


def test_lost_commits_are_shown_and_cleared(relay, capsys):
    relay.write_bytes(b"")
    with closing(sqlite3.connect(relay)) as empty:
        empty.execute("CREATE TABLE meta (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID")
    assert run("check", relay) == 1
    relay.unlink()
    Store(relay).close()
    assert run("check", relay) == 1
    text = capsys.readouterr().out
    assert f"records possibly lost: c2 {RECORDS}, c2@north 1, inbox 40; found 20" in text
    assert run("check", relay, "--clear") == 0
    assert f"cleared: records possibly lost: c2 {RECORDS}, c2@north 1, inbox 40" in capsys.readouterr().out
    assert run("check", relay) == 0
    with closing(Store(relay)) as store:
        assert store.lost is None


def test_loss_that_no_service_has_reported_yet(relay, capsys):
    backup = relay.read_bytes()
    with closing(Store(relay)) as store:
        send(store, b"after the backup", consumer="c2")
    relay.write_bytes(backup)
    assert run("check", relay) == 1
    text = capsys.readouterr().out
    assert re.search(r"^side-car +newer than the store$", text, re.MULTILINE)
    assert "records possibly lost: c2 1; not yet reported by the service" in text


def test_store_in_use_is_refused(relay, capsys):
    with closing(Store(relay)):
        for command in (["check", relay], ["check", relay, "--clear"], ["salvage", relay, "--out", f"{relay}.new"]):
            assert run(*command) == 2
            assert "relay.db: in use by another process" in capsys.readouterr().err
    assert not Path(f"{relay}.new").exists()


def test_missing_store_and_existing_output(relay, tmp_path, capsys):
    for command in (["check", tmp_path / "no.db"], ["salvage", tmp_path / "no.db", "--out", tmp_path / "new.db"]):
        assert run(*command) == 2
        assert "no.db: got 'no such file'" in capsys.readouterr().err
    assert not (tmp_path / "no.db").exists()
    assert run("salvage", relay, "--out", relay) == 2
    assert "relay.db exists" in capsys.readouterr().err


@pytest.fixture
def salvaged(relay, capsys):
    """Salvage a damaged store and open the new one; fails if the damaged one was changed."""
    with ExitStack() as stack:

        def salvage(status=1):
            before, out = relay.read_bytes(), relay.with_name("new.db")
            assert run("salvage", relay, "--out", out) == status
            assert relay.read_bytes() == before
            assert out.stat().st_mode & 0o777 == 0o600
            return stack.enter_context(closing(Store(out))), capsys.readouterr().out

        yield salvage


def numbers(store):
    items = queued_items(store, "c2", 9999)
    assert all(item.payload == payload(item.seq - 1) for item in items)
    return {item.seq for item in items}


def test_salvage_of_a_sound_store_copies_everything(relay, salvaged):
    with closing(Store(relay)) as old:
        origin = old.origin
    new, text = salvaged(0)
    assert new.origin == origin
    assert numbers(new) == set(range(1, RECORDS + 1))
    assert [item.payload for item in new.inbox_items(99)] == [payload(number) for number in range(40)]
    assert new.get_state("name") == b"value"
    assert new.refused_count() == 1
    assert send(new, b"next", consumer="c2") == [RECORDS + 1]
    with new.transaction() as tx:
        tx.accept("k", b"next")
    assert new.inbox_items(99)[-1].id == 41
    assert re.search(rf"^outbox +{RECORDS + 1} +-$", text, re.MULTILINE)


def test_salvage_around_damaged_pages(relay, salvaged):
    lost: set[int] = set()
    data = relay.read_bytes()
    for number in (20, 100, 101, 102, 250):
        page = next(p for p in pages_with(payload(number), data) if data[p * PAGE] == 13)
        lost |= {n + 1 for n in range(RECORDS) if payload(n) in data[page * PAGE : (page + 1) * PAGE]}
        overwrite_page(relay, page)
    with pytest.raises(DeliveryError, match=r"recover the records: sonarpost store salvage \S*relay\.db --out NEW"):
        Store(relay)
    assert run("check", relay) == 1
    new, text = salvaged()
    assert 5 <= len(lost) <= 20
    queued = numbers(new)
    inbox = {item.payload for item in new.inbox_items(99)}
    assert (set(range(1, RECORDS + 1)) - queued) | {n + 1 for n in range(40) if payload(n) not in inbox} == lost
    assert queued_items(new, "c2@north", 9)[0].payload == b"large" * 10_000
    assert new.get_state("name") == b"value"
    assert re.search(r"^outbox +\d+ +row \d+ to \d+, ", text, re.MULTILINE)


def test_store_without_a_readable_first_page_and_other_files_are_not_salvaged(relay, capsys):
    out = relay.with_name("new.db")
    overwrite_page(relay, 0, os.urandom(100))
    with pytest.raises(DeliveryError, match=r"file is not a database; .*sonarpost store salvage"):
        Store(relay)
    assert run("check", relay) == 1
    assert "file is not a database" in capsys.readouterr().out
    for content in (relay.read_bytes(), os.urandom(20 * PAGE), b"text"):
        relay.write_bytes(content)
        assert run("salvage", relay, "--out", out) == 2
        assert "a store whose first page can be read" in capsys.readouterr().err
    assert not out.exists()


def test_old_records_have_an_age(relay, capsys):
    with closing(sqlite3.connect(relay)) as db, db:
        db.execute("UPDATE outbox SET created_utc_s = ? WHERE consumer = 'c2'", (time.time() - 1000.0,))
    assert run("check", relay) == 0
    found = re.search(r"^c2 .* (\d+) s ", capsys.readouterr().out, re.MULTILINE)
    assert found
    assert 1000 <= int(found.group(1)) < 1100


# Quarantine


def test_quarantined_records_are_listed_and_queued_again(tmp_path, capsys):
    path = tmp_path / "c2.db"
    with closing(Store(path)) as store, store.transaction() as tx:
        tx.quarantine("in", "k/first", b"x" * 300_000, "crashed\x1b[2J", is_accepted=True)
        tx.quarantine("in", "k/second", b"second", "refused")
        tx.quarantine("in", "k/cut", b"x" * 300_000, "never accepted")
        tx.quarantine("out", "k/out", b"out", "refused by a consumer")
        tx.quarantine("in", "state undecoded/vessel-1", b"state", "cannot be read")
    assert main(["store", "quarantine", str(path)]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == ["number", "1", "2", "3", "4", "5"]
    assert "\x1b" not in listed[1]
    assert main(["store", "quarantine", str(path), "--requeue", "1", "4", "9"]) == 1
    assert capsys.readouterr().out == "1 records queued again\nnot queued: 4, 9\n"
    assert main(["store", "quarantine", str(path), "--requeue"]) == 0
    with closing(Store(path)) as store:
        assert [(item.key, len(item.payload)) for item in store.inbox_items(9)] == [
            ("k/first", 300_000),
            ("k/second", 6),
        ]
        assert [record.id for record in store.quarantined()] == [3, 4, 5]
