"""Processes of vessel and shore are killed (SIGKILL) at critical moments; every image arrives exactly once."""

from __future__ import annotations

import random
import time
from collections.abc import Callable

import pytest
from builders.image_source import make_image
from builders.vessel_and_shore import PROCESSES, VesselAndShore

COUNT = 200


def test_killed_routers_lose_nothing(system: VesselAndShore) -> None:
    for part, router in enumerate(("router-vessel", "router-shore", "router-vessel", "router-shore")):
        first = 50 * part
        system.send([make_image(n) for n in range(first, first + 50)])
        system.wait_until(lambda first=first: system.shore_image_count() >= first + 5, 60, "first images at the shore")
        system.kill(router)
        time.sleep(0.5)
        system.start(router)
    system.assert_all_delivered_once()


def test_relay_killed_during_an_image_resumes(start_system: Callable[..., VesselAndShore]) -> None:
    # 45 kB need two chunks; on the slow link the time between them is long enough to kill the relay.
    system = start_system(link_bytes_per_s=1.5e6)
    system.send([make_image(n, shape=(150, 300)) for n in range(COUNT)])
    interrupted = 0
    for _ in range(20):
        system.wait_until(lambda: bool(system.query("c2", "SELECT COUNT(*) FROM partial")), 60, "a part of an image")
        system.kill("relay")
        interrupted += bool(system.query("c2", "SELECT SUM(has) FROM partial"))  # else the rest arrived before the kill
        system.start("relay")
        if interrupted == 3:
            break
        before = system.shore_image_count()
        system.wait_until(lambda before=before: system.shore_image_count() > before + 5, 60, "the relay continues")
    assert interrupted == 3, "killed during an image"
    system.assert_all_delivered_once()
    assert system.depths("c2")["partial"] == 0


def test_c2_killed_before_the_acknowledgement_stores_each_image_once(system: VesselAndShore) -> None:
    link = system.link
    assert link is not None
    system.send([make_image(n) for n in range(20)])
    system.assert_all_delivered_once()
    for first in range(20, COUNT, 60):
        # No data returns from the shore: commits of c2 are not acknowledged from now on.
        link.stall("down")
        system.send([make_image(n) for n in range(first, first + 60)])
        system.wait_until(lambda first=first: (system.accepted_count("c2") or 0) > first, 60, "c2 has committed")
        system.kill("c2")
        accepted = system.accepted_count("c2")
        queued = system.query("relay", "SELECT COUNT(*) FROM outbox")
        before_outbox = system.source.store.outbox_depth() + (system.query("relay", "SELECT COUNT(*) FROM inbox") or 0)
        assert accepted is not None
        assert queued is not None
        assert accepted + queued + before_outbox > first + 60, "some are committed and still queued"
        link.reset()
        link.mend()
        system.start("c2")
        system.assert_all_delivered_once()


@pytest.mark.system
def test_c2_killed_while_its_store_grows_stores_each_image_once(system: VesselAndShore) -> None:
    system.send([make_image(n) for n in range(COUNT)])
    wal = system.shore_state / "c2.db-wal"

    def log_bytes() -> int:
        """Return the size of the write-ahead log, 0 until c2 has opened its store."""
        try:
            return wal.stat().st_size
        except FileNotFoundError:
            return 0

    for kill in range(6):
        system.wait_until(lambda kill=kill: system.shore_image_count() >= kill * COUNT // 8, 60, "more images")
        size = log_bytes()
        system.wait_until(lambda size=size: log_bytes() != size or system.is_complete(), 60, "c2 writes")
        system.kill("c2")
        system.start("c2")
    system.assert_all_delivered_once()


@pytest.mark.parametrize("seconds", [20.0, pytest.param(300.0, marks=[pytest.mark.system, pytest.mark.timeout(700)])])
def test_random_kills_of_all_processes_lose_and_duplicate_nothing(system: VesselAndShore, seconds: float) -> None:
    rng = random.Random(int(seconds))
    count = int(COUNT * max(1.0, seconds / 60))
    start_s = time.monotonic()
    order: list[str] = []
    kills = 0
    while (elapsed_s := time.monotonic() - start_s) < seconds:
        done, target = len(system.expected), min(count, 5 + int(count * elapsed_s / seconds))
        shape = rng.choice([(24, 32), (60, 80), (150, 300)])
        system.send([make_image(n, shape) for n in range(done, target)])
        # Each process in turn, in a changing order; sometimes while a process is still starting.
        order = order or rng.sample(PROCESSES, len(PROCESSES))
        name = order.pop()
        time.sleep(rng.uniform(0.05, 1.0))
        system.kill(name)
        kills += 1
        time.sleep(rng.uniform(0.0, 0.3))
        system.start(name)
        time.sleep(rng.uniform(0.2, 2.5))
    system.send([make_image(n) for n in range(len(system.expected), count)])
    assert kills >= len(PROCESSES)
    system.assert_all_delivered_once(240)
