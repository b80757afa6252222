"""atd_stub behind a full acoustic queue: the most confident contacts first, never too many, none lost."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time

import numpy as np
import pytest
from builders.common import REPOSITORY, eventually

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.messages import Contact, Health, Pixels, QueuedImage, QueueState, Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.pool import ContactPool
from sonarpost.services.atd_stub.service import AtdStubService
from sonarpost.services.atd_stub.way import STALE_S, WayToTheWater
from sonarpost.sonar.image_files import write_tiff

KEY = keys.contact_detected("uuv-1")


def report(service, **gauges):
    return Health(
        platform_id="uuv-1",
        service=service,
        time_utc_s=1.0,
        started_utc_s=1.0,
        state="ok",
        counters={},
        gauges={name: float(value) for name, value in gauges.items()},
    )


def queue_of(images, *bytes_left):
    return QueueState(
        platform_id="uuv-1",
        time_utc_s=1.0,
        rate=1,
        frame_loss=None,
        packet_interval_s=5.0,
        messages_waiting=0,
        message_bytes=0,
        images_waiting=images,
        images=tuple(
            QueuedImage(image_id=f"{n:04d}", contact_id="c", bytes_left=left, preview_utc_s=None, expected_utc_s=1.0)
            for n, left in enumerate(bytes_left)
        ),
    )


# What is on the way


@pytest.fixture
def way():
    return WayToTheWater(11.0, 1000.0, is_first_run=True)


def test_what_waits_anywhere_on_the_way_counts(way):
    assert way.on_the_way(3, 1000.0) == 3
    way.heard_health(report("compressor", inbox=2, outbox=1), 1001.0)
    way.heard_health(report("uuv_modem", inbox=1, messages_waiting=7), 1001.0)
    way.heard_queue(queue_of(20), 1001.0)
    assert way.on_the_way(3, 1001.0) == 3 + 2 + 1 + 1 + 20
    assert way.room(3, 32, 1001.0) == 5
    assert way.room(3, 20, 1001.0) == 0


def test_what_was_taken_counts_until_every_report_has_it(way):
    way.heard_health(report("compressor", inbox=0), 1001.0)
    way.heard_health(report("uuv_modem", inbox=0, messages_waiting=0), 1001.0)
    way.heard_queue(queue_of(0), 1001.0)
    for _ in range(4):
        way.taken(1002.0)
    assert way.on_the_way(0, 1002.0) == 4
    way.heard_health(report("compressor", inbox=3), 1006.0)
    assert way.on_the_way(0, 1006.0) == 7, "rather counted twice than not"
    way.heard_health(report("uuv_modem", inbox=1, messages_waiting=0), 1006.0)
    assert way.on_the_way(0, 1006.0) == 8
    way.heard_queue(queue_of(1), 1007.0)
    assert way.on_the_way(0, 1007.0) == 5


def test_pictures_of_which_nothing_is_left_have_gone(way):
    way.heard_queue(queue_of(3, 64, 0, 1), 1000.0)
    assert way.on_the_way(0, 1000.0) == 2
    way.heard_queue(queue_of(503, *[1] * 500), 1001.0)
    assert way.on_the_way(0, 1001.0) == 503


def test_without_reports_what_was_taken_lately_counts(way):
    for at in (1000.0, 1005.0, 1010.0):
        way.taken(at)
    assert way.on_the_way(1, 1010.0) == 4
    assert way.on_the_way(0, 1017.0) == 1
    assert way.on_the_way(0, 1030.0) == 0


def test_a_service_that_has_gone_for_good_counts_no_more(way):
    way.heard_health(report("compressor", inbox=0), 1000.0)
    way.heard_health(report("uuv_modem", inbox=40), 1000.0)
    assert way.room(0, 32, 1000.0 + STALE_S - 1) == 0
    assert way.room(0, 32, 1000.0 + STALE_S + 1) == 32


def test_the_papers_link_has_no_queue(way):
    way.heard_queue(queue_of(40), 1000.0)
    way.heard_health(report("uuv_modem", inbox=2, messages_waiting=0), 1000.0)
    assert way.on_the_way(0, 1000.0) == 42
    way.heard_health(report("uuv_modem", inbox=2), 1001.0)
    assert way.on_the_way(0, 1001.0) == 2


def test_after_a_restart_nothing_sets_out_before_the_reports_are_there():
    way = WayToTheWater(11.0, 1000.0, is_first_run=False)
    assert way.room(0, 32, 1001.0) == 0
    assert way.room(0, 32, 1011.0) == 32, "or nobody reports"
    way.heard_health(report("compressor", inbox=0), 1002.0)
    assert way.room(0, 32, 1002.0) == 0
    way.heard_health(report("uuv_modem", inbox=30), 1002.0)
    assert way.room(0, 32, 1002.0) == 2


# The pool


def snippet(name, confidence):
    picture = Pixels.from_array(np.full((16, 16), 7, np.uint8))
    return Snippet(contact=Contact(contact_id=name, vehicle_id="uuv-1", atd_confidence=confidence), picture=picture)


def commit(store, effects):
    with store.transaction() as tx:
        effects.write(tx)


def test_the_pool_gives_the_most_confident_first_and_survives(tmp_path):
    store = Store(tmp_path / "pool.db")
    pool = ContactPool(store)
    wanted = [("c", 1.9), ("a", 1.5), ("d", 1.5), ("e", 1.25), ("b", 0.0), ("f", None), ("g", None)]
    for name, confidence in sorted(wanted):
        effects = UnitOfWork()
        committed = pool.add(effects, [wire.encode(snippet(name, confidence))])
        commit(store, effects)
        committed()
    got = []
    for most in (1, 3, 2, 9):
        effects = UnitOfWork()
        count, committed = pool.release(effects, most, lambda _, payload: got.append(payload))
        commit(store, effects)
        committed()
        assert count == min(most, len(wanted) - (len(got) - count))
        pool = ContactPool(store)
        assert len(pool) == len(wanted) - len(got)
    assert [wire.decode(Snippet, each, "got").contact.contact_id for each in got] == [name for name, _ in wanted]
    store.close()


# The service


@pytest.fixture
def begin(runner, platform, tmp_path):
    def start(**changes):
        config = AtdStubConfig(mode="snippets", input_dir=tmp_path / "incoming", poll_s=0.02, settle_s=0.0, **changes)
        return runner.start(AtdStubService(platform("uuv-1"), config))

    return start


@pytest.fixture
def put_pictures(tmp_path, texture):
    """Pictures whose text files say how sure the detector was; in the order of their names."""
    folder = tmp_path / "incoming"
    folder.mkdir()

    def put(confidences):
        for number, confidence in enumerate(confidences):
            (folder / f"p{number:03d}.txt").write_text(f"contact_id: p{number:03d}\natd_confidence: {confidence}\n")
            hidden = folder / f".p{number:03d}.tiff"
            write_tiff(hidden, texture(seed=number))
            hidden.rename(folder / f"p{number:03d}.tiff")

    return put


@pytest.fixture
def slow_compressor(runner):
    """A compressor that takes everything into its inbox and handles one record a permit."""
    compressor = runner.peer("uuv-1", "compressor", {KEY: Snippet})
    compressor.permits = 0

    def handle(key, record, effects):
        if compressor.permits <= 0:
            raise OSError("busy with an image")
        compressor.permits -= 1
        compressor.received.append(record)

    compressor.handle = handle
    return compressor


def test_the_most_confident_go_first_and_never_too_many_are_on_the_way(begin, slow_compressor, put_pictures):
    confidences = random.Random(3).sample([n / 10 for n in range(20)], 8)
    put_pictures(confidences)
    service = begin(max_in_flight=2)
    eventually(lambda: service.health().counters.get("contacts_detected") == 8)
    eventually(lambda: slow_compressor.store.inbox_depth() == 2)
    eventually(lambda: service.health().gauges["contacts_on_the_way"] == 2)
    assert service.health().gauges["contacts_waiting"] == 6
    assert service.health().state == "ok"
    assert "6 contacts wait" in service.health().detail
    for number in range(1, 9):
        slow_compressor.permits = 1
        eventually(lambda number=number: len(slow_compressor.received) == number)
        left = min(2, 8 - number)
        eventually(lambda left=left: slow_compressor.store.inbox_depth() == left)
    got = [s.contact.atd_confidence for s in slow_compressor.received]
    assert sorted(got) == sorted(confidences)
    assert got[2:] == sorted(got[2:], reverse=True), "the first two went before the others were known"


def test_a_full_acoustic_queue_holds_contacts_over_a_restart(begin, runner, put_pictures, client):
    compressor = runner.peer("uuv-1", "compressor", {KEY: Snippet})
    modem = runner.peer("uuv-1", "uuv_modem")
    modem.gauges = lambda: {"messages_waiting": 0.0}
    put_pictures([1.0])
    service = begin(max_in_flight=3)
    eventually(lambda: len(compressor.received) == 1)
    full = wire.encode(queue_of(3))

    def tell(payload):
        client.put(keys.acoustic_queue("uuv-1"), payload)
        return True

    eventually(lambda: tell(full) and service.health().gauges["contacts_on_the_way"] >= 3)
    put_pictures([1.0, 0.5, 1.5])
    eventually(lambda: service.health().gauges["contacts_waiting"] == 2)
    runner.stop(service)
    service = begin(max_in_flight=3)
    eventually(lambda: tell(full) and service.health().gauges["contacts_on_the_way"] >= 3)
    assert service.health().gauges["contacts_waiting"] == 2
    assert len(compressor.received) == 1
    empty = wire.encode(queue_of(2))
    eventually(lambda: tell(empty) and len(compressor.received) == 2)
    empty = wire.encode(queue_of(0))
    eventually(lambda: tell(empty) and len(compressor.received) == 3)
    assert [s.contact.atd_confidence for s in compressor.received] == [1.0, 1.5, 0.5]


def test_a_report_that_is_none_is_left_out(begin, runner, put_pictures, publish, caplog):
    compressor = runner.peer("uuv-1", "compressor", {KEY: Snippet})
    service = begin()
    publish(keys.acoustic_queue("uuv-1"), b"\xc1")
    publish(keys.health("uuv-1", "uuv_modem"), b"no report")
    eventually(lambda: sum(r.message == "A report is left out" for r in caplog.records) == 2)
    put_pictures([1.0])
    eventually(lambda: len(compressor.received) == 1)
    assert not service.failed


def test_killed_again_and_again_it_sends_every_contact_once(runner, router, tmp_path, put_pictures):
    pictures, kills = 40, 3
    put_pictures([round(random.Random(n).uniform(0, 2), 3) for n in range(pictures)])
    compressor = runner.peer("uuv-1", "compressor", {KEY: Snippet})
    config = tmp_path / "uuv.toml"
    config.write_text(
        f'[platform]\nid = "uuv-1"\nrouter = ["{router}"]\nstate_dir = "{tmp_path / "vehicle"}"\n'
        f'health_interval_s = 0.1\n[atd_stub]\nmode = "snippets"\ninput_dir = "{tmp_path / "incoming"}"\n'
        "poll_s = 0.05\nsettle_s = 0.0\nmax_in_flight = 8\n"
    )
    rng = random.Random(5)
    command = [sys.executable, "-m", "sonarpost.services.atd_stub", "--config", str(config)]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "common")}
    for life in range(kills + 1):
        process = subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.DEVNULL, env=environment)
        try:
            # A little further each time, and then somewhere within what it does next.
            wanted = pictures if life == kills else (life + 1) * pictures // (kills + 2)
            eventually(lambda wanted=wanted: len(compressor.received) >= wanted)
            time.sleep(rng.uniform(0, 0.02))
        finally:
            process.kill()
            process.wait()
    assert sorted(s.contact.contact_id for s in compressor.received) == [f"p{n:03d}" for n in range(pictures)]
