"""The relay is killed (SIGKILL) repeatedly with two sites; each site receives every record exactly once."""

import hashlib
import os
import random
import subprocess
import sys
import time

import msgpack
import pytest
from builders.common import REPOSITORY, eventually
from builders.history import History
from builders.records import decision_record

from sonarpost import keys, wire
from sonarpost.messages import Relayed

RECORDS = 400
KILLS = 3


@pytest.fixture
def relay_process(router, tmp_path):
    """Starts the relay as a separate process on a persistent store."""
    config = tmp_path / "vessel.toml"
    config.write_text(
        f'[platform]\nid = "vessel-1"\nrouter = ["{router}"]\nstate_dir = "{tmp_path / "relay"}"\n'
        '[[relay.upstreams]]\nsite = "shore"\n[[relay.upstreams]]\nsite = "shore-2"\n'
    )
    running = []

    def start():
        process = subprocess.Popen(
            [sys.executable, "-m", "sonarpost.services.relay", "--config", str(config)],
            cwd=REPOSITORY,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY / "common")},
        )
        running.append(process)
        return process

    yield start
    for process in running:
        process.kill()
        process.wait()


def test_every_site_receives_every_record_once_if_the_relay_is_killed(runner, relay_process, tmp_path):
    first = runner.peer("shore-1", "c2", {keys.shore_inbox_all("shore"): Relayed})
    second = runner.peer("shore-2", "c2", {keys.shore_inbox_all("shore-2"): Relayed})
    console = runner.peer("vessel-1", "console")
    history = History(tmp_path / "history.jsonl")
    decisions = [decision_record(f"d{n}") for n in range(RECORDS)]
    console.send(keys.contact_decision("vessel-1"), "relay", *decisions)
    for decision in decisions:
        sha256 = hashlib.sha256(wire.encode(decision)).hexdigest()
        history.add("queued", "console", decision.decision_id, sha256=sha256)
    rng = random.Random(7)
    for kill in range(1, KILLS + 1):
        process = relay_process()
        # A little later each time, at a random point of the next batches.
        eventually(lambda kill=kill: len(first.received) >= kill * RECORDS // (KILLS + 2), timeout_s=120)
        time.sleep(rng.uniform(0, 0.02))
        history.fault("relay", "SIGKILL")
        process.kill()
        process.wait()
    relay_process()
    eventually(lambda: console.store.outbox_depth() == 0)
    for name, site in (("shore", first), ("shore-2", second)):
        eventually(lambda site=site: len(site.received) >= RECORDS, timeout_s=120)
        history.add("consumer", name)
        for envelope in site.received:
            sha256 = hashlib.sha256(envelope.payload).hexdigest()
            history.add("handled", name, msgpack.unpackb(envelope.payload)["decision_id"], sha256=sha256)
    history.close()
    assert history.verdict().ok, history.verdict()
