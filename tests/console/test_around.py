"""Map, fleet, events and exports."""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
from xml.etree import ElementTree as ET

import pytest
from builders.common import REPOSITORY
from builders.console import picture_record

from research.user_study.intervals import clopper_pearson, wilson
from sonarpost.messages import AcousticFrame, LinkQuality, QueuedImage, QueueState
from sonarpost.review.local import LocalFrame, distance_m, moved, vehicle_position
from sonarpost.services.console.events import Hub, Pace

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"


def test_the_map_is_in_metres_around_the_vessel(make_console):
    console = make_console(vessel_lat_deg=56.0, vessel_lon_deg=-5.0)
    console.board.take_image(picture_record("0001", place=moved(56.0, -5.0, 90.0, 300.0)))
    console.board.take_image(picture_record("0002", place=None))
    chart = console.browser("watch").get("/api/map").json()
    [point] = chart["contacts"]
    assert (point["x_m"], point["y_m"]) == (pytest.approx(300.0, abs=0.01), pytest.approx(0.0, abs=0.01))
    # Heading north, the object 12 m to starboard: the vehicle was 12 m west of it.
    [[x_m, y_m, _]] = chart["vehicles"][0]["track"]
    assert (x_m, y_m) == (pytest.approx(288.0, abs=0.01), pytest.approx(0.0, abs=0.01))
    assert (chart["unlocated"], chart["vessel"]) == (1, {"x_m": 0.0, "y_m": 0.0})
    [vehicle] = console.browser("watch").get("/api/fleet").json()["vehicles"]
    assert vehicle["range_m"] == pytest.approx(288.0, abs=0.1)
    assert (vehicle["stale"], vehicle["queue"]) == (True, None)


def test_an_empty_map_has_no_origin(console):
    chart = console.browser("watch").get("/api/map").json()
    assert (chart["origin"], chart["contacts"], chart["vessel"]) == (None, [], None)


def test_there_and_back_in_a_local_frame():
    frame = LocalFrame(70.0, 179.99)
    lat, lon = frame.to_degrees(1234.0, -567.0)
    assert frame.to_local(lat, lon) == (pytest.approx(1234.0, abs=1e-3), pytest.approx(-567.0, abs=1e-3))
    assert distance_m(70.0, 179.99, lat, lon) == pytest.approx((1234.0**2 + 567.0**2) ** 0.5, abs=1e-3)
    many = frame.to_local_all([lat, 70.001], [lon, 179.99])
    assert many[0] == (1234.0, -567.0)
    assert many[1] == tuple(round(part, 2) for part in frame.to_local(70.001, 179.99))
    assert frame.to_local_all([], []) == []
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


def test_the_link_is_told_and_becomes_stale(make_console):
    console = make_console(vehicle_stale_s=60.0)
    panel = console.board.fleet
    for packet, bad in enumerate((0, 1, 2)):
        panel.hear("uuv-1", frame(packet, bad), now_s=float(packet))
    panel.hear("uuv-1", frame(2, 2), now_s=2.5)
    panel.take_queue(
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
    [now] = panel.link(now_s=10.0)
    assert (now["frames"], now["bad_frames"], now["loss"]) == (9, 3, 0.333)
    assert (now["snr_in_db"], now["stale"], now["age_s"]) == (12.0, False, 7.5)
    assert now["queue"]["images"][0]["expected_utc_s"] == 1040.0
    assert panel.wait_s("uuv-1", 1010.0) == 30.0
    [later] = panel.link(now_s=100.0)
    assert (later["stale"], later["queue"]["stale"], later["frames_per_minute"]) == (True, True, 0)


def test_events_are_kept_for_those_who_come_back():
    hub = Hub(kept=3)
    woken = []
    listener = hub.listen(lambda: woken.append(1))
    for number in range(5):
        hub.publish("contact", {"n": number})
    hub.leave(listener)
    hub.publish("contact", {"n": 5})
    assert len(woken) == 5
    assert [json.loads(e.data)["n"] for e in hub.since(4) or ()] == [4, 5]
    assert hub.since(6) == ()
    assert hub.since(2) is None
    assert hub.since(7) is None
    assert hub.number_of(hub.identifier(4)) == 4
    for other in ("", "4", f"{Hub().run}-4", f"{hub.run}-x", f"{hub.run}-{'9' * 30}"):
        assert hub.number_of(other) is None
    with pytest.raises(ValueError, match="Out of range"):
        hub.publish("contact", {"n": float("nan")})


def test_a_pace_is_kept_for_each_name():
    pace = Pace(1.0)
    times = [("a", 0.0), ("a", 0.5), ("b", 0.5), ("a", 1.0), ("a", 1.9), ("a", 2.0)]
    assert [pace.allows(*at) for at in times] == [True, False, True, True, False, True]


def test_exports_hold_what_is_asked_for(console):
    console.board.take_image(picture_record("0001"))
    console.board.take_image(picture_record("0002", vehicle="uuv-2", place=None))
    anna = console.browser("anna")
    console.decide(anna, "sonarpost.vessel-1.uuv-1.20231114T221320Z.0001")
    table = anna.get("/api/export/contacts.csv")
    assert "attachment" in table.headers["content-disposition"]
    rows = list(csv.DictReader(io.StringIO(table.content.decode("utf-8-sig"))))
    assert {row["name"]: row["review"] for row in rows} == {"uuv-1/0001": "mine_like", "uuv-2/0002": "unreviewed"}
    only = anna.get("/api/export/contacts.geojson", review="mine_like").json()
    assert [feature["properties"]["name"] for feature in only["features"]] == ["uuv-1/0001"]
    assert only["unlocated"] == []
    with zipfile.ZipFile(io.BytesIO(anna.get("/api/export/contacts.kmz").content)) as archive:
        assert any(name.endswith(".kml") for name in archive.namelist())
        assert any(name.endswith(".png") for name in archive.namelist())
    events = ET.fromstring(anna.get("/api/export/contacts.cot.xml").content)
    assert (events.tag, [child.tag for child in events]) == ("events", ["event"])
    assert anna.get("/api/export/contacts.exe").status_code == 404


def test_a_report_says_what_is_known_and_what_is_not(console):
    console.board.take_image(picture_record(missing_rows=10, altitude_m=None))
    anna = console.browser("anna")
    console.decide(anna, ID)
    page = anna.get(f"/report/{ID}").text
    assert "data:image/png;base64," in page
    assert "25.0 % (black in the picture)" in page
    assert '<dt>Altitude of the vehicle, m</dt><dd><span class="missing">not known</span></dd>' in page
    assert "clean edge" in page
    assert "style=" not in page


def test_intervals_of_the_papers_share():
    # 18 of 20, 95 %: the values of the literature.
    assert wilson(18, 20) == (pytest.approx(0.699, abs=1e-3), pytest.approx(0.972, abs=1e-3))
    assert clopper_pearson(18, 20) == (pytest.approx(0.683, abs=1e-3), pytest.approx(0.988, abs=1e-3))
    assert wilson(0, 0) == clopper_pearson(0, 0) == (0.0, 1.0)
    assert clopper_pearson(20, 20)[1] == 1.0
    assert wilson(0, 5)[0] == 0.0


def test_every_route_is_described(console):
    told = (REPOSITORY / "docs" / "specifications" / "console-api.md").read_text(encoding="utf-8")
    paths = [route.path for route in console.app.asgi._app.routes]
    assert len(paths) > 20
    for path in paths:
        *_, before, last = re.sub(r"\{(\w+):\w+\}", r"{\1}", path).split("/")
        known = {
            "/": "`GET /`",
            "/api/export/{name}": "/api/export/contacts.geojson",
            "/static/{path:path}": "`/static/`",
        }
        assert known.get(path, f"/{last}" if before in ("", "{version}") else f"{before}/{last}") in told, path
    for name in console.browser("watch").get("/api/info").json():
        assert f'"{name}"' in told


def test_every_field_of_a_contact_is_described(console):
    console.board.take_image(picture_record())
    anna = console.browser("anna")
    console.decide(anna, ID)
    whole = anna.get(f"/api/contacts/{ID}").json()
    told = (REPOSITORY / "docs" / "specifications" / "console-api.md").read_text(encoding="utf-8")
    for part in (whole, whole["contact"], whole["versions"][0], whole["decisions"][0], whole["audit"][0]):
        for name in part:
            assert f'"{name}"' in told, name
