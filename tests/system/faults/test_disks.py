"""Full disks on either side: no loss, degraded health, and recovery when there is space."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from builders.image_source import make_image
from builders.small_disk import SmallDisk
from builders.vessel_and_shore import VesselAndShore

COUNT = 200
LARGE = (150, 300)

MakeDisk = Callable[[int], SmallDisk]


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[MakeDisk]:
    """Creates small disks, which are unmounted after the system is closed."""
    with ExitStack() as stack:

        def make(size_kb: int) -> SmallDisk:
            made = SmallDisk(tmp_path / "disk", size_kb)
            stack.callback(made.close)
            return made

        yield make


def state_of(system: VesselAndShore, service: str) -> str:
    health = system.health.get(service)
    return "" if health is None else health.state


def detail_of(system: VesselAndShore, service: str) -> str:
    return system.health[service].detail


def test_unreachable_vessel_fills_its_disk_to_the_reserve_and_recovers(
    disk: MakeDisk, start_system: Callable[..., VesselAndShore]
) -> None:
    small = disk(32_000)
    system = start_system(relay="disk_reserve_bytes = 12_000_000\n", vessel_state=small.folder / "state")
    system.watch_health()
    assert system.link is not None
    system.link.cut()
    system.send([make_image(n, (200, 600)) for n in range(COUNT)])  # 24 MB
    system.wait_until(lambda: state_of(system, "relay") == "degraded", 60, "relay reports degraded")
    assert "below the reserve" in detail_of(system, "relay")
    assert small.free_bytes > 4_000_000, "space remains for small records and for handling"
    waiting = system.source.store.outbox_depth()
    assert waiting > 0
    # Delivered images free space inside the store's file, which does not shrink.
    system.link.mend()
    system.assert_all_delivered_once()
    system.wait_until(lambda: state_of(system, "relay") == "ok", 30, "relay has recovered")


@pytest.mark.system
def test_sender_keeps_images_while_the_vessel_disk_is_full(
    disk: MakeDisk, start_system: Callable[..., VesselAndShore]
) -> None:
    small = disk(64_000)
    system = start_system(relay="disk_reserve_bytes = 0\n", vessel_state=small.folder / "state")
    system.watch_health()
    system.send([make_image(n, LARGE) for n in range(20)])
    system.wait_until(lambda: system.shore_image_count() >= 5, 60, "first images at the shore")
    small.fill()
    system.history.fault("disk", "full")
    system.send([make_image(n, LARGE) for n in range(20, COUNT)])
    system.wait_until(lambda: state_of(system, "relay") == "degraded", 60, "relay reports degraded")
    assert detail_of(system, "relay")
    assert system.source.store.outbox_depth() > 0
    small.empty()
    system.history.fault("disk", "has space")
    system.assert_all_delivered_once()
    system.wait_until(lambda: state_of(system, "relay") == "ok", 30, "relay has recovered")


def test_images_stay_in_the_store_while_the_shore_image_disk_is_full(
    disk: MakeDisk, start_system: Callable[..., VesselAndShore]
) -> None:
    small = disk(1_500)
    system = start_system(shore_out=small.folder / "out")
    system.watch_health()
    system.send([make_image(n, (60, 80)) for n in range(COUNT)])  # 4 MB of files
    system.wait_until(lambda: state_of(system, "c2") == "degraded", 60, "c2 reports degraded")
    assert "No space left" in detail_of(system, "c2") or "disk is full" in detail_of(system, "c2")
    system.wait_until(lambda: system.depths("relay")["outbox"] == 0, 60, "c2 has accepted all")
    assert 0 < system.shore_image_count() < COUNT
    small.grow(64_000)
    system.assert_all_delivered_once()
    system.wait_until(lambda: state_of(system, "c2") == "ok", 30, "c2 has recovered")


def test_images_stay_on_the_vessel_while_the_shore_store_disk_is_full(
    disk: MakeDisk, start_system: Callable[..., VesselAndShore]
) -> None:
    small = disk(64_000)
    system = start_system(shore_state=small.folder / "state")
    system.watch_health()
    system.send([make_image(n, LARGE) for n in range(50)])
    system.assert_all_delivered_once()
    small.fill()
    system.history.fault("disk", "full")
    system.send([make_image(n, LARGE) for n in range(50, COUNT)])
    system.wait_until(lambda: state_of(system, "c2") == "degraded", 60, "c2 reports degraded")
    assert detail_of(system, "c2")
    assert system.depths("relay")["outbox"] or system.depths("relay")["inbox"]
    small.empty()
    system.history.fault("disk", "has space")
    system.assert_all_delivered_once()
    system.wait_until(lambda: state_of(system, "c2") == "ok", 30, "c2 has recovered")


@pytest.mark.system
def test_shore_with_unwritable_images_fills_its_store_to_the_reserve_and_recovers(
    disk: MakeDisk, start_system: Callable[..., VesselAndShore]
) -> None:
    small = disk(24_000)
    blocked = small.folder.parent / "out"
    blocked.write_text("a file in place of the folder")
    system = start_system(shore_state=small.folder / "state", shore_out=blocked)
    system.watch_health()
    system.send([make_image(n, (200, 600)) for n in range(COUNT)])  # 24 MB
    system.wait_until(lambda: small.free_bytes < 9_000_000, 60, "c2 has filled its disk to the reserve")
    system.history.fault("disk", "c2 refuses records below the reserve")
    system.wait_until(lambda: state_of(system, "c2") == "degraded", 30, "c2 reports degraded")
    system.wait_until(lambda: (system.depths("relay")["outbox"] or 0) > 0, 30, "the other images wait on the vessel")
    blocked.unlink()
    system.assert_all_delivered_once()
    system.wait_until(lambda: state_of(system, "c2") == "ok", 30, "c2 has recovered")
