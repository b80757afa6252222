"""The image in a real browser: size, mark, axes, orientation, ground range, gain, loupe, measuring by dragging."""

import json
import math

import numpy as np
import pytest
from builders.console import image_record, with_pixels

from sonarpost.review.measurement import measure_length

# Slant range 9.43 m at 8 m of altitude: ground range 5 m.
NEAR = {"altitude_m": 8.0, "ground_range_m": 5.0, "pixel_across_m": 0.02, "pixel_along_m": 0.05}
GREY = """([x, y]) => {
  const canvas = document.querySelector('.stage canvas');
  const ratio = canvas.width / canvas.clientWidth;
  return [...canvas.getContext('2d').getImageData(Math.round(x * ratio), Math.round(y * ratio), 1, 1).data].slice(0, 3);
}"""
MARK_PIXELS = """() => {
  const canvas = document.querySelector('.stage canvas');
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let i = 0; i < data.length; i += 4) count += data[i] > 200 && data[i + 1] < 110 && data[i + 2] > 170;
  return count;
}"""


def opened(served, record=None, **options):
    served.state.store_image(record or image_record("00A7"))
    visit = served.visit(**options)
    visit.wait_for_contact("00A7")
    return visit


def dataset(visit, name):
    return json.loads(visit.page.evaluate(f"document.querySelector('.stage canvas').dataset.{name} || 'null'"))


def description(visit):
    return visit.page.locator(".stage canvas").first.get_attribute("aria-description")


def at(visit, x, y):
    """Position on the page of a point of the canvas."""
    box = visit.page.locator(".stage canvas").first.bounding_box()
    return box["x"] + x, box["y"] + y


def drag(visit, start, end):
    visit.page.mouse.move(*at(visit, *start))
    visit.page.mouse.down()
    visit.page.mouse.move(*at(visit, *((start[i] + end[i]) / 2 for i in (0, 1))))
    visit.page.mouse.move(*at(visit, *end))
    visit.page.mouse.up()


def tool(visit, name):
    """A tool of the image; those that are used less are shown first."""
    if visit.page.locator(f"[data-tool={name}]").count() == 0:
        visit.page.locator("[data-tool=more]").click()
    return visit.page.locator(f"[data-tool={name}]")


def uniform(image, height_px=40, width_px=60):
    """The record with an image of grey 100, and a black and a white pixel: automatic gain keeps the levels."""
    pixels = np.full((height_px, width_px), 100, np.uint8)
    pixels[0, 0], pixels[0, -1] = 0, 255
    return with_pixels(image, pixels)


def test_mark_surrounds_the_contact_and_axes_name_the_range(served):
    visit = opened(served)
    corners = dataset(visit, "mark")
    [version] = served.contact()["versions"]
    assert visit.page.evaluate(MARK_PIXELS) > 50
    # The corners have the proportions of the box in metres: 20 rows of 0.1 m, 50.5 columns of 0.05 m.
    width, height = corners[2][0] - corners[0][0], corners[2][1] - corners[0][1]
    box = version["box"]
    metres = [(box["columns"][1] - box["columns"][0]) * 0.05, (box["rows"][1] - box["rows"][0]) * 0.1]
    assert width / height == pytest.approx(metres[0] / metres[1], rel=0.03)
    text = description(visit)
    assert "slant range, m (± 0.4)" in text
    assert "along-track from the contact, m" in text
    assert "starboard, mirrored" in text
    assert "contact marked" in text


def test_nothing_is_marked_where_the_place_is_unknown(served):
    visit = opened(served, image_record("00A7", altitude_m=None, channel=None, ground_range_m=None))
    assert dataset(visit, "mark") is None
    assert visit.page.evaluate(MARK_PIXELS) == 0
    assert "nadir side unknown" in description(visit)
    assert "contact marked" not in description(visit)
    assert tool(visit, "ground").get_attribute("aria-disabled") == "true"
    tool(visit, "ground").dispatch_event("click")
    visit.wait("#toasts >> text=No ground range")


def test_ground_range_view_has_the_computed_width(served):
    visit = opened(served, image_record("00A7", **NEAR))
    assert dataset(visit, "extent") == pytest.approx([1.2, 2.0])
    tool(visit, "ground").click()
    visit.until("() => /ground range, m/.test(document.querySelector('.stage canvas').ariaDescription)")
    [version] = served.contact()["versions"]
    mark = version["mark"]
    first, last = (mark["range_m"] + (column - mark["column"]) * 0.02 for column in (0, 60))
    expected = math.sqrt(last**2 - 8.0**2) - math.sqrt(first**2 - 8.0**2)
    assert expected > 1.5 * 1.2
    assert dataset(visit, "extent") == pytest.approx([expected, 2.0], abs=0.01)
    tool(visit, "ground").click()
    visit.until("() => /slant range, m/.test(document.querySelector('.stage canvas').ariaDescription)")


@pytest.mark.parametrize("side", ["port", "starboard"])
def test_view_from_above_and_north_up_have_the_true_handedness(served, side):
    # A heading of 0° is north up: both views are equal.
    visit = opened(served, image_record("00A7", channel=side, heading_deg=0.0))
    before = dataset(visit, "mark")
    visit.press("v")
    visit.until("() => /as seen from above/.test(document.querySelector('.stage canvas').ariaDescription)")
    above = dataset(visit, "mark")
    # Seen from above with the bow up, later rows are above earlier ones, and port is left of the nadir.
    assert (before[0][1] < before[2][1], above[0][1] > above[2][1]) == (True, True)
    assert (above[0][0] < above[2][0]) == (side == "starboard")
    visit.press("v")
    visit.until("() => /north up/.test(document.querySelector('.stage canvas').ariaDescription)")
    # Without the across-track scale the image has the same orientation.
    north = dataset(visit, "mark")
    assert [north[i][0] < north[(i + 2) % 4][0] for i in range(4)] == [
        above[i][0] < above[(i + 2) % 4][0] for i in range(4)
    ]
    visit.press("v")
    visit.until("() => /nadir/.test(document.querySelector('.stage canvas').ariaDescription)")
    assert dataset(visit, "mark") == before


def test_gain_changes_the_pixels_and_auto_restores_it(served):
    visit = opened(served, uniform(image_record("00A7")))
    visit.expect_errors("willReadFrequently")
    tool(visit, "grid").click()
    centre = [sum(axis) / 4 for axis in zip(*dataset(visit, "mark"), strict=True)]
    point = [centre[0] - 3, centre[1] - 3]
    pressed = "() => document.querySelector('[data-tool=auto]').ariaPressed === "

    def grey():
        return visit.page.evaluate(GREY, point)[0]

    # The image has levels from 0 to 255: the automatic gain leaves them.
    assert grey() == pytest.approx(100, abs=1)
    visit.press(".", ".")
    visit.until(f"{pressed} 'false'")
    assert grey() == pytest.approx(100 / 0.9, abs=1)
    visit.press(",", ",", ",", ",")
    assert grey() == pytest.approx(100 / 1.1, abs=1)
    visit.press("a")
    visit.until(f"{pressed} 'true'")
    assert grey() == pytest.approx(100, abs=1)


# Height and width in pixels, and metres of a pixel, of the contacts of `sonarpost demo` and of training.
SHAPES = {"demo": (80, 140, 0.1, 0.03), "training": (80, 140, 0.1, 30 / 512)}
SHARE_OF_GREY = """() => {
  const canvas = document.querySelector('.stage canvas');
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let i = 0; i < data.length; i += 4) {
    count += Math.abs(data[i] - 100) < 2 && data[i] === data[i + 1] && data[i + 3] === 255;
  }
  return count / (canvas.width / canvas.clientWidth) ** 2 / (innerWidth * innerHeight);
}"""


@pytest.mark.firefox
@pytest.mark.parametrize("shape", SHAPES)
def test_image_itself_fills_the_stage_and_what_qualifies_it_is_in_sight(served, shape):
    height_px, width_px, along_m, across_m = SHAPES[shape]
    fields = {"p_mine_like": 0.95, "p_other_object": 0.03, "position_sigma_m": 4.0, "heading_deg": 40.0}
    for version in (1, 2):
        record = image_record("00A7", version, pixel_along_m=along_m, pixel_across_m=across_m, **fields)
        record = record.model_copy(update={"despeckle_strength": 1.0, "complete": version == 2})
        served.state.store_image(uniform(record, height_px, width_px))
    visit = served.visit()
    visit.wait_for_contact("00A7")
    visit.expect_errors("willReadFrequently")
    tool(visit, "grid").click()
    visit.page.locator("[data-tool=more]").click()
    for size, least in (((1366, 768), 0.3), ((1920, 1080), 0.4), ((390, 844), 0.2)):
        visit.resize(*size)
        # Pixels under mark and north arrow do not count.
        share = visit.page.evaluate(SHARE_OF_GREY)
        print(f"{shape}, {size}: the image is {100 * share:.1f} % of the screen")  # shown by -rP
        assert share >= least
        heading, strip = visit.page.locator(".heading"), visit.page.locator(".strip")
        words = heading.inner_text(), strip.inner_text()
        for part in ("00A7", "2023-11-14 22:11:40 UTC", "N 005°", "± 4", "range 12", "altitude 5.0"):
            assert part in words[0].replace("  ", " "), part
        for part in ("200\u202fB", "sharp to", "despeckled", "image area missing 0", "mine-like 95\u202f%"):
            assert part in words[1], part
        for element in (heading, strip):
            box = element.bounding_box()
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= size[0]
            # Firefox rounds heights to whole pixels.
            hidden = element.evaluate("e => Math.max(e.scrollWidth - e.clientWidth, e.scrollHeight - e.clientHeight)")
            assert hidden <= 1
    # The arrow of north and the caption agree with a long image that lies along the screen.
    visit.resize(1366, 768)
    assert description(visit).startswith("▲ nadir" if shape == "demo" else "◀ nadir")
    first, _, third, _ = dataset(visit, "mark")
    # Turned clockwise: later rows are at the left, and larger ranges below.
    assert (first[0] > third[0], first[1] < third[1]) == (shape == "demo", True)


def test_pixels_that_are_not_square_are_interpolated_and_surroundings_dark(served):
    visit = opened(served)
    visit.expect_errors("willReadFrequently")
    colours = """() => {
      const canvas = document.querySelector('.stage canvas');
      const { data } = canvas.getContext('2d').getImageData(canvas.width / 2, canvas.height / 3, 60, 1);
      let changes = 0;
      for (let i = 4; i < data.length; i += 4) changes += data[i] !== data[i - 4];
      return changes;
    }"""
    tool(visit, "grid").click()
    smooth = visit.page.evaluate(colours)
    assert tool(visit, "smooth").get_attribute("aria-pressed") == "true"
    tool(visit, "smooth").click()
    assert visit.page.evaluate(colours) < smooth / 2
    assert tool(visit, "smooth").get_attribute("aria-pressed") == "false"
    for theme in ("day", "night"):
        visit.set_appearance(theme=theme)
        colour = visit.page.evaluate("getComputedStyle(document.querySelector('.stage')).backgroundColor")
        assert max(int(part) for part in colour[4:-1].split(",")) < 40


def test_ends_of_a_drag_move_to_the_edges_and_can_be_moved(served):
    # An object of rows 14 to 26 and columns 18 to 30.
    pixels = np.full((40, 60), 60, np.uint8)
    pixels[14:26, 18:30] = 200
    visit = opened(served, with_pixels(image_record("00A7"), pixels))
    visit.press("m")
    visit.wait(".hint >> text=next line is width")
    # The corners of the mark are those of the box.
    (left, top), _, (right, bottom), _ = dataset(visit, "mark")
    box = served.contact()["versions"][0]["box"]

    def point(row, column):
        parts = [(at - low) / (high - low) for at, (low, high) in ((column, box["columns"]), (row, box["rows"]))]
        return left + parts[0] * (right - left), top + parts[1] * (bottom - top)

    start, end = point(12.0, 24.0), point(27.5, 24.0)
    visit.page.mouse.move(*at(visit, *start))
    visit.page.mouse.down()
    visit.page.mouse.move(*at(visit, *end))
    # The loupe is visible, and is not empty.
    visit.wait(".loupe", state="visible")
    assert visit.pixels(".loupe") > 1000
    visit.page.mouse.up()
    visit.wait(".hint >> text=Enter keeps it")
    first = visit.text(".size[data-kind=length] b")
    # The drawn ends are at the edges: there they can be dragged. On seabed without an edge an end stays.
    drag(visit, point(26.0, 24.0), point(36.0, 24.0))
    visit.wait(".hint >> text=no edge found")
    assert visit.text(".size[data-kind=length] b") != first
    drag(visit, point(36.0, 24.0), point(27.0, 24.0))
    visit.wait(".hint >> text=no edge found", state="detached")
    drag(visit, point(14.0, 24.0), point(13.0, 24.0))
    visit.wait(".hint >> text=Enter keeps it")
    assert served.contact()["measurements"] == []
    visit.press("Enter")
    visit.wait(".hint >> text=next line is shadow")
    [stored] = served.contact()["measurements"]
    # After the first end was moved, the line is stored from end to start.
    assert [stored["from"][0], stored["to"][0]] == pytest.approx([26.0, 14.0], abs=0.2)
    assert stored["snapped"] == [True, True]
    image = image_record("00A7")
    line = measure_length(image.contact, image.missing(), tuple(stored["from"]), tuple(stored["to"]))
    assert stored["value_m"] == pytest.approx(math.sqrt(line.value_m**2 - stored["blur_m"] ** 2))
    visit.press("Escape")


def test_shadow_is_measured_across_the_track(served):
    visit = opened(served)
    visit.press("m", "m", "m")
    left, right = dataset(visit, "mark")[0], dataset(visit, "mark")[2]
    drag(visit, (left[0] + 40, left[1] + 60), (right[0] - 20, left[1] + 110))
    visit.wait(".hint >> text=Enter keeps it")
    visit.wait(".size[data-kind=height] b >> text=/[0-9] ± /")
    visit.press("Enter")
    visit.wait("[data-size=withdraw-shadow]")
    [stored] = served.contact()["measurements"]
    assert stored["from"][0] == stored["to"][0]
    assert (stored["along_m"], stored["metres"]) == (0.0, "slant")


def test_withdrawn_measurement_leaves_the_panel_and_stays_in_the_database(served):
    visit = opened(served)
    visit.press("m", "m", "Enter", *["Shift+ArrowRight"] * 3, "Enter")
    visit.wait("[data-size=keep]")
    visit.press("Enter")
    visit.wait("[data-size=withdraw-width]")
    visit.press("Escape")
    visit.page.locator("[data-size=withdraw-width]").click()
    visit.until("() => document.querySelector('.size[data-kind=width] b').textContent === '\u2013'")
    detail = served.contact()
    assert [one["withdrawn_by"] for one in detail["measurements"]] == ["anna"]
    assert detail["size"]["width"] is None
    visit.wait('details[data-name="measurements"] li.undone')


@pytest.mark.chromium_only("Playwright sends touches of two fingers to Chromium only")
def test_two_fingers_zoom_the_image(served):
    visit = opened(served, has_touch=True)
    extent = "() => JSON.parse(document.querySelector('.stage canvas').dataset.mark)"
    before = visit.page.evaluate(extent)
    x, y = at(visit, *before[0])
    touch = visit.page.context.new_cdp_session(visit.page)

    def send(kind, *points):
        touch_points = [{"x": px, "y": py, "id": i} for i, (px, py) in enumerate(points)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touch_points})

    send("touchStart", (x + 40, y + 80), (x + 80, y + 80))
    send("touchMove", (x + 20, y + 80), (x + 100, y + 80))
    send("touchMove", (x, y + 80), (x + 120, y + 80))
    send("touchEnd")
    after = visit.page.evaluate(extent)
    assert after[2][0] - after[0][0] > 2 * (before[2][0] - before[0][0])
