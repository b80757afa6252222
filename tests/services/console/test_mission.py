"""Progress of a mission."""

from __future__ import annotations

import pytest
from builders.common import REPOSITORY
from builders.console import image_record

from sonarpost.messages import AcousticFrame, DownlinkState, QueuedImage, QueueState
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
    """A console with contacts of two vehicles, whose clock a test sets."""
    console = make_console(downlink_rate=0)
    times = [NOW_S]
    console.state.clock = lambda: times[0]
    console.set_time = lambda utc_s: times.__setitem__(0, utc_s)
    return console


def progress(console):
    return console.browser("watch").get("/api/mission").json()


def contact_id(console, image_id):
    items = console.browser("watch").get("/api/contacts").json()["items"]
    return next(row["id"] for row in items if row["image_id"] == image_id)


def test_mission_without_contacts(mission):
    empty = progress(mission)
    assert (empty["vehicles"], empty["operators"]) == ([], [])
    total = empty["total"]
    assert (total["contacts"], total["area"], total["image_bytes"], total["contacts_utc_s"]) == ({}, None, 0, None)


def test_contacts_area_and_bytes_by_vehicle(mission):
    # The heading is unknown, so that the positions of the vehicle are unknown: the corners are those of the contacts.
    corner = (56.0, -5.0)
    east = destination(*corner, 90.0, 200.0)
    for number, position in enumerate((corner, east, destination(*east, 0.0, 100.0), destination(*corner, 0.0, 100.0))):
        mission.state.store_image(
            image_record(f"000{number}", position=position, heading_deg=None, total=100, missing_rows=20)
        )
    mission.set_time(NOW_S + 2 * HOUR_S)
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


def frame(packet, number, rate=1):
    return AcousticFrame(
        direction="rx",
        platform_id="vessel-1",
        time_utc_s=NOW_S + packet,
        source=3,
        destination=1,
        rate=rate,
        packet=packet,
        frame_number=number,
        frame_count=3,
        data=b"x",
    )


def test_air_time_counts_packets_not_frames(mission):
    for packet in (1, 2):
        for number in (1, 2, 3):
            mission.state.fleet.add_frame("uuv-1", frame(packet, number))
    mission.state.fleet.add_frame("uuv-1", frame(3, 1, rate=None))
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
    decision = anna.decide(contact_id(mission, "0001")).json()["decision"]
    state = DownlinkState(
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        kind="decision",
        record_id=decision["decision_id"],
        state="sent",
        times_sent=3,
        expires_utc_s=NOW_S + 100,
        changed_utc_s=NOW_S + 7,
    )
    mission.state.apply_downlink_state(state)
    downlink = progress(mission)["total"]["downlink"]
    assert downlink == {
        "transmissions": 3,
        "airtime_s": round(3 * RATES[0].airtime_s, 1),
        "time_utc_s": NOW_S + 7,
    }


def test_median_time_of_operators_is_to_the_first_verdict(mission):
    for number in range(3):
        mission.state.store_image(image_record(f"000{number}"))
    anna, bo = mission.browser("anna"), mission.browser("bo")
    for number, delay_s in enumerate((10.0, 20.0, 60.0)):
        mission.set_time(NOW_S + delay_s)
        assert anna.decide(contact_id(mission, f"000{number}")).status_code == 201
    mission.set_time(NOW_S + 1000.0)
    last = bo.decide(contact_id(mission, "0000"), verdict="unsure").json()["decision"]
    detail = bo.contact(contact_id(mission, "0000"))
    shown = {name: detail["versions"][-1][name] for name in ("version", "sha256")}
    body = {"decision_id": last["decision_id"], **shown, "layer": "raw"}
    undone = bo.post(f"/api/contacts/{contact_id(mission, '0000')}/undo", body)
    assert undone.status_code == 201
    by_name = {one["operator"]: one for one in progress(mission)["operators"]}
    assert by_name["anna"]["median_s"] == 20.0
    assert (by_name["anna"]["decisions"], by_name["anna"]["verdicts"]) == (3, {"mine_like": 3})
    # Bo's verdict was not the first one, and the undo is not a decision.
    assert (by_name["bo"]["decisions"], by_name["bo"]["median_s"], by_name["bo"]["first_verdicts"]) == (1, None, 0)


def queue(images, waiting):
    return QueueState(
        platform_id="uuv-1",
        time_utc_s=NOW_S - 5,
        rate=1,
        frame_loss=None,
        packet_interval_s=6.0,
        messages_waiting=0,
        message_bytes=0,
        images_waiting=waiting,
        images=tuple(
            QueuedImage(image_id=f"000{n}", contact_id="c", bytes_left=64, preview_utc_s=None, expected_utc_s=end)
            for n, end in enumerate(images)
        ),
    )


@pytest.mark.parametrize(
    ("images", "waiting", "finished", "work_off_s"),
    [
        ([NOW_S + 40, NOW_S + 90], 2, NOW_S + 90, 90.0),
        ([], 0, NOW_S, 0.0),
        ([NOW_S - 3], 1, NOW_S - 3, 0.0),
        ([NOW_S + 40], 2, None, None),  # the record lists only a part
    ],
)
def test_forecast_of_a_queue(mission, images, waiting, finished, work_off_s):
    mission.state.fleet.set_queue(queue(images, waiting))
    [vehicle] = progress(mission)["vehicles"]
    forecast = vehicle["queue"]
    assert (forecast["images_waiting"], forecast["finished_utc_s"], forecast["work_off_s"]) == (
        waiting,
        finished,
        work_off_s,
    )
    assert (forecast["time_utc_s"], forecast["stale"]) == (NOW_S - 5, False)
    assert queue_forecast(None, NOW_S) is None


def test_all_fields_are_documented(mission):
    text = (REPOSITORY / "docs" / "specifications" / "console-api.md").read_text(encoding="utf-8")
    mission.state.store_image(image_record("0001"))
    mission.state.fleet.add_frame("uuv-1", frame(1, 1))
    mission.state.fleet.set_queue(queue([], 0))
    mission.browser("anna").decide(contact_id(mission, "0001"))
    found = progress(mission)
    [vehicle] = found["vehicles"]
    for part in (found, vehicle, vehicle["uplink"], vehicle["queue"], vehicle["downlink"], found["operators"][0]):
        for name in part:
            assert f'"{name}"' in text, name
