"""Side-car of a store: lost commits are found at the next start, and only lost commits."""

import logging
import os
import shutil
import subprocess
import sys

import pytest
from builders.store_steps import fail_within, queued_items, send

from sonarpost.delivery.watermark import SUFFIX, Marks, Numbers, compare, read
from sonarpost.errors import StoredFileError

KILLED = """
import os
from pathlib import Path
from sonarpost.delivery.store import Store
store = Store(Path({path!r}))
store._db.execute("PRAGMA wal_autocheckpoint=0")
store._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
for number in range(30):
    with store.transaction() as tx:
        tx.send("k", "c2", b"%d" % number, encoding="e")
for number in range(3):
    with store.transaction() as tx:
        tx.accept("k", b"in %d" % number)
os._exit(0)
"""


@pytest.fixture(scope="module")
def killed_store(tmp_path_factory):
    """A store with 30 queued and 3 accepted records in its write-ahead log, whose process was killed."""
    path = tmp_path_factory.mktemp("killed") / "relay.db"
    subprocess.run([sys.executable, "-c", KILLED.format(path=str(path))], check=True)
    assert path.with_name("relay.db-wal").stat().st_size > 100_000
    return path


@pytest.fixture
def killed(killed_store, tmp_path):
    return shutil.copytree(killed_store.parent, tmp_path / "store") / killed_store.name


def delete_log(path):
    path.with_name(f"{path.name}-wal").unlink()


def overwrite_log(path):
    log = path.with_name(f"{path.name}-wal")
    log.write_bytes(os.urandom(log.stat().st_size))


def truncate_store(path):
    delete_log(path)
    path.write_bytes(b"")


def delete_store(path):
    delete_log(path)
    path.unlink()


@pytest.mark.parametrize("damage", [delete_log, overwrite_log, truncate_store, delete_store])
def test_lost_commits_are_logged_and_reported(killed, damage, caplog, open_store):
    damage(killed)
    store = open_store(killed)
    assert store.outbox_depth() == 0
    assert (dict(store.lost.queues), store.lost.inbox) == ({"c2": 30}, 3)
    assert str(store.lost) == "c2 30, inbox 3"
    messages = [(record.levelno, record.message) for record in caplog.records]
    assert messages == [(logging.ERROR, "Commits of the store are lost; records are possibly lost")]
    # Numbers are not used again.
    assert send(store, b"new", consumer="c2") == [31]
    assert [item.payload for item in queued_items(store, "c2", 9)] == [b"new"]


def test_report_remains_after_a_restart_and_further_losses_are_added(killed, open_store):
    delete_store(killed)
    open_store(killed).close()
    backup = killed.read_bytes()
    store = open_store(killed)
    assert dict(store.lost.queues) == {"c2": 30}
    send(store, b"a", b"b", consumer="c2")
    store.close()
    killed.write_bytes(backup)
    lost = open_store(killed).lost
    assert (dict(lost.queues), lost.inbox) == ({"c2": 32}, 3)


def test_store_with_its_log_reports_no_loss(killed, caplog, open_store):
    store = open_store(killed)
    assert store.lost is None
    assert (store.outbox_depth(), store.inbox_depth()) == (30, 3)
    assert not caplog.records


def test_delivered_records_are_not_counted_as_lost(store, open_store):
    send(store, *[b"x"] * 8, consumer="c2")
    with store.transaction() as tx:
        tx.remove_acknowledged("c2", range(1, 9))
    send(store, *[b"x"] * 2, consumer="c2")
    store.close()
    store.path.unlink()
    assert dict(open_store().lost.queues) == {"c2": 2}


def test_older_side_car_is_no_loss(store, open_store, tmp_path, caplog):
    side_car = store.path.with_name(store.path.name + SUFFIX)
    send(store, b"1", consumer="c2")
    shutil.copy(side_car, tmp_path / "older")
    send(store, b"2", consumer="c2")
    store.close()
    shutil.copy(tmp_path / "older", side_car)
    assert open_store().lost is None
    assert not caplog.records
    store.close()
    assert read(store.path) == Marks(queues={"c2": Numbers(2, 1)})


@pytest.mark.parametrize("content", [b"", b"{}\n", b'{"v":1}\nffffffff\n', b'{"v":2}\n5ded8eb5\n', bytes(5000)])
def test_unreadable_side_car_is_logged_and_written_again(content, store, open_store, caplog):
    send(store, b"1", consumer="c2")
    store.close()
    store.path.with_name(store.path.name + SUFFIX).write_bytes(content)
    with pytest.raises(StoredFileError):
        read(store.path)
    assert open_store().lost is None
    assert [record.message for record in caplog.records] == ["Side-car of the store cannot be read; writing a new one"]
    assert read(store.path) == Marks(queues={"c2": Numbers(1, 1)})


def test_side_car_is_written_after_each_commit(store):
    send(store, b"1", b"2", consumer="a")
    send(store, b"1", consumer="b@shore")
    assert read(store.path) == Marks(queues={"a": Numbers(2, 1), "b@shore": Numbers(1, 1)})
    with store.transaction() as tx:
        tx.accept("k", b"x")
    assert read(store.path) == Marks(Numbers(1, 1), {"a": Numbers(2, 1), "b@shore": Numbers(1, 1)})
    with store.transaction() as tx:
        tx.remove_handled(store.inbox_items()[0])
        tx.accept("k", b"y")
        tx.accept("k", b"z")
    assert read(store.path).inbox == Numbers(3, 2)
    with pytest.raises(ZeroDivisionError):
        fail_within(store, lambda tx: tx.send("k", "a", b"3", encoding="e"))
    assert read(store.path).queues["a"] == Numbers(2, 1)


def test_side_car_that_cannot_be_written_does_not_stop_the_store(open_store, tmp_path, caplog):
    (tmp_path / f"s.db{SUFFIX}").mkdir()
    assert send(open_store(), b"1") == [1]
    assert [record.message for record in caplog.records] == [
        "Side-car of the store cannot be read; writing a new one",
        "Side-car of the store not written",
    ]


def test_compare_counts_only_open_numbers_above_the_store():
    side_car = Marks(Numbers(10, 8), {"a": Numbers(100, 91), "b": Numbers(5, 6), "c": Numbers(7, 1)})
    lost = compare(side_car, Marks(Numbers(9, 8), {"a": Numbers(20, 1), "c": Numbers(7, 7)}), 5.0)
    assert (lost.inbox, dict(lost.queues), lost.found_utc_s) == (1, {"a": 10, "b": 0}, 5.0)
    assert compare(side_car, side_car, 5.0) is None
    assert compare(Marks(), side_car, 5.0) is None
