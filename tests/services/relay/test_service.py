"""relay: records of the vessel in envelopes, urgent ones first, stored until the shore has acknowledged them."""

import msgpack
import zenoh
from builders.common import eventually
from builders.image_source import make_image
from builders.record_samples import SAMPLES
from builders.records import decision_record

from sonarpost import keys, logs, wire
from sonarpost.archive.image_parts import whole_part
from sonarpost.messages import ImagePart
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

IMAGES, DECISIONS = keys.image_coded("vessel-1"), keys.contact_decision("vessel-1")
INBOX = keys.shore_inbox("vessel-1")


def image(image_id="AAAA", vessel="vessel-1"):
    changes = {"vessel_id": vessel, "vehicle_id": "uuv-1", "image_id": image_id}
    return make_image(1, (80, 140)).model_copy(update=changes)


def identity(record):
    """Identifier of a received image or decision; the type of another record."""
    if isinstance(record, ImagePart):
        return record.i
    fields = msgpack.unpackb(record.payload)
    return fields.get("decision_id", fields["type"])


def test_decision_is_relayed_unchanged_in_an_envelope_and_an_image_as_part(begin, c2, source, watch, check_monitoring):
    seen, shore, service = watch(INBOX), c2(), begin()
    source.send(DECISIONS, "relay", decision_record())
    eventually(lambda: len(shore.received) == 1)
    source.send(IMAGES, "relay", image())
    eventually(lambda: len(shore.received) == 2)
    envelope, part = shore.received
    assert (envelope.vessel_id, envelope.key) == ("vessel-1", DECISIONS)
    assert envelope.payload == wire.encode(decision_record())
    assert envelope.relayed_utc_s >= service.health().started_utc_s
    assert part == whole_part(image())
    eventually(lambda: service.health().gauges["waiting_for_shore"] == 0.0)
    counters = service.health().counters
    assert (counters["coded_images_relayed"], counters["decisions_relayed"]) == (1, 1)
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
        service._handler.handle_batch(items)
        service.store.close()
        lines = [line for line in capsys.readouterr().err.splitlines() if "queued for the shore" in line]
        assert [line.split()[1] for line in lines] == (["DEBUG"] * 2 if level == "debug" else []) + ["INFO"]
        assert "Records queued for the shore first=uuv-1/" in lines[-1]
        assert lines[-1].endswith(" decisions_relayed=2")


def test_records_wait_for_the_shore_and_decisions_are_first(begin, runner, c2, source):
    service = begin()
    source.send(IMAGES, "relay", *(image(f"{n:04d}") for n in range(3)))
    eventually(lambda: service.health().gauges["waiting_for_shore"] == 3.0)
    source.send(DECISIONS, "relay", decision_record("d1"), decision_record("d2"))
    eventually(lambda: service.health().gauges["waiting_for_shore"] == 5.0)
    runner.stop(service)
    shore = c2()
    begin()
    eventually(lambda: len(shore.received) == 5)
    assert [identity(record) for record in shore.received] == ["d1", "d2", "0000", "0001", "0002"]


def test_record_of_another_vessel_is_refused_to_its_sender_and_logged(begin, c2, source, refused, capsys):
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


def test_record_is_relayed_once_after_a_stop_before_sending(begin, runner, c2, platform):
    idle = RelayService(platform("vessel-1"), RelayConfig())
    with idle.store.transaction() as tx:
        tx.accept(IMAGES, wire.encode(image()))
    idle.store.close()
    service = begin()
    eventually(lambda: service.health().gauges["waiting_for_shore"] == 1.0)
    runner.stop(service)
    shore, again = c2(), begin()
    # The shore site acknowledges a record before it handles it.
    eventually(lambda: again.health().gauges["waiting_for_shore"] == 0.0 and shore.received)
    assert [identity(record) for record in shore.received] == ["AAAA"]


def test_sender_keeps_the_record_while_the_disk_is_full(begin, c2, source):
    shore, service = c2(), begin()
    service.store._db.execute("PRAGMA max_page_count=1")
    source.send(IMAGES, "relay", *(image(f"{n:04d}") for n in range(6)))
    eventually(lambda: service.health().state == "degraded")
    assert source.store.outbox_depth() > 0
    service.store._db.execute("PRAGMA max_page_count=1000000")
    eventually(lambda: len(shore.received) == 6)
    eventually(lambda: service.health().state == "ok")


def test_latest_status_of_each_vehicle_waits_for_the_shore_and_precedes_images(begin, runner, c2, source, client):
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
    assert [identity(record) for record in shore.received] == ["received_status", "received_status", "AAAA"]
    inner = [msgpack.unpackb(envelope.payload) for envelope in shore.received[:2]]
    last_s = 1476262830.5 + published - 1
    assert {m["vehicle_id"]: m["received_utc_s"] for m in inner} == {"uuv-0": last_s - 1, "uuv-1": last_s}


def test_statuses_are_not_relayed_if_configured(begin):
    assert keys.acoustic_status("vessel-1") not in begin(forward_status=False).consumed_keys()
