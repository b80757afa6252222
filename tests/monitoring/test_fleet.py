"""Fleet state: ages by the host's clock, validation of sources, limits, expiry."""

import pytest

from sonarpost import keys, wire
from sonarpost.messages import Health
from sonarpost.monitoring import fleet as fleet_module
from sonarpost.monitoring.fleet import FleetTracker


def health(platform="uuv-1", service="c2", **changes):
    fields = {"time_utc_s": 5.0, "started_utc_s": 1.0, "state": "ok", "counters": {}, "gauges": {}}
    return Health(platform_id=platform, service=service, **(fields | changes))


def add(fleet, record, now_s, key=""):
    fleet.add(key or keys.health(record.platform_id, record.service), wire.encode(record), now_s)


def test_age_counts_from_arrival():
    fleet = FleetTracker()
    add(fleet, health(time_utc_s=4e9), 100.0)
    fleet.set_alive([keys.alive("uuv-1", "c2"), keys.alive("uuv-1", "relay")], 101.0)
    c2, relay = fleet.state(103.0).services
    assert (c2.age_s, c2.alive, relay.health, relay.age_s, relay.alive) == (3.0, True, None, None, True)


def test_liveliness_is_unknown_without_a_router():
    fleet = FleetTracker()
    add(fleet, health(), 0.0)
    assert fleet.state(1.0).services[0].alive is None
    fleet.set_alive([], 1.0)
    assert fleet.state(1.0).services[0].alive is False
    fleet.set_alive(None, 2.0)
    assert (fleet.state(2.0).services[0].alive, fleet.state(2.0).connected) == (None, False)


@pytest.mark.parametrize(
    ("key", "payload"),
    [
        (keys.health("uuv-1", "c2"), b"\xc1"),
        (keys.health("uuv-1", "c2"), wire.encode(health("uuv-2"))),
        (keys.health("uuv-1", "c2"), wire.encode(health(service="relay"))),
        ("sonarpost/v1/uuv-1/health/c2/more", wire.encode(health())),
        ("sonarpost/v1/UUV/health/c2", wire.encode(health())),
        ("other/v1/uuv-1/health/c2", wire.encode(health())),
    ],
)
def test_invalid_record_is_counted_and_dropped(key, payload, caplog):
    fleet = FleetTracker()
    fleet.add(key, payload, 0.0)
    assert (fleet.state(0.0).services, fleet.state(0.0).rejected) == ((), 1)
    assert "expected" in vars(caplog.records[0])["fields"]["reason"]


@pytest.mark.parametrize("name", ["range", "status"])
def test_invalid_record_of_a_vehicle_is_counted_logged_and_dropped(name, caplog):
    fleet = FleetTracker()
    key, add_record = {
        "range": (keys.acoustic_range("vessel-1"), fleet.add_range),
        "status": (keys.acoustic_status("vessel-1"), fleet.add_status),
    }[name]
    add_record(key, b"\xc1", 0.0)
    assert fleet.state(0.0).rejected == 1
    [record] = caplog.records
    assert record.message.endswith("of a vehicle rejected")
    assert key in vars(record)["fields"]["reason"]


def test_invalid_tokens_are_ignored():
    fleet = FleetTracker()
    fleet.set_alive(["sonarpost/v1/uuv-1/alive/c2", "sonarpost/v1/uuv-1/alive/a/b", "x"], 0.0)
    assert [(s.platform, s.service) for s in fleet.state(0.0).services] == [("uuv-1", "c2")]


def test_service_without_a_token_expires():
    fleet = FleetTracker(expire_after_s=60.0)
    for service in ("c2", "relay"):
        add(fleet, health(service=service), 0.0)
    fleet.set_alive([keys.alive("uuv-1", "c2")], 60.0)
    assert len(fleet.state(60.0).services) == 2
    fleet.set_alive([keys.alive("uuv-1", "c2")], 61.0)
    assert [s.service for s in fleet.state(61.0).services] == ["c2"]


def test_invented_services_of_a_platform_hide_no_other_platform(monkeypatch):
    monkeypatch.setattr(fleet_module, "MAX_SERVICES_OF_PLATFORM", 3)
    monkeypatch.setattr(fleet_module, "MAX_SERVICES", 10)
    fleet = FleetTracker()
    fleet.set_alive([keys.alive("uuv-1", f"t{number}") for number in range(20)] + [keys.alive("uuv-2", "c2")], 0.0)
    for number in range(20):
        add(fleet, health(service=f"s{number}"), 0.0)
    add(fleet, health("uuv-2", "relay"), 0.0)
    large = health(service="t1", gauges={f"gauge-{number}": 0.0 for number in range(10_000)})
    add(fleet, large, 0.0)
    state = fleet.state(0.0)
    assert [one.service for one in state.services if one.platform == "uuv-2"] == ["c2", "relay"]
    assert len([one for one in state.services if one.platform == "uuv-1"]) == 3
    assert state.rejected == 21


def test_number_of_services_is_limited(monkeypatch):
    monkeypatch.setattr(fleet_module, "MAX_SERVICES", 3)
    fleet = FleetTracker()
    for number in range(5):
        add(fleet, health(service=f"s{number}"), 0.0)
    fleet.set_alive([keys.alive("uuv-1", f"t{number}") for number in range(9)], 0.0)
    state = fleet.state(0.0)
    assert state.rejected == 2
    assert len(state.services) <= 6
    add(fleet, health(service="s1", state="degraded"), 1.0)
    assert next(s for s in fleet.state(1.0).services if s.service == "s1").health == health(
        service="s1", state="degraded"
    )
