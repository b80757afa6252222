"""Disk reserve, and free space inside the file of a store and in its write-ahead log."""

import sqlite3
from collections import namedtuple
from contextlib import closing

import pytest

from sonarpost.delivery.disk_reserve import DiskReserve
from sonarpost.errors import DeliveryError, RetryLaterError

DiskUsage = namedtuple("DiskUsage", "total used free")
RECORD = bytes(100_000)


@pytest.fixture
def disk(monkeypatch):
    free = [0]
    monkeypatch.setattr("sonarpost.delivery.disk_reserve.shutil.disk_usage", lambda _: DiskUsage(10**9, 0, free[0]))
    return free


def test_records_are_rejected_and_degraded_is_reported_below_the_reserve(store, disk):
    reserve = DiskReserve(store, 1000, "records wait")
    disk[0] = 999
    assert reserve.degraded_reason() == "", "no record was rejected yet"
    with pytest.raises(RetryLaterError, match="999 bytes free, below the reserve of 1000: records wait"):
        reserve.require()
    assert "records wait" in reserve.degraded_reason()
    disk[0] = 1000
    assert reserve.degraded_reason() == ""
    reserve.require()


def test_an_emptied_store_accepts_records_again(store, disk):
    with store.transaction() as tx:
        for _ in range(20):
            tx.accept("k", RECORD)
    reserve = DiskReserve(store, 1_000_000, "records wait")
    with pytest.raises(RetryLaterError):
        reserve.require()
    with store.transaction() as tx:
        for item in store.inbox_items(20):
            tx.remove_handled(item)
    assert store.reusable_bytes() >= 20 * len(RECORD)
    reserve.require()


def test_a_log_that_a_reader_kept_long_gives_its_space_back(store, disk, monkeypatch):
    log = store.path.with_name(f"{store.path.name}-wal")
    monkeypatch.setattr(
        "sonarpost.delivery.disk_reserve.shutil.disk_usage",
        lambda folder: DiskUsage(10**7, 0, 10**7 - sum(f.stat().st_size for f in folder.iterdir())),
    )
    reserve = DiskReserve(store, 5_000_000, "records wait")
    with closing(sqlite3.connect(store.path)) as other:
        other.execute("BEGIN")
        other.execute("SELECT COUNT(*) FROM inbox").fetchone()
        with store.transaction() as tx:
            for _ in range(30):
                tx.accept("k", RECORD)
        with store.transaction() as tx:
            for item in store.inbox_items(30):
                tx.remove_handled(item)
        with store.transaction() as tx:
            for _ in range(30):
                tx.accept("k", RECORD)
        with pytest.raises(RetryLaterError):
            reserve.require()
        assert "records wait" in reserve.degraded_reason(), "the reader needs the log"
    with store.transaction() as tx:
        for item in store.inbox_items(30):
            tx.remove_handled(item)
    assert log.stat().st_size > 5_000_000
    assert reserve.degraded_reason() == ""
    assert log.stat().st_size == 0
    reserve.require()


def test_a_log_that_cannot_be_written_is_reported(store, disk, monkeypatch):
    reserve = DiskReserve(store, 1000, "records wait")
    with pytest.raises(RetryLaterError):
        reserve.require()

    def full():
        raise DeliveryError("database or disk is full")

    monkeypatch.setattr(store, "truncate_log", full)
    assert "records wait" in reserve.degraded_reason()
    disk[0] = 1000
    assert reserve.degraded_reason() == "database or disk is full"
    reserve.require()


def test_a_rejection_is_reported_once_although_there_is_space_again(store, disk):
    reserve = DiskReserve(store, 1000, "records wait")
    disk[0] = 999
    with pytest.raises(RetryLaterError):
        reserve.require()
    disk[0] = 1000
    assert "999 bytes free" in reserve.degraded_reason()
    assert reserve.degraded_reason() == ""
