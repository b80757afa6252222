"""relay with several sites: queue, session, bandwidth limit and quota of each, and unreachable sites."""

from collections import namedtuple

import msgpack
import pytest
import zenoh
from builders.common import eventually, free_port
from builders.image_source import make_image
from builders.records import decision_record
from pydantic import ValidationError

from sonarpost import keys, wire
from sonarpost.bus.session import client_config, router_config
from sonarpost.messages import ImagePart
from sonarpost.services.relay import config
from sonarpost.services.relay.config import RelayConfig, UpstreamOptions
from sonarpost.services.relay.service import topic_of

IMAGES, DECISIONS = keys.image_coded("vessel-1"), keys.contact_decision("vessel-1")


def image(image_id="AAAA", version=1, height_px=40, **changes):
    return make_image(1, (height_px, 100), version=version).model_copy(update={"image_id": image_id, **changes})


def names(site):
    """Received records: identifiers of decisions, identifier and version of images."""
    return [
        f"{record.i}v{record.n}" if isinstance(record, ImagePart) else msgpack.unpackb(record.payload)["decision_id"]
        for record in site.received
    ]


def test_two_bearers_can_have_one_key(monkeypatch):
    monkeypatch.setattr(config, "_BEARERS", {"radio": {"router", "max_bytes"}, "own": {"max_bytes"}})
    assert UpstreamOptions(bearer="own", max_bytes=5).max_bytes == UpstreamOptions(max_bytes=5).max_bytes
    with pytest.raises(ValidationError, match="no router with bearer own"):
        UpstreamOptions(bearer="own", router=("tcp/127.0.0.1:7447",))


def test_every_site_receives_everything_and_an_unreachable_one_delays_none(begin, runner, c2, source):
    first = c2("shore")
    service = begin(UpstreamOptions(), UpstreamOptions(site="shore-2"))
    source.send(IMAGES, "relay", *(image(f"{n:04d}") for n in range(20)))
    source.send(DECISIONS, "relay", decision_record())
    eventually(lambda: len(first.received) == 21)
    eventually(lambda: service.gauges()["waiting_for_shore"] == 0)
    gauges = service.gauges()
    assert (gauges["waiting_for_shore-2"], gauges["answering_shore-2"]) == (21, 0)
    assert (gauges["answering_shore"], gauges["delivered_to_shore"]) == (1, 21)
    assert gauges["waiting_bytes_for_shore-2"] > 20 * 4000
    assert 0 < gauges["oldest_s_for_shore-2"] < 3600
    assert gauges["oldest_s_for_shore"] == 0
    runner.stop(service)
    service = begin(UpstreamOptions(), UpstreamOptions(site="shore-2"))
    second = c2("shore-2", "shore-2")
    eventually(lambda: len(second.received) == 21)
    assert names(second)[0] == "d1"
    assert sorted(names(second)) == sorted(names(first))
    eventually(lambda: service.gauges()["waiting_for_shore-2"] == 0)
    assert len(first.received) == 21


def test_site_with_its_own_router_is_reached_when_the_router_starts(begin, source, c2):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    near = c2("shore")
    service = begin(UpstreamOptions(), UpstreamOptions(site="far", router=(endpoint,)))
    source.send(DECISIONS, "relay", decision_record())
    eventually(lambda: len(near.received) == 1)
    assert service.gauges()["waiting_for_far"] == 1
    far_router = zenoh.open(router_config([endpoint]))
    far = zenoh.open(client_config([endpoint]))
    try:
        asked = []

        def answer(query):
            with query:
                asked.append(msgpack.unpackb(query.payload.to_bytes())["key"])
                query.reply(query.key_expr, msgpack.packb({"v": 1, "status": "stored", "next": 0, "reason": ""}))

        far.declare_queryable(keys.delivery_query(keys.shore_inbox_all("far"), "c2"), answer)
        eventually(lambda: service.gauges()["waiting_for_far"] == 0)
        assert asked == [DECISIONS]
    finally:
        far.close()
        far_router.close()


def test_renamed_site_accepts_new_numbers(begin, runner, c2, source, platform):
    shore = c2("shore")
    service = begin(UpstreamOptions())
    source.send(DECISIONS, "relay", decision_record("d1"), decision_record("d2"))
    eventually(lambda: len(shore.received) == 2)
    eventually(lambda: service.gauges()["waiting_for_shore"] == 0)
    runner.stop(service)
    runner.stop(shore)
    renamed = c2("hq")
    begin(UpstreamOptions(site="hq"))
    source.send(DECISIONS, "relay", decision_record("d3"))
    eventually(lambda: names(renamed) == ["d3"])


def test_order_is_decisions_first_versions_later_versions(begin, c2, source, runner):
    service = begin(supersede=False)
    source.send(IMAGES, "relay", image("AAAA", 1), image("AAAA", 2), image("AAAA", 3), image("BBBB", 1))
    source.send(DECISIONS, "relay", decision_record())
    eventually(lambda: service.gauges()["waiting_for_shore"] == 5)
    runner.stop(service)
    shore = c2()
    begin(supersede=False)
    eventually(lambda: len(shore.received) == 5)
    assert names(shore) == ["d1", "AAAAv1", "BBBBv1", "AAAAv2", "AAAAv3"]


def test_newer_version_replaces_unsent_ones(begin, c2, source, runner):
    service = begin()
    # The first record is in flight as soon as the relay queries c2; the others wait.
    source.send(DECISIONS, "relay", decision_record())
    eventually(lambda: service.gauges()["waiting_for_shore"] == 1)
    for version in (1, 2, 3):
        source.send(IMAGES, "relay", image("AAAA", version))
        eventually(lambda version=version: service.health().counters.get("coded_images_relayed") == version)
    source.send(IMAGES, "relay", image("BBBB", 1))
    eventually(lambda: service.health().counters.get("coded_images_relayed") == 4)
    assert service.gauges()["waiting_for_shore"] == 3
    assert service.health().counters["records_superseded"] == 2
    runner.stop(service)
    shore = c2()
    service = begin()
    eventually(lambda: len(shore.received) == 3)
    assert names(shore) == ["d1", "AAAAv3", "BBBBv1"]
    # The consumer stores nothing for the gaps in the numbers.
    source.send(IMAGES, "relay", image("CCCC", 1))
    eventually(lambda: len(shore.received) == 4)
    assert shore.store._query("SELECT COUNT(*) FROM received") == [(4,)]


def test_image_of_another_mission_is_not_a_version_of_the_first():
    assert topic_of(image(first_frame_utc_s=1.0)).name != topic_of(image(first_frame_utc_s=2.0)).name
    assert topic_of(image(version=1)).name == topic_of(image(version=2)).name


def test_decision_overtakes_an_image_at_a_bandwidth_limit(begin, c2, source):
    shore = c2()
    begin(UpstreamOptions(bandwidth_bytes_per_s=400))  # the image takes 100 s
    source.send(IMAGES, "relay", image("AAAA", height_px=400))
    eventually(lambda: shore.store._query("SELECT COUNT(*) FROM partial") == [(1,)])
    source.send(DECISIONS, "relay", decision_record())
    eventually(lambda: names(shore) == ["d1"])
    assert shore.store._query("SELECT COUNT(*) FROM partial") == [(1,)]


DiskUsage = namedtuple("DiskUsage", "total used free")


def test_senders_keep_images_below_the_reserve_and_decisions_are_accepted(begin, c2, source, monkeypatch, refused):
    free = [20_000_000]
    monkeypatch.setattr("sonarpost.delivery.disk_reserve.shutil.disk_usage", lambda _: DiskUsage(10**9, 0, free[0]))
    shore = c2()
    service = begin(disk_reserve_bytes=50_000_000)
    source.send(IMAGES, "relay", image("AAAA"))
    eventually(lambda: "below the reserve of 50000000" in service.health().detail)
    assert service.health().state == "degraded"
    source.send(DECISIONS, "relay", decision_record("d1"), decision_record("d2"), priority=3)
    eventually(lambda: sorted(names(shore)) == ["d1", "d2"])
    free[0] = 10**8
    eventually(lambda: sorted(names(shore)) == ["AAAAv1", "d1", "d2"])
    eventually(lambda: service.health().state == "ok")
    assert refused(source) == []


def test_plain_publication_of_an_image_below_the_reserve_is_refused_and_logged(begin, c2, publish, monkeypatch):
    monkeypatch.setattr("sonarpost.delivery.disk_reserve.shutil.disk_usage", lambda _: DiskUsage(10**9, 0, 20_000_000))
    service = begin(disk_reserve_bytes=50_000_000)
    publish(IMAGES, wire.encode(image()))
    eventually(lambda: service.health().counters.get("records_refused") == 1)
    assert service.gauges()["waiting_for_shore"] == 0


def test_quota_drops_images_of_one_site_and_no_decisions(begin, runner, c2, source):
    service = begin(UpstreamOptions(max_bytes=15_000), UpstreamOptions(site="shore-2"))
    source.send(DECISIONS, "relay", decision_record())
    source.send(IMAGES, "relay", *(image(f"{n:04d}") for n in range(6)))
    eventually(lambda: service.gauges()["waiting_for_shore-2"] == 7)
    eventually(lambda: service.health().counters.get("images_dropped") == 3)
    assert service.gauges()["waiting_bytes_for_shore"] <= 15_000
    runner.stop(service)
    shore = c2()
    begin(UpstreamOptions(max_bytes=15_000), UpstreamOptions(site="shore-2"))
    eventually(lambda: len(shore.received) == 4)
    assert names(shore) == ["d1", "0003v1", "0004v1", "0005v1"]


def test_records_of_a_removed_site_are_kept_unless_dropped_by_configuration(begin, runner, source):
    service = begin(UpstreamOptions(), UpstreamOptions(site="old"))
    source.send(DECISIONS, "relay", decision_record())
    eventually(lambda: service.gauges().get("waiting_for_old") == 1)
    runner.stop(service)
    service = begin(UpstreamOptions())
    assert service.gauges()["held_for_removed"] == 1
    runner.stop(service)
    service = begin(UpstreamOptions(), drop_removed_upstreams=True)
    assert service.gauges()["held_for_removed"] == 0
    assert service.gauges()["waiting_for_shore"] == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"upstreams": ({"site": "a"}, {"site": "a"})},
        {"upstreams": ({"site": "A"},)},
        {"upstreams": ({"bandwidth_bytes_per_s": 0},)},
        {"upstreams": ({"max_bytes": -1},)},
        {"upstreams": ({"sit": "a"},)},
        {"comment_consumers": ("relay",)},
        {"command_consumers": ("Op Modem",)},
        {"disk_reserve_bytes": -1},
    ],
)
def test_invalid_configuration_is_rejected(wrong):
    with pytest.raises(ValidationError):
        RelayConfig(**wrong)
