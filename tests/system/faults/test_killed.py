"""Processes of vessel and shore are killed (SIGKILL) at critical moments; every image arrives exactly once.

`SONARPOST_KILLS` sets the number of random kills (16).
"""

import os
import random

import pytest
from builders.image_source import make_image
from builders.vessel_and_shore import PROCESSES

COUNT = 200
KILLS = int(os.environ.get("SONARPOST_KILLS", "16"))


def test_killed_routers_lose_nothing(system):
    for part, router in enumerate(("router-vessel", "router-shore", "router-vessel", "router-shore")):
        first = 50 * part
        system.send([make_image(n) for n in range(first, first + 50)])
        system.wait_until(lambda first=first: system.shore_image_count() >= first + 5, "first images at the shore")
        system.kill(router)
        system.start(router)
    system.assert_all_delivered_once()


def test_relay_killed_during_an_image_resumes(start_system):
    # 45 kB need two chunks; the slow link takes 0.2 s for one, in which the relay is killed.
    system = start_system(link_bytes_per_s=150_000)
    interrupted = 0
    while interrupted < 3:
        number = len(system.expected)
        system.send([make_image(number, shape=(150, 300))])

        def has_arrived(number=number):
            return bool(system.query("c2", "SELECT COUNT(*) FROM partial")) or system.shore_image_count() > number

        system.wait_until(has_arrived, "a part of an image")
        system.kill("relay")
        interrupted += bool(system.query("c2", "SELECT SUM(has) FROM partial"))  # else the rest arrived before the kill
        system.start("relay")
        system.wait_until(lambda number=number: system.shore_image_count() > number, "the relay continues")
    system.assert_all_delivered_once()
    assert system.depths("c2")["partial"] == 0


def test_c2_killed_before_the_acknowledgement_stores_each_image_once(system):
    link = system.link
    system.send([make_image(n) for n in range(20)])
    system.assert_all_delivered_once()
    for first in (20, 80):
        # No data returns from the shore: commits of c2 are not acknowledged from now on.
        link.stall("down")
        system.send([make_image(n) for n in range(first, first + 60)])
        system.wait_until(lambda first=first: (system.accepted_count("c2") or 0) > first, "c2 has committed")
        system.kill("c2")
        system.wait_until(lambda: system.depths("relay")["outbox"] == 60, "all are queued, also what c2 has committed")
        link.reset()
        link.mend()
        system.start("c2")
        system.assert_all_delivered_once()


def test_c2_killed_while_its_store_grows_stores_each_image_once(system):
    system.send([make_image(n) for n in range(COUNT)])
    wal = system.shore_state / "c2.db-wal"

    def log_bytes():
        """Return the size of the write-ahead log, 0 until c2 has opened its store."""
        try:
            return wal.stat().st_size
        except FileNotFoundError:
            return 0

    for kill in range(6):
        system.wait_until(lambda kill=kill: system.shore_image_count() >= kill * COUNT // 8, "more images")
        size = log_bytes()
        system.wait_until(lambda size=size: log_bytes() != size or system.is_complete(), "c2 writes")
        system.kill("c2")
        system.start("c2")
    system.assert_all_delivered_once()


@pytest.mark.timeout(1800 + 30 * KILLS)
def test_random_kills_of_all_processes_lose_and_duplicate_nothing(system):
    rng = random.Random(KILLS)
    order = []
    for _ in range(KILLS):
        first = len(system.expected)
        shape = rng.choice([(24, 32), (60, 80), (150, 300)])
        system.send([make_image(n, shape) for n in range(first, first + rng.randrange(4, 12))])
        # A random number of images later, none while a process is still starting; each process in a changing order.
        wanted = min(system.shore_image_count() + rng.choice((0, 1, 2, 8, 20)), len(system.expected))
        system.wait_until(lambda wanted=wanted: system.shore_image_count() >= wanted, "images at the shore")
        order = order or rng.sample(PROCESSES, len(PROCESSES))
        name = order.pop()
        system.kill(name)
        system.start(name)
    system.assert_all_delivered_once()
