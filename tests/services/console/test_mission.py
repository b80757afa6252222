"""Progress of a mission."""

from __future__ import annotations

import pytest
from builders.console import Clock, contact_ids, downlink_state, image_record, queue_state, received_frame

from sonarpost.modem.micromodem.rates import RATES
from sonarpost.review.positions import destination
from sonarpost.services.console.mission import hourly_counts, hull_area_m2, queue_forecast

NOW_S = 1_700_100_000.0
HOUR_S = 3600.0


def test_area_of_a_convex_hull():
    square = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]
    assert hull_area_m2(square) == 10_000.0
    assert hull_area_m2([*square, (50.0, 50.0), (50.0, 0.0), (0.0, 0.0)]) == 10_000.0
    assert hull_area_m2([(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)]) == 0.0
    assert hull_area_m2(square[:2]) == 0.0


def test_contacts_of_the_last_24_hours():
    hour = int(NOW_S // HOUR_S)
    hours = hourly_counts([(hour, 3), (hour - 23, 2), (hour - 24, 7)], NOW_S)
    assert len(hours) == 24
    assert hours[-1] == {"start_utc_s": hour * HOUR_S, "contacts": 3}
    assert hours[0] == {"start_utc_s": (hour - 23) * HOUR_S, "contacts": 2}
    assert sum(one["contacts"] for one in hours) == 5


@pytest.fixture
def mission(make_console):
    """A console with a clock for tests."""
    console = make_console(downlink_rate=0)
    console.clock = Clock(console, NOW_S)
    return console


def progress(console):
    return console.browser("watch").get("/api/mission").json()


def test_contacts_area_and_bytes_by_vehicle(mission):
    empty = progress(mission)
    assert (empty["vehicles"], empty["operators"]) == ([], [])
    assert [empty["total"][name] for name in ("contacts", "area", "image_bytes", "contacts_utc_s")] == [
        {},
        None,
        0,
        None,
    ]
    # The heading is unknown, so that the positions of the vehicle are unknown: the corners are those of the contacts.
    corner = (56.0, -5.0)
    east = destination(*corner, 90.0, 200.0)
    for number, position in enumerate((corner, east, destination(*east, 0.0, 100.0), destination(*corner, 0.0, 100.0))):
        changes = {"position": position, "heading_deg": None, "total": 100, "missing_rows": 20}
        mission.state.store_image(image_record(f"000{number}", **changes))
    mission.clock.advance(2 * HOUR_S)
    mission.state.store_image(image_record("0009", vehicle="uuv-2", position=None))
    found = progress(mission)
    one, two = found["vehicles"]
    assert (one["vehicle_id"], two["vehicle_id"]) == ("uuv-1", "uuv-2")
    assert one["area"]["area_m2"] == pytest.approx(20_000.0, rel=0.001)
    assert (one["area"]["contacts"], one["area"]["time_utc_s"]) == (4, NOW_S)
    assert two["area"] is None
    assert (one["contacts"], two["contacts"]) == ({"unreviewed": 4}, {"unreviewed": 1})
    assert (one["image_bytes"], two["image_bytes"], found["total"]["image_bytes"]) == (200, 200, 400)
    assert [hour["contacts"] for hour in found["total"]["hours"]][-3:] == [4, 0, 1]
    assert found["total"]["contacts_utc_s"] == NOW_S + 2 * HOUR_S
    assert (two["uplink"], two["queue"], two["seabed"]) == (None, None, None)


def test_air_time_counts_packets_not_frames(mission):
    for packet in (1, 2):
        for number in (1, 2, 3):
            mission.state.fleet.add_frame("uuv-1", received_frame(NOW_S + packet, packet, number))
    mission.state.fleet.add_frame("uuv-1", received_frame(NOW_S + 3, 3, rate=None))
    [vehicle] = progress(mission)["vehicles"]
    assert vehicle["uplink"] == {
        "packets": 3,
        "packets_of_unknown_rate": 1,
        "airtime_s": round(2 * RATES[1].airtime_s, 1),
        "time_utc_s": NOW_S + 3,
    }


def test_downlink_counts_each_transmission(mission):
    mission.state.store_image(image_record("0001"))
    anna = mission.browser("anna")
    decision = anna.decide(contact_ids(mission.state)["0001"]).json()["decision"]
    state = downlink_state("decision", decision["decision_id"], "sent", NOW_S + 7, times_sent=3)
    mission.state.apply_downlink_state(state)
    airtime_s = round(3 * RATES[0].airtime_s, 1)
    assert progress(mission)["total"]["downlink"] == {
        "transmissions": 3,
        "airtime_s": airtime_s,
        "time_utc_s": NOW_S + 7,
    }


def test_median_time_of_operators_is_to_the_first_verdict(mission):
    for number in range(3):
        mission.state.store_image(image_record(f"000{number}"))
    anna, bo, ids = mission.browser("anna"), mission.browser("bo"), contact_ids(mission.state)
    for number, delay_s in enumerate((10.0, 10.0, 40.0)):
        mission.clock.advance(delay_s)
        assert anna.decide(ids[f"000{number}"]).status_code == 201
    mission.clock.advance(1000.0)
    last = bo.decide(ids["0000"], verdict="unsure").json()["decision"]
    assert bo.undo(ids["0000"], last["decision_id"]).status_code == 201
    by_name = {one["operator"]: one for one in progress(mission)["operators"]}
    assert by_name["anna"]["median_s"] == 20.0
    assert (by_name["anna"]["decisions"], by_name["anna"]["verdicts"]) == (3, {"mine_like": 3})
    # Bo's verdict was not the first one, and the undo is not a decision.
    assert (by_name["bo"]["decisions"], by_name["bo"]["median_s"], by_name["bo"]["first_verdicts"]) == (1, None, 0)


def test_forecast_of_a_queue(mission):
    for expected, waiting, finished, work_off_s in (
        ([NOW_S + 40, NOW_S + 90], 2, NOW_S + 90, 90.0),
        ([], 0, NOW_S, 0.0),
        ([NOW_S - 3], 1, NOW_S - 3, 0.0),
        ([NOW_S + 40], 2, None, None),  # the record lists only a part
    ):
        images = [(f"000{n}", 64, expected_utc_s) for n, expected_utc_s in enumerate(expected)]
        mission.state.fleet.set_queue(queue_state(images, NOW_S - 5, waiting))
        [vehicle] = progress(mission)["vehicles"]
        assert vehicle["queue"] == vehicle["queue"] | {
            "images_waiting": waiting,
            "finished_utc_s": finished,
            "work_off_s": work_off_s,
            "time_utc_s": NOW_S - 5,
            "stale": False,
        }
    assert queue_forecast(None, NOW_S) is None
