"""Disk reserve, and free space inside the file of a store."""

from collections import namedtuple

import pytest

from sonarpost.delivery.store import DiskReserve
from sonarpost.errors import RetryLaterError

DiskUsage = namedtuple("DiskUsage", "total used free")
RECORD = bytes(100_000)


@pytest.fixture
def disk(monkeypatch):
    free = [0]
    monkeypatch.setattr("sonarpost.delivery.store.shutil.disk_usage", lambda _: DiskUsage(10**9, 0, free[0]))
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
