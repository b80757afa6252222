"""Map and fleet."""

import math

import pytest
from builders.console import encoded_health, image_record, queue_state, received_frame

from sonarpost.messages import LinkQuality
from sonarpost.review.positions import LocalFrame, destination, distance_m, vehicle_position


def test_map_has_positions_in_degrees(make_console):
    console = make_console(vessel_lat_deg=56.0, vessel_lon_deg=-5.0, ring_m=[250.0])
    position = destination(56.0, -5.0, 90.0, 300.0)
    console.state.store_image(image_record("0001", position=position))
    console.state.store_image(image_record("0002", position=None))
    watch = console.browser("watch")
    chart = watch.get("/api/map").json()
    [point] = watch.chart().values()
    assert (point["lat_deg"], point["lon_deg"]) == pytest.approx(position, abs=1e-7)
    assert point["heading_deg"] == 0.0
    # The object is 12 m to starboard.
    vehicle_at = destination(*position, 270.0, 12.0)
    assert (chart["unlocated"], chart["vessel"]) == (1, {"lat_deg": 56.0, "lon_deg": -5.0})
    assert chart["ring_m"] == [250.0]
    [vehicle] = watch.get("/api/fleet").json()["vehicles"]
    assert (vehicle["lat_deg"], vehicle["lon_deg"]) == pytest.approx(vehicle_at)
    assert (vehicle["vehicle_id"], vehicle["heading_deg"]) == ("uuv-1", 0.0)
    assert vehicle["range_m"] == pytest.approx(288.0, abs=0.1)
    assert (vehicle["last_heard_utc_s"], vehicle["queue"]) == (None, None)


def test_vehicle_is_at_its_newest_contact(console):
    for number, seen_s in ((1, 50.0), (2, 90.0), (3, 70.0)):
        console.state.store_image(
            image_record(f"000{number}", position=(56.0 + 0.01 * number, -5.0), time_utc_s=1_700_000_000.0 + seen_s)
        )
    [vehicle] = console.browser("watch").get("/api/fleet").json()["vehicles"]
    assert (vehicle["lat_deg"], vehicle["position_utc_s"]) == (pytest.approx(56.02, abs=1e-4), 1_700_000_090.0)


def test_map_without_vessel_and_heading(console):
    watch = console.browser("watch")
    chart = watch.get("/api/map").json()
    assert (chart["contacts"], chart["unlocated"], chart["vessel"]) == ([], 0, None)
    console.state.store_image(image_record("0001", heading_deg=None))
    [point] = watch.chart().values()
    assert point["heading_deg"] is None
    assert watch.get("/api/fleet").json()["vehicles"] == []


def test_local_frame():
    frame = LocalFrame(70.0, 179.99)
    range_m = math.hypot(1234.0, 567.0)
    lat, lon = destination(70.0, 179.99, math.degrees(math.atan2(1234.0, -567.0)), range_m)
    assert distance_m(70.0, 179.99, lat, lon) == pytest.approx(range_m, abs=1e-3)
    first, second = frame.to_local([lat, 70.001], [lon, 179.99])
    assert first == (1234.0, -567.0)
    assert second == (0.0, pytest.approx(distance_m(70.0, 179.99, 70.001, 179.99), abs=0.005))
    assert frame.to_local([], []) == []
    assert vehicle_position(56.0, -5.0, None, "port", 10.0) is None


def frame(packet, bad):
    return received_frame(1000.0, packet, quality=LinkQuality(snr_in_db=12.0, frames=3, bad_frames=bad))


def test_link_quality(console):
    monitor = console.state.fleet
    for packet, bad in enumerate((0, 1, 2)):
        monitor.add_frame("uuv-1", frame(packet, bad), now_s=float(packet))
    monitor.add_frame("uuv-1", frame(2, 2), now_s=2.5)
    monitor.set_queue(queue_state([("0001", 64, 1040.0)], 1000.0))
    now = monitor.vehicles(now_s=10.0)["uuv-1"]
    assert (now["frames"], now["bad_frames"], now["loss"]) == (9, 3, 0.333)
    assert (now["snr_in_db"], now["last_heard_utc_s"]) == (12.0, 1000.0)
    assert now["queue"]["images"][0]["expected_utc_s"] == 1040.0
    assert monitor.vehicles(now_s=100.0)["uuv-1"]["frames_per_minute"] == 0


def test_seabed_is_from_the_health_of_the_vehicles_detector(console):
    monitor = console.state.fleet
    gauges = {"expected_pd": 0.62, "worst_expected_pd": 0.35, "clutter_per_1000_m2": 41.0, "ripple_strength": 0.12}
    monitor.services.add(*encoded_health("atd_stub", "uuv-1", **gauges), now_s=10.0)
    monitor.services.add(*encoded_health("compressor", "uuv-2", expected_pd=0.1), now_s=10.0)
    monitor.add_frame("uuv-2", frame(1, 0), now_s=10.0)
    vehicles = monitor.vehicles(now_s=12.0)
    assert vehicles["uuv-2"]["seabed"] is None
    assert vehicles["uuv-1"]["seabed"] == gauges | {
        "warning": "expected Pd 62 % on this seabed; a clean result does not mean no mines",
        "time_utc_s": 1000.0,
    }
    served = {v["vehicle_id"]: v["seabed"] for v in console.browser("watch").get("/api/fleet").json()["vehicles"]}
    assert served["uuv-1"]["expected_pd"] == 0.62
    assert served["uuv-2"] is None


def test_warning_of_a_difficult_seabed_and_values_beyond_their_range(console):
    monitor = console.state.fleet
    monitor.add_frame("uuv-1", frame(1, 0), now_s=1.0)

    def seabed(**gauges):
        monitor.services.add(*encoded_health("atd_stub", "uuv-1", **gauges), now_s=1.0)
        return monitor.vehicles(now_s=1.0)["uuv-1"]["seabed"]

    for expected_pd, warns in ((0.0, True), (0.799, True), (0.8, False), (1.0, False)):
        found = seabed(expected_pd=expected_pd)
        assert ("a clean result does not mean no mines" in found["warning"]) == warns
        assert found["worst_expected_pd"] is None
    for value in (-0.1, 1.1, 1e300):
        assert seabed(expected_pd=value) is None
        assert seabed(expected_pd=0.5, ripple_strength=value)["ripple_strength"] is None
