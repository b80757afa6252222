"""Map and fleet."""

from __future__ import annotations

import math

import pytest
from builders.console import image_record

from sonarpost import keys, wire
from sonarpost.messages import AcousticFrame, Health, LinkQuality, QueuedImage, QueueState
from sonarpost.review.positions import LocalFrame, destination, distance_m, vehicle_position

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"


def test_map_is_in_metres_around_the_vessel(make_console):
    console = make_console(vessel_lat_deg=56.0, vessel_lon_deg=-5.0)
    console.state.store_image(image_record("0001", position=destination(56.0, -5.0, 90.0, 300.0)))
    console.state.store_image(image_record("0002", position=None))
    chart = console.browser("watch").get("/api/map").json()
    [point] = chart["contacts"]
    assert (point["x_m"], point["y_m"]) == (pytest.approx(300.0, abs=0.01), pytest.approx(0.0, abs=0.01))
    # The heading is north and the object 12 m to starboard: the vehicle was 12 m west of it.
    [[x_m, y_m, _]] = chart["vehicles"][0]["track"]
    assert (x_m, y_m) == (pytest.approx(288.0, abs=0.01), pytest.approx(0.0, abs=0.01))
    assert (chart["unlocated"], chart["vessel"]) == (1, {"x_m": 0.0, "y_m": 0.0})
    [vehicle] = console.browser("watch").get("/api/fleet").json()["vehicles"]
    assert vehicle["range_m"] == pytest.approx(288.0, abs=0.1)
    assert (vehicle["stale"], vehicle["queue"]) == (True, None)


def test_map_without_contacts_has_no_origin(console):
    chart = console.browser("watch").get("/api/map").json()
    assert (chart["origin"], chart["contacts"], chart["vessel"]) == (None, [], None)


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


def frame(packet: int, bad: int, vehicle_time: float = 1000.0) -> AcousticFrame:
    return AcousticFrame(
        direction="rx",
        platform_id="vessel-1",
        time_utc_s=vehicle_time,
        source=3,
        destination=1,
        rate=1,
        packet=packet,
        frame_number=1,
        frame_count=3,
        data=b"x",
        quality=LinkQuality(snr_in_db=12.0, frames=3, bad_frames=bad),
    )


def test_link_quality_and_stale_link(make_console):
    console = make_console(vehicle_stale_s=60.0)
    monitor = console.state.fleet
    for packet, bad in enumerate((0, 1, 2)):
        monitor.add_frame("uuv-1", frame(packet, bad), now_s=float(packet))
    monitor.add_frame("uuv-1", frame(2, 2), now_s=2.5)
    monitor.set_queue(
        QueueState(
            platform_id="uuv-1",
            time_utc_s=1000.0,
            rate=1,
            frame_loss=None,
            packet_interval_s=6.0,
            messages_waiting=0,
            message_bytes=0,
            images_waiting=1,
            images=(
                QueuedImage(image_id="0001", contact_id="c", bytes_left=64, preview_utc_s=None, expected_utc_s=1040.0),
            ),
        ),
        now_s=2.0,
    )
    now = monitor.vehicles(now_s=10.0)["uuv-1"]
    assert (now["frames"], now["bad_frames"], now["loss"]) == (9, 3, 0.333)
    assert (now["snr_in_db"], now["stale"], now["age_s"]) == (12.0, False, 7.5)
    assert now["queue"]["images"][0]["expected_utc_s"] == 1040.0
    assert monitor.queue_wait_s("uuv-1", 1010.0) == 30.0
    later = monitor.vehicles(now_s=100.0)["uuv-1"]
    assert (later["stale"], later["queue"]["stale"], later["frames_per_minute"]) == (True, True, 0)


def detector_health(vehicle="uuv-1", service="atd_stub", **gauges: float) -> tuple[str, bytes]:
    health = Health(
        platform_id=vehicle,
        service=service,
        time_utc_s=1000.0,
        started_utc_s=900.0,
        state="ok",
        counters={},
        gauges=gauges,
    )
    return keys.health(vehicle, service), wire.encode(health)


def test_seabed_is_from_the_health_of_the_vehicles_detector(make_console):
    console = make_console()
    monitor = console.state.fleet
    gauges = {"expected_pd": 0.62, "worst_expected_pd": 0.35, "clutter_per_1000_m2": 41.0, "ripple_strength": 0.12}
    monitor.services.add(*detector_health(**gauges), now_s=10.0)
    monitor.services.add(*detector_health("uuv-2", "compressor", expected_pd=0.1), now_s=10.0)
    monitor.add_frame("uuv-2", frame(1, 0), now_s=10.0)
    vehicles = monitor.vehicles(now_s=12.0)
    assert vehicles["uuv-2"]["seabed"] is None
    assert vehicles["uuv-1"]["seabed"] == gauges | {
        "warning": "expected Pd 62 % on this seabed; a clean result does not mean no mines",
        "time_utc_s": 1000.0,
        "age_s": 2.0,
        "stale": False,
    }
    assert monitor.vehicles(now_s=100.0)["uuv-1"]["seabed"]["stale"]
    served = {v["vehicle_id"]: v["seabed"] for v in console.browser("watch").get("/api/fleet").json()["vehicles"]}
    assert served["uuv-1"]["expected_pd"] == 0.62
    assert served["uuv-2"] is None


@pytest.mark.parametrize(("expected_pd", "warns"), [(0.0, True), (0.799, True), (0.8, False), (1.0, False)])
def test_warning_of_a_difficult_seabed(make_console, expected_pd, warns):
    monitor = make_console().state.fleet
    monitor.services.add(*detector_health(expected_pd=expected_pd), now_s=1.0)
    seabed = monitor.vehicles(now_s=1.0)["uuv-1"]["seabed"]
    assert ("a clean result does not mean no mines" in seabed["warning"]) == warns
    assert seabed["worst_expected_pd"] is None


@pytest.mark.parametrize("value", [-0.1, 1.1, 1e300])
def test_values_of_a_seabed_beyond_their_range_are_unknown(make_console, value):
    monitor = make_console().state.fleet
    monitor.add_frame("uuv-1", frame(1, 0), now_s=1.0)
    monitor.services.add(*detector_health(expected_pd=value), now_s=1.0)
    assert monitor.vehicles(now_s=1.0)["uuv-1"]["seabed"] is None
    monitor.services.add(*detector_health(expected_pd=0.5, ripple_strength=value), now_s=1.0)
    assert monitor.vehicles(now_s=1.0)["uuv-1"]["seabed"]["ripple_strength"] is None
