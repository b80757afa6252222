"""The relay of the benchmarks: which image, which size and which time an acknowledgement is recorded with."""

import hashlib

import pytest

from research.recording_relay import FILE_NAME, RecordingRelay, acknowledged
from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import OutboxItem
from sonarpost.messages import Decision, ImagePart, Record, Relayed
from sonarpost.services.relay.config import RelayConfig

QUEUED_UTC_S = 1_700_000_000.5


@pytest.fixture
def relay(tmp_path):
    made = RecordingRelay(PlatformConfig(id="vessel-1", router=("tcp/127.0.0.1:1",), state_dir=tmp_path), RelayConfig())
    yield made
    made.stop()


def item_of(seq: int, key: str, record: Record) -> OutboxItem:
    payload = wire.encode(record)
    return OutboxItem("c2", seq, key, "", 5, payload, hashlib.sha256(payload).digest())


def envelope_of(record: Record, key: str) -> Relayed:
    return Relayed(vessel_id="vessel-1", key=key, payload=wire.encode(record), relayed_utc_s=1.0)


def acknowledge(relay: RecordingRelay, *items: OutboxItem) -> None:
    with relay.store.transaction() as tx:
        for item in items:
            relay.on_acknowledged(tx, item, None)


def test_images_are_recorded_with_their_size_and_time(relay, tmp_path) -> None:
    part = ImagePart(u="uuv-1", i="0001", n=2, t=QUEUED_UTC_S - 2.0, d=2 << 22, p=bytes(40))
    exact = ImagePart(u="uuv-2", i="0002", n=1, t=QUEUED_UTC_S - 2.0, l=QUEUED_UTC_S, p=bytes(40))
    items = [item_of(seq, keys.shore_part("vessel-1"), record) for seq, record in enumerate((part, exact), start=1)]
    acknowledge(relay, *items)
    first, second = acknowledged(tmp_path)
    assert (first["image_id"], first["version"], first["bytes"]) == ("0001", 2, len(items[0].payload))
    assert (second["image_id"], second["version"], second["bytes"]) == ("0002", 1, len(items[1].payload))
    assert first["queued_utc_s"] == second["queued_utc_s"] == QUEUED_UTC_S
    assert not first["refused"]


def test_a_record_that_is_acknowledged_twice_counts_once_and_decisions_do_not(relay, tmp_path) -> None:
    part = item_of(1, keys.shore_part("vessel-1"), ImagePart(u="uuv-1", i="0001", n=1, t=QUEUED_UTC_S, p=bytes(40)))
    acknowledge(relay, part)
    acknowledge(relay, part)
    assert len((tmp_path / FILE_NAME).read_text().splitlines()) == 2
    assert [entry["seq"] for entry in acknowledged(tmp_path)] == [1]
    names = {"vessel_id": "vessel-1", "vehicle_id": "uuv-1", "image_id": "0001", "image_version": 1}
    made = Decision(decision_id="d-1", verdict="unsure", operator="op", decided_utc_s=1.0, **names)
    acknowledge(relay, item_of(2, keys.shore_inbox("vessel-1"), envelope_of(made, "k")))
    assert [entry["seq"] for entry in acknowledged(tmp_path)] == [1]
