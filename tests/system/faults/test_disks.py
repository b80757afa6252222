"""Disks that are full, on either side: nothing is lost, people are told, and it goes on when there is room."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from builders.coast import Coast
from builders.feeder import make_image
from builders.small_disk import SmallDisk

COUNT = 200
LARGE = (150, 300)

MakeDisk = Callable[[int], SmallDisk]


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[MakeDisk]:
    """Makes small disks; they are unmounted after the coast on them is closed."""
    with ExitStack() as stack:

        def make(size_kb: int) -> SmallDisk:
            made = SmallDisk(tmp_path / "disk", size_kb)
            stack.callback(made.close)
            return made

        yield make


def state_of(coast: Coast, service: str) -> str:
    health = coast.health.get(service)
    return "" if health is None else health.state


def detail_of(coast: Coast, service: str) -> str:
    return coast.health[service].detail


def test_a_vessel_out_of_reach_for_long_fills_its_disk_up_to_the_reserve_and_recovers_by_itself(
    disk: MakeDisk, start_coast: Callable[..., Coast]
) -> None:
    small = disk(32_000)
    coast = start_coast(relay="disk_reserve_bytes = 12_000_000\n", vessel_state=small.folder / "state")
    coast.watch_health()
    assert coast.link is not None
    coast.link.cut()
    coast.owe([make_image(n, (200, 600)) for n in range(COUNT)])  # 24 MB
    coast.until(lambda: state_of(coast, "relay") == "degraded", 60, "relay says that it is degraded")
    assert "below the reserve" in detail_of(coast, "relay")
    assert small.free_bytes > 4_000_000, "what is small, and handling, have room"
    waiting = coast.feeder.store.outbox_depth()
    assert waiting > 0
    # What goes ashore makes room inside the store's file, which does not become smaller, for what waits.
    coast.link.mend()
    coast.assert_all_ashore_once()
    coast.until(lambda: state_of(coast, "relay") == "ok", 30, "relay is well again")


@pytest.mark.long
def test_a_disk_of_the_vessel_without_a_byte_leaves_pictures_with_their_sender(
    disk: MakeDisk, start_coast: Callable[..., Coast]
) -> None:
    small = disk(64_000)
    coast = start_coast(relay="disk_reserve_bytes = 0\n", vessel_state=small.folder / "state")
    coast.watch_health()
    coast.owe([make_image(n, LARGE) for n in range(20)])
    coast.until(lambda: coast.ashore_count() >= 5, 60, "first pictures ashore")
    small.fill()
    coast.owe([make_image(n, LARGE) for n in range(20, COUNT)])
    coast.until(lambda: state_of(coast, "relay") == "degraded", 60, "relay says that it is degraded")
    assert detail_of(coast, "relay")
    assert coast.feeder.store.outbox_depth() > 0
    small.empty()
    coast.assert_all_ashore_once()
    coast.until(lambda: state_of(coast, "relay") == "ok", 30, "relay is well again")


def test_a_full_disk_under_the_shores_pictures_leaves_them_in_its_store(
    disk: MakeDisk, start_coast: Callable[..., Coast]
) -> None:
    small = disk(1_500)
    coast = start_coast(shore_out=small.folder / "out")
    coast.watch_health()
    coast.owe([make_image(n, (60, 80)) for n in range(COUNT)])  # 4 MB of files
    coast.until(lambda: state_of(coast, "c2") == "degraded", 60, "c2 says that it is degraded")
    assert "No space left" in detail_of(coast, "c2") or "disk is full" in detail_of(coast, "c2")
    coast.until(lambda: coast.depths("relay")["outbox"] == 0, 60, "c2 has all in its store")
    assert 0 < coast.ashore_count() < COUNT
    small.grow(64_000)
    coast.assert_all_ashore_once()
    coast.until(lambda: state_of(coast, "c2") == "ok", 30, "c2 is well again")


def test_a_full_disk_under_the_shores_store_leaves_pictures_with_the_vessel(
    disk: MakeDisk, start_coast: Callable[..., Coast]
) -> None:
    small = disk(64_000)
    coast = start_coast(shore_state=small.folder / "state")
    coast.watch_health()
    coast.owe([make_image(n, LARGE) for n in range(50)])
    coast.assert_all_ashore_once()
    small.fill()
    coast.owe([make_image(n, LARGE) for n in range(50, COUNT)])
    coast.until(lambda: state_of(coast, "c2") == "degraded", 60, "c2 says that it is degraded")
    assert detail_of(coast, "c2")
    assert coast.depths("relay")["outbox"] or coast.depths("relay")["inbox"]
    small.empty()
    coast.assert_all_ashore_once()
    coast.until(lambda: state_of(coast, "c2") == "ok", 30, "c2 is well again")


@pytest.mark.long
def test_a_shore_whose_pictures_cannot_be_written_fills_its_store_up_to_the_reserve_and_recovers_by_itself(
    disk: MakeDisk, start_coast: Callable[..., Coast]
) -> None:
    small = disk(24_000)
    blocked = small.folder.parent / "out"
    blocked.write_text("a file where the folder should be")
    coast = start_coast(shore_state=small.folder / "state", shore_out=blocked)
    coast.watch_health()
    coast.owe([make_image(n, (200, 600)) for n in range(COUNT)])  # 24 MB
    coast.until(lambda: small.free_bytes < 9_000_000, 60, "c2 has filled its disk up to the reserve")
    coast.until(lambda: state_of(coast, "c2") == "degraded", 30, "c2 says that it is degraded")
    coast.until(lambda: (coast.depths("relay")["outbox"] or 0) > 0, 30, "the rest waits on the vessel")
    blocked.unlink()
    coast.assert_all_ashore_once()
    coast.until(lambda: state_of(coast, "c2") == "ok", 30, "c2 is well again")
