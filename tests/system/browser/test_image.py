"""The image in a real browser: mark, axes, orientation, ground range, gain, loupe, measuring by dragging."""

from __future__ import annotations

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


def uniform(image):
    """The record with an image of constant grey 100, and one darker and one brighter pixel."""
    pixels = np.full((40, 60), 100, np.uint8)
    pixels[0, 0], pixels[0, 59] = 0, 255
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
    assert visit.page.locator("[data-tool=ground]").get_attribute("aria-disabled") == "true"
    visit.press("b")
    visit.wait("#toasts >> text=No ground range")


def test_ground_range_view_has_the_computed_width(served):
    visit = opened(served, image_record("00A7", **NEAR))
    assert dataset(visit, "extent") == pytest.approx([1.2, 2.0])
    visit.press("b")
    visit.until("() => /ground range, m/.test(document.querySelector('.stage canvas').ariaDescription)")
    [version] = served.contact()["versions"]
    mark = version["mark"]
    first, last = (mark["range_m"] + (column - mark["column"]) * 0.02 for column in (0, 60))
    expected = math.sqrt(last**2 - 8.0**2) - math.sqrt(first**2 - 8.0**2)
    assert expected > 1.5 * 1.2
    assert dataset(visit, "extent") == pytest.approx([expected, 2.0], abs=0.01)
    visit.press("b")
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


def test_gamma_black_point_and_white_point_change_the_pixels(served):
    visit = opened(served, uniform(image_record("00A7")))
    visit.expect_errors("willReadFrequently")
    visit.press("#")
    centre = [sum(axis) / 4 for axis in zip(*dataset(visit, "mark"), strict=True)]
    point = [centre[0] - 3, centre[1] - 3]

    def grey():
        return visit.page.evaluate(GREY, point)[0]

    visit.press("I")
    visit.wait("#level-gamma", state="visible")

    def level(name, value):
        visit.page.locator(f"#level-{name}").evaluate(
            "(input, value) => { input.value = value; input.dispatchEvent(new Event('input')); }", value
        )

    for name, value in (("low", 0), ("high", 100), ("gamma", 1)):
        level(name, value)
    assert grey() == pytest.approx(100, abs=1)
    level("gamma", 2)
    assert grey() == pytest.approx(255 * math.sqrt(100 / 255), abs=2)
    level("gamma", 1)
    level("low", 20)
    assert grey() == pytest.approx((100 - 51) / (255 - 51) * 255, abs=2)
    assert visit.page.locator("[data-tool=auto]").get_attribute("aria-pressed") == "false"
    visit.press("(")
    assert float(visit.page.locator("#level-gamma").input_value()) < 1


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
    visit.press("#")
    smooth = visit.page.evaluate(colours)
    assert visit.page.locator("[data-tool=smooth]").get_attribute("aria-pressed") == "true"
    visit.press("d")
    assert visit.page.evaluate(colours) < smooth / 2
    assert visit.page.locator("[data-tool=smooth]").get_attribute("aria-pressed") == "false"
    for _theme in range(2):
        colour = visit.page.evaluate("getComputedStyle(document.querySelector('.stage')).backgroundColor")
        assert max(int(part) for part in colour[4:-1].split(",")) < 40
        visit.press("t")


def test_one_drag_measures_and_both_ends_can_be_moved(served):
    visit = opened(served)
    visit.press("4")
    visit.wait(".hint >> text=next line is width")
    left, right = dataset(visit, "mark")[0], dataset(visit, "mark")[2]
    start, end = (left[0] + 40, left[1] + 30), (right[0] - 40, right[1] - 60)
    visit.page.mouse.move(*at(visit, *start))
    visit.page.mouse.down()
    visit.page.mouse.move(*at(visit, *end))
    # The loupe is visible, and is not empty.
    visit.wait(".loupe", state="visible")
    assert visit.pixels(".loupe") > 1000
    visit.page.mouse.up()
    visit.wait(".hint >> text=Enter keeps it")
    first = visit.text(".size[data-kind=length] b")
    # Both ends can be moved.
    moved = (end[0], end[1] + 40)
    drag(visit, end, moved)
    visit.until("text => document.querySelector('.size[data-kind=length] b').textContent !== text", first)
    visit.wait(".hint >> text=Enter keeps it")
    second = visit.text(".size[data-kind=length] b")
    drag(visit, start, (start[0], start[1] + 20))
    visit.until("text => document.querySelector('.size[data-kind=length] b').textContent !== text", second)
    visit.wait(".hint >> text=Enter keeps it")
    assert served.contact()["measurements"] == []
    visit.press("Enter")
    visit.wait(".hint >> text=next line is shadow")
    [stored] = served.contact()["measurements"]
    # The canvas has as many pixels per metre as the mark.
    box = served.contact()["versions"][0]["box"]
    unit = (right[1] - left[1]) / ((box["rows"][1] - box["rows"][0]) * 0.1)
    assert stored["along_m"] == pytest.approx((moved[1] - start[1] - 20) / unit, rel=0.03)
    image = image_record("00A7")
    # After both ends were moved, the line is stored from end to start.
    expected = measure_length(image.contact, image.missing(), tuple(stored["from"]), tuple(stored["to"])).value_m
    assert stored["value_m"] == pytest.approx(expected)
    visit.press("Escape")


def test_shadow_is_measured_across_the_track(served):
    visit = opened(served)
    visit.press("6")
    left, right = dataset(visit, "mark")[0], dataset(visit, "mark")[2]
    drag(visit, (left[0] + 40, left[1] + 60), (right[0] - 20, left[1] + 110))
    visit.wait(".hint >> text=Enter keeps it")
    visit.press("Enter")
    visit.wait(".size[data-kind=height] b >> text=/[0-9] ± /")
    [stored] = served.contact()["measurements"]
    assert stored["from"][0] == stored["to"][0]
    assert (stored["along_m"], stored["metres"]) == (0.0, "slant")


def test_withdrawn_measurement_leaves_the_panel_and_stays_in_the_database(served):
    visit = opened(served)
    visit.press("5", "Enter", *["Shift+ArrowRight"] * 3, "Enter")
    visit.wait(".hint >> text=Enter keeps it")
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
