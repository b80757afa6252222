"""The map in a real browser: symbols, clusters, position of the cursor, keys, tiles, 13,380 contacts."""

import math
import re
from operator import itemgetter

import pytest
from builders.console import image_record
from builders.record_samples import SAMPLES
from PIL import Image

from sonarpost.review.positions import destination, distance_m

VESSEL = (56.0, -5.0)
POSITION = re.compile(r"(\d+)° ([\d.]+)\u2032 ([NS])\s+(\d+)° ([\d.]+)\u2032 ([EW])")
SYMBOL_AT = """id => {
  const dot = document.querySelector(`.map .contact[title^="uuv-1/${id}"] .dot`).getBoundingClientRect();
  const chart = document.querySelector('.map .chart').getBoundingClientRect();
  return [dot.x + dot.width / 2 - chart.x, dot.y + dot.height / 2 - chart.y];
}"""
CHOSEN = "() => document.querySelector('.map .card h3')?.firstChild.textContent"


def add(served, image_id, bearing_deg, range_m, **fields):
    served.state.store_image(image_record(image_id, position=destination(*VESSEL, bearing_deg, range_m), **fields))


def scene(serve, **options):
    """Five contacts around a vessel, from west to east 0004, 0003, 0001, 0002, 0005."""
    served = serve(vessel_lat_deg=VESSEL[0], vessel_lon_deg=VESSEL[1], ring_m=[100.0, 400.0], **options)
    add(served, "0001", 0.0, 300.0, position_sigma_m=40.0)
    add(served, "0002", 90.0, 300.0, atd_class="structure")
    add(served, "0003", 180.0, 300.0, heading_deg=90.0)
    add(served, "0004", 270.0, 300.0, heading_deg=None)
    add(served, "0005", 90.0, 450.0)
    return served


def open_map(served, **options):
    visit = served.visit(**options)
    visit.press("p")
    visit.wait(".map[data-drawn]")
    return visit


def chart_box(visit):
    return visit.page.locator(".map .chart").bounding_box()


def degrees(text):
    """Latitude and longitude of a text in degrees and decimal minutes."""
    lat, lat_min, north, lon, lon_min, east = POSITION.search(text).groups()
    return (
        (int(lat) + float(lat_min) / 60) * (1 if north == "N" else -1),
        (int(lon) + float(lon_min) / 60) * (1 if east == "E" else -1),
    )


def test_symbols_are_at_their_true_places(serve):
    served = scene(serve)
    visit = open_map(served)
    page = visit.page
    assert page.locator(".map .contact").count() == 5
    assert page.locator(".map .contact .dot.structure").count() == 1
    at = {number: page.evaluate(SYMBOL_AT, f"000{number}") for number in (1, 2, 3, 4, 5)}
    # North is up, and the same range has the same length in all directions.
    centre = [(at[2][0] + at[4][0]) / 2, (at[1][1] + at[3][1]) / 2]
    north, east = centre[1] - at[1][1], at[2][0] - centre[0]
    assert north == pytest.approx(east, rel=0.02)
    assert at[1][0] == pytest.approx(centre[0], abs=1.5)
    assert (at[5][0] - centre[0]) / east == pytest.approx(1.5, abs=0.02)
    # The range rings have their radius on the same scale.
    widths = [one["width"] for one in (ring.bounding_box() for ring in page.locator(".map path.ring").all())]
    assert max(widths) / 2 == pytest.approx(east * 400.0 / 300.0, rel=0.02)
    # Four contacts have a heading; the position circle of 40 m is larger than its symbol.
    assert page.locator(".map .contact .tick").count() == 4
    turns = page.locator(".map .contact .tick").evaluate_all("list => list.map(one => one.style.rotate)")
    assert sorted(turns) == ["0deg", "0deg", "0deg", "90deg"]
    assert page.locator(".map path.sigma").bounding_box()["width"] / 2 == pytest.approx(east * 40.0 / 300.0, rel=0.05)
    # Frame, scale and distances are labelled.
    assert "\u2032 N" in visit.text(".map .at-west")
    assert "\u2032 W" in visit.text(".map .at-south")
    assert re.search(r"\d+ k?m$", visit.text(".map .leaflet-control-scale-line"))
    assert visit.text(".map .ring-label").endswith("m")
    # No line joins contacts: apart from frame, rings and circles there is no path.
    assert page.locator(".map path:not(.frame-line, .ring, .sigma)").count() == 0


def test_track_surveyed_area_and_measured_distance(serve):
    served = scene(serve)
    first = SAMPLES["received-status"]
    for number in range(3):
        lat_deg, lon_deg = destination(*VESSEL, 90.0, 100.0 + 100.0 * number)
        changes = {"lat_deg": lat_deg, "lon_deg": lon_deg, "time_utc_s": 1_700_000_000.0 + number, "swath_m": 50.0}
        status = first.status.model_copy(update=changes)
        served.state.store_status(first.model_copy(update={"status": status}))
    served.state.fleet.set_range(SAMPLES["vehicle-range"].model_copy(update={"distance_m": 300.0}))
    visit = open_map(served)
    page = visit.page
    track = page.locator(".map path.track").bounding_box()
    at = {number: page.evaluate(SYMBOL_AT, f"000{number}") for number in (2, 4)}
    pixels_per_m = (at[2][0] - at[4][0]) / 600.0
    assert track["width"] == pytest.approx(200.0 * pixels_per_m, abs=4.0)
    circle = page.locator(".map path.measured-range").bounding_box()
    assert circle["width"] == pytest.approx(600.0 * pixels_per_m, rel=0.02)
    assert any("uuv-1: 300" in text for text in page.locator(".map .ring-label").all_inner_texts())
    # 200 m of track, 50 m to each side.
    swath = page.locator(".map path.swath").bounding_box()
    assert (swath["width"], swath["height"]) == pytest.approx((200.0 * pixels_per_m, 100.0 * pixels_per_m), rel=0.03)
    assert re.search(r"Surveyed area (19|20),?\d{3}\u202fm², since 14 Nov 2023", visit.text(".map .surveyed"))
    # Its position is years old, as Link states too.
    assert "uuv-1 (14 Nov 2023, stale)" in visit.text(".map .vehicle.old .name")
    # The label of a vehicle at the same place is beside the first one.
    other_status = status.model_copy(update={"vehicle_id": "uuv-2", "time_utc_s": 1_700_000_003.0})
    served.state.store_status(first.model_copy(update={"vehicle_id": "uuv-2", "status": other_status}))
    visit = open_map(served)
    visit.until("() => document.querySelectorAll('.map .vehicle .name').length === 2")
    names = visit.page.locator(".map .vehicle .name").all()
    one, other = sorted((name.bounding_box() for name in names), key=itemgetter("y"))
    assert one["y"] + one["height"] <= other["y"] or abs(one["x"] - other["x"]) >= min(one["width"], other["width"])


def test_range_and_bearing_of_the_cursor(serve):
    served = scene(serve)
    visit = open_map(served)
    page, box = visit.page, chart_box(visit)
    x, y = page.evaluate(SYMBOL_AT, "0002")
    page.mouse.move(box["x"] + x + 60, box["y"] + y - 40)
    cursor = degrees(visit.text(".map .readout"))
    shown = re.search(r"from vessel (\d+)\s*m (\d+)°", visit.text(".map .readout"))
    assert float(shown[1]) == pytest.approx(distance_m(*VESSEL, *cursor), abs=2.0)
    # From the selected contact to another one.
    page.mouse.click(box["x"] + x, box["y"] + y)
    visit.until(f"() => ({CHOSEN})() === 'uuv-1/0002'")
    x, y = page.evaluate(SYMBOL_AT, "0004")
    page.mouse.move(box["x"] + x, box["y"] + y)
    assert re.search(r"from uuv-1/0002 (599|600|601)\s*m 270°", visit.text(".map .readout"))


def test_geometry_is_that_of_the_ellipsoid(served):
    visit = served.visit(path="login", user="")
    for start, bearing_deg, range_m in (
        (VESSEL, 33.0, 500.0),
        (VESSEL, 271.0, 40_000.0),
        ((-33.5, 151.0), 185.0, 100_000.0),
        ((70.0, 179.99), 80.0, 20_000.0),
        ((0.0, 0.0), 45.0, 1000.0),
    ):
        end = destination(*start, bearing_deg, range_m)
        found = visit.page.evaluate(
            """async ([a, b]) => {
              const { rangeBearing, offset } = await import('/static/js/map/map_geometry.js');
              const position = ([lat_deg, lon_deg]) => ({ lat_deg, lon_deg });
              const { range_m, bearing_deg } = rangeBearing(position(a), position(b));
              return { range_m, bearing_deg, there: offset(position(a), bearing_deg, Math.min(range_m, 1000)) };
            }""",
            [start, end],
        )
        assert found["range_m"] == pytest.approx(range_m, rel=1e-3)
        assert found["bearing_deg"] == pytest.approx(bearing_deg, abs=0.1)
        assert distance_m(*start, *found["there"]) == pytest.approx(min(range_m, 1000.0), rel=1e-3)
    minutes = visit.page.evaluate(
        "async () => { const { latitude } = await import('/static/js/base/format.js');"
        " return [55.999999999, -0.0083333, 12.5].map(latitude); }"
    )
    assert minutes == ["56° 00.000\u2032 N", "00° 00.500\u2032 S", "12° 30.000\u2032 N"]


def test_keys_select_from_west_to_east(serve):
    served = scene(serve)
    visit = open_map(served)
    page = visit.page
    for number in ("0004", "0003", "0001", "0002", "0005"):
        visit.press("j")
        visit.until(f"() => ({CHOSEN})() === 'uuv-1/{number}'")
    assert "450" in visit.text(".map .card")
    assert degrees(visit.text(".map .card")) == pytest.approx(destination(*VESSEL, 90.0, 450.0), abs=1e-4)
    visit.press("k")
    visit.until(f"() => ({CHOSEN})() === 'uuv-1/0002'")
    visit.press("Enter")
    visit.wait_for_contact("0002")
    assert page.locator(".review").is_visible()


def test_zoom_pan_and_fit_by_keys(serve):
    served = scene(serve)
    visit = open_map(served)
    page = visit.page
    before = page.evaluate(SYMBOL_AT, "0001")
    visit.press("ArrowRight")
    moved = page.evaluate(SYMBOL_AT, "0001")
    assert moved[0] == pytest.approx(before[0] - 80, abs=1.5)
    visit.press("0")
    assert page.evaluate(SYMBOL_AT, "0001") == pytest.approx(before, abs=1.5)
    count = "() => document.querySelector('.map .legend').innerText"
    assert "5 of 5 contacts" in page.evaluate(count)
    visit.press("+", "+", "+", "+", "+", "+")
    visit.until(f"() => /[0-4] of 5 contacts/.test(({count})())")
    visit.press("-", "-", "-", "-", "-", "-")
    visit.until(f"() => /5 of 5 contacts/.test(({count})())")


def test_cluster_has_the_worst_verdict(serve):
    served = serve()
    for number in range(6):
        served.state.store_image(image_record(f"000{number}", position=(56.0, -5.0 + 3e-5 * number)))
    served.state.store_image(image_record("0006", position=(56.1, -5.0)))
    browser = served.client("anna")
    points = {image_id: one["id"] for image_id, one in browser.chart().items()}
    for number, verdict in (("0000", "not_mine_like"), ("0003", "unsure")):
        assert browser.decide(points[number], verdict=verdict).status_code == 201
    visit = open_map(served)
    page = visit.page
    clusters = page.locator(".map .cluster")
    assert clusters.count() == 1
    count = int(visit.text(".map .cluster span"))
    assert (count, clusters.get_attribute("title")) == (6, "6 contacts, worst verdict: unsure")
    browser.decide(points["0001"], verdict="mine_like")
    # The event of the server updates the open map.
    visit.wait(".map .cluster.mine_like .dot")
    page.locator(".map .cluster .dot").click()
    visit.until("() => !document.querySelector('.map .cluster')")
    assert page.locator(".map .contact").count() == 6


def test_contacts_on_both_sides_of_the_180th_meridian(serve):
    served = serve()
    for number, lon_deg in enumerate((179.999, -179.999)):
        served.state.store_image(image_record(f"000{number}", position=(-40.0, lon_deg)))
    visit = open_map(served)
    west, east = (visit.page.evaluate(SYMBOL_AT, f"000{number}") for number in (0, 1))
    assert 200 < east[0] - west[0] < 1000
    visit.press("j", "j")
    visit.until(f"() => ({CHOSEN})() === 'uuv-1/0001'")
    assert "W" in visit.text(".map .card .number")


def test_tiles_of_a_folder_are_dark_at_night(serve, tmp_path):
    for zoom in (14, 15, 16, 17):
        size = 2**zoom
        column = int((VESSEL[1] + 180) / 360 * size)
        row = int((1 - math.asinh(math.tan(math.radians(VESSEL[0]))) / math.pi) / 2 * size)
        for x in range(column - 6, column + 7):
            for y in range(row - 6, row + 7):
                path = tmp_path / str(zoom) / str(x) / f"{y}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.new("RGB", (256, 256), (250, 250, 250)).save(path)
    served = scene(serve, tiles_dir=tmp_path)
    visit = open_map(served)
    visit.wait(".map .leaflet-tile-loaded")
    page = visit.page
    brightness = "() => getComputedStyle(document.querySelector('.map .leaflet-tile-pane')).filter"
    assert page.evaluate(brightness) == "none"
    visit.set_appearance(theme="night")
    assert "brightness(0.4)" in page.evaluate(brightness)


def test_map_is_loaded_at_its_first_use(serve):
    served = scene(serve)
    visit = served.visit()
    loaded = "() => performance.getEntriesByType('resource').filter(one => one.name.includes('/vendor/')).length"
    assert visit.page.evaluate(loaded) == 0
    visit.press("p")
    visit.wait(".map[data-drawn]")
    assert visit.page.evaluate(loaded) == 2


def test_13380_contacts_are_all_on_the_map(serve):
    served = serve(vessel_lat_deg=VESSEL[0], vessel_lon_deg=VESSEL[1])
    add(served, "0000", 0.0, 10.0, position_sigma_m=5.0)
    with served.state.database.transaction() as db:
        # Copies of one contact: storing images and associating objects are not measured here.
        first = dict(db.execute("SELECT * FROM contact").fetchone())
        marks = ", ".join("?" * len(first))
        for number in range(1, 13380):
            lat_deg, lon_deg = destination(*VESSEL, 137.508 * number, 70.0 * number**0.5)
            changes = {
                "id": f"{first['id'][:-4]}{number:05d}",
                "image_id": f"{number:05d}",
                "name": f"uuv-1/{number:05d}",
            }
            changes |= {"lat_deg": lat_deg, "lon_deg": lon_deg, "group_id": None}
            db.execute(f"INSERT INTO contact VALUES ({marks})", tuple((first | changes).values()))
            copied = "version, received_utc_s, rate, payload, removed"
            sql = f"INSERT INTO version (contact_id, {copied}) SELECT ?, {copied} FROM version WHERE contact_id = ?"
            db.execute(sql, (changes["id"], first["id"]))
    visit = served.visit()
    took_ms = visit.page.evaluate(
        """async () => {
          const element = document.querySelector('.map');
          const isDrawn = () => element.dataset.drawn === '13380';
          const drawn = new Promise((resolve) => {
            new MutationObserver(() => isDrawn() && resolve()).observe(element, { attributes: true });
          });
          const start_ms = performance.now();
          document.dispatchEvent(new KeyboardEvent('keydown', { key: 'p', bubbles: true }));
          await drawn;
          const loaded_ms = performance.now() - start_ms;
          await new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
          return [loaded_ms, performance.now() - start_ms];
        }"""
    )
    again_ms = visit.page.evaluate(
        """async () => {
          const start_ms = performance.now();
          document.dispatchEvent(new KeyboardEvent('keydown', { key: '+', bubbles: true }));
          await new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
          return performance.now() - start_ms;
        }"""
    )
    print(f"\n13,380 contacts: map {took_ms[1]:.0f} ms with data and library, zoom {again_ms:.0f} ms")
    visit.press("0")
    # The selected contact is a symbol of its own, and so are contacts without a neighbour.
    clusters = visit.page.locator(".map .cluster span").evaluate_all("list => list.map(one => Number(one.textContent))")
    # Few elements are drawn, and none is left out.
    assert 20 < len(clusters) < 1000
    assert sum(clusters) + visit.page.locator(".map .contact").count() == 13380
    assert "13380 of 13380 contacts" in visit.text(".map .legend").replace(",", "")


def test_click_on_contacts_at_one_place_selects_each_in_turn(serve):
    served = serve()
    for number in range(3):
        served.state.store_image(image_record(f"000{number}", position=VESSEL))
    visit = open_map(served)
    visit.press(*["+"] * 12)
    found = set()
    for _ in range(3):
        before = visit.page.evaluate(CHOSEN)
        visit.page.evaluate("document.querySelector('.map .cluster, .map .contact:not(.chosen)').click()")
        visit.until(f"before => ({CHOSEN})() && ({CHOSEN})() !== before", before)
        found.add(visit.page.evaluate(CHOSEN))
    assert len(found) == 3
