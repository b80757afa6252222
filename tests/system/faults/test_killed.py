"""Processes between vessel and shore are killed (SIGKILL) at the worst moments: every picture arrives, once."""

from __future__ import annotations

import random
import time
from collections.abc import Callable

import pytest
from builders.coast import PROCESSES, Coast
from builders.feeder import make_image

COUNT = 200


def test_routers_killed_and_started_again_lose_nothing(coast: Coast) -> None:
    for part, router in enumerate(("router-vessel", "router-shore", "router-vessel", "router-shore")):
        first = 50 * part
        coast.owe([make_image(n) for n in range(first, first + 50)])
        coast.until(lambda first=first: coast.ashore_count() >= first + 5, 60, "first pictures of this part ashore")
        coast.kill(router)
        time.sleep(0.5)
        coast.start(router)
    coast.assert_all_ashore_once()


def test_a_relay_killed_in_the_middle_of_a_picture_goes_on_from_there(start_coast: Callable[..., Coast]) -> None:
    # 45 kB go in two pieces; the thin link makes the time between them long enough to be met.
    coast = start_coast(link_bytes_per_s=1.5e6)
    coast.owe([make_image(n, shape=(150, 300)) for n in range(COUNT)])
    met = 0
    for _ in range(20):
        coast.until(lambda: bool(coast.ask("c2", "SELECT COUNT(*) FROM partial")), 60, "c2 has a part of a picture")
        coast.kill("relay")
        met += bool(coast.ask("c2", "SELECT SUM(has) FROM partial"))  # else the rest came as the relay was killed
        coast.start("relay")
        if met == 3:
            break
        before = coast.ashore_count()
        coast.until(lambda before=before: coast.ashore_count() > before + 5, 60, "the relay goes on")
    assert met == 3, "killed in the middle of a picture"
    coast.assert_all_ashore_once()
    assert coast.depths("c2")["partial"] == 0


def test_c2_killed_between_commit_and_acknowledgement_has_each_once(coast: Coast) -> None:
    link = coast.link
    assert link is not None
    coast.owe([make_image(n) for n in range(20)])
    coast.assert_all_ashore_once()
    for first in range(20, COUNT, 60):
        # Nothing comes back from the shore: whatever c2 commits from now on is not acknowledged.
        link.stall("down")
        coast.owe([make_image(n) for n in range(first, first + 60)])
        coast.until(lambda first=first: (coast.accepted("c2") or 0) > first, 60, "c2 has committed")
        coast.kill("c2")
        accepted = coast.accepted("c2")
        owed = coast.ask("relay", "SELECT COUNT(*) FROM outbox")
        in_relay_or_before = coast.feeder.store.outbox_depth() + (coast.ask("relay", "SELECT COUNT(*) FROM inbox") or 0)
        assert accepted is not None
        assert owed is not None
        assert accepted + owed + in_relay_or_before > first + 60, "some are committed, and owed all the same"
        link.lose_what_is_on_its_way()
        link.mend()
        coast.start("c2")
        coast.assert_all_ashore_once()


@pytest.mark.long
def test_c2_killed_as_its_store_grows_has_each_once(coast: Coast) -> None:
    coast.owe([make_image(n) for n in range(COUNT)])
    wal = coast.shore_state / "c2.db-wal"
    for kill in range(6):
        coast.until(lambda kill=kill: coast.ashore_count() >= kill * COUNT // 8, 60, "some more ashore")
        size = wal.stat().st_size
        coast.until(lambda size=size: wal.stat().st_size != size or coast.settled(), 60, "c2 writes")
        coast.kill("c2")
        coast.start("c2")
        coast.until(wal.is_file, 30, "c2 has opened its store")
    coast.assert_all_ashore_once()


@pytest.mark.parametrize("seconds", [20.0, pytest.param(300.0, marks=[pytest.mark.long, pytest.mark.timeout(700)])])
def test_everything_killed_at_random_loses_and_doubles_nothing(coast: Coast, seconds: float) -> None:
    rng = random.Random(int(seconds))
    count = int(COUNT * max(1.0, seconds / 60))
    began_s = time.monotonic()
    order: list[str] = []
    kills = 0
    while (spent_s := time.monotonic() - began_s) < seconds:
        done, wanted = len(coast.expected), min(count, 5 + int(count * spent_s / seconds))
        shape = rng.choice([(24, 32), (60, 80), (150, 300)])
        coast.owe([make_image(n, shape) for n in range(done, wanted)])
        # Each in turn, in an order that changes; sometimes while it or another one still starts.
        order = order or rng.sample(PROCESSES, len(PROCESSES))
        name = order.pop()
        time.sleep(rng.uniform(0.05, 1.0))
        coast.kill(name)
        kills += 1
        time.sleep(rng.uniform(0.0, 0.3))
        coast.start(name)
        time.sleep(rng.uniform(0.2, 2.5))
    coast.owe([make_image(n) for n in range(len(coast.expected), count)])
    assert kills >= len(PROCESSES)
    coast.assert_all_ashore_once(240)
