"""Full disks on either side: no loss, degraded health, and recovery when there is space."""

from collections.abc import Callable
from contextlib import ExitStack

import pytest
from builders.image_source import make_image
from builders.small_disk import SmallDisk

COUNT = 200
LARGE = (150, 300)
ALL_VERSIONS = "supersede = false\n"

MakeDisk = Callable[[int], SmallDisk]


@pytest.fixture
def disk(tmp_path):
    """Creates small disks, which are unmounted after the system is closed."""
    with ExitStack() as stack:

        def make(size_kb):
            made = SmallDisk(tmp_path / "disk", size_kb)
            stack.callback(made.close)
            return made

        yield make


def versions_of_images():
    """Return 12 MB in four versions of each image; relay and c2 keep the last one of each."""
    return [make_image(n % (COUNT // 4), (200, 300), version=1 + n // (COUNT // 4)) for n in range(COUNT)]


def test_unreachable_vessel_fills_its_disk_to_the_reserve_and_recovers(disk, start_system):
    small = disk(20_000)
    system = start_system(relay=f"disk_reserve_bytes = 12_000_000\n{ALL_VERSIONS}", vessel_state=small.folder / "state")
    system.watch_health()
    system.link.cut()
    system.send(versions_of_images())
    system.wait_for_state("relay", "degraded", "below the reserve")
    assert small.free_bytes > 4_000_000, "space remains for small records and for handling"
    assert system.source.store.outbox_depth() > 0
    # Delivered images free space inside the store's file, which does not shrink.
    system.link.mend()
    system.assert_all_delivered_once()
    system.wait_for_state("relay", "ok")


def test_sender_keeps_images_while_the_vessel_disk_is_full(disk, start_system):
    small = disk(64_000)
    system = start_system(relay="disk_reserve_bytes = 0\n", vessel_state=small.folder / "state")
    system.watch_health()
    system.send([make_image(n, LARGE) for n in range(20)])
    system.wait_until(lambda: system.shore_image_count() >= 5, "first images at the shore")
    small.fill()
    system.history.fault("disk", "full")
    system.send([make_image(n, LARGE) for n in range(20, COUNT)])
    system.wait_for_state("relay", "degraded", ".")
    assert system.source.store.outbox_depth() > 0
    small.empty()
    system.history.fault("disk", "has space")
    system.assert_all_delivered_once()
    system.wait_for_state("relay", "ok")


def test_images_stay_in_the_store_while_the_shore_image_disk_is_full(disk, start_system):
    small = disk(8_000)
    system = start_system(shore_out=small.folder / "out")
    system.watch_health()
    system.send([make_image(n, (60, 80)) for n in range(COUNT)])  # 4 MB of files, up to 5 MB of archive.db
    system.wait_for_state("c2", "degraded", "No space left|disk is full")
    system.wait_until(lambda: system.depths("relay")["outbox"] == 0, "c2 has accepted all")
    system.history.fault("disk", "full")
    system.wait_until(lambda: system.shore_image_count() > 0, "first images at the shore")
    assert system.shore_image_count() < COUNT
    small.grow(64_000)
    system.assert_all_delivered_once()
    system.wait_for_state("c2", "ok")


def test_images_stay_on_the_vessel_while_the_shore_store_disk_is_full(disk, start_system):
    small = disk(64_000)
    system = start_system(shore_state=small.folder / "state")
    system.watch_health()
    system.send([make_image(n, LARGE) for n in range(50)])
    system.assert_all_delivered_once()
    small.fill()
    system.history.fault("disk", "full")
    system.send([make_image(n, LARGE) for n in range(50, COUNT)])
    system.wait_for_state("c2", "degraded", ".")
    system.wait_until(lambda: bool(system.depths("relay")["outbox"]), "images that wait on the vessel")
    small.empty()
    system.history.fault("disk", "has space")
    system.assert_all_delivered_once()
    system.wait_for_state("c2", "ok")


def test_shore_with_unwritable_images_fills_its_store_to_the_reserve_and_recovers(disk, start_system):
    small = disk(24_000)
    blocked = small.folder.parent / "out"
    blocked.write_text("a file in place of the folder")
    system = start_system(relay=ALL_VERSIONS, shore_state=small.folder / "state", shore_out=blocked)
    system.watch_health()
    system.send(versions_of_images())
    system.wait_until(lambda: small.free_bytes < 9_000_000, "c2 has filled its disk to the reserve")
    system.history.fault("disk", "c2 refuses records below the reserve")
    system.wait_for_state("c2", "degraded")
    system.wait_until(lambda: (system.depths("relay")["outbox"] or 0) > 0, "the other images wait on the vessel")
    blocked.unlink()
    system.assert_all_delivered_once()
    system.wait_for_state("c2", "ok")
