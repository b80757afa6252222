"""Statuses of vehicles: track, latest position, surveyed area, limits."""

from itertools import pairwise

import pytest
from builders.console import image_record
from builders.record_samples import SAMPLES

from sonarpost.messages import ReceivedStatus, VehicleStatus
from sonarpost.review.positions import destination
from sonarpost.services.console.store import tracks
from sonarpost.services.console.store.database import DATABASE_NAME, Database
from sonarpost.services.console.store.tracks import covered_area_m2

START_S = 1_700_000_000.0
CORNER = (56.0, -5.0)


def received(number=0, position=CORNER, vehicle="uuv-1", vessel="vessel-1", **values):
    lat_deg, lon_deg = position or (None, None)
    values = {"time_utc_s": START_S + 60.0 * number, "lat_deg": lat_deg, "lon_deg": lon_deg, **values}
    return ReceivedStatus(
        vessel_id=vessel,
        vehicle_id=vehicle,
        received_utc_s=START_S + 60.0 * number + 8.0,
        status=VehicleStatus(vehicle_id=vehicle, **values),
        authenticated=True,
    )


def along(bearing_deg, steps, start=CORNER, length_m=100.0):
    return [destination(*start, bearing_deg, length_m * n) for n in range(steps + 1)]


def get(console, path):
    return console.browser("watch").get(path).json()


def test_track_and_latest_position(make_console):
    console = make_console(vessel_lat_deg=56.0, vessel_lon_deg=-5.0)
    places = along(90.0, 3)
    for number, place in enumerate(places):
        console.state.store_status(received(number, place, heading_deg=90.0, depth_m=12.4, images_waiting=4))
    [track] = get(console, "/api/map/tracks")["tracks"]
    assert track == {"vehicle_id": "uuv-1", "points": [list(place) for place in places]}
    [vehicle] = get(console, "/api/fleet")["vehicles"]
    assert (vehicle["lat_deg"], vehicle["lon_deg"], vehicle["heading_deg"]) == (*places[-1], 90.0)
    assert vehicle["position_utc_s"] == START_S + 180.0
    assert vehicle["range_m"] == pytest.approx(300.0, abs=0.1)
    status = vehicle["status"]
    assert (status["depth_m"], status["images_waiting"], status["battery"]) == (12.4, 4, None)
    assert (status["received_utc_s"], status["authenticated"]) == (START_S + 188.0, True)


def test_measured_distance(make_console):
    console = make_console(vessel_lat_deg=56.0, vessel_lon_deg=-5.0)
    console.state.fleet.set_range(SAMPLES["vehicle-range"])
    measured = {"distance_m": 740.0, "measured_utc_s": 1476262840.5}
    [vehicle] = get(console, "/api/fleet")["vehicles"]
    assert (vehicle["vehicle_id"], vehicle["measured_range"], vehicle["range_m"]) == ("uuv-1", measured, None)


def test_the_newer_of_contact_and_status_is_the_position(console):
    console.state.store_status(received(0, CORNER))
    console.state.store_image(image_record("0001", position=(56.5, -5.0), time_utc_s=START_S + 30.0))
    assert get(console, "/api/fleet")["vehicles"][0]["lat_deg"] == pytest.approx(56.5, abs=1e-3)
    console.state.store_status(received(1, CORNER))
    assert get(console, "/api/fleet")["vehicles"][0]["lat_deg"] == CORNER[0]
    console.state.store_status(received(2, None))
    [vehicle] = get(console, "/api/fleet")["vehicles"]
    assert vehicle["lat_deg"] == pytest.approx(56.5, abs=1e-3), "the latest status has no position"
    assert len(get(console, "/api/map/tracks")["tracks"][0]["points"]) == 2


def test_a_repeated_position_is_one_point(console):
    for number in range(3):
        console.state.store_status(received(number, time_utc_s=START_S))
    [track] = get(console, "/api/map/tracks")["tracks"]
    assert len(track["points"]) == 1
    assert get(console, "/api/fleet")["vehicles"][0]["status"]["received_utc_s"] == START_S + 128.0


def test_points_and_vehicles_are_limited(console, monkeypatch):
    monkeypatch.setattr(tracks, "MAX_POINTS", 5)
    monkeypatch.setattr(tracks, "MAX_VEHICLES", 2)
    monkeypatch.setattr(tracks, "MAX_POINTS_DRAWN", 3)
    for vehicle in ("uuv-1", "uuv-2", "uuv-3"):
        for number in range(9):
            console.state.store_status(received(number, (56.0 + 0.001 * number, -5.0), vehicle))
    with console.state.database.read() as db:
        counts = dict(db.execute("SELECT vehicle_id, COUNT(*) FROM track GROUP BY vehicle_id").fetchall())
    assert counts == {"uuv-1": 5, "uuv-2": 5}
    assert [[point[0] for point in track["points"]] for track in get(console, "/api/map/tracks")["tracks"]] == [
        [56.006, 56.007, 56.008]
    ] * 2


def test_statuses_of_one_vessel_displace_none_of_the_same_vehicle_of_another(console, monkeypatch):
    monkeypatch.setattr(tracks, "MAX_POINTS", 2)
    monkeypatch.setattr(tracks, "MAX_POINTS_DRAWN", 2)
    places = along(90.0, 1)
    for number, place in enumerate(places):
        console.state.store_status(received(number, place))
    for number in range(5):
        console.state.store_status(received(number, (10.0, 10.0 + number), vessel="vessel-2"))
    drawn = [track["points"] for track in get(console, "/api/map/tracks")["tracks"]]
    assert drawn == [[list(place) for place in places], [[10.0, 13.0], [10.0, 14.0]]]


def test_invented_vehicles_of_a_vessel_hide_no_vehicle_of_another(console, monkeypatch):
    monkeypatch.setattr(tracks, "MAX_VEHICLES", 2)
    for vehicle in ("a", "b", "c"):
        console.state.store_status(received(0, vehicle=vehicle, vessel="vessel-2"))
    console.state.store_status(received(0, vehicle="uuv-1"))
    assert {one["vehicle_id"] for one in get(console, "/api/fleet")["vehicles"]} == {"a", "b", "uuv-1"}


def test_surveyed_area_of_overlapping_lines_and_vehicles(console):
    line = along(90.0, 10)
    back = [destination(*place, 0.0, 100.0) for place in reversed(line)]
    for number, place in enumerate([*line, *back]):
        console.state.store_status(received(number, place, swath_m=100.0))
    surveyed = get(console, "/api/map/tracks")["surveyed"]
    # Two lines of 1000 m, 100 m apart, with 100 m to each side, and the turn of 100 m between them.
    assert surveyed["area_m2"] == pytest.approx(1000 * 300 + 100 * 100, rel=0.02)
    assert (len(surveyed["legs"]), surveyed["since_utc_s"]) == (21, START_S)
    assert surveyed["legs"][0] == [*line[0], *line[1], 100.0]
    # Another vehicle on half of the first line adds nothing; 500 m further on it adds its own line.
    for number, place in enumerate(along(90.0, 5)):
        console.state.store_status(received(number, place, "uuv-2", swath_m=50.0))
    surveyed_by_two = get(console, "/api/map/tracks")["surveyed"]
    assert len(surveyed_by_two["legs"]) == 26
    assert surveyed_by_two["area_m2"] == pytest.approx(surveyed["area_m2"], rel=0.02)
    for number, place in enumerate(along(90.0, 5, destination(*CORNER, 180.0, 500.0))):
        console.state.store_status(received(20 + number, place, "uuv-2", swath_m=50.0))
    area_m2 = get(console, "/api/map/tracks")["surveyed"]["area_m2"]
    # The leg of 707 m between both lines is 15 minutes long, and counts too, with half of its width beyond the lines.
    assert area_m2 > surveyed_by_two["area_m2"] + 500 * 100


@pytest.mark.parametrize(
    "statuses",
    [
        [received(0, CORNER, swath_m=100.0)],
        [received(n, place) for n, place in enumerate(along(0.0, 2))],
        [received(n, place, swath_m=100.0) for n, place in enumerate(along(0.0, 2, length_m=1500.0))],
        [received(20 * n, place, swath_m=100.0) for n, place in enumerate(along(0.0, 2))],
        [received(-n, place, swath_m=100.0) for n, place in enumerate(along(0.0, 2))],
        [received(n, place, swath_m=100.0) for n, place in enumerate([(90.0, 0.0), (-90.0, 180.0), (0.0, -180.0)])],
    ],
    ids=["one position", "no range", "too long", "too late", "clock set back", "far apart"],
)
def test_what_is_no_leg_is_not_counted(console, statuses):
    for status in statuses:
        console.state.store_status(status)
    assert get(console, "/api/map/tracks")["surveyed"] is None


def test_many_wide_legs_are_counted_with_few_cells():
    places = [(float(n % 2) * 900.0, 0.4 * n) for n in range(2000)]
    legs = [(*start, *end, 1.0 if n % 3 else 508.0) for n, (start, end) in enumerate(pairwise(places))]
    # All rectangles lie in a box of 900 m by 1816 m, with slanted ends.
    assert covered_area_m2(legs) == pytest.approx(900.0 * 1816.0, rel=0.1)


def test_track_survives_a_restart(tmp_path):
    path = tmp_path / DATABASE_NAME
    database = Database(path)
    with database.transaction() as db:
        assert tracks.store_status(db, received())
    database.close()
    database = Database(path)
    with database.read() as db:
        assert tracks.tracks_json(db) == [{"vehicle_id": "uuv-1", "points": [list(CORNER)]}]
    database.close()
