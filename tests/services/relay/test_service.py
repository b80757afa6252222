"""relay: records of the vessel in envelopes, urgent ones first, stored until the shore has acknowledged them."""

import msgpack
import pytest
import zenoh
from builders.common import eventually
from builders.record_samples import SAMPLES
from builders.records import decision_record, reconstructed_image

from sonarpost import keys, logs, wire
from sonarpost.messages import Pixels
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

IMAGES, DECISIONS = keys.image_reconstructed("vessel-1"), keys.contact_decision("vessel-1")
INBOX = keys.shore_inbox("vessel-1")


@pytest.fixture
def image(texture):
    def make(image_id="AAAA", vessel="vessel-1"):
        return reconstructed_image(Pixels.from_array(texture()), vessel_id=vessel, image_id=image_id)

    return make


def test_records_are_relayed_unchanged_in_an_envelope(begin, c2, source, image, watch, check_monitoring):
    seen, shore, service = watch(INBOX), c2(), begin()
    records = {IMAGES: image(), DECISIONS: decision_record()}
    for key, record in records.items():
        source.send(key, "relay", record)
    eventually(lambda: len(shore.received) == 2)
    for envelope in shore.received:
        assert envelope.vessel_id == "vessel-1"
        assert envelope.payload == wire.encode(records[envelope.key])
        assert envelope.relayed_utc_s >= service.started_utc_s
    eventually(lambda: service.health().gauges["waiting_for_shore"] == 0.0)
    counters = service.health().counters
    assert (counters["reconstructed_images_relayed"], counters["decisions_relayed"]) == (1, 1)
    check_monitoring(service)
    assert seen == [], "envelopes are not published"


def test_a_batch_is_one_line_and_each_record_has_its_own_at_level_debug(platform, capsys):
    for level in ("info", "debug"):
        service = RelayService(platform("vessel-1"), RelayConfig())
        with service.store.transaction() as tx:
            for name in ("d1", "d2"):
                tx.accept(DECISIONS, wire.encode(decision_record(name)))
        logs.configure_logging("relay", level)
        items = service.store.inbox_items(2)
        service._handle_batch(items)
        service.store.close()
        lines = [line for line in capsys.readouterr().err.splitlines() if "queued for the shore" in line]
        assert [line.split()[1] for line in lines] == (["DEBUG"] * 2 if level == "debug" else []) + ["INFO"]
        assert "Records queued for the shore first=uuv-1/" in lines[-1]
        assert lines[-1].endswith(" decisions_relayed=2")


def test_records_wait_for_the_shore_and_decisions_are_first(begin, runner, c2, source, image):
    service = begin()
    source.send(IMAGES, "relay", *(image(f"{n:04d}") for n in range(3)))
    eventually(lambda: service.health().gauges["waiting_for_shore"] == 3.0)
    source.send(DECISIONS, "relay", decision_record("d1"), decision_record("d2"))
    eventually(lambda: service.health().gauges["waiting_for_shore"] == 5.0)
    runner.stop(service)
    shore = c2()
    begin()
    eventually(lambda: len(shore.received) == 5)
    inner = [msgpack.unpackb(e.payload) for e in shore.received]
    assert [m.get("decision_id", m["image_id"]) for m in inner] == ["d1", "d2", "0000", "0001", "0002"]


def test_record_of_another_vessel_is_refused_to_its_sender_and_logged(begin, c2, source, image, refused, capsys):
    logs.configure_logging("relay")
    shore, service = c2(), begin()
    source.send(IMAGES, "relay", image("00A7", vessel="vessel-2"))
    source.send(DECISIONS, "relay", decision_record("strange", vessel_id="vessel-2"))
    source.send(DECISIONS, "relay", decision_record("own"))
    eventually(lambda: len(shore.received) == 1)
    assert msgpack.unpackb(shore.received[0].payload)["decision_id"] == "own"
    eventually(lambda: len(refused(source)) == 2)
    assert all("vessel_id: got 'vessel-2', expected vessel-1" in reason for _, reason in refused(service))
    assert service.health().counters["records_refused"] == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "Record refused vehicle=" in line]
    assert "vehicle=uuv-1 image_id=00A7" in lines[0]


def test_invalid_records_are_refused_and_the_next_one_relayed(begin, c2, source, refused):
    shore, service = c2(), begin()
    invalid = [b"", b"\xff", msgpack.packb({"type": "decision", "v": 1}), wire.encode(decision_record())[:-1]]
    for payload in invalid:
        source.send_bytes(DECISIONS, "relay", payload)
    source.send(DECISIONS, "relay", decision_record())
    eventually(lambda: len(shore.received) == 1)
    assert [key for key, _ in refused(service)] == [DECISIONS] * len(invalid)
    assert all("expected" in reason for _, reason in refused(service))
    assert service.health().state == "ok"


def test_record_is_relayed_once_after_a_stop_before_sending(begin, runner, c2, platform, image):
    idle = RelayService(platform("vessel-1"), RelayConfig())
    with idle.store.transaction() as tx:
        tx.accept(IMAGES, wire.encode(image()))
    idle.store.close()
    service = begin()
    eventually(lambda: service.health().gauges["waiting_for_shore"] == 1.0)
    runner.stop(service)
    shore, again = c2(), begin()
    eventually(lambda: again.health().gauges["waiting_for_shore"] == 0.0)
    assert [e.key for e in shore.received] == [IMAGES]


def test_sender_keeps_the_record_while_the_disk_is_full(begin, c2, source, image):
    shore, service = c2(), begin()
    service.store._db.execute("PRAGMA max_page_count=1")
    source.send(IMAGES, "relay", *(image(f"{n:04d}") for n in range(6)))
    eventually(lambda: service.health().state == "degraded")
    assert source.store.outbox_depth() > 0
    service.store._db.execute("PRAGMA max_page_count=1000000")
    eventually(lambda: len(shore.received) == 6)
    eventually(lambda: service.health().state == "ok")


def test_latest_status_of_each_vehicle_waits_for_the_shore_and_precedes_images(
    begin, runner, c2, source, image, client
):
    service = begin()
    source.send(IMAGES, "relay", image("AAAA"))
    key, first = keys.acoustic_status("vessel-1"), SAMPLES["received-status"]
    publisher = client.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    eventually(lambda: publisher.matching_status.matching)
    published = 0

    def only_the_latest_wait():
        nonlocal published
        for _ in range(20):
            vehicle = f"uuv-{published % 2}"
            status = first.status.model_copy(update={"vehicle_id": vehicle})
            record = first.model_copy(
                update={"vehicle_id": vehicle, "status": status, "received_utc_s": 1476262830.5 + published}
            )
            publisher.put(wire.encode(record), encoding=wire.encoding_of(type(record)))
            published += 1
        eventually(lambda: service.health().counters.get("statuses_relayed") == published)
        return service.health().gauges["waiting_for_shore"] == 3.0

    eventually(only_the_latest_wait)  # one that is being sent is replaced by the next after its attempt
    publisher.put(wire.encode(first.model_copy(update={"vessel_id": "vessel-2"})))
    eventually(lambda: service.health().counters.get("records_refused") == 1)
    runner.stop(service)
    shore = c2()
    begin()
    eventually(lambda: len(shore.received) == 3)
    inner = [msgpack.unpackb(e.payload) for e in shore.received]
    assert [m["type"] for m in inner] == ["received_status", "received_status", "reconstructed_image"]
    last_s = 1476262830.5 + published - 1
    assert {m["vehicle_id"]: m["received_utc_s"] for m in inner[:2]} == {"uuv-0": last_s - 1, "uuv-1": last_s}


def test_statuses_are_not_relayed_if_configured(begin):
    assert keys.acoustic_status("vessel-1") not in begin(forward_status=False).consumed_keys()
