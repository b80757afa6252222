"""Producer whose store is restored from an older copy: numbers are assigned again, nothing is lost or doubled."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from builders.common import eventually
from builders.records import decision_record

from sonarpost import keys
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Decision, Record
from sonarpost.runtime.service import Service, UnitOfWork

KEY = keys.contact_decision("vessel-1")
PlatformMaker = Callable[[str], PlatformConfig]


class Producer(Service[ServiceConfig]):
    """Queues decisions."""

    NAME = "producer"

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        raise AssertionError("consumes nothing")

    def send(self, *names: str) -> None:
        effects = UnitOfWork()
        for name in names:
            effects.send(KEY, "consumer", decision_record(name))
        self.commit(effects)


class Consumer(Service[ServiceConfig]):
    """Counts the received decisions."""

    NAME = "consumer"

    def __init__(self, platform: PlatformConfig, config: ServiceConfig) -> None:
        super().__init__(platform, config)
        self.got: Counter[str] = Counter()

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        return {KEY: Decision}

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        assert isinstance(record, Decision)
        self.got[record.decision_id] += 1


def origins(producer: Producer) -> set[bytes]:
    return {bytes(row[0]) for row in producer.store._query("SELECT origin FROM outbox_next")}


def wait_until_delivered(producer: Producer) -> None:
    eventually(lambda: producer.store.outbox_depth() == 0, timeout_s=120)


def names(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}{number}" for number in range(count))


@pytest.mark.parametrize("queued_in_copy", [0, 100])
@pytest.mark.parametrize("after_restore", [10, 120])
def test_restored_store_loses_and_doubles_nothing(
    platform: PlatformMaker, caplog: pytest.LogCaptureFixture, queued_in_copy: int, after_restore: int
) -> None:
    """270 records with a copy of 100 in between; the same with an empty copy, and with fewer new records."""
    made = platform("vessel-1")
    consumer = Consumer(made, ServiceConfig())
    consumer.start()
    producer = Producer(made, ServiceConfig())
    producer.start()
    producer.send(*names("early", 50))
    wait_until_delivered(producer)
    producer.stop()
    producer = Producer(made, ServiceConfig())
    if queued_in_copy:
        producer.send(*names("copied", queued_in_copy))
    producer.stop()
    state = Path(made.state_dir)
    copy = state.parent / "copy"
    copy.mkdir()
    for path in state.glob("producer.db*"):
        shutil.copy2(path, copy)

    producer = Producer(made, ServiceConfig())
    producer.start()
    producer.send(*names("late", 100))
    wait_until_delivered(producer)
    producer.stop()
    for path in state.glob("producer.db*"):
        path.unlink()
    for path in copy.iterdir():
        shutil.copy2(path, state)

    producer = Producer(made, ServiceConfig())
    before = origins(producer)
    producer.send(*names("new", after_restore))
    producer.start()
    try:
        wait_until_delivered(producer)
        expected = Counter([*names("early", 50), *names("copied", queued_in_copy), *names("late", 100)])
        expected += Counter(names("new", after_restore))
        eventually(lambda: consumer.got.total() >= expected.total(), timeout_s=120)
        assert consumer.got == expected
        assert "Store is older than its last delivery" in caplog.text
        assert "producer.db is older than its last delivery to consumer" in producer.health().detail
        assert origins(producer) != before
        producer.send("after")
        eventually(lambda: consumer.got["after"] == 1)
    finally:
        producer.stop()
        consumer.stop()


def test_restart_without_a_restore_keeps_the_origin(platform: PlatformMaker, caplog: pytest.LogCaptureFixture) -> None:
    made = platform("vessel-1")
    consumer = Consumer(made, ServiceConfig())
    consumer.start()
    seen = set()
    for number in range(3):
        producer = Producer(made, ServiceConfig())
        producer.start()
        producer.send(*names(f"{number}-", 5))
        wait_until_delivered(producer)
        seen |= origins(producer)
        assert producer.health().detail == ""
        producer.stop()
    consumer.stop()
    assert len(seen) == 1
    assert consumer.got.total() == 15
    assert "older than" not in caplog.text
