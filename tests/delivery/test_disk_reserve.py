"""Room on the disk: a reserve, and what lies free inside a store's file."""

from __future__ import annotations

from collections import namedtuple

import pytest

from sonarpost.delivery.disk_reserve import DiskReserve
from sonarpost.delivery.inbox import RetryLaterError

DiskUsage = namedtuple("DiskUsage", "total used free")
RECORD = bytes(100_000)


@pytest.fixture
def disk(monkeypatch):
    free = [0]
    monkeypatch.setattr("sonarpost.delivery.disk_reserve.shutil.disk_usage", lambda _: DiskUsage(10**9, 0, free[0]))
    return free


def test_below_the_reserve_records_are_not_admitted_and_it_is_said_until_there_is_room(store, disk):
    room = DiskReserve(store, 1000, "records wait")
    disk[0] = 999
    assert room.degraded_reason() == "", "nobody was turned away yet"
    with pytest.raises(RetryLaterError, match="999 bytes free, below the reserve of 1000: records wait"):
        room.require()
    assert "records wait" in room.degraded_reason()
    disk[0] = 1000
    assert room.degraded_reason() == ""
    room.require()


def test_a_store_that_was_full_and_is_empty_takes_records_again(store, disk):
    with store.transaction() as tx:
        for _ in range(20):
            tx.accept("k", RECORD)
    room = DiskReserve(store, 1_000_000, "records wait")
    with pytest.raises(RetryLaterError):
        room.require()
    with store.transaction() as tx:
        for item in store.pending(20):
            tx.done(item)
    assert store.reusable_bytes() >= 20 * len(RECORD)
    room.require()
